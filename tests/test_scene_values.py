"""Scenes that show values: maximum intensity projections and slices; what they build, plan, refuse and write."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from filterlab import Volume, save_volume, signals
from filterlab.cli import main
from filterlab.io.config import ConfigError, dump_config, loads_config
from filterlab.render import ColorScale, PerspectiveCamera, Plane, colored, maximum_projection, plane_values
from filterlab.scenes.build import build, render_scene
from filterlab.scenes.model import Scene
from filterlab.scenes.plan import ValuePlan, plan
from filterlab.scenes.plan_report import table

BASE = "signal: {name: marschner-lobb, samples: 12}\nsize: [9, 7]\nbackground: '#203040'\n"

RED_TO_BLUE = (
    "transfer: {axis: normalized, points: [{value: 0, color: red, opacity: 0}, {value: 1, color: blue, opacity: 0}]}"
)


def scene(more: str, overrides: dict[str, str] | None = None) -> Scene:
    return loads_config(BASE + more, Scene, overrides)


def test_a_projection_is_what_its_parts_make() -> None:
    found = scene(
        "mip: {center: 0.5, width: 0.5, colormap: magma}\nstep: 0.7\njitter: 3\ncamera: {direction: [1, 2, -1]}\n"
    )
    prepared = build(found)
    camera = PerspectiveCamera.framing(prepared.field.domain, (1.0, 2.0, -1.0), aspect=9 / 7)
    values = maximum_projection(prepared.field, camera, size=(9, 7), step=0.7, jitter_seed=3)
    expected = colored(values, ColorScale(0.25, 0.75, "magma"), found.background)
    assert torch.equal(prepared.render(), expected)
    assert expected[..., 3].unique().tolist() == [0, 1]
    assert render_scene(found).std() > 0.05


@pytest.mark.parametrize("kind", ["mip: true", "slice: z"])
def test_without_a_window_it_is_the_range_of_the_samples(kind: str) -> None:
    low, high = signals.marschner_lobb().sample(12, dtype=torch.float32).samples.aminmax()
    prepared = build(scene(kind + "\n"))
    assert prepared.colors == ColorScale(float(low), float(high))  # type: ignore[union-attr]


@pytest.mark.parametrize("kind", ["mip: true", "slice: y"])
def test_a_transfer_function_gives_its_colours_opaque(kind: str) -> None:
    more = f"{kind}\n{RED_TO_BLUE}\n"
    image = build(scene(more)).render()
    assert image[..., 1][image[..., 3] == 1].max() == 0
    assert image[..., 0].std() > 0.01


def test_slices_are_seen_from_the_front_unless_the_camera_is_somewhere() -> None:
    prepared = build(scene("slice: {axis: x, position: 0.25}\ncamera: {window: [0, 0, 0.5, 1], margin: 1.2}\n"))
    domain = prepared.field.domain
    plane = Plane.across("x", domain, 0.25)
    camera = plane.camera(domain, aspect=18 / 7, margin=1.2, window=(0, 0, 0.5, 1))
    values = plane_values(prepared.field, plane, camera, size=(9, 7))
    assert torch.equal(prepared.values().nan_to_num(-9), values.nan_to_num(-9))  # type: ignore[union-attr]
    turned = build(scene("slice: z\ncamera: {up: [0, -1, 0]}\n")).render()
    torch.testing.assert_close(turned, build(scene("slice: z\n")).render().flip(0, 1), rtol=0, atol=1e-5)
    oblique = build(scene("slice: {point: [0, 0, 0], normal: [1, 2, 0.5]}\ncamera: {direction: [1, 1, 0]}\n"))
    camera = PerspectiveCamera.framing(domain, (1.0, 1.0, 0.0), aspect=9 / 7)
    values = plane_values(prepared.field, Plane((0, 0, 0), (1, 2, 0.5)), camera, size=(9, 7))
    assert torch.equal(oblique.values().nan_to_num(-9), values.nan_to_num(-9))  # type: ignore[union-attr]


def test_a_grey_window_has_the_digits_of_a_viewer(tmp_path: Path) -> None:
    """255 (v − low) / width, of every voxel where pixels lie on voxels."""
    samples = torch.arange(5 * 6 * 7, dtype=torch.int16).reshape(5, 6, 7)
    save_volume(Volume(samples), tmp_path / "scan.nrrd")
    out = tmp_path / "slice.png"
    window = ["--slice", "{axis: z, position: 2, center: 100, width: 50}", "--camera.margin", "1", "--size", "7", "6"]
    assert main(["render", str(tmp_path / "scan.nrrd"), *window, "--method", "nearest", "-o", str(out)]) == 0
    expected = 255 * ((samples[2].double() - 75) / 50).clamp(0, 1).flip(0)
    with Image.open(out) as picture:
        assert np.abs(np.asarray(picture)[..., 0] - expected.numpy()).max() <= 0.5 + 1e-4


def test_a_volume_is_enough(tmp_path: Path) -> None:
    save_volume(Volume(torch.rand(5, 6, 7)), tmp_path / "scan.nrrd")
    for k, more in enumerate((["--mip"], ["--slice", "x"], ["--slice.axis", "y", "--slice.colormap", "magma"])):
        out = tmp_path / f"{k}.png"
        assert main(["render", str(tmp_path / "scan.nrrd"), *more, "--size", "8", "8", "-o", str(out)]) == 0
        with Image.open(out) as picture:
            assert picture.size == (8, 8)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ("mip: {center: 3}", "center and width of the window together"),
        ("mip: false", "mip"),
        ("mip: {width: 0, center: 1}", "mip.width: expected greater than 0"),
        ("mip: {colormap: greyish}", "unknown colormap"),
        ("mip: true\nslice: z", "expected one of surface, terrain, mip, slice; got mip and slice"),
        ("mip: true\nsurface: 0.5", "got surface and mip"),
        (
            "mip: true\ntermination: 0.1\nlighting: {}",
            "termination and lighting: a projection looks along all of a ray",
        ),
        ("slice: z\nstep: 0.5\njitter: 1", "step and jitter: a slice has one value a pixel"),
        ("slice: w", "slice: unknown name 'w'; known names: x, y, z"),
        ("slice: {}", "either an axis or a point and a normal"),
        ("slice: {axis: z, point: [0, 0, 0], normal: [0, 0, 1]}", "got both"),
        ("slice: {point: [0, 0, 0]}", "point and normal together"),
        ("slice: {position: 3, point: [0, 0, 0], normal: [0, 0, 1]}", "position goes with an axis"),
        ("slice: {point: [0, 0, 0], normal: [0, 0, 0]}", "normal of a plane"),
        (
            "slice: {axis: z, colormap: bone}\ntransfer: {points: [{value: 0, color: red, opacity: 1}]}",
            "colours .* once",
        ),
        (
            "slice: {axis: z, position: 3}",
            r"a plane through the volume \(x -1 … 1, .*\); got one through .*, 3$",
        ),
    ],
)
def test_mistakes_are_named(more: str, message: str) -> None:
    with pytest.raises((ConfigError, ValueError), match=message):
        build(scene(more + "\n"))


@pytest.mark.parametrize(
    "more", ["mip: {center: 1, width: 2}", "slice: {axis: y, position: 0.5}", "slice: x", f"mip: true\n{RED_TO_BLUE}"]
)
def test_they_survive_a_round_trip(more: str) -> None:
    found = scene(more + "\n")
    assert loads_config(dump_config(found), Scene) == found


def test_the_plan_counts_what_is_taken(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    prepared = build(scene("mip: true\nstep: 0.3\njitter: 1\n"))
    told: list[int] = []
    prepared.render(lambda done, total: told.append(total))
    found = plan(prepared)
    assert isinstance(found, ValuePlan)
    assert (found.samples, found.rays, found.step, found.method) == (told[-1], 63, 0.3, "triquadratic")
    assert found.seconds.low > 0
    sliced = plan(build(scene("slice: z\n")))
    assert isinstance(sliced, ValuePlan)
    assert (sliced.samples, sliced.step) == (63, None)
    assert table(sliced).row_count > 5
    path = tmp_path / "scene.yaml"
    path.write_text(BASE + "mip: true\n")
    assert main(["render", str(path), "--explain"]) == 0
    assert "maximum along every ray" in capsys.readouterr().out
