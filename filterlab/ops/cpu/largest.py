"""The program that finds the largest sample along rays: rays in, numbers of segments out.

`ops.cpu.traversal` finds runs of segments, whose middles are sampled as a march samples them. Few runs have a sample
that is larger than all before: only of those the lanes are compared one after the other.
"""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass

from llvmlite import ir

from filterlab.ops.cpu import frame, job
from filterlab.ops.cpu.compositing import FIELDS as OF_A_MARCH
from filterlab.ops.cpu.compositing import WRITTEN_OUT, Parts
from filterlab.ops.cpu.job import AXES
from filterlab.ops.cpu.lanes import DOUBLE, I64, STORAGE, Lanes, Value
from filterlab.ops.cpu.sums import sums_of
from filterlab.ops.cpu.taps import Grid
from filterlab.ops.cpu.traversal import Run, State, Traversal
from filterlab.ops.tetrahedra import LoweredStencil

_SHARED = (
    *("next", "coefficients", "width", "height", "start"),
    *(f"{end}_{axis}" for end in ("low", "high") for axis in AXES),
    *("entry", "direction", "length", "offset", "count", "step"),
    *("per_unit", "opaque"),  # 1 and ∞: nothing ends a ray
    *("first", "last", "stride", "chunks"),
)
FIELDS: dict[str, type] = {name: OF_A_MARCH[name] for name in _SHARED} | {"largest": ctypes.c_void_p}  # (R) int64


class LargestJob(job.Job):
    _fields_ = tuple(FIELDS.items())


@dataclass(frozen=True)
class LargestVariant:
    """Everything the program depends on, apart from the machine; see `ops.cpu.compositing.MarchVariant`.

    Attributes:
        stencil: the value.
    """

    stencil: LoweredStencil
    arithmetic: str
    storage: str
    room: bool
    lanes: int

    def write(self, function: ir.Function) -> None:
        """The program, into an empty function."""
        _Largest(self, function).write()


class _Largest:
    kept = ("depth", "best", "number")

    def __init__(self, variant: LargestVariant, function: ir.Function) -> None:
        self.builder = ir.IRBuilder(function.append_basic_block("entry"))
        part = Lanes(self.builder, variant.arithmetic, variant.lanes)
        self.lanes = Lanes(self.builder, variant.arithmetic, 2 * variant.lanes)
        self.job = j = frame.load_job(self.lanes, function.args[0], FIELDS)
        taps = sums_of(part, variant.stencil, STORAGE[variant.storage], Grid.of(j), variant.room, WRITTEN_OUT)
        self.taps = Parts(self.lanes, taps)
        self.traversal = Traversal(taps.location(self.lanes), j, self.kept, skipping=False)

    def write(self) -> None:
        with frame.every_chunk(self.lanes, self.job) as chunk, self.traversal.every_block(chunk):
            with self.traversal.every_ray() as (_, state):
                self._begin(state)
            self.traversal.every_run(self._look)
            with self.traversal.every_ray() as (number, state):
                self._finish(number, state)
        self.builder.ret_void()

    def _begin(self, state: State) -> None:
        for name, first in (("depth", 0.0), ("best", -math.inf), ("number", -1.0)):
            state.kept[name].value = DOUBLE(first)

    def _look(self, run: Run) -> None:
        e, b, kept = self.lanes, self.builder, run.ray.state.kept
        segments = self.traversal.segments(run.ray, run.first)
        (value,) = self.taps.contract(segments.points, self.job.coefficients)
        larger = b.fcmp_ordered(">", value, e.everywhere(e.scalar(kept["best"].value)))
        with b.if_then(e.any(b.and_(segments.real, larger))):
            self._compare(run, e.where(segments.real, value, e.constant(-math.inf)))

    def _compare(self, run: Run, values: Value) -> None:
        """One lane after the other; never with a NaN, which nothing is larger than."""
        e, b, kept = self.lanes, self.builder, run.ray.state.kept
        best, number = kept["best"].value, kept["number"].value
        first = b.sitofp(run.first, DOUBLE)
        for lane in range(e.count):
            value = e.lane(values, lane)
            value = value if e.number == DOUBLE else b.fpext(value, DOUBLE)
            larger = b.fcmp_ordered(">", value, best)
            best = b.select(larger, value, best)
            number = b.select(larger, b.fadd(first, DOUBLE(float(lane))), number)
        kept["best"].value, kept["number"].value = best, number

    def _finish(self, number: Value, state: State) -> None:
        e, b = self.lanes, self.builder
        b.store(b.fptosi(state.kept["number"].value, I64), e.advance(self.job.largest, number, I64))
