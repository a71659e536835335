"""Roots in exact arithmetic: what a float answer is judged by. Imports nothing of filterlab.

Letters: p(t) = Σ_i c_i B_i(t) of the float coefficients exactly as they are, p̃(t) = Σ_i |c_i| B_i(t).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from fractions import Fraction
from itertools import pairwise
from typing import Literal

Verdict = Literal["right", "touch", "lost", "invented", "later", "inaccurate"]
BAD: tuple[Verdict, ...] = ("lost", "invented", "later", "inaccurate")
_NEIGHBOURS = 2  # floats to either side of t: where p has a root between them, t is as good as a float can be
_NEAR = Fraction(1, 10**6)  # a root no farther away was found, if inaccurately; farther away it is another one
_SAMPLES = 64  # between a root and a t that may belong to it


class ExactPolynomial:
    """p, of integer coefficients: the float ones times a power of two."""

    def __init__(self, coefficients: Sequence[float]) -> None:
        fractions = [Fraction(c) for c in coefficients]
        scale = math.lcm(*(f.denominator for f in fractions))
        self.bernstein = [int(f * scale) for f in fractions]
        self.power = monomial(self.bernstein)
        self._chain: list[list[int]] | None = None

    @property
    def chain(self) -> list[list[int]]:
        """The Sturm chain, divided by its last member: valid at multiple roots too."""
        if self._chain is None:
            self._chain = _sturm(_trimmed(self.power))
        return self._chain

    def value(self, t: Fraction) -> Fraction:
        """p(t), in units of the scale."""
        return _sum(self.bernstein, t)

    def size(self, t: Fraction) -> Fraction:
        """p̃(t), in units of the scale."""
        return _sum([abs(c) for c in self.bernstein], t)

    def roots_between(self, a: Fraction, b: Fraction) -> int:
        """How many distinct roots a ≤ t ≤ b has; of the zero polynomial 1."""
        if not any(self.power):
            return 1
        return _variations(self.chain, a) - _variations(self.chain, b) + (self.value(a) == 0)

    def first_root(self, a: Fraction = Fraction(0), b: Fraction = Fraction(1), bits: int = 80) -> Fraction | None:
        """The smallest root in [a, b], or a number above it by less than (b − a) 2^−bits."""
        if not self.roots_between(a, b):
            return None
        if self.value(a) == 0:
            return a
        for _ in range(bits):
            middle = (a + b) / 2
            a, b = (a, middle) if self.roots_between(a, middle) else (middle, b)
        return b


def monomial(bernstein: Sequence[int]) -> list[int]:
    """a_j = binom(n, j) Σ_i (−1)^(j − i) binom(j, i) c_i of p(t) = Σ_j a_j t^j."""
    n = len(bernstein) - 1
    return [
        math.comb(n, j) * sum((-1) ** (j - i) * math.comb(j, i) * bernstein[i] for i in range(j + 1))
        for j in range(n + 1)
    ]


def judge(coefficients: Sequence[float], t: float, tolerance: float, *, digits: int = 53) -> Verdict:
    """What a solver's answer is worth.

    Args:
        coefficients: c_0 … c_n, floats.
        t: the first root in [0, 1] according to the solver; ∞ for none.
        tolerance: p is 0 within rounding where |p| ≤ tolerance · p̃.
        digits: binary digits of t's type.

    Returns:
        `right`; `touch`: p has no root in [0, 1], but is 0 within rounding at t; `lost`: it has one, none was returned;
        `later`: it has an earlier one, and between the two p is not 0 within rounding; `invented`: t is no root;
        `inaccurate`: either of these two, but there is a root nearer than 10⁻⁶.
    """
    p, bound = ExactPolynomial(coefficients), Fraction(tolerance)
    zero, one = Fraction(0), Fraction(1)
    if t == math.inf:
        return "lost" if p.roots_between(zero, one) else "right"
    at = Fraction(t)
    before, after = (min(max(at + k * _spacing(t, digits), zero), one) for k in (-_NEIGHBOURS, _NEIGHBOURS))
    here = p.roots_between(before, after) > 0
    if not here and not _vanishes(p, at, bound):
        return "inaccurate" if _near(p, at) else "invented"
    if p.roots_between(zero, before):
        return _or_later(p, at, before, bound)
    return "right" if here or p.roots_between(zero, one) else "touch"


def _or_later(p: ExactPolynomial, at: Fraction, before: Fraction, bound: Fraction) -> Verdict:
    first = p.first_root(Fraction(0), before)
    assert first is not None
    between = (first + (at - first) * Fraction(k, _SAMPLES) for k in range(1, _SAMPLES))
    if all(_vanishes(p, t, bound) for t in between):
        return "right"
    return "inaccurate" if at - first <= _NEAR else "later"


def _vanishes(p: ExactPolynomial, t: Fraction, bound: Fraction) -> bool:
    return abs(p.value(t)) <= bound * p.size(t)


def _near(p: ExactPolynomial, t: Fraction) -> bool:
    return p.roots_between(max(t - _NEAR, Fraction(0)), min(t + _NEAR, Fraction(1))) > 0


def _spacing(t: float, digits: int) -> Fraction:
    """From t to its neighbour of that many binary digits."""
    return Fraction(2) ** (math.frexp(t)[1] - digits)


def _sum(bernstein: Sequence[int], t: Fraction) -> Fraction:
    """Σ_i c_i B_i(t), over the common denominator."""
    n, x, y = len(bernstein) - 1, t.numerator, t.denominator
    total = sum(math.comb(n, i) * c * x**i * (y - x) ** (n - i) for i, c in enumerate(bernstein))
    return Fraction(total, y**n)


def _variations(chain: Sequence[Sequence[int]], t: Fraction) -> int:
    signs = [s for s in (_sign(f, t) for f in chain) if s]
    return sum(a != b for a, b in pairwise(signs))


def _sign(f: Sequence[int], t: Fraction) -> int:
    x, y, total, power = t.numerator, t.denominator, 0, 1
    for a in reversed(f):  # Horner's rule times y^degree
        total, power = total * x + a * power, power * y
    return (total > 0) - (total < 0)


def _sturm(f: list[int]) -> list[list[int]]:
    chain = [f, _primitive([j * a for j, a in enumerate(f)][1:])] if len(f) > 1 else [f]
    while len(chain) > 1 and len(chain[-1]) > 1:
        rest = _primitive([-a for a in _remainder(chain[-2], chain[-1])])
        if not rest:
            break
        chain.append(rest)
    if len(chain[-1]) > 1:  # the greatest common divisor: multiple roots
        chain = [_quotient(member, chain[-1]) for member in chain]
    return chain


def _remainder(f: Sequence[int], g: Sequence[int]) -> list[int]:
    """A positive multiple of the remainder of f by g."""
    f = list(f)
    lead = abs(g[-1])
    while len(f) >= len(g):
        top, shift = f[-1] * (1 if g[-1] > 0 else -1), len(f) - len(g)
        f = [lead * a for a in f]
        for i, b in enumerate(g):
            f[shift + i] -= top * b
        f = _trimmed(f[:-1])
    return f


def _quotient(f: Sequence[int], g: Sequence[int]) -> list[int]:
    """A positive multiple of f / g, which leaves nothing over, or a negative one where g's leading coefficient is."""
    rest, quotient = [Fraction(a) for a in f], [Fraction(0)] * (len(f) - len(g) + 1)
    for k in range(len(quotient) - 1, -1, -1):
        quotient[k] = rest[k + len(g) - 1] / abs(g[-1])
        for i, b in enumerate(g):
            rest[k + i] -= quotient[k] * b * (1 if g[-1] > 0 else -1)
    scale = math.lcm(*(q.denominator for q in quotient))
    return _primitive([int(q * scale) for q in quotient])


def _trimmed(f: Sequence[int]) -> list[int]:
    """Without leading zeros."""
    end = len(f)
    while end and not f[end - 1]:
        end -= 1
    return list(f[:end])


def _primitive(f: Sequence[int]) -> list[int]:
    """Divided by the greatest common divisor of its coefficients."""
    f = _trimmed(f)
    content = math.gcd(*f) if f else 1
    return [a // content for a in f]
