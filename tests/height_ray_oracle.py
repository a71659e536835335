"""Where a ray crosses the quartic spline of heights, found independently: every piece sampled, every root kept.

Nothing here imports filterlab. Masks are whole numbers over a common denominator, one for each class of coefficients;
the others follow by the symmetries of the triangle. Planes x = i, y = j and x ± y = k (in cells) cut a ray into pieces;
on each s − z is a quartic: the one through 5 values of it. `ray_oracle` finds its critical points and, between them,
its crossings, and says which rays are undecided. Rays are measured from where they enter the domain, found in
`longdouble`.

Source of the masks: High-quality rendering of quartic spline surfaces on the GPU, figures 6 to 8.
"""

from __future__ import annotations

from math import factorial

import numpy as np
from numpy.polynomial import chebyshev

from tests import ray_oracle
from tests.ray_oracle import Truth

NAMES = ("linear", "c0", "c1", "c2", "c2, prefiltered")
STEPS = {"linear": 1, "c0": 4, "c1": 3, "c2": 1, "c2, prefiltered": 1}
_DENOMINATORS = {"c0": 36, "c1": 48, "c2": 24}
_MARGIN = 8  # data that are written out beyond the ends
_NONE = 1e-12  # pieces that are shorter, of the way in the domain, are none

_TOUCHES = 1e-9  # rays that are no longer than this in the domain, of t, are undecided

_INDICES = [(4 - j - k, j, k) for k in range(5) for j in range(5 - k)]

_CLASSES: dict[str, dict[tuple[int, int, int], str]] = {
    "c0": {
        (4, 0, 0): "0 0 36",
        (3, 1, 0): "0 0 -39, 1 0 144, 2 0 -108, 3 0 48, 4 0 -9",
        (2, 2, 0): "0 0 26, 1 0 -128, 2 0 240, 3 0 -128, 4 0 26",
        (2, 1, 1): (
            "0 0 26, 0 1 -64, 0 2 -24, 0 3 32, 0 4 -9, 1 0 -64, 1 1 288, 1 2 -96, 1 3 16, 2 0 -24, 2 1 -96, 2 2 12, "
            "3 0 32, 3 1 16, 4 0 -9"
        ),
    },
    "c1": {
        (4, 0, 0): "0 0 48",
        (3, 1, 0): (
            "-3 0 -4, -3 3 -2, -2 0 18, -2 2 9, -1 0 -36, -1 1 -18, 0 -3 -2, 0 -2 9, 0 -1 -18, 0 0 48, 0 1 18, 0 2 -9, "
            "0 3 2, 1 -1 18, 1 0 36, 2 -2 -9, 2 0 -18, 3 -3 2, 3 0 4"
        ),
        (2, 2, 0): (
            "0 0 16, 0 1 -18, 0 2 -18, 0 3 8, 1 -1 -18, 1 0 -36, 1 1 108, 1 2 -18, 2 -2 -18, 2 -1 108, 2 0 -36, "
            "2 1 -18, 3 -3 8, 3 -2 -18, 3 -1 -18, 3 0 16"
        ),
        (2, 1, 1): (
            "-3 0 -2, -2 0 9, -1 0 -18, 0 -3 -2, 0 -2 9, 0 -1 -18, 0 0 32, 0 2 -27, 0 3 10, 1 1 108, 1 2 -18, 2 0 -27, "
            "2 1 -18, 3 0 10"
        ),
    },
    "c2": {
        (4, 0, 0): "-1 0 2, -1 1 2, 0 -1 2, 0 0 12, 0 1 2, 1 -1 2, 1 0 2",
        (3, 1, 0): "-1 1 1, 0 -1 1, 0 0 12, 0 1 3, 1 -1 3, 1 0 4",
        (2, 2, 0): "0 0 8, 0 1 4, 1 -1 4, 1 0 8",
        (2, 1, 1): "-1 1 1, 0 0 10, 0 1 6, 1 -1 1, 1 0 6",
    },
}


def masks(name: str) -> list[dict[tuple[int, int], float]]:
    """Of `_INDICES` in turn, weights of the data at V0 + a (V1 − V0)/m + b (V2 − V0)/m."""
    name = name.removesuffix(", prefiltered")
    if name == "linear":
        return [{(0, 0): i / 4, (1, 0): j / 4, (0, 1): k / 4} for i, j, k in _INDICES]
    m, found = STEPS[name], []
    corners = np.array([(0, 0), (m, 0), (0, m)])
    for index in _INDICES:
        order = sorted(range(3), key=lambda n: -index[n])
        origin, first, second = corners[order]
        own = {}
        for entry in _CLASSES[name][tuple(sorted(index, reverse=True))].split(", "):
            a, b, weight = map(int, entry.split())
            place = origin + (a * (first - origin) + b * (second - origin)) // m
            own[tuple(place.tolist())] = weight / _DENOMINATORS[name]
        found.append(own)
    return found


