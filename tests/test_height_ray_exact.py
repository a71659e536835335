"""The judge of many bits says what is right, missed, later and invented; and of rays that rounding decides, right."""

from __future__ import annotations

from math import inf

import numpy as np
import pytest
import torch

from tests import height_rays
from tests.height_ray_exact import verdict
from tests.height_ray_oracle import Ground, crossings


@pytest.mark.parametrize(
    ("t", "told"), [(2.0, "right"), (inf, "missed"), (2.1, "later"), (1.9, "invented"), (2 + 1e-9, "right")]
)
def test_it_tells_hits_from_others(t: float, told: str):
    """At a plane, from 2 above it."""
    ground = Ground("c1", np.add.outer(np.arange(7.0), np.arange(10.0)))
    assert verdict(ground, np.array([4.0, 3, 9]), np.array([0.0, 0, -1]), t, 1e-7) == told


def test_rays_beside_the_ground_need_no_hit():
    ground = Ground("c0", np.zeros((5, 5)))
    assert verdict(ground, np.array([-1.0, 2, 1]), np.array([1.0, 0, 0]), inf, 1e-7) == "right"
    assert verdict(ground, np.array([-1.0, 2, 1]), np.array([1.0, 0, 0]), 2.0, 1e-7) == "invented"


def test_rays_that_rounding_decides():
    case, rng = height_rays.case_of("c0", "at heights of vertices", "mirror", "anti", 0)
    origins, directions = height_rays.at_heights(rng, case, 200)
    undecided = np.nonzero(crossings(case.ground, origins, directions).undecided)[0][:6]
    assert len(undecided) == 6
    t = case.surface.hit(torch.from_numpy(origins), torch.from_numpy(directions)).t.numpy()
    for k in undecided:
        tolerance = float(1e-7 / np.linalg.norm(directions[k]))
        assert verdict(case.ground, origins[k], directions[k], float(t[k]), tolerance) == "right"
