"""gather and scatter of splines on tetrahedra, in plain torch: `ops.tetrahedra.Sum` with tensors.

Letters as in `ops.reference.gather`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from itertools import product

import torch
from torch import Tensor

from filterlab.ops.tetrahedra import (
    QUADRATICS,
    Block,
    Rows,
    Steps,
    Sum,
    Tetrahedra,
    TetrahedralStencil,
    at_centre,
    trend_of,
)


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

_NUMBERS_AT_ONCE = 1 << 20
"""Coefficients of as many layers of cubes, or of one: they stay in cache."""


def hulls_of_cubes(samples: Tensor, spline: Tetrahedra, off_trend: bool = False) -> tuple[Tensor, Tensor]:
    """(least, greatest) Bernstein coefficient of every cube about a sample, NaN where a sample is not finite.

    Args:
        samples: (D, H, W), also those that the outermost cubes need; cubes are counted from an even index on.
        off_trend: of f − t (`ops.bounds`), not of f.
    """
    low, high = (samples.new_empty([n - 2 * spline.around for n in samples.shape]) for _ in range(2))
    parts = _where_octahedra_meet(samples, spline) if spline.octahedral else _windows(samples, spline)
    for place, inputs, masks in _without_trend(parts, samples, spline) if off_trend else parts:
        weights, shape = samples.new_tensor(masks), inputs[0].shape
        layers = max(1, _NUMBERS_AT_ONCE // max(1, len(masks) * shape[1] * shape[2]))
        found = [
            (weights @ torch.stack(own).flatten(1)).aminmax(dim=0)
            for own in zip(*(x.split(layers) for x in inputs), strict=True)
        ]
        for out, columns in zip((low, high), zip(*found, strict=True), strict=True):
            out[place] = torch.cat(columns).reshape(shape)
    return low, high


_Inputs = tuple[tuple[slice, ...], list[Tensor], Sequence[Sequence[float]]]
"""Of some cubes: which, the numbers that their coefficients are made of, and the masks of these."""


def _without_trend(parts: Iterable[_Inputs], samples: Tensor, spline: Tetrahedra) -> Iterator[_Inputs]:
    """What is left when t is taken off: ten inputs more, its coefficients along the axes of each cube."""
    count = [n - 2 * spline.around for n in samples.shape]
    trend = trend_of(Tensors(samples), lambda at: _from(samples, [spline.around + k for k in reversed(at)], count, 1))
    for cubes, inputs, masks in parts:
        odd = [isinstance(own, slice) and own.start == 1 for own in cubes[::-1]]
        turned = (sum(k for k, own in zip(m, odd, strict=True) if own) % 2 for m in QUADRATICS)
        own = [
            -trend[m][cubes] if negative else trend[m][cubes] for m, negative in zip(QUADRATICS, turned, strict=True)
        ]
        less = [[*mask, *(-c for c in moments)] for mask, moments in zip(masks, spline.moments, strict=True)]
        yield cubes, [*inputs, *own], less


def _windows(samples: Tensor, spline: Tetrahedra) -> Iterator[_Inputs]:
    """All cubes: the samples around each."""
    whole = [n - 2 * spline.around for n in samples.shape]
    places = product(range(spline.size), repeat=3)
    yield (slice(None),) * 3, [_from(samples, (z, y, x), whole, 1) for x, y, z in places], spline.masks_of_cube


def _where_octahedra_meet(samples: Tensor, spline: Tetrahedra) -> Iterator[_Inputs]:
    """Cubes of even and odd indices along each axis: what blocks tell of their centres, turned round along odd axes."""
    whole = [n - 1 for n in samples.shape]
    block = {(x, y, z): _from(samples, (z, y, x), whole, 1) for x, y, z in product(range(2), repeat=3)}
    rows = at_centre(Tensors(samples), block)
    terms = [{(centre, unit): weight for centre, unit, weight in mask} for mask in spline.masks_of_octahedra]
    keys = sorted(set().union(*terms))
    masks = [[mask.get(key, 0.0) for key in keys] for mask in terms]
    for parity in product((0, 1), repeat=3):
        every_second = tuple(slice(p, None, 2) for p in parity)
        count = [len(range(p, n - 4, 2)) for p, n in zip(parity, samples.shape, strict=True)]
        if 0 not in count:
            yield every_second, [_turned_row(rows, parity, count, *key) for key in keys], masks


def _turned_row(rows: Rows, parity: Sequence[int], count: Sequence[int], centre: Steps, unit: Steps) -> Tensor:
    """Of every second cube along z, y, x: eight times a value, or four times a derivative, at twice a centre."""
    sides = [1 - 2 * p for p in parity]
    first = [2 + p + (side * c - 1) // 2 for p, side, c in zip(parity, sides, reversed(centre), strict=True)]
    row = _from(rows[unit], first, count, 2)
    return -row if any(side < 0 and u for side, u in zip(sides, reversed(unit), strict=True)) else row


def _from(values: Tensor, first: Sequence[int], count: Sequence[int], step: int) -> Tensor:
    """As many numbers from a place on along every axis, so many steps apart."""
    return values[tuple(slice(a, a + step * (n - 1) + 1, step) for a, n in zip(first, count, strict=True))]


def largest_of_windows(values: Tensor, size: int) -> Tensor:
    """The greatest of every window of size³; NaN where one is."""
    for dim in range(3):
        values = values.unfold(dim, size, 1).amax(-1)
    return values
