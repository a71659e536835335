"""Points brought into an order in which neighbours in memory are neighbours in space, where that pays.

Points along rays are in such an order already. Points that are not (random ones, a shuffled batch) read a volume beyond
the cache at one or two misses per line of taps; sorted by bricks of 8³ coefficients they read every brick once. Sorting
and putting rows back costs 8 to 30 ns per point. Measured for 10⁶ random float32 points, value + gradient, one thread,
ns per point as they lie → sorted, everything included:

                     gather 3³ taps   gather 4³ taps   scatter 3³ taps   scatter 4³ taps
    Zen 5, AVX-512, 32 MB of last cache
     64³                5 → 13           11 → 15          10 → 14           14 → 17
    128³                8 → 20           17 → 23          22 → 24           32 → 28
    192³               29 → 26           38 → 28          40 → 30           62 → 32
    256³               34 → 30           51 → 32          46 → 34           73 → 41
    384³               39 → 41           58 → 42          58 → 52           89 → 55
    Zen 3, AVX2, a busy machine
     64³               17 → 38           32 → 38          30 → 39           41 → 50
    128³               74 → 51          111 → 61         161 → 49          148 → 65
    256³              143 → 74          222 → 71         190 → 71          224 → 98

The line is drawn between 128³ and 192³: what the caches hold of a volume is the machine's, and its neighbours'.

Memory: copies of the points and rows of `POINTS_AT_ONCE` points, 4 bytes more for each.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from filterlab.ops.cpu import compiler, threads
from filterlab.ops.cpu.sorting import AXES, SortingJob, SortingVariant

POINTS_AT_ONCE = 1 << 22  # points that are sorted together, for which copies of points and rows are held
_EDGE = 8  # of a brick
_MOST_BRICKS = 1 << 16
_LOOKED_AT = 2048


def scattered(points: Tensor) -> bool:
    """Whether most points lie more than a brick from the one before: looked at in a few places."""
    count = points.shape[1]
    at = torch.linspace(0, count - 2, min(_LOOKED_AT, count - 1), dtype=torch.float64).long()
    steps = (points[:, at + 1] - points[:, at]).abs().amax(-1)
    return bool((steps > _EDGE).double().mean() > 0.5)


class Sorted:
    """Some points sorted by bricks.

    Args:
        points: (M, 3), contiguous, in coordinates of the coefficients, M at least the lanes of a pack.
        shape: (D, H, W) of the coefficients.
        start: the coordinate of coefficient 0.
        lanes: P.

    Attributes:
        points: (M, 3), sorted; the order within a brick is that of the points.
    """

    def __init__(self, points: Tensor, shape: tuple[int, int, int], start: int, lanes: int) -> None:
        self.arithmetic, self.lanes = str(points.dtype).removeprefix("torch."), lanes
        self.count = points.shape[0]
        assert self.count >= lanes, f"{self.count} points are fewer than a pack of {lanes}"
        edge = _EDGE
        while math.prod(-(-n // edge) for n in shape) > _MOST_BRICKS:
            edge *= 2
        bricks = [-(-n // edge) for n in shape[::-1]]
        self._begin = np.zeros(math.prod(bricks), np.int32)
        self._rank = np.empty(self.count, np.int32)
        moved = np.empty((self.count, 3), self.arithmetic)
        job = self._job(start=start, per_edge=1 / edge)
        job.point(points=points, sorted=moved)
        for axis, number, step in zip(AXES, bricks, (1, bricks[0], bricks[0] * bricks[1]), strict=True):
            setattr(job, f"last_{axis}", number - 1)
            setattr(job, f"step_{axis}", step)
        self._run("count", job)
        self._begin[:] = np.cumsum(self._begin) - self._begin
        self._run("move", job)
        self.points = torch.from_numpy(moved)

    def restore(self, sorted_rows: Tensor, rows: Tensor) -> None:
        """rows (J, M) = sorted_rows (J, M) in the order of the points; rows may be part of longer ones."""
        self._exchange("restore", sorted_rows, rows)

    def arrange(self, rows: Tensor, sorted_rows: Tensor) -> None:
        """The reverse."""
        self._exchange("arrange", sorted_rows, rows)

    def _exchange(self, step: str, sorted_rows: Tensor, rows: Tensor) -> None:
        job = self._job(stride=rows.stride(0), row_count=rows.shape[0])
        job.point(rows=rows, sorted_rows=sorted_rows)
        self._run(step, job)

    def _job(self, **fields) -> SortingJob:
        job = SortingJob(count=self.count, chunks=1, **fields)
        job.point(brick=self._rank, begin=self._begin)
        return job

    def _run(self, step: str, job: SortingJob) -> None:
        job.next = 0
        threads.run(compiler.compiled(SortingVariant(step, self.arithmetic, self.lanes)), [job])
