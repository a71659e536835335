"""Quadrics: every hit and no other, against exact arithmetic; bounds, culling, derivatives, images, bad input."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from filterlab.ops.differentiable import quadrics
from filterlab.ops.reference import quadrics as reference
from filterlab.render import PerspectiveCamera, raycast
from filterlab.surfaces import Bounds, Planes, Quadrics, Spheres, Tetrahedra, culling, mesh
from tests import quadric_rays

F64 = torch.float64
EYE = torch.eye(3, dtype=F64)


def numbers(*rows) -> Tensor:
    return torch.tensor(rows, dtype=F64)


def balls(count: int = 40, seed: int = 0, faces: str = "both") -> Quadrics:
    """Spheres, not touched by their bounds."""
    rng = torch.Generator().manual_seed(seed)
    centers = 6 * torch.rand(count, 3, dtype=F64, generator=rng)
    radii = 0.2 + 0.3 * torch.rand(count, dtype=F64, generator=rng)
    A = EYE.expand(count, 3, 3)
    bounds = Spheres(centers, 1.01 * radii)
    return Quadrics(A, torch.zeros(count, 3, dtype=F64), -(radii**2), bounds, origins=centers, faces=faces)


def rays(count: int, seed: int = 1, side: float = 6.0) -> tuple[Tensor, Tensor]:
    rng = torch.Generator().manual_seed(seed)
    aim = side * torch.rand(count, 3, dtype=F64, generator=rng)
    origins = side / 2 + side * torch.randn(count, 3, dtype=F64, generator=rng)
    return origins, (aim - origins) * 10 ** (4 * torch.rand(count, 1, dtype=F64, generator=rng) - 2)


def one(A, b, c: float, radius: float = 1.0, **more) -> Quadrics:
    """A single quadric about 0, in a ball about 0."""
    bounds = Spheres(torch.zeros(1, 3, dtype=F64), radius)
    return Quadrics(numbers(*[A]), numbers(b), torch.tensor([c], dtype=F64), bounds, **more)


CONE = [[1.0, 0, 0], [0, 1.0, 0], [0, 0, -1.0]]
SPHERE = EYE.tolist()
FLAT = [[0.0, 0, 0], [0, 0, 0], [0, 0, 1.0]]
NONE = torch.zeros(3, 3).tolist()


# --- hits -------------------------------------------------------------------------------------------------------------


@pytest.fixture
def plain(monkeypatch):
    """Plain torch in place of the program."""
    monkeypatch.setattr(quadrics, "missing", lambda *given: "it is not asked for")


@pytest.fixture(params=["fused", "plain"])
def either(request):
    """By the program where it runs, and in plain torch."""
    if request.param == "plain":
        request.getfixturevalue("plain")


@pytest.mark.parametrize("quadric", quadric_rays.QUADRICS)
def test_every_hit_is_found_and_no_other(quadric, either):
    expected = 0
    for kind in quadric_rays.RAYS:
        found = quadric_rays.verdict(quadric, kind, 6, 0)
        assert found["missed"] == found["invented"] == found["inconsistent"] == 0, (kind, found)
        expected += found["expected"]
    assert expected > 4


def test_a_touching_ray_hits_once(either):
    origins = numbers([-3, 1, 0], [-3, 1 + 1e-12, 0], [-3, 1 - 1e-12, 0])
    t = one(SPHERE, [0, 0, 0], -1.0, 1.1).hits(origins, numbers([1, 0, 0]), 3).t
    assert t.isfinite().sum(-1).tolist() == [1, 0, 2]
    assert t[0, 0] == 3


@pytest.mark.parametrize("direction", [[1.0, 0, 0], [3.0, 4, 0], [1.0, 1, 8], [0.0, 0, 2]])
def test_the_apex_of_a_cone(direction, either):
    d = numbers(direction)
    hit = one(CONE, [0, 0, 0], 0.0).hits(-3 * d, d, 3)
    assert hit.t[0].tolist() == [3, math.inf, math.inf]
    at = one(CONE, [0, 0, 0], 0.0).at(-3 * d, d, hit)
    assert at.normal.abs().sum() == 0
    assert at.point[0, 0].tolist() == [0, 0, 0]


@pytest.mark.parametrize("direction", [[1.0, 0, 1], [0.0, 3, -3]])
def test_a_ray_on_the_surface_hits_where_it_enters_the_bounds(direction, either):
    d = numbers(direction)
    t = one(CONE, [0, 0, 0], 0.0).hits(-3 * d, d, 3).t
    assert t[0, 0].item() == pytest.approx(3 - 1 / d.norm().item(), rel=1e-13)
    assert t[0, 1:].tolist() == [math.inf] * 2
    flat = one(NONE, [0, 0, 0.5], 0.0, cuts=numbers([-1, 0, 0, -0.25]))
    t = flat.hits(numbers([-3, 0.5, 0], [0.5, 0, 0], [-3, 0.5, 0.1]), numbers([1, 0, 0]), 2).t
    assert t[:, 0].tolist() == [pytest.approx(2.75), 0, math.inf]
    assert t[:, 1].tolist() == [math.inf] * 3


def test_a_double_plane_is_solid(either):
    """(n·x)² is 0 on both sides of nothing: β² − αγ is rounding, of any sign."""
    n = numbers([0.3, -0.7, 0.64]).T
    surface = one((n @ n.T).tolist(), [0, 0, 0], 0.0)
    origins, directions = rays(500, side=0.4)
    met = surface.hits(origins - 0.2, directions, 3).t.isfinite().sum(-1)
    assert met.max() == 1
    aim = torch.randn(500, 3, dtype=F64, generator=torch.Generator().manual_seed(2))
    aim = 0.9 * torch.nn.functional.normalize(aim - (aim @ n) * n.T / (n.T @ n))
    assert bool(surface.hit(origins, aim - origins).valid.all())


def test_an_eye_on_the_surface_is_met_at_once():
    t = one(SPHERE, [0, 0, 0], -1.0, 1.1).hits(numbers([1, 0, 0], [0.6, 0.8, 0]), numbers([1, 0, 0], [-1, 0, 0]), 2).t
    assert t[0].tolist() == [0, math.inf]
    assert t[1].tolist() == [0, pytest.approx(1.2)]


def every(surface: Quadrics, origins: Tensor, directions: Tensor) -> Tensor:
    """All hits of rays with spheres, by the schoolbook's formula (R, 2 M), sorted."""
    p, d = origins[:, None] - surface.origins, directions[:, None]
    a, b, c = (d * d).sum(-1), (p * d).sum(-1), (p * p).sum(-1) + surface.c
    s = (b * b - a * c).sqrt()
    t = torch.cat(((-b - s) / a, (-b + s) / a), 1)
    return torch.where(t >= 0, t, torch.inf).sort(-1).values


