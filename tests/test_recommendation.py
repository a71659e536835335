"""Recommendations: what is picked is within the budget, and nothing cheaper is; bad questions are refused."""

from __future__ import annotations

import json
import math

import pytest
import torch
import yaml

import filterlab as fl
from filterlab.cli import MEMORY, TIME, UsageError, main, quantity
from filterlab.io.config import loads_config
from filterlab.recommendation import ErrorEstimate, Recommendation, recommend, report
from filterlab.recommendation.choice import _marched
from filterlab.render.scene import Scene

FAST = {"seconds": 0.05}


@pytest.fixture(scope="module")
def samples() -> torch.Tensor:
    return fl.signals.marschner_lobb(frequency=4.0).sample(40).samples


@pytest.fixture(scope="module")
def found(samples) -> Recommendation:
    return recommend(samples, 0.02, **FAST)


def test_the_pick_is_the_cheapest_within_the_budget(found) -> None:
    assert found.pick is not None
    assert found.pick.error.high <= 0.02
    for candidate in found.candidates:
        assert candidate.error.low <= candidate.error.predicted <= candidate.error.high
        if candidate.seconds < found.pick.seconds:
            assert candidate.error.high > 0.02
    assert [c.seconds for c in found.candidates] == sorted(c.seconds for c in found.candidates)
    assert found.best.error.high == min(c.error.high for c in found.candidates)


def test_errors_are_those_that_the_signal_shows(samples) -> None:
    """Of every method, at random points of the inner box, in parts of the range."""
    signal, volume = fl.signals.marschner_lobb(), fl.signals.marschner_lobb().sample(64)
    answer = recommend(volume, 1e-9, **FAST)
    points = 1.8 * torch.rand(6000, 3, generator=torch.Generator().manual_seed(1)) - 0.9
    span = float(volume.samples.max() - volume.samples.min())
    for candidate in answer.candidates:
        field = fl.reconstruct(volume, boundary="reflect", **candidate.options())
        true = float((field(points) - signal(points)).square().mean().sqrt()) / span
        assert candidate.error.low / 1.1 <= true <= candidate.error.high * 1.1


def test_nothing_meets_an_impossible_budget(samples) -> None:
    answer = recommend(samples, 1e-9, methods=["trilinear", "tricubic"], **FAST)
    assert answer.pick is None
    assert answer.chosen is answer.best
    assert answer.best.method == "tricubic"
    assert answer.runners_up()[0].method == "trilinear"


def test_limits_of_memory_and_time_count(samples) -> None:
    small = recommend(samples, 0.5, max_memory=120_000, methods=["trilinear"], **FAST)
    assert small.pick is not None
    assert small.pick.storage == "uint8"
    assert small.pick.memory <= 120_000
    assert recommend(samples, 0.5, max_memory=1000, methods=["trilinear"], **FAST).pick is None
    assert recommend(samples, 0.5, max_time=1e-9, methods=["trilinear"], **FAST).pick is None


def test_gradients_count_for_surfaces_and_pictures(samples) -> None:
    errors = {
        task: {
            c.method: c for c in recommend(samples, 1e-9, task=task, methods=["trilinear", "notch"], **FAST).candidates
        }
        for task in ("resample", "isosurface", "dvr")
    }
    for method in ("trilinear", "notch"):
        value, surface, picture = (errors[task][method].error.predicted for task in ("resample", "isosurface", "dvr"))
        assert value < surface < picture
        assert errors["dvr"][method].step is not None
        assert errors["resample"][method].step is None


