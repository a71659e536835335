"""Signals: published values, exact gradients against finite differences, sampling and geometry."""

from __future__ import annotations

import inspect
import math

import numpy as np
import pytest
import torch

from filterlab import signals
from filterlab.render import PerspectiveCamera, TransferFunction, render
from tests import laws

every_signal = pytest.mark.parametrize("name", signals.SIGNALS)


def inside(signal: signals.Signal, count: int = 200) -> torch.Tensor:
    lower, upper = (torch.tensor(c, dtype=torch.float64) for c in (signal.domain.lower, signal.domain.upper))
    return lower + (upper - lower) * torch.rand(count, 3, dtype=torch.float64)


@every_signal
def test_gradient_and_hessian_are_differences(name):
    signal = signals.named(name)
    points = inside(signal)
    value, gradient, hessian = signal.jet(points, 2)
    laws.assert_close(gradient, laws.finite_difference(signal, points, 2e-4), 2e-7, float(gradient.abs().max()))
    differences = laws.finite_difference(lambda p: signal.value_and_gradient(p)[1], points, 2e-4)
    laws.assert_close(hessian, differences, 2e-6, float(hessian.abs().max()))
    assert torch.equal(value, signal(points))
    assert torch.equal(gradient, signal.value_and_gradient(points)[1])


@every_signal
def test_autograd_of_the_value_is_the_gradient(name):
    signal = signals.named(name)
    points = inside(signal).requires_grad_()
    value, gradient = signal.value_and_gradient(points)
    (along,) = torch.autograd.grad(value.sum(), points)
    laws.assert_close(along, gradient, 1e-10, float(gradient.detach().abs().max()))


@every_signal
def test_centre_and_axes_are_finite(name):
    """r = 0 is where a naive gradient divides by zero."""
    signal = signals.named(name)
    points = torch.tensor([[0, 0, 0], [0, 0, 0.5], [0.5, 0, 0], [1, 1, 1]], dtype=torch.float64, requires_grad=True)
    for quantity in signal.jet(points, 2 if name != "sphere-distance" else 1):
        assert torch.isfinite(quantity).all()
    (along,) = torch.autograd.grad(signal(points).sum(), points)
    assert torch.isfinite(along).all()


@every_signal
def test_the_box_tells_how_to_sample_it(name):
    signal = signals.named(name)
    volume = signal.sample((4, 5, 6))
    assert volume.shape == (6, 5, 4)
    assert volume.dtype == torch.float64
    lower, upper = np.array(signal.domain.lower), np.array(signal.domain.upper)
    assert volume.spacing == pytest.approx(tuple((upper - lower) / [4, 5, 6]))
    z, y, x = np.indices((6, 5, 4))
    world = volume.voxel_to_world(torch.as_tensor(np.stack([x, y, z], -1).astype(float)))
    laws.assert_close(volume.samples, signal(world), 1e-14, float(volume.samples.abs().max()))
    laws.assert_close(world[0, 0, 0], lower + (upper - lower) / [8, 10, 12], 1e-14)
    nodes = signal.sample(3, centering="node", dtype=torch.float32)
    assert nodes.dtype == torch.float32
    corners = nodes.voxel_to_world(torch.tensor([[0.0, 0, 0], [2, 2, 2]]))
    laws.assert_close(corners, np.stack([lower, upper]), 1e-6)


def test_marschner_lobb_as_printed():
    """ρ = (1 − sin(πz/2) + α (1 + cos(2π f cos(πr/2)))) / (2 (1 + α)), f = 6, α = ¼."""
    p = inside(signals.marschner_lobb()).numpy()
    r = np.hypot(p[:, 0], p[:, 1])
    rho = np.cos(2 * np.pi * 6 * np.cos(np.pi * r / 2))
    expected = (1 - np.sin(np.pi * p[:, 2] / 2) + 0.25 * (1 + rho)) / (2 * 1.25)
    laws.assert_close(signals.marschner_lobb()(torch.as_tensor(p)), expected, 1e-13)


def test_franke_as_printed():
    """Renka 1988, test function 1, at (0, 0, 0), where every exponent is a short sum."""
    expected = 0.75 * math.exp(-3) + 0.75 * math.exp(-1 / 49 - 0.2)
    expected += 0.5 * math.exp(-(49 + 9 + 25) / 4) - 0.2 * math.exp(-(16 + 49 + 25))
    assert float(signals.franke()(torch.zeros(3, dtype=torch.float64))) == pytest.approx(expected, rel=1e-14)


def test_spheres():
    p = torch.tensor([[0.6, 0, 0], [0, 0, 0], [0, 1.0, 0]], dtype=torch.float64)
    laws.assert_close(signals.sphere()(p), np.array([0.5, 1, 0]), 1e-8)
    laws.assert_close(signals.sphere_distance()(p), np.array([0, -0.6, 0.4]), 1e-14)
    moved = signals.sphere_distance(center=(0.6, 0, 0))
    laws.assert_close(moved(p), np.array([-0.6, 0, math.sqrt(1.36) - 0.6]), 1e-14)


