"""The sums of splines on tetrahedra as vector code: what `Location` and `Taps` are for sums over taps.

Samples are read in blocks as they lie in memory, a line of a lane at a time, and are turned into the cone in registers:
signs and exchanges of axes choose between two packs each. (Lanes that read their samples one by one, along axes turned
already, took about twice as long.) All arithmetic is that of `ops.tetrahedra.Sum`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from llvmlite import ir

from filterlab.ops.cpu.lanes import I32, I64, Lanes, Storage, Value
from filterlab.ops.cpu.taps import Grid, Lines, Location
from filterlab.ops.tetrahedra import Block, Rows, Sum, TetrahedralStencil, Turned, trend_of


class CellLocation(Location):
    """Writes in which cells points lie: `locate` gives the address of the coefficient of the cell's index, and u.

    What `Location` calls a point's first tap is the first of the samples that any cell around it may need.
    """

    def __init__(self, lanes: Lanes, stencil: TetrahedralStencil, storage: Storage, grid: Grid) -> None:
        super().__init__(lanes, stencil.supports, storage, grid)
        self.sum = Sum(lanes, stencil)

    def located(self, points: Sequence[Value]) -> list[tuple[Value, Value]]:
        e, b, (before, behind) = self.lanes, self.builder, self.sum.spline.reach
        ends = (self.grid.low, before), (self.grid.high, self.supports[0] - 1 - behind)
        start, found = e.everywhere(b.trunc(self.grid.start, I32)), []
        for axis, (x, own) in enumerate(zip(points, self.sum.cells(points), strict=True)):
            low, high = (e.add(e.everywhere(e.scalar(end[axis])), e.constant(by)) for end, by in ends)
            cell = e.clamp(own, low, high)
            u = e.multiply_add(x, e.constant(0), self.sum.local(x, cell))  # 0 · ∞ = NaN: no value at infinity
            found.append((b.sub(e.to_integer(cell), start), u))
        return found


@dataclass(frozen=True)
class Corners:
    """Where blocks of samples begin, in coefficients.

    Attributes:
        each: for each block what every lane adds (64 bits); None: nothing.
        same: what all add.
    """

    each: list[Value | None]
    same: Value


@dataclass(frozen=True)
class _Placed:
    """Turned points, and their blocks, from the coefficient of the cell's index."""

    turned: Turned
    corners: Corners


