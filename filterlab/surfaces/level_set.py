"""Level sets of fields, found exactly along rays: every crossing, and no other.

A field that is piecewise polynomial is a row of univariate polynomials along a ray. Bricks whose bounds leave out the
level are passed over; of the pieces left, those whose Bernstein coefficients lie on one side of it hold no root; in the
others the root search of `filterlab.roots` cannot miss one. Nothing is stepped, and a new level needs no preparation.

| case | what is a hit |
|---|---|
| f = level between two pieces | one hit: both have the same value there, to the bit |
| f = level where many pieces meet | one hit: places that rounding alone has apart are one |
| a ray touches the level | one hit, if it does within the rounding of the piece's coefficients (`filterlab.roots`) |
| a stretch of a ray lies on the level | one hit in every piece of it at most, the first where it begins |
| the field jumps over the level from one piece to the next | one hit, at the knot |
| a ray begins inside, or on the surface | as any other: a surface has no inside; t = 0 where f(o) = level |
| the surface leaves the domain | it ends there, open |
| coefficients that are not finite | no hit in cells that read them: the surface ends there, open |
| a level that no value has | no hit |
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property

import torch
from torch import Tensor

from filterlab.fields.base import Field, Relevant
from filterlab.roots import MAX_DEGREE, all_roots
from filterlab.surfaces.base import Hits, Surface

RAYS_AT_ONCE = 1 << 16  # whose sheets are sorted
_PLACES_APART = 32  # roundings of a place on a ray, up to which two are the same


class LevelSet(Surface):
    """The points where a field has a value: f = level.

    Args:
        field: unbatched. Piecewise polynomial along rays, of degree 9 at most: any method made of kernels of degree 3,
            or a signal that is a polynomial; or a signal with bounds or a step (`field.search` says what that finds).
        level: a finite number, or a tensor of no axes, in which hits are then differentiable.

    Raises:
        TypeError: no Field; one that is not searched. ValueError: a batched field, a higher degree, no finite level.
    """

    def __init__(self, field: Field, level: float | Tensor) -> None:
        self.field, self.level = _checked(field), _checked_level(level)
        self.domain, self.max_order = field.domain, field.max_order

    def __repr__(self) -> str:
        return f"LevelSet({self.field!r}, level={self._number:g})"

    @property
    def _number(self) -> float:
        return _number(self.level)

    def jet(self, points: Tensor, order: int, piece: Tensor | None = None) -> tuple[Tensor, ...]:
        value, *derivatives = self.field.jet(points, order)
        return value - self.level, *derivatives

    @property
    def tensors(self) -> tuple[Tensor, ...] | None:
        own, level = self.field.tensors, self.level
        return own if own is None or not isinstance(level, Tensor) else (*own, level)

    def with_tensors(self, tensors: Sequence[Tensor]) -> LevelSet:
        given, own = list(tensors), self.field.tensors or ()
        return LevelSet(self.field.with_tensors(given[: len(own)]), *(given[len(own) :] or [self.level]))

    @property
    def device(self) -> torch.device | None:
        return self.field.device

    @property
    def detached(self) -> LevelSet:
        """The same surface, of numbers that no derivatives are asked by; the level as it is now."""
        return LevelSet(self._detached_field, self._number)

    @cached_property
    def _detached_field(self) -> Field:
        """It shares the coefficients, and what is found out about them once."""
        return self.field.detached()

    def relevant(self) -> Relevant:
        """How many cells of the domain, and pieces in them, may hold the level: their coefficients straddle it."""
        return self.field.relevant(self._number)

    def _first(self, origins: Tensor, directions: Tensor) -> Hits:
        return Hits(self.field.first_crossing(origins, directions, self._number))

    def _sheets(self, origins: Tensor, directions: Tensor, sheets: int, farthest: bool) -> Hits:
        parts = zip(origins.split(RAYS_AT_ONCE), directions.split(RAYS_AT_ONCE), strict=True)
        return Hits(torch.cat([self._sheets_of_part(o, d, sheets, farthest) for o, d in parts]))

    def _sheets_of_part(self, origins: Tensor, directions: Tensor, sheets: int, farthest: bool) -> Tensor:
        found = self.field.crossing_candidates(origins, directions, self._number)
        within = all_roots(found.coefficients).t
        within = torch.where(found.repeated[:, None] & (within == 0), math.inf, within)
        jump = torch.where(found.jump, 0, torch.inf).to(within)
        every = found.t(torch.cat((jump[:, None], within), 1))
        hit = every < math.inf
        ray = found.ray[:, None].expand_as(every)[hit]
        ray, t = _told_apart(ray, every[hit], self._extent / directions.abs().amax(-1).double())
        empty = origins.new_full((len(origins), sheets), math.inf, dtype=torch.float64)
        return _in_order(ray, t, empty, farthest)

    @cached_property
    def _extent(self) -> float:
        """The diagonal of the domain, in the world."""
        corners = self.domain.corners()
        return float((corners - corners[:1]).norm(dim=-1).max())


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


def _checked(field: Field) -> Field:
    if not isinstance(field, Field):
        raise TypeError(f"a level set is that of a Field; got {type(field).__name__}")
    if field.channels is not None:
        raise ValueError("a level set is that of one channel: `select` it from this batched field")
    if field.search is None:
        raise TypeError(
            f"{field.no_pieces()}, and nothing else is known to find crossings by: a Signal is given its degree, "
            "bounds, or a step"
        )
    degree = field.degree_along_rays
    if degree is not None and degree > MAX_DEGREE:
        raise ValueError(f"degrees along a ray go up to {MAX_DEGREE}, kernels of degree 3; this field has {degree}")
    return field


def _checked_level(level: float | Tensor) -> float | Tensor:
    if isinstance(level, Tensor) and (level.ndim or not level.is_floating_point()):
        raise ValueError(f"level must be a number, or a floating-point tensor of no axes; got {tuple(level.shape)}")
    try:
        fine = math.isfinite(_number(level))
    except (TypeError, ValueError):
        fine = False
    if not fine:
        raise ValueError(f"level must be a finite number; got {level!r}")
    return level if isinstance(level, Tensor) else float(level)


def _number(level: float | Tensor) -> float:
    return float(level.detach()) if isinstance(level, Tensor) else float(level)
