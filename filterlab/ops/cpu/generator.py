"""jet and splat as vector code: this module writes the program that `ops.reference` describes, for any kernel.

Letters, as in `ops.reference`: N batch, C channels, M points, J rows of a jet; x, y, z along W, H, D; S taps per axis;
u the local coordinate; (mx, my, mz) the orders of a derivative. P points are handled at a time: a *pack* is P numbers,
one per point, and a point's place in it is its *lane* (`ops.cpu.lanes` explains the instructions).

The program, for one pack of points:

    locate     x, y, z -> first taps (integers) and u             (3 packs -> 3 packs)
    weigh      w[axis][m][t] = m-th derivative of tap t's weight, a polynomial in u
    for every row of taps (z, y):
        fetch      the S coefficients of that row, for every lane: S packs
        along x    line[mx]         = Σ_x w[x][mx][x] · tap x
        along y    plane[mx, my]   += w[y][my][y] · line[mx]
    along z        jet[mx, my, mz] += w[z][mz][z] · plane[mx, my]     after every plane

so that value and gradient of a 3×3×3 kernel cost 93 multiply-adds, not 27·4. splat runs the three sums backwards.
Packs are located a block at a time and then summed one after the other: a sum never waits for the addresses it reads
(5 to 10 % faster). Everything is written out but for the loops over chunks, blocks, packs, channels and z.

The coefficients of one row lie together in memory, but a pack wants the first tap of every lane together, then the
second tap of every lane. Collecting them one by one (a gather) is slow; instead every lane's row is read in one piece
and the P×S table is transposed in registers. Four lanes a, b, c, d with four taps 0 1 2 3:

    rows as read             pairs interleaved            halves joined
    a0 a1 a2 a3    ─┐
    b0 b1 b2 b3    ─┴─▶  a0 b0 a1 b1 │ a2 b2 a3 b3   ─┐   a0 b0 c0 d0   tap 0 of every lane
    c0 c1 c2 c3    ─┐                                ─┼─▶ a1 b1 c1 d1   tap 1
    d0 d1 d2 d3    ─┴─▶  c0 d0 c1 d1 │ c2 d2 c3 d3   ─┘   a2 b2 c2 d2   tap 2
                                                          a3 b3 c3 d3   tap 3

With P = 8 two such tables lie side by side in every register (lanes 0-3 and 4-7), with P = 16 four: a *group* is four
lanes. Rows of two taps need one step less; rows of five and six are a row of four and the rest.

Nothing outside the arrays is touched. The first tap is clamped before it becomes an integer, NaN included. A pack that
would reach beyond the last point works on a copy of the remaining points, followed by zeros.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import SimpleNamespace

from llvmlite import ir

from filterlab.ops.cpu.job import AXES, FIELDS
from filterlab.ops.cpu.lanes import DOUBLE, I1, I32, I64, POINTER, STORAGE, Lanes, Value
from filterlab.ops.reference import multi_indices

BLOCK = 16  # packs that are located before the first of them is summed
ENTRY = "run"  # name of the compiled function: void run(Job *)

Table = tuple[tuple[float, ...], ...]
"""Row t: the weight of tap t as a polynomial in u, constant term first."""


Weights = list[list[list[Value]]]
"""[axis][m][t]: the m-th derivative of the weight of tap t, a pack."""


@dataclass(frozen=True)
class Recipe:
    """Everything the program depends on, apart from the machine.

    Attributes:
        operation: "jet" or "splat".
        tables: the taps along x, y and z (`Kernel.taps`).
        order: of the highest derivative.
        arithmetic: "float32" or "float64": dtype of points, rows and sums.
        storage: dtype of the coefficients; for splat the same as `arithmetic`.
        lanes: P.
    """

    operation: str
    tables: tuple[Table, Table, Table]
    order: int
    arithmetic: str
    storage: str
    lanes: int


def generate(recipe: Recipe) -> str:
    """The program as LLVM IR text: one function that takes chunks of packs until none is left."""
    module = ir.Module("filterlab")
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [POINTER]), ENTRY)
    function.attributes.add("nounwind")
    _Program(recipe, function).write()
    return str(module)


class _Program:
    def __init__(self, recipe: Recipe, function: ir.Function) -> None:
        self.recipe, self.function = recipe, function
        self.builder = ir.IRBuilder(function.append_basic_block("entry"))
        self.lanes = Lanes(self.builder, recipe.arithmetic, recipe.lanes)
        self.storage = STORAGE[recipe.storage]
        self.supports = [len(table) for table in recipe.tables]
        self.rows = multi_indices(recipe.order)

    # --- the frame: chunks, packs, channels ---

    def write(self) -> None:
        e, j = self.lanes, self._load_job()
        self.job = j
        self.scratch_points = e.reserve(e.number, 3 * e.count)
        self.scratch_rows = e.reserve(e.number, len(self.rows) * e.count)
        self.plane_weights = e.reserve(e.pack, self.supports[2] * (self.recipe.order + 1))
        self.addresses = e.reserve(I64, BLOCK * e.count)
        self.local = e.reserve(e.number, BLOCK * 3 * e.count)
        with self._every_chunk() as (entry, first, last):
            points = e.advance(j.points, self._product(entry, j.points_entry), e.number)
            rows = e.advance(j.rows, self._product(entry, j.channels, I64(len(self.rows)), j.count), e.number)
            volume = e.advance(j.coefficients, self._product(entry, j.coefficients_entry), self.storage.raw)
            with e.repeat(first, last, BLOCK) as block:
                end = e.smaller(self.builder.add(block, I64(BLOCK)), last)
                with e.repeat(block, end) as pack:
                    self._write_location(pack, self.builder.sub(pack, block), points, volume)
                with e.repeat(block, end) as pack:
                    self._write_sums(pack, self.builder.sub(pack, block), rows)
        self.builder.ret_void()

    def _load_job(self) -> SimpleNamespace:
        """The fields of the struct, as values; `next` stays in memory, threads share it."""
        fields, address = {}, self.function.args[0]
        for index, (name, ctype) in enumerate(FIELDS.items()):
            kind = {"P": POINTER, "d": DOUBLE}.get(ctype._type_, I64)
            where = self.lanes.advance(address, I64(index), I64)
            fields[name] = where if name == "next" else self.builder.load(where, typ=kind)
        return SimpleNamespace(**fields)

    @contextmanager
    def _every_chunk(self) -> Iterator[tuple[Value, Value, Value]]:
        """while (c = next++) < chunks: the with-block, given the batch entry and the range of packs."""
        b, j = self.builder, self.job
        take, work, done = (b.append_basic_block(name) for name in ("take", "work", "done"))
        b.branch(take)
        b.position_at_end(take)
        c = b.atomic_rmw("add", j.next, I64(1), "monotonic")
        b.cbranch(b.icmp_signed("<", c, j.chunks), work, done)
        b.position_at_end(work)
        packs = b.udiv(b.add(j.count, I64(self.lanes.count - 1)), I64(self.lanes.count))
        first = b.mul(b.udiv(c, j.entries), j.chunk)
        yield b.urem(c, j.entries), first, self.lanes.smaller(b.add(first, j.chunk), packs)
        b.branch(take)
        b.position_at_end(done)

    def _write_location(self, pack: Value, index: Value, points: Value, volume: Value) -> None:
        """Locate a pack's points and keep the result as number `index` of the block."""
        e = self.lanes
        window = _Window(self, pack)
        offset, u = self._locate_points(self._load_points(window.points(points)))
        first_tap = self.builder.add(offset, e.everywhere(self.builder.ptrtoint(volume, I64)))
        e.store(first_tap, self._lane_of(self.addresses, index, 0, I64))
        for axis in range(3):
            e.store(u[axis], self._lane_of(self.local, self._product(index, I64(3)), axis * e.count, e.number))

    def _write_sums(self, pack: Value, index: Value, rows: Value) -> None:
        """Everything after the location, for every channel."""
        e, b, j = self.lanes, self.builder, self.job
        taps = [b.load(self._lane_of(self.addresses, index, lane, I64), typ=POINTER) for lane in range(e.count)]
        weights = []
        for axis, table in enumerate(self.recipe.tables):
            u = self._lane_of(self.local, self._product(index, I64(3)), axis * e.count, e.number)
            weights.append(self._weigh(table, e.load(u, e.number, e.count)))
        for m, plane_weights in enumerate(weights[2]):
            for z, weight in enumerate(plane_weights):
                e.store(weight, e.advance(self.plane_weights, I64(z * len(weights[2]) + m), e.pack))
        window = _Window(self, pack)
        with e.repeat(I64(0), j.channels) as channel:
            own_rows = e.advance(rows, self._product(channel, I64(len(self.rows)), j.count), e.number)
            here = b.mul(channel, j.coefficients_channel)
            if self.recipe.operation == "jet":
                window.write(own_rows, self._contract(taps, here, weights))
            else:
                self._spread(taps, here, weights, window.read(own_rows))

    def _lane_of(self, packs: Value, pack: Value, lane: int, element: ir.Type) -> Value:
        """Address of a lane in an array of packs."""
        index = self.builder.add(self._product(pack, I64(self.lanes.count)), I64(lane))
        return self.lanes.advance(packs, index, element)

    def _product(self, *factors: Value) -> Value:
        product = factors[0]
        for f in factors[1:]:
            product = self.builder.mul(product, f)
        return product

    # --- where the points read, and with which weights ---

    def _load_points(self, address: Value) -> list[Value]:
        """x y z x y z … -> a pack of x, a pack of y, a pack of z."""
        e = self.lanes
        triples = e.load(address, e.number, 3 * e.count)
        return [e.shuffle(triples, triples, range(axis, 3 * e.count, 3)) for axis in range(3)]

    def _locate_points(self, points: Sequence[Value]) -> tuple[Value, list[Value]]:
        """Every lane's offset of its first tap, in bytes, and its local coordinates."""
        e, b = self.lanes, self.builder
        (x, y, z), u = zip(
            *(self._locate(x, axis, n) for x, axis, n in zip(points, AXES, self.supports, strict=True)), strict=True
        )
        size = I64(self.storage.bytes)
        row = b.add(b.mul(z, e.everywhere(b.trunc(self.job.height, I32))), y)
        row_size = e.widen(e.everywhere(b.trunc(b.mul(self.job.width, size), I32)))
        offset = b.add(b.mul(e.widen(row), row_size), b.mul(e.widen(x), e.everywhere(size)))
        return offset, list(u)  # 64 bits from here on: volumes may be large

    def _locate(self, x: Value, axis: str, support: int) -> tuple[Value, Value]:
        """First tap (from 0) and local coordinate; the start is subtracted from integers, u keeps all its digits."""
        e, b = self.lanes, self.builder
        low, high = (e.everywhere(self._scalar(getattr(self.job, f"{end}_{axis}"))) for end in ("low", "high"))
        shifted = e.subtract(x, e.constant(support / 2 - 1))
        base = e.clamp(e.floor(shifted), low, high)
        u = e.multiply_add(shifted, e.constant(0), e.subtract(shifted, base))  # 0 · ∞ = NaN: no value at infinity
        start = e.everywhere(b.trunc(self.job.start, I32))
        return b.sub(e.to_integer(base), start), u

    def _scalar(self, number: Value) -> Value:
        return number if self.lanes.number == DOUBLE else self.builder.fptrunc(number, self.lanes.number)

    def _weigh(self, table: Table, u: Value) -> list[list[Value]]:
        weights = []
        for _ in range(self.recipe.order + 1):
            weights.append([self.lanes.polynomial(row, u) for row in table])
            table = _derivative(table)
        return weights

    # --- jet ---

    def _contract(self, taps: list[Value], here: Value, weights: Weights) -> list[Value]:
        """The rows of the jet; `taps` are the addresses of every lane's first tap, `here` the channel's offset."""
        e, order = self.lanes, self.recipe.order
        wx, wy, _ = weights
        jets = [e.variable(e.constant(0)) for _ in self.rows]
        with self._every_plane(here, weights) as (plane_offset, wz):
            planes: dict[tuple[int, int], Value] = {}
            for y in range(self.supports[1]):
                values = self._fetch(self._row(taps, plane_offset, y))
                for mx in range(order + 1):
                    line = None
                    for weight, value in zip(wx[mx], values, strict=True):
                        line = e.multiply_add(weight, value, line)
                    for my in range(order + 1 - mx):
                        planes[mx, my] = e.multiply_add(wy[my][y], line, planes.get((mx, my)))
            for (mx, my, mz), jet in zip(self.rows, jets, strict=True):
                jet.value = e.multiply_add(wz[mz], planes[mx, my], jet.value)
        return [jet.value for jet in jets]

    @contextmanager
    def _every_plane(self, here: Value, weights: Weights) -> Iterator[tuple[Value, list[Value]]]:
        """for z: the with-block, given the offset of the plane's first tap and the weights of the plane.

        The one loop over taps that is not unrolled: programs are S times shorter and compile S times faster.
        """
        e, b, j = self.lanes, self.builder, self.job
        orders = len(weights[2])
        with e.repeat(I64(0), I64(self.supports[2])) as z:
            own = [e.advance(self.plane_weights, b.add(b.mul(z, I64(orders)), I64(m)), e.pack) for m in range(orders)]
            offset = e.opaque(b.add(here, self._product(z, j.height, j.width)))
            yield offset, [e.load(address, e.number, e.count) for address in own]

    def _row(self, taps: list[Value], plane_offset: Value, y: int) -> list[Value]:
        """Addresses of every lane's row y of taps."""
        offset = self.lanes.opaque(self.builder.add(plane_offset, self.builder.mul(self.job.width, I64(y))))
        return [self.lanes.advance(tap, offset, self.storage.raw) for tap in taps]

    def _fetch(self, rows: list[Value]) -> list[Value]:
        """Tap 0 of every lane, tap 1 of every lane, …"""
        packs = []
        for first, taps in _pieces(self.supports[0]):
            addresses = [self.lanes.advance(row, I64(first), self.storage.raw) for row in rows]
            packs += self._fetch_piece(addresses, taps)
        return [self.lanes.convert(pack, self.storage) for pack in packs]

    def _fetch_piece(self, rows: list[Value], taps: int) -> list[Value]:
        e = self.lanes
        if taps == 1:
            return [self._join([e.load(row, self.storage.raw, 1) for row in rows])]
        if taps == 2:
            pairs = [e.load(row, self.storage.raw, 2) for row in rows]
            return _transpose_pairs(e, [self._join(_lanes_of_groups(pairs, k)) for k in ((0, 1), (2, 3))])
        quads = [e.load_quad(row, self.storage, taps) for row in rows]
        return _transpose_quads(e, [self._join(_lanes_of_groups(quads, (k,))) for k in range(4)])[:taps]

    def _join(self, vectors: list[Value]) -> Value:
        """Vectors laid end to end; their number is a power of two."""
        while len(vectors) > 1:
            width = range(2 * vectors[0].type.count)
            vectors = [self.lanes.shuffle(a, b, width) for a, b in zip(vectors[::2], vectors[1::2], strict=True)]
        return vectors[0]

    # --- splat: the same three sums backwards ---

    def _spread(self, taps: list[Value], here: Value, weights: Weights, cotangents: list[Value]) -> None:
        e = self.lanes
        wx, wy, _ = weights
        with self._every_plane(here, weights) as (plane_offset, wz):
            planes: dict[tuple[int, int], Value] = {}
            for (mx, my, mz), cotangent in zip(self.rows, cotangents, strict=True):
                planes[mx, my] = e.multiply_add(wz[mz], cotangent, planes.get((mx, my)))
            for y in range(self.supports[1]):
                lines: dict[int, Value] = {}
                for (mx, my), plane in planes.items():
                    lines[mx] = e.multiply_add(wy[my][y], plane, lines.get(mx))
                values = []
                for x in range(self.supports[0]):
                    value = None
                    for mx, line in lines.items():
                        value = e.multiply_add(wx[mx][x], line, value)
                    values.append(value)
                self._add_row(self._row(taps, plane_offset, y), values)

    def _add_row(self, rows: list[Value], values: list[Value]) -> None:
        """Add to every lane's row of taps, one lane after the other: two lanes may share a coefficient."""
        e, b = self.lanes, self.builder
        for first, taps in _pieces(self.supports[0]):
            for row, own in zip(rows, self._rows_of_lanes(values[first : first + taps]), strict=True):
                address = e.advance(row, I64(first), self.storage.raw)
                e.store(b.fadd(e.load(address, e.number, taps), own), address)

    def _rows_of_lanes(self, packs: list[Value]) -> list[Value]:
        """The inverse of `_fetch_piece`: for every lane a vector of its taps."""
        e, taps = self.lanes, len(packs)
        if taps == 1:
            return [e.shuffle(packs[0], packs[0], [i]) for i in range(e.count)]
        if taps == 2:
            joined = _interleave_pairs(e, packs)
            return [e.shuffle(joined[i % 4 // 2], joined[i % 4 // 2], _places(i, 2)) for i in range(e.count)]
        joined = _transpose_quads(e, [*packs, *[e.constant(0)] * (4 - taps)])
        return [e.shuffle(joined[i % 4], joined[i % 4], _places(i, taps)) for i in range(e.count)]


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

    def read(self, rows: Value) -> list[Value]:
        """The pack of every row; 0 in the lanes without a point."""
        e, b = self.lanes, self.builder
        with self._when_partial():
            e.clear(self.program.scratch_rows, len(self.program.rows) * e.count * e.bits // 8)
            for row in range(len(self.program.rows)):
                e.copy(self._copied(row), self._own(rows, row), b.mul(self.left, I64(e.bits // 8)))
        return [e.load(address, e.number, e.count) for address in self._addresses(rows)]

    def write(self, rows: Value, packs: list[Value]) -> None:
        e, b = self.lanes, self.builder
        for pack, address in zip(packs, self._addresses(rows), strict=True):
            e.store(pack, address)
        with self._when_partial():
            for row in range(len(packs)):
                e.copy(self._own(rows, row), self._copied(row), b.mul(self.left, I64(e.bits // 8)))

    def _own(self, rows: Value, row: int) -> Value:
        b = self.builder
        return self.lanes.advance(rows, b.add(b.mul(self.program.job.count, I64(row)), self.first), self.lanes.number)

    def _copied(self, row: int) -> Value:
        return self.lanes.advance(self.program.scratch_rows, I64(row * self.lanes.count), self.lanes.number)

    def _addresses(self, rows: Value) -> list[Value]:
        """Where every row's pack is, in the array or in the copy."""
        e, b = self.lanes, self.builder
        first = b.select(self.whole, self._own(rows, 0), self.program.scratch_rows)
        stride = b.select(self.whole, self.program.job.count, I64(e.count))
        return [e.advance(first, b.mul(stride, I64(row)), e.number) for row in range(len(self.program.rows))]

    def _when_partial(self):
        return self.builder.if_then(self.builder.xor(self.whole, I1(1)), likely=False)


def _derivative(table: Table) -> Table:
    if len(table[0]) == 1:
        return tuple((0.0,) for _ in table)
    return tuple(tuple(j * c for j, c in enumerate(row))[1:] for row in table)


def _pieces(support: int) -> list[tuple[int, int]]:
    """A row of taps in pieces of at most four: (first tap, taps)."""
    return [(first, min(4, support - first)) for first in range(0, support, 4)]


# --- transpositions; a group is four lanes --------------------------------------------------------------------------


def _lanes_of_groups(vectors: list[Value], lanes: tuple[int, ...]) -> list[Value]:
    """The vectors of those lanes of every group."""
    return [vectors[group + k] for group in range(0, len(vectors), 4) for k in lanes]


def _in_groups(e: Lanes, a: Value, b: Value, pattern: Sequence[int]) -> Value:
    """A shuffle that does the same in every group: 0-3 are the lanes of a's group, 4-7 those of b's."""
    return e.shuffle(a, b, [g + k if k < 4 else e.count + g + k - 4 for g in range(0, e.count, 4) for k in pattern])


def _transpose_quads(e: Lanes, rows: list[Value]) -> list[Value]:
    """Four registers, row k holding the four taps of lane k of every group -> tap k of every lane; its own inverse."""
    a, b, c, d = rows
    low = _in_groups(e, a, b, (0, 4, 1, 5)), _in_groups(e, c, d, (0, 4, 1, 5))  # a0 b0 a1 b1 and c0 d0 c1 d1
    high = _in_groups(e, a, b, (2, 6, 3, 7)), _in_groups(e, c, d, (2, 6, 3, 7))  # a2 b2 a3 b3 and c2 d2 c3 d3
    return [_in_groups(e, ab, cd, half) for ab, cd in (low, high) for half in ((0, 1, 4, 5), (2, 3, 6, 7))]


def _transpose_pairs(e: Lanes, rows: list[Value]) -> list[Value]:
    """a0 a1 b0 b1 and c0 c1 d0 d1 in every group -> tap 0 and tap 1 of every lane."""
    ab, cd = rows
    return [_in_groups(e, ab, cd, pattern) for pattern in ((0, 2, 4, 6), (1, 3, 5, 7))]


def _interleave_pairs(e: Lanes, taps: list[Value]) -> list[Value]:
    """The inverse of `_transpose_pairs`."""
    first, second = taps
    return [_in_groups(e, first, second, pattern) for pattern in ((0, 4, 1, 5), (2, 6, 3, 7))]


def _places(lane: int, taps: int) -> range:
    """Where the taps of a lane stand after the transposition into rows."""
    first = lane // 4 * 4 + (2 * (lane % 2) if taps == 2 else 0)
    return range(first, first + taps)
