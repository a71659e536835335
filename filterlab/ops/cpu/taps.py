"""The sums over taps, written as vector code for any stencil: the heart of every fused operation.

Letters, as in `ops.reference`: x, y, z along W, H, D; S taps per axis; u the local coordinate. P points are handled at
a time: a *pack* is P numbers, one per point, and a point's place in it is its *lane* (`ops.cpu.lanes` explains the
instructions). a, b, c number the weight functions along x, y, z that the stencil's products are made of: for a jet the
derivatives of one kernel.

What is written for one pack of points:

    locate     x, y, z -> address of the first tap, and u         (3 packs -> 3 packs and addresses)
    weigh      w[axis][function][t] = the weight of tap t, a polynomial in u
    for every line of taps (z, y):
        fetch      the coefficients of that line, for every lane: up to S packs
        along x    line[a]       = Σ_x w[x][a][x] · tap x
        along y    plane[a, b]  += w[y][b][y] · line[a]
    along z        row[a, b, c] += w[z][c][z] · plane[a, b]       after every plane

so that value and gradient of a 3×3×3 kernel cost 93 multiply-adds, not 27·4. `spread`, the adjoint of `contract`, runs
the three sums backwards. Taps that a product has no weight for are neither read nor multiplied: NCRSI reads 32
coefficients of its 4×4×4. Everything is written out but for the loop over planes of taps that look alike, and that as
well where it is short.

The coefficients of one line lie together in memory, but a pack wants the first tap of every lane together, then the
second tap of every lane. Collecting them one by one (a gather) is slow; instead every lane's line is read in one piece
and the P×S table is transposed in registers. Four lanes a, b, c, d with four taps 0 1 2 3:

    lines as read            pairs interleaved            halves joined
    a0 a1 a2 a3    ─┐
    b0 b1 b2 b3    ─┴─▶  a0 b0 a1 b1 │ a2 b2 a3 b3   ─┐   a0 b0 c0 d0   tap 0 of every lane
    c0 c1 c2 c3    ─┐                                ─┼─▶ a1 b1 c1 d1   tap 1
    d0 d1 d2 d3    ─┴─▶  c0 d0 c1 d1 │ c2 d2 c3 d3   ─┘   a2 b2 c2 d2   tap 2
                                                          a3 b3 c3 d3   tap 3

With P = 8 two such tables lie side by side in every register (lanes 0-3 and 4-7), with P = 16 four: a *group* is four
lanes. Lines of two taps need one step less; lines of five and six are a line of four and the rest.

Nothing outside the coefficients is touched: the first tap is clamped before it becomes an integer, NaN included.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from types import SimpleNamespace

from filterlab.ops.cpu.lanes import I32, I64, Lanes, Storage, Value
from filterlab.ops.stencil import Lowered

_LINES_AT_ONCE = 4
"""Pieces of lines that are read together where packs have 512 bits: such machines have 32 registers for them.

Measured with AVX-512 (Zen 5), coefficients in the cache: 0.8 times the time of one line after the other.
"""
_ROWS_WITH_LINES = 4
"""Sums of more rows need the registers themselves: the gradient to points of a tricubic jet took 1.25 × the time."""

WRITTEN_OUT = 6

Weights = list[list[list[Value | None]]]
"""[axis][function][t]: the weight of tap t, a pack; None where the function has none."""


@dataclass(frozen=True)
class Grid:
    """How the coefficients of one channel lie in memory and in space, as values of the program.

    Attributes:
        width, height: W and H (64 bits).
        start: coordinate of coefficient 0 along every axis (64 bits).
        low, high: smallest and largest coordinate of a first tap along x, y, z (doubles).
    """

    width: Value
    height: Value
    start: Value
    low: tuple[Value, Value, Value]
    high: tuple[Value, Value, Value]

    @classmethod
    def of(cls, job: SimpleNamespace) -> Grid:
        """From a job's fields of these names, low_x … high_z for the ends."""
        low = job.low_x, job.low_y, job.low_z
        return cls(job.width, job.height, job.start, low, (job.high_x, job.high_y, job.high_z))


@dataclass(frozen=True)
class _Piece:
    """At most four taps of line y of a plane, and the offset of that line, in coefficients."""

    y: int
    taps: range
    offset: Value


