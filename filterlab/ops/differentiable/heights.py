"""jet and splat of heights as differentiable operations, each the other's adjoint; and what computes them.

    d jet / d heights = splat         d jet / d points = the jet of the next order, contracted
    d splat / d cotangents = jet      d splat / d points = the same of the incoming gradient

Backward passes keep heights and points. In holes, where rows are NaN, nothing has a derivative.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from filterlab.ops import cpu, cuda
from filterlab.ops.differentiable.drivers import driver, room_of
from filterlab.ops.differentiable.recording import plain, transformed
from filterlab.ops.heights import DEGREE, Heights, raised, rows, unsupported
from filterlab.ops.reference import heights as reference


def missing(implementation: str, heights: Heights, points: Tensor) -> str | None:
    """What keeps "cpu" or "cuda" from running here; None: nothing does."""
    if transformed():
        return "it has no transforms of torch.func, and no torch.compile"
    if heights.values.device != points.device:
        return f"it works on tensors of one device; got {heights.values.device} and {points.device}"
    if problem := cpu.llvmlite_problem() if implementation == "cpu" else cuda.device_problem(points):
        return problem
    if implementation == "cpu" and points.device.type != "cpu":
        return f"it works on tensors of the CPU; got {points.device}"
    return unsupported(heights, points)


def jet(heights: Heights, points: Tensor, order: int, implementation: str | None = None) -> Tensor:
    """The rows (N, R, P) of `ops.heights.rows` at world points (N, P, 2); see `ops.reference.heights.jet`.

    Args:
        implementation: "reference", "cpu" or "cuda"; None: the fastest one that can run.
    """
    if implementation is None:
        fused = room_of(points.device)
        implementation = fused if missing(fused, heights, points) is None else "reference"
    if implementation == "reference":
        return reference.jet(heights, points, order)
    return _jet(heights.values, points, heights, order, implementation)


def _jet(values: Tensor, points: Tensor, heights: Heights, order: int, implementation: str) -> Tensor:
    if order > DEGREE:  # derivatives beyond the degree are 0
        found = _jet(values, points, heights, DEGREE, implementation)
        more = len(rows(order)) - len(rows(DEGREE))
        return torch.cat((found, found.new_zeros(len(found), more, found.shape[-1])), 1)
    if plain(values, points):
        return driver(implementation, "heights").jet(replace(heights, values=values), points, order)
    return _Jet.apply(values, points, heights, order, implementation)  # type: ignore[return-value]


def _splat(cotangents: Tensor, points: Tensor, heights: Heights, order: int, implementation: str) -> Tensor:
    """(N, H, W) from rows (N, R, P) of any order."""
    if order > DEGREE:
        return _splat(cotangents[:, : len(rows(DEGREE))], points, heights, DEGREE, implementation)
    if plain(cotangents, points):
        return driver(implementation, "heights").splat(heights, points, cotangents, order)
    return _Splat.apply(cotangents, points, heights, order, implementation)  # type: ignore[return-value]


def _pull(values: Tensor, points: Tensor, cotangents: Tensor, heights: Heights, order: int, name: str) -> Tensor:
    """The adjoint of `jet` to the points, (N, P, 2)."""
    higher = _jet(values, points, heights, order + 1, name)
    by_axis = [(cotangents * higher[:, list(places)]).sum(1) for places in raised(order)]
    return torch.stack(by_axis, -1)


def _without(heights: Heights) -> Heights:
    """The same, of no derivatives: a backward pass keeps the heights themselves."""
    return replace(heights, values=heights.values.detach())


class _Jet(torch.autograd.Function):
    """(values (N, H, W), points (N, P, 2), heights, order, implementation) -> rows (N, R, P)."""

    @staticmethod
    def forward(ctx, values: Tensor, points: Tensor, heights: Heights, order: int, implementation: str) -> Tensor:
        ctx.rest = _without(heights), order, implementation
        found = driver(implementation, "heights").jet(replace(heights, values=values), points, order)
        ctx.hole = hole if bool((hole := found[:, :1].isnan()).any()) else None
        ctx.save_for_backward(values, points)
        return found

    @staticmethod
    def backward(ctx, *gradients: Tensor):
        values, points = ctx.saved_tensors
        (cotangents,), hole = gradients, ctx.hole
        if hole is not None:
            cotangents = cotangents.masked_fill(hole, 0)
        to_values = to_points = None
        if ctx.needs_input_grad[0]:
            to_values = _splat(cotangents, points, *ctx.rest).to(values.dtype)
        if ctx.needs_input_grad[1]:
            to_points = _pull(values, points, cotangents, *ctx.rest)
            to_points = to_points if hole is None else to_points.masked_fill(hole[:, 0, :, None], 0)
        return to_values, to_points, None, None, None


class _Splat(torch.autograd.Function):
    """(cotangents (N, R, P), points (N, P, 2), heights, order, implementation) -> (N, H, W)."""

    @staticmethod
    def forward(ctx, cotangents: Tensor, points: Tensor, heights: Heights, order: int, implementation: str) -> Tensor:
        ctx.rest = heights, order, implementation
        ctx.save_for_backward(cotangents, points)
        return driver(implementation, "heights").splat(heights, points, cotangents, order)

    @staticmethod
    def backward(ctx, *gradients: Tensor):
        cotangents, points = ctx.saved_tensors
        (incoming,) = gradients
        to_cotangents = to_points = None
        if ctx.needs_input_grad[0]:
            to_cotangents = _jet(incoming, points, *ctx.rest)
        if ctx.needs_input_grad[1]:
            to_points = _pull(incoming, points, cotangents, *ctx.rest)
        return to_cotangents, to_points, None, None, None
