"""Casting rays at a spline over a grid of heights, described: which cells a ray passes, and what may be hit in them.

Letters: x, y in cells, from the first cell's corner; z a height; a ray is o + s d, measured from where it enters the
box around all heights, with d so long that its largest component is 1.

    blocks    the least and greatest coefficient of every 2^l × 2^l cells, from single cells (or 4 × 4 of them) to all:
              where a ray stays above or below, a block is left out. Out of a block it goes to the next one of that
              size, or of twice that size where that begins; cells lie in the smallest blocks, nothing between
    cells     a ray crosses a cell, and its diagonal: two pieces at most
    pieces    on the ray's part from p to q of a triangle c_i = b[p, …, p, q, …, q], with q i times, minus the height of
              the ray, which is a line: its coefficients are z_p + i/4 (z_q − z_p)
    roots     the first root of the first piece that has one (`filterlab.roots`)

| case | what is a hit |
|---|---|
| s = z | one hit; of neighbouring pieces both have the value there that the first one has, to the bit |
| a ray touches the surface | one hit, if it does within the rounding of the piece's coefficients |
| a part of a ray lies on the surface | one hit in every piece at most, the first where it begins |
| along an edge, through a vertex | as any other: pieces of no length are pieces |
| a vertical ray | one piece, in the cell that ⌊x⌋, ⌊y⌋ name, and at the far end of the grid in the last one |
| from below, or from within the box | as any other; t = 0 where the ray begins on the surface |
| a triangle that uses a height that is not finite | a hole: no hit |
| beyond the grid | nothing |

All of it is float64, whatever the type of rays and heights. Bounds are float32, rounded outwards, and wider than that
by what rounding may do to coefficients.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import accumulate

import torch
from torch import Tensor

from filterlab.bernstein import multi_indices
from filterlab.ops.heights import Heights, Pattern, Triangle
from filterlab.volume import Boundary

DEGREE = 4
POINTS = (DEGREE + 1) ** 2
"""Domain points of a cell, number 5 t + s at (s/4, t/4): n of the upper triangle is 24 − n of the lower one."""

SLACK = 2.0**-44
"""Of the largest height that the data could make, by what bounds are wider."""

ROUNDING, SMALLEST = 2.0**-23, 2.0**-149  # of numbers that become float32

Weights = tuple[tuple[int, float], ...]
"""Numbers of data in a window, and their weights."""


@dataclass(frozen=True)
class Cell:
    """What the coefficients of a cell are made of.

    Attributes:
        steps: m, of data along an edge.
        before: steps that its window begins before the cell.
        size: w, data of the window along an axis, which are numbered row after row.
        masks: of every domain point, which data count and how much.
        mirrored: whether s runs against the columns.
    """

    steps: int
    before: int
    size: int
    masks: tuple[Weights, ...]
    mirrored: bool

    @classmethod
    def of(cls, pattern: Pattern) -> Cell:
        """The cell of both triangles."""
        places = [n for triangle in (pattern.up, pattern.down) for place in triangle.samples for n in place]
        before, after = -min(places), max(places)
        size = before + after + 1
        known = dict(_masks(pattern.down, before, size, down=True)) | dict(_masks(pattern.up, before, size, down=False))
        return cls(pattern.steps, before, size, tuple(known[n] for n in range(POINTS)), pattern.mirrored)

    @property
    def norm(self) -> float:
        """No coefficient is larger than this times the largest datum."""
        return max(sum(abs(weight) for _, weight in mask) for mask in self.masks)

    @property
    def finest(self) -> int:
        """log₂ of the cells along an edge of the smallest blocks: as small as a third of the heights' memory allows."""
        return 0 if self.steps > 2 else 2


def _masks(triangle: Triangle, before: int, size: int, down: bool) -> Iterator[tuple[int, Weights]]:
    """Of every domain point of a triangle, by number."""
    for (_, j, k), row in zip(multi_indices(DEGREE, 2), triangle.weights, strict=True):
        number = (DEGREE + 1) * k + j
        data = [(before + y) * size + before + x for x, y in triangle.samples]
        mask = tuple(sorted((n, w) for n, w in zip(data, row, strict=True) if w))
        yield (POINTS - 1 - number if down else number), mask


