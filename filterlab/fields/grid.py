"""Fields on a grid: coefficients stored padded under the boundary, and the way from world points to them and back.

Padding once means that no tap is ever folded: points are folded (or clamped) into the stored domain instead, the signs
of gradients flipped where a reflection turned an axis round, and every boundary costs the same.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from copy import copy
from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeVar

import torch
from torch import Tensor

from filterlab import ops
from filterlab.arrays import Array
from filterlab.fields.base import Domain, Field, Relevant, check_order, check_points, type_of_rays
from filterlab.fields.ranges import ranges, straddling
from filterlab.fields.storage import Quantization, stored_as
from filterlab.geometry import Geometry
from filterlab.kernels import Factor, Kernel, PiecewisePolynomial
from filterlab.ops.differentiable import raycast as casting
from filterlab.ops.differentiable.drivers import room_of
from filterlab.ops.differentiable.prefilter import implementation_for
from filterlab.ops.pieces import Lattice, Pieces
from filterlab.ops.place import InWorld, Placement
from filterlab.ops.prefilter import VOLUME
from filterlab.ops.raycast import Candidates, Raycast
from filterlab.ops.reference.pieces import in_cells, pieces_of_rays
from filterlab.ops.stencil import Product, Stencil
from filterlab.ops.tetrahedra import AnyLattice
from filterlab.prefilters import Prefilter
from filterlab.volume import Boundary, Volume

_Cells = TypeVar("_Cells", bound=AnyLattice)


@dataclass(frozen=True)
class Term:
    """weight · Σ_k c_k φ_x(x−k_x) φ_y(y−k_y) φ_z(z−k_z): one separable term of a field's value."""

    weight: float
    kernels: tuple[PiecewisePolynomial, PiecewisePolynomial, PiecewisePolynomial]


Axes = tuple[bool, bool, bool]
"""Which of x, y, z."""

NO_AXIS: Axes = (False, False, False)