class Location:
    """Writes where points lie among the coefficients.

    Args:
        lanes: writer of instructions.
        supports: S along x, y, z.
        storage: how coefficients lie in memory.
        grid: where they lie.
    """

    def __init__(self, lanes: Lanes, supports: tuple[int, int, int], storage: Storage, grid: Grid) -> None:
        self.lanes, self.builder = lanes, lanes.builder
        self.supports, self.storage, self.grid = supports, storage, grid

    def locate(self, points: Sequence[Value], volume: Value) -> tuple[Value, list[Value]]:
        """The address of every lane's first tap (64 bits), and its local coordinates u along x, y, z.

        Args:
            points: packs of x, y, z.
            volume: address of coefficient 0.
        """
        e, b = self.lanes, self.builder
        (x, y, z), u = zip(*self.located(points), strict=True)
        size = I64(self.storage.bytes)
        line = b.add(b.mul(z, e.everywhere(b.trunc(self.grid.height, I32))), y)
        line_size = e.widen(e.everywhere(b.trunc(b.mul(self.grid.width, size), I32)))
        offset = b.add(b.mul(e.widen(line), line_size), b.mul(e.widen(x), e.everywhere(size)))
        return b.add(offset, e.everywhere(b.ptrtoint(volume, I64))), list(u)  # 64 bits: volumes may be large

    def located(self, points: Sequence[Value]) -> list[tuple[Value, Value]]:
        """What `locate` gives, along x, y, z."""
        return self.cells(points)

    def cells(self, points: Sequence[Value]) -> list[tuple[Value, Value]]:
        """Along x, y, z: every lane's first tap, counted from coefficient 0 (32 bits), and its u."""
        return [self._locate(point, axis) for axis, point in enumerate(points)]

    def _locate(self, x: Value, axis: int) -> tuple[Value, Value]:
        """First tap (from 0) and local coordinate; the start is subtracted from integers, u keeps all its digits."""
        e, b = self.lanes, self.builder
        low, high = (e.everywhere(e.scalar(end[axis])) for end in (self.grid.low, self.grid.high))
        shifted = e.subtract(x, e.constant(self.supports[axis] / 2 - 1))
        base = e.clamp(e.floor(shifted), low, high)
        u = e.multiply_add(shifted, e.constant(0), e.subtract(shifted, base))  # 0 · ∞ = NaN: no value at infinity
        start = e.everywhere(b.trunc(self.grid.start, I32))
        return b.sub(e.to_integer(base), start), u


