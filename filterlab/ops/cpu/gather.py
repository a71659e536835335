"""gather, scatter and pull as vector code: describes the arrays to the programs of `ops.cpu.points`, and runs them.

Same meaning as `ops.reference.gather`, orders 0 … 3. Coefficients are read as they are stored, sums are in the points'
dtype. The result of gather does not depend on the number of threads, bit by bit; that of scatter only on their number.
Points that lie all over a large volume are sorted first (`order`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from filterlab.ops.cpu import compiler, order
from filterlab.ops.cpu import threads as pool
from filterlab.ops.cpu.job import AXES, Function
from filterlab.ops.cpu.machine import CHUNKS_PER_THREAD, MOST_POINTS, lanes_of, threads_for
from filterlab.ops.cpu.memory import ARITHMETIC, fresh, zeros
from filterlab.ops.cpu.order import Bricks, Sorted
from filterlab.ops.cpu.place import Placing
from filterlab.ops.cpu.points import BLOCK, PointsJob, PointsVariant
from filterlab.ops.gather import STORAGE, readable
from filterlab.ops.tetrahedra import AnyStencil

FEWEST_SORTED = 1 << 16  # points of a batch entry
SMALLEST_SORTED_IN = 16 << 20  # bytes of one channel
SPLAT_MEMORY = 1 << 30  # bytes that scatter may take for partial results beyond the result itself

_POINTS_PER_THREAD = 4096  # fewer are not worth waking a thread for


def gather(coefficients: Tensor, points: Tensor, stencil: AnyStencil, start: int = 0) -> Tensor:
    """`ops.reference.gather.gather`, fused."""
    return Gathering(coefficients, stencil, start, points.dtype)(points)


class Gathering:
    """Rows of a stencil at points, of given coefficients: what no point changes is settled once.

    Args:
        coefficients: (N, C, D, H, W). Nothing is copied but what is not contiguous within a channel.
        stencil, start: as for `gather`.
        dtype: of the points.
    """

    def __init__(self, coefficients: Tensor, stencil: AnyStencil, start: int, dtype: torch.dtype) -> None:
        self.coefficients = readable(coefficients, 2)
        self.channels, self.rows, self.start = coefficients.shape[1], len(stencil.rows), start
        self.dtype, self.program = dtype, Program.of("gather", self.coefficients, stencil, start, dtype)
        self.bytes_of_channel = math.prod(coefficients.shape[2:]) * coefficients.element_size()

    def __call__(self, points: Tensor) -> Tensor:
        """(N, M, 3) -> (N, C, J, M)."""
        out = self.fresh(points)
        if out.numel() == 0:
            return out
        points = readable(points, 1)
        if _sorting_pays(points, self.bytes_of_channel):
            self._sorted(points, out)
        else:
            pool.run(self.program.run, self.program.shared(self.coefficients, points, out))
        return out

    def fresh(self, points: Tensor) -> Tensor:
        """What the rows at these points are written to."""
        entries, count, _ = points.shape
        return fresh((entries, self.channels, self.rows, count), self.dtype)

    def _sorted(self, points: Tensor, out: Tensor) -> None:
        for entry, part, ordered in _in_order(points, self.coefficients.shape, self.start):
            rows = fresh((1, self.channels, self.rows, ordered.count), self.dtype)
            own = self.coefficients[entry : entry + 1]
            pool.run(self.program.run, self.program.shared(own, ordered.points[None], rows))
            for channel in range(self.channels):
                ordered.restore(rows[0, channel], out[entry, channel, :, part])


def scatter(cotangents: Tensor, points: Tensor, stencil: AnyStencil, shape: Sequence[int], start: int = 0) -> Tensor:
    """`ops.reference.gather.scatter`, fused.

    Each thread takes an equal share of the points and adds into a partial result of its own; these are summed at the
    end, in order. Partial results take at most `SPLAT_MEMORY` beyond the result itself: fewer threads work when the
    volume is large, and when there are so few points that adding up would take longer than what is gained.
    """
    n, c = cotangents.shape[:2]
    volume = n * c * shape[0] * shape[1] * shape[2]
    parts = min(_threads(points), 1 + SPLAT_MEMORY // (volume * points.element_size() or 1))
    parts = max(1, min(parts, 8 * n * c * points.shape[1] // (volume or 1)))
    out = zeros((n, c, *shape), points.dtype)
    if not (cotangents.numel() and volume):
        return out
    more = [zeros(out.shape, out.dtype) for _ in range(parts - 1)]
    cotangents, points = readable(cotangents.to(points.dtype), 0), readable(points, 1)
    program = Program.of("scatter", out, stencil, start, points.dtype)
    if not _sorting_pays(points, math.prod(shape) * points.element_size()):
        pool.run(program.run, program.divided([out, *more], points, cotangents))
    else:
        for entry, part, ordered in _in_order(points, out.shape, start):
            rows = _arranged(ordered, cotangents[entry, :, :, part])
            own = [volume[entry : entry + 1] for volume in (out, *more)]
            pool.run(program.run, program.divided(own, ordered.points[None], rows))
    for part in more:
        out += part
    return out.contiguous()


def pull(coefficients: Tensor, points: Tensor, cotangents: Tensor, stencil: AnyStencil, start: int = 0) -> Tensor:
    """The adjoint of gather to its points, (N, M, 3): Σ over channels and rows of cotangent · gradient of the row."""
    if cotangents.numel() == 0 or points.numel() == 0:
        return torch.zeros_like(points)
    coefficients, points = readable(coefficients, 2), readable(points, 1)
    cotangents = readable(cotangents.to(points.dtype), 0)
    derivatives, raised = stencil.derivatives
    program = Program.of("pull", coefficients, derivatives, start, points.dtype, raised)
    out = fresh(points.shape, points.dtype)
    if not _sorting_pays(points, math.prod(coefficients.shape[2:]) * coefficients.element_size()):
        pool.run(program.run, program.shared(coefficients, points, cotangents, gradient=out))
        return out
    for entry, part, ordered in _in_order(points, coefficients.shape, start):
        rows = _arranged(ordered, cotangents[entry, :, :, part])
        own = fresh((1, ordered.count, 3), points.dtype)
        jobs = program.shared(coefficients[entry : entry + 1], ordered.points[None], rows, gradient=own)
        pool.run(program.run, jobs)
        back = fresh((3, ordered.count), points.dtype)
        ordered.restore(own[0].T.contiguous(), back)
        out[entry, part] = back.T
    return out


def _arranged(ordered: Sorted, cotangents: Tensor) -> Tensor:
    """Cotangents (C, J, M) in the order of sorted points, (1, C, J, M)."""
    rows = fresh((1, *cotangents.shape), cotangents.dtype)
    for channel, own in enumerate(cotangents):
        ordered.arrange(own, rows[0, channel])
    return rows


def _sorting_pays(points: Tensor, bytes_of_channel: int) -> bool:
    """Whether sorting points (N, M, 3) costs less than it saves (`order`)."""
    return sorting_may_pay(points.shape[1], bytes_of_channel) and order.scattered(points)


def sorting_may_pay(count: int, bytes_of_channel: int) -> bool:
    """Whether it is worth looking at so many located points."""
    return count >= FEWEST_SORTED and bytes_of_channel >= SMALLEST_SORTED_IN


def _in_order(points: Tensor, shape: Sequence[int], start: int) -> Iterator[tuple[int, slice, Sorted]]:
    """Points (N, M, 3) of coefficients (…, D, H, W), as `order.in_order` gives them."""
    return order.in_order(points, Bricks.of(shape[:-4:-1], (start,) * 3, (1,) * 3))


@dataclass(frozen=True)
class Program:
    """A compiled program, and its job as far as coefficients and stencil decide it.

    Attributes:
        run: the machine code.
        job: with everything but addresses and what the number of points decides.
        lanes: P.
        most: blocks of a chunk.
    """

    run: Function
    job: PointsJob
    lanes: int
    most: int

    @classmethod
    def of(
        cls,
        operation: str,
        volume: Tensor,
        stencil: AnyStencil,
        start: int,
        dtype: torch.dtype,
        raised: tuple[tuple[int, ...], ...] = (),
    ) -> Program:
        """Compiled, or found.

        Args:
            operation: "gather", "scatter" or "pull".
            volume: (N, C, D, H, W) or like it: coefficients, or what is added to.
            stencil, start: as for `gather`; for pull the derivatives of what was gathered.
            dtype: of points and sums.
            raised: for pull, as in `Stencil.derivatives`.
        """
        lanes = lanes_of(dtype)
        variant = PointsVariant(operation, stencil.lowered, ARITHMETIC[dtype], STORAGE[volume.dtype], lanes, raised)
        d, h, w = volume.shape[2:]
        job = PointsJob(
            channels=volume.shape[1],
            width=w,
            height=h,
            start=start,
            coefficients_entry=volume.stride(0),
            coefficients_channel=volume.stride(1),
        )
        for axis, size, support in zip(AXES, (w, h, d), stencil.supports, strict=True):
            setattr(job, f"low_{axis}", start)
            setattr(job, f"high_{axis}", start + size - support)
        most = max(1, MOST_POINTS // (lanes * BLOCK * max(1, volume.shape[1])))
        return cls(compiler.compiled(variant), job, lanes, most)

    def after(self, place: Placing) -> Program:
        """gather at points that this places first; gradients come back by its matrix."""
        job = self.job.copy()
        job.call(place=place.run, placing=place.job)
        job.oblique = place.placement.geometry.diagonal is None
        for name in (f"matrix_{row}{column}" for row in AXES for column in AXES):
            setattr(job, name, getattr(place.job, name))
        return replace(self, job=job)

    def shared(self, coefficients: Tensor, points: Tensor, rows: Tensor, **gradient: Tensor) -> list[PointsJob]:
        """gather or pull, a job for every thread: all share the points, chunk by chunk.

        Args:
            points: (N, M, 3).
            rows: (N, C, J, M), contiguous; written by gather, read by pull.
            gradient: (N, M, 3), written by pull; (N, C, M, 3), by gather after a place, of a jet of order 1: then rows
                are (N, C, M), its values.
        """
        threads = _threads(points)
        blocks = self._blocks(points, threads * CHUNKS_PER_THREAD if threads > 1 else 1)
        return [self._described(points, rows, min(blocks, self.most), coefficients=coefficients, **gradient)] * threads

    def divided(self, volumes: Sequence[Tensor], points: Tensor, rows: Tensor) -> list[PointsJob]:
        """scatter: a job for each of `volumes` (as of `memory.zeros`), with an equal share of the points."""
        blocks = self._blocks(points, len(volumes))
        cuts = _least_divisor(blocks, -(-blocks // self.most))  # shares end where they would without
        job = self._described(points, rows, blocks // cuts)
        firsts = range(0, job.chunks // job.entries, cuts)
        return [_own_share(job, first, cuts, volume) for first, volume in zip(firsts, volumes, strict=False)]

    def _blocks(self, points: Tensor, parts: int) -> int:
        """Blocks of packs in one of so many parts of an entry's points, or of a little fewer."""
        packs = -(-points.shape[1] // self.lanes)
        return -(-packs // (parts * BLOCK))

    def _described(self, points: Tensor, rows: Tensor, blocks: int, **arrays: Tensor) -> PointsJob:
        """The job of these points in chunks of so many blocks."""
        entries, count, _ = points.shape
        job = self.job.copy(points=points, rows=rows, **arrays)
        assert None not in (job.points, job.rows), "tensors without memory"
        chunk = blocks * BLOCK
        job.count, job.entries, job.points_entry = count, entries, points.stride(0)
        job.chunk, job.chunks = chunk, -(-count // (self.lanes * chunk)) * entries
        return job


def _own_share(job: PointsJob, first: int, parts: int, volume: Tensor) -> PointsJob:
    """The job of adding some parts of every batch entry's points to a volume of its own."""
    own = job.copy(coefficients=volume)
    own.next, own.chunks = first * job.entries, min((first + parts) * job.entries, job.chunks)
    return own


def _least_divisor(number: int, least: int) -> int:
    """The least divisor of a number from `least` on."""
    return next(cuts for cuts in range(least, number + 1) if number % cuts == 0)


def _threads(points: Tensor) -> int:
    return threads_for(points.shape[0] * points.shape[1], _POINTS_PER_THREAD)
