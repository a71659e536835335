"""Section of `terrain_frames`: nanoseconds per ray by size of the grid and angle of view, and what bounds cost."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.report import plots
from experiments.report.page import Column, Plot, Section, Table
from experiments.report.style import LOOKS
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.terrain_frames import Config

LEAD = (
    "First hits of a square of hills, rough down to the step of its data, from so many degrees above the horizon; "
    "nothing is shaded. Coefficients are made where rays ask for them; stored are the heights, and bounds of blocks of "
    "them."
)


def draw(config: Config, records: Mapping[str, Record], _folder: Path) -> Section:
    """The section of the report."""
    listed = sorted(records.values(), key=lambda r: (r["spline"], r["size"]))
    splines = list(dict.fromkeys(r["spline"] for r in listed))
    growth = [g for s in splines for g in _growths(listed, s)]
    summary = f"{config.pixels}² rays, {config.timed_by}."
    if growth:
        summary += f" From one size to twice that a frame takes {max(growth):.2f} times as long at most."
    return Section(
        "Frames of terrains by size and angle of view",
        (summary, LEAD),
        [_plot(listed, splines), _times(listed), _bounds(listed)],
    )


def _growths(records: Sequence[Record], spline: str) -> list[float]:
    """Medians of a size over those of half of it, for every angle."""
    own = [r for r in records if r["spline"] == spline]
    pairs = [(a, b) for a, b in pairwise(own) if b["size"] == 2 * a["size"]]
    return [b["frames"][angle][1] / a["frames"][angle][1] for a, b in pairs for angle in a["frames"]]


def _nanoseconds(record: Record, angle: str) -> float:
    return 1e9 * record["frames"][angle][1] / record["rays"]


def _plot(records: Sequence[Record], splines: Sequence[str]) -> Plot:
    angles = list(records[0]["frames"])
    with plots.settings():
        figure = plots.canvas(10.4, 3.4)
        every = figure.subplots(1, len(splines), sharey=True, squeeze=False)[0]
        for axes, spline in zip(every, splines, strict=True):
            own = [r for r in records if r["spline"] == spline]
            for angle, look in zip(angles, LOOKS.values(), strict=False):
                sizes = [r["size"] for r in own]
                axes.plot(
                    sizes,
                    [1e3 / _nanoseconds(r, angle) for r in own],
                    look.marker + "-",
                    color=look.light,
                    label=f"{angle}°",
                )
            axes.set_xscale("log", base=2)
            axes.set_title(spline)
            axes.set_xlabel("data along an edge")
        every[0].set_ylabel("million rays per second")
        every[0].set_ylim(bottom=0)
        plots.legend_right(every[-1])
        drawn = plots.svg(figure, "terrain-frames")
    return Plot(drawn, "Rays per second by size, from degrees above the horizon.")


def _times(records: Sequence[Record]) -> Table:
    angles = list(records[0]["frames"])
    columns = [Column("spline", numeric=False), Column("data"), *(Column(f"{a}°", "ns/ray") for a in angles)]
    columns += [Column(f"{a}°", "hit") for a in angles]
    rows = [
        [
            r["spline"],
            f"{r['size']}²",
            *(f"{_nanoseconds(r, a):.0f}" for a in angles),
            *(f"{100 * r['hits'][a]:.0f} %" for a in angles),
        ]
        for r in records
    ]
    return Table(columns, rows, "Medians of all rounds; share of rays that hit.")


def _bounds(records: Sequence[Record]) -> Table:
    columns = [Column("spline", numeric=False), Column("data"), Column("made in", "s"), Column("weigh", "MiB")]
    columns.append(Column("of the heights", "%"))
    rows = [
        [
            r["spline"],
            f"{r['size']}²",
            f"{r['bounds_seconds']:.3f}",
            f"{r['bounds_bytes'] / 2**20:.2f}",
            f"{100 * r['bounds_bytes'] / r['heights_bytes']:.0f}",
        ]
        for r in records
    ]
    return Table(columns, rows, "Bounds of blocks: made once for a grid.")
