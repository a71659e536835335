"""The search for equal errors: its arithmetic on errors that are known, and that what it finds is true."""

from itertools import pairwise

import pytest
import torch

import filterlab as fl
from experiments import equal_error
from experiments.equal_error import Needed, coarse, least_resolution
from experiments.rms_error import Truth, evaluate
from experiments.runs import Run
from experiments.timing import along_rays, cost_record, ratio
from filterlab.costs import Cost, Quartiles

GRID = coarse(4, 256)


def test_the_grid_is_fine_and_ends_where_it_should():
    assert (GRID[0], GRID[-1]) == (4, 256)
    assert all(1 < b / a <= 1.5 for a, b in pairwise(GRID))
    assert coarse(2, 3) == [2, 3]


@pytest.mark.parametrize("order", [1, 2, 4])
@pytest.mark.parametrize("crossing", [4.5, 37.2, 64.0, 99.9, 255.5])
def test_the_least_resolution_of_a_power_law_is_exact(order, crossing):
    tried = []

    def error(n):
        tried.append(n)
        return 3.0 * n**-order

    target = 3.0 * crossing**-order * (1 + 1e-12)
    found = least_resolution(error, target, GRID)
    assert found.resolution == -(-crossing // 1)
    assert found.crossing == pytest.approx(crossing, rel=1e-9)
    assert len(set(tried)) < 30


@pytest.mark.parametrize("step", [77, 200, 250])
def test_a_steep_error_is_found_soon_too(step):
    """log-log interpolation is far off where an error falls at a step: the middle takes over."""
    tried = set()

    def error(n):
        tried.add(n)
        return 1.0 if n < step else 1e-12

    found = least_resolution(error, 0.99, GRID)
    assert found.resolution == step
    assert step - 1 < found.crossing <= step
    assert len(tried) <= len(GRID) + 12


def test_a_dip_of_an_unresolved_signal_does_not_count():
    found = least_resolution(lambda n: 0.01 if n == GRID[5] else 1 / n, 1 / 50, GRID)
    assert found == Needed(50, pytest.approx(50))


def test_what_is_never_reached_or_always_says_so():
    assert least_resolution(lambda n: 1 / n, 1e-9, GRID) == Needed(None, None)
    assert least_resolution(lambda n: 1 / n, 1.0, GRID) == Needed(4, None)
    assert least_resolution(lambda n: 1 / n, 1 / 256, GRID).resolution == 256


def config(**changes):
    return equal_error.Config.model_validate(
        {
            "experiment": "equal_error",
            "description": "tiny",
            "studies": [{"signal": "gaussian"}],
            "comparisons": [{"quantity": "value", "usual": "trilinear"}],
            "resolutions": [16],
            "methods": ["triquadratic"],
            "points": 500,
            "timed_points": 20,
            "seconds": 0,
            "largest": 24,
            **changes,
        }
    )


def test_what_is_found_is_as_accurate_and_one_voxel_less_is_not(tmp_path):
    c = config()
    run = Run(tmp_path, {})
    for unit in equal_error.units(c):
        run.append(unit.key, equal_error.compute(c, unit, run))
    needed = run.records["0/search/triquadratic"]["needed"]["value"]["16"]
    signal = fl.signals.gaussian()
    truth = Truth.of(signal, 500, 0.9, 0, torch.float32, "cpu")

    def rms(method, n):
        field = fl.reconstruct(signal.sample(n, dtype=torch.float32), method, boundary="reflect")
        return truth.errors(*evaluate(field, truth.points))["value_rms"]

    assert needed["target"] == rms("trilinear", 16)
    m = needed["resolution"]
    assert m < 10
    assert rms("triquadratic", m) <= needed["target"] < rms("triquadratic", m - 1)
    assert m - 1 < needed["crossing"] <= m
    times = run.records["0/times/value/16"]
    assert times["resolutions"] == {"usual": 16, "triquadratic": m}
    for costs in times["costs"].values():
        assert costs["usual"]["ratio"] == [1, 1, 1]
        assert costs["triquadratic"]["bytes"] < costs["usual"]["bytes"]


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"smallest": 24}, "smallest < largest; got 24 and 24"),
        ({"comparisons": [{"quantity": "value", "usual": "trilinear"}] * 2}, "each quantity once"),
        ({"resolutions": [32, 16]}, "increasing"),
    ],
)
def test_configs_that_make_no_sense_are_refused(changes, words):
    with pytest.raises(ValueError, match=words):
        config(**changes)


def test_rays_fill_the_inner_box_and_neighbours_are_near():
    signal = fl.signals.franke()
    points = along_rays(signal, 3000, 0.5 / 32)
    assert points.shape == (3000, 3)
    assert points.dtype == torch.float32
    assert points.min() > 0.05
    assert points.max() < 0.95
    assert (points.amax(0) - points.amin(0)).min() > 0.6
    steps = (points[1:] - points[:-1]).norm(dim=-1)
    assert steps.median() == pytest.approx(0.5 / 32, rel=0.03)
    assert (steps > 0.1).float().mean() < 0.02, "rays end seldom"


def test_ratios_of_records_are_within_rounds():
    def record(*rounds):
        return cost_record(Cost(Quartiles(1, 2, 3), Quartiles.of(rounds), 7, rounds))

    slow = record(4, 8, 500, 12, 12)
    assert (slow["bytes"], slow["build_seconds"]) == (7, [1, 2, 3])
    assert ratio(slow, record(2, 4, 4, 6, 6)) == [2, 2, 2]
