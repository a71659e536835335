"""What is evaluated: volumes of n³ voxels and points in them, in voxel coordinates x, y, z.

Points keep two voxels and a half away from the faces: there a boundary rule decides, and peers have others. They keep
a thousandth of a voxel away from grid planes: there trilinear gradients jump, and rounding would decide.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from filterlab.fields.grid import Term
from filterlab.methods import tensor_product

MARGIN = 2.5
OFF_GRID = 1e-3
ARRANGEMENTS = ("coherent", "random")
_STEP = 0.5  # voxels from one point of a ray to the next


def noise(n: int, seed: int = 0) -> Tensor:
    """(n, n, n) float32, uniform in 0 … 1."""
    return torch.rand(n, n, n, generator=torch.Generator().manual_seed(seed))


def points(arrangement: str, n: int, count: int) -> Tensor:
    """(count, 3) float32: "random", or "coherent": along rays, as a renderer asks for them."""
    low, high = MARGIN, n - 1 - MARGIN
    if low >= high:
        raise ValueError(f"expected a volume of more than {2 * MARGIN + 1:g} voxels along an axis; got {n}")
    if arrangement == "random":
        x = low + (high - low) * torch.rand(count, 3, generator=torch.Generator().manual_seed(1))
    else:
        x = _along_rays(low, high, count)
    cell = x.floor()
    return cell + (x - cell).clamp(OFF_GRID, 1 - OFF_GRID)


def _along_rays(low: float, high: float, count: int) -> Tensor:
    """Ray after ray of slanted parallel rays on a square grid, steps of half a voxel along z."""
    samples = max(int((high - low) / _STEP), 1)
    rays = -(-count // samples)
    side = math.ceil(math.sqrt(rays))
    ray = torch.arange(rays)
    t = torch.arange(samples, dtype=torch.float64) / samples
    start = low + (high - low) * 0.8 * torch.stack((ray % side, ray // side), -1) / side  # (rays, 2)
    slant = (high - low) * torch.tensor([0.12, 0.08])
    across = start[:, None] + t[:, None] * slant
    along = (low + t * (high - low))[None, :, None].expand(rays, samples, 1)
    return torch.cat((across, along), -1).reshape(-1, 3)[:count].float().contiguous()


def terms_of(method: str) -> tuple[Term, ...]:
    """The separable terms of a tensor product's value."""
    found = tensor_product(method)
    assert found is not None, f"{method} is no tensor product"
    return found.value_terms
