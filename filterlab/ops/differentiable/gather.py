"""gather and scatter as differentiable operations, each the other's adjoint.

    d gather / d coefficients = scatter      d gather / d points = the gather of the stencil's derivatives, contracted
    d scatter / d cotangents = gather        d scatter / d points = the same of the incoming gradient

The pair is closed under differentiation: double backward, forward mode and vmap need nothing new, and a backward pass
keeps the coefficients and the points only, none of the taps. The implementation asked for computes all of it, except
for orders beyond those that it has: these fall to the reference (the fused ones have orders up to 3, so this concerns
third and higher derivatives of a value-and-gradient jet).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import torch
from torch import Tensor

from filterlab.ops import cpu, cuda
from filterlab.ops.differentiable.drivers import driver
from filterlab.ops.differentiable.recording import plain, transformed
from filterlab.ops.gather import MAX_ORDER
from filterlab.ops.reference import gather as reference
from filterlab.ops.tetrahedra import AnyStencil


class Sums(Protocol):
    """What computes a gather and a scatter, without derivatives; see `ops.reference.gather` for the meaning."""

    def gather(self, coefficients: Tensor, points: Tensor, stencil: AnyStencil, start: int = 0) -> Tensor: ...
    def scatter(
        self, cotangents: Tensor, points: Tensor, stencil: AnyStencil, shape: Sequence[int], start: int = 0
    ) -> Tensor: ...


@dataclass(frozen=True)
class Implementation:
    """A way to compute gather and scatter.

    Attributes:
        name: of the room that has what computes them; what that needs is asked of `missing` first.
        missing: what keeps it from running as asked; None: it runs everything.
        max_order: of a stencil; None: any.
        pulls: whether it has the adjoint to the points in one pass, of stencils below `max_order`.
    """

    name: str
    missing: Callable[..., str | None] | None = None
    max_order: int | None = None
    pulls: bool = False

    @property
    def sums(self) -> Any:
        """What computes it, imported at its first use."""
        return driver(self.name, "gather")

    def of(self, stencil: AnyStencil) -> Sums:
        """What computes this stencil: the reference where its order is too high."""
        return reference if self.max_order is not None and stencil.order > self.max_order else self.sums


IMPLEMENTATIONS: dict[str, Implementation] = {
    "reference": Implementation("reference"),
    "cpu": Implementation("cpu", cpu.missing, MAX_ORDER, pulls=True),
    "cuda": Implementation("cuda", cuda.missing, MAX_ORDER),
}


def missing(implementation: str, values: Tensor, points: Tensor, stencil: AnyStencil, *sizes) -> str | None:
    """What an implementation lacks to gather (or scatter) as asked; None: nothing. See `ops.cpu.missing`."""
    asked = IMPLEMENTATIONS[implementation].missing
    return None if asked is None else asked(values, points, stencil, *sizes)


def _along_axes(raised: Tensor, stencil: AnyStencil) -> Tensor:
    """(N, C, J', M) of the stencil's derivatives -> (3, N, C, J, M): the derivative of every row along x, y, z."""
    index = torch.tensor(stencil.derivatives[1], device=raised.device)
    return torch.stack([raised.index_select(2, index[axis]) for axis in range(3)])


def pull(
    coefficients: Tensor, points: Tensor, cotangents: Tensor, stencil: AnyStencil, start: int, implementation: str
) -> Tensor:
    """The adjoint of gather to its points, (N, M, 3); in one pass where no derivative of it is asked."""
    alone = not transformed() and (not torch.is_grad_enabled() or plain(coefficients, points, cotangents))
    chosen = IMPLEMENTATIONS[implementation]
    if alone and chosen.pulls and stencil.order < MAX_ORDER:
        return chosen.sums.pull(coefficients, points, cotangents, stencil, start)
    raised = gather(coefficients, points, stencil.derivatives[0], start, implementation)
    return gradient_to_points(raised, cotangents, stencil)


def gradient_to_points(raised: Tensor, cotangents: Tensor, stencil: AnyStencil) -> Tensor:
    """(N, M, 3): Σ over channels and rows of cotangent · derivative of the row."""
    return torch.stack([(cotangents * row).sum((1, 2)) for row in _along_axes(raised, stencil)], -1)


class Gather(torch.autograd.Function):
    """(coefficients (N,C,D,H,W), points (N,M,3), stencil, start, implementation) -> (N, C, J, M)."""

    @staticmethod
    def forward(coefficients: Tensor, points: Tensor, stencil: AnyStencil, start: int, implementation: str) -> Tensor:
        return IMPLEMENTATIONS[implementation].of(stencil).gather(coefficients, points, stencil, start)

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        coefficients, points, ctx.stencil, *ctx.rest = inputs  # rest: start, implementation
        ctx.save_for_backward(coefficients, points)
        ctx.save_for_forward(coefficients, points)

    @staticmethod
    def backward(ctx, *gradients: Tensor):
        coefficients, points = ctx.saved_tensors
        (cotangents,) = gradients
        to_coefficients = to_points = None
        if ctx.needs_input_grad[0]:
            to_coefficients = scatter(cotangents, points, ctx.stencil, tuple(coefficients.shape[2:]), *ctx.rest)
            to_coefficients = to_coefficients.to(coefficients.dtype)
        if ctx.needs_input_grad[1]:
            to_points = pull(coefficients, points, cotangents, ctx.stencil, *ctx.rest)
        return to_coefficients, to_points, None, None, None

    @staticmethod
    def jvp(ctx, *tangents):
        coefficients, points = ctx.saved_tensors
        out = None
        if tangents[0] is not None:
            out = gather(tangents[0], points, ctx.stencil, *ctx.rest)
        if tangents[1] is not None:
            raised = gather(coefficients, points, ctx.stencil.derivatives[0], *ctx.rest)
            steps = tangents[1].movedim(-1, 0)[:, :, None, None]  # (3, N, 1, 1, M)
            moved = (steps * _along_axes(raised, ctx.stencil)).sum(0)
            out = moved if out is None else out + moved
        return out

    @staticmethod
    def vmap(info, in_dims, coefficients: Tensor, points: Tensor, stencil: AnyStencil, *rest):
        volume_dim, point_dim = in_dims[:2]
        b = info.batch_size
        if point_dim is None:  # one set of points: the batch joins the channels
            c = coefficients.movedim(volume_dim, 1)
            out = gather(c.flatten(1, 2), points, stencil, *rest)
            return out.unflatten(1, (b, c.shape[2])), 1
        p = points.movedim(point_dim, 0)
        if volume_dim is None:  # one volume: the batch joins the points
            out = gather(coefficients, p.movedim(0, 1).flatten(1, 2), stencil, *rest)
            return out.unflatten(3, (b, p.shape[2])), 3
        c = coefficients.movedim(volume_dim, 0)
        return gather(c.flatten(0, 1), p.flatten(0, 1), stencil, *rest).unflatten(0, (b, c.shape[1])), 0


class Scatter(torch.autograd.Function):
    """(cotangents (N,C,J,M), points (N,M,3), stencil, shape, start, implementation) -> (N, C, D, H, W)."""

    @staticmethod
    def forward(
        cotangents: Tensor, points: Tensor, stencil: AnyStencil, shape: tuple[int, ...], start: int, implementation: str
    ) -> Tensor:
        return IMPLEMENTATIONS[implementation].of(stencil).scatter(cotangents, points, stencil, shape, start)

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        cotangents, points, ctx.stencil, ctx.shape, *ctx.rest = inputs
        ctx.save_for_backward(cotangents, points)
        ctx.save_for_forward(cotangents, points)

    @staticmethod
    def backward(ctx, *gradients: Tensor):
        cotangents, points = ctx.saved_tensors
        (incoming,) = gradients
        to_cotangents = to_points = None
        if ctx.needs_input_grad[0]:
            to_cotangents = gather(incoming, points, ctx.stencil, *ctx.rest)
        if ctx.needs_input_grad[1]:
            to_points = pull(incoming, points, cotangents, ctx.stencil, *ctx.rest)
        return to_cotangents, to_points, None, None, None, None

    @staticmethod
    def jvp(ctx, *tangents):
        cotangents, points = ctx.saved_tensors
        out = None
        if tangents[0] is not None:
            out = scatter(tangents[0], points, ctx.stencil, ctx.shape, *ctx.rest)
        if tangents[1] is not None:  # moving the points differentiates every row along x, y and z
            n, c, _, m = cotangents.shape
            derivatives, rows = ctx.stencil.derivatives
            raised = cotangents.new_zeros((n, c, len(derivatives.rows), m))
            for axis in range(3):
                index = torch.tensor(rows[axis], device=cotangents.device)
                raised = raised.index_add(2, index, cotangents * tangents[1][:, None, None, :, axis])
            moved = scatter(raised, points, derivatives, ctx.shape, *ctx.rest)
            out = moved if out is None else out + moved
        return out

    @staticmethod
    def vmap(info, in_dims, cotangents: Tensor, points: Tensor, stencil: AnyStencil, shape, *rest):
        cotangent_dim, point_dim = in_dims[:2]
        b = info.batch_size
        if point_dim is None:
            g = cotangents.movedim(cotangent_dim, 1)
            out = scatter(g.flatten(1, 2), points, stencil, shape, *rest)
            return out.unflatten(1, (b, g.shape[2])), 1
        p = points.movedim(point_dim, 0)
        g = cotangents.expand(b, *cotangents.shape) if cotangent_dim is None else cotangents.movedim(cotangent_dim, 0)
        out = scatter(g.flatten(0, 1), p.flatten(0, 1), stencil, shape, *rest)
        return out.unflatten(0, (b, p.shape[1])), 0


def gather(
    coefficients: Tensor, points: Tensor, stencil: AnyStencil, start: int = 0, implementation: str = "reference"
) -> Tensor:
    if not stencil.exact:  # tables that are tensors: torch differentiates the sum itself, in them too
        return reference.gather(coefficients, points, stencil, start)
    if plain(coefficients, points):
        return IMPLEMENTATIONS[implementation].of(stencil).gather(coefficients, points, stencil, start)
    return Gather.apply(coefficients, points, stencil, start, implementation)  # type: ignore[return-value]


def scatter(
    cotangents: Tensor,
    points: Tensor,
    stencil: AnyStencil,
    shape: tuple[int, ...],
    start: int = 0,
    implementation: str = "reference",
) -> Tensor:
    if not stencil.exact:
        return reference.scatter(cotangents, points, stencil, shape, start)
    if plain(cotangents, points):
        return IMPLEMENTATIONS[implementation].of(stencil).scatter(cotangents, points, stencil, shape, start)
    return Scatter.apply(cotangents, points, stencil, shape, start, implementation)  # type: ignore[return-value]
