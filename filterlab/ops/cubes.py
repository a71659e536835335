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
from itertools import chain

from filterlab.ops.stencil import MultiIndex
from filterlab.ops.tetrahedra import QUADRATICS, UNITS, Block, Sum, Turned, Value, at_centre


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

    def trend(self, blocks: Sequence[Block], way: Way) -> tuple[list[Value], Value]:
        """The quadratic near the spline: from where a way begins to where it ends, three Bernstein coefficients.

        With them the most that it is apart from the spline, anywhere in the cube.

        Args:
            blocks: the samples around the one in the middle; or those around `Trend.centres`, along the axes of space.
        """
        e, trend = self.arithmetic, self.spline.trend
        numbers = self._of_centres(blocks, way) if way.odd else self._of_samples(blocks[0])
        q = {m: self.sum.weighted(self._polar(m, row), numbers) for m, row in zip(QUADRATICS, trend.rows, strict=True)}
        start, end = (self._turned_round(way, x) for x in (way.start, self._at(way, e.constant(1))))
        at_start, at_end = self._linear(q, start), self._linear(q, end)
        apart = None
        for row in trend.apart:
            own = e.absolute(self.sum.weighted(row, numbers))
            apart = own if apart is None else e.add(apart, own)
        return [self._affine(*at_start, start), self._affine(*at_start, end), self._affine(*at_end, end)], apart

    def _polar(self, m: MultiIndex, row: Sequence[float]) -> list[float]:
        """Of a coefficient of q, its share in either argument of the polar form."""
        return [w if m == (0, 0, 0) or max(m) == 2 else w / 2 for w in row]

    def _linear(self, q: Mapping[MultiIndex, Value], x: Sequence[Value]) -> tuple[Value, list[Value]]:
        """q's polar form with x in one place: a number and three slopes in the other."""
        one = [q[unit] for unit in UNITS]
        slopes = [self._affine(one[i], [q[_sum(unit, other)] for other in UNITS], x) for i, unit in enumerate(UNITS)]
        return self._affine(q[0, 0, 0], one, x), slopes

    def _affine(self, number: Value, slopes: Sequence[Value], x: Sequence[Value]) -> Value:
        for slope, own in zip(slopes, x, strict=True):
            number = self.arithmetic.multiply_add(slope, own, number)
        return number

    def _of_centres(self, blocks: Sequence[Block], way: Way) -> list[Value]:
        """The numbers that `Trend` describes, of octahedra."""
        e, numbers = self.arithmetic, []
        for block in blocks:
            value, *slopes = at_centre(e, block).values()
            numbers.append([value, *self._turned_round(way, slopes)])
        half = len(blocks) // 2
        opposite = list(zip(chain(*numbers[:half]), chain(*numbers[half:]), strict=True))
        return [write(a, b) for write in (e.add, e.subtract) for a, b in opposite]

    def _of_samples(self, block: Block) -> list[Value]:
        """The numbers that `Trend` describes, of cubes."""
        numbers = [block[at] for at in sorted(block)]  # z running fastest
        for step in (9, 3, 1):
            for first in (i for i in range(27) if i // step % 3 == 0):
                own = slice(first, first + 3 * step, step)
                low, middle, high = numbers[own]
                numbers[own] = middle, self.arithmetic.add(low, high), self.arithmetic.subtract(high, low)
        return numbers

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
