"""Signed distances from meshes: against closed forms, what holes do, grids, files, the command."""

from __future__ import annotations

import struct
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch

from filterlab.cli import main
from filterlab.io import load_mesh, load_volume
from filterlab.signed_distances import Grid, Triangles, signed_distance
from filterlab.volume import Volume
from tests.laws import assert_close

trimesh = pytest.importorskip("trimesh", reason="the extra `mesh` is not installed")
pytest.importorskip("igl", reason="the extra `mesh` is not installed")

SIDES = np.array([1.0, 2.0, 0.5])
TURNED = np.array([0, 2, 1])


def triangles(mesh) -> Triangles:
    return Triangles(torch.tensor(mesh.vertices), torch.tensor(mesh.faces))


def box(faces: slice | list[int] = slice(None)) -> Triangles:
    """A box of `SIDES` about the origin, or some of its twelve triangles."""
    whole = triangles(trimesh.creation.box(SIDES))
    return Triangles(whole.vertices, whole.faces[faces])


def centres(volume: Volume) -> np.ndarray:
    """Voxel centres in the world, (D, H, W, 3)."""
    z, y, x = np.indices(volume.samples.shape)
    return volume.geometry.to_world(torch.from_numpy(np.stack([x, y, z], -1)).double()).numpy()


def distance_to_box(points: np.ndarray) -> np.ndarray:
    beyond = np.abs(points) - SIDES / 2
    return np.linalg.norm(np.maximum(beyond, 0), axis=-1) + np.minimum(beyond.max(-1), 0)


# --- distances --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [[0, 1, 2], TURNED], ids=["outwards", "inwards"])
def test_a_box_equals_its_closed_form(order):
    """Whichever way round all triangles go; voxels are no cubes."""
    found = box()
    grid = Grid.with_shape(found, (17, 24, 13))
    volume = signed_distance(Triangles(found.vertices, found.faces[:, order]), grid, dtype=torch.float64)
    assert_close(volume.samples, distance_to_box(centres(volume)), 1e-14)


def test_a_sphere_of_triangles_is_as_far_as_the_sphere_within_their_sag():
    mesh = trimesh.creation.icosphere(4)
    sag = 1 - float(np.abs((mesh.face_normals * mesh.triangles_center).sum(-1)).min())
    volume = signed_distance(triangles(mesh), Grid.with_size(triangles(mesh), 25))
    assert (volume.samples.dtype, sag < 2e-3) == (torch.float32, True)
    beyond = volume.samples.numpy() - (np.linalg.norm(centres(volume), axis=-1) - 1)
    assert beyond.min() >= -1e-6
    assert beyond.max() <= sag + 1e-6


def test_holes_change_no_distance_to_what_is_there():
    """Half of a box's lid is missing: the winding number is no whole number, yet distances are not scaled by it."""
    found = box()
    z = found.vertices[found.faces][..., 2]
    lid = int((z.amin(1) > 0).nonzero()[0])
    opened = box([i for i in range(12) if i != lid])
    volume = signed_distance(opened, Grid.with_size(found, 24), dtype=torch.float64)
    points = centres(volume)
    below = points[..., 2] < -SIDES[2] / 4  # nearer to the bottom, or to walls, than to the lid
    assert (volume.samples.numpy()[below] < 0).any()
    assert_close(volume.samples.numpy()[below], distance_to_box(points)[below], 1e-14)


def test_edges_that_are_in_the_way_of_signs_are_counted():
    found = box()
    soup = Triangles(found.vertices[found.faces].reshape(-1, 3), torch.arange(36).reshape(-1, 3))
    turned = found.faces.clone()
    turned[4] = turned[4, TURNED]
    assert [t.unbalanced_edges() for t in (found, soup, box(slice(1, None)))] == [0, 0, 3]
    assert Triangles(found.vertices, turned).unbalanced_edges() == 3


def test_progress_ends_at_one():
    parts: list[float] = []
    signed_distance(box(), Grid.with_size(box(), 60), progress=parts.append)
    assert len(parts) > 1
    assert parts[-1] == 1
    assert all(a < b for a, b in pairwise(parts))


