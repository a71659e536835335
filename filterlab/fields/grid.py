"""Fields on a grid: coefficients stored padded under the boundary, and the way from world points to them and back.

Padding once means that no tap is ever folded: points are folded (or clamped) into the stored domain instead, the signs
of gradients flipped where a reflection turned an axis round, and every boundary costs the same.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor

from filterlab import ops
from filterlab.fields.base import Domain, Field, check_order, check_points
from filterlab.fields.storage import Quantization, stored_as
from filterlab.kernels import Factor, PiecewisePolynomial
from filterlab.ops.placement import Placement
from filterlab.ops.prefilter import implementation_for, prefilter_samples
from filterlab.prefilters import Prefilter
from filterlab.volume import Boundary, Geometry, Volume


@dataclass(frozen=True)
class Term:
    """weight · Σ_k c_k φ_x(x−k_x) φ_y(y−k_y) φ_z(z−k_z): one separable term of a field's value."""

    weight: float
    kernels: tuple[PiecewisePolynomial, PiecewisePolynomial, PiecewisePolynomial]


class Scheme(Protocol):
    """How the sum over coefficients is computed.

    Attributes:
        name: `direct`, `eight_trilinear`, …
        gradient: `analytic`, or `central` (differences of the trilinear interpolant).
        max_order: the highest derivative it gives.
        reach: coefficients needed on each side of a point's cell.
        terms: the value as a sum of separable terms (what `resample` uses).
    """

    @property
    def name(self) -> str: ...
    @property
    def gradient(self) -> str: ...
    @property
    def max_order(self) -> int: ...
    @property
    def reach(self) -> int: ...
    @property
    def terms(self) -> tuple[Term, ...]: ...

    def jet(self, coefficients: Coefficients, points: Tensor, order: int) -> Tensor:
        """Located points (N, M, 3) -> (N, C, J, M), rows as in `multi_indices(order)`."""
        ...


@dataclass(frozen=True)
class Coefficients:
    """Coefficients padded under a boundary.

    Attributes:
        values: (..., D', H', W'); (N, C, D', H', W') where a scheme reads them.
        start: the first coefficient lies at start + shift in voxel coordinates, the same along every axis.
        shift: 0, or ½ for coefficients at half-integers (the notch).
        size: voxels of the volume along x, y, z.
        boundary: the extension of the samples.
        tail: how far beyond the ends points are told apart (border and zeros); the extension is constant beyond.
        quantization: what integers in `values` stand for; None: values are the coefficients themselves.
    """

    values: Tensor
    start: int
    shift: float
    size: tuple[int, int, int]
    boundary: Boundary
    tail: int
    quantization: Quantization | None = None

    @classmethod
    def of(
        cls,
        samples: Tensor,
        prefilter: Prefilter,
        boundary: Boundary,
        reach: int,
        factor: Factor | None = None,
        storage: torch.dtype | None = None,
        unknown: Tensor | None = None,
    ) -> Coefficients:
        """Prefilter, extend by the boundary, apply the discrete part of a factored kernel, and store.

        Where `unknown`, a mask of the samples, coefficients are NaN: after the prefilter, which would spread them.

        Memory: (n + 2·pad)³ coefficients, pad = reach (+1 for a factored kernel) under mirror, reflect and wrap;
        under border and zeros 2·reach plus the prefilter's decay (about 10 … 50 voxels, see `Prefilter.decay`).
        """
        reach = reach if factor is None else reach + 1
        decay = 0 if boundary.periodic else prefilter.decay(torch.promote_types(samples.dtype, torch.float32))
        tail = 0 if boundary.periodic else decay + reach
        pad = reach + tail - decay
        values = samples
        if not prefilter.is_identity:  # periodic coefficients extend as the samples do
            filtered = pad if boundary.periodic else decay
            values = prefilter_samples(samples, prefilter, boundary, filtered, implementation_for(samples))
        if prefilter.is_identity or not boundary.periodic:
            for dim in (-3, -2, -1):
                values = boundary.extend(values, dim, pad, pad)
        if unknown is not None:
            values = values.masked_fill(_extended(unknown, boundary, pad + decay), torch.nan)
        shift = 0.0
        if factor is not None:
            values, shift = _apply_factor(values, factor), 0.5
        values, quantization = stored_as(values, storage)
        d, h, w = samples.shape[-3:]
        return cls(values, -(pad + decay), shift, (w, h, d), boundary, tail, quantization)

    def __getitem__(self, index: tuple[int, int]) -> Coefficients:
        """Those of entry n and channel c of a batch."""
        quantization = None if self.quantization is None else self.quantization[index]
        return replace(self, values=self.values[index], quantization=quantization)

    def decoded(self, dtype: torch.dtype) -> Tensor:
        """The coefficients as numbers of a floating type."""
        values = self.values
        return values.to(dtype) if self.quantization is None else self.quantization.decoded(values, dtype)

    def placement(self, geometry: Geometry) -> Placement:
        """How world points become coordinates of these coefficients."""
        return Placement(geometry, self.boundary, self.size, self.tail, self.shift)


def _extended(mask: Tensor, boundary: Boundary, reach: int) -> Tensor:
    for dim in (-3, -2, -1):
        mask = boundary.extend(mask, dim, reach, reach)
    return mask


