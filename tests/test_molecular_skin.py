"""Skins of atoms: against the envelope that defines them, C¹ across cells, closed; degenerate atoms; bad input."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import scipy.optimize
import torch
from torch import Tensor

from filterlab.render import PerspectiveCamera, raycast
from filterlab.surfaces import Quadrics, molecular_skin

F64 = torch.float64


def numbers(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, dtype=F64, generator=torch.Generator().manual_seed(seed))


def atoms(count: int, seed: int = 0, room: float = 6.0) -> tuple[Tensor, Tensor]:
    """Ångström: a blob of so many."""
    rng = torch.Generator().manual_seed(seed)
    centers = (count * room) ** (1 / 3) * torch.rand(count, 3, dtype=F64, generator=rng)
    return centers, 1.1 + 0.7 * torch.rand(count, dtype=F64, generator=rng)


GRID = torch.cartesian_prod(*[torch.arange(3, dtype=F64)] * 3)
RING = torch.stack([torch.tensor([math.cos(a), math.sin(a), 0.0]) for a in torch.arange(6) * math.pi / 3]).double()
OCTAHEDRON = torch.cat((torch.eye(3), -torch.eye(3))).double()
PLACES = {
    "one": numbers(1, 3),
    "two": numbers(2, 3),
    "three": numbers(3, 3),
    "four": numbers(4, 3),
    "in a line": torch.arange(5)[:, None] * torch.tensor([[1.0, 0.3, -0.2]]).double() + 7,
    "in a plane": numbers(9, 2) @ numbers(2, 3) + 3,
    "a ring": 1.4 * RING,
    "a sphere": 1.2 * OCTAHEDRON + 100,
    "a grid": GRID,
    "a sheet": GRID[GRID[:, 2] == 0],
}


def lines(surface: Quadrics, count: int, seed: int = 3) -> tuple[Tensor, Tensor]:
    middle, size = torch.tensor(surface.domain.center, dtype=F64), surface.domain.diagonal
    origins = middle + size * torch.nn.functional.normalize(numbers(count, 3, seed=seed), dim=-1)
    return origins, middle + 0.3 * size * numbers(count, 3, seed=seed + 1) - origins


def envelope(x: np.ndarray, centers: np.ndarray, weights: np.ndarray, s: float) -> tuple[float, np.ndarray]:
    """By definition the least |x − q|² − s W over balls (q, W) of the convex hull in the space of balls, and x − q.

    q = Σ λ p and |q|² − W = Σ λ (|p|² − w), λ ≥ 0 with the sum 1: a quadratic programme.
    """
    p = centers - x
    own = s * ((p**2).sum(1) - weights)
    gram = (1 - s) * p @ p.T

    def of(q):
        return q @ gram @ q + own @ q, 2 * gram @ q + own

    found = scipy.optimize.minimize(
        of,
        np.full(len(p), 1 / len(p)),
        jac=True,
        method="SLSQP",
        bounds=[(0, 1)] * len(p),
        constraints={"type": "eq", "fun": lambda q: q.sum() - 1, "jac": lambda q: np.ones_like(q)},
        options={"ftol": 1e-14, "maxiter": 400},
    )
    return found.fun, -found.x @ p


@pytest.mark.parametrize("shrink", [0.25, 0.5, 0.8])
def test_it_is_the_envelope_of_the_hull_of_balls(shrink):
    centers, radii = atoms(7, seed=1)
    surface = molecular_skin(centers, radii, shrink)
    o, d = lines(surface, 400)
    hits = surface.hits(o, d, 8)
    at = surface.at(o, d, hits)
    assert int(hits.valid.sum()) > 200
    weights = (radii**2 / shrink).numpy()
    for x, normal in zip(at.point[hits.valid][:60], at.normal[hits.valid][:60], strict=True):
        value, way = envelope(x.numpy(), centers.numpy(), weights, shrink)
        assert abs(value) < 1e-6
        np.testing.assert_allclose(way / np.linalg.norm(way), normal.numpy(), atol=1e-4)


def test_the_inside_is_inside():
    """Points between crossings, by definition."""
    centers, radii = atoms(6, seed=2)
    surface = molecular_skin(centers, radii)
    o, d = lines(surface, 100)
    t = surface.hits(o, d, 6).t
    wrong = 0
    for row, place, way in zip(t, o, d, strict=True):
        for i, (begin, end) in enumerate(itertools.pairwise(row.tolist())):
            if math.isfinite(end):
                x = place + (begin + end) / 2 * way
                wrong += (envelope(x.numpy(), centers.numpy(), 2 * radii.numpy() ** 2, 0.5)[0] < 0) != (i % 2 == 0)
    assert wrong == 0


def at_walls(surface: Quadrics, count: int, seed: int = 5) -> tuple[Tensor, Tensor, Tensor]:
    """Places on walls of cells where these may be hit, and two pieces that both have them."""
    bounds = surface.bounds
    if not bounds.planes.shape[1]:
        return torch.zeros(0, 3).double(), *torch.zeros(2, 0).long()
    rng = torch.Generator().manual_seed(seed)
    piece = torch.randint(len(bounds), (count,), generator=rng)
    side = torch.randint(bounds.planes.shape[1], (count,), generator=rng)
    plane = bounds.planes[piece, side]
    x = bounds.centers[piece] + 0.6 * bounds.radii[piece, None] * numbers(count, 3, seed=seed)
    x = x - ((plane[:, :3] * x).sum(1) + plane[:, 3])[:, None] * plane[:, :3]
    off = (bounds.planes[..., :3] * x[:, None, None]).sum(-1) + bounds.planes[..., 3]  # (count, M, H)
    near = (x[:, None] - bounds.centers).norm(dim=-1) <= bounds.radii
    holds = (off <= 1e-12).all(-1) & near & plane[:, :3].any(1)[:, None]
    holds &= holds[torch.arange(count), piece][:, None]
    row, other = holds.nonzero().unbind(1)
    apart = other != piece[row]
    return x[row[apart]], piece[row[apart]], other[apart]


def jump(surface: Quadrics, tries: int = 1000) -> tuple[float, float, int]:
    """Between cells: of F, of its gradient, and at how many places."""
    x, first, second = at_walls(surface, tries)
    one, two = (surface.jet(x, 1, piece) for piece in (first, second))
    if not len(x):
        return 0.0, 0.0, 0
    return float((one[0] - two[0]).abs().max()), float((one[1] - two[1]).norm(dim=1).max()), len(x)


@pytest.mark.parametrize("shrink", [0.2, 0.5, 0.9])
def test_it_is_smooth_across_cells(shrink):
    value, gradient, count = jump(molecular_skin(*atoms(50), shrink))
    assert count > 20
    assert value <= 1e-10
    assert gradient <= 1e-10


@pytest.mark.parametrize("count", [50, 300])
def test_it_is_closed(count):
    """Lines cross it an even number of times, in turn from outside and from inside."""
    centers, radii = atoms(count)
    surface = molecular_skin(centers, radii)
    o, d = lines(surface, 6000)
    hits = surface.hits(o, d, 20)
    number = hits.valid.sum(-1)
    assert (number % 2 == 0).all()
    assert int(number.max()) >= 6
    assert int((number > 0).sum()) > 1500
    fronts = molecular_skin(centers, radii, faces="front").hits(o, d, 10)
    assert torch.equal(hits.t[:, 0::2], fronts.t)


@pytest.mark.parametrize("name", PLACES)
def test_degenerate_atoms(name):
    """Closed, smooth, around all of the atoms; one of them, in the open, is its sphere."""
    centers = PLACES[name]
    radii = torch.full((len(centers),), 0.8, dtype=F64)
    surface = molecular_skin(centers, radii)
    o, d = lines(surface, 2000)
    hits = surface.hits(o, d, 20)
    assert (hits.valid.sum(-1) % 2 == 0).all()
    assert hits.valid.any(-1).double().mean() > 0.05
    value, gradient, _ = jump(surface)
    assert max(value, gradient) < 1e-8
    at = surface.at(o, d, hits).point[hits.valid]
    apart = (at[:, None] - centers).norm(dim=-1).amin(1)
    assert apart.min() > 0.8 - 1e-7
    if name == "one":
        assert (apart - 0.8).abs().max() < 1e-12


def test_grids_of_many_alike():
    centers = torch.cartesian_prod(*[torch.arange(6, dtype=F64)] * 3)
    surface = molecular_skin(centers, torch.full((216,), 0.45, dtype=F64))
    o, d = lines(surface, 5000)
    assert (surface.hits(o, d, 60).valid.sum(-1) % 2 == 0).all()
    assert jump(surface, 50)[1] < 1e-8


def test_hidden_atoms_change_nothing():
    centers, radii = atoms(6)
    o, d = lines(molecular_skin(centers, radii), 600)
    hidden = torch.cat((centers, centers[:2] + 0.05)), torch.cat((radii, torch.full((2,), 0.3, dtype=F64)))
    one, two = (molecular_skin(*given).hits(o, d, 8).t for given in ((centers, radii), hidden))
    torch.testing.assert_close(one, two, rtol=1e-6, atol=1e-6)


def test_near_1_it_is_the_union_of_balls():
    centers, radii = atoms(12)
    o, d = lines(molecular_skin(centers, radii), 1500)
    skin = molecular_skin(centers, radii, 1 - 1e-6).hit(o, d).t
    balls = Quadrics.ellipsoids(centers, radii).hit(o, d).t
    both = skin.isfinite() & balls.isfinite()
    assert int(both.sum()) > 200
    assert torch.equal(skin.isfinite(), balls.isfinite())
    assert (skin - balls)[both].abs().max() < 1e-2


def test_derivatives_in_centers_and_radii():
    """They know of no walls: differences that move these agree."""
    centers, radii = (x.clone().requires_grad_() for x in atoms(5, seed=4))
    surface = molecular_skin(centers.detach(), radii.detach())
    o, d = lines(surface, 60)
    hit = surface.hit(o, d)
    at = surface.at(o, d, hit)
    square = -(at.normal * torch.nn.functional.normalize(d, dim=-1)).sum(-1)
    own = hit.valid & (square > 0.3)
    o, d = o[own][:12], d[own][:12]
    assert len(torch.unique(hit.piece[own][:12])) >= 6

    def shown(*given):
        surface = molecular_skin(*given)
        hit = surface.hit(o, d)
        return hit.t, surface.at(o, d, hit).point

    assert torch.autograd.gradcheck(shown, (centers, radii), rtol=1e-3, atol=1e-4, eps=1e-5)


def test_an_image():
    surface = molecular_skin(*(x.float().numpy() for x in atoms(30)))
    camera = PerspectiveCamera.framing(surface.domain, (0.3, 1.0, -0.4))
    image = raycast(surface, camera, size=(24, 24), channels=("color", "normal"), shadows=True)
    assert bool(image["color"].isfinite().all())
    assert 0.15 < float(image["color"][..., 3].mean()) < 0.8


GOOD = {"centers": OCTAHEDRON, "radii": torch.ones(6, dtype=F64)}


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"centers": OCTAHEDRON[:, :2]}, r"centers must have shape \(…, 3\); got \(6, 2\)"),
        ({"centers": OCTAHEDRON * math.inf}, "centers must be finite"),
        ({"centers": OCTAHEDRON[[0, 1, 2, 3, 4, 4]]}, "centers must differ; 1 of 6 are those of others"),
        ({"centers": OCTAHEDRON[:0], "radii": torch.ones(0)}, "atoms must be at least one; got none"),
        ({"radii": torch.ones(5)}, r"radii must have shape \(6\); got \(5,\)"),
        ({"radii": torch.zeros(6)}, "radii must be positive; 6 of 6 are not"),
        ({"shrink": 1.0}, "shrink must be between 0 and 1, both left out; got 1.0"),
        ({"shrink": math.nan}, "shrink must be between 0 and 1"),
        ({"faces": "all"}, "faces must be one of both, front, back; got 'all'"),
    ],
)
def test_bad_atoms_are_refused(changed, message):
    with pytest.raises((TypeError, ValueError), match=message):
        molecular_skin(**{**GOOD, **changed})
