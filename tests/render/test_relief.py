"""Colours of the ground, sky, haze and water, on planes and a dome whose hits are closed forms."""

import math

import numpy as np
import pytest
import torch

from filterlab.fields.base import Domain
from filterlab.io.images import to_srgb
from filterlab.render import (
    ByAspect,
    ByHeight,
    ByNormal,
    BySlope,
    ColorScale,
    Draped,
    Environment,
    Haze,
    Hillshade,
    Lambertian,
    Light,
    OrthographicCamera,
    Sky,
    Unlit,
    Water,
    raycast,
    sun,
)
from filterlab.render.colormaps import encoded_entries
from filterlab.render.materials import Seen
from filterlab.render.relief import aspect, slope
from filterlab.render.scenery import toward
from filterlab.surfaces import Hits, Surface

F64 = torch.float64


class Slope(Surface):
    """z = a x + b y + c over a rectangle: F = z − a x − b y − c."""

    max_order = 2

    def __init__(self, a, b, c, half=10.0, z=(-30.0, 30.0)):
        self.plane = torch.tensor([-a, -b, 1.0], dtype=F64)
        self.c = c
        self.domain = Domain((-half, -half, z[0]), (half, half, z[1]))

    def jet(self, points, order, piece=None):
        n = self.plane.to(points)
        rows = ((points * n).sum(-1) - self.c, n.expand_as(points), points.new_zeros(*points.shape, 3))
        return rows[: order + 1]

    @property
    def detached(self):
        return self

    def _first(self, origins, directions):
        n = self.plane.to(origins)
        t = (self.c - (origins * n).sum(-1)) / (directions * n).sum(-1)
        x, y, _ = (origins + t[..., None] * directions).unbind(-1)
        half = self.domain.upper[0]
        return Hits(torch.where((t >= 0) & (x.abs() <= half) & (y.abs() <= half), t, torch.inf))

    def _sheets(self, origins, directions, sheets, farthest):
        first = self._first(origins, directions).t
        return Hits(torch.stack([first] + [torch.full_like(first, torch.inf)] * (sheets - 1), -1))


def normal_of(a, b):
    n = torch.tensor([[-a, -b, 1.0]], dtype=F64)
    return n / n.norm()


def seen(normal, point=(0.0, 0.0, 0.0), direction=(0.0, 0.0, -1.0)):
    rows = (torch.as_tensor(x, dtype=F64).reshape(-1, 3) for x in (point, normal, direction))
    return Seen(*rows)


def ray(origin, direction):
    o, d = (torch.tensor([x], dtype=F64) for x in (origin, direction))
    return o, d / d.norm()


# --- slope, aspect, hillshade -----------------------------------------------------------------------------------------


@pytest.mark.parametrize("sign", [1, -1])
@pytest.mark.parametrize("azimuth", range(0, 360, 30))
def test_slope_and_aspect_of_planes(azimuth, sign):
    """A plane that falls by tan 35° towards an azimuth; either of its normals."""
    steep = math.tan(math.radians(35))
    a, b = -steep * math.sin(math.radians(azimuth)), -steep * math.cos(math.radians(azimuth))
    n = sign * normal_of(a, b)
    assert slope(n).item() == pytest.approx(35)
    assert math.cos(math.radians(aspect(n).item() - azimuth)) == pytest.approx(1)


def test_flat_ground_faces_nowhere():
    n = torch.tensor([[0.0, 0.0, 1.0]], dtype=F64, requires_grad=True)
    assert slope(n).item() == 0
    assert aspect(n).item() == 0
    (by_normal,) = torch.autograd.grad(slope(n).sum() + aspect(n).sum(), n)
    assert by_normal.isfinite().all()
    assert ByAspect()(seen(n.detach())).tolist() == [[0.4] * 3]


def test_hillshade_as_gis_computes_it():
    """255 (cos Z cos S + sin Z sin S cos(A − a)), Z the zenith angle, S slope, A azimuth of light, a aspect."""
    generator = np.random.default_rng(3)
    for a, b in generator.normal(0, 1, (20, 2)):
        n = normal_of(a, b)
        s, facing = math.radians(slope(n).item()), math.radians(aspect(n).item())
        for azimuth, altitude in ((315, 45), (80, 20)):
            zenith = math.radians(90 - altitude)
            shade = math.cos(zenith) * math.cos(s) + math.sin(zenith) * math.sin(s) * math.cos(
                math.radians(azimuth) - facing
            )
            digits = 255 * to_srgb(Hillshade(azimuth, altitude)(seen(n)))
            assert digits[0].tolist() == pytest.approx([255 * max(shade, 0)] * 3, abs=0.01)


