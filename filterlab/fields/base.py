"""The one contract that everything downstream (renderers, metrics, experiments) relies on."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass, field

import torch
from torch import Tensor

from filterlab.volume import Geometry


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

    @property
    def center(self) -> tuple[float, float, float]:
        """World centre of the box."""
        return tuple(self.corners().mean(0).tolist())  # type: ignore[return-value]

    @property
    def diagonal(self) -> float:
        """World length of the box's diagonal: the diameter of the sphere around it."""
        corners = self.corners()
        return float(2 * (corners - corners.mean(0)).norm(dim=-1).max())


class Field(ABC):
    """A function of space with value, gradient and (up to `max_order`) higher derivatives.

    Points are world points `(..., 3)` in x, y, z order. An unbatched field maps points `(*P, 3)` to values `(*P)`,
    gradients `(*P, 3)` and Hessians `(*P, 3, 3)`; a batched one (`channels` is (N, C)) maps points `(N, *P, 3)` to
    `(N, C, *P)`, `(N, C, *P, 3)` and `(N, C, *P, 3, 3)`. Gradients are per world unit. Everything is computed in
    promote(points.dtype, float32), and is differentiable in the points and in whatever the field was built from.
    """

    domain: Domain
    max_order: int = 2
    channels: tuple[int, int] | None = None

    @abstractmethod
    def jet(self, points: Tensor, order: int) -> tuple[Tensor, ...]:
        """(value,), (value, gradient) or (value, gradient, Hessian) for order 0, 1, 2, in one pass."""

    def __call__(self, points: Tensor) -> Tensor:
        """Values at the points."""
        return self.jet(points, 0)[0]

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Values and gradients (per world unit) at the points, in one pass."""
        value, gradient = self.jet(points, 1)
        return value, gradient


def check_points(points: Tensor, channels: tuple[int, int] | None) -> Tensor:
    """The points in their compute type, promote(points, float32). Raises on a wrong type or shape."""
    if not isinstance(points, Tensor):
        raise TypeError(f"points must be a torch.Tensor; got {type(points).__name__}")
    if points.dtype.is_complex or points.dtype == torch.bool:
        raise TypeError(f"points must be real numbers; got {points.dtype}")
    if points.ndim == 0 or points.shape[-1] != 3:
        raise ValueError(f"points must have shape (..., 3) in x, y, z order; got {tuple(points.shape)}")
    if channels is not None and (points.ndim < 2 or points.shape[0] not in (1, channels[0])):
        raise ValueError(
            f"a batched field needs points of shape (N, ..., 3), N = {channels[0]} or 1; got {tuple(points.shape)}"
        )
    return points.to(torch.promote_types(points.dtype, torch.float32))


def check_order(order: int, max_order: int) -> None:
    """Raises ValueError unless 0 ≤ order ≤ max_order."""
    if not isinstance(order, int) or not 0 <= order <= max_order:
        raise ValueError(f"order must be an integer from 0 (value) to {max_order} here; got {order!r}")
