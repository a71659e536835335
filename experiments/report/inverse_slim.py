"""Section of `inverse_slim`: target, start and results, how they converged, and what is left."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.report.inverse_surface import CAPTION, VIEWS, convergence, two_rows
from experiments.report.page import Column, Gallery, Section, Table
from experiments.report.style import OTHERS, fixed, text
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.inverse_slim import Config

PANELS = (
    ("misfit", "Misfit of training views"),
    ("distance", "From the torus, held out: RMS"),
    ("depth_rms", "Depth, held out: RMS / world units"),
    ("normal_angle", "Normal, held out: mean angle / °"),
)


def draw(config: Config, records: Mapping[str, Record], folder: Path) -> Section:
    """The section of the report."""
    listed = list(records.values())
    parts = [Section(title, (), [_view(listed, view, folder)]) for view, title in VIEWS.items()]
    names = list(config.weights)
    look = lambda r: {"color": OTHERS[names.index(r["compared"]) % len(OTHERS)].light, "label": r["compared"]}  # noqa: E731
    drawn = convergence(listed, look, PANELS, "inverse-slim")
    parts.append(Section("Convergence", (), [drawn, _numbers(listed)]))
    return Section("A rough cover, refined by depths and normals", _lead(config, listed), (), parts)


def _lead(config: Config, records: Sequence[Record]) -> list[str]:
    views = config.views
    balls = records[0]["balls"] if records else config.balls
    return [
        f"The target is a torus, R = 1, r = 0.4. {balls} balls start on it, each with a flat disc, off by "
        f"{config.noise:g} radii in place, {config.noise / 2:g} in size and {config.noise:g} radians in direction. "
        f"Places, radii and quadrics are refined by {config.descent.iterations} steps of Adam through the blended hits "
        f"of {views.training} views of {views.size}² pixels, {views.at_once} at a time; {views.held_out} others are "
        "never matched.",
        "Depths and normals are compared where both are hit. Outlines pull at nothing: of covers there is no "
        "derivative of edges. Radii are held near those of the start.",
    ]


def _view(records: Sequence[Record], view: str, folder: Path) -> Gallery:
    pictures = [p for r in records for p in two_rows(r["images"][view], r["compared"], folder)]
    return Gallery(pictures, CAPTION, columns=4)


def _numbers(records: Sequence[Record]) -> Table:
    columns = [
        Column("", numeric=False),
        Column("from the torus", "RMS"),
        Column("masks", "IoU"),
        Column("depth", "RMS"),
        Column("normal", "mean angle, °"),
        Column("time", "s"),
    ]
    rows = [_row("start", records[0]["observations"][0], None)] if records else []
    rows += [_row(r["compared"], r["observations"][-1], r.get("seconds")) for r in records]
    return Table(columns, rows, "Held-out views. Wall-clock seconds; they depend on what else ran.")


def _row(name: str, seen: Record, seconds: float | None) -> list[str]:
    cells = [text(seen["distance"]), fixed(seen["iou"], 4), text(seen["depth_rms"]), fixed(seen["normal_angle"], 2)]
    return [name, *cells, fixed(seconds, 0)]
