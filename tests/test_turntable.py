"""Turntables: where the camera goes, what is written, and that nothing is left of one that ends early."""

from __future__ import annotations

import math
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from filterlab.cli import main
from filterlab.io.config import loads_config
from filterlab.render import OrthographicCamera, PerspectiveCamera
from filterlab.scenes import build as building
from filterlab.scenes.build import build, picture
from filterlab.scenes.model import Scene
from filterlab.scenes.turntable import seconds_of_each, turntable

BASE = "signal: {name: marschner-lobb, samples: [8, 12, 5]}\nsize: [9, 7]\nstep: 2\n"
MEDIUM = BASE + "transfer: {points: [{value: 0, color: navy, opacity: 0}, {value: 1, color: gold, opacity: 0.7}]}\n"
POSE = "camera: {position: [4, 1, 2], target: [0.5, 0, 0.25], up: [0, 1, 0]}\n"


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    path = tmp_path / "scene.yaml"
    path.write_text(MEDIUM)
    return path


def test_a_camera_goes_round_what_is_up() -> None:
    up = torch.tensor([0.3, -0.2, 2.0], dtype=torch.float64)
    camera = PerspectiveCamera(position=(4, 1, 2), target=(0.5, 0, 0.25), up=up)
    axis = up / up.norm()
    target = torch.tensor(camera.target, dtype=torch.float64)
    before = torch.tensor(camera.position, dtype=torch.float64) - target
    after = torch.as_tensor(camera.turned(37.0).position) - target
    assert float(after @ axis) == pytest.approx(float(before @ axis), abs=1e-12)
    flat = [v - (v @ axis) * axis for v in (before, after)]
    assert float(flat[1].norm()) == pytest.approx(float(flat[0].norm()), rel=1e-12)
    angle = math.atan2(float(torch.linalg.cross(flat[0], flat[1]) @ axis), float(flat[0] @ flat[1]))
    assert math.degrees(angle) == pytest.approx(37, rel=1e-12)
    torch.testing.assert_close(camera.turned(360).position, before + target, rtol=0, atol=1e-12)


def test_a_compass_that_looks_straight_down_turns_on_the_spot() -> None:
    """It was refused, for nothing turns about an axis that is looked along, with that axis above."""
    scene = loads_config(MEDIUM + "camera: {compass: [30, 90]}\n", Scene)
    views = [view.camera for view in turntable(build(scene), 4)]
    for k, camera in enumerate(views):
        angle = math.radians(30 - 90 * k)  # counter-clockwise from above: azimuths fall
        above = torch.tensor([math.sin(angle), math.cos(angle), 0.0], dtype=torch.float64)
        assert torch.allclose(torch.as_tensor(camera.up, dtype=torch.float64), above, atol=1e-12)
        places = (torch.as_tensor(c.position, dtype=torch.float64) for c in (camera, views[0]))
        assert torch.allclose(*places, atol=1e-9)


def test_a_pose_begins_where_it_is_and_keeps_its_distance() -> None:
    prepared = build(loads_config(MEDIUM + POSE, Scene))
    views = turntable(prepared, 5)
    assert torch.equal(views[0].render(), prepared.render())
    for k, view in enumerate(views):
        assert torch.equal(
            torch.as_tensor(view.camera.position), torch.as_tensor(prepared.camera.turned(72 * k).position)
        )
        assert view.field is prepared.field
    assert len({tuple(view.render().flatten().tolist()) for view in views}) == 5


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_a_framed_volume_stays_in_view_and_as_far_away(projection: str) -> None:
    """Its corners lie within the picture all the way round, and in some view at its edge."""
    more = f"camera: {{projection: {projection}, direction: [0.1, 1, -0.3], margin: 1}}\nsurface: 0.5\n"
    prepared = build(loads_config(BASE.replace("step: 2\n", "") + more, Scene))
    corners = prepared.field.domain.corners()
    farthest, distances = [], []
    for view in turntable(prepared, 12):
        camera = view.camera
        position, right, up, forward = camera._frame(torch.device("cpu"))
        x, y, z = ((corners - position) @ torch.stack((right, up, forward), -1)).unbind(-1)
        half = float(camera.height) / 2 if isinstance(camera, OrthographicCamera) else math.tan(math.radians(15)) * z
        farthest.append(float(torch.maximum(x.abs() / (9 / 7), y.abs()).div(half).max()))
        distances.append(float((position - torch.as_tensor(camera.target)).norm()))
    assert max(farthest) == pytest.approx(1, rel=1e-9)
    assert min(farthest) < 0.95
    assert all(a == pytest.approx(b, rel=1e-12) for a, b in pairwise(distances))


