"""Terrains as pictures: what is suggested, drapes, water, flights, and the command."""

import math
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from filterlab.cli import main
from filterlab.cli.terrain import _KEYS
from filterlab.cli.terrain import Terrain as Command
from filterlab.heights import Heights, metres_per_degree
from filterlab.io import load_image, save_heights
from filterlab.io.config import ConfigError, dump_config
from filterlab.render import Lambertian, Phong
from filterlab.scenes.build import build, load_scene, picture, terrain_scene
from filterlab.scenes.flight import Flight
from filterlab.scenes.model import Scene, TerrainLook, TerrainModel
from filterlab.scenes.plan import plan
from filterlab.scenes.plan_report import table
from filterlab.scenes.terrain import VIEW, PreparedTerrain, Terrain
from filterlab.scenes.turntable import turntable

ANY = "matplotlib:mpl-data/sample_data/jacksboro_fault_dem.npz"  # a file of heights that there is


def hills(rows=13, columns=16, high=300.0, step=90.0) -> Heights:
    """A ridge from south-west to north-east on a slope, rows from the north; 300 m within 1.4 km."""
    y, x = np.mgrid[0:rows, 0:columns] / (rows - 1)
    z = 1000 + high * (np.exp(-20 * (x + y - 1) ** 2) + 0.2 * x)
    return Heights(z.astype(np.float32), (step, -step), (627190.0, 4852070.0), "metre", "metre", "EPSG:32718")


def terrain(heights=None, **asked) -> Terrain:
    return Terrain.of(TerrainLook(**asked), heights or hills())


def shown(heights=None, view=(20.0, 33.0), size=(24, 16), **asked) -> PreparedTerrain:
    """A picture of heights, one ray a pixel."""
    model = TerrainModel(heights=ANY, **({"subpixels": 1} | asked))
    scene = Scene(terrain=model, size=size, camera=VIEW.model_copy(update={"compass": view}))
    return PreparedTerrain.of(scene, Terrain.of(model, heights or hills()))


@pytest.fixture
def dem(tmp_path) -> Path:
    save_heights(hills(), tmp_path / "dem.npz")
    return tmp_path / "dem.npz"


# --- what is suggested ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("aspect", [(30, 20), (20, 30)])
@pytest.mark.parametrize("view", [(20.0, 33.0), (200.0, 60.0), (-90.0, 10.0)])
def test_the_whole_map_is_in_view(view, aspect):
    prepared = shown(view=view, size=aspect)
    own, camera = prepared.terrain, prepared.camera
    position, target = (torch.tensor([float(c) for c in v]).double() for v in (camera.position, camera.target))
    forward = (target - position) / (target - position).norm()
    assert math.degrees(math.atan2(forward[0], forward[1])) % 360 == pytest.approx(view[0] % 360, abs=1e-4)
    assert math.degrees(-math.asin(forward[2])) == pytest.approx(view[1], abs=1e-4)
    right = torch.linalg.cross(forward, torch.tensor([0.0, 0, 1]).double())
    right = right / right.norm()
    up = torch.linalg.cross(right, forward)
    half = math.tan(math.radians(camera.field_of_view / 2))
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
    image = picture(shown(**asked))
    assert image.shape == (16, 24, 3)
    assert image.isfinite().all()
    behind = image[0, 0]
    assert (image - behind).abs().sum(-1).gt(0.02).float().mean() > 0.2


def test_a_map_from_above_lies_with_north_at_the_top():
    """Heights that rise to the north, tinted: bright rows above; to the east: bright columns at the right."""
    rows, columns = np.mgrid[0:12, 0:12].astype(np.float32)
    for samples, ends in ((-rows, ((4, 8), (12, 8))), (columns, ((8, 12), (8, 4)))):
        flat = {"color": "gray", "block": False, "exaggeration": 0.01}
        image = picture(shown(Heights(samples, (1.0, -1.0)), (0.0, 90.0), (16, 16), **flat)).sum(-1)
        assert image[ends[0]] > 1.5 * image[ends[1]]


