"""Ways of rays through the cubes about samples, cut into parts of one tetrahedron each; written for every arithmetic.

Where a spline on tetrahedra is summed along a ray, a program has come to a cube |x − i| ≤ ½ about a sample i. The
planes that cut the cube are met in order:

    start + τ step, τ in [0, 1] ─▶ τ of every plane ─▶ from a to the next one, z ─▶ the middle of that part, turned
      ─▶ its tetrahedron, and where the part's ends are in it

Loops and memory are a program's own. What is read there, `Sum.restrict` makes the polynomial of.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from filterlab.ops.stencil import MultiIndex
from filterlab.ops.tetrahedra import UNITS, Sum, Turned, Value


@dataclass(frozen=True)
class Way:
    """The ways of rays in cubes.

    Attributes:
        start, step: x, y, z from the sample in the middle; a place is start + τ step, τ in [0, 1].
        odd: masks along x, y, z, where the sample's index is odd; of cubes that octahedra meet in, else none.
    """

    start: list[Value]
    step: list[Value]
    odd: list[Value]


@dataclass(frozen=True)
class Part:
    """A part of a way, in one tetrahedron.

    Attributes:
        turned: its middle, from the centre of the cell.
        start, end: λ of its ends.
    """

    turned: Turned
    start: list[Value]
    end: list[Value]


class Cubes:
    """Writes what becomes of ways in cubes.

    Args:
        of: the sum that is restricted to them; all is written in its arithmetic.
    """

    def __init__(self, of: Sum) -> None:
        self.sum, self.spline, self.arithmetic = of, of.spline, of.arithmetic

    def way(self, start: Sequence[Value], end: Sequence[Value], odd: Sequence[Value]) -> Way:
        """From place to place in a cube, each in [0, 1] from its corner; `odd` as in `Way`, where that matters."""
        e = self.arithmetic
        first = [e.subtract(x, e.constant(0.5)) for x in start]
        step = [e.subtract(z, a) for a, z in zip(start, end, strict=True)]
        return Way(first, step, list(odd) if self.spline.octahedral else [])

    def cuts(self, way: Way) -> list[Value]:
        """τ of every plane; whatever, or NaN, where the ray does not move across it."""
        e, found = self.arithmetic, []
        start, step = self._turned_round(way, way.start), self._turned_round(way, way.step)
        for normal, d in self.spline.cuts:
            place, speed = (self.sum.weighted(normal, x) for x in (start, step))
            found.append(e.divide(e.subtract(e.constant(d), place), speed))
        return found

    def following(self, cuts: Sequence[Value], a: Value) -> Value:
        """The next τ behind a where a plane is met, or 1."""
        e = self.arithmetic
        one = e.constant(1)
        ahead = [e.where(e.less(a, met), met, one) for met in cuts]
        while len(ahead) > 1:  # in pairs: none waits for all before it
            ahead = [self._lesser(*ahead[i : i + 2]) for i in range(0, len(ahead), 2)]
        return self._lesser(ahead[0], one)

    def _lesser(self, a: Value, b: Value | None = None) -> Value:
        return a if b is None else self.arithmetic.where(self.arithmetic.less(a, b), a, b)

    def part(self, way: Way, a: Value, z: Value) -> Part:
        """From τ = a to z, between which no plane is met."""
        e = self.arithmetic
        middle = e.multiply(e.add(a, z), e.constant(0.5))
        centre = self._centre(way, self._at(way, middle))

        def local(x: Sequence[Value]) -> list[Value]:
            return list(x) if centre is None else [e.subtract(c, m) for c, m in zip(x, centre, strict=True)]

        towards_sample = None if centre is None else [e.less(e.constant(0), m) for m in centre]
        turned = self.sum.turn(local(self._at(way, middle)), towards_sample)
        start, end = (self.sum.barycentric(turned, local(self._at(way, t))) for t in (a, z))
        return Part(turned, start, end)

    def along(self, quadratic: Mapping[MultiIndex, Value], way: Way) -> list[Value]:
        """Coefficients of 1, τ, τ² on ways of Σ_m t_m x^m, t_m those of `QUADRATICS`.

        With v_i = t_i + Σ_(j≥i) t_ij start_j and w_i = Σ_(j≥i) t_ij step_j they are t_0 + start · v,
        step · v + start · w and step · w.
        """
        v = [self._bent(quadratic, i, way.start, quadratic[unit]) for i, unit in enumerate(UNITS)]
        w = [self._bent(quadratic, i, way.step, None) for i in range(3)]
        linear = self._dot(way.start, w, self._dot(way.step, v, None))
        return [self._dot(way.start, v, quadratic[0, 0, 0]), linear, self._dot(way.step, w, None)]

    def _bent(self, quadratic: Mapping[MultiIndex, Value], i: int, x: Sequence[Value], onto: Value | None) -> Value:
        return self._dot([quadratic[_sum(UNITS[i], other)] for other in UNITS[i:]], x[i:], onto)

    def _dot(self, a: Sequence[Value], b: Sequence[Value], onto: Value | None) -> Value:
        for x, y in zip(a, b, strict=True):
            onto = self.arithmetic.multiply_add(x, y, onto)
        return onto

    def _at(self, way: Way, t: Value) -> list[Value]:
        """The place at τ = t."""
        e = self.arithmetic
        return [e.multiply_add(t, step, start) for start, step in zip(way.start, way.step, strict=True)]

    def _turned_round(self, way: Way, x: Sequence[Value]) -> list[Value]:
        """Along the axes of odd indices: where all cubes that octahedra meet in are alike."""
        e = self.arithmetic
        return [e.where(odd, e.negate(c), c) for odd, c in zip(way.odd, x, strict=True)] if way.odd else list(x)

    def _centre(self, way: Way, x: Sequence[Value]) -> list[Value] | None:
        """Of the octahedron around each place, one of two, from the sample; None of cubes, whose centre that is."""
        if not way.odd:
            return None
        e, total = self.arithmetic, None
        for c in self._turned_round(way, x):
            total = c if total is None else e.add(total, c)
        half = e.where(e.less(total, e.constant(0)), e.constant(-0.5), e.constant(0.5))
        return self._turned_round(way, [half] * 3)


def _sum(a: MultiIndex, b: MultiIndex) -> MultiIndex:
    x, y, z = (i + j for i, j in zip(a, b, strict=True))
    return x, y, z