@pytest.mark.parametrize("count", [1, 7, 64, 65, 700])
def test_all_sheets_of_many(count, either):
    surface, (origins, directions) = balls(count), rays(300)
    expected = every(surface, origins, directions)
    k = min(8, expected.shape[1])
    hits, first = surface.hits(origins, directions, k), surface.hit(origins, directions)
    torch.testing.assert_close(hits.t, expected[:, :k], rtol=1e-11, atol=0)
    assert torch.equal(hits.t[:, 0], first.t)
    assert torch.equal(hits.piece[:, 0], first.piece)
    assert torch.equal(hits.piece >= 0, hits.valid)
    last = expected.masked_fill(expected == torch.inf, -1).sort(-1, descending=True).values[:, :k]
    found = surface.hits(origins, directions, k, farthest=True).t
    torch.testing.assert_close(found, last.masked_fill(last == -1, torch.inf), rtol=1e-11, atol=0)
    assert torch.equal(surface.met(origins, directions), first.valid)


@pytest.mark.parametrize("faces", ["front", "back", "both"])
def test_the_farthest_are_the_same_from_behind(faces, either):
    surface, (origins, directions) = balls(faces=faces), rays(200)
    near, far = (surface.hits(origins, directions, 30, farthest) for farthest in (False, True))
    count = near.valid.sum(-1)
    assert 2 < int(count.max()) < 30
    for t, back, n in zip(near.t, far.t, count, strict=True):
        torch.testing.assert_close(t[:n].flip(0), back[:n], rtol=1e-11, atol=0)
        assert not bool(back[n:].isfinite().any())


