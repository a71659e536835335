"""The one contract that everything downstream (renderers, metrics, experiments) relies on."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from filterlab.arrays import Array, as_tensor
from filterlab.geometry import Geometry
from filterlab.ops.pieces import Pieces
from filterlab.ops.raycast import Candidates, Sheets
from filterlab.ops.reference import raycast


@dataclass(frozen=True)
class Domain:
    """The box a field is defined on: a box in voxel coordinates, placed in the world by a geometry.

    Attributes:
        lower, upper: the box in voxel coordinates, x, y, z. For n voxels along an axis it is [−½, n−½]: whole cells.
        geometry: voxel -> world.
        voxel_size: world length of the shortest voxel edge; a renderer's step of 1 is this long.
    """

    lower: tuple[float, float, float]
    upper: tuple[float, float, float]
    geometry: Geometry = field(default_factory=Geometry)
    voxel_size: float = 1.0

    @classmethod
    def of_grid(cls, size: tuple[int, int, int], geometry: Geometry) -> Domain:
        """The domain of a grid of `size` (x, y, z) voxels."""
        upper = (size[0] - 0.5, size[1] - 0.5, size[2] - 0.5)
        return cls((-0.5, -0.5, -0.5), upper, geometry, min(geometry.spacing))

    def corners(self) -> Tensor:
        """The eight corners in the world, `(8, 3)` float64."""
        box = torch.tensor([self.lower, self.upper], dtype=torch.float64)
        return self.geometry.to_world(torch.cartesian_prod(*box.T))

    def relative_to(self, origin: Sequence[float]) -> Domain:
        """The same box in a world whose origin lies at `origin` of this one."""
        moved = tuple(a - float(b) for a, b in zip(self.geometry.origin, origin, strict=True))
        return replace(self, geometry=replace(self.geometry, origin=moved))

    @cached_property
    def center(self) -> tuple[float, float, float]:
        """World centre of the box."""
        return tuple(self.corners().mean(0).tolist())  # type: ignore[return-value]

    @cached_property
    def diagonal(self) -> float:
        """World length of the box's diagonal: the diameter of the sphere around it."""
        corners = self.corners()
        return 2 * max(math.hypot(*offset) for offset in (corners - corners.mean(0)).tolist())


class Named(Protocol):
    """What has a name."""

    @property
    def name(self) -> str: ...


@dataclass(frozen=True)
class ClosedForm:
    """The scheme of a field that is computed from its definition, with no coefficients."""

    name: str = "closed form"


class Relevant(NamedTuple):
    """How many cells, and pieces in them, may hold a level: their Bernstein coefficients straddle it."""

    cells: int
    pieces: int


