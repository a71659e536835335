"""Covers of a torus: a graph of second order in each of many balls, as fits give them. Imports nothing of filterlab."""

from __future__ import annotations

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
