"""Bounds of a field's values by brick: what lies in the brick whatever is asked of it, a level, a transfer function.

The polynomial of a cell lies between its least and greatest Bernstein coefficient, Σ over taps of coefficient times
Bernstein coefficient of the tap's weight, axis by axis. That is exact about kernels with negative lobes and prefiltered
coefficients that overshoot: bounds of the taps alone let through up to ten times as many cells. Where cells meet, a
continuous field has the same coefficients in both: they are computed once.

    coefficients ──▶ Bernstein coefficients, a few layers at a time ──▶ least and greatest of every brick

Built once for a volume, in float64; then a level costs two comparisons a brick. A brick with a coefficient that is not
finite has NaN for bounds, and may hold anything.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from filterlab import bernstein
from filterlab.ops.pieces import Lattice
from filterlab.ops.raycast import clear_of
from filterlab.ops.stencil import Product

_MANY = 1 << 25  # cells from which on bricks have edges of 4, not 2
_AT_ONCE = 8
"""Cells along z whose taps are summed together. Measured (128³, one core): 2 take 1.1 to 2 times as long (trilinear,
tricubic: taps are read again), 32 up to 2.8 times (they leave the cache)."""
_NUMBERS_AT_ONCE = 1 << 24
"""The same on a GPU, in coefficients: there a small operation costs as much as one of millions of numbers."""
_ROUNDING = 64  # units of rounding that a sum of taps may lose, relative to Σ |w| · max |c|


@dataclass(frozen=True)
class Ranges:
    """Between what values lie in bricks of `edge`³ cells.

    Attributes:
        low, high: (bz, by, bx) float64; NaN where a coefficient is not finite.
        largest: Σ |w| · max |c|, what rounding of a sum is relative to.
        edge: cells along an edge of a brick.
        continuous: whether the field is: else a jump over a level may lie between bricks that don't hold it.
    """

    low: Tensor
    high: Tensor
    largest: float
    edge: int
    continuous: bool = True
    _clear: dict[tuple[float, torch.dtype], Tensor] = field(default_factory=dict, repr=False, compare=False)

    def may_hold(self, level: float, dtype: torch.dtype) -> Tensor:
        """Which bricks may hold the level, (bz, by, bx), where values are computed in a dtype."""
        if not self.continuous:
            return torch.ones_like(self.low, dtype=torch.bool)
        margin = _ROUNDING * torch.finfo(dtype).eps * self.largest
        return ~((self.low > level + margin) | (self.high < level - margin))

    def clear(self, level: float, dtype: torch.dtype) -> Tensor:
        """`ops.raycast.clear_of` the same; the last one asked for is kept."""
        found = self._clear.get((level, dtype))
        if found is None:
            found = clear_of(self.may_hold(level, dtype))
            self._clear.clear()
            self._clear[level, dtype] = found
        return found


_known: WeakTensorKeyDictionary = WeakTensorKeyDictionary()
"""Of coefficients that are still alive: {what was asked of them: (their version, ranges)}."""


def edge_for(lattice: Lattice) -> int:
    """Cells along an edge of a brick: bounds take 2 bytes a cell, or, of large volumes, ¼.

    Measured: with edges of 2 rays look into half as many cells as with 4, and take 0.85 of the time (Marschner-Lobb
    128³, trilinear to tricubic).
    """
    return 2 if math.prod(lattice.cells) < _MANY else 4


def ranges(lattice: Lattice, edge: int | None = None) -> Ranges:
    """Bounds of every brick; kept for as long as the coefficients are, and made anew after they were written to.

    Made anew every time for kernels that are tensors: these may change too.
    """
    grid, edge = lattice.coefficients.detach(), edge or edge_for(lattice)
    if grid.is_inference() or not lattice.exact:  # the former don't count how often they are written to
        return _made(lattice, edge)
    base = lattice.coefficients._base
    owner = lattice.coefficients if base is None else base
    asked = (grid.storage_offset(), grid.shape, grid.stride(), lattice.row, lattice.scale, lattice.shift, edge)
    kept: dict = _known.setdefault(owner, {})  # type: ignore[assignment]
    version, found = kept.get(asked, (None, None))
    if found is None or version != grid._version:
        found = _made(lattice, edge)
        kept[asked] = grid._version, found
    return found


def _made(lattice: Lattice, edge: int) -> Ranges:
    low, high = (torch.cat(layers) for layers in zip(*layers_of(lattice, edge), strict=True))
    c = lattice.coefficients.detach()
    finite = torch.where(c.isfinite(), c, 0) if c.is_floating_point() else c
    least, most = finite.aminmax()
    largest = max(abs(float(least)), abs(float(most))) * _norm(lattice)
    return Ranges(low, high, abs(lattice.scale) * largest + abs(lattice.shift), edge, lattice.continuous)


def _norm(lattice: Lattice) -> float:
    """At least Σ |w|, anywhere in a cell."""
    total = 0.0
    for product in lattice.row:
        size = abs(product.weight)
        for axis in range(3):
            size *= float(_weights(product, axis, lattice).abs().sum(0).max())
        total += size
    return total


def layers_of(lattice: Lattice, edge: int) -> Iterator[tuple[Tensor, Tensor]]:
    """(low, high) of a few layers of bricks after the others, (…, by, bx) each: no more than these are in memory."""
    values, (_, _, sz), (_, _, depth) = lattice.coefficients.detach(), lattice.supports, lattice.cells
    step = max(_cells_at_once(lattice) // edge, 1) * edge
    for first in range(0, depth, step):
        cells = min(step, depth - first)
        slab = values.narrow(0, first, cells + sz - 1).double()
        hull = lattice.scale * _hull(slab, lattice) + lattice.shift
        low = high = hull
        for dim, own in enumerate(reversed(_columns(lattice))):
            asked = dim, own * edge, int(lattice.continuous)
            low, high = over_windows(torch.amin, low, *asked), over_windows(torch.amax, high, *asked)
        yield low, high


def _cells_at_once(lattice: Lattice) -> int:
    if lattice.coefficients.device.type == "cpu":
        return _AT_ONCE
    a_layer = math.prod(n * own for n, own in zip(lattice.cells, _columns(lattice), strict=True)) // lattice.cells[2]
    return max(_AT_ONCE, _NUMBERS_AT_ONCE // a_layer)


def straddling(lattice: Lattice, level: float) -> int:
    """How many cells have Bernstein coefficients on both sides of a level, or on it."""
    return sum(int(((low <= level) & (level <= high)).sum()) for low, high in layers_of(lattice, 1))


def _columns(lattice: Lattice) -> list[int]:
    """Coefficients along x, y, z that a cell has of its own: its last one is the next cell's first where both agree."""
    return [p if lattice.continuous else p + 1 for p in lattice.degrees]


def _hull(slab: Tensor, lattice: Lattice) -> Tensor:
    """Bernstein coefficients of all cells of a slab, along each axis cell by cell."""
    total = torch.zeros((), dtype=slab.dtype, device=slab.device)
    for product in lattice.row:
        part = slab
        for axis, own in enumerate(_columns(lattice)):
            part = _along(part, 2 - axis, _weights(product, axis, lattice).to(slab.device), own)
        total = total + product.weight * part
    return total


def _weights(product: Product, axis: int, lattice: Lattice) -> Tensor:
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
