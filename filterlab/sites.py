"""Where the voxel centres of one grid lie among those of another: in its voxel coordinates, float64.

Coordinates are products and sums of float64 numbers, whatever the type of the samples and wherever in the world both
grids lie: of two origins that are far away only the difference matters.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import product

import numpy as np
import torch
from torch import Tensor

from filterlab.geometry import Geometry
from filterlab.volume import Volume

NEARER = 1e-9  # voxels within which two coordinates are the same: what is halfway between samples, or on the box
ALIGNED = 1e-12  # of the largest step: less than that beside an axis is along it
POINTS_AT_ONCE = 1 << 15

Part = tuple[slice, slice]
"""Planes, and of each of them lines."""


@dataclass(frozen=True)
class Sites:
    """voxel of the old grid = matrix · voxel of the new one + start, x, y, z.

    Attributes:
        shape: (D, H, W) of the new grid.
        size: voxels of the old grid along x, y, z.
        matrix: (3, 3) float64.
        start: (3,) float64, where the first voxel lies.
        device: of the samples.
    """

    shape: tuple[int, int, int]
    size: tuple[int, int, int]
    matrix: np.ndarray
    start: np.ndarray
    device: torch.device

    @classmethod
    def of(cls, volume: Volume, shape: tuple[int, int, int], geometry: Geometry) -> Sites:
        """The centres of a grid (D, H, W) in voxels of a volume."""
        own = np.asarray(volume.geometry.matrix)
        apart = np.subtract(geometry.origin, volume.origin)
        steps = np.linalg.solve(own, np.column_stack((geometry.matrix, apart)))
        return cls(shape, volume.size, steps[:, :3], steps[:, 3], volume.device)

    @cached_property
    def aligned(self) -> bool:
        """Whether every axis of the new grid lies along that of the old one."""
        steps = np.abs(self.matrix)
        return bool((steps - np.diag(np.diag(steps))).max() <= ALIGNED * steps.max())

    @cached_property
    def steps(self) -> tuple[float, float, float]:
        """How far apart new voxels are along the old x, y and z: their distances, or of turned grids at most."""
        x, y, z = np.sqrt((self.matrix**2).sum(1)).tolist()
        return x, y, z

    @property
    def everything(self) -> Part:
        """All voxels."""
        return slice(0, self.shape[0]), slice(0, self.shape[1])

    def along(self, axis: int) -> Tensor:
        """Coordinates along an axis (0 = x) of an aligned grid, on the CPU."""
        places = torch.arange(self.shape[2 - axis], dtype=torch.float64)
        return float(self.matrix[axis, axis]) * places + float(self.start[axis])

    def points(self, part: Part) -> Iterator[Tensor]:
        """Coordinates (M, 3) of the voxels of a part, some lines at a time."""
        planes, lines = (torch.arange(p.start, p.stop) for p in part)
        steps = torch.from_numpy(self.matrix.T.copy()).to(self.device)
        start = torch.from_numpy(self.start).to(self.device)
        across = torch.arange(self.shape[2], dtype=torch.float64, device=self.device)[:, None] * steps[0]
        every = torch.cartesian_prod(planes, lines).to(across)
        for some in every.split(max(1, POINTS_AT_ONCE // len(across))):
            first = start + some[:, 1:] * steps[1] + some[:, :1] * steps[2]
            yield (first[:, None] + across).reshape(-1, 3)

    def parts(self, most: int) -> Iterator[Part]:
        """All voxels, at most so many at a time, but for whole lines."""
        depth, height, width = self.shape
        lines = min(max(1, most // width), height)
        planes = max(1, most // (width * height))
        for z, y in product(range(0, depth, planes), range(0, height, lines)):
            yield slice(z, min(z + planes, depth)), slice(y, min(y + lines, height))

    def outside(self, part: Part) -> Tensor:
        """Which voxels of a part, (planes, lines, W), have their centre outside of the old box of voxels."""
        planes, lines = part
        if self.aligned:
            x, y, z = (_beyond(self.along(axis), n).to(self.device) for axis, n in enumerate(self.size))
            return z[planes, None, None] | y[lines, None] | x
        found = torch.cat([self._beyond(points) for points in self.points(part)])
        return found.reshape(planes.stop - planes.start, -1, self.shape[2])

    @property
    def meet_box(self) -> bool:
        """Whether any voxel has its centre in the old box of voxels."""
        if self.aligned:
            return not any(bool(_beyond(self.along(axis), n).all()) for axis, n in enumerate(self.size))
        return not all(bool(self._beyond(points).all()) for points in self.points(self.everything))

    def _beyond(self, points: Tensor) -> Tensor:
        x, y, z = (_beyond(p, n) for p, n in zip(points.unbind(-1), self.size, strict=True))
        return x | y | z


def _beyond(x: Tensor, n: int) -> Tensor:
    return (x < -0.5 - NEARER) | (x > n - 0.5 + NEARER)
