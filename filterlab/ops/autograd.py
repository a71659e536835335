"""jet and splat as differentiable operations, each the other's adjoint.

    d jet / d coefficients = splat          d jet / d points = the jet of one order more, contracted
    d splat / d cotangents = jet            d splat / d points = the same of the incoming gradient

The pair is closed under differentiation: double backward, forward mode and vmap need nothing new, and a backward pass
keeps the coefficients and the points only, none of the gathered taps.
"""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor

from filterlab.kernels import Kernel
from filterlab.ops import reference
from filterlab.ops.reference import multi_indices

Kernels = tuple[Kernel, Kernel, Kernel]


@lru_cache
def _raised(order: int) -> tuple[tuple[int, ...], ...]:
    """raised[axis][row]: the row of the jet of order + 1 that is the derivative along `axis` of a row of this one."""
    rows = {m: i for i, m in enumerate(multi_indices(order + 1))}
    return tuple(
        tuple(rows[(m[0] + (a == 0), m[1] + (a == 1), m[2] + (a == 2))] for m in multi_indices(order)) for a in range(3)
    )


def _derivatives(jets: Tensor, order: int) -> Tensor:
    """(N, C, J', M) of order + 1 -> (3, N, C, J, M): the derivative of every row along x, y, z."""
    index = torch.tensor(_raised(order), device=jets.device)
    return torch.stack([jets.index_select(2, index[axis]) for axis in range(3)])


def _gradient_to_points(jets: Tensor, cotangents: Tensor, order: int) -> Tensor:
    """(N, M, 3): Σ over channels and rows of cotangent · derivative of the jet."""
    return torch.einsum("ncjm,ancjm->nma", cotangents, _derivatives(jets, order))


class Jet(torch.autograd.Function):
    """(coefficients (N,C,D,H,W), points (N,M,3), kernels, order, start) -> (N, C, J, M)."""

    @staticmethod
    def forward(coefficients: Tensor, points: Tensor, kernels: Kernels, order: int, start: int) -> Tensor:
        return reference.jet(coefficients, points, kernels, order, start)

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        coefficients, points, ctx.kernels, ctx.order, ctx.start = inputs
        ctx.save_for_backward(coefficients, points)
        ctx.save_for_forward(coefficients, points)

    @staticmethod
    def backward(ctx, *gradients: Tensor):
        coefficients, points = ctx.saved_tensors
        (cotangents,) = gradients
        to_coefficients = to_points = None
        if ctx.needs_input_grad[0]:
            shape = tuple(coefficients.shape[2:])
            to_coefficients = splat(cotangents, points, ctx.kernels, ctx.order, shape, ctx.start)
            to_coefficients = to_coefficients.to(coefficients.dtype)
        if ctx.needs_input_grad[1]:
            raised = jet(coefficients, points, ctx.kernels, ctx.order + 1, ctx.start)
            to_points = _gradient_to_points(raised, cotangents, ctx.order)
        return to_coefficients, to_points, None, None, None

    @staticmethod
    def jvp(ctx, *tangents):
        coefficients, points = ctx.saved_tensors
        out = None
        if tangents[0] is not None:
            out = jet(tangents[0], points, ctx.kernels, ctx.order, ctx.start)
        if tangents[1] is not None:
            raised = _derivatives(jet(coefficients, points, ctx.kernels, ctx.order + 1, ctx.start), ctx.order)
            moved = torch.einsum("nma,ancjm->ncjm", tangents[1], raised)
            out = moved if out is None else out + moved
        return out

    @staticmethod
    def vmap(info, in_dims, coefficients: Tensor, points: Tensor, kernels: Kernels, order: int, start: int):
        volume_dim, point_dim = in_dims[:2]
        b = info.batch_size
        if point_dim is None:  # one set of points: the batch joins the channels
            c = coefficients.movedim(volume_dim, 1)
            out = jet(c.flatten(1, 2), points, kernels, order, start)
            return out.unflatten(1, (b, c.shape[2])), 1
        p = points.movedim(point_dim, 0)
        if volume_dim is None:  # one volume: the batch joins the points
            out = jet(coefficients, p.movedim(0, 1).flatten(1, 2), kernels, order, start)
            return out.unflatten(3, (b, p.shape[2])), 3
        c = coefficients.movedim(volume_dim, 0)
        return jet(c.flatten(0, 1), p.flatten(0, 1), kernels, order, start).unflatten(0, (b, c.shape[1])), 0


