"""Casting rays at a level in Triton: describes lattices and rays to the programs of `ops.cuda.crossings`.

Memory beyond the result: as on the CPU (`ops.cpu.raycast`).
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from filterlab.ops.cuda.cells import BLOCK
from filterlab.ops.cuda.crossings import ARRAYS, NUMBERS, SIZES, RaycastVariant
from filterlab.ops.cuda.launch import interpreting, launchable
from filterlab.ops.cuda.taps import AXES
from filterlab.ops.gather import in_whole_rows
from filterlab.ops.raycast import Candidates, Raycast, Sheets, Written, written_in_parts


def first(given: Raycast, origins: Tensor, directions: Tensor) -> Tensor:
    """`ops.reference.raycast.first`, fused: t (...) float64 of rays (..., 3), without derivatives."""
    t = torch.empty(origins.shape[:-1], dtype=torch.float64, device=origins.device)
    _cast(given, "first", origins.reshape(-1, 3), directions.reshape(-1, 3), {"t": t})
    return t


def sheets(given: Raycast, origins: Tensor, directions: Tensor, asked: Sheets) -> Tensor:
    """`ops.reference.raycast.sheets`, fused: t (..., k) float64 of rays (..., 3), without derivatives."""
    t, count = asked.room(origins.shape[:-1], origins.device)
    rays, own = (origins.reshape(-1, 3), directions.reshape(-1, 3)), {"t": t, "count": count}
    _cast(given, "sheets", *rays, own, asked.count, asked.most, asked.extent)
    return asked.in_order(t, count)


def candidates(given: Raycast, origins: Tensor, directions: Tensor) -> Candidates:
    """`ops.reference.raycast.candidates`, fused."""

    def write(rays: Tensor, capacity: int) -> Written:
        written = Written.room(len(rays), capacity, given.lattice.degree, given.dtype, origins.device)
        _cast(given, "candidates", origins[rays], directions[rays], written._asdict(), capacity)
        return written

    return written_in_parts(write, given.lattice.degree, len(origins), origins.device)


def _cast(
    given: Raycast,
    asked: str,
    origins: Tensor,
    directions: Tensor,
    own: Mapping[str, Tensor],
    capacity: int = 0,
    most: int = 0,
    extent: float = 0.0,
) -> None:
    """Run a program for all rays; `own` is what it writes, the rest as in `ops.cuda.crossings`."""
    if not len(origins):
        return
    lattice = given.lattice
    arithmetic = str(given.dtype).removeprefix("torch.")
    variant = RaycastVariant(asked, lattice.stencil.lowered, lattice.degree, lattice.continuous, arithmetic)
    rays = {"origins": origins.to(given.dtype), "directions": directions.to(given.dtype)}
    arrays = {**rays, "marks": given.marks, "numbers": _numbers(given, extent), **own}
    coefficients = in_whole_rows(lattice.coefficients)
    handed = [arrays[name].detach().resolve_neg().contiguous() for name in (*ARRAYS[1:], *variant.own)]
    sizes = {**_sizes(given, coefficients), "rays": len(origins), "capacity": capacity, "most": most}
    program = _program(variant, interpreting())
    with torch.cuda.device_of(coefficients):  # Triton launches on the current device
        arguments = (coefficients, *handed, *(sizes[name] for name in SIZES))
        program[(-(-len(origins) // BLOCK),)](*arguments, BLOCK=BLOCK, num_warps=1)


def _numbers(given: Raycast, extent: float) -> Tensor:
    lattice, geometry = given.lattice, given.geometry
    triples = {"origin": geometry.origin, "offset": lattice.offset, "lower": lattice.lower, "upper": lattice.upper}
    numbers = {f"{name}_{a}": x for name, triple in triples.items() for a, x in zip(AXES, triple, strict=True)}
    numbers |= {f"matrix_{i}{k}": x for i, row in enumerate(geometry.inverse) for k, x in enumerate(row)}
    numbers |= {"infinity": torch.inf, "gain": lattice.scale, "shift": lattice.shift - given.level, "extent": extent}
    ordered = [float(numbers[name]) for name in NUMBERS]
    return torch.tensor(ordered, dtype=torch.float64, device=lattice.coefficients.device)


def _sizes(given: Raycast, coefficients: Tensor) -> dict[str, int]:
    plane, row, _ = coefficients.stride()
    numbers = {"width": row, "height": plane // row, "edge": given.edge.bit_length() - 1}
    numbers |= {f"cells_{a}": n for a, n in zip(AXES, given.lattice.cells, strict=True)}
    return numbers | {f"bricks_{a}": n for a, n in zip(AXES, given.marks.shape[::-1], strict=True)}


@lru_cache(maxsize=256)
def _program(variant: RaycastVariant, interpreted: bool) -> Any:
    return launchable(variant.write())
