"""Fronts and claims on numbers that are known; that candidates are what they are called, and errors what they say."""

import json
import math
import random

import pytest
import torch

import filterlab as fl
from experiments import speed_accuracy
from experiments.claims import CENTRAL, CLAIMS, Claim, Evidence, judged, verdict
from experiments.config import Recipe
from experiments.fronts import front
from experiments.held_out import HeldOut, resolution_of
from experiments.report.speed_accuracy import draw
from experiments.rms_error import uniform_points
from experiments.runs import Run
from experiments.speed_accuracy import Variant
from filterlab import Volume, load_volume, save_volume
from filterlab.io.config import ConfigError, loads_config


def test_without_ties_the_front_is_whom_nobody_beats():
    generator = random.Random(3)
    for _ in range(50):
        points = {str(i): (generator.randint(1, 9), generator.randint(1, 9)) for i in range(12)}
        beaten = {a for a, p in points.items() for q in points.values() if q != p and q[0] <= p[0] and q[1] <= p[1]}
        worthy = {points[a] for a in points if a not in beaten}
        found = front(points, tie=0)
        assert [points[a] for a in found] == sorted(worthy)


def test_rounding_puts_nobody_on_the_front():
    points = {"fast": (1.0, 10.0), "same": (2.0, 9.9), "better": (3.0, 9.0), "dear": (4.0, 9.0)}
    assert front(points) == ["fast", "better"]
    assert front(points, tie=0) == ["fast", "same", "better"]


def test_what_was_not_measured_takes_no_part():
    points = {"a": (1.0, None), "b": (math.nan, 0.1), "c": (2.0, math.inf), "d": (None, 1.0), "e": (9.0, 1.0)}
    assert front(points) == ["e"]
    assert front({}) == []


@pytest.mark.parametrize(
    ("at_most", "numbers", "expected"),
    [
        (True, [0.5, 1.0], "holds"),
        (True, [0.5, 1.1], "in part"),
        (True, [1.2, 1.1], "does not hold"),
        (False, [1.0, 7.0], "holds"),
        (False, [0.9, 7.0], "in part"),
        (False, [0.9], "does not hold"),
    ],
)
def test_a_verdict_is_about_every_number(at_most, numbers, expected):
    assert verdict(Claim("", "", "", lambda e: {}, 1.0, at_most), numbers) == expected


