"""What a peer is asked to compute, and whether it is there."""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib.util import find_spec

import numpy as np
from torch import Tensor

from filterlab.render.tiles import tiled


@dataclass(frozen=True)
class Sampling:
    """What is asked of a library: a kernel summed over coefficients, at points.

    Attributes:
        kernel: "linear", "bspline2", "bspline3", or "keys": cubic convolution with the slope −¾ that torch uses.
        gradient: with the gradient, or the value alone.
        coefficients: (n, n, n) float32.
        points: (M, 3) float32 voxel coordinates x, y, z, a few voxels inside.
        threads: how many it may use.
    """

    kernel: str
    gradient: bool
    coefficients: Tensor
    points: Tensor
    threads: int

    @property
    def computes(self) -> str:
        return "value and gradient" if self.gradient else "value"


@dataclass(frozen=True)
class Casting:
    """What is asked of whoever casts rays at a level set.

    Attributes:
        volume: (n, n, n) float32, samples at the integers.
        level: f = level is hit.
        origins, directions: (H, W, 3) float32 voxel coordinates x, y, z, of an image.
        threads: how many it may use.
    """

    volume: Tensor
    level: float
    origins: Tensor
    directions: Tensor
    threads: int
    computes: str = "trilinear hits"

    @property
    def rays(self) -> int:
        """How many there are."""
        return self.origins.shape[:-1].numel()

    def flat(self) -> tuple[np.ndarray, np.ndarray]:
        """Origins and directions (R, 3), one after the other."""
        return self.origins.reshape(-1, 3).numpy(), self.directions.reshape(-1, 3).numpy()

    def tile_by_tile(self) -> Casting:
        """The same rays in another order, for peers that take them as they come: of 4×4 pixels, of 16×16 of these."""
        height, width = self.origins.shape[:2]
        order = tiled(height, width, self.origins.device)
        origins, directions = (x.reshape(-1, 3)[order].reshape(x.shape) for x in (self.origins, self.directions))
        return replace(self, origins=origins, directions=directions)

    @staticmethod
    def summary(t: np.ndarray) -> tuple[np.ndarray, ...]:
        """How many hits, and how far away in the mean: rays that graze the surface may be judged either way."""
        hit = np.isfinite(t)
        return np.array([hit.mean()]), np.array([t[hit].mean()])


def without(package: str, install: str | None = None) -> str | None:
    """Why a package can't be imported, or None."""
    return None if find_spec(package) else f"not installed: pip install {install or package}"
