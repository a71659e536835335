"""Every experiment on tiny parameters: its records, its report, and what it must show."""

import hashlib
import json
import math
import os
import re
import struct
import sys
from collections.abc import Callable
from copy import deepcopy
from functools import cache
from pathlib import Path

import nibabel
import numpy as np
import pytest
import torch
import yaml

import filterlab as fl
from experiments import rms_error
from experiments.__main__ import main
from experiments.config import Recipe, VolumeChoice, input_files
from experiments.dvr_signal import amplified_difference, displayed, image_errors
from experiments.headings import known_configs
from experiments.registry import EXPERIMENTS, load
from experiments.runs import read_provenance, read_records
from experiments.views import View
from filterlab.cli import main as filterlab_main
from filterlab.io import load_image

VIEW = {
    "size": [24, 16],
    "step": 1,
    "camera": {"direction": [0.2, 1.0, -0.8]},
    "transfer": {"unit": 0.1, "peaks": [{"center": 0.5, "width": 0.4, "height": 0.9, "color": [0.9, 0.5, 0.2]}]},
    "lighting": {"ambient": 0.3},
    "background": [1, 1, 1],
}


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    z, y, x = torch.meshgrid(*(torch.linspace(-1, 1, n) for n in (9, 10, 11)), indexing="ij")
    samples = (torch.exp(-3 * (x * x + y * y + z * z)) * 255).to(torch.uint8)
    path = tmp_path_factory.mktemp("scan") / "scan.nrrd"
    fl.io.save_volume(fl.Volume(samples, spacing=(1.0, 1.1, 1.3)), path)
    return path


def ridge(path):
    """Heights 5 apart, from 0 to 30."""
    y, x = np.mgrid[0:11, 0:10] / 10.0
    fl.save_heights(fl.Heights(30 * np.exp(-8 * (x - y) ** 2), (5.0, 5.0)), path)
    return path


