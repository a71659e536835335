"""gather and scatter as differentiable operations, each the other's adjoint.

    d gather / d coefficients = scatter      d gather / d points = the gather of the stencil's derivatives, contracted
    d scatter / d cotangents = gather        d scatter / d points = the same of the incoming gradient

The pair is closed under differentiation: double backward, forward mode and vmap need nothing new, and a backward pass
keeps the coefficients and the points only, none of the taps. The implementation asked for computes all of it, except
for orders beyond those that it has: these fall to the reference (the fused ones have orders up to 3, so this concerns
third and higher derivatives of a value-and-gradient jet).
"""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Protocol

import torch
from torch import Tensor
from torch.autograd import forward_ad

from filterlab.ops import cpu, cuda, reference
from filterlab.ops.stencil import Stencil


class Implementation(Protocol):
    """What computes a gather and a scatter, without derivatives; see `ops.reference` for the meaning."""

    def gather(self, coefficients: Tensor, points: Tensor, stencil: Stencil, start: int = 0) -> Tensor: ...
    def scatter(
        self, cotangents: Tensor, points: Tensor, stencil: Stencil, shape: Sequence[int], start: int = 0
    ) -> Tensor: ...


IMPLEMENTATIONS: dict[str, Implementation] = {"reference": reference, "cpu": cpu, "cuda": cuda}
MAX_ORDER = {"cpu": cpu.MAX_ORDER, "cuda": cuda.MAX_ORDER}
MISSING = {"cpu": cpu.missing, "cuda": cuda.missing}
"""Of every implementation that can't do everything: what says why not."""


def _implementation(name: str, stencil: Stencil) -> Implementation:
    return reference if stencil.order > MAX_ORDER.get(name, stencil.order) else IMPLEMENTATIONS[name]


def _along_axes(raised: Tensor, stencil: Stencil) -> Tensor:
    """(N, C, J', M) of the stencil's derivatives -> (3, N, C, J, M): the derivative of every row along x, y, z."""
    index = torch.tensor(stencil.derivatives[1], device=raised.device)
    return torch.stack([raised.index_select(2, index[axis]) for axis in range(3)])


def pull(
    coefficients: Tensor, points: Tensor, cotangents: Tensor, stencil: Stencil, start: int, implementation: str
) -> Tensor:
    """The adjoint of gather to its points, (N, M, 3); in one pass where no derivative of it is asked."""
    alone = not transformed() and (not torch.is_grad_enabled() or plain(coefficients, points, cotangents))
    if implementation == "cpu" and stencil.order < cpu.MAX_ORDER and alone:
        return cpu.pull(coefficients, points, cotangents, stencil, start)
    raised = gather(coefficients, points, stencil.derivatives[0], start, implementation)
    return gradient_to_points(raised, cotangents, stencil)


def gradient_to_points(raised: Tensor, cotangents: Tensor, stencil: Stencil) -> Tensor:
    """(N, M, 3): Σ over channels and rows of cotangent · derivative of the row."""
    return torch.einsum("ncjm,ancjm->nma", cotangents, _along_axes(raised, stencil))


class Gather(torch.autograd.Function):
    """(coefficients (N,C,D,H,W), points (N,M,3), stencil, start, implementation) -> (N, C, J, M)."""

    @staticmethod
    def forward(coefficients: Tensor, points: Tensor, stencil: Stencil, start: int, implementation: str) -> Tensor:
        return _implementation(implementation, stencil).gather(coefficients, points, stencil, start)

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
            moved = torch.einsum("nma,ancjm->ncjm", tangents[1], _along_axes(raised, ctx.stencil))
            out = moved if out is None else out + moved
        return out

    @staticmethod
    def vmap(info, in_dims, coefficients: Tensor, points: Tensor, stencil: Stencil, *rest):
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
        cotangents: Tensor, points: Tensor, stencil: Stencil, shape: tuple[int, ...], start: int, implementation: str
    ) -> Tensor:
        return _implementation(implementation, stencil).scatter(cotangents, points, stencil, shape, start)

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
    def vmap(info, in_dims, cotangents: Tensor, points: Tensor, stencil: Stencil, shape, *rest):
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


_modes = threading.local()  # in its list, one mark for everybody who has changed the grad mode


@contextmanager
def differentiating(on: bool) -> Iterator[None]:
    """torch's grad mode, put back in any case.

    `torch.no_grad` leaves it off for good when Ctrl-C comes between its first line and the block. This generator, left
    behind there, is closed with the exception; and whoever is around it has put the mode back by then, marks included.
    """
    before, mark, marks = torch.is_grad_enabled(), object(), _modes.__dict__.setdefault("marks", [])
    try:
        marks.append(mark)
        torch._C._set_grad_enabled(on)
        yield
    finally:
        if mark in marks:
            torch._C._set_grad_enabled(before)
            del marks[marks.index(mark) :]


def plain(*tensors: Tensor) -> bool:
    """True when no derivative of any kind is asked: autograd.Function's own 0.1 ms can be saved."""
    return not (any(t.requires_grad for t in tensors) or transformed())


def transformed() -> bool:
    """True inside a transform: vmap, jvp and the like, forward mode, torch.compile."""
    return (
        torch._C._are_functorch_transforms_active() or forward_ad._current_level >= 0 or torch.compiler.is_compiling()
    )


def gather(
    coefficients: Tensor, points: Tensor, stencil: Stencil, start: int = 0, implementation: str = "reference"
) -> Tensor:
    if not stencil.exact:  # tables that are tensors: torch differentiates the sum itself, in them too
        return reference.gather(coefficients, points, stencil, start)
    if plain(coefficients, points):
        return _implementation(implementation, stencil).gather(coefficients, points, stencil, start)
    return Gather.apply(coefficients, points, stencil, start, implementation)  # type: ignore[return-value]


def scatter(
    cotangents: Tensor,
    points: Tensor,
    stencil: Stencil,
    shape: tuple[int, ...],
    start: int = 0,
    implementation: str = "reference",
) -> Tensor:
    if not stencil.exact:
        return reference.scatter(cotangents, points, stencil, shape, start)
    if plain(cotangents, points):
        return _implementation(implementation, stencil).scatter(cotangents, points, stencil, shape, start)
    return Scatter.apply(cotangents, points, stencil, shape, start, implementation)  # type: ignore[return-value]
