"""place and gather in one, for the coefficients of a field: what no point changes is settled once."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from filterlab.ops.cpu import threads as pool
from filterlab.ops.cpu.folding import LOST, TURNED
from filterlab.ops.cpu.gather import Gathering, sorting_may_pay
from filterlab.ops.cpu.memory import fresh
from filterlab.ops.cpu.place import Placing
from filterlab.ops.gather import readable
from filterlab.ops.place import InWorld, Placed, Placement
from filterlab.ops.tetrahedra import AnyStencil


class Evaluator:
    """Rows of a stencil at world points of one dtype, and how the points were turned; no derivatives.

    One program places and gathers, block by block. In two steps go points that may have to be sorted once they are
    located, and those of which some are lost.
    """

    def __init__(
        self, coefficients: Tensor, placement: Placement, stencil: AnyStencil, start: int, dtype: torch.dtype
    ) -> None:
        self.place = Placing(placement, dtype)
        self.gather = Gathering(coefficients, stencil, start, dtype)
        self.program = self.gather.program.after(self.place)

    def __call__(self, points: Tensor) -> Placed:
        """(N, M, 3) -> rows (N, C, J, M), and sign (N, M, 3) or None."""
        gather, (entries, count, _) = self.gather, points.shape
        if sorting_may_pay(count, gather.bytes_of_channel):
            return self._in_steps(points)
        out = fresh((entries, gather.channels, gather.rows, count), gather.dtype)
        if not (entries and count and gather.channels):
            return out, None
        jobs = self.program.shared(gather.coefficients, readable(points, 1), out)
        pool.run(self.program.run, jobs)
        met, sign = jobs[0].met, None
        if met & LOST:
            return self._in_steps(points)
        if met & TURNED:
            located, sign = (fresh(points.shape, points.dtype) for _ in range(2))
            pool.run(self.place.run, self.place.shared(points, located=located, signs=sign))
        return out, sign

    def in_world(self, points: Tensor, shape: Sequence[int], turned: bool) -> InWorld | None:
        """(N, M, 3) -> value and gradient in the world, of N C M numbers in the shape asked for; see `Evaluation`."""
        gather, (entries, count, _) = self.gather, points.shape
        if sorting_may_pay(count, gather.bytes_of_channel):
            return None
        value, gradient = fresh(shape, gather.dtype), fresh((*shape, 3), gather.dtype)
        if entries and count and gather.channels:
            jobs = self.program.shared(gather.coefficients, readable(points, 1), value, gradient=gradient)
            pool.run(self.program.run, jobs)
            if jobs[0].met & (LOST if turned else LOST | TURNED):
                return None
        return value, gradient

    def _in_steps(self, points: Tensor) -> Placed:
        located, sign = self.place(points)
        return self.gather(located), sign
