"""How recommendations are judged and calibrated, on made-up answers and records."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from experiments.recommend_validation import HALVES, Truth, fitted, fitted_on_surfaces, judged
from experiments.report.recommend_validation import BARS, _met, _verdict, outcomes, pictured
from filterlab.recommendation import Candidate, ErrorEstimate, Recommendation
from filterlab.recommendation.calibration import CALIBRATION, FALLS, factors


def candidate(method: str, seconds: float, low: float, high: float) -> Candidate:
    error = ErrorEstimate((low + high) / 2, 0.0, low, high, high)
    return Candidate(method, "fused", None, None, error, True, seconds, 1.0, 8)


CHEAP = candidate("trilinear", 1.0, 0.015, 0.025)
GOOD = candidate("tricubic", 2.0, 0.0005, 0.002)


def answer(pick: Candidate | None, *others: Candidate) -> Recommendation:
    candidates = tuple(sorted({pick, *others} - {None}, key=lambda c: c.seconds))
    asked = {"task": "resample", "max_error": 0.01, "max_memory": math.inf, "max_time": math.inf}
    best = candidates[-1]
    found = {"value_range": (0.0, 1.0), "candidates": candidates, "pick": pick, "best": best, "of_value": best.error}
    return Recommendation(**asked, boundary="mirror", nan="refuse", **found)


def test_a_pick_within_the_budget_that_is_the_cheapest() -> None:
    found = judged(answer(GOOD, CHEAP), {CHEAP: 0.02, GOOD: 0.001}.__getitem__)
    assert found["kept"]
    assert found["justified"] is None
    assert found["factor"] == 1


def test_a_pick_over_the_budget() -> None:
    found = judged(answer(GOOD, CHEAP), {CHEAP: 0.02, GOOD: 0.011}.__getitem__)
    assert found["kept"] is False
    assert found["factor"] is None  # nothing meets it


def test_a_pick_that_costs_more_than_it_must() -> None:
    dear = replace(GOOD, seconds=1.7)
    found = judged(answer(dear, CHEAP), {CHEAP: 0.009, dear: 0.001}.__getitem__)
    assert found["kept"]
    assert found["factor"] == pytest.approx(1.7)


def test_a_refusal_is_justified_where_nothing_meets_the_budget() -> None:
    assert judged(answer(None, CHEAP, GOOD), {CHEAP: 0.02, GOOD: 0.011}.__getitem__)["justified"]
    found = judged(answer(None, CHEAP, GOOD), {CHEAP: 0.02, GOOD: 0.009}.__getitem__)
    assert found["justified"] is False
    assert found["kept"] is None


def test_a_refusal_is_undecided_where_an_interval_holds_the_budget() -> None:
    wide = candidate("tricubic", 2.0, 0.005, 0.05)
    assert judged(answer(None, CHEAP, wide), lambda _: 0.02)["undecided"]
    assert not judged(answer(None, CHEAP), lambda _: 0.02)["undecided"]


def test_truths_are_counted_as_the_task_counts() -> None:
    truth = Truth(0.01, 0.03, 2.4)
    assert truth.counted("resample", None) == 0.01
    assert truth.counted("isosurface", None) == 0.03
    assert truth.counted("dvr", 0.5) == pytest.approx(math.hypot(0.03, 0.25 / 24 * 2.4))


def test_truths_in_pictures() -> None:
    """Of a level without a step, of a medium by the step of the march."""
    truth = Truth(0.01, 0.03, 2.4, 0.05, {0.5: 0.04})
    assert truth.pictured(None) == 0.05
    assert truth.pictured(0.5) == 0.04
    assert Truth(0.01, 0.03, 2.4).pictured(0.5) is None


# --- calibration ------------------------------------------------------------------------------------------------------


def record(fall: float, doubt: float, pairs: list[list[float]], half: str = HALVES[0]) -> dict:
    ways = [{"method": "m", "storage": None, "value": pair, "gradient": pair} for pair in pairs]
    doubts = dict.fromkeys(CALIBRATION, doubt)
    found = {"fall": fall, "doubts": doubts, "bend": [1.0, 1.0], "ways": ways, "answers": []}
    return {"half": half, "differentiable": True, "boundaries": [found], "class": "waves", "label": "w"}


def test_factors_are_those_with_which_intervals_would_just_have_held() -> None:
    """Truths at √(1 + (C u)²) above and 1 − c u below a distance of 1."""
    u = 0.2
    above = [[1.0, 0.0, math.hypot(1, factor * u)] for factor in np.linspace(0, 5, 1001)]
    below = [[1.0, 0.0, 1 - factor * u] for factor in np.linspace(0, 2, 1001)]
    found = fitted([record(FALLS[3], u, above), record(FALLS[6], u, below)])
    for quantity in ("value", "gradient"):
        least, most, likely = found[quantity]
        assert most[3] == pytest.approx(0.97 * 5, rel=0.01)
        assert likely[3] == pytest.approx(0.85 * 5, rel=0.01)
        assert least[6] == pytest.approx(0.97 * 2, rel=0.01)
        assert least[3] == most[6] == pytest.approx(0, abs=1e-6)
        assert least[0] == math.inf  # nothing near


def test_factors_on_a_surface_are_in_parts_of_those_of_a_volume() -> None:
    c, most, likely = factors("value", FALLS[4])
    whole = record(FALLS[3], 0.2, [[1.0, 0.0, 1.0]])
    assert fitted_on_surfaces([whole]) == {"value": [math.inf] * 3, "gradient": [math.inf] * 3}
    surface, = record(FALLS[4], 0.2, [[1.0, 0.0, math.hypot(1, 1.7 * most * 0.2)]])["boundaries"]  # fmt: skip
    below, = record(FALLS[4], 0.2, [[1.0, 0.0, 1 - 0.5 * c * 0.2]])["boundaries"]  # fmt: skip
    whole["boundaries"][0]["aimed"] = surface
    assert fitted([whole])["value"][1][3] == 0
    assert fitted_on_surfaces([whole])["value"] == pytest.approx([0.0, 1.7, 1.7 * most / likely])
    whole["boundaries"][0]["aimed"] = below
    assert fitted_on_surfaces([whole])["value"] == pytest.approx([0.5, 0.0, 0.0])


def test_factors_are_not_fitted_to_what_reports() -> None:
    far = record(10.0, 0.2, [[1.0, 0.0, 9.0]], HALVES[1])
    near = record(10.0, 0.2, [[1.0, 0.0, 1.0]])
    assert max(x for x in fitted([near, far])["value"][1] if math.isfinite(x)) == 0


def test_small_doubts_do_not_count() -> None:
    assert fitted([record(10.0, 0.01, [[1.0, 0.0, 9.0]])])["value"][1][4] == math.inf


def test_outcomes_of_a_volume() -> None:
    way = {"method": "m", "storage": None, "value": [0, 0, 0.5], "gradient": [0, 0, 2.0]}
    answers = [
        {"task": "resample", "picked": True, "kept": False, "justified": None, "factor": 1.6},
        {"task": "dvr", "picked": False, "kept": None, "justified": True, "factor": None, "undecided": False},
        {"task": "dvr", "picked": False, "kept": None, "justified": False, "factor": None, "undecided": True},
    ]
    answers = [{"near": i == 2, **a} for i, a in enumerate(answers)]
    found = {"ways": [{**way, "resample": [0.4, 0.6], "isosurface": [0.0, 1.9]}], "answers": answers}
    counted = outcomes({"differentiable": True}, found)
    assert counted["holds"] == [True, False]
    assert (counted["kept"], counted["near"]) == ([False], [False])
    assert (counted["justified"], counted["hard"], counted["sure"]) == ([True], [False], [True])
    assert outcomes({"differentiable": False}, found)["holds"] == [True]
    assert outcomes({"differentiable": True}, found, "isosurface")["holds"] == [False]


def test_outcomes_in_pictures() -> None:
    """Refusals that the region bears out and the picture does not are told apart; what has no picture is left out."""
    pick = {"picked": True, "kept": False, "budget": 0.1, "rendered": 0.2, "pictured": {"kept": True}}
    refused = {"picked": False, "justified": True, "undecided": False, "pictured": {"justified": False}}
    doubtful = {"picked": False, "justified": False, "undecided": True, "pictured": {"justified": True}}
    counted = pictured([pick, {**pick, "rendered": 0.1}, refused, doubtful, {"picked": True, "kept": False}])
    assert (counted["kept"], counted["rendered"]) == ([True, True], [False, True])
    assert (counted["justified"], counted["sure"], counted["elsewhere"]) == ([False, True], [False], [True])


def test_rates_are_compared_with_what_was_asked() -> None:
    assert _met([True] * 49 + [False], 0.98) == "met"
    assert _met([True] * 48 + [False], 0.98) == "MISSED"
    assert _met([], 0.98) == _met([False], None) == ""
    assert [row[-1] for row in _verdict([]).rows] == [""] * len(BARS)
