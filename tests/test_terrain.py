"""Terrains as pictures: what is suggested, drapes, water, flights, and the command."""

import math
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from filterlab.cli import main
from filterlab.heights import Heights, metres_per_degree
from filterlab.io import load_image, save_heights
from filterlab.io.config import ConfigError
from filterlab.scenes.flight import Flight
from filterlab.scenes.terrain import Terrain, TerrainScene, scene_of

SMALL = {"size": (24, 16), "subpixels": 1}


def hills(rows=13, columns=16, high=300.0, step=90.0) -> Heights:
    """A ridge from south-west to north-east on a slope, rows from the north; 300 m within 1.4 km."""
    y, x = np.mgrid[0:rows, 0:columns] / (rows - 1)
    z = 1000 + high * (np.exp(-20 * (x + y - 1) ** 2) + 0.2 * x)
    return Heights(z.astype(np.float32), (step, -step), (627190.0, 4852070.0), "metre", "metre", "EPSG:32718")


def terrain(heights=None, **asked) -> Terrain:
    return Terrain.of(TerrainScene(**(SMALL | asked)), heights or hills())


@pytest.fixture
def dem(tmp_path) -> Path:
    save_heights(hills(), tmp_path / "dem.npz")
    return tmp_path / "dem.npz"


# --- what is suggested ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("aspect", [(30, 20), (20, 30)])
@pytest.mark.parametrize("view", [(20.0, 33.0), (200.0, 60.0), (-90.0, 10.0)])
def test_the_whole_map_is_in_view(view, aspect):
    own = terrain(view=view, size=aspect)
    position, target = (torch.tensor([float(c) for c in v]).double() for v in (own.camera.position, own.camera.target))
    forward = (target - position) / (target - position).norm()
    assert math.degrees(math.atan2(forward[0], forward[1])) % 360 == pytest.approx(view[0] % 360, abs=1e-4)
    assert math.degrees(-math.asin(forward[2])) == pytest.approx(view[1], abs=1e-4)
    right = torch.linalg.cross(forward, torch.tensor([0.0, 0, 1]).double())
    right = right / right.norm()
    up = torch.linalg.cross(right, forward)
    half = math.tan(math.radians(own.scene.field_of_view / 2))
    left, bottom, east, top = own.heights.extent
    corners = torch.tensor([(x, y) for x in (left, east) for y in (bottom, top)]).double()
    ground = own.surface.jet(corners, 0)[0]
    for z in (ground, torch.full_like(ground, own.base)):
        seen = torch.cat((corners, z[:, None]), 1) - position
        depth = (seen * forward).sum(-1)
        across, high = ((seen * v).sum(-1) / depth / half for v in (right, up))
        assert across.abs().max() <= aspect[0] / aspect[1]
        assert high.abs().max() <= 1


@pytest.mark.parametrize(("high", "expected"), [(300.0, 1.0), (20.0, 4.0), (1e-3, 20.0), (0.0, 1.0)])
def test_exaggeration_follows_the_relief(high, expected):
    """20 m within 1.35 km: 8 % of 1.35 km are 4.5 times as high as what is left of 24 m without ½ % at either end."""
    assert terrain(hills(high=high)).exaggeration == expected


def test_exaggeration_is_the_view_s_own():
    own = terrain(exaggeration=3.0)
    assert own.surface.jet(torch.zeros(1, 2), 0)[0] == pytest.approx(
        3 * terrain(exaggeration=1.0).surface.jet(torch.zeros(1, 2), 0)[0]
    )
    assert own.span == terrain().span
    assert own.coloring.exaggeration == 3.0


def test_degrees_become_metres_about_the_middle():
    z = hills(high=3000.0).samples
    own = terrain(Heights(z, (1 / 1200, -1 / 1200), (-84.4, 36.7), "degree"))
    across, along = metres_per_degree(36.7 - 6 / 1200)
    assert own.heights.spacing == pytest.approx((across / 1200, -along / 1200))
    assert own.heights.extent == pytest.approx(
        (-7.5 * across / 1200, -6 * along / 1200, 7.5 * across / 1200, 6 * along / 1200)
    )
    guessed = terrain(Heights(z, (1 / 1200, -1 / 1200), (-84.4, 36.7)))
    assert guessed.heights.spacing == own.heights.spacing
    with pytest.raises(ValueError, match="the unit that the file declares, metre; got degree"):
        terrain(unit="degree")
    with pytest.raises(ValueError, match="a height somewhere"):
        terrain(Heights(np.full((3, 3), np.nan, np.float32)))


# --- pictures ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "asked", [{}, {"color": "slope"}, {"color": "aspect"}, {"color": "normal"}, {"color": "tomato"}]
)
def test_pictures_have_the_ground_and_what_is_behind_it(asked):
    image = terrain(**asked).render()
    assert image.shape == (16, 24, 3)
    assert image.isfinite().all()
    behind = image[0, 0]
    assert (image - behind).abs().sum(-1).gt(0.02).float().mean() > 0.2


