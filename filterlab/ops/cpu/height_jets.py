"""The programs of splines of heights: the rows of a jet at points, and their transpose, added up in heights.

P points are a pack. Where they are is found in float64, everything else in the arithmetic of the points; each reads the
data of its own triangle (`ops.cpu.height_data`). A half turn maps the triangles of a cell onto one another, so in each
lane the data are V0 + σ (a, b), with signs σ of its own, and all arithmetic is that of one triangle: the sums of
`ops.reference.heights`, masks without their zeros.

Packs are located some turns before they are summed: memory brings the data of points that lie all over while others are
summed. Meanwhile machines do not notice that points and rows lie one after the other: these are asked for as well.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass

from llvmlite import ir

from filterlab.ops.cpu import frame, job
from filterlab.ops.cpu.height_data import Data
from filterlab.ops.cpu.lanes import DOUBLE, I32, I64, STORAGE, Lanes, Value
from filterlab.ops.heights import Masks, Pattern, rows

_LINE = 64  # bytes
_LINES_ASKED = 128  # of memory, about, for data that are not read yet
_POINTS_ASKED = 8  # packs before they are located
_NEAR = 16  # data: points that are no farther from the one before have theirs in lines that are there
_BEYOND = 2.0**31 - 256  # columns or rows, of points: further than any grid has

# Strides are in numbers.
FIELDS: dict[str, type] = {
    "next": ctypes.c_int64,  # the chunk to be taken next; threads add 1 atomically
    "values": ctypes.c_void_p,  # (N, H, W); read by jet, added to by splat
    "points": ctypes.c_void_p,  # (N, M, 2)
    "rows": ctypes.c_void_p,  # (N, R, M); written by jet, read by splat
    "column": ctypes.c_void_p,  # where the column of an index is stored, int64, and those before it
    "line": ctypes.c_void_p,  # the same of rows
    "values_entry": ctypes.c_int64,  # from one grid to the next
    "points_entry": ctypes.c_int64,
    "count": ctypes.c_int64,  # M
    "entries": ctypes.c_int64,  # N; chunk c is part c // N of entry c % N
    "chunk": ctypes.c_int64,  # packs of a chunk
    "chunks": ctypes.c_int64,  # `next` stops here
    **{f"{name}_{axis}": ctypes.c_double for name in ("origin", "step") for axis in "xy"},  # of cells
    **{f"{name}_{axis}": ctypes.c_double for name in ("low", "high") for axis in "xy"},  # of a cell's first datum
    **{f"size_{axis}": ctypes.c_int64 for axis in "xy"},  # W, H
    "row_step": ctypes.c_int64,  # from one row of heights to the next
}


class HeightsJob(job.Job):
    _fields_ = tuple(FIELDS.items())


@dataclass(frozen=True)
class HeightsVariant:
    """Everything the program depends on, apart from the machine.

    Attributes:
        operation: "jet" or "splat".
        pattern: the spline.
        order: of the jet.
        periodic: whether indices are folded into one period, which is `high`, or clamped between `low` and `high`.
        zeros: whether heights are 0 beyond their ends.
        arithmetic: "float32" or "float64": type of points, rows and sums.
        storage: of the heights; of splat the same as `arithmetic`.
        lanes: P.
    """

    operation: str
    pattern: Pattern
    order: int
    periodic: bool
    zeros: bool
    arithmetic: str
    storage: str
    lanes: int

    def write(self, function: ir.Function) -> None:
        """The program, into an empty function."""
        _Program(self, function).write()


@dataclass(frozen=True)
class _Located:
    """P points.

    Attributes:
        local: λ1, λ2.
        start: (column, row) of V0, 32-bit integers.
        signs: σ along columns and rows, 32-bit integers.
    """

    local: list[Value]
    start: list[Value]
    signs: list[Value]


def _packs_at_once(variant: HeightsVariant) -> int:
    """How many packs are kept, from where they are located to where they are summed: a power of two."""
    fitting = _LINES_ASKED // (variant.pattern.lines * variant.lanes)
    return max(2, 1 << fitting.bit_length() >> 1)


class _Program:
    def __init__(self, variant: HeightsVariant, function: ir.Function) -> None:
        self.variant = variant
        self.builder = ir.IRBuilder(function.append_basic_block("entry"))
        self.lanes = Lanes(self.builder, variant.arithmetic, variant.lanes)
        self.wide = Lanes(self.builder, "float64", variant.lanes)
        self.storage, self.rows = STORAGE[variant.storage], rows(variant.order)
        self.job = frame.load_job(self.lanes, function.args[0], FIELDS)
        self.masks, self.packs = Masks(self.lanes, variant.pattern), _packs_at_once(variant)
        self.data = Data(self.lanes, self.job, variant.pattern, self.storage, variant.zeros, self.packs)
        self.local = self.lanes.reserve(self.lanes.number, 2 * self.packs * variant.lanes)
        self.down = self.lanes.reserve(I32, self.packs * variant.lanes)
        per_step = (self.wide.divide(DOUBLE(1), getattr(self.job, f"step_{axis}")) for axis in "xy")
        self.per_step = [self.lanes.convert(self.wide.everywhere(own), STORAGE["float64"]) for own in per_step]

    def write(self) -> None:
        e, b, j = self.lanes, self.builder, self.job
        with frame.every_chunk(e, j) as chunk:
            entry, part = b.urem(chunk, j.entries), b.udiv(chunk, j.entries)
            packs = b.udiv(b.add(j.count, I64(e.count - 1)), I64(e.count))
            first = b.mul(part, j.chunk)
            points = e.advance(j.points, b.mul(entry, j.points_entry), e.number)
            own_rows = e.advance(j.rows, e.product(entry, I64(len(self.rows)), j.count), e.number)
            values = e.advance(j.values, b.mul(entry, j.values_entry), self.storage.raw)
            last = e.smaller(b.add(first, j.chunk), packs)
            ahead = I64(self.packs - 1)
            with e.repeat(first, b.add(last, ahead)) as found:
                with b.if_then(b.icmp_signed("<", found, last), likely=True):
                    self._ask(b.mul(found, I64(e.count)), points, own_rows)
                    self._find(b.mul(found, I64(e.count)), self._index(found), points, values)
                pack = b.sub(found, ahead)
                with b.if_then(b.icmp_signed(">=", pack, first), likely=True):
                    self._write_pack(b.mul(pack, I64(e.count)), self._index(pack), own_rows, values)
        b.ret_void()

    def _index(self, pack: Value) -> Value:
        """Of a pack among those that are kept."""
        return self.builder.and_(pack, I64(self.packs - 1))

    def _ask(self, first: Value, points: Value, own_rows: Value) -> None:
        """Have what is read one after the other brought near: later points, and the cotangents of these."""
        e, b = self.lanes, self.builder
        later = b.mul(b.add(first, I64(_POINTS_ASKED * e.count)), I64(2))
        asked = [(points, later, 2 * e.count)]
        if self.variant.operation == "splat":
            asked += [(own_rows, b.add(b.mul(self.job.count, I64(n)), first), e.count) for n in range(len(self.rows))]
        for array, start, count in asked:
            for n in range(0, count, 8 * _LINE // e.bits):
                e.ask(e.advance(array, b.add(start, I64(n)), e.number))

    def _find(self, first: Value, index: Value, points: Value, values: Value) -> None:
        """Locate a pack of points, and their data."""
        e, b, j = self.lanes, self.builder, self.job
        xy = self._points(e.advance(points, b.mul(first, I64(2)), e.number), b.sub(j.count, first))
        places, cells = zip(*map(self._axis, xy, "xy"), strict=True)
        firsts = list(map(self._first, cells))
        at = self._located(places, firsts)
        for n, own in enumerate(at.local):
            e.store(own, self._kept(self.local, 2, index, n, e.number))
        e.store(at.signs[1], self._kept(self.down, 1, index, 0, I32))
        self.data.find(values, index, at.start, at.signs)
        within = e.both(*map(self._within, firsts, "xy"))
        with b.if_then(b.not_(e.all(within)), likely=False):
            start = self._located(places, list(map(self._folded, cells, "xy"))).start
            self.data.copy(values, index, b.not_(within), [*start, *at.signs], self.variant.operation == "splat")
        with b.if_then(self._scattered(at.start)):
            self.data.ask(index)

    def _scattered(self, start: Sequence[Value]) -> Value:
        """Whether data of a pack are far from those of a lane before."""
        e, b = self.lanes, self.builder
        before = [n - 1 for n in range(1, e.count)]
        steps = [b.sub(own, e.shuffle(own, own, [0, *before])) for own in start]
        near = [b.icmp_unsigned("<=", b.add(step, e.integers_32(_NEAR)), e.integers_32(2 * _NEAR)) for step in steps]
        return b.not_(e.all(e.both(*near)))

    def _kept(self, array: Value, packs: int, index: Value, number: int, kind: ir.Type) -> Value:
        """Where pack `number` of so many is that are kept of a pack of points."""
        b = self.builder
        place = b.mul(b.add(b.mul(index, I64(packs)), I64(number)), I64(self.lanes.count))
        return self.lanes.advance(array, place, kind)

    def _write_pack(self, first: Value, index: Value, own_rows: Value, values: Value) -> None:
        e, b, j = self.lanes, self.builder, self.job
        within = e.first_lanes(b.sub(j.count, first))
        addresses = [e.advance(own_rows, b.add(b.mul(j.count, I64(n)), first), e.number) for n in range(len(self.rows))]
        s, t = (e.load(self._kept(self.local, 2, index, n, e.number), e.number, e.count) for n in range(2))
        down = e.load(self._kept(self.down, 1, index, 0, I32), I32, e.count)
        if self.variant.operation == "jet":
            self._store(self._jet(index, s, t, down), addresses, within)
        else:
            known = b.fcmp_ordered("ord", s, t)
            s, t = (e.where(known, own, e.constant(0)) for own in (s, t))  # 0 · NaN is NaN
            mask = e.both(within, known)
            cotangents = [e.load_masked(address, e.number, within) for address in addresses]
            self._splat(index, s, t, down, [e.where(mask, own, e.constant(0)) for own in cotangents])
            self.data.give(values, index)

    def _store(self, found: Sequence[Value], addresses: Sequence[Value], within: Value) -> None:
        """Rows of a pack. No mask where all lanes have points: with one machines take many times as long to store."""
        e, b = self.lanes, self.builder
        with b.if_else(e.all(within), likely=True) as (whole, partly):
            with whole:
                for row, address in zip(found, addresses, strict=True):
                    e.store(row, address)
            with partly:
                for row, address in zip(found, addresses, strict=True):
                    e.store_masked(row, address, within)

    # --- where points are ---

    def _points(self, address: Value, left: Value) -> tuple[Value, Value]:
        """x and y, in float64; 0 beyond the last point."""
        e, b, count = self.lanes, self.builder, self.lanes.count
        left = b.mul(left, I64(2))
        lower, upper = (
            e.load_masked(e.advance(address, I64(n), e.number), e.number, e.first_lanes(b.sub(left, I64(n))))
            for n in (0, count)
        )
        x, y = (e.shuffle(lower, upper, range(axis, 2 * count, 2)) for axis in range(2))
        arithmetic = STORAGE[self.variant.arithmetic]
        return self.wide.convert(x, arithmetic), self.wide.convert(y, arithmetic)

    def _axis(self, x: Value, axis: str) -> tuple[Value, Value]:
        """Where points are within their cells, in [0, 1], and which datum is the first of these, a double."""
        w = self.wide
        origin, step = (w.everywhere(getattr(self.job, f"{name}_{axis}")) for name in ("origin", "step"))
        place = w.divide(w.subtract(x, origin), step)
        cell = w.floor(place)
        local = self.lanes.convert(w.subtract(place, cell), STORAGE["float64"])
        return local, w.multiply(cell, w.constant(self.variant.pattern.steps))

    def _within(self, first: Value, axis: str) -> Value:
        """A mask: whether all data that a cell may need are in the grid."""
        e, b, pattern = self.lanes, self.builder, self.variant.pattern
        most = b.sub(b.trunc(getattr(self.job, f"size_{axis}"), I32), I32(pattern.steps + pattern.reach))
        after = b.icmp_signed(">=", first, e.integers_32(pattern.reach))
        return e.both(after, b.icmp_signed("<", first, e.everywhere(most)))

    def _first(self, first: Value) -> Value:
        """In 32 bits, far beyond the grid where it is not in it."""
        w = self.wide
        return w.to_integer(w.clamp(first, w.constant(-_BEYOND), w.constant(_BEYOND)))

    def _folded(self, first: Value, axis: str) -> Value:
        """As the tables have it, in 32 bits."""
        w = self.wide
        low, high = (w.everywhere(getattr(self.job, f"{name}_{axis}")) for name in ("low", "high"))
        if self.variant.periodic:
            first = w.subtract(first, w.multiply(w.floor(w.divide(first, high)), high))
            first = w.where(w.less(first, low), w.add(first, high), first)
            first = w.where(w.less(first, high), first, w.subtract(first, high))
        return w.to_integer(w.clamp(first, low, high))

    def _located(self, places: Sequence[Value], firsts: Sequence[Value]) -> _Located:
        e, b, m = self.lanes, self.builder, self.variant.pattern.steps
        (s, t), one, positive, negative = places, e.constant(1), e.integers_32(1), e.integers_32(-1)
        mirrored = self.variant.pattern.mirrored
        s = e.subtract(one, s) if mirrored else s
        up = b.fcmp_ordered("<=", e.add(s, t), one)
        local = [e.where(up, own, e.subtract(one, own)) for own in (s, t)]
        down = b.select(up, positive, negative)
        signs = [b.neg(down) if mirrored else down, down]
        start = [
            b.add(own, b.select(b.icmp_signed("<", sign, e.integers_32(0)), e.integers_32(m), e.integers_32(0)))
            for own, sign in zip(firsts, signs, strict=True)
        ]
        return _Located(local, start, signs)

    # --- what they get and give ---

    def _factors(self, down: Value) -> list[Value]:
        """By what derivatives along λ1 and λ2 are those along x and y, row by row."""
        e = self.lanes
        forward, up = self._forward(down), self.builder.icmp_signed(">", down, e.integers_32(0))
        along = [e.where(to, own, e.negate(own)) for to, own in zip((forward, up), self.per_step, strict=True)]
        return [self._power(along, i, j) for i, j in self.rows]

    def _power(self, along: Sequence[Value], i: int, j: int) -> Value:
        total = self.lanes.constant(1)
        for factor in [along[0]] * i + [along[1]] * j:
            total = self.lanes.multiply(total, factor)
        return total

    def _barycentric(self, s: Value, t: Value) -> list[Value]:
        e = self.lanes
        return [e.subtract(e.subtract(e.constant(1), s), t), s, t]

    def _forward(self, down: Value) -> Value:
        return self.builder.icmp_signed("<" if self.variant.pattern.mirrored else ">", down, self.lanes.integers_32(0))

    def _jet(self, index: Value, s: Value, t: Value, down: Value) -> list[Value]:
        e = self.lanes
        forward = self._forward(down)
        base, data = self.data.read(index, forward)
        coefficients = self.masks.coefficients(e.subtract(datum, base) for datum in data)
        found = self.masks.derivatives(coefficients, self._barycentric(s, t), self.variant.order)
        value, *others = (e.multiply(own, factor) for own, factor in zip(found, self._factors(down), strict=True))
        value = e.add(value, base)
        return [value, *(e.multiply_add(value, e.constant(0), own) for own in others)]  # in holes all are NaN

    def _splat(self, index: Value, s: Value, t: Value, down: Value, cotangents: Sequence[Value]) -> None:
        e = self.lanes
        scaled = [e.multiply(own, factor) for own, factor in zip(cotangents, self._factors(down), strict=True)]
        spread = self.masks.spread(scaled, self._barycentric(s, t), self.variant.order)
        self.data.add(index, self._forward(down), spread)
