"""The program of contract: planes of the result, by bundles of lines.

Of one term a chunk makes some planes of the result (a *block*), and of these some neighbouring lines (a *band*):

    along z    every line of samples that the band depends on, once for each plane of the block, is *kept*
    along y    a *bundle* of lines of the result, still as wide as the samples, from those that are kept
    along x    the bundle transposed, so that a row has one number of every line; rows are summed, and transposed back

What is kept is small enough to stay in the processor's cache, and nothing else is written but the result. A sum goes
through the entries of a row of its matrix, for several packs of neighbouring numbers at a time. Every number is summed
in the same order wherever it stands, so that the result depends neither on chunks nor on the number of threads.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass

from llvmlite import ir

from filterlab.ops.cpu import frame, job
from filterlab.ops.cpu.job import AXES
from filterlab.ops.cpu.lanes import I64, POINTER, STORAGE, Lanes, Value

# Strides and places of sums count elements: places along z are multiples of a plane of samples, along y of a kept line,
# along x of a row of a bundle.
FIELDS: dict[str, type] = {
    "next": ctypes.c_int64,  # the chunk to be taken next; threads add 1 atomically
    "source": ctypes.c_void_p,  # (entries, planes, lines, width)
    "target": ctypes.c_void_p,  # (entries, planes, lines, width) of the result
    "scratch": ctypes.c_void_p,  # an array for every thread: kept lines, a bundle of lines, the same as rows, a tile
    "scratch_size": ctypes.c_int64,
    "bundle": ctypes.c_int64,  # where in it these begin
    "rows": ctypes.c_int64,
    "tile": ctypes.c_int64,
    "source_entry": ctypes.c_int64,  # strides
    "source_line": ctypes.c_int64,
    "target_entry": ctypes.c_int64,
    "target_plane": ctypes.c_int64,
    "target_line": ctypes.c_int64,
    "width": ctypes.c_int64,  # of the samples
    "line": ctypes.c_int64,  # the same in whole packs: from one kept line to the next
    "kept": ctypes.c_int64,  # from one plane of them to the next
    "planes": ctypes.c_int64,  # of the result
    "result": ctypes.c_int64,  # width of the result
    "block": ctypes.c_int64,  # planes of one
    "blocks": ctypes.c_int64,
    "bands": ctypes.c_int64,
    "band": ctypes.c_void_p,  # (bands + 1,) the first line of each
    "needs": ctypes.c_void_p,  # (bands + 1,) the first of the lines that each depends on, among
    "needed": ctypes.c_void_p,  # all of these
    **{f"{name}_{a}": ctypes.c_void_p for a in AXES for name in ("starts", "places", "weights")},
    "chunks": ctypes.c_int64,  # `next` stops here
}


class ContractionJob(job.Job):
    _fields_ = tuple(FIELDS.items())


@dataclass(frozen=True)
class ContractionVariant:
    """Everything the program depends on, apart from the machine.

    Attributes:
        adds: whether the term is added to what the target has.
        arithmetic: "float32" or "float64": dtype of the result and of all that is computed.
        storage: dtype of the samples.
        lanes: P.
        packs: K, of a sum; a bundle has K · P lines.
    """

    adds: bool
    arithmetic: str
    storage: str
    lanes: int
    packs: int

    def write(self, function: ir.Function) -> None:
        """The program, into an empty function."""
        _Program(self, function).write()


Read = Callable[[Value], list[Value]]
"""The packs that lie at a place."""


class _Program:
    def __init__(self, variant: ContractionVariant, function: ir.Function) -> None:
        self.variant, self.function = variant, function
        self.builder = ir.IRBuilder(function.append_basic_block("entry"))
        self.lanes = Lanes(self.builder, variant.arithmetic, variant.lanes)
        self.lines = variant.lanes * variant.packs  # of a bundle
        self.storage = STORAGE[variant.storage]

    def write(self) -> None:
        e, b = self.lanes, self.builder
        self.job = j = frame.load_job(e, self.function.args[0], FIELDS)
        self.targets = e.reserve(I64, self.lines)
        self.kept = e.advance(j.scratch, b.mul(self.function.args[1], j.scratch_size), e.number)
        self.bundle, self.rows, self.tile = (e.advance(self.kept, o, e.number) for o in (j.bundle, j.rows, j.tile))
        with frame.every_chunk(e, j) as chunk:
            block, rest = b.urem(chunk, j.blocks), b.udiv(chunk, j.blocks)
            self._write_band(b.udiv(rest, j.bands), b.mul(block, j.block), b.urem(rest, j.bands))
        b.ret_void()

    def _write_band(self, entry: Value, plane: Value, band: Value) -> None:
        e, b, j = self.lanes, self.builder, self.job
        planes = e.smaller(j.block, b.sub(j.planes, plane))
        source = e.advance(j.source, b.mul(entry, j.source_entry), self.storage.raw)
        self._keep(source, plane, planes, *self._between(j.needs, band))
        first, last = self._between(j.band, band)
        lines = b.sub(last, first)
        target = e.advance(j.target, b.mul(entry, j.target_entry), e.number)
        total = b.mul(planes, lines)
        with e.repeat(I64(0), total, self.lines) as begin:
            count = e.smaller(I64(self.lines), b.sub(total, begin))
            with e.repeat(I64(0), count) as i:
                at = b.add(begin, i)
                own, line = b.udiv(at, lines), b.add(first, b.urem(at, lines))
                self._write_line(i, own, line)
                place = b.add(b.mul(b.add(plane, own), j.target_plane), b.mul(line, j.target_line))
                b.store(e.advance(target, place, e.number), e.advance(self.targets, i, I64))
            self._write_rows(b.sub(count, I64(1)))

    def _between(self, array: Value, i: Value) -> tuple[Value, Value]:
        """array[i], array[i + 1]."""
        e, b = self.lanes, self.builder
        first, last = (b.load(e.advance(array, at, I64), typ=I64) for at in (i, b.add(i, I64(1))))
        return first, last

    # --- along z, and along y ---

    def _keep(self, source: Value, plane: Value, planes: Value, first: Value, last: Value) -> None:
        """Of lines `needed` first … last−1: their sums for some planes of the result."""
        e, b, j = self.lanes, self.builder, self.job
        with e.repeat(I64(0), planes) as own:
            span = self._between(j.starts_z, b.add(plane, own))
            with e.repeat(first, last) as i:
                line = b.load(e.advance(j.needed, i, I64), typ=I64)
                samples = e.advance(source, b.mul(line, j.source_line), self.storage.raw)
                kept = b.add(b.mul(own, j.kept), b.mul(b.sub(i, first), j.line))
                self._every_column(
                    j.width,
                    lambda x, packs, mask: self._sum("z", span, packs, self._samples(samples, x, packs, mask)),
                    e.advance(self.kept, kept, e.number),
                )

    def _samples(self, line: Value, x: Value, packs: int, mask: Value | None) -> Read:
        e, raw = self.lanes, self.storage.raw
        begin = e.advance(line, x, raw)

        def read(place: Value) -> list[Value]:
            first = e.advance(begin, place, raw)
            where = [e.advance(first, I64(k * e.count), raw) for k in range(packs)]
            loaded = [e.load(w, raw, e.count) if mask is None else e.load_masked(w, raw, mask) for w in where]
            return [e.convert(pack, self.storage) for pack in loaded]

        return read

    def _write_line(self, i: Value, own: Value, line: Value) -> None:
        """Line i of the bundle, from the kept ones of one plane."""
        e, b, j = self.lanes, self.builder, self.job
        span = self._between(j.starts_y, line)
        kept = e.advance(self.kept, b.mul(own, j.kept), e.number)
        self._every_column(
            j.line,
            lambda x, packs, _: self._sum("y", span, packs, self._numbers(e.advance(kept, x, e.number), packs)),
            e.advance(self.bundle, b.mul(i, j.line), e.number),
        )

    def _numbers(self, begin: Value, packs: int) -> Read:
        """Packs that lie one after the other."""
        e = self.lanes

        def read(place: Value) -> list[Value]:
            first = e.advance(begin, place, e.number)
            return [e.load(e.advance(first, I64(k * e.count), e.number), e.number, e.count) for k in range(packs)]

        return read

    def _every_column(
        self, width: Value, packs_at: Callable[[Value, int, Value | None], list[Value]], target: Value
    ) -> None:
        """A line: bundles of packs, packs, and the rest, which is written as a whole pack."""
        e, b = self.lanes, self.builder
        bundled, packed = (b.sub(width, b.urem(width, I64(n))) for n in (self.lines, e.count))
        for begin, end, packs in ((I64(0), bundled, self.variant.packs), (bundled, packed, 1), (packed, width, 1)):
            with e.repeat(begin, end, packs * e.count) as x:
                mask = e.first_lanes(b.sub(width, x)) if begin is packed else None
                for k, pack in enumerate(packs_at(x, packs, mask)):
                    e.store(pack, e.advance(target, b.add(x, I64(k * e.count)), e.number))

    def _sum(self, axis: str, span: tuple[Value, Value], packs: int, read: Read) -> list[Value]:
        """Σ weight · packs at the place, over entries of a matrix."""
        e, b = self.lanes, self.builder
        places, weights = (getattr(self.job, f"{name}_{axis}") for name in ("places", "weights"))
        totals = [e.variable(e.constant(0)) for _ in range(packs)]
        with e.repeat(*span) as t:
            weight = e.everywhere(b.load(e.advance(weights, t, e.number), typ=e.number))
            values = read(b.load(e.advance(places, t, I64), typ=I64))
            for total, value in zip(totals, values, strict=True):
                total.value = e.multiply_add(weight, value, total.value)
        return [total.value for total in totals]

    # --- along x ---

    def _write_rows(self, last: Value) -> None:
        """The bundle as rows, and their sums, P at a time, as lines of the result; line `last` is the last one."""
        e, b, j, p = self.lanes, self.builder, self.job, self.lanes.count
        for group in range(self.variant.packs):
            lines = [b.mul(e.smaller(I64(group * p + lane), last), j.line) for lane in range(p)]
            with e.repeat(I64(0), j.line, p) as x:
                packs = [e.load(e.advance(self.bundle, b.add(line, x), e.number), e.number, p) for line in lines]
                for i, pack in enumerate(e.transpose(packs)):
                    place = b.add(b.mul(b.add(x, I64(i)), I64(self.lines)), I64(group * p))
                    e.store(pack, e.advance(self.rows, place, e.number))
        whole = b.sub(j.result, b.urem(j.result, I64(p)))
        for begin, end in ((I64(0), whole), (whole, j.result)):
            with e.repeat(begin, end, p) as x:
                self._write_tile(x, last, e.first_lanes(b.sub(j.result, x)) if begin is whole else None)

    def _write_tile(self, x: Value, last: Value, mask: Value | None) -> None:
        """P numbers of every line of the bundle."""
        e, b, j, p = self.lanes, self.builder, self.job, self.lanes.count
        read = self._numbers(self.rows, self.variant.packs)
        with e.repeat(I64(0), I64(p)) as i:
            span = self._between(j.starts_x, e.smaller(b.add(x, i), b.sub(j.result, I64(1))))
            for k, pack in enumerate(self._sum("x", span, self.variant.packs, read)):
                place = b.add(b.mul(i, I64(self.lines)), I64(k * p))
                e.store(pack, e.advance(self.tile, place, e.number))
        with e.repeat(I64(0), b.add(last, I64(1)), p) as group:
            first = e.advance(self.tile, group, e.number)
            rows = [e.load(e.advance(first, I64(i * self.lines), e.number), e.number, p) for i in range(p)]
            for lane, pack in enumerate(e.transpose(rows)):
                line = b.add(group, I64(lane))
                with b.if_then(b.icmp_signed("<=", line, last), likely=True):
                    address = b.load(e.advance(self.targets, line, I64), typ=POINTER)
                    self._write(pack, e.advance(address, x, e.number), mask)

    def _write(self, pack: Value, address: Value, mask: Value | None) -> None:
        e = self.lanes
        if self.variant.adds:
            there = e.load(address, e.number, e.count) if mask is None else e.load_masked(address, e.number, mask)
            pack = e.add(there, pack)
        if mask is None:
            e.store(pack, address)
        else:
            e.store_masked(pack, address, mask)
