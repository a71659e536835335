"""Hits of splines on tetrahedra, every class of rays: all crossings that the oracle finds, and no other."""

from __future__ import annotations

from fractions import Fraction
from itertools import combinations

import numpy as np
import pytest

from tests import laws, tetrahedral_oracle, tetrahedral_ray_oracle
from tests.level_set_rays import BOUNDARIES, FAULTS, of_first, random
from tests.tetrahedral_oracle import SPLINES
from tests.tetrahedral_ray_oracle import Polynomials, crossings
from tests.tetrahedral_rays import CLASSES, SIZE, campaign, noise, one

every_spline = pytest.mark.parametrize("name", SPLINES)

# ---- the oracle


@every_spline
def test_every_face_lies_in_a_plane_of_the_oracles_lists(name):
    inner = {tuple(n) for n in tetrahedral_ray_oracle.inner(name)}
    outer = {tuple(n): Fraction(k) for n, k in tetrahedral_ray_oracle.outer(name)}
    shift = SPLINES[name].shift
    for tetrahedron in SPLINES[name].tetrahedra:
        for a, b, c in combinations(tetrahedron.vertices, 3):
            (x, y, z), (u, v, w) = (tuple(p - q for p, q in zip(end, a, strict=True)) for end in (b, c))
            cross = (y * w - z * v, z * u - x * w, x * v - y * u)
            size = min(abs(n) for n in cross if n)
            normal = tuple(int(n / size) for n in cross)
            upright = max(normal, tuple(-n for n in normal))
            level = sum((n * p for n, p in zip(upright, a, strict=True)), Fraction(0))
            if level == 0:
                assert upright in inner
            else:
                assert (level + shift * sum(upright) - outer[upright]).denominator == 1


@every_spline
@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_polynomials_are_the_spline(name, boundary):
    rng = np.random.default_rng(0)
    samples, points = rng.random(SIZE[::-1]), rng.uniform(-0.5, 0.5, (60, 3)) + rng.uniform(0, 1, (60, 3)) * (SIZE - 1)
    f = Polynomials(name, samples, boundary)
    near = points + 1e-6 * rng.normal(size=points.shape)
    values = f.on_pieces(f.cells(points), points, near, np.array([0.0, 1.0]))
    for at, found in zip((points, near), values.T, strict=True):
        laws.assert_close(found, tetrahedral_oracle.reconstruct(name, samples, at, boundary, True, 0)[0], 1e-12)


@every_spline
def test_crossings_are_those_that_a_scan_sees(name):
    rng = np.random.default_rng(3)
    case = noise(rng, name, "mirror", True)
    rays, seen = random(rng, case, 16), 0
    for o, d, truth in zip(*rays, crossings(case.polynomials, *rays, case.level), strict=True):
        ends = np.sort(np.stack([(-0.5 - o) / d, (SIZE - 0.5 - o) / d]), 0)
        near, far = max(ends[0].max(), 0), ends[1].min()
        if near >= far:
            assert len(truth.t) == 0
            continue
        t = np.linspace(near, far, 500)[1:-1]
        values = case.jet(o + t[:, None] * d)[0] - case.level
        between = np.histogram(truth.t, t)[0]
        assert ((between % 2 == 1) == (values[1:] > 0) ^ (values[:-1] > 0)).all()
        seen += len(truth.t)
        if len(truth.t):
            assert np.abs(case.jet(o + truth.t[:, None] * d)[0] - case.level).max() < 1e-12
    assert seen > 10


def test_verdicts_see_what_is_wrong():
    truth = [tetrahedral_ray_oracle.Truth(np.array(t), u) for t, u in (([1.0, 2.0], np.inf), ([], np.inf), ([], 1e-12))]
    tolerance = np.full(3, 1e-9)
    none = {"rays": 3, "undecided": 1, "hits": 1, "missed": 0, "invented": 0, "later": 0}
    for hits, wrong in (
        ([1.0, np.inf, 7.0], {}),
        ([np.inf, np.inf, 7.0], {"missed": 1}),
        ([2.0, np.inf, 7.0], {"later": 1}),
        ([0.5, np.inf, 7.0], {"invented": 1}),
        ([1.0, 3.0, 7.0], {"invented": 1}),
    ):
        assert of_first(truth, np.array(hits), tolerance) == none | wrong


# ---- hits


@every_spline
@pytest.mark.parametrize("kind", CLASSES)
def test_every_crossing_is_found_and_no_other(name, kind):
    """Boundaries in turn, with and without prefilter: `campaign` takes them all, and as many rays as there is time."""
    number, seed = list(CLASSES).index(kind), list(SPLINES).index(name)
    verdict = one(name, kind, BOUNDARIES[(number + seed) % 5], bool((number + seed) % 2), 60, 10 * number + seed)
    assert not any(verdict[fault] for fault in FAULTS), verdict
    assert verdict["undecided"] <= (30 if kind == "the level at a vertex" else 2)  # where qss has kinks rays touch it
    assert verdict["sheets rays"] > verdict["undecided"]


def test_a_campaign_counts_what_it_did():
    found = campaign(0.5, rays=10)
    assert found
    assert all(verdict["rays"] > 0 and not any(verdict[fault] for fault in FAULTS) for verdict in found.values())
