"""Quadrics of which the surface is known: covers of a torus, and a sphere in tetrahedra.

Of the torus a graph of second order in each of many balls, as fits give them.
"""

from __future__ import annotations

import itertools
import math
from typing import NamedTuple

import torch
from torch import Tensor

MAJOR, MINOR = 1.0, 0.4


class CoverOf(NamedTuple):
    """Arguments of `Slim`."""

    centers: Tensor
    radii: Tensor
    A: Tensor
    b: Tensor
    c: Tensor


def torus(count: int, overlap: float = 6.0, dtype: torch.dtype = torch.float64) -> CoverOf:
    """About `count` balls whose centres are spread evenly; every point of it is in `overlap` balls.

    Of a graph z = (κ₁ x² + κ₂ y²) / 2 over the tangent plane, F = z − …, outside positive.
    """
    u, v = _spread(count)
    n = torch.stack((u.cos() * v.cos(), u.sin() * v.cos(), v.sin()), 1)
    centers = torch.stack((MAJOR * u.cos(), MAJOR * u.sin(), torch.zeros_like(u)), 1) + MINOR * n
    first = torch.stack((-u.sin(), u.cos(), torch.zeros_like(u)), 1)
    second = torch.linalg.cross(n, first)
    around, across = v.cos() / (MAJOR + MINOR * v.cos()), torch.full_like(v, 1 / MINOR)
    outer = lambda x: x[:, :, None] * x[:, None]  # noqa: E731
    A = (around[:, None, None] * outer(first) + across[:, None, None] * outer(second)) / 2
    area = 4 * math.pi**2 * MAJOR * MINOR
    radius = math.sqrt(overlap * area / (len(u) * math.pi))
    rows = centers, torch.full_like(u, radius), A, n / 2, torch.zeros_like(u)
    return CoverOf(*(x.to(dtype) for x in rows))


def _spread(count: int) -> tuple[Tensor, Tensor]:
    """Angles around and across the tube, rings as far apart as their points."""
    area = 4 * math.pi**2 * MAJOR * MINOR
    rings = max(3, round(2 * math.pi * MINOR / math.sqrt(area / count)))
    v = 2 * math.pi * torch.arange(rings, dtype=torch.float64) / rings
    own = (count * (MAJOR + MINOR * v.cos()) / (rings * MAJOR)).round().long().clamp_min(3)
    index = torch.cat([torch.arange(n, dtype=torch.float64) for n in own.tolist()])
    ring = torch.repeat_interleave(torch.arange(rings), own)
    return 2 * math.pi * (index + 0.5 * (ring % 2)) / own[ring], v[ring]


def distance(points: Tensor) -> Tensor:
    """(...) signed, of the torus, positive outside."""
    return torch.hypot(torch.hypot(points[..., 0], points[..., 1]) - MAJOR, points[..., 2]) - MINOR


class Clipped(NamedTuple):
    """Quadrics in tetrahedra: A (M, 3, 3), b (M, 3), c (M,) about the world's origin, and corners (M, 4, 3)."""

    A: Tensor
    b: Tensor
    c: Tensor
    corners: Tensor


def sphere(count: int) -> Clipped:
    """About `count` tetrahedra that the unit sphere passes through, each with the sphere as its quadric.

    Of cubes that are cut in six around a diagonal.
    """
    n = max(2, round(math.sqrt(count / _OF_A_GRID)))
    corners = _tetrahedra(_cubes(n), 2.4 / n)
    value = corners.square().sum(-1) - 1
    corners = corners[(value.amin(1) < 0) & (value.amax(1) > 0)]
    m, dtype = len(corners), torch.float64
    A = torch.eye(3, dtype=dtype).expand(m, 3, 3)
    return Clipped(A, torch.zeros(m, 3, dtype=dtype), torch.full((m,), -1.0, dtype=dtype), corners)


_OF_A_GRID = 15.0  # n² tetrahedra of a grid of n³ cubes are met by a sphere of 5/6 of its width


def _cubes(n: int) -> Tensor:
    """The lower corners (Q, 3) of the cubes that the sphere may pass through, in [−1.2, 1.2]³."""
    axis = torch.arange(n, dtype=torch.float64) * (2.4 / n) - 1.2
    near = []
    for x in axis:  # a layer at a time: n³ would not fit
        layer = torch.cartesian_prod(x[None], axis, axis)
        off = (layer + 1.2 / n).norm(dim=1) - 1
        near.append(layer[off.abs() <= 2.4 / n])
    return torch.cat(near)


def _tetrahedra(cubes: Tensor, side: float) -> Tensor:
    """(6 Q, 4, 3): from the lower to the upper corner along the axes in every order."""
    steps = torch.eye(3, dtype=cubes.dtype)[torch.tensor(list(itertools.permutations(range(3))))].cumsum(1)
    ways = torch.cat((torch.zeros(6, 1, 3, dtype=cubes.dtype), steps), 1)
    return (cubes[:, None, None] + side * ways).flatten(0, 1)
