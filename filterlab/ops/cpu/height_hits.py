"""Casting rays at splines of heights as vector code: describes grids and rays to `height_hulls` and `height_rays`.

Memory beyond the result: 8 bytes for every row and column of the data; for sheets 8 bytes for every ray, and as much as
the result once or twice more for the farthest; for candidates 25 + 40 bytes for every ray and
each of the `capacity` that there is room for.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import torch
from torch import Tensor

from filterlab.ops.cpu import compiler
from filterlab.ops.cpu import threads as pool
from filterlab.ops.cpu.height_hulls import HeightHullsJob, HeightHullsVariant
from filterlab.ops.cpu.height_rays import LANES, PACKS_OF_A_CHUNK, HeightRaysJob, HeightRaysVariant
from filterlab.ops.cpu.job import Job
from filterlab.ops.cpu.memory import ARITHMETIC, fresh
from filterlab.ops.gather import STORAGE, in_whole_rows
from filterlab.ops.height_hits import DEGREE, Cell, HeightHits, Pyramid, data_of_windows, slack_of
from filterlab.ops.heights import Heights
from filterlab.ops.raycast import Candidates, Sheets, Written, written_in_parts


def pyramid(heights: Heights, cell: Cell) -> Pyramid:
    """`ops.reference.height_hits.pyramid`, fused; on huge pages, since rays read it here and there."""
    found = Pyramid.room(heights, cell.finest, fresh)
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
    return _first(given, "first", origins, directions)


def met(given: HeightHits, origins: Tensor, directions: Tensor) -> Tensor:
    """`ops.reference.height_hits.met`, fused: without the root search."""
    return _first(given, "met", origins, directions) < math.inf


def _first(given: HeightHits, asked: str, origins: Tensor, directions: Tensor) -> Tensor:
    """t (R,) float64 of first hits; of "met" any where there is one."""
    t = torch.empty(-(-len(origins) // LANES) * LANES, dtype=torch.float64)
    _cast(given, asked, origins, directions, {}, t=t)
    return t[: len(origins)]


def sheets(given: HeightHits, origins: Tensor, directions: Tensor, asked: Sheets) -> Tensor:
    """`ops.reference.height_hits.sheets`, fused."""
    t, count = asked.room(origins.shape[:-1], origins.device)
    own = {"sheets": asked.count, "most": asked.most, "extent": asked.extent}
    _cast(given, "sheets", origins, directions, own, t=t, count=count)
    return asked.in_order(t, count)


def candidates(given: HeightHits, origins: Tensor, directions: Tensor) -> Candidates:
    """`ops.reference.height_hits.candidates`, fused."""

    def write(rays: Tensor, capacity: int) -> Written:
        written = Written.room(len(rays), capacity, DEGREE, torch.float64, rays.device)
        _cast(given, "candidates", origins[rays], directions[rays], {"capacity": capacity}, **written._asdict())
        return written

    return written_in_parts(write, DEGREE, len(origins), origins.device)


def _cast(
    given: HeightHits,
    asked: str,
    origins: Tensor,
    directions: Tensor,
    own: Mapping[str, float],
    **results: Tensor,
) -> None:
    """Run a program for all rays; `own` are fields of its job, `results` what it writes."""
    if not len(origins):
        return
    heights, pyramid = given.heights, given.pyramid
    job = HeightRaysJob(rays=len(origins), top=pyramid.top, **own)
    job.cells_x, job.cells_y = heights.cells
    job.shift_x, job.shift_y = heights.origin
    job.spacing_x, job.spacing_y = (given.cell.steps * d for d in heights.spacing)
    (job.end_x, job.end_y), (job.low_z, job.high_z) = given.domain, pyramid.range
    job.chunks = -(-len(origins) // (LANES * PACKS_OF_A_CHUNK))
    starts, widths = (torch.tensor(x) for x in (pyramid.starts, [w for _, w in pyramid.sizes]))
    dtype = torch.promote_types(origins.dtype, directions.dtype)
    rays = {"origins": origins.to(dtype).contiguous(), "directions": directions.to(dtype).contiguous()}
    job.point(bounds=pyramid.numbers, starts=starts, widths=widths, **rays, **results)
    _point_to(job, heights, given.cell)
    _run(HeightRaysVariant(asked, given.cell, STORAGE[heights.values.dtype], ARITHMETIC[dtype]), job)


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
