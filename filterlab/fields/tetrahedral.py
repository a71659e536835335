"""Splines on tetrahedra: locate ▶ the samples a tetrahedron needs ▶ Bernstein coefficients ▶ value and derivatives.

A partition cuts space into cells that are alike (cubes, truncated octahedra), and each cell into tetrahedra that meet in
its centre. Every signed permutation of the axes about a centre maps the cell's tetrahedra onto one another; what it
makes of a point lies in the cone x ≥ y ≥ z ≥ 0, where there are few of them: the partition's `Shape`s, with one table
of exact weights each. A spline is such tables: the Bernstein coefficient of a tetrahedron at the multi-index α is

    b_α = Σ_o mask_α(o) · f(centre + P o),        P the signed permutation that maps the cone to the point's own

so that nothing else need be known to evaluate it.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from fractions import Fraction

from torch import Tensor

from filterlab.bernstein import Index

Vector = tuple[Fraction, Fraction, Fraction]

Mask = Mapping[Vector, Fraction]
"""Where samples lie, relative to the centre of a cell -> their weights."""


@dataclass(frozen=True, eq=False)
class Shape:
    """One tetrahedron of the cone x ≥ y ≥ z ≥ 0, and the spline on it.

    Attributes:
        vertices: v_0 … v_3, relative to the centre of the cell.
        masks: for every multi-index α of the degree, of the domain point Σ α_k v_k / n, what its coefficient is made of.
    """

    vertices: tuple[Vector, Vector, Vector, Vector]
    masks: Mapping[Index, Mask]


@dataclass(frozen=True, eq=False)
class Spline:
    """A spline on the tetrahedra of a partition.

    Attributes:
        name: of the spline.
        degree: n.
        shapes: the tetrahedra of the cone; they fill the cell's part of it and share faces.
        cells: voxel coordinates (..., 3) -> the cell of each, (..., 3) whole numbers of the same type; NaN for NaN.
        shift: the centre of a cell lies at cell + shift along every axis: 0 or ½.
        period: how far the partition has to be moved along any axis to lie on itself: 1 or 2.
    """

    name: str
    degree: int
    shapes: tuple[Shape, ...]
    cells: Callable[[Tensor], Tensor]
    shift: Fraction
    period: int
