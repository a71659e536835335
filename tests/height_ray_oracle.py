"""Where rays cross the quartic spline of heights, found independently: every piece cut until its roots are told apart.

Nothing here imports filterlab. Planes x = i, y = j and x ± y = k (in cells) cut a ray into pieces; on each s − z is a
quartic, in Bernstein form: the one through 5 values of it. Rays are measured from where they enter the domain, found
in `longdouble`. All pieces of all rays are halved together, as often as it takes, until a part

    is clear       all coefficients lie on one side of 0, by more than `close`
    or monotone    all differences of neighbouring coefficients have one sign

A row of monotone parts that lead the same way from one side of 0 to the other, by more than `close`, is one crossing,
which bisection finds. Where rounding decides what there is, the ray is *undecided*: parts that neither holds of, rows
that begin or end nearer to 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb, factorial

import numpy as np

from tests import quartic_oracle
from tests.quartic_oracle import INDICES

NAMES = ("linear", "c0", "c1", "c2", "c2, prefiltered")
STEPS = {name: quartic_oracle.STEPS[name.replace(",", "")] for name in NAMES}
_MARGIN = 8  # data that are written out beyond the ends
_NONE = 1e-12  # pieces that are shorter, of the way in the domain, are none
_TOUCHES = 1e-9  # rays that are no longer than this in the domain, of t, are undecided
_HALVINGS = 40
_ROUNDING = 1e-14  # of heights of a few units
_N = 4

_VALUES = np.array([[comb(_N, i) * x**i * (1 - x) ** (_N - i) for i in range(_N + 1)] for x in np.arange(5) / 4])
_TO_BERNSTEIN = np.linalg.inv(_VALUES)  # from the values at 0, 1/4, …, 1
_FACTORS = [factorial(4) // (factorial(i) * factorial(j) * factorial(k)) for i, j, k in INDICES]


@dataclass(frozen=True)
class Crossings:
    """Those of rays.

    Attributes:
        t: (R, K) in order, ∞ behind the last.
        loose: (R, K) how far rounding may move them: much, where a ray leaves the ground at a slope of 1e-9.
        undecided: (R,) whether rounding decides what there is.
    """

    t: np.ndarray
    loose: np.ndarray
    undecided: np.ndarray

    @property
    def first(self) -> np.ndarray:
        return self.t[:, 0]

    @property
    def count(self) -> np.ndarray:
        return (self.t < np.inf).sum(1)

    def chosen(self, which: slice) -> Crossings:
        return Crossings(self.t[which], self.loose[which], self.undecided[which])


class Ground:
    """z = s(x, y) of heights (H, W), in coordinates of the data: column, row."""

    def __init__(self, name: str, heights: np.ndarray, boundary: str = "mirror", diagonal: str = "main") -> None:
        self.steps, self.size, self.mirrored = STEPS[name], heights.shape[::-1], diagonal == "main"
        self.cells = [max(-(-(n - 1) // self.steps), 1) for n in self.size]
        data = quartic_oracle.continued(np.asarray(heights, dtype=np.float64), boundary, _MARGIN)
        x, y = np.meshgrid(*(self.steps * np.arange(n) + _MARGIN for n in self.cells))
        masks = [quartic_oracle.mask(name.replace(",", ""), alpha) for alpha in INDICES]
        self.triangles = np.stack([self._coefficients(masks, data, x, y, up) for up in (True, False)], -2)
        self.low, self.high = self.triangles.min(-1), self.triangles.max(-1)

    def _coefficients(self, masks: list, data: np.ndarray, x: np.ndarray, y: np.ndarray, up: bool) -> np.ndarray:
        """(rows, columns, 15) of one triangle of every cell."""
        m, rows = self.steps, []
        for mask in masks:
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
        return self.on_pieces(*self.piece(place), place[:, None])[:, 0]

    def piece(self, place: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Cells (P, 2) of places (P, 2) in cells, and whether their upper triangles have them."""
        cell = np.clip(np.floor(place).astype(int), 0, np.array(self.cells) - 1)
        s, t = (place - cell).T
        return cell, ((1 - s) if self.mirrored else s) + t <= 1

    def on_pieces(self, cell: np.ndarray, up: np.ndarray, places: np.ndarray) -> np.ndarray:
        """(P, M): the polynomials of triangles at places (P, M, 2) in cells."""
        s, t = np.moveaxis(places - cell[:, None], -1, 0)
        s = 1 - s if self.mirrored else s
        s, t = (np.where(up[:, None], x, 1 - x) for x in (s, t))
        c = self.triangles[cell[:, 1], cell[:, 0], np.where(up, 0, 1)] * _FACTORS
        powers = [np.stack([x**n for n in range(_N + 1)]) for x in (1 - s - t, s, t)]
        total = np.zeros(s.shape)
        for n, (i, j, k) in enumerate(INDICES):
            total += c[:, n, None] * powers[0][i] * powers[1][j] * powers[2][k]
        return total


