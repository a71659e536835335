"""Schemes for separable kernels: the sum over taps, and linear combinations of trilinear samples.

`direct` sums S³ taps in plain torch, `fused` the same in compiled vector code. `sampled` is what a texture unit
wants: eight trilinear samples for a triquadratic value *and* its gradient (the paper's contribution), 8 + 24 for a
tricubic one (Sigg & Hadwiger). The trilinear sample itself is pluggable; one sampler models the 8-bit fractions of a
texture unit.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from functools import cached_property, wraps
from itertools import chain, product
from typing import Any, Self, TypeVar

import torch
from torch import Tensor

from filterlab import ops
from filterlab.fields.grid import NO_AXIS, Axes, Coefficients, Evaluation, Term, implementation_of
from filterlab.kernels import CENTRAL_DIFFERENCE, LINEAR, Kernel, PiecewisePolynomial, bspline, horner
from filterlab.ops import Product, Stencil, multi_indices
from filterlab.ops.place import Placement
from filterlab.ops.stencil import Kernels
from filterlab.volume import Boundary

Sampler = Callable[[Coefficients, Tensor], Tensor]
"""(coefficients with values (N, C, D, H, W), points (N, M, 3)) -> trilinear samples (N, C, M).

The first coefficient, `coefficients.values[..., 0, 0, 0]`, lies at `coefficients.start` along every axis.
"""

_ALONG = (LINEAR, bspline(0))
_TRILINEAR = {
    (x, y, z): Stencil(((Product((_ALONG[x], _ALONG[y], _ALONG[z])),),)) for x, y, z in product((False, True), repeat=3)
}
"""By which axes have one coefficient."""


def exact_sample(coefficients: Coefficients, points: Tensor) -> Tensor:
    """Trilinear interpolation in the dtype of the points; along an axis of one coefficient, that."""
    d, h, w = coefficients.values.shape[-3:]
    return ops.gather(coefficients.values, points, _TRILINEAR[w == 1, h == 1, d == 1], coefficients.start)[:, :, 0]


def texture_unit_sample(coefficients: Coefficients, points: Tensor) -> Tensor:
    """Trilinear interpolation as a texture unit computes it: each fraction α rounded to the nearest 1/256.

    GPUs filter with 9-bit fixed-point weights, 8 of them fractional (CUDA C++ Programming Guide, "Linear filtering").
    The rounding is invisible to derivatives (straight-through), so that gradients are those of the unrounded sample.
    """
    cell = points.floor()
    rounded = cell + torch.round((points - cell) * 256) / 256
    return exact_sample(coefficients, points + (rounded - points).detach())


SAMPLERS: dict[str, Sampler] = {"exact": exact_sample, "texture_unit": texture_unit_sample}


def named_sampler(sampler: str | Sampler) -> Sampler:
    """The sampler of that name, or the callable itself. Raises ValueError that lists the known names."""
    if callable(sampler):
        return sampler
    if sampler not in SAMPLERS:
        raise ValueError(f"sampler must be one of {', '.join(SAMPLERS)} or a callable; got {sampler!r}")
    return SAMPLERS[sampler]


SchemeJet = TypeVar("SchemeJet", bound=Callable[..., Tensor])


def with_exact_positions(jet: SchemeJet) -> SchemeJet:
    """Lets a scheme place its samples in float64, and returns the result in the type of the points.

    A float32 position x ± δ is rounded to 6e-8·x voxels, as a texture coordinate is: in noise of 512 voxels that alone
    cost 1.1e-4 of the range in a triquadratic gradient, the most of 200,000 points. The direct sum moves no point and
    needs no such care.
    """

    @wraps(jet)
    def wrapped(self: Any, coefficients: Coefficients, points: Tensor, order: int) -> Tensor:
        return jet(self, coefficients, points.to(torch.float64), order).to(points.dtype)

    return wrapped  # type: ignore[return-value]


def reach_of(terms: tuple[Term, ...]) -> int:
    """Coefficients that the widest kernel needs on each side of a point's cell."""
    return max(k.support for term in terms for k in term.kernels) // 2 + 1


def same_kernel(kernel: PiecewisePolynomial) -> tuple[Term, ...]:
    """One term with the same kernel along x, y and z."""
    return (Term(1.0, (kernel, kernel, kernel)),)


