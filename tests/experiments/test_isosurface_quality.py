"""`isosurface_quality`: errors of what is seen, absent scans, zooms, what is refused."""

import json

import numpy as np
import pytest
import torch
import yaml

import filterlab as fl
from experiments.__main__ import main
from experiments.isosurface_quality import Config, SurfaceDistance, noisy
from experiments.registry import EXPERIMENTS
from experiments.runs import read_records
from filterlab.io import load_image
from tests.laws import assert_close

FIGURE = {
    "title": "a torus",
    "signal": "torus",
    "resolution": 10,
    "surface": 0,
    "methods": ["trilinear", "tricubic"],
    "look": {"size": [16, 16], "camera": {"direction": [0.2, 0.5, -1]}},
    "zooms": [{"title": "its upper left", "window": [0, 0, 0.5, 0.5]}],
}


@pytest.fixture
def ran(tmp_path):
    def run(*figures, **changes):
        content = {"experiment": "isosurface_quality", "description": "tiny", "figures": figures, **changes}
        path = tmp_path / "surfaces.yaml"
        path.write_text(yaml.safe_dump(json.loads(json.dumps(content))))
        code = main(["run", str(path), "--runs", str(tmp_path / "runs")])
        if code:
            return code
        (folder,) = (tmp_path / "runs").iterdir()
        return folder, read_records(folder)[0], (folder / "report.html").read_text()

    return run


def test_the_better_method_is_nearer_to_the_signals_surface(ran):
    _, records, page = ran({**FIGURE, "resolution": 20}, dtype="float64")
    errors = {key.split("/")[1]: r["distance_median"] for key, r in records.items() if r["view"] == "whole"}
    assert errors["signal"] < 1e-12 < errors["tricubic"] < 0.1 * errors["trilinear"] < 0.1
    assert 0.3 < errors["marching-cubes"] / errors["trilinear"] < 3
    assert "torus itself" in page


def test_distances_are_those_to_a_sphere():
    signal = fl.signals.sphere(radius=0.6, edge=0.2).with_voxel_size(0.05)
    points = torch.nn.functional.normalize(torch.randn(50, 3, dtype=torch.float64), dim=-1) * 0.6004
    assert_close(SurfaceDistance(signal, 0.5)(points), np.full(50, 0.0004 / 0.05), 1e-5)


def test_noise_is_in_the_samples_alone(ran):
    """The truth stays; what is reconstructed from noisy samples is off by the noise over the gradient."""
    _, records, page = ran({**FIGURE, "resolution": 20, "noise": 0.01, "methods": ["tricubic"]}, dtype="float64")
    errors = {key.split("/")[1]: r["distance_median"] for key, r in records.items() if r["view"] == "whole"}
    assert errors["signal"] < 1e-12
    assert (
        0.02 < errors["tricubic"] < 0.5
    )  # 0.01 ÷ (0.6 · 0.1 world units a voxel), times what a median is of a deviation
    assert "with noise of standard deviation 0.01 in them" in page


def test_noise_is_independent_and_of_its_deviation():
    volume = fl.Volume(torch.zeros(20, 20, 20, dtype=torch.float64), spacing=(1.0, 2.0, 3.0))
    loud = noisy(volume, 0.5, 3)
    assert float(loud.samples.std()) == pytest.approx(0.5, rel=0.03)
    assert float((loud.samples[1:] * loud.samples[:-1]).mean()) == pytest.approx(0, abs=0.01)
    assert loud.geometry == volume.geometry
    assert torch.equal(noisy(volume, 0.5, 3).samples, loud.samples)
    assert not torch.equal(noisy(volume, 0.5, 4).samples, loud.samples)
    assert noisy(volume, 0.0, 3) is volume


def test_colours_tell_errors(ran):
    """Blue where the surface is right, red where it is off by the limit."""
    look = {**FIGURE["look"], "background": [0, 0, 0], "lighting": {"ambient": 1, "diffuse": 0, "specular": 0}}
    material = {"kind": "phong", "ambient": 1, "diffuse": 0, "specular": 0}
    surface = {"level": 0, "material": material}
    figure = {**FIGURE, "surface": surface, "look": {**look, "error": 0.01}, "methods": ["trilinear"], "zooms": []}
    folder, records, _ = ran(figure)
    found = {}
    for name in ("signal", "trilinear"):
        image = load_image(folder / records[f"0/{name}/whole"]["image"]).reshape(-1, 3)
        found[name] = image[image.sum(-1) > 0].mean(0)
    assert found["signal"][2] > 5 * found["signal"][0]
    assert found["trilinear"][0] > 2 * found["trilinear"][2]


def test_a_zoom_casts_the_rays_of_its_part(ran):
    folder, records, _ = ran({**FIGURE, "look": {**FIGURE["look"], "size": [32, 32]}})
    other = {**FIGURE, "look": {**FIGURE["look"], "size": [16, 16]}}
    whole = load_image(folder / records["0/tricubic/whole"]["image"])
    for path in folder.parent.iterdir():
        path.rename(path.parent.parent / "first")
    folder, records, _ = ran(other)
    zoom = load_image(folder / records["0/tricubic/zoom-1"]["image"])
    assert (whole[:16, :16] - zoom).abs().max() < 0.02
    assert zoom.std() > 0.05


def test_a_scan_that_is_not_here_is_skipped_with_a_word(ran, tmp_path):
    scan = {**FIGURE, "signal": None, "resolution": None, "volume": {"file": "lost.nrrd", "optional": True}}
    scan = {k: v for k, v in scan.items() if v is not None}
    _, records, page = ran(scan)
    assert list(records) == ["0/absent/whole"]
    assert "Skipped: there is no file lost.nrrd here." in page
    fl.save_volume(fl.Volume(torch.rand(5, 6, 7)), tmp_path / "lost.nrrd")
    needed = {**scan, "volume": str(tmp_path / "none.nrrd")}
    assert ran(needed) == 2
    here = {**scan, "volume": str(tmp_path / "lost.nrrd")}
    content = {"experiment": "isosurface_quality", "description": "x", "figures": [here]}
    assert len(EXPERIMENTS["isosurface_quality"].units(Config.model_validate(content))) == 2 * 3


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"resolution": None}, "either a signal and its resolution, or a volume"),
        ({"volume": "scan.nrrd"}, "either a signal"),
        ({"surface": {"level": 0, "sheets": 2}}, "sheets: 1"),
        ({"surface": {"level": 0, "material": "toon"}, "look": {"error": 1.0}}, "expected the material phong"),
        ({"signal": "tours"}, "did you mean 'torus'"),
    ],
)
def test_what_has_no_picture_is_refused(changes, words, ran, capsys):
    assert ran({**FIGURE, **changes}) == 2
    assert words in capsys.readouterr().err
