"""Images of surfaces: against a ball, whose hits, normals and curvatures are known."""

from __future__ import annotations

import inspect
import math

import pytest
import torch
from torch import Tensor

from filterlab.methods import reconstruct
from filterlab.render import Light, OrthographicCamera, Shading, TransferFunction, raycast
from filterlab.render.image import PixelRays
from filterlab.render.materials import (
    ByCurvature,
    ByField,
    Environment,
    Phong,
    ReflectionLines,
    Seen,
    Toon,
    Triplanar,
)
from filterlab.render.raycast import Options
from filterlab.surfaces import LevelSet
from filterlab.volume import Volume

N, RADIUS, SIZE = 25, 4.0, (15, 13)
CENTER = (N - 1) / 2
F64 = torch.float64


def ball(level: float | Tensor = RADIUS**2) -> LevelSet:
    """f = |x − center|², which the quadratic spline reproduces, but for what the boundary does 8 voxels away."""
    x = torch.arange(N, dtype=F64) - CENTER
    samples = x[:, None, None] ** 2 + x[:, None] ** 2 + x**2
    return LevelSet(reconstruct(Volume(samples), "triquadratic"), level)


def camera() -> OrthographicCamera:
    """Along +y, so that pixels are at x and z; the ball fills most of the image."""
    return OrthographicCamera(position=(CENTER, -30.0, CENTER), target=(CENTER,) * 3, up=(0, 0, 1), height=10.0)


def offsets() -> tuple[Tensor, Tensor]:
    """Of every pixel's ray from the centre: along the image's right (x), and up (z)."""
    origins, _ = camera().rays(*SIZE)
    return origins[..., 0] - CENTER, origins[..., 2] - CENTER


def cast(surface: LevelSet | None = None, material=None, **options):
    return raycast(surface or ball(), camera(), material, **{"size": SIZE, "dtype": F64, **options})


def assert_near(actual: Tensor, expected: Tensor, tolerance: float = 2e-5) -> None:
    torch.testing.assert_close(actual, expected, rtol=0, atol=tolerance)


def test_depth_normal_position_and_sheets_are_those_of_a_ball() -> None:
    found = cast(channels=("depth", "normal", "position", "sheets", "color"), sheets=3)
    x, z = offsets()
    square = RADIUS**2 - x**2 - z**2
    hit = square > 0
    y = -square.clamp_min(0).sqrt()
    assert 20 < hit.sum() < hit.numel() - 20
    assert torch.equal(found["sheets"][..., 0] == 2, hit)
    assert torch.equal(found["color"][..., 3] == 1, hit)
    assert (found["depth"][~hit] == math.inf).all()
    assert not found["normal"][~hit].any()
    assert not found["position"][~hit].any()
    normal = torch.stack((x, y, z), -1) / RADIUS
    assert_near(found["normal"][hit], normal[hit])
    assert_near(found["position"][hit], (normal * RADIUS + CENTER)[hit], 1e-4)
    assert_near(found["depth"][..., 0][hit], (y + CENTER + 30)[hit], 1e-4)


def test_the_colour_is_that_of_the_shading_at_the_hit() -> None:
    lights = (Light((-1.0, -1.0, 2.0), (0.9, 0.8, 0.7)), Light(None, (0.2, 0.3, 0.4)))
    weights = (0.1, 0.6, 0.4, 12.0)
    image = cast(material=Phong((0.9, 0.5, 0.2), *weights), lights=lights, background=(0.1, 0.2, 0.3))
    found = cast(channels=("normal", "depth"))
    hit = found["depth"][..., 0] < math.inf
    direction = torch.tensor([0.0, 1.0, 0.0], dtype=F64).expand(int(hit.sum()), 3)
    color = torch.tensor([0.9, 0.5, 0.2], dtype=F64).expand_as(direction)
    assert_near(image[hit][:, :3], Shading(lights, *weights)(color, found["normal"][hit], direction), 1e-12)
    assert torch.equal(image[~hit], torch.tensor([0.1, 0.2, 0.3, 0.0], dtype=F64).expand_as(image[~hit]))


