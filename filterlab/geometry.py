"""Geometry: where a grid lies in the world. A light module: a file's header has a geometry before torch is there."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from filterlab.world import UNDECLARED, World

if TYPE_CHECKING:
    from numpy.typing import ArrayLike
    from torch import Tensor

Matrix = tuple[tuple[float, float, float], ...]

IDENTITY = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0))


def _transposed(matrix: Matrix) -> Matrix:
    return tuple(zip(*matrix, strict=True))


def _triple(name: str, value: Sequence[float] | Tensor | np.ndarray | float) -> tuple[float, float, float]:
    try:
        values = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"{name} must be three finite numbers in x, y, z order; got {value!r}") from None
    if values.ndim == 0:
        values = np.repeat(values, 3)
    if values.shape != (3,) or not np.isfinite(values).all():
        raise ValueError(f"{name} must be three finite numbers in x, y, z order; got {value!r}")
    return tuple(values.tolist())  # type: ignore[return-value]


@dataclass(frozen=True)
class Geometry:
    """Where a grid lies: world = matrix · voxel + origin, everything in x, y, z order.

    This is the one place where spacing enters: gradients are turned from per voxel to per world unit here.
    Geometry is constant (plain float64 numbers), never a differentiable parameter.

    Attributes:
        matrix: 3 rows of the map from voxel steps to world steps; column d is the world step of one voxel along axis d.
        origin: world position of the centre of voxel (0, 0, 0).
        world: what is declared of the world; it takes part in nothing but files, and in no comparison.
    """

    matrix: Matrix = IDENTITY
    origin: tuple[float, float, float] = (0.0, 0.0, 0.0)
    world: World = field(default=UNDECLARED, compare=False)

    def __post_init__(self) -> None:
        m = np.asarray(self.matrix, dtype=np.float64)
        scale = np.abs(m).max(axis=0)
        regular = np.isfinite(m).all() and scale.min() > 0 and abs(np.linalg.det(m / scale)) >= 1e-9
        if not regular or not np.isfinite(self.origin).all():
            raise ValueError(f"the affine must be finite and invertible; got {self.affine.tolist()}")
        _ = self.inverse, self.diagonal, self.is_identity  # made now: torch.compile can't make them while it traces

    @classmethod
    def of(
        cls,
        spacing: Sequence[float] | float | None = None,
        origin: Sequence[float] | None = None,
        affine: ArrayLike | Tensor | None = None,
        world: World = UNDECLARED,
    ) -> Geometry:
        """From spacing and origin (x, y, z), or from a 4×4 affine voxel → world (not both)."""
        if affine is not None:
            if spacing is not None or origin is not None:
                raise ValueError("give spacing and origin, or an affine, not both")
            a = np.asarray(affine, dtype=np.float64)
            if a.shape != (4, 4) or not np.isfinite(a).all() or not np.allclose(a[3], (0, 0, 0, 1)):
                raise ValueError(f"affine must be a finite 4×4 matrix with last row 0 0 0 1; got {a.tolist()}")
            return cls(tuple(map(tuple, a[:3, :3].tolist())), tuple(a[:3, 3].tolist()), world)  # type: ignore[arg-type]
        s = _triple("spacing", 1.0 if spacing is None else spacing)
        if min(s) <= 0:
            raise ValueError(f"spacing must be positive; got {s} (use an affine for flipped axes)")
        return cls(
            ((s[0], 0.0, 0.0), (0.0, s[1], 0.0), (0.0, 0.0, s[2])),
            _triple("origin", (0.0, 0.0, 0.0) if origin is None else origin),
            world,
        )

    def moved(self, affine: ArrayLike) -> Geometry:
        """The same grid elsewhere: what was at the world point p is at affine · (p, 1).

        Raises ValueError for a matrix that is not 4×4, finite, invertible, with the last row 0 0 0 1.
        """
        return Geometry.of(affine=Geometry.of(affine=affine).affine @ self.affine, world=self.world)

    @property
    def affine(self) -> np.ndarray:
        """The 4×4 map from voxel (x, y, z, 1) to world, float64."""
        a = np.eye(4)
        a[:3, :3], a[:3, 3] = self.matrix, self.origin
        return a

    @property
    def spacing(self) -> tuple[float, float, float]:
        """World length of one voxel step along x, y, z."""
        return tuple(math.hypot(*column) for column in zip(*self.matrix, strict=True))  # type: ignore[return-value]

    @cached_property
    def is_identity(self) -> bool:
        return self.matrix == IDENTITY and self.origin == (0.0, 0.0, 0.0)

    @cached_property
    def diagonal(self) -> tuple[float, float, float] | None:
        """The signed steps along x, y, z when the axes are the world's, else None."""
        m = np.asarray(self.matrix)
        return tuple(np.diag(m).tolist()) if np.count_nonzero(m - np.diag(np.diag(m))) == 0 else None  # type: ignore[return-value]

    @cached_property
    def inverse(self) -> Matrix:
        """3 rows of the map from world steps to voxel steps."""
        return tuple(map(tuple, np.linalg.inv(np.asarray(self.matrix)).tolist()))

    def _map_rows(self, rows: Tensor, matrix: Matrix) -> Tensor:
        """rows · matrix; for world-aligned axes one product per component, so that nothing is mixed."""
        if self.diagonal is not None:
            return rows * rows.new_tensor([row[i] for i, row in enumerate(matrix)])
        return rows @ rows.new_tensor(matrix)

    def to_world(self, voxels: Tensor) -> Tensor:
        """Voxel coordinates `(..., 3)` to world points."""
        if self.is_identity:
            return voxels
        return self._map_rows(voxels, _transposed(self.matrix)) + voxels.new_tensor(self.origin)

    def to_voxel(self, points: Tensor) -> Tensor:
        """World points `(..., 3)` to voxel coordinates; the origin is subtracted before scaling."""
        if self.is_identity:
            return points
        return self._map_rows(points - points.new_tensor(self.origin), _transposed(self.inverse))

    def direction_to_voxel(self, directions: Tensor) -> Tensor:
        """World directions `(..., 3)` to voxel steps (no origin)."""
        return directions if self.is_identity else self._map_rows(directions, _transposed(self.inverse))

    def gradient_to_world(self, gradient: Tensor) -> Tensor:
        """Gradients `(..., 3)` per voxel to per world unit: g_world = matrix⁻ᵀ g_voxel."""
        return gradient if self.is_identity else self._map_rows(gradient, self.inverse)

    def hessian_to_world(self, hessian: Tensor) -> Tensor:
        """Hessians `(..., 3, 3)` per voxel² to per world unit²: matrix⁻ᵀ H matrix⁻¹."""
        return self.gradient_to_world(self.gradient_to_world(hessian).mT).mT
