"""The program of the prefilter: lines of samples in, lines of coefficients out.

Along every line, with the poles z of the prefilter and any boundary, `prefilters` asks for

    forwards    a_i = f_i + z a_{i−1}        from zero, far enough before the line
    backwards   c_i = a_i + z c_{i+1}        from zero, far enough behind it

for one pole after the other, and a gain. Here all poles go forwards together, then all of them backwards: each takes
what the one before it has just made. A line is *extended* by reading it through a table: `places` says which of its
samples stands at each place of the extended line (−1: a zero). So there is no code for boundaries here either.

One line is slow: every step waits for the one before it. P lines at a time are a *pack* (`ops.cpu.lanes`), K packs
side by side a *bundle*, K steps that wait for nothing but their own past. The i-th numbers of all its lines are a *row*
of a bundle; a is kept in a scratch array of rows, small enough to stay in the processor's cache.

    lines that are neighbours in memory (along y and z)       a row is a piece of memory
    lines along x                                             P×P tables are transposed on the way in and out

A plane is filtered along x and then, in place and still in the cache, along y; all planes are filtered before the first
column along z. A volume passes through memory twice. Every number is computed by the same operations wherever its line
stands in a bundle, so that the result depends neither on the chunks nor on the number of threads.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass

from llvmlite import ir

from filterlab.ops.cpu import frame, job
from filterlab.ops.cpu.lanes import DOUBLE, I64, POINTER, STORAGE, Lanes, Storage, Value, Variable

# Strides count elements. A chunk is `part` lines of one plane, or `part` neighbouring columns of one entry.
FIELDS: dict[str, type] = {
    "next": ctypes.c_int64,  # the chunk to be taken next; threads add 1 atomically
    "source": ctypes.c_void_p,  # (entries, planes, lines, width) along x; (entries, length, width) for columns
    "target": ctypes.c_void_p,  # the same with `count` places instead of the length of the axis; the place of sample 0
    "scratch": ctypes.c_void_p,  # an array for every thread
    "scratch_size": ctypes.c_int64,  # of one scratch array: first the rows of a, then, from
    "transposed": ctypes.c_int64,  # this element on, a bundle of lines along x as rows
    "source_entry": ctypes.c_int64,  # strides
    "source_plane": ctypes.c_int64,
    "source_row": ctypes.c_int64,
    "target_entry": ctypes.c_int64,
    "target_plane": ctypes.c_int64,
    "target_row": ctypes.c_int64,
    "planes": ctypes.c_int64,
    "lines": ctypes.c_int64,
    "width": ctypes.c_int64,
    "warm_up": ctypes.c_int64,  # places beyond each end of the result after which nothing matters
    "places": ctypes.c_void_p,  # int64, count + 2 · warm_up: along x, or of the columns
    "count": ctypes.c_int64,  # coefficients of a line
    "along_y": ctypes.c_int64,  # 1: planes are filtered along y, too, with
    "places_y": ctypes.c_void_p,
    "count_y": ctypes.c_int64,
    "before_y": ctypes.c_int64,  # rows of the target before `target`
    "poles": ctypes.c_void_p,  # float64
    "gain": ctypes.c_double,
    "part": ctypes.c_int64,
    "parts": ctypes.c_int64,  # chunks of a plane or of an entry
    "chunks": ctypes.c_int64,  # `next` stops here
}


class RecursionJob(job.Job):
    _fields_ = tuple(FIELDS.items())


@dataclass(frozen=True)
class RecursionVariant:
    """Everything the program depends on, apart from the machine.

    Attributes:
        columns: True for columns, False for lines along x and then, if the job says so, the columns of the plane.
        poles: how many, at least one.
        arithmetic: "float32" or "float64": dtype of the result and of all that is computed.
        storage: dtype of the source.
        lanes: P.
        packs: K.
    """

    columns: bool
    poles: int
    arithmetic: str
    storage: str
    lanes: int
    packs: int

    def write(self, function: ir.Function) -> None:
        """The program, into an empty function."""
        _Program(self, function).write()


class _Rows:
    """Rows of a bundle in memory, one every `stride` elements.

    Attributes:
        packs: how many stand side by side.
        mask: the lanes that there are; None: all of them.
    """

    def __init__(
        self, lanes: Lanes, address: Value, stride: Value, storage: Storage, packs: int, mask: Value | None = None
    ) -> None:
        self.lanes, self.address, self.stride, self.storage = lanes, address, stride, storage
        self.packs, self.mask = packs, mask

    def at(self, row: Value) -> Value:
        return self.lanes.advance(self.address, self.lanes.builder.mul(row, self.stride), self.storage.raw)

    def load(self, address: Value) -> list[Value]:
        e = self.lanes
        return [e.convert(_load(e, where, self.storage, self.mask), self.storage) for where in self._packs(address)]

    def store(self, row: Value, packs: list[Value]) -> None:
        for where, pack in zip(self._packs(self.at(row)), packs, strict=True):
            _store(self.lanes, pack, where, self.mask)

    def _packs(self, address: Value) -> list[Value]:
        e = self.lanes
        return [e.advance(address, I64(k * e.count), self.storage.raw) for k in range(self.packs)]


class _Program:
    def __init__(self, variant: RecursionVariant, function: ir.Function) -> None:
        self.variant, self.function = variant, function
        self.builder = ir.IRBuilder(function.append_basic_block("entry"))
        self.lanes = Lanes(self.builder, variant.arithmetic, variant.lanes)
        self.bundle = variant.lanes * variant.packs  # lines
        self.storage, self.number = STORAGE[variant.storage], STORAGE[variant.arithmetic]

    def write(self) -> None:
        e, b = self.lanes, self.builder
        self.job = j = frame.load_job(e, self.function.args[0], FIELDS)
        self.gain = e.everywhere(e.scalar(j.gain))
        where = [e.advance(j.poles, I64(i), DOUBLE) for i in range(self.variant.poles)]
        self.poles = [e.everywhere(e.scalar(b.load(address, typ=DOUBLE))) for address in where]
        self.no_gain = e.constant(1)
        self.zeros = e.reserve(e.number, self.bundle)  # the samples' own numbers are not larger
        for first in range(0, self.bundle, e.count):
            e.store(e.constant(0), e.advance(self.zeros, I64(first), e.number))
        self.sources, self.targets = (e.reserve(I64, self.bundle) for _ in range(2))
        own = b.mul(self.function.args[1], j.scratch_size)
        self.scratch = e.advance(j.scratch, own, e.number)
        self.transposed = e.advance(self.scratch, j.transposed, e.number)
        with frame.every_chunk(e, j) as chunk:
            first = b.mul(b.urem(chunk, j.parts), j.part)
            write_chunk = self._filter_entry if self.variant.columns else self._filter_plane
            write_chunk(b.udiv(chunk, j.parts), first)
        b.ret_void()

    def _filter_entry(self, entry: Value, first: Value) -> None:
        """Columns of an entry, from `first` on."""
        e, b, j = self.lanes, self.builder, self.job
        source = e.advance(j.source, b.mul(entry, j.source_entry), self.storage.raw)
        target = e.advance(j.target, b.mul(entry, j.target_entry), e.number)
        last = e.smaller(b.add(first, j.part), j.width)
        self._filter_columns(
            (source, j.source_row, self.storage), (target, j.target_row, self.number), first, last, j.places, j.count
        )

    def _filter_plane(self, plane: Value, first: Value) -> None:
        """Lines of a plane, from `first` on; then all its columns, in place, if the job says so."""
        e, b, j = self.lanes, self.builder, self.job
        entry, z = b.udiv(plane, j.planes), b.urem(plane, j.planes)
        source_offset = b.add(b.mul(entry, j.source_entry), b.mul(z, j.source_plane))
        target_offset = b.add(b.mul(entry, j.target_entry), b.mul(z, j.target_plane))
        source = e.advance(j.source, source_offset, self.storage.raw)
        target = e.advance(j.target, target_offset, e.number)
        last = e.smaller(b.add(first, j.part), j.lines)
        with e.repeat(first, last, self.bundle) as line:
            self._filter_lines(source, target, line, last)
        with e.repeat(I64(0), j.along_y):
            before = e.advance(target, b.neg(b.mul(j.before_y, j.target_row)), e.number)
            self._filter_columns(
                (target, j.target_row, self.number),
                (before, j.target_row, self.number),
                I64(0),
                j.count,
                j.places_y,
                j.count_y,
                gain=self.no_gain,
            )

    # --- lines that are neighbours in memory ---

    def _filter_columns(
        self,
        source: tuple[Value, Value, Storage],
        target: tuple[Value, Value, Storage],
        first: Value,
        last: Value,
        places: Value,
        count: Value,
        gain: Value | None = None,
    ) -> None:
        """Columns first … last−1 of arrays given by address, stride and storage: whole bundles, packs, and the rest."""
        b, lanes = self.builder, self.lanes.count
        bundled = b.sub(last, b.urem(b.sub(last, first), I64(self.bundle)))
        packed = b.sub(last, b.urem(b.sub(last, first), I64(lanes)))
        ranges = [(first, bundled, self.variant.packs), (bundled, packed, 1), (packed, last, 1)]
        for begin, end, packs in ranges:
            with self.lanes.repeat(begin, end, packs * lanes) as column:
                mask = self.lanes.first_lanes(b.sub(last, column)) if begin is packed else None
                from_rows, to_rows = (
                    _Rows(self.lanes, self.lanes.advance(address, column, s.raw), stride, s, packs, mask)
                    for address, stride, s in (source, target)
                )
                self._sweep(from_rows, to_rows, places, count, gain or self.gain)

    # --- lines along x ---

    def _filter_lines(self, source: Value, target: Value, first: Value, last: Value) -> None:
        """A bundle of lines from `first` on. Beyond the last line it is repeated: the same is written again."""
        e, b, j = self.lanes, self.builder, self.job
        with e.repeat(I64(0), I64(self.bundle)) as i:
            line = e.smaller(b.add(first, i), b.sub(last, I64(1)))
            for table, address, stride, raw in (
                (self.sources, source, j.source_row, self.storage.raw),
                (self.targets, target, j.target_row, e.number),
            ):
                b.store(e.advance(address, b.mul(line, stride), raw), e.advance(table, i, I64))
        self._every_tile(self.sources, j.width, self._transpose_in)
        rows = _Rows(e, self.transposed, I64(self.bundle), self.number, self.variant.packs)
        self._sweep(rows, rows, j.places, j.count, self.gain)
        self._every_tile(self.targets, j.count, self._transpose_out)

    def _every_tile(
        self, table: Value, length: Value, transpose: Callable[[list[Value], Value, Value, Value | None], None]
    ) -> None:
        """P numbers of P lines at a time: `transpose`, given their addresses, x, the address as rows, and a mask."""
        e, b, p = self.lanes, self.builder, self.lanes.count
        whole = b.sub(length, b.urem(length, I64(p)))
        with e.repeat(I64(0), I64(self.bundle), p) as first:
            lines = [b.load(e.advance(table, b.add(first, I64(lane)), I64), typ=POINTER) for lane in range(p)]
            for begin, end in ((I64(0), whole), (whole, length)):
                with e.repeat(begin, end, p) as x:
                    mask = e.first_lanes(b.sub(length, x)) if begin is whole else None
                    row = e.advance(self.transposed, b.add(b.mul(x, I64(self.bundle)), first), e.number)
                    transpose(lines, x, row, mask)

    def _transpose_in(self, lines: list[Value], x: Value, row: Value, mask: Value | None) -> None:
        e = self.lanes
        raw = [_load(e, e.advance(line, x, self.storage.raw), self.storage, mask) for line in lines]
        for i, pack in enumerate(e.transpose([e.convert(r, self.storage) for r in raw])):
            e.store(pack, e.advance(row, I64(i * self.bundle), e.number))

    def _transpose_out(self, lines: list[Value], x: Value, row: Value, mask: Value | None) -> None:
        e = self.lanes
        packs = [e.load(e.advance(row, I64(i * self.bundle), e.number), e.number, e.count) for i in range(e.count)]
        for line, pack in zip(lines, e.transpose(packs), strict=True):
            _store(e, pack, e.advance(line, x, e.number), mask)

    # --- the recursions ---

    def _sweep(self, source: _Rows, target: _Rows, places: Value, count: Value, gain: Value) -> None:
        """Forwards through the extended source, backwards into the target; they may be the same array."""
        e, b, warm_up = self.lanes, self.builder, self.job.warm_up
        kept = _Rows(e, self.scratch, I64(source.packs * e.count), self.number, source.packs)
        states = self._start(source.packs)
        with e.repeat(I64(0), warm_up) as i:
            self._step(states, source.load(self._place(source, places, i)))
        with e.repeat(I64(0), b.add(count, warm_up)) as i:
            values = source.load(self._place(source, places, b.add(i, warm_up)))
            kept.store(i, self._step(states, values))
        states, last = self._start(source.packs), b.sub(count, I64(1))
        with e.repeat(I64(0), warm_up) as i:
            self._step(states, kept.load(kept.at(b.sub(b.add(last, warm_up), i))))
        with e.repeat(I64(0), count) as i:
            row = b.sub(last, i)
            values = self._step(states, kept.load(kept.at(row)))
            target.store(row, [e.multiply(gain, value) for value in values])

    def _place(self, source: _Rows, places: Value, i: Value) -> Value:
        """Address of the row that stands at place i of the extended lines."""
        b = self.builder
        place = b.load(self.lanes.advance(places, i, I64), typ=I64)
        return b.select(b.icmp_signed("<", place, I64(0)), self.zeros, source.at(place))

    def _start(self, packs: int) -> list[list[Variable]]:
        """[pack][pole]: what the recursions remember of the row before."""
        return [[self.lanes.variable(self.lanes.constant(0)) for _ in self.poles] for _ in range(packs)]

    def _step(self, states: list[list[Variable]], values: list[Value]) -> list[Value]:
        """One row further."""
        results = []
        for state, value in zip(states, values, strict=True):
            for pole, remembered in zip(self.poles, state, strict=True):
                value = self.lanes.multiply_add(pole, remembered.value, value)
                remembered.value = value
            results.append(value)
        return results


def _load(e: Lanes, address: Value, storage: Storage, mask: Value | None) -> Value:
    if mask is None:
        return e.load(address, storage.raw, e.count)
    return e.load_masked(address, storage.raw, mask)


def _store(e: Lanes, pack: Value, address: Value, mask: Value | None) -> None:
    if mask is None:
        e.store(pack, address)
    else:
        e.store_masked(pack, address, mask)