def tiny(name, scan):
    """The smallest sensible config of every experiment."""
    volume_view = {**VIEW, "transfer": {"peaks": [{"center": 120, "width": 90, "height": 0.5, "color": [1, 1, 1]}]}}
    configs = {
        "frequency_response": {
            "methods": ["trilinear", "catmull-rom"],
            "figures": [{"title": "both", "methods": ["trilinear", "catmull-rom"], "caption": "two curves"}],
            "samples": 17,
            "markers": 9,
            "dimensions": [1],
        },
        "terrain_error": {"splines": ["linear", "c1", "c2 prefiltered"], "steps": [12, 24], "points": 50},
        "partitions": {"splines": ["quadratic-c1", "qss"], "fineness": 2},
        "rms_error": {
            "studies": [{"signal": "gaussian", "resolutions": [4, 6], "fit_from": 4}],
            "methods": ["trilinear", {"name": "trilinear", "gradient": "central"}, "notch"],
            "points": 20,
        },
        "dvr_signal": {
            "signal": "marschner-lobb",
            "resolution": 10,
            "methods": ["trilinear", {"name": "notch", "prefilter": False}],
            "view": VIEW,
        },
        "dvr_volume": {
            "volume": str(scan),
            "methods": ["ncrsi", "triquadratic"],
            "reference": "triquadratic",
            "view": volume_view,
            "zooms": [{"title": "the middle", "window": [0.25, 0.25, 0.75, 0.75]}],
        },
        "texture_precision": {
            "methods": [{"name": "trilinear", "gradient": "central"}, "triquadratic"],
            "image_methods": ["triquadratic"],
            "sources": [
                {"title": "signal", "signal": "gaussian", "resolution": 12, "view": VIEW},
                {"title": "scan", "volume": str(scan)},
            ],
            "points": 200,
        },
        "inverse_dvr": {
            "signal": "gaussian",
            "resolution": 4,
            "methods": ["trilinear"],
            "views": {"training": 2, "held_out": 1, "size": 6, "shown": 6},
            "volume": {
                "transfer": VIEW["transfer"],
                "stages": [{"resolution": 4, "iterations": 2, "learning_rate": 0.1}],
                "rays": 20,
            },
            "transfer_function": {
                "target": deepcopy(VIEW["transfer"]),  # else YAML writes an alias
                "points": 3,
                "iterations": 2,
                "learning_rate": 0.1,
                "rays": 20,
            },
        },
        "fit_kernel": {
            "classes": [{"kind": "waves", "title": "waves", "bandwidth": 0.5, "waves": 4}],
            "candidates": [{"kernel": "notch", "prefilter": 3}],
            "methods": ["triquadratic", "notch"],
            "resolution": 6,
            "training": 1,
            "validation": 1,
            "test": 1,
            "points": 10,
            "test_points": 10,
            "repetitions": 1,
            "iterations": 2,
        },
    }
    configs["brick_economy"] = {
        "scans": [{"file": "not_here.nrrd", "optional": True}],
        "signals": [{"signal": "gaussian", "resolution": 12}],
        "methods": ["triquadratic"],
        "budgets": [0.001, 0.01],
        "points": 100,
        "timed_points": 100,
        "size": 4,
        "seconds": 0,
    }
    configs["equal_error"] = {
        "studies": [{"signal": {"name": "gaussian", "parameters": {"sigma": 0.5}}}],
        "comparisons": [
            {"quantity": "value", "usual": "trilinear"},
            {"quantity": "gradient", "usual": {"name": "trilinear", "gradient": "central"}},
        ],
        "resolutions": [8, 12],
        "methods": ["triquadratic", {"name": "triquadratic", "prefilter": False}],
        "largest": 12,
        "points": 200,
        "timed_points": 50,
        "seconds": 0,
    }
    configs["speed_accuracy"] = {
        "sources": [{"signal": "gaussian", "view": deepcopy(VIEW)}],
        "resolutions": [8],
        "methods": [{"name": "trilinear", "gradient": "central"}, "triquadratic"],
        "variants": [
            {"name": "float32"},
            {"name": "float16", "storage": "float16"},
            {"name": "eight samples", "scheme": "sampled"},
        ],
        "images": [
            {"title": "steps", "methods": ["triquadratic"], "resolutions": [8], "steps": [2, 1], "shown": [8, 1]},
            {"title": "one step", "methods": ["trilinear"], "resolutions": [8], "steps": [1]},
        ],
        "points": 50,
        "timed_points": 50,
        "seconds": 0,
        "image_seconds": 0,
        "finest": 32,
    }
    configs["recommend_validation"] = {
        "classes": ["waves", "steps"],
        "each": 2,
        "sizes": [4, 12],
        "scans": [str(scan), {"file": "not_here.nrrd", "optional": True}],
        "pieces": 3,
        "boundaries": 1,
        "budgets": 2,
        "methods": ["trilinear", "triquadratic"],
        "points": 200,
        "seconds": 0.01,
    }
    configs["stability"] = {"methods": ["trilinear"], "cases": ["nan-coordinate"], "amount": 0.02}
    configs["inverse_surface"] = {
        "balls": [{"center": [0.2, 0, 0], "sigma": 0.3}],
        "target_resolution": 8,
        "resolution": 6,
        "method": "trilinear",
        "views": {"training": 2, "held_out": 1, "size": 6, "shown": 8, "at_once": 1},
        "descent": {"iterations": 2, "learning_rate": 0.01},
    }
    configs["inverse_terrain"] = {
        "samples": 7,
        "views": {"count": 2, "size": 6, "shown": 8},
        "descent": {"iterations": 2, "learning_rate": 0.05},
    }
    configs["terrain_quality"] = {
        "splines": ["linear", "c1"],
        "reference": {"spline": "linear", "steps": 20},
        "points": 200,
        "size": [12, 8],
        "subpixels": 1,
    }
    if name == "terrain_views":  # a file of heights is written for it
        configs["terrain_views"] = {
            "places": [
                {
                    "title": "a ridge",
                    "heights": str(ridge(scan.with_name("ridge.npz"))),
                    "views": [
                        {"title": "as it is", "size": [12, 8], "terrain": {"subpixels": 1}},
                        {
                            "title": "a flight",
                            "size": [12, 8],
                            "terrain": {"subpixels": 1, "haze": 500},
                            "flight": {"points": [[5, 30, 20], [40, 35, 20]]},
                            "frames": 2,
                        },
                    ],
                },
                {"title": "none", "heights": {"file": "not_here.tif", "optional": True}, "views": [{"title": "none"}]},
            ]
        }
    configs["silhouettes"] = {
        "methods": ["trilinear"],
        "volumes": ["ball"],
        "parameters": ["level"],
        "quantities": ["mask"],
        "size": 4,
        "subpixels": 1,
        "lines": 1,
        "parts": 1,
        "estimates": 2,
        "rows": 2,
        "repeats": 2,
    }
    configs["quadrics_numerics"] = {
        "dtypes": ["float32"],
        "alphas": [1, 1e-6],
        "distances": [30],
        "heights": [1, 1e-4],
        "covers": [100],
        "offsets": [0, 0.5],
        "count": 500,
        "quadrics": 60,
        "points": 2,
    }
    configs["root_finding"] = {
        "families": ["random", "double", "root-at-end"],
        "degrees": [4, 5],
        "dtypes": ["float32"],
        "count": 40,
        "kornia": 5,
        "exact": 5,
        "chunk": 25,
    }
    configs["terrain_roots"] = {
        "families": ["grazing rays", "rays at the C1 terrain"],
        "dtypes": ["float32", "float64"],
        "count": 12,
    }
    configs["terrain_frames"] = {"splines": ["c1"], "sizes": [16, 32], "angles": [30], "pixels": 6, "seconds": 0.01}
    configs["hit_error"] = {
        "studies": [{"signal": "torus", "level": 0, "resolutions": [8, 12], "fit_from": 8}],
        "methods": ["trilinear", {"name": "trilinear", "gradient": "central"}, "triquadratic"],
        "rays": 40,
    }
    configs["prefilters_on_tetrahedra"] = {
        "splines": ["cubic-c1"],
        "learning": {
            "source": {"kind": "waves", "title": "waves", "bandwidth": 0.5, "waves": 4},
            "taps": [3],
            "training": 1,
            "validation": 1,
            "test": 1,
            "points": 10,
            "test_points": 10,
            "resolution": 6,
            "iterations": 2,
        },
        "signal": "gaussian",
        "resolutions": [6],
        "noise": [0.1],
        "points": 20,
        "frequencies": 5,
        "pictures": {"signal": "torus", "resolution": 8, "level": 0, "noise": 0.01, "look": {"size": [8, 6]}},
    }
    configs["isosurface_quality"] = {
        "figures": [
            {
                "title": "a signal",
                "signal": "torus",
                "resolution": 8,
                "surface": 0,
                "methods": ["triquadratic"],
                "look": {"size": [12, 10], "error": 0.5},
                "zooms": [{"title": "the middle", "window": [0.25, 0.25, 0.75, 0.75]}],
            },
            {
                "title": "a scan",
                "volume": str(scan),
                "surface": {"level": 120, "material": "reflection_lines", "subpixels": 2},
                "methods": ["notch"],
                "look": {"size": [12, 10]},
            },
            {
                "title": "no scan",
                "volume": {"file": "not_here.nrrd", "optional": True},
                "surface": 120,
                "methods": ["notch"],
            },
        ]
    }
    configs["tetrahedral_table"] = {
        "sources": [
            {
                "title": "a signal",
                "signal": "torus",
                "resolution": 8,
                "level": 0,
                "zoom": {"title": "the middle", "window": [0.25, 0.25, 0.75, 0.75]},
            },
            {
                "title": "no scan",
                "volume": {"file": "not_here.nrrd", "optional": True},
                "level": 120,
                "zoom": {"title": "the middle", "window": [0.25, 0.25, 0.75, 0.75]},
            },
        ],
        "methods": ["qss", "cubic-c1", "quadratic-c1"],
        "sizes": [[24, 20]],
        "scale": 0.5,
        "points": 20,
        "seconds": 0,
    }
    configs["quadrics_tables"] = {
        "covers": [80],
        "sets": [100],
        "sizes": [[12, 10]],
        "rays": 30,
        "quadrics": 8,
        "seconds": 0,
    }
    configs["slim_error"] = {
        "studies": [{"shape": "torus", "points": 400, "tolerances": [3e-2, 1e-2]}],
        "rays": 20,
        "orders": [2],
    }
    configs["quadrics_gallery"] = {"points": 500, "tolerance": 1e-2, "size": [12, 10], "samples": 10}
    configs["inverse_slim"] = {
        "target_balls": 100,
        "balls": 60,
        "unknowns": ["numbers", "points"],
        "points": 150,
        "views": {"training": 2, "held_out": 1, "size": 6, "shown": 8, "at_once": 1},
        "descent": {"iterations": 2, "learning_rate": 0.01},
    }
    parts = {n: {"experiment": n, "description": f"tiny {n}", **c} for n, c in configs.items()}
    parts["demo"] = {"experiment": "demo", "description": "tiny", "sections": [parts["rms_error"], parts["dvr_volume"]]}
    if name not in parts:
        pytest.fail(f"the experiment {name} has no tiny config: add one to `tiny` in {Path(__file__).name}")
    return parts[name]


