"""To a coarser grid without aliasing: the least-squares projection on cubic splines of that grid, along one axis.

With s > 1 the new step in voxels, β the cubic B-spline and f the reconstruction of the samples by any method, the cubic
spline of the coarser grid that is nearest to f in L² has at the new voxels x_i = x_0 + s i the values

    v_i = Σ_m q_m a(x_i + s m),     a(x) = 1/s ∫ β(t/s) f(x + t) dt,     q̂(ω) = Σ_k β(k) cos kω / Σ_k r_k cos kω,

r_k = ∫ β(t) β(t + k) dt: the inner products a are solved for coefficients, and these are summed to values. So v is f
convolved with one kernel, taken at x_i: rows of weights like any others, under every boundary. It is nearer to the
ideal low-pass than block means and Gaussians are (docs/shrinking.md).

Source: Unser, Aldroubi & Eden, Enlargement or reduction of digital images with minimum loss of information, 1995.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from fractions import Fraction
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from filterlab.kernels import Kernel, PiecewisePolynomial, bspline
from filterlab.ops.contract import Rows
from filterlab.resampling_rows import Given, convolved, folded, impulse_response

SPLINE = bspline(3)

_PERIOD = 1024  # of the filter q; at half of it it is 0 to rounding
_ROUNDING = 2e-16  # of its transform


def projected(x: Tensor, step: float, n: int, given: Given) -> Rows:
    """The matrix from n samples to values of their projection at x (R,) float64, `step` apart."""
    first, weights = _taps(x, step, given)
    return folded(first, weights, n, given.boundary)


def smoothing(step: float, n: int, given: Given) -> Rows:
    """The matrix from n samples to values of their projection at the samples, for a grid of that step anywhere."""
    first, weights = _taps(torch.zeros(1, dtype=torch.float64), step, given)
    return folded(first + torch.arange(n), weights.expand(n, -1), n, given.boundary)


def _taps(x: Tensor, step: float, given: Given) -> tuple[Tensor, Tensor]:
    """The first integer that each of x (R,), `step` apart, depends on, and the weights from there on (R, W)."""
    size, q = abs(step), x.new_tensor(solving(SPLINE, given.dtype))
    reach = len(q) // 2
    steps = torch.arange(1, reach + 1, dtype=torch.float64) * step
    places = torch.cat((x[0] - steps.flip(0), x, x[-1] + steps))
    near, width = places.floor(), math.ceil(size * SPLINE.support / 2 + given.kernel.support / 2)
    offsets = torch.arange(-width, width + 1)
    inner = inner_products((places - near)[:, None] - offsets, size, SPLINE, given.kernel)
    reached = near.long().unfold(0, len(q), 1)  # (R, 2M + 1)
    first = reached.amin(-1) - width
    index = reached[..., None] + offsets - first[:, None, None]
    weights = x.new_zeros(len(x), int(index.max()) + 1)
    shares = inner.unfold(0, len(q), 1).mT * q[:, None]  # (R, 2M + 1, T)
    weights.scatter_add_(1, index.flatten(1), shares.flatten(1))
    impulse = x.new_tensor(impulse_response(given.prefilter, given.dtype))
    return first - len(impulse) // 2, convolved(weights, impulse)


def inner_products(y: Tensor, step: float, spline: Kernel, kernel: PiecewisePolynomial) -> Tensor:
    """1/s ∫ φ(t/s) ψ(y − t) dt of two kernels, exactly: by Gauss's rule between all knots of both."""
    t, w = (torch.from_numpy(a) for a in np.polynomial.legendre.leggauss((spline.degree + kernel.degree) // 2 + 1))
    total = torch.zeros_like(y)
    for piece in range(kernel.support):  # of ψ: t in [a, a + 1], where at most one knot of φ(t/s) lies, as s > 1
        a = y + (piece - kernel.support / 2)
        knot = ((a / step + spline.support / 2).floor() + 1 - spline.support / 2) * step
        middle = knot.clamp(max=a + 1)
        for low, high in ((a, middle), (middle, a + 1)):
            at = (low + high)[..., None] / 2 + (high - low)[..., None] / 2 * t
            total = total + (high - low) / 2 * (spline(at / step) * kernel(y[..., None] - at) * w).sum(-1)
    return total / step


@lru_cache(maxsize=64)
def solving(spline: Kernel, dtype: torch.dtype) -> tuple[float, ...]:
    """q_m for |m| ≤ M, behind which all are below the rounding of a type."""
    q = np.fft.irfft(_spectrum(spline.integer_samples()) / _spectrum(correlations(spline)), _PERIOD)
    size = np.abs(q[: _PERIOD // 2])
    reach = int(np.nonzero(size > size[0] * max(torch.finfo(dtype).eps / 16, _ROUNDING))[0][-1])
    return tuple(q[np.arange(-reach, reach + 1)].tolist())


def correlations(kernel: Kernel) -> dict[int, float]:
    """r_k = ∫ φ(t) φ(t + k) dt where it is not 0."""
    k = torch.arange(-kernel.support + 1, kernel.support, dtype=torch.float64)
    t, w = (torch.from_numpy(a) for a in np.polynomial.legendre.leggauss(kernel.degree + 1))
    at = ((t + 1) / 2 + torch.arange(kernel.support)[:, None] - kernel.support / 2).flatten()
    values = (kernel(at) * kernel(at + k[:, None]) * (w / 2).repeat(kernel.support)).sum(-1)
    return dict(zip(k.int().tolist(), values.tolist(), strict=True))


def _spectrum(symmetric: Mapping[int, Fraction] | Mapping[int, float]) -> np.ndarray:
    omega = np.arange(_PERIOD // 2 + 1) * (2 * np.pi / _PERIOD)
    return sum((float(c) * np.cos(k * omega) for k, c in symmetric.items()), np.zeros_like(omega))
