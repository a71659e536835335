"""What roots pieces have, told by the signs of their coefficients: the first one, or one after the other.

A piece that changes its sign once, and has no root at an end, is kept as a whole; of others the parts that have one
root are looked for at once (`ops.cpu.polynomials`). Newton's method is left to whoever keeps them.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from llvmlite import ir

from filterlab.ops.cpu.lanes import Value
from filterlab.ops.cpu.polynomials import FirstRoot, NextRoots, Rows

Keep = Callable[[Value, Rows, Value, Value], None]
"""Keeps parts under a mask that have a root: coefficients, positive where they begin, on [a, a + h]."""

Note = Callable[[Value, Value, Value], None]
"""Is told of masks: pieces with a root; those that have it where they begin, and where they end, and keep no part."""


@dataclass(frozen=True)
class Signs:
    """Pieces that hold the level, made positive where they begin, and what their signs tell.

    Attributes:
        rows: coefficients; an end that is 0 is the smallest number, so that the level is met there for no sign.
        begins, ends: masks: where the level is met where the piece begins, or ends.
        simple: a mask of those that meet it once, and not at their ends.
        hard: a mask of all others.
    """

    rows: Rows
    begins: Value
    ends: Value
    simple: Value
    hard: Value

    @classmethod
    def of(cls, search: FirstRoot, given: Rows, holds: Value, jump: Value) -> Signs:
        """Of pieces under a mask, some of which, under another, meet the level where they begin whatever they are."""
        e, b = search.lanes, search.builder
        zero, begin = e.constant(0), given[0]
        turn = e.where(b.fcmp_ordered("<", begin, zero), e.constant(-1), e.constant(1))
        *rows, end = (e.multiply(turn, r) for r in given)
        on_end = b.fcmp_ordered("==", end, zero)  # a root for the case that there is no earlier one
        rows.append(e.where(on_end, e.constant(2.0**-126 if e.bits == 32 else 2.0**-1022), end))
        begins = b.and_(holds, b.or_(jump, b.fcmp_ordered("==", begin, zero)))
        inner = b.and_(holds, b.not_(begins))
        simple = b.and_(inner, b.and_(_changes_once(search, rows), b.fcmp_ordered("<", rows[-1], zero)))
        return cls(rows, begins, on_end, simple, b.and_(holds, b.not_(simple)))


def _changes_once(search: FirstRoot, rows: Rows) -> Value:
    changes = search.changes(search.negative(search.lowered(rows)))
    return search.builder.icmp_unsigned("==", changes, ir.Constant(changes.type, [1] * search.lanes.count))


def first_root(search: FirstRoot, signs: Signs, keep: Keep, note: Note) -> None:
    """Write the search of the first root of every piece."""
    e, b = search.lanes, search.builder
    keep(signs.simple, signs.rows, e.constant(0), e.constant(1))
    found, hard = e.variable(b.or_(signs.begins, signs.simple)), b.and_(signs.hard, b.not_(signs.begins))

    def met(mask: Value, rows: Rows, a: Value, h: Value) -> None:
        keep(mask, rows, a, h)
        found.value = b.or_(found.value, mask)

    with b.if_then(e.any(hard), likely=False):
        search.first_part(hard, signs.rows, met)
    at_end = b.and_(b.and_(hard, signs.ends), b.not_(found.value))
    note(b.or_(found.value, at_end), signs.begins, at_end)


class EveryRoot:
    """Writes the search of one root of every piece after the other. Make it before any loop.

    Args:
        room: makes room for one more root of the pieces under a mask; returns those of them that still want one.
        keep, note: once for every root, if there is room.
    """

    def __init__(self, search: NextRoots, room: Callable[[Value], Value], keep: Keep, note: Note) -> None:
        self.search, self.lanes, self.builder = search, search.lanes, search.builder
        self.room, self.keep, self.note = room, keep, note
        self.none = self.lanes.mask(False)
        self._left, self._simple, self._begins = (self.lanes.variable(self.none) for _ in range(3))

    def write(self, rows: Rows, signs: Signs, repeated: Value) -> None:
        """Of pieces as they are, and their signs; a root where a piece under the mask begins has been noted before."""
        e, b, zero = self.lanes, self.builder, self.lanes.constant(0)
        at_zero = b.fcmp_ordered("==", rows[0], zero)
        ends = b.and_(signs.ends, self._some(rows))  # else it is met where the piece begins, and stays there
        self._simple.value = signs.simple
        self._begins.value = b.and_(signs.begins, b.not_(b.and_(repeated, at_zero)))
        self._left.value = b.or_(signs.simple, signs.hard)
        with b.if_then(e.any(signs.hard), likely=False):
            self.search.begin(signs.hard, signs.rows, e.where(at_zero, zero, e.constant(1)), ends)
        with e.repeat_while(lambda: e.any(self._left.value)):
            self._round(signs, ends)

    def _round(self, signs: Signs, ends: Value) -> None:
        """One more root of every piece that has one."""
        e, b = self.lanes, self.builder
        left = self.room(self._left.value)
        simple, begins = b.and_(left, self._simple.value), b.and_(left, self._begins.value)
        self.keep(simple, signs.rows, e.constant(0), e.constant(1))
        self.note(b.or_(simple, begins), begins, self.none)
        self._simple.value = self._begins.value = self.none
        self._left.value = b.and_(left, b.not_(simple))
        search = b.and_(self._left.value, b.not_(begins))
        with b.if_then(e.any(search), likely=False):
            found, over = self.search.next_part(search, self.keep)
            at_end = b.and_(b.and_(over, self.search.above()), b.and_(ends, b.not_(found)))
            self.note(b.or_(found, at_end), self.none, at_end)
            self._left.value = b.and_(self._left.value, b.not_(over))

    def _some(self, rows: Rows) -> Value:
        """A mask of those that are not all 0."""
        size = self.lanes.absolute(rows[0])
        for row in rows[1:]:
            size = self.lanes.maximum(size, self.lanes.absolute(row))
        return self.builder.fcmp_ordered(">", size, self.lanes.constant(0))