def test_sheets_are_composited_in_order() -> None:
    """The far side of the ball is seen through the near one, and the background through both."""
    near, both = (cast(material=Phong(opacity=0.4), sheets=k, background=(0.5, 0.5, 0.5)) for k in (1, 2))
    opaque = cast(material=Phong(), background=(0.5, 0.5, 0.5))
    far = torch.flip(opaque, (0, 1))  # by the symmetry of the ball its far side looks like the near one, two-sided
    hit = opaque[..., 3] == 1
    assert_near(near[hit][:, 3], torch.full_like(near[hit][:, 3], 0.4), 1e-12)
    assert_near(both[hit][:, 3], torch.full_like(both[hit][:, 3], 1 - 0.6**2), 1e-12)
    expected = 0.4 * opaque[hit][:, :3] + 0.6 * 0.4 * far[hit][:, :3] + 0.36 * 0.5
    assert_near(both[hit][:, :3], expected, 1e-4)


def test_what_a_region_cuts_away_is_not_hit() -> None:
    """Without its near half a ball shows the inside of the far one."""
    region = ((-1.0, CENTER, -1.0), (30.0, 30.0, 30.0))
    whole, cut = (cast(channels=("depth",), **more)["depth"][..., 0] for more in ({}, {"region": region}))
    hit = whole < math.inf
    assert torch.equal(cut < math.inf, hit)
    assert_near(cut[hit] + whole[hit], torch.full_like(cut[hit], 2 * (CENTER + 30)), 2e-4)


def test_a_convex_body_shadows_what_faces_away_from_the_light() -> None:
    toward = torch.tensor([-2.0, -1.0, 1.5], dtype=F64)
    light = Light(toward.tolist())
    material = Phong((1.0, 1.0, 1.0), 0.2, 0.8, 0.0)
    image = cast(material=material, lights=[light], shadows=True)
    normal = cast(channels=("normal",))["normal"]
    facing = normal @ (toward / toward.norm())
    hit, clear = image[..., 3] == 1, facing.abs() > 0.05
    lit = hit & clear & (facing > 0)
    dark = hit & clear & (facing < 0)
    assert lit.sum() > 20
    assert dark.sum() > 10
    assert_near(image[lit][:, 0], 0.2 + 0.8 * facing[lit], 1e-12)
    assert_near(image[dark][:, 0], torch.full_like(facing[dark], 0.2), 1e-12)


def _in_small_parts(seen: PixelRays, at_once: int) -> list[range]:
    return [range(i, min(i + 17, seen.count)) for i in range(0, seen.count, 17)]


