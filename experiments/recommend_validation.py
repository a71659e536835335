"""Does `filterlab recommend` keep its word? Volumes of wide variety whose truth is known (`variety`), in two halves.

On every volume, under some of the boundaries, for every method and storage, what `recommend` estimates is set
against the true error over the region that is promised; and for every task and some budgets, what it answers is judged:

    an interval     must hold the true error
    a pick          its true error must not exceed the budget, nor its cost 1.5 × that of the cheapest that meets it
    a refusal       nothing that was considered may truly meet the budget

For isosurfaces and dvr the same is judged by pictures too, seen from anywhere:

    isosurface      of a level: errors of value and gradient where rays hit the surface that a method makes
    dvr             of a translucent medium: errors of value and gradient where a march samples, and what it loses over
                    its segments, all weighted by what the picture of the true signal shows of each segment

Levels are drawn by volume or by detail, see `pictures`. A pixel of a medium is a mean along its ray, in which errors
cancel: it can be right where what it shows is wrong, and so refutes no refusal. Of a pick the rendered picture is set
beside that of the signal all the same.

For isosurfaces the same is asked again of the picture's level (`level=`): then errors next to that surface are what is
estimated, and what the picture shows is all that counts.

Budgets are drawn log-uniform, half of them between 0.01 % and 10 %, as people ask; the other half from a quarter of the
least true error to four times the largest, where answers are hardest. Costs are measured once, on one volume, and
carried over: what is judged is the choice.

Volumes of even number are for tuning: `recommend`'s `CALIBRATION` is fitted to them (`fitted`). The others report.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field, model_validator

import filterlab as fl
from experiments.config import ExperimentConfig, VolumeChoice, number
from experiments.members import seed_of
from experiments.pictures import NO_PICTURES, Pictures
from experiments.runs import Record, Run, Unit
from experiments.variety import CLASSES, Subject, of_class, of_scan, size_of
from filterlab.methods import METHODS
from filterlab.recommendation.calibration import CALIBRATION, FALLS, SURFACE, factors
from filterlab.recommendation.choice import TASKS, Candidate, Question, Recommendation, choose, errors_of
from filterlab.recommendation.errors import SURE, MethodErrors, Yardstick
from filterlab.recommendation.ways import Way, WayCost, costs_of, ways_of
from filterlab.scenes.model import MethodName
from filterlab.volume import Boundary, as_volume

Size = Annotated[int, Field(ge=2, le=160)]
FACTOR = 1.5  # of the cheapest that truly meets the budget
HALVES = ("tuning", "reporting")

_BUDGETS = 1e-4, 0.1
_AROUND = 4.0  # times the true errors
_COUNTS, _PARTS = 0.05, (0.97, 0.97, 0.85)  # see `filterlab.recommendation.calibration`
_COSTS_ON = 64  # voxels along an axis


class Config(ExperimentConfig):
    """Which volumes, boundaries and budgets.

    Attributes:
        classes: of `variety`; each: volumes of every one.
        sizes: voxels along an axis, least and most, log-uniform; large: those of one volume in `every`.
        scans, pieces: files, and pieces of every one; one in three is not low-passed before it is decimated.
        boundaries, budgets: how many of the five are drawn for a volume, and of budgets for each task.
        methods: among which it chooses; left out, all.
        points: at which errors are computed.
        seconds: for which costs are measured, once.
    """

    experiment: Literal["recommend_validation"]
    classes: Annotated[list[str], Field(min_length=1)]
    each: Annotated[int, Field(ge=1, le=1000)]
    sizes: tuple[Size, Size] = (8, 64)
    large: tuple[Size, Size] = (96, 160)
    every: Annotated[int, Field(ge=2)] = 15
    scans: Annotated[list[VolumeChoice], Field(default_factory=list)]
    pieces: Annotated[int, Field(ge=1, le=100)] = 6
    boundaries: Annotated[int, Field(ge=1, le=5)] = 2
    budgets: Annotated[int, Field(ge=2, le=20, multiple_of=2)] = 4
    methods: Annotated[list[MethodName], Field(min_length=2, default_factory=lambda: list(METHODS))]
    points: Annotated[int, Field(ge=100, le=10**6)] = 2**14
    seconds: Annotated[float, Field(gt=0, le=600)] = 20.0

    @model_validator(mode="after")
    def _known(self) -> Config:
        if unknown := [name for name in self.classes if name not in CLASSES]:
            raise ValueError(f"expected classes of {', '.join(CLASSES)}; got {', '.join(unknown)}")
        return self


def check(config: Config, path: str = "") -> None:
    """Raises ConfigError unless the scans, but for optional ones, are here."""
    for i, scan in enumerate(config.scans):
        if scan.present:
            scan.check(f"{path}scans[{i}]")


def units(config: Config) -> list[Unit]:
    """One per volume."""
    named = [(name, k) for k in range(config.each) for name in config.classes]
    scanned = [(scan.file, k) for k in range(config.pieces) for scan in config.scans if scan.present]
    return [Unit(f"{i}|{name}|{k}", f"{name} {k}", 4.0) for i, (name, k) in enumerate(named + scanned)]


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one volume: estimates and answers under each boundary."""
    index, name, k = unit.key.split("|")
    random = np.random.default_rng(seed_of(config.seed, int(index)))
    subject = _subject(config, name, int(k), random, run)
    costs = run.memo("costs", lambda: _costs(config))
    chosen = random.permutation(len(Boundary))[: config.boundaries]
    return {
        "class": name if name in CLASSES else "scans",
        "label": subject.label if name in CLASSES else f"{name}, {subject.label}",
        "half": HALVES[int(k) % 2],
        "differentiable": subject.differentiable,
        "boundaries": [_judged(config, subject, list(Boundary)[i], costs, random) for i in chosen],
    }


