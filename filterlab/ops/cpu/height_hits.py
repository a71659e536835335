"""Casting rays at splines of heights as vector code: describes grids and rays to `height_hulls` and `height_rays`.

Memory beyond the result: 72 bytes for every ray of a part, at most `RAYS_AT_ONCE` of them; 8 bytes for every row and
column of the data.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from filterlab.ops.cpu import compiler
from filterlab.ops.cpu import threads as pool
from filterlab.ops.cpu.height_hulls import HeightHullsJob, HeightHullsVariant
from filterlab.ops.cpu.height_rays import LANES, PACKS_OF_A_CHUNK, HeightRaysJob, HeightRaysVariant
from filterlab.ops.cpu.job import Job
from filterlab.ops.gather import STORAGE, in_whole_rows
from filterlab.ops.height_hits import DEGREE, Cell, HeightHits, Pyramid, data_of_windows, slack_of
from filterlab.ops.heights import Heights
from filterlab.ops.raycast import Candidates, Written, written_in_parts
from filterlab.ops.reference.height_hits import entered
from filterlab.ops.reference.pieces import Lines

RAYS_AT_ONCE = 1 << 18


def pyramid(heights: Heights, cell: Cell) -> Pyramid:
    """`ops.reference.height_hits.pyramid`, fused."""
    found = Pyramid.room(heights, cell.finest)
    columns, rows = heights.cells
    blocks_y, blocks_x = found.sizes[0]
    job = HeightHullsJob(cells_x=columns, cells_y=rows, blocks_x=blocks_x, chunks=blocks_y)
    job.slack = slack_of(heights, cell)
    job.point(bounds=found.numbers)
    _point_to(job, heights, cell)
    _run(HeightHullsVariant(cell, STORAGE[heights.values.dtype]), job)
    return found.complete()


def first(given: HeightHits, origins: Tensor, directions: Tensor) -> Tensor:
    """`ops.reference.height_hits.first`, fused."""
    return _in_parts(given, "first", origins, directions)


def met(given: HeightHits, origins: Tensor, directions: Tensor) -> Tensor:
    """`ops.reference.height_hits.met`, fused: without the root search."""
    return _in_parts(given, "met", origins, directions) < math.inf


def _in_parts(given: HeightHits, asked: str, origins: Tensor, directions: Tensor) -> Tensor:
    """t (R,) float64 of first hits; of "met" any where there is one."""
    t = torch.full((len(origins),), math.inf, dtype=torch.float64)
    parts = zip(*(x.split(RAYS_AT_ONCE) for x in (t, origins, directions)), strict=True)
    for own, o, d in parts:
        lines = entered(given, o, d)
        s = torch.empty(-(-len(lines.ray) // LANES) * LANES, dtype=torch.float64)
        _cast(given, asked, lines.lines, s=s)
        own[lines.ray] = lines.t(s[: len(lines.ray)])
    return t


def candidates(given: HeightHits, origins: Tensor, directions: Tensor) -> Candidates:
    """`ops.reference.height_hits.candidates`, fused."""

    def write(rays: Tensor, capacity: int) -> Written:
        own = lines.lines.chosen(rays)
        written = Written.room(len(rays), capacity, DEGREE, torch.float64, rays.device)
        _cast(given, "candidates", own, capacity=capacity, **written._asdict())
        return written

    lines = entered(given, origins, directions)
    found = written_in_parts(write, DEGREE, len(lines.ray), origins.device)
    start, length = lines.start[found.ray], lines.length[found.ray]
    places = length * start, length * found.near, length * found.far
    return Candidates(lines.ray[found.ray], *places, *found[4:])


def _cast(given: HeightHits, asked: str, lines: Lines, capacity: int = 0, **results: Tensor) -> None:
    if not len(lines.near):
        return
    job, pyramid = HeightRaysJob(lines=len(lines.near), capacity=capacity, top=given.pyramid.top), given.pyramid
    job.cells_x, job.cells_y = given.heights.cells
    job.chunks = -(-len(lines.near) // (LANES * PACKS_OF_A_CHUNK))
    starts, widths = (torch.tensor(x) for x in (pyramid.starts, [w for _, w in pyramid.sizes]))
    rays = {
        name: x.contiguous() for name, x in zip(("origins", "directions", "far"), (*lines[:2], lines.far), strict=True)
    }
    job.point(bounds=pyramid.numbers, starts=starts, widths=widths, **rays, **results)
    _point_to(job, given.heights, given.cell)
    _run(HeightRaysVariant(asked, given.cell, STORAGE[given.heights.values.dtype]), job)


def _point_to(job: Job, heights: Heights, cell: Cell) -> None:
    """The grid."""
    (values,) = in_whole_rows(heights.values)
    job.height, job.width = values.shape  # type: ignore[attr-defined]
    job.row = values.stride(0)  # type: ignore[attr-defined]
    columns, rows = (data_of_windows(heights, cell, axis) for axis in range(2))
    job.reach = len(columns)  # type: ignore[attr-defined]
    job.point(values=values, rows=rows, columns=columns)


def _run(variant: compiler.Variant, job: Job) -> None:
    pool.run(compiler.compiled(variant), [job] * max(1, min(torch.get_num_threads(), job.chunks)))
