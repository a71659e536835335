"""Bounds of the polynomials on cells in plain torch.

Where cells meet, a continuous field has the same coefficients in both: they are computed once.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator

import torch
from torch import Tensor

from filterlab import bernstein
from filterlab.ops.bounds import CODES, Bounds, Codes, in_pairs, tells_off_trend
from filterlab.ops.pieces import Lattice
from filterlab.ops.raycast import bits_of
from filterlab.ops.reference import tetrahedra
from filterlab.ops.stencil import Product
from filterlab.ops.tetrahedra import AnyLattice, TetrahedralLattice

_AT_ONCE = 8
"""Cells along z whose taps are summed together. Measured (128³, one core): 2 take 1.1 to 2 times as long (trilinear,
tricubic: taps are read again), 32 up to 2.8 times (they leave the cache)."""
_NUMBERS_AT_ONCE = 1 << 24
"""The same on a GPU, in coefficients: there a small operation costs as much as one of millions of numbers."""


def bounds(lattice: AnyLattice, edge: int, codes: Codes) -> Bounds:
    """Those of parts of `edge`³ cells."""
    parts, ends = [], (math.inf, -math.inf)
    for low, high in layers_of(lattice, edge):
        parts.append((codes(low, 0), codes(high, CODES)))
        finite = low.isfinite() & high.isfinite()
        least, most = low.where(finite, math.inf).min(), high.where(finite, -math.inf).max()
        ends = min(ends[0], float(least)), max(ends[1], float(most))
    low, high = (torch.cat(own) for own in zip(*parts, strict=True))
    off_trend = [in_pairs(*own) for own in _layers_of_cubes(lattice, edge, True)] if tells_off_trend(lattice) else None  # type: ignore[arg-type]
    return Bounds(low, high, ends, None if off_trend is None else torch.cat(off_trend))


def bits_of_blocks(low: Tensor, high: Tensor, least: Tensor, most: Tensor, below: int, above: int) -> Tensor:
    """Which parts may hold a level: (K, 4, 4, 4) uint8, for each brick as in `ops.raycast.bits_of`.

    Args:
        low, high: (K, 8, 8, 8) int16, codes of the bounds of parts, of K blocks.
        least, most: (K,) int16, of blocks; of others than straddle as a whole no part is read.
        below, above: codes that the level lies between.
    """
    (some,) = straddle(least, most, below, above).nonzero(as_tuple=True)
    bits = torch.zeros(len(low), 4, 4, 4, dtype=torch.uint8, device=low.device)
    return bits.index_copy_(0, some, bits_of(straddle(low[some], high[some], below, above)))


def straddle(low: Tensor, high: Tensor, below: int, above: int) -> Tensor:
    """Which codes are on both sides of those of a level, or between."""
    if low.device.type == "cpu":  # numpy compares short integers in a tenth of torch's time
        return torch.from_numpy((low.numpy() <= above) & (high.numpy() >= below))
    return (low <= above) & (high >= below)


def layers_of(lattice: AnyLattice, edge: int) -> Iterator[tuple[Tensor, Tensor]]:
    """(low, high) of a few layers of bricks of `edge`³ cells after the others, (…, by, bx) float64 each.

    No more than these are in memory. NaN where a coefficient is not finite.
    """
    if isinstance(lattice, TetrahedralLattice):
        yield from _layers_of_cubes(lattice, edge)
        return
    values, (_, _, sz), (_, _, depth) = lattice.coefficients.detach(), lattice.supports, lattice.cells
    step = max(_cells_at_once(lattice) // edge, 1) * edge
    for first in range(0, depth, step):
        cells = min(step, depth - first)
        slab = values.narrow(0, first, cells + sz - 1).double()
        hull = lattice.scale * _hull(slab, lattice) + lattice.shift
        low = high = hull
        for dim, (own, shared) in enumerate(reversed(_columns(lattice))):
            asked = dim, own * edge, shared
            low, high = over_windows(torch.amin, low, *asked), over_windows(torch.amax, high, *asked)
        yield low, high


def _layers_of_cubes(
    lattice: TetrahedralLattice, edge: int, off_trend: bool = False
) -> Iterator[tuple[Tensor, Tensor]]:
    """The same of a spline on tetrahedra, f or f − t."""
    values, (_, _, size), (_, _, depth) = lattice.coefficients.detach(), lattice.supports, lattice.cells
    for first in range(0, depth, _AT_ONCE):
        cells = min(_AT_ONCE, depth - first)
        slab = lattice.scale * values.narrow(0, first, cells + size - 1).double() + lattice.shift
        low, high = tetrahedra.hulls_of_cubes(slab, lattice.spline, off_trend)
        for dim in range(3):
            low, high = over_windows(torch.amin, low, dim, edge, 0), over_windows(torch.amax, high, dim, edge, 0)
        yield low, high


def _cells_at_once(lattice: Lattice) -> int:
    if lattice.coefficients.device.type == "cpu":
        return _AT_ONCE
    a_layer = math.prod(n * own for n, (own, _) in zip(lattice.cells, _columns(lattice), strict=True))
    a_layer //= lattice.cells[2]
    return max(_AT_ONCE, _NUMBERS_AT_ONCE // a_layer)


def _columns(lattice: Lattice) -> list[tuple[int, int]]:
    """Coefficients along x, y, z that a cell has of its own, and that it shares: where both agree its last one is the
    next cell's first. Of degree 0 it has but one."""
    shared = [int(lattice.continuous and p > 0) for p in lattice.degrees]
    return [(p + 1 - both, both) for p, both in zip(lattice.degrees, shared, strict=True)]


