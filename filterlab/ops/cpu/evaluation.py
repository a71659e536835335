"""place and gather in one, for the coefficients of a field: what no point changes is settled once."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from filterlab.ops.cpu.gather import Gathering
from filterlab.ops.cpu.place import Placing
from filterlab.ops.place import Placement
from filterlab.ops.stencil import Stencil


@dataclass(frozen=True)
class Evaluator:
    """What gives rows of a stencil at world points of one dtype; no derivatives.

    Attributes:
        place: world points (N, M, 3) to located points, and their sign or None.
        gather: located points to rows (N, C, J, M).
    """

    place: Placing
    gather: Gathering

    @classmethod
    def of(
        cls, coefficients: Tensor, placement: Placement, stencil: Stencil, start: int, dtype: torch.dtype
    ) -> Evaluator:
        """For points of that dtype."""
        return cls(Placing(placement, dtype), Gathering(coefficients, stencil, start, dtype))
