"""Section of `inverse_surface`: target, start and both results, how they converged, and what is left."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.report import plots
from experiments.report.page import Column, Gallery, Picture, Plot, Section, Table, picture
from experiments.report.style import OTHERS, fixed, text
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.inverse_surface import Config

VIEWS = {"held_out": "A held-out view", "training": "A training view"}
PANELS = (
    ("misfit", "Misfit of training views"),
    ("iou", "Masks, held out: 1 − IoU"),
    ("depth_rms", "Depth, held out: RMS / world units"),
    ("normal_angle", "Normal, held out: mean angle / °"),
)

CAPTION = (
    "Two rows for each recovery. Normals as ½ + ½ n. Errors: grey, differences of depth where both hit, white from 0.1 "
    "world units on; red, hit where the target is not; blue, missed where it is."
)


def draw(config: Config, records: Mapping[str, Record], folder: Path) -> Section:
    """The section of the report."""
    listed = list(records.values())
    parts = [Section(title, (), [_view(listed, view, folder)]) for view, title in VIEWS.items()]
    names = list(dict.fromkeys(r["compared"] for r in listed))
    drawn = convergence(listed, lambda r: _look(r, names), PANELS, "inverse-surface")
    parts.append(Section("Convergence", (), [drawn, _numbers(listed)]))
    return Section("From depths, normals and silhouettes back to a volume", _lead(config), (), parts)


def _lead(config: Config) -> list[str]:
    views = config.views
    compared = "; ".join(f"{n}: {w.mask:g}, {w.depth:g}, {w.normal:g}" for n, w in config.weights.items())
    return [
        f"The target is the level set of {len(config.balls)} Gaussians, sampled at {config.target_resolution}³. A "
        f"volume of {config.resolution}³ voxels, {config.method.key}, starts as a ball of radius {config.radius:g} and "
        f"is to have the same images in {views.training} views of {views.size}² pixels; {views.held_out} others are "
        f"never matched. {config.descent.iterations} steps of Adam, views of each: {views.at_once}; smoothness "
        f"{config.smoothness:g}. Weights of masks, depths and normals: {compared}.",
        "Hits move with the volume, and so do depths and normals; but whether a ray hits has no derivative of its own. "
        "“With silhouettes”, derivatives have the part by which the edges of what is seen sweep over pixels, found on "
        f"{config.lines} line{'s' * (config.lines > 1)} through every pixel. “Without”, masks pull at nothing; depths "
        "still do, as what one view sees beside the ball is in front of it for another.",
    ]


def _name(record: Record) -> str:
    return f"{record['compared']}, {record['kind']} silhouettes"


def _look(record: Record, names: Sequence[str]) -> dict:
    """Of a curve: a colour for what is compared, dashed without silhouettes."""
    color = OTHERS[names.index(record["compared"]) % len(OTHERS)].light
    return {"color": color, "linestyle": "-" if record["kind"] == "with" else "--", "label": _name(record)}


def _view(records: Sequence[Record], view: str, folder: Path) -> Gallery:
    pictures = []
    for r in records:
        pictures += two_rows(r["images"][view], _name(r), folder)
    return Gallery(pictures, CAPTION, columns=4)


def two_rows(images: Record, name: str, folder: Path) -> list[Picture]:
    """Four pictures of one view, twice: target, start, result, and errors."""
    return [
        picture(folder, images["target"], "target"),
        picture(folder, images["start"], "start"),
        picture(folder, images["result"], "result", name),
        picture(folder, images["start_error"], "error of the start"),
        picture(folder, images["target_normal"], "normals of the target"),
        picture(folder, images["start_normal"], "normals of the start"),
        picture(folder, images["result_normal"], "normals of the result", name),
        picture(folder, images["result_error"], "error of the result", name),
    ]


def convergence(
    records: Sequence[Record], look: Callable[[Record], dict], panels: Sequence[tuple[str, str]], name: str
) -> Plot:
    """Curves of what was observed, a panel for each quantity and title."""
    with plots.settings():
        figure = plots.canvas(10.4, 3.4)
        for axes, (quantity, title) in zip(figure.subplots(1, len(panels)), panels, strict=True):
            for r in records:
                axes.plot(*zip(*_course(r, quantity), strict=True), **look(r))
            axes.set_title(title, fontsize=9)
            axes.set_xlabel("iteration")
            axes.set_xlim(left=0)
            values = [value for r in records for _, value in _course(r, quantity)]
            if values and 0 < min(values) < max(values):  # else there is nothing that a logarithm could show
                plots.logarithmic(axes)
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False)
        drawn = plots.svg(figure, name)
    caption = "The misfit is the mean of the steps since the measurement before; the others are of all held-out views."
    return Plot(drawn, caption)


def _course(record: Record, quantity: str) -> list[tuple[int, float]]:
    """What is drawn: nothing where there is no number, and of masks how much is missing."""
    seen = [(o["iteration"], o[quantity]) for o in record["observations"] if o[quantity] is not None]
    return [(i, 1 - value) for i, value in seen] if quantity == "iou" else seen


def _numbers(records: Sequence[Record]) -> Table:
    columns = [
        Column("", numeric=False),
        Column("masks", "IoU"),
        Column("depth", "RMS"),
        Column("normal", "mean angle, °"),
        Column("time", "s"),
    ]
    rows = [_row("start", records[0]["observations"][0], None)] if records else []
    rows += [_row(_name(r), r["observations"][-1], r.get("seconds")) for r in records]
    caption = (
        "Held-out views, depths and normals where both hit: little says much only where the masks agree. Wall-clock "
        "seconds; they depend on what else ran."
    )
    return Table(columns, rows, caption)


def _row(name: str, seen: Record, seconds: float | None) -> list[str]:
    return [name, fixed(seen["iou"], 4), text(seen["depth_rms"]), fixed(seen["normal_angle"], 2), fixed(seconds, 0)]
