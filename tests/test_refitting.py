"""Covers as functions of the points they were fitted to, against least squares of every ball by itself."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from filterlab.surfaces import Slim, fit_slim
from filterlab.surfaces.fitting.refitting import Members
from tests.test_fitting import cube, sphere

F64 = torch.float64


def lump(count: int, seed: int = 3) -> np.ndarray:
    drawn = np.random.default_rng(seed).standard_normal((count, 3))
    return sphere(count) * [1.0, 0.8, 0.6] + 2e-3 * drawn


@cache
def cover(count: int = 44) -> Slim:
    return fit_slim(lump(count), tolerance=0.02)


def members_of(slim: Slim) -> Members:
    return slim.of_points.__self__  # type: ignore[union-attr]


def moved(points: np.ndarray, amount: float) -> np.ndarray:
    return points + amount * np.cos(np.arange(points.size)).reshape(points.shape)


def weight(rho: np.ndarray) -> np.ndarray:
    return np.where(rho <= 0.5, np.exp(-4 * rho**2), 4 / np.e * (1 - rho).clip(0) ** 2)


def fitted_again(members: Members, points: np.ndarray) -> np.ndarray:
    """F (M,) of every graph at the middle of its ball + 0.1 r (1, −1, 1), by rows of a least-squares problem each."""
    middle, size = members.middle.numpy(), members.diagonal
    found, first = [], 0
    for k, count in enumerate(members.count.tolist()):
        own = (points[members.point[first : first + count].numpy()] - middle) / size
        first += count
        r = float(members.graphs.radii[k])
        y = (own - members.graphs.centers[k].numpy()) / r
        u, v, z = members.graphs.frames[k].numpy() @ y.T
        w = weight(np.linalg.norm(y, axis=1))
        features = lambda u, v: np.stack([np.ones_like(u), u, v, u * u, u * v, v * v])  # noqa: E731
        ridge = w.sum() * np.array([1e-8] * 3 + [1e-2 if count <= 10 else 1e-8] * 3)
        rows = np.concatenate(((np.sqrt(w) * features(u, v)).T, np.diag(np.sqrt(ridge))))
        c = np.linalg.lstsq(rows, np.concatenate((np.sqrt(w) * z, np.zeros(6))), rcond=None)[0]
        u, v, z = members.graphs.frames[k].numpy() @ np.array([0.1, -0.1, 0.1])
        found.append(size * r * (z - c @ features(u, v)))
    return np.array(found)


def values(slim: Slim) -> torch.Tensor:
    """The same of a cover."""
    points = slim.centers + 0.1 * slim.radii[:, None] * torch.tensor([1.0, -1.0, 1.0], dtype=F64)
    return slim.jet(points, 0, torch.arange(len(slim)))[0]


@pytest.mark.parametrize("points", [lump(300), cube(1200)], ids=["lump", "cube"])
def test_fits_and_their_derivatives_are_those_of_least_squares(points):
    """At the points themselves, at others, and by differences; with and without sharp edges."""
    slim = fit_slim(points, tolerance=3e-3)
    assert slim.fit is not None
    members = members_of(slim)
    assert values(slim).numpy() == pytest.approx(fitted_again(members, points), abs=1e-8)
    assert torch.allclose(values(slim.refitted(points)), values(slim), rtol=0, atol=1e-10)
    given = torch.tensor(moved(points, 1e-3), requires_grad=True)
    again = values(slim.refitted(given))
    assert again.detach().numpy() == pytest.approx(fitted_again(members, given.detach().numpy()), abs=1e-7)
    assert float((again.detach() - values(slim)).abs().max()) > 1e-4
    step, share = 1e-5, np.sin(np.arange(len(slim)))
    ends = (share @ fitted_again(members, moved(points, 1e-3 + side * step)) for side in (1, -1))
    (slope,) = torch.autograd.grad(again @ torch.from_numpy(share), given)
    found = float((slope.numpy() * moved(np.zeros_like(points), 1.0)).sum())
    assert found == pytest.approx(np.subtract(*ends) / (2 * step), rel=1e-5)


def test_depths_and_normals_are_differentiable_twice_in_the_points():
    points, origins = torch.from_numpy(lump(44)), torch.tensor([[0.1, 3.0, 0.2]], dtype=F64)
    near = (points - torch.tensor([0.0, 0.8, 0.05], dtype=F64)).norm(dim=1).argsort()[:2]

    def seen(some: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        slim = cover().refitted(points.index_copy(0, near, some))
        hit = slim.hit(origins, -origins)
        assert hit.valid.all()
        normal = slim.at(origins, -origins, hit).normal
        assert normal is not None
        return hit.t, normal

    given = points[near].requires_grad_()
    assert gradcheck(seen, given)
    assert gradgradcheck(lambda x: seen(x)[0], given, fast_mode=True)


def test_points_that_ask_for_derivatives_have_them_from_the_fit_on():
    points = torch.tensor(lump(44), requires_grad=True)
    slim = fit_slim(points, tolerance=0.02)
    assert slim.fit is not None
    assert torch.allclose(slim.c, cover().c, rtol=0, atol=1e-12)
    direction = torch.tensor([[0.0, 0.0, -3.0]], dtype=F64)
    slim.hit(-direction, direction).t.sum().backward()
    assert points.grad is not None
    lifted = float(points.grad[:, 2].sum())  # of all points together: the surface is lifted as they are
    assert lifted == pytest.approx(-1 / 3, rel=0.1)


def test_parts_of_the_work_change_nothing(monkeypatch):
    points, found = torch.tensor(lump(44), requires_grad=True), []
    for at_once in (1 << 17, 30):
        monkeypatch.setattr("filterlab.surfaces.fitting.refitting._AT_ONCE", at_once)
        (own,) = torch.autograd.grad(values(cover().refitted(points)).square().sum(), points)
        found.append(own)
    assert torch.allclose(*found, rtol=1e-10, atol=1e-12)


def test_what_was_left_out_has_no_part():
    """A point given twice, and a stray."""
    points = np.concatenate((lump(300), lump(300)[:5], [[9.0, 9.0, 9.0]]))
    slim = fit_slim(points, tolerance=3e-3)
    assert slim.fit is not None
    assert (slim.fit.duplicates, slim.fit.strays) == (5, 1)
    given = torch.tensor(points, requires_grad=True)
    values(slim.refitted(given)).sum().backward()
    assert given.grad is not None
    assert (given.grad[300:] == 0).all()
    assert (given.grad[:300] != 0).any(1).all()


def test_other_points_are_refused():
    with pytest.raises(ValueError, match=r"points must have shape \(44, 3\); got \(43, 3\)"):
        cover().refitted(lump(43))
    with pytest.raises(ValueError, match="points must be finite; 1 of its 132 numbers are not"):
        cover().refitted(np.where(np.arange(132).reshape(44, 3) == 5, np.nan, lump(44)))
    with pytest.raises(TypeError, match=r"points must be a floating-point torch\.Tensor"):
        cover().refitted(np.zeros((44, 3), int))
    slim = Slim(*(x.clone() for x in cover().tensors))
    with pytest.raises(ValueError, match="only covers made by fit_slim know their points"):
        slim.refitted(lump(44))
