"""place in plain torch."""

from __future__ import annotations

import torch
from torch import Tensor

from filterlab.ops.place import Placement


def place(points: Tensor, placement: Placement) -> tuple[Tensor, Tensor]:
    """(located, sign), without the derivatives that `ops.differentiable.place` gives them."""
    voxels = placement.geometry.to_voxel(points)
    axes = [
        placement.boundary.fold(x, n, placement.tail) for x, n in zip(voxels.unbind(-1), placement.size, strict=True)
    ]
    located = torch.stack([x for x, _ in axes], -1)
    return located - placement.shift if placement.shift else located, torch.stack([s for _, s in axes], -1)
