"""place, described: world points to coordinates of stored coefficients.

Coefficients are stored padded under a boundary, so that no tap is ever folded; the points are, into the stored part:

    located = fold(matrix · (point − origin)) − shift,       sign = d fold / d voxel ∈ {1, −1, 0} along each axis,

and d located_i / d point_j = sign_i · matrix_ij.

A finite point whose voxel coordinate is beyond the range of its type is folded as exactly as any other. A point at
infinity lies where p + t s ends for t → ∞, p its finite coordinates and s the signs of its infinite ones: along an axis
of the voxels it is at ±∞, or, where matrix · s is 0, where p is.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from filterlab.geometry import Geometry
from filterlab.volume import Boundary

Placed = tuple[Tensor, Tensor | None]
"""(located, sign), both of the shape of the points; sign None where it is 1 everywhere."""

InWorld = tuple[Tensor, Tensor]
"""(value, gradient per world unit) of points that were placed: what gather's rows say, their signs minded."""


@dataclass(frozen=True)
class Placement:
    """Where points belong.

    Attributes:
        geometry: voxel -> world.
        boundary: the extension of the samples.
        size: voxels along x, y, z.
        tail: how far beyond the ends points are told apart (border and zeros).
        shift: what is subtracted in the end along x, y, z: ½ for coefficients at half-integers.
    """

    geometry: Geometry
    boundary: Boundary
    size: tuple[int, int, int]
    tail: int = 0
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
