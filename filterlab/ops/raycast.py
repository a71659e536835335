"""Casting rays at a level, described: which crossings of a piecewise polynomial are asked for.

    first        where each ray meets the level first
    sheets       where each ray meets it, the first k times or the last
    candidates   all pieces that may hold a crossing, in order

`ops.reference.raycast` says what is computed, from any pieces; the programs walk through the cells of a lattice and
restrict only those that their bricks' bounds leave over.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from filterlab.geometry import Geometry
from filterlab.ops.pieces import along_ray
from filterlab.ops.tetrahedra import AnyLattice

JUMP, REPEATED = 1, 2  # bits of `Written.flags`

# of the programs' root search
PASSES = 120  # of Newton's method and bisection
USUAL = 2  # passes before a value that may be rounding decides anything

PLACES_APART = 32  # roundings of a place on a ray, up to which two are the same

_ALL = 1 << 62  # crossings, more than any ray has
RADII = (1, 2, 3, 4, 5, 6, 7, 8)  # bricks around an empty one that are told to be empty as well
_FEW = 4  # candidates of a ray at first; those with more are cast again
_NUMBERS_AT_ONCE = 1 << 24  # of candidates


@dataclass(frozen=True)
class Sheets:
    """Which of all crossings are asked for.

    Attributes:
        count: k, of each ray.
        farthest: the last ones, from the last on; else the first ones in order.
        extent: the diagonal of the domain, in the world: what the rounding of places is measured by.
    """

    count: int
    farthest: bool
    extent: float

    @property
    def most(self) -> int:
        """Crossings of a ray behind which no more are looked for."""
        return _ALL if self.farthest else self.count

    def room(self, rays: torch.Size, device: torch.device) -> tuple[Tensor, Tensor]:
        """t (..., k) and numbers (..., 1) of crossings, for programs to write: crossing i of a ray at i mod k."""
        t = torch.full((*rays, self.count), torch.inf, dtype=torch.float64, device=device)
        return t, torch.zeros((*rays, 1), dtype=torch.int64, device=device)

    def in_order(self, t: Tensor, found: Tensor) -> Tensor:
        """t (..., k) as asked for, from what programs have written."""
        if not self.farthest:
            return t
        return t.gather(-1, (found - 1 - torch.arange(self.count, device=t.device)) % self.count)


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


class Written(NamedTuple):
    """What programs write of R rays with room for K candidates each.

    Attributes:
        count: (R,) int64, candidates of a ray, also those that there is no room for.
        places: (R, K, 3) float64: start, near, far.
        pieces: (R, K, n + 1) coefficients.
        flags: (R, K) bytes of `JUMP` and `REPEATED`.
    """

    count: Tensor
    places: Tensor
    pieces: Tensor
    flags: Tensor

    @classmethod
    def room(cls, rays: int, capacity: int, degree: int, dtype: torch.dtype, device: torch.device) -> Written:
        """To be written, of polynomials of a degree and type."""
        return cls(
            torch.zeros(rays, dtype=torch.int64, device=device),
            torch.empty(rays, capacity, 3, dtype=torch.float64, device=device),
            torch.empty(rays, capacity, degree + 1, dtype=dtype, device=device),
            torch.empty(rays, capacity, dtype=torch.uint8, device=device),
        )

    def candidates(self, rays: Tensor) -> Candidates:
        """Those of the rays that have no more than there is room for; `rays` says which rays they are."""
        capacity = self.flags.shape[1]
        here = torch.arange(capacity, device=rays.device) < torch.where(self.count > capacity, 0, self.count)[:, None]
        flags, (start, near, far) = self.flags[here], self.places[here].unbind(-1)
        ray = rays[:, None].expand(-1, capacity)[here]
        return Candidates(ray, start, near, far, self.pieces[here], (flags & JUMP) > 0, (flags & REPEATED) > 0)


def written_in_parts(
    write: Callable[[Tensor, int], Written], degree: int, rays: int, device: torch.device
) -> Candidates:
    """All candidates of so many rays, a part of them at a time; rays that have more than there was room for come later.

    Args:
        write: of rays, by their numbers, with room for so many candidates each.
    """
    parts, capacity = [], _FEW
    left = torch.arange(rays, device=device)
    while len(left) or not parts:
        again = []
        for own in left.split(max(1, _NUMBERS_AT_ONCE // (capacity * (degree + 4)))):
            written = write(own, capacity)
            parts.append(written.candidates(own))
            again.append(own[written.count > capacity])
        left, capacity = torch.cat(again), 8 * capacity
    return joined(parts)


@dataclass(frozen=True)
class Raycast:
    """The level set of a lattice in the world.

    Attributes:
        lattice: where f is one polynomial, and which.
        geometry: where it lies in the world; coordinates of cells are those of voxels − lattice.offset.
        level: f = level is what is hit.
        dtype: of the rays and of polynomials, float32 or float64.
        marks: (bz, by, bx) int16, of bricks of `edge`³ cells. Positive where the brick may hold the level: bit
            x + 2 y + 4 z tells whether its part there does, of two along every axis. Else −1 − r, where no brick within
            r of it, along every axis, may hold it.
        edge: cells along an edge of a brick, a power of two from 2 on.
        margin: what rounding may add to values.
        off_trend: (pz, py, px) int32 of parts of `edge` / 2 cells, as in `ops.bounds.Bounds`; None: it is not read.
    """

    lattice: AnyLattice
    geometry: Geometry
    level: float
    dtype: torch.dtype
    marks: Tensor
    edge: int
    margin: float
    off_trend: Tensor | None = None


def marks_of(parts: Tensor) -> Tensor:
    """`Raycast.marks` from (pz, py, px) which parts may hold the level."""
    whole = [n + n % 2 for n in parts.shape]
    pad = [k for n, own in zip(reversed(whole), reversed(parts.shape), strict=True) for k in (0, n - own)]
    return marks_of_bits(bits_of(torch.nn.functional.pad(parts, pad) if any(pad) else parts))


def bits_of(parts: Tensor) -> Tensor:
    """(..., bz, by, bx) uint8, of each brick which of its parts (..., 2 bz, 2 by, 2 bx) may hold the level."""
    bits = parts.view(torch.uint8) if parts.is_contiguous() else parts.to(torch.uint8)
    for dim, shift in ((-3, 4), (-2, 2), (-1, 1)):  # the last in memory when least is left
        first, second = bits.unflatten(dim, (-1, 2)).unbind(dim)
        bits = first | (second << shift)
    return bits


def marks_of_bits(bits: Tensor) -> Tensor:
    """`Raycast.marks` from (bz, by, bx) uint8 of `bits_of`."""
    near, reach = (bits > 0).to(torch.uint8), 0
    clear = 1 - near  # 1 + r, where no brick within r may hold the level
    for radius in RADII:  # within 2 k is within k of what is within k
        for dim in range(3):
            near = _spread(near, dim, radius - reach)
        clear += (1 - near) * (radius - reach)
        reach = radius
    return bits.to(torch.int16) - clear


def _spread(mask: Tensor, dim: int, by: int) -> Tensor:
    """Where it is 1, or was so many places before or behind along an axis."""
    out, kept = mask.clone(), mask.shape[dim] - by
    if kept > 0:
        out.narrow(dim, by, kept).bitwise_or_(mask.narrow(dim, 0, kept))
        out.narrow(dim, 0, kept).bitwise_or_(mask.narrow(dim, by, kept))
    return out
