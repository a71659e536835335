"""Bounds of a field's values by brick: what lies in the brick whatever is asked of it, a level, a transfer function.

    coefficients ──▶ bounds of every part of a brick (`ops.bounds`) ──▶ which parts may hold a level ──▶ marks of bricks

Built once for a volume, in float64, and kept as codes of 16 bits, in blocks of 8³ parts; then a level costs two
comparisons a block, and two a part of those blocks that may hold it. A part with a coefficient that is not finite may
hold anything.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import torch
from torch import Tensor
from torch.utils.weak import WeakTensorKeyDictionary

from filterlab.ops.bounds import Codes
from filterlab.ops.differentiable.bounds import bits_of_blocks, bounds
from filterlab.ops.differentiable.raycast import marks_of_bits
from filterlab.ops.pieces import Lattice
from filterlab.ops.reference.bounds import layers_of, straddle, weights_of
from filterlab.ops.tetrahedra import AnyLattice, TetrahedralLattice

_MANY = 1 << 25  # cells from which on bricks have edges of 4, not 2
_EDGE = 8  # parts of a block
_ROUNDING = 64  # units of rounding that a sum of taps may lose, relative to Σ |w| · max |c|


@dataclass(frozen=True)
class Blocks:
    """Codes of bounds of parts, a block of `_EDGE`³ parts after the other; parts beyond the last hold nothing.

    Attributes:
        low, high: (K, e, e, e) int16, of every part of every block.
        least, most: (K,) int16, of blocks.
        blocks: their number along z, y, x; shape: that of parts.
    """

    low: Tensor
    high: Tensor
    least: Tensor
    most: Tensor
    blocks: tuple[int, int, int]
    shape: tuple[int, int, int]

    @classmethod
    def of(cls, low: Tensor, high: Tensor) -> Blocks:
        """From (pz, py, px) int16 each."""
        z, y, x = low.shape
        blocks = -(-z // _EDGE), -(-y // _EDGE), -(-x // _EDGE)
        ends = torch.iinfo(low.dtype)
        low, high = (_in_blocks(own, blocks, no) for own, no in ((low, ends.max), (high, ends.min)))
        return cls(low, high, low.flatten(1).amin(1), high.flatten(1).amax(1), blocks, (z, y, x))

    def straddling(self, below: int, above: int) -> Tensor:
        """(pz, py, px): which parts have codes on both sides, or between."""
        return self.in_order(straddle(self.low, self.high, below, above), self.shape)

    def bits(self, below: int, above: int) -> Tensor:
        """`ops.raycast.bits_of` the same, (bz, by, bx); of other blocks than straddle as a whole no part is read."""
        bits = bits_of_blocks(self.low, self.high, self.least, self.most, below, above)
        z, y, x = (-(-n // 2) for n in self.shape)
        return self.in_order(bits.view(torch.int32), (z, y, -(-x // 4))).view(torch.uint8)[..., :x].contiguous()

    def in_order(self, values: Tensor, shape: tuple[int, int, int]) -> Tensor:
        """(K, n, n, m) as an array that ends where the volume does."""
        z, y, x = shape
        whole = values.unflatten(0, self.blocks).permute(0, 3, 1, 4, 2, 5)
        a, b, c = (n * own for n, own in zip(self.blocks, values.shape[1:], strict=True))
        return whole.reshape(a, b, c)[:z, :y, :x].contiguous()


def _in_blocks(codes: Tensor, blocks: tuple[int, int, int], empty: int) -> Tensor:
    """(K, e, e, e)."""
    pad = [k for n, own in zip(reversed(blocks), reversed(codes.shape), strict=True) for k in (0, n * _EDGE - own)]
    z, y, x = blocks
    whole = torch.nn.functional.pad(codes, pad, value=empty).view(z, _EDGE, y, _EDGE, x, _EDGE)
    return whole.permute(0, 2, 4, 1, 3, 5).reshape(-1, _EDGE, _EDGE, _EDGE)


@dataclass(frozen=True)
class Ranges:
    """Between what values lie in the parts of bricks of `edge`³ cells, each of which has two along every axis.

    Attributes:
        parts: codes of the bounds of every part.
        codes: what they stand for.
        ends: the least and the greatest of all.
        largest: Σ |w| · max |c|, what rounding of a sum is relative to.
        edge: cells along an edge of a brick.
        off_trend: of every part, as in `ops.bounds.Bounds`.
    """

    parts: Blocks
    codes: Codes
    ends: tuple[float, float]
    largest: float
    edge: int
    off_trend: Tensor | None = None
    _marks: dict[tuple[float, torch.dtype], Tensor] = field(default_factory=dict, repr=False, compare=False)

    @property
    def low(self) -> Tensor:
        """(pz, py, px) int16, codes of the least of every part."""
        return self.parts.in_order(self.parts.low, self.parts.shape)

    @property
    def high(self) -> Tensor:
        """Of the greatest."""
        return self.parts.in_order(self.parts.high, self.parts.shape)

    def margin(self, dtype: torch.dtype) -> float:
        """What rounding may add to values that are computed in a dtype."""
        return _ROUNDING * torch.finfo(dtype).eps * self.largest

    def may_hold(self, level: float, dtype: torch.dtype) -> Tensor:
        """Which parts may hold the level, (pz, py, px), where values are computed in a dtype."""
        return self.parts.straddling(*self._codes_of(level, dtype))

    def _codes_of(self, level: float, dtype: torch.dtype) -> tuple[int, int]:
        """The least and the greatest that rounding may make of a level."""
        margin = self.margin(dtype)
        below, above = (self.codes.of_number(x) for x in (level - margin, level + margin))
        if level + margin < self.ends[0] or level - margin > self.ends[1]:  # only what may hold anything
            below, above = (self.codes.of_number(x) for x in (math.inf, -math.inf))
        return below, above

    def marks(self, level: float, dtype: torch.dtype) -> Tensor:
        """`ops.raycast.marks_of` the same; those last asked for are kept."""
        found = self._marks.get((level, dtype))
        if found is None:
            found = marks_of_bits(self.parts.bits(*self._codes_of(level, dtype)))
            self._marks.clear()
            self._marks[level, dtype] = found
        return found


_known: WeakTensorKeyDictionary = WeakTensorKeyDictionary()
"""Of coefficients that are still alive: {what was asked of them: (their version, ranges)}."""


def edge_for(lattice: AnyLattice) -> int:
    """Cells along an edge of a brick: bounds take 4 bytes a cell, or, of large volumes, ½; of splines twice that.

    Measured (Marschner-Lobb 128³, trilinear to tricubic): with edges of 2 rays take 0.98 to 0.88 of the time that they
    take with 4, and with bounds of parts 0.92 to 0.80 of what they took with those of bricks of 2 alone.
    """
    return 2 if math.prod(lattice.cells) < _MANY else 4


def ranges(lattice: AnyLattice, edge: int | None = None) -> Ranges:
    """Bounds of every brick; kept for as long as the coefficients are, and made anew after they were written to.

    Made anew every time for kernels that are tensors: these may change too.
    """
    grid, edge = lattice.coefficients.detach(), edge or edge_for(lattice)
    if grid.is_inference() or not lattice.exact:  # the former don't count how often they are written to
        return _made(lattice, edge)
    base = lattice.coefficients._base
    owner = lattice.coefficients if base is None else base
    asked = (grid.storage_offset(), grid.shape, grid.stride(), lattice.stencil, lattice.scale, lattice.shift, edge)
    kept: dict = _known.setdefault(owner, {})  # type: ignore[assignment]
    version, found = kept.get(asked, (None, None))
    if found is None or version != grid._version:
        found = _made(lattice, edge)
        kept[asked] = grid._version, found
    return found


def _made(lattice: AnyLattice, edge: int) -> Ranges:
    least, most = _ends(lattice.coefficients.detach())
    codes = Codes.of(lattice, least, most)
    low, high, ends, off_trend = bounds(lattice, edge // 2, codes)
    if not lattice.continuous:  # a jump over a level lies between parts of which neither may hold it
        low, high = _with_neighbours(low, torch.minimum), _with_neighbours(high, torch.maximum)
    largest = abs(lattice.scale) * max(abs(least), abs(most)) * _norm(lattice) + abs(lattice.shift)
    return Ranges(Blocks.of(low, high), codes, ends, largest, edge, off_trend)


def _with_neighbours(codes: Tensor, choose: Callable[[Tensor, Tensor], Tensor]) -> Tensor:
    """Of every part and those around it."""
    for dim in range(3):
        own, count = codes.clone(), codes.shape[dim] - 1
        for to, of in ((0, 1), (1, 0)):
            place = own.narrow(dim, to, count)
            place.copy_(choose(place, codes.narrow(dim, of, count)))
        codes = own
    return codes


def _ends(c: Tensor) -> tuple[float, float]:
    """The least and the greatest that is finite; 0 too where something is not."""
    least, most = (float(x) for x in c.aminmax())
    if math.isfinite(least) and math.isfinite(most):  # NaN is among neither then
        return least, most
    least, most = (float(x) for x in torch.where(c.isfinite(), c, 0).aminmax())
    return least, most


def _norm(lattice: AnyLattice) -> float:
    """At least Σ |w|, anywhere in a cell."""
    if isinstance(lattice, TetrahedralLattice):
        return lattice.spline.norm
    total = 0.0
    for product in lattice.row:
        size = abs(product.weight)
        for axis in range(3):
            size *= float(weights_of(product, axis, lattice).abs().sum(0).max())
        total += size
    return total


def straddling(lattice: Lattice, level: float) -> int:
    """How many cells have Bernstein coefficients on both sides of a level, or on it."""
    return sum(int(((low <= level) & (level <= high)).sum()) for low, high in layers_of(lattice, 1))
