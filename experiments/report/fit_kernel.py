"""Section of `fit_kernel`: does learning beat what has a name, where and by how much; and what it has learned."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap, LogNorm
from matplotlib.lines import Line2D

import filterlab as fl
from experiments.comparison import BETTER, MIXED, QUANTITIES, WORSE
from experiments.report import plots
from experiments.report.fitted_class import class_blocks, learned_name
from experiments.report.page import Block, Column, Plot, Section, Table
from experiments.report.style import fixed, look
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.fit_kernel import Config


def draw(config: Config, records: Mapping[str, Record], folder: Path) -> Section:
    """The section of the report."""
    verdicts = [r for r in records.values() if r["kind"] == "verdict"]
    parts = [Section("Verdict", _verdict_in_words(verdicts), _verdict(config, verdicts))] if verdicts else []
    if crossed := [r for r in records.values() if r["kind"] == "elsewhere"]:
        parts.append(Section("A filter learned for something else", (), [_elsewhere(config, crossed)]))
    for i, source in enumerate(config.classes):
        own = [r for r in records.values() if r["class"] == i]
        if blocks := class_blocks(config, own, folder):
            parts.append(Section(source.title, (), blocks))
    return Section("Learned filters against named ones", _lead(config), (), parts)


def _lead(config: Config) -> tuple[str, ...]:
    minimised = "the squared error of the value"
    if config.gradient_weight > 0:
        minimised = f"the squared errors of value and gradient (weights 1 and {config.gradient_weight:g})"
    minimised += f", relative to {config.reference.key}"
    return (
        "A kernel with a short symmetric prefilter, or the family of kernels with parameters B and C, is fitted to "
        f"members of a class of signals by gradient descent on {minimised}. {config.training} members train, "
        f"{config.validation} others say where to stop and which filter to choose, and {config.test} more, which had "
        f"no say in anything, judge. All of it is repeated {config.repetitions} times with other training and "
        "validation members.",
        "Cost is taps: the coefficients that one value reads, 27 for the triquadratic and the notch, 64 for "
        "Catmull-Rom, Mitchell and the tricubic B-spline. The prefilter is paid once per voxel and not per value, and "
        "is stated apart. “Better” and “worse” mean: by at least 1 % over all test members in every repetition, and so "
        "on at least nine of ten single members; everything else is “mixed”.",
        "An RMS error is one measure of several. The notch, for one, is made to leave no staircases: it gives up "
        "sharpness for the least postaliasing, which the tables below show beside the errors.",
    )


# --- the verdict ------------------------------------------------------------------------------------------------------


def _verdict_in_words(verdicts: Sequence[Record]) -> list[str]:
    """A sentence for every cost: against all named methods of that cost, and against the tricubic B-spline."""
    sentences = []
    for taps in _costs(verdicts):
        rivals = _rivals(verdicts, taps)
        equal = [name for name, costs_as_much in rivals.items() if costs_as_much]
        if equal:
            listed = " and ".join(filter(None, [", ".join(equal[:-1]), equal[-1]]))
            best = ", in each class the best of them" if len(equal) > 1 else ""
            sentences.append(f"Learned, {taps} taps, against {listed}{best}: {_outcome(verdicts, taps, equal)}.")
        if rivals.get("tricubic") is False:
            against = f"Learned, {taps} taps, against tricubic with its {fl.METHODS['tricubic'].facts.taps}"
            sentences.append(f"{against}: {_outcome(verdicts, taps, ['tricubic'])}.")
    return sentences


def _outcome(verdicts: Sequence[Record], taps: int, rivals: Sequence[str]) -> str:
    """In how many classes the learned filter beats the one of these that is hardest to beat there, and by how much."""
    parts = []
    for quantity in QUANTITIES:
        hardest = [
            max((a[quantity] for a in against if a["recipe"] in rivals), key=lambda o: o["ratio"])
            for against in _against(verdicts, taps)
        ]
        counts = {word: sum(o["verdict"] == word for o in hardest) for word in (BETTER, MIXED, WORSE)}
        said = [f"{word} in {count}" for word, count in counts.items() if count or word == BETTER]
        changes = sorted(100 * (o["ratio"] - 1) for o in hardest)
        parts.append(f"by {quantity} {', '.join(said)} (error {_signed(changes[0])} … {_signed(changes[-1])})")
    return f"of {len(hardest)} classes " + "; ".join(parts)


def _signed(change: float, decimals: int = 0) -> str:
    shown = fixed(change, decimals)
    return f"{'+' if change > 0 and not shown.startswith('0') else ''}{shown} %"


def _costs(verdicts: Sequence[Record]) -> list[int]:
    return sorted({c["taps"] for v in verdicts for c in v["choices"]})


def _rivals(verdicts: Sequence[Record], taps: int) -> dict[str, bool]:
    """The named methods, and whether they cost as much."""
    return {
        a["recipe"]: a["equal_cost"] for v in verdicts for c in v["choices"] if c["taps"] == taps for a in c["against"]
    }


def _against(verdicts: Sequence[Record], taps: int) -> list[list[Record]]:
    """The comparisons of the chosen filter of that cost, class by class."""
    return [c["against"] for v in verdicts for c in v["choices"] if c["taps"] == taps]


def _verdict(config: Config, verdicts: Sequence[Record]) -> list[Block]:
    return [_ratios(config, verdicts), *(_ratio_table(config, verdicts, taps) for taps in _costs(verdicts))]


def _ratios(config: Config, verdicts: Sequence[Record]) -> Plot:
    """Errors of the chosen filters divided by those of each named method: a panel for each cost and quantity."""
    costs = _costs(verdicts)
    with plots.settings():
        figure = plots.canvas(10.4, 0.7 + len(costs) * (0.9 + 0.36 * len(verdicts)))
        grid = figure.subplots(len(costs), 2, squeeze=False, sharey=True, sharex=True)
        for row, taps in zip(grid, costs, strict=True):
            for axes, quantity in zip(row, QUANTITIES, strict=True):
                _ratio_panel(axes, verdicts, taps, quantity)
        for axes in grid[-1]:
            axes.set_xlabel("error of the learned filter / error of the named method")
        names = list(dict.fromkeys(a["recipe"] for v in verdicts for c in v["choices"] for a in c["against"]))
        handles = [Line2D([], [], label=name, **_dot(name, equal=True)) for name in names]
        figure.legend(handles=handles, loc="outside lower center", ncols=7, frameon=False)
        drawn = plots.svg(figure, "fit-ratios")
    caption = (
        "The filter that validation chose, on test members. Left of the line at 1 the learned filter has the smaller "
        "error. Filled: named methods with as many taps; hollow: with more or fewer. One mark for each repetition."
    )
    return Plot(drawn, caption)


def _ratio_panel(axes: Axes, verdicts: Sequence[Record], taps: int, quantity: str) -> None:
    for row, v in enumerate(verdicts):
        for choice in (c for c in v["choices"] if c["taps"] == taps):
            for a in sorted(choice["against"], key=lambda a: a["equal_cost"]):
                ratios = a[quantity]["ratios"]
                axes.plot(ratios, [row] * len(ratios), **_dot(a["recipe"], equal=a["equal_cost"]))
    axes.axvline(1, color=plots.INK, linewidth=0.9)
    axes.set_yticks(range(len(verdicts)), [v["title"] for v in verdicts])
    axes.set_ylim(len(verdicts) - 0.5, -0.5)
    plots.logarithmic_x(axes)
    axes.set_title(f"{taps} taps: {quantity}")


def _dot(recipe: str, *, equal: bool) -> dict[str, Any]:
    own = look(recipe.partition("+")[0])
    filled = own.light if equal else "none"
    return {
        "color": own.light,
        "marker": own.marker,
        "linestyle": "none",
        "markerfacecolor": filled,
        "markersize": 6.5 if equal else 5.0,
    }


def _ratio_table(config: Config, verdicts: Sequence[Record], taps: int) -> Table:
    """One row for each class: the chosen filter, and for each rival of that cost the change of both errors."""
    rivals = [name for name, equal in _rivals(verdicts, taps).items() if equal or name == "tricubic"]
    columns = [Column("class", numeric=False), Column(f"chosen, {taps} taps", numeric=False)]
    columns += [Column(rival if q == "value" else "", q) for rival in rivals for q in QUANTITIES]
    rows = []
    for v in verdicts:
        for choice in (c for c in v["choices"] if c["taps"] == taps):
            against = {a["recipe"]: a for a in choice["against"]}
            cells = [_outcome_cell(against[r][q]) for r in rivals for q in QUANTITIES]
            rows.append([v["title"], learned_name(choice), *cells])
    caption = (
        f"How much smaller (−) or larger (+) the test error of the chosen filter of {taps} taps is than those of named "
        "methods. No mark: better; ≈: mixed, less than 1 % apart or not on nine of ten members; ▲: worse."
    )
    return Table(columns, rows, caption)


def _outcome_cell(outcome: Record) -> str:
    marks = {BETTER: "", MIXED: " ≈", WORSE: " ▲"}
    return _signed(100 * (outcome["ratio"] - 1), 1) + marks[outcome["verdict"]]


# --- one filter for another class -------------------------------------------------------------------------------------


def _elsewhere(config: Config, records: Sequence[Record]) -> Plot:
    costs = sorted({f["taps"] for r in records for f in r["filters"]})
    titles = [source.title for source in config.classes]
    with plots.settings():
        figure = plots.canvas(10.4, 1.3 + 0.42 * len(titles) * math.ceil(len(costs) / 2) + 0.9)
        grid = figure.subplots(1, len(costs), squeeze=False, sharey=True)[0]
        for axes, taps in zip(grid, costs, strict=True):
            _matrix(axes, records, taps, titles)
        grid[0].set_yticks(range(len(titles)), [f"learned on {t}" for t in titles])
        drawn = plots.svg(figure, "fit-elsewhere")
    caption = (
        "Value error of the filter that was learned on one class (row) and tested on another (column), divided by that "
        "of the named method of equal cost that is best on those test members. Blue: smaller than 1, the learned "
        "filter is better; orange: worse. On the diagonal a filter is tested on what it was made for."
    )
    return Plot(drawn, caption)


def _matrix(axes: Axes, records: Sequence[Record], taps: int, titles: Sequence[str]) -> None:
    ratios = np.full((len(titles), len(titles)), np.nan)
    for r in records:
        for f in r["filters"]:
            if f["taps"] == taps:
                ratios[f["learned_on"], r["class"]] = f["value"]["ratio"]
    shades = LinearSegmentedColormap.from_list("ratio", [look("triquadratic").light, "#ffffff00", look("notch").light])
    axes.imshow(np.clip(ratios, 0.5, 2), cmap=shades, norm=LogNorm(0.5, 2), aspect="auto", alpha=0.6)
    for (row, column), ratio in np.ndenumerate(ratios):
        if math.isfinite(ratio):
            axes.text(column, row, fixed(ratio), ha="center", va="center", color=plots.INK)
    axes.set_xticks(range(len(titles)), [_wrapped(t) for t in titles], fontsize=8.5)
    axes.set_title(f"{taps} taps, tested on")
    axes.xaxis.tick_top()
    axes.tick_params(length=0)
    axes.grid(visible=False)
    for spine in axes.spines.values():
        spine.set_visible(False)


def _wrapped(title: str) -> str:
    words, lines = title.split(), [""]
    for word in words:
        if lines[-1] and len(lines[-1]) + len(word) > 10:
            lines.append("")
        lines[-1] = f"{lines[-1]} {word}".strip()
    return "\n".join(lines)