def single_axes(terms: tuple[Term, ...], size: Sequence[int], boundary: Boundary) -> Axes:
    """The axes x, y, z of one voxel that goes on as it is, of sums that are constant along them."""
    sums = [_sum_over_translates(kernel) for term in terms for kernel in term.kernels]
    if boundary is Boundary.ZEROS or None in sums:
        return NO_AXIS
    x, y, z = (n == 1 for n in size)
    return x, y, z


def summed_along(terms: tuple[Term, ...], single: Axes) -> tuple[Term, ...]:
    """Terms over coefficients that are the same all along some axes: one coefficient serves for the taps of each.

    Its weight is Σ_k φ(x − k), which is the same at every x. Terms that differ in nothing else are one.
    """
    weights: dict[Kernels, float] = {}
    for term in terms:
        weight, kernels = term.weight, list(term.kernels)
        for axis in (axis for axis in range(3) if single[axis]):
            weight *= float(_sum_over_translates(kernels[axis]) or 0)
            kernels[axis] = bspline(0)
        x, y, z = kernels
        weights[x, y, z] = weights.get((x, y, z), 0.0) + weight
    return tuple(Term(weight, kernels) for kernels, weight in weights.items())


def _sum_over_translates(kernel: PiecewisePolynomial) -> Fraction | None:
    return kernel.sum_over_translates if isinstance(kernel, Kernel) else None


def along(axis: int, kernel: PiecewisePolynomial, others: PiecewisePolynomial = LINEAR) -> Term:
    """`kernel` along one axis (0 = x), `others` along the other two."""
    kernels = [others] * 3
    kernels[axis] = kernel
    return Term(1.0, (kernels[0], kernels[1], kernels[2]))


CENTRAL_TERMS = tuple(along(axis, CENTRAL_DIFFERENCE) for axis in range(3))
"""∂f/∂x_d ≈ (T(x + e_d) − T(x − e_d)) / 2 with T the trilinear interpolant: each is a separable sum itself."""


@dataclass(frozen=True)
class Direct:
    """The sum over taps, Σ_terms weight · Σ_k c_k φ_x φ_y φ_z, with analytic or central-difference gradients.

    `direct` computes it in plain torch, `fused` in vector code made for this processor (`ops.cpu`); either reads the
    taps once for the value and all derivatives.

    Attributes:
        terms: the value.
        gradient: `analytic`: derivatives of the terms, up to the Hessian. `central`: differences of the trilinear
            interpolant, and nothing beyond.
        single: the axes x, y, z of one coefficient.
    """

    terms: tuple[Term, ...]
    name: str = "direct"
    gradient: str = "analytic"
    exact: bool = True
    single: Axes = NO_AXIS
    around: int = 0
    period: int = 1

    def __post_init__(self) -> None:
        _ = self.stencils  # made now: torch.compile can't make them while it traces

    def along(self, size: Sequence[int], boundary: Boundary) -> Direct:
        """The same of a volume of so many voxels along x, y, z: axes of one that goes on as it is are single."""
        single = single_axes(self.terms, size, boundary)
        return replace(self, terms=summed_along(self.terms, single), single=single)

    @property
    def max_order(self) -> int:
        return 2 if self.gradient == "analytic" else 1

    @property
    def reach(self) -> int:
        return reach_of(self.terms if self.gradient == "analytic" else (*self.terms, *CENTRAL_TERMS))

    @cached_property
    def stencils(self) -> tuple[Stencil, ...]:
        """What is summed for a jet of order 0, 1, … `max_order`."""
        value = tuple(Product(term.kernels, weight=term.weight) for term in self.terms)
        if self.gradient == "central":
            central = (summed_along((term,), self.single) for term in CENTRAL_TERMS)
            differences = tuple((Product(term.kernels, weight=term.weight),) for (term,) in central)
            return Stencil((value,)), Stencil((value, *differences))
        return tuple(
            Stencil(tuple(tuple(replace(p, orders=orders) for p in value) for orders in multi_indices(order)))
            for order in range(self.max_order + 1)
        )

    def evaluation(self, coefficients: Coefficients, placement: Placement, order: int) -> ops.Evaluation:
        values, start = coefficients.values, coefficients.start
        return ops.Evaluation(
            values, placement, self.stencils[order], start, implementation_of(self.name, values.device)
        )


