"""Terrains: heights on a grid as a quartic spline over triangles, a surface that rays hit.

    z = s(x, y),    F(x, y, z) = z − s(x, y):    F > 0 is above the ground

Nothing is stored but the heights: coefficients of a patch are made of them where they are asked. The datum in column c
and row r stands at origin + spacing · (c, r), so y grows with the rows; of a map whose first row is its north the
spacing along y is negative.

The domain is where the data are: [0, W − 1] × [0, H − 1] steps. A cell is m × m steps (`surfaces.quartic`), the first
ones begin at the first datum; where m does not divide W − 1, or a patch needs data beyond an edge, the heights go on by
the boundary. Along an axis of a single datum the domain is one step. Jets are given anywhere, of the extended data.

Letters: H rows, W columns, N grids; *P leading axes of points.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from numbers import Real
from typing import Any

import torch
from torch import Tensor

from filterlab.arrays import Array, all_finite, as_tensor
from filterlab.fields.base import Domain, check_order
from filterlab.missing_values import filled
from filterlab.names import NAN_CHOICES
from filterlab.ops import height_hits
from filterlab.ops import heights as described
from filterlab.ops.differentiable import height_hits as ops
from filterlab.ops.differentiable import heights as jets
from filterlab.ops.gather import STORAGE
from filterlab.ops.raycast import Sheets
from filterlab.ops.reference import heights as reference
from filterlab.surfaces import sight
from filterlab.surfaces.base import Hits, Surface, check_rays
from filterlab.surfaces.relief import Relief
from filterlab.volume import Boundary

_TYPES = {*STORAGE, torch.int64}
_WIDER = {torch.uint16: torch.int32, torch.uint32: torch.int64}  # torch reads none of these


class HeightField(Surface):
    """The ground z = s(x, y) of a quartic spline s of heights on a grid.

    Args:
        heights: (H, W), or (N, H, W) for jets of many; any H, W ≥ 1, real: it is neither copied nor converted, but
            for what `nan` says, and for uint16 and uint32, which become int32 and int64. World units. Differentiable.
        spline: "linear", "c0", "c1" or "c2"; `surfaces.quartic` says what each gives.
        spacing: world length of a step along x (columns) and y (rows), or one number for both; may be negative.
        origin: x, y of the first datum of the first row.
        boundary: how heights go on beyond their ends, as for volumes.
        diagonal: along which cells are cut: "main" from the corner (0, 0) to (1, 1) of (column, row), "anti" the other.
        prefilter: of "c2" only: its control values are 3/2 f − 1/12 Σ of the six neighbours, not f, and it has order 4.
        nan: of heights that are not finite: "refuse" raises; "propagate" leaves a hole, every patch that needs one of
            them, where jets are NaN and no ray hits; "fill" takes heights from around, in a copy.

    Attributes:
        heights: as they were given, or filled.
        spline: the `QuarticSpline`.
        cells: columns and rows of cells that hold the domain.

    Raises:
        TypeError, ValueError: no such heights; an unknown spline, boundary, diagonal; a step of length 0.
    """

    max_order = 2

    def __init__(
        self,
        heights: Array,
        spline: str = "c1",
        spacing: float | Sequence[float] = 1.0,
        origin: Sequence[float] = (0.0, 0.0),
        *,
        boundary: str | Boundary = Boundary.MIRROR,
        diagonal: str = "main",
        prefilter: bool = False,
        nan: str = "refuse",
    ) -> None:
        from filterlab.surfaces.quartic import quartic_spline  # it derives masks as exact fractions

        self.spline = quartic_spline(spline, prefilter)
        if diagonal not in described.DIAGONALS:
            raise ValueError(f"diagonal must be one of {', '.join(described.DIAGONALS)}; got {diagonal!r}")
        self.boundary, self.diagonal = Boundary.named(boundary), diagonal
        self.spacing, self.origin = _checked_spacing(spacing), _pair("origin", origin)
        self.heights = _resolved(_checked_heights(heights), nan)
        self._kept: dict[str, Any] = {}  # what is cast, and of which version of the heights

    def __repr__(self) -> str:
        rows, columns = self.heights.shape[-2:]
        return f"HeightField({rows} x {columns}, spline={self.spline.name!r}, boundary={str(self.boundary)!r})"

    # --- the function of the plane ---

    def jet(self, points: Array, order: int = 1, piece: Tensor | None = None) -> tuple[Tensor, ...]:
        """Height, slope and curvature anywhere.

        Args:
            points: (*P, 2), x and y in the world; (N, *P, 2) of N grids. Or (*P, 3): then F = z − s(x, y) and its
                derivatives are returned, as of any surface.
            order: 0, 1 or 2.

        Returns:
            z (*P); ∇z (*P, 2); the Hessian (*P, 2, 2); up to the order, per world unit, in promote(points, float32).
            NaN in holes and where a coordinate is not finite. Of a spline of continuity r derivatives beyond r jump
            between patches: there, those of one of them. Differentiable twice in heights and points.

        Raises:
            TypeError, ValueError: no such points, or another order.
        """
        points = self._checked_points(points)
        check_order(order, self.max_order)
        return self._implicit(points, order) if points.shape[-1] == 3 else self._explicit(points, order)

    def relief(self, points: Array, order: int = 2) -> Relief:
        """Slope, aspect and curvatures anywhere: `Relief` says what, and in which units.

        Args:
            points: as for `jet`, (*P, 2).
            order: 1 for slope and aspect, 2 for curvatures too.

        x must go to the east and y to the north, in the unit of the heights. Differentiable and raises as `jet`.
        """
        if order not in (1, 2):
            raise ValueError(f"order must be 1 or 2; got {order!r}")
        points = self._checked_points(points)
        if points.shape[-1] != 2:
            raise ValueError(f"points must have shape (..., 2): x, y; got {tuple(points.shape)}")
        return Relief(*self._explicit(points, order))

    @property
    def places(self) -> Tensor:
        """(H, W, 2) float64: x and y of all data in the world."""
        rows, columns = (torch.arange(n, device=self.device, dtype=torch.float64) for n in self.heights.shape[-2:])
        x, y = (o + d * n for o, d, n in zip(self.origin, self.spacing, (columns, rows), strict=True))
        return torch.stack(torch.meshgrid(x, y, indexing="xy"), -1)

    def viewshed(
        self,
        observer: Array | Sequence[float],
        height: float = 1.7,
        target: float = 0.0,
        points: Array | None = None,
        *,
        earth_radius: float | None = None,
        refraction: float = sight.REFRACTION,
    ) -> Tensor:
        """Which places an observer sees: those to whom the straight line meets no ground before its last 10⁻⁹.

        Args:
            observer: x, y in the world, (2,), over the domain.
            height: of the eye above the ground there, in the unit of the heights.
            target: of what is looked at above the ground.
            points: (*P, 2), x and y; None: all data, (H, W).
            earth_radius: R, in the unit of heights, x and y: ground at a distance d lies (1 − k) d² / (2 R) lower.
                `surfaces.sight.EARTH_RADIUS` is that in metres. None: a flat earth.
            refraction: k.

        Returns:
            (*P) bool; False in holes. Nothing is recorded.

        Raises:
            ValueError: an observer in a hole, or of another shape; a radius that is not positive.
        """
        return sight.viewshed(self, observer, height, target, points, earth_radius, refraction)

    def horizon(
        self,
        observer: Array | Sequence[float],
        azimuths: Array | Sequence[float],
        height: float = 1.7,
        *,
        earth_radius: float | None = None,
        refraction: float = sight.REFRACTION,
    ) -> Tensor:
        """The angle above the horizontal, in radians, over which an observer sees no ground, for every azimuth.

        Args:
            azimuths: (*P) radians from +y towards +x: clockwise from north, where y goes there.
            observer, height, earth_radius, refraction: as for `viewshed`, which raises the same.

        Returns:
            (*P) float64, found by halving to the last bit; where there is nothing but the end of the grid, the angle to
            that end.
        """
        return sight.horizon(self, observer, azimuths, height, earth_radius, refraction)

    def _explicit(self, points: Tensor, order: int) -> tuple[Tensor, ...]:
        n = self.heights.shape[0] if self.batched else 1
        rows = jets.jet(self._described, points.reshape(n, -1, 2), order)
        z, *slopes = (row.reshape(points.shape[:-1]) for row in rows.unbind(1))
        if order == 0:
            return (z,)
        gradient = torch.stack(slopes[:2], -1)
        if order == 1:
            return z, gradient
        xx, xy, yy = slopes[2:]
        return z, gradient, torch.stack((xx, xy, xy, yy), -1).unflatten(-1, (2, 2))

    def _implicit(self, points: Tensor, order: int) -> tuple[Tensor, ...]:
        """F = z − s(x, y) and its derivatives in space."""
        s, *derivatives = self._explicit(points[..., :2], order)
        value = points[..., 2] - s
        if order == 0:
            return (value,)
        gradient = torch.cat((-derivatives[0], torch.ones_like(s)[..., None]), -1)
        padded = [torch.nn.functional.pad(-hessian, (0, 1, 0, 1)) for hessian in derivatives[1:]]
        return value, gradient, *padded

    def patches(self, cells: Tensor, dtype: torch.dtype = torch.float64) -> Tensor:
        """Bernstein coefficients of both triangles of cells: (*P, 2, 15), up and down; (N, *P, 2, 15) of N grids.

        Args:
            cells: (*P, 2) int64, column and row; those of the domain are 0 … `self.cells` − 1, and any others exist.
            dtype: that they are computed in.

        Which triangles these are, and their corners, `ops.heights` says; the order of coefficients is that of
        `filterlab.bernstein`. Those on an edge are the same for both its triangles, to the bit. All of a triangle in a
        hole are NaN. Differentiable in the heights. Raises ValueError for cells of another type or shape.
        """
        if cells.dtype is not torch.int64 or cells.shape[-1:] != (2,):
            raise ValueError(f"cells must be int64 of shape (..., 2); got {cells.dtype} {tuple(cells.shape)}")
        found = reference.patches(self._described, cells.reshape(-1, 2), dtype)
        found = found.unflatten(1, cells.shape[:-1]) if cells.ndim > 1 else found[:, 0]
        return found if self.batched else found[0]

    @property
    def batched(self) -> bool:
        """Whether these are N grids."""
        return self.heights.ndim == 3

    @property
    def cells(self) -> tuple[int, int]:
        return self._described.cells

    @property
    def _described(self) -> described.Heights:
        values = self.heights if self.batched else self.heights[None]
        return described.Heights(values, self._pattern, self.boundary, self.spacing, self.origin)

    @cached_property
    def _pattern(self) -> described.Pattern:
        return self.spline.pattern(self.diagonal)

    def _checked_points(self, points: Array) -> Tensor:
        points = as_tensor(points)
        if not isinstance(points, Tensor) or points.is_complex():
            raise TypeError(f"points must be a real torch.Tensor or NumPy array; got {_told(points)}")
        if points.ndim == 0 or points.shape[-1] not in (2, 3):
            raise ValueError(f"points must have shape (..., 2): x, y, or (..., 3) of space; got {tuple(points.shape)}")
        if self.batched and (points.ndim < 2 or len(points) != len(self.heights)):
            raise ValueError(f"points of {len(self.heights)} grids have shape (N, ..., 2); got {tuple(points.shape)}")
        return points.to(torch.promote_types(points.dtype, torch.float32))

    # --- what a surface is ---

    @property
    def domain(self) -> Domain:  # pyright: ignore[reportIncompatibleVariableOverride]
        """The box around the part of the surface that has data, from its coefficients."""
        x, y = (
            sorted((o, o + d * max(n - 1, 1)))
            for o, d, n in zip(self.origin, self.spacing, self.heights.shape[:-3:-1], strict=True)
        )
        lows, highs = zip(*(cast.pyramid.range for cast in self._casts), strict=True)
        low, high = (min(lows), max(highs)) if min(lows) <= max(highs) else (0.0, 0.0)
        return Domain((x[0], y[0], low), (x[1], y[1], high), voxel_size=min(map(abs, self.spacing)))

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        return (self.heights,)

    def with_tensors(self, tensors: Sequence[Tensor]) -> HeightField:
        other = copy.copy(self)
        (other.heights,) = tensors
        other._kept = {}
        return other

    @property
    def device(self) -> torch.device:
        return self.heights.device

    @property
    def detached(self) -> HeightField:
        other = copy.copy(self)
        other.heights = self.heights.detach()
        return other

    def _first(self, origins: Tensor, directions: Tensor) -> Hits:
        return Hits(ops.first(self.cast, origins.reshape(-1, 3), directions.reshape(-1, 3)))

    def _sheets(self, origins: Tensor, directions: Tensor, sheets: int, farthest: bool) -> Hits:
        asked = Sheets(sheets, farthest, self.domain.diagonal)
        return Hits(ops.sheets(self.cast, origins.reshape(-1, 3), directions.reshape(-1, 3), asked))

    def met(self, origins: Array, directions: Array) -> Tensor:
        origins, directions = check_rays(origins, directions)
        o, d = (x.detach().reshape(-1, 3) for x in (origins, directions))
        return ops.met(self.cast, o, d).reshape(origins.shape[:-1])

    @property
    def cast(self) -> height_hits.HeightHits:
        """What rays are cast at: the heights as they are now, and bounds of blocks of them."""
        if self.batched:
            raise ValueError(f"rays are cast at one grid; got {len(self.heights)}: make a HeightField of each")
        return self._casts[0]

    @property
    def _casts(self) -> list[height_hits.HeightHits]:
        """Of every grid; made again when heights were changed in place."""
        given, version = self._described, self.heights._version
        if self._kept.get("version") != version:
            grids = [replace(given, values=grid.detach()[None]) for grid in given.values]
            self._kept.update(version=version, casts=[ops.described(grid) for grid in grids])
        return self._kept["casts"]


# --- what is refused --------------------------------------------------------------------------------------------------


def _told(x: object) -> str:
    return str(x.dtype) if isinstance(x, Tensor) else type(x).__name__


def _checked_heights(heights: Array) -> Tensor:
    heights = as_tensor(heights)
    if isinstance(heights, Tensor):
        heights = heights.to(_WIDER.get(heights.dtype, heights.dtype))
    if not isinstance(heights, Tensor) or heights.dtype not in _TYPES:
        raise TypeError(f"heights must be a torch.Tensor or NumPy array of real numbers; got {_told(heights)}")
    if heights.ndim not in (2, 3) or not heights.numel():
        raise ValueError(f"heights must have shape (H, W) or (N, H, W), of at least one; got {tuple(heights.shape)}")
    return heights


def _resolved(heights: Tensor, choice: str) -> Tensor:
    """Heights that are finite, or NaN where they are holes."""
    if choice not in NAN_CHOICES:
        raise ValueError(f"nan must be one of {', '.join(NAN_CHOICES)}; got {choice!r}")
    if not heights.dtype.is_floating_point or all_finite(heights):
        return heights
    unknown = ~heights.detach().isfinite()
    if choice == "refuse":
        raise ValueError(
            f"expected finite heights; got {int(unknown.sum()):,} of {heights.numel():,} that are not: "
            "nan='fill' takes heights from around, nan='propagate' leaves holes"
        )
    if choice == "propagate":
        return torch.where(heights.isinf(), torch.nan, heights) if bool(heights.isinf().any()) else heights
    if bool(unknown.flatten(-2).all(-1).any()):
        raise ValueError("expected at least one finite height to fill from; got none")
    return filled(heights[..., None, :, :], unknown[..., None, :, :])[..., 0, :, :]


def _pair(name: str, given: Sequence[float]) -> tuple[float, float]:
    numbers = [float(x) for x in given]
    if len(numbers) != 2 or not all(map(math.isfinite, numbers)):
        raise ValueError(f"{name} must be two finite numbers, along x and y; got {given!r}")
    return numbers[0], numbers[1]


def _checked_spacing(spacing: float | Sequence[float]) -> tuple[float, float]:
    pair = _pair("spacing", [float(spacing)] * 2 if isinstance(spacing, (int, float, Real)) else spacing)
    if 0 in pair:
        raise ValueError(f"spacing must not be 0; got {spacing!r}")
    return pair
