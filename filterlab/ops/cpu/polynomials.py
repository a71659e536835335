"""The first root in [0, 1] of polynomials in Bernstein form, a pack of them at a time.

The same roots, tolerances and letters as in `filterlab.roots` (read it first): with τ = 3 n ε, the first t counts at
which p − τ p̃ vanishes, for p(0) > 0. What is searched differs: a pack goes through [0, 1] from left to right, in dyadic
parts that are halved until the coefficients change their sign once at most.

    no change of sign                no root in the part: on to the next one, as wide as its place allows
    one                              one root: the part is kept, and Newton's method is left for later
    several                          halves
    several, where floats end        a root within rounding: the part is kept

So a double root costs halvings, at most as many as floats have digits, and nothing that is found later has to be
compared with it.

All roots are met by going on in the same way. Every place of [0, 1] lies on a side: 1 where p > τ p̃, −1 where p < −τ p̃,
and 0 between; a root is where a side 1 or −1 is left, and what stays on side 0 is the same root. p + τ p̃ tells of one
side what p − τ p̃ tells of the other, and parts are halved until both change their sign once at most.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from math import comb

from llvmlite import ir

from filterlab.ops.cpu.lanes import I1, I8, I64, Kept, Lanes, Value, Variable
from filterlab.ops.raycast import PASSES, USUAL
from filterlab.roots import ROUNDINGS

Rows = list[Value]
"""Coefficients, packs."""


@dataclass(frozen=True)
class Part:
    """Where a root is: coefficients on [a, a + h], positive at a; in memory."""

    rows: list[Variable]
    a: Variable
    h: Variable

    @classmethod
    def of(cls, e: Lanes, degree: int) -> Part:
        """The whole of [0, 1], of a polynomial that stays 1."""
        one = e.constant(1)
        return cls([e.variable(one) for _ in range(degree + 1)], e.variable(e.constant(0)), e.variable(one))

    def assign(self, e: Lanes, mask: Value, rows: Rows, a: Value, h: Value) -> None:
        """Where the mask is true."""
        for variable, value in zip((*self.rows, self.a, self.h), (*rows, a, h), strict=True):
            variable.value = e.where(mask, value, variable.value)


class FirstRoot:
    """Writes the search. Make it before any loop.

    Args:
        lanes: writer of instructions.
        degree: n.
    """

    def __init__(self, lanes: Lanes, degree: int) -> None:
        self.lanes, self.builder, self.degree = lanes, lanes.builder, degree
        self.eps = 2.0**-23 if lanes.bits == 32 else 2.0**-52
        self.tolerance = ROUNDINGS * degree * self.eps

    # --- signs ---

    def lowered(self, rows: Rows, times: float = 1.0) -> Rows:
        """p − times τ p̃."""
        e = self.lanes
        lean = e.constant(-times * self.tolerance)
        return [e.multiply_add(e.absolute(r), lean, r) for r in rows]

    def changes(self, flags: Sequence[Value]) -> Value:
        """How often neighbours differ, 8-bit integers."""
        b, count = self.builder, None
        kind = ir.VectorType(I8, self.lanes.count)
        for left, right in pairwise(flags):
            one = b.zext(b.xor(left, right), kind)
            count = one if count is None else b.add(count, one)
        return count

    def negative(self, rows: Rows) -> list[Value]:
        zero = self.lanes.constant(0)
        return [self.builder.fcmp_ordered("<=", r, zero) for r in rows]

    def at_most_one(self, count: Value) -> Value:
        return self.builder.icmp_unsigned("<=", count, ir.Constant(count.type, [1] * self.lanes.count))

    # --- the part that holds the first root ---

    def first_part(self, mask: Value, rows: Rows, found: Callable[[Value, Rows, Value, Value], None]) -> None:
        """Halve [0, 1] of the polynomials under the mask (c_0 > 0), from left to right.

        Args:
            found: is given a mask of those whose part was found, its coefficients, a and h; the others have none.
        """
        e, b = self.lanes, self.builder
        one = e.constant(1)
        own, lowered = [e.kept(r) for r in rows], [e.kept(r) for r in self.lowered(rows)]
        left = e.variable(mask)
        a, h = e.variable(e.constant(0)), e.variable(one)
        with e.repeat_while(lambda: e.any(left.value)):
            end = e.add(a.value, h.value)
            here = self.between([r.all(e.count) for r in lowered], a.value, end)
            below = self.negative(here)
            changes = self.changes(below)
            narrow = b.fcmp_ordered("<=", h.value, e.constant(self.eps))
            several = b.not_(self.at_most_one(changes))
            holds = b.and_(left.value, b.select(several, narrow, below[-1]))
            with b.if_then(e.any(holds)):
                found(holds, self.between([r.all(e.count) for r in own], a.value, end), a.value, h.value)
            halves = b.and_(left.value, b.and_(several, b.not_(narrow)))
            on = b.and_(b.and_(left.value, b.not_(holds)), b.not_(halves))
            a.value, h.value = self.moved(a.value, h.value, on, halves)
            over = b.and_(on, b.fcmp_ordered(">=", a.value, one))
            left.value = b.and_(left.value, b.not_(b.or_(holds, over)))

    def moved(self, a: Value, h: Value, on: Value, halves: Value) -> tuple[Value, Value]:
        """a and h of the next part, as wide as its place allows; or of the first half of this one."""
        e, b = self.lanes, self.builder
        a = e.where(on, e.add(a, h), a)
        doubled = e.multiply(h, e.constant(2))
        parts = e.divide(a, doubled)
        wider = b.and_(on, b.fcmp_ordered("==", e.floor(parts), parts))
        return a, e.where(halves, e.multiply(h, e.constant(0.5)), e.where(wider, doubled, h))

    def between(self, rows: Rows, start: Value, end: Value) -> Rows:
        """Coefficients on [start, end], by de Casteljau's algorithm at the end and, from there, at start / end."""
        e = self.lanes
        return self._right(self._left(rows, end), e.divide(start, end))

    def _left(self, rows: Rows, t: Value) -> Rows:
        rows, out = list(rows), [rows[0]]
        s = self.lanes.subtract(self.lanes.constant(1), t)
        while len(rows) > 1:
            rows = [self._mixed(left, right, s, t) for left, right in pairwise(rows)]
            out.append(rows[0])
        return out

    def _right(self, rows: Rows, t: Value) -> Rows:
        rows, out = list(rows), [rows[-1]]
        s = self.lanes.subtract(self.lanes.constant(1), t)
        while len(rows) > 1:
            rows = [self._mixed(left, right, s, t) for left, right in pairwise(rows)]
            out.append(rows[-1])
        return out[::-1]

    def _mixed(self, left: Value, right: Value, s: Value, t: Value) -> Value:
        e = self.lanes
        return e.multiply_add(right, t, e.multiply(left, s))

    # --- one root in a part ---

    def root(self, rows: Rows, mask: Value) -> Value:
        """t in [0, 1] where p, positive at 0 and not, or within rounding, at 1, vanishes; any number elsewhere.

        By Newton's method in the half where the root is, in u = t / (1 − t), or (1 − t) / t in the right half, of
        p − 1.5 τ p̃, which changes its sign for certain; the last step is p's own.
        """
        e, b, n = self.lanes, self.builder, self.degree
        one = e.constant(1)
        scaled = [e.multiply(r, e.constant(comb(n, i))) if comb(n, i) > 1 else r for i, r in enumerate(rows)]
        lowered = self.lowered(scaled, 1.5)
        middle = lowered[0]
        for r in lowered[1:]:
            middle = e.add(middle, r)
        right = b.fcmp_ordered(">", middle, e.constant(0))
        turn = e.where(right, e.constant(-1), one)  # positive at the low end of u, or not at the high end
        chart = lambda row: [  # noqa: E731
            e.multiply(turn, e.where(right, far, near)) for near, far in zip(row, reversed(row), strict=True)
        ]
        own, search = chart(scaled), chart(lowered)
        u = self._polished(own, self._newton(search, mask))
        share = e.divide(one, e.add(one, u))
        return e.where(right, share, e.multiply(u, share))

    def _newton(self, rows: Rows, mask: Value) -> Value:
        """u in [0, 1] where Σ rows[i] u^i, positive at 0 and not at 1, vanishes."""
        e, b = self.lanes, self.builder
        zero, half = e.constant(0), e.constant(0.5)
        rows_, sizes = [e.kept(r) for r in rows], [e.kept(e.absolute(r)) for r in rows]
        low, high = e.variable(e.constant(1e-300 if e.bits == 64 else 1e-37)), e.variable(e.constant(1))
        start = rows[0]
        for r in rows[1:]:
            start = e.add(start, r)
        part = e.divide(rows[0], e.subtract(rows[0], start))
        u = e.variable(e.maximum(e.minimum(part, e.constant(0.98)), e.constant(0.02)))
        last, active = e.variable(e.constant(1)), e.variable(mask)
        k = e.variable(I8(0))
        going = lambda: b.and_(e.any(active.value), b.icmp_unsigned("<", k.value, I8(PASSES)))  # noqa: E731
        with e.repeat_while(going):
            at = u.value
            value, slope = self._horner([r.all(e.count) for r in rows_], at)
            size = self._plain_horner([r.all(e.count) for r in sizes], at)
            noise = e.multiply(size, e.constant(0.5 * len(rows) * self.eps))
            clear = b.fcmp_ordered(">", e.absolute(value), noise)
            late = e.everywhere(b.icmp_unsigned(">=", k.value, I8(USUAL)))
            arrived = b.and_(late, b.and_(b.not_(clear), b.fcmp_ordered("<", slope, zero)))
            positive = b.select(clear, b.fcmp_ordered(">", value, zero), b.fcmp_ordered("<", at, half))
            low.value, high.value = e.where(positive, at, low.value), e.where(positive, high.value, at)
            step = e.divide(value, slope)
            new = e.subtract(at, step)
            inside = b.and_(b.fcmp_ordered(">=", new, low.value), b.fcmp_ordered("<=", new, high.value))
            good = b.and_(inside, b.fcmp_ordered("<=", e.absolute(step), e.multiply(half, last.value)))
            new = e.where(good, new, e.multiply(half, e.add(low.value, high.value)))
            moves = b.and_(active.value, b.not_(arrived))
            last.value = e.absolute(e.subtract(new, at))
            u.value = e.where(moves, new, at)
            active.value = b.and_(moves, b.fcmp_ordered(">", last.value, e.multiply(new, e.constant(2 * self.eps))))
            k.value = b.add(k.value, I8(1))
        return u.value

    def _polished(self, rows: Rows, u: Value) -> Value:
        """One step of Newton's method, where p falls and it leads nearer to a root with nothing between."""
        e, b = self.lanes, self.builder
        value, slope = self._horner(rows, u)
        new = e.subtract(u, e.divide(value, slope))
        value_there, slope_there = self._horner(rows, new)
        change = e.divide(slope_there, slope)
        nearer = b.fcmp_ordered("<=", e.absolute(value_there), e.multiply(e.constant(0.5), e.absolute(value)))
        alike = b.and_(b.fcmp_ordered(">", change, e.constant(0.5)), b.fcmp_ordered("<", change, e.constant(2)))
        inside = b.and_(b.fcmp_ordered(">=", new, e.constant(0)), b.fcmp_ordered("<=", new, e.constant(1)))
        falls = b.fcmp_ordered("<", slope, e.constant(0))
        return e.where(b.and_(b.and_(falls, nearer), b.and_(alike, inside)), new, u)

    def _horner(self, rows: Rows, u: Value) -> tuple[Value, Value]:
        """Σ rows[i] u^i and its derivative."""
        e = self.lanes
        slope, value = rows[-1], e.multiply_add(rows[-1], u, rows[-2])
        for r in reversed(rows[:-2]):
            slope, value = e.multiply_add(slope, u, value), e.multiply_add(value, u, r)
        return value, slope

    def _plain_horner(self, rows: Rows, u: Value) -> Value:
        value = rows[-1]
        for r in reversed(rows[:-1]):
            value = self.lanes.multiply_add(value, u, r)
        return value