def test_a_map_from_above_lies_with_north_at_the_top():
    """Heights that rise to the north, tinted: bright rows above; to the east: bright columns at the right."""
    rows, columns = np.mgrid[0:12, 0:12].astype(np.float32)
    for samples, ends in ((-rows, ((4, 8), (12, 8))), (columns, ((8, 12), (8, 4)))):
        own = terrain(
            Heights(samples, (1.0, -1.0)), view=(0.0, 89.0), size=(16, 16), color="gray", block=False, exaggeration=0.01
        )
        image = own.render().sum(-1)
        assert image[ends[0]] > 1.5 * image[ends[1]]


def test_walls_and_water_of_the_block():
    camera = terrain().camera
    plain, walled = (terrain(block=block, color="#ffffff").render(camera=camera) for block in (False, True))
    wet = terrain(water=1200.0, color="#ffffff").render(camera=camera)
    assert (plain - walled).abs().sum(-1).gt(0.02).any()
    assert (wet - walled).abs().sum(-1).gt(0.02).float().mean() > 0.1
    brown = walled[(plain - walled).abs().sum(-1) > 0.02]
    assert (brown[:, 0] > brown[:, 2]).float().mean() > 0.9  # earth


def test_holes_are_seen_through_and_filled():
    heights = hills()
    heights.samples[4:8, 5:10] = np.nan
    holed, filled = (terrain(heights, fill=fill, block=False, view=(0.0, 80.0)).render() for fill in (False, True))
    assert (holed - filled).abs().sum(-1).gt(0.05).float().mean() > 0.02


def test_drapes(tmp_path):
    """Red west, green east: over the whole map as PNG and JPEG; as a GeoTIFF over its eastern half only."""
    import rasterio

    picture = np.zeros((8, 8, 3), np.uint8)
    picture[:, :4, 0] = picture[:, 4:, 1] = 255
    asked = {"view": (0.0, 89.0), "size": (16, 16), "block": False, "exaggeration": 0.01}
    for name in ("a.png", "a.jpg"):
        Image.fromarray(picture).save(tmp_path / name, quality=95)
        image = terrain(drape=tmp_path / name, **asked).render()
        assert image[8, 4, 0] > 4 * image[8, 4, 1]
        assert image[8, 12, 1] > 4 * image[8, 12, 0]
    heights = hills()
    left, bottom, right, top = heights.extent
    middle = (left + right) / 2
    affine = rasterio.Affine((right - middle) / 8, 0, middle, 0, (bottom - top) / 8, top)
    profile = {"driver": "GTiff", "width": 8, "height": 8, "count": 3, "dtype": "uint8", "transform": affine}
    for crs in ("EPSG:32718", "EPSG:4326"):
        with rasterio.open(tmp_path / f"{crs[5:]}.tif", "w", crs=crs, **profile) as file:
            file.write(np.moveaxis(picture, -1, 0))
    image = terrain(drape=tmp_path / "32718.tif", **asked).render()
    assert image[8, 4].max() < 1.3 * image[8, 4].min()  # grey beyond it
    assert image[8, 9, 0] > 4 * image[8, 9, 1]
    assert image[8, 12, 1] > 4 * image[8, 12, 0]
    with pytest.raises(ValueError, match="the reference system of the heights, EPSG:32718; got EPSG:4326"):
        terrain(drape=tmp_path / "4326.tif", **asked).render()


# --- flights ----------------------------------------------------------------------------------------------------------


def test_a_flight_keeps_its_height_and_looks_ahead():
    heights = hills()
    left, bottom, right, top = heights.extent
    points = [
        (left + f * (right - left), bottom + g * (top - bottom), 100.0) for f, g in ((0.1, 0.2), (0.5, 0.5), (0.9, 0.3))
    ]
    own = terrain(heights, exaggeration=2.0)
    cameras = Flight(points=points, pitch=10).cameras(own, 9)
    ends = [own.surface.jet(torch.tensor([cameras[k].position[:2]]), 0)[0].item() for k in (0, -1)]
    for k, z in zip((0, -1), ends, strict=True):
        assert cameras[k].position[2] == pytest.approx(z + 200, abs=0.01)
    for camera in cameras:
        above = camera.position[2] - own.surface.jet(torch.tensor([camera.position[:2]]), 0)[0].item()
        assert above >= 49.9
        sight = np.subtract(camera.target, camera.position)
        assert sight[0] > 0
        assert math.degrees(math.atan2(-sight[2], math.hypot(*sight[:2]))) == pytest.approx(10)
    steps = np.diff([c.position[0] for c in cameras])
    assert steps.max() < 1.3 * steps.min()
    closed = Flight(points=points, closed=True).cameras(own, 6)
    assert len({c.position for c in closed}) == 6
    with pytest.raises(ValueError, match="above known ground; got 0, 0"):
        Flight(points=[points[0], (0.0, 0.0, 10.0)]).cameras(own, 2)
    with pytest.raises(ValueError, match="the same twice in a row"):
        Flight(points=[points[0], points[0]])