def _subject(config: Config, name: str, k: int, random: np.random.Generator, run: Run) -> Subject:
    if name in CLASSES:
        large = k % config.every == config.every // 2
        return of_class(name, size_of(random, *(config.large if large else config.sizes)), config.points, random)
    scan = next(s for s in config.scans if s.file == name)
    samples = run.memo(name, lambda: scan.load().samples.double())
    return of_scan(samples, k % 3 == 2, config.sizes[1], config.points, random)


# --- costs ------------------------------------------------------------------------------------------------------------


def _costs(config: Config) -> dict[tuple[Way, int], WayCost]:
    """Of all ways, for jets of order 0 and 1, measured on one volume."""
    volume = fl.signals.marschner_lobb().sample(_COSTS_ON, dtype=torch.float32)
    ways = [way for name in config.methods for way in ways_of(METHODS[name], torch.float32, True)]
    return {
        (way, order): cost
        for order in (0, 1)
        for way, cost in costs_of(volume.samples, volume, ways, Boundary.MIRROR, order, config.seconds / 2).items()
    }


def _carried_over(costs: Mapping[tuple[Way, int], WayCost], task: str, voxels: int) -> dict[Way, WayCost]:
    order, part = (0 if task == "resample" else 1), voxels / _COSTS_ON**3
    return {
        way: WayCost(cost.build * part, cost.nanoseconds, round(cost.memory * part))
        for (way, known), cost in costs.items()
        if known == order
    }


# --- truth ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Truth:
    """True errors of a field, in parts of the range.

    Attributes:
        value, gradient: of these, over the region that is promised.
        bend: the second derivative along lines.
        hit: the greater of the errors of value and gradient in a picture of a level; None: there is none, or few rays
            hit.
        marched: all that dvr counts in a picture of a medium, by step; None: there is none, or hardly anything is seen.
    """

    value: float
    gradient: float
    bend: float
    hit: float | None = None
    marched: Mapping[float, float] | None = None

    def counted(self, task: str, step: float | None) -> float:
        """As the task counts it."""
        own = self.value if task == "resample" else max(self.value, self.gradient)
        return math.hypot(own, 0.0 if step is None else step**2 / 24 * self.bend)

    def pictured(self, step: float | None) -> float | None:
        """The same in a picture: of a medium at a step, of a level without; None: there is none."""
        return self.hit if step is None else None if self.marched is None else self.marched[step]


