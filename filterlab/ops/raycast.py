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

from filterlab.ops.pieces import Lattice, Triple

MAX_DEGREE = 9  # along a ray

_CUBES = (4, 16)  # bricks along an edge of what is leapt over at once, besides one


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
        start, near, far = (x.view(-1, *(1,) * (within.ndim - 1)) for x in (self.start, self.near, self.far))
        found = within < torch.inf
        return torch.where(found, start + torch.lerp(near, far, torch.where(found, within, 0).double()), torch.inf)


def joined(parts: Sequence[Candidates]) -> Candidates:
    """One after the other."""
    return Candidates(*(torch.cat(columns) for columns in zip(*parts, strict=True)))


@dataclass(frozen=True)
class Raycast:
    """The level set of a lattice in the world.

    Attributes:
        lattice: where f is one polynomial, and which.
        origin, matrix: coordinates of cells are matrix · (world − origin) − lattice.offset.
        level: f = level is what is hit.
        dtype: of the rays and of polynomials, float32 or float64.
        leaps: (bz, by, bx) uint8, by bricks of `edge`³ cells: log₂ of the edge of a cube of cells around the brick that
            does not hold the level; 0: the brick may.
        edge: cells along an edge of a brick, a power of two.
    """

    lattice: Lattice
    origin: Triple
    matrix: tuple[Triple, ...]
    level: float
    dtype: torch.dtype
    leaps: Tensor
    edge: int


def leaps_of(relevant: Tensor, edge: int) -> Tensor:
    """`Raycast.leaps`, by cubes of 1, 4 and 16 bricks along an edge, from (bz, by, bx) which may hold the level."""
    leaps = torch.full_like(relevant, edge.bit_length() - 1, dtype=torch.uint8)
    leaps[relevant] = 0
    pooled = relevant
    for bricks in _CUBES:
        pooled = _any_of_four(_any_of_four(_any_of_four(pooled, 0), 1), 2)
        wide = pooled
        for dim, size in enumerate(relevant.shape):
            wide = wide.repeat_interleave(bricks, dim).narrow(dim, 0, size)
        leaps.masked_fill_(~wide, (edge * bricks).bit_length() - 1)
    return leaps


def _any_of_four(mask: Tensor, dim: int) -> Tensor:
    """Whether one of four neighbours along an axis has it."""
    more = -mask.shape[dim] % 4
    pad = [0, 0] * (mask.ndim - 1 - dim) + [0, more]
    return torch.nn.functional.pad(mask, pad).unflatten(dim, (-1, 4)).any(dim + 1)