@pytest.fixture(scope="module")
def ran(tmp_path_factory, scan):
    """Runs a tiny config, each once; gives its folder, records and report."""

    @cache
    def run(name, changes):
        folder = tmp_path_factory.mktemp(name)
        path = folder / f"{name}.yaml"
        path.write_text(yaml.safe_dump({**tiny(name, scan), **json.loads(changes)}))
        assert main(["run", str(path), "--runs", str(folder / "runs")]) == 0
        (folder,) = (folder / "runs").iterdir()
        return folder, read_records(folder)[0], (folder / "report.html").read_text()

    return lambda name, **changes: run(name, json.dumps(changes))


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_every_experiment_runs_and_draws(name, ran):
    folder, records, page = ran(name)
    assert records
    assert f"{len(records)} of {len(records)} units" in page
    for line in (folder / "records.jsonl").read_text().splitlines():
        json.loads(line, parse_constant=pytest.fail)  # NaN and infinities are no JSON
    assert page.count("data:image/png") == sum(
        f.endswith(".png") for record in records.values() for f in record.get("files", [])
    )
    assert all("seconds" in record for record in records.values())


def test_frequency_responses_agree(ran):
    folder, records, _ = ran("frequency_response")
    for record in records.values():
        assert record["largest_difference"] < 1e-6
        assert np.load(folder / record["closed"])[0] == pytest.approx(1)
    assert records["trilinear"]["smoothing_1d"] > records["catmull-rom"]["smoothing_1d"]