def test_parts_and_subpixels_change_no_bit(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = cast(subpixels=2, seed=4)
    monkeypatch.setattr("filterlab.render.image.PixelRays.parts", _in_small_parts)
    told: list[int] = []
    assert torch.equal(cast(subpixels=2, seed=4, progress=lambda done, total: told.append(done / total)), whole)
    assert told == sorted(told)
    assert told[-1] == 1
    other = cast(subpixels=2, seed=5)
    assert not torch.equal(other, whole)
    edges = (whole[..., 3] > 0) & (whole[..., 3] < 1)
    assert 5 < edges.sum() < 60
    assert torch.equal((4 * whole[..., 3]).round() / 4, whole[..., 3])
    assert abs(float(whole[..., 3].mean()) - math.pi * RADIUS**2 / (10 * 10 * SIZE[0] / SIZE[1])) < 0.02


def test_derivatives_by_level_camera_and_material() -> None:
    """Of the ray through the middle: depth = distance − √level."""
    level = torch.tensor(RADIUS**2, dtype=F64, requires_grad=True)
    depth = cast(ball(level), channels=("depth",))["depth"]
    middle = depth[SIZE[1] // 2, SIZE[0] // 2, 0]
    (slope,) = torch.autograd.grad(middle, level)
    assert float(slope) == pytest.approx(-1 / (2 * RADIUS), rel=1e-4)
    color = torch.tensor([0.5, 0.5, 0.5], dtype=F64, requires_grad=True)
    image = cast(material=Phong(color, 0.3, 0.0, 0.0))
    (slopes,) = torch.autograd.grad(image[..., :3].sum(), color)
    assert_near(slopes, 0.3 * image[..., 3].sum().expand(3), 1e-9)


def test_rays_in_place_of_a_camera() -> None:
    origins, directions = camera().rays(*SIZE)
    rays = (origins[3], 5 * directions[3])
    assert torch.equal(raycast(ball(), rays, dtype=F64), cast()[3])


@pytest.mark.parametrize(
    ("change", "error", "words"),
    [
        ({"surface": 3}, TypeError, "must be a Surface"),
        ({"material": "gold"}, TypeError, "must be a Material"),
        ({"subpixels": 9}, ValueError, "from 1 to 8"),
        ({"channels": ("depth", "colour")}, ValueError, "some of color, depth"),
        ({"channels": ()}, ValueError, "some of color, depth"),
        ({"channels": ("depth",), "subpixels": 2}, ValueError, "no mean"),
        ({"dtype": torch.float16}, ValueError, "float32 or"),
        ({"sheets": 0}, ValueError, "sheets must be"),
        ({"sheets": 10**6}, ValueError, "sheets must be"),
        ({"size": None}, ValueError, r"size=\(width, height\)"),
        ({"background": (1, 2)}, ValueError, "three finite numbers"),
        ({"region": ((0, 0, 0), (0, 1, 1))}, ValueError, "lower < upper"),
        ({"camera": "front"}, TypeError, "must be a Camera"),
    ],
)
def test_mistakes_are_named(change: dict, error: type[Exception], words: str) -> None:
    given = {"surface": ball(), "camera": camera(), "material": None, "size": SIZE, **change}
    with pytest.raises(error, match=words):
        raycast(given.pop("surface"), given.pop("camera"), given.pop("material"), **given)


# --- materials --------------------------------------------------------------------------------------------------------


def on_a_ball(count: int = 400) -> Seen:
    """Random points of a unit ball, seen along +y, each from its own side."""
    normal = torch.nn.functional.normalize(torch.randn(count, 3, dtype=F64), dim=-1)
    normal[:, 1] = -normal[:, 1].abs()
    return Seen(normal, normal, torch.tensor([0.0, 1.0, 0.0], dtype=F64).expand(count, 3))


def test_reflected_rays_keep_their_angle() -> None:
    seen = on_a_ball()
    along = (seen.direction * seen.normal).sum(-1)
    assert_near((seen.reflected * seen.normal).sum(-1), -along, 1e-12)
    assert_near(seen.reflected.norm(dim=-1), torch.ones(len(along), dtype=F64), 1e-12)


def test_reflection_lines_are_as_many_as_were_asked() -> None:
    """Once around their axis, of mirrors that turn: a normal at half the angle of what it reflects."""
    angle = torch.linspace(0, math.pi, 4001, dtype=F64)[:-1]  # of the normal
    normal = torch.stack((angle.cos(), angle.sin(), torch.zeros_like(angle)), -1)
    direction = torch.tensor([0.0, 1.0, 0.0], dtype=F64).expand_as(normal)
    bright = ReflectionLines(count=5)(Seen(normal, normal, direction), ())[:, 0] > 0.5
    assert int((bright != bright.roll(1)).sum()) == 2 * 5


def test_a_mirror_shows_what_is_around() -> None:
    picture = torch.rand(6, 8, 3, dtype=F64)
    seen = on_a_ball()
    mirror = Environment(picture, reflectivity=1.0)
    assert_near(mirror(seen, ()), mirror.around(seen.reflected), 1e-12)
    up, east = (torch.tensor([v], dtype=F64) for v in ([0.0, 0.0, 1.0], [-1.0, -1e-12, 0.0]))
    assert_near(mirror.around(up), (picture[0, 3] + picture[0, 4])[None] / 2, 1e-9)
    assert_near(mirror.around(east), picture[2:4, [0, -1]].mean((0, 1))[None], 1e-6)
    sky = Environment()(seen, ())
    assert sky.isfinite().all()
    assert (sky >= 0).all()


def test_toons_have_bands_and_contours_of_a_width() -> None:
    """On a ball of radius 1 a contour of width T is where |n·v| < √(T (2 − T))."""
    seen = on_a_ball()
    flat = Toon((1.0, 1.0, 1.0), bands=3, ambient=0.0)(seen, (Light(),))
    assert set((3 * flat).unique().round(decimals=9).tolist()) <= {1.0, 2.0, 3.0}
    curved = seen._replace(curvatures=torch.ones(400, 2, dtype=F64), principal=_tangents(seen.normal))
    toon = Toon((1.0, 1.0, 1.0), contour=0.1, ink=(0.0, 0.0, 0.0))
    inked = ~toon(curved, (Light(),)).any(-1)
    facing = (seen.normal * seen.direction).sum(-1).abs()
    assert torch.equal(inked, facing < math.sqrt(0.1 * 1.9))
    assert 0 < inked.sum() < 400
    assert (toon.order, Toon().order) == (2, 1)


def _tangents(normal: Tensor) -> Tensor:
    first = torch.nn.functional.normalize(torch.linalg.cross(normal, normal.roll(1, -1) + 0.1), dim=-1)
    return torch.stack((first, torch.linalg.cross(normal, first)), -2)


def test_colours_by_field_curvature_and_texture() -> None:
    seen = on_a_ball()
    table = TransferFunction([-1.0, 1.0], [[0.0, 0.0, 1.0], [1.0, 0.0, 0.0]], [1.0, 1.0])
    field = reconstruct(torch.rand(5, 5, 5, dtype=F64), "trilinear")
    assert_near(ByField(field, table)(seen)[:, 0], (field(seen.point) + 1) / 2, 1e-12)
    curved = seen._replace(curvatures=torch.tensor([[0.5, -0.7]], dtype=F64).expand(400, 2))
    for kind, value in (("mean", -0.1), ("gaussian", -0.35), ("largest", 0.7)):
        assert float(ByCurvature(table, kind)(curved)[0, 0]) == pytest.approx((value + 1) / 2)
    assert Phong(ByCurvature(table)).order == 2
    plain = torch.full((3, 4, 3), 0.25, dtype=F64)
    assert_near(Triplanar(plain)(seen), torch.full((400, 3), 0.25, dtype=F64), 1e-12)
    tile = torch.rand(4, 4, 3, dtype=F64)
    moved = seen._replace(point=seen.point + 2 * 0.7)
    assert_near(Triplanar(tile, 0.7)(moved), Triplanar(tile, 0.7)(seen), 1e-9)


def test_curvature_of_the_ball_colours_its_image() -> None:
    """Values grow outwards: −(−1/r) by the convention that a ball of greater values than around it has −1/r."""
    table = TransferFunction([-1.0, 1.0], [[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]], [1.0, 1.0])
    image = cast(material=Phong(ByCurvature(table), 1.0, 0.0, 0.0))
    hit = image[..., 3] == 1
    expected = torch.full_like(image[hit][:, 0], (1 / RADIUS + 1) / 2)
    assert_near(image[hit][:, 0], expected, 1e-3)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: Phong(opacity=1.5), "opacity must be"),
        (lambda: Phong(shininess=0.5), "shininess must be"),
        (lambda: ReflectionLines(axis=(0, 0, 0)), "axis must be"),
        (lambda: Environment(torch.zeros(3, 3)), "picture must be"),
        (lambda: Environment(reflectivity=2.0), "reflectivity"),
        (lambda: Toon(bands=0), "bands"),
        (lambda: Toon(contour=-1.0), "contour"),
        (lambda: Triplanar(torch.zeros(2, 2, 4)), "texture must be"),
        (lambda: Triplanar(torch.zeros(2, 2, 3), 0.0), "size must be"),
        (lambda: ByCurvature(TransferFunction([0.0], [[1, 1, 1]], [1.0]), "shape"), "mean, gaussian, largest"),
    ],
)
def test_materials_that_cannot_be_are_refused(make, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        make()


def test_type_checkers_know_every_keyword():
    own = {"surface", "camera", "material", "channels"}
    assert own | set(Options.__annotations__) == set(inspect.signature(raycast).parameters)