@pytest.mark.parametrize(
    ("budget", "expected"),
    [
        (2.0, 1.0),
        (1.0, 0.7),  # √(0.9² + (0.5 s²)²) ≤ 1 where s ≤ 0.934; half of the budget for the method would not be enough
        (0.9005, 0.18),  # where s ≤ 0.245
        (0.89, 0.5),  # none: at most 1 % above the shortest's √(0.9² + 0.0078²) where s ≤ 0.506
    ],
)
def test_the_step_is_the_longest_within_the_budget(budget, expected) -> None:
    """Of a method whose own error is 0.9, on a volume where a march loses 0.5 s²."""

    def estimate(lost: float) -> ErrorEstimate:
        error = math.hypot(0.9, lost)
        return ErrorEstimate(error, None, error, error)

    step, error = _marched(estimate, 12.0, budget)
    assert step == expected
    assert error == estimate(0.5 * step**2)


def test_every_candidate_has_its_own_step(samples) -> None:
    """Less is left for the march where the method takes more of the budget."""
    answer = recommend(samples, 5.0, task="dvr", methods=["trilinear"], **FAST)
    assert answer.chosen.step == 1.0
    tight = 1.0001 * recommend(samples, 1e-9, task="isosurface", methods=["tricubic"], **FAST).chosen.error.high
    found = recommend(samples, tight, task="dvr", methods=["trilinear", "tricubic"], **FAST)
    steps = {c.method: c.step for c in found.candidates if c.storage is None}
    assert steps["tricubic"] < steps["trilinear"]


def test_a_volume_without_detail_is_resolved() -> None:
    """What is left of a constant is rounding: nothing is said about its spectrum."""
    for value in (3.0, -1e4):
        answer = recommend(torch.full((20, 20, 20), value), 0.1, methods=["trilinear", "catmull-rom"], **FAST)
        assert all(c.resolved for c in answer.candidates)
    noise = torch.rand(20, 20, 20, generator=torch.Generator().manual_seed(0))
    assert not any(c.resolved for c in recommend(noise, 0.5, methods=["tricubic"], **FAST).candidates)


def test_a_scene_shows_one_volume(tmp_path, capsys) -> None:
    fl.save_volume(fl.Volume(torch.rand(2, 1, 5, 6, 7)), tmp_path / "v.npy")
    ask = ["recommend", str(tmp_path / "v.npy"), "--max-error", "90%"]
    assert main([*ask, "-o", str(tmp_path / "s.yaml")]) == 1
    assert "expected one volume (D, H, W) to write a scene of" in capsys.readouterr().err
    assert not (tmp_path / "s.yaml").exists()


def test_the_same_seed_finds_the_same_errors(samples) -> None:
    first, second = (recommend(samples, 0.02, methods=["notch"], seed=3, **FAST) for _ in range(2))
    errors = [{(c.method, c.scheme, c.storage): c.error for c in answer.candidates} for answer in (first, second)]
    assert errors[0] == errors[1]


@pytest.mark.parametrize(
    "volume",
    [
        torch.full((1, 1, 1), 2.0),
        torch.full((20, 20, 20), -3.0),
        torch.arange(60).reshape(3, 4, 5),
        torch.rand(1, 40, 40),
        torch.rand(2, 2, 8, 9, 10),
        (torch.rand(9, 9, 9) * 255).to(torch.uint8),
    ],
    ids=["one voxel", "constant", "integers", "flat", "batch", "bytes"],
)
def test_any_volume_gets_an_answer(volume) -> None:
    answer = recommend(volume, 0.5, methods=["trilinear", "triquadratic"], **FAST)
    for candidate in answer.candidates:
        assert math.isfinite(candidate.error.high)
    assert answer.field(volume) is not None


def test_large_volumes_are_judged_by_blocks() -> None:
    answer = recommend(torch.rand(()).expand(120, 130, 140), 0.1, methods=["trilinear"], **FAST)
    assert answer.pick is not None


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"max_error": 0.0}, "max_error must be positive; got 0.0"),
        ({"max_error": math.nan}, "max_error must be positive"),
        ({"max_memory": -1}, "max_memory must be positive; got -1"),
        ({"task": "print"}, "task must be one of resample, dvr, isosurface; got 'print'"),
        ({"methods": ["noch"]}, "unknown method 'noch'"),
    ],
)
def test_questions_without_sense(options, match, samples) -> None:
    with pytest.raises(ValueError, match=match):
        recommend(samples, **{"max_error": 0.1, **options})


