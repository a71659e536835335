"""Writes the Bernstein coefficients of a cell of a spline of heights, and of P cells in a row.

Data are read where they lie; windows that reach beyond the grid are copied to the stack first, through tables of which
datum stands where. Only data that a coefficient needs are read for it, so that a hole is as large as it should be.
"""

from __future__ import annotations

import ctypes
import itertools
from types import SimpleNamespace

from llvmlite import ir

from filterlab import bernstein
from filterlab.ops.cpu.lanes import DOUBLE, FLOAT, HALF, I32, I64, POINTER, Lanes, Storage, Value
from filterlab.ops.height_hits import DEGREE, POINTS, Cell

UPPER = tuple((DEGREE + 1) * k + j for _, j, k in bernstein.multi_indices(DEGREE, 2))
"""Numbers of the domain points of the upper triangle, in the order of its coefficients."""

LOWER = tuple(POINTS - 1 - number for number in UPPER)

GRID: dict[str, type] = {
    "values": ctypes.c_void_p,  # (height, width) in their storage, rows `row` numbers apart
    "row": ctypes.c_int64,
    "width": ctypes.c_int64,
    "height": ctypes.c_int64,
    "rows": ctypes.c_void_p,  # int64, see `ops.height_hits.data_of_windows`
    "columns": ctypes.c_void_p,
    "reach": ctypes.c_int64,  # how many these are
}
"""Fields of a job."""


class Windows:
    """Where the data of cells lie.

    Args:
        lanes: writer of instructions.
        job: with the fields `GRID`.
        cell: what the coefficients are made of.
        storage: of the data.
        count: P, cells side by side of which a window has the data of all.
    """

    def __init__(self, lanes: Lanes, job: SimpleNamespace, cell: Cell, storage: Storage, count: int = 1) -> None:
        self.lanes, self.builder, self.job, self.cell, self.storage = lanes, lanes.builder, job, cell, storage
        self.count = count
        self.length = cell.steps * (count - 1) + cell.size
        self.buffer = lanes.reserve(storage.raw, cell.size * self.length)
        self.base = lanes.variable(ir.Constant(POINTER, None))
        self.stride = lanes.variable(I64(0))

    def go_to(self, x: Value, y: Value) -> None:
        """The window of the cell (x, y), and those behind it."""
        e, b, j, cell = self.lanes, self.builder, self.job, self.cell
        left, top = (b.sub(b.mul(n, I64(cell.steps)), I64(cell.before)) for n in (x, y))
        whole = b.and_(
            b.and_(b.icmp_signed(">=", left, I64(0)), b.icmp_signed(">=", top, I64(0))),
            b.and_(
                b.icmp_signed("<=", b.add(left, I64(self.length)), j.width),
                b.icmp_signed("<=", b.add(top, I64(cell.size)), j.height),
            ),
        )
        with b.if_else(whole, likely=True) as (direct, copied):
            with direct:
                self.base.value = e.advance(j.values, b.add(b.mul(top, j.row), left), self.storage.raw)
                self.stride.value = j.row
            with copied:
                self._copy(x, y)
                self.base.value, self.stride.value = self.buffer, I64(self.length)

    def ask(self, x: Value, y: Value) -> None:
        """Have the window of the cell (x, y) brought near; of one that is partly outside, whatever lies there."""
        e, b, j, cell = self.lanes, self.builder, self.job, self.cell
        left, top = (b.sub(b.mul(n, I64(cell.steps)), I64(cell.before)) for n in (x, y))
        row = e.advance(j.values, b.add(b.mul(top, j.row), left), self.storage.raw)
        used = sorted({number for mask in cell.masks for number, _ in mask})
        for _, numbers in itertools.groupby(used, key=lambda number: number // cell.size):
            columns = [number % cell.size for number in numbers]
            for column in {columns[0], columns[-1]}:
                e.ask(e.advance(row, I64(column), self.storage.raw))
            row = e.advance(row, j.row, self.storage.raw)

    def _copy(self, x: Value, y: Value) -> None:
        """Data through the tables; of places beyond the last cell the last ones again."""
        e, b, j, cell = self.lanes, self.builder, self.job, self.cell
        last = b.sub(j.reach, I64(1))
        first_row, first_column = (b.mul(n, I64(cell.steps)) for n in (y, x))
        with e.repeat(I64(0), I64(cell.size)) as r, e.repeat(I64(0), I64(self.length)) as c:
            row = b.load(e.advance(j.rows, b.add(first_row, r), I64), typ=I64)
            column = b.load(e.advance(j.columns, e.smaller(b.add(first_column, c), last), I64), typ=I64)
            inside = b.and_(b.icmp_signed(">=", row, I64(0)), b.icmp_signed(">=", column, I64(0)))
            index = b.select(inside, b.add(b.mul(row, j.row), column), I64(0))
            number = b.load(e.advance(j.values, index, self.storage.raw), typ=self.storage.raw)
            number = b.select(inside, number, ir.Constant(self.storage.raw, None))
            b.store(number, e.advance(self.buffer, b.add(b.mul(r, I64(self.length)), c), self.storage.raw))

    def datum(self, number: int) -> Value:
        """Of the window, as a double; or as a pack of P doubles, of every cell's own."""
        e, b = self.lanes, self.builder
        row, column = divmod(number, self.cell.size)
        place = b.add(b.mul(self.stride.value, I64(row)), I64(column))
        address = e.advance(self.base.value, place, self.storage.raw)
        if self.count == 1:
            return self._double(b.load(address, typ=self.storage.raw))
        reach = self.cell.steps * (self.count - 1) + 1
        every = e.load(address, self.storage.raw, reach)
        return e.convert(e.shuffle(every, every, range(0, reach, self.cell.steps)), self.storage)

    def _double(self, raw: Value) -> Value:
        b = self.builder
        match self.storage.kind:
            case "signed":
                return b.sitofp(raw, DOUBLE)
            case "unsigned":
                return b.uitofp(raw, DOUBLE)
            case "half":
                raw = b.bitcast(raw, HALF)
            case "bfloat":  # the upper half of a float
                raw = b.bitcast(b.shl(b.zext(raw, I32), I32(16)), FLOAT)
        return raw if raw.type == DOUBLE else b.fpext(raw, DOUBLE)

    def coefficients(self) -> list[Value]:
        """Of all 25 domain points."""
        e, data, found = self.lanes, {}, []
        constant = e.constant if self.count > 1 else lambda weight: DOUBLE(weight)
        for mask in self.cell.masks:
            total = None
            for number, weight in mask:
                if number not in data:
                    data[number] = self.datum(number)
                total = e.multiply_add(data[number], constant(weight), total)
            found.append(total)
        return found
