"""Meshes of level sets: on the exact surface, closed where it is, the same however cut up; files; the command."""

from __future__ import annotations

import sys
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from torch import Tensor

import filterlab as fl
from filterlab.cli import main
from filterlab.io import MESH_FORMATS, save_mesh
from filterlab.methods import METHODS
from filterlab.surfaces import LevelSet, Mesh, mesh, meshes
from tests import oracles
from tests.laws import assert_close
from tests.test_methods import CONTINUOUS, TENSOR_PRODUCTS

BOUNDARIES = [str(b) for b in fl.Boundary]
OBLIQUE = np.array([[0.5, 0.1, 0.0, 3.0], [0.0, 0.7, 0.2, 1.0], [0.1, 0.0, 1.3, 5.0], [0.0, 0.0, 0.0, 1.0]])
MIRRORED = OBLIQUE * [[1, 1, -1, 1]]
LEVEL = 0.3


def closed_noise(seed: int = 0, shape: tuple[int, ...] = (8, 7, 9)) -> Tensor:
    """Noise, and far lower values around it: no level near 0 reaches the domain's ends."""
    inner = torch.from_numpy(np.random.default_rng(seed).standard_normal(shape))
    return torch.nn.functional.pad(inner, (2,) * 6, value=-3.0)


def field_of(samples: Tensor, method: str, boundary: str = "mirror", affine: np.ndarray = OBLIQUE) -> fl.Field:
    return fl.reconstruct(fl.Volume(samples, affine=affine), method, boundary=boundary)


def as_trimesh(made: Mesh) -> trimesh.Trimesh:
    return trimesh.Trimesh(made.vertices.numpy(), made.faces.numpy(), process=False)


def turns(made: Mesh) -> np.ndarray:
    """Cosine of the angle between each triangle and the normals at its corners."""
    return (as_trimesh(made).face_normals * made.normals.numpy()[made.faces.numpy()].mean(1)).sum(1)


# --- on the surface ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(("method", "boundary"), list(product(CONTINUOUS, BOUNDARIES)))
def test_vertices_lie_on_the_level_set_by_the_published_formula(method, boundary):
    """Value and normal against the oracle, which shares no code; the mesh is closed and goes round one way."""
    samples = closed_noise()
    made = mesh(LevelSet(field_of(samples, method, boundary), LEVEL))
    geometry = fl.Volume(samples, affine=OBLIQUE).geometry
    points = geometry.to_voxel(made.vertices).numpy()
    kind = METHODS[method].gradients[0]
    value, gradient = oracles.reconstruct(method, samples.numpy(), points, boundary, gradient=kind)
    assert_close(value, np.full(len(points), LEVEL), 1e-13, float(samples.max() - samples.min()))
    assert made.residual <= 1e-13 * float(samples.max() - samples.min())
    inner = (np.abs(points - points.round()) > 1e-9).all(1) if method in ("trilinear", "ncrsi") else ...
    outward = -geometry.gradient_to_world(torch.from_numpy(gradient)).numpy()
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    assert_close(made.normals.numpy()[inner], outward[inner], 1e-9)
    own = as_trimesh(made)
    assert own.is_watertight
    assert own.is_winding_consistent
    assert own.volume > 0


@pytest.mark.parametrize("method", ["trilinear", "triquadratic", "tricubic"])
def test_there_is_one_vertex_on_every_edge_that_the_surface_crosses(method):
    """Edges of the grid counted anew, from the oracle's values at its points: voxels, and the domain's ends."""
    samples = closed_noise(1)
    made = mesh(LevelSet(field_of(samples, method, affine=np.eye(4)), LEVEL))
    places = [np.concatenate(([-0.5], np.arange(n), [n - 0.5])) for n in samples.shape]
    z, y, x = np.meshgrid(*places, indexing="ij")
    points = np.stack((x, y, z), -1).reshape(-1, 3)
    inside = (oracles.reconstruct(method, samples.numpy(), points)[0] >= LEVEL).reshape(x.shape)
    expected = sum(np.count_nonzero(np.diff(inside, axis=axis)) for axis in range(3))
    off_the_grid = np.abs(made.vertices.numpy() - made.vertices.numpy().round()) > 1e-12
    assert np.count_nonzero(off_the_grid.sum(1) == 1) == expected
    assert 0 < np.count_nonzero(off_the_grid.sum(1) == 3) < 0.1 * expected  # those in the middle of cells


