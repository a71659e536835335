"""How recommendations are judged, on made-up answers; and a tiny run."""

from __future__ import annotations

import math
from dataclasses import replace

import pytest

from experiments.recommend_validation import FACTOR, judged
from experiments.report.recommend_validation import _rate
from filterlab.recommendation import Candidate, ErrorEstimate, Recommendation

CHEAP = Candidate("trilinear", "fused", None, None, ErrorEstimate(0.02, None, 0.02, 0.02), True, 1.0, 1.0, 8)
GOOD = Candidate("tricubic", "fused", None, None, ErrorEstimate(0.001, None, 0.001, 0.001), True, 2.0, 2.0, 8)


def answer(pick: Candidate | None, *others: Candidate) -> Recommendation:
    candidates = tuple(sorted({pick, *others} - {None}, key=lambda c: c.seconds))
    return Recommendation("resample", 0.01, math.inf, math.inf, "mirror", (0.0, 1.0), candidates, pick, candidates[-1])


def test_a_pick_within_the_budget_that_is_the_cheapest() -> None:
    found = judged(answer(GOOD, CHEAP), [0.02, 0.001])
    assert found["holds"]
    assert found["near"]
    assert found["factor"] == 1


def test_a_pick_over_the_budget() -> None:
    found = judged(answer(GOOD, CHEAP), [0.02, 0.011])
    assert not found["holds"]
    assert not found["near"]  # nothing meets it: nothing should have been picked
    assert found["cheapest"] is None


@pytest.mark.parametrize(("seconds", "near"), [(FACTOR, True), (FACTOR * 1.01, False)])
def test_a_pick_that_costs_more_than_it_must(seconds: float, near: bool) -> None:
    dear = replace(GOOD, seconds=seconds)
    found = judged(answer(dear, CHEAP), [0.009, 0.001])
    assert found["holds"]
    assert found["factor"] == pytest.approx(seconds)
    assert found["near"] == near


def test_no_pick_is_right_where_nothing_meets_the_budget() -> None:
    assert judged(answer(None, CHEAP, GOOD), [0.02, 0.011])["near"]
    assert not judged(answer(None, CHEAP, GOOD), [0.02, 0.009])["near"]


def test_rates_are_compared_with_what_was_asked() -> None:
    assert _rate("x", [True] * 19 + [False], 0.95)[-1] == "met"
    assert _rate("x", [True] * 18 + [False] * 2, 0.95)[-1] == "MISSED"
    assert _rate("x", [], 0.95)[-1] == ""
