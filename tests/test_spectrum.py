"""Frequency responses: closed form against quadrature and the paper's formulas, and against what is implemented."""

from __future__ import annotations

from fractions import Fraction
from math import pi

import numpy as np
import pytest
import torch

from filterlab import prefilters, spectrum
from filterlab.kernels import KERNELS
from filterlab.methods import METHODS, reconstruct
from filterlab.prefilters import Prefilter
from tests import laws, oracles
from tests.test_methods import TENSOR_PRODUCTS

OMEGA = torch.linspace(0, 4 * pi, 257, dtype=torch.float64)
every_method = pytest.mark.parametrize("method", TENSOR_PRODUCTS)


def quadrature(low: int, high: int, nodes: int = 12) -> tuple[torch.Tensor, torch.Tensor]:
    """Gauss-Legendre nodes and weights on every half unit of [low, high]: no knot lies inside an interval."""
    t, w = np.polynomial.legendre.leggauss(nodes)
    starts = np.arange(2 * low, 2 * high) / 2
    x = (starts[:, None] + (t + 1) / 4).ravel()
    return torch.as_tensor(x), torch.as_tensor(np.tile(w / 4, starts.size))


either = pytest.mark.parametrize("prefilter", [True, False])


@every_method
@either
def test_closed_form_equals_quadrature_of_the_textbook_kernel(method, prefilter):
    response = spectrum.axis_response(method, OMEGA, prefilter)
    laws.assert_close(response, oracles.axis_response(method, OMEGA.numpy(), prefilter), 1e-12)
    laws.assert_close(spectrum.axis_response(method, -OMEGA, prefilter), response, 1e-14)


@pytest.mark.parametrize("method", ["trilinear", "triquadratic", "notch", "tricubic"])
@either
def test_closed_form_equals_the_formulas_of_the_paper(method, prefilter):
    response = spectrum.axis_response(method, OMEGA, prefilter)
    laws.assert_close(response, oracles.textbook_response(method, OMEGA.numpy(), prefilter), 1e-12)


@pytest.mark.parametrize("name", KERNELS)
def test_the_response_of_a_kernel(name):
    laws.assert_close(
        spectrum.kernel_response(KERNELS[name], OMEGA), oracles.fourier(oracles.PIECES[name], OMEGA.numpy()), 1e-12
    )


@every_method
@either
def test_measured_equals_closed_form(method, prefilter):
    """The transform of the implemented impulse response, every scheme, within 1e-6 (it is 1e-12) on [0, 4π]."""
    closed = spectrum.axis_response(method, OMEGA, prefilter)
    for scheme in METHODS[method].facts.schemes:
        measured = spectrum.measured_response(method, OMEGA, prefilter, scheme=scheme)
        laws.assert_close(measured, closed, 1e-10)


def test_what_is_measured_is_the_implementation(monkeypatch):
    """A prefilter that is slightly wrong shows in the measured response and not in the closed form."""
    from filterlab import ops

    before = spectrum.axis_response("tricubic", OMEGA)
    right, wrong = ops.prefilter_samples, Prefilter("wrong", ((Fraction(667, 1000), Fraction(333, 2000)),))
    monkeypatch.setattr(ops, "prefilter_samples", lambda samples, _, *rest: right(samples, wrong, *rest))
    laws.assert_close(spectrum.axis_response("tricubic", OMEGA), before, 0.0)
    assert float((spectrum.measured_response("tricubic", OMEGA) - before).abs().max()) > 1e-5


@pytest.mark.parametrize("method", [name for name in TENSOR_PRODUCTS if METHODS[name].terms is not None])
def test_the_response_of_a_nonseparable_method_is_the_transform_of_its_impulse_response(method):
    """By brute force in three dimensions: Gauss-Legendre quadrature of the field of one voxel."""
    f = torch.zeros(7, 7, 7, dtype=torch.float64)
    f[3, 3, 3] = 1
    x, weights = quadrature(-3, 3, nodes=8)
    h = reconstruct(f, method, boundary="zeros")(torch.stack(torch.meshgrid(x, x, x, indexing="ij"), -1) + 3)
    for omega in ((0.7, 1.9, 2.8), (3.0, 0.0, 1.0), (pi, pi, pi), (9.0, 2.0, 4.0)):
        waves = [torch.cos(k * x) * weights for k in omega]
        expected = torch.einsum("xyz,x,y,z->", h, *waves)
        actual = spectrum.response(method, torch.tensor(omega, dtype=torch.float64))
        assert float(actual) == pytest.approx(float(expected), abs=1e-10)


