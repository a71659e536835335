"""Which method for this volume: the cheapest one whose error stays within a budget, judged on the volume itself.

    blocks of the volume ─┬─▶ spectrum ──▶ predicted error of every method, at this resolution and at half of it
                          └─▶ every second sample ──▶ rebuilt, compared with the rest: measured error at half of it
    measured at half · predicted here / predicted at half  =  the measured error, corrected for the resolution

Prediction and corrected measurement are two views of the same error that fail for different reasons: what they differ
by is the uncertainty, and the larger of both must stay within the budget. Costs are measured on this machine.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from filterlab import costs, metrics
from filterlab.fields.base import Field
from filterlab.fields.grid import GridField
from filterlab.kernels import bspline
from filterlab.methods import METHODS, Method, reconstruct
from filterlab.missing_values import resolved
from filterlab.prediction import Spectrum, predicted_error, rms_second_derivative, spectrum_of
from filterlab.volume import Boundary, Volume, as_volume

TASKS = ("resample", "dvr", "isosurface")
STORAGE = ("float16", "int16", "uint8")
STEPS = (1.0, 0.7, 0.5, 0.35, 0.25, 0.18, 0.125)
IMAGE = 512  # pixels along a side of the picture whose time is told

_BLOCK, _BLOCKS = 64, 8
_WHOLE = 96**3  # voxels of a volume that is one block
_POINTS = 6000  # of a block at which a rebuilt field is compared
_CROP = 160  # voxels along an axis of the part that costs are measured on
_RAYS, _SAMPLES = 128, 64
_NEARLY = 1.01  # as good as the best
_ROUNDING = 1e-6  # parts of the range: about what float32 leaves
_RESOLVED = 0.1  # or less of the squared error comes from beyond the Nyquist frequency
_DOUBT = 1.02  # of what is measured: by so much a method may be further off than it seems, the sampling apart
_UNMEASURED = 1.5  # and so much where nothing could be held out

Progress = Callable[[float, str], None]
"""Told which fraction is done, and what comes next."""


@dataclass(frozen=True)
class ErrorEstimate:
    """An error in parts of the value range.

    Attributes:
        predicted: from the spectrum.
        measured: from the samples that were held out, corrected for the resolution; None: none could be.
        low, high: between what it lies.
    """

    predicted: float
    measured: float | None
    low: float
    high: float


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
        return reconstruct(volume, boundary=self.boundary, **self.chosen.options())


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
    found = _errors(flat, names, seed, lambda done: progress(0.5 * done, "spectra and hold-outs"))
    near = {name: found.methods[name].estimate(task, span, (0.0, 0.0)).high <= max_error for name in names}
    ways = [way for name in names for way in _ways(METHODS[name], flat.dtype, near[name])]
    progress(0.5, "costs")
    measured = _costs(flat[0], volume, ways, boundary, task, seconds, lambda done: progress(0.5 + 0.5 * done, "costs"))
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


# --- errors -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _MethodErrors:
    """RMS errors of one method over all blocks, (value, gradient per voxel).

    Attributes:
        predicted: at the resolution of the volume.
        measured: held out, corrected for the resolution; None: nothing could be held out.
        spread: standard error of the mean square over blocks, relative to it.
        beyond: part of the squared error that comes from beyond the Nyquist frequency.
    """

    predicted: tuple[float, float]
    measured: tuple[float, float] | None
    spread: float
    beyond: float

    def resolved(self, span: float) -> bool:
        """Whether the volume resolves what it shows; an error that is rounding says nothing of that."""
        return self.beyond < _RESOLVED or self.predicted[0] <= _ROUNDING * span

    def estimate(self, task: str, span: float, rounding: tuple[float, float], lost: float = 0.0) -> ErrorEstimate:
        """What the task counts, with what storage and step add."""

        def counted(errors: tuple[float, float]) -> float:
            both = [math.hypot(e, r) / span for e, r in zip(errors, rounding, strict=True)]
            return math.hypot(both[0] if task == "resample" else max(both), lost)

        predicted = counted(self.predicted)
        measured = None if self.measured is None else counted(self.measured)
        known = [predicted] if measured is None else [predicted, measured]
        doubt = (_UNMEASURED if measured is None else _DOUBT) * math.sqrt(1 + self.spread)
        return ErrorEstimate(predicted, measured, min(known) / doubt, max(known) * doubt)


@dataclass(frozen=True)
class _Errors:
    methods: dict[str, _MethodErrors]
    second_derivative: float


def _errors(samples: Tensor, names: Sequence[str], seed: int, tick: Callable[[float], None]) -> _Errors:
    """Of every method, from blocks of samples (V, D, H, W)."""
    random = np.random.default_rng(seed)
    blocks = list(_blocks(samples, random))
    rows: dict[str, list[list[float]]] = {name: [] for name in names}
    bends = []
    for i, block in enumerate(blocks):
        spectrum = spectrum_of(block)
        bends.append(rms_second_derivative(spectrum) ** 2)
        for name, row in _errors_of_block(block, spectrum, names, random).items():
            rows[name].append(row)
        tick((i + 1) / len(blocks))
    found = {name: _combined(np.array(rows[name])) for name in names}
    return _Errors(found, math.sqrt(float(np.mean(bends))))


def _blocks(samples: Tensor, random: np.random.Generator) -> Iterator[Tensor]:
    """The whole volumes where they are small, else blocks at random."""
    size = samples.shape[1:]
    if math.prod(size) <= _WHOLE and len(samples) <= _BLOCKS:
        yield from samples.unbind(0)
        return
    edges = [min(n, _BLOCK) for n in size]
    for _ in range(_BLOCKS):
        at = [int(random.integers(0, n - e + 1)) for n, e in zip(size, edges, strict=True)]
        chosen = samples[int(random.integers(0, len(samples)))]
        for dim, (first, edge) in enumerate(zip(at, edges, strict=True)):
            chosen = chosen.narrow(dim, first, edge)
        yield chosen


def _errors_of_block(
    block: Tensor, spectrum: Spectrum, names: Sequence[str], random: np.random.Generator
) -> dict[str, list[float]]:
    """Squared errors: predicted value, gradient; measured at half the resolution; predicted there; part beyond."""
    rows = {}
    held_out = _HoldOut.of(block, random)
    for name in names:
        here = predicted_error(spectrum, name)
        row = [here.value**2, here.gradient**2, *[math.nan] * 4, here.beyond * here.value**2]
        if held_out is not None:
            there = predicted_error(spectrum, name, step=2)
            value, gradient = held_out.error(name)
            row[2:6] = [value**2, gradient**2, there.value**2, there.gradient**2]
        rows[name] = row
    return rows


def _combined(rows: np.ndarray) -> _MethodErrors:
    mean = rows.mean(0)
    predicted = math.sqrt(mean[0]), math.sqrt(mean[1])
    spread = float(rows[:, 0].std(ddof=1) / math.sqrt(len(rows)) / mean[0]) if len(rows) > 1 and mean[0] > 0 else 0.0
    measured = None
    if math.isfinite(mean[2]):
        ratios = [mean[k] / mean[k + 2] if mean[k + 2] > 0 else 1.0 for k in (2, 3)]
        measured = predicted[0] * math.sqrt(ratios[0]), predicted[1] * math.sqrt(ratios[1])
    return _MethodErrors(predicted, measured, spread, float(mean[6] / mean[0]) if mean[0] > 0 else 0.0)


@dataclass(frozen=True)
class _HoldOut:
    """A block of which every second sample is kept, to be rebuilt.

    Attributes:
        kept: the samples that are kept, a volume on the same world.
        points: where fields are compared (P, 3).
        value, gradient: of the block itself, from a spline of degree five.
    """

    kept: Volume
    points: Tensor
    value: Tensor
    gradient: Tensor

    @classmethod
    def of(cls, block: Tensor, random: np.random.Generator) -> _HoldOut | None:
        """None for a block of which nothing can be left out."""
        step = [2 if n >= 16 or n == 1 else 0 for n in block.shape]
        if 0 in step or max(block.shape) < 16:
            return None
        exact = block.to("cpu", torch.float64)
        kept = exact[tuple(slice(None, None, s) for s in step)]
        size = torch.tensor([2.0 * (n - 1) for n in reversed(kept.shape)], dtype=torch.float64)
        unit = torch.tensor(random.random((_POINTS, 3)))
        points = size * (0.5 + 0.9 * (unit - 0.5))
        reference = reconstruct(exact, bspline(5), boundary="reflect")
        value, gradient = reference.value_and_gradient(points)
        return cls(Volume(kept, spacing=2.0), points, value, gradient)

    def error(self, method: str) -> tuple[float, float]:
        """RMS of value and gradient of the field rebuilt by a method."""
        field = reconstruct(self.kept, method, boundary="reflect")
        value, gradient = field.value_and_gradient(self.points)
        off = metrics.rms(value, self.value), metrics.rms(gradient, self.gradient, vectors=True)
        return float(off[0]), float(off[1])


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


# --- costs ------------------------------------------------------------------------------------------------------------

Way = tuple[str, str, str | None]
"""Method, scheme, storage."""


def _ways(method: Method, dtype: torch.dtype, all_of_them: bool) -> Iterator[Way]:
    """The first scheme that runs; or every scheme that gives the method's own gradient, and shorter storage."""
    first = _first_scheme(method, dtype)
    yield method.name, first, None
    if all_of_them:
        for scheme in method.schemes:
            own = scheme != "eight_trilinear" or method.sampled_gradient == method.gradients[0]
            if own and scheme != first:
                yield method.name, scheme, None
        for storage in STORAGE:
            yield method.name, first, storage