def implementation_of(scheme: str, device: torch.device) -> str:
    """What computes a scheme's sums: for `fused` vector code on the CPU and Triton on a GPU, else plain torch."""
    if scheme != "fused":
        return "reference"
    return "cuda" if device.type == "cuda" else "cpu"


def _apply_factor(values: Tensor, factor: Factor) -> Tensor:
    """Averages of neighbours along every axis: the coefficients at half-integers, one fewer per axis."""
    assert [float(o) for o in factor.offsets] == [0.5, -0.5], "only half-shifted pairs are factored"
    first, second = (float(w) for w in factor.weights)
    values = values.to(torch.promote_types(values.dtype, torch.float32))
    for dim in (-3, -2, -1):
        n = values.shape[dim] - 1
        values = first * values.narrow(dim, 0, n) + second * values.narrow(dim, 1, n)
    return values


class GridField(Field):
    """A field given by coefficients on a grid and a scheme that sums them.

    Attributes:
        method: name of the method that built it.
        scheme: how it is evaluated; `field.scheme.name` says which.
        coefficients: the padded coefficients.
    """

    def __init__(self, method: str, volume: Volume, coefficients: Coefficients, scheme: Scheme) -> None:
        self.method = method
        self.scheme = scheme
        self.coefficients = coefficients
        self.placement = coefficients.placement(volume.geometry)
        self.domain = Domain.of_grid(volume.size, volume.geometry)
        self.max_order = scheme.max_order
        self.channels = (volume.shape[0], volume.shape[1]) if volume.batched else None

    def __repr__(self) -> str:
        scheme, values = self.scheme, self.coefficients.values
        size = "×".join(str(n) for n in self.coefficients.size)
        return (
            f"{type(self).__name__}({self.method}, scheme={scheme.name}, gradient={scheme.gradient}, "
            f"boundary={self.coefficients.boundary}, {size} voxels, {str(values.dtype).removeprefix('torch.')})"
        )

    def select(self, n: int, c: int) -> GridField:
        """The unbatched field of entry n and channel c of a batched one: a view of its coefficients, differentiable.

        Raises:
            ValueError: this field is not batched.
            IndexError: no such entry or channel.
        """
        if self.channels is None:
            raise ValueError("select needs a batched field, of a volume (N, C, D, H, W); this one is unbatched")
        one = copy(self)
        one.coefficients = self.coefficients[n, c]
        one.channels = None
        return one

    def _relative_to(self, origin: tuple[float, float, float]) -> GridField:
        """The grid moves instead: numbers of float64, no work for any point."""
        moved = copy(self)
        moved.domain = self.domain.relative_to(origin)
        moved.placement = replace(self.placement, geometry=moved.domain.geometry)
        return moved

    def jet(self, points: Tensor, order: int) -> tuple[Tensor, ...]:
        check_order(order, self.max_order)
        points = check_points(points, self.channels)
        batched = points if self.channels is not None else points[None]
        flat = batched.reshape(batched.shape[0], math.prod(batched.shape[1:-1]), 3)
        implementation = implementation_of(self.scheme.name, self.coefficients.values.device)
        located, sign = ops.place(flat, self.placement, implementation)
        rows = self._rows(located, order)  # (N, C, J, M)
        shape = batched.shape[1:-1]
        out = [self._shaped(rows[:, :, 0], shape)]
        if order >= 1:
            gradient = rows[:, :, 1:4].movedim(2, -1)
            if sign is not None:
                gradient = gradient * sign[:, None]
            out.append(self._shaped(self.domain.geometry.gradient_to_world(gradient), shape))
        if order >= 2:
            hessian = _symmetric(rows[:, :, 4:10])
            if sign is not None:
                hessian = hessian * (sign[..., :, None] * sign[..., None, :])[:, None]
            out.append(self._shaped(self.domain.geometry.hessian_to_world(hessian), shape))
        return tuple(out)

    def _rows(self, located: Tensor, order: int) -> Tensor:
        """The scheme's jet; one set of points for a whole batch is evaluated once, with the batch as channels."""
        values = self.coefficients.values if self.channels is not None else self.coefficients.values[None, None]
        n, c = values.shape[:2]
        shared = located.shape[0] != n
        if shared:
            values = values.reshape(1, n * c, *values.shape[2:])
        rows = self.scheme.jet(replace(self.coefficients, values=values), located, order)
        rows = rows.reshape(n, c, *rows.shape[2:]) if shared else rows
        quantization = self.coefficients.quantization
        return rows if quantization is None else quantization.of_rows(rows)

    def _shaped(self, x: Tensor, shape: Sequence[int]) -> Tensor:
        """(N, C, M, ...) to (N, C, *P, ...), or (*P, ...) for an unbatched field."""
        x = x.reshape(*x.shape[:2], *shape, *x.shape[3:])
        return x if self.channels is not None else x[0, 0]


def _symmetric(rows: Tensor) -> Tensor:
    """(N, C, 6, M) of xx, xy, xz, yy, yz, zz to (N, C, M, 3, 3)."""
    xx, xy, xz, yy, yz, zz = rows.unbind(2)
    return torch.stack([torch.stack(r, -1) for r in ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))], -2)
