"""The programs of splines of heights: the rows of a jet at points, and their transpose, added up in heights.

P points at a time. Where they are is found in float64, everything else in the arithmetic of the points; each reads the
data of its own triangle, number by number, by tables that say where the column and the row of an index are stored under
the boundary. A half turn maps the triangles of a cell onto one another, so in each lane the data are V0 + σ (a, b),
with signs σ of its own, and all arithmetic is that of one triangle: the sums of `ops.reference.heights`, masks without
their zeros.
"""

from __future__ import annotations

import ctypes
from collections.abc import Sequence
from dataclasses import dataclass

from llvmlite import ir

from filterlab.ops.cpu import frame, job
from filterlab.ops.cpu.lanes import I32, I64, STORAGE, Lanes, Value
from filterlab.ops.heights import Masks, Pattern, rows

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

    def generate(self) -> str:
        """The program as LLVM IR text."""
        module, function = frame.new_module()
        _Program(self, function).write()
        return str(module)


@dataclass(frozen=True)
class _Located:
    """P points.

    Attributes:
        barycentric: λ.
        signs: σ along columns and rows, 32-bit integers.
        start: (column, row) of V0, 32-bit integers.
        known: a mask: whether both coordinates are finite.
    """

    barycentric: list[Value]
    signs: list[Value]
    start: list[Value]
    known: Value