class Splat(torch.autograd.Function):
    """(cotangents (N,C,J,M), points (N,M,3), kernels, order, shape, start) -> (N, C, D, H, W)."""

    @staticmethod
    def forward(
        cotangents: Tensor, points: Tensor, kernels: Kernels, order: int, shape: tuple[int, ...], start: int
    ) -> Tensor:
        return reference.splat(cotangents, points, kernels, order, shape, start)

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        cotangents, points, ctx.kernels, ctx.order, ctx.shape, ctx.start = inputs
        ctx.save_for_backward(cotangents, points)
        ctx.save_for_forward(cotangents, points)

    @staticmethod
    def backward(ctx, *gradients: Tensor):
        cotangents, points = ctx.saved_tensors
        (incoming,) = gradients
        to_cotangents = to_points = None
        if ctx.needs_input_grad[0]:
            to_cotangents = jet(incoming, points, ctx.kernels, ctx.order, ctx.start)
        if ctx.needs_input_grad[1]:
            raised = jet(incoming, points, ctx.kernels, ctx.order + 1, ctx.start)
            to_points = _gradient_to_points(raised, cotangents, ctx.order)
        return to_cotangents, to_points, None, None, None, None

    @staticmethod
    def jvp(ctx, *tangents):
        cotangents, points = ctx.saved_tensors
        out = None
        if tangents[0] is not None:
            out = splat(tangents[0], points, ctx.kernels, ctx.order, ctx.shape, ctx.start)
        if tangents[1] is not None:  # moving the points raises every row by one order along x, y and z
            n, c, _, m = cotangents.shape
            raised = cotangents.new_zeros((n, c, len(multi_indices(ctx.order + 1)), m))
            for axis, rows in enumerate(_raised(ctx.order)):
                index = torch.tensor(rows, device=cotangents.device)
                raised = raised.index_add(2, index, cotangents * tangents[1][:, None, None, :, axis])
            moved = splat(raised, points, ctx.kernels, ctx.order + 1, ctx.shape, ctx.start)
            out = moved if out is None else out + moved
        return out

    @staticmethod
    def vmap(info, in_dims, cotangents: Tensor, points: Tensor, kernels, order: int, shape, start: int):
        cotangent_dim, point_dim = in_dims[:2]
        b = info.batch_size
        if point_dim is None:
            g = cotangents.movedim(cotangent_dim, 1)
            out = splat(g.flatten(1, 2), points, kernels, order, shape, start)
            return out.unflatten(1, (b, g.shape[2])), 1
        p = points.movedim(point_dim, 0)
        g = cotangents.expand(b, *cotangents.shape) if cotangent_dim is None else cotangents.movedim(cotangent_dim, 0)
        out = splat(g.flatten(0, 1), p.flatten(0, 1), kernels, order, shape, start)
        return out.unflatten(0, (b, p.shape[1])), 0


def jet(coefficients: Tensor, points: Tensor, kernels: Kernels, order: int, start: int) -> Tensor:
    return Jet.apply(coefficients, points, kernels, order, start)  # type: ignore[return-value]


def splat(
    cotangents: Tensor, points: Tensor, kernels: Kernels, order: int, shape: tuple[int, ...], start: int
) -> Tensor:
    return Splat.apply(cotangents, points, kernels, order, shape, start)  # type: ignore[return-value]
