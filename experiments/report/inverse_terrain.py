"""Section of `inverse_terrain`: target, start and results, how they converged, and what is left."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.report import plots
from experiments.report.page import Column, Gallery, Plot, Section, Table, picture
from experiments.report.style import OTHERS, text
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.inverse_terrain import Config

PANELS = (
    ("height_rms", "Surface: RMS / relief"),
    ("depth_rms", "Depth, held out: RMS / relief"),
    ("shade_rms", "Shade, held out: RMS"),
)

LEFT = (*PANELS, ("data_rms", "Data: RMS / relief"))


def draw(config: Config, records: Mapping[str, Record], folder: Path) -> Section:
    """The section of the report."""
    listed = list(records.values())
    views, n = config.views, config.samples
    weights = "; ".join(f"{name}: {w.depth:g}, {w.shade:g}" for name, w in config.weights.items())
    lead = (
        f"Franke's function at {n} × {n} places, a {config.spline} spline. Heights are flat at first and are to have "
        f"the same depths and shades in {views.count} views of {views.size}² pixels; one more is never matched. Shades "
        "are those of three suns, one in each colour channel, on matt ground without shadows. "
        f"{config.descent.iterations} steps of Adam, one view each; smoothness {config.smoothness:g}. Weights of depth "
        f"and shade: {weights}. The derivatives are those of hits: no mesh, no stepping.",
    )
    return Section(
        "Heights from depths and shaded images", lead, [_views(listed, folder), _course(listed), _left(listed)]
    )


def _views(records: Sequence[Record], folder: Path) -> Gallery:
    pictures = []
    for r in records:
        for kind, what in (("tinted", "by height"), ("shaded", "three suns")):
            target, result = (r["images"][name][kind] for name in ("target", "result"))
            pictures.append(picture(folder, target, "target", what))
            pictures.append(picture(folder, result, f"from {r['compared']}", what))
    return Gallery(pictures, "The held-out view, beside that of the target.", columns=4)


def _course(records: Sequence[Record]) -> Plot:
    with plots.settings():
        figure = plots.canvas(10.4, 3.4)
        for axes, (quantity, title) in zip(figure.subplots(1, len(PANELS)), PANELS, strict=True):
            for k, r in enumerate(records):
                seen = [(o["iteration"], o[quantity]) for o in r["observations"] if o[quantity] is not None]
                axes.plot(*zip(*seen, strict=True), color=OTHERS[k % len(OTHERS)].light, label=f"from {r['compared']}")
            axes.set_title(title, fontsize=9)
            axes.set_xlabel("iteration")
            axes.set_xlim(left=0)
            plots.logarithmic(axes)
        handles, labels = figure.axes[0].get_legend_handles_labels()
        figure.legend(handles, labels, loc="outside lower center", ncols=3, frameon=False)
        drawn = plots.svg(figure, "inverse-terrain")
    return Plot(drawn, "Heights and depths as parts of the relief, from the lowest height to the highest.")


def _left(records: Sequence[Record]) -> Table:
    titles = [title.split(": ") for _, title in LEFT]
    columns = [Column("", numeric=False)] + [Column(quantity, unit) for quantity, unit in titles]
    rows = []
    if records:
        rows.append(["start", *_numbers(records[0]["observations"][0])])
    rows += [[f"from {r['compared']}", *_numbers(r["observations"][-1])] for r in records]
    caption = (
        "RMS differences from the target. Data may differ where surfaces don't: the patches of a cell of c1 depend on "
        "five combinations of its nine data. What nobody can see, the penalty decides."
    )
    return Table(columns, rows, caption)


def _numbers(seen: Record) -> list[str]:
    return [text(seen[quantity]) for quantity, _ in LEFT]