# --- grids ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("margin", [0, 1.5, 3])
@pytest.mark.parametrize(
    "made",
    [
        lambda t, m: Grid.with_size(t, 20, m),
        lambda t, m: Grid.with_shape(t, (11, 13, 9), m),
        lambda t, m: Grid.with_spacing(t, (0.1, 0.3, 0.07), m),
    ],
    ids=["size", "shape", "spacing"],
)
def test_grids_hold_the_mesh_and_its_margins_in_their_middle(made, margin):
    """From the box to the outermost voxel centres: the margin, and less than a voxel more where spacing is given."""
    moved = Triangles(box().vertices + torch.tensor([5.0, -7, 0.25]), box().faces)
    grid = made(moved, margin)
    low, high = moved.box()
    first = np.array(grid.geometry.origin)
    last = first + np.array(grid.geometry.spacing) * (np.array(grid.size) - 1)
    before, after = (low - first) / grid.geometry.spacing, (last - high) / grid.geometry.spacing
    assert_close(before, after, 1e-9)
    assert before.min() >= margin - 1e-9
    assert before.max() < margin + 0.5


def test_grids_have_what_was_asked():
    assert Grid.with_size(box(), 20).size[1] == 20
    assert len({round(s, 12) for s in Grid.with_size(box(), 20).geometry.spacing}) == 1
    assert Grid.with_shape(box(), (11, 13, 9)).size == (11, 13, 9)
    assert Grid.with_spacing(box(), (0.1, 0.3, 0.07)).geometry.spacing == (0.1, 0.3, 0.07)


@pytest.mark.parametrize(
    ("ask", "message"),
    [
        (lambda t: Grid.with_size(t, 7), "more than 7 voxels with a margin of 3; got 7"),
        (lambda t: Grid.with_size(t, 20, -1), "margin of 0 or more voxels; got -1"),
        (lambda t: Grid.with_size(t, 20, float("nan")), "margin of 0 or more voxels; got nan"),
        (lambda t: Grid.with_spacing(t, (0.1, 0, 0.1)), "spacing must be positive"),
        (lambda t: Grid.with_shape(Triangles(t.vertices * torch.tensor([1, 0, 1]), t.faces), (9,) * 3), "some extent"),
        (lambda t: Triangles(t.vertices, t.faces[:0]), "expected triangles; got none, and 8 vertices"),
        (lambda t: Triangles(t.vertices, t.faces + 1), r"numbers of 8 vertices, from 0; got faces of 1 … 8"),
        (lambda t: Triangles(t.vertices[:, :2], t.faces), r"vertices must have shape \(·, 3\); got \(8, 2\)"),
        (lambda t: Triangles(t.vertices / 0, t.faces), "finite vertices; got NaN or infinity"),
    ],
)
def test_what_makes_no_sense_is_refused(ask, message):
    with pytest.raises(ValueError, match=message):
        ask(box())


# --- files ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", [".ply", ".obj", ".stl", ".off", ".glb"])
def test_meshes_are_read_as_they_were_written(ending, tmp_path):
    mesh = trimesh.creation.icosphere(1)
    mesh.export(tmp_path / f"ball{ending}")
    found = load_mesh(tmp_path / f"ball{ending}")
    corners = found.vertices[found.faces].numpy()
    assert_close(np.sort(corners, 0), np.sort(mesh.vertices[mesh.faces], 0), 1e-7)
    assert (found.vertices.dtype, found.unbalanced_edges()) == (torch.float64, 0)


def strips(path: Path) -> Path:
    """A tetrahedron as PLY's triangle strips: one of four triangles, every second of which goes round the other way."""
    header = (
        "ply\nformat binary_little_endian 1.0\nelement vertex 4\nproperty float x\nproperty float y\nproperty float z"
    )
    header += "\nelement tristrips 1\nproperty list int int vertex_indices\nend_header\n"
    vertices, order = (0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1), (0, 1, 2, 3, 0, 1, -1)
    path.write_bytes(header.encode() + struct.pack("<12f", *vertices) + struct.pack("<8i", len(order), *order))
    return path