class Lines:
    """Reads lines of taps, and adds to them, each lane its own.

    Args:
        lanes: writer of instructions.
        storage: how coefficients lie in memory; to be added to in the type of the arithmetic.
        grid: where they lie.
        room: see `Taps`.
        rows: that are summed from what is read.
    """

    def __init__(self, lanes: Lanes, storage: Storage, grid: Grid, room: bool = False, rows: int = 1) -> None:
        self.lanes, self.builder = lanes, lanes.builder
        self.storage, self.grid, self.room = storage, grid, room
        wide = lanes.count * lanes.bits >= 512
        self.written_at_once = _LINES_AT_ONCE if wide else 1
        self.read_at_once = _LINES_AT_ONCE if wide and rows <= _ROWS_WITH_LINES else 1

    def _pieces(self, plane_offset: Value, needed: dict[int, range], at_once: int) -> list[list[_Piece]]:
        """Lines of taps in pieces of at most four, as many at a time as there are registers for."""
        e, b = self.lanes, self.builder
        pieces = []
        for y, taps in needed.items():
            offset = e.opaque(b.add(plane_offset, b.mul(self.grid.width, I64(y))))
            starts = range(taps.start, taps.stop, 4)
            pieces += [_Piece(y, range(first, min(first + 4, taps.stop)), offset) for first in starts]
        return [pieces[i : i + at_once] for i in range(0, len(pieces), at_once)]

    def _address(self, tap: Value, piece: _Piece) -> Value:
        """Of the first number of a piece, from a lane's first tap."""
        e, raw = self.lanes, self.storage.raw
        return e.advance(e.advance(tap, piece.offset, raw), I64(piece.taps.start), raw)

    def fetch(
        self, taps: list[Value], plane_offset: Value, needed: dict[int, range]
    ) -> Iterator[tuple[int, dict[int, Value]]]:
        """(y, {x: tap x of every lane}) for the lines y, one after the other.

        A lane's address is loaded once for several lines: there are more lanes than registers for addresses.
        """
        e = self.lanes
        found: dict[int, dict[int, Value]] = {y: {} for y in needed}
        for pieces in self._pieces(plane_offset, needed, self.read_at_once):
            read = {lane: [self._read(taps[lane], piece) for piece in pieces] for lane in self._as_joined()}
            for i, piece in enumerate(pieces):
                packs = packs_of_lines(e, [read[lane][i] for lane in range(e.count)], len(piece.taps))
                found[piece.y] |= zip(piece.taps, (e.convert(p, self.storage) for p in packs), strict=True)
            yield from ((y, found.pop(y)) for y in list(found) if len(found[y]) == len(needed[y]))

    def _as_joined(self) -> list[int]:
        """The first lane of every group, then the second of every group, …: those that are joined into one register."""
        return [lane for k in range(4) for lane in range(k, self.lanes.count, 4)]

    def _read(self, tap: Value, piece: _Piece) -> Value:
        e, raw, count = self.lanes, self.storage.raw, len(piece.taps)
        address = self._address(tap, piece)
        return e.load(address, raw, count) if count <= 2 else e.load_quad(address, self.storage, count, self.room)

    def add(
        self, taps: list[Value], plane_offset: Value, needed: dict[int, range], values: dict[int, list[Value]]
    ) -> None:
        """Add packs to every lane's lines of taps, one lane after the other: two lanes may share a coefficient.

        All lines of a lane before the next lane's: what it adds to a line may wait for what the lane before stored.
        Three taps are added as four, the fourth 0: one access instead of two, for which there is room behind the last
        coefficient. Measured (Zen 5): 0.7 times the time.
        """
        e, b = self.lanes, self.builder
        for pieces in self._pieces(plane_offset, needed, self.written_at_once):
            rows = []
            for piece in pieces:
                first = needed[piece.y].start
                packs = values[piece.y][piece.taps.start - first : piece.taps.stop - first]
                rows.append(lines_of_packs(e, packs))
            for lane, tap in enumerate(taps):
                for piece, row in zip(pieces, rows, strict=True):
                    address = self._address(tap, piece)
                    e.store(b.fadd(e.load(address, e.number, row[lane].type.count), row[lane]), address)


