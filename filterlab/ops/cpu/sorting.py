"""Points sorted by bricks of a volume or tiles of a plane, and rows put back in their order: a counting sort.

    count    brick b of every point; total[b] += 1
    (the caller turns totals into the place where each brick's points begin)
    move     rank[i] = begin[b of i]++;  sorted[rank[i]] = point i
    restore  row[i] = sorted row[rank[i]], for every row           arrange: the reverse

Everything is one pass over the points; what lies scattered is touched once.
"""

from __future__ import annotations

import ctypes
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import SimpleNamespace

from llvmlite import ir

from filterlab.ops.cpu import frame, job
from filterlab.ops.cpu.job import AXES
from filterlab.ops.cpu.lanes import I32, I64, Lanes, Value

FIELDS: dict[str, type] = {
    "next": ctypes.c_int64,
    "chunks": ctypes.c_int64,
    "points": ctypes.c_void_p,  # (M, axes)
    "sorted": ctypes.c_void_p,  # (M, axes)
    "brick": ctypes.c_void_p,  # (M) int32; afterwards the rank
    "begin": ctypes.c_void_p,  # (bricks) int32
    "rows": ctypes.c_void_p,  # (J, `stride`)
    "sorted_rows": ctypes.c_void_p,  # (J, M)
    "stride": ctypes.c_int64,  # from one row to the next
    "row_count": ctypes.c_int64,  # J
    "count": ctypes.c_int64,  # M
    **{f"start_{a}": ctypes.c_double for a in AXES},  # where the first brick begins
    **{f"per_edge_{a}": ctypes.c_double for a in AXES},  # 1 / edge of a brick
    **{f"last_{a}": ctypes.c_double for a in AXES},  # number of the last brick
    **{f"step_{a}": ctypes.c_int64 for a in AXES},  # from one brick to the next
}


class SortingJob(job.Job):
    _fields_ = tuple(FIELDS.items())


@dataclass(frozen=True)
class SortingVariant:
    """One pass.

    Attributes:
        step: "count", "move", "restore" or "arrange".
        arithmetic: "float32" or "float64".
        lanes: P.
        axes: that points have, 2 or 3.
    """

    step: str
    arithmetic: str
    lanes: int
    axes: int

    def write(self, function: ir.Function) -> None:
        """The program, into an empty function."""
        builder = ir.IRBuilder(function.append_basic_block("entry"))
        e = Lanes(builder, self.arithmetic, self.lanes)
        told = frame.load_job(e, function.args[0], FIELDS)
        with frame.every_chunk(e, told):
            match self.step:
                case "count":
                    _count(e, told, self.axes)
                case "move":
                    _move(e, told, self.axes)
                case "restore":
                    _restore(e, told)
                case "arrange":
                    _arrange(e, told)
        builder.ret_void()


def _count(e: Lanes, job: SimpleNamespace, axes: int) -> None:
    """The last pack begins early enough to be whole; what it has in common with the one before counts once."""
    b = e.builder
    start, per_edge, last = (
        [e.everywhere(e.scalar(getattr(job, f"{name}_{a}"))) for a in AXES[:axes]]
        for name in ("start", "per_edge", "last")
    )
    step = [e.everywhere(b.trunc(getattr(job, f"step_{a}"), I32)) for a in AXES[:axes]]
    with e.repeat(I64(0), job.count, e.count) as first:
        left = b.sub(job.count, first)
        whole = b.icmp_signed(">=", left, I64(e.count))
        at = b.select(whole, first, b.sub(job.count, I64(e.count)))
        points = e.load_tuples(e.advance(job.points, b.mul(at, I64(axes)), e.number), axes)
        brick = None
        for x, low, scale, most, stride in zip(points, start, per_edge, last, step, strict=True):
            number = e.floor(e.multiply(e.subtract(x, low), scale))
            part = b.mul(e.to_integer(e.clamp(number, e.constant(0), most)), stride)
            brick = part if brick is None else b.add(brick, part)
        e.store(brick, e.advance(job.brick, at, I32))
        new = b.sub(I64(e.count), b.select(whole, I64(e.count), left))  # lanes before this one were counted already
        for lane in range(e.count):
            total = e.advance(job.begin, b.zext(e.lane(brick, lane), I64), I32)
            one = b.zext(b.icmp_signed(">=", I64(lane), new), I32)
            b.store(b.add(b.load(total, typ=I32), one), total)


def _move(e: Lanes, job: SimpleNamespace, axes: int) -> None:
    b = e.builder
    with e.repeat(I64(0), job.count) as i:
        place = e.advance(job.brick, i, I32)
        begin = e.advance(job.begin, b.zext(b.load(place, typ=I32), I64), I32)
        rank = b.load(begin, typ=I32)
        b.store(b.add(rank, I32(1)), begin)
        b.store(rank, place)
        source = e.advance(job.points, b.mul(i, I64(axes)), e.number)
        target = e.advance(job.sorted, b.mul(b.zext(rank, I64), I64(axes)), e.number)
        e.store(e.load(source, e.number, axes), target)


def _restore(e: Lanes, job: SimpleNamespace) -> None:
    with _every_row(e, job) as (own, moved):
        e.builder.store(e.builder.load(moved, typ=e.number), own)


def _arrange(e: Lanes, job: SimpleNamespace) -> None:
    with _every_row(e, job) as (own, moved):
        e.builder.store(e.builder.load(own, typ=e.number), moved)


@contextmanager
def _every_row(e: Lanes, job: SimpleNamespace) -> Iterator[tuple[Value, Value]]:
    """For every row and point: where its number is, and where it is among the sorted."""
    b = e.builder
    with e.repeat(I64(0), job.row_count) as row:
        rows = e.advance(job.rows, b.mul(row, job.stride), e.number)
        moved = e.advance(job.sorted_rows, b.mul(row, job.count), e.number)
        with e.repeat(I64(0), job.count) as i:
            rank = b.zext(b.load(e.advance(job.brick, i, I32), typ=I32), I64)
            yield e.advance(rows, i, e.number), e.advance(moved, rank, e.number)
