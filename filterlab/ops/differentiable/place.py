"""place as a differentiable operation: d located_i / d point_j = sign_i · matrix_ij."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from filterlab.ops.differentiable.drivers import driver
from filterlab.ops.differentiable.recording import plain, transformed
from filterlab.ops.place import Placed, Placement
from filterlab.ops.reference import place as reference


def _on_the_cpu(points: Tensor, placement: Placement) -> Placed:
    return driver("cpu", "place").place(points, placement)


IMPLEMENTATIONS: dict[str, Callable[[Tensor, Placement], Placed]] = {
    "reference": reference.place,
    "cpu": _on_the_cpu,
    "cuda": reference.place,
}


class _Place(torch.autograd.Function):
    """d located / d point = sign · matrix everywhere, on planes of reflection too, where |·| and min have none.

    (points, placement, implementation, whole) -> (located, sign); sign None where it is 1 everywhere, if not `whole`:
    transforms want a tensor.
    """

    @staticmethod
    def forward(points: Tensor, placement: Placement, implementation: str, whole: bool) -> Placed:
        located, sign = IMPLEMENTATIONS[implementation](points, placement)
        return located, points.new_ones(()).expand_as(points) if sign is None and whole else sign

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        ctx.geometry = inputs[1].geometry
        ctx.turned = output[1] is not None
        if ctx.turned:
            ctx.mark_non_differentiable(output[1])
            ctx.save_for_backward(output[1])
            ctx.save_for_forward(output[1])

    @staticmethod
    def backward(ctx, *gradients: Tensor):
        turned = gradients[0] * ctx.saved_tensors[0] if ctx.turned else gradients[0]
        return ctx.geometry.gradient_to_world(turned), None, None, None

    @staticmethod
    def jvp(ctx, *tangents):
        moved = ctx.geometry.direction_to_voxel(tangents[0])
        return moved * ctx.saved_tensors[0] if ctx.turned else moved, None

    @staticmethod
    def vmap(info, in_dims, points: Tensor, placement: Placement, implementation: str, whole: bool):
        return _Place.apply(points, placement, implementation, True), (in_dims[0], in_dims[0])


def evaluate(points: Tensor, placement: Placement, implementation: str) -> tuple[Tensor, Tensor]:
    """(located, sign), without derivatives; sign is always a tensor."""
    located, sign = IMPLEMENTATIONS[implementation](points, placement)
    return located, points.new_ones(()).expand_as(points) if sign is None else sign


def place(points: Tensor, placement: Placement, implementation: str = "reference") -> Placed:
    """See `ops.place`."""
    if plain(points):
        return IMPLEMENTATIONS[implementation](points, placement)
    return _Place.apply(points, placement, implementation, transformed())  # type: ignore[return-value]
