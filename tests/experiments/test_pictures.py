"""What pictures show of a signal, and what fields are judged by there."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

import filterlab as fl
from experiments.pictures import Cloud, Picture, drawn, level_of, medium, shown_by
from experiments.variety import Subject
from filterlab.recommendation.choice import STEPS
from filterlab.render import TransferFunction, render
from filterlab.signals import Signal, ValueAndGradient

WHITE = (1.0, 1.0, 1.0)
N = 17
REGION = (0.35,) * 3, (15.65,) * 3  # 0.9 of −½ … 16½


def of_function(function: ValueAndGradient) -> Signal:
    return Signal("known", function, (-0.5, -0.5, -0.5), (N - 0.5, N - 0.5, N - 0.5), 1.0)


def ball(p: Tensor) -> tuple[Tensor, Tensor]:
    """|p − c|²: its mean over a segment is s²/12 more than its value in the middle."""
    away = p - 8.0
    return away.square().sum(-1), 2 * away


def ramp(p: Tensor) -> tuple[Tensor, Tensor]:
    """z: nothing is lost by one sample for a segment."""
    return p[..., 2].clone(), torch.zeros_like(p) + p.new_tensor([0.0, 0.0, 1.0])


def off(function: ValueAndGradient, value: float, gradient: float, where=lambda p: p[..., 2] > -1) -> Signal:
    """Another one, whose errors are these in a part of it."""

    def wrong(p: Tensor) -> tuple[Tensor, Tensor]:
        v, g = function(p)
        return v + value * where(p), g + gradient * where(p)[..., None] * p.new_tensor([1.0, 0.0, 0.0])

    return of_function(wrong)


def through(function: ValueAndGradient) -> Picture:
    """Rays along z."""
    across = torch.linspace(1.0, 15.0, 15, dtype=torch.float64)
    xy = torch.cartesian_prod(across, across)
    origins = torch.cat((xy, torch.full((len(xy), 1), 0.35)), -1)
    directions = torch.tensor([0.0, 0.0, 15.3], dtype=torch.float64).expand(len(xy), 3)
    return Picture(of_function(function), 1.0, 8.0, "volume", REGION, origins, directions)


def constant(opacity: float) -> TransferFunction:
    return TransferFunction([0.0], [WHITE], [opacity])


def cloud_of(picture: Picture, transfer: TransferFunction) -> Cloud:
    found = Cloud.seen(picture, transfer, np.random.default_rng(4))
    assert found is not None
    return found


# --- of a level -------------------------------------------------------------------------------------------------------


def subject_of(function: ValueAndGradient, random: np.random.Generator) -> Subject:
    """A volume of 17³ exact samples, known at random points."""
    signal = of_function(function)
    points = torch.tensor(random.random((4096, 3))) * (N - 1)
    value, gradient = signal.value_and_gradient(points)
    weights = torch.full((4096,), 1 / 4096, dtype=torch.float64)
    return Subject("known", signal.sample(N).samples, points, weights, value, gradient, torch.zeros(4096), signal)


def test_a_picture_judges_what_its_rays_hit() -> None:
    """A ball of radius 4 in the middle, exact, and 2 % too small."""
    random = np.random.default_rng(3)
    subject = subject_of(ball, random)
    picture = replace(Picture.of(subject, 1.0, random), level=16.0)
    assert (picture.directions.norm(dim=-1) > 0).all()
    assert torch.tensor(picture.region).allclose(torch.tensor(REGION))
    ends = torch.stack([picture.origins, picture.origins + picture.directions])
    assert ends.min() >= 0.35 - 1e-9
    assert ends.max() <= 15.65 + 1e-9
    exact = fl.reconstruct(subject.volume, "catmull-rom")
    found = picture.error(exact)
    assert found is not None
    assert found < 1e-10  # of a quadratic
    wrong = fl.reconstruct(subject.volume * 0.98, "catmull-rom")
    # hits at |p − c|² = 16 / 0.98: value off by 0.02 · 16 / 0.98, gradient by 0.02 · 2 · 4 / √0.98
    assert picture.error(wrong) == pytest.approx(max(0.32 / 0.98, 0.16 / math.sqrt(0.98)), rel=1e-4)
    assert replace(picture, level=-1.0).error(exact) is None
    nearest = picture.error(fl.reconstruct(subject.volume, "nearest"))
    assert nearest is not None
    assert nearest > 1  # its surface lies between voxels, and it has no gradient


def test_levels_are_drawn_by_volume_or_by_detail() -> None:
    """An edge in the plane z = 8: half of the volume is on each side, all of its detail is between."""

    def edge(p: Tensor) -> tuple[Tensor, Tensor]:
        t = torch.tanh(p[..., 2] - 8)
        return t, (1 - t * t)[..., None] * p.new_tensor([0.0, 0.0, 1.0])

    subject = subject_of(edge, np.random.default_rng(3))
    for part in (0.25, 0.75):
        z = 16 * part  # points are in 0 … 16
        assert level_of(subject, "volume", part) == pytest.approx(math.tanh(z - 8), abs=0.001)
        assert level_of(subject, "detail", part) == pytest.approx(2 * part - 1, abs=0.08)  # of 4096 points
    assert level_of(subject, "volume", 1.0) < 1


# --- of a medium ------------------------------------------------------------------------------------------------------


def test_cells_show_what_the_renderer_makes_of_them() -> None:
    picture = Picture.of(subject_of(ball, np.random.default_rng(3)), 1.0, np.random.default_rng(5))
    transfer = TransferFunction([10.0, 30.0, 60.0], [WHITE] * 3, [0.0, 0.4, 0.1])
    image = render(picture.signal, (picture.origins, picture.directions), transfer, region=picture.region, step=0.05)
    shown = shown_by(picture, transfer, 500)
    assert shown.min() >= 0
    assert shown.sum(-1).numpy() == pytest.approx(image[:, 3].numpy(), abs=1e-4)
    assert 0.3 < shown.sum(-1).mean() < 0.9


def test_places_are_drawn_by_what_is_seen() -> None:
    shown = torch.tensor([[0.0, 0.3, 0.1], [0.0, 0.0, 0.6]], dtype=torch.float64)
    ray, t = drawn(shown, 10_000, np.random.default_rng(1))
    assert ray.bincount().tolist() == pytest.approx([4000, 6000], abs=1)
    assert ((t * 3).long() + 3 * ray).bincount(minlength=6).tolist() == pytest.approx(
        [0, 3000, 1000, 0, 0, 6000], abs=1
    )
    assert t[ray == 1].min() < 0.667
    assert t[ray == 1].max() > 0.999


def test_what_a_march_loses_counts() -> None:
    """Of a field without error; the front hides the ends of rays, where segments are shorter."""
    cloud = cloud_of(through(ball), constant(0.9))
    lost = cloud.errors(cloud.picture.signal)
    assert list(lost) == list(STEPS)
    for step in STEPS:
        assert lost[step] == pytest.approx(step**2 / 12, rel=1e-3)
    wrong = cloud.errors(off(ball, 0.0, 0.04))
    for step in STEPS:
        assert wrong[step] == pytest.approx(math.hypot(0.04, step**2 / 12), rel=1e-3)


@pytest.mark.parametrize(("value", "gradient"), [(0.2, 0.0), (0.0, 0.3), (0.2, 0.3), (0.3, 0.2)])
def test_the_larger_of_the_errors_of_value_and_gradient_counts(value: float, gradient: float) -> None:
    cloud = cloud_of(replace(through(ramp), span=2.0), constant(0.2))
    for error in cloud.errors(off(ramp, value, gradient)).values():
        assert error == pytest.approx(0.5 * max(value, gradient), rel=1e-5)


def test_samples_are_the_middles_of_segments() -> None:
    """Of rays along z, from 0.35 to 15.65; the last segment is the rest."""
    cloud = cloud_of(through(ramp), constant(0.05))
    for step, points in zip(STEPS, cloud.points[..., 2] - 0.35, strict=True):
        whole = int(15.3 / step)
        number = (points / step - 0.5).round().clamp_max(whole)
        middle = torch.where(number < whole, (number + 0.5) * step, (whole * step + 15.3) / 2)
        assert points.numpy() == pytest.approx(middle.numpy(), abs=1e-5)


def test_errors_are_weighted_by_what_is_seen() -> None:
    """Clear places do not count, nor what is hidden: a part e^(−τ d) of the light comes from behind a depth d."""
    picture = through(ramp)
    low = cloud_of(picture, TransferFunction.triangle_peaks([(4.0, 6.0, 0.3, WHITE)]))
    behind = off(ramp, 0.5, 0.0, lambda p: p[..., 2] > 7.51)  # beyond the last segment that reaches z = 7
    assert max(low.errors(behind).values()) < 1e-6
    assert low.errors(off(ramp, 0.5, 0.0))[0.125] == pytest.approx(0.5)
    dense, tau, depth = cloud_of(picture, constant(0.3)), -math.log1p(-0.3), 4.9
    hidden = off(ramp, 0.5, 0.0, lambda p: p[..., 2] > 0.35 + depth)
    share = (math.exp(-tau * depth) - math.exp(-tau * 15.3)) / (1 - math.exp(-tau * 15.3))
    assert dense.errors(hidden)[0.35] == pytest.approx(0.5 * math.sqrt(share), rel=0.01)  # segments end at 4.9


def test_there_is_no_cloud_where_hardly_anything_is_seen() -> None:
    transfer = TransferFunction.triangle_peaks([(40.0, 6.0, 0.3, WHITE)])
    assert Cloud.seen(through(ramp), transfer, np.random.default_rng(4)) is None
    assert Cloud.seen(through(ramp), constant(0.001), np.random.default_rng(4)) is None


def test_pictures_are_compared_pixel_by_pixel() -> None:
    """A value off by 0.1 of the range is that of a pixel, as far as it is opaque; a march of a ramp loses nothing."""
    cloud = cloud_of(replace(through(ramp), span=4.0), constant(0.1))
    opacity = 1 - 0.9**15.3
    assert cloud.rendered(off(ramp, 0.4, 0.0), 0.35) == pytest.approx(0.1 * opacity, rel=0.01)
    assert cloud.rendered(cloud.picture.signal, 0.125) < 1e-4
    half = off(ramp, 0.4, 0.0, lambda p: p[..., 0] > 8.5)  # seven of fifteen rays
    assert cloud.rendered(half, 0.35) == pytest.approx(0.1 * opacity * math.sqrt(7 / 15), rel=0.02)


def test_in_a_dense_medium_the_front_of_a_segment_hides_its_back() -> None:
    """A ramp of slope 1: a step s moves what is seen by 1/τ − s / (e^(τ s) − 1) − s/2, about τ s²/12, to the back."""
    cloud, tau = cloud_of(replace(through(ramp), span=16.0), constant(0.7)), -math.log1p(-0.7)
    moved = [1 / tau - s / math.expm1(tau * s) - s / 2 for s in (1.0, 0.25)]
    assert moved[0] == pytest.approx(-tau / 12, rel=0.03)
    assert 16 * cloud.rendered(cloud.picture.signal, 1.0) == pytest.approx(moved[1] - moved[0], rel=0.002)


def test_media_lie_around_the_level() -> None:
    random = np.random.default_rng(2)
    for _ in range(30):
        found = medium(5.0, 2.0, random)
        assert 0.02 <= float(found.opacities.max()) <= 0.9
        assert float(found.opacities.min()) == 0
        assert float(found.positions.mean()) == pytest.approx(5.0)
        assert 0.06 <= float(found.positions[-1] - found.positions[0]) <= 2.0
