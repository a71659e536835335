"""gather and its adjoints scatter (to the coefficients) and pull (to the points), around the sums over taps.

Letters: N batch, C channels, M points, J rows; P points at a time are a pack (`ops.cpu.taps`). Packs are located a
block at a time and then summed one after the other: a sum never waits for the addresses it reads (5 to 10 % faster).
Points, rows and coefficients beyond the arrays are not touched: a pack that would reach beyond the last point works on
a copy of the remaining points, followed by zeros.

Rows of a jet of order 1 are gathered as they are, or as the world wants them, if the job says where its gradient goes:

    rows      f          gradient_a = Σ_b matrix_ba (sign_b ∂_b f)

with the signs of points that `ops.cpu.folding` turned. Products and sums are rounded one after the other, as torch's.
"""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from functools import reduce
from types import SimpleNamespace

from llvmlite import ir

from filterlab.ops.cpu import folding, frame, job
from filterlab.ops.cpu.job import AXES
from filterlab.ops.cpu.lanes import I1, I64, POINTER, STORAGE, Lanes, Value, Variable
from filterlab.ops.cpu.sums import sums_of
from filterlab.ops.cpu.taps import Grid
from filterlab.ops.tetrahedra import LoweredStencil

BLOCK = 16  # packs that are located before the first of them is summed

_ROWS_OF_JET = 4  # of order 1

# Strides are in elements.
FIELDS: dict[str, type] = {
    "next": ctypes.c_int64,  # the chunk to be taken next; threads add 1 atomically
    "coefficients": ctypes.c_void_p,  # (N, C, D, H, W); read by gather, added to by scatter
    "points": ctypes.c_void_p,  # (N, M, 3)
    "rows": ctypes.c_void_p,  # (N, C, J, M); written by gather, read by scatter and pull
    "gradient": ctypes.c_void_p,  # (N, M, 3), written by pull; (N, C, M, 3), by gather, null: it writes all rows
    "channels": ctypes.c_int64,  # C
    "count": ctypes.c_int64,  # M, points of one batch entry
    "width": ctypes.c_int64,  # W
    "height": ctypes.c_int64,  # H
    "start": ctypes.c_int64,  # coordinate of coefficient 0
    **{f"low_{a}": ctypes.c_double for a in AXES},  # smallest and largest coordinate of a first tap
    **{f"high_{a}": ctypes.c_double for a in AXES},
    "coefficients_entry": ctypes.c_int64,  # strides: from one batch entry to the next,
    "coefficients_channel": ctypes.c_int64,  # from one channel to the next,
    "points_entry": ctypes.c_int64,
    "chunk": ctypes.c_int64,  # packs of a chunk
    "entries": ctypes.c_int64,  # N; chunk c is part c // N of batch entry c % N
    "chunks": ctypes.c_int64,  # `next` stops here
    "place": ctypes.c_void_p,  # program of `folding` by which gather places points first; null: they are located
    "placing": ctypes.c_void_p,  # its job, as far as no point decides
    "met": ctypes.c_int64,  # what it met
    "oblique": ctypes.c_int64,  # whether the matrix has more than a diagonal
    **{f"matrix_{a}{b}": ctypes.c_double for a in AXES for b in AXES},  # world to voxels, row a: voxel coordinate a
}


class PointsJob(job.Job):
    _fields_ = tuple(FIELDS.items())


@dataclass(frozen=True)
class PointsVariant:
    """Everything the program depends on, apart from the machine.

    Attributes:
        operation: "gather", "scatter" or "pull".
        stencil: what is summed; for pull the derivatives of what was gathered.
        arithmetic: "float32" or "float64": dtype of points, rows and sums.
        storage: dtype of the coefficients; for scatter the same as `arithmetic`.
        lanes: P.
        raised: for pull, as in `Stencil.derivatives`.
    """

    operation: str
    stencil: LoweredStencil
    arithmetic: str
    storage: str
    lanes: int
    raised: tuple[tuple[int, ...], ...] = ()

    def write(self, function: ir.Function) -> None:
        """The program, into an empty function."""
        _Program(self, function).write()


