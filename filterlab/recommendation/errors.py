"""Errors of methods on a volume: how far each is from the best estimate of the signal, and how far that may be off.

Letters: f the signal, r the reference (a spline of degree 7 that needs no boundary), r₃ the same of degree 3, f_M the
field of a method under the boundary asked for, in the arithmetic that is used; ‖·‖ a root mean square over the region,
in parts of the range of the samples. Of a level the region is its surface in r, by area.

    d = ‖f_M − r‖   measured: kernel, prefilter, boundary, storage and rounding are all in it
    u = ‖r − r₃‖    the doubt: what two splines make of the same samples
    φ               how the spectrum falls towards the Nyquist frequency, decibels over a quarter of the band

    d − c u ≤ ‖f_M − f‖ ≤ √(d² + (C u)²),        c, C functions of φ; with L ≤ C most likely

What lies beyond the Nyquist frequency is in no sample, so that ‖r − f‖ itself can't be measured. But it is near to u
where the spectrum falls steeply, and several times u where it does not: `calibration` has the factors.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.quasirandom import SobolEngine

from filterlab.fields.base import Field
from filterlab.fields.storage import STORAGE
from filterlab.methods import reconstruct
from filterlab.recommendation.calibration import factors
from filterlab.recommendation.reference import endless_spline
from filterlab.recommendation.survey import Patch, patches_of
from filterlab.volume import Boundary

_DEGREES = (7, 3)
_RESOLVED, _ROUNDING = 10.0, 1e-6  # decibels; about what float32 leaves of a range
SURE = 2.5  # standard errors that the mean over points may be off by
_LAYER, _MOVES = 0.5, 2  # voxels on either side of a surface, from which points are moved onto it; how often
_SEGMENT, BANDS = 32, 8  # samples of a line whose spectrum is taken; parts of the band up to the Nyquist frequency
_STEEPEST = 60.0  # decibels
_INTEGERS = tuple(name for name, dtype in STORAGE.items() if not dtype.is_floating_point)
LARGEST = torch.finfo(torch.float32).max / 2**10  # of samples: coefficients and sums over them are larger


@dataclass(frozen=True)
class ErrorEstimate:
    """An error in parts of the value range.

    Attributes:
        measured: from the best estimate of the signal.
        doubt: how far two estimates of the signal are apart, counted as the task counts.
        low, high: between what the error lies, in 95 of 100 cases.
        likely: what it most likely does not exceed, by which is chosen: 99 of 100 picks keep their budgets.
    """

    measured: float
    doubt: float
    low: float
    high: float
    likely: float


@dataclass(frozen=True)
class Distance:
    """A root mean square over points, with its standard error relative to it."""

    rms: float
    spread: float = 0.0

    def between(
        self, quantity: str, doubt: float, fall: float, rounding: float = 0.0, on_surface: bool = False
    ) -> tuple[float, float, float]:
        """(low, high, likely) of the true error that has this distance from the reference."""
        least, most, likely = factors(quantity, fall, on_surface)
        sampled = 1 + SURE * self.spread
        low = max(self.rms / sampled - least * doubt - rounding, 0.0)
        high, most_likely = (math.hypot(self.rms * sampled, factor * doubt, rounding) for factor in (most, likely))
        return low, high, most_likely


@dataclass(frozen=True)
class MethodErrors:
    """What was measured of one method with one storage.

    Attributes:
        value, gradient: distances from the reference, in parts of the range; gradients per voxel.
    """

    value: Distance
    gradient: Distance


@dataclass(frozen=True)
class Yardstick:
    """The reference at points of a volume, and what fields are compared by. Errors are in parts of the range.

    Attributes:
        boundary: of the fields.
        value_range: the least and the largest sample.
        level: of the surface on which errors are looked at; None: in all of the region.
        patches, truth: parts of the volume, and (value, gradient) of the reference at their points.
        doubts: u of "value", "gradient" and "bend", the second derivative along lines.
        rounding: of the samples, by their floating type, RMS at most.
        bend: RMS of that of the reference.
        fall: φ.
    """

    boundary: Boundary
    value_range: tuple[float, float]
    level: float | None
    patches: tuple[Patch, ...]
    truth: tuple[tuple[Tensor, Tensor], ...]
    doubts: Mapping[str, float]
    rounding: float
    bend: float
    fall: float

    @property
    def span(self) -> float:
        """What errors are parts of."""
        return range_of(self.value_range)

    @property
    def resolved(self) -> bool:
        """Whether the samples resolve what they show: the spectrum falls, or what two splines differ by is rounding."""
        return self.fall >= _RESOLVED or self.doubts["value"] <= _ROUNDING

    @classmethod
    def of(
        cls,
        samples: Tensor,
        unknown: Tensor | None,
        boundary: Boundary,
        seed: int = 0,
        tick: Callable[[float], None] = lambda done: None,
        level: float | None = None,
    ) -> Yardstick:
        """From samples (V, D, H, W), and the mask of those without a value; of a level, on its surface alone.

        Raises:
            ValueError: no samples, samples that overflow when fields are evaluated, or a level without a surface.
        """
        value_range = _range(samples)
        bare = cls(boundary, value_range, level, (), (), {}, 0.0, 0.0, 0.0)
        drawn = patches_of(samples, unknown, boundary, SobolEngine(4, scramble=True, seed=seed), level)
        patches, truth = [], []
        sums, bands = torch.zeros(4, dtype=torch.float64), torch.zeros(BANDS, dtype=torch.float64)
        for i, patch in enumerate(drawn):
            scaled = bare._scaled(patch.samples)
            splines = [endless_spline(scaled, degree) for degree in _DEGREES]
            if level is not None:
                patch = _on_surface(patch, splines[0], (level - value_range[0]) / bare.span)
            if len(patch.points):
                fine, coarse = (_jet(spline, patch) for spline in splines)
                patches.append(patch)
                truth.append(fine[:2])
                off = [(a - b).flatten(1).square().sum(-1) for a, b in zip(fine[:2], coarse[:2], strict=True)]
                sums += torch.stack((*off, _along_lines(fine[2] - coarse[2]), _along_lines(fine[2]))) @ patch.weights
                bands += float(patch.weights.sum()) * band_powers(scaled)
            tick((i + 1) / len(drawn))
        if level is not None:
            patches, sums = _of_area(level, patches, sums, value_range)
        *doubts, bend = sums.sqrt().tolist()
        named = dict(zip(("value", "gradient", "bend"), doubts, strict=True))
        rounding = _rounding_of(samples.dtype) * max(map(abs, value_range)) / bare.span
        found = {"doubts": named, "rounding": rounding, "bend": bend, "fall": fall_of(bands)}
        return replace(bare, patches=tuple(patches), truth=tuple(truth), **found)

    def _scaled(self, x: Tensor) -> Tensor:
        """In parts of the range, float64: nothing under- or overflows when it is squared."""
        return (x.double() - self.value_range[0]) / self.span

    def errors(self, method: str, storage: str | None = None) -> MethodErrors:
        """Of a method: distances of its fields from the reference. Raises ValueError for a storage that can't hold it.

        Where patches were cut out, integers are coarser in the whole volume, by as much as its range is larger.
        """
        squares = []
        for patch, (value, gradient) in zip(self.patches, self.truth, strict=True):
            coarser = patch.coarser if storage in _INTEGERS else 1.0
            v, g = self._of_field(patch, method, storage if coarser == 1 else None)
            if coarser != 1:
                v, g = (
                    a + coarser * (b - a) for a, b in zip((v, g), self._of_field(patch, method, storage), strict=True)
                )
            off = torch.stack(((v - value[:, 0]).square(), (g - gradient).square().sum(-1)))
            squares.append(patch.weights * off)
        value, gradient = (_distance([s[row] for s in squares]) for row in (0, 1))
        return MethodErrors(value, gradient)

    def _of_field(self, patch: Patch, method: str, storage: str | None) -> tuple[Tensor, Tensor]:
        """Value and gradient at the points, in parts of the range."""
        made = reconstruct(patch.extended, method, boundary=self.boundary, storage=storage)
        value, gradient = made.value_and_gradient(patch.points)
        return self._scaled(value), gradient.double() / self.span

    def estimate(self, task: str, errors: MethodErrors, step: float | None = None) -> ErrorEstimate:
        """What the task counts, with what a march loses by a step."""
        parts = {"value": errors.value} if task == "resample" else {"value": errors.value, "gradient": errors.gradient}
        known = {"value": self.rounding, "gradient": 0.0}  # what is rounded alike has no gradient; what is not is in u
        on_surface = self.level is not None
        ends = [d.between(name, self.doubts[name], self.fall, known[name], on_surface) for name, d in parts.items()]
        lost = 0.0 if step is None else step**2 / 24
        bent = Distance(self.bend).between("bend", self.doubts["bend"], self.fall)
        return ErrorEstimate(
            math.hypot(max(d.rms for d in parts.values()), lost * self.bend),
            math.hypot(max(self.doubts[name] for name in parts), lost * self.doubts["bend"]),
            *(math.hypot(max(end), lost * own) for end, own in zip(zip(*ends, strict=True), bent, strict=True)),
        )


def range_of(value_range: tuple[float, float]) -> float:
    """The range of samples; of samples that are all equal, their magnitude; 1 where they are 0."""
    low, high = value_range
    return (high - low) or abs(low) or 1.0


def _rounding_of(dtype: torch.dtype) -> float:
    """RMS of the rounding of a number, in parts of it, at most: uniform in half a unit of its last digit. Integers are
    taken as they are."""
    return torch.finfo(dtype).eps / math.sqrt(12) if dtype.is_floating_point else 0.0


def _range(samples: Tensor) -> tuple[float, float]:
    """The least and the largest sample. Raises ValueError for none, and for what overflows when it is computed with."""
    if samples.numel() == 0:
        raise ValueError(f"expected a volume with samples; got shape {tuple(samples.shape)}")
    low, high = (float(end) for end in samples.aminmax())
    if max(abs(low), abs(high)) > LARGEST:
        raise ValueError(
            f"expected samples within ±{LARGEST:.3g}, as fields are evaluated in float32; got {low:.3g} … {high:.3g}"
        )
    return low, high


def _distance(squares: list[Tensor]) -> Distance:
    """From weighted squares at the points of every patch; points of a patch that was cut out are one draw."""
    draws = squares[0] if len(squares) == 1 else torch.stack([s.sum() for s in squares])
    total = float(draws.sum())
    if not 0 < total < math.inf:
        return Distance(0.0 if total == 0 else math.inf)
    spread = float(draws.std()) * math.sqrt(len(draws)) / total if len(draws) > 1 else 0.0  # of the mean square
    return Distance(math.sqrt(total), 0.5 * spread)


def _jet(spline: Field, patch: Patch) -> tuple[Tensor, Tensor, Tensor]:
    """Value (P, 1), gradient (P, 3), Hessian (P, 3, 3) of a reference at the points of a patch."""
    value, gradient, hessian = spline.jet(patch.points.double() + patch.shift, 2)
    return value[:, None], gradient, hessian


def _on_surface(patch: Patch, spline: Field, level: float) -> Patch:
    """The points that are near to where the reference is the level, moved there, along the gradient.

    The layer that they were drawn in is as thick everywhere, by the first order: their weights are those of area.
    """
    ends = torch.tensor(patch.samples.shape[::-1], dtype=torch.float64) - 1
    at, weights = patch.points.double() + patch.shift, patch.weights
    for _ in range(_MOVES):
        value, gradient = spline.value_and_gradient(at)
        off, slope = value - level, gradient.norm(dim=-1)
        near = (off.abs() <= _LAYER * slope) & (slope > 0)
        moved = at[near] - (off / slope.square())[near, None] * gradient[near]
        at, weights = torch.minimum(moved.clamp_min(0), ends), weights[near]
    return replace(patch, points=(at - patch.shift).float(), weights=weights)


def _of_area(
    level: float, patches: Sequence[Patch], sums: Tensor, value_range: tuple[float, float]
) -> tuple[list[Patch], Tensor]:
    """The same by weights that add up to 1. Raises ValueError where no patch has a point of the surface."""
    total = math.fsum(float(patch.weights.sum()) for patch in patches)
    if not total > 0:
        low, high = value_range
        raise ValueError(
            f"expected a level with a surface in the inner part of the volume, whose samples are {low:.6g} … "
            f"{high:.6g}; got {level:.6g}"
        )
    return [replace(patch, weights=patch.weights / total) for patch in patches], sums / total


def _along_lines(hessian: Tensor) -> Tensor:
    """Mean of (eᵀ H e)² over directions e: (2 |H|² + (tr H)²) / 15."""
    trace = hessian.diagonal(dim1=-2, dim2=-1).sum(-1)
    return (2 * hessian.square().sum((-2, -1)) + trace.square()) / 15


# --- how the spectrum falls -------------------------------------------------------------------------------------------


def fall_of(bands: Tensor) -> float:
    """φ in decibels: of the power density in the sixth and in the last of eight parts of the band; 0 … 60.

    0 where no line is long enough to tell: nothing is known of the fall then.
    """
    sixth, last = float(bands[5]), float(bands[7])
    if not sixth > 0:
        return 0.0
    return min(max(10 * math.log10(sixth / last), 0.0), _STEEPEST) if last > 0 else _STEEPEST


def band_powers(samples: Tensor) -> Tensor:
    """Mean power density in eight parts of the band up to the Nyquist frequency, along all lines of (D, H, W).

    Lines are cut into segments of 32 samples that overlap by half, and windowed by sin³. Second differences are taken,
    and divided out of the spectrum, so that slow changes don't leak into what is above them. Welch, The use of fast
    Fourier transform for the estimation of power spectra, 1967.
    """
    total = torch.zeros(BANDS, dtype=torch.float64)
    for dim, n in enumerate(samples.shape):
        if n >= BANDS:
            bent = torch.diff(samples.movedim(dim, -1), n=2)
            for part in bent.split(max(1, 2**20 // bent[0].numel())):
                total += _periodogram(part) * (len(part) / len(bent))
    return total


def _periodogram(lines: Tensor) -> Tensor:
    """Of second differences (..., M): mean power density of the lines in every part of the band, the second
    differences divided out."""
    length = min(lines.shape[-1], _SEGMENT)
    segments = lines.unfold(-1, length, max(1, length // 2))
    window = torch.sin(math.pi * (torch.arange(length, dtype=lines.dtype) + 1) / (length + 1)) ** 3
    spectrum = torch.fft.rfft(segments * window, n=2 * _SEGMENT)
    power = spectrum.abs().square().flatten(0, -2).mean(0)[1:] / window.square().sum()
    omega = math.pi * torch.arange(1, _SEGMENT + 1, dtype=lines.dtype) / _SEGMENT
    return (power / (2 * torch.sin(omega / 2)) ** 4).reshape(BANDS, -1).mean(-1)
