"""Casting rays at splines of heights in Triton: describes grids and rays to `height_hulls` and `height_rays`.

Memory beyond the result: as on the CPU (`ops.cpu.height_hits`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from filterlab.ops.cuda import height_cells
from filterlab.ops.cuda.height_hulls import SIZES as SIZES_OF_HULLS
from filterlab.ops.cuda.height_hulls import HeightHullsVariant
from filterlab.ops.cuda.height_rays import ARRAYS, BLOCK, NUMBERS, SIZES, HeightRaysVariant
from filterlab.ops.cuda.launch import interpreting, launchable
from filterlab.ops.gather import in_whole_rows
from filterlab.ops.height_hits import DEGREE, Cell, HeightHits, Pyramid, data_of_windows, slack_of
from filterlab.ops.heights import Heights
from filterlab.ops.raycast import Candidates, Sheets, Written, written_in_parts
from filterlab.volume import Boundary


def pyramid(heights: Heights, cell: Cell) -> Pyramid:
    """`ops.reference.height_hits.pyramid`, fused."""
    found, arrays, sizes = Pyramid.room(heights, cell.finest), *_grid(heights, cell)
    blocks_y, blocks_x = found.sizes[0]
    sizes |= {"blocks_x": blocks_x, "blocks": blocks_x * blocks_y}
    slack = found.numbers.new_tensor(slack_of(heights, cell), dtype=torch.float64)
    program = _program(HeightHullsVariant(cell, heights.boundary is Boundary.ZEROS), interpreting())
    handed = [arrays[name] for name in height_cells.ARRAYS]
    with torch.cuda.device_of(found.numbers):  # Triton launches on the current device
        numbers = [sizes[name] for name in SIZES_OF_HULLS]
        program[(-(-sizes["blocks"] // BLOCK),)](*handed, found.numbers, slack, *numbers, BLOCK=BLOCK, num_warps=1)
    return found.complete()


def first(given: HeightHits, origins: Tensor, directions: Tensor) -> Tensor:
    """`ops.reference.height_hits.first`, fused."""
    return _first(given, "first", origins, directions)


def met(given: HeightHits, origins: Tensor, directions: Tensor) -> Tensor:
    """`ops.reference.height_hits.met`, fused: without the root search."""
    return _first(given, "met", origins, directions) < math.inf


def _first(given: HeightHits, asked: str, origins: Tensor, directions: Tensor) -> Tensor:
    t = origins.new_empty(len(origins), dtype=torch.float64)
    _cast(given, asked, origins, directions, {"t": t})
    return t


def sheets(given: HeightHits, origins: Tensor, directions: Tensor, asked: Sheets) -> Tensor:
    """`ops.reference.height_hits.sheets`, fused."""
    t, count = asked.room(origins.shape[:-1], origins.device)
    own = {"t": t, "count": count}
    _cast(given, "sheets", origins, directions, own, asked.count, asked.most, asked.extent)
    return asked.in_order(t, count)


def candidates(given: HeightHits, origins: Tensor, directions: Tensor) -> Candidates:
    """`ops.reference.height_hits.candidates`, fused."""

    def write(rays: Tensor, capacity: int) -> Written:
        written = Written.room(len(rays), capacity, DEGREE, torch.float64, rays.device)
        _cast(given, "candidates", origins[rays], directions[rays], written._asdict(), capacity)
        return written

    return written_in_parts(write, DEGREE, len(origins), origins.device)


def _cast(
    given: HeightHits,
    asked: str,
    origins: Tensor,
    directions: Tensor,
    own: Mapping[str, Tensor],
    capacity: int = 0,
    most: int = 0,
    extent: float = 0.0,
) -> None:
    """Run a program for all rays; `own` is what it writes, the rest as in `ops.cuda.height_rays`."""
    if not len(origins):
        return
    heights, pyramid = given.heights, given.pyramid
    arrays, sizes = _grid(heights, given.cell)
    sizes |= {"rays": len(origins), "highest": pyramid.top, "capacity": capacity, "most": most}
    whole = {name: origins.new_tensor(x, dtype=torch.int64) for name, x in _levels(pyramid).items()}
    rays = {"origins": origins, "directions": directions, "numbers": _numbers(given, extent).to(origins.device)}
    arrays |= {"bounds": pyramid.numbers, **whole, **rays, **own}
    variant = HeightRaysVariant(asked, given.cell, heights.boundary is Boundary.ZEROS)
    program = _program(variant, interpreting())
    handed = [arrays[name].detach().resolve_neg() for name in (*ARRAYS, *variant.own)]
    handed = [handed[0], *(array.contiguous() for array in handed[1:])]  # of heights rows may be apart
    with torch.cuda.device_of(origins):  # Triton launches on the current device
        numbers = [sizes[name] for name in SIZES]
        program[(-(-len(origins) // BLOCK),)](*handed, *numbers, BLOCK=BLOCK, num_warps=1)


def _levels(pyramid: Pyramid) -> dict[str, list[int]]:
    return {"starts": list(pyramid.starts[:-1]), "widths": [width for _, width in pyramid.sizes]}


def _numbers(given: HeightHits, extent: float) -> Tensor:
    heights, (end_x, end_y), (low_z, high_z) = given.heights, given.domain, given.pyramid.range
    numbers = {"end_x": end_x, "end_y": end_y, "low_z": low_z, "high_z": high_z, "extent": extent}
    for a, origin, spacing in zip("xy", heights.origin, heights.spacing, strict=True):
        numbers |= {f"shift_{a}": origin, f"spacing_{a}": given.cell.steps * spacing}
    return torch.tensor([numbers[name] for name in NUMBERS], dtype=torch.float64)


def _grid(heights: Heights, cell: Cell) -> tuple[dict[str, Tensor], dict[str, int]]:
    """Arrays and sizes of heights."""
    (values,) = in_whole_rows(heights.values)
    columns, rows = (data_of_windows(heights, cell, axis).to(values.device) for axis in range(2))
    cells_x, cells_y = heights.cells
    sizes = {"width": values.stride(0), "cells_x": cells_x, "cells_y": cells_y}
    return {"values": values, "lines": rows, "columns": columns}, sizes


@lru_cache(maxsize=256)
def _program(variant: HeightHullsVariant | HeightRaysVariant, interpreted: bool) -> Any:
    return launchable(variant.write())
