"""jet and splat as differentiable operations, each the other's adjoint.

    d jet / d coefficients = splat          d jet / d points = the jet of one order more, contracted
    d splat / d cotangents = jet            d splat / d points = the same of the incoming gradient

The pair is closed under differentiation: double backward, forward mode and vmap need nothing new, and a backward pass
keeps the coefficients and the points only, none of the gathered taps. The implementation asked for computes all of it,
except for orders beyond those that it has: these fall to the reference (the fused ones have orders up to 3, so this
concerns third and higher derivatives of a value-and-gradient jet).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Protocol

import torch
from torch import Tensor
from torch.autograd import forward_ad

from filterlab.kernels import Kernel
from filterlab.ops import cpu, reference
from filterlab.ops.reference import multi_indices

Kernels = tuple[Kernel, Kernel, Kernel]


class Implementation(Protocol):
    """What computes a jet and a splat, without derivatives; see `ops.reference` for the meaning."""

    def jet(self, coefficients: Tensor, points: Tensor, kernels: Kernels, order: int, start: int = 0) -> Tensor: ...
    def splat(
        self,
        cotangents: Tensor,
        points: Tensor,
        kernels: Kernels,
        order: int,
        shape: Sequence[int],
        start: int = 0,
    ) -> Tensor: ...


IMPLEMENTATIONS: dict[str, Implementation] = {"reference": reference, "cpu": cpu}
MAX_ORDER = {"cpu": cpu.MAX_ORDER}


def _implementation(name: str, order: int) -> Implementation:
    return reference if order > MAX_ORDER.get(name, order) else IMPLEMENTATIONS[name]


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
    """(coefficients (N,C,D,H,W), points (N,M,3), kernels, order, start, implementation) -> (N, C, J, M)."""

    @staticmethod
    def forward(
        coefficients: Tensor, points: Tensor, kernels: Kernels, order: int, start: int, implementation: str
    ) -> Tensor:
        return _implementation(implementation, order).jet(coefficients, points, kernels, order, start)

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        coefficients, points, ctx.kernels, ctx.order, *ctx.rest = inputs  # rest: start, implementation
        ctx.save_for_backward(coefficients, points)
        ctx.save_for_forward(coefficients, points)

    @staticmethod
    def backward(ctx, *gradients: Tensor):
        coefficients, points = ctx.saved_tensors
        (cotangents,) = gradients
        to_coefficients = to_points = None
        if ctx.needs_input_grad[0]:
            shape = tuple(coefficients.shape[2:])
            to_coefficients = splat(cotangents, points, ctx.kernels, ctx.order, shape, *ctx.rest)
            to_coefficients = to_coefficients.to(coefficients.dtype)
        if ctx.needs_input_grad[1]:
            raised = jet(coefficients, points, ctx.kernels, ctx.order + 1, *ctx.rest)
            to_points = _gradient_to_points(raised, cotangents, ctx.order)
        return to_coefficients, to_points, None, None, None, None

    @staticmethod
    def jvp(ctx, *tangents):
        coefficients, points = ctx.saved_tensors
        out = None
        if tangents[0] is not None:
            out = jet(tangents[0], points, ctx.kernels, ctx.order, *ctx.rest)
        if tangents[1] is not None:
            raised = _derivatives(jet(coefficients, points, ctx.kernels, ctx.order + 1, *ctx.rest), ctx.order)
            moved = torch.einsum("nma,ancjm->ncjm", tangents[1], raised)
            out = moved if out is None else out + moved
        return out

    @staticmethod
    def vmap(info, in_dims, coefficients: Tensor, points: Tensor, kernels: Kernels, order: int, *rest):
        volume_dim, point_dim = in_dims[:2]
        b = info.batch_size
        if point_dim is None:  # one set of points: the batch joins the channels
            c = coefficients.movedim(volume_dim, 1)
            out = jet(c.flatten(1, 2), points, kernels, order, *rest)
            return out.unflatten(1, (b, c.shape[2])), 1
        p = points.movedim(point_dim, 0)
        if volume_dim is None:  # one volume: the batch joins the points
            out = jet(coefficients, p.movedim(0, 1).flatten(1, 2), kernels, order, *rest)
            return out.unflatten(3, (b, p.shape[2])), 3
        c = coefficients.movedim(volume_dim, 0)
        return jet(c.flatten(0, 1), p.flatten(0, 1), kernels, order, *rest).unflatten(0, (b, c.shape[1])), 0


class Splat(torch.autograd.Function):
    """(cotangents (N,C,J,M), points (N,M,3), kernels, order, shape, start, implementation) -> (N, C, D, H, W)."""

    @staticmethod
    def forward(
        cotangents: Tensor,
        points: Tensor,
        kernels: Kernels,
        order: int,
        shape: tuple[int, ...],
        start: int,
        implementation: str,
    ) -> Tensor:
        return _implementation(implementation, order).splat(cotangents, points, kernels, order, shape, start)

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        cotangents, points, ctx.kernels, ctx.order, ctx.shape, *ctx.rest = inputs
        ctx.save_for_backward(cotangents, points)
        ctx.save_for_forward(cotangents, points)

    @staticmethod
    def backward(ctx, *gradients: Tensor):
        cotangents, points = ctx.saved_tensors
        (incoming,) = gradients
        to_cotangents = to_points = None
        if ctx.needs_input_grad[0]:
            to_cotangents = jet(incoming, points, ctx.kernels, ctx.order, *ctx.rest)
        if ctx.needs_input_grad[1]:
            raised = jet(incoming, points, ctx.kernels, ctx.order + 1, *ctx.rest)
            to_points = _gradient_to_points(raised, cotangents, ctx.order)
        return to_cotangents, to_points, None, None, None, None, None

    @staticmethod
    def jvp(ctx, *tangents):
        cotangents, points = ctx.saved_tensors
        out = None
        if tangents[0] is not None:
            out = splat(tangents[0], points, ctx.kernels, ctx.order, ctx.shape, *ctx.rest)
        if tangents[1] is not None:  # moving the points raises every row by one order along x, y and z
            n, c, _, m = cotangents.shape
            raised = cotangents.new_zeros((n, c, len(multi_indices(ctx.order + 1)), m))
            for axis, rows in enumerate(_raised(ctx.order)):
                index = torch.tensor(rows, device=cotangents.device)
                raised = raised.index_add(2, index, cotangents * tangents[1][:, None, None, :, axis])
            moved = splat(raised, points, ctx.kernels, ctx.order + 1, ctx.shape, *ctx.rest)
            out = moved if out is None else out + moved
        return out

    @staticmethod
    def vmap(info, in_dims, cotangents: Tensor, points: Tensor, kernels, order: int, shape, *rest):
        cotangent_dim, point_dim = in_dims[:2]
        b = info.batch_size
        if point_dim is None:
            g = cotangents.movedim(cotangent_dim, 1)
            out = splat(g.flatten(1, 2), points, kernels, order, shape, *rest)
            return out.unflatten(1, (b, g.shape[2])), 1
        p = points.movedim(point_dim, 0)
        g = cotangents.expand(b, *cotangents.shape) if cotangent_dim is None else cotangents.movedim(cotangent_dim, 0)
        out = splat(g.flatten(0, 1), p.flatten(0, 1), kernels, order, shape, *rest)
        return out.unflatten(0, (b, p.shape[1])), 0


def _plain(*tensors: Tensor) -> bool:
    """True when no derivative of any kind is asked: autograd.Function's own 0.1 ms can be saved."""
    return not (
        any(t.requires_grad for t in tensors)
        or torch._C._are_functorch_transforms_active()
        or forward_ad._current_level >= 0
        or torch.compiler.is_compiling()
    )


def jet(
    coefficients: Tensor,
    points: Tensor,
    kernels: Kernels,
    order: int,
    start: int = 0,
    implementation: str = "reference",
) -> Tensor:
    if _plain(coefficients, points):
        return _implementation(implementation, order).jet(coefficients, points, kernels, order, start)
    return Jet.apply(coefficients, points, kernels, order, start, implementation)  # type: ignore[return-value]


def splat(
    cotangents: Tensor,
    points: Tensor,
    kernels: Kernels,
    order: int,
    shape: tuple[int, ...],
    start: int = 0,
    implementation: str = "reference",
) -> Tensor:
    if _plain(cotangents, points):
        return _implementation(implementation, order).splat(cotangents, points, kernels, order, shape, start)
    return Splat.apply(cotangents, points, kernels, order, shape, start, implementation)  # type: ignore[return-value]
