"""Reverse-mode differentiation while a program is written as text; the twin of `ops.cpu.tape`.

A *node* is a name of the program and, for every node it was computed from, the partial derivative by it as text.
`backward` walks from the last node to the first and writes, for every one with an adjoint x̄ = ∂result/∂x, the lines

    to_parent += x̄ * (partial)

so that a formula is written down once and its derivative follows. Nothing is written for nodes that no derivative is
asked by, nor by anything that they were computed from: the march uses the same formulas and asks for none. All of it
must stand in one block of the program.
"""

from __future__ import annotations

from collections.abc import Sequence

from filterlab.ops.cuda.source import Source


class Node:
    """A name and what became of it.

    Attributes:
        name: in the program.
        active: whether derivatives are asked by it, or by something that it was computed from.
        adjoint: text of the derivative of the result by it; None: it does not count.
    """

    def __init__(self, name: str, active: bool, parents: Sequence[tuple[Node, str]] = ()) -> None:
        self.name, self.active, self.parents = name, active, parents
        self.adjoint: str | None = None

    def __str__(self) -> str:
        return self.name


class Tape:
    """Writes lines and remembers their derivatives."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self._nodes: list[Node] = []

    def backward(self) -> None:
        """Adjoints of every active node, from those that have one."""
        for node in reversed(self._nodes):
            if node.adjoint is not None:
                for parent, partial in node.parents:
                    self.give(parent, node.adjoint if partial == "1.0" else f"{node.adjoint} * ({partial})")

    def give(self, node: Node, adjoint: str) -> None:
        """Add to the adjoint of a node."""
        if node.active:
            self.source.line(f"to_{node} {'=' if node.adjoint is None else '+='} {adjoint}")
            node.adjoint = f"to_{node}"

    def record(self, name: str, text: str, *parents: tuple[Node, str]) -> Node:
        """A node with the given partial derivatives. Names that they contain must not be assigned again."""
        self.source.line(f"{name} = {text}")
        node = Node(name, any(parent.active for parent, _ in parents), parents)
        self._nodes.append(node)
        return node

    # --- arithmetic ---

    def subtract(self, name: str, a: Node, b: Node) -> Node:
        return self.record(name, f"{a} - {b}", (a, "1.0"), (b, "-1.0"))

    def multiply(self, name: str, a: Node, b: Node) -> Node:
        return self.record(name, f"{a} * {b}", (a, f"{b}"), (b, f"{a}"))

    def multiply_add(self, name: str, a: Node, b: Node, c: Node) -> Node:
        return self.record(name, f"{a} * {b} + {c}", (a, f"{b}"), (b, f"{a}"), (c, "1.0"))

    def divide(self, name: str, a: Node, b: Node) -> Node:
        return self.record(name, f"{a} / {b}", (a, f"1.0 / {b}"), (b, f"-{name} / {b}"))

    def combine(self, name: str, nodes: Sequence[Node], factors: Sequence[str]) -> Node:
        """Σ node · factor, the factors held constant."""
        terms = list(zip(nodes, factors, strict=True))
        return self.record(name, " + ".join(f"{node} * {factor}" for node, factor in terms), *terms)

    def dot(self, name: str, a: Sequence[Node], b: Sequence[Node]) -> Node:
        """a_x b_x + a_y b_y + a_z b_z."""
        pairs = list(zip(a, b, strict=True))
        partials = [(own, f"{other}") for x, y in pairs for own, other in ((x, y), (y, x))]
        return self.record(name, " + ".join(f"{x} * {y}" for x, y in pairs), *partials)

    def absolute(self, name: str, a: Node) -> Node:
        """|a|, with derivative 0 at 0."""
        sign = f"tl.where({a} > 0.0, 1.0, tl.where({a} < 0.0, -1.0, 0.0))"
        return self.record(name, f"tl.abs({a})", (a, sign))

    def clamp_fraction(self, name: str, a: Node) -> Node:
        """a between 0 and 1, with derivative 1 there (both ends too) and 0 beyond; NaN stays."""
        inside = f"tl.where(({a} >= 0.0) & ({a} <= 1.0), 1.0, 0.0)"
        return self.record(name, f"tl.where({a} < 0.0, 0.0, tl.where({a} > 1.0, 1.0, {a}))", (a, inside))

    def blend(self, name: str, low: Node, high: Node, fraction: Node) -> Node:
        """low + fraction · (high − low), exact at both ends."""
        near_low = f"{low} + {fraction} * ({high} - {low})"
        near_high = f"{high} - ({high} - {low}) * (1.0 - {fraction})"
        return self.record(
            name,
            f"tl.where({fraction} < 0.5, {near_low}, {near_high})",
            (low, f"1.0 - {fraction}"),
            (high, f"{fraction}"),
            (fraction, f"{high} - {low}"),
        )
