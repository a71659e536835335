"""Edges of images: where they are found, how they move, and that images' derivatives then are those of their means."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

import filterlab as fl
from experiments.config import Recipe
from experiments.silhouettes import Depth, Scene, between, chance, mean_and_error, normal, welch
from filterlab.render import Light, OrthographicCamera, PerspectiveCamera, Phong, Silhouettes, raycast, silhouettes
from filterlab.render.image import PixelRays, check_background
from filterlab.render.raycast import Casting
from filterlab.surfaces import BilinearQuads, LevelSet, Quadrics, Slim, Spheres, Surface

F64 = torch.float64
N, RADIUS, SIZE = 16, 3.0, (14, 12)
CENTER = (N - 1) / 2


def squares() -> Tensor:
    """|x|² from the middle of N³ voxels."""
    x = torch.arange(N, dtype=F64) - CENTER
    return x[:, None, None] ** 2 + x[:, None] ** 2 + x**2


def ball(level: Tensor | float = RADIUS**2) -> LevelSet:
    """|x|² ≤ level, which the quadratic spline reproduces, but for what the boundary does voxels away."""
    return LevelSet(fl.reconstruct(fl.Volume(squares()), "triquadratic"), level)


def camera(**changes) -> OrthographicCamera:
    """Along +y: pixels are at x and z."""
    given = {"position": (CENTER, -30.0, CENTER), "target": (CENTER,) * 3, "height": 9.0, **changes}
    return OrthographicCamera(up=(0, 0, 1), **given)


def cast(surface: Surface, lines: int = 1, seen=None, **options) -> Tensor:
    how = Silhouettes(lines) if lines else None
    return raycast(surface, seen or camera(), size=SIZE, dtype=F64, silhouettes=how, **options)


def bumps(method: str, amount: Tensor, level: Tensor) -> LevelSet:
    """A ball of noise, changed by a known pattern."""
    noise = torch.rand(10, 10, 10, generator=torch.Generator().manual_seed(1), dtype=F64)
    x = torch.arange(10, dtype=F64) - 4.5
    samples = 1.2 * noise - (x[:, None, None] ** 2 + x[:, None] ** 2 + x**2) / 10
    pattern = torch.cos(torch.arange(1000, dtype=F64)).reshape(10, 10, 10)
    return LevelSet(fl.reconstruct(fl.Volume(samples + amount * pattern), method), level)


REGION = ((0.0, 3.3, 0.0), (7.0, 30.0, 30.0))


def eye(method: str, amount: Tensor, level: Tensor, position: Tensor) -> silhouettes.Eye:
    view = PerspectiveCamera(position=position, target=(4.5, 4.5, 4.5), field_of_view=28.0)
    seen = PixelRays.of(view, (7, 7), torch.device("cpu"))
    background = check_background((0, 0, 0), torch.device("cpu"))
    casting = Casting(bumps(method, amount, level), Phong(), (Light(),), background, REGION, 1, False, F64)
    return casting.eye(seen, ("color",))


@pytest.mark.parametrize("method", ["trilinear", "ncrsi", "triquadratic", "tricubic"])
def test_edges_move_as_their_derivative_says(method):
    """On folds, smooth and on creases between cells, and on faces: by the places where they are found again."""
    given = [torch.tensor(x, dtype=F64, requires_grad=True) for x in (0.0, -1.0, [4.0, -18.0, 6.0])]
    own = eye(method, *given)
    with torch.no_grad():
        lines = silhouettes._Lines.drawn(torch.arange(49), 1, 0)
        edges = silhouettes._found(own, lines, 2)
    assert 3 < int(edges.fold.sum()) < len(edges.low) - 2
    weights, across, down = silhouettes._slopes(own, edges)
    values = silhouettes._values(own, own.surface, edges, edges.lines.place(edges.rich), edges.t)
    slope = torch.where(edges.lines.across, across, down)
    m = (weights * values).sum(-1)
    step, along = 1e-5, (1.0, 1.0, torch.tensor([0.3, 0.5, -0.4], dtype=F64))
    for k, direction in enumerate(along):
        rows = [torch.autograd.grad(x, given[k], retain_graph=True)[0] for x in m]
        motion = -step * torch.stack([(row * direction).sum() for row in rows]) / slope
        moved = [x.detach() + (step * direction if n == k else 0) for n, x in enumerate(given)]
        other = eye(method, *moved)
        near, wide = (there_again(other, edges, motion, tolerance) for tolerance in (1e-3, 0.05))
        assert float(near.double().mean()) > 0.9
        assert wide.all()


@pytest.mark.parametrize("volume", ["quadrics", "cover"])
@pytest.mark.parametrize("parameter", ["level", "sample", "camera"])
def test_edges_of_pieces_move_as_their_derivative_says(volume, parameter):
    """Where rays touch a piece, and where one ends at its ball or plane."""
    scene = Scene(Recipe.model_validate("triquadratic"), volume, parameter, "mask")

    def at(theta: Tensor) -> silhouettes.Eye:
        return seen_by(scene.surface(theta), scene.camera(theta), size=(9, 9))

    theta, step = torch.zeros((), dtype=F64, requires_grad=True), 1e-5
    own = at(theta)
    with torch.no_grad():
        edges = silhouettes._found(own, silhouettes._Lines.drawn(torch.arange(81), 3, 0), 3)
    assert int(edges.fold.sum()) > 3
    assert int((edges.bound >= 0).sum()) > 2
    assert not (edges.fold & (edges.bound >= 0)).any()
    weights, across, down = silhouettes._slopes(own, edges)
    m = (weights * silhouettes._values(own, own.surface, edges, edges.lines.place(edges.rich), edges.t)).sum(-1)
    rows = torch.stack([torch.autograd.grad(x, theta, retain_graph=True)[0] for x in m])
    motion = -step * rows / torch.where(edges.lines.across, across, down)
    assert int((motion.abs() > 1e-8).sum()) > 2
    near, wide = (there_again(at(theta.detach() + step), edges, motion, x) for x in (1e-3, 0.05))
    assert float(near.double().mean()) > 0.9
    assert wide.all()


def there_again(own: silhouettes.Eye, edges, motion: Tensor, tolerance: float) -> Tensor:
    """Whether (Q,) numbers of hits change where edges should have moved to, give or take this part of the motion."""
    slack = tolerance * (motion.abs() + 1e-7) + 2e-9
    low, high = (number_of_hits(own, edges.lines, edges.rich + motion + sign * slack) for sign in (-1, 1))
    return low != high


def number_of_hits(own: silhouettes.Eye, lines, x: Tensor) -> Tensor:
    return (own.sheets(lines, x) < torch.inf).sum(-1)


def line_across(*values: float):
    """Lines across pixel 0, at these v."""
    zero = torch.zeros(len(values), dtype=torch.int64)
    return silhouettes._Lines(zero, zero, torch.ones(len(values), dtype=torch.bool), torch.tensor(values, dtype=F64))


def seen_by(surface: Surface, view, region=None, size: tuple[int, int] = (1, 1), sheets: int = 1) -> silhouettes.Eye:
    """One pixel, or some."""
    background = check_background((0, 0, 0), torch.device("cpu"))
    casting = Casting(surface, Phong(), (), background, region, sheets, False, F64)
    return casting.eye(PixelRays.of(view, size, torch.device("cpu")), ("color",))


def test_lines_go_evenly_both_ways():
    """Also an odd number of them; two of one way are never in the same half."""
    lines = silhouettes._Lines.drawn(torch.arange(40000), 3, 0)
    assert float(lines.across.double().mean()) == pytest.approx(0.5, abs=0.01)
    for way in (lines.across, ~lines.across):
        counts = torch.histc(lines.beside[way], 4, 0, 1)
        assert (counts / counts.mean()).tolist() == pytest.approx([1.0] * 4, abs=0.03)
    first, _, third = lines.beside.view(3, -1)
    assert (first < 0.5).all()
    assert (third >= 0.5).all()


def test_several_edges_of_one_part_are_found():
    """A ball without its front, from its middle to beside it: 1 hit, 2 where the front is whole, none."""
    region = ((-9.0, CENTER - 1.5, -9.0), (30.0, 30.0, 30.0))
    own = seen_by(ball(), camera(window=(0.5, 0.25, 1.0, 0.75)), region)
    edges = silhouettes._found(own, line_across(0.5), 1)
    assert edges.fold.tolist() == [False, True]
    expected = [math.sqrt(RADIUS**2 - 1.5**2) / 4.5, RADIUS / 4.5]
    assert edges.low.tolist() == pytest.approx(expected, abs=1e-3)


def test_an_edge_that_gives_what_another_takes_is_found():
    """From a ball in front of the other to that one alone, beside it or partly behind it: 2 hits at either end.

    What is behind has an edge that is seen through what is transparent only.
    """
    x = torch.arange(N, dtype=F64) - CENTER
    for apart, sheets, count in ((2.2, 1, 2), (2.2, 2, 2), (1.8, 1, 1), (1.8, 2, 2)):
        balls = [
            (x[:, None, None]) ** 2 + (x[:, None] - side * 2.8) ** 2 + (x - side * apart) ** 2 - 4.0 for side in (-1, 1)
        ]
        both = LevelSet(fl.reconstruct(fl.Volume(torch.minimum(*balls)), "tricubic"), 0.0)
        own = seen_by(both, camera(height=4.4), sheets=sheets)
        lines, ends = line_across(0.5), torch.tensor([[0.0], [1.0]], dtype=F64)
        assert [number_of_hits(own, lines, x).tolist() for x in ends] == [[2], [2]]
        edges = silhouettes._found(own, lines, 1)
        assert edges.fold.tolist() == [True] * count
        if count == 2:
            assert float(edges.low.diff()) == pytest.approx(abs(2 * apart - 4) / 4.4, abs=0.03)


def test_area_and_place_of_a_ball():
    """Coverage is π level / the image's area; a camera that moves aside changes it nowhere, but where it covers."""
    level = torch.tensor(RADIUS**2, dtype=F64, requires_grad=True)
    aside = torch.zeros((), dtype=F64, requires_grad=True)
    shift = aside * torch.tensor([1.0, 0.0, 0.0], dtype=F64)
    place, target = (torch.tensor(p, dtype=F64) + shift for p in ((CENTER, -30.0, CENTER), (CENTER,) * 3))
    mask = cast(ball(level), 16, camera(position=place, target=target))[..., 3]
    area = 9.0 * 9.0 * SIZE[0] / SIZE[1]
    grown, moved = torch.autograd.grad(mask.mean() * area, (level, aside), retain_graph=True)
    assert float(grown) == pytest.approx(math.pi, rel=0.04)
    assert abs(float(moved)) < 1.5  # what is gained on the right, 6, is lost on the left
    right = mask[:, SIZE[0] // 2 :].mean() * area / 2
    (gone,) = torch.autograd.grad(right, aside)
    assert abs(float(gone)) == pytest.approx(2 * RADIUS, rel=0.1)  # the diameter leaves to the left


def area_of(surface: Surface) -> Tensor:
    return cast(surface, 16)[..., 3].mean() * 9.0 * 9.0 * SIZE[0] / SIZE[1]


@pytest.mark.parametrize("faces", ["front", "back", "both"])
def test_area_of_a_quadric(faces):
    """Whichever sides are seen a ball covers π r²."""
    radius = torch.tensor([RADIUS], dtype=F64, requires_grad=True)
    ball = Quadrics.ellipsoids(torch.full((1, 3), CENTER, dtype=F64), radius, faces=faces)
    (grown,) = torch.autograd.grad(area_of(ball), radius)
    assert float(grown) == pytest.approx(2 * math.pi * RADIUS, rel=0.04)


def test_area_of_what_ends():
    """A disc that its ball ends: π r² cos; a ball, of which a plane leaves a part: its circle's arc moves."""
    middle, tilt = torch.full((1, 3), CENTER, dtype=F64), 0.7
    radius = torch.tensor([RADIUS], dtype=F64, requires_grad=True)
    normal = torch.tensor([[0.0, -math.cos(tilt), math.sin(tilt)]], dtype=F64)
    disc = Slim(middle, radius, torch.zeros(1, 3, 3, dtype=F64), normal / 2, torch.zeros(1, dtype=F64))
    (grown,) = torch.autograd.grad(area_of(disc), radius)
    assert float(grown) == pytest.approx(2 * math.pi * RADIUS * math.cos(tilt), rel=0.04)
    ball = Quadrics.ellipsoids(middle, radius)
    cut = torch.tensor([[1.0, 0, 0, -CENTER - RADIUS / 2]], dtype=F64)
    bounds = Spheres(middle, 2 * RADIUS)
    (grown,) = torch.autograd.grad(area_of(Quadrics(ball.A, ball.b, ball.c, bounds, ball.origins, cuts=cut)), radius)
    assert float(grown) == pytest.approx(2 * RADIUS * (math.pi - math.acos(0.5)), rel=0.04)


@pytest.mark.parametrize("cut", [0.5, 2.5])
def test_depth_of_a_ball_without_its_front(cut):
    """y over a background of the middle's y, so that the outline, where y is that, has no part in it.

    Of what is cut off c before the middle the back is seen inside a circle of a² = R² − c², and around it the front:
    2π (R³ − 2c³) / 3 in all. By R² that gives πR: π (R − 2c) since what is seen moves, 2πc since the circle grows.
    """
    level = torch.tensor(RADIUS**2, dtype=F64, requires_grad=True)
    scene = {"material": Depth(), "background": (CENTER + 20,) * 3, "region": ((-9.0, CENTER - cut, -9.0), (30.0,) * 3)}
    images = [cast(ball(level), lines, subpixels=8, **scene) for lines in (8, 0)]
    means = [image[..., 0].mean() * 9.0 * 9.0 * SIZE[0] / SIZE[1] for image in images]
    whole, inside = (float(torch.autograd.grad(mean, level)[0]) for mean in means)
    assert inside == pytest.approx(math.pi * (RADIUS - 2 * cut), abs=1.0)  # 1 / √ of how far the outline is: noisy
    assert whole - inside == pytest.approx(2 * math.pi * cut, rel=0.08)


@pytest.mark.parametrize(
    ("volume", "parameter", "quantity"),
    [
        ("bumps", "level", "depth"),
        ("cut", "camera", "shaded"),
        ("quadrics", "sample", "mask"),
        ("cover", "level", "mask"),
    ],
)
def test_derivatives_are_those_of_means(volume, parameter, quantity):
    """Against differences of integrals along rows, of which nothing is shared with how edges are found."""
    scene = Scene(Recipe.model_validate("triquadratic"), volume, parameter, quantity)
    mean, error = mean_and_error([scene.estimated(12, 2, Silhouettes(2, 4), seed) for seed in range(4)])
    truth, doubt = mean_and_error(scene.differences(12, 4, 0))
    bound = 4.5 * math.hypot(error, doubt)
    assert abs(mean - truth) < bound
    assert abs(scene.estimated(12, 2, None, 0) - truth) > 0.3 * abs(truth)  # without edges it is another number


def test_how_likely_differences_are():
    """Student's t by its table, Welch's degrees at their ends, and χ² of two by its closed form."""
    assert welch((1.0, 8), (1.0, 8)) == pytest.approx(14)
    assert welch((1.0, 8), (0.0, 3)) == pytest.approx(7)
    assert normal(-2.262157, 9) == pytest.approx(-1.959964, abs=1e-5)
    total, chances = chance([{"z": 1.2}, {"z": -0.9}])
    assert (total, chances) == (pytest.approx(2.25), pytest.approx(math.exp(-2.25 / 2)))


def test_the_rule_between_jumps_bears_square_roots():
    u, weight = between(torch.tensor([0.2], dtype=F64), torch.tensor([0.7], dtype=F64))
    for f, expected in ((torch.ones_like(u), 0.5), ((u - 0.2).sqrt(), 0.5**1.5 * 2 / 3), (u**3, (0.7**4 - 0.2**4) / 4)):
        assert float((weight * f).sum()) == pytest.approx(expected, rel=1e-12)


def test_the_image_is_the_same_and_nothing_is_recorded_in_vain():
    level = torch.tensor(RADIUS**2, dtype=F64, requires_grad=True)
    channels = ("color", "depth", "normal", "position", "sheets")
    plain, edged = (cast(ball(level), lines, channels=channels) for lines in (0, 1))
    assert all(torch.equal(plain[name], edged[name]) for name in channels)
    assert not cast(ball(), 1).requires_grad
    with torch.no_grad():
        assert not cast(ball(level), 1).requires_grad


def test_channels_jump_by_what_is_seen():
    """A normal by itself, as nothing has 0; a depth not, as nothing has none."""
    level = torch.tensor(RADIUS**2, dtype=F64, requires_grad=True)
    seen = cast(ball(level), 8, channels=("depth", "normal", "sheets"), sheets=2)
    count, interior = (cast(ball(level), lines, channels=("sheets",), sheets=2)["sheets"] for lines in (8, 0))
    assert not interior.requires_grad
    (grown,) = torch.autograd.grad(count.mean() * 81 * SIZE[0] / SIZE[1], level)
    assert float(grown) == pytest.approx(2 * math.pi, rel=0.05)
    depth = seen["depth"][seen["depth"].isfinite()].sum()
    alone = cast(ball(level), 0, channels=("depth",))["depth"]
    (a,), (b,) = (torch.autograd.grad(x, level, retain_graph=True) for x in (depth, alone[alone.isfinite()].sum()))
    assert float(a) == pytest.approx(float(b), rel=1e-9)
    outward = (seen["normal"] * torch.linspace(-1, 1, SIZE[0], dtype=F64)[:, None])[..., 0].sum()
    still = cast(ball(level), 0, channels=("normal",))["normal"]
    inward = (still * torch.linspace(-1, 1, SIZE[0], dtype=F64)[:, None])[..., 0].sum()
    (turned,), (alone,) = (torch.autograd.grad(x, level, retain_graph=True) for x in (outward, inward))
    assert float(turned) > 0 > float(alone)  # hits turn towards the eye when the ball grows, but there are more of them


def test_edges_hidden_behind_what_is_opaque_do_not_count():
    """A ball in front of another one that ends behind it: its mask moves with the first alone."""
    x = torch.arange(N, dtype=F64) - CENTER
    near = x[:, None, None] ** 2 + (x[:, None] + 2.5) ** 2 + x**2 - 2.5**2
    far = 1.5 * (x[:, None, None] ** 2 + (x[:, None] - 2.5) ** 2 + x**2) - 1.5 * 1.5**2
    amount = torch.zeros((), dtype=F64, requires_grad=True)
    field = fl.reconstruct(
        fl.Volume(torch.minimum(near, far + amount * (x[:, None] > 0))), "triquadratic", prefilter=False
    )
    mask = cast(LevelSet(field, 0.0), 4)[..., 3]
    (slope,) = torch.autograd.grad(mask.sum(), amount)
    assert float(slope) == 0


def test_images_of_float32_have_edges_too():
    """Once both sides of one were the same ray, rounded, and nothing jumped."""
    level = torch.tensor(RADIUS**2, dtype=F64, requires_grad=True)
    slopes = []
    for dtype in (torch.float32, F64):
        image = raycast(ball(level), camera(), size=SIZE, dtype=dtype, silhouettes=Silhouettes(1))
        assert image.dtype == dtype
        slopes.append(float(torch.autograd.grad(image[..., 3].sum(), level)[0]))
    assert slopes[0] == pytest.approx(slopes[1], rel=1e-5)
    assert slopes[1] > 0


def test_seeds_and_parts_of_the_work(monkeypatch):
    """A derivative depends on the seed, and on nothing that divides the work."""

    def slope(seed: int) -> float:
        level = torch.tensor(RADIUS**2, dtype=F64, requires_grad=True)
        return float(torch.autograd.grad(cast(ball(level), 2, seed=seed)[..., 3].sum(), level)[0])

    whole = slope(3)
    assert slope(4) != whole
    monkeypatch.setattr(
        PixelRays, "parts", lambda s, _: [range(i, min(i + 59, s.count)) for i in range(0, s.count, 59)]
    )
    assert slope(3) == pytest.approx(whole, rel=1e-12)


def test_nothing_to_see_has_no_edges():
    level = torch.tensor(-1.0, dtype=F64, requires_grad=True)
    image = cast(ball(level), 1)
    assert not image.any()
    assert float(torch.autograd.grad(image.sum(), level)[0]) == 0


@pytest.mark.parametrize("given", [{"lines": 0}, {"parts": 65}, {"lines": 1.0}, {"parts": True}])
def test_numbers_that_cannot_be_are_refused(given):
    with pytest.raises(ValueError, match="of silhouettes must be an integer from 1 to 64"):
        Silhouettes(**given)


def test_what_has_no_edges_is_refused():
    with pytest.raises(TypeError, match="must be Silhouettes"):
        raycast(ball(), camera(), size=SIZE, silhouettes=2)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="go with a camera"):
        raycast(ball(), camera().rays(*SIZE), silhouettes=Silhouettes())
    corners = torch.tensor([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 1]])
    quads = BilinearQuads(corners, torch.tensor([[0, 1, 2, 3]]))
    with pytest.raises(TypeError, match="need a surface that tells where its pieces end; got BilinearQuads"):
        raycast(quads, camera(), size=SIZE, silhouettes=Silhouettes())
