"""Judging many rays at once: as the exact oracle does, and it can tell what is wrong."""

from __future__ import annotations

import numpy as np
import pytest

from tests import quadric_many, quadric_oracle
from tests.quadric_rays import QUADRICS


@pytest.mark.parametrize("rays", ["eyes", "asymptotic"])
@pytest.mark.parametrize("kind", QUADRICS)
def test_many_rays_are_judged(kind, rays):
    found = quadric_many.verdict(kind, rays, 500, 3)
    assert found["missed"] == found["invented"] == found["float32 off"] == 0, found
    assert found["exactly"] < 20


@pytest.mark.parametrize("kind", ["general", "cone", "cut", "double_plane"])
def test_it_expects_what_the_exact_oracle_does(kind):
    rng = np.random.default_rng(5)
    quadric = QUADRICS[kind](rng)
    origins, directions = quadric_many.eyes(rng, quadric, 60)
    expected = quadric_many.Expected(quadric, origins, directions)
    for i in range(60):
        known = quadric_oracle.crossings(quadric, origins[i], directions[i])
        if not expected.sure[i]:
            continue
        if expected.touches[i]:
            assert len(known) == int(expected.there[i, 0])
            continue
        for side in (0, 1):
            own = [x for x in known if x.front == (side == 0)]
            assert len(own) == int(expected.there[i, side])
            for x in own:
                assert x.within == expected.surely[i, side]
                assert x.t == pytest.approx(float(expected.t[i, side]), rel=1e-12)
                assert x.moved == pytest.approx(float(expected.moved[i, side]), rel=1e-6)


@pytest.mark.parametrize(("change", "what"), [(lambda t: t + 1e-9, "missed"), (lambda t: t[:, :0], "missed")])
def test_hits_that_are_off_or_missing_are_noticed(change, what, monkeypatch):
    cast = quadric_many.cast
    room = ((0, 0), (0, 1))
    monkeypatch.setattr(quadric_many, "cast", lambda *given: np.pad(change(cast(*given)), room, constant_values=np.inf))
    assert quadric_many.verdict("ellipsoid", "inside", 50, 0)[what] > 20


def test_hits_that_are_invented_are_noticed(monkeypatch):
    cast = quadric_many.cast
    monkeypatch.setattr(quadric_many, "cast", lambda *given: np.where(np.isfinite(t := cast(*given)), t, 3.0))
    assert quadric_many.verdict("ellipsoid", "eyes", 50, 0)["invented"] > 20


@pytest.mark.parametrize("rays", quadric_many.AT_PATCHES)
@pytest.mark.parametrize("height", quadric_many.HEIGHTS)
def test_rays_at_patches_are_judged(height, rays):
    found = quadric_many.patch_verdict(height, rays, 2000, 3)
    assert found["missed"] == found["invented"] == found["float32 off"] == 0, found
    assert found["open"] < 5 if rays == "at_points" else found["open"] < 400
    assert min(found["expected"], found["float32"]) > 300


def test_patches_with_other_corners_are_noticed(monkeypatch):
    real = quadric_many.BilinearQuads
    monkeypatch.setattr(quadric_many, "BilinearQuads", lambda corners, quads: real(corners + 1e-3, quads))
    found = quadric_many.patch_verdict(0.1, "at_points", 500, 3)
    assert min(found["missed"], found["invented"]) > 100
    assert found["float32 off"] > 30
