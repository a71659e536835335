"""The march and its adjoint in Triton: describes rays and tables to their programs, and launches those.

Memory beyond the result: as on the CPU (`ops.cpu.march`), but one volume of derivatives by the coefficients, and 6 KiB
per interval of the transfer function.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from filterlab.ops.cuda import adjoint as backward
from filterlab.ops.cuda import compositing, segments
from filterlab.ops.cuda.launch import interpreting, launchable
from filterlab.ops.cuda.segments import RayVariant, arrays_of
from filterlab.ops.march import March, Steps
from filterlab.ops.march_derivatives import TABLE_ROW, by_name, columns_of_rays

Report = Callable[[int], None]


def march(given: March, report: Report = lambda rays: None) -> tuple[Tensor, Tensor]:
    """`ops.reference.march.march`, fused, without derivatives: light (R, 3) and optical depth (R,), float64."""
    rays = len(given.chords.count)
    light, depth = _zeros(given, rays, 3), _zeros(given, rays)
    if rays:
        even = given.transfer.even is not None
        variant = compositing.MarchVariant(given.stencil.lowered, given.lights, given.bricks is not None, even)
        _launch(variant, given, {"light": light, "optical_depth": depth})
        report(rays)
    return light, depth


def adjoint(
    given: March, gradients: tuple[str, ...], arrays: Mapping[str, Tensor], report: Report = lambda rays: None
) -> dict[str, Tensor]:
    """Derivatives of Σ light · its cotangent + Σ depth · its cotangent; see `ops.differentiable.march.adjoint`.

    Those by coefficients and table are added atomically, and repeat themselves up to rounding only.

    Args:
        gradients: of `ops.march_derivatives.GRADIENTS`.
        arrays: light, light_cotangent, depth_cotangent.
    """
    rays, points = len(given.chords.count), len(given.transfer.positions)
    volume = _zeros(given, *given.coefficients.shape, dtype=given.dtype) if "coefficients" in gradients else None
    tables = _zeros(given, backward.TABLES, max(points - 1, 1), TABLE_ROW)
    by_ray = _zeros(given, rays, columns_of_rays(given.lights))
    if rays and gradients:
        targets = {"coefficient_gradient": volume, "table_gradient": tables, "ray_gradient": by_ray}
        written = {name: target for name, target in targets.items() if target is not None}
        _launch(_variant_of_adjoint(given, gradients), given, {**arrays, **written})
        report(rays)
    return by_name(gradients, volume, by_ray, tables.sum(0), points, given.lights)


def _variant_of_adjoint(given: March, gradients: tuple[str, ...]) -> backward.AdjointVariant:
    raised = given.stencil.derivatives if "rays" in gradients else None
    derivatives = None if raised is None else (raised[0].lowered, raised[1])
    skipping, even = given.bricks is not None, given.transfer.even is not None
    return backward.AdjointVariant(
        gradients, given.stencil.lowered, derivatives, given.lights, skipping, even, backward.TABLES
    )


def _zeros(given: March, *shape: int, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.zeros(shape, dtype=dtype, device=given.coefficients.device)


def _launch(variant: RayVariant, given: March, own: Mapping[str, Tensor]) -> None:
    """Run the program for all rays of a march.

    Args:
        own: the arrays of `variant.own`; contiguous where they are written.
    """
    arrays = {"coefficients": given.coefficients, **given.inputs, "numbers": _numbers(given), **own}
    handed = [arrays[name].detach().resolve_neg().contiguous() for name in arrays_of(variant)]
    programs = -(-len(given.chords.count) // segments.BLOCK)
    with torch.cuda.device_of(handed[0]):  # Triton launches on the current device
        _program(variant, interpreting())[(programs,)](*handed, *_sizes(given), BLOCK=segments.BLOCK, num_warps=1)


def _numbers(given: March) -> Tensor:
    """In the order of `segments.NUMBERS`."""
    steps = given.transfer.even or Steps(0.0, 0.0, 1)
    of_steps = (steps.low, steps.scale, steps.count - 1)
    numbers = (given.step, 1 / given.transfer.unit, given.opaque, given.slack, math.inf, *of_steps)
    return torch.tensor(numbers, dtype=torch.float64, device=given.coefficients.device)


def _sizes(given: March) -> tuple[int, ...]:
    """In the order of `segments.SIZES`."""
    bricks = (0, 0, 0) if given.bricks is None else given.bricks.distance.shape
    edge = given.bricks.edge if given.bricks else 0
    inner = max(len(given.transfer.positions) - 2, 0)  # control points between the first and the last
    shape = given.coefficients.shape
    return len(given.chords.count), *shape, given.start, inner.bit_length(), inner, bricks[1], bricks[2], edge


@lru_cache(maxsize=256)
def _program(variant: RayVariant, interpreted: bool) -> Any:
    return launchable(variant.write())