def test_pieces_tell_which_quadric_is_hit():
    surface, (origins, directions) = balls(), rays(200)
    hits = surface.hits(origins, directions, 4)
    at, own = surface.at(origins, directions, hits, order=2), hits.valid
    distance = (at.point - surface.origins[hits.piece]).norm(dim=-1)
    radius = (-surface.c[hits.piece]).sqrt()
    torch.testing.assert_close(distance[own], radius[own])
    torch.testing.assert_close(at.curvatures[own], (1 / radius[own])[:, None].expand(-1, 2))
    outward = (at.point - surface.origins[hits.piece]) / radius[..., None]
    torch.testing.assert_close(at.normal[own], outward[own])


def test_tensors_of_another_device_take_bounds_with_them():
    surface = balls()
    moved = surface.with_tensors([x.to("meta") for x in surface.tensors])
    bounds = moved.bounds
    places = (bounds.centers, bounds.radii, bounds.planes, *bounds.boxes, *moved.tensors)
    assert {x.device.type for x in places} == {"meta"}
    assert moved.device.type == "meta"
    assert surface.with_tensors(surface.tensors).bounds is surface.bounds


def test_memory_does_not_grow_with_pairs(plain, monkeypatch):
    """A stack of a few pairs at a time finds the same."""
    surface, (origins, directions) = balls(700), rays(300)
    expected = surface.hits(origins, directions, 5)
    monkeypatch.setattr(reference, "PAIRS_AT_ONCE", 16)
    sizes, split = [], reference._Pairs.split
    monkeypatch.setattr(reference._Pairs, "split", lambda self: [sizes.append(len(p.ray)) or p for p in split(self)])
    found = surface.hits(origins, directions, 5)
    assert torch.equal(found.t, expected.t)
    assert torch.equal(found.piece, expected.piece)
    assert max(sizes) == 16


def test_directions_of_any_length_and_eyes_far_away():
    surface, (origins, directions) = balls(), rays(100)
    hit = surface.hit(origins, directions)
    for scale in (1e-160, 1e160):
        torch.testing.assert_close(surface.hit(origins, scale * directions).t * scale, hit.t, rtol=1e-13, atol=0)
    unit = torch.nn.functional.normalize(directions)
    for far in (1e3, 1e6, 1e9):
        t = surface.hits(origins - far * unit, unit, 80, farthest=True)
        near = surface.hits(origins - 20 * unit, unit, 80, farthest=True)
        apart = (t.t - far - near.t + 20)[near.valid & t.valid].abs().median()
        assert apart < 1e-14 * far


@pytest.mark.parametrize("distance", [3, 30, 300, 3000])
def test_float32_rays_from_far(distance):
    """Recentred, rounding of the rays is all that is left; solved from the eye in float32 a quarter is missed."""
    rng = torch.Generator().manual_seed(3)
    way, off = torch.randn(2, 2000, 3, dtype=F64, generator=rng)
    eye = distance * torch.nn.functional.normalize(way)
    side = torch.nn.functional.normalize(torch.linalg.cross(eye, off))
    direction = torch.nn.functional.normalize(0.9 * side - eye)
    o, d = eye.float(), direction.float()
    exact = every(one(SPHERE, [0, 0, 0], -1.0, 1.01), o.double(), d.double())[:, 0]
    hit = one(SPHERE, [0, 0, 0], -1.0, 1.01).hit(o, d)
    assert hit.t.dtype == torch.float32
    assert torch.equal(hit.valid, exact < torch.inf)
    assert ((hit.t.double() - exact).abs()[hit.valid] <= 2e-6 * distance).all()
    assert int((exact < torch.inf).sum()) > 1500


