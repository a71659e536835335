"""A quadratic near a spline on each cube about a sample, and how near: derived from the spline's masks, in float64.

On the cube |u| ≤ ½ about a sample the spline f is many polynomials, each a sum over the same numbers, made of samples.
With q the quadratic whose Bernstein coefficients on all of these tetrahedra are nearest to those of f (least squares),

    f − q = Σ_j n_j ψ_j,        |f − q| ≤ Σ_j |n_j| max |ψ_j|

where n_j, sums over these numbers, span all in which f and q differ, and max |ψ_j| is of Bernstein coefficients. Of
smooth data n_j are third differences. What is even and what is odd do not meet: numbers are sums and differences of
what lies opposite, and all rows have few weights.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product

import numpy as np

from filterlab.bernstein import Index, multi_indices, multinomial
from filterlab.ops.tetrahedra import QUADRATICS, Trend

Place = tuple[int, int, int]

Input = tuple[Place, int]
"""Twice the place of a sample, and 0; or of a centre of octahedra, and which of (f, ∂_x f, ∂_y f, ∂_z f) there."""

Piece = tuple[np.ndarray, Mapping[Index, Mapping[Input, float]]]
"""A tetrahedron's vertices (4, 3), from the sample in the middle, and what each of its coefficients is made of."""

_NOTHING = 1e-12
"""What is less is rounding, of numbers about 1."""

_OF_KIND = np.array([[0, 1, 0], [0.5, 0, 0.5], [-0.5, 0, 0.5]])
"""Samples at −1, 0, 1 along an axis where the one in the middle, the others' sum, or their difference is 1."""

_CENTRES: tuple[Place, ...] = ((1, 1, 1), (-3, 1, 1), (1, -3, 1), (1, 1, -3))
"""Twice those of octahedra whose jets tell of a cube about a sample at even indices; with those opposite."""


def on_cubes(degree: int, pieces: Sequence[Piece]) -> Trend:
    """Of a spline with these pieces in a cube, each a sum over the 3³ samples around."""
    kinds = np.array(list(product(range(3), repeat=3)))
    classes = [np.all((kinds == 2) == parity, axis=1) for parity in product((False, True), repeat=3)]
    rows = _rows(pieces, [((x, y, z), 0) for x, y, z in product((-2, 0, 2), repeat=3)])
    return _trend(degree, pieces, rows @ np.kron(np.kron(_OF_KIND, _OF_KIND), _OF_KIND).T, classes, ())


def on_octahedra(degree: int, pieces: Sequence[Piece]) -> Trend:
    """Of a spline with these pieces in a cube about a sample at even indices, sums over jets at eight centres."""
    opposite = tuple(_opposite(c) for c in _CENTRES)
    first, second = (_rows(pieces, list(product(own, range(4)))) for own in (_CENTRES, opposite))
    value = np.arange(first.shape[1]) % 4 == 0
    even = np.concatenate((value, ~value))  # sums of values, differences of slopes
    shares = np.where(value, 1 / 8, 1 / 4)  # see `ops.tetrahedra.at_centre`
    rows = np.concatenate(((first + second) * shares, (first - second) * shares), axis=1) / 2
    return _trend(degree, pieces, rows, [even, ~even], _CENTRES + opposite)


def _opposite(place: Place) -> Place:
    x, y, z = place
    return -x, -y, -z


def _rows(pieces: Sequence[Piece], inputs: Sequence[Input]) -> np.ndarray:
    """(B, K): all Bernstein coefficients, of these K."""
    masks = [mask for _, own in pieces for mask in own.values()]
    return np.array([[mask.get(key, 0.0) for key in inputs] for mask in masks])


def _trend(
    degree: int,
    pieces: Sequence[Piece],
    coefficients: np.ndarray,
    classes: Sequence[np.ndarray],
    centres: tuple[Place, ...],
) -> Trend:
    """From (B, K) coefficients, of K numbers that belong to several classes."""
    quadratics = _quadratics(degree, pieces)
    rows, *_ = np.linalg.lstsq(quadratics, coefficients, rcond=None)
    apart = _apart(coefficients - quadratics @ rows, classes)
    return Trend(centres, _in_numbers(rows), _in_numbers(apart))


def _quadratics(degree: int, pieces: Sequence[Piece]) -> np.ndarray:
    """(B, 10): the Bernstein coefficients of `QUADRATICS` on the same tetrahedra, by their values."""
    indices = np.array(multi_indices(degree, 3))
    places = indices / degree
    there = np.prod(places[:, None] ** indices, axis=-1) * [multinomial(tuple(row)) for row in indices.tolist()]
    points = (places[:, :, None] * np.array([own for own, _ in pieces])[:, None]).sum(2)
    values = np.prod(points[:, :, None] ** np.array(QUADRATICS), axis=-1)
    return np.concatenate(np.linalg.solve(there, values))


def _apart(differences: np.ndarray, classes: Sequence[np.ndarray]) -> np.ndarray:
    """(J, K): rows n_j max |ψ_j| of Σ_j n_j ψ_j, for each class of numbers."""
    rows = []
    for own in classes:
        functions, sizes, numbers = np.linalg.svd(differences[:, own], full_matrices=False)
        for function, size, number in zip(functions.T, sizes, numbers, strict=True):
            if size > _NOTHING:
                row = np.zeros(len(own))
                row[own] = number * (size * np.abs(function).max())
                rows.append(row)
    return np.array(rows)


def _in_numbers(rows: np.ndarray) -> tuple[tuple[float, ...], ...]:
    return tuple(tuple(0.0 if abs(w) < _NOTHING else float(w) for w in row) for row in rows)
