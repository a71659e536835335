"""Experiments on quadrics and covers: what they are made of is what it is said to be, rates are of the same hits."""

from __future__ import annotations

import pytest
import torch

from experiments import covers, quadrics_tables
from experiments.inverse_slim import Config, CoverProblem
from experiments.quadrics_tables import _brute_force, _incremental, _recentred
from experiments.report.quadrics_tables import PRINTED_COVERS, PRINTED_RATES, PRINTED_SETS
from filterlab.surfaces import Quadrics, Spheres, Tetrahedra

F64 = torch.float64


@pytest.mark.parametrize("count", [400, 5064])
def test_a_cover_of_a_torus(count):
    own = covers.torus(count)
    assert len(own.c) == pytest.approx(count, rel=0.02)
    assert covers.distance(own.centers).abs().amax() < 1e-14
    point = own.centers[::7].clone().requires_grad_()
    (normal,) = torch.autograd.grad(covers.distance(point).sum(), point)
    torch.testing.assert_close(2 * own.b[::7], normal)
    u, v = 6.28 * torch.rand(2, 500, dtype=F64, generator=torch.Generator().manual_seed(0))
    across = 1 + 0.4 * v.cos()
    on = torch.stack((across * u.cos(), across * u.sin(), 0.4 * v.sin()), 1)
    inside = ((on[:, None] - own.centers).norm(dim=-1) < own.radii).sum(1)
    assert int(inside.amin()) >= 3
    assert float(inside.double().mean()) == pytest.approx(6, abs=0.5)


@pytest.mark.parametrize("count", [600, 3000])
def test_a_sphere_in_tetrahedra(count):
    given = covers.sphere(count)
    assert len(given.c) == pytest.approx(count, rel=0.15)
    surface = Quadrics(given.A, given.b, given.c, Tetrahedra(given.corners), faces="front")
    way = torch.nn.functional.normalize(torch.randn(400, 3, dtype=F64, generator=torch.Generator().manual_seed(0)))
    hit = surface.hit(3 * way, -way)
    torch.testing.assert_close(hit.t, torch.full((400,), 2.0, dtype=F64))


def test_the_formulas_that_are_timed_find_the_same():
    own = covers.CoverOf(*(x[:40] for x in covers.torus(400)))
    rng = torch.Generator().manual_seed(1)
    eye = torch.tensor([2.0, 1.5, 1.0], dtype=F64).expand(300, 3)
    ways = own.centers[torch.arange(300) % 40] + 0.05 * torch.randn(300, 3, dtype=F64, generator=rng) - eye
    local = Quadrics(own.A, own.b, own.c, Spheres(own.centers, own.radii), origins=own.centers, faces="front")
    expected = local.hit(eye, ways).t
    assert 50 < int(expected.isfinite().sum()) < 300
    torch.testing.assert_close(_brute_force(own, eye, ways), expected, rtol=1e-8, atol=0)
    eyes = local.hits(eye, ways, 1).t[:, 0]
    assert torch.equal(eyes, expected)
    tau = _recentred(local, eye, ways)
    assert torch.equal(tau.isfinite(), expected.isfinite())
    front = _incremental(own, eye[0], ways, clip=True)
    found = front.isfinite()
    torch.testing.assert_close(front[found], expected[found], rtol=1e-6, atol=1e-6)


def test_what_is_printed_is_whole():
    assert all(len(row.split("|")) == 8 for row in PRINTED_COVERS)
    assert all(len(row.split("|")) == 4 for row in PRINTED_SETS)
    assert all(len(row.split("|")) == 3 for row in PRINTED_RATES)
    assert quadrics_tables.COVERS == "cover"


@pytest.mark.parametrize(("unknown", "compared", "rate"), [("numbers", "shapes", 0.02), ("points", "all", 0.05)])
def test_a_few_steps_bring_a_cover_nearer(unknown, compared, rate):
    config = Config.model_validate(
        {
            "experiment": "inverse_slim",
            "description": "a test",
            "target_balls": 800,
            "balls": 150,
            "points": 500,
            "views": {"training": 2, "held_out": 1, "size": 9, "shown": 8, "at_once": 1},
            "descent": {"iterations": 10, "learning_rate": 0.01},
            "parts": 1,
            "weights": {"shapes": {"mask": 0}, "all": {"mask": 0.05}},
        }
    )
    problem = CoverProblem.of(config, unknown, compared)
    parameters = {name: x.requires_grad_() for name, x in problem.start().items()}
    misfit = lambda: float(sum(float(problem.loss(parameters, 0, step)[0].detach()) for step in range(2)))  # noqa: E731
    before = misfit()
    optimiser = torch.optim.Adam(list(parameters.values()), lr=rate)
    for step in range(10):
        optimiser.zero_grad()
        sum(problem.loss(parameters, 0, step)).backward()
        assert all(bool(x.grad.isfinite().all()) for x in parameters.values())
        optimiser.step()
    assert misfit() < 0.8 * before