def truth_of(subject: Subject, boundary: Boundary, way: Way, span: float, pictures: Pictures = NO_PICTURES) -> Truth:
    """Of the field that a way makes of the volume."""
    field = fl.reconstruct(subject.volume, way[0], boundary=boundary, storage=way[2])
    value, gradient = field.value_and_gradient(subject.points)
    off = ((value.double() - subject.value) / span).square(), ((gradient.double() - subject.gradient) / span).square()
    bend = (subject.second_derivative / span).square()
    means = [float((subject.weights * x).sum()) for x in (off[0], off[1].sum(-1), bend)]
    hit, marched = pictures.errors(field)
    return Truth(*(math.sqrt(mean) for mean in means), hit=hit, marched=marched)


def truths_of(
    subject: Subject, boundary: Boundary, ways: Iterable[Way], span: float, pictures: Pictures = NO_PICTURES
) -> dict[Way, Truth]:
    """Of the fields of all ways; schemes compute the same field."""
    known: dict[tuple[str, str | None], Truth] = {}
    found = {}
    for way in ways:
        if (way[0], way[2]) not in known:
            known[way[0], way[2]] = truth_of(subject, boundary, way, span, pictures)
        found[way] = known[way[0], way[2]]
    return found


# --- judgement --------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Measured:
    """What `recommend` measures on a volume, all of it or next to the surface of a level."""

    yardstick: Yardstick
    errors: Mapping[Way, MethodErrors]

    @classmethod
    def of(cls, config: Config, subject: Subject, boundary: Boundary, level: float | None = None) -> Measured:
        """Of all ways."""
        yardstick = Yardstick.of(subject.volume[None], None, boundary, config.seed, level=level)
        return cls(yardstick, errors_of(yardstick, config.methods, subject.volume.dtype, lambda _: True))

    def answer(self, task: str, budget: float, volume: fl.Volume, costs: Mapping[Way, WayCost]) -> Recommendation:
        """Without limits of memory and time."""
        own = self.yardstick
        question = Question(task, budget, math.inf, math.inf, str(own.boundary), "refuse", level=own.level)
        return choose(question, volume, own, self.errors, costs)


def _judged(
    config: Config,
    subject: Subject,
    boundary: Boundary,
    costs: Mapping[tuple[Way, int], WayCost],
    random: np.random.Generator,
) -> dict[str, Any]:
    """Estimates and answers under a boundary."""
    measured = Measured.of(config, subject, boundary)
    yardstick, errors = measured.yardstick, measured.errors
    pictures = Pictures.of(subject, yardstick.span, random)
    truths = truths_of(subject, boundary, errors, yardstick.span, pictures)
    aimed = _aimed(config, subject, boundary, truths, pictures)
    return {
        "boundary": str(boundary),
        "fall": yardstick.fall,
        "doubts": dict(yardstick.doubts),
        "bend": [yardstick.bend, next(iter(truths.values())).bend],
        "ways": list(_compared(yardstick, errors, truths)),
        "answers": list(_answers(config, subject, measured, aimed, truths, costs, pictures, random)),
        **({} if aimed is None else {"aimed": _compared_aimed(aimed, subject, truths)}),
    }


def _aimed(
    config: Config, subject: Subject, boundary: Boundary, truths: Mapping[Way, Truth], pictures: Pictures
) -> Measured | None:
    """Next to the surface of the picture; None: there is none, or few of its rays hit."""
    if pictures.picture is None or not _all_seen(truths, None):
        return None
    return Measured.of(config, subject, boundary, pictures.picture.level)


def _compared_aimed(aimed: Measured, subject: Subject, truths: Mapping[Way, Truth]) -> dict[str, Any]:
    """Of all of the surface, and what its picture shows."""
    yardstick, (patch,) = aimed.yardstick, aimed.yardstick.patches
    assert yardstick.level is not None
    surface = subject.on_surface(yardstick.level, patch.points, patch.weights)
    of_surface = truths_of(surface, yardstick.boundary, aimed.errors, yardstick.span)
    shown = {(way[0], way[2]): truth.hit for way, truth in truths.items()}
    ways = _compared(yardstick, aimed.errors, of_surface)
    return {
        "fall": yardstick.fall,
        "doubts": dict(yardstick.doubts),
        "ways": [found | {"pictured": shown[found["method"], found["storage"]]} for found in ways],
    }