class _Program:
    def __init__(self, variant: HeightsVariant, function: ir.Function) -> None:
        self.variant = variant
        self.builder = ir.IRBuilder(function.append_basic_block("entry"))
        self.lanes = Lanes(self.builder, variant.arithmetic, variant.lanes)
        self.wide = Lanes(self.builder, "float64", variant.lanes)
        self.storage, self.rows = STORAGE[variant.storage], rows(variant.order)
        self.job = frame.load_job(self.lanes, function.args[0], FIELDS)
        self.masks = Masks(self.lanes, variant.pattern)

    def write(self) -> None:
        e, b, j = self.lanes, self.builder, self.job
        with frame.every_chunk(e, j) as chunk:
            entry, part = b.urem(chunk, j.entries), b.udiv(chunk, j.entries)
            packs = b.udiv(b.add(j.count, I64(e.count - 1)), I64(e.count))
            first = b.mul(part, j.chunk)
            points = e.advance(j.points, b.mul(entry, j.points_entry), e.number)
            own_rows = e.advance(j.rows, e.product(entry, I64(len(self.rows)), j.count), e.number)
            values = e.advance(j.values, b.mul(entry, j.values_entry), self.storage.raw)
            with e.repeat(first, e.smaller(b.add(first, j.chunk), packs)) as pack:
                self._write_pack(b.mul(pack, I64(e.count)), points, own_rows, values)
        b.ret_void()

    def _write_pack(self, first: Value, points: Value, own_rows: Value, values: Value) -> None:
        e, b, j = self.lanes, self.builder, self.job
        left = b.sub(j.count, first)
        within = e.first_lanes(left)
        addresses = [e.advance(own_rows, b.add(b.mul(j.count, I64(n)), first), e.number) for n in range(len(self.rows))]
        at = self._located(*self._points(e.advance(points, b.mul(first, I64(2)), e.number), left))
        if self.variant.operation == "jet":
            for row, address in zip(self._jet(at, values), addresses, strict=True):
                e.store_masked(row, address, within)
        else:
            mask = e.both(within, at.known)
            cotangents = [e.load_masked(address, e.number, within) for address in addresses]
            self._splat(at, values, [e.where(mask, own, e.constant(0)) for own in cotangents])

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

    def _located(self, x: Value, y: Value) -> _Located:
        e, b, m = self.lanes, self.builder, self.variant.pattern.steps
        (s, column), (t, row) = (self._axis(value, axis) for value, axis in ((x, "x"), (y, "y")))
        one, positive, negative = e.constant(1), e.integers_32(1), e.integers_32(-1)
        mirrored = self.variant.pattern.mirrored
        s = e.subtract(one, s) if mirrored else s
        up = b.fcmp_ordered("<=", e.add(s, t), one)
        s, t = (e.where(up, own, e.subtract(one, own)) for own in (s, t))
        down = b.select(up, positive, negative)
        signs = [b.neg(down) if mirrored else down, down]
        start = [
            b.add(own, b.select(b.icmp_signed("<", sign, e.integers_32(0)), e.integers_32(m), e.integers_32(0)))
            for own, sign in zip((column, row), signs, strict=True)
        ]
        barycentric = [e.subtract(e.subtract(one, s), t), s, t]
        known = b.fcmp_ordered("ord", s, t)
        if self.variant.operation == "splat":  # 0 · NaN is NaN
            barycentric = [e.where(known, own, e.constant(0)) for own in barycentric]
        return _Located(barycentric, signs, start, known)

    def _axis(self, x: Value, axis: str) -> tuple[Value, Value]:
        """Where points are within their cells, in [0, 1], and the first datum of these, in 32 bits."""
        w = self.wide
        origin, step, low, high = (
            w.everywhere(getattr(self.job, f"{name}_{axis}")) for name in ("origin", "step", "low", "high")
        )
        place = w.divide(w.subtract(x, origin), step)
        cell = w.floor(place)
        local = self.lanes.convert(w.subtract(place, cell), STORAGE["float64"])
        first = w.multiply(cell, w.constant(self.variant.pattern.steps))
        if self.variant.periodic:
            first = w.subtract(first, w.multiply(w.floor(w.divide(first, high)), high))
            first = w.where(w.less(first, low), w.add(first, high), first)
            first = w.where(w.less(first, high), first, w.subtract(first, high))
        return local, w.to_integer(w.clamp(first, low, high))

    # --- what they read ---

    def _places(self, at: _Located, axis: int) -> tuple[dict[int, list[Value]], dict[int, Value]]:
        """For every step of an offset: where it is stored, for each lane, and whether that is within the data."""
        e, b, j = self.lanes, self.builder, self.job
        table, size = (j.column, j.size_x) if axis == 0 else (j.line, j.size_y)
        found, inside = {}, {}
        for step in sorted({offset[axis] for offset in self.variant.pattern.offsets}):
            index = b.add(at.start[axis], b.mul(at.signs[axis], e.integers_32(step)))
            lanes = [b.sext(b.extract_element(index, I32(lane)), I64) for lane in range(e.count)]
            found[step] = [b.load(e.advance(table, own, I64), typ=I64) for own in lanes]
            if self.variant.zeros:
                most = e.everywhere(b.trunc(size, I32))
                inside[step] = b.icmp_unsigned("<", index, most)
        return found, inside

    def _addresses(self, at: _Located, values: Value) -> list[tuple[list[Value], Value | None]]:
        """For every datum its address, lane by lane, and a mask: whether it is one."""
        (columns, in_columns), (lines, in_lines) = self._places(at, 0), self._places(at, 1)
        found = []
        for a, b in self.variant.pattern.offsets:
            index = [self.builder.add(p, q) for p, q in zip(columns[a], lines[b], strict=True)]
            mask = self.lanes.both(in_columns[a], in_lines[b]) if self.variant.zeros else None
            found.append(([self.lanes.advance(values, own, self.storage.raw) for own in index], mask))
        return found

    def _read(self, addresses: Sequence[Value], mask: Value | None) -> Value:
        e, b = self.lanes, self.builder
        raw = ir.Constant(ir.VectorType(self.storage.raw, e.count), ir.Undefined)
        for lane, address in enumerate(addresses):
            one = b.load(address, typ=self.storage.raw, align=self.storage.bytes)
            raw = b.insert_element(raw, one, I32(lane))
        found = e.convert(raw, self.storage)
        return found if mask is None else e.where(mask, found, e.constant(0))

    # --- what they get and give ---

    def _factors(self, at: _Located) -> list[Value]:
        """By what derivatives along λ1 and λ2 are those along x and y, row by row."""
        e, w = self.lanes, self.wide
        along = []
        for sign, axis in zip(at.signs, "xy", strict=True):
            per_step = w.divide(w.of_integer(sign), w.everywhere(getattr(self.job, f"step_{axis}")))
            along.append(e.convert(per_step, STORAGE["float64"]))
        return [self._power(along, i, j) for i, j in self.rows]

    def _power(self, along: Sequence[Value], i: int, j: int) -> Value:
        total = self.lanes.constant(1)
        for factor in [along[0]] * i + [along[1]] * j:
            total = self.lanes.multiply(total, factor)
        return total

    def _jet(self, at: _Located, values: Value) -> list[Value]:
        e = self.lanes
        data = [self._read(addresses, mask) for addresses, mask in self._addresses(at, values)]
        base = data[self.masks.first]
        coefficients = self.masks.coefficients([e.subtract(datum, base) for datum in data])
        found = self.masks.derivatives(coefficients, at.barycentric, self.variant.order)
        value, *others = (e.multiply(own, factor) for own, factor in zip(found, self._factors(at), strict=True))
        value = e.add(value, base)
        return [value, *(e.multiply_add(value, e.constant(0), own) for own in others)]  # in holes all are NaN

    def _splat(self, at: _Located, values: Value, cotangents: Sequence[Value]) -> None:
        e, b = self.lanes, self.builder
        scaled = [e.multiply(own, factor) for own, factor in zip(cotangents, self._factors(at), strict=True)]
        spread = self.masks.spread(scaled, at.barycentric, self.variant.order)
        for own, (addresses, mask) in zip(spread, self._addresses(at, values), strict=True):
            own = own if mask is None else e.where(mask, own, e.constant(0))
            for lane, address in enumerate(addresses):
                before = b.load(address, typ=e.number, align=self.storage.bytes)
                b.store(b.fadd(before, b.extract_element(own, I32(lane))), address, align=self.storage.bytes)
