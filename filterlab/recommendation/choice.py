"""The choice: the cheapest way to reconstruct a volume whose error stays within a budget."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from torch import Tensor

from filterlab.fields.base import Field
from filterlab.methods import METHODS, reconstruct
from filterlab.missing_values import resolved
from filterlab.recommendation.errors import ErrorEstimate, errors_of
from filterlab.recommendation.ways import costs_of, ways_of
from filterlab.volume import Boundary, Volume, as_volume

TASKS = ("resample", "dvr", "isosurface")
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
class Recommendation:
    """What `recommend` found.

    Attributes:
        task, max_error, max_memory, max_time, boundary: what was asked.
        value_range: smallest and largest sample.
        candidates: all, the cheapest first.
        pick: the cheapest within the budget; None: there is none.
        best: the one with the least error, whatever it costs.
        nan: what becomes of voxels that are NaN, as asked.
    """

    task: str
    max_error: float
    max_memory: float
    max_time: float
    boundary: str
    value_range: tuple[float, float]
    candidates: tuple[Candidate, ...]
    pick: Candidate | None
    best: Candidate
    nan: str = "refuse"

    @property
    def chosen(self) -> Candidate:
        """The pick; where there is none, the best there is."""
        return self.pick or self.best

    def runners_up(self, number: int = 4) -> list[Candidate]:
        """The next cheapest within the budget; without a pick, the next best."""
        within = self.pick is not None
        rest = [c for c in self.candidates if c is not self.chosen and (not within or self._fits(c))]
        return (rest if within else sorted(rest, key=lambda c: c.error.high))[:number]

    def _fits(self, candidate: Candidate) -> bool:
        return _fits(candidate, self.max_error, self.max_memory, self.max_time)

    def field(self, volume: Volume | Tensor) -> Field:
        """The chosen field of the volume."""
        return reconstruct(volume, boundary=self.boundary, nan=self.nan, **self.chosen.options())


def recommend(
    volume: Volume | Tensor,
    max_error: float,
    *,
    task: str = "resample",
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

    Errors are root mean squares over the inner 0.9 of the volume, in parts of its range (largest − smallest sample):
    of the value for task "resample"; of the value or of the gradient per voxel, whichever is larger, for "isosurface"
    and "dvr", where surfaces and light come from the gradient; for "dvr" together with what a march loses by its step
    s, the RMS of s² |f''| / 24 along rays. Every candidate has its own step: the longest one with which it stays within
    the budget; where it does not with any, the longest one that makes its error at most 1 % larger than the shortest.

    Args:
        volume: a `Volume` or a bare tensor.
        max_error: the budget, as a fraction: 0.005 is half a percent.
        task: resample (as many samples as there are voxels), dvr (a picture of 512² pixels) or isosurface (value and
            gradient at as many points as there are voxels).
        max_memory: bytes that the coefficients may take.
        max_time: seconds that prefiltering and doing the task once may take.
        boundary, nan: as for `filterlab.reconstruct`.
        methods: names to choose from; default all.
        seconds: about how long costs are measured.
        seed: of blocks and points; the errors found repeat themselves, the costs do not.
        progress: told what is done.

    Work and memory are bounded whatever the size: errors are found on at most eight blocks of 64³ voxels (a volume of
    up to 96³ is taken whole), costs on a part of at most 160³.

    Raises:
        ValueError: a budget that is not positive, an unknown task or method, no finite voxels.
    """
    volume, boundary = as_volume(volume), Boundary.named(boundary)
    names = _checked(max_error, max_memory, max_time, task, methods)
    samples, _ = resolved(volume.samples.detach(), nan)
    flat = samples.reshape(-1, *samples.shape[-3:])
    if flat.numel() == 0:
        raise ValueError(f"expected a volume with samples; got shape {tuple(volume.shape)}")
    low, high = (float(end) for end in flat.aminmax())
    span = (high - low) or 1.0
    progress(0.0, "spectra and hold-outs")
    found = errors_of(flat, names, seed, lambda done: progress(0.5 * done, "spectra and hold-outs"))
    near = {name: found.methods[name].estimate(task, span, (0.0, 0.0)).high <= max_error for name in names}
    ways = [way for name in names for way in ways_of(METHODS[name], flat.dtype, near[name])]
    progress(0.5, "costs")
    measured = costs_of(
        flat[0], volume, ways, boundary, task, seconds, lambda done: progress(0.5 + 0.5 * done, "costs")
    )
    candidates = []
    for way, cost in measured.items():
        errors, rounding = found.methods[way[0]], (cost.value_rounding, cost.gradient_rounding)
        estimate = partial(errors.estimate, task, span, rounding)
        bend = found.second_derivative / span
        step, error = _marched(estimate, bend, max_error) if task == "dvr" else (None, estimate())
        seconds_needed = cost.build + 1e-9 * _samples_of(task, volume, step) * cost.nanoseconds
        resolved_here = errors.resolved(span)
        candidates.append(Candidate(*way, step, error, resolved_here, seconds_needed, cost.nanoseconds, cost.memory))
    candidates.sort(key=lambda c: (c.seconds, c.memory))
    fitting = [c for c in candidates if _fits(c, max_error, max_memory, max_time)]
    return Recommendation(
        task=task,
        max_error=max_error,
        max_memory=max_memory,
        max_time=max_time,
        boundary=str(boundary),
        value_range=(low, high),
        candidates=tuple(candidates),
        pick=fitting[0] if fitting else None,
        best=min(candidates, key=lambda c: (c.error.high, c.seconds)),
        nan=nan,
    )


def _checked(
    max_error: float, max_memory: float, max_time: float, task: str, methods: Sequence[str] | None
) -> list[str]:
    """The names of the methods to choose from."""
    for name, value in (("max_error", max_error), ("max_memory", max_memory), ("max_time", max_time)):
        if not value > 0:
            raise ValueError(f"{name} must be positive; got {value!r}")
    if task not in TASKS:
        raise ValueError(f"task must be one of {', '.join(TASKS)}; got {task!r}")
    for name in methods or ():
        if name not in METHODS:
            raise ValueError(f"unknown method {name!r}; known methods: {', '.join(METHODS)}")
    return list(dict.fromkeys(methods)) if methods else list(METHODS)


def _fits(candidate: Candidate, max_error: float, max_memory: float, max_time: float) -> bool:
    within = candidate.error.high <= max_error
    return within and candidate.memory <= max_memory and candidate.seconds <= max_time


def _samples_of(task: str, volume: Volume, step: float | None) -> float:
    """How often the field is sampled when the task is done once."""
    voxels = float(math.prod(volume.shape[-3:])) * math.prod(volume.shape[:-3])
    if task != "dvr" or step is None:
        return voxels
    chord = 0.6 * math.sqrt(sum(n * n for n in volume.shape[-3:]))  # of a ray through a box, roughly
    return IMAGE**2 * chord / step * math.prod(volume.shape[:-3])


def _marched(
    estimate: Callable[[float], ErrorEstimate], second_derivative: float, budget: float
) -> tuple[float, ErrorEstimate]:
    """The longest step within the budget and the error with it; the second derivative in parts of the range.

    Where no step is, the longest one that is nearly as good as the shortest.
    """
    errors = {step: estimate(step**2 * second_derivative / 24) for step in STEPS}
    least = errors[STEPS[-1]].high
    allowed = budget if least <= budget else _NEARLY * least
    return next((step, error) for step, error in errors.items() if error.high <= allowed)
