"""Blinn-Phong against its formula written per sample, and at its singular places."""

import math

import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from filterlab.ops.reference.optics import safe_normalize
from filterlab.render import Light, Shading


def unit(v):
    n = math.sqrt(sum(x * x for x in v))
    return [x / n for x in v]


def dot(a, b):
    return sum(x * y for x, y in zip(a, b, strict=True))


def test_equals_the_formula():
    lights = (Light((1.0, 2.0, 3.0), (1.0, 0.5, 0.2)), Light(None, (0.3, 0.3, 0.3)), Light((0.0, -2.0, 0.0)))
    shading = Shading(lights, ambient=0.15, diffuse=0.6, specular=0.4, shininess=7.5)
    generator = torch.Generator().manual_seed(1)
    color = torch.rand(20, 3, generator=generator, dtype=torch.float64)
    gradient = torch.randn(20, 3, generator=generator, dtype=torch.float64)
    rays = safe_normalize(torch.randn(20, 3, generator=generator, dtype=torch.float64))
    lit = shading(color, gradient, rays)
    for c, g, d, out in zip(color.tolist(), gradient.tolist(), rays.tolist(), lit.tolist(), strict=True):
        n, v = unit(g), [-x for x in d]
        expected = [0.15 * x for x in c]
        for light in lights:
            towards = v if light.direction is None else unit(light.direction)
            h = unit([a + b for a, b in zip(towards, v, strict=True)])
            for k in range(3):
                expected[k] += 0.6 * c[k] * light.color[k] * abs(dot(n, towards))
                expected[k] += 0.4 * light.color[k] * abs(dot(n, h)) ** 7.5
        assert out == pytest.approx(expected, rel=1e-12)


def test_two_sided_and_independent_of_the_gradients_length():
    shading = Shading((Light((1.0, 2.0, 3.0)),))
    color, g = torch.rand(5, 3), torch.randn(5, 3)
    rays = safe_normalize(torch.randn(5, 3))
    expected = shading(color, g, rays)
    assert torch.equal(shading(color, -g, rays), expected)
    for scale in (1e-30, 1e30, 1e-38):  # the square of each leaves float32
        torch.testing.assert_close(shading(color, g * scale, rays), expected, rtol=1e-5, atol=1e-6)


def test_zero_gradient_leaves_ambient_and_finite_derivatives():
    gradient = torch.zeros(2, 3, dtype=torch.float64, requires_grad=True)
    color = torch.rand(2, 3, dtype=torch.float64, requires_grad=True)
    rays = torch.tensor([[0.0, 0.0, 1.0]] * 2, dtype=torch.float64)
    for shininess in (1.0, 32.0):
        shading = Shading((Light(), Light((0.0, 0.0, 1.0))), shininess=shininess)  # the second: h is a zero vector
        lit = shading(color, gradient, rays)
        torch.testing.assert_close(lit, 0.2 * color)
        first = torch.autograd.grad(lit.square().sum(), (gradient, color), create_graph=True)
        assert all(x.isfinite().all() for x in first)
        second = torch.autograd.grad(sum(x.square().sum() for x in first), (gradient, color))
        assert all(x.isfinite().all() for x in second)
        assert not first[0].any()


def test_grazing_normal_has_finite_derivatives():
    gradient = torch.tensor([[1.0, 0.0, 0.0]], dtype=torch.float64, requires_grad=True)
    rays = torch.tensor([[0.0, 0.0, 1.0]], dtype=torch.float64)
    lit = Shading(shininess=1.0)(torch.ones(1, 3, dtype=torch.float64), gradient, rays)
    (first,) = torch.autograd.grad(lit.sum(), gradient, create_graph=True)
    (second,) = torch.autograd.grad(first.sum() + 0 * gradient.sum(), gradient)
    assert first.isfinite().all()
    assert second.isfinite().all()


def test_differentiable_twice_in_everything():
    def function(color, gradient, rays, direction, tint, weights):
        shading = Shading((Light(direction, tint), Light()), weights[0], weights[1], weights[2], 5 * weights[3])
        return shading(color, gradient, safe_normalize(rays))

    generator = torch.Generator().manual_seed(3)
    rows = [torch.rand(2, 3, generator=generator, dtype=torch.float64) + 0.2 for _ in range(3)]
    light = [torch.rand(3, generator=generator, dtype=torch.float64) + 0.2 for _ in range(2)]
    weights = torch.tensor([0.2, 0.5, 0.3, 0.7], dtype=torch.float64)
    inputs = [x.requires_grad_() for x in (*rows, *light, weights)]
    assert gradcheck(function, inputs)
    assert gradgradcheck(function, inputs)


def test_brightest_bounds_lit_colors():
    shading = Shading((Light((1.0, 2.0, 3.0), (1.0, 0.5, 0.2)), Light(None, (0.3, 0.9, 0.3))), specular=1.5)
    generator = torch.Generator().manual_seed(2)
    color = 0.8 * torch.rand(5000, 3, generator=generator)
    rays = safe_normalize(torch.randn(5000, 3, generator=generator))
    lit = shading(color, -rays + 0.2 * torch.randn(5000, 3, generator=generator), rays)
    assert 0.5 * shading.brightest(0.8) < lit.max() <= shading.brightest(0.8)
    assert Shading(()).brightest(0.8) == pytest.approx(0.16)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Light((0.0, 0.0, 0.0)), "direction"),
        (lambda: Light((math.nan, 0.0, 1.0)), "direction"),
        (lambda: Light(None, (1.0, -1.0, 0.0)), "color"),
        (lambda: Shading(ambient=-0.1), "ambient"),
        (lambda: Shading(diffuse=math.inf), "diffuse"),
        (lambda: Shading(specular=math.nan), "specular"),
        (lambda: Shading(shininess=0.5), "shininess"),
        (lambda: Light("a"), "light's direction must be three finite numbers, or None; got 'a'"),
        (lambda: Light(None, "red"), "light's color must be three finite numbers ≥ 0 .* got 'red'"),
        (lambda: Light((1.0, 2.0, "z")), "light's direction must be three finite numbers"),
        (lambda: Shading(ambient="a"), "ambient must be a finite number ≥ 0; got 'a'"),
        (lambda: Shading(specular=(1.0, 2.0)), "specular must be a finite number"),
    ],
)
def test_mistakes(make, message):
    with pytest.raises(ValueError, match=message):
        make()


@pytest.mark.parametrize("lights", [True, Light(), [(0.0, 0.0, 1.0)], "a"])
def test_lights_are_lights(lights):
    with pytest.raises(TypeError, match="lights must be a sequence of Light objects; got"):
        Shading(lights)


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("length", [5e-324, 1e-300, 1e-46, 1e39, 1e300, 1.7e308])
def test_no_length_of_a_light_s_direction_changes_anything(length, dtype):
    gradient, rays = torch.randn(9, 3, dtype=dtype), safe_normalize(torch.randn(9, 3, dtype=dtype))
    direction = torch.tensor([1.0, 0.0, -1.0], dtype=torch.float64)
    lit = []
    for size in (1.0, length):
        shading = Shading((Light(direction * size),))
        lit.append(shading(torch.ones(9, 3, dtype=dtype), gradient, rays))
    assert torch.equal(*lit)
