"""Splines over triangulated grids of heights, described: which data a triangle needs, and what they make.

A cell of m × m steps of the data, from the datum (m i, m j) on (column, row), is cut along a diagonal. With s, t ∈
[0, 1] across it along columns and rows, barycentric coordinates (λ0, λ1, λ2) of its triangles are

    anti    up    1 − s − t, s, t              if s + t ≤ 1         corners (0, 0) (1, 0) (0, 1)
            down  s + t − 1, 1 − s, 1 − t      else                         (1, 1) (0, 1) (1, 0)
    main    the same of 1 − s in place of s

and their 15 coefficients stand in the order of `filterlab.bernstein`. `ops.reference.heights` says what is computed.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from math import comb, perm

import torch
from torch import Tensor

from filterlab.bernstein import multi_indices
from filterlab.ops.gather import STORAGE
from filterlab.ops.tetrahedra import Arithmetic, Value
from filterlab.volume import Boundary

DIAGONALS = ("main", "anti")
DEGREE = 4


def rows(order: int) -> tuple[tuple[int, int], ...]:
    """The derivatives (i, j) along x and y of a jet: z; z_x, z_y; z_xx, z_xy, z_yy; …"""
    return tuple((own - j, j) for own in range(order + 1) for j in range(own + 1))


def raised(order: int) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """Which rows of the next higher order are the derivatives of these along x, and along y."""
    every = rows(order + 1)
    return tuple(every.index((i + 1, j)) for i, j in rows(order)), tuple(
        every.index((i, j + 1)) for i, j in rows(order)
    )


def differences(i: int, j: int, degree: int = DEGREE) -> dict[int, int]:
    """∂^i along λ1 and ∂^j along λ2 of degree n, of what is left after n − r steps, r = i + j ≤ n:

    n!/(n − r)! (e_1 − e_0)^i (e_2 − e_0)^j, in which e_α stands for the coefficient c_α. Place -> weight.
    """
    order = i + j
    place = {alpha: n for n, alpha in enumerate(multi_indices(order, 2))}
    return {
        place[order - p - q, p, q]: perm(degree, order) * comb(i, p) * comb(j, q) * (-1) ** (order - p - q)
        for p in range(i + 1)
        for q in range(j + 1)
    }


@dataclass(frozen=True)
class Triangle:
    """One of the two triangles of a cell.

    Attributes:
        samples: (column, row) of the K data it needs, from the first datum of the cell, row after row.
        weights: of every coefficient those of all data.
    """

    samples: tuple[tuple[int, int], ...]
    weights: tuple[tuple[float, ...], ...]

    @cached_property
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

    def __hash__(self) -> int:
        """Of the few patterns there are; those of hundreds of weights would be taken at every call of a program."""
        return hash((self.name, self.diagonal, self.steps, len(self.up.samples)))

    @property
    def mirrored(self) -> bool:
        """Whether s is taken from the other end."""
        return self.diagonal == "main"

    @cached_property
    def offsets(self) -> tuple[tuple[int, int], ...]:
        """(a, b) of the data of `up`: a steps from V0 towards V1, b towards V2; the same of both triangles."""
        return tuple((self.steps - a if self.mirrored else a, b) for a, b in self.up.samples)

    @property
    def degree(self) -> int:
        """The lowest that its polynomials have: three data make a plane."""
        return 1 if len(self.up.samples) == 3 else DEGREE

    @cached_property
    def lines(self) -> int:
        """In how many rows the data of a triangle lie."""
        return len({b for _, b in self.offsets})

    @cached_property
    def reach(self) -> int:
        """How many steps beyond a cell its data are."""
        return max(max(-a, -b, a - self.steps, b - self.steps) for a, b in self.offsets)


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


def unsupported(heights: Heights, points: Tensor) -> str | None:
    """What no fused implementation can do; None: nothing."""
    if points.dtype not in (torch.float32, torch.float64):
        return f"points must be float32 or float64; got {points.dtype}"
    if heights.values.dtype not in STORAGE:
        return f"heights must be stored as {', '.join(STORAGE.values())}; got {heights.values.dtype}"
    return None


# --- what programs are made of ----------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Places:
    """Where indices along an axis are stored, for programs that read no others.

    Beyond the ends of border and zeros all data are alike: cells that reach nothing else are one.

    Attributes:
        table: (T,) int64, what an index adds to the place of a datum.
        zero: the place in it of index 0.
        low, high: the first data of cells are folded into the period `high`, or clamped between both.
    """

    table: Tensor
    zero: int
    low: float
    high: float

    @classmethod
    def along(cls, heights: Heights, axis: int, stride: int) -> Places:
        """Along x (0) or y (1), for data that are `stride` numbers apart."""
        pattern, size = heights.pattern, heights.values.shape[-1 - axis]
        return _places(heights.boundary, size, pattern.steps, pattern.reach, stride)


@lru_cache(maxsize=64)
def _places(boundary: Boundary, n: int, steps: int, reach: int, stride: int) -> Places:
    if boundary.periodic:
        low, high = 0, round(boundary.period(n) or 0)
    else:
        low, high = -(steps + reach + 1), n + reach
    index = torch.arange(low - reach, high + steps + reach + 1)
    return Places(stride * boundary.source(index, n), reach - low, float(low), float(high))


class Masks:
    """The arithmetic of one triangle: data to coefficients to derivatives, and all of it transposed.

    Coefficients are those of the pattern's degree: of a plane the three at the corners.
    """

    def __init__(self, arithmetic: Arithmetic, pattern: Pattern) -> None:
        self.arithmetic, self.first, self.degree = arithmetic, pattern.up.first, pattern.degree
        kept = [n for n, alpha in enumerate(multi_indices(DEGREE, 2)) if self.degree == DEGREE or DEGREE in alpha]
        self.weights = [pattern.up.weights[n] for n in kept]

    def coefficients(self, data: Iterable[Value]) -> list[Value]:
        """All of a triangle, datum by datum: none need be kept."""
        e = self.arithmetic
        found: list[Value] = [None] * len(self.weights)
        for datum, column in zip(data, zip(*self.weights, strict=True), strict=True):
            for n, weight in enumerate(column):
                found[n] = e.multiply_add(datum, e.constant(weight), found[n]) if weight else found[n]
        return found

    def derivatives(self, coefficients: list[Value], barycentric: Sequence[Value], order: int) -> list[Value]:
        """All rows of a jet, along λ1 and λ2."""
        found: list[Value] = []
        for degree in range(self.degree, -1, -1):
            if degree <= order:
                found = [*(self._difference(coefficients, *row) for row in rows(degree) if sum(row) == degree), *found]
            if degree:
                coefficients = self._step(coefficients, barycentric, degree)
        nothing = self.arithmetic.multiply(found[0], self.arithmetic.constant(0))  # NaN in holes
        return found + [nothing] * (len(rows(order)) - len(found))

    def _difference(self, coefficients: Sequence[Value], i: int, j: int) -> Value:
        e, total = self.arithmetic, None
        for place, weight in differences(i, j, self.degree).items():
            total = e.multiply_add(coefficients[place], e.constant(weight), total)
        return total

    def _step(self, coefficients: Sequence[Value], barycentric: Sequence[Value], degree: int) -> list[Value]:
        """c_β ← Σ_k λ_k c_(β + e_k)."""
        e, found = self.arithmetic, []
        for places in _raised(degree):
            total = None
            for k, place in enumerate(places):
                total = e.multiply_add(coefficients[place], barycentric[k], total)
            found.append(total)
        return found

    def spread(self, cotangents: Sequence[Value], barycentric: Sequence[Value], order: int) -> list[Value]:
        """Of every datum what the rows of a jet give it."""
        e, left = self.arithmetic, list(cotangents)
        coefficients: list[Value | None] = []
        for degree in range(self.degree + 1):
            coefficients = self._step_back(coefficients, barycentric, degree) if degree else [None]
            if degree <= order:
                for row in [row for row in rows(degree) if sum(row) == degree]:
                    own = left.pop(0)
                    for place, weight in differences(*row, self.degree).items():
                        coefficients[place] = e.multiply_add(own, e.constant(weight), coefficients[place])
        return [self._sum(coefficients, column) for column in zip(*self.weights, strict=True)]

    def _step_back(self, lower: Sequence[Value], barycentric: Sequence[Value], degree: int) -> list[Value | None]:
        """c_(β + e_k) += λ_k c_β."""
        found: list[Value | None] = [None] * len(multi_indices(degree, 2))
        for own, places in zip(lower, _raised(degree), strict=True):
            for k, place in enumerate(places):
                found[place] = self.arithmetic.multiply_add(own, barycentric[k], found[place])
        return found

    def _sum(self, coefficients: Sequence[Value], weights: Sequence[float]) -> Value:
        e, total = self.arithmetic, None
        for own, weight in zip(coefficients, weights, strict=True):
            total = e.multiply_add(own, e.constant(weight), total) if weight else total
        return total


def _raised(degree: int) -> list[tuple[int, ...]]:
    """For every |β| = degree − 1 the places of β + e_0, β + e_1, β + e_2."""
    place = {alpha: n for n, alpha in enumerate(multi_indices(degree, 2))}
    lower = multi_indices(degree - 1, 2)
    return [tuple(place[tuple(b + (k == n) for n, b in enumerate(beta))] for k in range(3)) for beta in lower]
