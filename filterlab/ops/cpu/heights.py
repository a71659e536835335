"""Splines of heights as vector code: describes arrays to the programs of `ops.cpu.height_jets`, and runs them.

Same meaning as `ops.reference.heights`. Heights are read as they are stored, sums are in the points' type. The result
of jet does not depend on the number of threads, bit by bit; that of splat only on their number. Memory beyond the
results: 8 bytes for every row and column of the heights; of splat a copy of the result for every further thread.
"""

from __future__ import annotations

import math

from torch import Tensor

from filterlab.ops.cpu import compiler
from filterlab.ops.cpu import threads as pool
from filterlab.ops.cpu.gather import SPLAT_MEMORY
from filterlab.ops.cpu.height_jets import HeightsJob, HeightsVariant
from filterlab.ops.cpu.machine import CHUNKS_PER_THREAD, MOST_POINTS, lanes_of, threads_for
from filterlab.ops.cpu.memory import ARITHMETIC, fresh, zeros
from filterlab.ops.gather import STORAGE, readable
from filterlab.ops.heights import Heights, Places, rows
from filterlab.volume import Boundary

_POINTS_PER_THREAD = 2048  # fewer are not worth waking a thread for


def jet(heights: Heights, points: Tensor, order: int) -> Tensor:
    """`ops.reference.heights.jet`, fused."""
    n, m = points.shape[:2]
    out = fresh((n, len(rows(order)), m), points.dtype)
    if out.numel():
        values, points = _in_lines(heights.values), readable(points, 1)
        threads = threads_for(n * m, _POINTS_PER_THREAD)
        job, run = _described("jet", heights, values, points, out, order, threads * CHUNKS_PER_THREAD)
        pool.run(run, [job] * threads)
    return out


def splat(heights: Heights, points: Tensor, cotangents: Tensor, order: int) -> Tensor:
    """The adjoint of `jet` to the heights: rows (N, R, P) at points, added up in (N, H, W), in the points' type.

    Each thread adds its share of the points into a result of its own; these are summed at the end.
    """
    n, m = points.shape[:2]
    shape = heights.values.shape
    out = zeros(shape, points.dtype)
    if cotangents.numel():
        size = math.prod(shape)
        parts = min(threads_for(n * m, _POINTS_PER_THREAD), 1 + SPLAT_MEMORY // (size * points.element_size()))
        parts = max(1, min(parts, 8 * n * m // size))
        every = [out, *(zeros(shape, out.dtype) for _ in range(parts - 1))]
        points, cotangents = readable(points, 1), readable(cotangents.to(points.dtype), 0)
        job, run = _described("splat", heights, out, points, cotangents, order, parts)
        pool.run(run, [_share(job, own, part, parts) for part, own in enumerate(every)])
        for other in every[1:]:
            out += other
    return out.contiguous()


def _share(job: HeightsJob, values: Tensor, part: int, parts: int) -> HeightsJob:
    """Every part-th of the chunks, into values of its own."""
    own = job.copy(values=values)
    own.next, own.chunks = job.chunks * part // parts, job.chunks * (part + 1) // parts
    return own


def _in_lines(values: Tensor) -> Tensor:
    """(N, H, W) whose rows lie together."""
    values = values.detach().resolve_neg()
    return values if values.stride(-1) == 1 and values.stride(-2) >= 0 else values.contiguous()


def _described(operation: str, heights: Heights, values: Tensor, points: Tensor, rows_: Tensor, order: int, parts: int):
    """The job of all points, in at least so many chunks, and its program."""
    entries, count = points.shape[:2]
    pattern, boundary = heights.pattern, heights.boundary
    lanes = lanes_of(points.dtype)
    packs = -(-count // lanes)
    chunk = max(1, min(-(-packs // max(1, parts // entries)), MOST_POINTS // lanes))
    job = HeightsJob(next=0, count=count, entries=entries, chunk=chunk, chunks=entries * -(-packs // chunk))
    job.values_entry, job.points_entry = values.stride(0), points.stride(0)
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
