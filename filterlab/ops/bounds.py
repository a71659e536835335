"""Bounds of the polynomials on the cells of a lattice, described: the least and greatest Bernstein coefficient.

The polynomial of a cell lies between its least and greatest Bernstein coefficient, Σ over taps of coefficient times
Bernstein coefficient of the tap's weight, axis by axis. That is exact about kernels with negative lobes and prefiltered
coefficients that overshoot: bounds of the taps alone let through up to ten times as many cells.

    coefficients ──▶ Bernstein coefficients of cells ──▶ least and greatest of parts of a few cells ──▶ codes of 16 bits
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from filterlab.ops.tetrahedra import AnyLattice

CODES = 1 << 16
_USUAL = (0.0005, 0.9995)  # quantiles of coefficients that are told apart
_WIDER = 0.5  # of what lies between them, on either side: Bernstein coefficients overshoot
_ASKED = 24  # coefficients along each axis whose quantiles these are


class Bounds(NamedTuple):
    """Between what values lie.

    Attributes:
        low, high: (pz, py, px) int16, codes of the least and the greatest coefficient of every part; the first and the
            last code where one is not finite.
        ends: the least and the greatest of all that are finite; of rounding alike.
    """

    low: Tensor
    high: Tensor
    ends: tuple[float, float]


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
