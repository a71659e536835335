"""`slim_error` and `quadrics_gallery`: shapes against closed forms, triangles as near, records, pictures, reports."""

import math

import numpy as np
import pytest
import torch
import yaml

from experiments import quadrics_gallery, slim_error
from experiments.__main__ import main
from experiments.runs import read_records
from experiments.simplified import SmoothTriangles, as_near
from experiments.slim_error import AXES, RING, SHAPES, TUBE
from filterlab.io.images import load_image


@pytest.fixture
def ran(tmp_path):
    def run(content):
        path = tmp_path / "tiny.yaml"
        path.write_text(yaml.safe_dump({"description": "tiny", **content}))
        assert main(["run", str(path), "--runs", str(tmp_path / "runs")]) == 0
        (folder,) = (tmp_path / "runs").iterdir()
        return read_records(folder)[0], folder

    return run


@pytest.mark.parametrize("name", SHAPES)
def test_points_lie_on_their_shape_evenly_with_its_normals(name):
    shape = SHAPES[name]
    points = shape.draw(20_000, 0)
    assert len(points) == 20_000
    assert np.abs(shape.distance(points)).max() < 1e-12
    assert np.abs(shape.distance(shape.at(np.random.default_rng(1).uniform(size=(500, 2))))).max() < 1e-12
    step = 1e-6 * shape.normal(points)
    assert np.allclose(shape.distance(points + step), 1e-6, rtol=1e-4)
    if name == "torus":  # the outer half has more than half of the area
        share = np.mean(np.hypot(points[:, 0], points[:, 1]) > RING)
        assert share == pytest.approx(0.5 + TUBE / (np.pi * RING), abs=0.01)
    else:  # ∫ |x| dA is that of a fine grid of triangles
        ends = np.random.default_rng(2).standard_normal((400_000, 3))
        ends /= np.linalg.norm(ends, axis=1, keepdims=True)
        area = np.linalg.norm(ends / AXES, axis=1)
        expected = (np.abs(ends * AXES) * area[:, None]).sum(0) / area.sum()
        assert np.abs(points).mean(0) == pytest.approx(expected, abs=0.01)


def test_a_diagonal_is_that_of_the_box():
    assert SHAPES["torus"].diagonal == pytest.approx(math.hypot(2.8, 2.8, 0.8), rel=1e-3)


def test_four_times_as_many_triangles_are_four_times_as_near():
    shape = SHAPES["torus"]
    few, many = slim_error.off_grid(shape, 1000), slim_error.off_grid(shape, 4000)
    assert few / many == pytest.approx(4, rel=0.1)
    assert slim_error._off(shape, *slim_error.as_near(shape, few)) == pytest.approx(few, rel=0.1)


def test_covers_are_told_of_beside_triangles(ran):
    study = {"shape": "torus", "points": 2500, "tolerances": [3e-3, 5e-4]}
    records, folder = ran({"experiment": "slim_error", "studies": [study], "rays": 200, "orders": [2]})
    few, many = records["0/2/0"], records["0/2/1"]
    assert many["balls"] > 2 * few["balls"]
    for record in (few, many):
        assert record["missed"] == 0
        assert record["rms"] < record["tolerance"]
        assert record["rms"] < record["first"]
        assert record["rms"] < record["triangles_rms"]
        assert record["triangles"] > record["balls"]
    assert records["0/2/fit"]["rms_slope"] > 1
    assert "second order" in (folder / "report.html").read_text()


@pytest.mark.parametrize("study", [{"tolerances": [0.1]}, {"shape": "torus", "tolerances": [1e-4, 1e-3]}])
def test_studies_that_make_no_sense_are_refused(study):
    with pytest.raises(ValueError, match="expected"):
        slim_error.Study.model_validate(study)