class _Program:
    def __init__(self, variant: PointsVariant, function: ir.Function) -> None:
        self.variant, self.function = variant, function
        self.builder = ir.IRBuilder(function.append_basic_block("entry"))
        self.lanes = Lanes(self.builder, variant.arithmetic, variant.lanes)
        self.storage = STORAGE[variant.storage]
        self.rows = len(variant.raised[0] if variant.raised else variant.stencil.rows)  # J, as they lie in memory

    def write(self) -> None:
        e = self.lanes
        self.job = j = frame.load_job(e, self.function.args[0], FIELDS)
        grid = Grid.of(j)
        self.taps = sums_of(e, self.variant.stencil, self.storage, grid)
        self.location = self.taps.location(e)
        self.scratch_points = e.reserve(e.number, 3 * e.count)
        self.scratch_rows = e.reserve(e.number, self.rows * e.count)
        self.addresses = e.reserve(I64, BLOCK * e.count)
        self.local = e.reserve(e.number, BLOCK * 3 * e.count)
        placed = _Placed(e, j) if self.variant.operation == "gather" else None
        self.world = None if placed is None or self.rows != _ROWS_OF_JET else _World(e, j, placed)
        with frame.every_chunk(e, j) as chunk:
            self._write_chunk(chunk, placed)
        if placed is not None:
            placed.report()
        self.builder.ret_void()

    def _write_chunk(self, chunk: Value, placed: _Placed | None) -> None:
        """Part chunk // N of batch entry chunk % N."""
        e, b, j = self.lanes, self.builder, self.job
        entry, part = b.urem(chunk, j.entries), b.udiv(chunk, j.entries)
        packs = b.udiv(b.add(j.count, I64(e.count - 1)), I64(e.count))
        first = b.mul(part, j.chunk)
        last = e.smaller(b.add(first, j.chunk), packs)
        points = e.advance(j.points, b.mul(entry, j.points_entry), e.number)
        rows = e.advance(j.rows, e.product(entry, j.channels, self._rows_written(), j.count), e.number)
        gradients = I64(1) if self.world is None else j.channels
        gradient = e.advance(j.gradient, e.product(entry, gradients, j.count, I64(3)), e.number)
        volume = e.advance(j.coefficients, b.mul(entry, j.coefficients_entry), self.storage.raw)
        with e.repeat(first, last, BLOCK) as block:
            end = e.smaller(b.add(block, I64(BLOCK)), last)
            located = points if placed is None else placed.block(points, block, end)
            with e.repeat(block, end) as pack:
                self._write_location(pack, b.sub(pack, block), located, volume)
            with e.repeat(block, end) as pack:
                self._write_sums(pack, b.sub(pack, block), rows, gradient)

    def _write_location(self, pack: Value, index: Value, points: Value, volume: Value) -> None:
        """Locate a pack's points and keep the result as number `index` of the block."""
        e, b = self.lanes, self.builder
        window = _Window(self, pack)
        first_tap, u = self.location.locate(e.load_triples(window.points(points)), volume)
        e.store(first_tap, self._lane_of(self.addresses, index, 0, I64))
        for axis in range(3):
            e.store(u[axis], self._lane_of(self.local, b.mul(index, I64(3)), axis * e.count, e.number))

    def _write_sums(self, pack: Value, index: Value, rows: Value, gradient: Value) -> None:
        """Everything after the location, for every channel."""
        e, b, j = self.lanes, self.builder, self.job
        taps = [b.load(self._lane_of(self.addresses, index, lane, I64), typ=POINTER) for lane in range(e.count)]
        places = [self._lane_of(self.local, b.mul(index, I64(3)), axis * e.count, e.number) for axis in range(3)]
        u = [e.load(place, e.number, e.count) for place in places]
        scatter = self.variant.operation == "scatter"
        known = b.fcmp_ordered("ord", e.add(e.add(u[0], u[1]), u[2]), e.constant(0))
        weights = self.taps.weigh([b.select(known, own, e.constant(0)) for own in u] if scatter else u)
        window = _Window(self, pack)
        pulled = [e.variable(e.constant(0)) for _ in range(3)] if self.variant.operation == "pull" else []
        with e.repeat(I64(0), j.channels) as channel:
            own_rows = e.advance(rows, e.product(channel, self._rows_written(), j.count), e.number)
            here = b.mul(channel, j.coefficients_channel)
            if scatter:  # a point that is nowhere adds nothing, not NaN
                cotangents = [b.select(known, own, e.constant(0)) for own in window.read(own_rows)]
                self.taps.spread(taps, here, weights, cotangents)
            elif pulled:
                self._pull(pulled, window.read(own_rows), self.taps.contract(taps, here, weights, u))
            else:
                own = e.advance(gradient, e.product(channel, j.count, I64(3)), e.number)
                self._write_rows(window, index, self.taps.contract(taps, here, weights, u), own_rows, own)
        if pulled:
            window.write_points(gradient, [own.value for own in pulled])

    def _rows_written(self) -> Value:
        return I64(self.rows) if self.world is None else self.builder.select(self.world.asked, I64(1), I64(self.rows))

    def _write_rows(self, window: _Window, index: Value, found: list[Value], rows: Value, gradient: Value) -> None:
        """The rows of pack `index` of a block, or value and gradient in the world."""
        if self.world is None:
            window.write(rows, found)
            return
        with self.builder.if_else(self.world.asked, likely=True) as (asked, plain):
            with asked:
                window.write(rows, found[:1])
                window.write_points(gradient, self.world.gradient(found[1:], index))
            with plain:
                window.write(rows, found)

    def _pull(self, pulled: list[Variable], cotangents: list[Value], derivatives: list[Value]) -> None:
        """pulled[axis] += Σ_rows cotangent · derivative of the row along the axis."""
        for total, raised in zip(pulled, self.variant.raised, strict=True):
            for cotangent, row in zip(cotangents, raised, strict=True):
                total.value = self.lanes.multiply_add(cotangent, derivatives[row], total.value)

    def _lane_of(self, packs: Value, pack: Value, lane: int, element: ir.Type) -> Value:
        """Address of a lane in an array of packs."""
        index = self.builder.add(self.builder.mul(pack, I64(self.lanes.count)), I64(lane))
        return self.lanes.advance(packs, index, element)


