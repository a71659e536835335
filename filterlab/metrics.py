"""How far two functions, gradient fields or images are apart. Image metrics come from kornia and scikit-image.

All take tensors and NumPy arrays.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from filterlab.arrays import Array, as_tensor


def _comparable(a: Array, b: Array) -> tuple[Tensor, Tensor]:
    """Both as floating point of one type. Raises ValueError for different shapes."""
    a, b = as_tensor(a), as_tensor(b)
    if a.shape != b.shape:
        raise ValueError(f"both must have the same shape; got {tuple(a.shape)} and {tuple(b.shape)}")
    dtype = torch.promote_types(torch.promote_types(a.dtype, b.dtype), torch.float32)
    return a.to(dtype), b.to(dtype)


def _at_scale(x: Tensor, dim: int | None = None) -> tuple[Tensor, Tensor]:
    """(x / s, s) with s the power of two next to the largest |x|: squares stay in range, and no digit changes."""
    if x.numel() == 0:
        return x, x.new_ones(())
    size = x.detach().abs()
    largest = size.amax() if dim is None else size.amax(dim, keepdim=True)
    usable = largest.isfinite() & (largest > 0)
    unit = torch.exp2(torch.where(usable, largest, 1).log2().floor())
    return x / unit, unit


def rms(a: Array, b: Array, vectors: bool = False) -> Tensor:
    """√mean |a − b|²; with vectors=True |·| is the length along the last axis (gradients)."""
    a, b = _comparable(a, b)
    difference, unit = _at_scale(a - b)
    squared = difference**2
    return unit * (squared.sum(-1) if vectors else squared).mean().sqrt()


def max_error(a: Array, b: Array, vectors: bool = False) -> Tensor:
    """max |a − b|; with vectors=True |·| is the length along the last axis."""
    a, b = _comparable(a, b)
    difference, unit = _at_scale(a - b)
    return unit * (difference.norm(dim=-1) if vectors else difference.abs()).max()


def angular_error(a: Array, b: Array) -> Tensor:
    """The angle between vectors `(..., 3)` in radians, `(...)`: atan2(|a × b|, a · b), accurate for tiny angles too.

    Where either vector is zero the angle is NaN: it has no direction.
    """
    a, b = _comparable(a, b)
    a, b = _at_scale(a, dim=-1)[0], _at_scale(b, dim=-1)[0]  # each vector at its own: lengths do not matter
    angle = torch.atan2(torch.linalg.cross(a, b).norm(dim=-1), (a * b).sum(-1))
    undefined = (a == 0).all(-1) | (b == 0).all(-1)
    return torch.where(undefined, torch.full_like(angle, torch.nan), angle)


def psnr(a: Array, b: Array, peak: float = 1.0) -> float:
    """Peak signal-to-noise ratio 20 log₁₀(peak / rms) in dB; infinite for equal images. Through kornia."""
    from kornia.metrics import psnr as kornia_psnr

    a, b = _comparable(a, b)
    return float(kornia_psnr(a.detach(), b.detach(), peak))


def ssim(a: Array, b: Array, peak: float = 1.0) -> float:
    """Mean structural similarity of images (H, W) or (H, W, 3), Gaussian window σ = 1.5. Through scikit-image.

    Source: Wang, Bovik, Sheikh & Simoncelli, Image quality assessment, IEEE Trans. Image Processing 13, 2004.
    """
    from skimage.metrics import structural_similarity

    a, b = _comparable(a, b)
    first, second = (np.asarray(t.detach().cpu(), dtype=np.float64) for t in (a, b))
    channels = -1 if a.ndim == 3 else None
    score = structural_similarity(
        first,
        second,
        data_range=peak,
        channel_axis=channels,
        gaussian_weights=True,
        sigma=1.5,
        use_sample_covariance=False,
    )
    return float(np.asarray(score))
