"""The floor of this machine: three tiny programs that do nothing but multiply and add, read, or copy.

    multiply-add   12 independent sums in registers, acc = acc · a + b: more than any latency of today times the units
    read           8 packs at a time from a buffer, combined by exclusive or (which more units can do than additions)
    copy           8 packs at a time from the first half of a buffer to the second

What a jet must do at least is counted from its loops (`sums`, `weights`): S³ taps are summed along x, y and z one
after the other, so that value and gradient of a 3×3×3 kernel take 93 multiply-adds, and the weights by Horner's rule.
"""

from __future__ import annotations

import ctypes
import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import torch
from llvmlite import ir
from torch import Tensor

from filterlab.kernels import Kernel
from filterlab.ops.cpu import compiler
from filterlab.ops.cpu.compiler import compiled
from filterlab.ops.cpu.lanes import I32, I64, POINTER, Lanes, Value

ACCUMULATORS = 12
PACKS = 8  # of a step of read and copy


class FloorJob(ctypes.Structure):
    """What a program is told: where its buffer is, how many steps to take over it, how often."""

    _fields_ = [("buffer", ctypes.c_void_p), ("steps", ctypes.c_int64), ("times", ctypes.c_int64)]


def lanes() -> int:
    """Floats of the widest register that this processor multiplies and adds in."""
    wide = compiler.features()
    return 16 if "avx512f" in wide else 8 if "avx" in wide else 4


@dataclass(frozen=True)
class Program:
    """One of the three programs, for packs of `lanes` floats.

    Attributes:
        text: what stands for the text of this module; compiled programs are kept on disk under their attributes.
    """

    kind: str
    lanes: int
    text: str = hashlib.sha256(Path(__file__).read_bytes()).hexdigest()

    def write(self, function: ir.Function) -> None:
        """It, into an empty function; everything it depends on is in the attributes."""
        e = Lanes(ir.IRBuilder(function.append_basic_block("entry")), "float32", self.lanes)
        buffer, steps, times = (
            e.builder.load(e.advance(function.args[0], I64(i), I64), typ=kind)
            for i, kind in enumerate((POINTER, I64, I64))
        )
        {"multiply-add": self._multiply_add, "read": self._read, "copy": self._copy}[self.kind](e, buffer, steps, times)
        e.builder.ret_void()

    def _multiply_add(self, e: Lanes, buffer: Value, steps: Value, times: Value) -> None:
        a, b = (e.load(e.advance(buffer, I64(i * e.count), e.number), e.number, e.count) for i in range(2))
        sums = [e.variable(e.constant(i)) for i in range(ACCUMULATORS)]
        with e.repeat(I64(0), e.builder.mul(steps, times)):
            for one in sums:
                one.value = e.multiply_add(one.value, a, b)
        for i, one in enumerate(sums):
            e.store(one.value, e.advance(buffer, I64((2 + i) * e.count), e.number))

    def _read(self, e: Lanes, buffer: Value, steps: Value, times: Value) -> None:
        zero = ir.Constant(ir.VectorType(I32, e.count), [0] * e.count)
        seen = [e.variable(zero) for _ in range(PACKS)]
        with e.repeat(I64(0), times), e.repeat(I64(0), steps) as step:
            for i, one in enumerate(seen):
                one.value = e.builder.xor(one.value, e.load(self._pack(e, buffer, step, i), I32, e.count))
        for i, one in enumerate(seen):
            e.store(one.value, e.advance(buffer, I64(i * e.count), I32))

    def _copy(self, e: Lanes, buffer: Value, steps: Value, times: Value) -> None:
        target = self._pack(e, buffer, steps, 0)
        with e.repeat(I64(0), times), e.repeat(I64(0), steps) as step:
            packs = [e.load(self._pack(e, buffer, step, i), I32, e.count) for i in range(PACKS)]
            for i, pack in enumerate(packs):
                e.store(pack, self._pack(e, target, step, i))

    def _pack(self, e: Lanes, buffer: Value, step: Value, i: int) -> Value:
        index = e.builder.add(e.builder.mul(step, I64(PACKS * e.count)), I64(i * e.count))
        return e.advance(buffer, index, I32)


def multiply_adds(count: int) -> Callable[[], Tensor]:
    """A call that does `count` multiply-adds of single floats, rounded up to whole steps; returns its sums."""
    width = lanes()
    buffer = torch.cat((torch.full((width,), 0.5), torch.full((width,), 1.0), torch.zeros(ACCUMULATORS * width)))
    return _call(Program("multiply-add", width), buffer, -(-count // (ACCUMULATORS * width)), 1)


def reads(size: int, times: int = 1) -> Callable[[], Tensor]:
    """A call that reads `size` bytes `times` times."""
    width = lanes()
    return _call(Program("read", width), torch.zeros(size // 4, dtype=torch.int32), size // (PACKS * width * 4), times)


def copies(size: int, times: int = 1) -> Callable[[], Tensor]:
    """A call that copies `size` bytes `times` times."""
    width = lanes()
    buffer = torch.zeros(2 * size // 4, dtype=torch.int32)
    return _call(Program("copy", width), buffer, size // (PACKS * width * 4), times)


def _call(program: Program, buffer: Tensor, steps: int, times: int) -> Callable[[], Tensor]:
    function = compiled(program)

    job = FloorJob(buffer.data_ptr(), steps, times)

    def call() -> Tensor:
        function(ctypes.addressof(job), 0, 1)
        return buffer

    return call


def sums(support: int, order: int = 1) -> int:
    """Multiply-adds of a jet once the weights are known, per point: the loops of `filterlab.ops.cpu.taps`, counted.

    S² rows give a line for every m_x and add it to a plane for every (m_x, m_y); S planes are added to every row of the
    jet. Order 1: S²(2S + 3) + 4S, which is 93 for S = 3 and 192 for S = 4. The first term of a sum, a product only,
    counts as one.
    """
    orders = range(order + 1)
    planes = sum(1 for mx in orders for my in orders if mx + my <= order)
    rows = sum(1 for mx in orders for my in orders for mz in orders if mx + my + mz <= order)
    return support**2 * (support * (order + 1) + planes) + support * rows


def weights(kernel: Kernel, order: int = 1) -> int:
    """Multiply-adds of the weights and their derivatives along three axes, per point: one per power of u of every tap.

    Quadratic B-spline: 3 axes · 3 taps · (2 + 1) = 27; cubic: 3 · 4 · (3 + 2) = 60. Finding the first tap (floor,
    comparisons, two subtractions an axis) is not counted.
    """
    degree = kernel.taps(torch.float64).shape[1] - 1
    return 3 * kernel.support * sum(max(degree - m, 0) for m in range(order + 1))