class NextRoots(FirstRoot):
    """Writes the search of one root after the other. Make it before any loop."""

    def __init__(self, lanes: Lanes, degree: int) -> None:
        super().__init__(lanes, degree)
        zero, none = lanes.constant(0), ir.Constant(ir.VectorType(I1, lanes.count), None)
        with lanes.builder.goto_entry_block():
            self._rows, self._lowered, self._raised = ([lanes.kept() for _ in range(degree + 1)] for _ in range(3))
        self._a, self._h, self._side, self._until = (lanes.variable(zero) for _ in range(4))
        self._ends = lanes.variable(none)  # a root is where [0, 1] ends
        self._counted = lanes.variable(none)  # the root where this side is left was told of; it is left by `_until`

    def begin(self, mask: Value, rows: Rows, side: Value, ends: Value) -> None:
        """Of polynomials under the mask, which begin on a side; those of others are forgotten.

        `ends`, a mask: p(1) is 0, and stands among the rows as the smallest number.
        """
        e = self.lanes
        for kept, numbers in (
            (self._rows, rows),
            (self._lowered, self.lowered(rows)),
            (self._raised, self.lowered(rows, -1.0)),
        ):
            for pack, number in zip(kept, numbers, strict=True):
                pack.set_part(I64(0), number)
        self._a.value, self._h.value, self._side.value, self._ends.value = e.constant(0), e.constant(1), side, ends
        self._counted.value = ir.Constant(mask.type, None)

    def above(self) -> Value:
        """A mask of those that are on side 1 now."""
        return self.builder.fcmp_ordered(">", self._side.value, self.lanes.constant(0))

    def next_part(self, mask: Value, found: Callable[[Value, Rows, Value, Value], None]) -> tuple[Value, Value]:
        """Go on with the polynomials under a mask, each until it has a root, or is over.

        Args:
            found: as of `first_part`; coefficients are positive where the part begins.

        Returns:
            masks of those that were found, and of those that are over.
        """
        e, b = self.lanes, self.builder
        none = ir.Constant(mask.type, None)
        left, met, over = e.variable(mask), e.variable(none), e.variable(none)
        with e.repeat_while(lambda: e.any(left.value)):
            holds, past = self._step(left.value, found)
            met.value, over.value = b.or_(met.value, holds), b.or_(over.value, past)
            left.value = b.and_(left.value, b.not_(b.or_(holds, past)))
        return met.value, over.value

    def _step(self, left: Value, found: Callable[[Value, Rows, Value, Value], None]) -> tuple[Value, Value]:
        """One part of each: masks of those that have a root there, and of those that are behind the last part."""
        e, b, zero, one = self.lanes, self.builder, self.lanes.constant(0), self.lanes.constant(1)
        a, h, side, counted = self._a.value, self._h.value, self._side.value, self._counted.value
        end, narrow = e.add(a, h), b.fcmp_ordered("<=", h, e.constant(self.eps))
        not_above = self.negative(self._on(self._lowered, a, end))
        not_below = [b.fcmp_ordered(">=", r, zero) for r in self._on(self._raised, a, end)]
        many = [b.not_(self.at_most_one(self.changes(flags))) for flags in (not_above, not_below)]
        rises = b.and_(b.not_(not_below[0]), not_below[-2])  # before the end, at which it then comes from above
        many[1] = b.or_(many[1], b.and_(rises, b.and_(self._ends.value, b.fcmp_ordered(">=", end, one))))
        above, between = b.fcmp_ordered(">", side, zero), b.fcmp_ordered("==", side, zero)
        several, leaves = b.select(above, *many), b.select(above, not_above[-1], not_below[-1])
        holds = b.and_(b.and_(left, b.not_(b.or_(between, counted))), b.select(several, narrow, leaves))
        with b.if_then(e.any(holds)):
            found(holds, [e.multiply(side, r) for r in self._on(self._rows, a, end)], a, h)
        counted = b.or_(counted, holds)
        self._until.value = until = e.where(holds, end, self._until.value)
        on = b.and_(left, b.or_(narrow, b.not_(b.or_(*many))))
        self._a.value, self._h.value = self.moved(a, h, on, b.and_(left, b.not_(on)))
        there = e.where(not_above[-1], e.where(not_below[-1], zero, e.constant(-1)), one)
        left_behind = b.and_(counted, b.or_(leaves, several))
        late = b.and_(counted, b.fcmp_ordered(">=", end, until))  # left within rounding
        moved = e.where(b.or_(between, left_behind), there, e.where(late, zero, side))
        self._side.value = e.where(on, moved, side)
        self._counted.value = b.and_(counted, b.not_(b.and_(on, b.or_(left_behind, late))))
        return holds, b.and_(on, b.fcmp_ordered(">=", end, one))

    def _on(self, kept: Sequence[Kept], a: Value, end: Value) -> Rows:
        return self.between([pack.all(self.lanes.count) for pack in kept], a, end)