def test_triangle_strips_are_read(tmp_path):
    found = load_mesh(strips(tmp_path / "strips.ply"))
    assert (len(found.vertices), len(found.faces), found.unbalanced_edges()) == (4, 4, 0)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        (
            "a.ply",
            b"ply\nformat ascii 1.0\nelement vertex 9\nproperty float x\nend_header\n1\n",
            "expected a triangle mesh",
        ),
        ("points.obj", b"v 1 2 3\nv 2 2 3\n", "expected triangles; got none"),
        ("nan.obj", b"v nan 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n", "finite vertices"),
        ("beyond.obj", b"v 0 0 0\nf 1 2 9\n", "expected a triangle mesh"),
        ("a.xlsx", b"", "expected a triangle mesh"),
    ],
)
def test_files_without_triangles_are_refused_by_name(name, content, message, tmp_path):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(ValueError, match=f"{name}: .*{message}"):
        load_mesh(tmp_path / name)
    with pytest.raises(FileNotFoundError, match="expected a mesh file; got no file of this name"):
        load_mesh(tmp_path / "none.ply")


# --- the command ------------------------------------------------------------------------------------------------------


def written(path: Path, faces: slice = slice(None)) -> str:
    found = box(faces)
    trimesh.Trimesh(found.vertices.numpy(), found.faces.numpy(), process=False).export(path)
    return str(path)


@pytest.mark.parametrize(
    ("options", "size"),
    [
        ([], (68, 128, 38)),
        (["--size", "30"], (19, 30, 13)),
        (["--shape", "9", "10", "11"], (9, 10, 11)),
        (["--spacing", "0.25", "0.5", "0.125", "--margin", "2"], (9, 9, 9)),
    ],
)
def test_command(options, size, tmp_path, capsys):
    assert main(["sdf", written(tmp_path / "box.ply"), "-q", "-o", str(tmp_path / "box.nrrd"), *options]) == 0
    volume = load_volume(tmp_path / "box.nrrd")
    assert (volume.size, volume.dtype) == (size, torch.float32)
    assert_close(volume.samples, distance_to_box(centres(volume)), 1e-6)
    assert capsys.readouterr().err == ""


def test_command_says_that_a_mesh_is_open(tmp_path, capsys):
    source = written(tmp_path / "open.ply", slice(1, None))
    assert main(["sdf", source, "-o", str(tmp_path / "open.npy"), "--size", "20", "--dtype", "float64"]) == 0
    assert "open.ply is not closed: around 3 edges there are holes" in capsys.readouterr().err
    assert load_volume(tmp_path / "open.npy").dtype == torch.float64


@pytest.mark.parametrize(
    ("options", "code", "message"),
    [
        (["--size", "20", "--spacing", "1", "1", "1"], 2, "one of --size, --shape and --spacing; got several"),
        (["--size", "3"], 1, "more than 7 voxels"),
        (["--dtype", "int8"], 1, "float32, float64"),
        (["--size", "5000"], 1, "expected a result of at most 8 GiB (--max-gigabytes)"),
        (["--max-gigabytes", "0"], 1, "--max-gigabytes to be a positive number"),
        (["-o", "box.tif"], 1, "box.tif: expected"),
        (["-o", "none/box.nrrd"], 1, "expected an existing folder"),
        (["-o", "box.ply"], 1, "an output other than the input"),
    ],
)
def test_command_refuses_before_it_writes(options, code, message, tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    written(tmp_path / "box.ply")
    arguments = ["sdf", "box.ply", *(["-o", "box.nrrd"] if "-o" not in options else []), *options]
    assert main(arguments) == code
    assert message in capsys.readouterr().err
    assert [p.name for p in tmp_path.iterdir()] == ["box.ply"]


@pytest.mark.parametrize("package", ["igl", "trimesh"])
def test_command_names_the_extra_that_is_missing(package, tmp_path, capsys, monkeypatch):
    source = written(tmp_path / "box.ply")
    monkeypatch.setitem(sys.modules, package, None)
    assert main(["sdf", source, "-o", str(tmp_path / "box.nrrd")]) == 1
    assert "pip install 'filterlab[mesh]'" in capsys.readouterr().err
