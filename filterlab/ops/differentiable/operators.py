"""gather, scatter, place and prefilter as operators that torch.compile takes whole.

torch.compile does not look into an `autograd.Function` with forward mode, so that while it traces, the same operations
go by these `torch.library` operators. What is no tensor travels as text: operators take nothing else, and a compiled
graph that is stored on disk must find its stencil again.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from fractions import Fraction
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor
from torch.library import custom_op

from filterlab.geometry import Geometry
from filterlab.kernels import Kernel
from filterlab.ops.differentiable import gather as sums
from filterlab.ops.differentiable import place as placement
from filterlab.ops.differentiable import prefilter as filters
from filterlab.ops.place import Placement
from filterlab.ops.prefilter import VOLUME, Filtering
from filterlab.ops.stencil import Product, Stencil
from filterlab.ops.tetrahedra import AnyStencil, Tetrahedra, TetrahedralStencil
from filterlab.ops.tracing import constant
from filterlab.prefilters import Prefilter, named
from filterlab.volume import Boundary


@constant
def stencil_text(stencil: AnyStencil) -> str:
    """The stencil as JSON; `stencil_of` is the inverse."""
    if isinstance(stencil, TetrahedralStencil):
        return json.dumps({"spline": asdict(stencil.spline), "orders": stencil.orders}, separators=(",", ":"))
    kernels = list(dict.fromkeys(k for row in stencil.rows for p in row for k in p.kernels))
    tables = [[k.name, [[str(c) for c in piece] for piece in k.pieces]] for k in kernels]  # type: ignore[attr-defined]
    rows = [[[p.weight, [kernels.index(k) for k in p.kernels], p.orders] for p in row] for row in stencil.rows]
    return json.dumps([tables, rows], separators=(",", ":"))


@lru_cache(maxsize=1024)
def stencil_of(text: str) -> AnyStencil:
    known = json.loads(text)
    if isinstance(known, dict):
        return TetrahedralStencil(Tetrahedra(**_fields(known["spline"])), _tuples(known["orders"]))
    tables, rows = known
    kernels = [Kernel(name, tuple(tuple(Fraction(c) for c in piece) for piece in pieces)) for name, pieces in tables]
    return Stencil(
        tuple(
            tuple(
                Product((kernels[x], kernels[y], kernels[z]), tuple(orders), weight)  # type: ignore[arg-type]
                for weight, (x, y, z), orders in row
            )
            for row in rows
        )
    )


def _fields(known: dict[str, Any]) -> dict[str, Any]:
    return {name: _tuples(value) for name, value in known.items()}


def _tuples(value: Any) -> Any:
    """Lists of JSON as the tuples they were."""
    return tuple(map(_tuples, value)) if isinstance(value, list) else value


@constant
def placement_text(placement: Placement) -> str:
    """The placement as JSON; `placement_of` is the inverse."""
    g = placement.geometry
    return json.dumps([g.matrix, g.origin, placement.boundary, placement.size, placement.tail, placement.shift])


@lru_cache(maxsize=1024)
def placement_of(text: str) -> Placement:
    matrix, origin, boundary, size, tail, shift = json.loads(text)
    geometry = Geometry(tuple(map(tuple, matrix)), tuple(origin))
    return Placement(geometry, Boundary(boundary), tuple(size), tail, tuple(shift))


@constant
def filtering_text(
    prefilter: str | Prefilter, boundary: str | Boundary, tail: int, dims: tuple[int, ...] = VOLUME
) -> str:
    """A prefilter along some axes as JSON; `filtering_of` is the inverse."""
    own = named(prefilter)
    return json.dumps([own.name, [[str(c) for c in f] for f in own.factors], Boundary.named(boundary), tail, dims])


@lru_cache(maxsize=1024)
def filtering_of(text: str) -> Filtering:
    name, factors, boundary, tail, dims = json.loads(text)
    own = Prefilter(name, tuple(tuple(Fraction(c) for c in factor) for factor in factors))
    return Filtering(tuple(dims), own, Boundary(boundary), tail)


# --- gather -----------------------------------------------------------------------------------------------------------


@custom_op("filterlab::gather", mutates_args=())
def gather(coefficients: Tensor, points: Tensor, stencil: str, start: int, implementation: str) -> Tensor:
    """`ops.gather` of a stencil given as text."""
    return sums.gather(coefficients, points, stencil_of(stencil), start, implementation).contiguous()


@gather.register_fake
def _(coefficients: Tensor, points: Tensor, stencil: str, start: int, implementation: str) -> Tensor:
    n, c = coefficients.shape[:2]
    return points.new_empty((n, c, len(stencil_of(stencil).rows), points.shape[1]))


def _keep_gather(ctx, inputs, output) -> None:
    coefficients, points, *ctx.rest = inputs
    ctx.save_for_backward(coefficients, points)


def _gather_backward(ctx, cotangents: Tensor):
    coefficients, points = ctx.saved_tensors
    stencil, start, implementation = ctx.rest
    to_coefficients = to_points = None
    if ctx.needs_input_grad[0]:
        d, h, w = coefficients.shape[2:]
        spread = scatter(cotangents.contiguous(), points, stencil, [d, h, w], start, implementation)
        to_coefficients = spread.to(coefficients.dtype)
    if ctx.needs_input_grad[1]:
        to_points = _to_points(coefficients, points, cotangents, stencil, start, implementation)
    return to_coefficients, to_points, None, None, None


def _to_points(coefficients: Tensor, points: Tensor, cotangents: Tensor, stencil: str, *rest) -> Tensor:
    own = stencil_of(stencil)
    raised = gather(coefficients, points, stencil_text(own.derivatives[0]), *rest)
    return sums.gradient_to_points(raised, cotangents, own)


gather.register_autograd(_gather_backward, setup_context=_keep_gather)


# --- scatter ----------------------------------------------------------------------------------------------------------


@custom_op("filterlab::scatter", mutates_args=())
def scatter(
    cotangents: Tensor, points: Tensor, stencil: str, shape: list[int], start: int, implementation: str
) -> Tensor:
    """`ops.scatter` of a stencil given as text."""
    out = sums.scatter(cotangents, points, stencil_of(stencil), tuple(shape), start, implementation)
    return out.contiguous()


@scatter.register_fake
def _(cotangents: Tensor, points: Tensor, stencil: str, shape: list[int], start: int, implementation: str) -> Tensor:
    return points.new_empty((*cotangents.shape[:2], *shape))


def _keep_scatter(ctx, inputs, output) -> None:
    cotangents, points, ctx.stencil, _, *ctx.rest = inputs
    ctx.save_for_backward(cotangents, points)


def _scatter_backward(ctx, incoming: Tensor):
    cotangents, points = ctx.saved_tensors
    to_cotangents = to_points = None
    if ctx.needs_input_grad[0]:
        to_cotangents = gather(incoming.contiguous(), points, ctx.stencil, *ctx.rest)
    if ctx.needs_input_grad[1]:
        to_points = _to_points(incoming.contiguous(), points, cotangents, ctx.stencil, *ctx.rest)
    return to_cotangents, to_points, None, None, None, None


scatter.register_autograd(_scatter_backward, setup_context=_keep_scatter)


# --- place ------------------------------------------------------------------------------------------------------------


@custom_op("filterlab::place", mutates_args=())
def place(points: Tensor, where: str, implementation: str) -> tuple[Tensor, Tensor]:
    """`ops.place` at a placement given as text; the sign always as a tensor."""
    located, sign = placement.evaluate(points, placement_of(where), implementation)
    return located.contiguous().clone() if located is points else located.contiguous(), sign.contiguous()


@place.register_fake
def _(points: Tensor, where: str, implementation: str) -> tuple[Tensor, Tensor]:
    return points.new_empty(points.shape), points.new_empty(points.shape)


def _keep_place(ctx, inputs, output) -> None:
    ctx.geometry = placement_of(inputs[1]).geometry
    ctx.mark_non_differentiable(output[1])
    ctx.save_for_backward(output[1])


def _place_backward(ctx, to_located: Tensor, to_sign: Tensor):
    (sign,) = ctx.saved_tensors
    return ctx.geometry.gradient_to_world(to_located * sign), None, None


place.register_autograd(_place_backward, setup_context=_keep_place)


# --- prefilter --------------------------------------------------------------------------------------------------------


@custom_op("filterlab::prefilter", mutates_args=())
def prefilter(samples: Tensor, how: str, implementation: str) -> Tensor:
    """`ops.prefilter_samples` or `ops.prefilter_axis` of a filter given as text."""
    return _own(filters.evaluate(samples, filtering_of(how), implementation), samples)


@prefilter.register_fake
def _(samples: Tensor, how: str, implementation: str) -> Tensor:
    shape, filtering = list(samples.shape), filtering_of(how)
    for dim in filtering.dims:
        shape[dim] += 2 * filtering.tail
    return samples.new_empty(shape, dtype=torch.promote_types(samples.dtype, torch.float32))


def _keep_prefilter(ctx, inputs, output) -> None:
    samples, *ctx.rest = inputs
    ctx.shape, ctx.dtype = samples.shape, samples.dtype


def _prefilter_backward(ctx, cotangents: Tensor):
    return prefilter_adjoint(cotangents.contiguous(), list(ctx.shape), *ctx.rest).to(ctx.dtype), None, None


prefilter.register_autograd(_prefilter_backward, setup_context=_keep_prefilter)


@custom_op("filterlab::prefilter_adjoint", mutates_args=())
def prefilter_adjoint(cotangents: Tensor, shape: list[int], how: str, implementation: str) -> Tensor:
    """The adjoint of `prefilter`, back to the shape of the samples."""
    return _own(filters.adjoint(cotangents, torch.Size(shape), filtering_of(how), implementation), cotangents)


@prefilter_adjoint.register_fake
def _(cotangents: Tensor, shape: list[int], how: str, implementation: str) -> Tensor:
    return cotangents.new_empty(shape)


def _keep_adjoint(ctx, inputs, output) -> None:
    _, _, *ctx.rest = inputs


def _adjoint_backward(ctx, incoming: Tensor):
    return prefilter(incoming.contiguous(), *ctx.rest), None, None, None


prefilter_adjoint.register_autograd(_adjoint_backward, setup_context=_keep_adjoint)


def _own(result: Tensor, given: Tensor) -> Tensor:
    """The result in memory of its own: an operator may not return what it was given."""
    return result.clone() if result.data_ptr() == given.data_ptr() else result.contiguous()