def continued(heights: np.ndarray, boundary: str) -> np.ndarray:
    """With `_MARGIN` and a cell more data on every side."""
    for axis in range(2):
        n = heights.shape[axis]
        place, period = np.arange(-_MARGIN, n + _MARGIN), max(2 * (n - 1), 1)
        index = {
            "mirror": np.minimum(place % period, period - place % period) if n > 1 else 0 * place,
            "reflect": np.minimum(place % (2 * n), 2 * n - 1 - place % (2 * n)),
            "wrap": place % n,
            "border": np.clip(place, 0, n - 1),
            "zeros": np.clip(place, 0, n - 1),
        }[boundary]
        heights = np.take(heights, index, axis)
        if boundary == "zeros":
            shape = [1, 1]
            shape[axis] = -1
            heights = np.where(((place >= 0) & (place < n)).reshape(shape), heights, 0.0)
    return heights


class Ground:
    """z = s(x, y) of heights (H, W), in coordinates of the data: column, row."""

    def __init__(self, name: str, heights: np.ndarray, boundary: str = "mirror", diagonal: str = "main") -> None:
        self.steps, self.size, self.mirrored = STEPS[name], heights.shape[::-1], diagonal == "main"
        data = continued(np.asarray(heights, dtype=np.float64), boundary)
        if name == "c2, prefiltered":
            data = _prefiltered(data, self.mirrored)
        self.cells = [max(-(-(n - 1) // self.steps), 1) for n in self.size]
        x, y = np.meshgrid(*(self.steps * np.arange(n) + _MARGIN for n in self.cells))
        self.triangles = np.stack([self._coefficients(name, data, x, y, up) for up in (True, False)], -2)

    def _coefficients(self, name: str, data: np.ndarray, x: np.ndarray, y: np.ndarray, up: bool) -> np.ndarray:
        """(rows, columns, 15) of one triangle of every cell."""
        m, rows = self.steps, []
        for mask in masks(name):
            total = np.zeros(x.shape)
            for (a, b), weight in mask.items():
                s, t = (a, b) if up else (m - a, m - b)
                s = m - s if self.mirrored else s
                total = total + weight * data[y + t, x + s]
            rows.append(total)
        return np.stack(rows, -1)

    def at(self, points: np.ndarray) -> np.ndarray:
        """s at points (P, 2)."""
        place = np.asarray(points) / self.steps
        cell = np.clip(np.floor(place).astype(int), 0, np.array(self.cells) - 1)
        return self.on_pieces(cell, self.is_up(place, cell), place[:, None])[:, 0]

    def is_up(self, place: np.ndarray, cell: np.ndarray) -> np.ndarray:
        s, t = (place - cell).T
        return ((1 - s) if self.mirrored else s) + t <= 1

    def on_pieces(self, cell: np.ndarray, up: np.ndarray, places: np.ndarray) -> np.ndarray:
        """(P, M): the polynomials of triangles at places (P, M, 2) in cells."""
        s, t = np.moveaxis(places - cell[:, None], -1, 0)
        s = 1 - s if self.mirrored else s
        s, t = (np.where(up[:, None], x, 1 - x) for x in (s, t))
        c = self.triangles[cell[:, 1], cell[:, 0], np.where(up, 0, 1)]
        total = np.zeros(s.shape)
        for n, (i, j, k) in enumerate(_INDICES):
            factor = factorial(4) // (factorial(i) * factorial(j) * factorial(k))
            total = total + factor * c[:, n, None] * (1 - s - t) ** i * s**j * t**k
        return total


def _prefiltered(data: np.ndarray, mirrored: bool) -> np.ndarray:
    """3/2 f − 1/12 Σ of the six neighbours, those along the diagonal included."""
    side = -1 if mirrored else 1  # V1 − V0 along columns is −1 there
    around = [(side * a, b) for a, b in ((1, 0), (0, 1), (-1, 1), (-1, 0), (0, -1), (1, -1))]
    return 1.5 * data - sum(np.roll(data, (-b, -a), (0, 1)) for a, b in around) / 12


def crossings(f: Ground, origins: np.ndarray, directions: np.ndarray, close: float = 1e-11) -> list[Truth]:
    """Those of rays (R, 3), x and y in steps of the data, with z = s(x, y), over the domain and t ≥ 0."""
    o, d = (np.asarray(x, dtype=np.longdouble) / np.array([f.steps, f.steps, 1]) for x in (origins, directions))
    line, start, low, high, own = [], [], [], [], []
    touching = np.zeros(len(o), dtype=bool)
    for ray in range(len(o)):
        ends = _ends(f, o[ray], d[ray])
        touching[ray] = ends is not None and len(ends[1]) == 1
        if ends is not None and not touching[ray]:
            t0, cuts = ends
            line += [ray] * (len(cuts) - 1)
            start += [t0] * (len(cuts) - 1)
            low.append(cuts[:-1])
            high.append(cuts[1:])
            own.append(o[ray] + t0 * d[ray])
    if not line:
        return [Truth(np.zeros(0), 0.0 if own else np.inf) for own in touching]
    line, low, high = np.array(line), np.concatenate(low), np.concatenate(high)
    entry = np.repeat(np.array(own), np.unique(line, return_counts=True)[1], 0).astype(np.float64)
    nodes = chebyshev.chebpts1(5)
    s = low[:, None] + (high - low)[:, None] * (nodes + 1) / 2
    way = d[line].astype(np.float64)
    points = entry[:, None] + s[..., None] * way[:, None]
    middle = points[:, 2, :2]
    cell = np.clip(np.floor(middle).astype(int), 0, np.array(f.cells) - 1)
    values = f.on_pieces(cell, f.is_up(middle, cell), points[..., :2]) - points[..., 2]
    c = np.linalg.solve(chebyshev.chebvander(nodes, 4), values.T)
    start = np.array(start)
    found = _of_pieces(len(o), line, start + low, start + high, c, close)
    return [Truth(one.t, 0.0) if own else one for own, one in zip(touching, found, strict=True)]


def _of_pieces(rays: int, line, low, high, c, close: float) -> list[Truth]:
    """Pieces over holes are none: what is before and behind them is searched as if it were of two rays."""
    known = np.isfinite(c).all(0)
    begins = np.append(True, (line[1:] != line[:-1]) | ~known[:-1])
    part = np.cumsum(begins) - 1
    some = known & (np.abs(c[0]) <= np.abs(c[1:]).sum(0) + close)
    found = ray_oracle.of_pieces(part[-1] + 1, part[some], low[some], high[some], c[:, some], close)
    every: list[list[Truth]] = [[] for _ in range(rays)]
    for own, truth in zip(line[begins], found, strict=True):
        every[own].append(truth)
    return [
        Truth(np.concatenate([np.zeros(0), *(p.t for p in own)]), min((p.undecided for p in own), default=np.inf))
        for own in every
    ]


def _ends(f: Ground, o: np.ndarray, d: np.ndarray) -> tuple[np.longdouble, np.ndarray] | None:
    """t at which a ray enters the domain, and from there on where it is cut; one cut: it hardly touches it."""
    near, far = np.longdouble(0), np.longdouble(np.inf)
    low, high = np.nanmin(f.triangles, initial=np.inf) - 1, np.nanmax(f.triangles, initial=-np.inf) + 1
    for x, v, a, b in zip(o, d, (0, 0, low), (*(max(n - 1, 1) / f.steps for n in f.size), high), strict=True):
        if v == 0:
            if not a <= x <= b:
                return None
            continue
        first, last = sorted(((a - x) / v, (b - x) / v))
        near, far = max(near, first), min(far, last)
    if abs(far - near) <= _TOUCHES * (1 + abs(near)):
        return near, np.zeros(1)
    if near > far:
        return None
    o, length = o + near * d, far - near
    sign = -1 if f.mirrored else 1
    found = [np.zeros(0, dtype=np.longdouble)]
    for n in ((1, 0), (0, 1), (sign, 1)):
        place, speed = n @ o[:2], n @ d[:2]
        if speed != 0:
            ends = sorted((place, place + length * speed))
            found.append((np.arange(np.floor(ends[0]), np.ceil(ends[1]) + 1) - place) / speed)
    cuts = np.sort(np.concatenate(found))
    cuts = np.concatenate(([0], cuts[(cuts > 0) & (cuts < length)], [length]))
    keep = np.append(True, np.diff(cuts) > _NONE * length)
    return near, cuts[keep].astype(np.float64)
