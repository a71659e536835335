"""Rays that rounding decides for `tests.height_ray_oracle`, judged again with 240 bits. Nothing here imports filterlab.

Along a ray s − z is a quartic on each piece; with so many bits its values have no error that counts. A hit *must* be
where both signs have been seen, each by more than `CLOSE`; a hit *may* be where a value of at most `CLOSE` is. Between
the two lie touches, and ends within the rounding of coefficients, where either answer is right.
"""

from __future__ import annotations

from itertools import pairwise
from math import comb, inf

import mpmath
import numpy as np

from tests.height_ray_oracle import Ground
from tests.quartic_oracle import INDICES

CLOSE = 1e-12  # of heights of a few units; coefficients are rounded by 1e-15 of them
_BITS, _HALVINGS, _N = 240, 40, 4
_FACTORS = [comb(4, i) * comb(4 - i, j) for i, j, _ in INDICES]
_QUARTERS = np.array([[comb(_N, i) * x**i * (1 - x) ** (_N - i) for i in range(_N + 1)] for x in np.arange(5) / 4])
_TO_BERNSTEIN = np.rint(np.linalg.inv(_QUARTERS) * 36)  # whole numbers over 36


class Line:
    """A ray, o + t d in coordinates of the data.

    Attributes:
        must: t by which there surely is a hit; ∞: there need not be one.
    """

    def __init__(self, f: Ground, origin: np.ndarray, direction: np.ndarray) -> None:
        self.f = f
        with mpmath.workprec(_BITS):
            scale = (f.steps, f.steps, 1)
            self.o, self.d = (
                [mpmath.mpf(float(x)) / s for x, s in zip(v, scale, strict=True)] for v in (origin, direction)
            )
            self.must = self._both_signs()

    def value(self, t: float) -> float:
        """s − z there; NaN in a hole, and beyond the domain by more than rounding."""
        with mpmath.workprec(_BITS):
            t_ = mpmath.mpf(t)
            place = [o + t_ * d for o, d in zip(self.o, self.d, strict=True)]
            ends = [max(n - 1, 1) / self.f.steps for n in self.f.size]
            if any(not -1e-6 <= x <= e + 1e-6 for x, e in zip(place, ends, strict=False)):
                return float("nan")
            return float(self._on(self._triangle(place), place))

    def _both_signs(self) -> float:
        """Where the second sign is first surely seen."""
        seen: dict[int, float] = {}
        cuts = self._cuts()
        for a, b in pairwise(cuts):
            ends = [[o + t * d for o, d in zip(self.o, self.d, strict=True)] for t in (a, b)]
            triangle = self._triangle([(x + y) / 2 for x, y in zip(*ends, strict=True)])
            low, high = self.f.low[triangle], self.f.high[triangle]
            z = sorted(float(p[2]) for p in ends)
            if not low <= high:  # a hole: of what is behind it nothing is known
                seen.clear()
            elif z[0] > high + 1e-6 or z[1] < low - 1e-6:
                seen.setdefault(-1 if z[0] > high else 1, float(a))
            else:
                self._look(self._coefficients(triangle, *ends), a, b, seen)
            if len(seen) == 2:
                return max(seen.values())
        return inf

    def _coefficients(self, triangle: tuple[int, int, int], begin: list, end: list) -> list:
        points = [[x + (y - x) * k / _N for x, y in zip(begin, end, strict=True)] for k in range(_N + 1)]
        values = [self._on(triangle, p) for p in points]
        return [sum(int(w) * v for w, v in zip(row, values, strict=True)) / 36 for row in _TO_BERNSTEIN]

    def _look(self, c: list, a, b, seen: dict[int, float]) -> None:
        for sign in {1, -1} - set(seen):
            t = _first([sign * x for x in c], a, b)
            if t is not None:
                seen[sign] = float(t)

    def _cuts(self) -> list:
        near, far = mpmath.mpf(0), mpmath.mpf("1e30")
        box = [(0, max(n - 1, 1) / self.f.steps) for n in self.f.size]
        for (low, high), o, d in zip(box, self.o, self.d, strict=False):
            if d == 0:
                if not low <= o <= high:
                    return []
                continue
            first, last = sorted(((low - o) / d, (high - o) / d))
            near, far = max(near, first), min(far, last)
        if self.d[2] != 0:
            levels = float(np.nanmin(self.f.low)) - 1, float(np.nanmax(self.f.high)) + 1
            ends = sorted((z - self.o[2]) / self.d[2] for z in levels)
            near, far = max(near, ends[0]), min(far, ends[1])
        if not near <= far:
            return []
        found = {near, far}
        for u, v in ((1, 0), (0, 1), (-1 if self.f.mirrored else 1, 1)):
            o, d = u * self.o[0] + v * self.o[1], u * self.d[0] + v * self.d[1]
            if d != 0:
                ends = sorted((o + near * d, o + far * d))
                planes = range(int(mpmath.floor(ends[0])), int(mpmath.ceil(ends[1])) + 1)
                found |= {t for t in ((plane - o) / d for plane in planes) if near < t < far}
        return sorted(found)

    def _triangle(self, place: list) -> tuple[int, int, int]:
        """Row and column of the cell, 0 or 1."""
        x, y = (min(max(int(mpmath.floor(p)), 0), n - 1) for p, n in zip(place, self.f.cells, strict=False))
        s, t = place[0] - x, place[1] - y
        return y, x, 0 if ((1 - s) if self.f.mirrored else s) + t <= 1 else 1

    def _on(self, triangle: tuple[int, int, int], place: list):
        y, x, down = triangle
        s, t = place[0] - x, place[1] - y
        s = 1 - s if self.f.mirrored else s
        s, t = (1 - s, 1 - t) if down else (s, t)
        powers = [[w**n for n in range(_N + 1)] for w in (1 - s - t, s, t)]
        terms = zip(self.f.triangles[triangle], _FACTORS, INDICES, strict=True)
        total = sum(float(c) * w * powers[0][i] * powers[1][j] * powers[2][k] for c, w, (i, j, k) in terms)
        return total - place[2]


def _first(c: list, a, b, halvings: int = 0):
    """Where a polynomial on [a, b] is first surely above `CLOSE`; None: nowhere."""
    if c[0] > CLOSE:
        return a
    if max(c) <= CLOSE:
        return None
    if halvings == _HALVINGS:
        return b if c[-1] > CLOSE else None
    rows, middle = [c], (a + b) / 2
    while len(rows[-1]) > 1:
        rows.append([(x + y) / 2 for x, y in pairwise(rows[-1])])
    found = _first([row[0] for row in rows], a, middle, halvings + 1)
    return _first([row[-1] for row in rows[::-1]], middle, b, halvings + 1) if found is None else found


def verdict(f: Ground, origin: np.ndarray, direction: np.ndarray, t: float, tolerance: float) -> str:
    """Of a first hit at t, ∞ for none: "right", "missed", "later" or "invented"."""
    line = Line(f, origin, direction)
    if line.must + tolerance < t:
        return "missed" if t == inf else "later"
    if t == inf:
        return "right"
    values = [line.value(t + off) for off in (-tolerance, 0.0, tolerance)]
    known = [v for v in values if v == v]
    near = not known or min(map(abs, known)) <= CLOSE or min(known) < 0 < max(known)
    return "right" if near else "invented"
