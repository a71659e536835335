"""Pieces of a field along rays, described: which sums are restricted, and what the restriction is.

On a *cell*, the box between neighbouring knots, a sum of tensor products over taps is one polynomial in x, y and z; on
the part of a ray in a cell it is one in t, of degree p_x + p_y + p_z with p the degrees of the kernels:

    f(o + s(t) d) = Σ_i c_i B_i(t),    s(t) = (1 − t) near + t far,    t ∈ [0, 1]

Cells are counted by their first tap, so that coordinates of cells are those of voxels but for an offset, and knots are
integers, whatever the kernel's support.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

from filterlab.kernels import Kernel, PiecewisePolynomial
from filterlab.ops.stencil import Row, Stencil

Triple = tuple[float, float, float]

NO_MOTION = 1e-30  # of the largest component: over any distance that float64 resolves, such an axis stays put


class Pieces(NamedTuple):
    """The pieces that rays pass, ray by ray, along each from near to far.

    Where two are neighbours, `near` of the second is `far` of the first to the bit, and, if the field is continuous,
    the first coefficient of the second is the last of the first.

    Attributes:
        ray: (P,) int64, the ray that each belongs to.
        near, far: (P,) float64, where it begins and ends, in units of the ray's direction from `start` on.
        coefficients: (P, n + 1) Bernstein coefficients c_0 … c_n.
        start: (R,) float64, t of every ray from which near and far are measured: where it enters the domain.
    """

    ray: Tensor
    near: Tensor
    far: Tensor
    coefficients: Tensor
    start: Tensor

    @property
    def joined(self) -> Tensor:
        """(P,) whether a piece begins where the one before it ends."""
        joined = torch.zeros_like(self.ray, dtype=torch.bool)
        joined[1:] = (self.ray[1:] == self.ray[:-1]) & (self.near[1:] == self.far[:-1])
        return joined

    def t(self, within: Tensor) -> Tensor:
        """t (P, …) in units of the direction from the origin, of parameters `within` pieces in [0, 1]; ∞ stays."""
        return along_ray(self.start[self.ray], self.near, self.far, within)


def along_ray(start: Tensor, near: Tensor, far: Tensor, within: Tensor) -> Tensor:
    """t (P, …) of parameters in [0, 1] of pieces from near to far (P,), measured from start (P,); ∞ stays."""
    start, near, far = (x.view(-1, *(1,) * (within.ndim - 1)) for x in (start, near, far))
    found = within < torch.inf
    return torch.where(found, start + torch.lerp(near, far, torch.where(found, within, 0).double()), torch.inf)


@dataclass(frozen=True)
class Lattice:
    """Where a sum over taps is one polynomial, and which.

    Attributes:
        coefficients: (D, H, W), any real type: the taps of all cells that the domain meets, and no more.
        row: what is summed, products of kernels without derivatives.
        offset: x, y, z in voxels of the first corner of the first cell.
        lower, upper: corners of the domain in coordinates of cells.
        scale, shift: values are scale · sum + shift: what stored integers stand for.
    """

    coefficients: Tensor
    row: Row
    offset: Triple
    lower: Triple
    upper: Triple
    scale: float = 1.0
    shift: float = 0.0

    @cached_property
    def stencil(self) -> Stencil:
        """The one row."""
        return Stencil((self.row,))

    @property
    def supports(self) -> tuple[int, int, int]:
        """Taps of a cell along x, y, z."""
        return self.stencil.supports

    @property
    def exact(self) -> bool:
        """Whether all kernels are fixed tables."""
        return self.stencil.exact

    @cached_property
    def degrees(self) -> tuple[int, int, int]:
        """Degree of the polynomial of a cell in x, y and z."""
        x, y, z = (max(p.kernels[axis].degree for p in self.row) for axis in range(3))
        return x, y, z

    @cached_property
    def degree(self) -> int:
        """n ≥ 1, the degree along a ray."""
        return max(1, *(sum(k.degree for k in p.kernels) for p in self.row))

    @cached_property
    def cells(self) -> tuple[int, int, int]:
        """Cells along x, y, z."""
        x, y, z = (n - s + 1 for n, s in zip(self.coefficients.shape[::-1], self.supports, strict=True))
        return x, y, z

    @cached_property
    def continuous(self) -> bool:
        """Whether polynomials of neighbouring cells agree where they meet."""
        return all(_continuous(k) for p in self.row for k, n in zip(p.kernels, self.cells, strict=True) if n > 1)


def _continuous(kernel: PiecewisePolynomial) -> bool:
    if isinstance(kernel, Kernel):
        return kernel.continuity >= 0
    table = kernel.table(torch.float64).detach()
    zero = table.new_zeros(1)
    gaps = torch.cat((zero, table.sum(1))) - torch.cat((table[:, 0], zero))
    return bool((gaps.abs() <= 64 * torch.finfo(torch.float32).eps * table.abs().max()).all())
