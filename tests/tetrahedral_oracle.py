"""Splines on tetrahedra, found independently: masks as exact rationals, tetrahedra found by trying them all.

Nothing here imports filterlab. A spline is one polynomial per tetrahedron, s = Σ_α b_α |α|!/α! λ^α with λ the
barycentric coordinates and b_α a weighted sum (a mask) of samples around the cell that the tetrahedron lies in. One
tetrahedron of each kind is written down; the others are its images under the 48 signed permutations of the axes. Cells
are the Voronoi cells of their centres:

    qss, cubic-c1   cubes about the samples: type-6 partition, 24 tetrahedra each (Kalbe & Zeilfelder 2008)
    quadratic-c1    truncated octahedra about (i, j, k) + ½ with i, j, k all even or all odd, 144 tetrahedra each

Letters: samples f are `(D, H, W)`; points are `(P, 3)` in x, y, z order, in voxels. Samples are continued by the
boundary over ALL integers, and the spline runs over all of space: nothing is folded.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache
from itertools import permutations, product
from math import factorial, prod

import numpy as np

from tests import oracles

Vector = tuple[Fraction, Fraction, Fraction]
Index = tuple[int, int, int, int]
Mask = dict[Vector, Fraction]  # weight of the sample at a place relative to the centre of the cell

HALF = Fraction(1, 2)

# ---- the canonical tetrahedra: rows b_α, α descending lexicographically, in units of 1/128 or 1/192


def _rows(text: str) -> list[list[int]]:
    return [[int(word) for word in line.split()] for line in text.strip().splitlines()]


# all offsets of {−1, 0, 1}³, z fastest; vertices: the centre, that of the face x = ½, the ends of its edge y = ½
_TYPE6_OFFSETS = list(product((-1, 0, 1), repeat=3))
_TYPE6_VERTICES = "0 0 0, 1/2 0 0, 1/2 1/2 -1/2, 1/2 1/2 1/2"
_QSS = _rows("""
-1 2 -1 2 12 2 -1 2 -1 2 12 2 12 40 12 2 12 2 -1 2 -1 2 12 2 -1 2 -1
0 0 0 0 0 0 0 0 0 2 12 2 12 40 12 2 12 2 -2 4 -2 4 24 4 -2 4 -2
0 0 0 0 0 0 0 0 0 0 0 0 24 40 0 8 24 0 0 0 0 8 24 0 -8 8 0
0 0 0 0 0 0 0 0 0 0 0 0 0 40 24 0 24 8 0 0 0 0 24 8 0 8 -8
0 0 0 0 0 0 0 0 0 0 8 0 8 32 8 0 8 0 0 8 0 8 32 8 0 8 0
0 0 0 0 0 0 0 0 0 0 0 0 16 32 0 0 16 0 0 0 0 16 32 0 0 16 0
0 0 0 0 0 0 0 0 0 0 0 0 0 32 16 0 16 0 0 0 0 0 32 16 0 16 0
0 0 0 0 0 0 0 0 0 0 0 0 16 16 0 16 16 0 0 0 0 16 16 0 16 16 0
0 0 0 0 0 0 0 0 0 0 0 0 0 32 0 0 32 0 0 0 0 0 32 0 0 32 0
0 0 0 0 0 0 0 0 0 0 0 0 0 16 16 0 16 16 0 0 0 0 16 16 0 16 16
""")
_CUBIC = _rows("""
0 2 0 2 16 2 0 2 0 2 16 2 16 72 16 2 16 2 0 2 0 2 16 2 0 2 0
0 1 0 1 4 1 0 1 0 2 16 2 16 72 16 2 16 2 0 3 0 3 28 3 0 3 0
0 0 0 2 4 0 0 2 0 2 4 0 28 72 4 4 28 2 0 2 0 4 28 2 0 4 0
0 0 0 0 4 2 0 2 0 0 4 2 4 72 28 2 28 4 0 2 0 2 28 4 0 4 0
0 0 0 0 0 0 0 0 0 2 14 2 14 64 14 2 14 2 0 6 0 6 40 6 0 6 0
0 0 0 0 0 0 0 0 0 2 4 0 24 64 4 4 24 2 0 2 0 10 40 2 0 10 0
0 0 0 0 0 0 0 0 0 0 4 2 4 64 24 2 24 4 0 2 0 2 40 10 0 10 0
0 0 0 0 0 0 0 0 0 0 0 0 32 48 0 16 32 0 0 0 0 16 32 0 0 16 0
0 0 0 0 0 0 0 0 0 0 0 0 8 64 8 4 40 4 0 0 0 4 40 4 0 16 0
0 0 0 0 0 0 0 0 0 0 0 0 0 48 32 0 32 16 0 0 0 0 32 16 0 16 0
0 0 0 0 0 0 0 0 0 1 10 1 10 52 10 1 10 1 1 10 1 10 52 10 1 10 1
0 0 0 0 0 0 0 0 0 1 3 0 17 52 3 2 17 1 1 3 0 17 52 3 2 17 1
0 0 0 0 0 0 0 0 0 0 3 1 3 52 17 1 17 2 0 3 1 3 52 17 1 17 2
0 0 0 0 0 0 0 0 0 0 0 0 24 40 0 8 24 0 0 0 0 24 40 0 8 24 0
0 0 0 0 0 0 0 0 0 0 0 0 6 52 6 2 28 2 0 0 0 6 52 6 2 28 2
0 0 0 0 0 0 0 0 0 0 0 0 0 40 24 0 24 8 0 0 0 0 40 24 0 24 8
0 0 0 0 0 0 0 0 0 0 0 0 24 24 0 24 24 0 0 0 0 24 24 0 24 24 0
0 0 0 0 0 0 0 0 0 0 0 0 8 40 0 8 40 0 0 0 0 8 40 0 8 40 0
0 0 0 0 0 0 0 0 0 0 0 0 0 40 8 0 40 8 0 0 0 0 40 8 0 40 8
0 0 0 0 0 0 0 0 0 0 0 0 0 24 24 0 24 24 0 0 0 0 24 24 0 24 24
""")

# offsets relative to the cube (i, j, k), whose centre is that of the octahedron; rows S, HS, HH of the three kinds
_OCTAHEDRAL_OFFSETS = _rows(
    """
