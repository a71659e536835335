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
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from filterlab.ops.cpu import compiler, threads
from filterlab.ops.cpu.machine import lanes_of
from filterlab.ops.cpu.sorting import AXES, SortingJob, SortingVariant

POINTS_AT_ONCE = 1 << 22  # points that are sorted together, for which copies of points and rows are held
_EDGE = 8  # of a brick
_MOST_BRICKS = 1 << 16
_LOOKED_AT = 512


def scattered(points: Tensor, edge: Tensor | float = _EDGE) -> bool:
    """Whether most points (N, M, axes) lie more than a brick from the one before: looked at in a few places."""
    step = points.shape[1] // _LOOKED_AT | 1
    before, after = points[:, :-1:step], points[:, 1::step]
    far = ((after - before).abs_() > edge).any(-1)
    return 2 * int(far.sum()) > far.numel()


@dataclass(frozen=True)
class Bricks:
    """What points are sorted by, along x, y and, of a volume, z.

    Attributes:
        start: where the first brick begins.
        edge: how long one is; negative where they go the other way.
        count: how many there are.
    """

    start: tuple[float, ...]
    edge: tuple[float, ...]
    count: tuple[int, ...]

    @classmethod
    def of(
        cls, sizes: Sequence[int], start: Sequence[float], step: Sequence[float], edges: Sequence[int] = (_EDGE,) * 3
    ) -> Bricks:
        """Of so many coefficients, `edges` of them in a brick along the axes, more where there were too many bricks.

        Args:
            sizes: of the coefficients along every axis.
            start: coordinates of the first coefficient.
            step: from one to the next.
        """
        while math.prod(-(-n // edge) for n, edge in zip(sizes, edges, strict=True)) > _MOST_BRICKS:
            edges = [2 * edge for edge in edges]
        own = list(zip(sizes, step, edges, strict=True))
        return cls(tuple(start), tuple(edge * s for _, s, edge in own), tuple(-(-n // edge) for n, _, edge in own))


class Sorted:
    """Some points sorted by bricks.

    Args:
        points: (M, axes), contiguous, M at least the lanes of a pack.
        bricks: in the coordinates of the points; what is beyond belongs to the nearest one.
        lanes: P.

    Attributes:
        points: (M, axes), sorted; the order within a brick is that of the points.
    """

    def __init__(self, points: Tensor, bricks: Bricks, lanes: int) -> None:
        self.arithmetic, self.lanes = str(points.dtype).removeprefix("torch."), lanes
        self.count, self.axes = points.shape
        assert self.count >= lanes, f"{self.count} points are fewer than a pack of {lanes}"
        self._begin = np.zeros(math.prod(bricks.count), np.int32)
        self._rank = np.empty(self.count, np.int32)
        moved = np.empty((self.count, self.axes), self.arithmetic)
        job, step = self._job(), 1
        job.point(points=points, sorted=moved)
        for axis, start, edge, number in zip(AXES, bricks.start, bricks.edge, bricks.count, strict=False):
            told = {"start": start, "per_edge": 1 / edge, "last": number - 1, "step": step}
            for name, value in told.items():
                setattr(job, f"{name}_{axis}", value)
            step *= number
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
        threads.run(compiler.compiled(SortingVariant(step, self.arithmetic, self.lanes, self.axes)), [job])


def in_order(points: Tensor, bricks: Bricks) -> Iterator[tuple[int, slice, Sorted]]:
    """(batch entry, which of its points, those points sorted), of (N, M, axes), in parts, so that copies stay small."""
    count = points.shape[1]
    parts = -(-count // POINTS_AT_ONCE)
    for entry, own in enumerate(points):
        for i in range(parts):
            part = slice(count * i // parts, count * (i + 1) // parts)
            yield entry, part, Sorted(own[part], bricks, lanes_of(points.dtype))