def test_walls_and_water_of_the_block():
    camera = shown().camera
    asked = ({"block": False}, {}, {"water": 1200.0})
    plain, walled, wet = (picture(replace(shown(color="#ffffff", **a), camera=camera)) for a in asked)
    assert (plain - walled).abs().sum(-1).gt(0.02).any()
    assert (wet - walled).abs().sum(-1).gt(0.02).float().mean() > 0.1
    brown = walled[(plain - walled).abs().sum(-1) > 0.02]
    assert (brown[:, 0] > brown[:, 2]).float().mean() > 0.9  # earth


def test_holes_are_seen_through_and_filled():
    heights = hills()
    heights.samples[4:8, 5:10] = np.nan
    holed, filled = (picture(shown(heights, (0.0, 80.0), fill=fill, block=False)) for fill in (False, True))
    assert (holed - filled).abs().sum(-1).gt(0.05).float().mean() > 0.02


def test_drapes(tmp_path):
    """Red west, green east: over the whole map as PNG and JPEG; as a GeoTIFF over its eastern half only."""
    import rasterio

    drape = np.zeros((8, 8, 3), np.uint8)
    drape[:, :4, 0] = drape[:, 4:, 1] = 255
    asked = {"view": (0.0, 89.0), "size": (16, 16), "block": False, "exaggeration": 0.01}
    for name in ("a.png", "a.jpg"):
        Image.fromarray(drape).save(tmp_path / name, quality=95)
        image = picture(shown(drape=str(tmp_path / name), **asked))
        assert image[8, 4, 0] > 4 * image[8, 4, 1]
        assert image[8, 12, 1] > 4 * image[8, 12, 0]
    heights = hills()
    left, bottom, right, top = heights.extent
    middle = (left + right) / 2
    affine = rasterio.Affine((right - middle) / 8, 0, middle, 0, (bottom - top) / 8, top)
    profile = {"driver": "GTiff", "width": 8, "height": 8, "count": 3, "dtype": "uint8", "transform": affine}
    for crs in ("EPSG:32718", "EPSG:4326"):
        with rasterio.open(tmp_path / f"{crs[5:]}.tif", "w", crs=crs, **profile) as file:
            file.write(np.moveaxis(drape, -1, 0))
    image = picture(shown(drape=str(tmp_path / "32718.tif"), **asked))
    assert image[8, 4].max() < 1.3 * image[8, 4].min()  # grey beyond it
    assert image[8, 9, 0] > 4 * image[8, 9, 1]
    assert image[8, 12, 1] > 4 * image[8, 12, 0]
    with pytest.raises(ValueError, match="the reference system of the heights, EPSG:32718; got EPSG:4326"):
        shown(drape=str(tmp_path / "4326.tif"), **asked)


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
    cameras = [view.camera for view in turntable(shown(), 5)]
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
    assert run(dem, "--explain", "--frames", 7, "--size", 96, 60) == 0
    out = capsys.readouterr().out
    for told in (
        *("16 × 13", "90 × 90 m", "1.35 × 1.08 km", "c1, 5 × 4 cells", "as the relief suggests", "23,040"),
        *("memory", "bounds of them", "metre, but for", "to cast", "7 such pictures"),
    ):
        assert told in out