@dataclass(frozen=True)
class Sampled(ABC):
    """A scheme that places points and takes trilinear samples of the coefficients there; see `Scheme`."""

    sample: Sampler
    terms: tuple[Term, ...]
    name: str = "sampled"
    gradient: str = "analytic"
    max_order: int = 1
    reach: int = 3
    single: Axes = NO_AXIS
    around: int = 0
    period: int = 1

    def along(self, size: Sequence[int], boundary: Boundary) -> Self:
        """The same of a volume of so many voxels along x, y, z: axes of one that goes on as it is are single.

        Not with a sampler of somebody else, who may want two coefficients along every axis.
        """
        if self.sample not in SAMPLERS.values():
            return self
        single = single_axes(self.terms, size, boundary)
        return replace(self, terms=summed_along(self.terms, single), single=single)

    @property
    def exact(self) -> bool:
        return self.sample is exact_sample

    @abstractmethod
    def jet(self, coefficients: Coefficients, points: Tensor, order: int) -> Tensor:
        """Located points (N, M, 3) -> (N, C, J, M), rows as in `multi_indices(order)`."""

    def evaluation(self, coefficients: Coefficients, placement: Placement, order: int) -> Evaluation:
        return SampledEvaluation(self, coefficients, placement, order)


@dataclass(frozen=True, eq=False)
class SampledEvaluation:
    """The jet of a sampled scheme; see `Evaluation`."""

    scheme: Sampled
    coefficients: Coefficients
    placement: Placement
    order: int

    def __call__(self, points: Tensor) -> tuple[Tensor, Tensor | None]:
        located, sign = ops.place(points, self.placement)
        values = self.coefficients.values
        own = values.view_as(values)  # derivatives of one call are summed on their own
        return self.scheme.jet(replace(self.coefficients, values=own), located, self.order), sign

    def in_world(self, points: Tensor, shape: Sequence[int]) -> None:
        """Only by rows."""

    def of(self, coefficients: Tensor) -> SampledEvaluation:
        return replace(self, coefficients=replace(self.coefficients, values=coefficients))


@dataclass(frozen=True)
class EightTrilinearQuadratic(Sampled):
    """Triquadratic value and gradient from the same eight trilinear samples (paper, eqs. 7, 24, 25).

    With β = x − ⌊x + ½⌋ per axis: samples at x − δ₀ and x + δ₁, δ₀ = ¼ + β/2, δ₁ = ¼ − β/2, weighted by g₀ = ½ − β and
    g₁ = ½ + β for the value, by −2 and 2 for the derivative along that axis.
    """

    terms: tuple[Term, ...] = field(default_factory=lambda: same_kernel(bspline(2)))
    reach: int = 2

    @with_exact_positions
    def jet(self, coefficients: Coefficients, points: Tensor, order: int) -> Tensor:
        beta = points - (points + 0.5).floor()
        ends = (points - (0.25 + 0.5 * beta), points + (0.25 - 0.5 * beta))
        samples = _at_corners(self.sample, coefficients, ends, ends, ends)
        weights = torch.stack((0.5 - beta, 0.5 + beta))  # (2, N, M, 3)
        difference = points.new_tensor([-2.0, 2.0])[:, None, None, None].expand_as(weights)
        rows = [[weights] * 3]
        if order:
            rows += [[difference if a == axis else weights for a in range(3)] for axis in range(3)]
        return torch.stack([_combine(samples, row) for row in rows], 2)


