"""Errors of every method on a volume: predicted from its spectrum, and measured by leaving samples out.

blocks of the volume ─┬─▶ spectrum ──▶ predicted error of every method, at this resolution and at half of it
                      └─▶ every second sample ──▶ rebuilt, compared with the rest: measured error at half of it
measured at half · predicted here / predicted at half  =  the measured error, corrected for the resolution
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from filterlab import metrics
from filterlab.kernels import bspline
from filterlab.methods import reconstruct
from filterlab.prediction import Spectrum, predicted_error, rms_second_derivative, spectrum_of
from filterlab.volume import Volume

_BLOCK, _BLOCKS = 64, 8
_WHOLE = 96**3  # voxels of a volume that is one block
_POINTS = 6000  # of a block at which a rebuilt field is compared
_ROUNDING = 1e-6  # parts of the range: about what float32 leaves
_RESOLVED = 0.1  # or less of the squared error comes from beyond the Nyquist frequency
_DOUBT = 1.02  # of what is measured: by so much a method may be further off than it seems, the sampling apart
_UNMEASURED = 1.5  # and so much where nothing could be held out


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
class MethodErrors:
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
class Errors:
    methods: dict[str, MethodErrors]
    second_derivative: float


def errors_of(samples: Tensor, names: Sequence[str], seed: int, tick: Callable[[float], None]) -> Errors:
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
    return Errors(found, math.sqrt(float(np.mean(bends))))


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


def _combined(rows: np.ndarray) -> MethodErrors:
    mean = rows.mean(0)
    predicted = math.sqrt(mean[0]), math.sqrt(mean[1])
    spread = float(rows[:, 0].std(ddof=1) / math.sqrt(len(rows)) / mean[0]) if len(rows) > 1 and mean[0] > 0 else 0.0
    measured = None
    if math.isfinite(mean[2]):
        ratios = [mean[k] / mean[k + 2] if mean[k + 2] > 0 else 1.0 for k in (2, 3)]
        measured = predicted[0] * math.sqrt(ratios[0]), predicted[1] * math.sqrt(ratios[1])
    return MethodErrors(predicted, measured, spread, float(mean[6] / mean[0]) if mean[0] > 0 else 0.0)


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
