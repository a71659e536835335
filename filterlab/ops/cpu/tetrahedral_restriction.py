"""Splines on tetrahedra along rays, a cube about a sample at a time: what `restriction` is for sums over taps.

A cube is looked at first: how near a quadratic comes to the level along the ray, and whether the spline may be so much
apart from it (`ops.tetrahedra.Trend`). Of four cubes that may hold the level three are left out so (Marschner-Lobb
128³, level ½), and most tetrahedra of the others. In a cube that is left the parts of `ops.cubes` are met in order, one
in each lane, until all lanes are through or need not go on:

    next plane ahead, behind which the level may be ─▶ the part's middle, turned ─▶ coefficients of its tetrahedron
      ─▶ the blossom at both ends

A part that is left out is farther from the level than rounding reaches, at its ends too: no crossing between it and the
next one is lost.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from llvmlite import ir

from filterlab.ops.cpu.lanes import I1, I64, Lanes, Storage, Value, Variable
from filterlab.ops.cpu.restriction import Section
from filterlab.ops.cpu.taps import Grid
from filterlab.ops.cpu.tetrahedra import TetrahedralTaps
from filterlab.ops.cubes import Cubes, Way
from filterlab.ops.tetrahedra import TetrahedralStencil


@dataclass(frozen=True)
class Level:
    """Packs: f − level is scale · sum + shift, within the margin of what is computed."""

    scale: Value
    shift: Value
    margin: Value


class NearLevel:
    """What is known of the spline on each lane's way in a cube: a quadratic, and how far it is from that at most.

    Make it before any loop.
    """

    def __init__(self, lanes: Lanes, level: Level) -> None:
        self.lanes, self.builder, self.level = lanes, lanes.builder, level
        self._rows = [lanes.variable(lanes.constant(0)) for _ in range(3)]
        self._apart = lanes.variable(lanes.constant(0))

    def keep(self, mask: Value, rows: Sequence[Value], apart: Value) -> None:
        """For lanes under the mask; three Bernstein coefficients, and the distance, of sums."""
        e, level = self.lanes, self.level
        numbers = *(e.multiply_add(row, level.scale, level.shift) for row in rows), self._distance(apart)
        for kept, own in zip((*self._rows, self._apart), numbers, strict=True):
            kept.value = e.where(mask, own, kept.value)

    def _distance(self, apart: Value) -> Value:
        return self.lanes.multiply_add(apart, self.lanes.absolute(self.level.scale), self.level.margin)

    def may_hold(self, start: Value, end: Value) -> Value:
        """A mask: where the level may be met from start to end, in [0, 1] of the way."""
        e = self.lanes
        first, middle, last = (row.value for row in self._rows)
        before, behind = e.subtract(middle, first), e.subtract(last, middle)

        def along(t: Value) -> tuple[Value, Value]:
            return e.multiply_add(before, t, first), e.multiply_add(behind, t, middle)

        def blossom(ends: tuple[Value, Value], t: Value) -> Value:
            return e.multiply_add(e.subtract(ends[1], ends[0]), t, ends[0])

        at_start = along(start)
        return self._straddles([blossom(at_start, start), blossom(at_start, end), blossom(along(end), end)])

    def _straddles(self, rows: Sequence[Value]) -> Value:
        """Also where something is not a number."""
        e, b, apart = self.lanes, self.builder, self._apart.value
        low = high = rows[0]
        for row in rows[1:]:
            low, high = e.minimum(low, row), e.maximum(high, row)
        above, below = b.fcmp_ordered(">", low, apart), b.fcmp_ordered("<", high, e.negate(apart))
        return b.not_(b.or_(above, below))


class TetrahedralRestriction:
    """Writes restrictions of a spline to polynomials. Make it before any loop; see `Restriction`.

    Args:
        level: what is looked for. With `near` parts of rays that do not come near it are left out.
    """

    def __init__(
        self, lanes: Lanes, stencil: TetrahedralStencil, storage: Storage, grid: Grid, room: bool, level: Level
    ) -> None:
        self.lanes, self.builder = lanes, lanes.builder
        self.taps = TetrahedralTaps(lanes, stencil, storage, grid, room)
        self.spline, self.cubes = stencil.spline, Cubes(self.taps.sum)
        self._cuts = [lanes.variable(lanes.constant(0)) for _ in self.spline.cuts]
        self._at = lanes.variable(lanes.constant(0))
        self.near = NearLevel(lanes, level)

    def look(
        self, taps: list[Value], cell: Sequence[Value], start: Sequence[Value], end: Sequence[Value], mask: Value
    ) -> Value:
        """A mask: which of the lanes under another may meet the level in their cubes; what is known of them is kept.

        Args: as of `every`.
        """
        e, b = self.lanes, self.builder
        way = self._way(cell, start, end)
        corners = self.taps.around_sample(way.odd) if way.odd else self.taps.at_sample(None)
        rows, apart = self.cubes.trend(self.taps.blocks(taps, corners, I64(0)), way)
        self.near.keep(mask, rows, apart)
        return b.and_(mask, self.near.may_hold(e.constant(0), e.constant(1)))

    @contextmanager
    def every(
        self,
        taps: list[Value],
        cell: Sequence[Value],
        start: Sequence[Value],
        end: Sequence[Value],
        mask: Value,
        waiting: Callable[[], Value],
    ) -> Iterator[Section]:
        """The with-block for the next part of every lane under the mask, until it waits; see `Restriction.every`."""
        e, b = self.lanes, self.builder
        way = self._way(cell, start, end)
        same = None if self.spline.octahedral else self.taps.blocks(taps, self.taps.at_sample(None), I64(0))
        for kept, cut in zip(self._cuts, self.cubes.cuts(way), strict=True):
            kept.value = cut
        self._at.value = e.constant(0)
        on = e.variable(mask)
        with e.repeat_while(lambda: e.any(on.value)):
            a, z, here = self._next_part(on)
            part = self.cubes.part(way, a, z)
            blocks = same or self.taps.blocks(taps, self.taps.at_sample(part.turned), I64(0))
            yield Section(here, a, z, self.taps.sum.restrict(blocks, part.turned, part.start, part.end))
            self._at.value = z
            on.value = b.and_(b.and_(on.value, e.less(z, e.constant(1))), b.not_(waiting()))

    def _way(self, cell: Sequence[Value], start: Sequence[Value], end: Sequence[Value]) -> Way:
        odd = [self.builder.trunc(index, ir.VectorType(I1, self.lanes.count)) for index in cell]
        return self.cubes.way(start, end, odd)

    def _next_part(self, on: Variable) -> tuple[Value, Value, Value]:
        """From where to where the next part is, and in which lanes there is one."""
        e, b, near = self.lanes, self.builder, self.near
        cuts = [cut.value for cut in self._cuts]
        end, left = e.variable(e.constant(1)), e.variable(on.value)
        with e.repeat_while(lambda: e.any(left.value)):
            a = self._at.value
            z = self.cubes.following(cuts, a)
            passes = b.and_(left.value, b.not_(near.may_hold(a, z)))
            end.value = e.where(left.value, z, end.value)
            self._at.value = e.where(passes, z, a)
            left.value = b.and_(passes, e.less(z, e.constant(1)))
        here = b.and_(on.value, e.less(self._at.value, e.constant(1)))
        return self._at.value, end.value, here
