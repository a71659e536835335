"""Viewsheds and horizons: against rays of an oracle, one after the other, and closed forms on a round earth."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from filterlab.surfaces import HeightField, sight
from tests import laws
from tests.height_ray_oracle import Ground, crossings

F64 = torch.float64


def rough(n: int = 34, seed: int = 0) -> torch.Tensor:
    return 4 * torch.rand(n, n, dtype=F64, generator=torch.Generator().manual_seed(seed))


def pairs(name: str, count: int, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Whether an observer sees places, as found and by the oracle of rays, and where that can tell."""
    rng = np.random.default_rng(seed)
    heights = rough(seed=seed)
    ground, surface = Ground(name, heights.numpy()), HeightField(heights, name)
    observer, places = rng.uniform(0, 33, 2), rng.uniform(0, 33, (count, 2))
    eye = np.append(observer, ground.at(observer[None])[0] + 4)
    aim = np.concatenate((places, ground.at(places)[:, None] + 1), 1)
    truth = crossings(ground, np.broadcast_to(eye, aim.shape), aim - eye)
    return surface.viewshed(observer, 4, 1, places).numpy(), truth.first > 1, ~truth.undecided


@pytest.mark.parametrize("name", ["linear", "c0", "c1", "c2"])
def test_a_viewshed_is_what_single_rays_of_the_oracle_see(name):
    found, expected, decided = pairs(name, 1000, 1)
    assert (found == expected)[decided].all()
    assert decided.sum() > 990
    assert 100 < expected.sum() < 900


def test_the_program_sees_what_plain_torch_sees():
    surface = HeightField(rough(64), "c1")
    observer = torch.tensor([30.2, 31.7], dtype=F64)
    masks = [sight.viewshed(surface, observer, 1.0, 0.0, None, None, 0.0, how) for how in ("reference", "cpu")]
    assert torch.equal(*masks)
    assert masks[0].shape == (64, 64)
    assert 0.02 < float(masks[0].double().mean()) < 0.9


def test_holes_are_not_seen_and_nobody_stands_in_them():
    heights = rough()
    heights[20, 20] = torch.nan
    surface = HeightField(heights, "linear", nan="propagate")
    seen = surface.viewshed((5.0, 5.0), 100.0, 1.0)
    assert not bool(seen[20, 20])
    assert int((~seen).sum()) < 20
    with pytest.raises(ValueError, match="in a hole"):
        surface.viewshed((20.0, 20.0))


def test_a_round_earth_hides_what_lies_beyond_its_horizon():
    """From a height h above a sea the horizon is √(2 h R / (1 − k)) away, and √(2 h (1 − k) / R) below the eye."""
    n, step, height = 121, 500.0, 40.0
    sea = HeightField(torch.zeros(n, n, dtype=F64), "c1", spacing=step, origin=(0.0, 0.0))
    middle = (n - 1) / 2 * step
    for k in (0.0, sight.REFRACTION):
        far = math.sqrt(2 * height * sight.EARTH_RADIUS / (1 - k))
        x = middle + torch.tensor([0.5, 0.99, 1.01, 1.2], dtype=F64) * far
        places = torch.stack((x, torch.full_like(x, middle)), -1)
        seen = sea.viewshed((middle, middle), height, 1e-9, places, earth_radius=sight.EARTH_RADIUS, refraction=k)
        assert seen.tolist() == [True, True, False, False]
        angle = sea.horizon((middle, middle), [0.0, 1.0, 2.5], height, earth_radius=sight.EARTH_RADIUS, refraction=k)
        laws.assert_close(
            angle, torch.full((3,), -math.atan(math.sqrt(2 * height * (1 - k) / sight.EARTH_RADIUS))), 1e-9
        )
    assert bool(sea.viewshed((middle, middle), height).all())  # flat


def test_horizons_are_the_steepest_of_all_lines_to_the_ground():
    surface = HeightField(rough(), "c1")
    observer, azimuths = torch.tensor([15.1, 17.3], dtype=F64), torch.linspace(0, 6, 9, dtype=F64)
    found = surface.horizon(observer, azimuths, 1.0)
    eye = surface.jet(observer, 0)[0] + 1.0
    way = torch.stack((azimuths.sin(), azimuths.cos()), -1)
    distance = torch.linspace(0.01, 60, 20000, dtype=F64)
    places = observer + distance[:, None, None] * way
    inside = ((places >= 0) & (places <= 33)).all(-1)
    rise = (surface.jet(places, 0)[0] - eye) / distance[:, None]
    steepest = torch.where(inside, rise, -math.inf).amax(0).atan()
    laws.assert_close(found, steepest, 2e-4)
    assert bool((found >= steepest - 1e-12).all())


def test_errors():
    surface = HeightField(rough(), "c1")
    with pytest.raises(ValueError, match=r"shape \(2,\); got \(3,\)"):
        surface.viewshed((1.0, 2.0, 3.0))
    with pytest.raises(ValueError, match="earth_radius must be positive"):
        surface.viewshed((1.0, 2.0), earth_radius=-1.0)
