"""Ellipsoids, tubes, cones, paraboloids: what is hit is what their words say, in boxes that cut nothing off."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from filterlab.render import PerspectiveCamera, raycast
from filterlab.surfaces import Bounds, Quadrics

F64 = torch.float64
COUNT = 12


def numbers(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, dtype=F64, generator=torch.Generator().manual_seed(seed))


PLACES, ENDS = 4 * numbers(COUNT, 3), 4 * numbers(COUNT, 3) + numbers(COUNT, 3, seed=1)
RADII = 0.2 + numbers(COUNT, seed=2).abs()
SHAPES = numbers(COUNT, 3, 3, seed=3) + 0.3 * torch.eye(3)

KINDS = {
    "ellipsoids": lambda **more: Quadrics.ellipsoids(PLACES, SHAPES, **more),
    "cylinders": lambda **more: Quadrics.cylinders(PLACES, ENDS, RADII, **more),
    "cones": lambda **more: Quadrics.cones(PLACES, ENDS, RADII, **more),
    "paraboloids": lambda **more: Quadrics.paraboloids(PLACES, ENDS, RADII, **more),
}
OPEN = [name for name in KINDS if name != "ellipsoids"]


def rays(count: int = 400) -> tuple[Tensor, Tensor]:
    origins = 20 * torch.nn.functional.normalize(numbers(count, 3, seed=4), dim=-1)
    own = torch.arange(count) % COUNT
    aim = torch.lerp(
        PLACES[own], ENDS[own], torch.rand(count, 1, dtype=F64, generator=torch.Generator().manual_seed(5))
    )
    return origins, aim + 0.3 * numbers(count, 3, seed=6) - origins


def off(name: str, x: Tensor, piece: Tensor) -> Tensor:
    """By how much points are off the shape that was asked for, by its own words."""
    y = x - PLACES[piece]
    if name == "ellipsoids":
        return torch.linalg.solve(SHAPES[piece], y).norm(dim=-1) - 1
    way = (ENDS - PLACES)[piece]
    part = (y * way).sum(-1) / (way * way).sum(-1)
    assert (part >= -1e-9).all()
    assert (part <= 1 + 1e-9).all()
    across = (y - part[:, None] * way).norm(dim=-1) / RADII[piece]
    return across - {"cylinders": 1, "cones": part, "paraboloids": part.clamp_min(0).sqrt()}[name]


@pytest.mark.parametrize("name", KINDS)
def test_what_is_hit_is_what_was_asked_for(name):
    surface, (origins, directions) = KINDS[name](), rays()
    hits = surface.hits(origins, directions, 2 * COUNT)
    at = surface.at(origins, directions, hits)
    assert int(hits.valid.sum()) > 200
    assert off(name, at.point[hits.valid], hits.piece[hits.valid]).abs().max() < 1e-9


@pytest.mark.parametrize("name", KINDS)
def test_boxes_cut_nothing_off(name):
    surface, (origins, directions) = KINDS[name](), rays()
    own = surface.bounds
    loose = Bounds(own.centers, own.radii, own.planes)
    other = Quadrics(surface.A, surface.b, surface.c, loose, surface.origins)
    assert (own.boxes.upper - own.boxes.lower).prod(1).sum() < (loose.boxes.upper - loose.boxes.lower).prod(1).sum()
    a, b = (s.hits(origins, directions, 2 * COUNT).t for s in (surface, other))
    torch.testing.assert_close(a, b, rtol=1e-12, atol=0)


@pytest.mark.parametrize("name", OPEN)
def test_caps_close_them(name):
    """Lines from outside cross them an even number of times, and the first face is a front."""
    surface, (origins, directions) = KINDS[name](caps=True), rays()
    hits = surface.hits(origins, directions, 4 * COUNT)
    assert (hits.valid.sum(-1) % 2 == 0).all()
    assert int(hits.valid.any(-1).sum()) > 100
    open_ = KINDS[name]().hits(origins, directions, 4 * COUNT)
    assert (open_.valid.sum(-1) % 2 == 1).any()
    front = KINDS[name](caps=True, faces="front").hit(origins, directions)
    assert torch.equal(front.t, hits.t[:, 0])


def test_balls_and_boxes_of_radii():
    ball = Quadrics.ellipsoids(PLACES, RADII)
    axes = Quadrics.ellipsoids(PLACES, RADII[:, None].expand(-1, 3))
    whole = Quadrics.ellipsoids(PLACES, torch.diag_embed(RADII[:, None].expand(-1, 3)))
    o, d = rays()
    assert torch.equal(ball.hit(o, d).t, axes.hit(o, d).t)
    assert torch.equal(ball.hit(o, d).t, whole.hit(o, d).t)
    torch.testing.assert_close(ball.bounds.boxes.upper, PLACES + RADII[:, None])


def test_parts_are_joined_in_order():
    balls, tubes = Quadrics.ellipsoids(PLACES, RADII), Quadrics.cylinders(PLACES, ENDS, RADII / 3)
    both, (o, d) = Quadrics.joined([balls, tubes]), rays()
    hit, of_balls, of_tubes = (s.hit(o, d) for s in (both, balls, tubes))
    torch.testing.assert_close(hit.t, torch.minimum(of_balls.t, of_tubes.t), rtol=1e-12, atol=0)
    first = of_balls.t < of_tubes.t
    assert torch.equal(hit.piece[first], of_balls.piece[first])
    assert torch.equal(hit.piece[~first & hit.valid], of_tubes.piece[~first & hit.valid] + COUNT)
    with pytest.raises(ValueError, match="must show the same faces; got both, front"):
        Quadrics.joined([balls, Quadrics.ellipsoids(PLACES, RADII, faces="front")])


@pytest.mark.parametrize("name", OPEN)
def test_derivatives_in_what_they_are_made_of(name):
    o, d = torch.tensor([[-3.0, 0.4, 0.1]]).double(), torch.tensor([[1.0, -0.1, 0.02]]).double()
    given = [torch.tensor(x).double().requires_grad_() for x in ([[0.1, 0.0, -1.0]], [[0.0, 0.2, 1.0]], [0.7])]

    def shown(*given):
        surface = getattr(Quadrics, name)(*given)
        at = surface.at(o, d, surface.hit(o, d))
        assert at.normal.abs().sum() > 0
        return at.point, at.normal

    assert torch.autograd.gradcheck(shown, given)


def test_derivatives_of_an_ellipsoid():
    o, d = torch.tensor([[-3.0, 0.4, 0.1]]).double(), torch.tensor([[1.0, -0.1, 0.02]]).double()
    given = [torch.zeros(1, 3).double().requires_grad_(), (torch.eye(3) + 0.1 * SHAPES[:1]).requires_grad_()]
    assert torch.autograd.gradcheck(lambda *x: Quadrics.ellipsoids(*x).hit(o, d).t, given)


@pytest.mark.parametrize("name", KINDS)
def test_images(name):
    """Of float32 tensors, as they come: something is seen, and nothing is NaN."""
    surface = KINDS[name]()
    camera = PerspectiveCamera.framing(surface.domain, (0.2, 1, -0.3))
    image = raycast(surface, camera, size=(16, 16), shadows=True)
    assert image.dtype == torch.float32
    assert bool(image.isfinite().all())
    assert 0.02 < float(image[..., 3].mean()) < 1


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Quadrics.ellipsoids(PLACES, -RADII), "semi_axes must be positive; 12 of 12 are not"),
        (lambda: Quadrics.ellipsoids(PLACES, torch.ones(COUNT, 3, 3)), "semi_axes must span space; 12 of 12 do not"),
        (lambda: Quadrics.ellipsoids(PLACES, RADII[:5]), r"semi_axes must have shape \(12\); got \(5,\)"),
        (lambda: Quadrics.ellipsoids(PLACES, torch.tensor(1.0)), r"semi_axes must have shape"),
        (lambda: Quadrics.cylinders(PLACES, PLACES, RADII), "starts and ends must differ; 12 of 12 do not"),
        (lambda: Quadrics.cones(PLACES, ENDS, 0 * RADII), "radii must be positive"),
        (lambda: Quadrics.paraboloids(PLACES, ENDS[:3], RADII), r"bases must have shape \(12, 3\); got \(3, 3\)"),
        (lambda: Quadrics.joined([]), "must show the same faces; got None"),
    ],
)
def test_bad_shapes_are_refused(make, message):
    with pytest.raises((TypeError, ValueError), match=message):
        make()
