"""Section of `recommend_validation`: how often budgets held, how near picks were to the cheapest, and the misses."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from matplotlib.axes import Axes

from experiments.report import plots
from experiments.report.page import Block, Column, Plot, Section, Table
from experiments.report.style import LOOKS, MISSING, fixed, look, text
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.recommend_validation import Config

LEAD = (
    "Every case is a volume whose truth is known, a task and a budget for the error. What was recommended is judged by "
    "its true error, and by what the cheapest way costs that truly meets the budget. Where nothing was recommended, "
    "the answer is right if nothing meets the budget.",
)
HELD, NEAR = 0.95, 0.80


def draw(config: Config, records: Mapping[str, Record], _folder: Path) -> Section:
    """The section of the report."""
    cases = list(records.values())
    blocks: list[Block] = []
    if cases:
        blocks = [_rates(cases), _scatter(config, cases), _ratios(cases)]
        if missed := [r for r in cases if not (r["holds"] and r["near"])]:
            blocks.append(
                _cases(missed, "Cases in which the budget did not hold, or the pick was not near the cheapest.")
            )
        blocks.append(_cases(cases, "All cases."))
    return Section("Does recommend keep its word?", LEAD, blocks)


def _rates(cases: Sequence[Record]) -> Table:
    columns = [
        Column("", numeric=False),
        Column("cases"),
        Column("so"),
        Column("share"),
        Column("asked for"),
        Column(""),
    ]
    picked = [r for r in cases if r["pick"]]
    refused = [r for r in cases if not r["pick"]]
    held, near = [r["holds"] for r in picked], [r["near"] for r in cases]
    rows = [
        _rate("the budget holds for what was recommended", held, HELD),
        _rate("the pick costs at most 1.5 × the cheapest that meets it, or rightly nothing was picked", near, NEAR),
        _rate("nothing was recommended, and nothing meets the budget", [r["near"] for r in refused], None),
    ]
    volumes = len({r["volume"] for r in cases})
    return Table(columns, rows, f"{len(cases)} cases on {volumes} volumes.")


def _rate(what: str, outcomes: Sequence[bool], asked: float | None) -> list[str]:
    if not outcomes:
        return [what, "0", "0", MISSING, MISSING, ""]
    share = sum(outcomes) / len(outcomes)
    verdict = "" if asked is None else "met" if share >= asked else "MISSED"
    wanted = MISSING if asked is None else f"≥ {100 * asked:.0f} %"
    return [what, str(len(outcomes)), str(sum(outcomes)), f"{100 * share:.1f} %", wanted, verdict]


def _ways(cases: Sequence[Record]) -> list[dict[str, Any]]:
    """Every method on every volume and task once: the first budget's."""
    seen: dict[tuple[str, str, str], dict[str, Any]] = {}
    for record in cases:
        for way in record["ways"]:
            if way["true"] and way["predicted"]:
                seen.setdefault((record["volume"], record["task"], way["method"]), way)
    return list(seen.values())


def _scatter(config: Config, cases: Sequence[Record]) -> Plot:
    ways = _ways(cases)
    with plots.settings():
        figure = plots.canvas(10.4, 4.8)
        left, right = figure.subplots(1, 2, sharex=True, sharey=True)
        _panel(left, ways, "predicted", "predicted from the spectrum")
        _panel(right, [w for w in ways if w["measured"]], "measured", "held out, corrected for the resolution")
        for axes in (left, right):
            for budget in config.budgets:
                axes.axvline(budget, color=plots.RULE, linewidth=0.8, zorder=0)
        plots.legend_right(right)
        drawn = plots.svg(figure, "recommend-errors")
    caption = (
        "True error of every method on every volume, against both estimates of it; in parts of the range. On the "
        "diagonal they agree. Hollow: the volume does not resolve what it shows. Vertical lines: the budgets."
    )
    return Plot(drawn, caption)


def _panel(axes: Axes, ways: Sequence[Mapping[str, Any]], quantity: str, title: str) -> None:
    for method in LOOKS:
        own = look(method)
        for resolved in (True, False):
            found = [w for w in ways if w["method"] == method and w["resolved"] == resolved]
            face = own.light if resolved else "none"
            label = method if resolved else "_"
            x, y = [w["true"] for w in found], [w[quantity] for w in found]
            axes.plot(x, y, own.marker, color=own.light, markerfacecolor=face, markersize=4, label=label)
    plots.logarithmic_x(axes)
    plots.logarithmic(axes)
    low, high = (
        f(*ends) for f, ends in zip((max, min), zip(axes.get_xlim(), axes.get_ylim(), strict=True), strict=True)
    )
    axes.plot([low, high], [low, high], color=plots.INK, linewidth=0.8, alpha=0.6)
    axes.set_xlabel("true error, part of the range")
    axes.set_title(title)


def _ratios(cases: Sequence[Record]) -> Table:
    """Estimate ÷ truth: median, and between what nine of ten lie."""
    columns = [Column("", numeric=False), Column("methods × volumes"), *(Column(f"{p} %") for p in (5, 50, 95))]
    columns.append(Column("within 15 %"))
    rows = []
    for known, which in ((True, "resolved"), (False, "not resolved")):
        ways = [w for w in _ways(cases) if w["resolved"] == known]
        for quantity in ("predicted", "measured"):
            ratios = sorted(w[quantity] / w["true"] for w in ways if w[quantity])
            if ratios:
                at = [ratios[round(q * (len(ratios) - 1))] for q in (0.05, 0.5, 0.95)]
                near = sum(abs(r - 1) <= 0.15 for r in ratios) / len(ratios)
                rows.append([f"{quantity} ÷ true, {which}", str(len(ratios)), *map(fixed, at), f"{100 * near:.0f} %"])
    return Table(columns, rows, "How far both estimates are off: quantiles over all methods on all volumes.")


def _cases(cases: Sequence[Record], caption: str) -> Table:
    several = len({r["task"] for r in cases}) > 1
    columns = [Column("volume", numeric=False), Column("budget"), Column("picked", numeric=False), Column("true error")]
    columns += [Column("cheapest", "that meets it", numeric=False), Column("cost", "÷ cheapest")]
    columns += [Column("", numeric=False)]
    rows = []
    for r in cases:
        pick = r["pick"] or {}
        error = text(pick["true"]) if pick else f"best {text(r['best']['true'])}"
        verdict = "" if r["holds"] and r["near"] else "over budget" if not r["holds"] else "not near"
        names = [_named(r["pick"], "nothing"), _named(r["cheapest"], "nothing")]
        volume = f"{r['volume']}, {r['task']}" if several else r["volume"]
        rows.append([volume, f"{100 * r['budget']:g} %", names[0], error, names[1], fixed(r["factor"]), verdict])
    return Table(columns, rows, caption)


def _named(way: Mapping[str, Any] | None, nothing: str) -> str:
    if way is None:
        return nothing
    return way["method"] + (f", {way['storage']}" if way["storage"] else "")