@pytest.mark.parametrize("method", TENSOR_PRODUCTS)
def test_rays_along_edges_hit_their_vertices(method):
    """From the grid point before every vertex to the next: a hit, found from polynomials, is the vertex."""
    surface = LevelSet(field_of(closed_noise(2), method, affine=np.eye(4)), LEVEL)
    vertices = mesh(surface).vertices
    part = vertices - vertices.floor()
    on_edges = ((part > 1e-9).sum(1) == 1) & (part < 1 - 1e-9).all(1)
    t = surface.hits(vertices[on_edges].floor(), (part[on_edges] > 0).double(), 4).t
    assert len(t) > 300
    assert_close((t - part[on_edges].amax(1, keepdim=True)).abs().amin(1), torch.zeros(len(t)), 1e-11)


@pytest.mark.parametrize("affine", [OBLIQUE, MIRRORED], ids=["oblique", "mirrored"])
@pytest.mark.parametrize("outside", ["lower", "greater"])
def test_triangles_and_normals_face_outside(affine, outside):
    z, y, x = torch.meshgrid(*(torch.linspace(-1, 1, n, dtype=torch.float64) for n in (12, 13, 14)), indexing="ij")
    field = field_of(-(x * x + y * y + z * z), "tricubic", affine=affine)
    made = mesh(LevelSet(field, -0.5), outside=outside)
    assert turns(made).min() > 0.5
    values = field(made.vertices + 0.05 * made.normals)
    assert bool((values < -0.5).all() if outside == "lower" else (values > -0.5).all())
    assert (as_trimesh(made).volume > 0) == (outside == "lower")


def test_a_finer_grid_is_nearer_to_a_sphere():
    """Vertices lie on the field's surface at any step; the volume between triangles grows to that of the ball."""
    signal = fl.signals.sphere(radius=0.6, edge=0.3)
    surface = LevelSet(fl.reconstruct(signal.sample(20), "tricubic"), 0.5)
    ball = 4 / 3 * np.pi * 0.6**3
    missing = [1 - as_trimesh(mesh(surface, step)).volume / ball for step in (4, 2, 1)]
    assert missing[0] > 3 * missing[1] > 9 * missing[2] > 0
    assert all(mesh(surface, step).residual < 1e-14 for step in (0.7, 1.3, 4))


@pytest.mark.parametrize("storage", ["float16", "int16"])
def test_stored_integers_and_halves(storage):
    field = fl.reconstruct(closed_noise().float(), "triquadratic", storage=storage)
    made = mesh(LevelSet(field, LEVEL))
    assert_close(field(made.vertices), np.full(len(made.vertices), LEVEL), 1e-13)
    assert as_trimesh(made).is_watertight


# --- closed, whole, the same ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_volumes_of_two_values_give_closed_meshes(seed):
    """On every checkered face the products that join its corners are equal: cells on both sides join it alike."""
    samples = torch.nn.functional.pad(torch.from_numpy(np.random.default_rng(seed).integers(0, 2, (9, 9, 9))), (2,) * 6)
    assert as_trimesh(mesh(LevelSet(fl.reconstruct(samples.double(), "trilinear"), 0.5))).is_watertight


@pytest.mark.parametrize("method", ["trilinear", "triquadratic"])
def test_voxels_on_the_level_do_not_open_the_mesh(method):
    samples = torch.nn.functional.pad(torch.from_numpy(np.random.default_rng(3).integers(0, 4, (9, 9, 9))), (2,) * 6)
    made = mesh(LevelSet(fl.reconstruct(samples.double(), method), 2.0))
    assert as_trimesh(made).is_watertight
    assert made.residual < 1e-13


def test_layers_at_once_change_nothing(monkeypatch):
    surface = LevelSet(field_of(closed_noise(4), "notch"), LEVEL)
    whole = mesh(surface)
    told: list[float] = []
    monkeypatch.setattr(meshes, "NODES_AT_ONCE", 1)
    monkeypatch.setattr(meshes, "_POINTS", 100)
    parts = mesh(surface, progress=told.append)
    corners = [torch.sort(m.vertices[m.faces].reshape(-1, 9), 0).values for m in (whole, parts)]
    assert_close(corners[0], corners[1], 1e-13)
    assert parts.vertices.shape == whole.vertices.shape
    assert as_trimesh(parts).is_watertight
    assert told == sorted(told)
    assert told[-1] == 1


