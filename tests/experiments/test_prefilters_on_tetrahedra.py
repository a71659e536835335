"""`prefilters_on_tetrahedra`: learned taps, noise at which two forms are equally good, records by hand."""

import copy
import json
import math

import numpy as np
import pytest
import torch
import yaml

import filterlab as fl
from experiments import fir
from experiments.__main__ import main
from experiments.config import Recipe
from experiments.descent import Stage, minimize
from experiments.fitting import Fit, Objective
from experiments.isosurface_quality import noisy
from experiments.members import Members, Sampling
from experiments.prefilters_on_tetrahedra import Config, ShortPrefilter, check, equal_noise
from experiments.report.prefilters_on_tetrahedra import draw
from experiments.runs import read_records, run_file
from filterlab import metrics, signals, spectrum
from filterlab.io import load_image
from filterlab.io.config import ConfigError
from tests.experiments.conftest import figures_left_empty

TINY = {
    "experiment": "prefilters_on_tetrahedra",
    "description": "tiny",
    "splines": ["qss", "quadratic-c1"],
    "learning": {
        "source": {"kind": "waves", "title": "waves", "bandwidth": 0.5, "waves": 4},
        "taps": [3, 5],
        "training": 1,
        "validation": 1,
        "test": 2,
        "points": 20,
        "test_points": 20,
        "resolution": 6,
        "iterations": 3,
    },
    "signal": {"name": "gaussian", "parameters": {"sigma": 0.3}},
    "resolutions": [10],
    "noise": [0.01, 0.5],
    "points": 200,
    "frequencies": 9,
    "pictures": {"signal": "torus", "resolution": 10, "level": 0, "noise": 0.01, "look": {"size": [12, 10]}},
}


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    folder = tmp_path_factory.mktemp("prefilters")
    path = folder / "tiny.yaml"
    path.write_text(yaml.safe_dump(json.loads(json.dumps(TINY))))
    with figures_left_empty():
        assert main(["run", str(path), "--runs", str(folder / "runs")]) == 0
    (run,) = (folder / "runs").iterdir()
    return run, read_records(run)[0]


def entry(record, variant):
    return next(v for v in record["variants"] if v["variant"] == variant)


