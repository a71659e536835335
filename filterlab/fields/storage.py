"""How coefficients are stored: as they were computed, in a shorter floating type, or as integers.

Arithmetic stays in promote(points, float32) whatever the storage; what a shorter type costs is its rounding, once per
coefficient, and what it saves is memory and the time to read it. An integer q of b bits stands for

    c = scale · q + offset,    scale = (max c − min c) / (2^b − 1)

with a range of its own for every volume of a batch. Where 0 lies within the range, it is stored exactly, so that what
lies outside under the boundary `zeros` stays 0.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import torch
from torch import Tensor

StorageName = Literal["float64", "float32", "float16", "bfloat16", "int16", "int8", "uint8"]
STORAGE: dict[str, torch.dtype] = {name: getattr(torch, name) for name in get_args(StorageName)}
"""Names and types in which coefficients may be stored."""


def named_storage(storage: str | torch.dtype | None) -> torch.dtype | None:
    """The type of that name, or as it is. Raises ValueError that lists the known ones."""
    dtype = STORAGE.get(storage) if isinstance(storage, str) else storage
    if storage is not None and dtype not in STORAGE.values():
        raise ValueError(f"storage must be one of {', '.join(STORAGE)}, or None; got {storage!r}")
    return dtype


@dataclass(frozen=True)
class Quantization:
    """coefficient = scale · stored + offset.

    Attributes:
        scale, offset: float64, () or (N, C).
    """

    scale: Tensor
    offset: Tensor

    def __getitem__(self, index: tuple[int, int]) -> Quantization:
        return Quantization(self.scale[index], self.offset[index])

    def numbers(self) -> tuple[float, float]:
        """(scale, offset), of an unbatched field."""
        return float(self.scale), float(self.offset)

    def decoded(self, stored: Tensor, dtype: torch.dtype) -> Tensor:
        """The coefficients `(..., D, H, W)` of stored numbers."""
        return self._like(self.scale, stored, dtype) * stored.to(dtype) + self._like(self.offset, stored, dtype)

    def of_rows(self, rows: Tensor) -> Tensor:
        """Sums over coefficients from sums over stored numbers, (N, C, J, M): the value, then derivatives.

        The weights of a value sum to 1, those of a derivative to 0.
        """
        scaled = rows * self._like(self.scale, rows, rows.dtype)[..., 0]
        value = scaled[:, :, :1] + self._like(self.offset, rows, rows.dtype)[..., 0]
        return torch.cat((value, scaled[:, :, 1:]), 2)

    def stored(self, values: Tensor) -> Tensor:
        """The numbers, not rounded, that stand for `values`: the inverse map, of an unbatched field."""
        return ((values.double() - self.offset) / self.scale).to(values.dtype)

    @staticmethod
    def _like(number: Tensor, other: Tensor, dtype: torch.dtype) -> Tensor:
        return number.to(dtype)[..., None, None, None] if other.ndim > 3 else number.to(dtype)


def stored_as(values: Tensor, dtype: torch.dtype | None) -> tuple[Tensor, Quantization | None]:
    """Coefficients `(..., D, H, W)` in another type, and what integers stand for; None: as they are.

    Differentiable for the floating types.

    Raises:
        ValueError: coefficients that a floating type can't hold, or that require grad and would become integers.
    """
    if dtype is None or dtype == values.dtype:
        return values, None
    if dtype.is_floating_point:
        _check_range(values, dtype)
        return values.to(dtype), None
    if values.requires_grad:
        raise ValueError(f"storage={_name(dtype)} can't be differentiated; use a floating type or samples without grad")
    return _quantized(values.detach(), dtype)


def _check_range(values: Tensor, dtype: torch.dtype) -> None:
    # bfloat16 has the range of float32; only what is shorter in range is looked at
    if torch.finfo(dtype).max >= _largest_of(values.dtype):
        return
    largest = float(values.detach().abs().nan_to_num(posinf=0).max())
    if largest > torch.finfo(dtype).max:
        raise ValueError(
            f"storage={_name(dtype)} holds numbers up to {torch.finfo(dtype).max:g}; coefficients reach {largest:g}"
        )


def _largest_of(dtype: torch.dtype) -> float:
    return torch.finfo(dtype).max if dtype.is_floating_point else torch.iinfo(dtype).max


def _quantized(values: Tensor, dtype: torch.dtype) -> tuple[Tensor, Quantization]:
    info, flat = torch.iinfo(dtype), values.to(torch.promote_types(values.dtype, torch.float32)).flatten(-3)
    low, high = (end.double() for end in flat.aminmax(dim=-1))
    if not bool((low.isfinite() & high.isfinite()).all()):
        raise ValueError(f"storage={_name(dtype)} holds finite numbers only; coefficients are not all finite")
    scale = (high - low) / (info.max - info.min)
    scale = torch.where(scale > 0, scale, torch.ones_like(scale))
    zero = info.min - low / scale
    zero = torch.where((low <= 0) & (high >= 0), zero.round(), zero)
    q = (flat / scale.to(flat)[..., None]).add_(zero.to(flat)[..., None]).round_().clamp_(info.min, info.max)
    return q.to(dtype).reshape(values.shape), Quantization(scale, -zero * scale)


def _name(dtype: torch.dtype) -> str:
    return str(dtype).removeprefix("torch.")
