"""The programs that cast rays at blended quadrics (`tree_walk`, `quadric_leaves`).

Sheets, for each of them a walk to where it ends, then sums of weights, τ and normals of all hits before that, lane by
lane: of the leaves in which the walk came upon hits, or, where they were too many to be noted, by a second walk.
Members: all hits of a ray between two τ, counted, or written where a count before says.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass, replace

from llvmlite import ir

from filterlab.ops.cpu import job, mathematics, tree_walk
from filterlab.ops.cpu.lanes import DOUBLE, FLOAT, I1, I8, I32, I64, Value
from filterlab.ops.cpu.quadric_leaves import Met, QuadricLeaves, Take
from filterlab.ops.cpu.tree_walk import Ray, greatest
from filterlab.ops.quadrics import MATRIX, SQUARE, VECTOR, Kept
from filterlab.ops.slim import INNER, LEAST_WEIGHT, OUTER, STEEP
from filterlab.ops.tree import WIDTH

_PLACES = ir.VectorType(I64, WIDTH)
_NOTED = 64  # leaves with hits

SHEETS: dict[str, type] = tree_walk.FIELDS | {
    "sheets": ctypes.c_int64,  # k
    "offset": ctypes.c_double,  # of radii
    "tau": ctypes.c_void_p,  # (R, k) d, written, as those that follow; ∞ before
    "begin": ctypes.c_void_p,  # (R, k) d
    "end": ctypes.c_void_p,  # (R, k) d
    "normal": ctypes.c_void_p,  # (R, k, 3) d
    "place": ctypes.c_void_p,  # (R, k) int64, of the quadric with the greatest weight; −1 before
}
MEMBERS: dict[str, type] = tree_walk.FIELDS | {
    "begin": ctypes.c_void_p,  # (R) d
    "end": ctypes.c_void_p,  # (R) d
    "writes": ctypes.c_int64,  # whether hits are written; else their counts
    "count": ctypes.c_void_p,  # (R) int64: where those of each ray are written, or, written, how many there are
    "tau": ctypes.c_void_p,  # (P) d
    "place": ctypes.c_void_p,  # (P) int64
}


class SheetsJob(job.Job):
    _fields_ = tuple(SHEETS.items())


class MembersJob(job.Job):
    _fields_ = tuple(MEMBERS.items())


@dataclass(frozen=True)
class SheetsVariant:
    """Everything the program depends on, apart from the machine; see `quadric_leaves.QuadricLeavesVariant`."""

    planes: int
    kept: Kept
    reversed: bool
    fused: bool

    def write(self, function: ir.Function) -> None:
        """The program, into an empty function."""
        _Sheets(self, function, SHEETS).write()


@dataclass(frozen=True)
class MembersVariant:
    """The same of members."""

    planes: int
    kept: Kept
    fused: bool
    reversed: bool = False

    def write(self, function: ir.Function) -> None:
        """The program, into an empty function."""
        _Members(self, function, MEMBERS).write()


class _Walk(QuadricLeaves):
    def told(self, ray: Ray, take: Take) -> None:
        """Walks, and tells of all hits on the way."""
        self.walk(ray, lambda ray, leaf: self.quadrics(ray, leaf, take))


class _Sheets(_Walk):
    def write(self) -> None:
        self.leaves = self.lanes.reserve(I64, _NOTED)
        self.noted, self.last = self.lanes.variable(I64(0)), self.lanes.variable(I64(-1))
        super().write()

    def cast(self, ray: Ray) -> None:
        e, b, j = self.lanes, self.builder, self.job
        self.begin, self.sheet = e.variable(DOUBLE(float("-inf"))), e.variable(I64(0))
        with e.repeat_while(lambda: b.icmp_signed("<", self.sheet.value, j.sheets)):
            own = self._from(ray, self.begin.value)
            self.limit.value, self.noted.value, self.last.value = DOUBLE(float("inf")), I64(0), I64(-1)
            self.told(own, self._end)
            some = b.fcmp_ordered("<", self.limit.value, DOUBLE(float("inf")))
            with b.if_else(some) as (then, otherwise):
                with then:
                    self._blend(own)
                    self.begin.value = self._behind(self.limit.value)
                    self.sheet.value = b.add(self.sheet.value, I64(1))
                with otherwise:
                    self.sheet.value = j.sheets

    def _from(self, ray: Ray, begin: Value) -> Ray:
        """It without the boxes that end before τ."""
        f, b = self.boxes, self.builder
        return replace(ray, begins=f.maximum(ray.begins, f.everywhere(b.fptrunc(begin, FLOAT))))

    def _behind(self, end: Value) -> Value:
        """The next number."""
        b = self.builder
        positive = b.fadd(end, DOUBLE(0.0))  # −0 is 0
        bits = b.bitcast(positive, I64)
        step = b.select(b.fcmp_ordered("<", positive, DOUBLE(0.0)), I64(-1), I64(1))
        return b.bitcast(b.add(bits, step), DOUBLE)

    def _within(self, tau: Value, hit: Value) -> Value:
        e, b = self.lanes, self.builder
        own = b.fcmp_ordered(">=", tau, e.everywhere(self.begin.value))
        return b.and_(hit, b.and_(own, b.fcmp_ordered("<=", tau, e.everywhere(self.limit.value))))

    def _end(self, ray: Ray, met: Met, root: Value, hit: Value) -> None:
        e, b = self.lanes, self.builder
        tau = e.add(root, met.behind)
        hit = self._within(tau, hit)
        with b.if_then(e.any(hit)):
            radius = e.square_root(self.rows(met.base, [SQUARE])[0])
            end = e.multiply_add(e.everywhere(self.job.offset), radius, tau)
            least = b.fneg(greatest(e, e.where(hit, e.negate(end), e.constant(float("-inf")))))
            self.limit.value = b.select(b.fcmp_ordered("<", least, self.limit.value), least, self.limit.value)
            self._note(met.leaf)

    def _note(self, leaf: Value) -> None:
        """Once, though it may be told of one after the other: of fronts and backs."""
        e, b = self.lanes, self.builder
        slot = e.smaller(self.noted.value, I64(_NOTED - 1))
        b.store(leaf, e.advance(self.leaves, slot, I64))
        again = b.icmp_signed("==", leaf, self.last.value)
        self.noted.value = b.add(self.noted.value, b.select(again, I64(0), I64(1)))
        self.last.value = leaf

    def _blend(self, ray: Ray) -> None:
        e, b, j = self.lanes, self.builder, self.job
        self.sums = [e.variable(e.constant(0)) for _ in range(5)]
        self.most, self.best = e.variable(e.constant(0)), e.variable(ir.Constant(_PLACES, [-1] * WIDTH))
        with b.if_else(b.icmp_signed("<=", self.noted.value, I64(_NOTED))) as (few, many):
            with few, e.repeat(I64(0), self.noted.value) as slot:
                self.quadrics(ray, b.load(e.advance(self.leaves, slot, I64), typ=I64), self._add)
            with many:
                self.told(ray, self._add)
        weight, tau, *normal = (e.total(each.value) for each in self.sums)
        row = b.add(b.mul(ray.number, j.sheets), self.sheet.value)
        for array, number in ((j.tau, b.fdiv(tau, weight)), (j.begin, self.begin.value), (j.end, self.limit.value)):
            b.store(number, e.advance(array, row, DOUBLE))
        for axis, number in enumerate(normal):
            b.store(number, e.advance(j.normal, b.add(b.mul(row, I64(3)), I64(axis)), DOUBLE))
        b.store(self._heaviest(), e.advance(j.place, row, I64))

    def _add(self, ray: Ray, met: Met, root: Value, hit: Value) -> None:
        e, b = self.lanes, self.builder
        tau = e.add(root, met.behind)
        hit = self._within(tau, hit)
        with b.if_then(e.any(hit)):
            square = e.multiply_add(root, root, self.dot(met.q, met.q))
            w = self._weight(e.divide(square, self.rows(met.base, [SQUARE])[0]))
            rows = [e.constant(1), tau, *self._normal(ray, met, root)]
            for each, row in zip(self.sums, rows, strict=True):
                each.value = e.add(each.value, e.where(hit, e.multiply(w, row), e.constant(0)))
            lanes = ir.Constant(_PLACES, list(range(WIDTH)))
            place = b.add(e.everywhere(b.mul(met.leaf, I64(WIDTH))), lanes)
            same = b.and_(b.fcmp_ordered("==", w, self.most.value), b.icmp_signed(">", place, self.best.value))
            more = b.and_(hit, b.or_(b.fcmp_ordered(">", w, self.most.value), same))
            self.most.value, self.best.value = (
                b.select(more, w, self.most.value),
                b.select(more, place, self.best.value),
            )

    def _weight(self, square: Value) -> Value:
        """As `ops.reference.slim.weight`."""
        e = self.lanes
        left = e.maximum(e.subtract(e.constant(1), e.square_root(square)), e.constant(0))
        inner = mathematics.exp(e, e.multiply(e.constant(-STEEP), square))
        outer = e.multiply(e.constant(OUTER), e.multiply(left, left))
        own = e.where(e.less(e.constant(INNER * INNER), square), outer, inner)
        return e.add(own, e.constant(LEAST_WEIGHT))

    def _normal(self, ray: Ray, met: Met, root: Value) -> list[Value]:
        """n, where the gradient is 0 too."""
        e = self.lanes
        place = [e.multiply_add(root, u, x) for u, x in zip(ray.along, met.q, strict=True)]
        turned = self.times(self.rows(met.base, range(MATRIX.stop)), place)
        vector = self.rows(met.base, range(VECTOR.start, VECTOR.stop))
        gradient = [e.add(x, y) for x, y in zip(turned, vector, strict=True)]
        size = e.square_root(self.dot(gradient, gradient))
        inverse = e.divide(e.constant(1), e.where(e.less(e.constant(0), size), size, e.constant(1)))
        return [e.multiply(x, inverse) for x in gradient]

    def _heaviest(self) -> Value:
        """The last place among those of the greatest weight."""
        e, b = self.lanes, self.builder
        same = b.fcmp_ordered("==", self.most.value, e.everywhere(greatest(e, self.most.value)))
        place = b.select(same, self.best.value, ir.Constant(_PLACES, [-1] * WIDTH))
        best = e.lane(place, 0)
        for lane in range(1, WIDTH):
            other = e.lane(place, lane)
            best = b.select(b.icmp_signed(">", other, best), other, best)
        return best


class _Members(_Walk):
    def cast(self, ray: Ray) -> None:
        e, b, j = self.lanes, self.builder, self.job
        begin = self.number(j.begin, ray.number)
        self.begin, self.slot = e.variable(begin), e.variable(I64(0))
        counted = e.advance(j.count, ray.number, I64)
        writes = b.icmp_signed("!=", j.writes, I64(0))
        self.slot.value = b.select(writes, b.load(counted, typ=I64), I64(0))
        self.limit.value = self.number(j.end, ray.number)
        f = self.boxes
        near = f.maximum(ray.begins, f.everywhere(b.fptrunc(begin, FLOAT)))
        with b.if_then(b.fcmp_ordered("<=", begin, self.limit.value)):
            self.told(replace(ray, begins=near), self._take)
        with b.if_then(b.not_(writes)):
            b.store(self.slot.value, counted)

    def _take(self, ray: Ray, met: Met, root: Value, hit: Value) -> None:
        e, b, j = self.lanes, self.builder, self.job
        tau = e.add(root, met.behind)
        own = b.fcmp_ordered(">=", tau, e.everywhere(self.begin.value))
        own = b.and_(hit, b.and_(own, b.fcmp_ordered("<=", tau, e.everywhere(self.limit.value))))
        self.bits.value = b.bitcast(own, I8)
        with e.repeat_while(lambda: b.icmp_unsigned("!=", self.bits.value, I8(0))):
            lane = b.cttz(self.bits.value, I1(0))
            self.bits.value = b.xor(self.bits.value, b.shl(I8(1), lane))
            slot = self.slot.value
            with b.if_then(b.icmp_signed("!=", j.writes, I64(0))):
                b.store(b.extract_element(tau, b.zext(lane, I32)), e.advance(j.tau, slot, DOUBLE))
                place = b.add(b.mul(met.leaf, I64(WIDTH)), b.zext(lane, I64))
                b.store(place, e.advance(j.place, slot, I64))
            self.slot.value = b.add(slot, I64(1))
