"""The programs that bring rows of hits and rows of rays together: one pass over the hits, number after number.

    points     point[h] = o[i] + t[i] d[i], i = index[h]
    by_rays    all of the rays' rows are 0;  point[i], gradient[i], normal[i] = what hit h has

Sums and products are rounded one after the other, as torch's are, so that points are the same to the bit.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass
from functools import reduce

from llvmlite import ir

from filterlab.ops.cpu import frame, job
from filterlab.ops.cpu.lanes import ARITHMETIC, I64, Lanes, Value

UNKNOWN, FAR = 1, 2
"""What a job may have met: a gradient that is NaN; the origin of a hit beyond the reach."""

# Arrays are contiguous but for steps, in numbers; "number" is the type of the arithmetic.
FIELDS: dict[str, type] = {
    "next": ctypes.c_int64,  # the chunk to be taken next
    "index": ctypes.c_void_p,  # (M) int64, ascending: the ray of every hit
    "begin": ctypes.c_void_p,  # (chunks + 1) int64: the first hit of every chunk
    "origins": ctypes.c_void_p,  # (R, 3) numbers
    "directions": ctypes.c_void_p,
    "origins_step": ctypes.c_int64,  # from one ray to the next
    "directions_step": ctypes.c_int64,
    "t": ctypes.c_void_p,  # (R) numbers
    "points": ctypes.c_void_p,  # (M, 3) numbers; written by points, read by by_rays
    "gradients": ctypes.c_void_p,  # (M, 3) numbers
    "gradients_step": ctypes.c_int64,  # from one hit to the next
    "gradients_axis": ctypes.c_int64,  # from one component to the next
    "ray_point": ctypes.c_void_p,  # (R, 3) numbers, written by by_rays
    "ray_gradient": ctypes.c_void_p,
    "ray_normal": ctypes.c_void_p,
    "rays": ctypes.c_int64,  # R
    "chunk": ctypes.c_int64,  # rays of a chunk
    "chunks": ctypes.c_int64,
    "met": ctypes.c_int64,  # `UNKNOWN` and `FAR`; threads add to it atomically
    "reach": ctypes.c_double,  # of |o_k|; read by points
}


class HitRowsJob(job.Job):
    _fields_ = tuple(FIELDS.items())


@dataclass(frozen=True)
class HitRowsVariant:
    """Everything a program depends on, apart from the machine.

    Attributes:
        operation: "points" or "by_rays".
        arithmetic: "float32" or "float64".
    """

    operation: str
    arithmetic: str

    def write(self, function: ir.Function) -> None:
        """The program, into an empty function."""
        _Program(self, function).write()


class _Program:
    def __init__(self, variant: HitRowsVariant, function: ir.Function) -> None:
        self.variant, self.function = variant, function
        self.builder = ir.IRBuilder(function.append_basic_block("entry"))
        self.lanes = Lanes(self.builder, variant.arithmetic, 4)
        self.number = ARITHMETIC[variant.arithmetic]

    def write(self) -> None:
        e, b = self.lanes, self.builder
        self.job = j = frame.load_job(e, self.function.args[0], FIELDS)
        self.met = e.variable(I64(0))
        write = {"points": self._point, "by_rays": self._by_ray}[self.variant.operation]
        with frame.every_chunk(e, j) as chunk:
            if self.variant.operation == "by_rays":
                self._clear(chunk)
            begin, end = (b.load(e.advance(j.begin, n, I64), typ=I64) for n in (chunk, b.add(chunk, I64(1))))
            with e.repeat(begin, end) as hit:
                write(hit, b.load(e.advance(j.index, hit, I64), typ=I64))
        b.atomic_rmw("or", j.met, self.met.value, "monotonic")
        b.ret_void()

    def _clear(self, chunk: Value) -> None:
        e, b, j = self.lanes, self.builder, self.job
        first = b.mul(chunk, j.chunk)
        size = b.mul(e.smaller(j.chunk, b.sub(j.rays, first)), I64(3 * e.bits // 8))
        for array in (j.ray_point, j.ray_gradient, j.ray_normal):
            e.clear(e.advance(array, b.mul(first, I64(3)), self.number), size)

    def _point(self, hit: Value, ray: Value) -> None:
        b, j = self.builder, self.job
        origin = self._load(j.origins, b.mul(ray, j.origins_step), I64(1))
        direction = self._load(j.directions, b.mul(ray, j.directions_step), I64(1))
        (t,) = self._load(j.t, ray, I64(1), 1)
        found = [b.fadd(o, b.fmul(t, d)) for o, d in zip(origin, direction, strict=True)]
        reach = self.lanes.scalar(j.reach)
        beyond = [b.fcmp_ordered(">", x, reach) for o in origin for x in (o, b.fneg(o))]
        self.met.value = b.or_(self.met.value, b.select(reduce(b.or_, beyond), I64(FAR), I64(0)))
        self._store(found, j.points, b.mul(hit, I64(3)))

    def _by_ray(self, hit: Value, ray: Value) -> None:
        e, b, j = self.lanes, self.builder, self.job
        gradient = self._load(j.gradients, b.mul(hit, j.gradients_step), j.gradients_axis)
        x, y, z = (b.fmul(g, g) for g in gradient)
        square = b.fadd(b.fadd(x, y), z)
        none = b.fcmp_ordered("==", square, self.number(0.0))
        length = e.lane(e.square_root(e.everywhere(b.select(none, self.number(1.0), square))), 0)
        unknown = b.fcmp_unordered("uno", square, square)
        self.met.value = b.or_(self.met.value, b.select(unknown, I64(UNKNOWN), I64(0)))
        place = b.mul(ray, I64(3))
        self._store(self._load(j.points, b.mul(hit, I64(3)), I64(1)), j.ray_point, place)
        self._store(gradient, j.ray_gradient, place)
        self._store([b.fdiv(g, length) for g in gradient], j.ray_normal, place)

    def _load(self, array: Value, first: Value, step: Value, count: int = 3) -> list[Value]:
        e, b = self.lanes, self.builder
        places = [b.add(first, b.mul(step, I64(k))) for k in range(count)]
        return [b.load(e.advance(array, place, self.number), typ=self.number) for place in places]

    def _store(self, numbers: Sequence[Value], array: Value, first: Value) -> None:
        for k, number in enumerate(numbers):
            self.builder.store(number, self.lanes.advance(array, self.builder.add(first, I64(k)), self.number))