def test_values_of_any_size():
    """Marching cubes itself computes in float32, where these are 0 or infinite."""
    samples = closed_noise(5)
    one = mesh(LevelSet(fl.reconstruct(samples, "trilinear"), 0.25))
    for scale in (2.0**-600, 2.0**600):
        other = mesh(LevelSet(fl.reconstruct(samples * scale, "trilinear"), 0.25 * scale))
        assert torch.equal(one.faces, other.faces)
        assert_close(one.vertices, other.vertices, 1e-13)


def test_missing_voxels_leave_a_hole():
    samples = closed_noise(6)
    holed = samples.clone()
    holed[6, 5, 6] = torch.nan
    whole = mesh(LevelSet(fl.reconstruct(samples, "trilinear"), LEVEL))
    made = mesh(LevelSet(fl.reconstruct(holed, "trilinear", nan="propagate"), LEVEL))
    assert bool(made.vertices.isfinite().all())
    assert bool(made.normals.isfinite().all())
    middle = torch.tensor([5.5, 4.5, 5.5])  # cells of the voxel, and of points whose sum reads it, times 0
    assert not bool(((made.vertices - middle).abs() < 1.5).all(1).any())
    assert not as_trimesh(made).is_watertight
    far = ((whole.vertices - middle).abs() > 1.5).any(1)
    assert {tuple(v) for v in whole.vertices[far].tolist()} <= {tuple(v) for v in made.vertices.tolist()}


@pytest.mark.parametrize("level", [-100.0, 100.0])
def test_a_level_that_no_value_has_gives_an_empty_mesh(level, tmp_path):
    made = mesh(LevelSet(field_of(closed_noise(), "notch"), level))
    assert made.vertices.shape == made.normals.shape == made.faces.shape == (0, 3)
    assert made.residual == 0
    for ending in MESH_FORMATS:
        save_mesh(made, tmp_path / f"none{ending}")
        assert (tmp_path / f"none{ending}").stat().st_size > 0


def test_one_voxel_and_open_ends():
    made = mesh(LevelSet(fl.reconstruct(torch.tensor([[[0.0, 1.0, 2.0]]]), "trilinear", boundary="border"), 0.5))
    assert_close(made.vertices[:, 0], torch.full((len(made.vertices),), 0.5), 1e-15)
    assert made.vertices[:, 1:].abs().max() == 0.5
    assert as_trimesh(made).area == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"step": 0}, "positive number of voxels; got 0"),
        ({"step": float("nan")}, "got nan"),
        ({"step": True}, "got True"),
        ({"step": 1e-5}, "at most 67,108,864 grid points in a layer"),
        ({"outside": "in"}, "lower or greater; got 'in'"),
    ],
)
def test_what_cannot_be_meshed_is_refused(arguments, words):
    with pytest.raises(ValueError, match=words):
        mesh(LevelSet(field_of(closed_noise(), "notch"), 0.0), **arguments)


def test_a_mesh_is_that_of_a_surface():
    with pytest.raises(TypeError, match="surface must be a Surface"):
        mesh(field_of(closed_noise(), "notch"))  # type: ignore[arg-type]


# --- files ------------------------------------------------------------------------------------------------------------


@pytest.fixture
def made() -> Mesh:
    return mesh(LevelSet(field_of(closed_noise(), "triquadratic"), LEVEL))


@pytest.mark.parametrize("ending", MESH_FORMATS)
def test_files_hold_the_mesh(ending, made, tmp_path):
    path = tmp_path / f"surface{ending.upper()}"
    save_mesh(made, path)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    read = trimesh.load(path, file_type=ending[1:], process=False, maintain_order=True)
    corners = made.vertices[made.faces].numpy()
    assert_close(read.vertices[read.faces], corners, 0.0 if ending == ".obj" else 1e-6)
    if ending != ".stl":
        assert_close(read.vertex_normals, made.normals, 1e-6)
        assert read.is_watertight