0 0 0,0 0 1,0 1 0,0 1 1,1 0 0,1 0 1,1 1 -1,1 1 0,1 1 1,1 1 2,1 2 -1,1 2 0,1 2 1,1 2 2
2 0 0,2 0 1,2 1 -1,2 1 0,2 1 1,2 1 2,2 2 -1,2 2 0,2 2 1,2 2 2,3 0 0,3 0 1,3 1 0,3 1 1
""".replace(",", "\n")
)
_OCTAHEDRAL_VERTICES = {
    "S": "0 0 0, 1 0 0, 1 1/4 1/4, 1 1/2 0",
    "HS": "0 0 0, 1/2 1/2 1/2, 1 1/4 1/4, 1 1/2 0",
    "HH": "0 0 0, 1/2 1/2 1/2, 3/4 3/4 0, 1 1/2 0",
}
_OCTAHEDRAL = {
    "S": _rows("""
16 16 16 16 16 16 0 16 16 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0
0 0 0 0 32 32 0 32 32 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0
-8 0 0 8 24 32 0 32 40 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0
-8 -8 8 8 24 24 0 40 40 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0
0 0 0 0 16 16 0 16 16 0 0 0 0 0 16 16 0 16 16 0 0 0 0 0 0 0 0 0
-4 0 0 4 12 16 0 16 20 0 0 0 0 0 12 16 0 16 20 0 0 0 0 0 -4 0 0 4
-4 -4 4 4 12 12 0 20 20 0 0 0 0 0 12 12 0 20 20 0 0 0 0 0 -4 -4 4 4
-3 0 0 3 9 12 0 12 25 4 0 0 4 -2 9 12 0 12 25 4 0 0 4 -2 -3 0 0 3
-3 -3 3 3 9 9 0 15 25 2 0 0 6 -2 9 9 0 15 25 2 0 0 6 -2 -3 -3 3 3
-2 -2 2 2 6 6 2 20 20 2 -2 6 6 -2 6 6 2 20 20 2 -2 6 6 -2 -2 -2 2 2
"""),
    "HS": _rows("""