def test_a_flight_goes_over_what_is_in_its_way():
    """From one side of the ridge to the other, straight through it but for the quarter of 20 m that is kept."""
    heights = hills()
    left, bottom, right, top = heights.extent
    ends = [(left + f * (right - left), bottom + (1 - f) * (top - bottom), 20.0) for f in (0.2, 0.8)]
    own = terrain(heights)
    places = torch.tensor([camera.position for camera in Flight(points=ends).cameras(own, 15)], dtype=torch.float64)
    above = places[:, 2] - own.surface.jet(places[:, :2], 0)[0]
    assert above.min() == pytest.approx(5.0)


def test_a_turn_keeps_its_distance():
    cameras = terrain().around(5)
    lengths = [math.dist([float(v) for v in c.position], [float(v) for v in c.target]) for c in cameras]
    assert max(lengths) == pytest.approx(min(lengths))
    bearings = [math.atan2(float(c.position[0] - c.target[0]), float(c.position[1] - c.target[1])) for c in cameras]
    assert len({round(b, 3) for b in bearings}) == 5


# --- the command ------------------------------------------------------------------------------------------------------


def run(*words) -> int:
    return main(["terrain", *map(str, words)])


def test_a_file_alone_is_a_picture(dem, capsys):
    out = dem.with_name("view.png")
    assert run(dem, "-o", out, "--size", 30, 20) == 0
    assert load_image(out).shape == (20, 30, 3)
    assert f"wrote {out}: 30 × 20 pixels, 8-bit RGB, 1 times as high as it is" in capsys.readouterr().err
    other = dem.with_name("other.jpg")
    assert run(dem, "-o", other, "--size", 30, 20, "--legend", "--quiet") == 0
    assert load_image(other).shape[1] > 30
    assert capsys.readouterr().err == ""


def test_the_same_seed_is_the_same_picture(dem):
    names = [dem.with_name(f"{k}.png") for k in range(3)]
    for name, seed in zip(names, (1, 1, 2), strict=True):
        assert run(dem, "-o", name, "--size", 16, 12, "--seed", seed, "-q") == 0
    first, same, other = (name.read_bytes() for name in names)
    assert first == same != other


def test_flights_and_turns(dem, tmp_path):
    left, bottom, right, top = hills().extent
    x, y = (left + right) / 2, (bottom + top) / 2
    (tmp_path / "flight.yaml").write_text(f"points: [[{left + 100}, {y}, 90], [{x}, {y}, 90]]\n")
    small = ("--size", 12, 8, "--subpixels", 1, "-q")
    assert run(dem, "-o", tmp_path / "folder", "--frames", 3, "--path", tmp_path / "flight.yaml", *small) == 0
    assert sorted(p.name for p in (tmp_path / "folder").iterdir()) == ["000.png", "001.png", "002.png"]
    assert run(dem, "-o", tmp_path / "turn.gif", "--frames", 3, *small) == 0
    with Image.open(tmp_path / "turn.gif") as film:
        assert (film.n_frames, film.size) == (3, (12, 8))


def test_explain(dem, capsys):
    assert run(dem, "--explain", "--frames", 7) == 0
    out = capsys.readouterr().out
    for told in (
        "16 × 13",
        "90 × 90 m",
        "1.35 × 1.08 km",
        "c1, 5 × 4 cells",
        "as the relief suggests",
        "2.3 million",
        "7",
    ):
        assert told in out


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        ([], 2, "either -o FILE.png or --explain"),
        (["-o", "a.png", "--path", "f.yaml"], 2, "--frames N with --path"),
        (["-o", "a.png", "--frames", "1"], 2, "at least 2 pictures; got 1"),
        (["-o", "a.bmp"], 1, "ends in .png or .jpg"),
        (["-o", "a.png", "--spline", "c3"], 1, "unknown spline 'c3'; did you mean 'c2'?"),
        (["-o", "a.png", "--color", "virids"], 1, "did you mean 'viridis'?"),
        (["-o", "a.png", "--sun", "0", "91"], 1, "--sun: sun[1]: expected less than or equal to 90; got 91"),
        (["-o", "a.png", "--range", "2", "1"], 1, "expected the lower end first; got 2 and 1"),
        (["-o", "a.png", "--drape", "none.png"], 1, "none.png"),
        (["-o", "a.png", "--band", "2"], 1, "no band: npz has one"),
    ],
)
def test_refusals(dem, tmp_path, monkeypatch, capsys, words, code, told):
    monkeypatch.chdir(tmp_path)
    assert run(dem, *words) == code
    assert told in capsys.readouterr().err
    assert not (tmp_path / "a.png").exists()


def test_options_are_checked():
    with pytest.raises(ConfigError, match="--color: color: unknown colormap 'no'"):
        scene_of({"color": "no"})
    assert scene_of({"sun": (10.0, 20.0), "drape": Path("a.png"), "water": None}).sun == (10.0, 20.0)
