"""Splines on tetrahedra along rays, a cube about a sample at a time: what `restriction` is for sums over taps.

The parts of `ops.cubes` are met in order, one in each lane, until all lanes are through or need not go on:

    next plane ahead ─▶ the part's middle, turned ─▶ coefficients of its tetrahedron ─▶ the blossom at both ends
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager

from llvmlite import ir

from filterlab.ops.cpu.lanes import I1, I64, Lanes, Storage, Value
from filterlab.ops.cpu.restriction import Section
from filterlab.ops.cpu.taps import Grid
from filterlab.ops.cpu.tetrahedra import TetrahedralTaps
from filterlab.ops.cubes import Cubes
from filterlab.ops.tetrahedra import TetrahedralStencil


class TetrahedralRestriction:
    """Writes restrictions of a spline to polynomials. Make it before any loop; see `Restriction`."""

    def __init__(self, lanes: Lanes, stencil: TetrahedralStencil, storage: Storage, grid: Grid, room: bool) -> None:
        self.lanes, self.builder = lanes, lanes.builder
        self.taps = TetrahedralTaps(lanes, stencil, storage, grid, room)
        self.spline, self.cubes = stencil.spline, Cubes(self.taps.sum)
        self._cuts = [lanes.variable(lanes.constant(0)) for _ in self.spline.cuts]
        self._at = lanes.variable(lanes.constant(0))

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
        odd = [b.trunc(index, ir.VectorType(I1, e.count)) for index in cell] if self.spline.octahedral else []
        way = self.cubes.way(start, end, odd)
        same = None if self.spline.octahedral else self.taps.blocks(taps, self.taps.at_sample(None), I64(0))
        for kept, cut in zip(self._cuts, self.cubes.cuts(way), strict=True):
            kept.value = cut
        self._at.value = e.constant(0)
        on = e.variable(mask)
        with e.repeat_while(lambda: e.any(on.value)):
            a = self._at.value
            z = self.cubes.following([cut.value for cut in self._cuts], a)
            part = self.cubes.part(way, a, z)
            blocks = same or self.taps.blocks(taps, self.taps.at_sample(part.turned), I64(0))
            yield Section(on.value, a, z, self.taps.sum.restrict(blocks, part.turned, part.start, part.end))
            self._at.value = z
            on.value = b.and_(b.and_(on.value, e.less(z, e.constant(1))), b.not_(waiting()))