16 16 16 16 16 16 0 16 16 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0
-8 8 8 24 8 24 0 24 40 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0
-8 0 0 8 24 32 0 32 40 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0
-8 -8 8 8 24 24 0 40 40 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0
-4 4 4 12 4 12 0 12 40 12 0 0 12 4 0 0 0 0 12 4 0 0 4 -4 0 0 0 0
-4 0 0 4 12 16 0 16 40 8 0 0 8 -4 0 0 0 0 20 8 0 0 8 -4 0 0 0 0
-4 -4 4 4 12 12 0 20 40 4 0 0 12 -4 0 0 0 0 20 4 0 0 12 -4 0 0 0 0
-3 0 0 3 9 12 0 12 25 4 0 0 4 -2 9 12 0 12 25 4 0 0 4 -2 -3 0 0 3
-3 -3 3 3 9 9 0 15 25 2 0 0 6 -2 9 9 0 15 25 2 0 0 6 -2 -3 -3 3 3
-2 -2 2 2 6 6 2 20 20 2 -2 6 6 -2 6 6 2 20 20 2 -2 6 6 -2 -2 -2 2 2
"""),
    "HH": _rows("""
16 16 16 16 16 16 0 16 16 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0
-8 8 8 24 8 24 0 24 40 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0
-8 -8 16 16 16 16 0 40 40 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0
-8 -8 8 8 24 24 0 40 40 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0 0
-4 4 4 12 4 12 0 12 40 12 0 0 12 4 0 0 0 0 12 4 0 0 4 -4 0 0 0 0
-4 -4 8 8 8 8 0 20 40 4 0 0 16 0 0 0 0 0 16 0 0 0 12 -4 0 0 0 0
-4 -4 4 4 12 12 0 20 40 4 0 0 12 -4 0 0 0 0 20 4 0 0 12 -4 0 0 0 0
-2 -2 4 4 4 4 3 25 25 3 0 12 12 0 0 0 0 12 12 0 -3 9 9 -3 0 0 0 0
-2 -2 2 2 6 6 3 25 25 3 -3 9 9 -3 0 0 3 15 15 3 -3 9 9 -3 0 0 0 0
-2 -2 2 2 6 6 2 20 20 2 -2 6 6 -2 6 6 2 20 20 2 -2 6 6 -2 -2 -2 2 2
"""),
}


# ---- partitions


@dataclass(frozen=True)
class Tetrahedron:
    """One polynomial of a spline.

    Attributes:
        kind: which canonical tetrahedron it is an image of.
        vertices: relative to the centre of its cell.
        masks: of every b_α.
    """

    kind: str
    vertices: tuple[Vector, ...]
    masks: dict[Index, Mask]

    def image(self, matrix: np.ndarray) -> Tetrahedron:
        """Itself under a signed permutation of the axes."""
        to = {at: _turned(matrix, at) for at in {at for mask in self.masks.values() for at in mask}}
        masks = {alpha: {to[at]: weight for at, weight in mask.items()} for alpha, mask in self.masks.items()}
        return Tetrahedron(self.kind, tuple(_turned(matrix, v) for v in self.vertices), masks)


def _turned(matrix: np.ndarray, v: Vector) -> Vector:
    x, y, z = (sum(int(m) * c for m, c in zip(row, v, strict=True) if m) for row in matrix)
    return Fraction(x), Fraction(y), Fraction(z)


def signed_permutations() -> list[np.ndarray]:
    """The 48 symmetries of the cube, as integer matrices."""
    return [np.diag(signs) @ np.eye(3, dtype=int)[list(p)] for p in permutations(range(3)) for signs in _SIGNS]


_SIGNS = list(product((1, -1), repeat=3))


def indices(degree: int) -> list[Index]:
    """Every α with |α| = degree, descending lexicographically."""
    return sorted((a for a in product(range(degree + 1), repeat=4) if sum(a) == degree), reverse=True)  # type: ignore


@dataclass(frozen=True)
class Spline:
    """A spline: degree, the tetrahedra of the cell about the origin, and where centres of cells are.

    Attributes:
        shift: centres lie at integers + shift along every axis.
        body_centred: only at those whose integers are all even or all odd.
    """

    degree: int
    shift: Fraction
    body_centred: bool
    tetrahedra: tuple[Tetrahedron, ...]

    def centres(self, points: np.ndarray) -> np.ndarray:
        """The nearest centre to every point (P, 3), as integers: the shift is left out."""
        x = points - float(self.shift)
        steps = np.array(list(product((-1, 0, 1, 2), repeat=3)))
        candidates = np.floor(x).astype(int)[:, None] + steps
        distance = ((candidates - x[:, None]) ** 2).sum(-1)
        if self.body_centred:
            parity = candidates % 2
            distance = np.where((parity == parity[..., :1]).all(-1), distance, np.inf)
        return np.take_along_axis(candidates, distance.argmin(-1)[:, None, None], 1)[:, 0]


def _tetrahedron(kind: str, vertices: str, degree: int, places: Sequence[Vector], rows: list[list[int]], unit: int):
    corners = tuple(tuple(map(Fraction, v.split())) for v in vertices.split(","))
    masks = [{at: Fraction(n, unit) for at, n in zip(places, row, strict=True) if n} for row in rows]
    return Tetrahedron(kind, corners, dict(zip(indices(degree), masks, strict=True)))  # type: ignore[arg-type]


def _orbit(canonical: Sequence[Tetrahedron]) -> tuple[Tetrahedron, ...]:
    """All images, each tetrahedron once: where vertices only change places, the first order of them stays."""
    found: dict[frozenset[Vector], Tetrahedron] = {}
    for one in canonical:
        for matrix in signed_permutations():
            vertices = frozenset(_turned(matrix, v) for v in one.vertices)
            if vertices not in found:
                found[vertices] = one.image(matrix)
    return tuple(found.values())


def _type6(degree: int, rows: list[list[int]], unit: int) -> Spline:
    places = [tuple(map(Fraction, offset)) for offset in _TYPE6_OFFSETS]
    one = _tetrahedron("T", _TYPE6_VERTICES, degree, places, rows, unit)  # type: ignore[arg-type]
    return Spline(degree, Fraction(0), False, _orbit([one]))


def _octahedral() -> Spline:
    places = [tuple(c - HALF for c in offset) for offset in _OCTAHEDRAL_OFFSETS]
    kinds = [_tetrahedron(k, v, 2, places, _OCTAHEDRAL[k], 128) for k, v in _OCTAHEDRAL_VERTICES.items()]  # type: ignore
    return Spline(2, HALF, True, _orbit(kinds))


SPLINES = {"qss": _type6(2, _QSS, 128), "cubic-c1": _type6(3, _CUBIC, 192), "quadratic-c1": _octahedral()}


# ---- evaluation


@dataclass(frozen=True)
class _Table:
    """A spline as arrays: T tetrahedra, A = |{α}|, K places of samples.

    Attributes:
        to_barycentric: (T, 4, 4): λ = to_barycentric (1, x, y, z).
        offsets: (K, 3) integers relative to the integers of a centre.
        weights: (T, A, K).
    """

    to_barycentric: np.ndarray
    offsets: np.ndarray
    weights: np.ndarray


@lru_cache
def _table(name: str) -> _Table:
    spline = SPLINES[name]
    corners = np.array([[[1, *v] for v in t.vertices] for t in spline.tetrahedra], dtype=np.float64)
    places = sorted({at for t in spline.tetrahedra for mask in t.masks.values() for at in mask})
    offsets = np.array([[int(c + spline.shift) for c in at] for at in places])
    weights = [
        [[float(t.masks[a].get(at, 0)) for at in places] for a in indices(spline.degree)] for t in spline.tetrahedra
    ]
    return _Table(np.linalg.inv(corners).swapaxes(-1, -2), offsets, np.array(weights))


def _basis(degree: int, barycentric: np.ndarray, along: Sequence[int]) -> np.ndarray:
    """The derivatives of all Bernstein polynomials (P, A) by the barycentric coordinates of those numbers."""
    columns = []
    for alpha in indices(degree):
        power, factor = list(alpha), factorial(degree) / prod(map(factorial, alpha))
        for n in along:
            factor *= power[n]
            power[n] = max(power[n] - 1, 0)
        columns.append(factor * np.prod(barycentric**power, axis=-1))
    return np.stack(columns, -1)


def jet(name: str, samples: Samples, points: np.ndarray, order: int = 1) -> tuple[np.ndarray, ...]:
    """(value (P), gradient (P, 3), Hessian (P, 3, 3)) up to `order`, per voxel, of continued samples."""
    spline, table, points = SPLINES[name], _table(name), np.asarray(points, dtype=np.float64)
    centres = spline.centres(points)
    local = points - centres - float(spline.shift)
    barycentric = np.einsum("tnc,pc->ptn", table.to_barycentric, np.insert(local, 0, 1, axis=-1))
    which = barycentric.min(-1).argmax(-1)
    inside = barycentric[np.arange(len(points)), which]
    b = np.einsum("pak,pk->pa", table.weights[which], samples.at(centres[:, None] + table.offsets))
    slopes = table.to_barycentric[which][:, :, 1:]

    def derivative(*along: int) -> np.ndarray:
        return (b * _basis(spline.degree, inside, along)).sum(-1)

    out = [derivative()]
    if order >= 1:
        out.append(np.sum([derivative(m)[:, None] * slopes[:, m] for m in range(4)], axis=0))
    if order >= 2:
        rows = [np.sum([derivative(m, n)[:, None] * slopes[:, n] for n in range(4)], axis=0) for m in range(4)]
        out.append(np.einsum("pmi,mpj->pij", slopes, rows))
    return tuple(out)


@dataclass(frozen=True)
class Samples:
    """Samples continued over a box of integers: `values[z − z₀, y − y₀, x − x₀]` stands at (x, y, z)."""

    values: np.ndarray
    first: np.ndarray

    @classmethod
    def continued(cls, samples: np.ndarray, boundary: str, prefilter: bool, points: np.ndarray) -> Samples:
        """Those around points, deconvolved by the sampled quadratic B-spline where prefiltered."""
        c, deconvolve = np.asarray(samples, dtype=np.float64), ("bspline2",) if prefilter else ()
        first, last = np.floor(points.min(0)).astype(int) - 4, np.ceil(points.max(0)).astype(int) + 4
        for axis, n in enumerate(c.shape):
            index = np.arange(first[2 - axis], last[2 - axis] + 1)
            matrix = oracles.coefficient_matrix(deconvolve, boundary, n, index)
            c = np.moveaxis(np.tensordot(matrix, c, (1, axis)), 0, axis)
        return cls(c, first)

    def at(self, index: np.ndarray) -> np.ndarray:
        """Those at integers (..., 3) in x, y, z order."""
        x, y, z = np.moveaxis(index - self.first, -1, 0)
        return self.values[z, y, x]


def reconstruct(
    name: str,
    samples: np.ndarray,
    points: np.ndarray,
    boundary: str = "mirror",
    prefilter: bool = True,
    order: int = 1,
) -> tuple[np.ndarray, ...]:
    """(value, gradient, Hessian) up to `order` of a spline at `points` `(P, 3)`, everything per voxel."""
    points = np.asarray(points, dtype=np.float64)
    return jet(name, Samples.continued(samples, boundary, prefilter, points), points, order)
