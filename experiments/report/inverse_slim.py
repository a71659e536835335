"""Section of `inverse_slim`: target, start and results, how they converged, and what is left."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from experiments import covers
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
    names = [f"{unknown}, {name}" for unknown in config.unknowns for name in config.weights]
    look = lambda r: {"color": OTHERS[names.index(_name(r)) % len(OTHERS)].light, "label": _name(r)}  # noqa: E731
    drawn = convergence(listed, look, PANELS, "inverse-slim")
    parts.append(Section("Convergence", (), [drawn, _numbers(listed)]))
    return Section("A rough cover, refined by what images show", _lead(config, listed), (), parts)


def _name(record: Record) -> str:
    return f"{record['unknown']}, {record['compared']}"


def _lead(config: Config, records: Sequence[Record]) -> list[str]:
    views, found = config.views, {r["unknown"]: r["balls"] for r in records}
    told = [f"The target is a torus, R = {covers.MAJOR:g}, r = {covers.MINOR:g}."]
    if "numbers" in found:
        told.append(
            f"Numbers: {found['numbers']} balls start on it, each with a flat disc, off by {config.noise:g} radii in "
            f"place, {config.noise / 2:g} in size and {config.noise:g} radians in direction; places, radii and "
            "quadrics are refined. Radii are held near those of the start."
        )
    if "points" in found:
        told.append(
            f"Points: {config.points} about evenly on it, off by {config.noise:g} of their distance along each axis, "
            f"to which {found['points']} balls are fitted. Points are refined; the local fits are solved again at "
            "every step. They are held near where they start."
        )
    told.append(
        f"{config.descent.iterations} steps of Adam through the blended hits of {views.training} views of "
        f"{views.size}² pixels, {views.at_once} at a time; {views.held_out} others are never matched."
    )
    edges = [name for name, weights in config.weights.items() if weights.mask]
    matched = (
        f"Depths and normals are compared where both are hit. With masks ({', '.join(edges)}) derivatives are also "
        f"those of what edges sweep over, along {config.lines} lines of {config.parts} parts through every pixel."
        if edges
        else "Depths and normals are compared where both are hit; outlines pull at nothing."
    )
    return [" ".join(told), matched]


def _view(records: Sequence[Record], view: str, folder: Path) -> Gallery:
    pictures = [p for r in records for p in two_rows(r["images"][view], _name(r), folder)]
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
    starts = {r["unknown"]: r["observations"][0] for r in records}
    rows = [_row(f"start of {unknown}", seen, None) for unknown, seen in starts.items()]
    rows += [_row(_name(r), r["observations"][-1], r.get("seconds")) for r in records]
    return Table(columns, rows, "Held-out views. Wall-clock seconds; they depend on what else ran.")


def _row(name: str, seen: Record, seconds: float | None) -> list[str]:
    cells = [text(seen["distance"]), fixed(seen["iou"], 4), text(seen["depth_rms"]), fixed(seen["normal_angle"], 2)]
    return [name, *cells, fixed(seconds, 0)]
