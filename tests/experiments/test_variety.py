"""Volumes of known truth: gradients are those of the values, weights those of the points."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from experiments.variety import CLASSES, Draw, _points, of_class, of_scan, size_of
from filterlab.recommendation.survey import inner_box

SIZE = (14, 17, 20)


@pytest.mark.parametrize("name", CLASSES)
def test_gradients_are_those_of_the_values(name) -> None:
    drawn = CLASSES[name](Draw(np.random.default_rng(2), torch.tensor(SIZE[::-1], dtype=torch.float64)))
    points = torch.rand(50, 3, dtype=torch.float64) * 12 + 1
    _, gradient = drawn.function(points)
    for axis in range(3):
        step = torch.zeros(3, dtype=torch.float64)
        step[axis] = 1e-4
        slope = (drawn.function(points + step)[0] - drawn.function(points - step)[0]) / 2e-4
        if drawn.differentiable:
            assert torch.allclose(slope, gradient[:, axis], atol=1e-4 * float(gradient.abs().max()) + 1e-5)


@pytest.mark.parametrize("name", CLASSES)
def test_a_volume_has_the_values_of_its_truth(name) -> None:
    subject = of_class(name, SIZE, 3000, np.random.default_rng(2))
    assert subject.volume.shape == SIZE
    lower, upper = inner_box(SIZE)
    assert bool(((subject.points.double() >= lower - 1e-6) & (subject.points.double() <= upper + 1e-6)).all())
    assert float(subject.weights.sum()) == pytest.approx(1, abs=0.03)
    near = (subject.points - subject.points.round()).norm(dim=-1) < 0.2
    x, y, z = subject.points[near].round().long().unbind(-1)
    off = (subject.volume[z, y, x].double() - subject.value[near]).abs()
    slopes = subject.gradient.norm(dim=-1).max()
    if subject.differentiable:
        assert float(off.max()) < 0.2 * float(slopes) + 0.01 * float(subject.volume.double().std()) + 0.1


def test_a_seed_is_a_volume() -> None:
    one, same, other = (of_class("blobs", SIZE, 200, np.random.default_rng(seed)) for seed in (1, 1, 2))
    assert torch.equal(one.volume, same.volume)
    assert torch.equal(one.points, same.points)
    assert not torch.equal(one.volume, other.volume)


def test_points_in_focus_are_weighted_down() -> None:
    """The mean of anything is that over the region, in focus or not."""
    lower, upper = inner_box(SIZE)
    foci = [(torch.tensor([3.0, 3.0, 3.0], dtype=torch.float64), 2.0), (torch.tensor([9.0] * 3).double(), 3.0)]
    at, weights = _points(SIZE, 2**14, foci, np.random.default_rng(0))
    assert float(((at < 5).all(-1)).double().mean()) > 0.2
    even, _ = _points(SIZE, 2**14, (), np.random.default_rng(1))
    assert bool(((even >= lower) & (even <= upper)).all())
    for function in (lambda p: p[:, 0], lambda p: (p[:, 1] < 4).double(), lambda p: torch.exp(-p.sum(-1) / 9)):
        assert float((weights * function(at)).sum()) == pytest.approx(float(function(even).mean()), rel=0.03)


@pytest.mark.parametrize("aliased", [False, True])
def test_a_scan_is_held_out_from_itself(aliased) -> None:
    z, y, x = torch.meshgrid(*(torch.linspace(-2, 2, n, dtype=torch.float64) for n in (40, 44, 50)), indexing="ij")
    subject = of_scan(torch.exp(-(x * x + y * y + z * z)), aliased, 16, 500, np.random.default_rng(0))
    assert subject.volume.shape == (16, 16, 16)
    x, y, z = subject.points.round().long().unbind(-1)
    near = subject.volume[z, y, x].double()
    reach = (subject.points.double() - subject.points.double().round()).norm(dim=-1)
    assert bool(((near - subject.value).abs() < 0.35 * reach + 0.02).all())


def test_sizes_are_within_what_was_asked() -> None:
    random = np.random.default_rng(0)
    sizes = [size_of(random, 8, 64) for _ in range(200)]
    assert min(map(min, sizes)) >= 4
    assert max(map(max, sizes)) <= 64
    assert len({s for s in sizes if len(set(s)) > 1}) > 20
