"""The program that casts rays at a spline of heights: every ray walks alone, P of them are searched together.

For P rays in turn, as `ops.height_hits` says:

    walk        from block to block, up and down the pyramid, in integers: no rounding can lose a ray or stop it. Some
                rays come to the first cell that they may hit something in before the first of them goes on: of a large
                grid the data of all are then on their way from memory. Bounds are asked for on the way down; of a deep
                pyramid rays rest above the smallest blocks, until the others have come so far too
    restrict    in a cell the quartics of both triangles at once: lanes are (upper p, upper q, lower p, lower q), where
                a step of de Casteljau's algorithm to p is one to q, or to the other of both, in every lane
    signs       no change of sign: on. One: there is the hit, the ray waits for the others
                several: the part that holds the first root is looked for at once (`ops.cpu.polynomials`)

and then one root search for all. Where every hit is asked for, rays go on with what they keep, and P roots are searched
whenever there are so many, of whatever rays they are.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from types import SimpleNamespace

from llvmlite import ir

from filterlab import bernstein
from filterlab.ops.cpu import frame, job
from filterlab.ops.cpu.height_cells import GRID, LOWER, UPPER, Windows
from filterlab.ops.cpu.lanes import ARITHMETIC, DOUBLE, FLOAT, I1, I8, I64, STORAGE, Lanes, Value, Variable
from filterlab.ops.cpu.piece_roots import EveryRoot, Signs, first_root
from filterlab.ops.cpu.polynomials import FirstRoot, NextRoots, Rows
from filterlab.ops.height_hits import DEGREE, POINTS, Cell
from filterlab.ops.pieces import NO_MOTION
from filterlab.ops.raycast import PLACES_APART, REPEATED

LANES = 4
PACKS_OF_A_CHUNK = 16
AHEAD = 16  # rays that come to their first cells before the first of them is restricted to one
_N = DEGREE + 1
_LEVELS_AHEAD = 2  # at which bounds are asked for where a line goes down
_RESTING = 3  # levels above the smallest blocks, where lines rest
_RESTS = 3  # of a line, at most, before its first cell
_DEEP = 10  # levels above the smallest blocks, from which on caches do not hold the bounds
_NUMBERS = 9  # doubles of a line
_NOTHING, _INNER, _AT_START, _AT_END = range(4)

# Arrays are contiguous; R rays, d a double.
FIELDS: dict[str, type] = {
    "next": ctypes.c_int64,  # the chunk to be taken next; threads add 1 atomically
    **GRID,
    "cells_x": ctypes.c_int64,
    "cells_y": ctypes.c_int64,
    "bounds": ctypes.c_void_p,  # `ops.height_hits.Pyramid.numbers`
    "starts": ctypes.c_void_p,  # int64 of every level
    "widths": ctypes.c_void_p,  # int64 of every level, blocks of a row
    "top": ctypes.c_int64,
    **dict.fromkeys(("shift_x", "shift_y", "spacing_x", "spacing_y"), ctypes.c_double),  # of cells in the world
    **dict.fromkeys(("end_x", "end_y", "low_z", "high_z"), ctypes.c_double),  # of the box around all; from 0, 0
    "origins": ctypes.c_void_p,  # (R, 3) numbers, in the world
    "directions": ctypes.c_void_p,  # (R, 3) numbers
    "rays": ctypes.c_int64,
    "t": ctypes.c_void_p,  # (R) d, written, in whole packs: of the first hit; (R, k) where sheets are
    "sheets": ctypes.c_int64,  # k, places for sheets of a ray, which are written in a ring
    "most": ctypes.c_int64,  # sheets behind which no more are looked for
    "extent": ctypes.c_double,  # the diagonal of the domain, in the world
    "capacity": ctypes.c_int64,  # K, candidates of a ray that there is room for
    "count": ctypes.c_void_p,  # (R) int64, written: candidates or sheets of a ray, also those that there is no room for
    "places": ctypes.c_void_p,  # (R, K, 3) d, written: start, near, far
    "pieces": ctypes.c_void_p,  # (R, K, 5) d, written
    "flags": ctypes.c_void_p,  # (R, K) bytes of `REPEATED`, written
    "chunks": ctypes.c_int64,  # `next` stops here
}


class HeightRaysJob(job.Job):
    _fields_ = tuple(FIELDS.items())


@dataclass(frozen=True)
class HeightRaysVariant:
    """Everything the program depends on, apart from the machine.

    Attributes:
        asked: "first", "met", "sheets" or "candidates".
        cell: what the coefficients of a cell are made of.
        storage: dtype of the heights.
        rays: "float32" or "float64".
    """

    asked: str
    cell: Cell
    storage: str
    rays: str

    def write(self, function: ir.Function) -> None:
        """The program, into an empty function."""
        _PROGRAMS[self.asked](self, function).write()


@dataclass(frozen=True)
class _Line:
    """A ray from where it enters the box around all heights, in coordinates of cells.

    Attributes:
        number: of the ray.
        origin, direction: doubles along x, y, z.
        start: how far the origin is from that of the ray. far: where it leaves. length: of the direction, in units of
            the ray's own. Doubles.
        forward: integers, 1 where x and y grow.
        meets: whether it meets the box.
    """

    number: Value
    origin: list[Value]
    direction: list[Value]
    start: Value
    far: Value
    length: Value
    forward: list[Value]
    meets: Value

    @property
    def numbers(self) -> list[Value]:
        """All doubles."""
        return [*self.origin, *self.direction, self.start, self.far, self.length]

    def at(self, e: Lanes, axis: int, s: Value) -> Value:
        return e.multiply_add(s, self.direction[axis], self.origin[axis])


class _Kept:
    """Values of some kinds, of every line that is underway."""

    def __init__(self, lanes: Lanes, kinds: Sequence[ir.Type]) -> None:
        self.lanes, self.builder, self.kinds = lanes, lanes.builder, kinds
        self.arrays = [lanes.reserve(kind, AHEAD) for kind in kinds]

    def _places(self, place: Value) -> list[Value]:
        return [self.lanes.advance(own, place, kind) for own, kind in zip(self.arrays, self.kinds, strict=True)]

    def write(self, place: Value, values: Sequence[Value]) -> None:
        for address, value in zip(self._places(place), values, strict=True):
            self.builder.store(value, address)

    def read(self, place: Value) -> list[Value]:
        return [self.builder.load(own, typ=kind) for own, kind in zip(self._places(place), self.kinds, strict=True)]


class _Program:
    """What all have in common: the way, and both pieces in a cell."""

    def __init__(self, variant: HeightRaysVariant, function: ir.Function) -> None:
        self.variant, self.cell = variant, variant.cell
        self.builder = ir.IRBuilder(function.append_basic_block("entry"))
        self.lanes = e = Lanes(self.builder, "float64", LANES)
        self.job: SimpleNamespace = frame.load_job(e, function.args[0], FIELDS)
        self.windows = Windows(e, self.job, self.cell, STORAGE[variant.storage])
        self.points = e.reserve(DOUBLE, POINTS)
        self.pieces, self.ends = e.reserve(DOUBLE, 2 * _N), e.reserve(DOUBLE, 3)
        self.passed = e.reserve(I1, 2)
        self.cell_at = [e.variable(I64(0)) for _ in range(2)]
        self.level, self.going = e.variable(I64(0)), e.variable(I1(0))
        self.s, self.ended_at, self.ended_with = (e.variable(DOUBLE(0.0)) for _ in range(3))
        self.relevant, self.on, self.arrived = (e.variable(I1(0)) for _ in range(3))
        self.resting = e.variable(I64(0))
        self.lines, self.states = _Kept(e, [DOUBLE] * _NUMBERS), _Kept(e, [I64, I64, DOUBLE, I64, I1])

    def write(self) -> None:
        e, b, j = self.lanes, self.builder, self.job
        self.prepare()
        deep = b.icmp_signed(">=", b.sub(j.top, I64(self.cell.finest)), I64(_DEEP))
        rests = b.select(deep, I64(_RESTS), I64(0))
        with frame.every_chunk(e, j) as chunk:
            begin = b.mul(chunk, I64(LANES * PACKS_OF_A_CHUNK))
            end = e.smaller(b.add(begin, I64(LANES * PACKS_OF_A_CHUNK)), j.rays)
            with e.repeat(begin, end, AHEAD) as ahead:
                last = e.smaller(b.add(ahead, I64(AHEAD)), end)
                with e.repeat(ahead, last) as number:
                    self._enter(number, b.sub(number, ahead))
                with e.repeat(I64(0), b.add(rests, I64(1))) as turn:
                    level = b.select(b.icmp_signed("<", turn, rests), I64(self.cell.finest + _RESTING), I64(-1))
                    with e.repeat(ahead, last) as number:
                        self._approach(number, b.sub(number, ahead), level)
                with e.repeat(ahead, last, LANES) as first:
                    self.begin()
                    with e.repeat(first, e.smaller(b.add(first, I64(LANES)), last)) as number:
                        self._walk(number, b.sub(number, first), b.sub(number, ahead))
                    self.finish(first)
            self.close()
        b.ret_void()

    def prepare(self) -> None:
        """Make what is needed of variables."""

    def begin(self) -> None:
        """Before a pack of lines."""

    def take(self, line: _Line, lane: Value, rows: Rows, near: Value, far: Value, repeated: Value) -> None:
        """A piece whose coefficients straddle 0; set `going` to 0 where the line need not go on."""
        raise NotImplementedError

    def finish(self, first: Value) -> None:
        """A pack of lines from that number on has ended."""

    def close(self) -> None:
        """A chunk has ended."""

    # --- the way ---

    def _number(self, array: Value, index: Value) -> Value:
        return self.builder.load(self.lanes.advance(array, index, DOUBLE), typ=DOUBLE)

    def _line(self, number: Value) -> _Line:
        """As `ops.reference.height_hits.entered` says."""
        e, b, j = self.lanes, self.builder, self.job
        zero, one = DOUBLE(0.0), DOUBLE(1.0)
        origin, direction = (self._world(array, number) for array in (j.origins, j.directions))
        for axis, (shift, spacing) in enumerate(((j.shift_x, j.spacing_x), (j.shift_y, j.spacing_y))):
            origin[axis] = e.divide(e.subtract(origin[axis], shift), spacing)
            direction[axis] = e.divide(direction[axis], spacing)
        sizes = [self._size(d) for d in direction]
        length = e.divide(one, e.maximum(e.maximum(sizes[0], sizes[1]), sizes[2]))
        direction = [e.multiply(d, length) for d in direction]
        box = list(zip((zero, zero, j.low_z), (j.end_x, j.end_y, j.high_z), strict=True))
        start, last, moving = zero, DOUBLE(math.inf), []
        for o, d, (low, high) in zip(origin, direction, box, strict=True):
            still = b.fcmp_ordered("<=", self._size(d), DOUBLE(NO_MOTION))
            first, second = (e.divide(e.subtract(end, o), b.select(still, one, d)) for end in (low, high))
            within = b.and_(b.fcmp_ordered(">=", o, low), b.fcmp_ordered("<=", o, high))
            near, far = DOUBLE(-math.inf), DOUBLE(math.inf)
            near, far = b.select(within, near, far), b.select(within, far, near)
            start = e.maximum(b.select(still, near, e.minimum(first, second)), start)
            last = e.minimum(b.select(still, far, e.maximum(first, second)), last)
            moving.append(b.select(still, zero, d))
        entry = [
            e.minimum(e.maximum(e.multiply_add(start, d, o), low), high)
            for o, d, (low, high) in zip(origin, moving, box, strict=True)
        ]
        forward = [b.zext(b.fcmp_ordered(">", d, zero), I64) for d in moving[:2]]
        meets = b.fcmp_ordered("<=", start, last)
        return _Line(number, entry, moving, start, e.subtract(last, start), length, forward, meets)

    def _world(self, array: Value, number: Value) -> list[Value]:
        """x, y, z as doubles."""
        b, kind, found = self.builder, ARITHMETIC[self.variant.rays], []
        for axis in range(3):
            place = self.lanes.advance(array, b.add(b.mul(number, I64(3)), I64(axis)), kind)
            one = b.load(place, typ=kind)
            found.append(one if kind == DOUBLE else b.fpext(one, DOUBLE))
        return found

    def _size(self, a: Value) -> Value:
        """|a| of one double."""
        return self.lanes.maximum(a, self.builder.fneg(a))

    def _enter(self, number: Value, place: Value) -> None:
        """A line before its first step."""
        j, line = self.job, self._line(number)
        self.lines.write(place, line.numbers)
        for own, x, count in zip(self.cell_at, line.origin[:2], (j.cells_x, j.cells_y), strict=True):
            own.value = self._cell_of(x, I64(0), self.builder.sub(count, I64(1)))
        self.level.value, self.s.value, self.arrived.value = j.top, DOUBLE(0.0), line.meets
        self._keep(place)

    def _entered(self, number: Value, place: Value) -> _Line:
        """A line again, that has got somewhere."""
        b, numbers = self.builder, self.lines.read(place)
        direction, (start, far, length) = numbers[3:6], numbers[6:]
        forward = [b.zext(b.fcmp_ordered(">", d, DOUBLE(0.0)), I64) for d in direction[:2]]
        return _Line(number, numbers[:3], direction, start, far, length, forward, I1(1))

    def _state(self) -> list[Variable]:
        return [*self.cell_at, self.s, self.level, self.arrived]

    def _keep(self, place: Value) -> None:
        self.states.write(place, [own.value for own in self._state()])

    def _take_up(self, place: Value) -> None:
        for own, value in zip(self._state(), self.states.read(place), strict=True):
            own.value = value

    def _approach(self, number: Value, place: Value, resting: Value) -> None:
        """Down to the first cell in which a line may meet something, or below the level where it rests.

        What it reads next is asked for: the data of the cell, or all bounds within its block.
        """
        self._take_up(place)
        with self.builder.if_then(self.arrived.value):
            line = self._entered(number, place)
            self.going.value, self.arrived.value, self.resting.value = I1(1), I1(0), resting
            with self.lanes.repeat_while(lambda: self.going.value):
                self._step(line, self._arrive, self._rest)
            self._keep(place)

    def _arrive(self, cell: Sequence[Value], s: Value, out: Value) -> None:
        self.going.value, self.arrived.value = I1(0), I1(1)
        self.windows.ask(*cell)

    def _rest(self, cell: Sequence[Value], level: Value) -> None:
        """Where a line goes down from a level."""
        with self.builder.if_else(self.builder.icmp_signed("==", level, self.resting.value)) as (rest, on):
            with rest:
                self.going.value, self.arrived.value = I1(0), I1(1)
                self._ask_for_all_bounds(cell)
            with on:
                self._ask_for_bounds(cell, level)

    def _walk(self, number: Value, lane: Value, place: Value) -> None:
        """From the first cell on."""
        self._take_up(place)
        with self.builder.if_then(self.arrived.value):
            line = self._entered(number, place)
            self.going.value, self.ended_at.value, self.ended_with.value = I1(1), DOUBLE(-1.0), DOUBLE(0.0)
            with self.lanes.repeat_while(lambda: self.going.value):
                self._step(line, partial(self._in_cell, line, lane), self._ask_for_bounds)

    def _cell_of(self, place: Value, low: Value, high: Value) -> Value:
        """⌊place⌋ within [low, high]."""
        b = self.builder
        whole = b.fptosi(place, I64)
        whole = b.sub(whole, b.zext(b.fcmp_ordered("<", place, b.sitofp(whole, DOUBLE)), I64))
        return self.lanes.smaller(self._larger(whole, low), high)

    def _larger(self, a: Value, c: Value) -> Value:
        return self.builder.select(self.builder.icmp_signed(">", a, c), a, c)

    def _step(
        self,
        line: _Line,
        in_cell: Callable[[Sequence[Value], Value, Value], None],
        going_down: Callable[[Sequence[Value], Value], None],
    ) -> None:
        e, b = self.lanes, self.builder
        level, s = self.level.value, self.s.value
        cell = [own.value for own in self.cell_at]
        ways = [self._way(line, axis, cell[axis], level) for axis in range(2)]
        out = e.maximum(e.minimum(e.minimum(*ways), line.far), s)
        self.relevant.value, self.on.value = I1(1), I1(1)
        with b.if_then(b.icmp_signed(">=", level, I64(self.cell.finest))):
            self.relevant.value = self._meets(line, cell, level, s, out)
        with b.if_then(self.relevant.value), b.if_else(b.icmp_signed(">", level, I64(0))) as (down, here):
            with down:
                self.level.value, self.on.value = self._lower(level), I1(0)
                going_down(cell, level)
            with here:
                in_cell(cell, s, out)
        with b.if_then(b.and_(self.on.value, self.going.value)):
            self._advance(line, cell, level, ways, out)

    def _way(self, line: _Line, axis: int, cell: Value, level: Value) -> Value:
        """s where the line leaves its block along an axis."""
        e, b = self.lanes, self.builder
        plane = b.shl(b.add(b.ashr(cell, level), line.forward[axis]), level)
        direction = line.direction[axis]
        way = e.divide(e.subtract(b.sitofp(plane, DOUBLE), line.origin[axis]), direction)
        return b.select(b.fcmp_ordered("==", direction, DOUBLE(0.0)), DOUBLE(math.inf), way)

    def _meets(self, line: _Line, cell: Sequence[Value], level: Value, s: Value, out: Value) -> Value:
        """Whether the line may meet something in its block."""
        e, b = self.lanes, self.builder
        block = self._bounds(cell, level)
        low, high = (b.fpext(b.load(e.advance(block, I64(k), FLOAT), typ=FLOAT), DOUBLE) for k in range(2))
        first, last = (line.at(e, 2, at) for at in (s, out))
        below = b.fcmp_ordered("<=", e.minimum(first, last), high)
        return b.and_(below, b.fcmp_ordered(">=", e.maximum(first, last), low))

    def _bounds(self, cell: Sequence[Value], level: Value) -> Value:
        """Where those of a cell's block are."""
        e, b, j = self.lanes, self.builder, self.job
        own = b.sub(level, I64(self.cell.finest))
        start, width = (b.load(e.advance(array, own, I64), typ=I64) for array in (j.starts, j.widths))
        x, y = (b.ashr(n, level) for n in cell)
        return e.advance(j.bounds, b.shl(b.add(start, b.add(b.mul(y, width), x)), I64(1)), FLOAT)

    def _ask_for_bounds(self, cell: Sequence[Value], level: Value) -> None:
        """Some levels below this one."""
        below = self._larger(self.builder.sub(level, I64(_LEVELS_AHEAD)), I64(self.cell.finest))
        self.lanes.ask(self._bounds(cell, below))

    def _ask_for_all_bounds(self, cell: Sequence[Value]) -> None:
        """Within a block where lines rest: rows of the blocks below."""
        b, (x, y) = self.builder, cell
        for level in range(self.cell.finest, self.cell.finest + _RESTING):
            top = b.and_(y, I64(-1 << self.cell.finest + _RESTING))
            for row in range(0, 1 << self.cell.finest + _RESTING, 1 << level):
                self.lanes.ask(self._bounds([x, b.add(top, I64(row))], I64(level)))

    def _advance(self, line: _Line, cell: Sequence[Value], level: Value, ways: Sequence[Value], out: Value) -> None:
        """To the beginning of the next block."""
        e, b, j = self.lanes, self.builder, self.job
        along_y, up = b.fcmp_ordered("<", ways[1], ways[0]), self._higher(level)
        self.s.value = out
        leaves = inside = None
        for axis, count in enumerate((j.cells_x, j.cells_y)):
            own, forward = cell[axis], b.icmp_signed("!=", line.forward[axis], I64(0))
            backward = b.fcmp_ordered("<", line.direction[axis], DOUBLE(0.0))
            low = b.shl(b.ashr(own, level), level)
            next_ = b.add(low, b.shl(I64(1), level))
            high = e.smaller(b.sub(next_, I64(1)), b.sub(count, I64(1)))
            least, most = b.select(forward, own, low), b.select(backward, own, high)
            place = self._cell_of(line.at(e, axis, out), least, most)
            across = b.select(forward, next_, b.sub(low, I64(1)))
            new = b.select(along_y if axis else b.not_(along_y), across, place)
            self.cell_at[axis].value = new
            left = b.icmp_signed("!=", b.ashr(new, up), b.ashr(own, up))
            fits = b.and_(b.icmp_signed(">=", new, I64(0)), b.icmp_signed("<", new, count))
            leaves = left if leaves is None else b.or_(leaves, left)
            inside = fits if inside is None else b.and_(inside, fits)
        self.level.value = b.select(leaves, e.smaller(up, j.top), level)
        self.going.value = b.and_(inside, b.fcmp_ordered("<", out, line.far))

    def _lower(self, level: Value) -> Value:
        """See `ops.height_hits`: of the smallest blocks cells."""
        b, finest = self.builder, I64(self.cell.finest)
        return b.select(b.icmp_signed(">", level, finest), b.sub(level, I64(1)), I64(0))

    def _higher(self, level: Value) -> Value:
        """Of cells the smallest blocks."""
        b, finest = self.builder, I64(self.cell.finest)
        return b.select(b.icmp_signed(">=", level, finest), b.add(level, I64(1)), finest)

    # --- cells ---

    def _in_cell(self, line: _Line, lane: Value, cell: Sequence[Value], near: Value, far: Value) -> None:
        e, b = self.lanes, self.builder
        crossing, upper_first = self._diagonal(line, cell)
        between = e.minimum(e.maximum(crossing, near), far)
        self.windows.go_to(*cell)
        for number, value in enumerate(self.windows.coefficients()):
            b.store(value, e.advance(self.points, I64(number), DOUBLE))
        for number, s in enumerate((near, between, far)):
            b.store(s, e.advance(self.ends, I64(number), DOUBLE))
        for number, passed in enumerate((b.fcmp_ordered(">=", crossing, near), b.fcmp_ordered("<=", crossing, far))):
            b.store(passed, e.advance(self.passed, I64(number), I1))
        self._restrict(line, cell, [near, between, far], upper_first)
        with e.repeat(I64(0), I64(2)) as k:
            passed = b.load(e.advance(self.passed, k, I1), typ=I1)
            with b.if_then(b.and_(passed, self.going.value)):
                self._piece(line, lane, k)

    def _diagonal(self, line: _Line, cell: Sequence[Value]) -> tuple[Value, Value]:
        """s where the line crosses the diagonal of its cell, ±∞ beside it, and whether it comes from the upper side."""
        e, b, (x, y) = self.lanes, self.builder, cell
        zero, mirrored = DOUBLE(0.0), self.cell.mirrored
        o, d = (
            e.subtract(rows[1], rows[0]) if mirrored else e.add(rows[0], rows[1])
            for rows in (line.origin, line.direction)
        )
        level = b.sitofp(b.sub(y, x) if mirrored else b.add(b.add(x, y), I64(1)), DOUBLE)
        beside = b.select(b.fcmp_ordered("<=", o, level), DOUBLE(math.inf), DOUBLE(-math.inf))
        crossing = e.divide(e.subtract(level, o), d)
        return b.select(b.fcmp_ordered("==", d, zero), beside, crossing), b.fcmp_ordered(">=", d, zero)

    def _restrict(self, line: _Line, cell: Sequence[Value], ends: Sequence[Value], upper_first: Value) -> None:
        """Coefficients of both pieces, in order, into `pieces`."""
        e, b = self.lanes, self.builder
        places = [self._place(line, cell, s) for s in ends]
        heights = [line.at(e, 2, s) for s in ends]
        first, second = ([(*places[k], heights[k]) for k in own] for own in ((0, 1), (1, 2)))
        choose = lambda a, c: [b.select(upper_first, x, y) for x, y in zip(a, c, strict=True)]  # noqa: E731
        upper = [choose(*pair) for pair in zip(first, second, strict=True)]
        lower = [choose(*pair) for pair in zip(second, first, strict=True)]
        one = DOUBLE(1.0)
        turned = [[e.subtract(one, s), e.subtract(one, t), z] for s, t, z in lower]
        s, t, z = (self._pack(column) for column in zip(*upper, *turned, strict=True))
        weights = [e.subtract(e.subtract(e.constant(1), s), t), s, t]
        rows = self._blossoms(weights)
        other = self._swapped(z)
        for number, row in enumerate(rows):  # lanes 0 and 2 are number, 1 and 3 are n − number
            line_ = e.multiply_add(e.subtract(other, z), e.constant(number / DEGREE), z)
            c = e.subtract(row, line_)
            for lane in range(4):
                place = number if lane % 2 == 0 else DEGREE - number
                if 2 * number == DEGREE and lane % 2:
                    continue
                is_first = upper_first if lane < 2 else b.not_(upper_first)
                index = b.add(b.select(is_first, I64(0), I64(_N)), I64(place))
                b.store(e.lane(c, lane), e.advance(self.pieces, index, DOUBLE))

    def _place(self, line: _Line, cell: Sequence[Value], s: Value) -> list[Value]:
        """s and t in the cell, from the side where the upper triangle has its right angle."""
        e, b, out = self.lanes, self.builder, []
        for axis in range(2):
            own = e.subtract(line.origin[axis], b.sitofp(cell[axis], DOUBLE))
            place = e.multiply_add(s, line.direction[axis], own)
            out.append(e.minimum(e.maximum(place, DOUBLE(0.0)), DOUBLE(1.0)))
        return [e.subtract(DOUBLE(1.0), out[0]), out[1]] if self.cell.mirrored else out

    def _pack(self, numbers: Sequence[Value]) -> Value:
        pack = self.lanes.constant(0)
        for lane, number in enumerate(numbers):
            pack = self.builder.insert_element(pack, number, I64(lane))
        return pack

    def _swapped(self, pack: Value) -> Value:
        """p and q, each in the other's place."""
        return self.lanes.shuffle(pack, pack, [1, 0, 3, 2])

    def _blossoms(self, own: Sequence[Value]) -> list[Value]:
        """c_0, c_1, c_2 in the lanes of p, c_4, c_3, c_2 in those of q, from weights of p and q."""
        other = [self._swapped(w) for w in own]
        thrice = self._to(self._to(self._corners(), own, 3), own, 2)
        twice_and_other = self._to(thrice, other, 1)
        thrice = self._to(thrice, own, 1)
        return [*self._to(thrice, own, 0), *self._to(thrice, other, 0), *self._to(twice_and_other, other, 0)]

    def _corners(self) -> list[Value]:
        """The coefficients of the upper triangle in two lanes, of the lower one in two."""
        e, found = self.lanes, []
        for upper, lower in zip(UPPER, LOWER, strict=True):
            up, low = (e.everywhere(self._number(self.points, I64(n))) for n in (upper, lower))
            found.append(e.shuffle(up, low, [0, 1, 6, 7]))
        return found

    def _to(self, rows: Sequence[Value], weights: Sequence[Value], degree: int) -> list[Value]:
        """A step of de Casteljau's algorithm, to so low a degree."""
        e = self.lanes
        place = {alpha: n for n, alpha in enumerate(bernstein.multi_indices(degree + 1, 2))}
        found = []
        for i, j, k in bernstein.multi_indices(degree, 2):
            corners = ((i + 1, j, k), (i, j + 1, k), (i, j, k + 1))
            total = None
            for corner, weight in zip(corners, weights, strict=True):
                total = e.multiply_add(rows[place[corner]], weight, total)
            found.append(total)
        return found

    def _piece(self, line: _Line, lane: Value, k: Value) -> None:
        """Number k of a cell."""
        e, b, zero = self.lanes, self.builder, DOUBLE(0.0)
        base = e.advance(self.pieces, b.mul(k, I64(_N)), DOUBLE)
        rows = [self._number(base, I64(n)) for n in range(_N)]
        near, far = (self._number(self.ends, b.add(k, I64(n))) for n in range(2))
        before = self.ended_with.value
        finite = lambda x: b.fcmp_ordered("==", e.subtract(x, x), zero)  # noqa: E731
        joined = b.and_(b.fcmp_ordered("==", near, self.ended_at.value), finite(before))
        joined = b.and_(joined, finite(rows[0]))
        rows[0] = b.select(joined, before, rows[0])
        self.ended_at.value, self.ended_with.value = far, rows[-1]
        low = high = total = rows[0]
        for row in rows[1:]:
            low, high, total = e.minimum(low, row), e.maximum(high, row), e.add(total, row)
        straddles = b.and_(b.fcmp_ordered("<=", low, zero), b.fcmp_ordered(">=", high, zero))
        with b.if_then(b.and_(straddles, finite(total)), likely=False):
            self.take(line, lane, rows, near, far, b.and_(joined, b.fcmp_ordered("==", before, zero)))