def test_errors_are_those_of_the_definition(ran):
    """One record recomputed by hand: other points would give another number."""
    _, records, _ = ran("rms_error")
    signal = fl.signals.gaussian()
    unit = torch.rand(20, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    points = 0.9 * (2 * unit - 1)
    field = fl.reconstruct(signal.sample(6), "notch", boundary="reflect")
    value, gradient = signal.value_and_gradient(points)
    v, g = field.value_and_gradient(points)
    record = records["0/6/notch"]
    assert record["value_rms"] == pytest.approx(float((v - value).square().mean().sqrt()), rel=1e-12)
    assert record["gradient_rms"] == pytest.approx(float((g - gradient).square().sum(-1).mean().sqrt()), rel=1e-12)
    other = records["0/6/trilinear+central"]
    assert other["value_rms"] == records["0/6/trilinear"]["value_rms"]
    assert other["gradient_rms"] != records["0/6/trilinear"]["gradient_rms"]


# Value and gradient errors at 32³ and 64³, computed once by independent float64 prototypes, by config.
KNOWN = {
    "rms_error": {
        ("trilinear", 32): (0.0448, 2.56),
        ("ncrsi", 32): (0.0405, 3.27),
        ("catmull-rom", 32): (0.0402, 2.21),
        ("triquadratic", 32): (0.0388, 2.12),
        ("notch", 32): (0.0570, 3.11),
        ("tricubic", 32): (0.0380, 2.05),
        ("trilinear", 64): (0.0150, 1.43),
        ("triquadratic", 64): (0.0028, 0.372),
        ("notch", 64): (0.0058, 0.446),
    },
    "tetrahedral_rms": {
        ("qss", 32): (0.0407, 2.26),
        ("cubic-c1", 32): (0.0390, 2.12),
        ("quadratic-c1", 32): (0.0433, 2.48),
        ("qss+unprefiltered", 32): (0.0523, 2.82),
        ("cubic-c1+unprefiltered", 32): (0.0513, 2.76),
        ("quadratic-c1+unprefiltered", 32): (0.0534, 2.89),
        ("qss", 64): (0.00293, 0.372),
        ("cubic-c1", 64): (0.00278, 0.352),
        ("quadratic-c1", 64): (0.00431, 0.580),
        ("qss+unprefiltered", 64): (0.0200, 1.13),
        ("cubic-c1+unprefiltered", 64): (0.0198, 1.12),
        ("quadratic-c1+unprefiltered", 64): (0.0204, 1.19),
    },
}


@pytest.mark.parametrize("name", KNOWN)
def test_marschner_lobb_errors_are_the_known_ones(name):
    known = sorted({n for _, n in KNOWN[name]})
    changes = {"studies.0.resolutions": str(known), "studies.0.fit_from": "null", "points": "20000"}
    _, _, config = load(name, changes)
    study = config.studies[0]
    points, value, gradient = rms_error._truth(config, study)
    assert study.signal.name == "marschner-lobb"
    assert study.inner == 0.9
    volumes = {n: study.signal.build().sample(n) for n in known}
    recipes = {recipe.key: recipe for recipe in config.methods}
    for (key, n), expected in KNOWN[name].items():
        v, g = rms_error.evaluate(recipes[key].build(volumes[n], config.boundary), points)
        found = fl.metrics.rms(v, value), fl.metrics.rms(g, gradient, vectors=True)
        for number, written in zip(found, expected, strict=True):
            # 2 %, plus the rounding of the two digits that 0.0028 and 0.0058 were written with
            assert float(number) == pytest.approx(written, rel=0.02, abs=5e-5 if written < 0.01 else 0), (key, n)


def test_the_slope_of_a_power_law_is_its_exponent():
    n = [10, 20, 35]
    assert rms_error.slope(n, [k**-3.5 for k in n]) == pytest.approx(3.5)
    assert rms_error.slope(n, [0.1, 0.0, 0.1]) is None


def test_images_compare_with_the_signal_itself(ran):
    folder, records, page = ran("dvr_signal")
    truth = records["signal"]
    assert np.load(folder / truth["array"]).shape == (16, 24, 3)
    blurred, sharp = records["notch+unprefiltered"], records["trilinear"]
    assert 0 < blurred["ssim"] < 1
    assert blurred["psnr"] == pytest.approx(-20 * math.log10(blurred["rms"]), abs=1e-3)
    assert sharp["files"] != blurred["files"]
    assert "notch, no prefilter" in page


def test_an_image_equals_itself():
    image = torch.rand(12, 12, 3, generator=torch.Generator().manual_seed(1))
    assert image_errors(image, image) == {"psnr": None, "ssim": 1.0, "rms": 0.0, "max": 0.0}
    assert amplified_difference(image, image, 4).abs().max() == 0
    grey = torch.full((8, 8, 3), 0.2)
    brighter = torch.full((8, 8, 3), 0.3)
    step = float((displayed(brighter) - displayed(grey))[0, 0, 0])
    assert float(amplified_difference(brighter, grey, 3)[0, 0, 0]) == pytest.approx(3 * step, rel=1e-5)


def test_a_zoom_is_a_magnified_part(scan):
    """The zoomed view at half the size, against the same rays of the whole view at double size."""

    class Silent:
        def advance(self, fraction):
            pass

    settings = tiny("dvr_volume", scan)["view"]
    view = View.model_validate_json(json.dumps({**settings, "size": [16, 16], "termination": None}))
    field = fl.reconstruct(fl.load_volume(scan), "triquadratic")
    whole = view.model_copy(update={"size": (32, 32)}).draw(field, Silent(), "cpu", "float64")
    part = view.through([0.25, 0.25, 0.75, 0.75]).draw(field, Silent(), "cpu", "float64")
    assert (whole[8:24, 8:24] - part).abs().max() < 1e-5
    assert part.std() > 0.01


def test_images_of_a_scan_are_compared_with_those_of_the_reference(ran):
    folder, records, page = ran("dvr_volume")
    for view in ("whole", "zoom-1"):
        other, own = records[f"ncrsi/{view}"], records[f"triquadratic/{view}"]
        assert "difference" not in own
        a, b = (load_image(folder / r["image"], srgb=False) for r in (other, own))
        shown = load_image(folder / other["difference"], srgb=False)
        assert (shown - (4 * (a - b).abs()).clamp(0, 1)).abs().max() <= 4.6 / 255  # each is rounded to 8 bits
        assert shown.max() > 0
        assert 0 < other["rms"] < 1
    assert "Absolute differences to the image of triquadratic" in page


def test_rounded_fractions_cost_more_than_float32(ran):
    _, records, _ = ran("texture_precision")
    for key in ("0/points/triquadratic", "1/points/trilinear+central"):
        variants = records[key]["variants"]
        assert variants["float64 eight samples"]["value_rms"] < 1e-14
        assert variants["float32 direct"]["value_rms"] < 1e-6
        for quantity in ("value_rms", "gradient_rms"):
            assert variants["float32 8-bit fractions"][quantity] > 30 * variants["float32 eight samples"][quantity]
    assert "method_error" in records["0/points/trilinear+central"]
    assert "method_error" not in records["1/points/trilinear+central"]
    assert records["0/image/triquadratic"]["psnr"] > 30


def test_the_demo_gives_what_its_parts_give(ran):
    _, records, page = ran("demo")
    parts = {key.partition("/")[0] for key in records}
    assert parts == {"0", "1"}
    assert "tiny rms_error" in page
    assert "tiny dvr_volume" in page
    own = {k: r["value_rms"] for k, r in records.items() if r.get("kind") == "error"}
    for key, record in ran("rms_error")[1].items():
        if record["kind"] == "error":
            assert own[f"0/{key}"] == record["value_rms"]


@pytest.mark.parametrize("kind", ["attached", "detached", "moved"])
def test_another_volume_of_the_same_name_is_another_run(kind, tmp_path, monkeypatch, capsys):
    """The file is found by a bare name; its content changes, or the folder that it is found in."""
    views = []
    config = tiny("dvr_volume", "scan.nhdr" if kind == "detached" else "scan.nrrd")
    config["methods"], config["zooms"] = ["triquadratic"], []
    path = tmp_path / "dvr.yaml"
    path.write_text(yaml.safe_dump(config))
    for i, peak in enumerate((100, 150)):
        folder = tmp_path / (f"volumes{i}" if kind == "moved" else "volumes")
        folder.mkdir(exist_ok=True)
        monkeypatch.setenv("FILTERLAB_VOLUMES", str(folder))
        samples = torch.full((6, 6, 6), peak if kind != "moved" else 100, dtype=torch.uint8)
        if kind == "detached":
            (folder / "scan.raw").write_bytes(samples.numpy().tobytes())
            header = "NRRD0004\ntype: uint8\ndimension: 3\nsizes: 6 6 6\nencoding: raw\ndata file: scan.raw\n"
            (folder / "scan.nhdr").write_text(header)
            inputs = [folder / "scan.nhdr", folder / "scan.raw"]
        else:
            fl.io.save_volume(fl.Volume(samples), folder / "scan.nrrd")
            inputs = [folder / "scan.nrrd"]
        for _ in range(2):
            assert main(["run", str(path), "--runs", str(tmp_path / "runs")]) == 0
        assert "done already" in capsys.readouterr().err
        (run,) = set((tmp_path / "runs").iterdir()) - set(views)
        views.append(run)
        expected = {str(file.resolve()): hashlib.sha256(file.read_bytes()).hexdigest() for file in inputs}
        assert [start["inputs"] for start in read_provenance(run)] == [expected] * 2
        assert all(word in (run / "report.html").read_text() for item in expected.items() for word in item)
    images = [next((run / "files").glob("*.png")).read_bytes() for run in views]
    assert (images[0] == images[1]) == (kind == "moved")


def test_the_volumes_of_sections_are_inputs(scan):
    config = EXPERIMENTS["demo"].config.model_validate(tiny("demo", scan))
    assert input_files(config) == {str(scan): hashlib.sha256(scan.read_bytes()).hexdigest()}


def series_of(folder, frames=3):
    samples = np.random.default_rng(0).integers(0, 255, (4, 5, 6, frames)).astype(np.uint8)
    nibabel.save(nibabel.Nifti1Image(samples, np.diag([1.0, 2.0, 3.0, 1.0])), folder / "series.nii")
    return folder / "series.nii", samples


def test_a_frame_of_a_time_series_is_that_volume(tmp_path):
    path, samples = series_of(tmp_path)
    choice = VolumeChoice(file=str(path), frame=2)
    assert np.array_equal(choice.load().samples.numpy(), samples[..., 2].T)
    assert choice.load().spacing == (1, 2, 3)
    assert choice.extent() == pytest.approx(120 ** (1 / 3))
    assert choice.check("volume").upper == (3.5, 4.5, 5.5)


@pytest.mark.parametrize(
    ("volume", "words"),
    [
        ("series.nii", ["its 3 frames", "frame=0 to frame=2"]),
        ({"file": "series.nii", "frame": 3}, ["from 0 to 2", "got frame 3"]),
        ({"file": "lying.nii", "frame": 0}, ["32000000000 bytes"]),
        ("batch.npy", ["one volume of shape (D, H, W)", "(2, 1, 3, 4, 5)"]),
    ],
)
def test_a_file_without_the_volume_is_refused_by_its_header(volume, words, tmp_path, scan, monkeypatch, capsys):
    path, _ = series_of(tmp_path)
    lying = bytearray(path.read_bytes())
    struct.pack_into("<5h", lying, 40, 4, 2000, 2000, 2000, 4)
    (tmp_path / "lying.nii").write_bytes(lying)
    np.save(tmp_path / "batch.npy", np.zeros((2, 1, 3, 4, 5)))
    monkeypatch.setenv("FILTERLAB_VOLUMES", str(tmp_path))
    assert_refused({**tiny("dvr_volume", scan), "volume": volume}, [": volume: ", *words], tmp_path, capsys)


def assert_refused(config, words, tmp_path, capsys, code=2):
    """The command ends with one line that has all the words, and writes nothing."""
    (tmp_path / "refused.yaml").write_text(yaml.safe_dump(config))
    assert main(["run", str(tmp_path / "refused.yaml"), "--runs", str(tmp_path / "runs")]) == code
    message = capsys.readouterr().err
    assert len(message.splitlines()) == 1
    for word in words:
        assert word in message
    assert not (tmp_path / "runs").exists()


@pytest.mark.parametrize("name", ["dvr_signal", "dvr_volume", "texture_precision"])
@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"step": 1e-9}, ["view.step", "at most 1.7e+10 samples", "a longer step"]),
        ({"size": [32768, 32768], "step": 0.01}, ["view.step", "samples"]),
        ({"size": [10, 20]}, ["view.size", "at least 11 pixels"]),
    ],
)
def test_a_view_that_cannot_be_drawn_is_refused_before_work(name, change, words, tmp_path, scan, capsys):
    config = tiny(name, scan)
    view = config["sources"][0]["view"] if name == "texture_precision" else config["view"]
    changed = {**view, **change}
    if name == "texture_precision":
        config["sources"][0]["view"] = changed
    else:
        config["view"] = changed
    if name == "dvr_volume" and "size" in change and "step" not in change:
        alone = EXPERIMENTS[name].config.model_validate({**config, "reference": None})
        assert EXPERIMENTS[name].check(alone, "") is None  # compares nothing
    assert_refused(config, words, tmp_path, capsys)


