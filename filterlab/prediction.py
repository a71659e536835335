"""Predicted errors: how far a method will be from the signal, from the spectrum of its samples alone.

A method is linear and repeats itself from voxel to voxel, so that averaged over all positions of the grid its error is
a property of frequencies. With Ĝ(ω) the transform of a row of its stencil (the value, or a derivative), P(ω) the
response of its prefilter and m(ω) what is wanted (1 for the value, iω_d for ∂/∂x_d), ω in radians per voxel:

    mean |error|² = (2π)⁻³ ∫ |f̂(ω)|² E(ω) dω,      E(ω) = |m − P Ĝ(ω)|² + Σ_{k≠0} |P Ĝ(ω + 2πk)|²

The sum over all aliases is the spectrum of sampled correlations of kernels, and finite: nothing is cut off. Filtered by
√E, the samples become the error that is expected in every voxel, so that its mean can be taken away from the ends.

The samples tell f̂ up to the Nyquist frequency only, and what lay beyond has been folded into it. What is assumed of a
volume is therefore: it is resolved, and beyond the Nyquist frequency its spectrum goes on falling as it fell before.

Where a volume resolves its signal, value and gradient of every method are within 15 % of the true error (a test).

Source: Blu & Unser, Quantitative Fourier analysis of approximation techniques, part I, 1999, eqs. 9-12; gradients and
nonseparable sums as above.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

from filterlab import prefilters
from filterlab.fields.tensor_product import Direct, same_kernel
from filterlab.kernels import Kernel, PiecewisePolynomial
from filterlab.methods import Method, TensorProduct, as_method, tensor_product
from filterlab.ops.stencil import Product, Row
from filterlab.prefilters import Prefilter
from filterlab.spectrum import correlation_samples

INNER = 0.9  # of the box along every axis: where errors are averaged
_SHELLS = 4  # between half the Nyquist frequency and it; there the fall of a spectrum is measured
_SLOWEST_FALL = 6.0  # beyond the Nyquist frequency, whatever was measured: a signal has finite energy
_FARTHEST = 3 * math.pi  # how far a spectrum is continued
_DIRECTIONS = 4096

Size = tuple[int, int, int]


@dataclass(frozen=True)
class Spectrum:
    """The spectrum of samples, of their even extension beyond both ends (boundary `reflect`): real, in cosines.

    Attributes:
        cosines: orthonormal cosine transform (DCT-II) along the three axes, (D, H, W) float64, on the CPU.
        level, fall: power per unit of ω³ beyond the Nyquist frequency is taken as level · |ω|^−fall.
    """

    cosines: Tensor
    level: float
    fall: float


def spectrum_of(samples: Tensor) -> Spectrum:
    """The spectrum of samples `(D, H, W)`. Memory: about six copies of them in float64."""
    cosines = samples.detach().to("cpu", torch.float64)
    for dim in range(3):
        cosines = _cosine_transform(cosines, dim)
    return Spectrum(cosines, *_continuation(cosines))


def _cosine_transform(x: Tensor, dim: int) -> Tensor:
    """DCT-II, orthonormal, by the Fourier transform of the even extension."""
    n, x = x.shape[dim], x.movedim(dim, -1)
    k = torch.arange(n, dtype=torch.float64)
    turned = torch.fft.rfft(torch.cat((x, x.flip(-1)), -1))[..., :n] * torch.exp(-0.5j * math.pi * k / n)
    return (turned.real * _scale(n)).movedim(-1, dim)


def _inverse_transform(x: Tensor, dim: int) -> Tensor:
    """The inverse of that: DCT-III."""
    n, x = x.shape[dim], x.movedim(dim, -1)
    k = torch.arange(n, dtype=torch.float64)
    turned = x / _scale(n) * torch.exp(0.5j * math.pi * k / n)
    end = torch.zeros_like(turned[..., :1])
    return torch.fft.irfft(torch.cat((turned, end), -1), 2 * n)[..., :n].movedim(-1, dim)


def _scale(n: int) -> Tensor:
    scale = torch.full((n,), math.sqrt(0.5 / n), dtype=torch.float64)
    scale[0] = 0.5 / math.sqrt(n)
    return scale


def _frequencies(shape: Sequence[int]) -> tuple[Tensor, Tensor, Tensor]:
    """ω of a cosine transform of (D, H, W) samples along x, y, z, in radians per voxel."""
    x, y, z = (torch.arange(n, dtype=torch.float64) * (math.pi / n) for n in reversed(shape))
    return x, y, z


def _continuation(cosines: Tensor) -> tuple[float, float]:
    """(level, fall), fitted to shells of the last octave before the Nyquist frequency, away from the ends."""
    x, y, z = _frequencies(cosines.shape)
    radius = (z[:, None, None] ** 2 + y[:, None] ** 2 + x**2).sqrt()
    centers = math.pi / 2 * torch.arange(2, _SHELLS + 2, dtype=torch.float64) / _SHELLS + math.pi / 4
    density = torch.zeros(_SHELLS, dtype=torch.float64)
    for i, center in enumerate(centers):
        # smooth shells: sharp ones would carry what happens at the ends into the middle
        away = ((radius - center) / (math.pi / 2 / _SHELLS)).clamp(-1, 1)
        shell = torch.cos(math.pi / 2 * away) ** 2
        share = float(shell.square().mean())  # of the (2π)³ units of ω³ that all cosines stand for
        density[i] = _mean_square(cosines * shell, 0.5) / (share * (2 * math.pi) ** 3) if share else 0.0
    if not bool((density > 0).all()):
        return 0.0, 0.0
    a, b = centers.log(), density.log()
    fall = -float(((a - a.mean()) * (b - b.mean())).sum() / (a - a.mean()).square().sum())
    fall = max(fall, _SLOWEST_FALL)
    return math.exp(float(b[-1]) + fall * float(a[-1])), fall


def _mean_square(cosines: Tensor, inner: float = INNER) -> float:
    """Over the inner voxels, of what has that cosine transform."""
    x = cosines
    for dim in range(3):
        x = _inverse_transform(x, dim)
    x = x.square()
    for n in reversed(x.shape):
        x = (x * _share_of_box(n, inner)).sum(-1)
    return float(x)


def _share_of_box(n: int, inner: float) -> Tensor:
    """The part of the inner box, along an axis of n voxels, that every voxel has."""
    edge = n * (1 - inner) / 2
    at = torch.arange(n, dtype=torch.float64)
    inside = (torch.minimum(at + 1, n - at) - edge).clamp(0, 1)
    return inside / inside.sum()


# --- errors -----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class PredictedError:
    """Root-mean-square errors in the units of the samples, over the inner 0.9 of the box.

    Attributes:
        value: of the value.
        gradient: of the gradient as a vector, per voxel.
        beyond: which part of the value's squared error comes from beyond the Nyquist frequency: where it is large, the
            samples do not resolve the signal, and what is predicted rests on how its spectrum is continued.
    """

    value: float
    gradient: float
    beyond: float


def predicted_error(
    spectrum: Spectrum,
    method: str | Method | PiecewisePolynomial,
    *,
    prefilter: bool = True,
    gradient: str | None = None,
    step: int = 1,
) -> PredictedError:
    """The error of a method on a signal of that spectrum; see the top of this file.

    Args:
        spectrum: of the samples.
        method: with an exact kernel.
        prefilter, gradient: as for `filterlab.reconstruct`.
        step: predict for every `step`-th sample along every axis that has more than one. The spectrum then reaches
            beyond the Nyquist frequency of that grid, and the error has what is aliased in it. Gradients are per voxel
            of the samples all the same.

    Raises:
        TypeError: a method whose kernel is a tensor, or that is no tensor product: its errors are measured only.
    """
    method = _predictable(method)
    if not isinstance(method.kernel, Kernel):
        raise TypeError(f"errors are predicted for exact kernels; {method.kernel.name} is not one")
    kind = gradient or method.gradients[0]
    applied = method.prefilter if prefilter else prefilters.IDENTITY
    shape = spectrum.cosines.shape
    value, slopes = _error_kernels(method, kind, applied, (shape[0], shape[1], shape[2]), step)
    beyond, slopes_beyond = _errors_beyond(spectrum, method, kind, applied, step)
    squared = _mean_square(spectrum.cosines * value) + beyond
    total = _mean_square(spectrum.cosines * slopes) + slopes_beyond
    return PredictedError(math.sqrt(squared), math.sqrt(total), beyond / squared if squared else 0.0)


def rms_second_derivative(spectrum: Spectrum) -> float:
    """RMS of f'' along a line, averaged over directions: of |ω|² f̂, as the mean of cos⁴ over directions is 1/5."""
    x, y, z = _frequencies(spectrum.cosines.shape)
    squared = z[:, None, None] ** 2 + y[:, None] ** 2 + x**2
    return math.sqrt(_mean_square(spectrum.cosines * squared) / 5)


def _predictable(method: str | Method | PiecewisePolynomial) -> TensorProduct:
    if (found := tensor_product(method)) is None:
        raise TypeError(f"the errors of {as_method(method).name} have no closed form: they are measured only")
    return found


def _rows(method: TensorProduct, gradient: str) -> tuple[Row, ...]:
    return Direct(method.terms or same_kernel(method.kernel), gradient=gradient).stencils[1].rows


@lru_cache(maxsize=64)
def _error_kernels(
    method: TensorProduct, gradient: str, prefilter: Prefilter, shape: Size, step: int
) -> tuple[Tensor, Tensor]:
    """√E of the value and of the gradient as a vector, for the frequencies of a cosine transform, (D, H, W)."""
    axes = tuple(w * (step if len(w) > 1 else 1) for w in _frequencies(shape))
    grid = (axes[0], axes[1][:, None], axes[2][:, None, None])
    value, *slopes = (
        _squared_error(row, axis, prefilter, grid)
        for axis, row in zip((None, 0, 1, 2), _rows(method, gradient), strict=True)
    )
    return value.sqrt(), sum(slopes[1:], slopes[0]).sqrt() / step


def _errors_beyond(
    spectrum: Spectrum, method: TensorProduct, gradient: str, prefilter: Prefilter, step: int
) -> tuple[float, float]:
    """Squared errors of value and gradient from beyond the Nyquist frequency, out to `_FARTHEST`, by quadrature."""
    if spectrum.level <= 0:
        return 0.0, 0.0
    live = torch.tensor([n > 1 for n in reversed(spectrum.cosines.shape)], dtype=torch.float64)
    unit = torch.quasirandom.SobolEngine(3).draw(_DIRECTIONS + 1, dtype=torch.float64)[1:]
    omega = (2 * unit - 1) * _FARTHEST * live
    radius = omega.norm(dim=-1)
    outside = (omega.abs().amax(-1) > math.pi) & (radius <= _FARTHEST)
    power = spectrum.level * radius[outside] ** (-spectrum.fall) * ((2 * _FARTHEST) ** 3 / _DIRECTIONS)
    points = tuple((step * omega[outside]).unbind(-1))
    value, *slopes = (
        float((power * _squared_error(row, axis, prefilter, points)).sum())
        for axis, row in zip((None, 0, 1, 2), _rows(method, gradient), strict=True)
    )
    return value, sum(slopes) / step**2


# --- error kernels ----------------------------------------------------------------------------------------------------


def _squared_error(row: Row, axis: int | None, prefilter: Prefilter, omega: Sequence[Tensor]) -> Tensor:
    """E at frequencies whose x, y and z broadcast: |m|² − 2 Re(m* PĜ) + Σ_k |PĜ(ω + 2πk)|²; not below 0."""
    x, y, z = (_Axis(row, d, w, prefilter) for d, w in enumerate(omega))
    response, aliased = 0.0, 0.0
    for i, p in enumerate(row):
        response = response + p.weight * (x.transform[i] * y.transform[i]) * z.transform[i]
        for j, q in enumerate(row[: i + 1]):
            twice = 1.0 if i == j else 2.0
            one = (x.correlation[i, j] * y.correlation[i, j]) * z.correlation[i, j]
            aliased = aliased + twice * p.weight * q.weight * one.real
    if axis is None:
        return (1 - 2 * torch.as_tensor(response).real + aliased).clamp_min(0.0)
    wanted = omega[axis]  # m = iω: Re(m* r) = ω Im r
    return (wanted**2 - 2 * wanted * torch.as_tensor(response).imag + aliased).clamp_min(0.0)


class _Axis:
    """What a row's products are along one axis: transforms, and spectra of their sampled correlations; prefiltered."""

    def __init__(self, row: Row, axis: int, omega: Tensor, prefilter: Prefilter) -> None:
        kernels = [_differentiated(product, axis) for product in row]
        response = prefilter.response(omega)
        known = {k: response * k.fourier(omega) for k in set(kernels)}
        pairs = {(p, q): response**2 * _correlations(p, q, omega) for p in known for q in known}
        self.transform = [known[k] for k in kernels]
        self.correlation = {(i, j): pairs[p, q] for i, p in enumerate(kernels) for j, q in enumerate(kernels)}


@lru_cache(maxsize=256)
def _derivative(kernel: Kernel, times: int) -> Kernel:
    return kernel.derivative(times) if times else kernel


def _differentiated(product: Product, axis: int) -> Kernel:
    kernel = product.kernels[axis]
    assert isinstance(kernel, Kernel)
    return _derivative(kernel, product.orders[axis])


def _correlations(p: Kernel, q: Kernel, omega: Tensor) -> Tensor:
    """Σ_k p̂(ω+2πk) q̂(ω+2πk)* = Σ_n e^{−iωn} ∫ p(x + n) q(x) dx."""
    total = torch.zeros_like(omega, dtype=torch.complex128)
    for n, r in _correlation_samples(p, q).items():
        total = total + r * torch.exp(-1j * n * omega)
    return total


@lru_cache(maxsize=1024)
def _correlation_samples(p: Kernel, q: Kernel) -> dict[int, float]:
    return correlation_samples(p, q)  # kept: exact kernels don't change
