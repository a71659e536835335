"""What a sample looks like: transfer function and shading, on packs, with their derivatives (`ops.cpu.tape`).

Letters: v the field's value, w where it lies between two control points, α opacity, s length, τ optical depth; K
lights, l the direction to a light, h halfway between it and the viewer. Same meaning as `render.transfer` and
`render.shading`.

A transfer function is two tables with one row per interval between control points. Every lane looks up its own row:

    positions and opacities   x₀ x₁ α₀ α₁
    colours and opacities     r₀ r₁ g₀ g₁ │ b₀ b₁ α₀ α₁

There are three ways to find the interval (`WAYS`). Control points at equal steps, as look-up tables from 0 to 1 have
them, need no positions: with t = (v − low) · scale the interval is ⌊t⌋ and w = t − ⌊t⌋, and the second table says all
else. They are taken for equal only where (x − low) · scale is a whole number at each of them, rounding included.

Else v is compared with all inner control points one after the other: three instructions per control point for a whole
register, measured as 0.035 ns per sample and control point (AVX2). Where there are many, v is first put into one of
many buckets of equal width that have one inner control point each, or none. A third table says what a bucket has: the
two intervals that meet at its control point x₁, and the number j of the first,

    x₀ x₁ x₂ j │ α₀ α₁ α₂ –

v ≥ x₁ is in the second. Numbers are put into buckets by the same two operations, (v − low) · scale, here and where the
table is made: rounding is monotonic, so that no v lands on the wrong side of a control point.

With l and h known (they are constant along a ray) a lit colour is

    rgb · (ambient + Σ_k D_k |n·l_k|) + Σ_k S_k |n·h_k|^shininess

D and S are the lights' colours times the weights of diffuse and specular reflection, n the gradient made a unit vector.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from llvmlite import ir

from filterlab.ops.cpu import mathematics
from filterlab.ops.cpu.lanes import DOUBLE, I32, I64, Lanes, Value
from filterlab.ops.cpu.tape import Node, Tape
from filterlab.ops.cpu.taps import lanes_of_groups, transpose_quads

OPACITY_ROW, COLOR_ROW, BUCKET_ROW = 4, 8, 8  # numbers of a row

WAYS = ("even", "compared", "bucketed")
"""How the interval of a value is found."""


@dataclass(frozen=True)
class OnTable:
    """Where values fall between control points.

    Attributes:
        interval: number of the row, 32-bit integers.
        ends: x₀ x₁ α₀ α₁.
        fraction: w.
        blue: b₀ b₁, if they were read with the opacities.
    """

    interval: Value
    ends: list[Node]
    fraction: Node
    blue: list[Value] | None = None

    def kept(self, lanes: Lanes) -> Callable[[Value, int], OnTable]:
        """Write it to memory; the result reads part number i of `count` lanes each. No derivatives are passed on."""
        packs = [lanes.kept(p) for p in (self.interval, self.fraction.value, *(self.blue or []))]

        def part(i: Value, count: int) -> OnTable:
            interval, fraction, *blue = (pack.part(i, count) for pack in packs)
            return OnTable(interval, [], Node(fraction), blue or None)

        return part

    def colored(self, lanes: Lanes) -> Value:
        """A mask: the interval has an opacity other than 0 at one of its ends."""
        return lanes.builder.or_(*(lanes.differs(end.value) for end in self.ends[2:]))


@dataclass(frozen=True)
class Steps:
    """Equal steps, of control points or of buckets: low, 1/width and the number of the last one, as doubles."""

    low: Value
    scale: Value
    last: Value


class TransferTable:
    """The transfer function in memory.

    Args:
        way: of `WAYS`.
        inner: address of the control points between the first and the last, `intervals` − 1 of them.
        opacities, colors, buckets: addresses of the three tables.
        steps: of "even" intervals or of buckets.
    """

    def __init__(
        self,
        lanes: Lanes,
        way: str,
        inner: Value,
        opacities: Value,
        colors: Value,
        intervals: Value,
        buckets: Value,
        steps: Steps,
    ) -> None:
        self.lanes, self.way, self.inner, self.intervals = lanes, way, inner, intervals
        self.opacities, self.colors, self.buckets, self.steps = opacities, colors, buckets, steps

    def locate(self, tape: Tape, value: Node) -> OnTable:
        """A NaN is looked up in the first interval, where its fraction is NaN."""
        if self.way == "even":
            return self._at_equal_steps(tape, value)
        interval, packs = self._search(value.value) if self.way == "compared" else self._in_bucket(value.value)
        ends = [Node(pack) for pack in packs]
        low, high, _, _ = ends
        fraction = tape.divide(tape.subtract(value, low), tape.subtract(high, low))
        return OnTable(interval, ends, tape.clamp_fraction(fraction))

    def _at_equal_steps(self, tape: Tape, value: Node) -> OnTable:
        e = self.lanes
        interval, t = self._step_of(value.value)
        number, scale = e.of_integer(interval), e.everywhere(e.scalar(self.steps.scale))
        b0, b1, *opacities = self._rows(self.colors, interval, COLOR_ROW, 4)
        width = e.divide(e.constant(1), scale)
        first = e.multiply_add(number, width, e.everywhere(e.scalar(self.steps.low)))
        ends = [Node(pack) for pack in (first, e.add(first, width), *opacities)]
        w = e.subtract(t, number)
        fraction = tape.record(
            w,
            (value, scale),
            (ends[0], e.multiply(e.subtract(w, e.constant(1)), scale)),
            (ends[1], e.negate(e.multiply(w, scale))),
        )
        return OnTable(interval, ends, tape.clamp_fraction(fraction), [b0, b1])

    def _step_of(self, value: Value) -> tuple[Value, Value]:
        """The number of a value's step, and t = (v − low) · scale."""
        e = self.lanes
        low, scale, last = (e.everywhere(e.scalar(n)) for n in (self.steps.low, self.steps.scale, self.steps.last))
        t = e.multiply(e.subtract(value, low), scale)
        return e.to_integer(e.clamp(t, e.constant(0), last)), t

    def _search(self, value: Value) -> tuple[Value, list[Value]]:
        """The interval and its ends, by comparing with every control point."""
        e, b = self.lanes, self.lanes.builder
        integers = ir.VectorType(I32, e.count)
        found = e.variable(ir.Constant(integers, None))
        with e.repeat(I64(0), b.sub(self.intervals, I64(1))) as j:
            point = b.load(e.advance(self.inner, j, e.number), typ=e.number)
            beyond = b.fcmp_ordered(">=", value, e.everywhere(point))
            found.value = b.sub(found.value, b.sext(beyond, integers))
        return found.value, self._rows(self.opacities, found.value, OPACITY_ROW, 0)

    def _in_bucket(self, value: Value) -> tuple[Value, list[Value]]:
        """The same, by comparing with the one control point of the bucket."""
        e, b = self.lanes, self.lanes.builder
        bucket, _ = self._step_of(value)
        x0, x1, x2, number = self._rows(self.buckets, bucket, BUCKET_ROW, 0)
        alpha0, alpha1, alpha2, _ = self._rows(self.buckets, bucket, BUCKET_ROW, 4)
        beyond = b.fcmp_ordered(">=", value, x1)
        first, second = (x0, x1, alpha0, alpha1), (x1, x2, alpha1, alpha2)
        ends = [e.where(beyond, right, left) for left, right in zip(first, second, strict=True)]
        return b.sub(e.to_integer(number), b.sext(beyond, ir.VectorType(I32, e.count))), ends

    def opacity(self, tape: Tape, located: OnTable) -> Node:
        return tape.blend(located.ends[2], located.ends[3], located.fraction)

    def color_ends(self, located: OnTable) -> list[Node]:
        """r₀ r₁ g₀ g₁ b₀ b₁."""
        red_green = self._rows(self.colors, located.interval, COLOR_ROW, 0)
        blue = located.blue or self._rows(self.colors, located.interval, COLOR_ROW, 4)[:2]
        return [Node(pack) for pack in red_green + blue]

    def color(self, tape: Tape, located: OnTable, ends: Sequence[Node]) -> list[Node]:
        return [tape.blend(ends[k], ends[k + 1], located.fraction) for k in (0, 2, 4)]

    def _rows(self, table: Value, interval: Value, width: int, first: int) -> list[Value]:
        """Four numbers of every lane's row as four packs."""
        e, b = self.lanes, self.lanes.builder
        start = b.mul(interval, ir.Constant(interval.type, [width] * e.count))
        quads = []
        for lane in range(e.count):
            place = b.add(b.zext(e.lane(start, lane), I64), I64(first))
            quads.append(e.load(e.advance(table, place, e.number), e.number, 4))
        return transpose_quads(e, [e.join(lanes_of_groups(quads, (k,))) for k in range(4)])

    def add_to_rows(
        self, tables: Sequence[Value], interval: Value, packs: Sequence[Value], width: int, first: int
    ) -> None:
        """Add up to four packs to every lane's row of a table of doubles, one lane after the other.

        Lanes take turns with the tables, whose sum counts: neighbours often share a row, and would wait for each other.
        """
        e, b = self.lanes, self.lanes.builder
        padded = [*packs, *[e.constant(0)] * (4 - len(packs))]
        groups = transpose_quads(e, padded)
        wide = ir.VectorType(DOUBLE, 4)
        for lane in range(e.count):
            own = groups[lane % 4]
            quad = e.shuffle(own, own, range(lane // 4 * 4, lane // 4 * 4 + 4))
            quad = quad if e.number == DOUBLE else b.fpext(quad, wide)
            row = b.mul(b.zext(e.lane(interval, lane), I64), I64(width))
            place = e.advance(tables[lane % len(tables)], b.add(row, I64(first)), DOUBLE)
            e.store(b.fadd(e.load(place, DOUBLE, 4), quad), place)


def optical_depth(tape: Tape, opacity: Node, length: Node) -> Node:
    """τ = −log1p(−α) · s; ∞ for α = 1 over any s > 0, with derivative 0 there. s is in units of the opacity."""
    e, b = tape.lanes, tape.lanes.builder
    opaque = b.fcmp_ordered(">=", opacity.value, e.constant(1))
    clear = e.where(opaque, e.constant(0), opacity.value)
    density = e.negate(mathematics.log1p(e, e.negate(clear), ends=False))
    full = b.and_(opaque, b.fcmp_ordered(">", length.value, e.constant(0)))
    slope = e.divide(length.value, e.subtract(e.constant(1), clear))
    return tape.record(
        e.where(full, e.constant(math.inf), e.multiply(density, length.value)),
        (opacity, e.where(opaque, e.constant(0), slope)),
        (length, e.where(opaque, e.constant(0), density)),
    )


@dataclass(frozen=True)
class Lights:
    """What shading needs besides the sample; all the same in every lane.

    Attributes:
        ambient, shininess: numbers.
        toward, halfway: for every light l and h, three nodes each.
        diffuse, specular: for every light D and S, three nodes each (red, green, blue).
    """

    ambient: Node
    shininess: Node
    toward: list[list[Node]]
    halfway: list[list[Node]]
    diffuse: list[list[Node]]
    specular: list[list[Node]]


def shade(tape: Tape, color: list[Node], gradient: list[Node], lights: Lights) -> list[Node]:
    """The lit colour; of a zero gradient only the ambient part."""
    direction, inverse_length = _normal(tape, gradient)
    matt = [lights.ambient] * 3
    shine: list[Node | None] = [None] * 3
    for toward, halfway, diffuse, specular in zip(
        lights.toward, lights.halfway, lights.diffuse, lights.specular, strict=True
    ):
        facing = tape.absolute(tape.multiply(tape.dot(direction, toward), inverse_length))
        half = tape.absolute(tape.multiply(tape.dot(direction, halfway), inverse_length))
        highlight = _power(tape, half, lights.shininess)
        for k in range(3):
            matt[k] = tape.multiply_add(diffuse[k], facing, matt[k])
            before = shine[k]
            shine[k] = (
                tape.multiply(specular[k], highlight)
                if before is None
                else tape.multiply_add(specular[k], highlight, before)
            )
    lit = []
    for own, dull, bright in zip(color, matt, shine, strict=True):
        lit.append(tape.multiply(own, dull) if bright is None else tape.multiply_add(own, dull, bright))
    return lit


def _normal(tape: Tape, gradient: list[Node]) -> tuple[list[Node], Node]:
    """The gradient at a scale where its square can be taken, and 1/its length there (1 for a zero gradient).

    The scale is a power of two, so that it changes no digit; held constant, as it does not change the normal.
    """
    e, b = tape.lanes, tape.lanes.builder
    sizes = [e.absolute(g.value) for g in gradient]
    largest = e.maximum(e.maximum(sizes[0], sizes[1]), sizes[2])
    digits = {32: 23, 64: 52}[e.bits]
    highest = (1 << (e.bits - 1 - digits)) - 2  # exponent field of the largest finite numbers
    exponent = b.lshr(e.bits_of(largest), e.integers(digits))
    opposite = b.sub(e.integers(highest), exponent)
    opposite = b.select(b.icmp_signed(">", opposite, e.integers(1)), opposite, e.integers(1))
    factor = e.of_bits(b.shl(opposite, e.integers(digits)))
    scaled = [tape.scale(g, factor) for g in gradient]
    squared = tape.dot(scaled, scaled)
    zero = b.fcmp_ordered("==", squared.value, e.constant(0))
    inverse = e.divide(e.constant(1), e.square_root(e.where(zero, e.constant(1), squared.value)))
    cubed = e.multiply(e.multiply(inverse, inverse), e.multiply(inverse, e.constant(-0.5)))
    return scaled, tape.record(inverse, (squared, cubed))


def _power(tape: Tape, base: Node, exponent: Node) -> Node:
    """base^exponent for 0 ≤ base ≤ 1, more is rounding; 0 with derivative 0 at base = 0."""
    e = tape.lanes
    value, logarithm = mathematics.power(e, base.value, exponent.value)
    zero = e.builder.fcmp_ordered("==", base.value, e.constant(0))
    slope = e.divide(e.multiply(exponent.value, value), e.where(zero, e.constant(1), base.value))
    return tape.record(value, (base, slope), (exponent, e.multiply(value, logarithm)))
