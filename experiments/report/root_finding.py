"""Section of `root_finding`: which roots were lost, invented or mixed up, by family, degree and type; and by kornia."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from itertools import cycle
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.exact_roots import BAD
from experiments.report import plots
from experiments.report.page import Block, Column, Plot, Section, Table
from experiments.report.style import LOOKS, OTHERS
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.root_finding import Config

LEAD = (
    "t is the first root where p(t) = Σ cᵢ Bᵢ(t) vanishes in [0, 1], of the float coefficients exactly as they are. p "
    "is 0 within rounding where |p| ≤ 6 n ε Σ |cᵢ| Bᵢ: there a polynomial vanishes whose coefficients differ by 6 n ε, "
    "relatively. Lost: p has a root, none was returned. Invented: p is not 0 within rounding at t, and has no root "
    "between t's neighbours. Later: p has an earlier root, and between the two it is not 0 within rounding. "
    "Inaccurate: either, but a root is nearer than 10⁻⁶. Touch: p has no root, but is 0 within rounding at t, which "
    "counts as one.",
    "Every answer is checked in float64 by other formulas, which find what is wrong but also suspect what is right; "
    "whoever is suspected, and a sample of all, is judged in exact arithmetic by Sturm's chain.",
)


def draw(_config: Config, records: Mapping[str, Record], _folder: Path) -> Section:
    """The section of the report."""
    listed = list(records.values())
    solved = sum(r["solved"] for r in listed)
    bad = _bad(listed, "filterlab")
    judged = sum(sum(r["verdicts"].get("filterlab", {}).values()) for r in listed)
    summary = (
        f"{solved:,} polynomials solved and checked, {judged:,} of them judged exactly: "
        + (", ".join(f"{bad[v]:,} {v}" for v in BAD) if judged else "none yet")
        + "."
    )
    blocks: list[Block] = [_families(listed, dtype) for dtype in dict.fromkeys(r["dtype"] for r in listed)]
    compared = [r for r in listed if "kornia" in r["verdicts"]]
    if compared:
        blocks += [_compared(compared), _picture(compared)]
    if broken := [r for r in listed if r["examples"]]:
        blocks.append(_examples(broken))
    return Section("First roots of polynomials that break root finders", (summary, *LEAD), blocks)


def _bad(records: Sequence[Record], solver: str) -> Counter[str]:
    total = Counter[str]()
    for record in records:
        total.update(record["verdicts"].get(solver, {}))
    return total


def _families(records: Sequence[Record], dtype: str) -> Table:
    own = [r for r in records if r["dtype"] == dtype]
    columns = [
        Column("family", numeric=False),
        Column("degrees"),
        Column("solved"),
        Column("hits"),
        Column("suspected"),
    ]
    columns += [Column("judged"), *(Column(v) for v in BAD), Column("touch")]
    rows = []
    for family in dict.fromkeys(r["family"] for r in own):
        found = [r for r in own if r["family"] == family]
        verdicts, degrees = _bad(found, "filterlab"), [r["degree"] for r in found]
        sums = [sum(r[key] for r in found) for key in ("solved", "hits", "suspects")]
        counts = [*sums, verdicts.total(), *(verdicts[v] for v in (*BAD, "touch"))]
        rows.append([family, f"{min(degrees)} to {max(degrees)}", *(f"{n:,}" for n in counts)])
    return Table(columns, rows, f"{dtype}: what became of all polynomials, by family.")


def _compared(records: Sequence[Record]) -> Table:
    columns = [Column("type", numeric=False), Column("degree"), Column("family", numeric=False), Column("judged")]
    columns += [Column(v, "kornia") for v in BAD] + [Column("wrong", "filterlab")]
    rows = []
    for r in records:
        theirs = _bad([r], "kornia")
        ours = _bad([r], "filterlab")
        counts = [theirs.total(), *(theirs[v] for v in BAD), sum(ours[v] for v in BAD)]
        rows.append([r["dtype"], str(r["degree"]), r["family"], *(f"{n:,}" for n in counts)])
    caption = (
        "solve_quadratic, solve_cubic and solve_quartic of kornia.geometry.solvers on the first polynomials of each "
        "family, all of them judged; beside them everything that filterlab got wrong, of all that it solved."
    )
    return Table(columns, rows, caption)


def _picture(records: Sequence[Record]) -> Plot:
    """Shares of wrong answers of kornia by family, a marker for each degree and type."""
    families = list(dict.fromkeys(r["family"] for r in records))
    kinds = list(dict.fromkeys((r["dtype"], r["degree"]) for r in records))
    with plots.settings():
        figure = plots.canvas(10.4, 3.8)
        axes = figure.subplots()
        for kind, shade in zip(kinds, cycle([*LOOKS.values(), *OTHERS])):
            own = [r for r in records if (r["dtype"], r["degree"]) == kind]
            places = [families.index(r["family"]) for r in own]
            axes.plot(
                places, [_wrong(r) for r in own], shade.marker, color=shade.light, label=f"{kind[0]}, degree {kind[1]}"
            )
        axes.set_xticks(range(len(families)), families, rotation=20)
        axes.set_ylabel("wrong, % of what was judged")
        plots.legend_right(axes)
        drawn = plots.svg(figure, "root-finding")
    return Plot(drawn, "kornia's closed forms: lost, invented, later and inaccurate first roots together.")


def _wrong(record: Record) -> float:
    verdicts = _bad([record], "kornia")
    return 100 * sum(verdicts[v] for v in BAD) / max(verdicts.total(), 1)


def _examples(records: Sequence[Record]) -> Table:
    columns = [Column(n, numeric=False) for n in ("family", "type", "verdict", "coefficients")]
    rows = [
        [r["family"], r["dtype"], verdict, ", ".join(map(repr, c))]
        for r in records
        for verdict, c in r["examples"].items()
    ]
    return Table(columns, rows, "One polynomial of each kind that filterlab got wrong.", wrapped=True)
