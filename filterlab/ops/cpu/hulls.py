"""The program that bounds the polynomials on cells: coefficients in, codes of the least and the greatest out.

For P cells of a row at a time: in every plane of taps sums along x and y, to Bernstein coefficients in x and y of the
plane, which are kept in memory; then, for each of these, sums along z over the planes, of which none is kept. Of a
spline on tetrahedra every mask that a cube has, of its samples in registers.
"""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import product
from types import SimpleNamespace

import torch
from llvmlite import ir

from filterlab import bernstein
from filterlab.ops.bounds import CODES, HALF_ROUNDING
from filterlab.ops.cpu import frame, job
from filterlab.ops.cpu.lanes import DOUBLE, FLOAT, I1, I16, I32, I64, STORAGE, Lanes, Value
from filterlab.ops.stencil import Lowered
from filterlab.ops.tetrahedra import QUADRATICS, LoweredStencil, Steps, TetrahedralStencil, at_centre, trend_of

# Arrays are contiguous; d is a double.
FIELDS: dict[str, type] = {
    "next": ctypes.c_int64,  # the layer to be taken next; threads add 1 atomically
    "coefficients": ctypes.c_void_p,  # the first tap of the first cell; rows together, planes as many rows as `height`
    "width": ctypes.c_int64,
    "height": ctypes.c_int64,
    "cells_x": ctypes.c_int64,  # their number; at least P are written, fewer are not
    "cells_y": ctypes.c_int64,
    "factor": ctypes.c_double,  # the code is ⌊factor · sum + offset⌋, if that is one
    "offset": ctypes.c_double,
    "low": ctypes.c_void_p,  # (layers, cells_y, cells_x) 16 bits, written
    "high": ctypes.c_void_p,
    "scale": ctypes.c_double,  # f is scale · sum and a number
    "off_trend": ctypes.c_void_p,  # (layers, cells_y, cells_x) 32 bits, written: of splines, as in `ops.bounds.Bounds`
    "least": ctypes.c_void_p,  # (layers, P) d, written: of those of a layer that are finite
    "most": ctypes.c_void_p,
    "chunks": ctypes.c_int64,  # `next` stops here: layers
}


class HullsJob(job.Job):
    _fields_ = tuple(FIELDS.items())


@dataclass(frozen=True)
class HullsVariant:
    """Everything the program depends on, apart from the machine.

    Attributes:
        stencil: what is summed, one row.
        degrees: of a cell's polynomial in x, y, z, of sums over taps.
        storage: dtype of the coefficients.
        lanes: P.
    """

    stencil: LoweredStencil
    degrees: tuple[int, int, int]
    storage: str
    lanes: int

    def write(self, function: ir.Function) -> None:
        """The program, into an empty function."""
        if not isinstance(self.stencil, TetrahedralStencil):
            _OfCells(self, function).write()
        else:
            (_OfOctahedra if self.stencil.spline.octahedral else _OfCubes)(self, function).write()