def test_the_samples_of_a_view_are_estimated_well(scan):
    """Against the renderer's own count, which it names when it refuses."""
    view = View.model_validate({**VIEW, "size": [240, 160], "camera": {"direction": [0.2, 1.0, -0.8], "margin": 2.0}})
    field = fl.reconstruct(fl.load_volume(scan), "trilinear")
    transfer = view.transfer.build(lambda: (0.0, 1.0), 1.0)
    with pytest.raises(ValueError, match="the limit") as refusal:
        fl.render.render(
            field, view.camera.build(field.domain, view.size), transfer, size=view.size, step=1.0, max_samples=1
        )
    exact = float(re.search(r"take ([0-9.e+]+) samples", str(refusal.value)).group(1))
    assert view._samples(field.domain) == pytest.approx(exact, rel=0.05)


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (ValueError("expected a;\n got b"), "expected a; got b"),
        (MemoryError(), "expected enough memory"),
        (torch.OutOfMemoryError("CUDA out of memory"), "expected enough memory"),
        (None, "expected enough memory"),
    ],
)
def test_what_only_the_work_finds_out_ends_in_one_line(error, said, tiny_rms, tmp_path, monkeypatch, capsys):
    def fail(*_):
        if error is not None:
            raise error
        return torch.empty(2**50)  # the allocator's own words

    monkeypatch.setattr("experiments.rms_error._error", fail)
    assert main(["run", str(tiny_rms), "--runs", str(tmp_path / "runs")]) == 1
    message = capsys.readouterr().err
    assert message.splitlines()[-1].startswith(f"error: gaussian 4³, trilinear: {said}")
    assert "Traceback" not in message
    (folder,) = (tmp_path / "runs").iterdir()
    assert not read_records(folder)[0]
    assert not (folder / "report.html").exists()