# --- bounds -----------------------------------------------------------------------------------------------------------


def cube(half: float = 1.0) -> list[list[float]]:
    return [[*(sign * float(a == axis) for a in range(3)), -half] for axis in range(3) for sign in (-1, 1)]


def test_a_polyhedron_cuts_as_its_planes_say():
    flat = Quadrics(
        torch.zeros(1, 3, 3, dtype=F64), numbers([0, 0, 1]), torch.zeros(1).double(), Planes(numbers(cube()))
    )
    x = torch.linspace(-1.5, 1.5, 31, dtype=F64)
    origins = torch.stack((*torch.meshgrid(x, x, indexing="xy"), torch.full((31, 31), 4.0, dtype=F64)), -1)
    valid = flat.hit(origins, numbers([0, 0, -1])[0]).valid
    inside = (origins[..., :2].abs() <= 1).all(-1)
    edge = ((origins[..., :2].abs() - 1).abs() < 1e-9).any(-1)
    assert torch.equal(valid[~edge], inside[~edge])
    assert bool(valid[10:21, 10].all())  # what lies on the edge is kept


def test_tetrahedra_cut_whichever_way_they_go_round():
    corners = torch.randn(20, 4, 3, dtype=F64, generator=torch.Generator().manual_seed(4))
    b = torch.randn(20, 3, dtype=F64, generator=torch.Generator().manual_seed(5))
    c = -2 * (b * corners.mean(1)).sum(-1)  # a plane through the middle
    zero = torch.zeros(20, 3, 3, dtype=F64)
    surface, turned = (Quadrics(zero, b, c, Tetrahedra(p)) for p in (corners, corners[:, [1, 0, 2, 3]]))
    origins, directions = rays(300, side=1.0)
    origins, directions = origins - 0.5, directions
    hits = surface.hits(origins, directions, 20)
    assert torch.equal(hits.valid, turned.hits(origins, directions, 20).valid)
    t = (-(c / 2) - origins @ b.T) / (directions @ b.T)
    point = origins[:, None] + t[..., None] * directions[:, None]
    edges = (corners[:, 1:] - corners[:, :1]).mT
    inner = torch.linalg.solve(edges, (point - corners[:, 0])[..., None])[..., 0]
    margin = torch.minimum(inner.amin(-1), 1 - inner.sum(-1))
    assert margin.abs().min() > 1e-9
    assert torch.equal(hits.valid.sum(-1), ((margin > 0) & (t >= 0)).sum(-1))


def test_tetrahedra_that_share_faces_leave_no_gap():
    """A sphere cut into the tetrahedra of a cube about its middle: rays at edges and faces of the partition all hit."""
    corner = torch.cartesian_prod(*[numbers(-1.0, 1.0)] * 3)
    order = [(0, a, a + b, 7) for a in (1, 2, 4) for b in (1, 2, 4) if a != b]
    tetrahedra = torch.stack([corner[list(own)] for own in order])
    count = len(order)
    middle = numbers([0.3, 0.1, -0.2]) * 100
    bounds = Tetrahedra(tetrahedra + middle)
    c = torch.full((count,), -0.49, dtype=F64)
    surface = Quadrics(
        EYE.expand(count, 3, 3), torch.zeros(count, 3).double(), c, bounds, origins=middle.expand(count, 3)
    )
    ways = torch.cartesian_prod(*[torch.arange(-3, 4, dtype=F64)] * 3)
    ways = ways[ways.any(-1)]
    for o in (middle + 5 * ways, middle + torch.zeros_like(ways)):
        assert bool(surface.hit(o, torch.where(o == middle, ways, -ways)).valid.all())