def test_every_picture_shows_something_and_is_in_the_report(ran):
    content = {"experiment": "quadrics_gallery", "points": 1500, "tolerance": 3e-3, "size": [24, 20], "samples": 10}
    records, folder = ran(content)
    assert len(records) == sum(map(len, quadrics_gallery.PICTURES.values()))
    for record in records.values():
        image = load_image(folder / record["image"])
        assert float(image.max()) > 0.2 > float(image[0, 0].max())
    assert records["culling/all"]["left"] < 0.8 * records["culling/all"]["balls"]
    assert (
        load_image(folder / records["culling/all"]["image"]) == load_image(folder / records["culling/left"]["image"])
    ).all()
    assert records["edges/cut"]["sharp"] > 0
    cover, simplified = (records[f"triangles/{name}"] for name in ("cover", "simplified"))
    assert 0.5 * cover["rms"] < simplified["rms"] <= cover["rms"]
    shown = {key: load_image(folder / record["image"]) for key, record in records.items()}
    for which in ("signal", "volume"):
        quadrics, walk = (shown[f"level-sets/{which}-{how}"] for how in ("quadrics", "walk"))
        assert float((quadrics - walk).abs().max()) <= 1 / 255 + 1e-6
        assert records[f"level-sets/{which}-quadrics"]["tetrahedra"] > 100
    assert records["level-sets/volume-walk"]["shown"] == "jet"
    assert float((shown["quads/bilinear"] - shown["quads/two-triangles"]).abs().max()) > 0.1
    assert (folder / "report.html").read_text().count("data:image/png") == len(records)


def test_the_block_has_a_hole_and_outward_normals():
    points, normals = quadrics_gallery.block(5000, 0)
    assert np.hypot(points[:, 0], points[:, 1]).min() > 0.99 * 0.35
    assert np.allclose(np.linalg.norm(normals, axis=1), 1)
    outside = points + 1e-3 * normals
    inside = (np.abs(outside) < [1, 0.7, 0.45]).all(1) & (np.hypot(outside[:, 0], outside[:, 1]) > 0.35)
    assert not inside.any()


def test_normals_of_smooth_triangles_are_those_between_corners():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    normals = torch.tensor([[0.0, 0, 1], [0.6, 0, 0.8], [0, 0.6, 0.8]], dtype=torch.float64)
    triangle = SmoothTriangles(torch.from_numpy(vertices), torch.tensor([[0, 1, 2]]), normals)
    weights = torch.tensor([[1.0, 1, 1], [8, 1, 1], [1, 2, 5]], dtype=torch.float64)
    weights = weights / weights.sum(1, keepdim=True)
    down = torch.tensor([0.0, 0, -1], dtype=torch.float64).expand(3, 3)
    origins = (weights[..., None] * torch.from_numpy(vertices)).sum(1) - 2 * down
    seen = triangle.at(origins, down, triangle.hit(origins, down))
    expected = torch.nn.functional.normalize((weights[..., None] * normals).sum(1), dim=1)
    torch.testing.assert_close(seen.normal, expected)


def test_a_mesh_that_is_too_rough_is_not_simplified():
    vertices, faces = quadrics_gallery._fine(1e-2)
    with pytest.raises(ValueError, match="nearer"):
        as_near(vertices, faces, 1e-9, lambda mesh: 1e-3)


def test_the_column_has_one_outside():
    """Every edge is gone along once in each way, and the volume within is positive."""
    vertices, quads = quadrics_gallery.column()
    ways = torch.stack((quads, quads.roll(-1, 1)), -1).flatten(0, 1)
    assert sorted(ways.tolist()) == sorted(ways.flip(1).tolist())
    a, b, c, d = vertices[quads].unbind(1)
    volume = sum((x * torch.linalg.cross(y, z)).sum() for x, y, z in ((a, b, c), (a, c, d)))
    assert volume > 0


def test_paraboloids_that_are_cut_meet_at_the_plane():
    x = torch.tensor([-0.3, -0.2, -0.1, 0.1, 0.2, 0.3], dtype=torch.float64)
    origins = torch.stack((x, 0 * x, 0 * x + 3), 1)
    down = torch.tensor([0.0, 0, -1], dtype=torch.float64).expand(6, 3)
    for cut, sheets in ((True, 1), (False, 2)):
        hits = quadrics_gallery.paraboloids(cut).hits(origins, down, 3)
        assert (hits.valid.sum(1) == sheets).all()
