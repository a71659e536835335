"""Where on a volume errors are looked at: at points drawn where it has detail, weighted so that means stay unbiased.

Letters: V volumes of a batch, b a brick of 4³ voxels, a_b its activity, p_b = its share of the points, N points.

    every voxel ──▶ differences of order 2 and 4, across the ends as the boundary extends ──▶ a_b of every brick
    p_b ∝ part of the region in b + shares of a_b ──▶ N points, each with the weight (volume of b) / (N p_b)

A brick that holds all of the detail gets most of the points, however small it is; one that seems to have none gets its
share by volume all the same. Points come from a scrambled Sobol sequence in four dimensions, one along the running sum
of p_b and three within a brick: their means are as unbiased as those of random points, and spread less.

Of a level only bricks count whose samples, or those next to them, lie on both sides of it.

A volume of up to 160³ voxels is one patch. Of a larger one 24 patches of 16³ voxels are drawn in the same way, and cut
out with 24 voxels around them, over which what a prefilter carries from the cut falls below 10⁻¹³.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional
from torch.quasirandom import SobolEngine

from filterlab.volume import Boundary

INNER = 0.9
POINTS = 2**14
WHOLE = 160**3  # voxels in all, up to which nothing is cut out

_BRICK = 4
_REACH = 3  # voxels around one without a value
_PATCHES, _PATCH, _HALO = 24, 4, 24  # how many, bricks along an axis, voxels around
_WHOLE_VOLUMES = 32  # in a batch that is not cut
_SLAB = 2**22  # voxels whose differences are held at a time
_BY_VOLUME = 0.25  # of the points are spread evenly, whatever the activity

Size = Sequence[int]


def inner_box(size: Size) -> tuple[Tensor, Tensor]:
    """(lower, upper) corner, x, y, z in voxels, of the region that errors are averaged over.

    It is the inner 0.9 of the box that voxels fill, [−½, n − ½] along an axis, as far as it lies between the first and
    the last sample (all of it from n = 10).
    """
    n = torch.tensor([float(k) for k in reversed(size)], dtype=torch.float64)
    lower = (0.5 * (1 - INNER) * n - 0.5).clamp_min(0.0)
    return lower, n - 1 - lower


@dataclass(frozen=True)
class Patch:
    """A part of one volume of a batch, and the points in it.

    Attributes:
        samples: (D, H, W), what the reference is made of.
        extended: (D', H', W'), what fields are made of; under the boundary `wrap` its halo goes on at the other end.
        points: (P, 3) in voxels of `extended`, float32: what fields are asked.
        shift: from those to voxels of `samples`, x, y, z.
        weights: (P,), summing to about 1 over all points of all patches.
            but 0 for points that voxels without a value are within reach of.
        coarser: range of the volume ÷ range of `samples`.
    """

    samples: Tensor
    extended: Tensor
    points: Tensor
    shift: Tensor
    weights: Tensor
    coarser: float


def patches_of(
    samples: Tensor, unknown: Tensor | None, boundary: Boundary, random: SobolEngine, level: float | None = None
) -> list[Patch]:
    """Of samples (V, D, H, W), and a mask of the same shape of those that have no value; None: all have.

    With a level, of bricks that may hold it alone; none: there are none.
    """
    volume = torch.stack([_volume_of_bricks(samples.shape[1:])] * len(samples))  # (V, bd, bh, bw), in parts of 1
    if level is not None:
        volume = volume * torch.stack([_may_hold(level, one, boundary) for one in samples])
        if not bool(volume.any()):
            return []
    share = _share(volume / len(samples), samples, boundary)
    if samples.numel() <= WHOLE and len(samples) <= _WHOLE_VOLUMES:
        unit = random.draw(POINTS, dtype=torch.float64)
        bricks = _drawn(share, unit[:, 0])
        weights = (volume / len(samples) / share).flatten()[bricks] / POINTS
        v, *number = torch.unravel_index(bricks, share.shape)
        points = _within(torch.stack(number, -1), samples.shape[1:], unit[:, 1:]).float()
        return [_whole(samples, unknown, i, points[v == i], weights[v == i]) for i in v.unique().tolist()]
    return list(_cut_out(samples, unknown, boundary, volume / len(samples), share, random))


def _volume_of_bricks(size: Size) -> Tensor:
    """Which part of the region lies in each brick."""
    lower, upper = inner_box(size)
    parts = []
    for n, low, high in zip(size, lower.flip(0), upper.flip(0), strict=True):
        low_end, high_end = _ends_of_bricks(n, float(low), float(high))
        length = high_end - low_end
        parts.append(length / length.sum() if n > 1 else torch.ones(1, dtype=torch.float64))
    return parts[0][:, None, None] * parts[1][:, None] * parts[2]


def _may_hold(level: float, one: Tensor, boundary: Boundary) -> Tensor:
    """(bd, bh, bw): bricks of (D, H, W) whose samples, with one more on every side, lie on both sides of a level."""
    planes = _planes(one)
    slabs = (_slab(one, start, planes, boundary)[1:-1] for start in range(0, one.shape[0], planes))
    return torch.cat([_straddling(level, slab, boundary) for slab in slabs])


def _straddling(level: float, slab: Tensor, boundary: Boundary) -> Tensor:
    """Of a slab with one plane more on both sides."""
    wide = boundary.extend(boundary.extend(slab.double(), 1, 1, 1), 2, 1, 1)
    rest = [end for n in reversed(wide.shape) for end in (0, (2 - n) % _BRICK)]
    most, negated = (
        functional.max_pool3d(functional.pad(own, rest, value=-math.inf)[None], _BRICK + 2, _BRICK)[0]
        for own in (wide, -wide)
    )
    return (most >= level) & (-negated <= level)


def _ends_of_bricks(n: int, low: float, high: float) -> tuple[Tensor, Tensor]:
    """Along an axis of n voxels: the part of every brick, [4i − ½, 4i + 3½], that lies in [low, high]."""
    start = _BRICK * torch.arange(-(-n // _BRICK), dtype=torch.float64) - 0.5
    return start.clamp(low, high), (start + _BRICK).clamp(low, high)


def _share(volume: Tensor, samples: Tensor, boundary: Boundary) -> Tensor:
    """p_b: a quarter by volume, the rest by the roots of the activity of order 2 and of order 4."""
    total = _BY_VOLUME * volume
    active = [energy.sqrt() * (volume > 0) for energy in _activities(samples, boundary)]
    for root in active:
        amount = float(root.sum())
        even = root / amount if amount > 0 else volume
        total = total + (1 - _BY_VOLUME) / len(active) * even
    return total


def _activities(samples: Tensor, boundary: Boundary) -> tuple[Tensor, Tensor]:
    """Sums of squared differences of order 2 and 4 along all axes, (V, bd, bh, bw), in units that cancel.

    One pass over all voxels, in slabs.
    """
    low, high = (float(end) for end in samples.aminmax())
    planes = _planes(samples[0])
    found: tuple[list[Tensor], list[Tensor]] = ([], [])
    for one in samples:
        rows: tuple[list[Tensor], list[Tensor]] = ([], [])
        for start in range(0, one.shape[0], planes):
            slab = _scaled(_slab(one, start, planes, boundary), low, high)
            for row, energy in zip(rows, _energies(slab, boundary), strict=True):
                row.append(energy)
        for kept, row in zip(found, rows, strict=True):
            kept.append(torch.cat(row))
    return torch.stack(found[0]), torch.stack(found[1])


def _planes(one: Tensor) -> int:
    """Of (D, H, W), that are looked at at a time: whole bricks."""
    return max(1, _SLAB // (one[0].numel() * _BRICK)) * _BRICK


def _slab(one: Tensor, start: int, planes: int, boundary: Boundary) -> Tensor:
    """Planes start − 2 … start + planes + 1 of (D, H, W), as the boundary goes on beyond the ends."""
    n = one.shape[0]
    index = torch.arange(start - 2, min(start + planes, n) + 2, device=one.device)
    taken = one.index_select(0, boundary.source(index, n))
    if boundary is Boundary.ZEROS:
        taken = torch.where(((index >= 0) & (index < n))[:, None, None], taken, torch.zeros_like(taken[:1]))
    return taken


def _scaled(x: Tensor, low: float, high: float) -> Tensor:
    """float32, about −1 … 1: squares of what is small do not underflow."""
    return ((x.double() - low) / ((high - low) or 1.0)).float()


def _energies(slab: Tensor, boundary: Boundary) -> tuple[Tensor, Tensor]:
    """Of a slab with two planes more on both sides."""
    inside = slab[2:-2]
    sums = []
    for order in (2, 4):
        squared = torch.zeros_like(inside)
        for dim in range(3):
            wide = slab if dim == 0 else boundary.extend(inside, dim, 2, 2)
            spare = 2 - order // 2
            squared += torch.diff(wide.narrow(dim, spare, wide.shape[dim] - 2 * spare), n=order, dim=dim).square()
        brick = [min(_BRICK, n) for n in squared.shape]
        pooled = functional.avg_pool3d(squared[None, None], brick, ceil_mode=True, count_include_pad=False)
        sums.append(pooled[0, 0].double())
    return sums[0], sums[1]


def _drawn(share: Tensor, at: Tensor) -> Tensor:
    """The indices (P,) that positions in [0, 1) along the running sum of the shares fall on."""
    running = share.flatten().cumsum(0)
    return torch.searchsorted(running, at * running[-1], right=True).clamp_max(len(running) - 1)


def _within(number: Tensor, size: Size, unit: Tensor) -> Tensor:
    """Points (P, 3), x, y, z, from ones in the unit cube: each to its brick's part of the region (P, 3), z, y, x."""
    lower, upper = inner_box(size)
    columns = []
    for dim in (2, 1, 0):
        start, end = _ends_of_bricks(size[dim], float(lower[2 - dim]), float(upper[2 - dim]))
        start, end = start[number[:, dim]], end[number[:, dim]]
        columns.append(start + (end - start) * unit[:, dim])
    return torch.stack(columns, -1)


def _whole(samples: Tensor, unknown: Tensor | None, v: int, points: Tensor, weights: Tensor) -> Patch:
    weights = _counted(weights, points, None if unknown is None else unknown[v])
    return Patch(samples[v], samples[v], points, torch.zeros(3, dtype=torch.float64), weights, 1.0)


def _counted(weights: Tensor, points: Tensor, unknown: Tensor | None) -> Tensor:
    """Weights of points (P, 3) in a volume, 0 where a voxel of the mask (D, H, W) is within reach of a kernel."""
    if unknown is None:
        return weights
    near = functional.max_pool3d(unknown[None, None].float(), 2 * _REACH + 1, 1, _REACH)[0, 0] > 0
    x, y, z = points.round().long().unbind(-1)
    return weights * ~near[z, y, x]


def _cut_out(
    samples: Tensor,
    unknown: Tensor | None,
    boundary: Boundary,
    volume: Tensor,
    share: Tensor,
    random: SobolEngine,
) -> Iterator[Patch]:
    """Patches around cubes of bricks, drawn by the share of all of their bricks."""
    size = samples.shape[1:]
    cube = [min(_PATCH, k) for k in share.shape[1:]]
    cubes = functional.avg_pool3d(share[:, None], cube, ceil_mode=True, divisor_override=1)[:, 0]
    count = POINTS // _PATCHES
    for drawn in _drawn(cubes, random.draw(_PATCHES, dtype=torch.float64)[:, 0]):
        v, *first = (int(i) for i in torch.unravel_index(drawn, cubes.shape))
        first = [_PATCH * f for f in first]
        own = tuple(slice(f, f + _PATCH) for f in first)
        inside = share[v][own]
        unit = random.draw(count, dtype=torch.float64)
        bricks = _drawn(inside, unit[:, 0])
        weights = (volume[v][own] / inside).flatten()[bricks] / (count * _PATCHES)
        number = torch.stack(torch.unravel_index(bricks, inside.shape), -1) + torch.tensor(first)
        points = _within(number, size, unit[:, 1:])
        yield _around(samples[v], None if unknown is None else unknown[v], boundary, first, points, weights)


def _around(
    one: Tensor, unknown: Tensor | None, boundary: Boundary, first: list[int], points: Tensor, weights: Tensor
) -> Patch:
    """The patch at a cube whose first brick is `first`, with its halo."""
    inside, wrapped, start, shift = one, one, [0.0] * 3, [0.0] * 3
    weights = _counted(weights, points, unknown)
    for dim, n in enumerate(one.shape):
        low, high = _BRICK * first[dim] - _HALO, _BRICK * (first[dim] + _PATCH) + _HALO
        if high - low >= n:
            continue
        kept = torch.arange(max(low, 0), min(high, n), device=one.device)
        taken = torch.arange(low, high, device=one.device) % n if boundary is Boundary.WRAP else kept
        inside, wrapped = inside.index_select(dim, kept), wrapped.index_select(dim, taken)
        start[dim] = float(low if boundary is Boundary.WRAP else kept[0])
        shift[dim] = start[dim] - float(kept[0])
    origin = torch.tensor(start[::-1], dtype=torch.float64)
    moved = (points - origin).float()
    coarser = _range(one) / (_range(inside) or math.inf)
    return Patch(inside, wrapped, moved, torch.tensor(shift[::-1], dtype=torch.float64), weights, coarser)


def _range(samples: Tensor) -> float:
    low, high = samples.aminmax()
    return float(high) - float(low)
