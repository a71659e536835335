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


@pytest.mark.parametrize("kind", slim_descent.KINDS)
def test_a_descent_stays_finite_and_goes_down(kind, monkeypatch):
    losses = []
    misfit = slim_descent.misfit
    monkeypatch.setattr(slim_descent, "misfit", lambda *given: losses.append(misfit(*given)) or losses[-1])
    found = slim_descent.descended(kind, 300, 1)
    assert (found["steps"], found["not finite"]) == (300, 0)
    assert found["with gradient"] > 200
    first, last = (float(torch.stack([x.detach() for x in part]).mean()) for part in (losses[:8], losses[-8:]))
    assert last < first


def test_a_number_that_is_not_finite_ends_a_descent_and_is_counted(monkeypatch):
    misfit = slim_descent.misfit
    monkeypatch.setattr(slim_descent, "misfit", lambda *given: misfit(*given) * np.nan)
    found = slim_descent.descended("quadrics", 20, 0)
    assert found["not finite"] == 2
