"""Predicted errors against measured ones, and what they are made of."""

from __future__ import annotations

import math

import pytest
import torch

import filterlab as fl
from filterlab import metrics
from filterlab.prediction import (
    INNER,
    Spectrum,
    _rows,
    _squared_error,
    predicted_error,
    rms_second_derivative,
    spectrum_of,
)
from tests.test_methods import TENSOR_PRODUCTS

SMOOTH = [("marschner-lobb", {}, 64), ("gaussian", {"sigma": 0.15}, 24)]


def measured(signal, n: int, method: str, gradient: str | None = None, step: int = 1) -> tuple[float, float]:
    """RMS errors of value and of the gradient per voxel, at random points of the inner box."""
    volume = signal.sample(n, dtype=torch.float64)
    if step > 1:
        kept = volume.samples[::step, ::step, ::step]
        volume = fl.Volume(kept, spacing=[step * s for s in volume.spacing], origin=volume.origin)
    field = fl.reconstruct(volume, method, boundary="reflect", gradient=gradient)
    lower, upper = (torch.tensor(c, dtype=torch.float64) for c in (signal.domain.lower, signal.domain.upper))
    unit = torch.rand(8000, 3, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
    points = signal.domain.geometry.to_world((lower + upper) / 2 + INNER * (upper - lower) * (unit - 0.5))
    (v, g), (w, h) = field.value_and_gradient(points), signal.value_and_gradient(points)
    voxel = volume.spacing[0] / step
    return float(metrics.rms(v, w)), voxel * float(metrics.rms(g, h, vectors=True))


@pytest.mark.parametrize("method", TENSOR_PRODUCTS)
@pytest.mark.parametrize(("name", "parameters", "n"), SMOOTH)
def test_holds_within_15_percent_where_the_data_are_resolved(name, parameters, n, method) -> None:
    signal = fl.signals.named(name, **parameters)
    spectrum = spectrum_of(signal.sample(n, dtype=torch.float64).samples)
    for gradient in fl.METHODS[method].gradients:
        found = predicted_error(spectrum, method, gradient=gradient)
        value, slope = measured(signal, n, method, gradient)
        assert found.beyond < 0.1
        assert found.value == pytest.approx(value, rel=0.15)
        assert found.gradient == pytest.approx(slope, rel=0.15)


@pytest.mark.parametrize("method", ["trilinear", "ncrsi", "triquadratic", "notch"])
def test_knows_what_every_second_sample_would_lose(method) -> None:
    """Aliasing included: at half the resolution the spectrum of the samples is known to twice the Nyquist frequency."""
    signal = fl.signals.marschner_lobb()
    found = predicted_error(spectrum_of(signal.sample(80, dtype=torch.float64).samples), method, step=2)
    value, slope = measured(signal, 80, method, step=2)
    assert found.value == pytest.approx(value, rel=0.1)
    assert found.gradient == pytest.approx(slope, rel=0.1)


@pytest.mark.parametrize("method", ["trilinear", "notch", "mitchell"])
def test_holds_on_the_average_over_positions_of_the_grid(method) -> None:
    """The error of a blob of 1.2 voxels depends on where it lies between voxels; a quarter off, it is the mean."""
    errors = []
    for quarters in (0, 1):
        signal = fl.signals.gaussian(sigma=0.1, center=(quarters / 48,) * 3)
        found = predicted_error(spectrum_of(signal.sample(24, dtype=torch.float64).samples), method).value
        errors.append(found / measured(signal, 24, method)[0])
    assert errors[1] == pytest.approx(1, abs=0.15)
    assert abs(errors[0] - 1) > abs(errors[1] - 1)


def test_a_plane_wave_has_the_error_of_its_frequency() -> None:
    """√E(ω)·amplitude/√2 by the definition, aliases summed one by one."""
    n, k = 64, 16
    omega = math.pi * k / n
    wave = torch.cos(omega * (torch.arange(n, dtype=torch.float64) + 0.5))
    spectrum = spectrum_of(wave.expand(4, 4, n))
    for method in ("trilinear", "triquadratic", "notch", "tricubic"):
        aliases = torch.tensor([omega + 2 * math.pi * j for j in range(-4000, 4001)], dtype=torch.float64)
        response = fl.spectrum.axis_response(method, aliases)
        error = (1 - response[4000]) ** 2 + response.square().sum() - response[4000] ** 2
        found = predicted_error(spectrum, method)
        assert found.beyond < 1e-20
        assert found.value == pytest.approx(math.sqrt(float(error) / 2), rel=0.02)


def test_what_every_method_reproduces_has_no_error() -> None:
    constant = spectrum_of(torch.full((8, 9, 10), 3.0))
    for method in TENSOR_PRODUCTS:
        found = predicted_error(constant, method)
        assert found.value < 1e-6
        assert found.gradient < 1e-6


def test_samples_that_resolve_nothing_say_so() -> None:
    noise = torch.rand(32, 32, 32, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert predicted_error(spectrum_of(noise), "tricubic").beyond > 0.5


def test_the_second_derivative_of_a_wave_along_random_lines() -> None:
    omega = math.pi * 10 / 64
    wave = torch.cos(omega * (torch.arange(64, dtype=torch.float64) + 0.5)).expand(5, 5, 64)
    assert rms_second_derivative(spectrum_of(wave)) == pytest.approx(omega**2 / math.sqrt(2 * 5), rel=0.02)


def test_single_voxels_and_axes_are_predicted_too() -> None:
    for shape in ((1, 1, 1), (1, 7, 1), (2, 1, 9)):
        found = predicted_error(spectrum_of(torch.rand(shape, dtype=torch.float64)), "triquadratic", step=2)
        assert math.isfinite(found.value)
        assert math.isfinite(found.gradient)


def test_a_tensor_kernel_is_refused() -> None:
    kernel = fl.kernels.bc(torch.tensor(0.3), torch.tensor(0.3))
    with pytest.raises(TypeError, match="exact kernels"):
        predicted_error(spectrum_of(torch.rand(4, 4, 4)), kernel, prefilter=False)


def test_no_signal_falls_slower_than_its_energy_is_finite() -> None:
    """White noise does not fall within the band; beyond it is taken to fall as |ω|⁻⁶, what falls faster as it does."""
    noise = torch.rand(32, 32, 32, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert spectrum_of(noise).fall == 6.0
    assert spectrum_of(fl.signals.gaussian(sigma=0.15).sample(24).samples).fall > 8.0


def test_gradients_from_beyond_are_per_voxel_of_the_samples_at_any_step() -> None:
    """What lies beyond the Nyquist frequency alone: power of a shell, by quadrature of its own."""
    level, fall, step = 0.7, 8.0, 2
    nothing = Spectrum(torch.zeros(8, 8, 8, dtype=torch.float64), level, fall)
    method = fl.methods.named("trilinear")
    omega = 3 * math.pi * (2 * torch.rand(200_000, 3, generator=torch.Generator().manual_seed(0)).double() - 1)
    radius = omega.norm(dim=-1)
    power = level * radius**-fall * ((omega.abs().amax(-1) > math.pi) & (radius <= 3 * math.pi))
    slopes = [
        _squared_error(row, axis, method.prefilter, (step * omega).unbind(-1)) / step**2
        for axis, row in zip((0, 1, 2), _rows(method, "analytic")[1:], strict=True)
    ]
    squared = (6 * math.pi) ** 3 * float((power * sum(slopes)).mean())
    found = predicted_error(nothing, method, step=step)
    assert found.gradient == pytest.approx(math.sqrt(squared), rel=0.05)
    assert found.beyond == 1
