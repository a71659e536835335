"""Splines of heights in Triton: describes arrays to the programs of `ops.cuda.height_jets`, and launches them.

Same meaning as `ops.reference.heights`. Heights are read as they are stored, sums are in the points' type. splat adds
atomically, in whatever order the GPU comes by, and repeats itself up to rounding only.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from filterlab.ops.cuda import height_jets as programs
from filterlab.ops.cuda.launch import interpreting, launchable
from filterlab.ops.gather import readable
from filterlab.ops.heights import Heights, Pattern, Places, rows
from filterlab.volume import Boundary

BLOCK = 128  # points of one program, one for each of its threads
WARPS = BLOCK // 32


def jet(heights: Heights, points: Tensor, order: int) -> Tensor:
    """`ops.reference.heights.jet`, fused."""
    n, m = points.shape[:2]
    out = points.new_empty((n, len(rows(order)), m))
    if out.numel():
        values = heights.values.detach().resolve_neg()
        _launch("jet", heights, values if values.stride(-1) == 1 else values.contiguous(), points, out, order)
    return out


def splat(heights: Heights, points: Tensor, cotangents: Tensor, order: int) -> Tensor:
    """The adjoint of `jet` to the heights: rows (N, R, P) at points, added up in (N, H, W), in the points' type."""
    out = points.new_zeros(heights.values.shape)
    if cotangents.numel():
        _launch("splat", heights, out, points, readable(cotangents.to(points.dtype), 0), order)
    return out


def _launch(operation: str, heights: Heights, values: Tensor, points: Tensor, rows_: Tensor, order: int) -> None:
    """One launch: programs for all blocks of all grids."""
    points = readable(points, 1)
    entries, count = points.shape[:2]
    places = [Places.along(heights, axis, values.stride(-1 - axis)) for axis in (0, 1)]
    tables = [own.table.to(points.device) for own in places]
    step = [heights.pattern.steps * d for d in heights.spacing]
    numbers = [(heights.origin[k], step[k], places[k].low, places[k].high) for k in (0, 1)]
    frame = points.new_tensor(numbers, dtype=torch.float64).flatten()
    height, width = values.shape[-2:]
    sizes = (count, width, height, places[0].zero, places[1].zero, values.stride(0), points.stride(0))
    boundary = heights.boundary
    program = _program(operation, heights.pattern, order, boundary.periodic, boundary is Boundary.ZEROS, interpreting())
    with torch.cuda.device_of(points):  # Triton launches on the current device
        grid = (entries * -(-count // BLOCK),)
        program[grid](values, points, rows_, *tables, frame, *sizes, BLOCK=BLOCK, num_warps=WARPS)


@lru_cache(maxsize=256)
def _program(operation: str, pattern: Pattern, order: int, periodic: bool, zeros: bool, interpreted: bool) -> Any:
    write = {"jet": programs.jet, "splat": programs.splat}[operation]
    return launchable(write(pattern, order, periodic, zeros))
