"""The way of rays through the cells of a lattice, a pack of rays at a time; what surely holds nothing is leapt over.

Every ray has a cell and a place s. Its next cell is behind the nearest of three planes: those of its cell; in a part
of a brick whose bounds leave out the level, those of the part; in such a brick, those of the cube of clear ones around
it (`ops.raycast.Raycast.marks`). Where a ray crosses a plane is (plane − o) / d, whoever asks, so that neighbours share
their ends to the bit; through edges and corners cells follow one another by faces, some of them over no length.

Places are doubles, whatever polynomials are computed in. A ray is measured from where it enters the domain, and its
direction scaled by a power of two to a length about 1. Who has found a cell that may hold the level waits for the
others of the pack.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace

from llvmlite import ir

from filterlab.ops.cpu.job import AXES
from filterlab.ops.cpu.lanes import DOUBLE, I1, I16, I32, I64, Lanes, Value, Variable
from filterlab.ops.pieces import NO_MOTION

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


class Gathered:
    """Cells that rays wait in while others of their pack look for theirs. Make it before any loop.

    Args:
        lanes: of doubles.
    """

    def __init__(self, lanes: Lanes) -> None:
        zero, none = (
            ir.Constant(ir.VectorType(I32, lanes.count), None),
            ir.Constant(ir.VectorType(I1, lanes.count), None),
        )
        self.lanes, self.builder, self._none = lanes, lanes.builder, none
        self._mask, self._cell = lanes.variable(none), [lanes.variable(zero) for _ in AXES]
        self._near, self._far = (lanes.variable(lanes.constant(0)) for _ in range(2))

    def clear(self) -> None:
        self._mask.value = self._none

    def add(self, mask: Value, found: Found) -> None:
        """Those under the mask."""
        self._mask.value = self.builder.or_(self._mask.value, mask)
        own, kept = (*found.cell, found.near, found.far), (*self._cell, self._near, self._far)
        for variable, value in zip(kept, own, strict=True):
            variable.value = self.lanes.where(mask, value, variable.value)

    @property
    def mask(self) -> Value:
        return self._mask.value

    @property
    def found(self) -> Found:
        """All of them."""
        return Found(self.mask, [c.value for c in self._cell], self._near.value, self._far.value)


class Walk:
    """Writes the walk of one pack of rays after the other. Make it before any loop.

    Args:
        lanes: of doubles, as many as a pack of rays has.
        job: fields of `ops.cpu.crossings.FIELDS`.
    """

    def __init__(self, lanes: Lanes, job: SimpleNamespace) -> None:
        self.lanes, self.builder, self.job = lanes, lanes.builder, job
        self.integers = ir.VectorType(I32, lanes.count)
        nothing, zero, never = lanes.constant(0), ir.Constant(self.integers, [0] * lanes.count), lanes.mask(False)
        doubles, cells = (lambda: lanes.variable(nothing)), (lambda: lanes.variable(zero))
        self.entry, self.direction = [doubles() for _ in AXES], [doubles() for _ in AXES]
        self._from, self._inverse = [doubles() for _ in AXES], [doubles() for _ in AXES]
        self._backward = [cells() for _ in AXES]  # −1 where rays go backward, else 0
        self.start, self.scale, self._s, self._end = doubles(), doubles(), doubles(), doubles()
        self._cell = [cells() for _ in AXES]
        self.going = lanes.variable(never)

    # --- rays ---

    def begin(self, origins: Sequence[Value], directions: Sequence[Value]) -> None:
        """Put a pack of rays where they enter the domain, all axes at once: packs of x, y, z in the world, doubles."""
        e, b = self.lanes, self.builder
        origins, directions = self._in_cells(origins, directions)
        most = e.multiply(self._largest(directions), e.constant(NO_MOTION))
        still = [b.fcmp_ordered("<=", e.absolute(d), most) for d in directions]
        speed = [e.where(rests, e.constant(1), d) for rests, d in zip(still, directions, strict=True)]
        first, last = self._span(origins, speed, still)
        self.going.value = met = b.fcmp_ordered("<=", first, last)
        self.start.value = first = e.where(met, first, e.constant(0))
        self._s.value, self._end.value = e.constant(0), e.where(met, e.subtract(last, first), e.constant(0))
        for i, (o, d, rests) in enumerate(zip(origins, speed, still, strict=True)):
            self.direction[i].value = moving = e.where(rests, e.constant(0), d)
            self.entry[i].value = entry = e.clamp(e.multiply_add(first, moving, o), *self._ends(i))
            self._from[i].value = e.where(rests, e.constant(-math.inf), entry)
            self._inverse[i].value = e.divide(e.constant(1), d)
            self._backward[i].value = self._wide(b.fcmp_ordered("<", d, e.constant(0)))
            self._cell[i].value = self._bounded(e.to_integer(e.floor(entry)), i)

    def _in_cells(self, origins: Sequence[Value], directions: Sequence[Value]) -> tuple[list[Value], list[Value]]:
        """World to coordinates of cells, with directions as long as is told by `scale`."""
        e = self.lanes
        rows = [[self._number("matrix", 3 * i + k) for k in range(3)] for i in range(3)]
        own = [e.subtract(x, self._number("origin", i)) for i, x in enumerate(origins)]
        origins = [e.subtract(self._dot(row, own), self._number("offset", i)) for i, row in enumerate(rows)]
        return origins, self._normalized([self._dot(row, directions) for row in rows])

    def _span(self, origins: Sequence[Value], speed: Sequence[Value], still: Sequence[Value]) -> tuple[Value, Value]:
        """From where to where rays are in the domain, from 0 on; where they are not, the first is greater."""
        e, b = self.lanes, self.builder
        always, never = e.constant(-math.inf), e.constant(math.inf)
        first, last = e.constant(0), never
        for i, (o, d, rests) in enumerate(zip(origins, speed, still, strict=True)):
            low, high = self._ends(i)
            a, z = e.divide(e.subtract(low, o), d), e.divide(e.subtract(high, o), d)
            within = b.and_(b.fcmp_ordered(">=", o, low), b.fcmp_ordered("<=", o, high))
            first = e.maximum(e.where(rests, e.where(within, always, never), e.minimum(a, z)), first)
            last = e.minimum(e.where(rests, e.where(within, never, always), e.maximum(a, z)), last)
        return first, last

    def _ends(self, axis: int) -> tuple[Value, Value]:
        """Of the domain along an axis."""
        return self._number("lower", axis), self._number("upper", axis)

    def _largest(self, direction: Sequence[Value]) -> Value:
        x, y, z = (self.lanes.absolute(d) for d in direction)
        return self.lanes.maximum(self.lanes.maximum(x, y), z)

    def _normalized(self, direction: list[Value]) -> list[Value]:
        """Times a power of two, whose inverse leads back from s to t."""
        e, b = self.lanes, self.builder
        exponent = b.and_(e.bits_of(self._largest(direction)), e.integers(_EXPONENT))
        self.scale.value = scale = e.of_bits(b.sub(e.integers(_FLIP), exponent))
        return [e.multiply(d, scale) for d in direction]

    def _dot(self, row: Sequence[Value], x: Sequence[Value]) -> Value:
        e = self.lanes
        return e.multiply_add(row[2], x[2], e.multiply_add(row[1], x[1], e.multiply(row[0], x[0])))

    def _number(self, array: str, index: int) -> Value:
        """Of an array of the job, in every lane."""
        e = self.lanes
        return e.everywhere(self.builder.load(e.advance(getattr(self.job, array), I64(index), DOUBLE), typ=DOUBLE))

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

        A ray is then behind the cell that was found. `going` ends with the ray; that it may do in the cell.
        """
        e, b = self.lanes, self.builder
        searching = b.and_(self.going.value, b.not_(waiting))
        on, found = e.variable(self._wide(searching)), e.variable(self._integers(0))
        mark = e.variable(self._integers(0))
        self._look(on, found, mark)
        with e.repeat_while(lambda: e.any(self._narrow(on.value))):
            self._leap(on, mark.value)
            self._look(on, found, mark)
        mask = self._narrow(found.value)
        cell = [b.select(mask, c.value, self._integers(0)) for c in self._cell]  # taps are read in every lane
        ahead = [b.add(c, self._sign(f, 0)) for c, f in zip(cell, self._backward, strict=True)]
        near, end = self._s.value, self._end.value
        crossed = self._crossed(ahead)
        far = e.maximum(self._least(crossed), near)
        over = b.fcmp_unordered(">=", far, end)
        through = self._through(crossed)
        beyond = [b.add(p, back.value) for p, back in zip(ahead, self._backward, strict=True)]
        outside = self._outside([b.select(t, x, c) for t, x, c in zip(through, beyond, cell, strict=True)])
        for own, t, x, c in zip(self._cell, through, beyond, cell, strict=True):
            own.value = b.select(mask, b.select(t, x, c), own.value)
        self._s.value = e.where(mask, far, near)
        self.going.value = b.and_(self.going.value, b.not_(b.and_(mask, b.or_(over, outside))))
        return Found(mask, cell, near, e.minimum(far, end))

    def _look(self, on: Variable, found: Variable, mark: Variable) -> None:
        """Whoever is in a part of a brick that may hold the level has found its cell."""
        b, one = self.builder, self._integers(1)
        edge = self._whole(self.job.edge)
        cell = [c.value for c in self._cell]
        mark.value = seen = self._marks([b.lshr(c, edge) for c in cell])
        half = b.sub(edge, one)
        part = self._integers(0)
        for i, c in enumerate(cell):
            part = b.or_(part, b.shl(b.and_(b.lshr(c, half), one), self._integers(i)))
        bit = b.and_(b.lshr(self._larger(seen, self._integers(0)), part), one)
        holds = b.and_(on.value, b.sub(self._integers(0), bit))
        found.value = b.or_(found.value, holds)
        on.value = b.xor(on.value, holds)

    def _leap(self, on: Variable, mark: Value) -> None:
        """Over the clear bricks around, or the clear part of a brick."""
        e, b = self.lanes, self.builder
        moves = self._narrow(on.value)
        is_clear = b.ashr(mark, self._integers(31))  # −1 where the whole brick is, else 0
        edge = b.sub(b.sub(self._whole(self.job.edge), self._integers(1)), is_clear)
        radius = b.and_(b.not_(mark), is_clear)
        cell = [c.value for c in self._cell]
        brick = [b.lshr(c, edge) for c in cell]  # or the part, as a brick of half the edge
        plane = [b.shl(b.add(x, self._sign(f, radius)), edge) for x, f in zip(brick, self._backward, strict=True)]
        crossed = self._crossed(plane)
        before = self._s.value
        reached = e.maximum(self._least(crossed), before)
        cells = []
        for i, through in enumerate(self._through(crossed)):
            at = e.to_integer(e.multiply_add(reached, self.direction[i].value, self.entry[i].value))
            low = b.shl(b.sub(brick[i], radius), edge)
            high = b.sub(b.shl(b.add(b.add(brick[i], radius), self._integers(1)), edge), self._integers(1))
            at = self._smaller(self._larger(at, low), self._smaller(high, self._last(i)))  # also on the domain's end
            cells.append(b.select(through, b.add(plane[i], self._backward[i].value), at))
            self._cell[i].value = b.select(moves, cells[i], cell[i])
        self._s.value = e.where(moves, reached, before)
        ended = b.or_(b.fcmp_unordered(">=", reached, self._end.value), self._outside(cells))
        ended = b.and_(moves, ended)
        self.going.value = b.and_(self.going.value, b.not_(ended))
        on.value = self._wide(b.and_(moves, b.not_(ended)))

    def _crossed(self, plane: Sequence[Value]) -> list[Value]:
        """Where rays cross planes across x, y and z; at infinity where they don't move along an axis."""
        e = self.lanes
        return [
            e.multiply(e.subtract(self.builder.sitofp(p, e.pack), o.value), inverse.value)
            for p, o, inverse in zip(plane, self._from, self._inverse, strict=True)
        ]

    def _least(self, crossed: Sequence[Value]) -> Value:
        return self.lanes.minimum(self.lanes.minimum(*crossed[:2]), crossed[2])

    def _through(self, crossed: Sequence[Value]) -> list[Value]:
        """Masks: which of the planes is the nearest one; where several are, the first of them."""
        b, (x, y, z) = self.builder, crossed
        first = b.and_(b.fcmp_ordered("<=", x, y), b.fcmp_ordered("<=", x, z))
        second = b.and_(b.not_(first), b.fcmp_ordered("<=", y, z))
        return [first, second, b.not_(b.or_(first, second))]

    def _sign(self, backward: Variable, radius: Value | int) -> Value:
        """1 + r for a ray that goes forward, −r for one that goes backward: bricks to the plane ahead."""
        b = self.builder
        flipped = b.xor(backward.value, radius) if radius else backward.value
        return b.add(flipped, self._integers(1))

    def _outside(self, cell: Sequence[Value]) -> Value:
        """A mask of cells beyond the lattice."""
        b, out = self.builder, self.lanes.mask(False)
        for i, own in enumerate(cell):
            out = b.or_(out, b.icmp_unsigned(">", own, self._last(i)))
        return out

    def _integers(self, value: int) -> Value:
        return ir.Constant(self.integers, [value] * self.lanes.count)

    def _wide(self, mask: Value) -> Value:
        """A mask as integers of 32 bits, −1 for true, which are kept in registers."""
        return self.builder.sext(mask, self.integers)

    def _narrow(self, mask: Value) -> Value:
        return self.builder.icmp_signed("<", mask, self._integers(0))

    def _marks(self, brick: Sequence[Value]) -> Value:
        """`Raycast.marks` of bricks; whatever, but in memory, beyond the lattice."""
        e, b, j = self.lanes, self.builder, self.job
        x, y, z = brick
        bx, by, bz = (self._whole(n) for n in (j.bricks_x, j.bricks_y, j.bricks_z))
        last = b.sub(b.mul(b.mul(bz, by), bx), self._integers(1))
        index = b.add(b.mul(b.add(b.mul(z, by), y), bx), x)
        index = b.select(b.icmp_unsigned("<", index, last), index, last)
        found = ir.Constant(ir.VectorType(I16, e.count), [0] * e.count)
        for lane in range(e.count):
            place = b.zext(b.extract_element(index, I32(lane)), I64)
            found = b.insert_element(found, b.load(e.advance(j.marks, place, I16), typ=I16), I32(lane))
        return b.sext(found, self.integers)
