"""Rows of hits by rows of rays, in plain torch; differentiable."""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
from torch import Tensor

from filterlab.ops.hit_points import ByRays, OnRays


def points(origins: Tensor, directions: Tensor, t: Tensor, index: Tensor, reach: float) -> OnRays:
    """o + t d (M, 3) of rays (..., 3) that hit at t (...).

    Args:
        index: (M,) int64, the flat places in t of those that do.
        reach: the |o_k| of these rays from which on they are far.
    """
    o, d = chosen(index, t.shape, origins, directions)
    return OnRays(along(o, d, t.flatten().index_select(0, index)), bool((o.detach().abs() > reach).any()))


def by_rays(index: Tensor, shape: torch.Size, point: Tensor, gradient: Tensor) -> ByRays:
    """Rows (M, 3) of hits by rays of a shape."""
    normal = gradient / length(gradient)[..., None]
    at_points, gradients, normals = spread((point, gradient, normal), index, shape)
    return ByRays(at_points, gradients, normals, bool(gradient.isnan().any()))


def along(origins: Tensor, directions: Tensor, t: Tensor) -> Tensor:
    return origins + t[..., None] * directions


def length(vectors: Tensor) -> Tensor:
    """|v|, with a finite derivative where v is 0: there it is 1."""
    square = (vectors * vectors).sum(-1)
    return torch.where(square == 0, 1, square).sqrt()


def chosen(index: Tensor, shape: torch.Size, *rows: Tensor) -> list[Tensor]:
    """Of rows that broadcast to (*shape, k), those at flat places: (M, k)."""
    return [x.expand(*shape, x.shape[-1]).reshape(-1, x.shape[-1]).index_select(0, index) for x in rows]


def spread(rows: Sequence[Tensor], index: Tensor, shape: torch.Size) -> list[Tensor]:
    """Rows (M, …) at flat places of (*shape, …), 0 elsewhere."""
    joined = torch.cat([row.flatten(1) for row in rows], 1)
    out = joined.new_zeros(shape.numel(), joined.shape[1]).index_copy_(0, index, joined)
    parts = out.split([math.prod(row.shape[1:]) for row in rows], 1)
    return [part.reshape(*shape, *row.shape[1:]) for part, row in zip(parts, rows, strict=True)]
