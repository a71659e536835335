"""A quadratic near a spline on each cube about a sample, and how near: derived from the spline's masks, in float64.

On the cube |u| ≤ ½ about a sample the spline f is many polynomials, each a sum over the 3³ samples around. With q the
quadratic whose Bernstein coefficients on all of these tetrahedra are nearest to those of f (least squares),

    f − q = Σ_j n_j ψ_j,        |f − q| ≤ Σ_j |n_j| max |ψ_j|

where n_j, numbers made of samples, span all in which f and q differ, and max |ψ_j| is of Bernstein coefficients. Of
smooth data n_j are third differences. What is even along an axis and what is odd do not meet: samples enter as sums
and differences, and all rows have few weights.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product

import numpy as np

from filterlab.bernstein import Index, multi_indices, multinomial
from filterlab.ops.tetrahedra import QUADRATICS, Trend

Piece = tuple[Sequence[tuple[float, float, float]], Mapping[Index, Mapping[tuple[int, int, int], float]]]
"""A tetrahedron's vertices; of each of its coefficients the samples' weights. All from the sample in the middle."""

_NOTHING = 1e-12
"""What is less is rounding, of numbers about 1."""

_OF_KIND = np.array([[0, 1, 0], [0.5, 0, 0.5], [-0.5, 0, 0.5]])
"""Samples at −1, 0, 1 along an axis where the one in the middle, the others' sum, or their difference is 1."""


def trend(degree: int, pieces: Sequence[Piece]) -> Trend:
    """Of a spline with these pieces in a cube."""
    coefficients, quadratics = _coefficients(pieces), _quadratics(degree, pieces)
    rows, *_ = np.linalg.lstsq(quadratics, coefficients, rcond=None)
    return Trend(_in_numbers(rows), _in_numbers(_apart(coefficients - quadratics @ rows)))


def _coefficients(pieces: Sequence[Piece]) -> np.ndarray:
    """(B, 27): all Bernstein coefficients, of the sums and differences that `Trend` describes."""
    places = list(product((-1, 0, 1), repeat=3))
    masks = [mask for _, own in pieces for mask in own.values()]
    rows = np.array([[mask.get(place, 0.0) for place in places] for mask in masks])
    return rows @ np.kron(np.kron(_OF_KIND, _OF_KIND), _OF_KIND).T


def _quadratics(degree: int, pieces: Sequence[Piece]) -> np.ndarray:
    """(B, 10): the Bernstein coefficients of `QUADRATICS` on the same tetrahedra, by their values."""
    indices = np.array(multi_indices(degree, 3))
    places = indices / degree
    there = np.prod(places[:, None] ** indices, axis=-1) * [multinomial(tuple(row)) for row in indices.tolist()]
    points = (places[:, :, None] * np.array([own for own, _ in pieces])[:, None]).sum(2)
    values = np.prod(points[:, :, None] ** np.array(QUADRATICS), axis=-1)
    return np.concatenate(np.linalg.solve(there, values))


def _apart(differences: np.ndarray) -> np.ndarray:
    """(J, 27): rows n_j max |ψ_j| of Σ_j n_j ψ_j, for numbers of each parity apart."""
    kinds, rows = np.array(list(product(range(3), repeat=3))), []
    for parity in product((False, True), repeat=3):
        own = np.all((kinds == 2) == parity, axis=1)
        functions, sizes, numbers = np.linalg.svd(differences[:, own], full_matrices=False)
        for function, size, number in zip(functions.T, sizes, numbers, strict=True):
            if size > _NOTHING:
                row = np.zeros(len(kinds))
                row[own] = number * (size * np.abs(function).max())
                rows.append(row)
    return np.array(rows)


def _in_numbers(rows: np.ndarray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(0.0 if abs(w) < _NOTHING else float(w) for w in row) for row in rows)
