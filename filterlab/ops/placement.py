"""place: world points to coordinates of stored coefficients.

Coefficients are stored padded under a boundary, so that no tap is ever folded; the points are, into the stored part:

    located = fold(matrix · (point − origin)) − shift,       sign = d fold / d voxel ∈ {1, −1, 0} along each axis,

and d located_i / d point_j = sign_i · matrix_ij.

A finite point whose voxel coordinate is beyond the range of its type is folded as exactly as any other. A point at
infinity lies where p + t s ends for t → ∞, p its finite coordinates and s the signs of its infinite ones: along an axis
of the voxels it is at ±∞, or, where matrix · s is 0, where p is.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from filterlab.ops import autograd, cpu
from filterlab.volume import Boundary, Geometry, all_between

Placed = tuple[Tensor, Tensor | None]


@dataclass(frozen=True)
class Placement:
    """Where points belong.

    Attributes:
        geometry: voxel -> world.
        boundary: the extension of the samples.
        size: voxels along x, y, z.
        tail: how far beyond the ends points are told apart (border and zeros).
        shift: what is subtracted in the end: ½ for coefficients at half-integers.
    """

    geometry: Geometry
    boundary: Boundary
    size: tuple[int, int, int]
    tail: int = 0
    shift: float = 0.0


def _reference(points: Tensor, placement: Placement) -> tuple[Tensor, Tensor]:
    voxels = _voxels(points, placement)
    axes = [
        placement.boundary.fold(x, n, placement.tail) for x, n in zip(voxels.unbind(-1), placement.size, strict=True)
    ]
    located = torch.stack([x for x, _ in axes], -1)
    return located - placement.shift if placement.shift else located, torch.stack([s for _, s in axes], -1)


def _voxels(points: Tensor, placement: Placement) -> Tensor:
    """Voxel coordinates `(..., 3)`; those that would leave the range of their type by a period, or where they end."""
    voxels = placement.geometry.to_voxel(points)
    largest = torch.finfo(voxels.dtype).max
    if placement.geometry.is_identity or all_between(voxels, -largest, largest):
        return voxels
    return torch.where(voxels.isfinite(), voxels, _far_voxels(points, placement))


def _far_voxels(points: Tensor, placement: Placement) -> Tensor:
    """The same by numbers that are small enough: matrix · (point − origin) / 2^k, and modulo period / 2^k is exact."""
    geometry = placement.geometry
    infinite = points.isinf()
    ahead = geometry.direction_to_voxel(torch.where(infinite, points.sign(), 0))
    power = max(math.frexp(max(sum(map(abs, row)) for row in geometry.inverse))[1] + 1, 1)
    near = torch.where(infinite, 0, points) * 2.0**-power - points.new_tensor(geometry.origin) * 2.0**-power
    near = geometry.direction_to_voxel(near)
    periods = [placement.boundary.period(n) for n in placement.size]
    if None not in periods:
        near = near.fmod(points.new_tensor(periods) * 2.0**-power)
    near = near * 2.0**power
    return torch.where(ahead == 0, near, ahead * torch.inf + near)


def evaluate(points: Tensor, placement: Placement, implementation: str) -> tuple[Tensor, Tensor]:
    """(located, sign), without derivatives."""
    located, sign = IMPLEMENTATIONS.get(implementation, _reference)(points, placement)
    return located, points.new_ones(()).expand_as(points) if sign is None else sign


def _on_cpu(points: Tensor, placement: Placement) -> Placed:
    """Fused; the few points that are NaN or beyond the range of their type are left to the plain sum."""
    located, sign, lost = cpu.place(points, placement)
    if not lost or placement.geometry.is_identity:
        return located, sign
    rows = located.isnan().any(-1)
    sign = torch.ones_like(located) if sign is None else sign
    located[rows], sign[rows] = _reference(points[rows], placement)
    return located, sign


IMPLEMENTATIONS: dict[str, Callable[[Tensor, Placement], Placed]] = {"reference": _reference, "cpu": _on_cpu}


class _Place(torch.autograd.Function):
    """d located / d point = sign · matrix everywhere, on planes of reflection too, where |·| and min have none."""

    @staticmethod
    def forward(points: Tensor, placement: Placement, implementation: str) -> tuple[Tensor, Tensor]:
        return evaluate(points, placement, implementation)

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        ctx.geometry = inputs[1].geometry
        ctx.mark_non_differentiable(output[1])
        ctx.save_for_backward(output[1])
        ctx.save_for_forward(output[1])

    @staticmethod
    def backward(ctx, *gradients: Tensor):
        (sign,) = ctx.saved_tensors
        return ctx.geometry.gradient_to_world(gradients[0] * sign), None, None

    @staticmethod
    def jvp(ctx, *tangents):
        (sign,) = ctx.saved_tensors
        return ctx.geometry.direction_to_voxel(tangents[0]) * sign, None

    @staticmethod
    def vmap(info, in_dims, points: Tensor, placement: Placement, implementation: str):
        return _Place.apply(points, placement, implementation), (in_dims[0], in_dims[0])


def place(points: Tensor, placement: Placement, implementation: str = "reference") -> Placed:
    """See `ops.place`."""
    if implementation == "cpu" and autograd.plain(points):
        return _on_cpu(points, placement)
    return _Place.apply(points, placement, implementation)  # type: ignore[return-value]
