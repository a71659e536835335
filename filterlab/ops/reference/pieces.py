"""Pieces along rays in plain torch: cells passed, and the restriction of a tensor product in scaled Bernstein form.

Letters: L lines o + s d in coordinates of cells, P pieces, S taps and p degree of an axis, u ∈ [0, 1] place in a cell.

The weight of a tap is a polynomial of degree p in u; along the part of a ray from u₀ to u₁ it is one in t whose
Bernstein coefficients are the blossom at (u₀ p−j times, u₁ j times). In *scaled* form, times binom(p, j), products of
polynomials are convolutions of coefficients; with tables X, Y, Z (S, p + 1) of the three axes

    A[k, j, a] = Σ_i c[k, j, i] X[i, a],    B[k, ·] = Σ_j A[k, j, ·] ∗ Y[j, ·],    C = Σ_k B[k, ·] ∗ Z[k, ·],

and the coefficients are C[e] / binom(n, e). No sum cancels more than the taps themselves do.

Lines are measured from where they enter the domain, and places in a cell from its corner, not from the eye.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import comb
from typing import NamedTuple

import torch
from torch import Tensor

from filterlab import bernstein
from filterlab.geometry import Geometry, times_matrix
from filterlab.kernels import PiecewisePolynomial
from filterlab.ops.gather import extent
from filterlab.ops.pieces import NO_MOTION, Lattice, Pieces, Triple
from filterlab.ops.stencil import Product

CHUNK = 1 << 13  # pieces restricted at a time: their taps stay in the cache


class Lines(NamedTuple):
    """o + s d, near ≤ s ≤ far: (L, 3), (L, 3), (L,), (L,) float64."""

    origins: Tensor
    directions: Tensor
    near: Tensor
    far: Tensor

    def chosen(self, index: Tensor) -> Lines:
        return Lines(*(x.index_select(0, index) for x in self))

    def at(self, s: Tensor) -> Tensor:
        return self.origins + s[:, None] * self.directions


class Passed(NamedTuple):
    """Cells passed, line by line, in order: (P,) numbers of lines, (P, 3) cells, (P,) near and far."""

    line: Tensor
    cells: Tensor
    near: Tensor
    far: Tensor

    def where(self, mask: Tensor) -> Passed:
        return Passed(*(x[mask] for x in self))


# --- lines and cells --------------------------------------------------------------------------------------------------


def inside(origins: Tensor, directions: Tensor, lower: Triple, upper: Triple) -> tuple[Lines, Tensor, Tensor]:
    """(lines measured from where rays enter a closed box, which rays they are, t of every ray where it enters).

    Rays `(R, 3)` begin at their origins: nothing behind is seen. Of rays that miss the box there is no line.
    """
    low, high = origins.new_tensor(lower), origins.new_tensor(upper)
    still = directions.abs() <= NO_MOTION * directions.abs().amax(-1, keepdim=True)
    speed = torch.where(still, 1, directions)
    a, b = (low - origins) / speed, (high - origins) / speed
    within = (origins >= low) & (origins <= high)
    first = torch.where(still, torch.where(within, -torch.inf, torch.inf), torch.minimum(a, b)).amax(-1).clamp_min(0)
    last = torch.where(still, torch.where(within, torch.inf, -torch.inf), torch.maximum(a, b)).amin(-1)
    met = (first <= last).nonzero()[:, 0]
    start, moving = first[met], torch.where(still, 0, directions)[met]
    entry = (origins[met] + start[:, None] * moving).clamp(low, high)
    lines = Lines(entry, moving, torch.zeros_like(start), last[met] - start)
    return lines, met, torch.where(first <= last, first, 0)


def walk(lines: Lines, width: int, lower: Tensor, upper: Tensor) -> Passed:
    """The boxes of width³ cells that lines pass, each from one plane between boxes to the next.

    Where a line crosses a plane is (plane − o) / d, whoever asks: boxes on both sides get the same bits. Which boxes
    come follows from the number of planes crossed, not from places: through edges and corners the boxes follow one
    another by faces, some of them over no length.

    Args:
        lower, upper: (L, 3) int64, the least and greatest box that a line may be in.
    """
    first, last = (_box(lines.at(s), width, lower, upper) for s in (lines.near, lines.far))
    number = (last - first).abs()
    step = (last - first).sign()
    events = []
    for axis in range(3):
        j = torch.arange(int(number[:, axis].max()) if len(number) else 0, device=number.device)
        plane = first[:, axis, None] + step[:, axis, None] * j + (step[:, axis, None] > 0)
        speed = torch.where(step[:, axis] == 0, 1, lines.directions[:, axis])[:, None]
        s = (width * plane - lines.origins[:, axis, None]) / speed
        s = torch.minimum(torch.maximum(s, lines.near[:, None]), lines.far[:, None])
        events.append(torch.where(j < number[:, axis, None], s, torch.inf))
    axes = torch.cat([torch.full((e.shape[1],), axis, device=e.device) for axis, e in enumerate(events)])
    s, order = torch.cat(events, 1).sort(dim=1, stable=True)
    return _passed(lines, first, step, number.sum(1), s, axes[order])


def _box(points: Tensor, width: int, lower: Tensor, upper: Tensor) -> Tensor:
    return torch.minimum(torch.maximum((points / width).floor().long(), lower), upper)


def _passed(lines: Lines, first: Tensor, step: Tensor, count: Tensor, s: Tensor, axes: Tensor) -> Passed:
    """From events s (L, K) in order, of which each line has `count`, and the axis that each is a step along."""
    one = torch.nn.functional.one_hot(axes, 3) * step[:, None]
    cells = torch.cat((first[:, None], first[:, None] + one.cumsum(1)), 1)
    near = torch.cat((lines.near[:, None], s), 1)
    place = torch.arange(near.shape[1], device=near.device)
    far = torch.where(place == count[:, None], lines.far[:, None], torch.cat((s, lines.far[:, None]), 1))
    own = place <= count[:, None]
    line = torch.arange(len(near), device=near.device)[:, None].expand_as(near)
    return Passed(line[own], cells[own], near[own], far[own])


def cells_of(lines: Lines, lattice: Lattice, width: int = 1, relevant: Tensor | None = None) -> Passed:
    """The cells that lines pass; with a mask of bricks of width³ cells, (z, y, x), only those in bricks it has."""
    least = lines.origins.new_zeros(len(lines.near), 3, dtype=torch.int64)
    most = least + torch.tensor(lattice.cells, device=least.device) - 1
    if relevant is None:
        return walk(lines, 1, least, most)
    bricks = walk(lines, width, least, most.div(width, rounding_mode="floor"))
    x, y, z = bricks.cells.unbind(-1)
    bricks = bricks.where(relevant[z, y, x])
    parts = Lines(lines.origins[bricks.line], lines.directions[bricks.line], bricks.near, bricks.far)
    low = bricks.cells * width
    found = walk(parts, 1, low, torch.minimum(low + width - 1, most[bricks.line]))
    return found._replace(line=bricks.line[found.line])


# --- restriction ------------------------------------------------------------------------------------------------------


def pieces(lines: Lines, passed: Passed, lattice: Lattice, dtype: torch.dtype) -> Tensor:
    """(P, n + 1) Bernstein coefficients of the cells passed, in a dtype; not differentiable.

    Where two are neighbours on a line and the field is continuous, both have the value at the knot that the first has.
    """
    values = lattice.coefficients.detach()
    parts = [
        _restricted(values, lattice, passed.cells[part], *_places(lines, passed, part, dtype))
        for part in torch.arange(len(passed.line), device=values.device).split(CHUNK)
    ]
    out = torch.cat(parts) if parts else values.new_zeros((0, lattice.degree + 1), dtype=dtype)
    return joined(out, passed.line, passed.near, passed.far) if lattice.continuous else out


def _places(lines: Lines, passed: Passed, part: Tensor, dtype: torch.dtype) -> tuple[Tensor, Tensor]:
    """Where pieces begin and end in their cells, (P, 3) each, in [0, 1]."""
    line, cells = passed.line[part], passed.cells[part]
    origin, direction = lines.origins[line] - cells, lines.directions[line]
    near, far = ((origin + s[part, None] * direction).clamp(0, 1) for s in (passed.near, passed.far))
    return near.to(dtype), far.to(dtype)


def joined(coefficients: Tensor, line: Tensor, near: Tensor, far: Tensor) -> Tensor:
    """Coefficients (P, n + 1), written to: of two pieces that are neighbours both have the value that the first has."""
    last = coefficients[:-1, -1]
    same = (line[1:] == line[:-1]) & (near[1:] == far[:-1]) & last.isfinite()
    coefficients[1:, 0] = torch.where(same, last, coefficients[1:, 0])
    return coefficients


def _restricted(values: Tensor, lattice: Lattice, cells: Tensor, start: Tensor, end: Tensor) -> Tensor:
    taps = _taps(values, cells, lattice.supports).to(start.dtype)
    total = start.new_zeros(len(cells), lattice.degree + 1)
    for product in lattice.row:
        degree = sum(k.degree for k in product.kernels)
        total += product.weight * _elevated(_product(taps, product, start, end), lattice.degree - degree)
    binomials = start.new_tensor([comb(lattice.degree, e) for e in range(lattice.degree + 1)])
    return lattice.scale * (total / binomials) + lattice.shift


def _taps(values: Tensor, cells: Tensor, supports: Sequence[int]) -> Tensor:
    """(P, S_z, S_y, S_x)."""
    (sx, sy, sz), device = supports, cells.device
    strides = values.stride()
    z, y, x = (torch.arange(s, device=device) * stride for s, stride in zip((sz, sy, sx), strides, strict=True))
    offsets = (z[:, None, None] + y[:, None] + x).flatten()
    first = (cells * torch.tensor(strides[::-1], device=device)).sum(-1)
    flat = torch.as_strided(values, (extent(values),), (1,))
    return flat[first[:, None] + offsets].view(-1, sz, sy, sx)


def _product(taps: Tensor, product: Product, start: Tensor, end: Tensor) -> Tensor:
    """Scaled Bernstein coefficients of one product of kernels, without its weight."""
    own, tables = taps, []
    for axis, kernel in enumerate(product.kernels):
        spare = (taps.shape[3 - axis] - kernel.support) // 2
        own = own.narrow(3 - axis, spare, kernel.support)
        tables.append(_table(kernel, start[:, axis], end[:, axis]))
    x, y, z = tables
    a = times_matrix(own, x[:, None, None].movedim(-2, 0))  # (P, k, j, a)
    b = _contracted(a, y[:, None])  # (P, k, ·)
    return _contracted(b, z)


def _contracted(coefficients: Tensor, table: Tensor) -> Tensor:
    """Σ_j coefficients[…, j, ·] ∗ table[…, j, ·]."""
    n, p = coefficients.shape[-1], table.shape[-1] - 1
    out = coefficients.new_zeros(*coefficients.shape[:-2], n + p)
    for i in range(n):
        out[..., i : i + p + 1] += (coefficients[..., i, None] * table).sum(-2)
    return out


def _elevated(coefficients: Tensor, times: int) -> Tensor:
    """The same polynomials in scaled form with a degree that is higher: times (s + t)^times."""
    n = coefficients.shape[-1]
    out = coefficients.new_zeros(*coefficients.shape[:-1], n + times)
    for i in range(times + 1):
        out[..., i : i + n] += comb(times, i) * coefficients
    return out


def _table(kernel: PiecewisePolynomial, start: Tensor, end: Tensor) -> Tensor:
    """(P, S, p + 1): scaled Bernstein coefficients of the weights of all taps between two places in a cell."""
    taps = bernstein.from_monomial(kernel.taps(torch.float64, start.device).detach()).to(start.dtype)
    ends = (bernstein.on_interval(u)[:, None] for u in (start, end))
    restricted = bernstein.restrict(taps, *ends)
    return restricted * start.new_tensor([comb(kernel.degree, j) for j in range(kernel.degree + 1)])


def in_cells(origins: Tensor, directions: Tensor, geometry: Geometry, lattice: Lattice) -> tuple[Tensor, Tensor]:
    """Rays (R, 3) in the world, in coordinates of cells; float64, without derivatives."""
    own = geometry.to_voxel(origins.detach().double())
    return own - own.new_tensor(lattice.offset), geometry.direction_to_voxel(directions.detach().double())


def pieces_of_rays(
    rays: tuple[Tensor, Tensor], lattice: Lattice, dtype: torch.dtype, width: int = 1, relevant: Tensor | None = None
) -> Pieces:
    """The pieces of rays (origins, directions), (R, 3) float64 each in coordinates of cells."""
    lines, met, start = inside(*rays, lattice.lower, lattice.upper)
    passed = cells_of(lines, lattice, width, relevant)
    return Pieces(met[passed.line], passed.near, passed.far, pieces(lines, passed, lattice, dtype), start)
