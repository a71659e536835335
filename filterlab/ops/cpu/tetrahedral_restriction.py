"""Splines on tetrahedra along rays, a cube about a sample at a time: what `restriction` is for sums over taps.

Planes cut the part of a ray in a cube into parts of one tetrahedron each. They are met in order, a part in each lane,
until all lanes are through or need not go on:

    next plane ahead ─▶ the part's middle, turned ─▶ coefficients of its tetrahedron ─▶ the blossom at both ends
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

from llvmlite import ir

from filterlab.ops.cpu.lanes import I1, I64, Lanes, Storage, Value
from filterlab.ops.cpu.restriction import Section
from filterlab.ops.cpu.taps import Grid
from filterlab.ops.cpu.tetrahedra import TetrahedralTaps
from filterlab.ops.tetrahedra import Block, TetrahedralStencil


@dataclass(frozen=True)
class _InCube:
    """The parts of rays in cubes.

    Attributes:
        start, step: packs of x, y, z from the sample in the middle; a place is start + τ step, τ in [0, 1].
        odd: masks along x, y, z, where the sample's index is odd; of octahedra.
        blocks: of samples, where all tetrahedra of a cube need the same.
    """

    taps: list[Value]
    start: list[Value]
    step: list[Value]
    odd: list[Value]
    blocks: list[Block] | None


class TetrahedralRestriction:
    """Writes restrictions of a spline to polynomials. Make it before any loop; see `Restriction`."""

    def __init__(self, lanes: Lanes, stencil: TetrahedralStencil, storage: Storage, grid: Grid, room: bool) -> None:
        self.lanes, self.builder = lanes, lanes.builder
        self.taps = TetrahedralTaps(lanes, stencil, storage, grid, room)
        self.sum, self.spline = self.taps.sum, stencil.spline
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
        own = self._in_cube(taps, cell, start, end)
        self._meet_cuts(own)
        self._at.value = e.constant(0)
        on = e.variable(mask)
        with e.repeat_while(lambda: e.any(on.value)):
            a = self._at.value
            z = self._next(a)
            yield Section(on.value, a, z, self._rows(own, a, z))
            self._at.value = z
            on.value = b.and_(b.and_(on.value, e.less(z, e.constant(1))), b.not_(waiting()))

    # --- the cube ---

    def _in_cube(
        self, taps: list[Value], cell: Sequence[Value], start: Sequence[Value], end: Sequence[Value]
    ) -> _InCube:
        e = self.lanes
        first = [e.subtract(x, e.constant(0.5)) for x in start]
        step = [e.subtract(z, a) for a, z in zip(start, end, strict=True)]
        odd = [self._is_odd(index) for index in cell] if self.spline.octahedral else []
        blocks = None if self.spline.octahedral else self.taps.blocks(taps, self.taps.at_sample(None), I64(0))
        return _InCube(taps, first, step, odd, blocks)

    def _is_odd(self, index: Value) -> Value:
        return self.builder.trunc(index, ir.VectorType(I1, self.lanes.count))

    def _turned_round(self, own: _InCube, x: Sequence[Value]) -> list[Value]:
        """Along the axes of odd indices: where all cubes of octahedra are alike."""
        e = self.lanes
        return [e.where(odd, e.negate(c), c) for odd, c in zip(own.odd, x, strict=True)] if own.odd else list(x)

    def _meet_cuts(self, own: _InCube) -> None:
        """τ of every plane; whatever, or NaN, where the ray does not move across it."""
        e = self.lanes
        start, step = self._turned_round(own, own.start), self._turned_round(own, own.step)
        for kept, (normal, d) in zip(self._cuts, self.spline.cuts, strict=True):
            place, speed = (self.sum.weighted(normal, x) for x in (start, step))
            kept.value = e.divide(e.subtract(e.constant(d), place), speed)

    def _next(self, a: Value) -> Value:
        """The next τ where a plane is met, or 1."""
        e, b, found = self.lanes, self.builder, self.lanes.constant(1)
        for cut in self._cuts:
            met = cut.value
            found = e.where(b.and_(e.less(a, met), e.less(met, found)), met, found)
        return found

    # --- a part ---

    def _rows(self, own: _InCube, a: Value, z: Value) -> list[Value]:
        e = self.lanes
        middle = e.multiply(e.add(a, z), e.constant(0.5))

        def at(t: Value) -> list[Value]:
            return [e.multiply_add(t, step, start) for start, step in zip(own.start, own.step, strict=True)]

        centre = self._centre(own, at(middle))

        def local(x: Sequence[Value]) -> list[Value]:
            return list(x) if centre is None else [e.subtract(c, m) for c, m in zip(x, centre, strict=True)]

        towards_sample = None if centre is None else [e.less(e.constant(0), m) for m in centre]
        turned = self.sum.turn(local(at(middle)), towards_sample)
        ends = [self.sum.barycentric(turned, local(at(t))) for t in (a, z)]
        blocks = own.blocks or self.taps.blocks(own.taps, self.taps.at_sample(turned), I64(0))
        return self.sum.restrict(blocks, turned, *ends)

    def _centre(self, own: _InCube, x: Sequence[Value]) -> list[Value] | None:
        """Of the octahedron around each point, one of two; from the sample."""
        if not own.odd:
            return None
        e, total = self.lanes, None
        for c in self._turned_round(own, x):
            total = c if total is None else e.add(total, c)
        half = e.where(e.less(total, e.constant(0)), e.constant(-0.5), e.constant(0.5))
        return self._turned_round(own, [half] * 3)
