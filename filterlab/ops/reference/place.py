"""place in plain torch."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from filterlab.geometry import Geometry
from filterlab.ops.place import Placement
from filterlab.volume import all_between


def place(points: Tensor, placement: Placement) -> tuple[Tensor, Tensor]:
    """(located, sign), without the derivatives that `ops.differentiable.place` gives them."""
    voxels = _voxels(points, placement)
    axes = [
        placement.boundary.fold(x, n, placement.tail) for x, n in zip(voxels.unbind(-1), placement.size, strict=True)
    ]
    located = torch.stack([x for x, _ in axes], -1)
    if any(placement.shift):
        located = located - located.new_tensor(placement.shift)
    return located, torch.stack([s for _, s in axes], -1)


def _voxels(points: Tensor, placement: Placement) -> Tensor:
    """Voxel coordinates `(..., 3)`; those that would leave the range of their type by a period, or where they end."""
    voxels = placement.geometry.to_voxel(points)
    largest = torch.finfo(voxels.dtype).max
    if placement.geometry.is_identity or all_between(voxels, -largest, largest):
        return voxels
    periods = [placement.boundary.period(n) for n in placement.size]
    known = None if None in periods else points.new_tensor(periods)
    return torch.where(voxels.isfinite(), voxels, far_voxels(points, placement.geometry, known))


def far_voxels(points: Tensor, geometry: Geometry, periods: Tensor | None) -> Tensor:
    """Voxel coordinates by numbers small enough: matrix · (point − origin) / 2^k, and modulo period / 2^k is exact.

    Args:
        points: (..., 3); at infinity they lie where the description of `place` says.
        geometry: voxel -> world.
        periods: (3,), after how many voxels all repeats; None: it does not.
    """
    infinite = points.isinf()
    ahead = geometry.direction_to_voxel(torch.where(infinite, points.sign(), 0))
    power = max(math.frexp(max(sum(map(abs, row)) for row in geometry.inverse))[1] + 1, 1)
    near = torch.where(infinite, 0, points) * 2.0**-power - points.new_tensor(geometry.origin) * 2.0**-power
    near = geometry.direction_to_voxel(near)
    if periods is not None:
        near = near.fmod(periods * 2.0**-power)
    near = near * 2.0**power
    return torch.where(ahead == 0, near, ahead * torch.inf + near)
