"""place as vector code: describes the arrays to the program of `ops.cpu.folding`, and runs it."""

from __future__ import annotations

import torch
from torch import Tensor

from filterlab.ops.cpu import compiler
from filterlab.ops.cpu import threads as pool
from filterlab.ops.cpu.folding import LOST, TURNED, FoldingJob, FoldingVariant
from filterlab.ops.cpu.job import AXES, Function
from filterlab.ops.cpu.machine import CHUNKS_PER_THREAD, MOST_POINTS, lanes_of, threads_for
from filterlab.ops.cpu.memory import ARITHMETIC, fresh
from filterlab.ops.gather import readable
from filterlab.ops.place import Placed, Placement
from filterlab.ops.reference import place as reference
from filterlab.volume import Boundary

_POINTS_PER_THREAD = 4096  # fewer are not worth waking a thread for


def place(points: Tensor, placement: Placement) -> Placed:
    """`ops.place`, fused: (located, sign); sign None where it is 1 everywhere."""
    return Placing(placement, points.dtype)(points)


class Placing:
    """Points of one dtype to where a placement tells: what no point changes is settled once."""

    def __init__(self, placement: Placement, dtype: torch.dtype) -> None:
        self.dtype, self.lanes = dtype, lanes_of(dtype)
        self.placement = placement
        self.job = _job(placement)
        self.run = self._program()

    def _program(self) -> Function:
        geometry, boundary = self.placement.geometry, self.placement.boundary
        x, y, z = (_how_it_folds(boundary, n) for n in self.placement.size)
        affine = "identity" if geometry.is_identity else "full" if geometry.diagonal is None else "diagonal"
        return compiler.compiled(FoldingVariant((x, y, z), affine, ARITHMETIC[self.dtype], self.lanes))

    def __call__(self, points: Tensor) -> Placed:
        """(..., 3) to (located, sign)."""
        located, sign = fresh(points.shape, self.dtype), None
        if points.numel() == 0:
            return located, None
        jobs = self.shared(points, located=located)
        pool.run(self.run, jobs)
        met = jobs[0].met
        if met & TURNED:
            sign = fresh(points.shape, self.dtype)
            pool.run(self.run, self.shared(points, located=located, signs=sign))
        return self._with_lost(points, located, sign) if met & LOST else (located, sign)

    def shared(self, points: Tensor, **written: Tensor) -> list[FoldingJob]:
        """A job for every thread: all share the points, chunk by chunk. One reads in `met` what there was."""
        points = readable(points, 0)
        count = points.numel() // 3
        threads = threads_for(count, _POINTS_PER_THREAD)
        packs = -(-count // self.lanes)
        chunk = min(-(-packs // (threads * CHUNKS_PER_THREAD if threads > 1 else 1)), MOST_POINTS // self.lanes)
        job = self.job.copy(points=points, **written)
        job.count, job.chunk, job.chunks = count, chunk, -(-packs // chunk)
        return [job] * threads

    def _with_lost(self, points: Tensor, located: Tensor, sign: Tensor | None) -> Placed:
        """The few points that are NaN or beyond the range of their type are left to the plain twin."""
        if self.placement.geometry.is_identity:
            return located, sign
        rows = located.isnan().any(-1)
        sign = torch.ones_like(located) if sign is None else sign
        located[rows], sign[rows] = reference.place(points[rows], self.placement)
        return located, sign


def _job(placement: Placement) -> FoldingJob:
    """With everything but addresses and what the number of points decides."""
    geometry = placement.geometry
    job = FoldingJob()
    for i, (a, n) in enumerate(zip(AXES, placement.size, strict=True)):
        setattr(job, f"origin_{a}", geometry.origin[i])
        setattr(job, f"shift_{a}", placement.shift[i])
        low, high = placement.boundary.interval(n, placement.tail)
        setattr(job, f"low_{a}", low)
        setattr(job, f"high_{a}", high)
        for j, b in enumerate(AXES):
            setattr(job, f"matrix_{a}{b}", geometry.inverse[i][j])
    return job


def _how_it_folds(boundary: Boundary, n: int) -> str:
    if boundary is Boundary.MIRROR and n == 1:
        return "flat"
    return {Boundary.MIRROR: "reflect", Boundary.REFLECT: "reflect", Boundary.WRAP: "wrap"}.get(boundary, "clamp")
