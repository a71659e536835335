"""Colormaps by name, and the scales that give values their colours.

Names and entries are matplotlib's, but for `hypsometric`. They are colours of a screen, encoded by sRGB; computed is
with linear light.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from filterlab.io.images import from_srgb
from filterlab.names import unknown_name

GRAY, HYPSOMETRIC = "gray", "hypsometric"
_TINTS = (
    *("#5e8f62", "#7ba869", "#9bbd75", "#bccd86", "#d8d597", "#e6d49b", "#dfc08a", "#cda673", "#b98f64", "#a67f5f"),
    *("#9b7b66", "#a28b7f", "#b3a59e", "#c9c1bd", "#dfdbd9", "#f1f0ef", "#ffffff"),
)
"""Tints of an atlas at equal steps of height: meadows, dry land, rock, snow."""
_WELL_KNOWN = ("viridis", "magma", "inferno", "plasma", "cividis", "turbo", "gray", "bone", "hot", "coolwarm", "RdBu")


def check_colormap(name: str) -> str:
    """The name. Raises ValueError unless there is a colormap of it."""
    if name not in (GRAY, HYPSOMETRIC):  # which need no matplotlib
        from matplotlib import colormaps

        if name not in colormaps:
            close = unknown_name("colormap", name, colormaps).partition("known colormaps")[0]
            raise ValueError(f"{close}known colormaps: {HYPSOMETRIC}, those of matplotlib, as {', '.join(_WELL_KNOWN)}")
    return name


def encoded_entries(name: str) -> Tensor:
    """A colormap's own entries, first to last, encoded by sRGB, `(N, 3)` float64. Raises as `check_colormap`."""
    if check_colormap(name) == GRAY:
        return torch.tensor([[0.0] * 3, [1.0] * 3], dtype=torch.float64)
    if name == HYPSOMETRIC:
        return torch.tensor([list(bytes.fromhex(tint[1:])) for tint in _TINTS], dtype=torch.float64) / 255
    from matplotlib import colormaps

    colormap = colormaps[name]
    return torch.as_tensor(colormap(range(colormap.N))[:, :3], dtype=torch.float64)


@dataclass(frozen=True)
class ColorScale:
    """Colours for the values of a window: those of a colormap from its first value to its last, constant beyond.

    c(v) = sRGB⁻¹(e_j + (w (N−1) − j)(e_{j+1} − e_j)),   w = (v − low)/(high − low) cut to 0 … 1, j = ⌊w (N−1)⌋

    with the colormap's N entries e, which are encoded: under `gray` a pixel of a picture is 255 w, as viewers show it.
    Differentiable in the values.

    Attributes:
        low, high: the values at both ends; where they are equal, as in a constant volume, every value is the first.
        colormap: a name of matplotlib's, or `hypsometric`.

    Raises:
        ValueError: no such colormap, or ends that do not increase.
    """

    low: float
    high: float
    colormap: str = GRAY

    def __post_init__(self) -> None:
        check_colormap(self.colormap)
        if not self.low <= self.high < float("inf"):
            raise ValueError(f"expected the lower end of a window first; got {self.low:g} and {self.high:g}")

    def __call__(self, value: Tensor) -> Tensor:
        """Linear RGB `(..., 3)` of values `(...)`, in promote(value, float32)."""
        value = value.to(torch.promote_types(value.dtype, torch.float32))
        entries = encoded_entries(self.colormap).to(value)
        place = ((value - self.low) / (self.high - self.low or 1.0)).clamp(0, 1) * (len(entries) - 1)
        first = place.detach().floor().clamp(max=len(entries) - 2).long()
        return from_srgb(torch.lerp(entries[first], entries[first + 1], (place - first)[..., None]))