def _compared(
    yardstick: Yardstick, errors: Mapping[Way, MethodErrors], truths: Mapping[Way, Truth]
) -> Iterator[dict[str, Any]]:
    """Every method and storage once: what was measured, and what is true."""
    seen = set()
    for way, found in errors.items():
        if (way[0], way[2]) not in seen:
            seen.add((way[0], way[2]))
            estimates = {task: yardstick.estimate(task, found) for task in ("resample", "isosurface")}
            yield {
                "method": way[0],
                "storage": way[2],
                "value": [number(found.value.rms), found.value.spread, number(truths[way].value)],
                "gradient": [number(found.gradient.rms), found.gradient.spread, number(truths[way].gradient)],
                **{task: [number(e.low), number(e.high)] for task, e in estimates.items()},
            }


def _answers(
    config: Config,
    subject: Subject,
    measured: Measured,
    aimed: Measured | None,
    truths: Mapping[Way, Truth],
    costs: Mapping[tuple[Way, int], WayCost],
    pictures: Pictures,
    random: np.random.Generator,
) -> Iterator[dict[str, Any]]:
    """For every task and budget."""
    volume = as_volume(subject.volume)
    for task in TASKS if subject.differentiable else TASKS[:1]:
        taken = _carried_over(costs, task, subject.volume.numel())
        for near, budget in _budgets(config, task, truths, random):
            answer = measured.answer(task, budget, volume, taken)
            found = {"near": near, **judged(answer, partial(_true, task, truths))}
            found |= _by_pictures(answer, subject, truths, pictures)
            if task == "isosurface" and aimed is not None:
                found["aimed"] = judged(aimed.answer(task, budget, volume, taken), partial(_seen, truths))
            yield found


def _all_seen(truths: Mapping[Way, Truth], step: float | None) -> bool:
    """Whether there is a picture of every field; but for the method `nearest`, which has few levels."""
    return all(t.pictured(step) is not None for way, t in truths.items() if way[0] != "nearest")


def _by_pictures(
    answer: Recommendation, subject: Subject, truths: Mapping[Way, Truth], pictures: Pictures
) -> dict[str, Any]:
    """The answer judged by pictures, and the picture of a pick beside the true one; nothing where there are none."""
    if pictures.picture is None or answer.task == "resample" or not _all_seen(truths, answer.best.step):
        return {}
    found = {"level": pictures.picture.drawn_by, "pictured": judged(answer, partial(_seen, truths))}
    if answer.pick is None or answer.pick.step is None or pictures.cloud is None:
        return found
    return found | {"rendered": number(pictures.cloud.rendered(answer.field(subject.volume), answer.pick.step))}


def _seen(truths: Mapping[Way, Truth], candidate: Candidate) -> float:
    seen = truths[candidate.method, candidate.scheme, candidate.storage].pictured(candidate.step)
    return math.inf if seen is None else seen


def _true(task: str, truths: Mapping[Way, Truth], candidate: Candidate) -> float:
    return truths[candidate.method, candidate.scheme, candidate.storage].counted(task, candidate.step)


def _budgets(
    config: Config, task: str, truths: Mapping[Way, Truth], random: np.random.Generator
) -> Iterator[tuple[bool, float]]:
    """(whether it is near the true errors, budget)."""
    plain = [t.counted(task, None) for way, t in truths.items() if way[2] is None]
    around = max(min(plain), 1e-9) / _AROUND, max(*plain, 1e-9) * _AROUND
    for i in range(config.budgets):
        low, high = around if i % 2 else _BUDGETS
        yield bool(i % 2), low * (high / low) ** random.random()


