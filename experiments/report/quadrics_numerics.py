"""Section of `quadrics_numerics`: errors of roots, of hits by distance, culling, flat quads."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.report import plots
from experiments.report.page import Block, Column, Plot, Section, Table
from experiments.report.style import LOOKS
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.quadrics_numerics import Config

LEAD = (
    "α λ² + 2 β λ + γ = 0 along a ray. 7: (−β − s) / α, the front root, where β < 0; linear: the same, and −γ / 2β "
    "where |α| < 10⁻⁶; 15: the first positive root from β / γ and α / γ; stable: the library's, front and back, in "
    "which nothing cancels. Numbers of equations are those of Stoll, Gumhold & Seidel, 2006.",
    "Recentred and u-v are the library's plain programs in float32 throughout; library is what is used, float64 with "
    "rays and distances of float32. Missed are rays that no root was found for.",
)
FORMULAS = ("7", "7, linear", "15", "stable")
FROM = ("7", "stable, fma", "recentred", "library")
QUADS = ("eye", "recentred", "u-v")


def draw(_config: Config, records: Mapping[str, Record], _folder: Path) -> Section:
    """The section of the report."""
    of = {table: [r for key, r in records.items() if key.startswith(table)] for table in TABLES}
    blocks: list[Block] = [block for table, rows in of.items() if rows for block in TABLES[table](rows)]
    culled = of["culling"]
    lost = sum(r["lost"] for r in culled)
    summary = (
        f"{sum(r['fronts'] for r in culled):,} quadrics that show fronts: {lost:,} lost by culling." if culled else ""
    )
    return Section("Rounding, and rays at quadrics", (*filter(None, [summary]), *LEAD), blocks)


def _roots(records: Sequence[Record]) -> list[Block]:
    columns = [Column("type", numeric=False), Column("α"), *(Column(name) for name in FORMULAS)]
    rows = [[r["dtype"], f"{r['alpha']:g}", *(_short(r[name]) for name in FORMULAS)] for r in records]
    caption = "Worst relative errors of roots below 1,000, of radicands above 0.01; β and γ are normally distributed."
    return [Table(columns, rows, caption), _picture(records)]


def _picture(records: Sequence[Record]) -> Plot:
    """Errors by α, one line for each formula and type."""
    with plots.settings():
        figure = plots.canvas(10.4, 3.8)
        axes = figure.subplots()
        for dtype, line in (("float32", "-"), ("float64", "--")):
            own = [r for r in records if r["dtype"] == dtype]
            for name, look in zip(FORMULAS, LOOKS.values(), strict=False):
                errors = [max(r[name], 1e-17) for r in own]
                label = f"{name}, {dtype}"
                axes.loglog([r["alpha"] for r in own], errors, line, marker=look.marker, color=look.light, label=label)
        axes.set_xlabel("α")
        axes.set_ylabel("worst relative error of a root")
        plots.legend_right(axes)
        drawn = plots.svg(figure, "quadrics-numerics")
    return Plot(drawn, "Roots by three formulas: solid in float32, dashed in float64.")


def _distances(records: Sequence[Record]) -> list[Block]:
    columns = [Column("eye, radii"), *_pairs(FROM), Column("rays")]
    rows = [[f"{r['distance']:g}", *_errors(r, FROM), f"{r['rays']:,}"] for r in records]
    caption = (
        "Hits of float32 rays with quadrics as bent as the balls they are in, of radius 1: errors in radii, of 99 % of "
        "them, and missed."
    )
    return [Table(columns, rows, caption)]


def _culling(records: Sequence[Record]) -> list[Block]:
    columns = [Column("bounds", numeric=False), Column("seen"), Column("show fronts"), Column("lost")]
    columns += [Column("left out"), Column("eye", "float32 wrong"), Column("local", "float32 wrong")]
    rows = [
        [
            r["bounds"],
            *(f"{r[name]:,}" for name in ("shown", "fronts", "lost")),
            f"{100 * r['removed']:.0f} %",
            *(f"{100 * r[name]:.3f} %" for name in ("wrong, eye", "wrong, local")),
        ]
        for r in records
    ]
    caption = (
        "Quadrics that random lines meet within their bounds. Left out: of those that show backs only. Wrong: "
        "decisions in float32 of an eye 3,000 radii away, in its coordinates and about the centre of the bounds."
    )
    return [Table(columns, rows, caption)]


def _quads(records: Sequence[Record]) -> list[Block]:
    columns = [Column("height"), Column("distance"), *_pairs(QUADS), Column("rays")]
    rows = [[f"{r['height']:g}", _short(r["distance"]), *_errors(r, QUADS), f"{r['rays']:,}"] for r in records]
    caption = (
        "Bilinear quads of size 1, so far from flat; distance: 99 % of their points are so near to their quadrics, in "
        "float64. Then hits of float32 rays from nine sizes away: quadrics from the eye by formula 7, recentred, and "
        "by u and v, which is what BilinearQuads does, in float64: errors, of 99 %, and missed."
    )
    return [Table(columns, rows, caption)]


def _blending(records: Sequence[Record]) -> list[Block]:
    offsets = [name for name in records[0]["rms"] if name != "nearest"]
    columns = [Column("balls"), Column("radius"), Column("nearest"), *(Column(x, "blended, offset") for x in offsets)]
    rows = [[f"{r['balls']:,}", f"{r['radius']:.3f}", *map(_short, r["rms"].values())] for r in records]
    value, slope, *ends = records[0]["jumps"]
    caption = (
        "A torus, R = 1, r = 0.4, covered by graphs of second order, every point in six balls: rms distance of hits "
        f"from it; offsets in radii. The weight jumps by {value:.0e}, its slope by {slope:.0e} at ½, of what they are "
        f"there; at 1 they are {ends[0]:.0e} and {ends[1]:.0e}."
    )
    return [Table(columns, rows, caption)]


def _pairs(names: Sequence[str]) -> list[Column]:
    return [Column(what, name) for name in names for what in ("error", "missed")]


def _errors(record: Record, names: Sequence[str]) -> list[str]:
    found = []
    for name in names:
        found += [_short(record[f"{name}: error"]), f"{100 * record[f'{name}: missed']:.2g} %"]
    return found


def _short(number: float | None) -> str:
    return "–" if number is None else f"{number:.1e}"


TABLES = {
    "roots": _roots,
    "distance": _distances,
    "culling": _culling,
    "quads": _quads,
    "blending": _blending,
}
