"""Section of `slim_error`: distance against number of balls, beside triangles."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.report.page import Block, Column, Plot, Section, Table
from experiments.report.plots import canvas, legend_right, logarithmic, logarithmic_x, settings, svg
from experiments.report.style import MISSING, OTHERS, fixed, text
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.slim_error import Config, Study

LEAD = (
    "Points of a surface are covered by balls with local fits, at some tolerances; rays down the normals of others "
    "measure how far the cover is from the surface. All lengths are in parts of the diagonal of its box. First hit: of "
    "the balls that a ray meets the first alone, as without blending.",
    "Triangles are those of a grid in the surface's parameters with all vertices on it: as many as there are balls, or "
    "as many as it takes to be as near as the blended cover.",
)
_ORDERS = {2: "second order", 1: "planes"}


def draw(config: Config, records: Mapping[str, Record], _folder: Path) -> Section:
    """The section of the report."""
    parts = [_study(study, i, records) for i, study in enumerate(config.studies)]
    return Section("Distance of covers against number of balls", LEAD, (), parts)


def _study(study: Study, index: int, records: Mapping[str, Record]) -> Section:
    own = [r for r in records.values() if r["study"] == index]
    covers, fits = ([r for r in own if r["kind"] == kind] for kind in ("cover", "fit"))
    blocks: list[Block] = []
    if study.shape is not None and len(covers) > 1:
        blocks.append(_plot(study, index, covers, fits))
    if covers:
        blocks.append(_numbers(study, covers))
    return Section(study.label, (), blocks)


def _plot(study: Study, index: int, covers: list[Record], fits: list[Record]) -> Plot:
    with settings():
        figure = canvas(8.0, 3.8)
        axes = figure.subplots()
        for order, color in zip(_ORDERS, (OTHERS[0].light, OTHERS[1].light), strict=True):
            some = [r for r in covers if r["order"] == order]
            balls = [r["balls"] for r in some]
            if some:
                axes.plot(balls, [r["rms"] for r in some], "o-", color=color, label=f"{_ORDERS[order]}, blended")
                axes.plot(balls, [r["first"] for r in some], "o:", color=color, label=f"{_ORDERS[order]}, first hit")
        some = sorted(covers, key=lambda r: r["balls"])
        line = [r["triangles_rms"] for r in some]
        axes.plot([r["balls"] for r in some], line, "s--", color=OTHERS[2].light, label="triangles")
        axes.set_xlabel("balls, or triangles")
        axes.set_ylabel("rms distance / diagonal")
        logarithmic(axes)
        logarithmic_x(axes)
        legend_right(axes)
        drawn = svg(figure, f"slim-error-{index}")
    slopes = "; ".join(
        f"{_ORDERS[f['order']]} {fixed(f['rms_slope'])} blended, {fixed(f['first_slope'])} first hit" for f in fits
    )
    caption = f"{study.points:,} points of the {study.label}, without noise."
    return Plot(drawn, f"{caption} rms ∝ 1 / ballsᵖ with fitted p: {slopes}." if slopes else caption)


def _numbers(study: Study, covers: list[Record]) -> Table:
    shape = study.shape is not None
    columns = [Column("fit", numeric=False), Column("tolerance"), Column("balls"), Column("seconds")]
    columns += [Column("points", "rms"), Column("", "worst")]
    if shape:
        columns += [Column("surface", "blended"), Column("", "first hit"), Column("", "missed")]
        columns += [Column("triangles", "rms of as many"), Column("", "as near")]
    rows = [_row(r, shape) for r in covers]
    told = "Distances of the points themselves are to first order"
    return Table(columns, rows, f"{told}; those of the surface are along rays." if shape else f"{told}.")


def _row(r: Record, shape: bool) -> list[str]:
    cells = [_ORDERS[r["order"]], text(r["tolerance"]), f"{r['balls']:,}", f"{r['seconds']:.1f}"]
    cells += [text(r["fit_rms"]), text(r["fit_worst"])]
    if shape:
        cells += [text(r["rms"]), text(r["first"]), f"{r['missed']:,}" if "missed" in r else MISSING]
        cells += [text(r["triangles_rms"]), f"{r['triangles']:,}"]
    return cells
