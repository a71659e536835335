"""place: world points to coordinates of stored coefficients.

Coefficients are stored padded under a boundary, so that no tap is ever folded; the points are, into the stored part:

    located = fold(matrix · (point − origin)) − shift,       sign = d fold / d voxel ∈ {1, −1, 0} along each axis,

and d located_i / d point_j = sign_i · matrix_ij.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from filterlab.ops import autograd, cpu
from filterlab.volume import Boundary, Geometry

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
    voxels = placement.geometry.to_voxel(points)
    axes = [
        placement.boundary.fold(x, n, placement.tail) for x, n in zip(voxels.unbind(-1), placement.size, strict=True)
    ]
    located = torch.stack([x for x, _ in axes], -1)
    return located - placement.shift if placement.shift else located, torch.stack([s for _, s in axes], -1)


def evaluate(points: Tensor, placement: Placement, implementation: str) -> tuple[Tensor, Tensor]:
    """(located, sign), without derivatives."""
    located, sign = IMPLEMENTATIONS.get(implementation, _reference)(points, placement)
    return located, points.new_ones(()).expand_as(points) if sign is None else sign


IMPLEMENTATIONS: dict[str, Callable[[Tensor, Placement], Placed]] = {"reference": _reference, "cpu": cpu.place}


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
        return cpu.place(points, placement)
    return _Place.apply(points, placement, implementation)  # type: ignore[return-value]
