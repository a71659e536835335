"""gather and its transpose scatter, described: which numbers they read, which stencils the fused ones sum.

    gather     rows (N, C, J, M) of a stencil at M points, from coefficients (N, C, D, H, W)
    scatter    the transpose of that: rows at points, added up in coefficients
    pull       the adjoint of gather to its points (N, M, 3)

`ops.reference.gather` says exactly what is computed.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

from filterlab.ops.stencil import Stencil
from filterlab.ops.tetrahedra import AnyStencil

MAX_ORDER = 3
MAX_SUPPORT = 6

STORAGE = {
    torch.float32: "float32",
    torch.float64: "float64",
    torch.float16: "float16",
    torch.bfloat16: "bfloat16",
    torch.uint8: "uint8",
    torch.int8: "int8",
    torch.int16: "int16",
    torch.int32: "int32",
}
"""How coefficients may be stored."""


def unsupported(
    coefficients: Tensor, points: Tensor, stencil: AnyStencil, shape: Sequence[int] | None = None
) -> str | None:
    """What no fused implementation can do of a gather (or, with `shape`, a scatter of cotangents); None: nothing."""
    if points.dtype not in (torch.float32, torch.float64):
        return f"points must be float32 or float64; got {points.dtype}"
    if shape is None and coefficients.dtype not in STORAGE:
        return f"coefficients must be stored as {', '.join(STORAGE.values())}; got {coefficients.dtype}"
    if not stencil.exact:
        return "its kernels are fixed tables; got a TensorKernel"
    if isinstance(stencil, Stencil) and max(stencil.supports) > MAX_SUPPORT:
        return f"supports go up to {MAX_SUPPORT}; got {', '.join(str(s) for s in stencil.supports)}"
    if stencil.order > MAX_ORDER:
        return f"orders go up to {MAX_ORDER}; got {stencil.order}"
    return None


def readable(tensor: Tensor, outer: int) -> Tensor:
    """The tensor with everything after its first `outer` dimensions lying together; any strides before (0 too)."""
    if tensor.is_contiguous() and not tensor.is_neg():
        return tensor
    tensor = tensor.detach().resolve_neg()
    together = tensor[(0,) * outer].is_contiguous()
    return tensor if together else tensor.contiguous()


def in_whole_rows(coefficients: Tensor) -> Tensor:
    """The same (D, H, W), in rows that lie together and planes of whole rows."""
    values = coefficients.detach().resolve_neg()
    plane, row, one = values.stride()
    whole = one == 1 and row > 0 and plane % max(row, 1) == 0
    return values if whole else values.contiguous()


def extent(tensor: Tensor) -> int:
    """Numbers from the first of a tensor to its last, in memory; of one that has any."""
    return 1 + sum((n - 1) * stride for n, stride in zip(tensor.shape, tensor.stride(), strict=True))