def cost(*rounds):
    return {"ns_per_sample": [0, sorted(rounds)[len(rounds) // 2], 0], "rounds": list(rounds)}


def test_claims_compare_what_they_name():
    """Made-up records with ratios that are seen at once: each claim must find its own."""
    costs = {
        CENTRAL: cost(10, 20, 10),
        "triquadratic": cost(5, 10, 500),
        "triquadratic+direct": cost(50, 50, 50),
        "triquadratic+sampled": cost(100, 100, 100),
        f"{CENTRAL}+sampled": cost(80, 80, 80),
    }
    errors = {"triquadratic": 0.1, CENTRAL: 0.4, "ncrsi": 0.2, "notch": 0.3, "triquadratic+unprefiltered": 0.8}
    images = [("triquadratic", 1, 30.0), ("triquadratic", 0.5, 41.0), (CENTRAL, 1, 29.0), (CENTRAL, 0.5, 38.5)]
    records = {
        "cost/64/gradient-rays": {"costs": costs},
        "cost/64/value-rays": {"costs": {"triquadratic": cost(4, 4, 4)}},
        **{f"error/0/64/{k}": {"value_rms": e, "gradient_rms": 2 * e} for k, e in errors.items()},
        "images/0/0/64": {
            "source": 0, "resolution": 64,
            "entries": [{"recipe": r, "step": s, "psnr": p} for r, s, p in images],
        },
    }  # fmt: skip
    found = {c["said"]: c for c in judged(Evidence(records, [64], ["s"]))}

    def starting(words):
        (claim,) = (c for said, c in found.items() if said.startswith(words))
        return claim["found"], claim["verdict"]

    assert starting("Triquadratic value and gradient are nearly") == ({"64³": 0.5}, "holds")
    assert starting("… in the paper's own scheme") == ({"64³": 1.25}, "does not hold")
    assert starting("Eight trilinear samples are the fast") == ({"64³": 2.0}, "does not hold")
    assert starting("The gradient comes for free") == ({"64³": 2.5}, "does not hold")
    assert starting("The prefiltered triquadratic has the least") == ({"s 64³": pytest.approx(0.5)}, "holds")
    assert starting("Without its prefilter") == ({"s 64³": pytest.approx(8)}, "holds")
    assert starting("Triquadratic images") == ({"s 64³": 2.5}, "holds")
    assert not any(said.startswith("NCRSI costs") for said in found), "nobody timed it"


def test_every_claim_says_what_it_is_about():
    for claim in CLAIMS:
        assert all((claim.said, claim.paper, claim.measured))
        assert claim.unit in ("×", "dB")
        assert claim.of(Evidence({}, [64], ["s"])) == {}


VIEW = {
    "size": [14, 12],
    "transfer": {"unit": 0.1, "peaks": [{"center": 0.5, "width": 0.4, "height": 0.9, "color": [0.9, 0.5, 0.2]}]},
    "lighting": {"ambient": 0.3},
}
TINY = {
    "experiment": "speed_accuracy",
    "description": "tiny",
    "sources": [{"signal": "gaussian", "view": VIEW}],
    "resolutions": [8, 12],
    "methods": [{"name": "trilinear", "gradient": "central"}, "trilinear", "triquadratic"],
    "variants": [
        {"name": "float32"},
        {"name": "float64", "dtype": "float64"},
        {"name": "uint8", "storage": "uint8"},
        {"name": "eight samples", "scheme": "sampled"},
    ],
    "images": [
        {
            "title": "steps",
            "methods": ["triquadratic", {"name": "trilinear", "gradient": "central"}],
            "resolutions": [8, 12],
            "steps": [2, 0.5],
            "shown": [12, 0.5],
        }
    ],
    "points": 500,
    "timed_points": 60,
    "seconds": 0,
    "image_seconds": 0,
    "finest": 64,
}


def config(**changes):
    return speed_accuracy.Config.model_validate_json(json.dumps({**TINY, **changes}))


def test_candidates_are_methods_in_the_variants_they_offer():
    keys = [c.key for c in config().candidates]
    assert len(keys) == len(set(keys)) == 11
    assert "triquadratic+sampled" in keys
    assert "trilinear+central+in_float64" in keys
    assert "trilinear+sampled" not in keys, "its analytic gradient has no such scheme"
    assert Variant(name="x", scheme="sampled").of(Recipe(name="mitchell")) is None


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"methods": [{"name": "trilinear", "storage": "uint8"}]}, "the variants give scheme"),
        ({"variants": [{"name": "a"}, {"name": "b"}]}, "variants that differ; .* measured twice"),
        ({"methods": ["mitchell"]}, "'eight samples': expected at least one method"),
        ({"clock": "cpu"}, "expected threads: 1"),
        ({"finest": 40}, r"finest ≥ 48; got 40"),
    ],
)
def test_configs_that_make_no_sense_are_refused(changes, words):
    with pytest.raises(ValueError, match=words):
        config(**changes)


@pytest.fixture(scope="module")
def records(tmp_path_factory):
    c = config()
    run = Run(tmp_path_factory.mktemp("run"), {})
    for unit in speed_accuracy.units(c):
        run.append(unit.key, speed_accuracy.compute(c, unit, run))
    return run.records


def test_errors_are_those_of_the_variant(records):
    signal = fl.signals.gaussian()
    points = uniform_points(signal, 500, 0.9, 0, torch.float32, "cpu").double()
    field = fl.reconstruct(signal.sample(12), "triquadratic", boundary="reflect")
    (value, gradient), (v, g) = signal.value_and_gradient(points), field.value_and_gradient(points)
    found = records["error/0/12/triquadratic+in_float64"]
    assert found["value_rms"] == pytest.approx(float((v - value).square().mean().sqrt()), rel=1e-12)
    assert found["gradient_rms"] == pytest.approx(float((g - gradient).square().sum(-1).mean().sqrt()), rel=1e-12)
    assert found["angle_mean"] > 0
    coarse = records["error/0/12/triquadratic+uint8"]
    assert coarse["value_rms"] > 1.2 * found["value_rms"], "storage rounds"
    assert records["error/0/12/triquadratic"]["value_rms"] == pytest.approx(found["value_rms"], rel=1e-3)


def test_costs_are_those_of_the_variant(records):
    costs = records["cost/12/gradient-rays"]["costs"]
    assert set(costs) == {c.key for c in config().candidates}
    single = costs["triquadratic"]["bytes"]
    assert costs["triquadratic+in_float64"]["bytes"] == 2 * single
    assert costs["triquadratic+uint8"]["bytes"] == single / 4
    low, median, high = costs["triquadratic"]["ns_per_sample"]
    assert 0 < low <= median <= high


