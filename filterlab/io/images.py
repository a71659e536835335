"""Images: linear light in tensors, sRGB in PNG files."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import torch
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from filterlab.io.atomic import atomic_write


def to_srgb(linear: Tensor) -> Tensor:
    """The sRGB transfer function: 12.92 c for c ≤ 0.0031308, else 1.055 c^(1/2.4) − 0.055. Differentiable.

    Source: IEC 61966-2-1:1999.
    """
    curve = 1.055 * linear.clamp_min(0.0031308) ** (1 / 2.4) - 0.055
    return torch.where(linear <= 0.0031308, 12.92 * linear, curve)


def from_srgb(encoded: Tensor) -> Tensor:
    """The inverse of `to_srgb`: c / 12.92 for c ≤ 0.04045, else ((c + 0.055) / 1.055)^2.4. Differentiable."""
    curve = ((encoded.clamp_min(0.04045) + 0.055) / 1.055) ** 2.4
    return torch.where(encoded <= 0.04045, encoded / 12.92, curve)


def save_image(image: Tensor, path: str | os.PathLike[str], *, srgb: bool = True) -> None:
    """Writes an 8-bit PNG; the file appears whole or not at all.

    Args:
        image: (H, W) grey, (H, W, 3) RGB, or (H, W, 4) RGB and alpha, not premultiplied; floating, linear light in
            0..1 (clipped to it). Row 0 is the top.
        srgb: encode grey and RGB by the sRGB transfer function (alpha stays linear); False stores the numbers as given.

    Raises:
        ValueError: another shape or ending, or values that are not finite.
        OSError: the folder is missing or not writable.
    """
    if Path(path).suffix.lower() != ".png":
        raise ValueError(f"expected a file name that ends in .png; got {path}")
    if not image.dtype.is_floating_point or 0 in image.shape:
        raise ValueError(f"image must be floating and not empty; got {image.dtype} {tuple(image.shape)}")
    if image.ndim != 2 and not (image.ndim == 3 and image.shape[-1] in (3, 4)):
        raise ValueError(f"image must have shape (H, W), (H, W, 3) or (H, W, 4); got {tuple(image.shape)}")
    linear = image.detach().cpu().to(torch.float64)
    if not linear.isfinite().all():
        raise ValueError(f"image must be finite; got {int((~linear.isfinite()).sum())} values that are not")
    linear = linear.clamp(0, 1)
    if srgb:
        colour = to_srgb(linear[..., :3] if linear.ndim == 3 else linear)
        linear = torch.cat((colour, linear[..., 3:]), -1) if linear.ndim == 3 else colour
    encoded = (255 * linear).round().to(torch.uint8).numpy()
    with atomic_write(path) as temporary:
        Image.fromarray(encoded).save(temporary, format="PNG")


def load_image(path: str | os.PathLike[str], *, srgb: bool = True) -> Tensor:
    """The image in a file as linear RGB, float32 (H, W, 3) in 0..1; grey is repeated and alpha is left out.

    Raises:
        ValueError: no image, or one of more than 2^28 pixels.
        OSError: the file cannot be read.
    """
    try:
        with Image.open(path, formats=["PNG"]) as picture:
            if picture.width * picture.height > 2**28:
                raise ValueError(f"{path}: expected at most {2**28} pixels; got {picture.width} × {picture.height}")
            deep = picture.mode.startswith("I")
            pixels = np.asarray(picture.convert("I") if deep else picture.convert("RGB"))
    except (UnidentifiedImageError, SyntaxError, Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise ValueError(f"{path}: expected a PNG image; got {error}") from None
    encoded = torch.from_numpy(pixels.astype(np.float64) / (65535 if deep else 255))
    encoded = encoded[..., None].expand(-1, -1, 3) if deep else encoded
    return (from_srgb(encoded) if srgb else encoded).to(torch.float32).contiguous()