def test_exaggeration_leaves_the_slope_of_the_ground():
    flat, high = normal_of(0.3, -0.4), normal_of(0.3 * 5, -0.4 * 5)
    for coloring in (BySlope, ByNormal, Hillshade, ByAspect):
        assert torch.allclose(coloring(exaggeration=5)(seen(high)), coloring()(seen(flat)))
        if coloring is not ByAspect:
            assert not torch.allclose(coloring()(seen(high)), coloring()(seen(flat)))


def test_tints():
    tints = ByHeight.between(100, 300, exaggeration=2)
    ends = to_srgb(tints(seen(normal_of(0, 0).expand(3, 3), [[0, 0, 200], [0, 0, 600], [0, 0, 900]], [[0, 0, -1]] * 3)))
    entries = encoded_entries("hypsometric")
    assert torch.allclose(ends, entries[[0, -1, -1]])
    light = (entries * torch.tensor([0.2126, 0.7152, 0.0722])).sum(-1)
    assert light[-1] == pytest.approx(1)
    with pytest.raises(ValueError, match="known colormaps: hypsometric, those of matplotlib"):
        ByHeight.between(0, 1, "hypso")


def test_a_drape_lies_with_its_first_row_in_the_north():
    picture = torch.zeros(2, 2, 3)
    picture[0, 0, 0], picture[0, 1, 1], picture[1, 0, 2] = 1, 1, 1  # red NW, green NE, blue SW
    drape = Draped(picture, (10, 20, 30, 40), outside=(0.5, 0.5, 0.5))
    points = [[11, 39, 0], [29, 39, 0], [11, 21, 0], [29, 21, 0], [31, 30, 0], [20, 30, 0]]
    found = drape(seen(normal_of(0, 0).expand(6, 3), points, [[0, 0, -1]] * 6))
    expected = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0], [0.5] * 3, [0.25, 0.25, 0.25]]
    assert torch.allclose(found, torch.tensor(expected, dtype=F64))
    with pytest.raises(ValueError, match="left < right"):
        Draped(picture, (1, 0, 0, 1))


def test_lambertian_ground_has_a_dark_back():
    n, material = normal_of(1.0, 0.0), Lambertian((1.0, 1.0, 1.0), skylight=(0, 0, 0))  # rises to the east, faces west
    west, east = (material(seen(n), [sun(azimuth, 30)]) for azimuth in (270, 90))
    assert west[0, 0].item() == pytest.approx(math.sin(math.radians(75)))
    assert east.abs().max() == 0
    sky = Lambertian((1.0, 0.5, 0.25), skylight=(0.2, 0.4, 0.8))(seen(n), [])
    assert torch.allclose(sky, torch.tensor([[0.2, 0.2, 0.2]], dtype=F64) * (1 + math.cos(math.radians(45))) / 2)


def test_a_place_in_the_sky():
    assert toward(90, 0) == pytest.approx((1, 0, 0), abs=1e-15)
    assert toward(0, 30) == pytest.approx((0, math.cos(math.pi / 6), 0.5), abs=1e-15)
    with pytest.raises(ValueError, match="altitude from −90° to 90°"):
        sun(0, 91)


# --- sky, haze, water -------------------------------------------------------------------------------------------------


def test_a_sky_is_behind_what_is_not_hit():
    rays = ray((0, -50, 5), (0, 1, 0.3))
    image = raycast(Slope(0, 0, 0), rays, background=Sky(), dtype=F64)
    assert torch.allclose(image[0, :3], Sky()(rays[1])[0])
    picture = torch.rand(4, 8, 3)
    around = Environment(picture).around
    assert torch.allclose(raycast(Slope(0, 0, 0), rays, background=around, dtype=F64)[0, :3], around(rays[1])[0])


def test_haze():
    surface, rays = Slope(0, 0, 0), ray((0, -30, 30), (0, 1, -1))
    haze = Haze(20.0, (0.1, 0.5, 0.9))
    for sheets in (1, 2):
        image = raycast(surface, rays, Unlit((1.0, 0.0, 0.5)), haze=haze, sheets=sheets, dtype=F64)
        left = math.exp(-30 * math.sqrt(2) / 20)
        expected = [0.1 + left * 0.9, 0.5 - left * 0.5, 0.9 - left * 0.4]
        assert image[0, :3].tolist() == pytest.approx(expected)
    assert raycast(surface, ray((0, -30, 30), (0, -1, 0)), haze=haze, dtype=F64)[0, :3].tolist() == [0, 0, 0]
    with pytest.raises(ValueError, match="a positive world distance"):
        Haze(0)