def _hull(slab: Tensor, lattice: Lattice) -> Tensor:
    """Bernstein coefficients of all cells of a slab, along each axis cell by cell."""
    total = torch.zeros((), dtype=slab.dtype, device=slab.device)
    for product in lattice.row:
        part = slab
        for axis, (own, _) in enumerate(_columns(lattice)):
            part = _along(part, 2 - axis, weights_of(product, axis, lattice).to(slab.device), own)
        total = total + product.weight * part
    return total


def weights_of(product: Product, axis: int, lattice: Lattice) -> Tensor:
    """(S, p + 1): Bernstein coefficients of the weights of the taps, in the degree that is highest along the axis."""
    kernel = product.kernels[axis]
    table = bernstein.from_monomial(kernel.taps(torch.float64).detach())
    for _ in range(lattice.degrees[axis] - kernel.degree):
        table = bernstein.elevate(table, 1)
    spare = (lattice.supports[axis] - kernel.support) // 2
    return torch.nn.functional.pad(table, (0, 0, spare, spare))


def _along(values: Tensor, dim: int, weights: Tensor, own: int) -> Tensor:
    """Taps along an axis to coefficients: `own` of every cell, and the last one of the last cell."""
    support, columns = weights.shape
    cells = values.shape[dim] - support + 1
    found = torch.stack([_sum(values, dim, weights[:, i], cells) for i in range(own)], dim + 1).flatten(dim, dim + 1)
    if own == columns:
        return found
    last = _sum(values.narrow(dim, cells - 1, support), dim, weights[:, -1], 1)
    return torch.cat((found, last), dim)


def _sum(values: Tensor, dim: int, weights: Tensor, cells: int) -> Tensor:
    terms = [w * values.narrow(dim, t, cells) for t, w in enumerate(weights.tolist()) if w]
    return sum(terms[1:], terms[0]) if terms else torch.zeros_like(values.narrow(dim, 0, cells))


def over_windows(reduce: Callable[..., Tensor], values: Tensor, dim: int, step: int, shared: int) -> Tensor:
    """Along one axis what `reduce` makes of the numbers of every brick: `step`, and `shared` that the next reads too.

    The last brick may have fewer. Of three axes z goes first: it leaves rows along x as they are in memory.

    Args:
        reduce: torch.amin or torch.amax.
    """
    whole, left = divmod(values.shape[dim] - shared, step)
    parts = [reduce(values.unfold(dim, step + shared, step), -1)] if whole else []
    if left:
        parts.append(reduce(values.narrow(dim, whole * step, left + shared), dim, keepdim=True))
    return torch.cat(parts, dim)
