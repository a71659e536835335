"""Splines on tetrahedra along rays, a cube about a sample at a time: what `restriction` is for sums over taps.

A cube is looked at first: how near its trend comes to the level along the ray, a quadratic made of 19 samples, and
between what the spline is off that anywhere in the cube, which was found when the volume was bounded (`ops.bounds`).
Of ten cubes that may hold the level seven are left out so (Marschner-Lobb 128³, level ½), and most tetrahedra of the
others. In a cube that is left the parts of `ops.cubes` are met in order, one in each lane, until all lanes are through
or need not go on:

    next plane ahead, behind which the level may be ─▶ the part's middle, turned ─▶ coefficients of its tetrahedron
      ─▶ the blossom at both ends

A part that is left out is farther from the level than rounding reaches, at its ends too: no crossing between it and the
next one is lost.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from types import SimpleNamespace

from llvmlite import ir

from filterlab.ops.cpu.lanes import FLOAT, I1, I32, I64, Lanes, Storage, Value, Variable
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


class OffTrend:
    """Reads what is known of f − t in cubes (`ops.bounds`).

    Args:
        lanes: of packs of rays.
        job: fields of `ops.cpu.crossings.FIELDS`.
    """

    def __init__(self, lanes: Lanes, job: SimpleNamespace) -> None:
        self.lanes, self.builder, self.job = lanes, lanes.builder, job
        b = lanes.builder
        self._half = b.sub(job.edge, I64(1))  # log₂ of the cells along an edge of a part
        last = b.sub(b.shl(I64(1), self._half), I64(1))
        self._width, self._height = (b.lshr(b.add(n, last), self._half) for n in (job.cells_x, job.cells_y))

    def read(self, cell: Sequence[Value]) -> tuple[Value, Value]:
        """Packs of floats: the least and the greatest in every lane's cube."""
        e, b = self.lanes, self.builder
        half, width, height = (e.everywhere(b.trunc(n, I32)) for n in (self._half, self._width, self._height))
        x, y, z = (b.lshr(own, half) for own in cell)
        line, kind = b.add(b.mul(z, height), y), ir.VectorType(I32, e.count)
        index, pairs = b.add(b.mul(e.widen(line), e.widen(width)), e.widen(x)), ir.Constant(kind, ir.Undefined)
        for lane in range(e.count):
            place = e.advance(self.job.off_trend, e.lane(index, lane), I32)
            pairs = b.insert_element(pairs, b.load(place, typ=I32), I32(lane))
        floats = ir.VectorType(FLOAT, e.count)
        low, high = b.shl(pairs, e.integers_32(16)), b.and_(pairs, e.integers_32(-0x10000))
        return b.bitcast(low, floats), b.bitcast(high, floats)


class NearLevel:
    """What is known of the spline on each lane's way in a cube: its trend, and between what it is off that.

    Make it before any loop.
    """

    def __init__(self, lanes: Lanes, level: Level) -> None:
        self.lanes, self.builder, self.level = lanes, lanes.builder, level
        self._powers = [lanes.variable(lanes.constant(0)) for _ in range(3)]
        self._low, self._high = (lanes.variable(lanes.constant(0)) for _ in range(2))

    def keep(self, mask: Value, powers: Sequence[Value], off: Sequence[Value]) -> None:
        """For lanes under the mask: coefficients of 1, τ, τ² of the trend, sums; between what f is off it."""
        e, level = self.lanes, self.level
        first, *others = (e.multiply(own, level.scale) for own in powers)
        own = e.add(first, level.shift), *others, e.subtract(off[0], level.margin), e.add(off[1], level.margin)
        for variable, value in zip((*self._powers, self._low, self._high), own, strict=True):
            variable.value = e.where(mask, value, variable.value)

    def may_hold(self, start: Value, end: Value) -> Value:
        """A mask: where the level may be met from start to end, in [0, 1] of the way; also where something is NaN."""
        e, b = self.lanes, self.builder
        number, rise, bend = (power.value for power in self._powers)
        bent = e.multiply(bend, start)
        half = e.multiply(e.add(start, end), e.constant(0.5))
        middle = e.multiply_add(bent, end, e.multiply_add(rise, half, number))
        first = e.multiply_add(e.add(bent, rise), start, number)
        last = e.multiply_add(e.multiply_add(bend, end, rise), end, number)
        low, high = e.minimum(e.minimum(first, middle), last), e.maximum(e.maximum(first, middle), last)
        above = b.fcmp_ordered(">", e.add(low, self._low.value), e.constant(0))
        below = b.fcmp_ordered("<", e.add(high, self._high.value), e.constant(0))
        return b.not_(b.or_(above, below))


class TetrahedralRestriction:
    """Writes restrictions of a spline to polynomials. Make it before any loop; see `Restriction`.

    Args:
        level: what is looked for. With `near` parts of rays that do not come near it are left out.
    """

    def __init__(
        self,
        lanes: Lanes,
        stencil: TetrahedralStencil,
        storage: Storage,
        grid: Grid,
        room: bool,
        level: Level,
        off_trend: OffTrend,
    ) -> None:
        self.lanes, self.builder = lanes, lanes.builder
        self.taps = TetrahedralTaps(lanes, stencil, storage, grid, room)
        self.spline, self.cubes = stencil.spline, Cubes(self.taps.sum)
        self._cuts = [lanes.variable(lanes.constant(0)) for _ in self.spline.cuts]
        self._at = lanes.variable(lanes.constant(0))
        self.near, self.off_trend = NearLevel(lanes, level), off_trend

    def look(
        self, taps: list[Value], cell: Sequence[Value], start: Sequence[Value], end: Sequence[Value], mask: Value
    ) -> Value:
        """A mask: which of the lanes under another may meet the level in their cubes; what is known of them is kept.

        Args: as of `every`.
        """
        e, b = self.lanes, self.builder
        powers = self.cubes.along(self.taps.trend(taps), self._way(cell, start, end))
        self.near.keep(mask, powers, [self._number(x) for x in self.off_trend.read(cell)])
        return b.and_(mask, self.near.may_hold(e.constant(0), e.constant(1)))

    def _number(self, pack: Value) -> Value:
        """Floats as numbers of the arithmetic."""
        return pack if pack.type == self.lanes.pack else self.builder.fpext(pack, self.lanes.pack)

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