def test_cuts_take_away_what_is_beyond():
    surface = one(SPHERE, [0, 0, 0], -1.0, 1.1, cuts=numbers([0, 0, 1, 0.0]))
    t = surface.hits(numbers([0.1, 0.2, 4]), numbers([0, 0, -1]), 2).t
    assert t[0, 0].item() == pytest.approx(4 + math.sqrt(0.95))
    assert t[0, 1] == torch.inf
    both = one(SPHERE, [0, 0, 0], -1.0, 1.1, cuts=numbers([[0, 0, 2, 0.0], [3, 0, 0, -0.3]]))
    assert both.hit(numbers([0.2, 0.2, -4]), numbers([0, 0, 1])).valid.tolist() == [False]
    assert both.hit(numbers([0.0, 0.2, -4]), numbers([0, 0, 1])).valid.tolist() == [True]


# --- faces and culling ------------------------------------------------------------------------------------------------


def test_faces():
    origins, direction = numbers([-3, 0, 0], [0, 0, 0]), numbers([1, 0, 0])
    of = {faces: one(SPHERE, [0, 0, 0], -1.0, 1.1, faces=faces).hits(origins, direction, 2).t for faces in FACES}
    assert of["both"].tolist() == [[2, 4], [1, math.inf]]
    assert of["front"].tolist() == [[2, math.inf], [math.inf] * 2]
    assert of["back"].tolist() == [[4, math.inf], [1, math.inf]]


FACES = ("front", "back", "both")


def graphs(bounds: Bounds, seed: int, faces: str) -> Quadrics:
    """A piece of surface in each, turned anyhow, little bent."""
    rng = torch.Generator().manual_seed(seed)
    A = 0.3 * torch.randn(len(bounds), 3, 3, dtype=F64, generator=rng)
    b = torch.randn(len(bounds), 3, dtype=F64, generator=rng)
    c = 0.3 * torch.randn(len(bounds), dtype=F64, generator=rng)
    return Quadrics(A, b, c, bounds, origins=bounds.centers, faces=faces)


@pytest.mark.parametrize("faces", ["front", "back"])
@pytest.mark.parametrize("kind", ["spheres", "tetrahedra"])
def test_culling_loses_nothing_and_most_of_what_faces_away(kind, faces):
    rng = torch.Generator().manual_seed(6)
    centers = 10 * torch.rand(600, 3, dtype=F64, generator=rng)
    corners = centers[:, None] + 0.3 * torch.randn(600, 4, 3, dtype=F64, generator=rng)
    surface = graphs(Spheres(centers, 0.5) if kind == "spheres" else Tetrahedra(corners), 7, faces)
    eye = numbers([3.0, -14.0, 8.0])[0]
    kept = surface.facing(eye)
    aim = surface.bounds.centers.repeat(8, 1) + 0.2 * torch.randn(4800, 3, dtype=F64, generator=rng)
    whole, part = (s.hit(eye, aim - eye) for s in (surface, surface.seen_from(eye)))
    assert torch.equal(whole.t, part.t)
    assert torch.equal(whole.piece, part.piece)
    other = Quadrics(*surface.tensors[:3], surface.bounds, origins=surface.origins, faces="both")
    shown, away = torch.zeros(2, 600, dtype=torch.bool)
    hits, of = (s.hits(eye, aim - eye, 30) for s in (other, surface))
    shown[of.piece[of.valid]] = True
    away[hits.piece[hits.valid]] = True
    away &= ~shown
    assert int(away.sum()) > 100
    assert (~kept[away]).double().mean() > 0.8
    assert bool(kept[shown].all())


