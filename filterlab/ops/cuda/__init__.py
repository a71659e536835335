"""Every op in Triton: one program per stencil (the prefilter's: per number of poles), compiled at its first use.

`gather`, `prefilter`, `march`, `raycast`, `heights`, `height_hits`, … describe arrays to programs and launch them;
`points`, `recursion`, `compositing`, `adjoint`, `crossings`, `height_jets`, `height_rays`, … write those programs,
from the sums of `taps` (read it first; of splines on tetrahedra `tetrahedra`) and what `segments` and `cells` know of
rays; `launch` hands their text to Triton, which keeps what it has compiled on disk. With TRITON_INTERPRET=1 in the
environment the same programs run on tensors of the CPU, in Triton's interpreter: slowly, to test them where there is
no GPU. What is here can be asked without Triton: whether they can run at all.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor

from filterlab.ops.gather import unsupported
from filterlab.ops.tetrahedra import AnyStencil

_COORDINATES = {torch.float32: 1 << 24, torch.float64: 1 << 31}  # exact in the dtype


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
    if coefficients.device != points.device:
        return f"it works on tensors of one device; got {coefficients.device} and {points.device}"
    if problem := device_problem(points):
        return problem
    if problem := unsupported(coefficients, points, stencil, shape):
        return problem
    sizes, limit = tuple(coefficients.shape[2:] if shape is None else shape), _COORDINATES[points.dtype]
    if abs(start) + max(sizes) >= limit:
        return f"indices along an axis must stay below {limit}; got {sizes} from {start}"
    return None


@lru_cache
def _triton_problem() -> str | None:
    try:
        import filterlab.ops.cuda.launch  # noqa: F401
    except (ImportError, OSError) as error:
        return f"the package triton can't be loaded ({error}); pip install triton"
    return None


def device_problem(tensor: Tensor) -> str | None:
    """What keeps programs from running where this tensor is; None: nothing does."""
    if problem := _triton_problem():
        return problem
    from filterlab.ops.cuda.launch import interpreting

    if tensor.device.type == "cuda" or (tensor.device.type == "cpu" and interpreting()):
        return None
    return f"it works on tensors of a GPU (of the CPU with TRITON_INTERPRET=1); got {tensor.device}"