def test_a_file_appears_whole_or_not_at_all(made, tmp_path, monkeypatch):
    path = tmp_path / "surface.ply"
    path.write_text("old")

    def full(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr("filterlab.io.atomic._flush", full)
    with pytest.raises(OSError, match=r"surface\.ply"):
        save_mesh(made, path)
    assert path.read_text() == "old"
    assert len(list(tmp_path.iterdir())) == 1


def test_another_ending_is_refused(made, tmp_path):
    with pytest.raises(ValueError, match=r"ends in \.ply, \.obj, \.stl; got .*surface\.vtk"):
        save_mesh(made, tmp_path / "surface.vtk")


def test_without_trimesh_the_extra_is_named(made, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "trimesh", None)
    with pytest.raises(ValueError, match=r"pip install 'filterlab\[mesh\]'"):
        save_mesh(made, tmp_path / "surface.ply")


# --- the command ------------------------------------------------------------------------------------------------------


@pytest.fixture
def volume_file(tmp_path: Path) -> Path:
    samples = (40 * (closed_noise() + 3)).round().to(torch.uint8)
    fl.save_volume(fl.Volume(samples, spacing=(1, 2, 3), origin=(10, 20, 30)), tmp_path / "in.nrrd")
    return tmp_path / "in.nrrd"


def test_a_volume_and_a_level_are_a_mesh(volume_file, tmp_path):
    out = tmp_path / "out.obj"
    words = [
        "mesh",
        volume_file,
        "--level",
        "130",
        "-o",
        out,
        "--method",
        "notch",
        "--step",
        "0.5",
        "--outside=greater",
    ]
    assert main(list(map(str, words))) == 0
    read = trimesh.load(out, process=False, maintain_order=True)
    field = fl.reconstruct(fl.load_volume(volume_file), "notch")
    assert_close(field(torch.from_numpy(read.vertices.copy())), np.full(len(read.vertices), 130.0), 1e-11)
    assert read.is_watertight
    assert read.volume < 0


def test_a_scene_with_a_surface_is_a_mesh(tmp_path):
    scene = tmp_path / "scene.yaml"
    scene.write_text("signal: {name: sphere, samples: 12}\nsurface: 0.5\n")
    assert main(["mesh", str(scene), "-o", str(tmp_path / "a.stl")]) == 0
    assert trimesh.load(tmp_path / "a.stl").volume == pytest.approx(4 / 3 * np.pi * 0.6**3, rel=0.1)
    scene.write_text(
        "signal: {name: sphere, samples: 12}\ntransfer: {points: [{value: 0, color: [1, 1, 1], opacity: 1}]}"
    )
    assert main(["mesh", str(scene), "-o", str(tmp_path / "b.stl")]) == 1
    assert not (tmp_path / "b.stl").exists()


def test_a_plan_of_a_mesh_makes_none(volume_file, tmp_path, capsys):
    before = sorted(tmp_path.iterdir())
    assert main(["mesh", str(volume_file), "--level", "130", "--explain"]) == 0
    printed = capsys.readouterr().out
    made = mesh(LevelSet(fl.reconstruct(fl.load_volume(volume_file)), 130))
    assert f"about {len(made.faces):,} triangles" in printed  # so few points that the grid of the plan is no coarser
    assert "15 × 13 × 14 points" in printed
    assert sorted(tmp_path.iterdir()) == before


@pytest.mark.parametrize(
    ("words", "code", "message"),
    [
        (["--level", "130"], 2, "either -o FILE.ply or --explain; got neither"),
        (["--level", "130", "-o", "a.ply", "--explain"], 2, "got both"),
        (["--level", "130", "-o", "a.vtk"], 1, "ends in .ply, .obj, .stl"),
        (["--level", "130", "-o", "none/a.ply"], 1, "an existing folder"),
        (["--level", "130", "-o", "a.ply", "--step", "-1"], 1, "positive number of voxels; got -1"),
        (["--level", "130", "-o", "a.ply", "--outside", "lowr"], 1, "did you mean 'lower'"),
        (["--level", "130", "-o", "a.ply", "--methd", "notch"], 1, "did you mean 'method'"),
        (["--level", "130", "-o", "a.ply", "--method", "notc"], 1, "did you mean 'notch'"),
        (["--level", "high", "-o", "a.ply"], 1, "level"),
        (["-o", "a.ply"], 1, "a volume and --level"),
        (["--level", "999", "-o", "a.ply"], 0, "nothing crosses level 999"),
    ],
)
def test_mistakes_are_told_in_a_line(words, code, message, volume_file, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["mesh", volume_file.name, *words]) == code
    printed = capsys.readouterr()
    assert message in printed.err
    assert "Traceback" not in printed.err
    assert (tmp_path / "a.ply").exists() == (code == 0)
