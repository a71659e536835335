"""The program that finds the parts of bricks that may hold a level, a block of 8³ parts after the other.

Where a block straddles the level as a whole, two lines of its parts are compared at a time; of the others, most of a
volume, no part is read. Bits along x are drawn apart, two to each of four bricks, and lines laid over one another:

    bit x + 2 y + 4 z of brick X:    line (z, y), bit 2 X + x
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass

from llvmlite import ir

from filterlab.ops.cpu import frame, job
from filterlab.ops.cpu.lanes import I16, I32, I64, Lanes, Value

EDGE = 8
"""Parts of a block."""

FIELDS: dict[str, type] = {
    "next": ctypes.c_int64,  # the chunk to be taken next; threads add 1 atomically
    "low": ctypes.c_void_p,  # (K, 8, 8, 8) 16 bits, codes of parts
    "high": ctypes.c_void_p,
    "least": ctypes.c_void_p,  # (K) 16 bits, codes of blocks
    "most": ctypes.c_void_p,
    "below": ctypes.c_int64,  # the least and the greatest code of the level
    "above": ctypes.c_int64,
    "bits": ctypes.c_void_p,  # (K, 4, 4, 4) bytes, written
    "blocks": ctypes.c_int64,  # K
    "chunk": ctypes.c_int64,  # blocks of a chunk
    "chunks": ctypes.c_int64,
}


class BlockBitsJob(job.Job):
    _fields_ = tuple(FIELDS.items())


@dataclass(frozen=True)
class BlockBitsVariant:
    """Everything the program depends on, apart from the machine: nothing."""

    def write(self, function: ir.Function) -> None:
        """The program, into an empty function."""
        _Program(function).write()


class _Program:
    def __init__(self, function: ir.Function) -> None:
        self.builder = ir.IRBuilder(function.append_basic_block("entry"))
        self.lanes = Lanes(self.builder, "float32", 2 * EDGE)  # parts of two lines
        self.job = frame.load_job(self.lanes, function.args[0], FIELDS)

    def write(self) -> None:
        e, b, j = self.lanes, self.builder, self.job
        with frame.every_chunk(e, j) as chunk:
            first = b.mul(chunk, j.chunk)
            with e.repeat(first, e.smaller(b.add(first, j.chunk), j.blocks)) as block:
                self._write_block(block)
        b.ret_void()

    def _write_block(self, block: Value) -> None:
        e, b, j = self.lanes, self.builder, self.job
        least, most = (b.sext(b.load(e.advance(x, block, I16), typ=I16), I64) for x in (j.least, j.most))
        straddles = b.and_(b.icmp_signed("<=", least, j.above), b.icmp_signed(">=", most, j.below))
        size = EDGE // 2
        bits = e.advance(j.bits, b.mul(block, I64(size * size)), I32)
        with b.if_else(straddles) as (some, none):
            with some, e.repeat(I64(0), I64(size)) as z, e.repeat(I64(0), I64(size)) as y:
                self._write_bricks(block, z, y, e.advance(bits, b.add(b.mul(z, I64(size)), y), I32))
            with none:
                e.clear(bits, size**3)

    def _write_bricks(self, block: Value, z: Value, y: Value, place: Value) -> None:
        """Those of four bricks in a row, a byte each."""
        b = self.builder
        found = None
        for dz in range(2):
            plane = b.add(b.mul(block, I64(EDGE)), b.add(b.add(z, z), I64(dz)))
            lines = self._holding(b.add(b.mul(plane, I64(EDGE * EDGE)), b.mul(y, I64(2 * EDGE))))
            for dy in range(2):
                line = b.and_(b.lshr(lines, I32(EDGE * dy)), I32(0xFF))
                own = b.shl(self._in_pairs(line), I32(4 * dz + 2 * dy))
                found = own if found is None else b.or_(found, own)
        b.store(found, place, align=1)

    def _holding(self, first: Value) -> Value:
        """Of two lines of parts: 16 bits, of 32."""
        e, b, j = self.lanes, self.builder, self.job
        low, high = (e.load(e.advance(x, first, I16), I16, e.count) for x in (j.low, j.high))
        below, above = (e.everywhere(b.trunc(code, I16)) for code in (j.below, j.above))
        mask = b.and_(b.icmp_signed("<=", low, above), b.icmp_signed(">=", high, below))
        return b.zext(b.bitcast(mask, I16), I32)

    def _in_pairs(self, line: Value) -> Value:
        """Eight bits, two in each of four bytes."""
        b = self.builder
        for shift, kept in ((12, 0x000F000F), (6, 0x03030303)):
            line = b.and_(b.or_(line, b.shl(line, I32(shift))), I32(kept))
        return line