def judged(answer: Recommendation, true: Callable[[Candidate], float]) -> dict[str, Any]:
    """An answer beside the truth.

    kept: of a pick, whether the budget holds; justified: of a refusal, whether nothing meets it; undecided: whether
    something may, as far as intervals tell; factor: what the pick costs ÷ the cheapest that truly meets the budget.
    """
    pick = answer.pick
    meeting = [c for c in answer.candidates if true(c) <= answer.max_error]
    cheapest = min((c.seconds for c in meeting), default=None)
    shown = pick or answer.best
    return {
        "task": answer.task,
        "budget": answer.max_error,
        "picked": pick is not None,
        "way": [shown.method, shown.storage, shown.step],
        "true": number(true(shown)),
        "interval": [number(shown.error.low), number(shown.error.high)],
        "kept": None if pick is None else true(pick) <= answer.max_error,
        "undecided": pick is None and any(c.error.low <= answer.max_error for c in answer.candidates),
        "justified": None if pick is not None else not meeting,
        "factor": None if pick is None or cheapest is None else pick.seconds / cheapest,
    }


# --- calibration ------------------------------------------------------------------------------------------------------


def fitted(records: Sequence[Record]) -> dict[str, tuple[list[float], ...]]:
    """c, C and L of `filterlab.recommendation.calibration`, from the records of the tuning half."""
    tuning = [r for r in records if r["half"] == HALVES[0]]
    return {quantity: _quantiles(_needed(tuning, quantity)) for quantity in CALIBRATION}


def fitted_on_surfaces(records: Sequence[Record]) -> dict[str, list[float]]:
    """`filterlab.recommendation.calibration.SURFACE`, likewise; infinite where nothing tells."""
    tuning = [r for r in records if r["half"] == HALVES[0]]
    found = {}
    for quantity in SURFACE:
        fall, *needed = _needed(tuning, quantity, "aimed").T
        known = np.array([factors(quantity, own) for own in fall]).reshape(-1, 3).T
        with np.errstate(divide="ignore", invalid="ignore"):
            parts = [np.nan_to_num(needed[i > 0] / own, posinf=math.inf) for i, own in enumerate(known)]
        found[quantity] = [_quantile(own, part) for own, part in zip(parts, _PARTS, strict=True)]
    return found


def _needed(records: Sequence[Record], quantity: str, part: str | None = None) -> np.ndarray:
    """(N, 3): φ, and the c and the C with which each interval would just have held, where the doubt counts at all; of
    a part of the records."""
    rows = []
    for found in _estimated(records, quantity, part):
        doubt = found["doubts"][quantity]
        for d, spread, t in _pairs(found, quantity):
            if d is not None and t is not None and doubt > _COUNTS * d:
                sampled = 1 + SURE * spread
                below, above = max(d / sampled - t, 0.0), math.sqrt(max(t**2 - (d * sampled) ** 2, 0.0))
                rows.append((found["fall"], below / doubt, above / doubt))
    return np.array(rows).reshape(-1, 3)


def _estimated(records: Sequence[Record], quantity: str, part: str | None) -> Iterator[Mapping[str, Any]]:
    """What was estimated under each boundary, or that part of it, where it is and has the quantity."""
    for record in records:
        if record["differentiable"] or quantity == "value":
            for found in record["boundaries"]:
                if part is None or part in found:
                    yield found if part is None else found[part]


def _pairs(found: Mapping[str, Any], quantity: str) -> list[list[Any]]:
    """(distance, its spread, truth) of every method as it comes; of the second derivative, of the reference."""
    if quantity == "bend":
        measured, true = found["bend"]
        return [[measured, 0.0, true]]
    return [way[quantity] for way in found["ways"] if way["storage"] is None]


def _quantiles(rows: np.ndarray) -> tuple[list[float], ...]:
    """At each of `FALLS`, over what lies between its neighbours; infinite where nothing does."""
    ends = (-math.inf, *FALLS, math.inf)
    near = [rows[(rows[:, 0] >= low) & (rows[:, 0] <= high), 1:] for low, high in zip(ends[:-2], ends[2:], strict=True)]
    return tuple(
        [_quantile(found[:, column], part) for found in near] for column, part in zip((0, 1, 1), _PARTS, strict=True)
    )


def _quantile(values: np.ndarray, part: float) -> float:
    return float(np.quantile(values, part)) if len(values) else math.inf