@dataclass(frozen=True)
class EightTrilinearCubic(Sampled):
    """Tricubic B-spline value from 8 trilinear samples, each partial derivative from 8 more (paper, eqs. 1-3).

    Per axis, with α the fractional part and w_t the four weights (or their derivatives): samples at
    i − 1 + w₁/g₀ and i + 1 + w₃/g₁ with g₀ = w₀ + w₁, g₁ = w₂ + w₃. Source: Sigg & Hadwiger, GPU Gems 2, chapter 20.
    """

    terms: tuple[Term, ...] = field(default_factory=lambda: same_kernel(bspline(3)))

    @with_exact_positions
    def jet(self, coefficients: Coefficients, points: Tensor, order: int) -> Tensor:
        cell = points.floor()
        pairs = [_paired(cell, points - cell, derivative) for derivative in range(order + 1)]
        choices = [(0, 0, 0)] + ([(1, 0, 0), (0, 1, 0), (0, 0, 1)] if order else [])
        rows = []
        for choice in choices:
            ends = [pairs[c][0] for c in choice]
            rows.append(_combine(_at_corners(self.sample, coefficients, *ends), [pairs[c][1] for c in choice]))
        return torch.stack(rows, 2)


def _paired(cell: Tensor, alpha: Tensor, derivative: int) -> tuple[tuple[Tensor, Tensor], Tensor]:
    """Positions of the two linear samples that replace four taps, and their weights (2, N, M, 3)."""
    kernel = bspline(3).derivative(derivative)
    w = [horner(row.unbind(0), alpha) for row in kernel.taps(alpha.dtype, alpha.device)]
    g0, g1 = w[0] + w[1], w[2] + w[3]
    return (cell - 1 + w[1] / g0, cell + 1 + w[3] / g1), torch.stack((g0, g1))


def _at_corners(
    sample: Sampler,
    coefficients: Coefficients,
    x: tuple[Tensor, Tensor],
    y: tuple[Tensor, Tensor],
    z: tuple[Tensor, Tensor],
) -> Sequence[Tensor]:
    """The eight samples at all combinations of two positions per axis; x varies fastest. Each pair holds (N, M, 3)."""
    corners = product(range(2), repeat=3)
    places = (torch.stack((x[i][..., 0], y[j][..., 1], z[k][..., 2]), -1) for k, j, i in corners)
    return samples_at(sample, coefficients, places)


_FEW = 1 << 15


def samples_at(sample: Sampler, coefficients: Coefficients, places: Iterable[Tensor]) -> Sequence[Tensor]:
    """Samples (N, C, M) at each of the places (N, M, 3).

    Few in one call, as then calls are what takes the time; else one after the other, as then places take memory.
    """
    places = iter(places)
    first = next(places)
    if first.numel() > _FEW:
        return [sample(coefficients, place) for place in chain((first,), places)]
    together = [first, *places]
    return sample(coefficients, torch.cat(together, 1)).chunk(len(together), -1)


def _combine(samples: Sequence[Tensor], weights: list[Tensor]) -> Tensor:
    """Σ over the eight corners, along x, then y, then z; weights[axis] is (2, N, M, 3)."""
    for axis in range(3):
        low, high = (w[..., axis][:, None] for w in weights[axis])  # (N, 1, M): over channels
        samples = [torch.addcmul(low * a, high, b) for a, b in zip(samples[::2], samples[1::2], strict=True)]
    return samples[0]


@dataclass(frozen=True)
class TrilinearCentral(Sampled):
    """One trilinear sample for the value, six more for central differences: what volume renderers do by default."""

    terms: tuple[Term, ...] = field(default_factory=lambda: same_kernel(LINEAR))
    gradient: str = "central"

    @with_exact_positions
    def jet(self, coefficients: Coefficients, points: Tensor, order: int) -> Tensor:
        if order == 0:
            return self.sample(coefficients, points)[:, :, None]
        return with_central_differences(*unit_steps(self.sample, coefficients, points))


def unit_steps(
    sample: Sampler, coefficients: Coefficients, points: Tensor
) -> tuple[Tensor, Sequence[Tensor], Sequence[Tensor]]:
    """Trilinear samples at the points, and one voxel ahead and one behind along x, y and z."""
    steps = torch.eye(3, dtype=points.dtype, device=points.device)
    here, *around = samples_at(
        sample, coefficients, chain((points,), (points + s for s in steps), (points - s for s in steps))
    )
    return here, around[:3], around[3:]


def with_central_differences(value: Tensor, ahead: Sequence[Tensor], behind: Sequence[Tensor]) -> Tensor:
    """The rows of a jet of order 1: the value (N, C, M), and half the difference of the samples along each axis."""
    return torch.stack([value, *((a - b) / 2 for a, b in zip(ahead, behind, strict=True))], 2)