@pytest.mark.parametrize(
    ("words", "code", "told"),
    [
        ([], 2, "either -o FILE.png or --explain"),
        (["-o", "a.png", "--path", "f.yaml"], 2, "--frames N with --path"),
        (["-o", "a.png", "--frames", "1"], 2, "at least 2 pictures of a turn or a flight; got 1"),
        (["-o", "a.bmp"], 1, "ends in .png or .jpg"),
        (["-o", "a.png", "--spline", "c3"], 1, "unknown spline 'c3'; did you mean 'c2'?"),
        (["-o", "a.png", "--color", "virids"], 1, "did you mean 'viridis'?"),
        (["-o", "a.png", "--sun", "0", "91"], 1, "--sun: sun[1]: expected less than or equal to 90; got 91"),
        (["-o", "a.png", "--range", "2", "1"], 1, "--range: range: expected the lower end first; got 2 and 1"),
        (["-o", "a.png", "--view", "0", "99"], 1, "--view: expected less than or equal to 90; got 99"),
        (["-o", "a.png", "--material", "mat"], 1, "--material: material: unknown name 'mat'; did you mean 'matt'?"),
        (["-o", "a.png", "--drape", "dem.npz", "--color", "slope"], 1, "expected either a drape or a color; got both"),
        (
            ["-o", "a.png", "--legend", "--color", "normal"],
            1,
            "legend: the colours of this terrain stand for no values",
        ),
        (["-o", "a.png", "--write-scene", "s.yaml"], 2, "expected --write-scene without -o"),
        (["--write-scene", "s.txt"], 2, "ends in .yaml"),
        (["-o", "a.png", "--drape", "none.png"], 1, "none.png"),
        (["-o", "a.png", "--band", "2"], 1, "no band: npz has one"),
    ],
)
def test_refusals(dem, tmp_path, monkeypatch, capsys, words, code, told):
    monkeypatch.chdir(tmp_path)
    assert run(dem, *words) == code
    assert told in capsys.readouterr().err
    assert not (tmp_path / "a.png").exists()


# --- scenes -----------------------------------------------------------------------------------------------------------

LAKE = ("--water", 1100, "--sun", 280, 20, "--haze", 4000, "--legend", "--seed", 5, "--size", 20, 14)


def test_the_scene_of_a_command_makes_its_picture_bit_by_bit(dem, tmp_path):
    assert run(dem, "-o", tmp_path / "a.png", *LAKE, "-q") == 0
    assert run(dem, "--write-scene", tmp_path / "s.yaml", *LAKE, "-q") == 0
    assert main(["render", str(tmp_path / "s.yaml"), "-o", str(tmp_path / "b.png"), "-q"]) == 0
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    written = load_scene(tmp_path / "s.yaml")
    (tmp_path / "full.yaml").write_text(dump_config(written))
    assert torch.equal(picture(build(load_scene(tmp_path / "full.yaml"))), picture(build(written)))


def test_options_that_are_left_out_are_those_of_scenes():
    """The command and scene files have one set of defaults."""
    own = {f.name: f.default for f in fields(Command)}
    sky = own.pop("sky")
    assert sky is None
    assert TerrainModel.model_fields["sky"].default == "clear"
    assert own["material"] == TerrainModel.model_fields["material"].default.kind
    for name in set(own) & set(TerrainModel.model_fields) - {"material"} - set(_KEYS):
        assert own[name] == TerrainModel.model_fields[name].default, name
    assert own["view"] == VIEW.compass
    assert own["size"] == terrain_scene(ANY).size


def test_heights_alone_are_shown_as_the_command_does(dem, tmp_path, capsys):
    assert run(dem, "-o", tmp_path / "a.png", "--size", 20, 14, "-q") == 0
    assert main(["render", str(dem), "-o", str(tmp_path / "b.png"), "--size", "20", "14", "-q"]) == 0
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert main(["scene", str(dem), "--terrain.water", "1100"]) == 0
    assert f"heights: {dem}" in (told := capsys.readouterr().out)
    assert "water: 1100" in told


@pytest.mark.parametrize("asked", [["--level", "3"], ["--mip"], ["--frame", "1"]])
def test_heights_have_no_level_and_are_no_volume(dem, tmp_path, capsys, asked):
    assert main(["render", str(dem), "-o", str(tmp_path / "b.png"), *asked]) == 1
    assert f"expected no {asked[0]} of heights, which are a terrain" in capsys.readouterr().err


def test_a_file_of_holes_alone_is_told_by_name(tmp_path, capsys):
    np.save(tmp_path / "holes.npy", np.full((3, 4), np.nan, np.float32))
    assert main(["terrain", str(tmp_path / "holes.npy"), "-o", str(tmp_path / "b.png")]) == 1
    assert "holes.npy: expected a height somewhere; all 12 are missing" in capsys.readouterr().err