def _first_scheme(method: Method, dtype: torch.dtype) -> str:
    """What `reconstruct` takes for such samples when it is not told."""
    field = reconstruct(torch.zeros(2, 2, 2, dtype=dtype), method)
    assert isinstance(field, GridField)
    return field.scheme.name


@dataclass(frozen=True)
class _Cost:
    """Seconds to build the whole field, nanoseconds per sample, bytes, and what the storage rounds off."""

    build: float
    nanoseconds: float
    memory: int
    value_rounding: float
    gradient_rounding: float


def _costs(
    samples: Tensor,
    volume: Volume,
    ways: list[Way],
    boundary: Boundary,
    task: str,
    seconds: float,
    tick: Callable[[float], None],
) -> dict[Way, _Cost]:
    """Of the ways that can run here: measured on the middle of (D, H, W), and carried over to the whole volume."""
    part = samples
    for dim, n in enumerate(samples.shape):
        edge = min(n, _CROP)
        part = part.narrow(dim, (n - edge) // 2, edge)
    part = part.contiguous()
    points = _points_along_rays(part)
    fields = {way: _built(part, way, boundary) for way in ways}
    runs = {way: field for way, field in fields.items() if field is not None and not _stored_so_anyway(way, fields)}
    builders = {"/".join(map(str, way)): (lambda way=way: _built(part, way, boundary)) for way in runs}
    order = 0 if task == "resample" else 1
    taken = costs.measure(builders, points, order=order, seconds=seconds, tick=tick)  # type: ignore[arg-type]
    whole = math.prod(volume.shape) / part.numel()
    found = {}
    for way, field in runs.items():
        cost = taken["/".join(map(str, way))]
        rounding = _rounding(field, runs[way[0], way[1], None], points)
        memory = _memory_of_whole(field, volume)
        found[way] = _Cost(cost.build.median * whole, cost.sample.median, memory, *rounding)
    return found


def _built(part: Tensor, way: Way, boundary: Boundary) -> GridField | None:
    """The field, or None where it can't be as asked here (numbers that a short type does not hold, no fused scheme)."""
    method, scheme, storage = way
    try:
        field = reconstruct(part, method, boundary=boundary, scheme=scheme, storage=storage)
    except ValueError:
        return None
    assert isinstance(field, GridField)
    return field


def _stored_so_anyway(way: Way, fields: dict[Way, GridField | None]) -> bool:
    """Whether the storage asked for is the one that coefficients have without it."""
    field = fields.get((way[0], way[1], None))
    return way[2] is not None and field is not None and str(field.coefficients.values.dtype) == f"torch.{way[2]}"


def _points_along_rays(part: Tensor) -> Tensor:
    """Points at half a voxel from one another along rays, as a renderer or a resampler visits them."""
    generator = torch.Generator().manual_seed(0)
    size = torch.tensor([float(n - 1) for n in reversed(part.shape)])
    start = torch.rand(_RAYS, 1, 3, generator=generator) * size
    direction = torch.randn(_RAYS, 1, 3, generator=generator)
    along = 0.5 * torch.arange(_SAMPLES, dtype=torch.float32)[:, None]
    points = start + along * direction / direction.norm(dim=-1, keepdim=True)
    return points.clamp_min(0).minimum(size).reshape(-1, 3).to(part.device)


def _rounding(field: GridField, exact: GridField, points: Tensor) -> tuple[float, float]:
    """RMS of value and gradient that the storage of `field` adds to `exact`."""
    if field is exact:
        return 0.0, 0.0
    (v, g), (w, h) = (f.value_and_gradient(points) for f in (field, exact))
    return float(metrics.rms(v, w)), float(metrics.rms(g, h, vectors=True))


def _memory_of_whole(field: GridField, volume: Volume) -> int:
    """Bytes of the coefficients of all of the volume, padded as those of its part are."""
    values = field.coefficients.values
    pads = [n - m for n, m in zip(values.shape, reversed(field.coefficients.size), strict=True)]
    padded = [n + pad for n, pad in zip(volume.shape[-3:], pads, strict=True)]
    return math.prod(volume.shape[:-3]) * math.prod(padded) * values.dtype.itemsize
