"""Short symmetric prefilters: a few taps that are convolved with the samples, and can be learned.

A prefilter of 2m + 1 taps is given by the m that are free, h_1 … h_m: h_−k = h_k, and h_0 = 1 − 2 Σ h_k, so that a
constant stays what it was. Along an axis

    c_i = f_i + Σ_k h_k (f_{i−k} − 2 f_i + f_{i+k}),        H(ω) = 1 − 2 Σ_k h_k (1 − cos kω),

with the samples extended by the boundary. The prefilters of `filterlab.prefilters` are inverses of such filters.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from filterlab.kernels import PiecewisePolynomial
from filterlab.prefilters import Prefilter
from filterlab.spectrum import kernel_response
from filterlab.volume import Boundary


def convolve(samples: Tensor, taps: Tensor, boundary: str | Boundary) -> Tensor:
    """The samples `(..., D, H, W)` prefiltered along x, y and z; the same shape.

    Differentiable in the samples and in `taps`, h_1 … h_m `(m)`. Under mirror, reflect and wrap the result extends as
    the samples do, so that a field can be made of it under the same boundary; under border and zeros it does not.

    Raises:
        ValueError: border or zeros.
    """
    boundary = Boundary.named(boundary)
    if not boundary.periodic:
        raise ValueError(
            f"expected the boundary mirror, reflect or wrap; got {boundary}: coefficients extend otherwise"
        )
    reach = len(taps)
    for dim in (-3, -2, -1) if reach else ():
        n, center = samples.shape[dim], 1 - 2 * taps.sum()
        extended = boundary.extend(samples, dim, reach, reach)
        filtered = center * samples
        for k, tap in enumerate(taps.unbind(), start=1):
            filtered = filtered + tap * (extended.narrow(dim, reach - k, n) + extended.narrow(dim, reach + k, n))
        samples = filtered
    return samples


def response(taps: Tensor, omega: Tensor) -> Tensor:
    """H(ω) along an axis; ω in radians per voxel."""
    k = torch.arange(1, len(taps) + 1, dtype=omega.dtype, device=omega.device)
    return 1 - 2 * (taps.to(omega) * (1 - torch.cos(omega[..., None] * k))).sum(-1)


def low_pass(cutoff: float, reach: int) -> Tensor:
    """The free taps of a low-pass: a sinc under a Hann window of 2·reach + 1 taps, ½ at `cutoff` radians per voxel."""
    k = torch.arange(reach + 1, dtype=torch.float64)
    taps = cutoff / math.pi * torch.sinc(k * cutoff / math.pi) * torch.cos(math.pi / 2 * k / (reach + 1)) ** 2
    return taps[1:] / (taps[0] + 2 * taps[1:].sum())


def multiplications(prefilter: Prefilter | int) -> int:
    """Per voxel of a volume, once: of a prefilter of so many taps, or of a recursive one.

    Symmetric taps share a factor: m + 1 for 2m + 1 taps along an axis. A recursive prefilter has two for each pole
    (forth and back) and one for the gain.
    """
    if isinstance(prefilter, int):
        return 0 if prefilter == 1 else 3 * ((prefilter - 1) // 2 + 1)
    return 0 if prefilter.is_identity else 3 * (2 * len(prefilter.poles) + 1)


def error_kernel(kernel: PiecewisePolynomial, prefiltering: Tensor, omega: Tensor) -> Tensor:
    """RMS error of a reconstructed wave cos(ωx + phase), relative to its own RMS, over all phases; along an axis.

    E(ω)² = (1 − P(ω)Φ(ω))² + P(ω)² Σ_{k≠0} Φ(ω + 2πk)²: what is lost of the wave, and what it leaves at its aliases.
    `prefiltering` is P at the ω. Aliases up to |k| = 64; Φ² falls as ω⁻⁴ at the least.

    Source: Blu & Unser, Quantitative Fourier analysis of approximation techniques, part I, 1999.
    """
    lost = 1 - prefiltering * kernel_response(kernel, omega)
    return (lost.square() + prefiltering.square() * _aliases(kernel, omega)).sqrt()


def _aliases(kernel: PiecewisePolynomial, omega: Tensor) -> Tensor:
    """Σ_{k≠0} Φ(ω + 2πk)²."""
    k = torch.arange(1, 65, dtype=omega.dtype, device=omega.device)
    return kernel_response(kernel, omega[..., None] + 2 * math.pi * torch.cat((-k, k))).square().sum(-1)


def measures(kernel: PiecewisePolynomial, prefiltering: Callable[[Tensor], Tensor]) -> dict[str, float]:
    """Smoothing and postaliasing along an axis, as `filterlab.spectrum` has them for methods; P is given as a function.

    Source: Marschner & Lobb 1994, section 3.
    """
    t, w = np.polynomial.legendre.leggauss(48)
    omega, weights = torch.tensor((t + 1) * math.pi / 2), torch.tensor(w / 2)  # everything is even: [0, π] will do
    squared = prefiltering(omega).square() * weights
    kept = float((squared * kernel_response(kernel, omega).square()).sum())
    return {"smoothing": 1 - kept, "postaliasing": float((squared * _aliases(kernel, omega)).sum())}