class _Placed:
    """Points of a block after a program of `folding` has placed them, if the job names one. Make it before any loop.

    The program works on a copy of its job, which tells it of one block after the other.
    """

    def __init__(self, lanes: Lanes, told: SimpleNamespace) -> None:
        self.lanes, self.builder, self.told = lanes, lanes.builder, told
        self.asked, self.signs_asked = lanes.given(told.place), lanes.given(told.gradient)
        self.located, self.signs = (lanes.reserve(lanes.number, BLOCK * 3 * lanes.count) for _ in range(2))
        self.own = lanes.reserve(I64, len(folding.FIELDS))
        self.turned, self.met = lanes.variable(I1(0)), lanes.variable(I64(0))
        with self.builder.if_then(self.asked):
            lanes.copy(self.own, told.placing, I64(8 * len(folding.FIELDS)))
            self._field("located", POINTER).value = self.located

    def _field(self, name: str, kind: ir.Type = I64) -> Variable:
        return self.lanes.at(self.lanes.advance(self.own, I64(list(folding.FIELDS).index(name)), I64), kind)

    def block(self, points: Value, block: Value, end: Value) -> Value:
        """Where the points of packs `block` to `end` are located, as an address of point 0."""
        e, b = self.lanes, self.builder
        first, last = (b.mul(pack, I64(e.count)) for pack in (block, end))
        with b.if_then(self.asked):
            self._field("points", POINTER).value = e.advance(points, b.mul(first, I64(3)), e.number)
            self._field("count").value = b.sub(e.smaller(last, self.told.count), first)
            self._field("chunk").value, self._field("chunks").value = b.sub(end, block), I64(1)
            self._place(I64(0))
            met = self._field("met").value
            self.met.value = b.or_(self.met.value, met)
            self.turned.value = b.and_(self.signs_asked, b.trunc(b.and_(met, I64(folding.TURNED)), I1))
            with b.if_then(self.turned.value, likely=False):  # few blocks are: they are placed once more
                self._place(b.ptrtoint(self.signs, I64))
        return b.select(self.asked, e.advance(self.located, b.mul(first, I64(-3)), e.number), points)

    def _place(self, signs: Value) -> None:
        self._field("signs").value, self._field("met").value, self._field("next").value = signs, I64(0), I64(0)
        frame.call(self.builder, self.told.place, self.own)

    def report(self) -> None:
        """Say what was met, when all is done."""
        with self.builder.if_then(self.asked):
            self.builder.atomic_rmw("or", self.told.met, self.met.value, "monotonic")