def test_records_are_what_fields_of_these_prefilters_give(ran):
    """Without noise and with it, once more by hand: the noise goes through the prefilter too."""
    _, records = ran
    config, record = Config.model_validate(TINY), records["quadratic-c1/errors/10"]
    signal = config.signal.build()
    volume = signal.sample(10)
    unit = torch.rand(200, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    points = 0.9 * (2 * unit - 1)
    loud = noisy(volume, config.noise[1] * record["range"], config.seed)
    assert record["range"] == float(volume.samples.max() - volume.samples.min())
    taps = torch.tensor(records["quadratic-c1/fit/5"]["parameters"]["taps"], dtype=torch.float64)
    short = lambda v: fl.Volume.with_geometry(fir.convolve(v.samples, taps, "reflect"), v.geometry)  # noqa: E731
    for variant, samples, on in (("published", loud, False), ("recursive", loud, True), ("fir5", short(loud), False)):
        field = fl.reconstruct(samples, "quadratic-c1", boundary="reflect", prefilter=on)
        v, g = field.value_and_gradient(points)
        value, gradient = signal.value_and_gradient(points)
        found = entry(record, variant)
        assert found["value"]["noisy"][1] == pytest.approx(float(metrics.rms(v, value)), rel=1e-9)
        assert found["gradient"]["noisy"][1] == pytest.approx(float(metrics.rms(g, gradient, vectors=True)), rel=1e-9)
    published, recursive = entry(record, "published")["value"], entry(record, "recursive")["value"]
    assert published["error"] > recursive["error"]
    assert published["gain"] < recursive["gain"]


def test_at_the_equal_noise_both_are_equally_good(ran):
    """Of other noise than it was found with, the mean over several draws."""
    _, records = ran
    record = records["qss/errors/10"]
    share = entry(record, "recursive")["equal_noise"]["value"]
    signal = signals.gaussian(0.3)
    volume = signal.sample(10)
    points = 1.8 * torch.rand(2000, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64) - 0.9

    def error(deviation, prefilter):
        squares = []
        for seed in range(10, 40):
            loud = noisy(volume, deviation, seed)
            field = fl.reconstruct(loud, "qss", boundary="reflect", prefilter=prefilter)
            squares.append(float((field(points) - signal(points)).square().mean()))
        return math.sqrt(sum(squares) / len(squares))

    at = share * record["range"]
    assert error(at, True) == pytest.approx(error(at, False), rel=0.1)
    assert error(at / 2, True) < 0.9 * error(at / 2, False)
    assert error(2 * at, True) > 1.1 * error(2 * at, False)


def test_equal_noise_is_none_where_one_is_always_better():
    form = lambda error, gain: {"value": {"error": error, "gain": gain}}  # noqa: E731
    assert equal_noise(form(0.5, 0.3), form(0.3, 0.5), "value", 2.0) == pytest.approx(0.5)
    assert equal_noise(form(0.3, 0.3), form(0.5, 0.5), "value", 1.0) is None
    assert equal_noise(form(0.5, 0.5), form(0.3, 0.3), "value", 1.0) is None


@pytest.mark.parametrize("spline", ["qss", "cubic-c1", "quadratic-c1"])
def test_on_quadratics_order_three_is_learned(spline, tmp_path):
    """Q f = f + h²/8 Δf, so the prefilter must be 1 + ω²/8 + …: h₁ = −1/8."""
    terms = {(2, 0, 0): 1.0, (0, 2, 0): -0.7, (0, 0, 2): 0.4, (1, 1, 0): 0.5, (0, 0, 1): 1.0}
    members = Members.of_signals([signals.polynomial(terms)], Sampling(8, 0.3), 20, 1)
    f = Objective.of(members, "reflect", 0.0, Recipe(name=spline, prefilter=False))
    fit = Fit.of(ShortPrefilter(spline), f, f, {"taps": torch.zeros(1, dtype=torch.float64)})
    state = minimize(
        fit, [Stage(iterations=150, learning_rate=0.05)], tmp_path / "state.pt", observe_every=150, checkpoint_every=150
    )
    assert state.observations[-1]["parameters"]["taps"] == pytest.approx([-1 / 8], abs=2e-3)


def test_spectra_are_those_of_the_implementation(ran):
    folder, records = ran
    for spline, positions in (("qss", 1), ("quadratic-c1", 4)):
        record = records[f"{spline}/spectrum/"]
        assert record["positions"] == positions
        assert record["largest_difference"] < 1e-5
        omega, rows = (torch.from_numpy(np.load(run_file(folder, record[k]))) for k in ("omega", "responses"))
        mean, low, high = rows.unbind(2)
        assert bool((low <= mean + 1e-12).all() and (mean <= high + 1e-12).all())
        assert (record["spread"] > 1e-2) == (positions > 1)
        # along an axis the three respond as the quadratic B-spline does
        for variant, prefilter in (("published", False), ("recursive", True)):
            along = mean[record["variants"].index(variant), 0]
            expected = spectrum.axis_response("triquadratic", omega, prefilter)
            torch.testing.assert_close(along, expected, rtol=0, atol=1e-6)


def test_pictures_of_noisy_samples_are_other_ones(ran):
    folder, records = ran
    images = {k: load_image(run_file(folder, r["image"])) for k, r in records.items() if r["kind"] == "picture"}
    assert len(images) == 2 * 2 * 3
    clean, noise = (images[f"qss/picture/recursive-{s}"] for s in ("clean", "noisy"))
    assert float((clean - noise).abs().max()) > 0.02
    assert records["qss/picture/recursive-clean"]["distance"] < records["qss/picture/published-clean"]["distance"]


def test_the_report_says_what_the_records_say(ran, undrawn):
    folder, records = ran
    config = Config.model_validate(TINY)
    turned = copy.deepcopy(records)
    for record in turned.values():
        if record["kind"] == "fit":
            for q in ("value", "gradient"):
                record["against_recursive"][q]["ratio"] = 1.5
    said = " ".join(draw(config, turned, folder).lead)
    assert "3 taps: value +50.0 % … +50.0 %, gradient +50.0 % … +50.0 %" in said
    assert said != " ".join(draw(config, records, folder).lead)


def test_an_unfinished_run_is_drawn_as_far_as_it_is(ran):
    folder, records = ran
    for count in (1, 4):
        draw(Config.model_validate(TINY), dict(list(records.items())[:count]), folder)


def test_what_is_refused():
    for change, message in (
        ({"learning": {**TINY["learning"], "taps": [4]}}, "odd number of taps"),
        ({"learning": {**TINY["learning"], "taps": [5, 3]}}, "increasing"),
        ({"splines": ["qs"]}, "qss"),
        ({"device": "cuda"}, "expected device: cpu"),
        ({"pictures": {**TINY["pictures"], "look": {"error": 1}}}, "leave it out"),
    ):
        with pytest.raises(ValueError, match=message):
            Config.model_validate({**TINY, **change})


def test_a_scan_to_learn_from_that_cannot_be_parted_is_refused(tmp_path):
    path = tmp_path / "small.npy"
    fl.io.save_volume(fl.Volume(torch.zeros(2, 9, 9)), path)
    source = {"kind": "scan", "title": "small", "volume": str(path)}
    config = Config.model_validate({**TINY, "learning": {**TINY["learning"], "source": source}})
    with pytest.raises(ConfigError, match=r"learning\.source\.volume.*halved and parted"):
        check(config)