def test_nan_voxels_are_refused_or_filled(samples) -> None:
    hole = samples.clone()
    hole[3, 4, 5] = math.nan
    with pytest.raises(ValueError, match="1 NaN of 64,000"):
        recommend(hole, 0.1)
    filled = recommend(hole, 0.5, nan="fill", methods=["trilinear"], **FAST)
    assert filled.pick is not None
    assert bool(filled.field(hole)(torch.tensor([5.0, 4.0, 3.0])).isfinite())


# --- what is shown ----------------------------------------------------------------------------------------------------


def test_the_scene_is_one_that_render_takes(found, samples, tmp_path) -> None:
    fl.save_volume(fl.Volume(samples), tmp_path / "v.nrrd")
    from filterlab.io.config import dump_data

    scene = loads_config(dump_data(report.scene(found, str(tmp_path / "v.nrrd"))), Scene)
    assert scene.method is not None
    assert scene.method.name == found.chosen.method


def test_data_is_plain(found) -> None:
    assert json.loads(json.dumps(report.data(found), allow_nan=False))["pick"]["method"] == found.chosen.method


def test_the_command(samples, tmp_path, capsys) -> None:
    file = tmp_path / "v.nrrd"
    fl.save_volume(fl.Volume(samples[:20, :20, :20].clone()), file)
    assert main(["recommend", str(file), "--max-error", "90%", "-o", str(tmp_path / "s.yaml"), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["max_error"] == 0.9
    assert yaml.safe_load((tmp_path / "s.yaml").read_text())["method"]["name"] == answer["pick"]["method"]
    assert main(["render", str(tmp_path / "s.yaml"), "-o", str(tmp_path / "p.png"), "--size", "8", "8"]) == 0
    assert main(["recommend", str(file), "--max-error", "0.000001%"]) == 3
    assert "Nothing meets the budget" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["--max-error", "much"], 2, "expected --max-error to be a positive number"),
        (["--max-error", "-1%"], 2, "expected --max-error to be a positive number"),
        (["--max-error", "1%", "--max-memory", "3 parsec"], 2, "expected --max-memory"),
        (["--max-error", "1%", "--task", "dwr"], 1, "unknown task 'dwr'; did you mean 'dvr'?"),
        (["--max-error", "1%", "-o", "scene.png"], 1, "ends in .yaml"),
    ],
)
def test_mistakes_on_the_command_line(arguments, code, message, tmp_path, capsys) -> None:
    file = tmp_path / "v.npy"
    fl.save_volume(fl.Volume(torch.rand(4, 4, 4)), file)
    assert main(["recommend", str(file), *arguments]) == code
    assert message in capsys.readouterr().err


def test_quantities() -> None:
    assert quantity("--x", "0.5%", {"%": 0.01, "": 1.0}) == pytest.approx(0.005)
    assert quantity("--x", "256MiB", MEMORY) == 256 * 2**20
    assert quantity("--x", "2 gb", MEMORY) == 2e9
    assert quantity("--x", "2min", TIME) == 120
    assert quantity("--x", None, TIME) == math.inf
    for text in ("", "x", "1e999", "1 fortnight", "nan"):
        with pytest.raises(UsageError):
            quantity("--x", text, TIME)


def test_numbers_are_shown_in_units_that_read_well() -> None:
    assert report.percent(0.00512) == "0.512 %"
    assert [report.duration(s) for s in (3.0, 0.0042, 1e-6)] == ["3 s", "4.2 ms", "1 µs"]
    assert [report.size(b) for b in (12, 2048, 3 * 2**20)] == ["12 bytes", "2 KiB", "3 MiB"]
