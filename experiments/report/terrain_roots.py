"""Section of `terrain_roots`: what the paper's root search gets wrong, with and without a residual test, and ours."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.exact_roots import BAD
from experiments.report import plots
from experiments.report.page import Block, Column, Plot, Section, Table
from experiments.report.style import LOOKS, OTHERS
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.terrain_roots import Config

LEAD = (
    "The first root in [0, 1] of quartics Σ cᵢ Bᵢ(t), as rays at quartic spline terrains ask for it. The paper takes "
    "six steps of Newton's method from both ends and both inflection points at once and returns the smallest component "
    "in [0, 1]. The residual test keeps components with |p(t)| ≤ 10⁻⁶ max |cᵢ| (10⁻⁵ in float32).",
    "Every answer is judged in exact arithmetic. Lost: p has a root, none was returned. Later: p has an earlier root. "
    "Invented: p is not 0 within rounding at t, and no root is near. Inaccurate: a root is nearer than 10⁻⁶, but "
    "farther than rounding. A residual test lets rays hit what they pass at a distance of 10⁻⁶: invented as well.",
)


def draw(_config: Config, records: Mapping[str, Record], _folder: Path) -> Section:
    """The section of the report."""
    listed = list(records.values())
    ours = [_share(r, "filterlab", BAD) for r in listed]
    judged = sum(r["count"] for r in listed)
    printed = [_share(r, name, BAD) for r in listed for name in r["verdicts"] if "printed" in name]
    summary = (
        f"Of {judged:,} quartics filterlab gets {max(ours, default=0):.3g} % wrong in the worst class; "
        f"six steps as printed {max(printed, default=0):.3g} %."
    )
    blocks: list[Block] = [_table(listed, dtype) for dtype in dict.fromkeys(r["dtype"] for r in listed)]
    return Section("First roots of quartics: Newton's steps and filterlab", (summary, *LEAD), [*blocks, _plot(listed)])


def _share(record: Record, solver: str, verdicts: Sequence[str]) -> float:
    """Per cent."""
    return 100 * sum(record["verdicts"][solver].get(v, 0) for v in verdicts) / record["count"]


def _table(records: Sequence[Record], dtype: str) -> Table:
    own = [r for r in records if r["dtype"] == dtype]
    solvers = list(own[0]["verdicts"])
    columns = [Column("quartics", numeric=False), Column("judged"), *(Column(s, "%") for s in solvers)]
    rows = []
    for r in own:
        cells = [
            " / ".join(f"{_share(r, s, [v]):.3g}" for v in ("lost", "later", "invented", "inaccurate")) for s in solvers
        ]
        rows.append([r["family"], f"{r['count']:,}", *cells])
    return Table(columns, rows, f"{dtype}: lost / later / invented / inaccurate first roots.")


def _plot(records: Sequence[Record]) -> Plot:
    names = list(dict.fromkeys(r["family"] for r in records))
    kinds = [(s, d) for s in records[0]["verdicts"] for d in dict.fromkeys(r["dtype"] for r in records)]
    looks = [*LOOKS.values(), *OTHERS]
    with plots.settings():
        figure = plots.canvas(10.4, 3.8)
        axes = figure.subplots()
        for (solver, dtype), look in zip(kinds, looks, strict=False):
            own = [r for r in records if r["dtype"] == dtype]
            heights = [_share(r, solver, BAD) for r in own]
            places = [names.index(r["family"]) for r in own]
            axes.plot(places, heights, look.marker, color=look.light, label=f"{solver}, {dtype}", clip_on=False)
        axes.set_yscale("symlog", linthresh=0.01)
        axes.set_ylim(0, 100)
        axes.set_xticks(range(len(names)), names, rotation=15)
        axes.set_ylabel("wrong, %")
        plots.legend_right(axes)
        drawn = plots.svg(figure, "terrain-roots")
    return Plot(drawn, "All that is wrong together; linear below 0.01 %.")