class _Located(_Program):
    """Lines keep parts of pieces that have a root, in places, and those of a pack of places are searched together.

    While a piece is taken `here` is its line, and where the piece begins and ends. A piece is the same in every lane.
    """

    here: tuple[_Line, Value, Value]

    def prepare(self) -> None:
        e = self.lanes
        self.search = self.search_of(DEGREE)
        self.rows = e.reserve(DOUBLE, _N * LANES)
        self.a, self.h, self.near, self.far, self.start, self.length = (e.reserve(DOUBLE, LANES) for _ in range(6))
        self.kind = e.reserve(I64, LANES)

    def search_of(self, degree: int) -> FirstRoot:
        """Of roots in a piece."""
        return FirstRoot(self.lanes, degree)

    def place(self) -> Value:
        """The number of the next free place."""
        raise NotImplementedError

    def roots(self, rows: Rows, signs: Signs, repeated: Value) -> None:
        """Keep parts of a piece that have a root; where it begins there is one already if it is `repeated`."""
        raise NotImplementedError

    def clear(self) -> None:
        """No place is taken."""
        e, one, zero = self.lanes, self.lanes.constant(1), self.lanes.constant(0)
        for n in range(_N):
            e.store(one, e.advance(self.rows, I64(n * LANES), DOUBLE))
        for array in (self.a, self.near, self.far, self.start, self.length):
            e.store(zero, array)
        e.store(one, self.h)
        e.store(e.integers(_NOTHING), self.kind)

    def take(self, line: _Line, lane: Value, rows: Rows, near: Value, far: Value, repeated: Value) -> None:
        e, packs = self.lanes, [self.lanes.everywhere(row) for row in rows]
        self.here = line, near, far
        signs = Signs.of(self.search, packs, e.mask(True), e.mask(False))
        self.roots(packs, signs, repeated)

    def keep(self, mask: Value, rows: Rows, a: Value, h: Value) -> None:
        """A part that has a root."""
        e, b, place = self.lanes, self.builder, self.place()
        with b.if_then(e.lane(mask, 0)):
            for n, row in enumerate(rows):
                b.store(e.lane(row, 0), e.advance(self.rows, b.add(place, I64(n * LANES)), DOUBLE))
            for array, pack in ((self.a, a), (self.h, h)):
                b.store(e.lane(pack, 0), e.advance(array, place, DOUBLE))

    def note(self, hit: Value, at_start: Value, at_end: Value) -> None:
        """That there is a root in the next place."""
        e, b, (line, near, far) = self.lanes, self.builder, self.here
        begins, ends = (e.lane(mask, 0) for mask in (at_start, at_end))
        with b.if_then(e.lane(hit, 0)):
            place = self.place()
            kind = b.select(begins, I64(_AT_START), b.select(ends, I64(_AT_END), I64(_INNER)))
            b.store(kind, e.advance(self.kind, place, I64))
            numbers = (self.near, near), (self.far, far), (self.start, line.start), (self.length, line.length)
            for array, value in numbers:
                b.store(value, e.advance(array, place, DOUBLE))
            self.noted(line)

    def noted(self, line: _Line) -> None:
        """A root of a line is in the next place."""
        raise NotImplementedError

    def located(self, search: bool = True) -> Value:
        """t of all places, ∞ of those that are not taken; without a search anywhere in the part."""
        e, b = self.lanes, self.builder
        kind = e.load(self.kind, I64, LANES)
        a, h, near, far = (e.load(x, DOUBLE, LANES) for x in (self.a, self.h, self.near, self.far))
        start, length = (e.load(x, DOUBLE, LANES) for x in (self.start, self.length))
        is_ = lambda k: b.icmp_signed("==", kind, e.integers(k))  # noqa: E731
        within = e.variable(e.constant(0))
        if search:
            with b.if_then(e.any(is_(_INNER))):
                rows = [e.load(e.advance(self.rows, I64(n * LANES), DOUBLE), DOUBLE, LANES) for n in range(_N)]
                within.value = e.multiply_add(self.search.root(rows, is_(_INNER)), h, a)
        own = e.where(is_(_AT_START), e.constant(0), e.where(is_(_AT_END), e.constant(1), within.value))
        s = e.minimum(e.maximum(e.multiply_add(e.subtract(far, near), own, near), near), far)
        return e.where(is_(_NOTHING), e.constant(math.inf), e.multiply(length, e.add(start, s)))