@pytest.mark.parametrize("material", ["phong", "toon", "{kind: environment, reflectivity: 1}", "reflection_lines"])
def test_terrains_have_every_material_and_their_own_colours(dem, material):
    asked = {"terrain.material": material, "size": "[16, 12]", "terrain.subpixels": "1"}
    one = picture(build(terrain_scene(dem, asked | {"terrain.color": "tomato"})))
    other = picture(build(terrain_scene(dem, asked | {"terrain.color": "[0, 0, 1]"})))
    assert one.isfinite().all()
    painted = material in ("phong", "toon")
    assert ((one - other).abs().amax(-1) > 0.05).float().mean().item() > 0.2 or not painted
    if not painted:
        assert torch.equal(one, other)


def test_lights_of_a_scene_take_the_place_of_the_sun(dem):
    lights = "{lights: [{direction: [1, 0, 1], color: [1, 0, 0]}, {direction: [-1, 0, 1], color: [0, 0, 1]}]}"
    prepared = build(terrain_scene(dem, {"lighting": lights}))
    assert [light.color for light in prepared.lights] == [(1, 0, 0), (0, 0, 1)]
    assert isinstance(prepared.material, Lambertian)
    assert isinstance(build(terrain_scene(dem, {"terrain.material": "phong"})).material, Phong)


def test_a_background_stands_where_there_is_no_sky(dem):
    asked = {"terrain.sky": "none", "background": "[0.2, 0.4, 0.6]", "size": "[16, 12]"}
    image = picture(build(terrain_scene(dem, asked)))
    assert image[0, 0].tolist() == pytest.approx([0.2, 0.4, 0.6])


def test_places_are_those_of_the_file():
    """A camera 500 m above a corner of heights in feet and degrees: 3 times as high above the ground that is shown."""
    z = (hills().samples / 0.3048).astype(np.float32)
    heights = Heights(z, (1 / 1200, -1 / 1200), (-84.4, 36.7), "degree", "foot")
    model = TerrainModel(heights=ANY, exaggeration=3, range=(3300, 4300), block=False)
    corner = (-84.4, 36.7, float(z[0, 0]) + 500 / 0.3048)
    camera = {"position": corner, "target": (-84.4 + 6 / 1200, 36.7 - 6 / 1200, 3000.0)}
    cut = {"lower": (-84.4, 36.69, 0.0), "upper": (-84.395, 36.7, 4000.0)}
    made = PreparedTerrain.of(Scene(terrain=model, camera=camera, region=cut), Terrain.of(model, heights))
    place = torch.tensor([[float(v) for v in made.camera.position]], dtype=torch.float64)
    ground = made.surface.jet(place[:, :2], 0)[0]
    assert float(place[0, 2] - ground[0]) == pytest.approx(1500, rel=1e-4)
    left, _, _, top = made.terrain.heights.extent
    assert place[0, :2].tolist() == pytest.approx([left, top])
    assert made.region[1][2] == pytest.approx(4000 * 0.3048 * 3)
    scale = made.terrain.coloring
    assert 4000 * 0.3048 * 3 / scale.exaggeration == pytest.approx(4000)  # tints of heights in feet
    assert made.terrain.span[0] == pytest.approx(hills().samples.min() / 0.3048, rel=1e-2)
    assert made.legend is not None
    assert made.legend.label == "height in ft"


def test_water_is_in_the_unit_of_the_heights():
    metres, feet = hills(), replace(hills(), samples=(hills().samples / 0.3048).astype(np.float32), height_unit="foot")
    levels = [terrain(h, water=level).water.level for h, level in ((metres, 1100.0), (feet, 1100 / 0.3048))]
    assert levels[1] == pytest.approx(levels[0], rel=1e-6)


def test_orthographic_maps_from_straight_above_fill_the_picture(dem):
    """North up: the map is 1.35 km by 1.08 km, and so is the picture, but for its margin."""
    asked = {"camera": "{projection: orthographic, compass: [0, 90], margin: 1}", "size": "[50, 40]", "jitter": "1"}
    prepared = build(terrain_scene(dem, asked | {"terrain.block": "false", "terrain.sky": "none"}))
    assert float(prepared.camera.height) == pytest.approx(12 * 90)
    assert (prepared.render()[..., 3] > 0).all()