class Scheme(Protocol):
    """How the sum over coefficients is computed.

    Attributes:
        name: `direct`, `sampled`, …
        gradient: `analytic`, or `central` (differences of the trilinear interpolant).
        max_order: the highest derivative it gives.
        reach: coefficients needed on each side of a point's cell.
        terms: the value as a sum of separable terms (what `resample` uses).
        exact: whether the value is that sum but for rounding: not where a texture unit's fractions are modelled.
        single: the axes x, y, z of one voxel that goes on as it is: along them all coefficients are the same.
        around: how many of these are kept on each side of the one; 0: that one is enough.
        period: by how many coefficients points may be moved for the same field, moved.
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
    @property
    def exact(self) -> bool: ...
    @property
    def single(self) -> Axes: ...
    @property
    def around(self) -> int: ...
    @property
    def period(self) -> int: ...

    def evaluation(self, coefficients: Coefficients, placement: Placement, order: int) -> Evaluation:
        """What gives the jet of that order of coefficients (N, C, D', H', W'); all that no point changes is settled.

        Nothing is asked of it that the scheme cannot do: `reconstruct` has found out.
        """
        ...


class Evaluation(Protocol):
    """The jet of some coefficients at points, with all settled that no point changes."""

    def __call__(self, points: Tensor) -> tuple[Tensor, Tensor | None]:
        """World points (N, M, 3) -> (N, C, J, M), rows as in `multi_indices(order)`, before points were turned; sign of
        `ops.place`, or None."""
        ...

    def in_world(self, points: Tensor, shape: Sequence[int]) -> InWorld | None:
        """Of a jet of order 1: value, of N C M numbers in the shape asked for, and gradient per world unit (*shape, 3).

        None: it has no faster way to them than by rows, or derivatives are asked.
        """
        ...

    def of(self, coefficients: Tensor) -> Evaluation:
        """The same of other coefficients, on the same device, which lie as these do."""
        ...


@dataclass(frozen=True)
class Coefficients:
    """Coefficients padded under a boundary.

    Attributes:
        values: (..., D', H', W'); (N, C, D', H', W') where a scheme reads them.
        start: the first coefficient lies at start + shift in voxel coordinates, the same along every axis.
        shift: along x, y, z: 0, ½ for coefficients at half-integers (the notch), or, along an axis of one voxel, what
            brings its coefficients to where the points are.
        size: voxels of the volume along x, y, z.
        boundary: the extension of the samples.
        tail: how far beyond the ends points are told apart (border and zeros); the extension is constant beyond.
        quantization: what integers in `values` stand for; None: values are the coefficients themselves.
    """

    values: Tensor
    start: int
    shift: tuple[float, float, float]
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
        single: Axes = NO_AXIS,
        around: int = 0,
        period: int = 1,
    ) -> Coefficients:
        """Prefilter, extend by the boundary, apply the discrete part of a factored kernel, and store.

        Along the axes x, y, z that are `single` nothing is done: their one sample is the coefficient everywhere, and is
        kept `around` times on each side, and as often more before it as moves points by a multiple of `period`.

        Where `unknown`, a mask of the samples, coefficients are NaN: after the prefilter, which would spread them.

        Memory: (n + 2·pad)³ coefficients, pad = reach (+1 for a factored kernel) under mirror, reflect and wrap;
        under border and zeros 2·reach plus the prefilter's decay (about 10 … 50 voxels, see `Prefilter.decay`); along
        an axis that is `single` 1 + 2·around, or as many and period − 1.
        """
        reach = reach if factor is None else reach + 1
        decay = 0 if boundary.periodic else prefilter.decay(torch.promote_types(samples.dtype, torch.float32))
        tail = 0 if boundary.periodic else decay + reach
        pad = reach + tail - decay
        dims, start = [dim for dim in VOLUME if not single[-1 - dim]], -(pad + decay)
        values = samples
        if not prefilter.is_identity:  # periodic coefficients extend as the samples do
            filtered = pad if boundary.periodic else decay
            values = _prefiltered(samples, dims, prefilter, boundary, filtered)
        if prefilter.is_identity or not boundary.periodic:
            values = _extended(values, dims, boundary, pad)
        if unknown is not None:
            values = values.masked_fill(_extended(unknown, dims, boundary, pad + decay), torch.nan)
        shift = 0.0
        if factor is not None:
            values, shift = _apply_factor(values, dims, factor), 0.5
        before = around + (-start - around) % period
        for dim in (dim for dim in VOLUME if single[-1 - dim]):
            values = boundary.extend(values, dim, before, around)
        values, quantization = stored_as(values, storage)
        d, h, w = samples.shape[-3:]
        x, y, z = (-before - start if alone else shift for alone in single)
        return cls(values, start, (x, y, z), (w, h, d), boundary, tail, quantization)

    @property
    def first(self) -> tuple[float, float, float]:
        """Where the first coefficient lies along x, y, z, in voxels."""
        x, y, z = self.shift
        return self.start + x, self.start + y, self.start + z

    def __getitem__(self, index: tuple[int, int]) -> Coefficients:
        """Those of entry n and channel c of a batch."""
        quantization = None if self.quantization is None else self.quantization[index]
        return replace(self, values=self.values[index], quantization=quantization)

    def decoded(self, dtype: torch.dtype) -> Tensor:
        """The coefficients as numbers of a floating type."""
        values = self.values
        return values.to(dtype) if self.quantization is None else self.quantization.decoded(values, dtype)

    def lattice(self, terms: tuple[Term, ...]) -> Lattice:
        """The cells that the domain meets, of the sum over terms; of coefficients (D', H', W').

        Inside of the domain no point is folded: the padding holds every tap.
        """
        row = tuple(Product(term.kernels, weight=term.weight) for term in terms)
        values, offset = self.values, []
        for axis, (n, support) in enumerate(zip(self.size, Stencil((row,)).supports, strict=True)):
            zero = self.first[axis] + support / 2 - 1  # where the first cell of all begins
            first, last = math.floor(-0.5 - zero), math.ceil(n - 0.5 - zero)
            values = values.narrow(-1 - axis, first, last - first + support - 1)
            offset.append(first + zero)
        (x, y, z), (w, h, d) = offset, self.size
        lower, upper = (-0.5 - x, -0.5 - y, -0.5 - z), (w - 0.5 - x, h - 0.5 - y, d - 0.5 - z)
        scale, shift = (1.0, 0.0) if self.quantization is None else self.quantization.numbers()
        return Lattice(values, row, (x, y, z), lower, upper, scale, shift)

    def placement(self, geometry: Geometry) -> Placement:
        """How world points become coordinates of these coefficients."""
        return Placement(geometry, self.boundary, self.size, self.tail, self.shift)


def _prefiltered(samples: Tensor, dims: list[int], prefilter: Prefilter, boundary: Boundary, tail: int) -> Tensor:
    implementation = implementation_for(samples)
    if len(dims) == len(VOLUME):
        return ops.prefilter_samples(samples, prefilter, boundary, tail, implementation)
    values = samples.to(torch.promote_types(samples.dtype, torch.float32))
    for dim in dims:
        values = ops.prefilter_axis(values, dim, prefilter, boundary, tail, implementation)
    return values


def _extended(values: Tensor, dims: list[int], boundary: Boundary, reach: int) -> Tensor:
    for dim in dims:
        values = boundary.extend(values, dim, reach, reach)
    return values


def implementation_of(scheme: str, device: torch.device) -> str:
    """What computes a scheme's sums: for `fused` vector code on the CPU and Triton on a GPU, else plain torch."""
    return room_of(device) if scheme == "fused" else "reference"


def _apply_factor(values: Tensor, dims: list[int], factor: Factor) -> Tensor:
    """Averages of neighbours along these axes: the coefficients at half-integers, one fewer per axis."""
    assert [float(o) for o in factor.offsets] == [0.5, -0.5], "only half-shifted pairs are factored"
    first, second = (float(w) for w in factor.weights)
    values = values.to(torch.promote_types(values.dtype, torch.float32))
    for dim in dims:
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

    scheme: Scheme
    _lattice: Any  # once it was asked for

    def __init__(self, method: str, volume: Volume, coefficients: Coefficients, scheme: Scheme) -> None:
        self.method = method
        self.scheme = scheme
        self.coefficients = coefficients
        self.domain = Domain.of_grid(volume.size, volume.geometry)
        self.max_order = scheme.max_order
        self.channels = (volume.shape[0], volume.shape[1]) if volume.batched else None
        self._settle()

    def _settle(self) -> None:
        """Decide everything that points don't: for points of every entry, and for points that all entries share."""
        self._lattice = None
        own, shared = self._batched()
        self._own = self._evaluations(own)
        self._shared = self._own if shared is None else self._evaluations(shared)

    def _batched(self) -> tuple[Tensor, Tensor | None]:
        """The coefficients (N, C, D', H', W'), and (1, N·C, D', H', W') where that is another shape."""
        values = self.coefficients.values
        own = values if self.channels is not None else values[None, None]
        return own, own.reshape(1, own.shape[0] * own.shape[1], *own.shape[2:]) if own.shape[0] != 1 else None

    def _evaluations(self, values: Tensor) -> list[Evaluation]:
        coefficients, placement = replace(self.coefficients, values=values), self.placement
        return [self.scheme.evaluation(coefficients, placement, order) for order in range(self.max_order + 1)]

    @property
    def device(self) -> torch.device:
        """Where the coefficients are."""
        return self.coefficients.values.device

    @property
    def requires_grad(self) -> bool:
        """Whether derivatives by the coefficients are asked."""
        return self.coefficients.values.requires_grad

    @property
    def placement(self) -> Placement:
        """How world points become coordinates of the coefficients."""
        return self.coefficients.placement(self.domain.geometry)

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
        one.coefficients, one.channels = self.coefficients[n, c], None
        one._settle()
        return one

    def with_coefficients(self, coefficients: Coefficients) -> GridField:
        """The same field of other coefficients, on the same device, which lie as these do."""
        one = copy(self)
        one.coefficients = coefficients
        one._exchange()
        return one

    def _exchange(self) -> None:
        """Settle for other coefficients only: what does not depend on them is decided."""
        self._lattice = None
        own, shared = self._batched()
        self._own = [evaluation.of(own) for evaluation in self._own]
        self._shared = self._own if shared is None else [evaluation.of(shared) for evaluation in self._shared]

    @property
    def tensors(self) -> tuple[Tensor, ...] | None:
        """The coefficients; None where kernels are tensors too."""
        exact = all(isinstance(k, Kernel) for term in self.scheme.terms for k in term.kernels)
        return (self.coefficients.values,) if exact else None

    def with_tensors(self, tensors: Sequence[Tensor]) -> GridField:
        (values,) = tensors
        return self.with_coefficients(replace(self.coefficients, values=values))

    def detached(self) -> GridField:
        """The same field, of coefficients that no derivatives are asked by; they are shared, not copied."""
        return self.with_tensors([self.coefficients.values.detach()]) if self.requires_grad else self

    def _relative_to(self, origin: tuple[float, float, float]) -> GridField:
        """The grid moves instead: numbers of float64, no work for any point."""
        moved = copy(self)
        moved.domain = self.domain.relative_to(origin)
        moved._settle()
        return moved

    @property
    def degree_along_rays(self) -> int | None:
        return self.lattice.degree if self.scheme.exact and self.channels is None else None

    @property
    def lattice(self) -> Lattice:
        """The cells on which this field is one polynomial each; of an unbatched field."""
        return self._once(lambda: self.coefficients.lattice(self.scheme.terms))

    def _once(self, lattice: Callable[[], _Cells]) -> _Cells:
        """The lattice of these coefficients, made once; not where it is recorded, which changes from call to call."""
        if self.requires_grad:
            return lattice()
        if self._lattice is None:
            self._lattice = lattice()
        return self._lattice

    def pieces_along(self, origins: Tensor, directions: Tensor, level: float | None = None) -> Pieces:
        self._check_pieces()
        dtype = type_of_rays(origins, directions)
        lattice = self.lattice
        rays = in_cells(origins, directions, self.domain.geometry, lattice)
        if level is None:
            return pieces_of_rays(rays, lattice, dtype)
        bounds = ranges(lattice)
        return pieces_of_rays(rays, lattice, dtype, bounds.edge // 2, bounds.may_hold(level, dtype))

    def first_crossing(self, origins: Tensor, directions: Tensor, level: float) -> Tensor:
        return casting.first(self._raycast(level, origins, directions), origins, directions, self._caster)

    def crossings(self, origins: Tensor, directions: Tensor, level: float, count: int, farthest: bool) -> Tensor:
        given = self._raycast(level, origins, directions)
        return casting.sheets(given, origins, directions, self._sheets(count, farthest), self._caster)

    def crossing_candidates(self, origins: Tensor, directions: Tensor, level: float) -> Candidates:
        return casting.candidates(self._raycast(level, origins, directions), origins, directions, self._caster)

    def _raycast(self, level: float, origins: Tensor, directions: Tensor) -> Raycast:
        self._check_pieces()
        dtype = type_of_rays(origins, directions)
        lattice = self.lattice
        bounds = ranges(lattice)
        marks, margin = bounds.marks(level, dtype), bounds.margin(dtype)
        return Raycast(lattice, self.domain.geometry, level, dtype, marks, bounds.edge, margin, bounds.off_trend)

    @property
    def _caster(self) -> str | None:
        """What casts rays: plain torch if that is how this field is evaluated, else what is fastest."""
        return "reference" if self.scheme.name == "direct" else None

    def relevant(self, level: float) -> Relevant:
        self._check_pieces()
        cells = straddling(self.lattice, level)
        return Relevant(cells, cells)

    def _check_pieces(self) -> None:
        if self.channels is not None:
            raise ValueError("pieces are those of one channel: `select` it from this batched field")
        if self.degree_along_rays is None:
            raise self.no_pieces()

    def jet(self, points: Array, order: int) -> tuple[Tensor, ...]:
        check_order(order, self.max_order)
        points = check_points(points, self.channels)
        if self.channels is None:
            axis, shape, flat, evaluations = 0, points.shape[:-1], points.reshape(1, -1, 3), self._own
        else:
            axis, shape = 2, points.shape[1:-1]
            flat = points.reshape(points.shape[0], math.prod(shape), 3)
            evaluations = self._own if len(flat) == self.channels[0] else self._shared
        if order == 1 and self.coefficients.quantization is None:
            found = evaluations[1].in_world(flat, (*(self.channels or ()), *shape))
            if found is not None:
                return found
        rows, sign = evaluations[order](flat)
        value, *others = self._decoded(rows, shape).split_with_sizes(_ROWS[: order + 1], axis)
        if sign is not None:
            sign = sign.reshape((*(len(flat), 1)[:axis], *shape, 3))  # over channels
        out = [value.squeeze(axis)]
        if order >= 1:
            gradient = others[0].movedim(axis, -1)
            if sign is not None:
                gradient = gradient * sign
            out.append(self.domain.geometry.gradient_to_world(gradient))
        if order >= 2:
            hessian = _symmetric(others[1], axis)
            if sign is not None:
                hessian = hessian * (sign[..., :, None] * sign[..., None, :])
            out.append(self.domain.geometry.hessian_to_world(hessian))
        return tuple(out)

    def _decoded(self, rows: Tensor, shape: Sequence[int]) -> Tensor:
        """Rows (N, C, J, M) as (N, C, J, *P), or (J, *P) for an unbatched field; of what stored integers stand for."""
        channels, quantization, count = self.channels or (), self.coefficients.quantization, rows.shape[2]
        if quantization is not None:
            rows = quantization.of_rows(rows.reshape(*(channels or (1, 1)), *rows.shape[2:]))
        return rows.reshape(*channels, count, *shape)


_ROWS = (1, 3, 6)
"""Rows of a jet that are its value, its gradient, its Hessian."""


def _symmetric(rows: Tensor, axis: int) -> Tensor:
    """Rows xx, xy, xz, yy, yz, zz along an axis to matrices (..., 3, 3) of the other axes."""
    xx, xy, xz, yy, yz, zz = rows.unbind(axis)
    return torch.stack([torch.stack(r, -1) for r in ((xx, xy, xz), (xy, yy, yz), (xz, yz, zz))], -2)
