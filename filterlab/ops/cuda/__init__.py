"""gather and scatter in Triton: one program per stencil, compiled for the GPU at its first use.

`taps` writes the sums (read it first), `points` the programs around them, `march` and `adjoint` those of the renderer;
`launch` hands their text to Triton, which keeps what it has compiled on disk. With TRITON_INTERPRET=1 in the
environment the same programs run on tensors of the CPU, in Triton's interpreter: slowly, to test them where there is no
GPU.

Same meaning as `ops.reference`, orders 0 … 3. Coefficients are read as they are stored, sums are in the points' dtype.
gather repeats itself bit by bit. scatter adds atomically, in whatever order the GPU comes by, and repeats itself up to
rounding only; under `torch.use_deterministic_algorithms` the reference takes its place.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from filterlab.ops import reference
from filterlab.ops.fused import MAX_ORDER as MAX_ORDER
from filterlab.ops.fused import readable, unsupported
from filterlab.ops.stencil import Stencil

BLOCK = 128  # points of one program, one for each of its threads
WARPS = BLOCK // 32

_COORDINATES = {torch.float32: 1 << 24, torch.float64: 1 << 31}  # exact in the dtype


def missing(
    coefficients: Tensor,
    points: Tensor,
    stencil: Stencil,
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
    if problem := _triton_problem():
        return problem
    if problem := _device_problem(coefficients, points):
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


def _device_problem(coefficients: Tensor, points: Tensor) -> str | None:
    from filterlab.ops.cuda.launch import interpreting

    if coefficients.device != points.device:
        return f"it works on tensors of one device; got {coefficients.device} and {points.device}"
    if points.device.type == "cuda" or (points.device.type == "cpu" and interpreting()):
        return None
    return f"it works on tensors of a GPU (of the CPU with TRITON_INTERPRET=1); got {points.device}"


def gather(coefficients: Tensor, points: Tensor, stencil: Stencil, start: int = 0) -> Tensor:
    """`ops.reference.gather`, fused. Nothing is copied but what is not contiguous within a channel or a batch entry."""
    n, c = coefficients.shape[:2]
    out = points.new_empty((n, c, len(stencil.rows), points.shape[1]))
    if out.numel():
        _launch("gather", readable(coefficients, 2), readable(points, 1), out, stencil, start)
    return out


def scatter(cotangents: Tensor, points: Tensor, stencil: Stencil, shape: Sequence[int], start: int = 0) -> Tensor:
    """`ops.reference.scatter`, fused; it is the reference where torch is told to be deterministic."""
    if torch.are_deterministic_algorithms_enabled():
        return reference.scatter(cotangents, points, stencil, shape, start)
    out = points.new_zeros((*cotangents.shape[:2], *shape))
    if cotangents.numel():
        _launch("scatter", out, readable(points, 1), readable(cotangents.to(points.dtype), 0), stencil, start)
    return out


def _launch(operation: str, coefficients: Tensor, points: Tensor, rows: Tensor, stencil: Stencil, start: int) -> None:
    """One launch: programs for all blocks of all batch entries. `rows` (N, C, J, M) is contiguous."""
    from filterlab.ops.cuda.launch import interpreting

    entries, count = points.shape[:2]
    arguments = (coefficients, points, rows, count, *coefficients.shape[1:], start)
    strides = (coefficients.stride(0), coefficients.stride(1), points.stride(0))
    program = _program(operation, stencil, interpreting())
    with torch.cuda.device_of(points):  # Triton launches on the current device
        program[(entries * -(-count // BLOCK),)](*arguments, *strides, BLOCK=BLOCK, num_warps=WARPS)


@lru_cache(maxsize=1024)
def _program(operation: str, stencil: Stencil, interpreted: bool) -> Any:
    from filterlab.ops.cuda import points
    from filterlab.ops.cuda.launch import launchable

    return launchable({"gather": points.gather, "scatter": points.scatter}[operation](stencil.lowered))