def beyond_planes(rng: torch.Generator) -> tuple[culling.Local, culling.Polar]:
    """Quadrics in tetrahedra, each with a plane anywhere."""
    A, b, c, p, value = (torch.randn(300, *shape, dtype=F64, generator=rng) for shape in ((3, 3), (3,), (), (3,), ()))
    corners = torch.randn(300, 4, 3, dtype=F64, generator=rng)
    return culling.Local(A + A.mT, b, 2 * c, corners.norm(dim=-1).amax(1), corners), culling.Polar(p, value)


def values(local: culling.Local, polar: culling.Polar, y: Tensor) -> tuple[Tensor, Tensor]:
    """The least and the largest F at points (M, K, 3) beyond the planes, ∞ and −∞ where there are none."""
    value = (y * (y @ local.A + 2 * local.b[:, None])).sum(-1) + local.c[:, None]
    there = (y @ polar.p[:, :, None])[..., 0] + polar.value[:, None] > 0
    return torch.where(there, value, torch.inf).amin(1), torch.where(there, value, -torch.inf).amax(1)


def test_bounds_in_caps_hold_every_value_there():
    rng = torch.Generator().manual_seed(3)
    local, polar = beyond_planes(rng)
    lowest, highest = culling.in_cap(local, polar)
    y = torch.randn(300, 2000, 3, dtype=F64, generator=rng)
    y *= (local.radii[:, None] * torch.rand(300, 2000, dtype=F64, generator=rng) ** 0.1 / y.norm(dim=-1))[..., None]
    low, high = values(local, polar, y)
    assert bool(((lowest <= low) & (high <= highest)).all())
    wide = low < high
    assert int(wide.sum()) > 200
    assert float(((highest - lowest) / (high - low))[wide].median()) < 2.5


def test_signs_in_hulls_are_those_of_every_value_there():
    rng = torch.Generator().manual_seed(4)
    local, polar = beyond_planes(rng)
    lowest, highest = culling.in_hull(local, polar)
    part = torch.rand(300, 2000, 4, dtype=F64, generator=rng).log()
    assert local.corners is not None
    low, high = values(local, polar, part / part.sum(-1, keepdim=True) @ local.corners)
    assert bool((low > 0)[lowest > 0].all())
    assert bool((high < 0)[highest < 0].all())
    one_sign = ((low > 0) | (high < 0)) & (low < high)
    assert int(one_sign.sum()) > 60
    assert float(((lowest > 0) | (highest < 0))[one_sign].double().mean()) > 0.5


def test_bounds_of_a_saddle_in_half_a_ball():
    A, c, r = torch.diag(numbers([1, -2, 0])[0])[None], numbers(3.0), numbers(2.0)
    local = culling.Local(A, numbers([0, 0, 0.5]), c, r, None)
    ends = culling.in_cap(local, culling.Polar(numbers([0, 0, 1]), numbers([0.0])[0]))
    assert torch.cat(ends).tolist() == pytest.approx([3 - 8, 3 + 4 + 2])


def test_nothing_is_culled_where_both_faces_count():
    surface = balls()
    assert surface.seen_from(numbers([0, 0, 0])[0]) is surface
    inside = balls(faces="front").seen_from(balls().origins[0])
    assert len(inside) == 40


def test_all_may_be_culled():
    surface = one(NONE, [0, 0, 1.0], 0.0, faces="front")
    hit = surface.seen_from(numbers([0, 0, -5])[0]).hit(numbers([0, 0, -5]), numbers([0, 0, 1]))
    assert hit.t.tolist() == [math.inf]
    assert hit.piece.tolist() == [-1]


# --- derivatives ------------------------------------------------------------------------------------------------------