@pytest.mark.parametrize("method", ["ncrsi", "notch", "tricubic"])
def test_responses_by_position_are_the_closed_form_where_there_is_one(method):
    omega = 6 * torch.rand(5, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    found = spectrum.position_responses(method, omega)
    assert found.shape == (1, 5)
    laws.assert_close(found[0], spectrum.response(method, omega, prefilter=False), 1e-10)


@pytest.mark.parametrize(("name", "positions"), [("qss", 1), ("cubic-c1", 1), ("quadratic-c1", 4)])
def test_responses_of_splines_on_tetrahedra(name, positions):
    """Along each axis, at every position, that of the quadratic B-spline; constants are reproduced; order two."""
    omega = torch.zeros(4, 3, dtype=torch.float64)
    omega[range(3), range(3)] = torch.tensor([0.9, 2.5, 5.0], dtype=torch.float64)
    found = spectrum.position_responses(name, omega, nodes=4)
    assert found.shape == (positions, 4)
    expected = spectrum.kernel_response(KERNELS["bspline2"], omega).prod(-1)
    laws.assert_close(found, expected.expand(positions, -1), 1e-5)
    aliases = 2 * pi * torch.tensor([(1, 0, 0), (1, 1, 0), (1, 1, 1), (0, 1, -1)], dtype=torch.float64)
    laws.assert_close(spectrum.position_responses(name, aliases, nodes=4).mean(0), torch.zeros(4), 5e-4)
    oblique = torch.tensor([(0.02, 0.03, -0.01), (1.0, 2.0, 3.0)], dtype=torch.float64)
    small, wide = spectrum.position_responses(name, oblique, nodes=4).unbind(-1)
    # Q f = f + h²/8 Δf + …
    assert float(1 - small.mean()) == pytest.approx(float(oblique[0].square().sum()) / 8, rel=1e-2)
    assert (float(wide.amax() - wide.amin()) > 1e-3) == (positions > 1)


@pytest.mark.parametrize("prefilter", [True, False])
def test_the_measured_response_of_splines_on_tetrahedra_is_the_mean_over_positions(prefilter):
    omega = torch.tensor([0.0, 1.0, 3.0, 5.0], dtype=torch.float64)
    points = torch.stack([omega, 0 * omega, 0 * omega], -1)
    expected = spectrum.position_responses("quadratic-c1", points, nodes=4).mean(0)
    if prefilter:
        expected = expected * prefilters.QUADRATIC.response(omega)
    laws.assert_close(spectrum.measured_response("quadratic-c1", omega, prefilter), expected, 1e-5)


@every_method
@either
def test_the_response_along_an_axis_and_of_separable_methods(method, prefilter):
    omega = torch.stack([OMEGA, 0 * OMEGA, 0 * OMEGA], -1)
    along = spectrum.axis_response(method, OMEGA, prefilter)
    for d in range(3):
        laws.assert_close(spectrum.response(method, omega.roll(d, -1), prefilter), along, 1e-12)
    if METHODS[method].terms is None:
        w = torch.rand(20, 3, dtype=torch.float64) * 6
        expected = spectrum.axis_response(method, w, prefilter).prod(-1)
        laws.assert_close(spectrum.response(method, w, prefilter), expected, 1e-12)


@every_method
def test_dc_gain_and_zeros_at_the_replicas_show_the_order(method):
    """Strang-Fix: H(0) = 1 and H has a zero of order L at 2π and 4π; quasi-interpolation: H − 1 = O(ω^L) at 0."""
    order = METHODS[method].facts.approximation_order
    assert float(spectrum.axis_response(method, torch.zeros(1))[0]) == pytest.approx(1, abs=1e-14)
    kernel_order = METHODS[method].kernel.approximation_order  # type: ignore[union-attr]
    # so near that what else varies there does not show, and |H| ≈ (h / 2π)^L is far above rounding
    h = 2 * pi * 10.0 ** (-12 / kernel_order) * torch.tensor([1, 0.5], dtype=torch.float64)
    for center in (2 * pi, 4 * pi):
        near = spectrum.axis_response(method, center + h).abs()
        assert float(torch.log2(near[0] / near[1])) > kernel_order - 0.3
    h = torch.tensor([1e-1, 5e-2], dtype=torch.float64)
    flat = (spectrum.axis_response(method, h) - 1).abs()
    assert float(torch.log2(flat[0] / flat[1])) > order - 0.3


def energy(method: str, prefilter: bool) -> tuple[float, float]:
    """(in the Nyquist band, in all) of (2π)⁻¹ ∫ H² dω; the latter as ∫ h² dx (Parseval), h of one sample."""
    t, w = np.polynomial.legendre.leggauss(60)
    inside = np.sum(w / 2 * oracles.axis_response(method, (t + 1) * pi / 2, prefilter) ** 2)
    recipe = oracles.RECIPES["catmull-rom" if method == "ncrsi" else method]
    x, weights = (v.numpy() for v in quadrature(-50, 50))
    deconvolve = recipe.deconvolve if prefilter else ()
    h = oracles.axis_weights(oracles.PIECES[recipe.kernel], deconvolve, "zeros", 1, x)[:, 0]
    return float(inside), float(np.sum(weights * h**2))


@every_method
@either
def test_smoothing_and_postaliasing_of_marschner_and_lobb(method, prefilter):
    inside, total = energy(method, prefilter)
    assert spectrum.smoothing(method, prefilter) == pytest.approx(1 - inside, abs=1e-12)
    assert spectrum.postaliasing(method, prefilter) == pytest.approx(total - inside, abs=1e-12)
    if METHODS[method].terms is None:
        assert spectrum.smoothing(method, prefilter, dimensions=3) == pytest.approx(1 - inside**3, abs=1e-12)
        outside = total**3 - inside**3
        assert spectrum.postaliasing(method, prefilter, dimensions=3) == pytest.approx(outside, abs=1e-12)


def test_the_energy_of_ncrsi_in_three_dimensions():
    """By brute force: ∫ h² over space, h the field of one voxel; the energy of its transform in the Nyquist cube."""
    f = torch.zeros(7, 7, 7, dtype=torch.float64)
    f[3, 3, 3] = 1
    x, weights = quadrature(-3, 3, nodes=5)
    h = reconstruct(f, "ncrsi", boundary="zeros")(torch.stack(torch.meshgrid(x, x, x, indexing="ij"), -1) + 3)
    total = float(torch.einsum("xyz,x,y,z->", h**2, weights, weights, weights))
    omega, w = quadrature(0, 1, nodes=12)  # two halves of [0, 1], times π
    waves = torch.cos(torch.outer(omega * pi, x)) * weights
    transform = torch.einsum("xyz,ax,by,cz->abc", h, waves, waves, waves)
    inside = float(torch.einsum("abc,a,b,c->", transform**2, w, w, w))
    assert spectrum.smoothing("ncrsi", dimensions=3) == pytest.approx(1 - inside, abs=1e-9)
    assert spectrum.postaliasing("ncrsi", dimensions=3) == pytest.approx(total - inside, abs=1e-9)


def test_the_paper_s_ranking():
    """Section 3.3: the notch is best against postaliasing, linear is worst in the passband; prefilters sharpen."""
    postaliasing = {m: spectrum.postaliasing(m) for m in ("trilinear", "catmull-rom", "triquadratic", "notch")}
    assert min(postaliasing, key=postaliasing.__getitem__) == "notch"
    smoothing = {m: spectrum.smoothing(m) for m in ("trilinear", "catmull-rom", "triquadratic", "notch")}
    assert max(smoothing, key=smoothing.__getitem__) == "trilinear"
    assert smoothing["triquadratic"] < smoothing["catmull-rom"]
    for method in ("triquadratic", "notch", "tricubic"):
        assert spectrum.smoothing(method) < spectrum.smoothing(method, prefilter=False)


def test_callers_mistakes():
    with pytest.raises(ValueError, match="known methods"):
        spectrum.axis_response("sinc", OMEGA)
    with pytest.raises(ValueError, match="dimensions"):
        spectrum.smoothing("notch", dimensions=2)