def test_frames_are_numbered_pictures_of_one_field(
    scene_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    built = []
    monkeypatch.setattr(building, "build", lambda *asked: built.append(1) or build(*asked))
    (tmp_path / "frames").mkdir()  # one that is empty may be there
    assert main(["render", str(scene_file), "--turntable", "3", "-o", str(tmp_path / "frames")]) == 0
    assert built == [1]
    assert sorted(p.name for p in (tmp_path / "frames").iterdir()) == ["000.png", "001.png", "002.png"]
    for k, view in enumerate(turntable(build(loads_config(MEDIUM, Scene)), 3)):
        expected = _digits(picture(view))
        with Image.open(tmp_path / "frames" / f"00{k}.png") as found:
            assert np.array_equal(np.asarray(found), expected)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["frames", "scene.yaml"]


def _digits(image: torch.Tensor) -> np.ndarray:
    from filterlab.io.images import to_srgb

    return (255 * to_srgb(image.double().clamp(0, 1))).round().numpy().astype(np.uint8)


@pytest.mark.parametrize("name", ["spin.gif", "spin.png"])
def test_pictures_that_move(name: str, scene_file: Path, tmp_path: Path) -> None:
    assert main(["render", str(scene_file), "--turntable", "5", "-o", str(tmp_path / name)]) == 0
    with Image.open(tmp_path / name) as found:
        assert found.n_frames == 5  # type: ignore[attr-defined]
        assert found.size == (9, 7)
        found.seek(3)
        assert found.info["duration"] == 1000 * seconds_of_each(5) == 800
    assert seconds_of_each(1000) == 0.02


@pytest.mark.parametrize("name", ["frames", "spin.gif", "spin.png"])
def test_nothing_is_left_of_one_that_is_interrupted(
    name: str, scene_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    made = []

    def stops(*arguments: object) -> torch.Tensor:
        made.append(1)
        if len(made) == 3:
            raise KeyboardInterrupt
        return picture(*arguments)  # type: ignore[arg-type]

    monkeypatch.setattr(building, "picture", stops)
    assert main(["render", str(scene_file), "--turntable", "4", "-o", str(tmp_path / name)]) == 130
    assert len(made) == 3
    assert "interrupted" in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["scene.yaml"]


def test_mistakes_are_found_before_anything_is_built(
    scene_file: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(building, "build", lambda scene: pytest.fail("nothing must be built"))
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "notes.txt").touch()
    (tmp_path / "file").touch()
    for arguments, words in (
        (["--turntable", "1", "-o", tmp_path / "a"], "at least 2 pictures of a turn or a flight; got 1"),
        (["--turntable", "3", "-o", tmp_path / "full"], "a new or an empty folder; got one with files"),
        (["--turntable", "3", "-o", tmp_path / "file"], "a new or an empty folder; got a file"),
        (["--turntable", "3", "-o", tmp_path / "no" / "frames"], "expected an existing folder"),
        (["--turntable", "3", "-o", tmp_path / "a.jpg"], "ends in .gif or .png"),
        (
            ["--turntable", "3", "-o", tmp_path / "a.gif", "--transfer", "null", "--step", "null", "--slice", "z"],
            "no other sides",
        ),
        (["-o", tmp_path / "frames"], "ends in .png or .jpg"),
    ):
        assert main(["render", str(scene_file), *map(str, arguments)]) == (2 if arguments[1:2] == ["1"] else 1)
        assert words in capsys.readouterr().err
    assert sorted(p.name for p in tmp_path.iterdir()) == ["file", "full", "scene.yaml"]


def test_the_plan_counts_the_pictures(scene_file: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["render", str(scene_file), "--turntable", "36", "--explain"]) == 0
    assert "36 such pictures, about" in capsys.readouterr().out
