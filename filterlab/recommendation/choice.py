"""The choice: the cheapest way to reconstruct a volume whose error stays within a budget."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from functools import partial
from typing import Any

import torch

from filterlab.arrays import Array
from filterlab.fields.base import Field
from filterlab.methods import METHODS, reconstruct
from filterlab.missing_values import resolved
from filterlab.names import TASKS
from filterlab.recommendation.errors import ErrorEstimate, MethodErrors, Yardstick
from filterlab.recommendation.ways import Way, WayCost, costs_of, ways_of
from filterlab.volume import Boundary, Volume, as_volume

STEPS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18, 0.125)
IMAGE = 512  # pixels along a side of the picture whose time is told

_NEARLY = 1.01  # as good as the best

Progress = Callable[[float, str], None]
"""Told which fraction is done, and what comes next."""


@dataclass(frozen=True)
class Candidate:
    """A way to reconstruct the volume.

    Attributes:
        method, scheme, storage: as for `filterlab.reconstruct`; storage None: as it comes.
        step: of a march, in voxels; None but for task "dvr".
        error: all that the task counts.
        resolved: False where much of the error comes from beyond the Nyquist frequency: the volume is too coarse for
            what it shows, and no method can know the rest.
        seconds: to prefilter the whole volume and do the task once.
        nanoseconds: per sample.
        memory: bytes of the coefficients of the whole volume.
    """

    method: str
    scheme: str
    storage: str | None
    step: float | None
    error: ErrorEstimate
    resolved: bool
    seconds: float
    nanoseconds: float
    memory: int

    def options(self) -> dict[str, Any]:
        """Keywords for `filterlab.reconstruct`."""
        return {"method": self.method, "scheme": self.scheme, "storage": self.storage}


@dataclass(frozen=True)
class Question:
    """What `recommend` is asked, as its arguments; `boundary` by name; level None: of no surface in particular."""

    task: str
    max_error: float
    max_memory: float
    max_time: float
    boundary: str
    nan: str
    level: float | None = field(default=None, kw_only=True)

    def __post_init__(self) -> None:
        for name in ("max_error", "max_memory", "max_time"):
            if not getattr(self, name) > 0:
                raise ValueError(f"{name} must be positive; got {getattr(self, name)!r}")
        if self.task not in TASKS:
            raise ValueError(f"task must be one of {', '.join(TASKS)}; got {self.task!r}")
        if self.level is not None and self.task != "isosurface":
            raise ValueError(f"level is that of an isosurface; got level={self.level:g} for task {self.task!r}")

    def fits(self, candidate: Candidate) -> bool:
        """Whether it most likely stays within the budget, and within the limits."""
        within = candidate.error.likely <= self.max_error
        return within and candidate.memory <= self.max_memory and candidate.seconds <= self.max_time


@dataclass(frozen=True)
class Recommendation(Question):
    """What `recommend` found, beside what was asked.

    Attributes:
        value_range: smallest and largest sample.
        candidates: all, the cheapest first.
        pick: the cheapest whose error is most likely within the budget; None: there is none.
        best: the one with the least error, whatever it costs.
        of_value: the least error of the value alone, as task "resample" counts it.
    """

    value_range: tuple[float, float]
    candidates: tuple[Candidate, ...]
    pick: Candidate | None
    best: Candidate
    of_value: ErrorEstimate

    @property
    def chosen(self) -> Candidate:
        """The pick; where there is none, the best there is."""
        return self.pick or self.best

    @property
    def undecided(self) -> bool:
        """Whether nothing was picked, though the error of something may be within the budget: its interval holds it."""
        return self.pick is None and any(c.error.low <= self.max_error for c in self.candidates)

    def runners_up(self, number: int = 4) -> list[Candidate]:
        """The next cheapest within the budget; without a pick, the next best."""
        within = self.pick is not None
        rest = [c for c in self.candidates if c is not self.chosen and (not within or self.fits(c))]
        return (rest if within else sorted(rest, key=lambda c: c.error.likely))[:number]

    def field(self, volume: Volume | Array) -> Field:
        """The chosen field of the volume."""
        return reconstruct(volume, boundary=self.boundary, nan=self.nan, **self.chosen.options())


def recommend(
    volume: Volume | Array,
    max_error: float,
    *,
    task: str = "resample",
    level: float | None = None,
    max_memory: float = math.inf,
    max_time: float = math.inf,
    boundary: str | Boundary = Boundary.MIRROR,
    nan: str = "refuse",
    methods: Sequence[str] | None = None,
    seconds: float = 2.0,
    seed: int = 0,
    progress: Progress = lambda done, what: None,
) -> Recommendation:
    """The cheapest method, scheme, storage (and step of a march) whose error on this volume stays within a budget.

    Errors are root mean squares in parts of the range of the samples (largest − smallest; of a constant volume, its
    magnitude), over the inner 0.9 of the box that voxels fill along every axis, as far as it lies between the first and
    the last sample, under the boundary asked for and as fields are evaluated at float32 points: of the value for task
    "resample"; of the value or of the gradient per voxel, whichever is larger, for "isosurface" and "dvr", where
    surfaces and light come from the gradient; for "dvr" together with what a march loses by its step s, the RMS of
    s² |f''| / 24 along rays. Every candidate has its own step: the longest one with which it stays within the budget;
    where it does not with any, the longest one that makes its error at most 1 % larger than the shortest.

    An error is an interval: what is measured, and how far the best estimate of the signal may be off, see
    `filterlab.recommendation.errors`. The pick's `likely` end is within the budget; where its upper end is not, the
    budget is kept in nine of ten cases. On 239 volumes that nothing was fitted to (`experiments.recommend_validation`:
    its reporting half, judged anew from its records, and half a draw with another seed) 96.5 % of intervals held the
    true error, and 95.6 % of refusals were justified, 83.5 % of those with budgets near the true errors; of the second
    draw 500 of 505 picks kept their budgets. Where nothing was picked though an interval holds the budget, the answer
    is `undecided`; else nothing met it in 99.7 %.

    Of a `level` errors are those on its surface, by area: in pictures of 249 volumes 97.5 % of 475 picks that were
    asked so kept their budgets, where 88.3 % of those did that were asked of the volume.

    A picture sees a part of the region, where errors may be larger, as on an edge, or smaller, as in what is nearly
    even: in pictures of 461 volumes 95.2 % of picks for dvr and 93.3 % of those for isosurfaces kept their budgets, and
    nothing met the budget after 96.5 and 93.5 % of refusals that were not undecided (`docs/recommend.md`). The loss of
    a march is that of the value: in a medium of optical depth τ per voxel a pixel moves by another τ s² / 12 times the
    slope along its ray, since the front of a segment hides its back. No transfer function is known here.

    Args:
        volume: a `Volume` or a bare tensor.
        max_error: the budget, as a fraction: 0.005 is half a percent.
        task: resample (as many samples as there are voxels), dvr (a picture of 512² pixels) or isosurface (value and
            gradient at as many points as there are voxels).
        level: of the isosurface that is shown, a value of the volume; None: errors are those of all of the region.
        max_memory: bytes that the coefficients may take.
        max_time: seconds that prefiltering and doing the task once may take.
        boundary, nan: as for `filterlab.reconstruct`.
        methods: names to choose from; default all.
        seconds: about how long costs are measured.
        seed: of the points; the errors found repeat themselves, the costs do not.
        progress: told what is done.

    Every voxel is looked at once, and once more for a level. Beyond that, work and memory are bounded: errors are found
    at 2¹⁴ points, drawn where the volume has detail, of the whole volume up to 160³ voxels, else of 24 parts of it;
    costs on a part of at most 160³. What is recommended is built once, to see that it can be.

    Raises:
        ValueError: a budget that is not positive, an unknown task or method, a level for another task, or one that has
            no surface in the region, no finite voxels, or values so large that float32 overflows.
    """
    volume, boundary = as_volume(volume), Boundary.named(boundary)
    question, names = Question(task, max_error, max_memory, max_time, str(boundary), nan, level=level), _known(methods)
    samples, unknown = resolved(volume.samples.detach(), nan)
    samples = samples.reshape(-1, *samples.shape[-3:])
    unknown = None if unknown is None else unknown.reshape(samples.shape).cpu()
    yardstick = Yardstick.of(samples.cpu(), unknown, boundary, seed, lambda done: progress(0.3 * done, "errors"), level)
    errors = errors_of(yardstick, names, samples.dtype, lambda e: yardstick.estimate(task, e).likely <= max_error)
    progress(0.5, "costs")
    order, tick = 0 if task == "resample" else 1, lambda done: progress(0.5 + 0.5 * done, "costs")
    costs = costs_of(samples[0], volume, list(errors), boundary, order, seconds, tick)
    return choose(question, volume, yardstick, errors, costs)


def _known(methods: Sequence[str] | None) -> list[str]:
    """The names of the methods to choose from."""
    for name in methods or ():
        if name not in METHODS:
            raise ValueError(f"unknown method {name!r}; known methods: {', '.join(METHODS)}")
    return list(dict.fromkeys(methods)) if methods else list(METHODS)


def errors_of(
    yardstick: Yardstick, names: Sequence[str], dtype: torch.dtype, near: Callable[[MethodErrors], bool]
) -> dict[Way, MethodErrors]:
    """Of every way worth considering: methods as they come; of those near the budget every scheme and storage."""
    found: dict[Way, MethodErrors] = {}
    for name in names:
        plain = yardstick.errors(name)
        for way in ways_of(METHODS[name], dtype, near(plain)):
            with suppress(ValueError):  # numbers that a storage can't hold
                found[way] = plain if way[2] is None else yardstick.errors(name, way[2])
    return found


def choose(
    question: Question,
    volume: Volume,
    yardstick: Yardstick,
    errors: Mapping[Way, MethodErrors],
    costs: Mapping[Way, WayCost],
) -> Recommendation:
    """The answer, from errors and costs of ways; of those that have both."""
    candidates = [
        _candidate(question, volume, yardstick, way, errors[way], cost) for way, cost in costs.items() if way in errors
    ]
    candidates.sort(key=lambda c: (c.seconds, c.memory))
    most_accurate = sorted(candidates, key=lambda c: (c.error.likely, c.seconds))
    builds, of_values = partial(_builds, question, volume), [yardstick.estimate("resample", e) for e in errors.values()]
    return Recommendation(
        **vars(question),
        value_range=yardstick.value_range,
        candidates=tuple(candidates),
        pick=next(filter(builds, filter(question.fits, candidates)), None),
        best=next(filter(builds, most_accurate)),
        of_value=min(of_values, key=lambda error: error.likely),
    )


def _candidate(
    question: Question, volume: Volume, yardstick: Yardstick, way: Way, errors: MethodErrors, cost: WayCost
) -> Candidate:
    estimate = partial(yardstick.estimate, question.task, errors)
    step, error = _marched(estimate, question.max_error) if question.task == "dvr" else (None, estimate())
    seconds = cost.build + 1e-9 * _samples_of(question.task, volume, step) * cost.nanoseconds
    return Candidate(*way, step, error, yardstick.resolved, seconds, cost.nanoseconds, cost.memory)


def _builds(question: Question, volume: Volume, candidate: Candidate) -> bool:
    """Whether the field can be built of all of the volume as it is; a part of it may have been easier to store."""
    try:
        reconstruct(volume, boundary=question.boundary, nan=question.nan, **candidate.options())
    except ValueError:
        return False
    return True


def _samples_of(task: str, volume: Volume, step: float | None) -> float:
    """How often the field is sampled when the task is done once.

    A picture is as wide as the diagonal of the box, which then fits into it from any side. Seen by parallel rays, the
    chords of all pixels add up to the volume, whatever the direction: IMAGE² V / (diagonal² s) samples.
    """
    voxels = float(math.prod(volume.shape))
    if task != "dvr" or step is None:
        return voxels
    return IMAGE**2 * voxels / (sum(n * n for n in volume.shape[-3:]) * step)


def _marched(estimate: Callable[[float], ErrorEstimate], budget: float) -> tuple[float, ErrorEstimate]:
    """The longest step within the budget and the error with it.

    Where no step is, the longest one that is nearly as good as the shortest.
    """
    errors = {step: estimate(step) for step in STEPS}
    least = errors[STEPS[-1]].likely
    allowed = budget if least <= budget else _NEARLY * least
    return next(
        ((step, error) for step, error in errors.items() if error.likely <= allowed), (STEPS[-1], errors[STEPS[-1]])
    )
