"""`slim_error` and `quadrics_gallery`: shapes against closed forms, triangles as near, records, pictures, reports."""

import math

import numpy as np
import pytest
import torch
import yaml

from experiments import quadrics_gallery, slim_error
from experiments.__main__ import main
from experiments.runs import read_records
from experiments.simplified import SmoothTriangles, closed_grid, simplified
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


def test_covers_are_told_of_beside_triangles(undrawn, ran):
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
    content = {"experiment": "quadrics_gallery", "points": 1500, "tolerance": 3e-3, "size": [24, 20], "samples": 12}
    records, folder = ran({**content, "scan": "there-is-none.ply", "fuel": {"file": "none.nrrd", "optional": True}})
    assert {key.split("/")[0] for key in records} == set(quadrics_gallery.PICTURES) - {"scan"}
    images = {key: load_image(folder / record["image"]) for key, record in records.items()}
    for image in images.values():
        assert float(image.max()) > 0.2
    assert records["culling/all"]["left"] < 0.8 * records["culling/all"]["balls"]
    assert (images["culling/all"] == images["culling/left"]).all()
    assert records["edges/cut"]["sharp"] > 0
    assert not (images["quads/bilinear"] == images["quads/two-triangles"]).all()
    for data in ("fuel", "marschner-lobb"):
        assert (images[f"levels/{data}-stored"] - images[f"levels/{data}-walked"]).abs().max() < 0.01
        assert records[f"levels/{data}-stored"]["differ"] == 0 < records[f"levels/{data}-stored"]["tetrahedra"]
    cover = records["triangles/cover"]["rms"]
    assert max(records[f"triangles/{name}"]["rms"] for name in ("simplified", "marching-cubes")) <= cover
    assert records["triangles/simplified"]["triangles"] < records["triangles/marching-cubes"]["triangles"]
    assert (folder / "report.html").read_text().count("data:image/png") == len(records)


def test_a_scan_is_covered_and_seen(tmp_path, ran):
    np.savetxt(tmp_path / "ball.xyz", SHAPES["ellipsoid"].draw(600, 0))
    content = {"experiment": "quadrics_gallery", "points": 500, "tolerance": 3e-2, "size": [8, 8], "samples": 6}
    records, folder = ran({**content, "scan": str(tmp_path / "ball.xyz")})
    image = load_image(folder / records["scan/phong"]["image"])
    assert float(image[4, 4].max()) > 0.2 > float(image[0, 0].max())


def test_meshes_are_simplified_to_an_error_and_shaded_smoothly():
    shape = SHAPES["torus"]
    at = np.stack(np.meshgrid(np.arange(60) / 60, np.arange(24) / 24, indexing="ij"), -1)
    vertices, triangles = closed_grid(torch.from_numpy(shape.at(at)))
    seen = shape.draw(300, 1)
    mesh = simplified(vertices, triangles, lambda own: slim_error.along_normals(shape, own, seen)[0], 3e-3)
    assert len(mesh) < len(triangles) / 2
    rms, missed = slim_error.along_normals(shape, mesh, seen)
    assert missed == 0
    assert 1.5e-3 < rms <= 3e-3
    points, normals = torch.from_numpy(seen), torch.from_numpy(shape.normal(seen))
    origins = points + 0.2 * normals
    fine = SmoothTriangles(vertices, triangles)
    hit = fine.hit(origins, -normals)
    smooth, flat = (own(origins, -normals, hit).normal for own in (fine.at, super(SmoothTriangles, fine).at))
    off, off_flat = ((own - normals).norm(dim=1).square().mean().sqrt() for own in (smooth, flat))
    assert off < off_flat / 5


def test_the_block_has_a_hole_and_outward_normals():
    points, normals = quadrics_gallery.block(5000, 0)
    assert np.hypot(points[:, 0], points[:, 1]).min() > 0.99 * 0.35
    assert np.allclose(np.linalg.norm(normals, axis=1), 1)
    outside = points + 1e-3 * normals
    inside = (np.abs(outside) < [1, 0.7, 0.45]).all(1) & (np.hypot(outside[:, 0], outside[:, 1]) > 0.35)
    assert not inside.any()
