"""What recommendations stand on: the reference, points and their weights, how spectra fall, the error of a method."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest
import torch
from torch.quasirandom import SobolEngine

import filterlab as fl
from filterlab.recommendation import calibration, survey
from filterlab.recommendation.calibration import CALIBRATION, FALLS, factors
from filterlab.recommendation.errors import Distance, MethodErrors, Yardstick, _distance, band_powers, fall_of
from filterlab.recommendation.reference import endless_spline
from filterlab.recommendation.survey import inner_box, patches_of
from filterlab.volume import Boundary

SIZES = [(1, 1, 1), (1, 2, 3), (4, 5, 6), (7, 9, 12), (16, 8, 30)]


def sobol() -> SobolEngine:
    return SobolEngine(4, scramble=True, seed=3)


def polynomial(points: torch.Tensor, degree: int) -> torch.Tensor:
    x, y, z = points.double().unbind(-1)
    return (0.1 * x) ** degree + (0.2 * y + 1) ** degree - (0.15 * z) ** degree


def voxels(size) -> torch.Tensor:
    axes = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in size), indexing="ij")
    return torch.stack(axes[::-1], -1)


# --- the reference ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("degree", [3, 5, 7])
@pytest.mark.parametrize("size", SIZES)
def test_the_reference_interpolates(size, degree) -> None:
    samples = torch.rand(size, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    assert torch.allclose(endless_spline(samples, degree)(voxels(size)), samples, atol=1e-10)


@pytest.mark.parametrize("degree", [3, 5, 7])
def test_the_reference_reproduces_polynomials_up_to_the_ends_and_no_further(degree) -> None:
    size = (9, 11, 14)
    points = torch.rand(500, 3, dtype=torch.float64) * torch.tensor([13.0, 10.0, 8.0], dtype=torch.float64)
    for power in range(5):
        field = endless_spline(polynomial(voxels(size), power), degree)
        off = float((field(points) - polynomial(points, power)).abs().max())
        assert (off < 1e-10) == (power < 4)


# --- points and weights -----------------------------------------------------------------------------------------------


def lumpy(shape, seed: int = 0) -> torch.Tensor:
    """Noise in one corner, a smooth rest."""
    x = torch.rand(shape, generator=torch.Generator().manual_seed(seed)) * 0.01
    x[..., :5, :5, :5] += torch.rand(5, 5, 5, generator=torch.Generator().manual_seed(seed))
    return x


@pytest.mark.parametrize("shape", [(1, 40, 37, 50), (2, 6, 20, 9), (20, 8, 8, 8)])
def test_means_over_points_are_means_over_the_region(shape) -> None:
    """Wherever the points are drawn: of 1, of a polynomial, of a lump."""
    lower, upper = inner_box(shape[1:])
    even = lower + (upper - lower) * SobolEngine(3, scramble=True, seed=1).draw(2**15, dtype=torch.float64)
    patches = patches_of(lumpy(shape), None, Boundary.MIRROR, sobol())
    assert len(patches) == shape[0]
    for function in (torch.ones_like, lambda p: 1 + (p / 10) ** 2, lambda p: torch.exp(-0.3 * p)):
        found = sum(float((p.weights * function(p.points.double()).prod(-1)).sum()) for p in patches)
        assert found == pytest.approx(float(function(even).prod(-1).mean()), rel=0.04)


def test_weights_of_parts_add_up(monkeypatch) -> None:
    monkeypatch.setattr(survey, "WHOLE", 100)
    sums = [
        sum(float(p.weights.sum()) for p in patches_of(lumpy((2, 40, 37, 50), seed), None, Boundary.MIRROR, sobol()))
        for seed in range(5)
    ]
    assert sum(sums) / 5 == pytest.approx(1, abs=0.15)


def test_most_points_are_where_the_detail_is_and_some_everywhere() -> None:
    patch, = patches_of(lumpy((1, 40, 40, 40)), None, Boundary.MIRROR, sobol())  # fmt: skip
    corner = (patch.points < 7).all(-1)
    assert float(corner.double().mean()) > 20 * (6 / 36) ** 3  # its share of the volume
    assert float((patch.points > 20).all(-1).double().mean()) > 0.02


@pytest.mark.parametrize("boundary", list(Boundary))
def test_parts_tell_what_the_whole_tells(boundary, monkeypatch) -> None:
    """The same errors from cut-out patches as from the whole volume, at every end and under every boundary."""
    signal = fl.signals.gaussian(sigma=0.25, center=(0.9, -0.9, 0.1))
    samples = 1000 + signal.sample(56).samples
    whole = Yardstick.of(samples[None], None, boundary)
    monkeypatch.setattr(survey, "WHOLE", 1000)
    parts = Yardstick.of(samples[None], None, boundary)
    assert len(parts.patches) > 1
    for method in ("trilinear", "tricubic"):
        one, other = whole.errors(method).value, parts.errors(method).value
        assert other.rms == pytest.approx(one.rms, rel=3 * (other.spread + one.spread) + 0.02)


def test_integers_are_as_coarse_in_a_part_as_in_the_whole(monkeypatch) -> None:
    """Of a quiet half beside a loud one: what uint8 rounds off is set by the range of the whole volume."""
    samples = 0.001 * torch.rand(1, 24, 24, 200, generator=torch.Generator().manual_seed(0))
    samples[..., :4] += torch.tensor([0.0, 1.0, 0.0, 1.0])
    whole = Yardstick.of(samples, None, Boundary.MIRROR).errors("trilinear", "uint8").value.rms
    monkeypatch.setattr(survey, "WHOLE", 1000)
    monkeypatch.setattr(survey, "_BY_VOLUME", 0.9)
    parts = Yardstick.of(samples, None, Boundary.MIRROR).errors("trilinear", "uint8").value.rms
    assert parts == pytest.approx(whole, rel=0.25)


@pytest.mark.parametrize("size", [*SIZES, (13, 20, 11)])
def test_bricks_that_may_hold_a_level(size, monkeypatch) -> None:
    """Those with samples on both sides, their own or next to them; looked for in slabs of a brick each."""
    monkeypatch.setattr(survey, "_SLAB", 1)
    samples = torch.rand(size, generator=torch.Generator().manual_seed(2))
    for level in (0.02, 0.5, 0.97, 1.5):
        found = survey._may_hold(level, samples, Boundary.MIRROR)
        assert found.shape == tuple(-(-n // 4) for n in size)
        for brick in torch.cartesian_prod(*(torch.arange(n) for n in found.shape)).reshape(-1, 3).tolist():
            near = samples[tuple(slice(max(4 * b - 1, 0), 4 * b + 5) for b in brick)]
            assert bool(found[tuple(brick)]) == bool(near.min() <= level <= near.max())


@pytest.mark.parametrize("whole", [survey.WHOLE, 1000], ids=["whole", "in parts"])
def test_points_of_a_level_are_spread_over_its_surface(whole, monkeypatch) -> None:
    """On a sphere where the slope is 2.6 times as steep on one side as on the other; all points are on it."""
    monkeypatch.setattr(survey, "WHOLE", whole)
    center, radius = torch.tensor([19.2, 20.1, 21.7], dtype=torch.float64), 9.3
    p = voxels((40, 42, 45)) - center
    samples = (1 + 0.45 * p[..., 0] / radius) * (p.square().sum(-1) - radius**2)
    patches = Yardstick.of(samples[None], None, Boundary.MIRROR, level=0.0).patches
    starts = [torch.zeros(3)] if len(patches) == 1 else [found_in(samples, patch.samples) for patch in patches]
    at = torch.cat([patch.points.double() + start for patch, start in zip(patches, starts, strict=True)]) - center
    weights = torch.cat([patch.weights for patch in patches])
    assert float(weights.sum()) == pytest.approx(1)
    assert bool(((at.norm(dim=-1) - radius).abs() < 0.01).all())
    mean = (weights[:, None] * at).sum(0) / radius
    assert float(mean.abs().max()) < (0.04 if len(patches) == 1 else 0.35)


def found_in(samples: torch.Tensor, part: torch.Tensor) -> torch.Tensor:
    """Where the first voxel of a part lies in (D, H, W), x, y, z."""
    first = (samples == part[0, 0, 0]).nonzero()
    return next(
        i
        for i in first
        if torch.equal(samples[tuple(slice(a, a + n) for a, n in zip(i, part.shape, strict=True))], part)
    ).flip(0)


def test_a_level_without_a_surface_is_refused() -> None:
    samples = torch.rand(36, 36, 36, generator=torch.Generator().manual_seed(0))
    samples[0, 0, 0] = 5.0  # outside of the region
    for level in (3.0, 4.9, 5.1, -3.0, math.nan):
        with pytest.raises(ValueError, match="expected a level with a surface in the inner part of the volume"):
            Yardstick.of(samples[None], None, Boundary.MIRROR, level=level)


def test_points_near_voxels_without_a_value_do_not_count() -> None:
    samples = lumpy((1, 20, 20, 20))
    unknown = torch.zeros(1, 20, 20, 20, dtype=torch.bool)
    unknown[0, 10, 11, 12] = True
    patch, = patches_of(samples, unknown, Boundary.MIRROR, sobol())  # fmt: skip
    near = ((patch.points - torch.tensor([12.0, 11.0, 10.0])).abs() < 3).all(-1)
    assert bool(near.any())
    assert bool((patch.weights[near] == 0).all())
    assert bool((patch.weights[~near & (patch.points < 8).all(-1)] > 0).all())


# --- how spectra fall -------------------------------------------------------------------------------------------------


def test_noise_does_not_fall() -> None:
    noise = torch.rand(40, 40, 40, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    bands = band_powers(noise)
    assert bands[2:].numpy() == pytest.approx(3 / 12, rel=0.1)  # of three axes
    assert fall_of(bands) < 0.5


def test_waves_are_in_their_band() -> None:
    x = torch.arange(64, dtype=torch.float64)
    for band in range(2, 8):
        wave = torch.cos(math.pi * (band + 0.5) / 8 * x).expand(16, 16, 64)
        assert int(band_powers(wave).argmax()) == band


def test_slow_changes_do_not_leak() -> None:
    """A ramp has none of the power of the noise on it."""
    noise = 1e-3 * torch.rand(8, 8, 100, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    ramp = torch.arange(100, dtype=torch.float64)
    assert torch.allclose(band_powers(noise + ramp)[1:], band_powers(noise)[1:], rtol=1e-4)


def test_short_lines_tell_nothing() -> None:
    assert fall_of(band_powers(torch.rand(4, 5, 6, dtype=torch.float64))) == 0


# --- errors -----------------------------------------------------------------------------------------------------------


def test_gradients_are_told_apart_from_values() -> None:
    """Of a plane wave of frequency ω, kept as it is: the gradient is off by about ω times as much, and more."""
    x = torch.cos(0.6 * torch.arange(48, dtype=torch.float64)).expand(12, 12, 48)
    found = Yardstick.of(x[None], None, Boundary.MIRROR).errors("trilinear")
    line = torch.linspace(0, 1, 101, dtype=torch.float64)
    value = (1 - line) * 1 + line * math.cos(0.6) - torch.cos(0.6 * line)
    assert found.gradient.rms > 3 * found.value.rms > 0
    assert found.value.rms < float(value.abs().max())
    assert 0 < found.value.spread < 0.1


def test_the_second_derivative_is_that_of_the_signal() -> None:
    """Of a wave of frequency ω along x, of amplitude 1 and range 2: RMS over lines ω² / (2 √(2·5))."""
    x = torch.cos(0.5 * torch.arange(60, dtype=torch.float64)).expand(20, 20, 60)
    found = Yardstick.of(x[None], None, Boundary.MIRROR)
    assert found.bend == pytest.approx(0.25 / 2 / math.sqrt(10), rel=0.03)


def test_factors_lie_between_their_knots() -> None:
    for quantity, (least, most, likely) in CALIBRATION.items():
        assert len(least) == len(most) == len(likely) == len(FALLS)
        for fall, c, big, nearly in zip(FALLS, least, most, likely, strict=True):
            assert factors(quantity, fall) == (c, big, nearly)
            assert nearly <= big
        assert factors(quantity, FALLS[-1] + 100) == (least[-1], most[-1], likely[-1])
    assert calibration.factors("value", 1.5)[1] == pytest.approx(sum(CALIBRATION["value"][1][1:3]) / 2)


def test_a_distance_is_as_sure_as_it_says() -> None:
    """Of uneven squares, in one patch and in parts, 400 draws of points: their spread, and how often its interval
    holds the distance over all points; 98.8 of 100 times it would if 2.5 standard errors were those of a normal law."""
    generator = torch.Generator().manual_seed(0)
    for parts, count, true in ((1, 500, math.exp(0.5)), (24, 20, 0.5 * math.exp(0.5))):
        squares = torch.randn(400, parts, count, generator=generator, dtype=torch.float64).exp() / (parts * count)
        squares *= torch.rand(400, parts, 1, generator=generator, dtype=torch.float64) if parts > 1 else 1
        found = [_distance(list(draw)) for draw in squares]
        rms = torch.tensor([d.rms for d in found])
        assert sum(d.spread for d in found) / 400 == pytest.approx(float(rms.std() / rms.mean()), rel=0.15)
        ends = [d.between("value", 0.0, 0.0) for d in found]
        assert 0.96 < sum(low <= math.sqrt(true) <= high for low, high, _ in ends) / 400 < 0.998
    assert _distance([torch.zeros(5)]) == Distance(0.0)
    assert _distance([torch.full((5,), math.inf)]) == Distance(math.inf)


@pytest.mark.parametrize(
    ("dtype", "offset"),
    [(torch.float16, 0.0), (torch.bfloat16, 1000.0), (torch.float32, -1030.0), (torch.float16, -1030.0)],
)
def test_what_samples_were_rounded_by_is_in_the_upper_end(dtype, offset) -> None:
    """Noise, kept in a type: the RMS of its rounding, in parts of its range, as that of its largest number at most."""
    exact = offset + 100 * torch.rand(1, 12, 12, 12, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    kept = exact.to(dtype)
    found = Yardstick.of(kept, None, Boundary.MIRROR)
    rounded = float((kept - exact).square().mean().sqrt()) / found.span
    assert rounded < 1.05 * found.rounding < 3 * rounded
    none = MethodErrors(Distance(0.0), Distance(0.0))
    surely = replace(found, doubts=dict.fromkeys(found.doubts, 0.0))
    assert surely.estimate("resample", none).high == found.rounding
    assert surely.estimate("resample", MethodErrors(Distance(found.rounding), none.gradient)).low == 0
    for whole in (torch.uint8, torch.int16):
        assert Yardstick.of(torch.arange(64, dtype=whole).reshape(1, 4, 4, 4), None, Boundary.MIRROR).rounding == 0


@pytest.mark.parametrize("task", ["resample", "isosurface", "dvr"])
@pytest.mark.parametrize("fall", [0.0, 10.0])
def test_what_a_task_counts(task, fall) -> None:
    """The value; of others the value or the gradient, whichever is further off; of a march s² |f''| / 24 beside."""
    doubts = {"value": 0.02, "gradient": 0.03, "bend": 0.05}
    yardstick = Yardstick(Boundary.MIRROR, (0.0, 1.0), None, (), (), doubts, 0.0, 0.4, fall)
    step = 0.7 if task == "dvr" else None
    lost = 0.0 if step is None else 0.49 / 24
    for value, gradient in ((0.2, 0.5), (0.5, 0.2)):
        errors = MethodErrors(Distance(value), Distance(gradient))
        counted = {"value": value} if task == "resample" else {"value": value, "gradient": gradient}
        ends = [
            (max(d - c * doubts[name], 0), math.hypot(d, big * doubts[name]), math.hypot(d, likely * doubts[name]))
            for name, d in (counted | {"bend": 0.4}).items()
            for c, big, likely in [factors(name, fall)]
        ]
        (*lows, low), (*highs, high), (*likelies, likely) = zip(*ends, strict=True)
        found = yardstick.estimate(task, errors, step)
        assert found.measured == pytest.approx(math.hypot(max(counted.values()), lost * 0.4))
        assert found.doubt == pytest.approx(math.hypot(max(doubts[name] for name in counted), lost * 0.05))
        assert found.low == pytest.approx(math.hypot(max(lows), lost * low))
        assert found.high == pytest.approx(math.hypot(max(highs), lost * high))
        assert found.likely == pytest.approx(math.hypot(max(likelies), lost * likely))


def test_a_sample_stands_for_its_step_but_for_a_24th_of_the_second_derivative() -> None:
    """Of a wave along a ray: the mean over a step less what stands in its middle."""
    x, omega, step = torch.linspace(0, 40 * math.pi, 4001, dtype=torch.float64), 0.3, 0.8
    within = (torch.arange(100, dtype=torch.float64) + 0.5) / 100 - 0.5
    lost = torch.cos(omega * (x[:, None] + step * within)).mean(1) - torch.cos(omega * x)
    bend = float((omega**2 * torch.cos(omega * x)).square().mean().sqrt())
    yardstick = Yardstick(Boundary.MIRROR, (0.0, 1.0), None, (), (), dict.fromkeys(CALIBRATION, 0.0), 0.0, bend, 20.0)
    none = MethodErrors(Distance(0.0), Distance(0.0))
    assert float(lost.square().mean().sqrt()) == pytest.approx(yardstick.estimate("dvr", none, step).measured, rel=0.01)
