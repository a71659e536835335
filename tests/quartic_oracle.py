"""Quartic splines over triangulated grids, once more, from published masks; NumPy in float64, nothing of filterlab.

Masks are whole numbers over a common denominator, for the four kinds of coefficients: v at a corner, u on an edge next
to it, e in the middle of an edge, z inside next to a corner. (a, b) lies a steps towards the second corner and b
towards the third one.
"""

from __future__ import annotations

import math
from itertools import permutations
from math import factorial

import numpy as np

STEPS = {"linear": 1, "c0": 4, "c1": 3, "c2": 1, "c2 prefiltered": 1}
DENOMINATORS = {"c0": 36, "c1": 48, "c2": 24}
RING = ((1, 0), (0, 1), (-1, 1), (-1, 0), (0, -1), (1, -1))

KINDS = {
    "c0": {
        "v": {(0, 0): 36},
        "u": {(0, 0): -39, (1, 0): 144, (2, 0): -108, (3, 0): 48, (4, 0): -9},
        "e": {(0, 0): 26, (1, 0): -128, (2, 0): 240, (3, 0): -128, (4, 0): 26},
        "z": {
            **{(0, 0): 26, (0, 1): -64, (0, 2): -24, (0, 3): 32, (0, 4): -9, (1, 0): -64, (1, 1): 288, (1, 2): -96},
            **{(1, 3): 16, (2, 0): -24, (2, 1): -96, (2, 2): 12, (3, 0): 32, (3, 1): 16, (4, 0): -9},
        },
    },
    "c1": {
        "v": {(0, 0): 48},
        "u": {
            **{(-3, 0): -4, (-3, 3): -2, (-2, 0): 18, (-2, 2): 9, (-1, 0): -36, (-1, 1): -18, (0, -3): -2, (0, -2): 9},
            **{(0, -1): -18, (0, 0): 48, (0, 1): 18, (0, 2): -9, (0, 3): 2, (1, -1): 18, (1, 0): 36, (2, -2): -9},
            **{(2, 0): -18, (3, -3): 2, (3, 0): 4},
        },
        "e": {
            **{(0, 0): 16, (0, 1): -18, (0, 2): -18, (0, 3): 8, (1, -1): -18, (1, 0): -36, (1, 1): 108, (1, 2): -18},
            **{(2, -2): -18, (2, -1): 108, (2, 0): -36, (2, 1): -18, (3, -3): 8, (3, -2): -18, (3, -1): -18},
            **{(3, 0): 16},
        },
        "z": {
            **{(-3, 0): -2, (-2, 0): 9, (-1, 0): -18, (0, -3): -2, (0, -2): 9, (0, -1): -18, (0, 0): 32, (0, 2): -27},
            **{(0, 3): 10, (1, 1): 108, (1, 2): -18, (2, 0): -27, (2, 1): -18, (3, 0): 10},
        },
    },
    "c2": {
        "v": {(0, 0): 12} | dict.fromkeys(RING, 2),
        "u": {(-1, 1): 1, (0, -1): 1, (0, 0): 12, (0, 1): 3, (1, -1): 3, (1, 0): 4},
        "e": {(0, 0): 8, (0, 1): 4, (1, -1): 4, (1, 0): 8},
        "z": {(-1, 1): 1, (0, 0): 10, (0, 1): 6, (1, -1): 1, (1, 0): 6},
    },
}

INDICES = tuple((i, j, 4 - i - j) for i in range(4, -1, -1) for j in range(4 - i, -1, -1))
PADS = {"mirror": "reflect", "reflect": "symmetric", "wrap": "wrap", "border": "edge", "zeros": "constant"}


def mask(spline: str, alpha: tuple[int, ...]) -> dict[tuple[int, int], float]:
    """The weights of the data for b_α."""
    m = STEPS[spline]
    corners = np.array([(0, 0), (m, 0), (0, m)])
    if spline == "linear":
        return {(int(x), int(y)): a / 4 for (x, y), a in zip(corners, alpha, strict=True) if a}
    largest, next_ = sorted(alpha, reverse=True)[:2]
    kind = {(4, 0): "v", (3, 1): "u", (2, 2): "e", (2, 1): "z"}[largest, next_]
    order = next(p for p in permutations(range(3)) if [alpha[k] for k in p] == sorted(alpha, reverse=True))
    first, second, third = corners[list(order)]
    along, across = (second - first) // m, (third - first) // m
    name = spline.split()[0]
    found: dict[tuple[int, int], float] = {}
    for (a, b), times in KINDS[name][kind].items():
        place, weight = first + a * along + b * across, times / DENOMINATORS[name]
        for (p, q), factor in prefilter(spline).items():
            key = (int(place[0]) + p, int(place[1]) + q)
            found[key] = found.get(key, 0.0) + factor * weight
    return found