def test_water_mirrors_the_sky_and_shows_the_ground():
    """Ground at −3 under water at 0: a way √2 · 3 through it at 45°, where 0.02 + 0.98 (1 − √½)⁵ is mirrored."""
    surface, sky = Slope(0, 0, -3.0), Sky()
    rays, water = ray((0, -20, 20), (0, 1, -1)), Water(0.0, (0.1, 0.2, 0.3), clarity=6.0)
    image = raycast(surface, rays, Unlit((1.0, 1.0, 1.0)), background=sky, water=water, dtype=F64)
    share, left = 0.02 + 0.98 * (1 - math.sqrt(0.5)) ** 5, math.exp(-3 * math.sqrt(2) / 6)
    mirrored = sky(rays[1] * torch.tensor([1, 1, -1]))[0]
    own = torch.tensor([0.1, 0.2, 0.3], dtype=F64)
    assert torch.allclose(image[0, :3], share * mirrored + (1 - share) * (own + left * (1 - own)))
    assert image[0, 3] == 1
    deep = raycast(Slope(0, 0, -3.0, z=(-30, -29)), rays, background=sky, water=water, dtype=F64)
    assert torch.allclose(deep[0, :3], share * mirrored + (1 - share) * own)  # of no ground, its own colour


def test_water_mirrors_the_ground():
    """A wall that rises to the north, seen over water: the mirrored ray is one from the point below."""
    surface, water = Slope(0.0, 1.5, 0.0), Water(1e-9, clarity=1e-6)
    tints = Unlit(ByHeight(ColorScale(0, 15, "viridis")))
    origin, direction = (0.0, -15.0, 3.0), (0.0, 1.0, -0.3)
    image = raycast(surface, ray(origin, direction), tints, background=Sky(), water=water, dtype=F64)
    face = (0.0, -15 + 3 / 0.3, 0.0)
    other = raycast(surface, ray(face, (0.0, 1.0, 0.3)), tints, background=Sky(), dtype=F64)
    share = 0.02 + 0.98 * (1 - 0.3 / math.hypot(1, 0.3)) ** 5
    assert torch.allclose(image[0, :3], share * other[0, :3] + (1 - share) * torch.tensor(water.color, dtype=F64))
    assert other[0, :3].sum() > 0.2


def test_dry_land_and_beyond_the_shore():
    surface, water = Slope(0, 0, 1.0), Water(0.0)
    for rays in (ray((0, -20, 20), (0, 1, -1)), ray((0, 30, 5), (0, 1, -1))):  # above the water; outside the domain
        given = {"background": (0.3, 0.2, 0.1), "dtype": F64}
        assert torch.equal(raycast(surface, rays, water=water, **given), raycast(surface, rays, **given))
    with pytest.raises(ValueError, match="water and block go with one sheet"):
        raycast(surface, rays, water=water, sheets=2)
    with pytest.raises(ValueError, match="a finite level and a positive clarity"):
        Water(math.nan)


def test_shadows_and_lights():
    """Several lights add up; a shadow is that of the sun alone."""
    surface = Slope(0, 0, 0)
    camera = OrthographicCamera(position=(0, 0, 20), target=(0, 0, 0), up=(0, 1, 0), height=4)
    lights = [sun(315, 30, (1.0, 0.9, 0.8)), Light((0, 0, 1), (0.1, 0.1, 0.2))]
    image = raycast(
        surface, camera, Lambertian((1, 1, 1), (0, 0, 0)), size=(3, 3), lights=lights, shadows=True, dtype=F64
    )
    assert torch.allclose(image[..., :3], torch.tensor([0.6, 0.55, 0.6], dtype=F64))


def test_derivatives_go_through_water_haze_and_tints():
    sky, water, haze = Sky(), Water(0.0, clarity=4.0), Haze(40.0)
    color = torch.tensor([0.4, 0.5, 0.6], dtype=F64, requires_grad=True)
    rays = ray((0, -20, 20), (0, 1, -1))

    def image(c):
        return raycast(Slope(0, 0.1, -3.0), rays, Lambertian(c), background=sky, water=water, haze=haze, dtype=F64)

    assert torch.autograd.gradcheck(image, (color,))
