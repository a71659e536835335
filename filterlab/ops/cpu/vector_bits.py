"""The program that looks through vectors: one pass over their bits, without their signs.

Bits of floating-point numbers without a sign are ordered as the numbers are, ∞ above all of them and NaN above ∞; they
are 0 where the number is. So greatest = max(x | y | z …) needs no comparison of numbers, and none is lost to a NaN.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import partial, reduce

from llvmlite import ir

from filterlab.ops.cpu import frame, job
from filterlab.ops.cpu.lanes import I64, Lanes

FIELDS: dict[str, type] = {
    "next": ctypes.c_int64,  # the chunk to be taken next
    "vectors": ctypes.c_void_p,  # (R, 3) numbers, contiguous
    "found": ctypes.c_void_p,  # (2) int64: the greatest bits of a component, the least ones of a vector's greatest
    "rows": ctypes.c_int64,  # R
    "chunk": ctypes.c_int64,  # rows of a chunk
    "chunks": ctypes.c_int64,
}


class VectorJob(job.Job):
    _fields_ = tuple(FIELDS.items())


@dataclass(frozen=True)
class VectorVariant:
    """Everything the program depends on, apart from the machine.

    Attributes:
        arithmetic: "float32" or "float64".
        lanes: P, vectors that are looked at together; there must be as many.
    """

    arithmetic: str
    lanes: int

    def write(self, function: ir.Function) -> None:
        """The program, into an empty function."""
        _write(function, self)


def _write(function: ir.Function, variant: VectorVariant) -> None:
    e = Lanes(ir.IRBuilder(function.append_basic_block("entry")), variant.arithmetic, variant.lanes)
    b = e.builder
    j = frame.load_job(e, function.args[0], FIELDS)
    unsigned = e.integers((1 << (e.bits - 1)) - 1)
    most, least = e.variable(e.integers(0)), e.variable(unsigned)
    last = b.sub(j.rows, I64(e.count))  # where the last pack begins, some of which another one has seen too
    with frame.every_chunk(e, j) as chunk:
        first = b.mul(chunk, j.chunk)
        with e.repeat(first, e.smaller(b.add(first, j.chunk), j.rows), e.count) as row:
            packs = e.load_triples(e.advance(j.vectors, b.mul(e.smaller(row, last), I64(3)), e.number))
            largest = reduce(partial(_chosen, b, ">"), (b.and_(e.bits_of(pack), unsigned) for pack in packs))
            most.value = _chosen(b, ">", most.value, largest)
            least.value = _chosen(b, "<", least.value, largest)
    for place, operation, relation, found in ((0, "max", ">", most), (1, "min", "<", least)):
        lanes = (e.lane(found.value, lane) for lane in range(e.count))
        bits = reduce(partial(_chosen, b, relation), lanes)
        bits = bits if e.bits == 64 else b.zext(bits, I64)
        b.atomic_rmw(operation, e.advance(j.found, I64(place), I64), bits, "monotonic")
    b.ret_void()


def _chosen(b: ir.IRBuilder, relation: str, one: ir.Value, other: ir.Value) -> ir.Value:
    """The greater one, or the lesser one; lane by lane."""
    return b.select(b.icmp_signed(relation, one, other), one, other)
