"""Bounds of a field's values by brick: what lies in the brick whatever is asked of it, a level, a transfer function.

The polynomial of a cell lies between its least and greatest Bernstein coefficient, Σ over taps of coefficient times
Bernstein coefficient of the tap's weight, axis by axis. That is exact about kernels with negative lobes and prefiltered
coefficients that overshoot: bounds of the taps alone let through up to ten times as many cells. Where cells meet, a
continuous field has the same coefficients in both: they are computed once.

    coefficients ──▶ Bernstein coefficients, a few layers at a time ──▶ least and greatest of every part of a brick

Built once for a volume, in float64, and kept as codes of 16 bits; then a level costs two comparisons a part. A part
with a coefficient that is not finite may hold anything.
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
from filterlab.ops.raycast import marks_of
from filterlab.ops.stencil import Product

_MANY = 1 << 25  # cells from which on bricks have edges of 4, not 2
_AT_ONCE = 8
"""Cells along z whose taps are summed together. Measured (128³, one core): 2 take 1.1 to 2 times as long (trilinear,
tricubic: taps are read again), 32 up to 2.8 times (they leave the cache)."""
_NUMBERS_AT_ONCE = 1 << 24
"""The same on a GPU, in coefficients: there a small operation costs as much as one of millions of numbers."""
_CODES = 1 << 16
_USUAL = (0.0005, 0.9995)  # quantiles of coefficients that are told apart
_WIDER = 0.5  # of what lies between them, on either side: Bernstein coefficients overshoot
_ASKED = 40  # coefficients along each axis whose quantiles these are
_ROUNDING = 64  # units of rounding that a sum of taps may lose, relative to Σ |w| · max |c|


@dataclass(frozen=True)
class Codes:
    """Numbers as integers of 16 bits: code k stands for [start + k step, start + (k + 1) step).

    The first code also stands for whatever is less, the last one for whatever is greater: outliers cost no precision.
    """

    start: float
    step: float

    @classmethod
    def of(cls, lattice: Lattice, least: float, most: float) -> Codes:
        """For values of a lattice whose finite coefficients lie between `least` and `most`."""
        c = lattice.coefficients.detach()
        some = c[tuple(slice(None, None, max(1, n // _ASKED)) for n in c.shape)].double()
        some = some[some.isfinite()]
        ends = some.quantile(some.new_tensor(_USUAL)).tolist() if len(some) else [least, most]
        if not ends[0] < ends[1]:
            ends = [least, most]
        first, last = sorted(lattice.scale * x + lattice.shift for x in ends)
        more = _WIDER * (last - first)
        step = (last - first + 2 * more) / _CODES
        return cls(first - more, step) if 0 < step < math.inf else cls(first, 1.0)

    def __call__(self, values: Tensor, if_none: float) -> Tensor:
        """int16, from the least number of 16 bits on; of NaN those of another number."""
        codes = ((values - self.start) / self.step).floor_().nan_to_num_(nan=if_none)
        return codes.clamp_(0, _CODES - 1).sub_(_CODES // 2).to(torch.int16)

    def of_number(self, value: float) -> int:
        return int(self(torch.tensor(value, dtype=torch.float64), 0))

    def least(self, codes: Tensor) -> Tensor:
        """float64, what values of these codes are not less than."""
        k = codes.double() + _CODES // 2
        return torch.where(k == 0, -math.inf, self.start + k * self.step)

    def most(self, codes: Tensor) -> Tensor:
        """float64, what values of these codes are not greater than."""
        k = codes.double() + _CODES // 2
        return torch.where(k == _CODES - 1, math.inf, self.start + (k + 1) * self.step)


@dataclass(frozen=True)
class Ranges:
    """Between what values lie in the parts of bricks of `edge`³ cells, each of which has two along every axis.

    Attributes:
        low, high: (pz, py, px) int16, `codes` of the bounds of every part.
        codes: what they stand for.
        ends: the least and the greatest of all.
        largest: Σ |w| · max |c|, what rounding of a sum is relative to.
        edge: cells along an edge of a brick.
        continuous: whether the field is: else a jump over a level may lie between bricks that don't hold it.
    """

    low: Tensor
    high: Tensor
    codes: Codes
    ends: tuple[float, float]
    largest: float
    edge: int
    continuous: bool = True
    _marks: dict[tuple[float, torch.dtype], Tensor] = field(default_factory=dict, repr=False, compare=False)

    def may_hold(self, level: float, dtype: torch.dtype) -> Tensor:
        """Which parts may hold the level, (pz, py, px), where values are computed in a dtype."""
        if not self.continuous:
            return torch.ones_like(self.low, dtype=torch.bool)
        margin = _ROUNDING * torch.finfo(dtype).eps * self.largest
        below, above = (self.codes.of_number(x) for x in (level - margin, level + margin))
        if level + margin < self.ends[0] or level - margin > self.ends[1]:  # only what may hold anything
            below, above = (self.codes.of_number(x) for x in (math.inf, -math.inf))
        if self.low.device.type == "cpu":  # numpy compares short integers in a tenth of torch's time
            return torch.from_numpy((self.low.numpy() <= above) & (self.high.numpy() >= below))
        return (self.low <= above) & (self.high >= below)

    def marks(self, level: float, dtype: torch.dtype) -> Tensor:
        """`ops.raycast.marks_of` the same; those last asked for are kept."""
        found = self._marks.get((level, dtype))
        if found is None:
            found = marks_of(self.may_hold(level, dtype))
            self._marks.clear()
            self._marks[level, dtype] = found
        return found


_known: WeakTensorKeyDictionary = WeakTensorKeyDictionary()
"""Of coefficients that are still alive: {what was asked of them: (their version, ranges)}."""


def edge_for(lattice: Lattice) -> int:
    """Cells along an edge of a brick: bounds take 4 bytes a cell, or, of large volumes, ½.

    Measured (Marschner-Lobb 128³, trilinear to tricubic): with edges of 2 rays take EDGE of the time that they take
    with 4, and with bounds of parts 0.92 to 0.80 of what they took with those of bricks of 2 alone.
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
    c = lattice.coefficients.detach()
    finite = torch.where(c.isfinite(), c, 0) if c.is_floating_point() else c
    least, most = (float(x) for x in finite.aminmax())
    codes = Codes.of(lattice, least, most)
    parts, ends = [], (math.inf, -math.inf)
    for low, high in layers_of(lattice, edge // 2):
        parts.append((codes(low, 0), codes(high, _CODES)))
        ends = (
            min(ends[0], float(low.nan_to_num(math.inf).min())),
            max(ends[1], float(high.nan_to_num(-math.inf).max())),
        )
    low, high = (torch.cat(own) for own in zip(*parts, strict=True))
    largest = abs(lattice.scale) * max(abs(least), abs(most)) * _norm(lattice) + abs(lattice.shift)
    return Ranges(low, high, codes, ends, largest, edge, lattice.continuous)


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
    """(low, high) of a few layers of bricks of `edge`³ cells after the others, (…, by, bx) float64 each.

    No more than these are in memory. NaN where a coefficient is not finite.
    """
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
