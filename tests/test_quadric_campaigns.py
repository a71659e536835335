"""Campaigns of culling and of descents, a little of each; and whether they can tell what they are for."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from filterlab.surfaces import Quadrics
from tests import quadric_culling, slim_descent
from tests.quadric_rays import QUADRICS


@pytest.mark.parametrize("bounds", ["balls", "tetrahedra"])
@pytest.mark.parametrize("kind", QUADRICS)
def test_culling_loses_no_quadric_that_shows_a_front_and_most_that_show_none(kind, bounds):
    found = quadric_culling.verdict(kind, bounds, 3, 150)
    assert found["points that face the eye"] > 100
    assert found["lost"] == 0
    assert 0.85 * found["show backs only"] - 3 <= found["of these left out"] <= found["show backs only"]


def test_quadrics_that_are_lost_are_noticed(monkeypatch):
    facing = Quadrics.facing
    monkeypatch.setattr(Quadrics, "facing", lambda own, eye: facing(own, eye) & (torch.arange(len(own.A)) % 2 == 0))
    assert quadric_culling.verdict("ellipsoid", "balls", 3, 150)["lost"] > 100


def test_culling_of_nothing_removes_nothing(monkeypatch):
    monkeypatch.setattr(Quadrics, "facing", lambda own, eye: torch.ones(len(own.A), dtype=torch.bool))
    found = quadric_culling.verdict("general", "tetrahedra", 3, 150)
    assert (found["lost"], found["of these left out"]) == (0, 0)
    assert found["show backs only"] > 0


STEPS = {"covers": 20, "quadrics": 20, "points": 20, "images of covers": 6, "images of points": 6}


@pytest.mark.parametrize(("kind", "steps"), STEPS.items())
def test_a_descent_stays_finite_and_goes_down(kind, steps, monkeypatch):
    """Of four scenes, by the same rays or view at every step, and by short steps, so that no ray begins to hit: what is
    drawn, and what comes in, moves losses by more than few steps do."""
    given, losses = slim_descent.KINDS[kind], []

    def apart(_rng, surface):
        losses.append(given.apart(np.random.default_rng(5), surface))
        return losses[-1]

    for name in ("FAR", "ROW"):
        monkeypatch.setattr(slim_descent, name, getattr(slim_descent, name)[:4])
    monkeypatch.setitem(slim_descent.KINDS, kind, given._replace(apart=apart, places=given.places[:4], rate=4e-4))
    found = slim_descent.descended(kind, 4 * steps, 1)
    assert (found["steps"], found["not finite"]) == (4 * steps, 0)
    assert found["with gradient"] > 0.7 * 4 * steps
    assert losses[-1] < losses[0]


def test_a_number_that_is_not_finite_ends_a_descent_and_is_counted(monkeypatch):
    given = slim_descent.KINDS["quadrics"]
    monkeypatch.setitem(slim_descent.KINDS, "quadrics", given._replace(apart=lambda *of: given.apart(*of) * np.nan))
    found = slim_descent.descended("quadrics", 20, 0)
    assert found["not finite"] == 2
