"""Points from files, covers to files, and what render, info and scenes make of them."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
import torch

from filterlab.cli import main
from filterlab.io.covers import load_slim, save_slim
from filterlab.io.images import load_image
from filterlab.io.points import load_points
from filterlab.scenes.build import build, load_scene
from filterlab.surfaces import Slim, fit_slim
from tests.test_fitting import sphere

POINTS = sphere(400)


@pytest.fixture(scope="module")
def cover(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("covers") / "ball.npz"
    save_slim(fit_slim(POINTS, tolerance=1e-2), path)
    return path


def written_ply(path: Path, rows: np.ndarray, names: str) -> Path:
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(rows)}"]
    lines += [f"property float {name}" for name in names.split()]
    header = "\n".join([*lines, "end_header\n"]).encode()
    path.write_bytes(header + b"".join(struct.pack(f"<{len(row)}f", *row) for row in rows))
    return path


OBJ = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 5\nf 1 2 3\n"  # the fourth is of no triangle


# --- points -----------------------------------------------------------------------------------------------------------


def test_tables_of_points(tmp_path):
    (tmp_path / "a.xyz").write_text("# x y z\n1 2 3\n4 5 6 # here\n\n")
    (tmp_path / "a.csv").write_text("1, 2, 3, 0, 0, 1\n4,5,6,0,1,0\n")
    points, normals = load_points(tmp_path / "a.xyz")
    assert points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert normals is None
    points, normals = load_points(tmp_path / "a.csv")
    assert points.tolist() == [[1, 2, 3], [4, 5, 6]]
    assert normals.tolist() == [[0, 0, 1], [0, 1, 0]]


def test_clouds_keep_their_normals(tmp_path):
    rows = np.concatenate((POINTS[:5], -POINTS[:5]), 1)
    points, normals = load_points(written_ply(tmp_path / "a.ply", rows, "x y z nx ny nz"))
    assert np.allclose(points, POINTS[:5], atol=1e-7)
    assert np.allclose(normals, -POINTS[:5], atol=1e-7)
    assert load_points(written_ply(tmp_path / "b.ply", rows[:, :3], "x y z")).normals is None


def test_triangles_give_normals_and_lose_no_vertex(tmp_path):
    (tmp_path / "a.obj").write_text(OBJ)
    points, normals = load_points(tmp_path / "a.obj")
    assert points.tolist() == [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 5]]
    assert normals.tolist() == [[0, 0, 1]] * 4
    (tmp_path / "b.obj").write_text(OBJ.replace("f 1 2 3", ""))
    assert load_points(tmp_path / "b.obj").normals is None


@pytest.mark.parametrize(
    ("name", "content", "told"),
    [
        ("a.xyz", "", "expected points; got none"),
        ("a.xyz", "1 2\n3 4\n", "expected lines of 3 or 6 numbers; got 2"),
        ("a.xyz", "one two three\n", "expected lines of 3 or 6 numbers"),
        ("a.xyz", "1 2 3\n4 5\n", "expected lines of 3 or 6 numbers"),
        ("a.ply", "no such thing", "expected points; got"),
        ("a.obj", "# nothing\n", "expected points; got none"),
    ],
)
def test_what_holds_no_points_is_refused(tmp_path, name, content, told):
    (tmp_path / name).write_text(content)
    with pytest.raises(ValueError, match=told):
        load_points(tmp_path / name)


# --- the command ------------------------------------------------------------------------------------------------------


def test_a_cover_from_a_file_is_that_of_its_points(tmp_path, capsys):
    np.savetxt(tmp_path / "a.xyz", np.concatenate((POINTS, POINTS[:3], [[40.0, 0, 0]])))
    assert main(["slim", str(tmp_path / "a.xyz"), "-o", str(tmp_path / "a.npz"), "--tolerance", "1e-2"]) == 0
    told = capsys.readouterr().err
    assert "3 points at places of others are left out" in told
    assert "1 points far from all surfaces are left out" in told
    found, direct = load_slim(tmp_path / "a.npz"), fit_slim(np.concatenate((POINTS, [[40.0, 0, 0]])), tolerance=1e-2)
    assert all(torch.equal(a, b) for a, b in zip(found.tensors, direct.tensors, strict=True))


def test_normals_of_a_file_are_taken_or_not(tmp_path):
    np.savetxt(tmp_path / "in.xyz", np.concatenate((POINTS, -POINTS), 1))
    rays = torch.zeros(9, 3, dtype=torch.float64), torch.from_numpy(sphere(9, 3))
    for normals, inside in (("given", True), ("found", False)):
        arguments = ["slim", str(tmp_path / "in.xyz"), "-o", str(tmp_path / "a.npz"), "--tolerance", "1e-2"]
        assert main([*arguments, "--normals", normals, "-q"]) == 0
        assert bool(load_slim(tmp_path / "a.npz").hit(*rays).valid.all()) == inside


@pytest.mark.parametrize(
    ("more", "told"),
    [
        (["--tolerance", "7"], "tolerance must be a part of the diagonal"),
        (["--least", "2"], "least must be a whole number of points"),
        (["--normals", "some"], "normals"),
        (["-o", "a.nrrd"], "ends in .npz"),
    ],
)
def test_mistakes_are_told_before_points_are_read(tmp_path, capsys, monkeypatch, more, told):
    monkeypatch.chdir(tmp_path)
    Path("a.xyz").write_text("not read")
    arguments = ["slim", "a.xyz", *(more if "-o" in more else ["-o", "a.npz", *more])]
    assert main(arguments) == 1
    assert told in capsys.readouterr().err
    assert not Path("a.npz").exists()


# --- what is made of covers -------------------------------------------------------------------------------------------


def test_a_cover_alone_is_shown(cover, tmp_path):
    assert main(["render", str(cover), "-o", str(tmp_path / "a.png"), "--size", "40", "30", "-q"]) == 0
    image = load_image(tmp_path / "a.png")
    assert image.shape == (30, 40, 3)
    assert image[15, 20].min() > 0.2 > image[0, 0].max()


def test_scenes_have_covers_with_any_camera_and_material(cover, tmp_path):
    scene = tmp_path / "scene.yaml"
    scene.write_text(
        f"surface: {{slim: {cover.name}, material: toon}}\ncamera: {{direction: [0, 0, -1], up: [0, 1, 0]}}"
    )
    with pytest.raises(ValueError, match="found none at"):
        load_scene(scene)
    (tmp_path / cover.name).write_bytes(cover.read_bytes())
    prepared = build(load_scene(scene, {"size": "[20, 20]"}))
    assert isinstance(prepared.surface, Slim)
    assert float(prepared.render()[10, 10, 3]) == 1.0
    assert (
        main(["render", str(scene), "--turntable", "2", "-o", str(tmp_path / "a.gif"), "--size", "8", "8", "-q"]) == 0
    )


def test_what_is_known_of_a_cover(cover, capsys):
    assert main(["info", str(cover)]) == 0
    assert main(["render", str(cover), "--explain"]) == 0
    told = capsys.readouterr().out
    assert f"{len(load_slim(cover)):,}, float64" in told
    assert "SLIM surface" in told
    assert f"SLIM, {len(load_slim(cover)):,} balls" in told


@pytest.mark.parametrize(
    ("arguments", "told"),
    [
        (["mesh", "{cover}", "-o", "a.ply"], "expected a level set, of which triangles are made; got a SLIM surface"),
        (["render", "{cover}", "--level", "3", "-o", "a.png"], "no --level"),
        (["resample", "{cover}", "-o", "a.nrrd", "--spacing", "1", "1", "1"], "samples"),
        (["render", "{volume}", "--surface", "{surface: 1}", "-o", "a.png"], "surface"),
        (["render", "slim.yaml", "-o", "a.png"], "expected a file that `filterlab slim` wrote"),
        (
            ["render", "both.yaml", "-o", "a.png"],
            "expected one of level, slim, quadrics, ellipsoids, molecule; got level and slim",
        ),
        (["render", "method.yaml", "-o", "a.png"], "method: a SLIM surface is no part of a volume"),
    ],
)
def test_covers_and_volumes_are_not_mistaken_for_each_other(cover, tmp_path, monkeypatch, capsys, arguments, told):
    monkeypatch.chdir(tmp_path)
    np.savez("volume.npz", samples=np.zeros((3, 3, 3), np.float32))
    Path("slim.yaml").write_text("surface: {slim: volume.npz}")
    Path("both.yaml").write_text(f"surface: {{slim: {cover}, level: 1}}")
    Path("method.yaml").write_text(f"surface: {{slim: {cover}}}\nmethod: notch")
    given = {"{cover}": str(cover), "{volume}": "volume.npz"}
    assert main([given.get(a, a) for a in arguments]) == 1
    assert told in capsys.readouterr().err
