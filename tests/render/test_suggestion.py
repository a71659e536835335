"""What is suggested for a field: air is clear, what is in it is not, and all of that is in view."""

from __future__ import annotations

import math
from fractions import Fraction
from itertools import combinations, pairwise

import pytest
import torch
from torch import Tensor

from filterlab import signals
from filterlab.methods import reconstruct
from filterlab.render import PerspectiveCamera, TransferFunction, render
from filterlab.render.suggestion import _last_bins
from filterlab.volume import Volume
from filterlab.world import World

SHAPE = (24, 30, 36)
RADII = (11.0, 8.0, 4.0)
VALUES = (0.0, 100.0, 180.0, 400.0)


def balls(noise: float = 3.0) -> Tensor:
    """One in another, each of its value, in air, with noise; float64 (D, H, W)."""
    z, y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) - (n - 1) / 2 for n in SHAPE), indexing="ij")
    radius = (x * x + y * y + z * z).sqrt()
    samples = torch.zeros(SHAPE, dtype=torch.float64)
    for own, value in zip(RADII, VALUES[1:], strict=True):
        samples[radius < own] = value
    return samples + noise * torch.randn(SHAPE, generator=torch.Generator().manual_seed(1), dtype=torch.float64)


def suggested(samples: Tensor, **more) -> TransferFunction:
    return TransferFunction.suggested(reconstruct(samples, "trilinear", **more))


def opacity(transfer: TransferFunction, *values: float) -> list[float]:
    return transfer(torch.tensor(values, dtype=torch.float64))[1].tolist()


def test_air_and_its_noise_are_clear_and_what_is_rare_and_far_from_it_is_opaque() -> None:
    transfer = suggested(balls())
    assert opacity(transfer, -20.0, 0.0, 9.0) == [0.0, 0.0, 0.0]
    low, middle, high = opacity(transfer, *VALUES[1:])
    assert 0.01 < low < middle < high <= 0.95
    field = reconstruct(balls(), "trilinear")
    image = render(field, PerspectiveCamera.suggested(field), transfer, size=(24, 24))
    assert (image[..., 3] == 0).double().mean() > 0.05
    assert image[11:13, 11:13, 3].min() > 0.9


@pytest.mark.parametrize(("scale", "shift"), [(1e-3, 0.0), (7.0, -1000.0), (-2.0, 50.0)])
def test_values_may_be_in_any_unit_and_upside_down(scale: float, shift: float) -> None:
    one, other = suggested(balls()), suggested(scale * balls() + shift)
    order = slice(None) if scale > 0 else torch.arange(len(one.positions)).flip(0)
    torch.testing.assert_close(other.opacities[order], one.opacities, rtol=0.05, atol=0.01)
    span = 400 * abs(scale)
    torch.testing.assert_close(other.positions[order], scale * one.positions + shift, rtol=0, atol=0.02 * span)
    assert opacity(other, shift) == [0.0]


@pytest.mark.parametrize("side", [2, 5, 12])
def test_a_line_through_a_class_has_its_depth_however_thick_it_is(side: int) -> None:
    samples = torch.zeros(SHAPE)
    samples[6 : 6 + side, 6 : 6 + side, 6 : 6 + side] = 1.0
    transfer = suggested(samples)
    assert opacity(transfer, 0.0, 1.0) == pytest.approx([0.0, min(1 - math.exp(-12 / side), 0.95)])


def test_what_is_missing_is_not_looked_at() -> None:
    samples = balls()
    around = torch.ones(SHAPE, dtype=torch.bool)
    around[3:-3, 3:-3, 3:-3] = False
    transfer = suggested(samples.masked_fill(around, math.nan), nan="propagate")
    assert opacity(transfer, 0.0, 9.0) == [0.0, 0.0]
    assert min(opacity(transfer, *VALUES[1:])) > 0.01
    nearly_nothing = torch.full((3, 3, 3), math.nan)
    nearly_nothing[0, 0, 0] = 1
    with pytest.raises(ValueError, match="expected a field with a finite value somewhere"):
        suggested(nearly_nothing, nan="propagate")
    with pytest.raises(ValueError, match="for one channel"):
        suggested(torch.rand(2, 1, 4, 4, 4))


