"""gather and scatter of splines on tetrahedra, in plain torch: `ops.tetrahedra.Sum` with tensors.

Letters as in `ops.reference.gather`.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import torch
from torch import Tensor

from filterlab.ops.tetrahedra import Block, Sum, Tetrahedra, TetrahedralStencil


class Tensors:
    """The arithmetic of tensors that lie as `like` does."""

    def __init__(self, like: Tensor) -> None:
        self._like = like

    def constant(self, value: float) -> Tensor:
        return self._like.new_tensor(value)

    def add(self, a: Tensor, b: Tensor) -> Tensor:
        return a + b

    def subtract(self, a: Tensor, b: Tensor) -> Tensor:
        return a - b

    def multiply(self, a: Tensor, b: Tensor) -> Tensor:
        return a * b

    def multiply_add(self, a: Tensor, b: Tensor, c: Tensor | None) -> Tensor:
        return a * b if c is None else torch.addcmul(c, a, b)

    def divide(self, a: Tensor, b: Tensor) -> Tensor:
        return a / b

    def negate(self, a: Tensor) -> Tensor:
        return -a

    def absolute(self, a: Tensor) -> Tensor:
        return a.abs()

    def floor(self, a: Tensor) -> Tensor:
        return a.floor()

    def less(self, a: Tensor, b: Tensor) -> Tensor:
        return a < b

    def both(self, a: Tensor, b: Tensor) -> Tensor:
        return a & b

    def where(self, mask: Tensor, a: Tensor, b: Tensor) -> Tensor:
        return torch.where(mask, a, b)


class Reads:
    """Where points (M, 3) read among coefficients (D, H, W), of which the first one lies at `start` along every axis.

    Attributes:
        sum: what is written out.
        turned: the points in the cone.
        index: (blocks · size³, M), the flat index of every sample.
    """

    def __init__(self, points: Tensor, stencil: TetrahedralStencil, shape: Sequence[int], start: int) -> None:
        arithmetic = Tensors(points)
        self.sum = Sum(arithmetic, stencil)
        before, behind = stencil.spline.reach
        x, y, z = points.unbind(-1)
        cells = [
            torch.nan_to_num(cell, nan=float(start)).clamp(start + before, start + size - 1 - behind)
            for cell, size in zip(self.sum.cells((x, y, z)), tuple(shape)[:-4:-1], strict=True)
        ]
        u = [self.sum.local(own, cell) + 0 * own for own, cell in zip((x, y, z), cells, strict=True)]
        self.turned = self.sum.turn(u)
        self.index = self._index([cell.long() - start for cell in cells], shape)

    def _index(self, cells: Sequence[Tensor], shape: Sequence[int]) -> Tensor:
        strides, spline = (1, shape[-1], shape[-1] * shape[-2]), self.sum.spline
        signed = [torch.where(negative, -s, s) for s, negative in zip(strides, self.turned.negative, strict=True)]
        along = self.sum.along_cone(self.turned, signed)
        first = sum(stride * (cell - spline.before) for stride, cell in zip(strides, cells, strict=True))
        index = []
        for centre in spline.centres:
            corner = first + sum(step * own for step, own in zip(centre, along, strict=True))
            index += [corner + i + j * strides[1] + k * strides[2] for i, j, k in self.sum.places]
        return torch.stack(index)

    def blocks(self, values: Sequence[Tensor]) -> list[Block]:
        """Of what was read at `index`."""
        count = len(self.sum.places)
        return [dict(zip(self.sum.places, values[i : i + count], strict=True)) for i in range(0, len(values), count)]


def contract(flat: Tensor, at: Reads, offset: Tensor | int, dtype: torch.dtype) -> Tensor:
    """(J, C, M), from coefficients (C, N·D·H·W) and the flat offset of every point's batch entry."""
    samples = [flat.index_select(1, index).to(dtype) for index in at.index + offset]
    rows = at.sum.contract(at.blocks(samples), at.turned)
    return torch.stack([row.expand(len(flat), -1) for row in rows])


def spread(out: Tensor, cotangents: Tensor, at: Reads, offset: Tensor | int) -> None:
    """The transpose, in place on `out` (C, N·D·H·W); cotangents (J, C, M)."""
    blocks = at.sum.spread(list(cotangents), at.turned)
    every = [block[place] for block in blocks for place in at.sum.places]
    for index, values in zip(at.index + offset, every, strict=True):
        if values is not None:
            out.index_add_(1, index, values)


# --- bounds -----------------------------------------------------------------------------------------------------------


def ranges_of_cubes(samples: Tensor, spline: Tetrahedra) -> tuple[Tensor, Tensor]:
    """(least, greatest) sample that the tetrahedra of every cube about a sample need, NaN where one is.

    Args:
        samples: (D, H, W), also those that the outermost cubes need; cubes are counted from an even index on.
    """
    low, high = -largest_of_windows(-samples, spline.size), largest_of_windows(samples, spline.size)
    return (-_largest_of_blocks(-low), _largest_of_blocks(high)) if spline.octahedral else (low, high)


def largest_of_windows(values: Tensor, size: int) -> Tensor:
    """The greatest of every window of size³; NaN where one is."""
    for dim in range(3):
        values = values.unfold(dim, size, 1).amax(-1)
    return values


def _largest_of_blocks(blocks: Tensor) -> Tensor:
    """Of the eight blocks of 2³ that a cube's two octahedra need: about their centres, and two steps beyond each.

    The centres stand at sample ± σ / 2, σ = 1 along axes of even, −1 along those of odd indices.
    """
    out = blocks.new_empty([n - 3 for n in blocks.shape])
    for parity in product((0, 1), repeat=3):
        every_second = tuple(slice(p, None, 2) for p in parity)
        count = out[every_second].shape
        if 0 not in count:
            parts = [_block(blocks, parity, count, centre) for centre in _centres(parity)]
            out[every_second] = torch.stack(parts).amax(0)
    return out


def _centres(parity: Sequence[int]) -> list[tuple[int, ...]]:
    """Twice the centres of a cube's blocks, from its sample."""
    centres: list[tuple[int, ...]] = []
    for side in (1, -1):
        own = tuple(side * (1 - 2 * p) for p in parity)
        centres += [own, *(tuple(c - 4 * c * (i == axis) for i, c in enumerate(own)) for axis in range(3))]
    return centres


def _block(blocks: Tensor, parity: Sequence[int], count: Sequence[int], centre: Sequence[int]) -> Tensor:
    """Of every second cube along each axis, the block at that centre."""
    first = (2 + p + (c - 1) // 2 for p, c in zip(parity, centre, strict=True))
    return blocks[tuple(slice(a, a + 2 * n - 1, 2) for a, n in zip(first, count, strict=True))]