class _First(_Located):
    """Every line waits at its first hit, in the place of its lane."""

    lane: Value

    def begin(self) -> None:
        self.clear()

    def place(self) -> Value:
        return self.lane

    def take(self, line: _Line, lane: Value, rows: Rows, near: Value, far: Value, repeated: Value) -> None:
        self.lane = lane
        super().take(line, lane, rows, near, far, repeated)

    def roots(self, rows: Rows, signs: Signs, repeated: Value) -> None:
        first_root(self.search, signs, self.keep, self.note)

    def noted(self, line: _Line) -> None:
        self.going.value = I1(0)

    def finish(self, first: Value) -> None:
        found = self.located(self.variant.asked == "first")
        self.lanes.store(found, self.lanes.advance(self.job.t, first, DOUBLE))


class _Sheets(_Located):
    """Roots are kept line after line, and searched when there is no place left, or a line may have all its sheets.

    Hits that rounding alone has apart are one.
    """

    search: NextRoots

    def prepare(self) -> None:
        super().prepare()
        e = self.lanes
        self.every = EveryRoot(self.search, self._room, self.keep, self.note)
        self.number, self.found = e.reserve(I64, LANES), e.reserve(DOUBLE, LANES)
        self.taken, self.own = (e.variable(I64(0)) for _ in range(2))  # places, and those of the line itself
        self.last, self.last_number = e.variable(DOUBLE(0.0)), e.variable(I64(-1))
        self.clear()

    def search_of(self, degree: int) -> NextRoots:
        return NextRoots(self.lanes, degree)

    def place(self) -> Value:
        return self.taken.value

    def noted(self, line: _Line) -> None:
        e, b = self.lanes, self.builder
        b.store(line.number, e.advance(self.number, self.taken.value, I64))
        self.taken.value = b.add(self.taken.value, I64(1))
        self.own.value = b.add(self.own.value, I64(1))

    def _has_all(self, line: _Line) -> Value:
        """Whether a line has all sheets, if what it keeps is some."""
        b, j = self.builder, self.job
        written = b.load(self.lanes.advance(j.count, line.number, I64), typ=I64)
        return b.icmp_signed(">=", b.add(written, self.own.value), j.most)

    def roots(self, rows: Rows, signs: Signs, repeated: Value) -> None:
        line, _, _ = self.here
        self.every.write(rows, signs, self.lanes.everywhere(repeated))
        with self.builder.if_then(self._has_all(line)):
            self._write()
            self.going.value = self.builder.not_(self._has_all(line))

    def _room(self, left: Value) -> Value:
        e, b, (line, _, _) = self.lanes, self.builder, self.here
        full, wanting = b.icmp_signed(">=", self.taken.value, I64(LANES)), e.variable(left)
        with b.if_then(b.or_(full, self._has_all(line))):
            self._write()
            wanting.value = b.select(e.everywhere(self._has_all(line)), e.mask(False), left)
        return wanting.value

    def _walk(self, number: Value, lane: Value, place: Value) -> None:
        self.own.value = I64(0)
        super()._walk(number, lane, place)

    def close(self) -> None:
        self._write()

    def _write(self) -> None:
        """Search the roots that are kept, and write them over those that are k before."""
        e = self.lanes
        e.store(self.located(), self.found)
        with e.repeat(I64(0), self.taken.value) as place:
            self._write_one(place)
        e.store(e.integers(_NOTHING), self.kind)
        self.taken.value = self.own.value = I64(0)

    def _write_one(self, place: Value) -> None:
        e, b, j = self.lanes, self.builder, self.job
        t = self._number(self.found, place)
        number = b.load(e.advance(self.number, place, I64), typ=I64)
        x, y, z = (self._size(d) for d in self._world(j.directions, number))
        extent = e.divide(j.extent, e.maximum(e.maximum(x, y), z))
        apart = e.multiply(e.add(t, extent), DOUBLE(PLACES_APART * 2.0**-52))
        same = b.icmp_signed("==", number, self.last_number.value)
        last = b.select(same, self.last.value, DOUBLE(-math.inf))
        self.last.value, self.last_number.value = t, number
        with b.if_then(b.fcmp_ordered(">", e.subtract(t, last), apart)):
            written = e.advance(j.count, number, I64)
            count = b.load(written, typ=I64)
            slot = b.add(b.mul(number, j.sheets), b.urem(count, j.sheets))
            b.store(t, e.advance(j.t, slot, DOUBLE))
            b.store(b.add(count, I64(1)), written)