def test_fronts_are_of_the_right_numbers(records):
    fronts = {(f["error"], f["cost"], f["resolution"]): f["members"] for f in records["front/0"]["fronts"]}
    assert set(fronts) == {
        (error, cost, n)
        for error in ("value_rms", "gradient_rms")
        for cost, resolutions in (("time", (8, 12)), ("memory", (None,)))
        for n in resolutions
    } | {("image_rms", "time", 8), ("image_rms", "time", 12)}
    smallest = fronts["value_rms", "memory", None][0]
    assert smallest == "8/triquadratic+uint8", "of the least memory the most accurate"
    errors = [records[f"error/0/{m}"]["gradient_rms"] for m in fronts["gradient_rms", "memory", None]]
    assert errors == sorted(errors, reverse=True)


def test_another_gradient_makes_no_other_value():
    c = config()
    parts = {error: speed_accuracy._taking_part(c, error) for error in ("value_rms", "gradient_rms")}
    assert parts["gradient_rms"] == c.candidates
    assert {p.key for p in c.candidates} - {p.key for p in parts["value_rms"]} == {
        p.key for p in c.candidates if p.recipe.gradient == "central"
    }


def test_images_come_nearer_to_the_signal_with_shorter_steps(records):
    entries = {(e["recipe"], e["step"]): e for e in records["images/0/0/12"]["entries"]}
    assert len(entries) == 4
    assert entries["triquadratic", 0.5]["psnr"] > entries["triquadratic", 2]["psnr"] + 3
    assert [key for key, e in entries.items() if "image" in e] == [("triquadratic", 0.5), ("trilinear+central", 0.5)]
    assert not any("image" in e for e in records["images/0/0/8"]["entries"])
    assert len(records["images/0/0/12"]["files"]) == 4


# --- a scan -----------------------------------------------------------------------------------------------------------

WAVE = torch.tensor([0.31, -0.22, 0.17], dtype=torch.float64)  # radians per voxel along x, y, z: the low-pass keeps it


@pytest.fixture(scope="module")
def scan(tmp_path_factory):
    """A plane wave of amplitude 50 about 300: known in closed form, whatever is held out of it."""
    z, y, x = torch.meshgrid(*(torch.arange(float(n)).double() for n in (45, 51, 61)), indexing="ij")
    path = tmp_path_factory.mktemp("scan") / "wave.nrrd"
    save_volume(Volume(300 + 50 * torch.cos((torch.stack((x, y, z), -1) * WAVE).sum(-1))), path)
    return path


def test_a_scan_is_known_where_every_second_voxel_was_left_out(scan):
    known = HeldOut.of(load_volume(scan).samples)
    assert known.volume.size == (23, 23, 23)
    assert resolution_of((45, 51, 61)) == 23
    assert (float(known.volume.samples.min()), float(known.volume.samples.max())) == (0.0, 1.0)
    points = uniform_points(known, 300, 0.35, 0, torch.float64, "cpu")  # the low-pass reaches 12 voxels
    assert float(points.min()) > 0
    value, gradient = known.value_and_gradient(points)
    phase = (points * WAVE).sum(-1)
    wave, found = torch.cos(phase), known.low + known.span * value - 300
    amplitude = float((found * wave).sum() / wave.square().sum())
    assert amplitude == pytest.approx(50, rel=0.005)  # what the low-pass has left of it
    torch.testing.assert_close(found, amplitude * wave, rtol=0, atol=0.01)
    expected = -amplitude * torch.sin(phase)[:, None] * WAVE
    torch.testing.assert_close(known.span * gradient, expected, rtol=0, atol=0.01)


def test_a_scan_in_place_of_signals(undrawn, scan, tmp_path):
    c = config(volume={"file": str(scan)}, points=400)
    speed_accuracy.check(c)
    run = Run(tmp_path, {})
    units = speed_accuracy.units(c)
    for unit in units:
        run.append(unit.key, speed_accuracy.compute(c, unit, run))
    assert {u.key.split("/")[0] for u in units} == {"cost", "error", "front", "claims"}
    errors = {r["candidate"]: r["value_rms"] for r in run.records.values() if r["kind"] == "error"}
    assert errors["triquadratic"] < 0.3 * errors["trilinear+central"] < 0.1
    section = draw(c, run.records, tmp_path)
    assert "wave.nrrd" in section.lead[0]
    with pytest.raises(ConfigError, match="expected a volume file; found none"):
        speed_accuracy.check(config(volume={"file": "none.nrrd"}))


def test_a_scan_is_chosen_on_the_command_line(scan):
    chosen = loads_config(json.dumps(TINY), speed_accuracy.Config, {"volume.file": str(scan)})
    assert chosen.volume is not None
    assert chosen.sizes == [23]
