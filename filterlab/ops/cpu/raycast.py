"""Casting rays as vector code: describes lattices and rays to the programs of `ops.cpu.crossings`.

Memory beyond the result: one byte for every brick; for candidates 24 + 1 bytes and n + 1 numbers for every ray and each
of the `capacity` that there is room for.
"""

from __future__ import annotations

import torch
from torch import Tensor

from filterlab.ops.cpu import compiler
from filterlab.ops.cpu import threads as pool
from filterlab.ops.cpu.crossings import JUMP, PACKS_OF_A_CHUNK, REPEATED, RaycastJob, RaycastVariant
from filterlab.ops.cpu.job import AXES
from filterlab.ops.cpu.machine import lanes_of
from filterlab.ops.cpu.memory import ARITHMETIC, has_room
from filterlab.ops.gather import STORAGE
from filterlab.ops.raycast import Candidates, Raycast, joined

_FEW = 4  # candidates of a ray at first; those with more are cast again
_NUMBERS_AT_ONCE = 1 << 24  # of candidates


def first(given: Raycast, origins: Tensor, directions: Tensor) -> Tensor:
    """`ops.reference.raycast.first`, fused: t (R,) float64 of rays (R, 3), without derivatives."""
    t = torch.full((len(origins),), torch.inf, dtype=torch.float64)
    if len(t):
        _Cast(given, "first", origins, directions).run(t=t)
    return t


def candidates(given: Raycast, origins: Tensor, directions: Tensor) -> Candidates:
    """`ops.reference.raycast.candidates`, fused."""
    parts, capacity, left = [], _FEW, torch.arange(len(origins))
    while len(left) or not parts:
        again = []
        for own in left.split(max(1, _NUMBERS_AT_ONCE // (capacity * (given.lattice.degree + 4)))):
            cast = _Cast(given, "candidates", origins[own], directions[own])
            count, part = cast.candidates(capacity, own)
            parts.append(part)
            again.append(own[count > capacity])
        left, capacity = torch.cat(again), 8 * capacity
    return joined(parts)


class _Cast:
    """A lattice and rays as a job."""

    def __init__(self, given: Raycast, asked: str, origins: Tensor, directions: Tensor) -> None:
        self.dtype, self.rays, self.degree = given.dtype, len(origins), given.lattice.degree
        coefficients = _readable(given.lattice.coefficients)
        self.function = compiler.compiled(_variant(given, asked, coefficients))
        self.job = _job(given, coefficients)
        self.job.rays = self.rays
        self.job.point(origins=origins.to(given.dtype).contiguous(), directions=directions.to(given.dtype).contiguous())

    def run(self, **results: Tensor) -> None:
        job = self.job
        job.point(**results)
        packs = -(-self.rays // lanes_of(self.dtype))
        job.next, job.chunks = 0, -(-packs // PACKS_OF_A_CHUNK)
        pool.run(self.function, [job] * max(1, min(torch.get_num_threads(), job.chunks)))

    def candidates(self, capacity: int, rays: Tensor) -> tuple[Tensor, Candidates]:
        """How many each ray has, and those of the rays that have no more than there is room for."""
        count = torch.zeros(self.rays, dtype=torch.int64)
        places = torch.empty(self.rays, capacity, 3, dtype=torch.float64)
        pieces = torch.empty(self.rays, capacity, self.degree + 1, dtype=self.dtype)
        flags = torch.empty(self.rays, capacity, dtype=torch.uint8)
        self.job.capacity = capacity
        self.run(count=count, places=places, pieces=pieces, flags=flags)
        written = torch.arange(capacity) < torch.where(count > capacity, 0, count)[:, None]
        flags, (start, near, far) = flags[written], places[written].unbind(-1)
        ray = rays[:, None].expand(-1, capacity)[written]
        return count, Candidates(ray, start, near, far, pieces[written], (flags & JUMP) > 0, (flags & REPEATED) > 0)


def _variant(given: Raycast, asked: str, coefficients: Tensor) -> RaycastVariant:
    lattice = given.lattice
    return RaycastVariant(
        asked,
        lattice.stencil.lowered,
        lattice.degree,
        lattice.continuous,
        ARITHMETIC[given.dtype],
        STORAGE[coefficients.dtype],
        has_room(coefficients),
        lanes_of(given.dtype),
    )


def _job(given: Raycast, coefficients: Tensor) -> RaycastJob:
    """With all but the rays."""
    lattice, (plane, row, _) = given.lattice, coefficients.stride()
    job = RaycastJob(
        width=row,
        height=plane // row,
        scale=lattice.scale,
        shift=lattice.shift - given.level,
        edge=given.edge.bit_length() - 1,
    )
    for axis, cells, bricks in zip(AXES, lattice.cells, given.clear.shape[::-1], strict=True):
        setattr(job, f"cells_{axis}", cells)
        setattr(job, f"bricks_{axis}", bricks)
    numbers = {
        "origin": given.geometry.origin,
        "matrix": given.geometry.inverse,
        "offset": lattice.offset,
        "lower": lattice.lower,
        "upper": lattice.upper,
    }
    arrays = {name: torch.tensor(x, dtype=torch.float64) for name, x in numbers.items()}
    job.point(coefficients=coefficients, clear=given.clear.contiguous(), **arrays)
    return job


def _readable(coefficients: Tensor) -> Tensor:
    """The same, in rows that lie together and planes of whole rows."""
    values = coefficients.detach().resolve_neg()
    plane, row, one = values.stride()
    whole = one == 1 and row > 0 and plane % max(row, 1) == 0
    return values if whole else values.contiguous()
