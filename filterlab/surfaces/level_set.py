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
from filterlab.roots import MAX_DEGREE
from filterlab.surfaces.base import Hits, Surface


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
        return Hits(self.field.crossings(origins, directions, self._number, sheets, farthest))


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
