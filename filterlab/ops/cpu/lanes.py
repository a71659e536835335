"""The instructions that the generator speaks: arithmetic on packs, rows in and out of memory, loops.

LLVM IR in six lines. A program is a list of instructions; each makes one new value that never changes afterwards. A
value has a type: i64 an integer of 64 bits, float, ptr an address, <8 x float> eight floats side by side. Instructions
stand in blocks; a block ends by jumping to another. A value that differs by the way one came (a loop counter) is a phi
at the top of a block. `gep` is address arithmetic: pointer + index · size of an element. `shufflevector a, b, pattern`
makes a vector whose lane i is the lane pattern[i] of a and b laid end to end. LLVM maps all of this to what the machine
has: a pack of eight floats is one register with AVX2, two with NEON, half a one with AVX-512.

A *pack* is P numbers, one for each of P points; the place of a point in the pack is its *lane*. Every line of
arithmetic below is written once and done for P points at a time.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

from llvmlite import ir

Value = Any  # an instruction's result; llvmlite comes without types

I1, I8, I16, I32, I64 = (ir.IntType(bits) for bits in (1, 8, 16, 32, 64))
FLOAT, DOUBLE, HALF, POINTER = ir.FloatType(), ir.DoubleType(), ir.HalfType(), ir.PointerType()

ARITHMETIC = {"float32": FLOAT, "float64": DOUBLE}

# A product may keep its digits until it is added (contract: fused multiply-add), and −0 may become 0 (nsz). No other
# licence: a NaN stays a NaN, infinities are not assumed away, sums are not reordered.
FLAGS = ("contract", "nsz")


@dataclass(frozen=True)
class Storage:
    """How a number lies in memory.

    Attributes:
        raw: the type that is loaded and moved about; 16-bit floats travel as integers until they are converted.
        bytes: its size.
        kind: "float", "half", "bfloat", "signed" or "unsigned".
    """

    raw: ir.Type
    bytes: int
    kind: str


STORAGE = {
    "float32": Storage(FLOAT, 4, "float"),
    "float64": Storage(DOUBLE, 8, "float"),
    "float16": Storage(I16, 2, "half"),
    "bfloat16": Storage(I16, 2, "bfloat"),
    "uint8": Storage(I8, 1, "unsigned"),
    "int8": Storage(I8, 1, "signed"),
    "int16": Storage(I16, 2, "signed"),
    "int32": Storage(I32, 4, "signed"),
}


class Variable:
    """A place on the stack; LLVM makes phis of it, and registers."""

    def __init__(self, builder: ir.IRBuilder, slot: Value, initial: Value) -> None:
        self._builder, self._slot, self._type = builder, slot, initial.type
        self.value = initial

    @property
    def value(self) -> Value:
        return self._builder.load(self._slot, typ=self._type)

    @value.setter
    def value(self, value: Value) -> None:
        self._builder.store(value, self._slot)


class Lanes:
    """Writes instructions at the end of the current block.

    Args:
        builder: llvmlite's writer of single instructions.
        arithmetic: "float32" or "float64", the type of every lane of a pack.
        count: P, lanes of a pack; a multiple of 4.
    """

    def __init__(self, builder: ir.IRBuilder, arithmetic: str, count: int) -> None:
        assert count % 4 == 0, count
        self.builder: Any = builder
        self.count = count
        self.number = ARITHMETIC[arithmetic]
        self.bits = 8 * STORAGE[arithmetic].bytes
        self.pack = ir.VectorType(self.number, count)

    # --- arithmetic ---

    def constant(self, value: float) -> Value:
        """The same number in every lane."""
        return ir.Constant(self.pack, [float(value)] * self.count)

    def add(self, a: Value, b: Value) -> Value:
        return self.builder.fadd(a, b, flags=FLAGS)

    def subtract(self, a: Value, b: Value) -> Value:
        return self.builder.fsub(a, b, flags=FLAGS)

    def multiply(self, a: Value, b: Value) -> Value:
        return self.builder.fmul(a, b, flags=FLAGS)

    def multiply_add(self, a: Value, b: Value, c: Value | None) -> Value:
        """a · b + c, in one instruction where the machine has one; a · b for c = None (the first term of a sum)."""
        product = self.multiply(a, b)
        return product if c is None else self.add(product, c)

    def polynomial(self, coefficients: Sequence[float], u: Value) -> Value:
        """Σ_j coefficients[j] u^j by Horner's rule; NaN where u is NaN, even for a constant."""
        *lower, highest = coefficients
        if not lower:
            return self.multiply_add(u, self.constant(0), self.constant(highest))
        value = self.constant(highest)
        for c in reversed(lower):
            value = self.multiply_add(value, u, self.constant(c) if c else None)
        return value

    def floor(self, a: Value) -> Value:
        return self._intrinsic(f"llvm.floor.v{self.count}f{self.bits}", self.pack, [a])

    def clamp(self, a: Value, low: Value, high: Value) -> Value:
        """min(max(a, low), high), and low where a is NaN: a comparison with NaN is false and its else branch counts."""
        b = self.builder
        at_least = b.select(b.fcmp_ordered(">", a, low), a, low)
        return b.select(b.fcmp_ordered("<", at_least, high), at_least, high)

    def to_integer(self, a: Value) -> Value:
        """To 32 bits."""
        return self.builder.fptosi(a, ir.VectorType(I32, self.count))

    def widen(self, a: Value) -> Value:
        """Integers that are not negative, to 64 bits."""
        return self.builder.zext(a, ir.VectorType(I64, self.count))

    def everywhere(self, scalar: Value) -> Value:
        """One number, copied to every lane."""
        vector = ir.VectorType(scalar.type, self.count)
        first = self.builder.insert_element(ir.Constant(vector, ir.Undefined), scalar, I32(0))
        return self.shuffle(first, first, [0] * self.count)

    def shuffle(self, a: Value, b: Value, pattern: Sequence[int]) -> Value:
        return self.builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(I32, len(pattern)), list(pattern)))

    def convert(self, raw: Value, storage: Storage) -> Value:
        """A pack as it lay in memory, as a pack of this arithmetic."""
        b, n = self.builder, self.count
        if storage.kind == "signed":
            return b.sitofp(raw, self.pack)
        if storage.kind == "unsigned":
            return b.uitofp(raw, self.pack)
        if storage.kind == "half":
            raw = b.bitcast(raw, ir.VectorType(HALF, n))
        elif storage.kind == "bfloat":  # the upper half of a float
            upper = b.shl(b.zext(raw, ir.VectorType(I32, n)), ir.Constant(ir.VectorType(I32, n), [16] * n))
            raw = b.bitcast(upper, ir.VectorType(FLOAT, n))
        source = raw.type.element
        if source == self.number:
            return raw
        return b.fptrunc(raw, self.pack) if source == DOUBLE else b.fpext(raw, self.pack)

    def smaller(self, a: Value, b: Value) -> Value:
        """The smaller one of two integers."""
        return self.builder.select(self.builder.icmp_signed("<", a, b), a, b)

    def opaque(self, a: Value) -> Value:
        """The same integer, as if it came from nowhere: an empty piece of assembly that LLVM can't look into.

        Without it LLVM computes the addresses of all rows of all lanes before the loops, in many times more registers
        than there are, instead of adding a lane's address and a row's offset in the load itself.
        """
        return self.builder.asm(ir.FunctionType(I64, [I64]), "", "=r,0", [a], side_effect=False)

    # --- memory ---

    def advance(self, address: Value, index: Value, element: ir.Type) -> Value:
        """address + index elements."""
        return self.builder.gep(address, [index], source_etype=element)

    def load(self, address: Value, element: ir.Type, count: int) -> Value:
        """`count` numbers that lie one after the other."""
        return self.builder.load(address, typ=ir.VectorType(element, count), align=_size(element))

    def store(self, value: Value, address: Value) -> None:
        self.builder.store(value, address, align=_size(value.type.element))

    def load_quad(self, address: Value, storage: Storage, taps: int) -> Value:
        """Three or four numbers as a vector of four; nothing beyond `taps` numbers is read."""
        if taps == 4:
            return self.load(address, storage.raw, 4)
        if storage.bytes < 4:  # machines have no masked loads of bytes and words
            pair = self.load(address, storage.raw, 2)
            last = self.load(self.advance(address, I64(2), storage.raw), storage.raw, 1)
            return self.shuffle(pair, self.shuffle(last, last, [0, 0]), [0, 1, 2, 3])
        quad = ir.VectorType(storage.raw, 4)
        suffix = ("i" if isinstance(storage.raw, ir.IntType) else "f") + str(8 * storage.bytes)
        mask = ir.Constant(ir.VectorType(I1, 4), [True, True, True, False])
        return self._intrinsic(f"llvm.masked.load.v4{suffix}.p0", quad, [address, mask, ir.Constant(quad, None)])

    def reserve(self, element: ir.Type, count: int) -> Value:
        """Address of `count` elements on the stack; write this before any loop."""
        place = self.builder.alloca(element, count)
        place.type = POINTER  # llvmlite still remembers what it points to; an address here is an address
        return place

    def variable(self, initial: Value) -> Variable:
        """A value that changes in a loop."""
        with self.builder.goto_entry_block():
            slot = self.builder.alloca(initial.type)
        return Variable(self.builder, slot, initial)

    def copy(self, target: Value, source: Value, size: Value) -> None:
        """`size` bytes."""
        self._intrinsic("llvm.memcpy.p0.p0.i64", ir.VoidType(), [target, source, size, I1(0)])

    def clear(self, target: Value, size: int) -> None:
        """`size` bytes of zeros."""
        self._intrinsic("llvm.memset.p0.i64", ir.VoidType(), [target, I8(0), I64(size), I1(0)])

    def _intrinsic(self, name: str, result: ir.Type, arguments: list[Value]) -> Value:
        """Call one of LLVM's own functions, declared at its first use."""
        module = self.builder.module
        signature = ir.FunctionType(result, [a.type for a in arguments])
        function = module.globals.get(name) or ir.Function(module, signature, name)
        return self.builder.call(function, arguments)

    # --- control ---

    @contextmanager
    def repeat(self, begin: Value, end: Value, step: int = 1) -> Iterator[Value]:
        """for i in range(begin, end, step): what the with-block writes."""
        b = self.builder
        before, body, after = b.block, b.append_basic_block("body"), b.append_basic_block("after")
        b.cbranch(b.icmp_signed("<", begin, end), body, after)
        b.position_at_end(body)
        i = b.phi(I64, "i")
        i.add_incoming(begin, before)
        yield i
        following = b.add(i, I64(step))
        i.add_incoming(following, b.block)
        b.cbranch(b.icmp_signed("<", following, end), body, after)
        b.position_at_end(after)


def _size(element: Any) -> int:
    """Bytes of a number in memory, which is also all the alignment that may be counted on."""
    return {FLOAT: 4, DOUBLE: 8, HALF: 2}.get(element) or element.width // 8