def test_flights_go_through_render_too(dem, tmp_path, capsys):
    left, bottom, right, top = hills().extent
    y = (bottom + top) / 2
    (tmp_path / "flight.yaml").write_text(f"points: [[{left + 100}, {y}, 90], [{right - 100}, {y}, 90]]\n")
    small = ["--size", "12", "8", "--terrain.subpixels", "1", "-q"]
    words = ["render", str(dem), "-o", str(tmp_path / "a"), "--frames", "2", "--path", str(tmp_path / "flight.yaml")]
    assert main([*words, *small]) == 0
    assert run(dem, "-o", tmp_path / "b", *words[4:], "--size", 12, 8, "--subpixels", 1, "-q") == 0
    for name in ("000.png", "001.png"):
        assert (tmp_path / "a" / name).read_bytes() == (tmp_path / "b" / name).read_bytes()
    (tmp_path / "s.yaml").write_text("signal: {name: sphere, samples: 8}\nsurface: 0.5\n")
    assert main(["render", str(tmp_path / "s.yaml"), "-o", str(tmp_path / "c"), *words[4:]]) == 1
    assert "expected a terrain to fly over" in capsys.readouterr().err


def test_the_plan_of_a_terrain(dem):
    prepared = build(terrain_scene(dem, {"size": "[40, 30]", "terrain.subpixels": "3"}))
    found = plan(prepared)
    assert (found.rays, found.image_bytes, found.height_bytes) == (40 * 30 * 9, 40 * 30 * 16, 13 * 16 * 4)
    assert found.bound_bytes == prepared.surface.cast.pyramid.numbers.nbytes > 0
    assert found.cells == prepared.surface.cells
    assert found.seconds.low > 0
    assert table(found).row_count > 8


@pytest.mark.parametrize(
    ("text", "told"),
    [
        ("terrain: none.tif", "terrain: expected a file of heights; found none at"),
        ("terrain: {heights: dem.txt}", "terrain.heights: .*expected a file of heights; got unknown ending '.txt'"),
        ("terrain: {heights: dem.npz, spline: c3}", "terrain.spline: unknown name 'c3'; did you mean 'c2'"),
        ("terrain: {heights: dem.npz, colour: slope}", "did you mean 'color'"),
        ("terrain: {heights: dem.npz, color: slop}", "terrain.color: .*slope, aspect"),
        ("terrain: {heights: dem.npz, sky: no.png}", "terrain.sky: expected a picture; found none"),
        ("terrain: {heights: dem.npz, prefilter: true}", "prefilter: it is that of the spline c2; got c1"),
        ("terrain: {heights: dem.npz, sheets: 2}", "sheets: more than one goes without water"),
        (
            "terrain: {heights: dem.npz, material: {kind: phong, color: red}}",
            "material.color: the colours of a terrain",
        ),
        ("terrain: {heights: dem.npz, material: {kind: matt, color: red}}", "unknown key 'color'"),
        ("terrain: {heights: dem.npz, color: red, range: [0, 1]}", "range: these colours stand for no values"),
        ("terrain: dem.npz\nmethod: notch", "method: a terrain is no part of a volume"),
        ("terrain: dem.npz\nstep: 1", "step: a terrain is hit exactly"),
        ("terrain: dem.npz\nsurface: 1", "expected one of surface, terrain, mip, slice; got surface and terrain"),
        ("terrain: dem.npz\nbackground: white", "background: behind a terrain is its sky"),
        ("terrain: dem.npz\nregion: {lower: [0, 0, 0], upper: [1, 1, 1]}", "region: walls and water reach"),
        ("terrain: dem.npz\ncamera: {compass: [0, 91]}", r"camera.compass\[1\]: expected less than or equal to 90"),
        ("terrain: dem.npz\ncamera: {compass: [0, 9], direction: [0, 1, 0]}", "got a direction and a compass"),
    ],
)
def test_mistakes_in_scenes_name_the_key(dem, text, told):
    dem.with_name("dem.txt").touch()
    dem.with_name("s.yaml").write_text(text)
    with pytest.raises(ConfigError, match=told):
        load_scene(dem.with_name("s.yaml"))
