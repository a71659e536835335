"""Where the data of P triangles of a spline of heights lie, for the programs of `ops.cpu.height_jets`.

A half turn maps the triangles of a cell onto one another: datum (a, b) is σ (a, b) from V0, with a sign σ of every
lane's own for columns and rows. The data of one row are as far from its one end as from the other, so a lane reads all
of them in the order of memory, up to four at a time, and where σ is −1 pairs of them change places. What is kept of a
pack is an address for every lane and row. Cells whose data are not all in the grid have theirs copied, through tables
that say where indices are stored under the boundary; sums in them are added to the grid in the end.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import SimpleNamespace

from llvmlite import ir

from filterlab.ops.cpu.lanes import I32, I64, POINTER, Lanes, Storage, Value
from filterlab.ops.cpu.taps import lines_of_packs, packs_of_lines
from filterlab.ops.heights import Pattern

_PIECES_AT_ONCE = 6  # of a lane, added before those of the next one: all of most splines


@dataclass(frozen=True)
class _Row:
    """Data of a triangle that have b in common.

    Attributes:
        step: b.
        first, last: the least and the greatest a.
        columns: of every datum, in the order of memory, how far it is from the first one.
        order: of every datum, in the order of the pattern, which of these it is where σ is 1; counted from the end
            where σ is −1.
        pieces: columns that lie side by side and are read at once, with those between that are not asked for.
    """

    step: int
    first: int
    last: int
    columns: tuple[int, ...]
    order: tuple[int, ...]
    pieces: tuple[range, ...]


def _rows_of(pattern: Pattern) -> list[_Row]:
    found = []
    for step, group in itertools.groupby(pattern.offsets, key=lambda offset: offset[1]):
        given = [a for a, _ in group]
        own = sorted(given)
        columns = tuple(a - own[0] for a in own)
        assert columns == tuple(own[-1] - a for a in reversed(own)), (pattern.name, step)
        found.append(_Row(step, own[0], own[-1], columns, tuple(map(own.index, given)), tuple(_pieces(columns))))
    return found


def _pieces(columns: Sequence[int]) -> Iterator[range]:
    """Columns in ranges of up to four: three or four of four with those between, others if they are neighbours."""
    left = list(columns)
    while left:
        start = left[0]
        near = [n for n in left if n < start + 4]
        near = near if len(near) > 2 else [n for n in near if n < start + 2]
        yield range(start, near[-1] + 1)
        left = left[len(near) :]


class Data:
    """Of the triangles of some packs at a time. Make it before any loop.

    Args:
        lanes: writer of instructions.
        job: with the fields of `ops.cpu.height_jets`.
        pattern: the spline.
        storage: of the data.
        zeros: whether heights are 0 beyond their ends.
        packs: how many are kept.
    """

    def __init__(
        self, lanes: Lanes, job: SimpleNamespace, pattern: Pattern, storage: Storage, zeros: bool, packs: int
    ) -> None:
        self.lanes, self.builder, self.job, self.pattern = lanes, lanes.builder, job, pattern
        self.storage, self.zeros, self.rows = storage, zeros, _rows_of(pattern)
        self.width = max(row.last - row.first + 1 for row in self.rows)
        count = packs * lanes.count
        self.addresses = lanes.reserve(I64, len(self.rows) * count)  # of a pack, row after row
        self.copied = lanes.reserve(I64, packs)  # whether a lane of it is
        self.outside = lanes.reserve(I64, count)
        self.copies = lanes.reserve(storage.raw, len(self.rows) * self.width * count + 1)  # three are added as four
        self.told = [lanes.reserve(I64, count) for _ in range(4)]  # column and row of V0, σ; of packs with copies

    # --- a pack is found ---

    def find(self, values: Value, index: Value, start: Sequence[Value], signs: Sequence[Value]) -> None:
        """Keep where the data of a pack are, if all are in the grid.

        Args:
            values: address of the datum (0, 0).
            index: of the pack among those that are kept.
            start: (column, row) of V0, 32-bit integers.
            signs: σ along columns and rows, 32-bit integers.
        """
        e, b, j = self.lanes, self.builder, self.job
        wide = lambda pack: b.sext(pack, ir.VectorType(I64, e.count))  # noqa: E731
        up, forward = (b.icmp_signed(">", sign, e.integers_32(0)) for sign in signs[::-1])
        row_step = wide(e.everywhere(b.trunc(j.row_step, I32)))  # of 32 bits: machines multiply packs of those at once
        number = b.add(b.mul(wide(start[1]), row_step), wide(start[0]))
        size = e.everywhere(I64(self.storage.bytes))
        own = b.add(e.everywhere(b.ptrtoint(values, I64)), b.mul(number, size))
        stride = b.mul(row_step, size)
        step, at = b.select(up, stride, b.sub(e.everywhere(I64(0)), stride)), 0
        for place, row in enumerate(self.rows):
            ends = (e.everywhere(I64(self.storage.bytes * n)) for n in (row.first, -row.last))
            own, at = b.add(own, b.mul(step, e.everywhere(I64(row.step - at)))), row.step
            e.store(b.add(own, b.select(forward, *ends)), self._address(index, place, I64(0)))
        b.store(I64(0), e.advance(self.copied, index, I64))

    def _address(self, index: Value, row: int, lane: Value) -> Value:
        b = self.builder
        place = b.add(b.mul(b.add(b.mul(index, I64(len(self.rows))), I64(row)), I64(self.lanes.count)), lane)
        return self.lanes.advance(self.addresses, place, I64)

    def ask(self, index: Value) -> None:
        """Have the data of a pack brought near."""
        e, b = self.lanes, self.builder
        for number, row in enumerate(self.rows):
            for lane in range(e.count):
                address = b.load(self._address(index, number, I64(lane)), typ=POINTER)
                for column in {0, row.columns[-1]}:
                    e.ask(e.advance(address, I64(column), self.storage.raw))

    def copy(self, values: Value, index: Value, outside: Value, told: Sequence[Value], empty: bool) -> None:
        """Of the lanes of a mask, copies.

        Args:
            told: column and row of V0, as the tables have them, and both signs.
            empty: zeros instead, to be added to.
        """
        e, b = self.lanes, self.builder
        first, pack = b.mul(index, I64(e.count)), ir.VectorType(I64, e.count)
        b.store(I64(1), e.advance(self.copied, index, I64))
        e.store(b.zext(outside, pack), e.advance(self.outside, first, I64))
        for array, own in zip(self.told, told, strict=True):
            e.store(b.sext(own, pack), e.advance(array, first, I64))
        with self._every_copy(index) as lane:
            for number, row in enumerate(self.rows):
                copy = self._copy_of(lane, number)
                b.store(b.ptrtoint(copy, I64), self._address(index, number, b.sub(lane, first)))
                if empty:
                    e.clear(copy, self.width * self.storage.bytes)
                else:
                    self._fill(values, lane, row, copy)

    def _fill(self, values: Value, lane: Value, row: _Row, copy: Value) -> None:
        b, nothing = self.builder, ir.Constant(self.storage.raw, None)
        with self._every_datum(values, lane, row, copy) as (source, inside, target):
            raw = b.load(source, typ=self.storage.raw)
            b.store(b.select(inside, raw, nothing) if self.zeros else raw, target)

    def give(self, values: Value, index: Value) -> None:
        """Add to the grid what was added to copies."""
        e, b = self.lanes, self.builder
        copied = b.icmp_signed("!=", b.load(e.advance(self.copied, index, I64), typ=I64), I64(0))
        with b.if_then(copied, likely=False), self._every_copy(index) as lane:
            for number, row in enumerate(self.rows):
                with self._every_datum(values, lane, row, self._copy_of(lane, number)) as (place, inside, copy):
                    own = b.load(copy, typ=e.number)
                    own = b.select(inside, own, ir.Constant(e.number, 0)) if self.zeros else own
                    b.store(b.fadd(b.load(place, typ=e.number), own), place)

    def _copy_of(self, lane: Value, row: int) -> Value:
        b = self.builder
        place = b.mul(b.add(b.mul(lane, I64(len(self.rows))), I64(row)), I64(self.width))
        return self.lanes.advance(self.copies, place, self.storage.raw)

    @contextmanager
    def _every_copy(self, index: Value) -> Iterator[Value]:
        """For every lane that is copied, counted from that of the first pack on."""
        e, b = self.lanes, self.builder
        first = b.mul(index, I64(e.count))
        with e.repeat(first, b.add(first, I64(e.count))) as lane:
            outside = b.load(e.advance(self.outside, lane, I64), typ=I64)
            with b.if_then(b.icmp_signed("!=", outside, I64(0))):
                yield lane

    @contextmanager
    def _every_datum(self, values: Value, lane: Value, row: _Row, copy: Value) -> Iterator[tuple[Value, Value, Value]]:
        """For those of a row, and what is between: where it is in the grid, whether it is one, where in the copy."""
        e, b, j = self.lanes, self.builder, self.job
        x, y, right, down = (b.load(e.advance(array, lane, I64), typ=I64) for array in self.told)
        line = b.add(y, b.mul(down, I64(row.step)))
        begin = b.add(x, b.select(b.icmp_signed(">", right, I64(0)), I64(row.first), I64(-row.last)))
        start = b.load(e.advance(j.line, line, I64), typ=I64)
        with e.repeat(I64(0), I64(row.columns[-1] + 1)) as n:
            column = b.add(begin, n)
            inside = b.and_(b.icmp_unsigned("<", column, j.size_x), b.icmp_unsigned("<", line, j.size_y))
            place = b.add(start, b.load(e.advance(j.column, column, I64), typ=I64))
            yield e.advance(values, place, self.storage.raw), inside, e.advance(copy, n, self.storage.raw)

    # --- a pack is used ---

    def read(self, index: Value, forward: Value) -> tuple[Value, Iterator[Value]]:
        """Of all lanes the datum that `Triangle.first` names, and the data, one after the other.

        Args:
            forward: a mask: where σ is 1 along columns.
        """
        wanted, number = self.pattern.up.first, 0
        while wanted >= len(self.rows[number].order):
            wanted, number = wanted - len(self.rows[number].order), number + 1
        row = self._row(index, number, forward)
        every = (row if n == number else self._row(index, n, forward) for n in range(len(self.rows)))
        return row[wanted], itertools.chain.from_iterable(every)

    def _row(self, index: Value, number: int, forward: Value) -> list[Value]:
        """The data of a row, in the order of the pattern."""
        e, row = self.lanes, self.rows[number]
        places, found = self._places(index, number), {}
        for piece in row.pieces:
            lines = [self._line(e.advance(place, I64(piece.start), self.storage.raw), len(piece)) for place in places]
            found |= zip(
                piece, (e.convert(own, self.storage) for own in packs_of_lines(e, lines, len(piece))), strict=True
            )
        data = [found[n] for n in row.columns]
        return [self._chosen(forward, data[own], data[-1 - own]) for own in row.order]

    def _line(self, address: Value, count: int) -> Value:
        e, storage = self.lanes, self.storage
        return e.load(address, storage.raw, count) if count <= 2 else e.load_quad(address, storage, count, room=False)

    def _chosen(self, forward: Value, pack: Value, other: Value) -> Value:
        return pack if pack is other else self.lanes.where(forward, pack, other)

    def _places(self, index: Value, number: int) -> list[Value]:
        """Where a row begins in memory, lane by lane."""
        return [
            self.builder.load(self._address(index, number, I64(lane)), typ=POINTER) for lane in range(self.lanes.count)
        ]

    def add(self, index: Value, forward: Value, packs: Sequence[Value]) -> None:
        """To every datum, in the order of `read`, one lane after the other: two may share a datum.

        What a lane adds waits for what the one before has stored, where part of that is the same: several pieces are
        written in a row, and neighbours among the points, which may well be so, not one after the other.
        """
        e, b = self.lanes, self.builder
        order = [lane for k in range(4) for lane in range(k, e.count, 4)]
        every = self._given(forward, packs)
        while pieces := list(itertools.islice(every, _PIECES_AT_ONCE)):
            for lane in order:
                for number, start, lines in pieces:
                    address = b.load(self._address(index, number, I64(lane)), typ=POINTER)
                    address = e.advance(address, I64(start), self.storage.raw)
                    e.store(b.fadd(e.load(address, e.number, lines[lane].type.count), lines[lane]), address)

    def _given(self, forward: Value, packs: Sequence[Value]) -> Iterator[tuple[int, int, list[Value]]]:
        """What lanes add: number of a row, column of a piece, and for every lane a vector."""
        left = list(packs)
        for number, row in enumerate(self.rows):
            own, left = left[: len(row.columns)], left[len(row.columns) :]
            own = [own[row.order.index(n)] for n in range(len(own))]
            chosen = [self._chosen(forward, pack, other) for pack, other in zip(own, reversed(own), strict=True)]
            given = dict(zip(row.columns, chosen, strict=True))
            for piece in row.pieces:
                yield (
                    number,
                    piece.start,
                    lines_of_packs(self.lanes, [given.get(n, self.lanes.constant(0)) for n in piece]),
                )