class Taps:
    """Writes the sums of a stencil at the end of the current block. Make it before any loop: it reserves memory.

    Args:
        lanes: writer of instructions.
        stencil: what is summed.
        storage: how coefficients lie in memory; for `spread` in the type of the arithmetic.
        grid: where they lie.
        room: whether the number behind the last coefficient may be read, so that three taps can be read as four.
            Measured (AVX-512, Zen 5): a march takes 0.97 times the time; jets of points gain nothing.
        written_out: rows times planes up to which `contract` has no loop over planes. Measured there: a march takes
            0.95 to 0.98 times the time (triquadratic, 1 or 4 rows), values at points 0.94 and 0.96 (tricubic);
            values with gradients at points gain nothing.
    """

    def __init__(
        self,
        lanes: Lanes,
        stencil: Lowered,
        storage: Storage,
        grid: Grid,
        room: bool = False,
        written_out: int = WRITTEN_OUT,
    ) -> None:
        self.lanes, self.builder = lanes, lanes.builder
        self.stencil, self.storage, self.grid = stencil, storage, grid
        self.supports = stencil.supports
        self.lines = Lines(lanes, storage, grid, room, len(stencil.rows))
        self.written_out = len(stencil.rows) * stencil.supports[2] <= written_out
        self._plane_weights = lanes.reserve(lanes.pack, self.supports[2] * len(stencil.functions[2]))

    def location(self, lanes: Lanes) -> Location:
        """Of points in packs that may be longer."""
        return Location(lanes, self.supports, self.storage, self.grid)

    def weigh(self, u: Sequence[Value]) -> Weights:
        """The weights of all taps, from `Location.locate`'s u; the loop over planes reads those along z from memory."""
        e = self.lanes
        weights: Weights = [
            [[e.polynomial(row, own) if any(row) else None for row in table] for table in functions]
            for functions, own in zip(self.stencil.functions, u, strict=True)
        ]
        for function, taps in enumerate(weights[2]):
            for z, weight in enumerate(taps):
                if weight is not None:
                    e.store(weight, self._plane_weight(I64(z), function))
        return weights

    def _plane_weight(self, z: Value, function: int) -> Value:
        b = self.builder
        index = b.add(b.mul(z, I64(len(self.stencil.functions[2]))), I64(function))
        return self.lanes.advance(self._plane_weights, index, self.lanes.pack)

    # --- the sums ---

    def contract(self, taps: list[Value], here: Value, weights: Weights, u: Sequence[Value]) -> list[Value]:
        """The rows of the stencil.

        Args:
            taps: address of every lane's first tap.
            here: offset of the channel, in coefficients.
            weights: of `weigh`.
            u: of `locate`; rows that are zero everywhere are NaN where it is.
        """
        e = self.lanes
        rows = [e.variable(e.constant(0)) for _ in self.stencil.rows]
        for planes in self._alike(apart=self.written_out):
            with self._every(planes, here) as (plane_offset, wz):
                sums: dict[tuple[int, int], Value] = {}
                pairs = self.stencil.pairs(wz)
                for y, line in self.lines.fetch(taps, plane_offset, self._needed(pairs)):
                    self._contract_line(y, line, weights, pairs, sums)
                for row, products in zip(rows, self.stencil.rows, strict=True):
                    for c, weight in wz.items():
                        if (total := self._combine(products, c, sums)) is not None:
                            row.value = e.multiply_add(weight, total, row.value)
        nothing = None
        for own in u:
            nothing = e.multiply_add(own, e.constant(0), nothing)
        return [row.value if products else nothing for row, products in zip(rows, self.stencil.rows, strict=True)]

    def _contract_line(
        self,
        y: int,
        line: dict[int, Value],
        weights: Weights,
        pairs: list[tuple[int, int]],
        sums: dict[tuple[int, int], Value],
    ) -> None:
        """Add line y of a plane, given its taps by number, to the sums over planes[a, b]."""
        e = self.lanes
        wx, wy, _ = weights
        pairs = [(a, b) for a, b in pairs if wy[b][y] is not None]
        for a in sorted({a for a, _ in pairs}):
            total = None
            for x, value in line.items():
                if wx[a][x] is not None:
                    total = e.multiply_add(wx[a][x], value, total)
            for b in sorted({b for own, b in pairs if own == a}):
                sums[a, b] = e.multiply_add(wy[b][y], total, sums.get((a, b)))

    def _combine(self, products: Sequence[tuple], c: int, sums: dict[tuple[int, int], Value]) -> Value | None:
        """Σ weight · plane[a, b] over the products of a row that have c along z."""
        e, total = self.lanes, None
        for weight, a, b, own in products:
            if own == c and (a, b) in sums:
                plane = sums[a, b]
                if weight != 1 or total is not None:
                    plane = e.multiply_add(e.constant(weight), plane, total)
                total = plane
        return total

    def spread(self, taps: list[Value], here: Value, weights: Weights, cotangents: list[Value]) -> None:
        """The three sums backwards: add every lane's cotangents (packs, one per row) into the coefficients."""
        for planes in self._alike():
            with self._every(planes, here) as (plane_offset, wz):
                sums = self._spread_planes(wz, cotangents)
                needed = self._needed(list(sums))
                values = {y: self._spread_line(y, taps_of_line, weights, sums) for y, taps_of_line in needed.items()}
                self.lines.add(taps, plane_offset, needed, values)

    def _spread_line(self, y: int, needed: range, weights: Weights, sums: dict[tuple[int, int], Value]) -> list[Value]:
        """What is added to the needed taps of line y, a pack for each."""
        e = self.lanes
        wx, wy, _ = weights
        lines: dict[int, Value] = {}
        for (a, b), plane in sums.items():
            if wy[b][y] is not None:
                lines[a] = e.multiply_add(wy[b][y], plane, lines.get(a))
        values = []
        for x in needed:
            value = None
            for a, line in lines.items():
                if wx[a][x] is not None:
                    value = e.multiply_add(wx[a][x], line, value)
            values.append(e.constant(0) if value is None else value)
        return values

    def _spread_planes(self, wz: dict[int, Value], cotangents: list[Value]) -> dict[tuple[int, int], Value]:
        e = self.lanes
        sums: dict[tuple[int, int], Value] = {}
        for products, cotangent in zip(self.stencil.rows, cotangents, strict=True):
            for weight, a, b, c in products:
                if c in wz:
                    own = wz[c] if weight == 1 else e.multiply(wz[c], e.constant(weight))
                    sums[a, b] = e.multiply_add(own, cotangent, sums.get((a, b)))
        return sums

    # --- which taps there are ---

    def _alike(self, apart: bool = False) -> list[tuple[range, tuple[int, ...]]]:
        """Runs of planes (or planes apart) with the same functions that have a weight along z; and those functions."""
        found = self.stencil.runs()
        return [(range(z, z + 1), key) for planes, key in found for z in planes] if apart else found

    def _needed(self, pairs: list[tuple[int, int]]) -> dict[int, range]:
        """The lines y of a plane that products with these (a, b) read, and which of their taps: first to last."""
        lines = {
            y: self.stencil.taps({a for a, b in pairs if self.stencil.has(1, b, y)}) for y in range(self.supports[1])
        }
        return {y: range(taps[0], taps[-1] + 1) for y, taps in lines.items() if taps}

    @contextmanager
    def _every(self, planes: tuple[range, tuple[int, ...]], here: Value) -> Iterator[tuple[Value, dict[int, Value]]]:
        """for z in planes: the with-block, given the offset of the plane's first tap and the weights along z.

        The one loop over taps that is not always unrolled: programs are S times shorter and compile S times faster.
        """
        run, functions = planes
        with self.lanes.repeat(I64(run.start), I64(run.stop)) if len(run) > 1 else nullcontext(I64(run.start)) as z:
            yield self._plane(z, functions, here)

    def _plane(self, z: Value, functions: Sequence[int], here: Value) -> tuple[Value, dict[int, Value]]:
        e, b, grid = self.lanes, self.builder, self.grid
        own = {c: e.load(self._plane_weight(z, c), e.number, e.count) for c in functions}
        return e.opaque(b.add(here, b.mul(b.mul(z, grid.height), grid.width))), own


