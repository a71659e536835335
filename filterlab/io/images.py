"""Images: linear light in tensors, sRGB in files: PNG, JPEG, and what moves: GIF and animated PNG."""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence

import numpy as np
import torch
from PIL import Image, UnidentifiedImageError
from torch import Tensor

from filterlab.io.atomic import atomic_write
from filterlab.io.picture_formats import ANIMATIONS, format_of


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


JPEG_QUALITY = 95
"""Of libjpeg, without subsampling of colours: thin coloured structures stay sharp. Photographs get by with less."""

_SAVED = {"PNG": {}, "JPEG": {"quality": JPEG_QUALITY, "subsampling": 0}}


def save_image(
    image: Tensor,
    path: str | os.PathLike[str],
    *,
    srgb: bool = True,
    background: Sequence[float] | Tensor | None = None,
) -> None:
    """Writes an 8-bit PNG, or a JPEG of quality 95 (4:4:4); the file appears whole or not at all.

    Args:
        image: (H, W) grey, (H, W, 3) RGB, or (H, W, 4) RGB and alpha, not premultiplied; floating, linear light in
            0..1 (clipped to it). Row 0 is the top.
        path: ends in .png, .jpg or .jpeg.
        srgb: encode grey and RGB by the sRGB transfer function (alpha stays linear); False stores the numbers as given.
        background: linear RGB. An image with alpha is written over it, α rgb + (1 − α) background; a JPEG, which has no
            alpha, needs one.

    Raises:
        ValueError: another shape or ending, values that are not finite, alpha in a JPEG without a background, a
            background without alpha.
        OSError: the folder is missing or not writable.
    """
    kind = format_of(path)
    if background is not None:
        image = _over(image, background)
    if kind == "JPEG" and image.ndim == 3 and image.shape[-1] == 4:
        raise ValueError(f"a JPEG has no alpha: give background=, or the colours alone (image[..., :3]); {path}")
    picture = Image.fromarray(_digits(image, srgb))
    with atomic_write(path) as temporary:
        picture.save(temporary, format=kind, **_SAVED[kind])


def _over(image: Tensor, background: Sequence[float] | Tensor) -> Tensor:
    if image.ndim != 3 or image.shape[-1] != 4:
        raise ValueError(f"a background goes with alpha, an image (H, W, 4); got {tuple(image.shape)}")
    color = torch.as_tensor(background, dtype=image.dtype, device=image.device)
    if color.shape != (3,):
        raise ValueError(f"background must be three numbers (linear RGB); got {background!r}")
    return color + image[..., 3:].clamp(0, 1) * (image[..., :3] - color)


def _digits(image: Tensor, srgb: bool) -> np.ndarray:
    """What stands in the file, uint8. Raises ValueError as `save_image`."""
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
    return (255 * linear).round().to(torch.uint8).numpy()


def save_animation(frames: Iterable[Tensor], path: str | os.PathLike[str], *, seconds: float) -> None:
    """Writes a GIF or an animated PNG that goes round for ever; the file appears whole or not at all.

    A PNG has every digit of `save_image`. A GIF has one palette of 256 colours for all frames, dithered.

    Args:
        frames: images (H, W, 3) as for `save_image`, all of one size; each is asked for when the one before is ready.
            Their digits, 3 bytes a pixel, are kept until the file is written.
        path: ends in .gif or .png.
        seconds: for which each is shown; a GIF counts hundredths.

    Raises:
        ValueError: no frame, frames of several sizes, and as `save_image` does.
        OSError: the folder is missing or not writable.
    """
    kind = format_of(path, ANIMATIONS)
    with atomic_write(path) as temporary:
        pictures = [Image.fromarray(_digits(frame, srgb=True)) for frame in frames]
        if len({picture.size for picture in pictures}) != 1:
            raise ValueError(f"expected frames of one size; got {sorted({picture.size for picture in pictures})}")
        first, *others = _in_one_palette(pictures) if kind == "GIF" else pictures
        timing = {"duration": 1000 * seconds, "loop": 0}
        first.save(temporary, format=kind, save_all=True, append_images=others, **timing)


_PALETTE_PIXELS = 1 << 22


def _in_one_palette(pictures: list[Image.Image]) -> list[Image.Image]:
    """With the 256 colours that suit all of them best, so that no colour changes from frame to frame by itself."""
    every = max(1, -(-sum(p.width * p.height for p in pictures) // _PALETTE_PIXELS))
    sample = np.concatenate([np.asarray(p).reshape(-1, 3)[::every] for p in pictures])
    palette = Image.fromarray(sample[None]).quantize(256, method=Image.Quantize.MEDIANCUT)
    return [p.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG) for p in pictures]


def load_image(path: str | os.PathLike[str], *, srgb: bool = True) -> Tensor:
    """The image in a PNG or JPEG file as linear RGB, float32 (H, W, 3) in 0..1; grey is repeated, alpha left out.

    Raises:
        ValueError: no image, or one of more than 2^28 pixels.
        OSError: the file cannot be read.
    """
    try:
        with Image.open(path, formats=["PNG", "JPEG"]) as picture:
            if picture.width * picture.height > 2**28:
                raise ValueError(f"{path}: expected at most {2**28} pixels; got {picture.width} × {picture.height}")
            deep = picture.mode.startswith("I")
            pixels = np.asarray(picture.convert("I") if deep else picture.convert("RGB"))
    except (UnidentifiedImageError, SyntaxError, Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise ValueError(f"{path}: expected a PNG or JPEG image; got {error}") from None
    encoded = torch.from_numpy(pixels.astype(np.float64) / (65535 if deep else 255))
    encoded = encoded[..., None].expand(-1, -1, 3) if deep else encoded
    return (from_srgb(encoded) if srgb else encoded).to(torch.float32).contiguous()
