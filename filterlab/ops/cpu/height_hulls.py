"""The program that bounds a spline of heights: for P cells of a row at a time the least and greatest coefficient."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Sequence
from dataclasses import dataclass
from types import SimpleNamespace

from llvmlite import ir

from filterlab.ops.cpu import frame, job
from filterlab.ops.cpu.height_cells import GRID, LOWER, UPPER, Windows
from filterlab.ops.cpu.lanes import FLOAT, I64, STORAGE, Lanes, Value
from filterlab.ops.height_hits import ROUNDING, SMALLEST, Cell

LANES = 4

FIELDS: dict[str, type] = {
    "next": ctypes.c_int64,  # the row of blocks to be taken next; threads add 1 atomically
    **GRID,
    "cells_x": ctypes.c_int64,
    "cells_y": ctypes.c_int64,
    "slack": ctypes.c_double,
    "bounds": ctypes.c_void_p,  # (blocks_y, blocks_x, 2) floats, written
    "blocks_x": ctypes.c_int64,
    "chunks": ctypes.c_int64,  # `next` stops here: rows of blocks
}


class HeightHullsJob(job.Job):
    _fields_ = tuple(FIELDS.items())


@dataclass(frozen=True)
class HeightHullsVariant:
    """Everything the program depends on, apart from the machine.

    Attributes:
        cell: what the coefficients are made of; blocks are single cells or as many as there are lanes along an axis.
        storage: dtype of the heights.
    """

    cell: Cell
    storage: str

    def write(self, function: ir.Function) -> None:
        """The program, into an empty function."""
        assert self.cell.finest in (0, LANES.bit_length() - 1), self.cell.finest
        _Program(self, function).write()


class _Program:
    def __init__(self, variant: HeightHullsVariant, function: ir.Function) -> None:
        self.cell = variant.cell
        self.builder = ir.IRBuilder(function.append_basic_block("entry"))
        self.lanes = Lanes(self.builder, "float64", LANES)
        self.job: SimpleNamespace = frame.load_job(self.lanes, function.args[0], FIELDS)
        self.windows = Windows(self.lanes, self.job, self.cell, STORAGE[variant.storage], LANES)

    def write(self) -> None:
        e, b, j = self.lanes, self.builder, self.job
        self.low, self.high = e.variable(e.constant(math.inf)), e.variable(e.constant(-math.inf))
        edge = 1 << self.cell.finest
        packs = b.udiv(b.add(j.cells_x, I64(LANES - 1)), I64(LANES))
        with frame.every_chunk(e, j) as row, e.repeat(I64(0), packs) as pack:
            x, first = b.mul(pack, I64(LANES)), b.mul(row, I64(edge))
            self.low.value, self.high.value = e.constant(math.inf), e.constant(-math.inf)
            with e.repeat(first, e.smaller(b.add(first, I64(edge)), j.cells_y)) as y:
                self.windows.go_to(x, y)
                self._bound(self.windows.coefficients(), e.first_lanes(b.sub(j.cells_x, x)))
            self._write(row, x)
        b.ret_void()

    def _bound(self, points: Sequence[Value], real: Value) -> None:
        """Cells under a mask, by those of their triangles that are no holes."""
        e, b = self.lanes, self.builder
        for numbers in (UPPER, LOWER):
            low, high, total = (points[numbers[0]],) * 3
            for number in numbers[1:]:
                point = points[number]
                low, high, total = e.minimum(low, point), e.maximum(high, point), e.add(total, point)
            whole = b.and_(real, b.fcmp_ordered("<", e.absolute(total), e.constant(math.inf)))
            self.low.value = e.where(whole, e.minimum(low, self.low.value), self.low.value)
            self.high.value = e.where(whole, e.maximum(high, self.high.value), self.high.value)

    def _write(self, row: Value, x: Value) -> None:
        e, b, j = self.lanes, self.builder, self.job
        low, high = self._widened(self.low.value, -1.0), self._widened(self.high.value, 1.0)
        if self.cell.finest:
            low, high = self._of_all(low, e.minimum), self._of_all(high, e.maximum)
            self._store(b.add(b.mul(row, j.blocks_x), b.udiv(x, I64(LANES))), low, high, 0)
            return
        for lane in range(LANES):
            own = b.add(x, I64(lane))
            with b.if_then(b.icmp_signed("<", own, j.cells_x)):
                self._store(b.add(b.mul(row, j.blocks_x), own), low, high, lane)

    def _store(self, block: Value, low: Value, high: Value, lane: int) -> None:
        e, b = self.lanes, self.builder
        place = e.advance(self.job.bounds, b.mul(block, I64(2)), FLOAT)
        b.store(e.lane(low, lane), place)
        b.store(e.lane(high, lane), e.advance(place, I64(1), FLOAT))

    def _widened(self, bound: Value, side: float) -> Value:
        """As floats, however they are rounded; ∞ stays."""
        e, b = self.lanes, self.builder
        more = e.multiply_add(e.absolute(bound), e.constant(ROUNDING), e.everywhere(self.job.slack))
        wide = e.multiply_add(e.add(more, e.constant(SMALLEST)), e.constant(side), bound)
        finite = b.fcmp_ordered("<", e.absolute(bound), e.constant(math.inf))
        return b.fptrunc(e.where(finite, wide, bound), ir.VectorType(FLOAT, LANES))

    def _of_all(self, pack: Value, better) -> Value:
        e, half = self.lanes, LANES // 2
        while half:
            pack = better(pack, e.shuffle(pack, pack, [(lane + half) % LANES for lane in range(LANES)]))
            half //= 2
        return pack
