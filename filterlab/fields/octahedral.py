"""The quadratic C¹ spline on truncated octahedra, derived from what it is at their centres.

Samples lie at the integers. The centres (i, j, k) + ½ with i, j, k all even or all odd are a body-centred lattice,
whose Voronoi cells are truncated octahedra: six squares, and eight hexagons with a sample in the middle of each. One
is cut into 144 tetrahedra [v_0, v_1, v_2, v_3] = [centre, barycentre of a face, midpoint of an edge of it, an end of
that edge].

A vertex is a mean of centres, those next to it that are equally far: v_1 of two, v_2 of three, v_3 of four. These are
c_0 … c_3, a tetrahedron of the centres' Delaunay triangulation. A C¹ quadratic is free in value and gradient at the
centres, and fixed by them: with the linear T_k(x) = f_k + g_k · (x − c_k) and v_i = Σ_k w_ik c_k, Σ_k w_ik = 1,

    b_(e_i + e_j) = Σ_k w_ik T_k((c_k + v_j) / 2),        i ≤ j

Value and gradient at a centre come from the eight samples around it, which lie at c + s / 2, s ∈ {−1, 1}³:

    f = 1/8 Σ_s f(c + s / 2),        g = 1/4 Σ_s s f(c + s / 2)

Source: Rhein and Kalbe, Quasi-interpolation by quadratic C¹-splines on truncated octahedral partitions, 2009: the
partition and the supports, 28 samples a tetrahedron and 88 an octahedron. The weights are derived: of the operators
with the symmetry of the octahedra and these supports, the one that is C¹ and reproduces linear functions.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction
from itertools import product

import torch
from torch import Tensor

from filterlab.bernstein import Index, multi_indices
from filterlab.fields.determining import Determining, moved
from filterlab.fields.tetrahedral import Jets, Mask, Shape, Spline, Vector, weighted

Centre = tuple[int, int, int]
Weights = tuple[int, int, int, int]

_CENTRES: tuple[Centre, ...] = ((0, 0, 0), (2, 0, 0), (1, 1, 1), (1, 1, -1))
"""c_0 … c_3 of the tetrahedra in the cone."""

_SQUARE, _HEXAGON, _END = (4, 4, 0, 0), (4, 0, 4, 0), (2, 2, 2, 2)
_ON_SQUARE, _ON_HEXAGONS = (3, 3, 2, 0), (2, 0, 3, 3)

_KINDS: tuple[tuple[Weights, Weights, Weights], ...] = (
    (_SQUARE, _ON_SQUARE, _END),
    (_HEXAGON, _ON_SQUARE, _END),
    (_HEXAGON, _ON_HEXAGONS, _END),
)
"""w_1, w_2, w_3 in eighths: of a face that is a square or a hexagon, of its edge on a square or between hexagons."""

_SIGNS = tuple(product((-1, 1), repeat=3))


def _half(s: tuple[int, ...]) -> Vector:
    x, y, z = (Fraction(n, 2) for n in s)
    return x, y, z


def _vertex(weights: Weights) -> Vector:
    """v = Σ_k w_k c_k."""
    x, y, z = (
        Fraction(sum(w * c for w, c in zip(weights, row, strict=True)), 8) for row in zip(*_CENTRES, strict=True)
    )
    return x, y, z


_F: Mask = {_half(s): Fraction(1, 8) for s in _SIGNS}
_G: tuple[Mask, ...] = tuple({_half(s): Fraction(s[axis], 4) for s in _SIGNS} for axis in range(3))
"""Value and gradient at a centre."""


def _linear(c: Centre, v: Vector) -> Jets:
    """T((c + v) / 2) = f + g · (v − c) / 2."""
    return {(c, 0): Fraction(1), **{(c, 1 + i): (v[i] - c[i]) / 2 for i in range(3)}}


def _rule(alpha: Index, weights: Sequence[Weights], vertices: Sequence[Vector]) -> Jets:
    """Σ_k w_ik T_k((c_k + v_j) / 2)."""
    i, j = (n for n, power in enumerate(alpha) for _ in range(power))
    return weighted(*((Fraction(w, 8), _linear(c, vertices[j])) for w, c in zip(weights[i], _CENTRES, strict=True)))


def _mask(jets: Jets) -> Mask:
    """Of samples, from that of jets."""
    return weighted(*((weight, moved((_F, *_G)[n], c)) for (c, n), weight in jets.items()))


def _of_kind(kind: Sequence[Weights]) -> tuple[Shape, dict[Index, Jets]]:
    """A tetrahedron of the cone, and the rules by which its coefficients follow from jets."""
    weights = ((8, 0, 0, 0), *kind)
    v = [_vertex(w) for w in weights]
    rules = {alpha: _rule(alpha, weights, v) for alpha in multi_indices(2, 3)}
    return Shape((v[0], v[1], v[2], v[3]), {alpha: _mask(jets) for alpha, jets in rules.items()}), rules


def _octahedra(x: Tensor) -> Tensor:
    """(i, j, k) of the octahedron around each point, all even or all odd: |x − centre|₁ ≤ 3/2, no coordinate over 1."""
    y = x - 0.5
    even, odd = 2 * (y / 2 + 0.5).floor(), 2 * (y / 2).floor() + 1
    return torch.where((y - even).abs().sum(-1, keepdim=True) <= 1.5, even, odd)


_SHAPES, _RULES = zip(*map(_of_kind, _KINDS), strict=True)

QUADRATIC_C1 = Spline("quadratic-c1", 2, _SHAPES, _octahedra, Fraction(1, 2), 2, _CENTRES, 2, _RULES)
"""Quadratic splines, C¹ everywhere."""

JETS = Determining.of_rows(QUADRATIC_C1, (_F, *_G), _RULES)
"""Value and gradient at the centres of octahedra: four numbers for every four samples."""
