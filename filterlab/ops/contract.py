"""contract, described: a sparse matrix along every axis of a volume, and sums of such products.

    out = Σ_terms (M_z ⊗ M_y ⊗ M_x) samples,       out_kji = Σ_terms Σ M_z[k, c] M_y[j, b] M_x[i, a] samples_cba

All that a separable method makes of samples on an aligned grid is one: prefilter, boundary, kernel and low-pass of an
axis are in the rows of its matrix. The adjoint is that of the transposed matrices.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import torch
from torch import Tensor


@dataclass(frozen=True, eq=False)
class Rows:
    """A sparse matrix, row after row: row i has the entries starts[i] … starts[i + 1] − 1.

    Attributes:
        starts: (R + 1,) int64.
        places: (E,) int64, the column of every entry.
        weights: (E,) float64; may require grad.
        columns: how many there are.
    """

    starts: Tensor
    places: Tensor
    weights: Tensor
    columns: int

    @classmethod
    def of_entries(cls, rows: Tensor, places: Tensor, weights: Tensor, shape: tuple[int, int]) -> Rows:
        """From entries (E,) in any order; those of one row and column are summed."""
        keys, index = torch.unique(rows * shape[1] + places, return_inverse=True)
        summed = weights.new_zeros(len(keys)).index_add(0, index, weights)
        counts = torch.bincount(keys // shape[1], minlength=shape[0])
        starts = torch.cat((counts.new_zeros(1), counts.cumsum(0)))
        return cls(starts, keys % shape[1], summed, shape[1])

    @classmethod
    def identity(cls, n: int) -> Rows:
        return cls(torch.arange(n + 1), torch.arange(n), torch.ones(n, dtype=torch.float64), n)

    @property
    def count(self) -> int:
        """R."""
        return len(self.starts) - 1

    @cached_property
    def counts(self) -> Tensor:
        """(R,) entries of every row."""
        return self.starts.diff()

    @cached_property
    def transposed(self) -> Rows:
        own = torch.repeat_interleave(torch.arange(self.count), self.counts)
        return Rows.of_entries(self.places, own, self.weights, (self.columns, self.count))

    def scaled(self, factor: float) -> Rows:
        """factor · the matrix."""
        return self if factor == 1 else replace(self, weights=factor * self.weights)

    def part(self, rows: slice) -> tuple[Rows, slice]:
        """Some neighbouring rows as a matrix of the columns that they read, and which columns these are."""
        starts = self.starts[rows.start : rows.stop + 1]
        own = slice(int(starts[0]), int(starts[-1]))
        places, weights = self.places[own], self.weights[own]
        first, last = (int(places.min()), int(places.max())) if len(places) else (0, 0)
        return Rows(starts - own.start, places - first, weights, last + 1 - first), slice(first, last + 1)


Axes = tuple[Rows, Rows, Rows]
"""Matrices along x, y, z."""


@dataclass(frozen=True, eq=False)
class Contraction:
    """Σ_terms M_z ⊗ M_y ⊗ M_x.

    Attributes:
        terms: at least one; their matrices along an axis have the same shape.
    """

    terms: Sequence[Axes]

    @property
    def shape(self) -> tuple[int, int, int]:
        """(D, H, W) of the result."""
        x, y, z = self.terms[0]
        return z.count, y.count, x.count

    @property
    def columns(self) -> tuple[int, int, int]:
        """(D, H, W) of the samples."""
        x, y, z = self.terms[0]
        return z.columns, y.columns, x.columns

    @property
    def exact(self) -> bool:
        """Whether weights are numbers by which no derivative is asked."""
        return not any(rows.weights.requires_grad for term in self.terms for rows in term)

    @cached_property
    def transposed(self) -> Contraction:
        """The adjoint."""
        return Contraction([(x.transposed, y.transposed, z.transposed) for x, y, z in self.terms])

    def part(self, planes: slice, lines: slice) -> tuple[Contraction, tuple[slice, slice]]:
        """What makes some lines of some planes of the result, and the planes and lines of samples that it is for."""
        xs, ys, zs = zip(*self.terms, strict=True)
        (z, own_planes), (y, own_lines) = _parts(zs, planes), _parts(ys, lines)
        return Contraction(list(zip(xs, y, z, strict=True))), (own_planes, own_lines)


def _parts(matrices: Sequence[Rows], rows: slice) -> tuple[list[Rows], slice]:
    """Some rows of matrices, of those columns that any of them reads."""
    parts = [matrix.part(rows) for matrix in matrices]
    first, last = min(own.start for _, own in parts), max(own.stop for _, own in parts)
    moved = [replace(part, places=part.places + own.start - first, columns=last - first) for part, own in parts]
    return moved, slice(first, last)