def prefilter(spline: str) -> dict[tuple[int, int], float]:
    return {(0, 0): 1.5} | dict.fromkeys(RING, -1 / 12) if spline == "c2 prefiltered" else {(0, 0): 1.0}


def continued(heights: np.ndarray, boundary: str, more: int) -> np.ndarray:
    """With so many more data on every side."""
    for axis, n in enumerate(heights.shape):
        mode = "edge" if n == 1 and boundary == "mirror" else PADS[boundary]
        heights = np.pad(heights, [(more, more) if k == axis else (0, 0) for k in range(2)], mode=mode)  # type: ignore
    return heights


class Oracle:
    """s(x, y) of heights (H, W), datum (column, row) at origin + spacing · (column, row)."""

    def __init__(self, heights, spline, spacing=(1.0, 1.0), origin=(0.0, 0.0), boundary="mirror", diagonal="main"):
        self.m, self.spacing, self.origin, self.main = STEPS[spline], spacing, origin, diagonal == "main"
        self.pad = 12 * self.m + 12
        self.data = continued(np.asarray(heights, dtype=np.float64), boundary, self.pad)
        self.masks = [mask(spline, alpha) for alpha in INDICES]

    def corners(self, cell, up):
        """Of a triangle in columns and rows of data."""
        (i, j), m = cell, self.m
        if self.main:
            local = [(1, 0), (0, 0), (1, 1)] if up else [(0, 1), (1, 1), (0, 0)]
        else:
            local = [(0, 0), (1, 0), (0, 1)] if up else [(1, 1), (0, 1), (1, 0)]
        return np.array([(m * (i + a), m * (j + b)) for a, b in local])

    def read_at(self, cell, up):
        """Where the data stand that a triangle needs."""
        first, second, third = self.corners(cell, up)
        along, across = (second - first) // self.m, (third - first) // self.m
        return {tuple(first + a * along + b * across) for own in self.masks for a, b in own}

    def patch(self, cell, up):
        first, second, third = self.corners(cell, up)
        along, across = (second - first) // self.m, (third - first) // self.m
        total = np.zeros(15)
        for n, own in enumerate(self.masks):
            for (a, b), weight in own.items():
                column, row = first + a * along + b * across
                total[n] += weight * self.data[row + self.pad, column + self.pad]
        return total

    def jet(self, point):
        """z, (z_x, z_y), ((z_xx, z_xy), (z_xy, z_yy))."""
        place = (np.asarray(point) - self.origin) / (np.asarray(self.spacing) * self.m)
        cell = np.floor(place).astype(int)
        s, t = place - cell
        up = t <= s if self.main else s + t <= 1
        corners = self.corners(cell, up).astype(float) * self.spacing + self.origin
        matrix = np.linalg.inv(np.column_stack((corners, np.ones(3))).T)  # λ = matrix (x, y, 1)
        bary, rise = matrix @ (*point, 1.0), matrix[:, :2]
        coefficients = self.patch(cell, up)
        scaled = coefficients * 24 / np.array([math.prod(map(factorial, alpha)) for alpha in INDICES])
        unit, alpha = np.eye(3, dtype=int), np.array(INDICES)

        def derivative(times):
            """By λ, so many times by each: Σ scaled α!/(α − times)! λ^(α − times)."""
            left = alpha - times
            falling = np.where(times == 0, 1, np.where(times == 1, alpha, alpha * (alpha - 1)))
            return (scaled * (falling * bary ** np.maximum(left, 0)).prod(1)).sum()

        by_one = np.array([derivative(p) for p in unit])
        by_two = np.array([[derivative(p + q) for q in unit] for p in unit])
        return derivative(0 * unit[0]), rise.T @ by_one, rise.T @ by_two @ rise
