"""Where a ray meets a quadric within its bounds, found independently: schoolbook formulas in 400 bits.

Nothing here imports filterlab. Products of three numbers of float64 are exact in so many bits, so that signs are those
of the numbers as they were given. What rounding of float64 may move is told with every crossing: how far, and whether
there is one at all. F = y·A y + 2 b·y + c, y = x − o; the ray is e + λ v, λ ≥ 0.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from mpmath import mp, mpf

BITS = 400
EPS = 2.0**-52
ROUNDED = 200  # units of rounding of the terms that a value is the sum of, up to which its sign is not certain


@dataclass(frozen=True)
class Quadric:
    """A (3, 3) symmetric, b (3), c; origin o; a ball (center, radius); planes n, d of n·x + d ≤ 0."""

    A: np.ndarray
    b: np.ndarray
    c: float
    origin: np.ndarray
    center: np.ndarray
    radius: float
    planes: Sequence[np.ndarray] = ()


@dataclass(frozen=True)
class Crossing:
    """Where F = 0 on a ray.

    Attributes:
        t: λ. front: whether F falls there; None where both hits are one, or none, by rounding.
        moved: by how much rounding may move it.
        within: whether it is surely within all bounds.
    """

    t: float
    front: bool | None
    moved: float
    within: bool


def exact(x) -> list:
    return [mpf(float(v)) for v in x]


def dot(u, v):
    return sum((a * b for a, b in zip(u, v, strict=True)), mpf(0))


def crossings(quadric: Quadric, origin: np.ndarray, direction: np.ndarray) -> list[Crossing]:
    """All that may be there, in order; of a ray that lies on the surface none: `lies_on` tells."""
    with mp.workprec(BITS):
        return sorted(_crossings(quadric, exact(origin), exact(direction)), key=lambda found: found.t)


class _Line:
    """α λ'² + 2 β λ' + γ of λ' from the point of the ray nearest to the ball's centre, and the sizes of their terms."""

    def __init__(self, quadric: Quadric, e, v) -> None:
        A, b, o = [exact(row) for row in quadric.A], exact(quadric.b), exact(quadric.origin)
        center = exact(quadric.center)
        self.behind = dot([x - y for x, y in zip(center, e, strict=True)], v) / dot(v, v)
        y = [p + self.behind * d - q for p, d, q in zip(e, v, o, strict=True)]
        to_center = [abs(p - q) for p, q in zip(center, o, strict=True)]
        off = [abs(p + q - r) for p, q, r in zip(y, o, center, strict=True)]
        turned = [dot(row, y) for row in A]
        self.alpha = dot(v, [dot(row, v) for row in A])
        self.beta = dot(v, [x + k for x, k in zip(turned, b, strict=True)])
        self.gamma = dot(y, [x + 2 * k for x, k in zip(turned, b, strict=True)]) + mpf(float(quadric.c))
        # sizes: of what the parts are summed from, whichever point coordinates are measured from
        absolute = [[abs(x) for x in row] for row in A]
        reach = [p + q for p, q in zip(to_center, off, strict=True)]
        speed, pull = [abs(x) for x in v], [abs(x) for x in b]
        bent = [dot(row, reach) for row in absolute]
        self.size_alpha = dot(speed, [dot(row, speed) for row in absolute])
        self.size_beta = dot(speed, [x + k for x, k in zip(bent, pull, strict=True)])
        self.size_gamma = dot(reach, [x + 2 * k for x, k in zip(bent, pull, strict=True)]) + abs(quadric.c)
        # what the place of the ray is rounded by moves β and γ
        place = ROUNDED * EPS * max(map(abs, [*e, *center, *o]))
        norm = mp.sqrt(sum(dot(row, row) for row in A))
        length, reached = mp.sqrt(dot(v, v)), mp.sqrt(dot(reach, reach)) + place
        force = norm * reached + mp.sqrt(dot(b, b))
        self.moved_alpha = ROUNDED * EPS * self.size_alpha
        self.moved_beta = ROUNDED * EPS * self.size_beta + length * norm * place
        self.moved_gamma = ROUNDED * EPS * self.size_gamma + 2 * force * place

    @property
    def radicand(self):
        return self.beta**2 - self.alpha * self.gamma

    @property
    def slack(self):
        """By how much rounding may be off, of the radicand."""
        alpha, beta, gamma = abs(self.alpha), abs(self.beta), abs(self.gamma)
        first = 2 * beta * self.moved_beta + self.moved_alpha * gamma + alpha * self.moved_gamma
        return first + self.moved_beta**2 + self.moved_alpha * self.moved_gamma

    @property
    def lies_on(self) -> bool:
        """On the surface, as far as rounding can tell."""
        parts = ((self.alpha, self.moved_alpha), (self.beta, self.moved_beta), (self.gamma, self.moved_gamma))
        return all(abs(x) <= moved for x, moved in parts)


def lies_on(quadric: Quadric, origin: np.ndarray, direction: np.ndarray) -> bool:
    """Whether the ray lies on the surface, or so nearly that rounding cannot tell."""
    with mp.workprec(BITS):
        return _Line(quadric, exact(origin), exact(direction)).lies_on


def _crossings(quadric: Quadric, e, v) -> list[Crossing]:
    line = _Line(quadric, e, v)
    if line.lies_on or line.radicand < -line.slack:
        return []
    s, touching = mp.sqrt(max(line.radicand, 0)), line.radicand <= line.slack
    if touching:  # both hits are one, or none: rounding of the radicand counts with its root
        one = -line.beta / line.alpha if line.alpha else -line.gamma / (2 * line.beta) if line.beta else None
        roots = [] if one is None else [(one, None)]
    elif not line.alpha:
        roots = [(-line.gamma / (2 * line.beta), line.beta < 0)]
    else:
        roots = [((-line.beta - s) / line.alpha, True), ((-line.beta + s) / line.alpha, False)]
    found = []
    for root, front in roots:
        off = line.moved_alpha * root**2 + 2 * line.moved_beta * abs(root) + line.moved_gamma
        moved = 2 * mp.sqrt(line.slack) / abs(line.alpha) if touching and line.alpha else off / s
        moved += ROUNDED * EPS * (abs(root) + abs(line.behind) + mpf(float(quadric.radius)) / mp.sqrt(dot(v, v)))
        kept, surely = _kept(quadric, e, v, line.behind + root, moved)
        if kept:
            found.append(Crossing(float(line.behind + root), front, float(moved), surely))
    return found


def _kept(quadric: Quadric, e, v, t, moved) -> tuple[bool, bool]:
    """Whether a point of the ray may be within all bounds, and whether it surely is."""
    x = [p + t * d for p, d in zip(e, v, strict=True)]
    length = mp.sqrt(dot(v, v))
    far = max(map(abs, [*e, *exact(quadric.center)]))
    slack = moved * length + ROUNDED * EPS * (far + quadric.radius)
    center = exact(quadric.center)
    from_center = [p - q for p, q in zip(x, center, strict=True)]
    inside = [mpf(float(quadric.radius)) - mp.sqrt(dot(from_center, from_center)), t * length]
    for plane in quadric.planes:
        n = exact(plane[:3])
        inside.append(-(dot(n, x) + mpf(float(plane[3]))) / mp.sqrt(dot(n, n)))
    return min(inside) >= -slack, min(inside) > slack


def judged(expected: Sequence[Crossing], t: Sequence[float], front: bool, touching: bool = False) -> dict[str, int]:
    """Of hits of one side that were found for a ray: how many of the expected are missed, how many are invented.

    Args:
        touching: whether those that rounding decides have to be found, as fronts.
    """
    wanted = lambda x: x.within and (front and touching if x.front is None else True)  # noqa: E731
    left = [x for x in t if np.isfinite(x)]
    missed = 0
    mine = [x for x in expected if x.front in (None, front)]
    for crossing in sorted(mine, key=lambda x: not wanted(x)):
        near = [x for x in left if abs(x - crossing.t) <= crossing.moved]
        if near:
            left.remove(min(near, key=lambda x: abs(x - crossing.t)))
        elif wanted(crossing):
            missed += 1
    return {"missed": missed, "invented": len(left)}
