"""The program that finds how far around bricks none may hold a level: 64 bricks along x at a time, a bit each.

    near[0]                     bricks that may hold it
    near[r + 1] from near[r]    these and all beside them: along x, then y, then z, in words
    clear                       how many of near[0] … near[8] a brick is in none of, by the binary digits of that number
    mark                        bits of parts − clear: one of them is 0

Around every plane of words are rows that stay 0, around all planes two that do; a word beyond every row keeps what
leaves it from coming in on the other side.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass

from llvmlite import ir

from filterlab.ops.cpu import frame, job
from filterlab.ops.cpu.lanes import I1, I8, I16, I64, Lanes, Value

_LANES = 4  # words at a time
_BRICKS = 16  # marks at a time
WORD = 64
"""Bricks of a word."""

FIELDS: dict[str, type] = {
    "next": ctypes.c_int64,  # the chunk to be taken next
    "near": ctypes.c_void_p,  # (9, planes + 2, rows + 2, words + 1) words: the first is read, the others written
    "along_x": ctypes.c_void_p,  # (planes + 2, rows + 2, words + 1) words of 0, written in between
    "along_y": ctypes.c_void_p,
    "bits": ctypes.c_void_p,  # (planes, rows, words · 64) bytes
    "marks": ctypes.c_void_p,  # (planes, rows, words · 64) 16 bits, written
    "planes": ctypes.c_int64,
    "rows": ctypes.c_int64,
    "words": ctypes.c_int64,
    "chunks": ctypes.c_int64,  # 1
}


class ClearBricksJob(job.Job):
    _fields_ = tuple(FIELDS.items())


@dataclass(frozen=True)
class ClearBricksVariant:
    """Everything the program depends on, apart from the machine.

    Attributes:
        radii: how many bricks around are looked at.
    """

    radii: int

    def write(self, function: ir.Function) -> None:
        """The program, into an empty function."""
        _Program(self.radii, function).write()


class _Program:
    def __init__(self, radii: int, function: ir.Function) -> None:
        self.radii = radii
        self.builder = b = ir.IRBuilder(function.append_basic_block("entry"))
        self.lanes = Lanes(b, "float64", _LANES)
        self.marks = Lanes(b, "float32", _BRICKS)
        self.job = j = frame.load_job(self.lanes, function.args[0], FIELDS)
        self.row = b.add(j.words, I64(1))
        self.plane = b.mul(b.add(j.rows, I64(2)), self.row)
        self.volume = b.mul(b.add(j.planes, I64(2)), self.plane)

    def write(self) -> None:
        e, b, j = self.lanes, self.builder, self.job
        with frame.every_chunk(e, j):
            with e.repeat(I64(0), I64(self.radii)) as radius:
                near = e.advance(j.near, b.mul(radius, self.volume), I64)
                self._pass(near, j.along_x, self._beside_along_x)
                self._pass(j.along_x, j.along_y, lambda at, kind: self._beside(at, self.row, kind))
                following = e.advance(near, self.volume, I64)
                self._pass(j.along_y, following, lambda at, kind: self._beside(at, self.plane, kind))
            self._write_marks()
        b.ret_void()

    # --- words, and what is beside them ---

    def _pass(self, source: Value, target: Value, of: Callable[[Value, ir.Type], Value]) -> None:
        """target = of(source), of all rows that words are in."""
        e, b, j = self.lanes, self.builder, self.job
        count = b.mul(j.rows, self.row)
        whole = b.and_(count, I64(-_LANES))
        with e.repeat(I64(1), b.add(j.planes, I64(1))) as z:
            first = b.add(b.mul(z, self.plane), self.row)
            for begin, end, kind in ((I64(0), whole, ir.VectorType(I64, _LANES)), (whole, count, I64)):
                with e.repeat(begin, end, _LANES if kind != I64 else 1) as place:
                    index = b.add(first, place)
                    b.store(of(e.advance(source, index, I64), kind), e.advance(target, index, I64), align=8)

    def _load(self, address: Value, away: Value, kind: ir.Type) -> Value:
        return self.builder.load(self.lanes.advance(address, away, I64), typ=kind, align=8)

    def _beside(self, at: Value, step: Value, kind: ir.Type) -> Value:
        b = self.builder
        before, behind = (self._load(at, away, kind) for away in (b.sub(I64(0), step), step))
        return b.or_(self._load(at, I64(0), kind), b.or_(before, behind))

    def _beside_along_x(self, at: Value, kind: ir.Type) -> Value:
        b = self.builder
        before, own, behind = (self._load(at, I64(away), kind) for away in (-1, 0, 1))
        one, last = (self._same(number, kind) for number in (1, WORD - 1))
        out = b.or_(own, b.or_(b.shl(own, one), b.lshr(own, one)))
        return b.or_(out, b.or_(b.lshr(before, last), b.shl(behind, last)))

    def _same(self, number: int, kind: ir.Type) -> Value:
        return ir.Constant(kind, number if kind == I64 else [number] * _LANES)

    # --- marks ---

    def _write_marks(self) -> None:
        e, b, j = self.lanes, self.builder, self.job
        with e.repeat(I64(0), j.planes) as z, e.repeat(I64(0), j.rows) as y, e.repeat(I64(0), j.words) as word:
            rows = b.add(b.mul(b.add(z, I64(1)), self.plane), b.mul(b.add(y, I64(1)), self.row))
            digits = self._digits(b.add(rows, word))
            own = b.add(b.mul(b.add(b.mul(z, j.rows), y), j.words), word)
            for part in range(WORD // _BRICKS):
                self._write_part(b.add(b.mul(own, I64(WORD)), I64(part * _BRICKS)), digits, part)

    def _digits(self, index: Value) -> list[Value]:
        """Words of the binary digits of how many near words bits are in none of, the least first."""
        e, b = self.lanes, self.builder
        clear = [
            b.not_(b.load(e.advance(self.job.near, b.add(b.mul(self.volume, I64(r)), index), I64), typ=I64))
            for r in range(self.radii + 1)
        ]  # each of these leaves out more than the one before
        found = []
        for place in range(len(clear).bit_length()):
            size, digit = 1 << place, I64(0)
            for first in range(size - 1, len(clear), 2 * size):
                more = clear[first]
                if first + size < len(clear):
                    more = b.and_(more, b.not_(clear[first + size]))
                digit = b.or_(digit, more)
            found.append(digit)
        return found

    def _write_part(self, place: Value, digits: list[Value], part: int) -> None:
        """Marks of some of a word's bricks."""
        e, b, j = self.marks, self.builder, self.job
        kind = ir.VectorType(I16, _BRICKS)
        mark = b.zext(e.load(e.advance(j.bits, place, I8), I8, _BRICKS), kind)
        for exponent, digit in enumerate(digits):
            own = b.bitcast(b.trunc(b.lshr(digit, I64(part * _BRICKS)), I16), ir.VectorType(I1, _BRICKS))
            weight = ir.Constant(kind, [1 << exponent] * _BRICKS)
            mark = b.sub(mark, b.select(own, weight, ir.Constant(kind, None)))
        e.store(mark, e.advance(j.marks, place, I16))