def test_a_mistake_of_ours_keeps_its_traceback(tiny_rms, tmp_path, monkeypatch):
    def fail(*_):
        raise RuntimeError("shapes do not match")

    monkeypatch.setattr("experiments.rms_error._error", fail)
    with pytest.raises(RuntimeError, match="shapes"):
        main(["run", str(tiny_rms), "--runs", str(tmp_path / "runs")])


def test_the_response_of_the_sampled_scheme_is_measured(ran):
    sampled = {"name": "trilinear", "gradient": "central", "scheme": "sampled"}
    _, records, _ = ran("frequency_response", methods=["trilinear", sampled], figures=[])
    assert all(record["largest_difference"] < 1e-6 for record in records.values())
    assert len(records) == 2


def test_a_missing_volume_is_found_before_anything_is_written(tmp_path, scan, capsys):
    path = tmp_path / "demo.yaml"
    config = tiny("demo", scan)
    config["sections"][1]["volume"] = "no-such-scan.nrrd"
    path.write_text(yaml.safe_dump(config))
    assert main(["run", str(path), "--runs", str(tmp_path / "runs")]) == 2
    message = capsys.readouterr().err
    assert "sections[1].volume" in message
    assert "no-such-scan.nrrd" in message
    assert not (tmp_path / "runs").exists()


