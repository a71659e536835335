"""Splines of heights as vector code: describes arrays to the programs of `ops.cpu.height_jets`, and runs them.

Same meaning as `ops.reference.heights`. Heights are read as they are stored, sums are in the points' type. The result
of jet does not depend on the number of threads, bit by bit; that of splat only on their number. Memory beyond the
results: 8 bytes for every row and column of the heights; of splat a copy of the result for every further thread.

Points that lie all over a large grid wait for memory. Their data are asked for ahead; where caches hold no part of it,
many points are sorted by tiles first (`ops.cpu.order`), in copies of a part of them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from torch import Tensor

from filterlab.ops.cpu import compiler
from filterlab.ops.cpu import threads as pool
from filterlab.ops.cpu.gather import FEWEST_SORTED, SPLAT_MEMORY
from filterlab.ops.cpu.height_jets import HeightsJob, HeightsVariant
from filterlab.ops.cpu.machine import CHUNKS_PER_THREAD, MOST_POINTS, lanes_of, threads_for
from filterlab.ops.cpu.memory import ARITHMETIC, fresh, zeros
from filterlab.ops.cpu.order import Bricks, in_order, scattered
from filterlab.ops.gather import STORAGE, readable
from filterlab.ops.heights import Heights, Places, rows
from filterlab.volume import Boundary

_POINTS_PER_THREAD = 2048  # fewer are not worth waking a thread for
_TILE = (256, 4)  # columns, rows by which points are sorted: rows of a grid may be apart by what caches keep together
_SMALLEST_SORTED_IN = 32 << 20  # bytes of a grid, times the rows in which a patch has its data
_NEAR = 16  # data: points that are farther from the one before are scattered


def jet(heights: Heights, points: Tensor, order: int) -> Tensor:
    """`ops.reference.heights.jet`, fused."""
    n, m = points.shape[:2]
    out = fresh((n, len(rows(order)), m), points.dtype)
    if not out.numel():
        return out
    values, points = _in_lines(heights.values), readable(points, 1)
    if not _sorting_pays(heights, values, points):
        _jet(heights, values, points, out, order)
        return out
    for entry, part, ordered in in_order(points, _tiles(heights)):
        own = fresh((1, out.shape[1], ordered.count), points.dtype)
        _jet(heights, values[entry : entry + 1], ordered.points[None], own, order)
        ordered.restore(own[0], out[entry, :, part])
    return out


def _jet(heights: Heights, values: Tensor, points: Tensor, out: Tensor, order: int) -> None:
    threads = threads_for(points.shape[0] * points.shape[1], _POINTS_PER_THREAD)
    job, run = _described("jet", heights, values, points, out, order, threads * CHUNKS_PER_THREAD)
    pool.run(run, [job] * threads)


def splat(heights: Heights, points: Tensor, cotangents: Tensor, order: int) -> Tensor:
    """The adjoint of `jet` to the heights: rows (N, R, P) at points, added up in (N, H, W), in the points' type.

    Each thread adds its share of the points into a result of its own; these are summed at the end.
    """
    n, m = points.shape[:2]
    shape = heights.values.shape
    out = zeros(shape, points.dtype)
    if not cotangents.numel():
        return out.contiguous()
    size = math.prod(shape)
    parts = min(threads_for(n * m, _POINTS_PER_THREAD), 1 + SPLAT_MEMORY // (size * points.element_size()))
    parts = max(1, min(parts, 8 * n * m // size))
    every = [out, *(zeros(shape, out.dtype) for _ in range(parts - 1))]
    points, cotangents = readable(points, 1), readable(cotangents.to(points.dtype), 0)
    if not _sorting_pays(heights, out, points):
        _splat(heights, every, points, cotangents, order)
    else:
        for entry, part, ordered in in_order(points, _tiles(heights)):
            own = fresh((1, cotangents.shape[1], ordered.count), points.dtype)
            ordered.arrange(cotangents[entry, :, part], own[0])
            _splat(heights, [grid[entry : entry + 1] for grid in every], ordered.points[None], own, order)
    for other in every[1:]:
        out += other
    return out.contiguous()


def _splat(heights: Heights, grids: Sequence[Tensor], points: Tensor, cotangents: Tensor, order: int) -> None:
    """An equal share of the points to every grid."""
    job, run = _described("splat", heights, grids[0], points, cotangents, order, len(grids))
    pool.run(run, [_share(job, own, part, len(grids)) for part, own in enumerate(grids)])


def _share(job: HeightsJob, values: Tensor, part: int, parts: int) -> HeightsJob:
    """Every part-th of the chunks, into values of its own."""
    own = job.copy(values=values)
    own.next, own.chunks = job.chunks * part // parts, job.chunks * (part + 1) // parts
    return own


def _in_lines(values: Tensor) -> Tensor:
    """(N, H, W) whose rows lie together, less than 2³¹ numbers apart."""
    values = values.detach().resolve_neg()
    return values if values.stride(-1) == 1 and 0 <= values.stride(-2) < 1 << 31 else values.contiguous()


def _described(
    operation: str,
    heights: Heights,
    values: Tensor,
    points: Tensor,
    rows_: Tensor,
    order: int,
    parts: int,
):
    """The job of all points, in at least so many chunks, and its program."""
    entries, count = points.shape[:2]
    pattern, boundary = heights.pattern, heights.boundary
    lanes = lanes_of(points.dtype)
    packs = -(-count // lanes)
    chunk = max(1, min(-(-packs // max(1, parts // entries)), MOST_POINTS // lanes))
    job = HeightsJob(next=0, count=count, entries=entries, chunk=chunk, chunks=entries * -(-packs // chunk))
    job.values_entry, job.points_entry, job.row_step = values.stride(0), points.stride(0), values.stride(-2)
    job.point(values=values, points=points, rows=rows_)
    for axis, name in enumerate(("column", "line")):
        n, letter = values.shape[-1 - axis], "xy"[axis]
        places = Places.along(heights, axis, values.stride(-1 - axis))
        job.point(**{name: places.table[places.zero :]})
        told = {"origin": heights.origin[axis], "step": pattern.steps * heights.spacing[axis], "size": n}
        for key, value in {**told, "low": places.low, "high": places.high}.items():
            setattr(job, f"{key}_{letter}", value)
    storage, zero = STORAGE[values.dtype], boundary is Boundary.ZEROS
    arithmetic = ARITHMETIC[points.dtype]
    variant = HeightsVariant(operation, pattern, order, boundary.periodic, zero, arithmetic, storage, lanes)
    return job, compiler.compiled(variant)


def _sorting_pays(heights: Heights, values: Tensor, points: Tensor) -> bool:
    """Whether sorting points (N, M, 2) costs less than it saves: many of them lie all over what no cache holds.

    Not for planes, whose data are asked for in time.
    """
    read = values[0].numel() * values.element_size() * heights.pattern.lines
    if points.shape[1] < FEWEST_SORTED or read < _SMALLEST_SORTED_IN or heights.pattern.degree == 1:
        return False
    return scattered(points, _NEAR * points.new_tensor(heights.spacing).abs())


def _tiles(heights: Heights) -> Bricks:
    return Bricks.of(heights.values.shape[:-3:-1], heights.origin, heights.spacing, _TILE)
