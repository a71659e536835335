"""What a field does with points: place, then gather. What no point changes is settled when the field is built."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import torch
from torch import Tensor

from filterlab.ops.differentiable import operators
from filterlab.ops.differentiable.drivers import driver
from filterlab.ops.differentiable.gather import gather
from filterlab.ops.differentiable.place import place
from filterlab.ops.differentiable.recording import plain
from filterlab.ops.place import InWorld, Placed, Placement
from filterlab.ops.tetrahedra import AnyStencil

if TYPE_CHECKING:
    from filterlab.ops.cpu.evaluation import Evaluator


@dataclass(frozen=True, eq=False)
class Evaluation:
    """Rows of a stencil at world points: `ops.place`, then `ops.gather`, in one descent where nothing is recorded.

    Nothing is checked here: whoever builds it knows that the implementation can run as asked, and gives points of a
    right type and shape.

    Attributes:
        coefficients: (N, C, D, H, W).
        placement, stencil, start: as for `ops.place` and `ops.gather`.
        implementation: a key of `ops.IMPLEMENTATIONS`.
    """

    coefficients: Tensor
    placement: Placement
    stencil: AnyStencil
    start: int
    implementation: str
    _prepared: dict[torch.dtype, Evaluator] = field(default_factory=dict, repr=False)

    def __call__(self, points: Tensor) -> Placed:
        """(N, M, 3) -> rows (N, C, J, M), and the sign (N, M, 3) of `ops.place` or None."""
        if self.implementation == "cpu" and plain(self.coefficients, points):
            return (self._prepared.get(points.dtype) or self._prepare(points.dtype))(points)
        if torch.compiler.is_compiling():
            return self._compiled(points)
        located, sign = place(points, self.placement, self.implementation)
        return gather(self.coefficients, located, self.stencil, self.start, self.implementation), sign

    def in_world(self, points: Tensor, shape: Sequence[int], turned: bool = True) -> InWorld | None:
        """(N, M, 3) -> value (N, C, M) and gradient (N, C, M, 3) per world unit, of a jet of order 1, in one pass.

        None: rows are to be asked for. Something is recorded, it takes other steps, or plain torch.

        Args:
            shape: N C M numbers, as the values are wanted.
            turned: whether points that `ops.place` would turn are right, too.
        """
        if self.implementation != "cpu" or not plain(self.coefficients, points):
            return None
        return (self._prepared.get(points.dtype) or self._prepare(points.dtype)).in_world(points, shape, turned)

    def of(self, coefficients: Tensor) -> Evaluation:
        """The same of other coefficients, on the same device, which lie as these do."""
        return Evaluation(coefficients, self.placement, self.stencil, self.start, self.implementation)

    def _prepare(self, dtype: torch.dtype) -> Evaluator:
        made = driver("cpu", "evaluation").Evaluator(self.coefficients, self.placement, self.stencil, self.start, dtype)
        if made.gather.coefficients.data_ptr() == self.coefficients.data_ptr():  # a copy could become outdated
            self._prepared[dtype] = made
        return made

    def _compiled(self, points: Tensor) -> Placed:
        """By operators of `torch.library`."""
        located, sign = operators.place(points, operators.placement_text(self.placement), self.implementation)
        text = operators.stencil_text(self.stencil)
        return operators.gather(self.coefficients, located, text, self.start, self.implementation), sign

    def __getstate__(self) -> dict[str, Any]:
        """Machine code stays behind in a copy."""
        return {**vars(self), "_prepared": {}}
