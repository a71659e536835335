"""The march as a differentiable operation: what runs it, its adjoint, and derivatives of higher order.

The backward pass marches once more and keeps nothing of a sample. What is marched is prepared anew for it from the
tensors that derivatives are asked by, so that nothing of the preparation has to be kept either:

    tensors ──prepare──▶ March ──▶ light, depth          derivatives by March.tensors ──autograd──▶ by the tensors

With create_graph=True derivatives are those of the plain twin, which can be differentiated again.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import ModuleType

import torch
from torch import Tensor

from filterlab.ops import cpu, cuda
from filterlab.ops.differentiable.drivers import driver, room_of
from filterlab.ops.differentiable.gather import gather
from filterlab.ops.differentiable.recording import transforming
from filterlab.ops.march import MAX_LIGHTS, Bricks, March
from filterlab.ops.march_derivatives import GRADIENTS, MEMBERS
from filterlab.ops.reference import march as reference
from filterlab.ops.tetrahedra import AnyStencil

Report = Callable[[int], None]
"""Is given the number of rays done, now and then."""

Preparation = Callable[[Mapping[str, Tensor]], March]
"""From tensors by name to a march without bricks, by differentiable operations."""


def implementation_for(coefficients: Tensor) -> str:
    """What marches rays through these coefficients: "cpu" (vector code), or "cuda" (Triton) on a GPU."""
    return room_of(coefficients.device)


def missing(coefficients: Tensor, stencil: AnyStencil, start: int, dtype: torch.dtype, lights: int) -> str | None:
    """What keeps the march from running here as asked; None: nothing does.

    Args:
        coefficients: (D, H, W).
        stencil: value, and gradient when lit.
        start: the coordinate of coefficient 0.
        dtype: of the samples.
        lights: K.
    """
    if transforming():
        return "it has no transforms of torch.func"
    if lights > MAX_LIGHTS:
        return f"up to {MAX_LIGHTS} lights; got {lights}"
    points = torch.empty(1, 0, 3, dtype=dtype, device=coefficients.device)
    room = cuda if implementation_for(coefficients) == "cuda" else cpu
    return room.missing(coefficients.detach()[None, None], points, stencil, None, start)


def run(given: March, report: Report = lambda rays: None, implementation: str | None = None) -> tuple[Tensor, Tensor]:
    """Light (R, 3) and optical depth (R,), float64, without derivatives; by default on the device of the tensors."""
    return _driver(given, implementation).march(given, report)


def adjoint(
    given: March,
    light: Tensor,
    light_cotangent: Tensor,
    depth_cotangent: Tensor,
    wanted: Collection[str],
    report: Report = lambda rays: None,
    implementation: str | None = None,
) -> dict[str, Tensor]:
    """Derivatives of Σ light · its cotangent + Σ depth · its cotangent.

    Args:
        light: what `run` gave, (R, 3).
        light_cotangent, depth_cotangent: (R, 3) and (R,), float64.
        wanted: some of "coefficients", "rays", "table", "shading".
        report, implementation: as for `run`.

    Returns:
        by name of `March.tensors`, in their shapes: what `march_derivatives.MEMBERS` lists for all that is wanted.
        Float64 but for the coefficients' (the dtype of the march).
    """
    gradients = tuple(name for name in GRADIENTS if name in wanted)
    arrays = {"light": light, "light_cotangent": light_cotangent, "depth_cotangent": depth_cotangent}
    return _driver(given, implementation).adjoint(given, gradients, arrays, report)


def _driver(given: March, implementation: str | None) -> ModuleType:
    return driver(implementation or implementation_for(given.coefficients), "march")


def march(
    prepare: Preparation,
    tensors: Mapping[str, Tensor],
    bricks: Bricks | None,
    memory: int = reference.MEMORY,
    report: Report = lambda rays: None,
) -> tuple[Tensor, Tensor]:
    """Light (R, 3) and optical depth (R,), float64, of what is prepared from some tensors; differentiable in them.

    Args:
        prepare: see there.
        tensors: by name, whatever `prepare` wants.
        bricks: which parts of the volume are empty; None: not known.
        memory: bytes that samples of the plain twin may take, for derivatives of derivatives.
        report: as for `run`.
    """
    job = _Asked(prepare, tuple(tensors), bricks, memory, report)
    return _March.apply(job, *tensors.values())  # type: ignore[return-value]


@dataclass(frozen=True)
class _Asked:
    """What `march` was given, but for the tensors."""

    prepare: Preparation
    names: tuple[str, ...]
    bricks: Bricks | None
    memory: int
    report: Report

    def prepared(self, tensors: Sequence[Tensor]) -> March:
        return self.prepare(dict(zip(self.names, tensors, strict=True)))


class _March(torch.autograd.Function):
    """(what is asked, *tensors) -> (light, depth)."""

    @staticmethod
    def forward(ctx, asked: _Asked, *tensors: Tensor):
        light, depth = run(replace(asked.prepared(tensors), bricks=asked.bricks), asked.report)
        ctx.asked = asked
        ctx.save_for_backward(*tensors, light)
        return light, depth

    @staticmethod
    def backward(ctx, *cotangents: Tensor):
        *tensors, light = ctx.saved_tensors
        needed = ctx.needs_input_grad[1:]
        if torch.is_grad_enabled():
            found = _by_the_plain_twin(ctx.asked, tensors, needed, cotangents)
        else:
            found = _by_the_adjoint(ctx.asked, tensors, needed, light, cotangents)
        return None, *found


def _by_the_adjoint(
    asked: _Asked, tensors: Sequence[Tensor], needed: Sequence[bool], light: Tensor, cotangents: Sequence[Tensor]
) -> list[Tensor | None]:
    """By the fused adjoint, and from what was prepared for it back to the tensors by autograd."""
    with torch.enable_grad():  # within a backward pass, which puts the mode back whatever is raised
        leaves = [t.detach().requires_grad_(need) for t, need in zip(tensors, needed, strict=True)]
        given = asked.prepared(leaves)
    named = given.tensors
    wanted = {g for g, names in MEMBERS.items() if any(n in named and named[n].requires_grad for n in names)}
    if "table" not in wanted:  # where opacity is 0 it changes with the control points nevertheless
        given = replace(given, bricks=asked.bricks)
    to_light, to_depth = cotangents
    found = adjoint(given, light, to_light, to_depth, wanted)
    outputs = [name for name in found if named[name].requires_grad]
    back = torch.autograd.grad(
        [named[name] for name in outputs],
        [leaf for leaf in leaves if leaf.requires_grad],
        [found[name].to(named[name].dtype) for name in outputs],
        allow_unused=True,
    )
    return _in_place_of(needed, back)


def _by_the_plain_twin(
    asked: _Asked, tensors: Sequence[Tensor], needed: Sequence[bool], cotangents: Sequence[Tensor]
) -> list[Tensor | None]:
    """With a graph; in aliases of the tensors, as one may depend on another."""
    aliases = [t.view_as(t) for t in tensors]
    given = asked.prepared(aliases)
    fused = implementation_for(given.coefficients)
    outputs = reference.march(given, asked.memory, partial(gather, implementation=fused))
    inputs = [t for t, need in zip(aliases, needed, strict=True) if need]
    pairs = [(x, g) for x, g in zip(outputs, cotangents, strict=True) if x.requires_grad]  # lights change no depth
    results, gradients = zip(*pairs, strict=True)
    back = torch.autograd.grad(results, inputs, gradients, create_graph=True, allow_unused=True)
    return _in_place_of(needed, back)


def _in_place_of(needed: Sequence[bool], derivatives: Sequence[Tensor | None]) -> list[Tensor | None]:
    """The derivatives where they are needed, None elsewhere."""
    left = iter(derivatives)
    return [next(left) if need else None for need in needed]
