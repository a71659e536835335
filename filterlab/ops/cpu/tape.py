"""Reverse-mode differentiation while a program is written: what was computed forwards is walked backwards.

A *node* is a pack and, for every node it was computed from, the partial derivative by it (a pack as well). `backward`
walks from the last node to the first and writes, for every one with an adjoint x̄ = ∂result/∂x, the lines

    parent's adjoint += x̄ · partial

so that a formula is written down once and its derivative follows. Partials are written when the node is made; those
that nobody asks for are code whose result is never used, and LLVM drops it. All of it must stand in one block of code,
or in blocks that always run one after the other.
"""

from __future__ import annotations

from collections.abc import Sequence

from filterlab.ops.cpu.lanes import Lanes, Value


class Node:
    """A pack and what became of it.

    Attributes:
        value: the pack.
        adjoint: derivative of the result by it; None: it does not count. To be set before `Tape.backward` runs.
    """

    def __init__(self, value: Value, parents: Sequence[tuple[Node, Value | None]] = ()) -> None:
        self.value, self.parents = value, parents
        self.adjoint: Value | None = None


class Tape:
    """Writes instructions and remembers their derivatives."""

    def __init__(self, lanes: Lanes) -> None:
        self.lanes = lanes
        self._nodes: list[Node] = []

    def backward(self) -> None:
        """Adjoints of every node, from those that have one."""
        for node in reversed(self._nodes):
            if node.adjoint is not None:
                for parent, partial in node.parents:
                    self.give(parent, node.adjoint, partial)

    def give(self, node: Node, adjoint: Value, factor: Value | None = None) -> None:
        """Add adjoint · factor to what a node has; None: 1."""
        e = self.lanes
        if factor is not None:
            node.adjoint = e.multiply_add(adjoint, factor, node.adjoint)
        else:
            node.adjoint = adjoint if node.adjoint is None else e.add(node.adjoint, adjoint)

    def record(self, value: Value, *parents: tuple[Node, Value | None]) -> Node:
        """A node with the given partial derivatives; None: 1."""
        node = Node(value, parents)
        self._nodes.append(node)
        return node

    # --- arithmetic ---

    def add(self, a: Node, b: Node) -> Node:
        return self.record(self.lanes.add(a.value, b.value), (a, None), (b, None))

    def subtract(self, a: Node, b: Node) -> Node:
        return self.record(self.lanes.subtract(a.value, b.value), (a, None), (b, self.lanes.constant(-1)))

    def multiply(self, a: Node, b: Node) -> Node:
        return self.record(self.lanes.multiply(a.value, b.value), (a, b.value), (b, a.value))

    def multiply_add(self, a: Node, b: Node, c: Node) -> Node:
        value = self.lanes.multiply_add(a.value, b.value, c.value)
        return self.record(value, (a, b.value), (b, a.value), (c, None))

    def scale(self, a: Node, factor: Value) -> Node:
        """a · factor, the factor held constant."""
        return self.record(self.lanes.multiply(a.value, factor), (a, factor))

    def divide(self, a: Node, b: Node) -> Node:
        e = self.lanes
        quotient, inverse = e.divide(a.value, b.value), e.divide(e.constant(1), b.value)
        return self.record(quotient, (a, inverse), (b, e.negate(e.multiply(quotient, inverse))))

    def dot(self, a: Sequence[Node], b: Sequence[Node]) -> Node:
        """a_x b_x + a_y b_y + a_z b_z."""
        total = self.multiply(a[0], b[0])
        for own, other in zip(a[1:], b[1:], strict=True):
            total = self.multiply_add(own, other, total)
        return total

    def absolute(self, a: Node) -> Node:
        """|a|, with derivative 0 at 0."""
        e, b = self.lanes, self.lanes.builder
        sign = e.where(b.fcmp_ordered("<", a.value, e.constant(0)), e.constant(-1), e.constant(0))
        sign = e.where(b.fcmp_ordered(">", a.value, e.constant(0)), e.constant(1), sign)
        return self.record(e.absolute(a.value), (a, sign))

    def clamp_fraction(self, a: Node) -> Node:
        """a between 0 and 1, with derivative 1 there (both ends too) and 0 beyond; NaN stays."""
        e, b = self.lanes, self.lanes.builder
        inside = b.and_(b.fcmp_ordered(">=", a.value, e.constant(0)), b.fcmp_ordered("<=", a.value, e.constant(1)))
        value = e.minimum(e.constant(1), e.maximum(e.constant(0), a.value))
        return self.record(value, (a, e.where(inside, e.constant(1), e.constant(0))))

    def blend(self, low: Node, high: Node, fraction: Node) -> Node:
        """low + fraction · (high − low), exact at both ends."""
        e, w = self.lanes, fraction.value
        left = e.subtract(e.constant(1), w)
        step = e.subtract(high.value, low.value)
        near_low = e.builder.fcmp_unordered("<", w, e.constant(0.5))
        value = e.where(
            near_low,
            e.multiply_add(w, step, low.value),
            e.subtract(high.value, e.multiply(left, step)),
        )
        return self.record(value, (low, left), (high, w), (fraction, step))