# --- transpositions; a group is four lanes --------------------------------------------------------------------------


def lanes_of_groups(vectors: list[Value], lanes: tuple[int, ...]) -> list[Value]:
    """The vectors of those lanes of every group."""
    return [vectors[group + k] for group in range(0, len(vectors), 4) for k in lanes]


def _in_groups(e: Lanes, a: Value, b: Value, pattern: Sequence[int]) -> Value:
    """A shuffle that does the same in every group: 0-3 are the lanes of a's group, 4-7 those of b's."""
    return e.shuffle(a, b, [g + k if k < 4 else e.count + g + k - 4 for g in range(0, e.count, 4) for k in pattern])


def packs_of_lines(e: Lanes, lines: list[Value], taps: int) -> list[Value]:
    """Every lane's line of up to four taps -> the first tap of every lane, the second of every lane, …"""
    if taps == 1:
        return [e.join(lines)]
    if taps == 2:
        return _transpose_pairs(e, [e.join(lanes_of_groups(lines, k)) for k in ((0, 1), (2, 3))])
    return transpose_quads(e, [e.join(lanes_of_groups(lines, (k,))) for k in range(4)])[:taps]


def lines_of_packs(e: Lanes, packs: list[Value]) -> list[Value]:
    """The inverse: for every lane a vector of its taps, and a 0 behind three of them."""
    taps = len(packs)
    if taps == 1:
        return [e.shuffle(packs[0], packs[0], [i]) for i in range(e.count)]
    if taps == 2:
        joined = _interleave_pairs(e, packs)
        return [e.shuffle(joined[i % 4 // 2], joined[i % 4 // 2], _places(i, 2)) for i in range(e.count)]
    joined = transpose_quads(e, [*packs, *[e.constant(0)] * (4 - taps)])
    return [e.shuffle(joined[i % 4], joined[i % 4], _places(i, 4)) for i in range(e.count)]


def transpose_quads(e: Lanes, rows: list[Value]) -> list[Value]:
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
