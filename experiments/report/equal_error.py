"""Section of `equal_error`: what every method needs to be as accurate as the usual one, and what that costs."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from matplotlib.axes import Axes

from experiments.report import plots
from experiments.report.page import Block, Column, Plot, Section, Table
from experiments.report.style import MISSING, label, line_style, memory, text, times
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.equal_error import Comparison, Config

WORDS = {"value": "value", "gradient": "value and gradient"}  # what is timed
Costs = Mapping[int, Record]  # resolution of the usual method -> record of the times


def draw(config: Config, records: Mapping[str, Record], _folder: Path) -> Section:
    """The section of the report."""
    parts = [_study(config, i, records) for i in range(len(config.studies))]
    return Section("Resolution, memory and time at equal error", _lead(config), _at_a_glance(config, records), parts)


def _lead(config: Config) -> list[str]:
    usual = " and ".join(f"{c.usual.name} for the {c.quantity}" for c in config.comparisons)
    return [
        f"A volume may be smaller where its reconstruction is better. The usual one ({usual}) is measured at some n³; "
        "for every other method the least m³ is sought at which its RMS error is no larger. Fields of these sizes then "
        "take turns at the same points in the world: what is compared is not a method with another at the same "
        "resolution, but two ways of being equally right.",
    ]


def _at_a_glance(config: Config, records: Mapping[str, Record]) -> list[Block]:
    """What is least at the finest resolution of the usual reconstruction, one row for each study and quantity."""
    n = config.resolutions[-1]
    columns = [
        Column("signal", numeric=False),
        Column("equal error of", numeric=False),
        Column("the usual", f"at {n}³"),
    ]
    for title in ("least memory", "least time"):
        columns += [Column(title, numeric=False), Column("memory"), Column("time")]
    rows = []
    for i, study in enumerate(config.studies):
        for c in config.comparisons:
            record = records.get(f"{i}/times/{c.quantity}/{n}")
            if record is not None and len(record["costs"]["rays"]) > 1:
                rows.append([study.signal.label, c.quantity, *_winners(config, record)])
    caption = (
        f"For the error of the usual reconstruction at {n}³: method and resolution with the least memory, and with the "
        "least time per sample (points along rays); memory and time in units of the usual."
    )
    return [Table(columns, rows, caption)] if rows else []


def _winners(config: Config, record: Record) -> list[str]:
    costs = dict(record["costs"]["rays"])
    usual = costs.pop("usual")
    cells = [memory(usual["bytes"])]
    for least in (lambda k: costs[k]["bytes"], lambda k: costs[k]["ratio"][1]):
        key = min(costs, key=least)
        name = label(next(r for r in config.methods if r.key == key).record())
        share, time = times(costs[key]["bytes"] / usual["bytes"]), times(costs[key]["ratio"][1])
        cells += [f"{name} at {record['resolutions'][key]}³", share, time]
    return cells


def _named(comparison: Comparison) -> Record:
    return comparison.usual.record()


def _study(config: Config, index: int, records: Mapping[str, Record]) -> Section:
    study = config.studies[index]
    parts = [_comparison(config, index, c, records) for c in config.comparisons]
    lead = (
        f"{config.points:,} uniform points of the box shrunk to {study.inner:g}, samples at cell centres, boundary "
        f"{config.boundary}, {config.dtype}.",
    )
    return Section(study.signal.label, lead, (), parts)


def _comparison(config: Config, index: int, comparison: Comparison, records: Mapping[str, Record]) -> Section:
    quantity = comparison.quantity
    searches = [r for r in records.values() if r["study"] == index and r["kind"] == "search"]
    costs = {
        r["resolution"]: r
        for r in records.values()
        if r["study"] == index and r["kind"] == "times" and r["quantity"] == quantity
    }
    usual = records.get(f"{index}/usual/{comparison.usual.key}")
    blocks: list[Block] = []
    if searches and costs:
        blocks.append(_curves(config, index, comparison, searches, costs))
    if searches and usual:
        blocks.append(_needed(config, comparison, searches, costs, usual))
    if costs:
        blocks.append(_times(config, comparison, searches, costs))
    return Section(f"The same {quantity} error as {label(_named(comparison))}", (), blocks)


def _curves(config: Config, index: int, comparison: Comparison, searches: Sequence[Record], costs: Costs) -> Plot:
    quantity = comparison.quantity
    panels: list[tuple[str, Callable[[Record, int], Any]]] = [
        ("Resolution needed", lambda r, n: _plain(_crossing(r, quantity, n))),
        ("Memory ÷ that of the usual", lambda r, n: _plain(_share(costs, r["recipe"], n))),
        ("Time per sample ÷ that of the usual", lambda r, n: _cost(costs, r["recipe"], n, "ratio")),
    ]
    with plots.settings():
        figure = plots.canvas(10.4, 4.0)
        for axes, (title, of) in zip(figure.subplots(1, 3), panels, strict=True):
            for record in searches:
                _line(axes, record, {n: of(record, n) for n in config.resolutions})
            reference = config.resolutions if title.startswith("Resolution") else [1] * len(config.resolutions)
            axes.plot(config.resolutions, reference, color=plots.INK, linewidth=1.2, linestyle=(0, (1, 1.5)))
            if title.startswith("Time"):
                axes.set_ylim(bottom=0)
            else:
                plots.logarithmic(axes)
            plots.resolution_axis(axes, config.resolutions)
            axes.set_xlabel(f"n of {comparison.usual.name}")
            axes.set_title(title)
        plots.legend_right(axes)
        drawn = plots.svg(figure, f"equal-{index}-{quantity}")
    caption = (
        f"At the {quantity} error of {label(_named(comparison))} at n³ (dotted). Left: voxels along each axis. Middle: "
        f"coefficients held. Right: time per sample of the {WORDS[quantity]}, points along rays; bars are quartiles of "
        "the ratio within rounds. A line ends where no resolution that was tried reaches the error."
    )
    if any(not r["prefilter"] for r in searches):
        caption += " Dashed and hollow: without the prefilter."
    return Plot(drawn, caption)


def _line(axes: Axes, record: Record, found: Mapping[int, Any]) -> None:
    """A curve through medians [low, median, high]; bars where the quartiles differ."""
    seen = {n: q for n, q in found.items() if q is not None}
    if not seen:
        return
    low, median, high = zip(*seen.values(), strict=True)
    bars = [[m - a for m, a in zip(median, low, strict=True)], [b - m for m, b in zip(median, high, strict=True)]]
    style = line_style(record)
    axes.errorbar(list(seen), median, yerr=bars, label=label(record), capsize=2, elinewidth=0.8, **style)


def _plain(value: float | None) -> list[float] | None:
    return None if value is None else [value] * 3


def _crossing(record: Record, quantity: str, n: int) -> float | None:
    needed = record["needed"][quantity][str(n)]
    return needed["crossing"] or needed["resolution"]


def _share(costs: Costs, recipe: str, n: int) -> float | None:
    size, usual = _cost(costs, recipe, n, "bytes"), _cost(costs, "usual", n, "bytes")
    return None if size is None or usual is None else size / usual


def _cost(costs: Costs, recipe: str, n: int, what: str, order: str = "rays") -> Any:
    return costs[n]["costs"][order].get(recipe, {}).get(what) if n in costs else None


def _needed(config: Config, comparison: Comparison, searches: Sequence[Record], costs: Costs, usual: Record) -> Table:
    quantity = comparison.quantity
    columns, first = [Column("method", numeric=False)], [f"{label(usual)} (the usual)"]
    for n in config.resolutions:
        error = usual["errors"][str(n)][f"{quantity}_rms"]
        columns += [Column(f"as at {n}³", f"RMS {text(error)}"), Column("", "memory")]
        first += [str(n), memory(_cost(costs, "usual", n, "bytes"))]
    rows = [first]
    for r in searches:
        cells = [
            (_resolution(config, r, quantity, n), times(_share(costs, r["recipe"], n))) for n in config.resolutions
        ]
        rows.append([label(r), *(cell for pair in cells for cell in pair)])
    caption = (
        "Voxels along each axis that reach the error named above, and the memory of the coefficients that the field "
        f"holds, padding included, in units of the usual. > {config.largest}: no resolution up to that reaches it; "
        f"≤ {config.smallest}: reached by the smallest that was tried."
    )
    return Table(columns, rows, caption)


def _resolution(config: Config, record: Record, quantity: str, n: int) -> str:
    needed = record["needed"][quantity][str(n)]
    if needed["resolution"] is None:
        return f"> {config.largest}"
    return str(needed["resolution"]) if needed["crossing"] else f"≤ {needed['resolution']}"


def _times(config: Config, comparison: Comparison, searches: Sequence[Record], costs: Costs) -> Table:
    last = config.resolutions[-1]
    columns, first = [Column("method", numeric=False)], [f"{label(_named(comparison))} (the usual)"]
    for n in config.resolutions:
        columns += [Column(f"as at {n}³", "rays"), Column("", "random")]
        first += [f"{_nanoseconds(costs, n, order)} ns" for order in ("rays", "random")]
    columns.append(Column("build", f"as at {last}³"))
    rows = [[*first, _build(costs, "usual", last)]]
    for r in searches:
        found = [
            _cost(costs, r["recipe"], n, "ratio", order) for n in config.resolutions for order in ("rays", "random")
        ]
        rows.append([label(r), *(times(q and q[1]) for q in found), _build(costs, r["recipe"], last)])
    caption = (
        f"Time per sample of the {WORDS[comparison.quantity]} in units of the usual one (first row: nanoseconds), for "
        f"{config.timed_points:,} points along slanted parallel rays, half a voxel of n³ apart, and the same points in "
        f"random order; {config.timed_by}, medians of ratios within rounds. Build: prefilter and padding, median."
    )
    return Table(columns, rows, caption)


def _nanoseconds(costs: Costs, n: int, order: str) -> str:
    found = _cost(costs, "usual", n, "ns_per_sample", order)
    return MISSING if found is None else text(found[1], 2)


def _build(costs: Costs, recipe: str, n: int) -> str:
    found = _cost(costs, recipe, n, "build_seconds")
    return MISSING if found is None else f"{text(1e3 * found[1], 2)} ms"