class _World:
    """Gradients per voxel of points that were placed, as gradients per world unit. Make it before any loop.

    Attributes:
        asked: whether the job wants them.
    """

    def __init__(self, lanes: Lanes, told: SimpleNamespace, placed: _Placed) -> None:
        self.lanes, self.builder, self.told, self.placed = lanes, lanes.builder, told, placed
        self.asked = placed.signs_asked
        self.packs = [lanes.variable(lanes.constant(0)) for _ in AXES]

    def gradient(self, rows: list[Value], index: Value) -> list[Value]:
        """(3) packs along the axes of the world, of the derivatives (3) of pack `index` of the block."""
        e, b = self.lanes, self.builder
        self._keep(rows)
        with b.if_then(self.placed.turned.value, likely=False):
            signs = e.load_triples(e.advance(self.placed.signs, b.mul(index, I64(3 * e.count)), e.number))
            self._keep([e.multiply(row, sign) for row, sign in zip(self._kept(), signs, strict=True)])
        with b.if_else(b.icmp_signed("==", self.told.oblique, I64(0)), likely=True) as (along_axes, oblique):
            with along_axes:
                self._keep([e.multiply(row, self._matrix(a, a)) for a, row in zip(AXES, self._kept(), strict=True)])
            with oblique:
                self._keep([self._along(axis) for axis in AXES])
        return self._kept()

    def _along(self, axis: str) -> Value:
        b = self.builder
        return reduce(b.fadd, (b.fmul(row, self._matrix(a, axis)) for a, row in zip(AXES, self._kept(), strict=True)))

    def _matrix(self, row: str, column: str) -> Value:
        return self.lanes.everywhere(self.lanes.scalar(getattr(self.told, f"matrix_{row}{column}")))

    def _keep(self, packs: list[Value]) -> None:
        for kept, pack in zip(self.packs, packs, strict=True):
            kept.value = pack

    def _kept(self) -> list[Value]:
        return [pack.value for pack in self.packs]


class _Window:
    """The P points of a pack in the arrays, or a copy of them when fewer than P are left.

    Args:
        pack: its number in the batch entry.
    """

    def __init__(self, program: _Program, pack: Value) -> None:
        self.program, self.lanes, self.builder = program, program.lanes, program.builder
        self.first = self.builder.mul(pack, I64(self.lanes.count))
        self.left = self.builder.sub(program.job.count, self.first)
        self.whole = self.builder.icmp_signed(">=", self.left, I64(self.lanes.count))

    def points(self, points: Value) -> Value:
        """Address of P points."""
        e, b = self.lanes, self.builder
        own, copy = e.advance(points, b.mul(self.first, I64(3)), e.number), self.program.scratch_points
        with self._when_partial():
            e.clear(copy, 3 * e.count * e.bits // 8)
            e.copy(copy, own, b.mul(self.left, I64(3 * e.bits // 8)))
        return b.select(self.whole, own, copy)

    def write_points(self, points: Value, packs: list[Value]) -> None:
        """The reverse of `points`."""
        e, b = self.lanes, self.builder
        own, copy = e.advance(points, b.mul(self.first, I64(3)), e.number), self.program.scratch_points
        e.store_triples(packs, b.select(self.whole, own, copy))
        with self._when_partial():
            e.copy(own, copy, b.mul(self.left, I64(3 * e.bits // 8)))

    def read(self, rows: Value) -> list[Value]:
        """The pack of every row; 0 in the lanes without a point."""
        e, b = self.lanes, self.builder
        with self._when_partial():
            e.clear(self.program.scratch_rows, self.program.rows * e.count * e.bits // 8)
            for row in range(self.program.rows):
                e.copy(self._copied(row), self._own(rows, row), b.mul(self.left, I64(e.bits // 8)))
        return [e.load(address, e.number, e.count) for address in self._addresses(rows, self.program.rows)]

    def write(self, rows: Value, packs: list[Value]) -> None:
        e, b = self.lanes, self.builder
        for pack, address in zip(packs, self._addresses(rows, len(packs)), strict=True):
            e.store(pack, address)
        with self._when_partial():
            for row in range(len(packs)):
                e.copy(self._own(rows, row), self._copied(row), b.mul(self.left, I64(e.bits // 8)))

    def _own(self, rows: Value, row: int) -> Value:
        b = self.builder
        return self.lanes.advance(rows, b.add(b.mul(self.program.job.count, I64(row)), self.first), self.lanes.number)

    def _copied(self, row: int) -> Value:
        return self.lanes.advance(self.program.scratch_rows, I64(row * self.lanes.count), self.lanes.number)

    def _addresses(self, rows: Value, count: int) -> list[Value]:
        """Where the pack of each of so many rows is, in the array or in the copy."""
        e, b = self.lanes, self.builder
        first = b.select(self.whole, self._own(rows, 0), self.program.scratch_rows)
        stride = b.select(self.whole, self.program.job.count, I64(e.count))
        return [e.advance(first, b.mul(stride, I64(row)), e.number) for row in range(count)]

    def _when_partial(self):
        return self.builder.if_then(self.builder.xor(self.whole, I1(1)), likely=False)