@pytest.mark.parametrize("given", [[[[7.0] * 4] * 4] * 4, [[[0.0]]], [[[0.0, 1.0]]]])
def test_anything_can_be_shown(given: list) -> None:
    field = reconstruct(torch.tensor(given), "trilinear", boundary="border")
    transfer = TransferFunction.suggested(field)
    image = render(field, PerspectiveCamera.suggested(field, transfer), transfer, size=(9, 9))
    assert image.isfinite().all()
    assert image[..., 3].max() > 0.1


@pytest.mark.parametrize("aspect", [0.5, 1.0, 2.0])
@pytest.mark.parametrize("space", [None, "right-anterior-superior"])
def test_all_that_is_seen_is_in_view_and_in_the_middle(space: str | None, aspect: float) -> None:
    """Of a small ball in a corner of a large volume, in voxels of any shape."""
    samples = torch.zeros(SHAPE)
    z, y, x = torch.meshgrid(*(torch.arange(float(n)) for n in SHAPE), indexing="ij")
    ball = (x - 27).square() + (y - 8).square() + (z - 7).square() < 30
    samples[ball] = 1.0
    field = reconstruct(Volume(samples, spacing=(1.0, 2.0, 0.5), origin=(100.0, 0.0, -50.0), world=World(space)))
    camera = PerspectiveCamera.suggested(field, aspect=aspect, margin=1.25)
    position, right, up, forward = camera._frame(torch.device("cpu"))
    assert forward.abs().min() > 0.2  # along no axis
    assert forward[2] < 0
    assert (forward[1] < 0) == (space is not None)  # of a patient from the front
    points = torch.stack((x[ball] + 100, 2 * y[ball], z[ball] / 2 - 50), -1).double() - position
    half = points @ forward * math.tan(math.radians(camera.field_of_view) / 2)
    across, upwards = points @ right / (half * aspect), points @ up / half
    reach = torch.maximum(across.abs(), upwards.abs()).max()
    assert 0.75 / 1.25 < reach < 1.02 / 1.25  # samples of the field, and voxels, are not the same points
    for ends in (across, upwards):
        assert abs(ends.min() + ends.max()) < 0.15


def test_signals_are_fields_too() -> None:
    signal = signals.marschner_lobb()
    transfer, camera = TransferFunction.suggested(signal), PerspectiveCamera.suggested(signal)
    image = render(signal, camera, transfer, size=(12, 12))
    assert transfer.unit == signal.domain.voxel_size
    assert 0.1 < image[..., 3].mean() < 1


@pytest.mark.parametrize("classes", [1, 2, 3, 4])
@pytest.mark.parametrize("seed", range(4))
def test_classes_of_a_histogram_have_the_largest_variance_between_them(seed: int, classes: int) -> None:
    """Of all ways to cut it, in rational arithmetic; a third of the bins are empty."""
    draw = torch.Generator().manual_seed(seed)
    counts = torch.randint(0, 30, (11,), generator=draw) * (torch.rand(11, generator=draw) > 0.35)
    numbers = [int(n) for n in counts]

    def between(last: tuple[int, ...]) -> Fraction:
        parts = [range(i, j) for i, j in pairwise((0, *(b + 1 for b in last), 11))]
        sums = [(sum(numbers[b] for b in part), sum(numbers[b] * b for b in part)) for part in parts]
        return sum((Fraction(s * s, n) for n, s in sums if n), Fraction(0))

    found = tuple(_last_bins(counts.double(), torch.arange(11.0).double(), classes).tolist())
    assert len(found) == classes - 1
    assert between(found) == max(map(between, combinations(range(10), classes - 1)))
