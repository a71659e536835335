"""The bound of the difference between two methods: it holds at every point, and is reached where it should be."""

import pytest
import torch

import filterlab as fl
from experiments.brick_economy import difference_bound, mixed, most_coefficient, of_bricks, projected

SHAPE = (9, 11, 14)


def fields(samples, method, boundary="mirror"):
    return [fl.reconstruct(samples, m, boundary=boundary) for m in (method, "trilinear")]


@pytest.mark.parametrize("boundary", ["mirror", "reflect", "wrap", "border", "zeros"])
@pytest.mark.parametrize("method", ["triquadratic", "tricubic"])
def test_the_bound_holds_in_every_cell(method, boundary):
    generator = torch.Generator().manual_seed(1)
    samples = torch.rand(SHAPE, generator=generator, dtype=torch.float64)
    samples[2:5] = 3.0  # flat parts, where the bound is small, and an edge
    asked, cheap = fields(samples, method, boundary)
    cells = difference_bound(asked)
    assert cells.shape == tuple(n - 1 for n in SHAPE)
    corner = torch.stack(torch.meshgrid(*(torch.arange(n - 1.0) for n in SHAPE), indexing="ij")[::-1], -1)
    for _ in range(40):
        points = corner.double() + torch.rand(corner.shape, generator=generator, dtype=torch.float64)
        true = (asked(points) - cheap(points)).abs()
        assert bool((true <= cells * (1 + 1e-12)).all())


@pytest.mark.parametrize("method", ["triquadratic", "tricubic"])
def test_the_bound_is_reached_by_a_parabola(method):
    """x² has second differences of 2 everywhere: its chord is off by ¼ in the middle, as the bound says."""
    x = torch.arange(40, dtype=torch.float64)
    asked, cheap = fields((x**2).expand(5, 6, 40).clone(), method)
    point = torch.tensor([[20.5, 2.5, 2.5]], dtype=torch.float64)
    assert float((asked(point) - cheap(point)).abs()) == pytest.approx(0.25, rel=1e-6)
    assert float(difference_bound(asked)[2, 2, 20]) == pytest.approx(0.25, rel=1e-6)


def test_no_value_is_above_the_most_of_its_cell():
    samples = torch.rand(SHAPE, generator=torch.Generator().manual_seed(2), dtype=torch.float64)
    asked, _ = fields(samples, "triquadratic")
    middles = torch.stack(torch.meshgrid(*(torch.arange(n - 1.0) for n in SHAPE), indexing="ij")[::-1], -1) + 0.5
    assert bool((asked(middles.double()) <= most_coefficient(asked)).all())


def test_points_get_the_field_that_their_brick_allows():
    samples = torch.rand(SHAPE, generator=torch.Generator().manual_seed(3))
    asked, cheap = fields(samples, "triquadratic")
    points = torch.rand(500, 3, generator=torch.Generator().manual_seed(4)) * (torch.tensor(SHAPE[::-1]) - 1)
    bricks = of_bricks(torch.zeros(8, 10, 13), 4)
    assert bricks.shape == (2, 3, 4)
    qualifying = torch.rand(bricks.shape, generator=torch.Generator().manual_seed(5)) < 0.5
    x, y, z = (points / 4).long().unbind(-1)
    expected = torch.where(qualifying[z, y, x], cheap(points), asked(points))
    torch.testing.assert_close(mixed(points, asked, cheap, qualifying, 4), expected, rtol=0, atol=1e-6)


def test_the_projection():
    assert projected(0.0, 0.5) == 1.0
    assert projected(1.0, 0.5) == 2.0
    assert projected(0.5, 0.5) == pytest.approx(4 / 3)
    assert projected(1.0, 1.2) == 1.0  # who is no cheaper is not used


def test_bounds_belong_to_their_cells():
    """Samples turned round give bounds turned round: none is a cell off."""
    samples = torch.rand(SHAPE, generator=torch.Generator().manual_seed(6), dtype=torch.float64)
    for measure in (difference_bound, most_coefficient):
        found, turned = (measure(fields(s, "tricubic")[0]) for s in (samples, samples.flip(0, 1, 2)))
        torch.testing.assert_close(found, turned.flip(0, 1, 2))
