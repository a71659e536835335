"""Section of `recommend_validation`: whether intervals, budgets and refusals held, where, and what did not."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from matplotlib.axes import Axes

from experiments.pictures import LEVELS
from experiments.recommend_validation import FACTOR, HALVES, fitted, fitted_on_surfaces
from experiments.report import plots
from experiments.report.page import Block, Column, Plot, Section, Table
from experiments.report.style import LOOKS, MISSING, fixed, look, text
from experiments.runs import Record
from filterlab.recommendation.calibration import CALIBRATION, FALLS, SURFACE

if TYPE_CHECKING:
    from experiments.recommend_validation import Config

LEAD = (
    "On volumes whose truth is known, what filterlab recommend says is set against it: the interval of the error of "
    "every method and storage, and its answers to questions with a budget. A pick must keep the budget; a refusal is "
    "justified if nothing that was considered meets it. Of isosurfaces and dvr both are judged a second time by what a "
    "picture shows: errors are then those at the hits of its rays, which lie where the surface does, or those of the "
    "segments of its march, weighted by what is seen of each, and not of anywhere in the volume. Where the "
    "level is told, errors are estimated on its surface alone.",
    "Factors were fitted to the tuning half. What counts is the reporting half.",
)
BARS = {"holds": 0.95, "kept": 0.98, "justified": 0.95, "hard": None, "sure": None, "near": 0.80}
WORDS = {
    "holds": "the interval holds the true error",
    "kept": "the pick keeps the budget",
    "justified": "nothing was picked, and nothing meets the budget: budgets as people ask",
    "hard": "the same: budgets near the true errors",
    "sure": "the same: no interval holds the budget (not undecided)",
    "near": f"the pick costs at most {FACTOR} × the cheapest that meets the budget",
}
PICTURED_BAR = 0.95
PICTURED_WORDS = {
    "kept": "the pick keeps the budget",
    "rendered": "so does its rendered picture, by the RMS of pixels",
    "justified": "nothing was picked, and nothing meets the budget",
    "sure": "the same: not undecided",
    "elsewhere": "where something does: nothing does over the region",
}
SHOWN = {
    "volume": "Such a level lies anywhere, and often in what is nearly even: less is wrong there than over the region, "
    "of which refusals speak.",
    "detail": "Such a level lies where the signal changes: more is wrong there than over the region, of which picks "
    "speak.",
}
_OF_LEVEL = " of that level"
AIMED = f"isosurface{_OF_LEVEL}"
TITLES = (
    "interval holds",
    "budget kept",
    "refusal justified",
    "near true errors",
    "not undecided",
    f"cost ≤ {FACTOR} ×",
)

Outcomes = Mapping[str, list[bool]]


def draw(config: Config, records: Mapping[str, Record], _folder: Path) -> Section:
    """The section of the report."""
    volumes = list(records.values())
    reporting = [r for r in volumes if r["half"] == HALVES[1]]
    blocks: list[Block] = []
    if volumes:
        blocks = [
            _verdict(volumes),
            *(_in_pictures(volumes, task, level) for task in ("dvr", "isosurface", AIMED) for level in LEVELS),
            _groups(reporting, "Reporting half, by kind of volume.", lambda r, _: r["class"]),
            _groups(reporting, "Reporting half, by boundary.", lambda _, found: found["boundary"]),
            _groups(reporting, "Reporting half, by task.", None),
            _scatter(reporting),
            _calibration(volumes),
            _on_surfaces(volumes),
            *_failures(reporting),
        ]
    return Section("Does recommend keep its word?", LEAD, blocks)


# --- outcomes ---------------------------------------------------------------------------------------------------------


def outcomes(record: Record, found: Mapping[str, Any], task: str | None = None) -> dict[str, list[bool]]:
    """What held on a volume under a boundary; of one task only."""
    answers = [a for a in found["answers"] if task in (None, a["task"])]
    tasks = {"resample": "value", "isosurface": "gradient"} if record["differentiable"] else {"resample": "value"}
    return {
        "holds": [
            _between(way[name], _counted(way, name))
            for way in found["ways"]
            for name in tasks
            if task in (None, name) and None not in (*way[name], _counted(way, name))  # infinite: no interval
        ],
        "kept": [a["kept"] for a in answers if a["picked"]],
        "justified": [a["justified"] for a in answers if not a["picked"] and not a["near"]],
        "hard": [a["justified"] for a in answers if not a["picked"] and a["near"]],
        "sure": [a["justified"] for a in answers if not a["picked"] and not a["undecided"]],
        "near": [a["factor"] <= FACTOR for a in answers if a["picked"] and a["factor"] is not None],
    }


def pictured(answers: Sequence[Mapping[str, Any]]) -> dict[str, list[bool]]:
    """What held of answers as they are judged by pictures."""
    seen = [(a, a["pictured"]) for a in answers if "pictured" in a]
    refused = [(a, p["justified"]) for a, p in seen if not a["picked"]]
    return {
        "kept": [p["kept"] for a, p in seen if a["picked"]],
        "rendered": [a["rendered"] is not None and a["rendered"] <= a["budget"] for a, _ in seen if "rendered" in a],
        "justified": [justified for _, justified in refused],
        "sure": [justified for a, justified in refused if not a["undecided"]],
        "elsewhere": [a["justified"] for a, justified in refused if not justified],
    }


def _counted(way: Mapping[str, Any], task: str) -> float | None:
    """The true error as the task counts it."""
    value, gradient = way["value"][2], way["gradient"][2]
    return value if task == "resample" or value is None or gradient is None else max(value, gradient)


def _between(interval: Sequence[float], true: float | None) -> bool:
    return true is not None and interval[0] <= true <= interval[1]


def _together(parts: Iterator[Outcomes]) -> dict[str, list[bool]]:
    total: dict[str, list[bool]] = {name: [] for name in BARS}
    for part in parts:
        for name in BARS:
            total[name] += part[name]
    return total


def _of(volumes: Sequence[Record]) -> dict[str, list[bool]]:
    return _together(outcomes(record, found) for record in volumes for found in record["boundaries"])


def _rate(held: Sequence[bool]) -> str:
    return f"{100 * sum(held) / len(held):.1f} % of {len(held)}" if held else MISSING


def _verdict(volumes: Sequence[Record]) -> Table:
    columns = [Column("", numeric=False), Column("asked for"), *(Column(half) for half in HALVES), Column("")]
    halves = {half: [r for r in volumes if r["half"] == half] for half in HALVES}
    known = {half: _of(of_half) for half, of_half in halves.items()}
    rows = [
        [
            WORDS[name],
            MISSING if bar is None else f"≥ {100 * bar:.0f} %",
            *(_rate(known[half][name]) for half in HALVES),
            _met(known[HALVES[1]][name], bar),
        ]
        for name, bar in BARS.items()
    ]
    numbers = " and ".join(f"{len(of_half)} ({half})" for half, of_half in halves.items())
    return Table(columns, rows, f"{numbers} volumes. The last column judges the reporting half.")


def _met(held: Sequence[bool], bar: float | None) -> str:
    return "" if bar is None or not held else "met" if sum(held) >= bar * len(held) else "MISSED"


def _in_pictures(volumes: Sequence[Record], task: str, level: str) -> Table:
    """Both kinds of budgets in both halves, of pictures whose levels are drawn so."""
    kinds = {
        (half, near): pictured(_pictured_answers(volumes, half, task, level, near))
        for half in HALVES
        for near in (False, True)
    }
    columns = [Column("", numeric=False), *(Column(f"{half}, near" if near else half) for half, near in kinds)]
    rows = [
        [
            words,
            *(_rate(held[name]) for held in kinds.values()),
            _met(kinds[HALVES[1], False][name], None if name == "elsewhere" else PICTURED_BAR),
        ]
        for name, words in PICTURED_WORDS.items()
        if (name != "rendered" or task == "dvr") and (name != "elsewhere" or task != AIMED)
    ]
    caption = (
        f"Task {task}, by what pictures show of levels drawn by {level}. {SHOWN[level] if task != AIMED else ''} Near: "
        f"of budgets near the true errors. The last column judges the reporting half, budgets as people ask, by "
        f"{100 * PICTURED_BAR:.0f} %."
    )
    return Table([*columns, Column("")], rows, caption)


def _pictured_answers(
    volumes: Sequence[Record], half: str, task: str, level: str, near: bool
) -> list[Mapping[str, Any]]:
    asked = {"task": task.removesuffix(_OF_LEVEL), "level": level, "near": near}
    found = [found for record in volumes if record["half"] == half for found in record["boundaries"]]
    answers = [a for f in found for a in f["answers"] if asked.items() <= a.items()]
    return [{**a["aimed"], "pictured": a["aimed"]} for a in answers if "aimed" in a] if task == AIMED else answers


def _groups(volumes: Sequence[Record], caption: str, key: Callable[[Record, Any], str] | None) -> Table:
    """Rates in groups of volumes and boundaries; by task without a key."""
    columns = [Column("", numeric=False), *(Column(title) for title in TITLES)]
    pairs = [(record, found) for record in volumes for found in record["boundaries"]]
    if key is None:
        groups = {t: [outcomes(r, f, t) for r, f in pairs] for t in ("resample", "isosurface", "dvr")}
    else:
        groups = {}
        for record, found in pairs:
            groups.setdefault(key(record, found), []).append(outcomes(record, found))
    rows = [[name, *(_rate(_together(iter(parts))[k]) for k in BARS)] for name, parts in sorted(groups.items())]
    return Table(columns, rows, caption)


# --- figures ----------------------------------------------------------------------------------------------------------


def _scatter(volumes: Sequence[Record]) -> Plot:
    with plots.settings():
        figure = plots.canvas(10.4, 4.8)
        left, right = figure.subplots(1, 2)
        for axes, quantity, title in ((left, "value", "value"), (right, "gradient", "gradient per voxel")):
            _panel(axes, volumes, quantity, title)
        left.set_ylabel("measured from the best estimate")
        plots.legend_right(right)
        drawn = plots.svg(figure, "recommend-errors")
    caption = (
        "Error of every method on every volume of the reporting half, as measured from the best estimate of the "
        "signal, against the true one; parts of the range. Hollow: the spectrum falls by less than 10 dB towards the "
        "Nyquist frequency, so that much may be unseen, and the interval is wide."
    )
    return Plot(drawn, caption)


def _panel(axes: Axes, volumes: Sequence[Record], quantity: str, title: str) -> None:
    for method in LOOKS:
        own = look(method)
        for resolved in (True, False):
            pairs = [
                (way[quantity][2], way[quantity][0])
                for record in volumes
                if record["differentiable"] or quantity == "value"
                for found in record["boundaries"]
                if (found["fall"] >= 10) == resolved
                for way in found["ways"]
                if way["method"] == method and way["storage"] is None and way[quantity][0] and way[quantity][2]
            ]
            face, label = (own.light, method) if resolved else ("none", "_")
            axes.plot(*zip(*pairs, strict=True) if pairs else ([], []), own.marker, color=own.light,
                      markerfacecolor=face, markersize=3.5, label=label)  # fmt: skip
    plots.logarithmic_x(axes)
    plots.logarithmic(axes)
    ends = (max(axes.get_xlim()[0], axes.get_ylim()[0]), min(axes.get_xlim()[1], axes.get_ylim()[1]))
    axes.plot(ends, ends, color=plots.INK, linewidth=0.8, alpha=0.6)
    axes.set_xlabel("true error")
    axes.set_title(title)


# --- factors and failures ---------------------------------------------------------------------------------------------


def _calibration(volumes: Sequence[Record]) -> Table:
    """Factors in use, and those that the tuning half gives."""
    columns = [Column("", numeric=False), *(Column(f"{fall:g} dB") for fall in FALLS)]
    found, rows = fitted(volumes), []
    for quantity, used in CALIBRATION.items():
        for i, letter in enumerate("cCL"):
            rows.append([f"{letter} of the {quantity}, in use", *(fixed(factor) for factor in used[i])])
            rows.append(["fitted to the tuning half", *(fixed(factor) for factor in found[quantity][i])])
    caption = (
        "Factors of the doubt at each fall of the spectrum: quantiles of those with which the interval of a method "
        "would just have held. By L is chosen."
    )
    return Table(columns, rows, caption)


def _on_surfaces(volumes: Sequence[Record]) -> Table:
    """By what these are multiplied where errors are those on a surface."""
    columns = [Column("", numeric=False), *(Column(letter) for letter in "cCL")]
    found, rows = fitted_on_surfaces(volumes), []
    for quantity, used in SURFACE.items():
        rows.append([f"of the {quantity}, in use", *(fixed(factor) for factor in used)])
        rows.append(["fitted to the tuning half", *(fixed(factor) for factor in found[quantity])])
    return Table(columns, rows, "On the surface of a level that is told, the factors above are multiplied by these.")


def _failures(volumes: Sequence[Record]) -> Iterator[Table]:
    """Picks over their budget, and refusals that were not justified."""
    for which, outcome, caption in (
        ("over", "kept", "Picks over their budget, reporting half."),
        ("met", "justified", "Refusals where something meets the budget, reporting half."),
    ):
        columns = [Column("volume", numeric=False), Column("boundary", numeric=False), Column("task", numeric=False)]
        columns += [Column("budget"), Column("picked" if which == "over" else "best", numeric=False)]
        columns += [Column("true error"), Column("interval")]
        rows = [
            [
                f"{record['label']} ({record['class']})",
                found["boundary"],
                answer["task"],
                _percent(answer["budget"]),
                ", ".join(str(part) for part in answer["way"] if part is not None),
                _percent(answer["true"]),
                " … ".join(_percent(end) for end in answer["interval"]),
            ]
            for record in volumes
            for found in record["boundaries"]
            for answer in found["answers"]
            if answer[outcome] is False
        ]
        if rows:
            yield Table(columns, rows, caption)


def _percent(part: float | None) -> str:
    return MISSING if part is None else f"{text(100 * part)} %"
