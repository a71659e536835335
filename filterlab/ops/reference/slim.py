"""Casting rays at blended quadrics in plain torch: what their programs compute, whatever the device.

Two walks for each sheet: where it ends, then all hits before that. Their number is not bounded.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
from torch import Tensor

from filterlab.ops.quadrics import CENTER, MATRIX, SQUARE, VECTOR, Rays, in_parts
from filterlab.ops.reference.quadrics import intersections, walk
from filterlab.ops.slim import INNER, LEAST_WEIGHT, OUTER, STEEP, Cover, Members, Sheets, behind, members_of

_RAYS_AT_ONCE = 1 << 18


def sheets(given: Cover, origins: Tensor, directions: Tensor, count: int, farthest: bool = False) -> Sheets:
    """The first sheets of rays (R, 3) in order, or the last ones, blended from behind, from the last on."""
    cast = lambda o, d: _of_part(given, Rays.of(given.quadrics.tree, o, d, farthest), count)  # noqa: E731
    return Sheets(*in_parts(cast, origins, directions, _RAYS_AT_ONCE))


def members(given: Cover, origins: Tensor, directions: Tensor, begin: Tensor, end: Tensor) -> Members:
    """All hits of rays (R, 3) with begin ≤ τ ≤ end (R,); rows in order."""
    rays = Rays.of(given.quadrics.tree, origins, directions, False)
    found = _Between(begin, end)
    walk(given.quadrics, intersections, rays, found)
    row, tau, place = (torch.cat(rows) for rows in zip(*found.all, strict=True))
    order = row.argsort(stable=True)
    return members_of(rays, given.quadrics.tree, row[order], tau[order], place[order])


def weight(square: Tensor) -> Tensor:
    """w by ρ², and the least weight."""
    inner = square <= INNER * INNER
    outside = torch.where(inner, 1, square).sqrt()  # no root of 0 in its derivative
    own = torch.where(inner, torch.exp(-STEEP * square), OUTER * (1 - outside).clamp_min(0) ** 2)
    return own + LEAST_WEIGHT


def _of_part(given: Cover, rays: Rays, count: int) -> Sheets:
    begin, found = torch.full_like(rays.first, -torch.inf), []
    for _ in range(count):
        ends = _Ends(given, begin, torch.full_like(begin, torch.inf).where(begin < torch.inf, -torch.inf))
        walk(given.quadrics, intersections, rays, ends)
        end = ends.limit.where(begin < torch.inf, torch.inf)
        found.append(_blended(given, rays, begin, end))
        begin = behind(end)
    written = Sheets(*(torch.stack(rows, 1) for rows in zip(*found, strict=True)))
    return written.of_rays(rays, given.quadrics.tree)


def _blended(given: Cover, rays: Rays, begin: Tensor, end: Tensor) -> tuple[Tensor, ...]:
    """τ, begin, end, normal and place (R,) of the hits in between."""
    found = _Between(begin, torch.where(end < torch.inf, end, -torch.inf))
    walk(given.quadrics, intersections, rays, found)
    ray, tau, place = (torch.cat(rows) for rows in zip(*found.all, strict=True))
    w, normal = _weighted(given, rays, ray, tau, place)
    rows = torch.cat((w[:, None], (w * tau)[:, None], w[:, None] * normal), 1)
    sums = rows.new_zeros(len(end), 5).index_add(0, ray, rows)
    most = torch.zeros_like(end).scatter_reduce(0, ray, w, "amax")
    best = torch.full_like(ray, -1).new_full((len(end),), -1)
    best = best.scatter_reduce(0, ray, torch.where(w == most[ray], place, -1), "amax")
    return (
        torch.where(sums[:, 0] > 0, sums[:, 1] / sums[:, 0], torch.inf),
        torch.where(end < torch.inf, begin, end),
        end,
        sums[:, 2:],
        best,
    )


def _weighted(given: Cover, rays: Rays, ray: Tensor, tau: Tensor, place: Tensor) -> tuple[Tensor, Tensor]:
    """w (P,) and n (P, 3) of hits."""
    leaf, lane = place // 8, place % 8
    row = given.quadrics.leaves[leaf, :, lane]
    y = rays.start[ray] + tau[:, None] * rays.along[ray] - row[:, CENTER]
    xx, yy, zz, xy, xz, yz = row[:, MATRIX].unbind(1)
    x, y_, z = y.unbind(1)
    turned = torch.stack((xx * x + xy * y_ + xz * z, xy * x + yy * y_ + yz * z, xz * x + yz * y_ + zz * z), 1)
    gradient = turned + row[:, VECTOR]
    size = gradient.norm(dim=1, keepdim=True)
    normal = gradient / torch.where(size > 0, size, 1)
    return weight((y * y).sum(1) / row[:, SQUARE]), normal


@dataclass
class _Ends:
    """Where sheets end that begin at τ (R,)."""

    given: Cover
    begin: Tensor
    limit: Tensor

    def take(self, ray: Tensor, tau: Tensor, place: Tensor) -> None:
        own = tau >= self.begin[ray]
        ray, tau, place = ray[own], tau[own], place[own]
        reach = self.given.offset * self.given.quadrics.leaves[place // 8, SQUARE, place % 8].sqrt()
        self.limit.scatter_reduce_(0, ray, tau + reach, "amin")


@dataclass
class _Between:
    """All hits of rays (R,) from begin to limit."""

    begin: Tensor
    limit: Tensor
    all: list[tuple[Tensor, Tensor, Tensor]] = field(default_factory=list)

    def __post_init__(self) -> None:
        none = self.begin.new_zeros(0, dtype=torch.int64)
        self.all.append((none, self.begin.new_zeros(0), none))

    def take(self, ray: Tensor, tau: Tensor, place: Tensor) -> None:
        own = (tau >= self.begin[ray]) & (tau <= self.limit[ray])
        self.all.append((ray[own], tau[own], place[own]))