class _Program:
    """What both have in common: packs of cells, bounds, codes."""

    def __init__(self, variant: HullsVariant, function: ir.Function) -> None:
        self.variant, self.storage = variant, STORAGE[variant.storage]
        self.builder = ir.IRBuilder(function.append_basic_block("entry"))
        self.lanes = Lanes(self.builder, "float64", variant.lanes)
        self.job: SimpleNamespace = frame.load_job(self.lanes, function.args[0], FIELDS)

    def prepare(self) -> None:
        """Reserve what has to be reserved before any loop."""

    def bound(self, z: Value, y: Value, x: Value) -> None:
        """All coefficients of a pack of cells from x on."""
        raise NotImplementedError

    def write(self) -> None:
        e, b, j = self.lanes, self.builder, self.job
        self.prepare()
        never = e.constant(math.inf)
        self.low, self.high, self.total, self.least, self.most = (e.variable(never) for _ in range(5))
        packs = b.udiv(b.add(j.cells_x, I64(e.count - 1)), I64(e.count))
        with frame.every_chunk(e, j) as z:
            self.least.value, self.most.value = never, e.constant(-math.inf)
            with e.repeat(I64(0), j.cells_y) as y, e.repeat(I64(0), packs) as pack:
                self._cells(z, y, b.mul(pack, I64(e.count)))
            place = b.mul(z, I64(e.count))
            e.store(self.least.value, e.advance(j.least, place, DOUBLE))
            e.store(self.most.value, e.advance(j.most, place, DOUBLE))
        b.ret_void()

    def _cells(self, z: Value, y: Value, x: Value) -> None:
        """A pack of them, from x on; of the last of a row some are bounded twice."""
        e, b, j = self.lanes, self.builder, self.job
        x = e.smaller(x, b.sub(j.cells_x, I64(e.count)))
        self.low.value, self.high.value = e.constant(math.inf), e.constant(-math.inf)
        self.total.value = e.constant(0)
        self.bound(z, y, x)
        self.write_cells(b.add(b.mul(b.add(b.mul(z, j.cells_y), y), j.cells_x), x))

    def _load(self, index: Value) -> Value:
        e, storage = self.lanes, self.storage
        return e.convert(e.load(e.advance(self.job.coefficients, index, storage.raw), storage.raw, e.count), storage)

    def _added(self, total: Value | None, weight: float, pack: Value) -> Value:
        e = self.lanes
        total = e.constant(0) if total is None else total
        return e.multiply_add(pack, e.constant(weight), total) if weight else total

    def _bound(self, coefficients: Sequence[Value]) -> None:
        e = self.lanes
        for variable, own in ((self.low, e.minimum), (self.high, e.maximum), (self.total, e.add)):
            value = variable.value
            for c in coefficients:
                value = own(value, c)
            variable.value = value

    def _whole(self) -> Value:
        """A mask of cells with nothing but finite coefficients."""
        e = self.lanes
        return self.builder.fcmp_ordered("<", e.absolute(self.total.value), e.constant(math.inf))

    def write_cells(self, place: Value) -> None:
        """What is told of a pack of cells, from the first one's place on."""
        e, b, j = self.lanes, self.builder, self.job
        whole = self._whole()
        low, high = self.low.value, self.high.value
        self.least.value = e.where(whole, e.minimum(low, self.least.value), self.least.value)
        self.most.value = e.where(whole, e.maximum(high, self.most.value), self.most.value)
        factor, offset = e.everywhere(j.factor), e.everywhere(j.offset)
        first, second = (e.multiply_add(x, factor, offset) for x in (low, high))
        ends = (j.low, e.minimum(first, second), 0), (j.high, e.maximum(first, second), CODES - 1)
        for array, value, if_none in ends:
            code = e.clamp(e.where(whole, e.floor(value), e.constant(if_none)), e.constant(0), e.constant(CODES - 1))
            code = b.sub(e.to_integer(code), ir.Constant(ir.VectorType(I32, e.count), [CODES // 2] * e.count))
            e.store(b.trunc(code, ir.VectorType(I16, e.count)), e.advance(array, place, I16))


class _OfCells(_Program):
    """Of sums over taps."""

    def __init__(self, variant: HullsVariant, function: ir.Function) -> None:
        super().__init__(variant, function)
        assert isinstance(variant.stencil, Lowered)
        self.stencil = variant.stencil
        self.weights = [
            [[_bernstein(row, degree) for row in table] for table in tables]
            for tables, degree in zip(self.stencil.functions, variant.degrees, strict=True)
        ]
        self.planes = list(dict.fromkeys((a, b) for _, a, b, _ in self.stencil.rows[0]))
        self.columns = (variant.degrees[0] + 1) * (variant.degrees[1] + 1)

    def prepare(self) -> None:
        e = self.lanes
        self.kept = e.reserve(e.pack, len(self.planes) * self.columns * self.stencil.supports[2])

    def bound(self, z: Value, y: Value, x: Value) -> None:
        e, b = self.lanes, self.builder
        with e.repeat(I64(0), I64(self.stencil.supports[2])) as dz:
            row = b.add(b.mul(b.add(z, dz), self.job.height), y)
            for place, pack in enumerate(self._of_plane(row, x)):
                e.store(pack, self._place(I64(place), dz))
        with e.repeat(I64(0), I64(self.columns)) as column:
            self._bound(self._along_z(column))

    def _of_plane(self, row: Value, x: Value) -> Iterator[Value]:
        """Coefficients in x and y of a plane of taps, for all that is summed of it: x runs fastest, then y."""
        b, v = self.builder, self.variant
        planes: dict[tuple[int, int, int, int], Value] = {}
        for dy in range(self.stencil.supports[1]):
            first = b.add(b.mul(b.add(row, I64(dy)), self.job.width), x)
            line = [self._load(b.add(first, I64(t))) for t in range(self.stencil.supports[0])]
            along = {a: self._sums(line, self.weights[0][a]) for a in dict.fromkeys(a for a, _ in self.planes)}
            for a, f in self.planes:
                for k, weight in enumerate(self.weights[1][f][dy]):
                    for i, pack in enumerate(along[a]):
                        planes[a, f, k, i] = self._added(planes.get((a, f, k, i)), weight, pack)
        for a, f in self.planes:
            for k in range(v.degrees[1] + 1):
                for i in range(v.degrees[0] + 1):
                    yield planes[a, f, k, i]

    def _sums(self, taps: Sequence[Value], weights: Sequence[Sequence[float]]) -> list[Value]:
        """Σ_t weights[t][i] · tap t, for every i."""
        found: list[Value] = []
        for row in zip(*weights, strict=True):
            total = self.lanes.constant(0)
            for weight, tap in zip(row, taps, strict=True):
                total = self._added(total, weight, tap)
            found.append(total)
        return found

    def _place(self, place: Value, dz: Value) -> Value:
        b, depth = self.builder, self.stencil.supports[2]
        return self.lanes.advance(self.kept, b.add(b.mul(place, I64(depth)), dz), self.lanes.pack)

    def _along_z(self, column: Value) -> list[Value]:
        """Coefficients along z, of one in x and y."""
        e, b, v = self.lanes, self.builder, self.variant
        found = [e.constant(0)] * (v.degrees[2] + 1)
        for factor, a, f, c in self.stencil.rows[0]:
            place = b.add(column, I64(self.planes.index((a, f)) * self.columns))
            for dz, weights in enumerate(self.weights[2][c]):
                pack = e.load(self._place(place, I64(dz)), DOUBLE, e.count)
                found = [self._added(t, factor * w, pack) for t, w in zip(found, weights, strict=True)]
        return found


class _OfSpline(_Program):
    """Of a spline on tetrahedra: every different mask, once."""

    def __init__(self, variant: HullsVariant, function: ir.Function) -> None:
        super().__init__(variant, function)
        assert isinstance(variant.stencil, TetrahedralStencil)
        self.spline = variant.stencil.spline

    def prepare(self) -> None:
        e = self.lanes
        self.off_low, self.off_high = e.variable(e.constant(0)), e.variable(e.constant(0))

    def bound(self, z: Value, y: Value, x: Value) -> None:
        e = self.lanes
        self.off_low.value, self.off_high.value = e.constant(math.inf), e.constant(-math.inf)
        at, sums = self.sums(z, y, x)
        trend = trend_of(e, at)
        for total, moments in zip(sums, self.spline.moments, strict=True):
            off = total
            for m, moment in zip(QUADRATICS, moments, strict=True):
                off = self._added(off, -moment, trend[m])
            self._bound([total])
            self.off_low.value = e.minimum(self.off_low.value, off)
            self.off_high.value = e.maximum(self.off_high.value, off)

    def sums(self, z: Value, y: Value, x: Value) -> tuple[Callable[[Steps], Value], Iterator[Value]]:
        """Samples by steps from the one in the middle; all coefficients of a pack of cubes."""
        raise NotImplementedError

    def write_cells(self, place: Value) -> None:
        super().write_cells(place)
        e, b, j = self.lanes, self.builder, self.job
        scale = e.everywhere(j.scale)
        first, second = (e.multiply(x.value, scale) for x in (self.off_low, self.off_high))
        low, high = self._half(e.minimum(first, second), -1), self._half(e.maximum(first, second), 1)
        pairs = b.or_(b.lshr(low, e.integers_32(16)), b.and_(high, e.integers_32(-0x10000)))
        e.store(pairs, e.advance(j.off_trend, place, I32))

    def _half(self, value: Value, side: int) -> Value:
        """Bits of floats whose upper half is a bfloat16 beyond a value; see `ops.bounds.in_pairs`."""
        e, b = self.lanes, self.builder
        wider = e.multiply_add(e.absolute(value), e.constant(side * HALF_ROUNDING), value)
        number = b.fptrunc(e.where(self._whole(), wider, e.constant(side * math.inf)), ir.VectorType(FLOAT, e.count))
        return b.add(b.bitcast(number, ir.VectorType(I32, e.count)), e.integers_32(0x8000))


class _OfCubes(_OfSpline):
    """With the same samples for all of a cube."""

    def sums(self, z: Value, y: Value, x: Value) -> tuple[Callable[[Steps], Value], Iterator[Value]]:
        samples = {at: self._sample(z, y, x, at) for at in product(range(self.spline.size), repeat=3)}

        def every() -> Iterator[Value]:
            for mask in self.spline.masks_of_cube:
                total = None
                for weight, sample in zip(mask, samples.values(), strict=True):
                    total = self._added(total, weight, sample)
                yield total

        return lambda steps: samples[steps[0] + 1, steps[1] + 1, steps[2] + 1], every()

    def _sample(self, z: Value, y: Value, x: Value, at: Sequence[int]) -> Value:
        b, j = self.builder, self.job
        row = b.add(b.mul(b.add(z, I64(at[2])), j.height), b.add(y, I64(at[1])))
        return self._load(b.add(b.mul(row, j.width), b.add(x, I64(at[0]))))


class _OfOctahedra(_OfSpline):
    """On octahedra, two of which meet in a cube; along axes of odd indices cubes are turned round."""

    def sums(self, z: Value, y: Value, x: Value) -> tuple[Callable[[Steps], Value], Iterator[Value]]:
        samples = _Samples(self, self.spline.around, (x, y, z))

        def every() -> Iterator[Value]:
            for terms in self.spline.masks_of_octahedra:
                total = None
                for centre, unit, weight in terms:
                    total = self._added(total, weight, samples.of_centre(centre, unit))
                yield total

        return samples.at, every()


class _Samples:
    """The samples around those of a pack, along axes that are turned round where their indices are odd.

    Args:
        around: samples before the one in the middle.
        first: x, y, z of the pack's first cell.
    """

    def __init__(self, program: _Program, around: int, first: Sequence[Value]) -> None:
        self.program, self.lanes, self.builder = program, program.lanes, program.builder
        b, count = self.builder, self.lanes.count
        self.x, *others = (b.add(own, I64(around)) for own in first)
        odd = [b.trunc(own, I1) for own in first]
        self.others = list(zip(others, odd[1:], strict=True))
        every_second = ir.Constant(ir.VectorType(I1, count), [bool(lane % 2) for lane in range(count)])
        self.odd = b.xor(every_second, self.lanes.everywhere(odd[0]))
        self._known: dict[Steps, Value] = {}
        self._blocks: dict[Steps, dict[Steps, Value]] = {}

    def at(self, place: Steps) -> Value:
        """So many steps from those in the middle."""
        if place not in self._known:
            e, b, j, i = self.lanes, self.builder, self.program.job, place[0]
            y, z = (
                b.add(own, b.select(odd, I64(-step), I64(step)))
                for (own, odd), step in zip(self.others, place[1:], strict=True)
            )
            row = b.mul(b.add(b.mul(z, j.height), y), j.width)
            ahead, behind = (self.program._load(b.add(row, b.add(self.x, I64(step)))) for step in (i, -i))
            self._known[place] = e.where(self.odd, behind, ahead)
        return self._known[place]

    def of_centre(self, centre: Steps, unit: Steps) -> Value:
        """Eight times the value or four times a derivative at a centre, given twice."""
        if centre not in self._blocks:
            x, y, z = centre
            block = {
                (i, j, k): self.at(((x - 1) // 2 + i, (y - 1) // 2 + j, (z - 1) // 2 + k))
                for i, j, k in product(range(2), repeat=3)
            }
            self._blocks[centre] = at_centre(self.lanes, block)
        return self._blocks[centre][unit]


def _bernstein(monomial: Sequence[float], degree: int) -> list[float]:
    """Of a polynomial that may have a lower degree."""
    whole = [*monomial, *[0.0] * (degree + 1 - len(monomial))]
    return bernstein.from_monomial(torch.tensor(whole, dtype=torch.float64)).tolist()