class Field(ABC):
    """A function of space with value, gradient and (up to `max_order`) higher derivatives.

    Points are world points `(..., 3)` in x, y, z order, a tensor or a NumPy array. An unbatched field maps points `(*P,
    3)` to values `(*P)`, gradients `(*P, 3)` and Hessians `(*P, 3, 3)`; a batched one (`channels` is (N, C)) maps
    points `(N, *P, 3)` to `(N, C, *P)`, `(N, C, *P, 3)` and `(N, C, *P, 3, 3)`. Gradients are per world unit.
    Everything is computed in promote(points.dtype, float32), and is differentiable in the points and in whatever the
    field was built from.

    Far from the origin float32 points have lost their digits before a field sees them: a million voxels away they are
    multiples of 1/16 voxel. Give points in float64, or, to compute in float32, measured from a point nearby:
    `field.relative_to(origin)(points - origin)`.
    """

    domain: Domain
    scheme: Named = ClosedForm()
    max_order: int = 2
    channels: tuple[int, int] | None = None

    @property
    def degree_along_rays(self) -> int | None:
        """The degree of this field's pieces along a ray; None where it is not piecewise polynomial."""
        return None

    @property
    def search(self) -> str | None:
        """How crossings of a level are found along rays, and what that guarantees; None: they are not found."""
        degree = self.degree_along_rays
        return None if degree is None else f"exact: roots of pieces of degree {degree}"

    def pieces_along(self, origins: Tensor, directions: Tensor, level: float | None = None) -> Pieces:
        """The exact pieces of the field on the parts of rays that lie in its domain.

        Where `degree_along_rays` is a number n, f(o + t d) is a row of polynomials of degree n in t. Neighbouring
        pieces share their end values bit by bit, unless the field itself jumps.

        Args:
            origins, directions: (R, 3) world points, and directions of any length; nothing behind an origin is seen.
            level: when given, parts in which the field surely differs from it are left out.

        Returns:
            the pieces, in promote(origins, directions, float32); places along rays are float64. Not differentiable.

        Raises:
            TypeError: the field is not piecewise polynomial. ValueError: it is batched.
        """
        raise self.no_pieces()

    def first_crossing(self, origins: Tensor, directions: Tensor, level: float) -> Tensor:
        """Where rays first meet a level: t (...) float64 in units of the direction, ∞ where they don't.

        Args:
            origins, directions: as for `pieces_along`, (..., 3). Not differentiable.

        Raises:
            TypeError, ValueError: as `pieces_along` does.
        """
        return raycast.first_of(self._candidates_at(level), origins, directions, self._most_pieces())

    def crossings(self, origins: Tensor, directions: Tensor, level: float, count: int, farthest: bool) -> Tensor:
        """Where rays meet a level: t (..., count) float64, in order, or from the last on; ∞ where there are no more.

        Args:
            origins, directions: as for `first_crossing`.

        Raises:
            TypeError, ValueError: as `pieces_along` does.
        """
        search = lambda o, d: self.crossing_candidates(o, d, level)  # noqa: E731
        return raycast.sheets_by(search, origins, directions, self._sheets(count, farthest))

    def _sheets(self, count: int, farthest: bool) -> Sheets:
        return Sheets(count, farthest, self.domain.diagonal)

    def crossing_candidates(self, origins: Tensor, directions: Tensor, level: float) -> Candidates:
        """The pieces of rays that may hold a crossing of a level, those of a ray in order; the others hold none."""
        return raycast.all_of(self._candidates_at(level), origins, directions, self._most_pieces())

    def _candidates_at(self, level: float) -> raycast.Search:
        return lambda o, d: raycast.candidates_of(self.pieces_along(o, d, level), level)

    def _most_pieces(self) -> int:
        """About how many pieces a ray has."""
        return sum(math.ceil(b - a) + 1 for a, b in zip(self.domain.lower, self.domain.upper, strict=True))

    def relevant(self, level: float) -> Relevant:
        """How many cells of the domain, and pieces in them, may hold a level. Raises as `pieces_along` does."""
        raise self.no_pieces()

    def no_pieces(self) -> TypeError:
        """What to say where pieces are asked of a field that has none."""
        return TypeError(f"{type(self).__name__} ({self.scheme.name}) is not piecewise polynomial along rays")

    @abstractmethod
    def jet(self, points: Array, order: int) -> tuple[Tensor, ...]:
        """(value,), (value, gradient) or (value, gradient, Hessian) for order 0, 1, 2, in one pass."""

    def __call__(self, points: Array) -> Tensor:
        """Values at the points."""
        return self.jet(points, 0)[0]

    def value_and_gradient(self, points: Array) -> tuple[Tensor, Tensor]:
        """Values and gradients (per world unit) at the points, in one pass."""
        value, gradient = self.jet(points, 1)
        return value, gradient

    @property
    def device(self) -> torch.device | None:
        """Where what it was built from is; None: it is computed wherever the points are."""
        return None

    @property
    def requires_grad(self) -> bool:
        """Whether its values have derivatives of their own, by what it was built from; asked of one point."""
        center = torch.tensor([self.domain.center], dtype=torch.float64, device=self.device)
        return self.jet(center if self.channels is None else center[None], 0)[0].requires_grad

    @property
    def tensors(self) -> tuple[Tensor, ...] | None:
        """All numbers that it is made of and may have derivatives by; None: it cannot tell."""
        return None

    def with_tensors(self, tensors: Sequence[Tensor]) -> Field:
        """The same field, made of others in place of `tensors`."""
        raise TypeError(f"{type(self).__name__} ({self.scheme.name}) cannot tell its tensors")

    def detached(self) -> Field:
        """The same field, by whose own numbers no derivatives are asked; itself where it cannot tell them apart."""
        return self

    def select(self, n: int, c: int) -> Field:
        """The unbatched field of entry n and channel c of a batched one.

        Here it costs as much as the whole field; one given by coefficients gives a view of them.

        Raises:
            ValueError: this field is not batched.
            IndexError: no such entry or channel.
        """
        if self.channels is None:
            raise ValueError("select needs a batched field, (N, C); this one is unbatched")
        for name, index, count in zip(("entry", "channel"), (n, c), self.channels, strict=True):
            if not -count <= index < count:
                raise IndexError(f"expected an {name} of {count}; got {index}")
        return _Selected(self, n, c)

    def relative_to(self, origin: Sequence[float]) -> Field:
        """The same function of points that are measured from `origin`: g(p) = f(origin + p).

        origin + p is never rounded to the type of p, so that float32 points near `origin` keep their digits however far
        from the world's origin that is. Derivatives are those of f at origin + p.

        Args:
            origin: a world point x, y, z. It is taken as numbers, not differentiated.

        Raises:
            ValueError: not three finite numbers.
        """
        origin = _checked_origin(origin)
        return self if origin == (0.0, 0.0, 0.0) else self._relative_to(origin)

    def _relative_to(self, origin: tuple[float, float, float]) -> Field:
        return _Relative(self, origin)


