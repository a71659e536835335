"""The way of rays through the cells of a lattice, a pack of rays at a time; what surely holds nothing is leapt over.

Every ray has a cell and a place s on it. Its next cell is behind the nearest of three planes, those of its cell or, in
a brick whose bounds leave out the level, those of the cube around it that does as well (`ops.raycast.leaps_of`). Where
a ray crosses a plane is (plane − o) / d, whoever asks, so that neighbours share their ends to the bit; through edges
and corners cells follow one another by faces, some of them over no length.

Places are doubles, whatever polynomials are computed in. A ray is measured from where it enters the domain, and its
direction scaled by a power of two to a length about 1. Who has found a cell that may hold the level waits for the
others of the pack.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace

from llvmlite import ir

from filterlab.ops.cpu.job import AXES
from filterlab.ops.cpu.lanes import DOUBLE, I8, I32, I64, Lanes, Value, Variable

_NO_MOTION = 1e-30  # of the largest component: over any distance that doubles resolve, such an axis stays put
_EXPONENT = 0x7FF << 52
_FLIP = 2046 << 52  # 2^(e − 1023) and 2^(1023 − e) have exponents that add up to this


@dataclass(frozen=True)
class Found:
    """Cells that rays have come to, packs.

    Attributes:
        mask: which rays have.
        cell: x, y, z, 32-bit integers.
        near, far: where the ray enters and leaves it, doubles.
    """

    mask: Value
    cell: list[Value]
    near: Value
    far: Value


class Walk:
    """Writes the walk of one pack of rays after the other. Make it before any loop.

    Args:
        lanes: of doubles, as many as a pack of rays has.
        job: fields of `ops.cpu.crossings.FIELDS`.
    """

    def __init__(self, lanes: Lanes, job: SimpleNamespace) -> None:
        self.lanes, self.builder, self.job = lanes, lanes.builder, job
        self.integers = ir.VectorType(I32, lanes.count)
        nothing, zero, never = lanes.constant(0), ir.Constant(self.integers, [0] * lanes.count), self.mask(False)
        doubles, cells = (lambda: lanes.variable(nothing)), (lambda: lanes.variable(zero))
        self.entry, self.direction = [doubles() for _ in AXES], [doubles() for _ in AXES]
        self._from, self._inverse = [doubles() for _ in AXES], [doubles() for _ in AXES]
        self._forward = [lanes.variable(never) for _ in AXES]
        self.start, self.scale, self._s, self._end = doubles(), doubles(), doubles(), doubles()
        self._near, self._far = doubles(), doubles()
        self._cell, self._own = [cells() for _ in AXES], [cells() for _ in AXES]
        self.going = lanes.variable(never)

    def mask(self, value: bool) -> Value:
        return ir.Constant(ir.VectorType(ir.IntType(1), self.lanes.count), [value] * self.lanes.count)

    # --- rays ---

    def begin(self, real: Value, origins: Sequence[Value], directions: Sequence[Value]) -> None:
        """Put a pack of rays where they enter the domain, all axes at once.

        Args:
            real: a mask: the others are not walked.
            origins, directions: packs of x, y, z in the world, doubles.
        """
        e, b = self.lanes, self.builder
        rows = [[self._of_all(self._number("matrix", 3 * i + k)) for k in range(3)] for i in range(3)]
        own = [e.subtract(x, self._of_all(self._number("origin", i))) for i, x in enumerate(origins)]
        offset = [self._of_all(self._number("offset", i)) for i in range(3)]
        origins = [e.subtract(self._dot(row, own), x) for row, x in zip(rows, offset, strict=True)]
        directions = self._normalized([self._dot(row, directions) for row in rows])
        first, last, moving = e.constant(0), e.constant(float("inf")), []
        largest = e.maximum(e.maximum(*(e.absolute(d) for d in directions[:2])), e.absolute(directions[2]))
        still = [b.fcmp_ordered("<=", e.absolute(d), e.multiply(largest, e.constant(_NO_MOTION))) for d in directions]
        for i, (o, d) in enumerate(zip(origins, directions, strict=True)):
            low, high = self._of_all(self._number("lower", i)), self._of_all(self._number("upper", i))
            speed = e.where(still[i], e.constant(1), d)
            a, z = e.divide(e.subtract(low, o), speed), e.divide(e.subtract(high, o), speed)
            within = b.and_(b.fcmp_ordered(">=", o, low), b.fcmp_ordered("<=", o, high))
            always, never = e.constant(float("-inf")), e.constant(float("inf"))
            first = e.maximum(e.where(still[i], e.where(within, always, never), e.minimum(a, z)), first)
            last = e.minimum(e.where(still[i], e.where(within, never, always), e.maximum(a, z)), last)
            moving.append(e.where(still[i], e.constant(0), d))
            self._inverse[i].value = e.divide(e.constant(1), speed)
            self._forward[i].value = b.fcmp_ordered(">=", speed, e.constant(0))
        met = b.and_(real, b.fcmp_ordered("<=", first, last))
        self.going.value = met
        self.start.value = first = e.where(met, first, e.constant(0))
        self._s.value, self._end.value = e.constant(0), e.where(met, e.subtract(last, first), e.constant(0))
        for i, (o, d) in enumerate(zip(origins, moving, strict=True)):
            low, high = self._of_all(self._number("lower", i)), self._of_all(self._number("upper", i))
            entry = e.clamp(e.multiply_add(first, d, o), low, high)
            self.entry[i].value, self.direction[i].value = entry, d
            self._from[i].value = e.where(still[i], e.constant(float("-inf")), entry)
            self._cell[i].value = self._bounded(e.to_integer(e.floor(entry)), i)

    def _normalized(self, direction: list[Value]) -> list[Value]:
        """Times a power of two, whose inverse leads back from s to t."""
        e, b = self.lanes, self.builder
        largest = e.maximum(e.maximum(*(e.absolute(d) for d in direction[:2])), e.absolute(direction[2]))
        exponent = b.and_(e.bits_of(largest), e.integers(_EXPONENT))
        self.scale.value = scale = e.of_bits(b.sub(e.integers(_FLIP), exponent))
        return [e.multiply(d, scale) for d in direction]

    def _dot(self, row: Sequence[Value], x: Sequence[Value]) -> Value:
        e = self.lanes
        return e.multiply_add(row[2], x[2], e.multiply_add(row[1], x[1], e.multiply(row[0], x[0])))

    def _number(self, array: str, index: int) -> Value:
        return self.builder.load(self.lanes.advance(getattr(self.job, array), I64(index), DOUBLE), typ=DOUBLE)

    def _of_all(self, number: Value) -> Value:
        return self.lanes.everywhere(number)

    def _bounded(self, cell: Value, axis: int) -> Value:
        zero = ir.Constant(self.integers, [0] * self.lanes.count)
        cell = self._larger(cell, zero)
        return self._smaller(cell, self._last(axis))

    def _last(self, axis: int) -> Value:
        """The number of the last cell along an axis."""
        return self._whole(self.builder.sub(getattr(self.job, f"cells_{AXES[axis]}"), I64(1)))

    def _whole(self, number: Value) -> Value:
        """A 64-bit integer, in 32 bits in every lane."""
        return self.lanes.everywhere(self.builder.trunc(number, I32))

    def _smaller(self, a: Value, b: Value) -> Value:
        return self.builder.select(self.builder.icmp_signed("<", a, b), a, b)

    def _larger(self, a: Value, b: Value) -> Value:
        return self.builder.select(self.builder.icmp_signed(">", a, b), a, b)

    # --- steps ---

    def next_cells(self, waiting: Value) -> Found:
        """Let all rays but those that wait go on, until each has come to a cell that may hold the level, or to its end.

        A ray ends with `going`; the cell that it ends in may be found as well.
        """
        e, b = self.lanes, self.builder
        searching = e.variable(b.and_(self.going.value, b.not_(waiting)))
        found = e.variable(self.mask(False))
        with e.repeat_while(lambda: e.any(searching.value)):
            self._step(searching, found)
        return Found(found.value, [c.value for c in self._own], self._near.value, self._far.value)

    def _step(self, searching: Variable, found: Variable) -> None:
        e, b = self.lanes, self.builder
        on = searching.value
        cell = [c.value for c in self._cell]
        leap = self._leaps(cell)
        one = ir.Constant(self.integers, [1] * e.count)
        width = b.shl(one, leap)
        forward = [f.value for f in self._forward]
        low = [b.shl(b.lshr(c, leap), leap) for c in cell]
        plane = [b.select(f, b.add(x, width), x) for f, x in zip(forward, low, strict=True)]
        crossed = [
            e.multiply(e.subtract(self._as_double(p), o.value), inverse.value)
            for p, o, inverse in zip(plane, self._from, self._inverse, strict=True)
        ]
        nearest = e.minimum(e.minimum(*crossed[:2]), crossed[2])
        s = self._s.value
        reached = e.maximum(nearest, s)
        through = [b.fcmp_ordered("<=", crossed[0], nearest)]
        through.append(b.and_(b.not_(through[0]), b.fcmp_ordered("<=", crossed[1], nearest)))
        through.append(b.not_(b.or_(*through)))
        end = self._end.value
        holds = b.and_(on, b.icmp_signed("==", leap, ir.Constant(self.integers, [0] * e.count)))
        over = b.fcmp_unordered(">=", reached, end)
        self._near.value = e.where(holds, s, self._near.value)
        self._far.value = e.where(holds, e.minimum(reached, end), self._far.value)
        outside = self.mask(False)
        for i in range(3):
            self._own[i].value = b.select(holds, cell[i], self._own[i].value)
            beyond = b.select(forward[i], plane[i], b.sub(plane[i], one))
            outside = b.or_(outside, b.and_(through[i], self._outside(beyond, i)))
            at = e.to_integer(e.floor(e.multiply_add(reached, self.direction[i].value, self.entry[i].value)))
            at = self._smaller(self._larger(at, low[i]), b.sub(b.add(low[i], width), one))
            self._cell[i].value = b.select(on, self._bounded(b.select(through[i], beyond, at), i), cell[i])
        self._s.value = e.where(on, reached, s)
        ended = b.and_(on, b.or_(over, outside))
        self.going.value = b.and_(self.going.value, b.not_(ended))
        found.value = b.or_(found.value, holds)
        searching.value = b.and_(on, b.not_(b.or_(holds, ended)))

    def _outside(self, cell: Value, axis: int) -> Value:
        return self.builder.icmp_unsigned(">", cell, self._last(axis))

    def _as_double(self, whole: Value) -> Value:
        return self.builder.sitofp(whole, self.lanes.pack)

    def _leaps(self, cell: list[Value]) -> Value:
        """log₂ of the edge of the cube that may be leapt over; 0 in a brick that may hold the level."""
        e, b, j = self.lanes, self.builder, self.job
        x, y, z = (b.lshr(c, self._whole(j.edge)) for c in cell)
        bx, by = (self._whole(n) for n in (j.bricks_x, j.bricks_y))
        index = b.add(b.mul(b.add(b.mul(z, by), y), bx), x)
        found = ir.Constant(ir.VectorType(I8, e.count), [0] * e.count)
        for lane in range(e.count):
            place = b.zext(b.extract_element(index, I32(lane)), I64)
            found = b.insert_element(found, b.load(e.advance(j.leaps, place, I8), typ=I8), I32(lane))
        return b.zext(found, self.integers)
