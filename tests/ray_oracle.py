"""Where a ray crosses a level, found independently: the direct kernel sum, cut into monotone stretches.

Nothing here imports filterlab. Between two planes of knots f(o + t d) is a polynomial of degree n; it is the one
through n + 1 values of the sum over taps, written out from the kernels' textbook formulas. Its critical points are
eigenvalues of the colleague matrix of its derivative; between neighbours of all ends and critical points it is
monotone, so that every change of sign is one crossing, which bisection finds. Rays are measured from where they enter
the domain, found in `longdouble`, so that far origins round nothing.

Where f comes closer to the level than `close` without a clear crossing (at a critical point, or an end of the domain),
rounding decides what there is to hit: such rays are *undecided*.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.polynomial import chebyshev

from tests import oracles

DEGREES = {"trilinear": 3, "ncrsi": 5, "triquadratic": 6, "notch": 6, "catmull-rom": 9, "mitchell": 9, "tricubic": 9}
_NONE = 1e-12  # pieces that are shorter, of the way in the domain, are none
_MARGIN = 6  # coefficients that are written out beyond the ends: the domain reaches ½ beyond, kernels 2


@dataclass(frozen=True)
class Truth:
    """Crossings of one ray.

    Attributes:
        t: in order.
        undecided: how close f comes to the level without crossing it, where that is too close; else ∞.
    """

    t: np.ndarray
    undecided: float


class Sum:
    """f(x) = Σ weight Σ_k c_k φ_x(x − k) φ_y(y − k) φ_z(z − k) from samples (D, H, W), at voxel coordinates (P, 3)."""

    def __init__(self, method: str, samples: np.ndarray, boundary: str) -> None:
        recipe = oracles.RECIPES["catmull-rom" if method == "ncrsi" else method]
        self.size, self.degree = samples.shape[::-1], DEGREES[method]
        c = np.asarray(samples, dtype=np.float64)
        for axis, n in enumerate(c.shape):
            index = np.arange(-_MARGIN, n + _MARGIN)
            matrix = oracles.coefficient_matrix(recipe.deconvolve, boundary, n, index)
            c = np.moveaxis(np.tensordot(matrix, c, (1, axis)), 0, axis)
        self.coefficients = c
        self.terms = [(1.0, (recipe.kernel,) * 3)]
        if method == "ncrsi":
            one = ("catmull-rom", "linear", "linear")
            self.terms = [(1.0, one[-d:] + one[:-d]) for d in range(3)] + [(-2.0, ("linear",) * 3)]
        reach = oracles.radius(oracles.PIECES[recipe.kernel])
        self.knots = 0.0 if reach == int(reach) else 0.5  # of the planes between polynomials, modulo 1
        self.taps = np.arange(int(np.ceil(2 * reach)))

    def __call__(self, points: np.ndarray) -> np.ndarray:
        first = np.floor(points - len(self.taps) / 2).astype(int) + 1
        weights = {}
        for name in {k for _, ks in self.terms for k in ks}:
            for axis in range(3):
                x = points[:, axis, None] - first[:, axis, None] - self.taps
                weights[name, axis] = oracles.kernel(name, x.astype(np.float64))
        total = np.zeros(len(points))
        x, y, z = (first + _MARGIN).T
        for i, j, k in product(self.taps, repeat=3):
            c = self.coefficients[z + k, y + j, x + i]
            for weight, (a, b, d) in self.terms:
                total += weight * c * weights[a, 0][:, i] * weights[b, 1][:, j] * weights[d, 2][:, k]
        return total


def crossings(f: Sum, origins: np.ndarray, directions: np.ndarray, level: float, close: float = 1e-11) -> list[Truth]:
    """Those of rays (R, 3) in voxel coordinates with the level, within the domain [−½, n − ½]³ and t ≥ 0."""
    met, start, entry, length = entered(np.array(f.size), origins, directions)
    d = np.asarray(directions, dtype=np.float64)[met]
    every = np.arange(len(met))
    planes = [passed(np.arange(-1, n + 1) + f.knots - entry[:, a, None], d[:, a, None]) for a, n in enumerate(f.size)]
    line, near, far, _ = cut(every, 0 * length, length, np.concatenate(planes, 1), length)
    nodes = chebyshev.chebpts1(f.degree + 1)
    t = near[:, None] + (far - near)[:, None] * (nodes + 1) / 2
    values = f((entry[line, None] + t[..., None] * d[line, None]).reshape(-1, 3)).reshape(t.shape) - level
    c = np.linalg.solve(chebyshev.chebvander(nodes, f.degree), values.T)  # (n + 1, P)
    some = near_level(c, close)
    ray, (low, high) = met[line], (start[line] + s for s in (near, far))
    return of_pieces(len(origins), ray[some], low[some], high[some], c[:, some], close)


def near_level(c: np.ndarray, close: float) -> np.ndarray:
    """(P,) of polynomials (n + 1, P) those that may come near 0."""
    return np.abs(c[0]) <= np.abs(c[1:]).sum(0) + close


# ---- rays in pieces


def entered(size: np.ndarray, origins: np.ndarray, directions: np.ndarray) -> tuple[np.ndarray, ...]:
    """Which rays meet the domain; of these t and place of entry, and how far they go from there, in units of d."""
    o, d = (np.asarray(x, dtype=np.longdouble) for x in (origins, directions))
    low, high = np.full(3, -0.5), size - 0.5
    still = d == 0
    with np.errstate(divide="ignore", invalid="ignore"):
        ends = np.sort(np.stack([(low - o) / d, (high - o) / d]), 0)
    ends[:, still] = np.array([[-np.inf], [np.inf]])
    near, far = np.maximum(ends[0].max(-1), 0), ends[1].min(-1)
    within = (((o >= low) & (o <= high)) | ~still).all(-1)
    met = np.nonzero((near < far) & within)[0]
    entry = np.clip((o + near[:, None] * d)[met], low, high)
    return met, near[met], entry.astype(np.float64), (far - near)[met].astype(np.float64)


def passed(distance: np.ndarray, speed: np.ndarray) -> np.ndarray:
    """Where planes are passed that are so far away; ∞ where never."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(speed == 0, np.inf, distance / speed)


