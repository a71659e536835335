"""Splines over triangulated grids of heights, described: which data a triangle needs, and what they make.

A cell of m × m steps of the data, from the datum (m i, m j) on (column, row), is cut along a diagonal. With s, t ∈
[0, 1] across it along columns and rows, barycentric coordinates (λ0, λ1, λ2) of its triangles are

    anti    up    1 − s − t, s, t              if s + t ≤ 1         corners (0, 0) (1, 0) (0, 1)
            down  s + t − 1, 1 − s, 1 − t      else                         (1, 1) (0, 1) (1, 0)
    main    the same of 1 − s in place of s

and their 15 coefficients stand in the order of `filterlab.bernstein`. `ops.reference.heights` says what is computed.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from filterlab.volume import Boundary

DIAGONALS = ("main", "anti")


@dataclass(frozen=True)
class Triangle:
    """One of the two triangles of a cell.

    Attributes:
        samples: (column, row) of the K data it needs, from the first datum of the cell, row after row.
        weights: of every coefficient those of all data.
    """

    samples: tuple[tuple[int, int], ...]
    weights: tuple[tuple[float, ...], ...]

    @property
    def first(self) -> int:
        """Which of the data stands at V0, or weighs most there."""
        return max(range(len(self.samples)), key=lambda k: self.weights[0][k])


@dataclass(frozen=True)
class Pattern:
    """A spline on both triangles of a cell.

    Attributes:
        name: of the spline.
        diagonal: one of `DIAGONALS`: "main" joins the corners (0, 0) and (1, 1) of a cell, "anti" (1, 0) and (0, 1).
        steps: m.
        up, down: the triangles.
    """

    name: str
    diagonal: str
    steps: int
    up: Triangle
    down: Triangle

    @property
    def mirrored(self) -> bool:
        """Whether s is taken from the other end."""
        return self.diagonal == "main"


@dataclass(frozen=True, eq=False)
class Heights:
    """Heights on a grid, and the spline that is made of them.

    Attributes:
        values: (N, H, W), of any type that stands for numbers; NaN is a hole.
        pattern: the spline.
        boundary: how the data go on beyond their ends.
        spacing, origin: along x and y: the datum in column c and row r stands at origin + spacing · (c, r).
    """

    values: Tensor
    pattern: Pattern
    boundary: Boundary
    spacing: tuple[float, float]
    origin: tuple[float, float]

    @property
    def cells(self) -> tuple[int, int]:
        """How many columns and rows of cells hold the data; of a single row or column one."""
        rows, columns = (max(1, -(-(n - 1) // self.pattern.steps)) for n in self.values.shape[-2:])
        return columns, rows