def test_the_demo_needs_no_volume_of_its_own(monkeypatch):
    pytest.importorskip("nibabel")
    monkeypatch.delenv("FILTERLAB_VOLUMES", raising=False)
    _, experiment, config = load("demo")
    assert 0 < sum(u.seconds for u in experiment.units(config)) < 180
    volume = config.sections[0].volume.load()
    assert volume.shape == (24, 96, 128)
    assert abs(volume.affine[1, 2]) > 0.1  # oblique, as the file says


def test_list_shows_every_config(capsys):
    assert main(["list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines] == list(known_configs())
    assert all(len(line.split()) > 3 for line in lines)


def test_a_list_that_nobody_reads_on_ends_quietly(capsys, monkeypatch):
    """`python -m experiments list | head -1`: with the code that `filterlab methods | head -1` ends with."""
    ended, writing = os.pipe()
    os.close(ended)
    for command in (main, filterlab_main):
        with open(os.dup(writing), "w") as output:
            monkeypatch.setattr(sys, "stdout", output)
            assert command(["list" if command is main else "methods"]) == 1
    monkeypatch.undo()
    os.close(writing)
    assert capsys.readouterr().err == ""


def test_a_config_that_is_not_known_is_told_the_nearest_name(capsys):
    assert main(["run", "terain_error"]) == 2
    told = capsys.readouterr().err
    assert "did you mean 'terrain_error'? known configs: brick_economy, " in told
    assert told.count("\n") == 1


LISTED = """
import sys
from experiments.__main__ import main
from experiments.registry import EXPERIMENTS
assert main(["list"]) == 0
assert len({*EXPERIMENTS}) == len(EXPERIMENTS) and "demo" in EXPERIMENTS and "demos" not in EXPERIMENTS
assert not {"torch", "matplotlib", "scipy", "experiments.demo", "experiments.rms_error"} & set(sys.modules)
"""


def test_names_are_known_without_importing_what_they_name(command):
    out, err = (process := command(code=LISTED)).communicate(timeout=60)
    assert process.returncode == 0, err
    assert len(out.splitlines()) == len(known_configs())


def test_no_other_experiment_is_known():
    with pytest.raises(KeyError, match="demos"):
        EXPERIMENTS["demos"]


def orders(name: str, chosen: Callable[[Recipe], bool]) -> dict[str, tuple[Recipe, float, float]]:
    """Recipes of a config with their orders of value and gradient, from the study that orders are read from.

    With fewer points, and its two finest small resolutions.
    """
    _, _, config = load(name)
    study = next(s for s in config.studies if s.signal.name == "gaussian")
    small = study.model_copy(update={"resolutions": [64, 128], "fit_from": 64})
    points, value, gradient = rms_error._truth(config.model_copy(update={"points": 3000}), small)
    volumes = [study.signal.build().sample(n) for n in small.fitted]
    found = {}
    for recipe in filter(chosen, config.methods):
        jets = [rms_error.evaluate(recipe.build(volume, config.boundary), points) for volume in volumes]
        values = [float(fl.metrics.rms(v, value)) for v, _ in jets]
        gradients = [float(fl.metrics.rms(g, gradient, vectors=True)) for _, g in jets]
        found[recipe.key] = recipe, *(rms_error.slope(small.fitted, errors) for errors in (values, gradients))
    return found


def test_fitted_orders_are_the_declared_ones():
    found = orders("rms_error", lambda recipe: recipe.prefilter and recipe.gradient is None)
    for key, (recipe, value, _) in found.items():
        assert value == pytest.approx(recipe.declared_order, abs=0.15), key


def test_fitted_orders_of_splines_on_tetrahedra():
    """As declared for values, with and without prefilter, and 2 for all gradients."""
    found = orders("tetrahedral_rms", lambda recipe: recipe.name in ("qss", "cubic-c1", "quadratic-c1"))
    assert len(found) == 6
    for key, (recipe, value, gradient) in found.items():
        assert recipe.declared_order == (3 if recipe.prefilter else 2)
        assert (value, gradient) == pytest.approx((recipe.declared_order, 2), abs=0.15), key
