"""Every op as vector code for this processor, compiled at its first use.

    stencil ──▶ variant ──write──▶ LLVM IR ──compiler──▶ machine code ──▶ cache (disk)
                                                                │
    tensors ──▶ job ────────────────────────────threads─────────┴──▶ result

`gather`, `place`, `prefilter`, `contract`, `march`, `projection`, `raycast`, `vectors`, `hit_points`, `quadrics`,
`heights` and `bounds` describe arrays to programs as jobs and run them; `points`, `folding`, `recursion`,
`contraction`, `compositing`, `largest`, `crossings`, `vector_bits`, `hit_rows`, `quadric_hits`, `height_jets` and
`hulls` write those programs, from the sums of `taps` (read it first, its head explains how they are computed) and the
single instructions of `lanes`.
`compiler` and `cache` make and keep machine code, `threads` runs it. What is here can be asked without llvmlite:
whether they can run at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor

from filterlab import forking
from filterlab.ops.gather import unsupported
from filterlab.ops.tetrahedra import AnyStencil
from filterlab.ops.tracing import constant

_COORDINATES = {torch.float32: 1 << 24, torch.float64: 1 << 28}  # exact in the dtype; 8 times it fits 32 bits


def missing(
    coefficients: Tensor,
    points: Tensor,
    stencil: AnyStencil,
    shape: Sequence[int] | None = None,
    start: int = 0,
) -> str | None:
    """What keeps gather (or, with `shape`, scatter of cotangents) from running here as asked; None: nothing does.

    Args:
        coefficients: (N, C, D, H, W), or the cotangents (N, C, J, M) of scatter.
        points: (N, M, 3).
        stencil: what is summed.
        shape: (D, H, W) of the result of scatter.
        start: the coordinate of coefficient 0.
    """
    if problem := llvmlite_problem():
        return problem
    if coefficients.device.type != "cpu" or points.device.type != "cpu":
        return f"it works on tensors of the CPU; got {coefficients.device} and {points.device}"
    if problem := unsupported(coefficients, points, stencil, shape):
        return problem
    sizes, limit = tuple(coefficients.shape[2:] if shape is None else shape), _COORDINATES[points.dtype]
    if abs(start) + max(sizes) >= limit or sizes[0] * sizes[1] >= 1 << 31:
        return f"indices along an axis must stay below {limit} and rows below {1 << 31}; got {sizes} from {start}"
    return None


@constant
def llvmlite_problem() -> str | None:
    """Why no program can be compiled here; None: they can."""
    return _llvmlite_problem()


@lru_cache
def _llvmlite_problem() -> str | None:
    try:
        with forking.lock:  # what the first call needs, whole
            import filterlab.ops.cpu.evaluation  # noqa: F401
    except (ImportError, OSError) as error:
        return f"the package llvmlite can't be loaded ({error}); pip install llvmlite"
    return None
