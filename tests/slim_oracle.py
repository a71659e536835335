"""SLIM hits by brute force in extended precision: every ray against every ball, formulas as published.

Imports nothing of filterlab.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np


class Sheet(NamedTuple):
    """One blended hit: t, the unit normal (3,), and which balls have a part in it."""

    t: float
    normal: np.ndarray
    balls: frozenset[int]


def sheets(cover, origin, direction, offset: float, back: bool = False) -> list[Sheet]:
    """All sheets of one ray, in order; of outsides, or insides where `back`.

    Args:
        cover: centers (M, 3), radii, A, b, c, and optionally cuts (M, K, 4), arrays or tensors.
    """
    centers, radii, A, b, c = (np.asarray(x, np.longdouble) for x in cover[:5])
    cuts = np.asarray(cover[5], np.longdouble) if len(cover) > 5 else np.zeros((len(radii), 0, 4), np.longdouble)
    o, d = (np.asarray(x, np.longdouble) for x in (origin, direction))
    hits = []
    for i in range(len(radii)):
        t = root(o - centers[i], d, A[i], b[i], c[i], back)
        if t is None or t < 0:
            continue
        y = o + t * d - centers[i]
        rho = np.sqrt(y @ y) / radii[i]
        if rho > 1 or any(n[:3] @ (y + centers[i]) + n[3] > 0 for n in cuts[i]):
            continue
        g = A[i] @ y + b[i]
        hits.append((t, radii[i], weight(rho), g / np.sqrt(g @ g), i))
    return grouped(hits, offset, np.sqrt(d @ d))


def root(p, d, A, b, c, back: bool):
    """Where F goes from + to − along p + t d, or from − to +; None: nowhere."""
    alpha, beta, gamma = d @ A @ d, d @ (A @ p + b), p @ (A @ p + 2 * b) + c
    if alpha == 0:
        falls = beta < 0
        return None if beta == 0 or falls == back else -gamma / (2 * beta)
    radicand = beta * beta - alpha * gamma
    if radicand < 0:
        return None
    return (-beta + (1 if back else -1) * np.sqrt(radicand)) / alpha


def weight(rho):
    if rho <= 0.5:
        return np.exp(-4 * rho * rho)
    return 4 / np.exp(np.longdouble(1)) * (1 - rho) ** 2


def grouped(hits, offset: float, length) -> list[Sheet]:
    found = []
    while hits:
        end = min(t + offset * r / length for t, r, *_ in hits)
        own, hits = [h for h in hits if h[0] <= end], [h for h in hits if h[0] > end]
        total = sum(h[2] for h in own)
        t = sum(h[2] * h[0] for h in own) / total
        n = sum(h[2] * h[3] for h in own)
        found.append(Sheet(float(t), np.asarray(n / np.sqrt(n @ n), float), frozenset(h[4] for h in own)))
    return sorted(found, key=lambda s: s.t)