@dataclass(frozen=True, eq=False)
class Pyramid:
    """Bounds of blocks within blocks.

    Attributes:
        numbers: (N, 2) float32: least and greatest coefficient of a block, ∞ and −∞ of one that is all holes. Level
            after level, the smallest blocks first, row after row.
        sizes: (rows, columns) of blocks of every level; the last is (1, 1).
        finest: log₂ of the cells along an edge of the smallest blocks.
    """

    numbers: Tensor
    sizes: tuple[tuple[int, int], ...]
    finest: int

    @property
    def top(self) -> int:
        """log₂ of the cells along an edge of the one block that has all."""
        return self.finest + len(self.sizes) - 1

    @cached_property
    def starts(self) -> tuple[int, ...]:
        """Where every level begins, and where the last one ends."""
        return (0, *accumulate(rows * columns for rows, columns in self.sizes))

    @cached_property
    def range(self) -> tuple[float, float]:
        """Between what all coefficients lie."""
        low, high = self.numbers[-1].tolist()
        return low, high

    def level(self, number: int) -> Tensor:
        """(rows, columns, 2) of blocks, the smallest ones first; written to, it changes."""
        return self.numbers[self.starts[number] : self.starts[number + 1]].unflatten(0, self.sizes[number])

    @classmethod
    def room(cls, heights: Heights, finest: int, allocated: Callable[..., Tensor] | None = None) -> Pyramid:
        """To be written: the first level, then `complete`.

        Args:
            allocated: makes the memory, of a shape and a type; None: where the heights are.
        """
        columns, rows = heights.cells
        sizes = [(-(-rows // (1 << finest)), -(-columns // (1 << finest)))]
        while max(sizes[-1]) > 1:
            sizes.append((-(-sizes[-1][0] // 2), -(-sizes[-1][1] // 2)))
        count = sum(r * c for r, c in sizes)
        allocated = allocated or partial(torch.empty, device=heights.values.device)
        return cls(allocated((count, 2), dtype=torch.float32), tuple(sizes), finest)

    def complete(self) -> Pyramid:
        """The same, with all levels made from the first."""
        for number in range(1, len(self.sizes)):
            enclose(self.level(number - 1), 2, self.level(number))
        return self


def enclose(bounds: Tensor, edge: int, out: Tensor) -> None:
    """Write those of edge × edge blocks each, fewer at the ends, of bounds (rows, columns, 2) of single ones."""
    out[..., 0], out[..., 1] = torch.inf, -torch.inf
    for part in (bounds[y::edge, x::edge] for y in range(edge) for x in range(edge)):
        low, high = out[: part.shape[0], : part.shape[1]].unbind(-1)
        torch.minimum(low, part[..., 0], out=low)
        torch.maximum(high, part[..., 1], out=high)


def slack_of(heights: Heights, cell: Cell) -> float:
    """By what bounds are wider than coefficients, for rounding."""
    values = heights.values.detach()
    least, most = map(float, values.aminmax())
    if least != least:  # of the others
        known = values[~values.isnan()]
        least, most = map(float, known.aminmax()) if len(known) else (0.0, 0.0)
    return SLACK * cell.norm * max(abs(float(least)), abs(float(most)))


@dataclass(frozen=True, eq=False)
class HeightHits:
    """A spline over one grid of heights.

    Attributes:
        heights: the grid, of which `values` are (1, H, W), without derivatives.
        cell: what the coefficients of a cell are made of.
        pyramid: bounds of blocks of cells.
    """

    heights: Heights
    cell: Cell
    pyramid: Pyramid

    @property
    def domain(self) -> tuple[float, float]:
        """Where the data end along x and y, in cells; of a single row or column after one step."""
        rows, columns = self.heights.values.shape[-2:]
        x, y = (max(n - 1, 1) / self.cell.steps for n in (columns, rows))
        return x, y


def data_of_windows(heights: Heights, cell: Cell, axis: int) -> Tensor:
    """(m n + w − m,) int64 for n cells along an axis (0: x): which datum a place in a window has, −1: it is a zero.

    The window of cell i begins at place m i.
    """
    size, cells = heights.values.shape[-1 - axis], heights.cells[axis]
    place = torch.arange(cell.steps * (cells - 1) + cell.size) - cell.before
    source = heights.boundary.source(place, size)
    outside = (place < 0) | (place >= size)
    return torch.where(outside, -1, source) if heights.boundary is Boundary.ZEROS else source