def test_derivatives_in_rays_and_coefficients():
    A = numbers([[1.3, 0.2, 0.1], [0.2, 0.9, -0.1], [0.1, -0.1, -0.7]])
    b, c, place = numbers([0.1, 0.2, 0.3]), torch.tensor([-0.4], dtype=F64), numbers([0.1, 0, 0])
    o, d = numbers([-3, 0.3, 0.1], [9, 9, 9]), numbers([2, -0.1, 0.05], [0, 0, 1])
    bounds = Spheres(numbers([0, 0, 0]), 1.5)

    def t(*given):
        surface = Quadrics(*given[:3], bounds, origins=given[3])
        hits = surface.hits(*given[4:], 3)
        assert hits.valid.sum(-1).tolist() == [2, 0]
        return torch.where(hits.valid, hits.t, 0)

    def shown(*given):
        surface = Quadrics(*given[:3], bounds, origins=given[3])
        at = surface.at(*given[4:], surface.hits(*given[4:], 2), order=2)
        return at.point, at.normal, at.curvatures

    given = [x.clone().requires_grad_() for x in (A, b, c, place, o, d)]
    assert torch.autograd.gradcheck(shown, given)
    assert torch.autograd.gradcheck(t, given)
    assert torch.autograd.gradgradcheck(t, given, fast_mode=True)


def test_a_derivative_reaches_its_own_quadric_alone():
    surface, (origins, directions) = balls(), rays(60)
    c = surface.c.clone().requires_grad_()
    given = Quadrics(surface.A, surface.b, c, surface.bounds, origins=surface.origins)
    hit = given.hit(origins, directions)
    hit.t[hit.valid].sum().backward()
    assert torch.equal(c.grad != 0, torch.zeros(40, dtype=torch.bool).index_fill(0, hit.piece[hit.valid], True))


@pytest.mark.parametrize(
    ("A", "c", "origin", "direction"),
    [
        (CONE, 0.0, [-3.0, 0, 0], [1.0, 0, 0]),
        (SPHERE, -0.25, [-3.0, 0.5, 0], [1.0, 0, 0]),
        (FLAT, 0.0, [0, 0, 2.0], [0, 0, -1.0]),
    ],
    ids=["apex", "tangent", "double plane"],
)
def test_derivatives_are_finite_where_there_are_none(A, c, origin, direction):
    given = [x.requires_grad_() for x in (numbers(*[A]), numbers([0.0, 0, 0]), torch.tensor([c], dtype=F64))]
    ray = [numbers(x).requires_grad_() for x in (origin, direction)]
    surface = Quadrics(*given, Spheres(torch.zeros(1, 3, dtype=F64), 1.0))
    hit = surface.hit(*ray)
    assert hit.valid.tolist() == [True]
    at = surface.at(*ray, hit, order=2)
    (at.point.sum() + at.normal.sum() + at.curvatures.sum() + hit.t.sum()).backward()
    assert all(bool(x.grad.isfinite().all()) for x in (*given, *ray))


def test_numbers_changed_in_place_are_seen():
    surface, (origins, directions) = balls(), rays(50)
    before = surface.hit(origins, directions)
    surface.c.mul_(0.5)
    after = surface.hit(origins, directions)
    assert torch.equal(after.t, balls_again(surface).hit(origins, directions).t)
    assert not torch.equal(after.t, before.t)


def balls_again(surface: Quadrics) -> Quadrics:
    return Quadrics(*surface.tensors[:3], surface.bounds, origins=surface.origins)


# --- images -----------------------------------------------------------------------------------------------------------


def test_an_image_shows_the_nearest():
    surface = balls(faces="front")
    camera = PerspectiveCamera.framing(surface.domain, (0.3, 1.0, -0.4))
    shown = raycast(surface, camera, size=(24, 24), channels=("depth", "normal", "color"), dtype=F64)
    origins, directions = camera.rays(24, 24)
    expected = every(surface, origins.reshape(-1, 3), directions.reshape(-1, 3))[:, 0].reshape(24, 24, 1)
    torch.testing.assert_close(shown["depth"], expected, rtol=1e-12, atol=0)
    assert ((shown["normal"] * directions).sum(-1) <= 0).all()
    assert (shown["color"][..., 3:] == (expected < torch.inf)).all()
    assert 0.1 < float((expected < torch.inf).double().mean()) < 0.9