def test_torus():
    """Points of it by its angles; the sign tells inside from outside."""
    u, v = 7 * torch.rand(2, 50, dtype=torch.float64)
    ring = 0.5 + 0.2 * torch.cos(v)
    p = torch.stack((ring * torch.cos(u), ring * torch.sin(u), 0.2 * torch.sin(v)), -1)
    signal = signals.torus(0.5, 0.2)
    laws.assert_close(signal(p), np.zeros(50), 1e-15)
    assert signal(torch.tensor([0.5, 0, 0])) < 0 < signal(torch.zeros(3))


def test_barth_sextic():
    """As printed, its symmetries, and a known double point: (1, 0, 0) scaled to where value and gradient are 0."""
    p = inside(signals.barth_sextic(), 50)
    x, y, z = (1.75 * p).T.numpy()
    t = (1 + 5**0.5) / 2
    factors = (t**2 * x**2 - y**2) * (t**2 * y**2 - z**2) * (t**2 * z**2 - x**2)
    expected = 4 * factors - (1 + 2 * t) * (x**2 + y**2 + z**2 - 1) ** 2
    value = signals.barth_sextic()(p)
    laws.assert_close(value, expected, 1e-13, np.abs(expected).max())
    for image in (p.roll(1, -1), p * torch.tensor([1, -1, 1])):
        laws.assert_close(signals.barth_sextic()(image), value, 1e-13, np.abs(expected).max())
    node = torch.tensor([1.0, 0, 0], dtype=torch.float64) / 1.75
    for quantity in signals.barth_sextic().jet(node, 1):
        laws.assert_close(quantity, np.zeros(quantity.shape), 1e-14)
    assert torch.linalg.matrix_rank(signals.barth_sextic().jet(node, 2)[2]) == 3  # a cone, not a crease


def test_polynomial_with_gradient():
    terms = {(0, 0, 0): 1.0, (1, 2, 0): 2.0, (0, 0, 3): -0.5}
    p = torch.rand(20, 3, dtype=torch.float64)
    x, y, z = p.unbind(-1)
    value, gradient = signals.polynomial(terms).value_and_gradient(p)
    laws.assert_close(value, 1 + 2 * x * y**2 - 0.5 * z**3, 1e-14)
    laws.assert_close(gradient, torch.stack([2 * y**2, 4 * x * y, -1.5 * z**2], -1), 1e-14)


def test_gradcheck_through_value_gradient_and_hessian():
    p = (0.1 + 0.7 * torch.rand(2, 3, dtype=torch.float64)).requires_grad_()
    for name in ("marschner-lobb", "gaussian"):
        signal = signals.named(name)
        assert torch.autograd.gradcheck(lambda q, signal=signal: signal.jet(q, 2), (p,))


@every_signal
def test_shapes_dtypes_and_voxel_size(name):
    signal = signals.named(name)
    value, gradient = signal.value_and_gradient(torch.rand(2, 4, 3))
    assert (value.shape, gradient.shape, value.dtype) == ((2, 4), (2, 4, 3), torch.float32)
    assert signal(torch.zeros(3, dtype=torch.int64)).dtype == torch.float32
    assert signal.with_voxel_size(0.25).domain.voxel_size == 0.25
    assert "voxel_size" in inspect.signature(signals.SIGNALS[name]).parameters


def test_a_function_may_give_views_of_another_type():
    def ramp(points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        x = torch.stack([points.double()[..., 0], points.double()[..., 1]], -1)
        return x[..., 0], torch.zeros_like(points, dtype=torch.float64) + torch.tensor([1.0, 0, 0])

    signal = signals.Signal("ramp", ramp)
    value, gradient, hessian = signal.jet(torch.rand(5, 3), 2)
    assert {value.dtype, gradient.dtype, hessian.dtype} == {torch.float32}
    transfer = TransferFunction([-1.0, 0.0, 1.0], [[0.0, 0, 0], [1, 0, 0], [1, 1, 1]], [0.0, 0.3, 0.5])
    image = render(signal, PerspectiveCamera.framing(signal.domain), transfer, size=(8, 8), step=0.2)
    assert image.dtype == torch.float32
    assert image.isfinite().all()


def test_callers_mistakes():
    with pytest.raises(ValueError, match="marschner-lobb, franke"):
        signals.named("lobb")
    signal = signals.gaussian()
    with pytest.raises(ValueError, match=r"\(\.\.\., 3\).*\(5, 2\)"):
        signal(torch.zeros(5, 2))
    with pytest.raises(ValueError, match="order"):
        signal.jet(torch.zeros(5, 3), 3)
    with pytest.raises(ValueError, match="n must be"):
        signal.sample(0)
    with pytest.raises(ValueError, match="n must be"):
        signal.sample(1, centering="node")
    with pytest.raises(ValueError, match="centering"):
        signal.sample(4, centering="corner")  # type: ignore[arg-type]


@pytest.mark.parametrize("name", list(signals.SIGNALS))
def test_finite_at_the_singular_points(name):
    for jet in signals.named(name).jet(torch.zeros(1, 3, dtype=torch.float64), 2):
        assert jet.isfinite().all()
        assert jet.abs().max() < 1e4


@pytest.mark.parametrize(
    ("name", "parameter"), [("sphere", "edge"), ("gaussian", "sigma"), ("marschner-lobb", "voxel_size")]
)
def test_parameters_that_must_be_positive(name, parameter):
    for value in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match=f"{parameter} must be a positive number"):
            signals.named(name, **{parameter: value})
