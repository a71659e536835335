"""Splines of heights in plain torch: their Bernstein coefficients, and their value and derivatives at points.

Letters: N grids, P points, K data that a triangle needs, B = 15 coefficients of one. Points are placed in float64,
whatever their type: their coordinates may be large. At points the coefficients of f − f(V0) are summed, so that neither
value nor derivatives lose the digits that heights have in common; f(V0) is added to the value in the end.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import torch
from torch import Tensor

from filterlab import bernstein
from filterlab.ops.heights import Heights, Pattern, Triangle, differences, rows
from filterlab.volume import Boundary

AT_ONCE = 1 << 13
"""Points whose data are read together: (K, P) numbers stay in cache."""


def patches(heights: Heights, cells: Tensor, dtype: torch.dtype) -> Tensor:
    """Bernstein coefficients (N, P, 2, 15) of both triangles, up and down, of cells (P, 2): column, row, any integers.

    Coefficients on the edge of two triangles are the same for both, to the bit. Those of a triangle that needs a NaN
    are all NaN. Differentiable in the heights.
    """
    pair = heights.pattern.up, heights.pattern.down
    return torch.stack([_of_triangle(heights, cells, triangle, dtype) for triangle in pair], -2)


def _of_triangle(heights: Heights, cells: Tensor, triangle: Triangle, dtype: torch.dtype) -> Tensor:
    steps, weights = _table(triangle)
    place = heights.pattern.steps * cells[:, None] + steps.to(cells.device)  # (P, K, 2)
    found = [_read(heights, values[None], place.movedim(1, 0), 0) for values in heights.values]
    data = torch.stack(found).to(dtype)  # (N, K, P)
    return _product(weights.to(data), data).movedim(1, -1)


def jet(heights: Heights, points: Tensor, order: int) -> Tensor:
    """The rows (N, R, P) of `ops.heights.rows` at world points (N, P, 2), in their type; order 0 to 4.

    NaN where a coordinate is not finite, and in holes. Differentiable twice in heights and points, by autograd.
    """
    n, m = points.shape[:2]
    parts = []
    for begin in range(0, max(n * m, 1), AT_ONCE):
        chunk = points.reshape(n * m, 2)[begin : begin + AT_ONCE]
        entry = torch.arange(begin, begin + len(chunk), device=points.device) // max(m, 1) if n > 1 else 0
        parts.append(_rows(heights, chunk, entry, order))
    return torch.cat(parts, -1).reshape(len(rows(order)), n, m).movedim(0, 1)


def _rows(heights: Heights, points: Tensor, entry: Tensor | int, order: int) -> Tensor:
    """(R, P) of points (P, 2) on the grids (P,)."""
    pattern = heights.pattern
    at = Located.of(heights, points)
    data = _read(heights, heights.values, at.samples(pattern), entry).to(points.dtype)
    unknown = data.detach().isnan().any(0) | at.unknown
    data = torch.where(unknown, 0, data)
    base = torch.where(at.up, data[pattern.up.first], data[pattern.down.first])
    coefficients = _coefficients(pattern, data - base, at.up)
    derivatives = _derivatives(coefficients.T, at.barycentric, order)
    scaled = torch.stack(derivatives) * at.factors(heights, order)
    scaled = torch.cat((scaled[:1] + base, scaled[1:]))
    return torch.where(unknown, torch.nan, scaled)


def _coefficients(pattern: Pattern, data: Tensor, up: Tensor) -> Tensor:
    """(15, P) of data (K, P), of every point its own triangle."""
    pair = [_product(_table(triangle)[1].to(data), data) for triangle in (pattern.up, pattern.down)]
    return torch.where(up, *pair)


@cache
def _table(triangle: Triangle) -> tuple[Tensor, Tensor]:
    """Samples (K, 2) and weights (15, K) as tensors."""
    return torch.tensor(triangle.samples), torch.tensor(triangle.weights, dtype=torch.float64)


def _product(weights: Tensor, data: Tensor) -> Tensor:
    """(B, K) times (..., K, P): one datum after the other, so that what a triangle gets depends on no other."""
    total = weights[:, 0, None] * data[..., None, 0, :]
    for k in range(1, weights.shape[1]):
        total = torch.addcmul(total, weights[:, k, None], data[..., None, k, :])
    return total


def _read(heights: Heights, values: Tensor, place: Tensor, entry: Tensor | int) -> Tensor:
    """Heights (K, P) at (column, row), (K, P, 2), of values (N, H, W) and the grids (P,)."""
    h, w = values.shape[-2:]
    column, row = (heights.boundary.source(x, size) for x, size in zip(place.unbind(-1), (w, h), strict=True))
    index = (entry * h + row) * w + column
    found = values.reshape(-1).index_select(0, index.reshape(-1)).reshape(index.shape)
    if heights.boundary is not Boundary.ZEROS:
        return found
    size = torch.tensor((w, h), device=place.device)
    return torch.where(((place >= 0) & (place < size)).all(-1), found, found.new_zeros(()))


# --- where points are -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Located:
    """Where points are.

    Attributes:
        cell: (P, 2) integers, column and row.
        up: (P,) whether in the first triangle of it.
        barycentric: λ (P, 3) in the type of the points.
        unknown: (P,) where a coordinate is not finite.
    """

    cell: Tensor
    up: Tensor
    barycentric: Tensor
    unknown: Tensor

    @classmethod
    def of(cls, heights: Heights, points: Tensor) -> Located:
        origin, spacing = (points.new_tensor(x, dtype=torch.float64) for x in (heights.origin, heights.spacing))
        place = (points.double() - origin) / (heights.pattern.steps * spacing)
        unknown = ~place.detach().isfinite().all(-1)
        place = torch.where(unknown[:, None], 0, place)
        cell = place.detach().floor()
        s, t = (place - cell).to(points.dtype).unbind(-1)
        s = 1 - s if heights.pattern.mirrored else s
        up = (s + t).detach() <= 1
        across = torch.where(up, s, 1 - s), torch.where(up, t, 1 - t)
        return cls(cell.long(), up, torch.stack((1 - across[0] - across[1], *across), -1), unknown)

    def samples(self, pattern: Pattern) -> Tensor:
        """(column, row) (K, P, 2) of the data that points need."""
        up, down = (_table(triangle)[0].to(self.cell.device)[:, None] for triangle in (pattern.up, pattern.down))
        return pattern.steps * self.cell + torch.where(self.up[:, None], up, down)

    def factors(self, heights: Heights, order: int) -> Tensor:
        """(R, P): derivatives along λ1 and λ2 times these are those along x and y."""
        turned = torch.where(self.up, 1.0, -1.0).to(self.barycentric)
        x, y = (turned / (heights.pattern.steps * d) for d in heights.spacing)
        x = -x if heights.pattern.mirrored else x
        return torch.stack([x**i * y**j for i, j in rows(order)])


def _derivatives(coefficients: Tensor, barycentric: Tensor, order: int) -> list[Tensor]:
    """R rows (P,) along λ1 and λ2, of coefficients (P, 15), by de Casteljau's algorithm."""
    found: list[Tensor] = []
    for own in range(order, -1, -1):
        steps = bernstein.degree_of(coefficients, 2) - own
        coefficients = bernstein.blossom(coefficients, [barycentric] * steps)
        left = coefficients.unbind(-1)
        sums = [[w * left[k] for k, w in differences(i, j).items()] for i, j in rows(own) if i + j == own]
        found = [*(sum(terms[1:], terms[0]) for terms in sums), *found]
    return found
