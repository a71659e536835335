"""Casting rays at a level in plain torch, from the pieces of whatever field.

Pieces whose Bernstein coefficients lie on one side of the level hold no crossing; in the others the root search of
`filterlab.roots` cannot miss one. Where a field jumps over the level between two pieces, that is a crossing too. Many
pieces can meet in a vertex of a partition, some of them no longer than rounding: where the level is that of the vertex,
signs of values in them tell nothing, and of crossings that rounding alone has apart the first counts.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from filterlab.ops.pieces import Lattice, Pieces
from filterlab.ops.raycast import PLACES_APART, Candidates, Raycast, Sheets, joined
from filterlab.ops.reference.pieces import in_cells, pieces_of_rays
from filterlab.roots import all_roots, first_root

PIECES_AT_ONCE = 1 << 19  # at most, of as many rays as may have so many
RAYS_AT_ONCE = 1 << 16  # whose crossings are sorted

Search = Callable[[Tensor, Tensor], Candidates]
"""What is found along rays (R, 3)."""


def first(given: Raycast, origins: Tensor, directions: Tensor) -> Tensor:
    """t (...) float64, where rays (..., 3) first meet the level; ∞ where they don't."""
    return first_of(_found(given), origins, directions, sum(given.lattice.cells))


def sheets(given: Raycast, origins: Tensor, directions: Tensor, asked: Sheets) -> Tensor:
    """t (..., k) float64 of crossings of rays (..., 3), in order, or from the last on; ∞ where there are no more."""
    return sheets_by(lambda o, d: candidates(given, o, d), origins, directions, asked)


def candidates(given: Raycast, origins: Tensor, directions: Tensor) -> Candidates:
    """The pieces of rays (R, 3) that may hold a crossing, ray by ray, in order."""
    return all_of(_found(given), origins, directions, sum(given.lattice.cells))


def _found(given: Raycast) -> Search:
    return lambda origins, directions: candidates_of(_pieces(given, origins, directions), given.level)


def _pieces(given: Raycast, origins: Tensor, directions: Tensor) -> Pieces:
    """The pieces of rays (R, 3) in bricks that may hold the level."""
    lattice = given.lattice
    assert isinstance(lattice, Lattice), "pieces on tetrahedra are a field's own"
    own = in_cells(origins, directions, given.geometry, lattice)
    return pieces_of_rays(own, lattice, given.dtype, given.edge, given.marks > 0)


def first_of(search: Search, origins: Tensor, directions: Tensor, most: int) -> Tensor:
    """t (...) of the first crossing among what a search finds, ∞ where none; `most` pieces, about, has a ray."""
    shape, origins, directions = origins.shape[:-1], origins.reshape(-1, 3), directions.reshape(-1, 3)
    t = origins.new_full((len(origins),), math.inf, dtype=torch.float64)
    for part in _parts(len(origins), most):
        found = search(origins[part], directions[part])
        within = torch.where(found.jump, 0, first_root(found.coefficients))
        t[part] = t[part].scatter_reduce(0, found.ray, found.t(within), "amin")
    return t.reshape(shape)


def sheets_by(search: Search, origins: Tensor, directions: Tensor, asked: Sheets) -> Tensor:
    """t (..., k), as `sheets`, among what a search finds."""
    flat = (x.reshape(-1, 3).split(RAYS_AT_ONCE) for x in (origins, directions))
    t = [sheets_of(search(o, d), d, asked) for o, d in zip(*flat, strict=True)]
    return torch.cat(t).reshape(*origins.shape[:-1], asked.count)


def all_of(search: Search, origins: Tensor, directions: Tensor, most: int) -> Candidates:
    """All that a search finds."""
    parts = []
    for part in _parts(len(origins), most):
        found = search(origins[part], directions[part])
        parts.append(found._replace(ray=found.ray + part.start))
    return joined(parts)


def _parts(rays: int, most: int) -> list[slice]:
    """Rays at a time, so that memory does not grow with their number."""
    step = max(1, PIECES_AT_ONCE // (most + 3))
    return [slice(first, first + step) for first in range(0, rays, step)] or [slice(0, 0)]


def candidates_of(pieces: Pieces, level: float) -> Candidates:
    """Those of some pieces that may hold a crossing."""
    c = pieces.coefficients - level
    low, high = c.aminmax(dim=-1) if len(c) else (c[:, 0], c[:, 0])
    jump, repeated = torch.zeros_like(pieces.ray, dtype=torch.bool), torch.zeros_like(pieces.ray, dtype=torch.bool)
    joined, before, after = pieces.joined[1:], c[:-1, -1], c[1:, 0]
    jump[1:] = joined & (before.sign() * after.sign() < 0)
    repeated[1:] = joined & (before == 0) & (after == 0)
    keep = ((low <= 0) & (high >= 0)) | jump
    rows = (pieces.ray, pieces.start[pieces.ray], pieces.near, pieces.far, c, jump, repeated)
    return Candidates(*(row[keep] for row in rows))


# --- sheets -----------------------------------------------------------------------------------------------------------


def sheets_of(found: Candidates, directions: Tensor, asked: Sheets) -> Tensor:
    """t (R, k) of all crossings in some pieces of rays (R, 3), as `sheets`."""
    within = all_roots(found.coefficients).t
    within = torch.where(found.repeated[:, None] & (within == 0), math.inf, within)
    jump = torch.where(found.jump, 0, torch.inf).to(within)
    every = found.t(torch.cat((jump[:, None], within), 1))
    hit = every < math.inf
    extent = asked.extent / directions.abs().amax(-1).double()
    ray, t = _told_apart(found.ray[:, None].expand_as(every)[hit], every[hit], extent)
    return _in_order(ray, t, t.new_full((len(extent), asked.count), math.inf), asked.farthest)


def _told_apart(ray: Tensor, t: Tensor, extent: Tensor) -> tuple[Tensor, Tensor]:
    """Rays and t (M,), ray by ray, in order: of crossings that rounding alone has apart the first.

    `extent` (R,) is that of the domain, in units of the direction.
    """
    order = t.argsort(stable=True)
    order = order[ray[order].argsort(stable=True)]
    ray, t = ray[order], t[order]
    again = torch.zeros_like(ray, dtype=torch.bool)
    near = t[1:] - t[:-1] <= PLACES_APART * torch.finfo(t.dtype).eps * (t + extent[ray])[1:]
    again[1:] = near & (ray[1:] == ray[:-1])
    return ray[~again], t[~again]


def _in_order(ray: Tensor, t: Tensor, empty: Tensor, farthest: bool) -> Tensor:
    """(R, k): crossings of rays in order, or from the last on, in the places of `empty`."""
    if farthest:
        ray, t = ray.flip(0), t.flip(0)
        order = ray.argsort(stable=True)
        ray, t = ray[order], t[order]
    rank = torch.arange(len(ray), device=ray.device) - torch.searchsorted(ray, ray)
    fits = rank < empty.shape[1]
    return empty.index_put((ray[fits], rank[fits]), t[fits])
