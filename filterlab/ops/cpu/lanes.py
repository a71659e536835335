"""The instructions that programs are written in: arithmetic on packs, rows in and out of memory, loops.

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

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
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


_WHOLE = 1.5 * 2.0**52


class Variable:
    """A place in memory; of those on the stack LLVM makes phis, and registers."""

    def __init__(self, builder: ir.IRBuilder, slot: Value, kind: ir.Type) -> None:
        self._builder, self._slot, self._type = builder, slot, kind

    @property
    def value(self) -> Value:
        return self._builder.load(self._slot, typ=self._type)

    @value.setter
    def value(self, value: Value) -> None:
        self._builder.store(value, self._slot)


class Kept:
    """A pack in memory, to be read in parts by a loop."""

    def __init__(self, builder: ir.IRBuilder, place: Value, element: ir.Type) -> None:
        self._builder, self._place, self._element = builder, place, element

    def part(self, index: Value, count: int) -> Value:
        """Part number `index` of `count` lanes each."""
        b = self._builder
        start = b.gep(self._place, [b.mul(index, I64(count))], source_etype=self._element)
        return b.load(start, typ=ir.VectorType(self._element, count), align=_size(self._element))

    def set_part(self, index: Value, value: Value) -> None:
        """Write part number `index`, as many lanes as `value` has."""
        b = self._builder
        start = b.gep(self._place, [b.mul(index, I64(value.type.count))], source_etype=self._element)
        b.store(value, start, align=_size(self._element))

    def all(self, count: int) -> Value:
        """The whole pack, of `count` lanes."""
        return self.part(I64(0), count)

    def number(self, index: Value) -> Value:
        """What one lane has."""
        b = self._builder
        return b.load(b.gep(self._place, [index], source_etype=self._element), typ=self._element)


# Constants are made once for all programs: to write the text of one takes as long as to write some instructions.


@cache
def _everywhere(pack: ir.VectorType, number: str) -> Value:
    """A number, in hexadecimal digits (0 and −0 are equal, their texts are not), in every lane."""
    return ir.Constant(pack, [float.fromhex(number)] * pack.count)


@cache
def _pattern(*lanes: int) -> Value:
    return ir.Constant(ir.VectorType(I32, len(lanes)), list(lanes))


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
        return _everywhere(self.pack, float(value).hex())

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

    def fused(self, a: Value, b: Value, c: Value) -> Value:
        """a · b + c with one rounding, whatever the machine has: slow where that is no instruction."""
        return self._intrinsic(f"llvm.fma.v{self.count}f{self.bits}", self.pack, [a, b, c])

    def polynomial(self, coefficients: Sequence[float], u: Value) -> Value:
        """Σ_j coefficients[j] u^j by Horner's rule; NaN where u is NaN, even for a constant."""
        *lower, highest = coefficients
        if not lower:
            return self.multiply_add(u, self.constant(0), self.constant(highest))
        value = self.constant(highest)
        for c in reversed(lower):
            value = self.multiply_add(value, u, self.constant(c) if c else None)
        return value

    def divide(self, a: Value, b: Value) -> Value:
        return self.builder.fdiv(a, b, flags=FLAGS)

    def negate(self, a: Value) -> Value:
        return self.builder.fneg(a)

    def floor(self, a: Value) -> Value:
        return self._intrinsic(f"llvm.floor.v{self.count}f{self.bits}", self.pack, [a])

    def absolute(self, a: Value) -> Value:
        return self._intrinsic(f"llvm.fabs.v{self.count}f{self.bits}", self.pack, [a])

    def square_root(self, a: Value) -> Value:
        return self._intrinsic(f"llvm.sqrt.v{self.count}f{self.bits}", self.pack, [a])

    def minimum(self, a: Value, b: Value) -> Value:
        """The smaller one; b where either is NaN."""
        return self.builder.select(self.builder.fcmp_ordered("<", a, b), a, b)

    def maximum(self, a: Value, b: Value) -> Value:
        """The larger one; b where either is NaN."""
        return self.builder.select(self.builder.fcmp_ordered(">", a, b), a, b)

    def less(self, a: Value, b: Value) -> Value:
        """A mask: a < b, false where either is NaN."""
        return self.builder.fcmp_ordered("<", a, b)

    def mask(self, value: bool) -> Value:
        """The same in every lane."""
        return ir.Constant(ir.VectorType(I1, self.count), [value] * self.count)

    def both(self, a: Value, b: Value) -> Value:
        """A mask: where two masks hold."""
        return self.builder.and_(a, b)

    def differs(self, a: Value, number: float = 0.0) -> Value:
        """A mask: a ≠ number, NaN included."""
        return self.builder.fcmp_unordered("!=", a, self.constant(number))

    def where(self, mask: Value, a: Value, b: Value) -> Value:
        return self.builder.select(mask, a, b)

    def bits_of(self, a: Value) -> Value:
        """The bit patterns of a pack, integers of the same size."""
        return self.builder.bitcast(a, ir.VectorType(ir.IntType(self.bits), self.count))

    def of_bits(self, a: Value) -> Value:
        return self.builder.bitcast(a, self.pack)

    def integers(self, value: int) -> Value:
        """The same integer, as large as a number of the arithmetic, in every lane."""
        kind = ir.VectorType(ir.IntType(self.bits), self.count)
        return ir.Constant(kind, [value] * self.count)

    def integers_32(self, value: int) -> Value:
        """The same integer of 32 bits in every lane."""
        return ir.Constant(ir.VectorType(I32, self.count), [value] * self.count)

    def to_bits_size(self, a: Value) -> Value:
        """Whole numbers (below 2⁵¹) to integers as large as a number of the arithmetic."""
        if self.bits == 32:
            return self.builder.fptosi(a, ir.VectorType(I32, self.count))
        # few machines convert packs to 64 bits: added to 1.5 · 2⁵², a whole number stands in the last bits of the sum
        return self.builder.sub(self.bits_of(self.add(a, self.constant(_WHOLE))), self.bits_of(self.constant(_WHOLE)))

    def of_bits_size(self, a: Value) -> Value:
        """The reverse."""
        if self.bits == 32:
            return self.builder.sitofp(a, self.pack)
        whole = self.constant(_WHOLE)
        return self.subtract(self.of_bits(self.builder.add(a, self.bits_of(whole))), whole)

    def delayed(self, a: Value, by: int, first: float = 0.0) -> Value:
        """Lane i gets what lane i − by has; `first` comes in at the start."""
        pattern = [lane if lane < by else self.count + lane - by for lane in range(self.count)]
        return self.shuffle(self.constant(first), a, pattern)

    def running_sums(self, a: Value) -> Value:
        """Lane i gets the sum of lanes 0 … i, in log₂P steps."""
        return self._running(a, self.add, neutral=0)

    def running_products(self, a: Value) -> Value:
        """Lane i gets the product of lanes 0 … i, in log₂P steps."""
        return self._running(a, self.multiply, neutral=1)

    def _running(self, a: Value, combine: Callable[[Value, Value], Value], neutral: float) -> Value:
        by = 1
        while by < self.count:
            a, by = combine(a, self.delayed(a, by, neutral)), 2 * by
        return a

    def total(self, a: Value) -> Value:
        """The sum of all lanes as one number, halves added to halves."""
        half = self.count // 2
        while half:
            a, half = (
                self.add(a, self.shuffle(a, a, [(lane + half) % self.count for lane in range(self.count)])),
                half // 2,
            )
        return self.lane(a, 0)

    def lane(self, a: Value, number: int) -> Value:
        return self.builder.extract_element(a, I32(number))

    def any(self, mask: Value) -> Value:
        """Whether the mask is true in some lane."""
        kind = ir.IntType(self.count)
        return self.builder.icmp_unsigned("!=", self.builder.bitcast(mask, kind), kind(0))

    def clamp(self, a: Value, low: Value, high: Value) -> Value:
        """min(max(a, low), high), and low where a is NaN: a comparison with NaN is false and its else branch counts."""
        b = self.builder
        at_least = b.select(b.fcmp_ordered(">", a, low), a, low)
        return b.select(b.fcmp_ordered("<", at_least, high), at_least, high)

    def to_integer(self, a: Value) -> Value:
        """To 32 bits."""
        return self.builder.fptosi(a, ir.VectorType(I32, self.count))

    def of_integer(self, a: Value) -> Value:
        """From 32 bits."""
        return self.builder.sitofp(a, self.pack)

    def widen(self, a: Value) -> Value:
        """Integers that are not negative, to 64 bits."""
        return self.builder.zext(a, ir.VectorType(I64, self.count))

    def everywhere(self, scalar: Value) -> Value:
        """One number, copied to every lane."""
        vector = ir.VectorType(scalar.type, self.count)
        first = self.builder.insert_element(ir.Constant(vector, ir.Undefined), scalar, I32(0))
        return self.shuffle(first, first, [0] * self.count)

    def shuffle(self, a: Value, b: Value, pattern: Sequence[int]) -> Value:
        return self.builder.shuffle_vector(a, b, _pattern(*pattern))

    def join(self, vectors: Sequence[Value]) -> Value:
        """Vectors laid end to end; their number is a power of two."""
        vectors = list(vectors)
        while len(vectors) > 1:
            width = range(2 * vectors[0].type.count)
            vectors = [self.shuffle(a, b, width) for a, b in zip(vectors[::2], vectors[1::2], strict=True)]
        return vectors[0]

    def parts(self, pack: Value, count: int) -> list[Value]:
        """The first `count` lanes, the next ones, and so on; `join` puts them together again."""
        return [self.shuffle(pack, pack, range(first, first + count)) for first in range(0, self.count, count)]

    def transpose(self, packs: Sequence[Value]) -> list[Value]:
        """P packs as the rows of a P×P table -> its columns.

        First within groups of 128 bits, which machines interleave in one instruction (as drawn at the head of
        `ops.cpu.taps`), then whole groups change places.
        """
        packs, count = list(packs), self.count
        group = 128 // self.bits
        tables = [self._transpose_groups(packs[first : first + group]) for first in range(0, count, group)]
        packs = [pack for table in tables for pack in table]
        distance = group
        while distance < count:
            for i in (i for i in range(count) if not i & distance):
                a, b, lower = packs[i], packs[i + distance], [lane & distance == 0 for lane in range(count)]
                own = [lane if low else count + lane - distance for lane, low in enumerate(lower)]
                other = [lane + distance if low else count + lane for lane, low in enumerate(lower)]
                packs[i], packs[i + distance] = self.shuffle(a, b, own), self.shuffle(a, b, other)
            distance *= 2
        return packs

    def _transpose_groups(self, packs: list[Value]) -> list[Value]:
        """As many packs as a group has lanes; every group of lanes is transposed for itself (a perfect shuffle)."""
        half = len(packs) // 2
        low = [first + lane for first in range(0, self.count, 2 * half) for lane in range(half)]
        low, high = ([n for lane in side for n in (lane, self.count + lane)] for side in (low, [n + half for n in low]))
        for _ in range(half.bit_length()):
            pairs = zip(packs[:half], packs[half:], strict=True)
            packs = [self.shuffle(a, b, pattern) for a, b in pairs for pattern in (low, high)]
        return packs

    def first_lanes(self, count: Value) -> Value:
        """True in as many lanes as the integer says, at most P: a mask for the end of a row."""
        b, kind = self.builder, ir.IntType(self.bits)  # as wide as what is masked
        count = b.select(b.icmp_signed(">", count, I64(0)), self.smaller(count, I64(self.count)), I64(0))
        count = count if self.bits == 64 else b.trunc(count, kind)
        lanes = ir.Constant(ir.VectorType(kind, self.count), list(range(self.count)))
        return b.icmp_signed("<", lanes, self.everywhere(count))

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

    def scalar(self, number: Value) -> Value:
        """A double as a number of this arithmetic."""
        return number if self.number == DOUBLE else self.builder.fptrunc(number, self.number)

    def all(self, condition: Value) -> Value:
        """Whether a condition holds in every lane."""
        mask = self.builder.bitcast(condition, ir.IntType(self.count))
        return self.builder.icmp_unsigned("==", mask, mask.type(2**self.count - 1))

    def smaller(self, a: Value, b: Value) -> Value:
        """The smaller one of two integers."""
        return self.builder.select(self.builder.icmp_signed("<", a, b), a, b)

    def product(self, *factors: Value) -> Value:
        """Of integers."""
        product, *others = factors
        for factor in others:
            product = self.builder.mul(product, factor)
        return product

    def given(self, address: Value) -> Value:
        """Whether an address is that of anything."""
        return self.builder.icmp_unsigned("!=", self.builder.ptrtoint(address, I64), I64(0))

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

    def load_quad(self, address: Value, storage: Storage, taps: int, room: bool) -> Value:
        """Three or four numbers as a vector of four; nothing beyond `taps` numbers is read, unless there is room."""
        if taps == 4 or room:
            return self.load(address, storage.raw, 4)
        if storage.bytes < 4:  # machines have no masked loads of bytes and words
            pair = self.load(address, storage.raw, 2)
            last = self.load(self.advance(address, I64(2), storage.raw), storage.raw, 1)
            return self.shuffle(pair, self.shuffle(last, last, [0, 0]), [0, 1, 2, 3])
        quad = ir.VectorType(storage.raw, 4)
        mask = ir.Constant(ir.VectorType(I1, 4), [True, True, True, False])
        return self._intrinsic(
            f"llvm.masked.load.v4{_suffix(storage.raw)}.p0", quad, [address, mask, ir.Constant(quad, None)]
        )

    def load_masked(self, address: Value, element: ir.Type, mask: Value) -> Value:
        """Numbers that lie one after the other, zeros where the mask is false: nothing is read there."""
        kind = ir.VectorType(element, self.count)
        name = f"llvm.masked.load.v{self.count}{_suffix(element)}.p0"
        return self._intrinsic(name, kind, [address, mask, ir.Constant(kind, None)])

    def store_masked(self, value: Value, address: Value, mask: Value) -> None:
        """Write the lanes in which the mask is true, nothing else."""
        name = f"llvm.masked.store.v{self.count}{_suffix(value.type.element)}.p0"
        self._intrinsic(name, ir.VoidType(), [value, address, mask])

    def load_triples(self, address: Value) -> list[Value]:
        """x y z x y z … -> a pack of x, a pack of y, a pack of z."""
        return self.load_tuples(address, 3)

    def load_tuples(self, address: Value, axes: int) -> list[Value]:
        """Of points of so many axes a pack of every coordinate."""
        every = self.load(address, self.number, axes * self.count)
        return [self.shuffle(every, every, range(axis, axes * self.count, axes)) for axis in range(axes)]

    def store_triples(self, packs: list[Value], address: Value) -> None:
        """The inverse of `load_triples`."""
        x, y, z = packs
        xy = self.shuffle(x, y, range(2 * self.count))
        zz = self.shuffle(z, z, [*range(self.count)] * 2)
        order = [lane + axis * self.count for lane in range(self.count) for axis in range(3)]
        self.store(self.shuffle(xy, zz, order), address)

    def reserve(self, element: ir.Type, count: int) -> Value:
        """Address of `count` elements on the stack; write this before any loop."""
        place = self.builder.alloca(element, count)
        place.align = 64
        place.type = POINTER  # llvmlite still remembers what it points to; an address here is an address
        return place

    def variable(self, initial: Value) -> Variable:
        """A value that changes in a loop."""
        with self.builder.goto_entry_block():
            slot = self.builder.alloca(initial.type)
        variable = Variable(self.builder, slot, initial.type)
        variable.value = initial
        return variable

    def at(self, address: Value, kind: ir.Type) -> Variable:
        """What lies at an address."""
        return Variable(self.builder, address, kind)

    def kept(self, pack: Value | None = None) -> Kept:
        """Memory for a pack, this one or one of this arithmetic that is written in parts."""
        kind = self.pack if pack is None else pack.type
        with self.builder.goto_entry_block():
            place = self.builder.alloca(kind)
        place.type = POINTER
        if pack is not None:
            self.builder.store(pack, place)
        return Kept(self.builder, place, kind.element)

    def ask(self, address: Value) -> None:
        """Have the line of memory at an address brought near, if there is one: nothing waits for it, nothing fails."""
        self._intrinsic("llvm.prefetch.p0", ir.VoidType(), [address, I32(0), I32(3), I32(1)])

    def copy(self, target: Value, source: Value, size: Value) -> None:
        """`size` bytes."""
        self._intrinsic("llvm.memcpy.p0.p0.i64", ir.VoidType(), [target, source, size, I1(0)])

    def clear(self, target: Value, size: int | Value) -> None:
        """`size` bytes of zeros."""
        size = I64(size) if isinstance(size, int) else size
        self._intrinsic("llvm.memset.p0.i64", ir.VoidType(), [target, I8(0), size, I1(0)])

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

    @contextmanager
    def repeat_while(self, condition: Callable[[], Value]) -> Iterator[None]:
        """while condition(): what the with-block writes."""
        b = self.builder
        test, body, after = (b.append_basic_block(name) for name in ("test", "body", "after"))
        b.branch(test)
        b.position_at_end(test)
        b.cbranch(condition(), body, after)
        b.position_at_end(body)
        yield
        b.branch(test)
        b.position_at_end(after)


def _size(element: Any) -> int:
    """Bytes of a number in memory, which is also all the alignment that may be counted on."""
    return {FLOAT: 4, DOUBLE: 8, HALF: 2}.get(element) or element.width // 8


def _suffix(element: Any) -> str:
    """How LLVM's intrinsics call a type: i16, f32."""
    return ("i" if isinstance(element, ir.IntType) else "f") + str(8 * _size(element))