def cut(line, near, far, events, length) -> tuple[np.ndarray, ...]:
    """Pieces (P) of lines, cut at the events (P, K) within them: lines, near, far, and which pieces they were of."""
    at = np.sort(np.clip(events, near[:, None], far[:, None]), 1)
    at[np.diff(at, axis=1, prepend=near[:, None]) <= _NONE * length[line, None]] = np.nan  # cut there already
    at[(far[:, None] - at) <= _NONE * length[line, None]] = np.nan
    of, k = np.nonzero(~np.isnan(at))
    every = np.concatenate((np.arange(len(line)), of))
    start = np.concatenate((near, at[of, k]))
    order = np.lexsort((start, every))
    every, start = every[order], start[order]
    last = np.append(every[1:] != every[:-1], True)[: len(every)]
    end = np.where(last, far[every], np.append(start[1:], 0)[: len(every)])
    return line[every], start, end, every


# ---- polynomials


def of_pieces(rays: int, ray, low, high, c, close: float) -> list[Truth]:
    """Zeros of polynomials with Chebyshev coefficients (n + 1, P) on [low, high] (P), in the order of their rays."""
    stops = np.sort(np.concatenate((-np.ones((len(ray), 1)), _critical(c), np.ones((len(ray), 1))), 1), 1)
    return _between(rays, ray, low, high, c, stops, close)


def _critical(c: np.ndarray) -> np.ndarray:
    """(P, n − 1): real parts of the zeros of the derivatives, cut off at the ends."""
    p = chebyshev.chebder(c)
    m = len(p) - 1
    scale = np.abs(p).max(0)
    leading = np.where(np.abs(p[-1]) > 1e-13 * scale, p[-1], 1e-13 * scale + 1e-300)
    matrix = np.zeros((p.shape[1], m, m))
    for k in range(m - 1):
        matrix[:, k, k + 1] = matrix[:, k + 1, k] = 0.5
    if m > 1:
        matrix[:, 0, 1] = 1.0  # x T_0 = T_1, x T_k = (T_(k−1) + T_(k+1)) / 2
        matrix[:, m - 1] -= (p[:-1] / leading / 2).T
    else:
        matrix[:, 0, 0] = -p[0] / leading
    return _polished(p, np.clip(np.nan_to_num(np.linalg.eigvals(matrix).real), -1, 1))


