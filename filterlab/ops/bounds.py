"""Bounds of the polynomials on the cells of a lattice, described: the least and greatest Bernstein coefficient.

The polynomial of a cell lies between its least and greatest Bernstein coefficient, Σ over taps of coefficient times
Bernstein coefficient of the tap's weight, axis by axis. That is exact about kernels with negative lobes and prefiltered
coefficients that overshoot: bounds of the taps alone let through up to ten times as many cells.

    coefficients ──▶ Bernstein coefficients of cells ──▶ least and greatest of parts of a few cells ──▶ codes of 16 bits

Of splines on tetrahedra also between what f − t lies, t the trend of a cube (`ops.tetrahedra.trend_of`): where a ray
goes, t and these tell more than bounds of all of the cube.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from filterlab.ops.tetrahedra import AnyLattice, TetrahedralLattice

CODES = 1 << 16
_USUAL = (0.0005, 0.9995)  # quantiles of coefficients that are told apart
_WIDER = 0.5  # of what lies between them, on either side: Bernstein coefficients overshoot
HALF_ROUNDING = 2.0**-7  # of bfloat16, as numbers are widened before they are rounded
_ASKED = 24  # coefficients along each axis whose quantiles these are


class Bounds(NamedTuple):
    """Between what values lie.

    Attributes:
        low, high: (pz, py, px) int16, codes of the least and the greatest coefficient of every part; the first and the
            last code where one is not finite.
        ends: the least and the greatest of all that are finite; of rounding alike.
        off_trend: (pz, py, px) int32, for the cubes of every part the least and the greatest Bernstein coefficient of
            f − t, as `in_pairs` has them; None where nothing reads it.
    """

    low: Tensor
    high: Tensor
    ends: tuple[float, float]
    off_trend: Tensor | None = None


def tells_off_trend(lattice: AnyLattice) -> bool:
    """Whether `Bounds.off_trend` is read: by programs on the CPU that cast rays at splines on tetrahedra."""
    return isinstance(lattice, TetrahedralLattice) and lattice.coefficients.device.type == "cpu"


def in_pairs(low: Tensor, high: Tensor) -> Tensor:
    """int32, two bfloat16 each, the low one in the lower half; rounded away from each other by up to 2⁻⁶ of their size.

    Of NaN −∞ and ∞.
    """
    halves = []
    for values, side in ((low, -1), (high, 1)):
        wider = (values + side * HALF_ROUNDING * values.abs()).nan_to_num_(side * math.inf, math.inf, -math.inf)
        halves.append(wider.float().bfloat16().view(torch.int16).int())
    return (halves[0] & 0xFFFF) | (halves[1] << 16)


def of_pairs(pairs: Tensor) -> tuple[Tensor, Tensor]:
    """(low, high) float32."""
    return (pairs << 16).view(torch.float32), (pairs & -0x10000).view(torch.float32)


@dataclass(frozen=True)
class Codes:
    """Numbers as integers of 16 bits: code k stands for [start + k step, start + (k + 1) step).

    The first code also stands for whatever is less, the last one for whatever is greater: outliers cost no precision.
    """

    start: float
    step: float

    @classmethod
    def of(cls, lattice: AnyLattice, least: float, most: float) -> Codes:
        """For values of a lattice whose finite coefficients lie between `least` and `most`."""
        c = lattice.coefficients.detach()
        some = c[tuple(slice(None, None, max(1, n // _ASKED)) for n in c.shape)].double()
        some = some[some.isfinite()]
        ends = some.quantile(some.new_tensor(_USUAL)).tolist() if len(some) else [least, most]
        if not ends[0] < ends[1]:
            ends = [least, most]
        first, last = sorted(lattice.scale * x + lattice.shift for x in ends)
        more = _WIDER * (last - first)
        step = (last - first + 2 * more) / CODES
        return cls(first - more, step) if 0 < step < math.inf else cls(first, 1.0)

    def __call__(self, values: Tensor, if_none: float) -> Tensor:
        """int16, from the least number of 16 bits on; of NaN another one, from 0 on."""
        codes = ((values - self.start) / self.step).floor_().nan_to_num_(nan=if_none)
        return codes.clamp_(0, CODES - 1).sub_(CODES // 2).to(torch.int16)

    def of_number(self, value: float) -> int:
        return int(self(torch.tensor(value, dtype=torch.float64), 0))

    def least(self, codes: Tensor) -> Tensor:
        """float64, what values of these codes are not less than."""
        k = codes.double() + CODES // 2
        return torch.where(k == 0, -math.inf, self.start + k * self.step)

    def most(self, codes: Tensor) -> Tensor:
        """float64, what values of these codes are not greater than."""
        k = codes.double() + CODES // 2
        return torch.where(k == CODES - 1, math.inf, self.start + (k + 1) * self.step)
