"""Casting rays at a level, described: which crossings of a piecewise polynomial are asked for.

    first        where each ray meets the level first
    candidates   all pieces that may hold a crossing, in order, for whoever wants every one

`ops.reference.raycast` says what is computed, from any pieces; the programs walk through the cells of a lattice and
restrict only those that their bricks' bounds leave over.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from filterlab.ops.pieces import Lattice, along_ray
from filterlab.volume import Geometry

_RADII = (1, 2, 4, 8)  # bricks around an empty one that are told to be empty as well


class Candidates(NamedTuple):
    """Pieces that may hold a crossing: their coefficients straddle the level.

    Attributes:
        ray: (Q,) int64. start, near, far: (Q,) float64, as in `Pieces`.
        coefficients: (Q, n + 1) of f − level.
        jump: (Q,) whether f jumps over the level where the piece begins.
        repeated: (Q,) whether the piece begins on the level where the one before ended on it.
    """

    ray: Tensor
    start: Tensor
    near: Tensor
    far: Tensor
    coefficients: Tensor
    jump: Tensor
    repeated: Tensor

    def t(self, within: Tensor) -> Tensor:
        """(Q, …) in units of the direction, of parameters in [0, 1]; ∞ stays."""
        return along_ray(self.start, self.near, self.far, within)


def joined(parts: Sequence[Candidates]) -> Candidates:
    """One after the other."""
    return Candidates(*(torch.cat(columns) for columns in zip(*parts, strict=True)))


@dataclass(frozen=True)
class Raycast:
    """The level set of a lattice in the world.

    Attributes:
        lattice: where f is one polynomial, and which.
        geometry: where it lies in the world; coordinates of cells are those of voxels − lattice.offset.
        level: f = level is what is hit.
        dtype: of the rays and of polynomials, float32 or float64.
        clear: (bz, by, bx) uint8, of bricks of `edge`³ cells: 0 where the brick may hold the level, else 1 + r, where
            no brick within r of it, along every axis, does.
        edge: cells along an edge of a brick, a power of two.
    """

    lattice: Lattice
    geometry: Geometry
    level: float
    dtype: torch.dtype
    clear: Tensor
    edge: int


def clear_of(relevant: Tensor) -> Tensor:
    """`Raycast.clear` from (bz, by, bx) which bricks may hold the level, for r of `_RADII`."""
    near = relevant.to(torch.uint8)
    clear, reach = 1 - near, 0
    for radius in _RADII:  # within 2 k is within k of what is within k
        for dim in range(3):
            near = _spread(near, dim, radius - reach)
        clear += (1 - near) * (radius - reach)
        reach = radius
    return clear


def _spread(mask: Tensor, dim: int, by: int) -> Tensor:
    """Where it is 1, or was so many places before or behind along an axis."""
    out, kept = mask.clone(), mask.shape[dim] - by
    if kept > 0:
        out.narrow(dim, by, kept).bitwise_or_(mask.narrow(dim, 0, kept))
        out.narrow(dim, 0, kept).bitwise_or_(mask.narrow(dim, by, kept))
    return out