def _polished(p: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Zeros x (P, m) of polynomials (m + 1, P), nearer: where a leading coefficient is rounding they are 1e-3 off."""
    slope = chebyshev.chebder(p)
    for _ in range(4):
        with np.errstate(divide="ignore", invalid="ignore"):
            step = np.nan_to_num(_value(p, x) / _value(slope, x), nan=0.0, posinf=0.0, neginf=0.0)
        nearer = np.clip(x - step, -1, 1)
        x = np.where(np.abs(_value(p, nearer)) < np.abs(_value(p, x)), nearer, x)
    return x


def _value(c: np.ndarray, x: np.ndarray) -> np.ndarray:
    """(P, K) of polynomials (n + 1, P) at x (P, K)."""
    return chebyshev.chebval(x.T, c[:, None] if c.ndim > 1 else c, tensor=False).T


def _between(rays: int, ray, low, high, c, stops, close: float) -> list[Truth]:
    """Crossings between stops (P, K) of pieces (P) in the order of rays, on each of which f is monotone."""
    own = np.repeat(ray, stops.shape[1])
    piece, x, v = np.repeat(np.arange(len(ray)), stops.shape[1]), stops.ravel(), _value(c, stops).ravel()
    turns = np.abs(v) < close  # too close to tell: fine at ends of pieces where f clearly passes through
    through = _nearest(~turns, own, v) * _nearest(~turns[::-1], own[::-1], v[::-1])[::-1] < 0
    undecided = np.full(rays, np.inf)
    doubt = turns & ((np.abs(x) < 1) | ~through)
    np.minimum.at(undecided, own[doubt], np.abs(v[doubt]))
    keep = ~turns & np.isinf(undecided[own])
    own, piece, x, v = own[keep], piece[keep], x[keep], v[keep]
    start = np.nonzero((v[:-1] * v[1:] < 0) & (own[:-1] == own[1:]))[0]
    end = start + 1
    t = _bisected(c, low, high, (piece[start], x[start]), (piece[end], x[end]), v[start])
    found = np.split(t, np.searchsorted(own[start], np.arange(1, rays)))[:rays]  # of no ray no part
    return [Truth(*one) for one in zip(found, undecided.tolist(), strict=True)]


def _nearest(clear: np.ndarray, own: np.ndarray, v: np.ndarray) -> np.ndarray:
    """At every stop the value of the last clear one up to it, of the same ray; 0 where there is none."""
    last = np.maximum.accumulate(np.where(clear, np.arange(len(v)), -1))
    return np.where((last >= 0) & (own[last] == own), v[last], 0)


def _bisected(c, low, high, start: tuple[np.ndarray, ...], end: tuple[np.ndarray, ...], sign: np.ndarray) -> np.ndarray:
    """t between two places, (piece, x) each, where the polynomials change from the sign at the first."""
    (p, a), (q, b) = start, end
    while (apart := p < q).any():  # the pieces between, some of no length
        here = apart & (c[:, p].sum(0) * sign <= 0)
        b, q = np.where(here, 1.0, b), np.where(here, p, q)
        a, p = np.where(apart & ~here, -1.0, a), p + (apart & ~here)
    c = c[:, p]
    for _ in range(60):
        middle = (a + b) / 2
        beyond = chebyshev.chebval(middle, c, tensor=False) * sign > 0
        a, b = np.where(beyond, middle, a), np.where(beyond, b, middle)
    return (low[p] + (high[p] - low[p]) * (a + 1).astype(np.longdouble) / 2).astype(np.float64)


def judged(truth: Sequence[Truth], t: np.ndarray, tolerance: float | np.ndarray) -> dict[str, int]:
    """Of hits t (R, k), ∞ where none: how many are missed, invented, out of place; and rays that are undecided.

    Of fewer than all hits, k in all, the first ones count. The tolerance is one, or one for every ray.
    """
    count = {"rays": len(truth), "hits": 0, "undecided": 0, "missed": 0, "invented": 0, "misplaced": 0}
    for one, hits, allowed in zip(truth, t, np.broadcast_to(tolerance, len(truth)), strict=True):
        if one.undecided < np.inf:
            count["undecided"] += 1
            continue
        hits = hits[np.isfinite(hits)]
        expected = one.t[: t.shape[1]]
        count["hits"] += len(expected)
        count["missed"] += max(len(expected) - len(hits), 0)
        count["invented"] += max(len(hits) - len(expected), 0)
        if len(hits) == len(expected):
            count["misplaced"] += int((np.abs(hits - expected) > allowed).sum())
    return count
