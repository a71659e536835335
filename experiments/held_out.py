"""A scan held out from itself, as a signal is known: what was low-passed and decimated is compared with what it was.

    scan ──low-pass──▶ truth, between its voxels by its quintic B-spline
                 └──every second voxel──▶ a cube of n³ from the middle, which methods reconstruct

See `experiments.members.Scan`. Values are in parts of the range of the cube, lengths in voxels of the scan.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

import filterlab as fl
from experiments.members import Sampling, Scan, largest_extent
from filterlab.fields.base import Domain


@dataclass(frozen=True)
class HeldOut:
    """What is asked of a signal, of a scan.

    Attributes:
        truth: the low-passed scan.
        volume: the cube, in the world of the scan's voxels: 2 from one voxel to the next.
        low, span: its least sample, and its range.
    """

    truth: fl.Field
    volume: fl.Volume
    low: float
    span: float

    @classmethod
    def of(cls, samples: Tensor, device: str = "cpu") -> HeldOut:
        """From voxels (D, H, W)."""
        scan = Scan.of(samples.to(device=device, dtype=torch.float64), Sampling(2, 1.0, device))
        n = min(scan.coarse.shape)
        first = [(size - n) // 2 for size in scan.coarse.shape]
        z, y, x = (slice(f, f + n) for f in first)
        low, high = (float(end) for end in scan.coarse[z, y, x].aminmax())
        span = high - low or 1.0
        cube = (scan.coarse[z, y, x] - low) / span
        return cls(scan.truth, fl.Volume(cube, spacing=2, origin=[2.0 * f for f in reversed(first)]), low, span)

    @property
    def domain(self) -> Domain:
        """The box of the cube's voxels."""
        return Domain.of_grid(self.volume.size, self.volume.geometry)

    def value_and_gradient(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Of the truth at world points (P, 3)."""
        value, gradient = self.truth.value_and_gradient(points)
        return (value - self.low) / self.span, gradient / self.span

    def sample(self, n: int, dtype: torch.dtype = torch.float64, device: str = "cpu") -> fl.Volume:
        """The cube, which has but one resolution n."""
        assert n == self.volume.size[0]
        return self.volume.to(device=device, dtype=dtype)


def resolution_of(shape: Sequence[int]) -> int:
    """n, of a scan (D, H, W)."""
    return min(map(largest_extent, shape))
