"""Programs in the making: the text of a Python function, line by line.

A Triton program is a Python function that Triton reads and compiles. Ours are as long as a stencil has taps, so they
are written by other functions (`taps`, `points`) and launched by `launch`.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterator, Sequence
from contextlib import contextmanager


class Source:
    """The text of one function, being written."""

    def __init__(self, name: str, parameters: Sequence[str]) -> None:
        self.name = name
        self._lines = [f"def {name}({', '.join(parameters)}):"]
        self._depth, self._names = 1, 0

    def line(self, text: str) -> None:
        self._lines.append("    " * self._depth + text)

    def lines(self, text: str) -> None:
        """Several of them, as deep as they stand to one another."""
        for line in textwrap.dedent(text).strip("\n").splitlines():
            self.line(line)

    def named(self, expression: str) -> str:
        """Its value by a name that nothing else in the program has: within loops and branches names keep their type."""
        self._names += 1
        self.line(f"t{self._names} = {expression}")
        return f"t{self._names}"

    @contextmanager
    def block(self, head: str) -> Iterator[None]:
        """head: what the with-block writes."""
        self.line(f"{head}:")
        self._depth += 1
        yield
        self._depth -= 1

    def __str__(self) -> str:
        return "\n".join(self._lines) + "\n"


def number(value: float) -> str:
    """A literal with all digits of a double, to be used within an expression.

    Triton takes a literal in the type of what it is combined with, but a name that is assigned a literal is float32:
    constants are therefore never given names.
    """
    return repr(float(value)) if value >= 0 else f"({float(value)!r})"


def any_of(mask: str) -> str:
    """Whether it holds for one of the numbers of a block."""
    return f"tl.reduce(({mask}).to(tl.int32), 0, either) > 0"


def polynomial(coefficients: Sequence[float], u: str) -> str:
    """Σ_j coefficients[j] u^j by Horner's rule; a literal for a constant."""
    *lower, highest = coefficients
    text = number(highest)
    for c in reversed(lower):
        text = f"({text} * {u}" + (f" + {number(c)})" if c else ")")
    return text