def crossings(f: Ground, origins: np.ndarray, directions: np.ndarray, close: float = 1e-11) -> Crossings:
    """Those of rays (R, 3), x and y in steps of the data, with z = s(x, y), over the domain and t ≥ 0."""
    o, d = (np.asarray(x, dtype=np.longdouble) / np.array([f.steps, f.steps, 1]) for x in (origins, directions))
    near, far = _domain(f, o, d)
    with np.errstate(invalid="ignore"):
        touching = np.abs(far - near) <= _TOUCHES * (1 + np.abs(near))
    line, low, high = _cut(f, o, d, near, np.where(touching, -np.inf, far))
    entry, way = (o + np.where(near < np.inf, near, 0)[:, None] * d).astype(np.float64), d.astype(np.float64)
    number, c = _pieces(f, entry[line], way[line], low, high, close)
    parts = _parted(number, c, close)
    own, s, loose, undecided = _rows(parts, line, low, high, close, len(o))
    place, count = _in_rows(own, len(o))
    t, apart = np.full((2, len(o), count), np.inf)
    t[own, place], apart[own, place] = (near[own] + s).astype(np.float64), loose
    return Crossings(t, apart, undecided | touching)


def _domain(f: Ground, o: np.ndarray, d: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """t (R,) at which rays enter the domain and leave it; near > far of those that miss it."""
    near, far = np.zeros(len(o), dtype=np.longdouble), np.full(len(o), np.inf, dtype=np.longdouble)
    box = [(0, max(n - 1, 1) / f.steps) for n in f.size]
    box.append((np.nanmin(f.low, initial=np.inf) - 1, np.nanmax(f.high, initial=-np.inf) + 1))
    for axis, (a, b) in enumerate(box):
        x, v = o[:, axis], d[:, axis]
        with np.errstate(divide="ignore", invalid="ignore"):
            first, last = (a - x) / v, (b - x) / v
        outside, still = (x < a) | (x > b), v == 0
        first, last = np.minimum(first, last), np.maximum(first, last)
        near = np.maximum(near, np.where(still, np.where(outside, np.inf, 0), first))
        far = np.where(still, far, np.minimum(far, last))
    return near, far


def _cut(f: Ground, o: np.ndarray, d: np.ndarray, near: np.ndarray, far: np.ndarray) -> tuple[np.ndarray, ...]:
    """Pieces of rays, in order: whose they are, and from where to where, from where the ray enters the domain."""
    rays = np.nonzero(near <= far)[0]
    o, d, length = o[rays] + near[rays, None] * d[rays], d[rays], far[rays] - near[rays]
    line, s = [np.arange(len(rays))] * 2, [np.zeros_like(length), length]
    for n in ((1, 0), (0, 1), (-1 if f.mirrored else 1, 1)):
        place, speed = o[:, :2] @ n, d[:, :2] @ n
        ends = np.sort([place, place + length * speed], 0)
        first = np.floor(ends[0]).astype(int)
        count = np.where(speed == 0, 0, np.ceil(ends[1]).astype(int) - first + 1)
        own = np.repeat(np.arange(len(rays)), count)
        plane = first[own] + np.arange(len(own)) - (np.cumsum(count) - count)[own]
        line.append(own)
        s.append((plane - place[own]) / speed[own])
    line, s = np.concatenate(line), np.concatenate(s)
    keep = (s >= 0) & (s <= length[line])
    line, s = line[keep], s[keep]
    order = np.lexsort((s, line))
    line, s = line[order], s[order]
    begins = np.append(True, np.diff(line) > 0)
    keep = begins | (np.diff(s, prepend=0) > _NONE * length[line])
    line, s = line[keep], s[keep].astype(np.float64)
    within = line[1:] == line[:-1]
    return rays[line[:-1][within]], s[:-1][within], s[1:][within]


def _pieces(f: Ground, entry, way, low, high, close: float) -> tuple[np.ndarray, np.ndarray]:
    """Of those that may meet the ground: their numbers, and coefficients of s − z (Q, 5)."""
    z = entry[:, 2] + np.stack((low, high)) * way[:, 2]
    middle = entry[:, :2] + ((low + high) / 2)[:, None] * way[:, :2]
    cell, up = f.piece(middle)
    triangle = cell[:, 1], cell[:, 0], np.where(up, 0, 1)
    meets = (z.min(0) <= f.high[triangle] + close) & (z.max(0) >= f.low[triangle] - close)  # not of holes
    number = np.nonzero(meets)[0]
    s = low[number, None] + (high - low)[number, None] * np.arange(_N + 1) / _N
    places = entry[number, None] + s[..., None] * way[number, None]
    values = f.on_pieces(cell[number], up[number], places[..., :2]) - places[..., 2]
    return number, values @ _TO_BERNSTEIN.T


@dataclass(frozen=True)
class _Parts:
    """Parts of pieces that are not clear of 0: [start, start + width] of [0, 1] of pieces, with coefficients (Q, 5).

    `rises` is 1 or −1 of monotone ones, else 0.
    """

    piece: np.ndarray
    start: np.ndarray
    width: np.ndarray
    c: np.ndarray
    rises: np.ndarray

    def chosen(self, which: np.ndarray) -> _Parts:
        return _Parts(self.piece[which], self.start[which], self.width[which], self.c[which], self.rises[which])


def _parted(piece: np.ndarray, c: np.ndarray, close: float) -> _Parts:
    """All parts that are left, in order."""
    start, width, done = np.zeros(len(piece)), np.ones(len(piece)), []
    for halving in range(_HALVINGS + 1):
        if halving and not len(piece):
            break
        left = ~((c > close).all(1) | (c < -close).all(1))
        piece, start, width, c = piece[left], start[left], width[left], c[left]
        steps = np.diff(c, axis=1)
        rises = (steps > 0).all(1).astype(int) - (steps < 0).all(1)
        ends = (rises != 0) | (halving == _HALVINGS)
        done.append(_Parts(piece[ends], start[ends], width[ends], c[ends], rises[ends]))
        piece, start, width, c = piece[~ends], start[~ends], width[~ends] / 2, c[~ends]
        piece, start, width = np.tile(piece, 2), np.concatenate((start, start + width)), np.tile(width, 2)
        c = np.concatenate(_halves(c))
    every = _Parts(*(np.concatenate([getattr(one, name) for one in done]) for name in _Parts.__dataclass_fields__))
    return every.chosen(np.lexsort((every.start, every.piece)))


def _halves(c: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    left, right = [c[:, 0]], [c[:, -1]]
    for _ in range(_N):
        c = (c[:, 1:] + c[:, :-1]) / 2
        left.append(c[:, 0])
        right.append(c[:, -1])
    return np.stack(left, 1), np.stack(right[::-1], 1)


def _rows(parts: _Parts, line, low, high, close: float, rays: int) -> tuple[np.ndarray, ...]:
    """Whose crossings there are, in order, where, and how loose; and rays (R,) that are undecided."""
    own, first, last = line[parts.piece], parts.c[:, 0], parts.c[:, -1]
    ends = parts.start + parts.width
    follows = parts.piece[1:] == parts.piece[:-1] + np.where(ends[:-1] == 1, 1, 0)
    follows &= (parts.start[1:] == np.where(ends[:-1] == 1, 0, ends[:-1])) & (own[1:] == own[:-1])
    joined = follows & (np.abs(last[:-1]) <= close) & (parts.rises[1:] == parts.rises[:-1])
    begin = np.nonzero(np.append(True, ~joined))[0] if len(own) else np.zeros(0, dtype=int)
    end = np.append(begin[1:], len(own))[: len(begin)] - 1
    clear = (np.abs(first[begin]) > close) & (np.abs(last[end]) > close) & (parts.rises[begin] != 0)
    undecided = np.zeros(rays, dtype=bool)
    undecided[own[begin[~clear]]] = True
    crosses = clear & (first[begin] * last[end] < 0)
    begin, sign = begin[crosses], np.sign(last[end[crosses]])
    while (on := parts.c[begin, -1] * sign <= 0).any():  # the part in which it does
        begin = begin + on
    found = parts.chosen(begin)
    within = _bisected(found.c, sign)
    length = (high - low)[found.piece]
    loose = _ROUNDING * found.width * length / np.abs(_slope(found.c, within))
    return own[begin], low[found.piece] + length * (found.start + found.width * within), loose, undecided


def _slope(c: np.ndarray, x: np.ndarray) -> np.ndarray:
    """Of polynomials (Q, 5) at x (Q,)."""
    terms = [comb(3, i) * own * x**i * (1 - x) ** (3 - i) for i, own in enumerate(np.diff(c, axis=1).T)]
    return _N * np.sum(terms, 0)


def _bisected(c: np.ndarray, sign: np.ndarray) -> np.ndarray:
    """Where polynomials (Q, 5) that end with the sign, and are monotone, get it."""
    a, b = np.zeros(len(c)), np.ones(len(c))
    c = c * [comb(_N, i) for i in range(_N + 1)] * sign[:, None]
    for _ in range(50):
        x = (a + b) / 2
        y = 1 - x
        value = (((c[:, 4] * x + c[:, 3] * y) * x + c[:, 2] * y**2) * x + c[:, 1] * y**3) * x + c[:, 0] * y**4
        a, b = np.where(value > 0, a, x), np.where(value > 0, x, b)
    return (a + b) / 2


def _in_rows(own: np.ndarray, rays: int) -> tuple[np.ndarray, int]:
    """Which crossing of its ray each is, of rays in order, and how many there are at most, 1 at least."""
    count = np.bincount(own, minlength=rays)
    return np.arange(len(own)) - (np.cumsum(count) - count)[own], max(int(count.max(initial=0)), 1)
