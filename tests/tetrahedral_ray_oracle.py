"""Where a ray crosses a level of a spline on tetrahedra, found independently: every piece sampled, every root isolated.

Nothing here imports filterlab. Planes that hold the faces of all tetrahedra cut a ray into pieces: first the planes
between cells, then, cell by cell, those through its centre. On each piece the spline is a polynomial of its degree n:
the one through n + 1 values of it. `ray_oracle` finds its critical points and, between them, its crossings, and says
which rays are undecided. Rays are measured from where they enter the domain, found in `longdouble`.
"""

from __future__ import annotations

from math import factorial, prod

import numpy as np
from numpy.polynomial import chebyshev

from tests import ray_oracle, tetrahedral_oracle
from tests.ray_oracle import Truth, cut, entered, near_level, passed
from tests.tetrahedral_oracle import SPLINES, signed_permutations

_MARGIN = 3  # cells beyond the ends of which polynomials are known
_AT_ONCE = 1 << 13  # points that are located together: what is tried for them stays in cache

_OUTER = {False: [((1, 0, 0), 0.5)], True: [((1, 0, 0), 0.5), ((1, 1, 1), 0.0)]}
"""Body-centred or not -> (n, k₀) of the planes n · x ∈ ℤ + k₀ between cells."""
_INNER = {False: [(1, 1, 0)], True: [(1, 0, 0), (1, 1, 0), (2, 1, 1), (2, 2, 1)]}
"""Body-centred or not -> n of the planes n · (x − centre) = 0. Of all these planes the images are meant too."""


def _images(normal: tuple[int, int, int]) -> np.ndarray:
    """(M, 3): a plane's normals under all signed permutations of the axes, of n and −n one."""
    return np.array(sorted({max(tuple(v), tuple(-v)) for v in (m @ normal for m in signed_permutations())}))


def outer(name: str) -> list[tuple[np.ndarray, float]]:
    return [(n, k) for normal, k in _OUTER[SPLINES[name].body_centred] for n in _images(normal)]


def inner(name: str) -> np.ndarray:
    return np.concatenate([_images(normal) for normal in _INNER[SPLINES[name].body_centred]])


class Polynomials:
    """Those of all tetrahedra around samples (D, H, W)."""

    def __init__(self, name: str, samples: np.ndarray, boundary: str, prefilter: bool = True) -> None:
        self.name, self.spline, self.size = name, SPLINES[name], np.array(samples.shape[::-1])
        self.degree, self._table = self.spline.degree, tetrahedral_oracle._table(name)
        last = self.size + _MARGIN
        box = np.array([[-_MARGIN] * 3, last + 0.0])
        continued = tetrahedral_oracle.Samples.continued(samples, boundary, prefilter, box)
        cells = np.stack(np.meshgrid(*(np.arange(-_MARGIN, n) for n in last), indexing="ij"), -1)
        values = continued.at(cells[..., None, :] + self._table.offsets)
        t, a, k = self._table.weights.shape
        self._coefficients = (values @ self._table.weights.reshape(t * a, k).T).reshape(*cells.shape[:3], t, a)
        alpha = np.array(tetrahedral_oracle.indices(self.degree))
        self._powers = alpha
        self._factors = np.array([factorial(self.degree) / prod(map(factorial, row)) for row in alpha])

    def cells(self, points: np.ndarray) -> np.ndarray:
        """The integers of the cell around each point (P, 3)."""
        parts = [self.spline.centres(p) for p in np.split(points, range(_AT_ONCE, len(points), _AT_ONCE))]
        return np.concatenate(parts)

    def on_pieces(self, cells: np.ndarray, start: np.ndarray, end: np.ndarray, x: np.ndarray) -> np.ndarray:
        """(P, M) values of the polynomials around the middle of pieces, at (1 − x) start + x end for x (M,)."""
        parts = range(_AT_ONCE, len(cells), _AT_ONCE)
        rows = zip(*(np.split(v, parts) for v in (cells, start, end)), strict=True)
        return np.concatenate([self._of_part(*row, x) for row in rows])

    def _of_part(self, cells: np.ndarray, start: np.ndarray, end: np.ndarray, x: np.ndarray) -> np.ndarray:
        at = np.stack((start, end, (start + end) / 2)) - cells - float(self.spline.shift)
        at = np.concatenate((np.ones_like(at[..., :1]), at), -1)  # (3, P, 4)
        table = self._table.to_barycentric
        every = (at[2] @ table.reshape(-1, 4).T).reshape(len(cells), len(table), 4)
        which = every.min(-1).argmax(-1)
        a, b = np.einsum("pnc,epc->epn", table[which], at[:2])
        place = (1 - x)[:, None] * a[:, None] + x[:, None] * b[:, None]  # (P, M, 4)
        i, j, k = (cells + _MARGIN).T
        return np.einsum("pa,pma->pm", self._coefficients[i, j, k, which], self._basis(place))

    def _basis(self, place: np.ndarray) -> np.ndarray:
        """(…, 4) barycentric coordinates to all Bernstein polynomials."""
        powers = [np.ones_like(place)]
        for _ in range(self.degree):
            powers.append(powers[-1] * place)
        table = np.stack(powers)  # (n + 1, …, 4)
        x, y, z, w = (table[self._powers[:, m], ..., m] for m in range(4))
        return np.moveaxis(self._factors.reshape(-1, *(1,) * (place.ndim - 1)) * x * y * z * w, 0, -1)


def crossings(f: Polynomials, origins: np.ndarray, directions: np.ndarray, level: float, close=1e-11) -> list[Truth]:
    """Those of rays (R, 3) in voxel coordinates with the level, within the domain [−½, n − ½]³ and t ≥ 0."""
    met, start, entry, length = entered(f.size, origins, directions)
    d = np.asarray(directions, dtype=np.float64)[met]
    every = np.arange(len(met))
    line, near, far, _ = cut(every, 0 * length, length, _outer_events(f, entry, d, length), length)
    cells = f.cells(entry[line] + ((near + far) / 2)[:, None] * d[line])
    line, near, far, of = cut(line, near, far, _inner_events(f, entry[line], d[line], cells), length)
    nodes = chebyshev.chebpts1(f.degree + 1)
    ends = (entry[line] + s[:, None] * d[line] for s in (near, far))
    values = f.on_pieces(cells[of], *ends, (nodes + 1) / 2) - level
    c = np.linalg.solve(chebyshev.chebvander(nodes, f.degree), values.T)
    some = near_level(c, close)
    ray, (low, high) = met[line], (start[line] + s for s in (near, far))
    return ray_oracle.of_pieces(len(origins), ray[some], low[some], high[some], c[:, some], close)


def _outer_events(f: Polynomials, o: np.ndarray, d: np.ndarray, length: np.ndarray) -> np.ndarray:
    """(L, K): where lines pass planes between cells; ∞ where there are fewer."""
    found = []
    for n, k in outer(f.name):
        speed, ends = d @ n, np.sort(np.stack((o @ n - k, (o + length[:, None] * d) @ n - k)), 0)
        first = np.ceil(ends[0])
        plane = first[:, None] + np.arange(int((ends[1] - first).max(initial=-1)) + 2)
        found.append(passed(plane - (o @ n - k)[:, None], speed[:, None]))
    return np.concatenate(found, 1)


def _inner_events(f: Polynomials, o: np.ndarray, d: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """(P, M): where they pass planes through the centres of cells."""
    n = inner(f.name).T
    return passed((cells + float(f.spline.shift) - o) @ n, d @ n)
