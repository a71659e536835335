"""Sheets of a surface along rays: all roots of the pieces that may hold one, in order, each once."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from filterlab.ops.raycast import Candidates
from filterlab.roots import all_roots

_PLACES_APART = 32  # roundings of a place on a ray, up to which two are the same


def sheets_of(found: Candidates, extent: Tensor, sheets: int, farthest: bool) -> Tensor:
    """t (R, sheets) float64 of hits in order, or from the last on; ∞ where there are no more.

    Args:
        extent: (R,) of the domain, in units of the rays' directions.
    """
    within = all_roots(found.coefficients).t
    within = torch.where(found.repeated[:, None] & (within == 0), math.inf, within)
    jump = torch.where(found.jump, 0, torch.inf).to(within)
    every = found.t(torch.cat((jump[:, None], within), 1))
    hit = every < math.inf
    ray, t = _told_apart(found.ray[:, None].expand_as(every)[hit], every[hit], extent)
    return _in_order(ray, t, t.new_full((len(extent), sheets), math.inf), farthest)


def _told_apart(ray: Tensor, t: Tensor, extent: Tensor) -> tuple[Tensor, Tensor]:
    """Rays and t (M,), ray by ray, in order: of hits that rounding alone has apart the first.

    Many pieces can meet in a vertex of a partition, some of them no longer than rounding: where the level is that of
    the vertex, signs of values in them tell nothing. `extent` (R,) is that of the domain, in units of the direction.
    """
    order = t.argsort(stable=True)
    order = order[ray[order].argsort(stable=True)]
    ray, t = ray[order], t[order]
    again = torch.zeros_like(ray, dtype=torch.bool)
    near = t[1:] - t[:-1] <= _PLACES_APART * torch.finfo(t.dtype).eps * (t + extent[ray])[1:]
    again[1:] = near & (ray[1:] == ray[:-1])
    return ray[~again], t[~again]


def _in_order(ray: Tensor, t: Tensor, empty: Tensor, farthest: bool) -> Tensor:
    """(R, k): hits of rays in order, or from the last on, in the places of `empty`."""
    if farthest:
        ray, t = ray.flip(0), t.flip(0)
        order = ray.argsort(stable=True)
        ray, t = ray[order], t[order]
    rank = torch.arange(len(ray), device=ray.device) - torch.searchsorted(ray, ray)
    fits = rank < empty.shape[1]
    return empty.index_put((ray[fits], rank[fits]), t[fits])
