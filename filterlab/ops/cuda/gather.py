"""gather and scatter in Triton: describes the arrays to the programs of `ops.cuda.points`, and launches them.

Same meaning as `ops.reference.gather`, orders 0 … 3. Coefficients are read as they are stored, sums are in the points'
dtype. gather repeats itself bit by bit. scatter adds atomically, in whatever order the GPU comes by, and repeats itself
up to rounding only; under `torch.use_deterministic_algorithms` the reference takes its place.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from filterlab.ops.cuda import points as programs
from filterlab.ops.cuda.launch import interpreting, launchable
from filterlab.ops.gather import readable
from filterlab.ops.reference import gather as reference
from filterlab.ops.tetrahedra import AnyStencil

BLOCK = 128  # points of one program, one for each of its threads
WARPS = BLOCK // 32


def gather(coefficients: Tensor, points: Tensor, stencil: AnyStencil, start: int = 0) -> Tensor:
    """`ops.reference.gather`, fused. Nothing is copied but what is not contiguous within a channel or a batch entry."""
    n, c = coefficients.shape[:2]
    out = points.new_empty((n, c, len(stencil.rows), points.shape[1]))
    if out.numel():
        _launch("gather", readable(coefficients, 2), readable(points, 1), out, stencil, start)
    return out


def scatter(cotangents: Tensor, points: Tensor, stencil: AnyStencil, shape: Sequence[int], start: int = 0) -> Tensor:
    """`ops.reference.scatter`, fused; it is the reference where torch is told to be deterministic."""
    if torch.are_deterministic_algorithms_enabled():
        return reference.scatter(cotangents, points, stencil, shape, start)
    out = points.new_zeros((*cotangents.shape[:2], *shape))
    if cotangents.numel():
        _launch("scatter", out, readable(points, 1), readable(cotangents.to(points.dtype), 0), stencil, start)
    return out


def _launch(
    operation: str, coefficients: Tensor, points: Tensor, rows: Tensor, stencil: AnyStencil, start: int
) -> None:
    """One launch: programs for all blocks of all batch entries. `rows` (N, C, J, M) is contiguous."""
    entries, count = points.shape[:2]
    arguments = (coefficients, points, rows, count, *coefficients.shape[1:], start)
    strides = (coefficients.stride(0), coefficients.stride(1), points.stride(0))
    program = _program(operation, stencil, interpreting())
    with torch.cuda.device_of(points):  # Triton launches on the current device
        program[(entries * -(-count // BLOCK),)](*arguments, *strides, BLOCK=BLOCK, num_warps=WARPS)


@lru_cache(maxsize=1024)
def _program(operation: str, stencil: AnyStencil, interpreted: bool) -> Any:
    return launchable({"gather": programs.gather, "scatter": programs.scatter}[operation](stencil.lowered))
