"""Frequency responses: of kernels, of whole methods, and as measured on what is implemented.

A method along an axis has the response P(ω) Φ(ω): P = 1/q̂ of its prefilter, Φ the Fourier transform of its kernel; ω in
radians per voxel, the Nyquist frequency is π. An ideal reconstruction has the response 1 on |ω| < π and 0 elsewhere.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import product

import numpy as np
import torch
from torch import Tensor

from filterlab import prefilters
from filterlab.arrays import Array, as_tensor
from filterlab.fields.base import Field
from filterlab.kernels import PiecewisePolynomial
from filterlab.methods import Method, TensorProduct, as_method, reconstruct, tensor_product
from filterlab.prefilters import Prefilter
from filterlab.volume import Boundary

NODES = 16  # Gauss-Legendre nodes per half voxel: exact to rounding for a kernel's piece times e^{−iωx}, |ω| ≤ 8π


def kernel_response(kernel: PiecewisePolynomial, omega: Array) -> Tensor:
    """Φ(ω) of a symmetric kernel, real."""
    return kernel.fourier(as_tensor(omega)).real


def closed_form(method: str | Method | PiecewisePolynomial) -> TensorProduct:
    """The method, if it has a response in closed form. Raises TypeError for one whose response is measured only."""
    if (found := tensor_product(method)) is None:
        name = as_method(method).name
        raise TypeError(f"the response of {name} has no closed form: it is measured only (`measured_response`)")
    return found


def axis_response(method: str | Method | PiecewisePolynomial, omega: Array, prefilter: bool = True) -> Tensor:
    """P(ω)Φ(ω) along an axis, closed form, float64 (paper, figures 2-4).

    For ncrsi, whose kernel is not separable, this is its 3-D response at (ω, 0, 0): the Catmull-Rom spline's.
    `response` has the whole of it.
    """
    method = closed_form(method)
    omega = as_tensor(omega).to(torch.float64)
    response = kernel_response(method.kernel, omega)
    return response * method.prefilter.response(omega) if prefilter else response


def response(method: str | Method | PiecewisePolynomial, omega: Array, prefilter: bool = True) -> Tensor:
    """The 3-D response at angular frequencies `(..., 3)` (x, y, z): Σ_terms Π_axes Φ(ω_d), times Π P(ω_d)."""
    method = closed_form(method)
    omega = as_tensor(omega).to(torch.float64)
    if method.terms is None:
        total = kernel_response(method.kernel, omega).prod(-1)
    else:
        total = torch.zeros_like(omega[..., 0])
        for term in method.terms:
            factors = [kernel_response(k, w) for k, w in zip(term.kernels, omega.unbind(-1), strict=True)]
            total = total + term.weight * factors[0] * factors[1] * factors[2]
    return total * method.prefilter.response(omega).prod(-1) if prefilter else total


def measured_response(
    method: str | Method | PiecewisePolynomial, omega: Array, prefilter: bool = True, scheme: str | None = None
) -> Tensor:
    """The response of the implementation: ∫ h(x) e^{−iωx} dx of the field's own impulse response h, real, float64.

    The volume is zero but for one plane of ones across the x axis, so that h is the response along x at (ω, 0, 0); it
    is averaged over y and z within a voxel, which is right for methods that do not reproduce constants, too. The
    integral is Gauss-Legendre quadrature on every half voxel; nothing of the closed form is used.
    """
    method, omega = as_method(method), as_tensor(omega)
    reach = method.reach(prefilter)
    samples = torch.zeros(1, 1, 2 * reach + 1, dtype=torch.float64, device=omega.device)
    samples[..., reach] = 1
    volume = samples.expand(3, 3, -1)
    gradient = None if scheme is None else method.gradient_of(scheme)
    field = reconstruct(volume, method, boundary=Boundary.WRAP, prefilter=prefilter, scheme=scheme, gradient=gradient)
    x, weights = _half_voxel_quadrature(2 * reach, omega.device)
    impulse = _mean_over_a_voxel(field, x + reach)
    phases = torch.cos(omega.to(torch.float64)[..., None] * x)  # h is even: its transform is real
    return (phases * (impulse * weights)).sum(-1)


def position_responses(method: str | Method | PiecewisePolynomial, omega: Array, nodes: int = 6) -> Tensor:
    """The 3-D responses of the implementation without prefilter, to one sample at each position in its partition.

    ĥ_p(ω) = ∫ h_p(x) cos(ω·x) dx at angular frequencies `(..., 3)` (x, y, z), h_p(x) the field at p + x of a sample at
    p; real, as h_p is even; `(positions, ...)`. There is one position, but for truncated octahedra there are four: of a
    wave with frequency ω the mean over positions is kept, and where they differ waves of other frequencies are added,
    by π (1, 1, 0) and its like.

    The integral is Gauss-Legendre quadrature with so many nodes along an axis on every half voxel. For |ω_d| ≤ 2π and 6
    nodes it is off by 2e-11 where pieces are boxes; faces of tetrahedra cross the half voxels: 2e-4 (`qss`, C⁰ there)
    and 8e-6 (both C¹ splines), along the axes 1e-11.
    """
    method, omega = as_method(method), as_tensor(omega)
    place = 2 * method.reach(False)  # even: the partition lies about it as about 0
    size = 2 * place + 2
    x, weights = _half_voxel_quadrature(method.facts.support, omega.device, nodes)
    points = torch.stack(torch.meshgrid(x, x, x, indexing="ij"), -1) + place
    waves = [torch.exp(1j * w[:, None] * x) * weights for w in omega.to(torch.float64).reshape(-1, 3).unbind(-1)]
    rows = []
    for z, y in product(range(method.period), repeat=2):  # moved along all three axes a partition lies on itself
        samples = torch.zeros(size, size, size, dtype=torch.float64, device=omega.device)
        samples[place + z, place + y, place] = 1
        field = reconstruct(samples, method, boundary=Boundary.ZEROS, prefilter=False)
        impulse = field(points + points.new_tensor([0, y, z])).to(waves[0].dtype)
        rows.append(torch.einsum("xyz,kx,ky,kz->k", impulse, *waves).real)
    return torch.stack(rows).reshape(-1, *omega.shape[:-1])


def _half_voxel_quadrature(length: int, device: torch.device, nodes: int = NODES) -> tuple[Tensor, Tensor]:
    """Nodes and weights on [−length/2, length/2], so many on every half voxel (kernels have knots at half-integers)."""
    t, w = np.polynomial.legendre.leggauss(nodes)
    starts = np.arange(-length, length) / 2
    x = (starts[:, None] + (t + 1) / 4).reshape(-1)
    return torch.tensor(x, device=device), torch.tensor(np.tile(w / 4, len(starts)), device=device)


def _mean_over_a_voxel(field: Field, x: Tensor) -> Tensor:
    """Mean over y, z ∈ [1, 2) of the field at each x, by a 4×4 Gauss-Legendre rule on each half of the voxel."""
    t, w = np.polynomial.legendre.leggauss(4)
    y = torch.tensor(np.concatenate([(t + 1) / 4, (t + 3) / 4]) + 1, device=x.device)
    wy = torch.tensor(np.tile(w / 4, 2), device=x.device)
    points = torch.stack(torch.meshgrid(x, y, y, indexing="ij"), -1)
    return torch.einsum("xyz,y,z->x", field(points), wy, wy)


def smoothing(method: str | Method | PiecewisePolynomial, prefilter: bool = True, dimensions: int = 1) -> float:
    """S = 1 − |R_N|⁻¹ ∫_{R_N} |ĥ|² dω over the Nyquist region R_N = [−π, π]^d: 0 for the ideal filter.

    d = `dimensions`, 1 (along an axis) or 3. Source: Marschner & Lobb 1994, section 3.
    """
    return 1 - _energy(closed_form(method), prefilter, dimensions, _passband_integral)


def postaliasing(method: str | Method | PiecewisePolynomial, prefilter: bool = True, dimensions: int = 1) -> float:
    """P = |R_N|⁻¹ ∫_{outside R_N} |ĥ|² dω: 0 for the ideal filter (Marschner & Lobb 1994, section 3)."""
    method = closed_form(method)
    total = _energy(method, prefilter, dimensions, _whole_integral)
    return total - _energy(method, prefilter, dimensions, _passband_integral)


AxisIntegral = Callable[[PiecewisePolynomial, PiecewisePolynomial, Prefilter], float]
"""(p, q, prefilter) -> (2π)⁻¹ ∫ P(ω)² Φ_p(ω) Φ_q(ω) dω over some range of ω."""


def _energy(method: TensorProduct, prefilter: bool, dimensions: int, integral: AxisIntegral) -> float:
    """(2π)^−d ∫ |ĥ|² dω; for a sum of separable terms, the sum over pairs of terms of products over axes."""
    if dimensions not in (1, 3):
        raise ValueError(f"dimensions must be 1 or 3; got {dimensions!r}")
    applied = method.prefilter if prefilter else prefilters.IDENTITY
    if dimensions == 1 or method.terms is None:
        return integral(method.kernel, method.kernel, applied) ** dimensions
    known: dict[tuple[int, int], float] = {}
    total = 0.0
    for a in method.terms:
        for b in method.terms:
            product = a.weight * b.weight
            for p, q in zip(a.kernels, b.kernels, strict=True):
                key = (id(p), id(q))
                if key not in known:
                    known[key] = integral(p, q, applied)
                product *= known[key]
            total += product
    return total


def _passband_integral(p: PiecewisePolynomial, q: PiecewisePolynomial, prefilter: Prefilter) -> float:
    """Over [−π, π], by Gauss-Legendre quadrature on [0, π] (everything is even)."""
    t, w = np.polynomial.legendre.leggauss(48)
    omega, weights = torch.tensor((t + 1) * math.pi / 2), torch.tensor(w / 2)
    product = kernel_response(p, omega) * kernel_response(q, omega) * prefilter.response(omega) ** 2
    return float((product * weights).sum())


def _whole_integral(p: PiecewisePolynomial, q: PiecewisePolynomial, prefilter: Prefilter) -> float:
    """Over all ω: the mean over [−π, π] of P(ω)² A(ω), A(ω) = Σ_k Φ_p Φ_q(ω + 2πk) = Σ_n cos(nω) ∫ p(x) q(x + n) dx.

    The mean of a smooth periodic function over 256 equidistant ω is exact to rounding.
    """
    omega = torch.arange(256, dtype=torch.float64) * (2 * math.pi / 256)
    return float((prefilter.response(omega) ** 2 * _correlation_spectrum(p, q, omega)).mean())


def _correlation_spectrum(p: PiecewisePolynomial, q: PiecewisePolynomial, omega: Tensor) -> Tensor:
    """Σ_n cos(nω) ∫ p(x + n) q(x) dx: the sampled cross-correlation of two even kernels."""
    total = torch.zeros_like(omega)
    for n, r in correlation_samples(p, q).items():
        total = total + r * torch.cos(n * omega)
    return total


def correlation_samples(p: PiecewisePolynomial, q: PiecewisePolynomial) -> dict[int, float]:
    """∫ p(x + n) q(x) dx for every integer n where it is not 0, by exact quadrature."""
    x, weights = _half_voxel_quadrature(q.support, torch.device("cpu"))
    reach = (p.support + q.support + 1) // 2
    return {n: float((p(x + n) * q(x) * weights).sum()) for n in range(-reach, reach + 1)}
