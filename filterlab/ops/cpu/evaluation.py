"""place and gather in one, for the coefficients of a field: what no point changes is settled once."""

from __future__ import annotations

from torch import Tensor

from filterlab.ops.cpu.gather import Gathering
from filterlab.ops.cpu.place import Placing
from filterlab.ops.place import Placement
from filterlab.ops.stencil import Stencil


class Evaluator:
    """Rows of a stencil at world points of one dtype, and how the points were turned; no derivatives."""

    def __init__(
        self, coefficients: Tensor, placement: Placement, stencil: Stencil, start: int, points: Tensor
    ) -> None:
        self.place = Placing(placement, points.dtype)
        self.gather = Gathering(coefficients, stencil, start, points.dtype)

    def __call__(self, points: Tensor) -> tuple[Tensor, Tensor | None]:
        """(N, M, 3) -> rows (N, C, J, M), and sign (N, M, 3) or None."""
        located, sign = self.place(points)
        return self.gather(located), sign