class TetrahedralTaps:
    """Writes the sums of a stencil at the end of the current block; see `Taps`."""

    def __init__(
        self, lanes: Lanes, stencil: TetrahedralStencil, storage: Storage, grid: Grid, room: bool = False
    ) -> None:
        self.lanes, self.builder = lanes, lanes.builder
        self.stencil, self.storage, self.grid = stencil, storage, grid
        self.sum, self.lines = Sum(lanes, stencil), Lines(lanes, storage, grid, room)
        taps = range(self.sum.spline.size)
        self._needed = dict.fromkeys(taps, taps)

    def location(self, lanes: Lanes) -> CellLocation:
        return CellLocation(lanes, self.stencil, self.storage, self.grid)

    def weigh(self, u: Sequence[Value]) -> _Placed:
        spline, turned = self.sum.spline, self.sum.turn(u)
        along = self.sum.along_cone(turned, self._signed_strides(turned))
        corners = [self._moved(None, along, centre) for centre in spline.centres]
        return _Placed(turned, Corners(corners, self._diagonal(-spline.before)))

    def at_sample(self, turned: Turned | None) -> Corners:
        """Of points in the cubes about samples, from the coefficient of the first sample that a cube needs.

        Args:
            turned: the points from the centres of their cells; None of cubes, which need the same samples everywhere.
        """
        spline = self.sum.spline
        same = self._diagonal(spline.around - spline.before)
        if turned is None:
            return Corners([None] * len(spline.centres), same)
        strides = self._signed_strides(turned)
        none, first = ir.Constant(strides[0].type, None), None
        for stride, negative in zip(strides, turned.negative, strict=True):  # the sample is ahead of the cell's centre
            own = self.lanes.where(negative, none, stride)
            first = self.builder.sub(none if first is None else first, own)
        along = self.sum.along_cone(turned, strides)
        return Corners([self._moved(first, along, centre) for centre in spline.centres], same)

    def trend(self, taps: list[Value]) -> Rows:
        """`trend_of` the samples around the one in the middle of every lane's cube.

        Args:
            taps: address of every lane's first sample that its cube needs.
        """
        b, middle, found = self.builder, self.sum.spline.around, {}
        plane = b.mul(self.grid.width, self.grid.height)
        for k in (-1, 0, 1):
            sides = {j: min(1, 2 - abs(j) - abs(k)) for j in (-1, 0, 1)}
            needed = {middle + j: range(middle - side, middle + side + 1) for j, side in sides.items()}
            for j, line in self.lines.fetch(taps, b.mul(plane, I64(middle + k)), needed):
                found |= {(i - middle, j - middle, k): tap for i, tap in line.items()}
        return trend_of(self.lanes, found.__getitem__)

    def _strides(self) -> list[Value]:
        plane = self.builder.mul(self.grid.width, self.grid.height)
        return [self.lanes.everywhere(n) for n in (I64(1), self.grid.width, plane)]

    def _signed_strides(self, turned: Turned) -> list[Value]:
        """Along x, y, z away from the centre."""
        e, b = self.lanes, self.builder
        strides = self._strides()
        none = ir.Constant(strides[0].type, None)
        return [e.where(negative, b.sub(none, s), s) for negative, s in zip(turned.negative, strides, strict=True)]

    def _diagonal(self, steps: int) -> Value:
        """So many steps along all three axes."""
        b = self.builder
        one = b.add(b.add(I64(1), self.grid.width), b.mul(self.grid.width, self.grid.height))
        return b.mul(one, I64(steps))

    def _moved(self, first: Value | None, along: Sequence[Value], steps: Sequence[int]) -> Value | None:
        b, total = self.builder, first
        for row, step in zip(along, steps, strict=True):
            if step:
                part = b.mul(row, ir.Constant(row.type, [step] * self.lanes.count))
                total = part if total is None else b.add(total, part)
        return total

    def _corners(self, taps: list[Value], corner: Value | None) -> list[Value]:
        """Where a block begins, for every lane, from its address of the cell."""
        if corner is None:
            return taps
        e, b = self.lanes, self.builder
        offsets = [b.extract_element(corner, I32(lane)) for lane in range(e.count)]
        return [e.advance(tap, offset, self.storage.raw) for tap, offset in zip(taps, offsets, strict=True)]

    def _planes(self, here: Value) -> list[Value]:
        """The offsets of a block's planes."""
        b, plane = self.builder, self.builder.mul(self.grid.width, self.grid.height)
        return [b.add(here, b.mul(plane, I64(k))) for k in range(self.sum.spline.size)]

    def contract(self, taps: list[Value], here: Value, weights: _Placed, u: Sequence[Value]) -> list[Value]:
        """The rows of the stencil; see `Taps.contract`."""
        return self.sum.contract(self.blocks(taps, weights.corners, here), weights.turned)

    def blocks(self, taps: list[Value], corners: Corners, here: Value) -> list[Block]:
        """All that a tetrahedron needs, as it lies in memory."""
        blocks, here = [], self.builder.add(here, corners.same)
        for corner in corners.each:
            own, block = self._corners(taps, corner), {}
            for k, offset in enumerate(self._planes(here)):
                for j, line in self.lines.fetch(own, offset, self._needed):
                    block |= {(i, j, k): tap for i, tap in line.items()}
            blocks.append(block)
        return blocks

    def spread(self, taps: list[Value], here: Value, weights: _Placed, cotangents: list[Value]) -> None:
        """The transpose: add into the coefficients; see `Taps.spread`."""
        e, here = self.lanes, self.builder.add(here, weights.corners.same)
        for corner, block in zip(weights.corners.each, self.sum.spread(cotangents, weights.turned), strict=True):
            own = self._corners(taps, corner)
            for k, offset in enumerate(self._planes(here)):
                lines = {j: [block[i, j, k] for i in needed] for j, needed in self._needed.items()}
                values = {j: [e.constant(0) if v is None else v for v in line] for j, line in lines.items()}
                self.lines.add(own, offset, self._needed, values)
