"""NumPy arrays where tensors are taken: the one place where they become tensors."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TypeVar, overload

import numpy as np
import torch
from torch import Tensor

Array = Tensor | np.ndarray


_Other = TypeVar("_Other")


@overload
def as_tensor(x: Array) -> Tensor: ...
@overload
def as_tensor(x: _Other) -> _Other: ...
def as_tensor(x: object) -> object:
    """A tensor as it is; a NumPy array as a tensor of its type, on the CPU, that shares its memory where torch can.

    It is copied where it is read-only, has negative strides or bytes in foreign order. What is computed stays a tensor.
    Anything else is returned as it is, for the caller to refuse.

    Raises:
        TypeError: an array of no numbers, of numbers that torch has no type for, or with a mask, which would be lost.
    """
    if not isinstance(x, np.ndarray):
        return x
    if isinstance(x, np.ma.MaskedArray):
        raise TypeError("expected an array without a mask; got a masked one: fill it, with NaN for what is missing")
    if x.dtype.kind not in "biufc" or x.dtype.itemsize > (16 if x.dtype.kind == "c" else 8):
        raise TypeError(f"expected an array of numbers that torch has a type for; got {x.dtype}")
    native = x.astype(x.dtype.newbyteorder("="), copy=False)
    strided = all(s >= 0 and s % x.itemsize == 0 for s in native.strides)
    return torch.from_numpy(np.asarray(native) if strided and native.flags.writeable else native.copy())


def as_numbers(
    x: Array | Sequence[float] | Sequence[Sequence[float]] | float,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str | None = None,
) -> Tensor:
    """Numbers, however they are given, as a tensor of a type; differentiable in a tensor.

    Args:
        device: where they are to be; None: where a tensor is, else on the CPU.

    Raises:
        TypeError, ValueError, OverflowError or RuntimeError, as torch does, for what are no numbers.
    """
    return torch.as_tensor(as_tensor(x), dtype=dtype, device=device)


def all_finite(x: Tensor) -> bool:
    """Whether all numbers are: a finite sum has finite terms; finite terms may have another one."""
    x = x.detach()
    total = x.sum(dtype=torch.promote_types(x.dtype, torch.float32))
    return math.isfinite(float(total)) or bool(x.isfinite().all())
