"""Level sets of signals: every crossing along a ray, by roots, by bounds, or as many as a step sees."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from filterlab import signals
from filterlab.fields.crossings import Bounds
from filterlab.signals import Signal
from filterlab.surfaces import LevelSet

LEVELS = {
    "marschner-lobb": 0.5,
    "franke": 0.3,
    "sphere": 0.5,
    "sphere-distance": 0.0,
    "torus": 0.0,
    "barth-sextic": 0.0,
    "gaussian": 0.4,
    "plane-wave": 0.3,
}
SAMPLES = 4000  # along a ray, of what is compared with


def rays(signal: Signal, count: int, reach: float = 3.0) -> tuple[Tensor, Tensor]:
    """From around the box, and within, through points of it."""
    generator = torch.Generator().manual_seed(3)
    lower, upper = (torch.tensor(c, dtype=torch.float64) for c in (signal.domain.lower, signal.domain.upper))
    a, b = torch.rand((2, count, 3), generator=generator, dtype=torch.float64)
    origins = lower + (upper - lower) * (a * reach - (reach - 1) / 2)
    return origins, (lower + (upper - lower) * b - origins) * 0.7


def sampled(signal: Signal, level: float, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """(count of sign changes, t of the first one to a sample) of dense samples within the box."""
    t = torch.linspace(0, 8, SAMPLES, dtype=torch.float64)
    points = origins[:, None] + t[:, None] * directions[:, None]
    lower, upper = (points.new_tensor(c) for c in (signal.domain.lower, signal.domain.upper))
    within = ((points >= lower) & (points <= upper)).all(-1)
    above = signal(points) > level
    change = (above[:, 1:] != above[:, :-1]) & within[:, 1:] & within[:, :-1]
    first = torch.where(change.any(-1), t[change.int().argmax(-1)], math.inf)
    return change.sum(-1), first


def test_every_signal_is_searched_with_a_guarantee():
    assert set(LEVELS) == set(signals.SIGNALS)
    for name in signals.SIGNALS:
        assert str(signals.named(name).search).startswith("exact"), name


@pytest.mark.parametrize("name", signals.SIGNALS)
def test_bounds_hold(name):
    """And are not far from what is reached."""
    signal = signals.named(name)
    if signal.bounds is None:
        pytest.skip("it is a polynomial along rays")
    origins, directions = rays(signal, 5000, reach=1.0)
    _, gradient, hessian = signal.jet(origins + 0.2 * directions, 2)
    steepest = float(gradient.norm(dim=-1).max())
    assert 0.25 * signal.bounds.slope < steepest <= signal.bounds.slope * (1 + 1e-12)
    if signal.bounds.bend < math.inf:
        most = float(torch.linalg.eigvalsh(hessian).abs().max())
        assert 0.2 * signal.bounds.bend < most <= signal.bounds.bend * (1 + 1e-12)


@pytest.mark.parametrize("name", signals.SIGNALS)
def test_no_crossing_that_samples_see_is_missed(name):
    signal, level = signals.named(name), LEVELS[name]
    origins, directions = rays(signal, 60)
    surface = LevelSet(signal, level)
    hits, first = surface.hits(origins, directions, 40), surface.hit(origins, directions)
    count, near = sampled(signal, level, origins, directions)
    more = hits.valid.sum(-1) - count
    assert (more >= 0).all()
    assert (more % 2 == 0)[hits.t.nan_to_num(posinf=0).amax(-1) < 8].double().mean() > 0.9  # pairs between two samples
    same = more == 0
    assert same.double().mean() > 0.9
    assert torch.equal(first.valid[same], near[same] < math.inf)
    close = (first.t - near)[same & first.valid]
    assert (close >= -1e-9).all()
    assert (close <= 8 / (SAMPLES - 1) + 1e-9).all()
    torch.testing.assert_close(first.t, hits.t[:, 0], rtol=0, atol=1e-12)
    at = surface.at(origins, directions, first).point[first.valid]
    scale = float(signal.value_and_gradient(at)[1].norm(dim=-1).max())
    assert float((signal(at) - level).abs().max()) < 1e-12 * scale


def test_two_crossings_next_to_each_other():
    """Where a Gaussian is next to its top: 8e-7 apart. Bounds find both; a step steps over them."""
    level = math.exp(-((4e-7 / 0.3) ** 2) / 2)
    origins = torch.tensor([[-0.7037, 0.0, 0.0], [-0.7037, 1e-3, 0.0]], dtype=torch.float64)
    directions = torch.tensor([[0.5, 0.0, 0.0]], dtype=torch.float64).expand(2, 3)
    whole = signals.gaussian()
    t = LevelSet(whole, level).hits(origins, directions, 4).t
    assert torch.isfinite(t).tolist() == [[True, True, False, False], [False] * 4]
    assert abs(float(t[0, 1] - t[0, 0]) - 2 * 4e-7 / 0.5) < 1e-9
    stepped = Signal("g", lambda p: whole.value_and_gradient(p), step=0.01)
    assert "0.01" in str(stepped.search)
    assert not LevelSet(stepped, level).hits(origins, directions, 4).valid.any()


def test_a_step_finds_what_is_farther_apart():
    whole = signals.marschner_lobb()
    signal = Signal("m", lambda p: whole.value_and_gradient(p), step=0.002)
    origins, directions = rays(signal, 40)
    found, expected = (LevelSet(s, 0.5).hits(origins, directions, 40).t for s in (signal, whole))
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12)
    assert torch.isfinite(expected).sum() > 60


def test_a_ray_that_begins_on_the_surface_hits_there():
    surface = LevelSet(signals.sphere_distance(0.5), 0.0)
    origins = torch.tensor([[0.5, 0.0, 0.0], [0.5, 0.0, 0.0]], dtype=torch.float64)
    directions = torch.tensor([[1.0, 0.0, 0.0], [-1.0, 0.0, 0.0]], dtype=torch.float64)
    assert surface.hit(origins, directions).t.tolist() == [0.0, 0.0]
    t = surface.hits(origins, directions, 3).t
    assert torch.isfinite(t).sum(-1).tolist() == [1, 2]
    assert abs(float(t[1, 1]) - 1) < 1e-12


@pytest.mark.parametrize("name", ["marschner-lobb", "torus"])
def test_hits_have_derivatives(name):
    signal = signals.named(name)
    o, d = rays(signal, 100)
    hit = LevelSet(signal, LEVELS[name]).hit(o, d).valid.nonzero()[:3, 0]
    origins, directions = (x[hit].requires_grad_() for x in (o, d))
    level = torch.tensor(LEVELS[name], dtype=torch.float64, requires_grad=True)

    def depth(o: Tensor, d: Tensor, level: Tensor) -> Tensor:
        return LevelSet(signal, level).hit(o, d).t

    assert torch.autograd.gradcheck(depth, (origins, directions, level))


def test_what_nothing_is_known_of_is_not_searched():
    nothing = Signal("unknown", lambda p: (p.sum(-1), torch.ones_like(p)))
    with pytest.raises(TypeError, match="its degree, bounds, or a step"):
        LevelSet(nothing, 0.0)
    for mistake in ({"step": 0.0}, {"step": math.inf}, {"degree": -1}, {"degree": 1.5}):
        with pytest.raises(ValueError, match="must be"):
            Signal("wrong", lambda p: (p.sum(-1), torch.ones_like(p)), **mistake)
    high = signals.polynomial({(10, 0, 0): 1.0})
    with pytest.raises(ValueError, match="degrees along a ray go up to 9"):
        LevelSet(high, 0.5)


def test_another_voxel_size_changes_no_search():
    bounds = Bounds(1.0, 2.0)
    signal = Signal("s", lambda p: (p.sum(-1), torch.ones_like(p)), bounds=bounds).with_voxel_size(0.1)
    assert signal.bounds == bounds
    assert signal.domain.voxel_size == 0.1
    assert signals.torus().with_voxel_size(0.1).degree_along_rays == 4
