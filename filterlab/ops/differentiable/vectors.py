"""Facts about vectors, which have no derivatives: a program where it can run and there are many, else plain torch."""

from __future__ import annotations

import torch
from torch import Tensor

from filterlab.ops import cpu
from filterlab.ops.differentiable.drivers import driver
from filterlab.ops.differentiable.recording import plain
from filterlab.ops.reference import vectors as reference
from filterlab.ops.vectors import Facts

_MANY = 1 << 15
"""Numbers: of fewer, plain torch takes less time than it takes to start a program."""


def facts(vectors: Tensor) -> Facts:
    """Of vectors (..., 3) of floating-point numbers."""
    fused = vectors.numel() >= _MANY and vectors.shape[-1] == 3 and _can_run(vectors)
    return driver("cpu", "vectors").facts(vectors) if fused else reference.facts(vectors)


def _can_run(vectors: Tensor) -> bool:
    held = vectors.device.type == "cpu" and vectors.dtype in (torch.float32, torch.float64)
    bare = held and vectors.is_contiguous() and not vectors.is_neg() and plain(vectors)
    return bare and cpu.llvmlite_problem() is None