class _Candidates(_Program):
    """Every piece that may hold a hit is written down, as far as there is room; all are counted."""

    def prepare(self) -> None:
        self.count = self.lanes.variable(I64(0))

    def _walk(self, number: Value, lane: Value, place: Value) -> None:
        self.count.value = I64(0)
        super()._walk(number, lane, place)
        self.builder.store(self.count.value, self.lanes.advance(self.job.count, number, I64))

    def take(self, line: _Line, lane: Value, rows: Rows, near: Value, far: Value, repeated: Value) -> None:
        e, b, j = self.lanes, self.builder, self.job
        count = self.count.value
        with b.if_then(b.icmp_signed("<", count, j.capacity)):
            index = b.add(b.mul(line.number, j.capacity), count)
            flag = b.select(repeated, I8(REPEATED), I8(0))
            places = [e.multiply(line.length, x) for x in (line.start, near, far)]
            arrays = (j.places, places, DOUBLE), (j.pieces, rows, DOUBLE), (j.flags, [flag], I8)
            for array, numbers, kind in arrays:
                for n, number in enumerate(numbers):
                    b.store(number, e.advance(array, b.add(b.mul(index, I64(len(numbers))), I64(n)), kind))
        self.count.value = b.add(count, I64(1))


_PROGRAMS: dict[str, type[_Program]] = {
    "first": _First,
    "met": _First,
    "candidates": _Candidates,
    "sheets": _Sheets,
}