class _Selected(Field):
    """Entry n and channel c of any batched field."""

    def __init__(self, field: Field, n: int, c: int) -> None:
        self.field, self.n, self.c = field, n, c
        self.domain, self.max_order, self.scheme = field.domain, field.max_order, field.scheme

    @property
    def device(self) -> torch.device | None:
        return self.field.device

    def jet(self, points: Array, order: int) -> tuple[Tensor, ...]:
        return tuple(x[self.n, self.c] for x in self.field.jet(points[None], order))


class _Relative(Field):
    """Any field in a world whose origin was moved; sums of points and origin are float64."""

    def __init__(self, field: Field, origin: tuple[float, float, float]) -> None:
        self.field, self.origin = field, origin
        self.domain, self.max_order, self.channels = field.domain.relative_to(origin), field.max_order, field.channels
        self.scheme = field.scheme

    @property
    def device(self) -> torch.device | None:
        return self.field.device

    def jet(self, points: Array, order: int) -> tuple[Tensor, ...]:
        points = check_points(points, self.channels)
        moved = points.double() + torch.tensor(self.origin, dtype=torch.float64, device=points.device)
        return tuple(row.to(points.dtype) for row in self.field.jet(moved, order))


def _checked_origin(origin: Sequence[float]) -> tuple[float, float, float]:
    try:
        x, y, z = (float(c) for c in origin)
    except (TypeError, ValueError):
        x = y = z = math.nan
    if not all(map(math.isfinite, (x, y, z))):
        raise ValueError(f"origin must be three finite numbers in x, y, z order; got {origin!r}")
    return x, y, z


_COMPUTED = torch.float32, torch.float64


def check_points(points: Array, channels: tuple[int, int] | None) -> Tensor:
    """The points in their compute type, promote(points, float32). Raises on a wrong type or shape."""
    points = as_tensor(points)
    if not isinstance(points, Tensor):
        raise TypeError(f"points must be a torch.Tensor or a NumPy array; got {type(points).__name__}")
    computed = points.dtype in _COMPUTED
    if not computed and (points.dtype.is_complex or points.dtype == torch.bool):
        raise TypeError(f"points must be real numbers; got {points.dtype}")
    if points.ndim == 0 or points.shape[-1] != 3:
        raise ValueError(f"points must have shape (..., 3) in x, y, z order; got {tuple(points.shape)}")
    if channels is not None and (points.ndim < 2 or points.shape[0] not in (1, channels[0])):
        raise ValueError(
            f"a batched field needs points of shape (N, ..., 3), N = {channels[0]} or 1; got {tuple(points.shape)}"
        )
    if computed:  # asked first: to find the type and convert to it takes microseconds to do nothing
        return points
    return points.to(torch.promote_types(points.dtype, torch.float32))


def type_of_rays(origins: Tensor, directions: Tensor) -> torch.dtype:
    """What rays are computed in: promote(origins, directions, float32)."""
    return torch.promote_types(torch.promote_types(origins.dtype, directions.dtype), torch.float32)


def check_order(order: int, max_order: int) -> None:
    """Raises ValueError unless 0 ≤ order ≤ max_order."""
    if not isinstance(order, int) or not 0 <= order <= max_order:
        raise ValueError(f"order must be an integer from 0 (value) to {max_order} here; got {order!r}")
