"""Casting rays as vector code: describes lattices and rays to the programs of `ops.cpu.crossings`.

Memory beyond the result: two bytes for every brick; for sheets 8 bytes for every ray, and as much as the result once or
twice more for the farthest; for candidates 24 + 1 bytes and n + 1 numbers for every ray and each of the `capacity` that
there is room for.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from filterlab.ops.cpu import compiler
from filterlab.ops.cpu import threads as pool
from filterlab.ops.cpu.clear_bricks import WORD, ClearBricksJob, ClearBricksVariant
from filterlab.ops.cpu.crossings import PACKS_OF_A_CHUNK, RaycastJob, RaycastVariant
from filterlab.ops.cpu.job import AXES
from filterlab.ops.cpu.machine import lanes_of
from filterlab.ops.cpu.memory import ARITHMETIC, has_room
from filterlab.ops.gather import STORAGE, in_whole_rows
from filterlab.ops.raycast import RADII, Candidates, Raycast, Sheets, Written, written_in_parts

_WASTED = 17 / 16  # places for rays in packs of two rows, over rays: more would take back most of what is gained


def first(given: Raycast, origins: Tensor, directions: Tensor) -> Tensor:
    """`ops.reference.raycast.first`, fused: t (...) float64 of rays (..., 3), without derivatives."""
    t = torch.empty(origins.shape[:-1], dtype=torch.float64)
    if t.numel():
        _Cast(given, "first", origins, directions).run(t=t)
    return t


def sheets(given: Raycast, origins: Tensor, directions: Tensor, asked: Sheets) -> Tensor:
    """`ops.reference.raycast.sheets`, fused: t (..., k) float64 of rays (..., 3), without derivatives."""
    t, count = asked.room(origins.shape[:-1], origins.device)
    if t.numel():
        cast = _Cast(given, "sheets", origins, directions)
        cast.job.sheets, cast.job.most, cast.job.extent = asked.count, asked.most, asked.extent
        cast.run(t=t, count=count)
    return asked.in_order(t, count)


def candidates(given: Raycast, origins: Tensor, directions: Tensor) -> Candidates:
    """`ops.reference.raycast.candidates`, fused."""

    def write(rays: Tensor, capacity: int) -> Written:
        written = Written.room(len(rays), capacity, given.lattice.degree, given.dtype, origins.device)
        if not len(rays):
            return written
        cast = _Cast(given, "candidates", origins[rays], directions[rays])
        cast.job.capacity = capacity
        cast.run(**written._asdict())
        return written

    return written_in_parts(write, given.lattice.degree, len(origins), origins.device)


def marks_of_bits(bits: Tensor) -> Tensor:
    """`ops.raycast.marks_of_bits`, by a program; memory: 11 bits for every brick."""
    planes, rows, columns = bits.shape
    words = -(-columns // WORD)
    padded = np.pad(bits.numpy(), ((0, 0), (0, 0), (0, words * WORD - columns)))
    near = np.zeros((RADII[-1] + 1, planes + 2, rows + 2, words + 1), np.uint64)
    near[0, 1:-1, 1:-1, :-1] = np.packbits(padded > 0, axis=-1, bitorder="little").view(np.uint64)
    between = np.zeros((2, *near.shape[1:]), np.uint64)
    marks = np.empty(padded.shape, np.int16)
    job = ClearBricksJob(planes=planes, rows=rows, words=words, chunks=1)
    job.point(near=near, along_x=between[0], along_y=between[1], bits=padded, marks=marks)
    pool.run(compiler.compiled(ClearBricksVariant(RADII[-1])), [job])
    return torch.from_numpy(np.ascontiguousarray(marks[..., :columns]))


class _Cast:
    """A lattice and rays as a job."""

    def __init__(self, given: Raycast, asked: str, origins: Tensor, directions: Tensor) -> None:
        coefficients = in_whole_rows(given.lattice.coefficients)
        self.function = compiler.compiled(_variant(given, asked, coefficients))
        self.job = _job(given, coefficients)
        self.job.rows, self.job.columns, self.job.packs, self.job.wide = _in_packs(origins.shape[:-1], given.dtype)
        self.job.point(origins=origins.to(given.dtype).contiguous(), directions=directions.to(given.dtype).contiguous())

    def run(self, **results: Tensor) -> None:
        job = self.job
        job.point(**results)
        job.next, job.chunks = 0, -(-job.packs // PACKS_OF_A_CHUNK)
        pool.run(self.function, [job] * max(1, min(torch.get_num_threads(), job.chunks)))


def _in_packs(shape: torch.Size, dtype: torch.dtype) -> tuple[int, int, int, int]:
    """Rows, columns, packs of rays of a shape, and log₂ of a pack's width: see `ops.cpu.crossings`."""
    rays, lanes = shape.numel(), lanes_of(dtype)
    columns = shape[-1] if shape else 1
    rows, wide = rays // columns, lanes // 2
    packs = -(-rows // 2) * -(-columns // wide)
    if packs * lanes > _WASTED * rays:
        rows, columns, wide, packs = 1, rays, lanes, -(-rays // lanes)
    return rows, columns, packs, wide.bit_length() - 1


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
        margin=given.margin,
        edge=given.edge.bit_length() - 1,
    )
    for axis, cells, bricks in zip(AXES, lattice.cells, given.marks.shape[::-1], strict=True):
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
    if given.off_trend is not None:
        arrays["off_trend"] = given.off_trend.contiguous()
    job.point(coefficients=coefficients, marks=given.marks.contiguous(), **arrays)
    return job
