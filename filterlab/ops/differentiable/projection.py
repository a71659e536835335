"""Which sample along a ray is the largest: what runs it. The answer is a number, and has no derivative."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from filterlab.ops import cpu
from filterlab.ops.differentiable.drivers import driver
from filterlab.ops.differentiable.recording import transforming
from filterlab.ops.projection import Projection
from filterlab.ops.tetrahedra import AnyStencil


def missing(coefficients: Tensor, stencil: AnyStencil, start: int, dtype: torch.dtype) -> str | None:
    """What keeps the program from running here as asked, of coefficients (D, H, W); None: nothing does."""
    if transforming():
        return "it has no transforms of torch.func"
    points = torch.empty(1, 0, 3, dtype=dtype, device=coefficients.device)
    return cpu.missing(coefficients.detach()[None, None], points, stencil, None, start)


def largest(
    given: Projection, report: Callable[[int], None] = lambda rays: None, implementation: str = "cpu"
) -> Tensor:
    """The number of the first of the largest samples of every ray (R,) int64; −1 where none has a value."""
    return driver(implementation, "projection").largest(given, report)