def test_a_region_cuts_what_is_seen():
    surface = balls()
    camera = PerspectiveCamera.framing(surface.domain, (0.3, 1.0, -0.4))
    region = ((-9.0, -9.0, 3.0), (15.0, 15.0, 15.0))
    shown = raycast(surface, camera, size=(24, 24), channels=("depth", "position"), region=region, dtype=F64)
    seen = shown["depth"][..., 0] < torch.inf
    assert int(seen.sum()) > 20
    assert shown["position"][..., 2][seen].min() > 3 - 1e-9


def test_an_image_shows_every_sheet():
    surface = balls()
    camera = PerspectiveCamera.framing(surface.domain, (0.3, 1.0, -0.4))
    counts = raycast(surface, camera, size=(16, 16), sheets=6, channels=("sheets",))["sheets"]
    o, d = camera.rays(16, 16)
    expected = (every(surface, o.reshape(-1, 3), d.reshape(-1, 3)) < torch.inf).sum(-1).clamp(max=6)
    assert torch.equal(counts.flatten().long(), expected)


# --- bad input --------------------------------------------------------------------------------------------------------

GOOD = {"A": EYE[None], "b": torch.zeros(1, 3).double(), "c": -torch.ones(1).double()}
UNIT = Spheres(torch.zeros(1, 3, dtype=F64), 1.0)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"A": EYE}, r"A must have shape \(1, 3, 3\); got \(3, 3\)"),
        ({"A": EYE[None] * math.nan}, "A must be finite; 9 of its 9 numbers are not"),
        ({"b": torch.zeros(2, 3).double()}, r"b must have shape \(1, 3\); got \(2, 3\)"),
        ({"c": torch.ones(1, dtype=torch.int64)}, "c must be a floating-point torch.Tensor; got torch.int64"),
        ({"A": 0 * EYE[None]}, "A and b must not both be 0"),
        ({"bounds": 1.0}, "bounds must be Spheres, Tetrahedra or Planes; got float"),
        ({"faces": "sides"}, "faces must be one of both, front, back; got 'sides'"),
        ({"cuts": torch.zeros(1, 3).double()}, r"cuts must have shape \(1, …, 4\); got \(1, 1, 3\)"),
        ({"cuts": torch.zeros(1, 4).double()}, "normals of cuts must not be 0; 1 are"),
        ({"origins": torch.zeros(3).double()}, r"origins must have shape \(1, 3\)"),
    ],
)
def test_bad_quadrics_are_refused(changed, message):
    with pytest.raises((TypeError, ValueError), match=message):
        Quadrics(**{**GOOD, "bounds": UNIT, **changed})


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Spheres(torch.zeros(1, 3), 0.0), "radii must be positive; 1 of 1 are not"),
        (lambda: Spheres(torch.zeros(3), 1.0), r"centers must have shape \(…, 3\); got \(3,\)"),
        (lambda: Spheres(torch.full((1, 3), math.inf), 1.0), "centers must be finite"),
        (lambda: Tetrahedra(torch.ones(2, 4, 3)), "must not lie in one plane; 2 of 2 do"),
        (lambda: Planes(numbers(cube())[:, :5]), "must leave something with an end"),
        (lambda: Planes(numbers([*cube()[:4], [1.0, 1, 0, -1]])), "must leave something with an end"),
        (lambda: Planes(numbers(cube(-1.0))), "1 of 1 polyhedra are empty"),
        (lambda: Planes(numbers([*cube(), [0.0, 0, 0, -1]])), "normals of halfspaces must not be 0; 1 are"),
    ],
)
def test_bad_bounds_are_refused(make, message):
    with pytest.raises((TypeError, ValueError), match=message):
        make()


def test_what_needs_one_function_says_so():
    surface = balls(3)
    with pytest.raises(TypeError, match="a mesh is that of one function"):
        mesh(surface)
    with pytest.raises(ValueError, match="expected which one as piece"):
        surface.jet(torch.zeros(1, 3), 0)
