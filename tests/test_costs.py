"""What fields cost: the arithmetic of rounds by a clock of our own, and that what is measured is what was asked for."""

from __future__ import annotations

import gc
from types import SimpleNamespace

import pytest
import torch

import filterlab as fl
from filterlab import costs
from filterlab.costs import Cost, Quartiles, measure, take_turns


class Clock:
    """Time that passes only where a call says so."""

    def __init__(self, monkeypatch) -> None:
        self.now, self.calls = 0.0, []
        monkeypatch.setattr(
            costs, "time", SimpleNamespace(perf_counter=lambda: self.now, process_time=lambda: self.now)
        )

    def call(self, name: str, *seconds: float):
        """Takes seconds[i] in its i-th call, the last of them ever after."""

        def run() -> None:
            turn = self.calls.count(name)
            self.calls.append(name)
            self.now += seconds[min(turn, len(seconds) - 1)]

        return run


def test_candidates_take_turns_and_the_first_calls_do_not_count(monkeypatch):
    clock, ticks = Clock(monkeypatch), []
    calls = {"A": clock.call("A", 9, 1), "B": clock.call("B", 8, 2)}
    rounds = take_turns(calls, seconds=1e6, rounds=3, tick=ticks.append)
    assert clock.calls == ["A", "B"] * 4
    assert rounds.seconds == {"A": [1, 1, 1], "B": [2, 2, 2]}
    assert (rounds.number, rounds.cores, ticks[-1]) == (3, 1.0, 1.0)
    assert ticks == sorted(ticks)


def test_what_is_fast_is_called_until_a_turn_is_long_enough(monkeypatch):
    clock = Clock(monkeypatch)
    rounds = take_turns({"A": clock.call("A", costs.SHORTEST / 4)}, seconds=1e6, rounds=2)
    assert rounds.calls == {"A": 4}
    assert rounds.seconds["A"] == pytest.approx([costs.SHORTEST / 4] * 2)


def test_a_turn_of_many_calls_begins_with_some_that_do_not_count(monkeypatch):
    """Who went before left its own data in the caches: the first calls of a turn are slow."""
    clock, usual = Clock(monkeypatch), costs.SHORTEST / 4
    rounds = take_turns({"A": clock.call("A", usual, 9.0, 9.0, usual)}, seconds=1, rounds=1)
    assert len(clock.calls) == 1 + 2 + 4
    assert rounds.seconds["A"] == pytest.approx([usual])


def test_what_disturbs_some_calls_of_a_turn_does_not_count(monkeypatch):
    clock, usual = Clock(monkeypatch), costs.SHORTEST / 20
    call = clock.call("A", *[usual] * 15, 50.0, *[usual] * 9, 7.0, usual)
    rounds = take_turns({"A": call}, seconds=1e6, rounds=1)
    assert rounds.calls == {"A": 20}
    assert len(clock.calls) == 1 + 10 + 20
    assert rounds.seconds["A"] == pytest.approx([usual])


@pytest.mark.parametrize(("seconds", "number"), [(100, 9), (16, 5), (1, 3)])
def test_rounds_are_as_many_as_the_time_allows_but_never_too_few(monkeypatch, seconds, number):
    clock = Clock(monkeypatch)
    assert take_turns({"A": clock.call("A", 1), "B": clock.call("B", 2)}, seconds=seconds, rounds=9).number == number


def test_nobody_takes_no_turns():
    assert take_turns({}, seconds=1).number == 0


def test_the_garbage_collector_rests_and_comes_back(monkeypatch):
    seen = []
    take_turns({"A": lambda: seen.append(gc.isenabled())}, seconds=0, rounds=1)
    assert seen[-1] is False
    assert gc.isenabled()


def cost(*rounds: float) -> Cost:
    return Cost(Quartiles.of([1.0]), Quartiles.of(rounds), 0, rounds)


def test_a_ratio_is_taken_within_rounds():
    """The machine slows down threefold, and one turn is disturbed: the ratio knows nothing of either."""
    slow, fast = cost(4, 8, 500, 12, 12), cost(2, 4, 4, 6, 6)
    assert slow.relative_to(fast) == Quartiles(2, 2, 2)
    with pytest.raises(ValueError, match="5 and 1 rounds"):
        slow.relative_to(cost(1))


def volume(n: int) -> torch.Tensor:
    return torch.rand(n, n, n, generator=torch.Generator().manual_seed(0))


def test_every_candidate_has_a_cost():
    samples, points = volume(9), torch.rand(50, 3) * 8
    candidates = {
        name: lambda name=name: fl.reconstruct(samples, name, scheme="direct") for name in ("trilinear", "tricubic")
    }
    ticks = []
    found = measure({**candidates, "signal": fl.signals.marschner_lobb}, points, order=0, seconds=0, tick=ticks.append)
    assert list(found) == ["trilinear", "tricubic", "signal"]
    for c in found.values():
        assert 0 < c.sample.low <= c.sample.median <= c.sample.high
        assert 0 < c.build.low <= c.build.median <= c.build.high
        assert len(c.rounds) == costs.LEAST_ROUNDS
        assert Quartiles.of(c.rounds) == c.sample
    assert ticks[-1] == 1
    assert found["tricubic"].coefficient_bytes == 4 * fl.reconstruct(samples, "tricubic").coefficients.values.numel()
    assert found["trilinear"].coefficient_bytes < found["tricubic"].coefficient_bytes
    assert found["signal"].coefficient_bytes == 0


class Counting(fl.Field):
    """A field that writes down what it is asked for, and takes a microsecond for each sample."""

    def __init__(self, clock: Clock) -> None:
        self.clock, self.asked = clock, []

    def jet(self, points, order):
        self.asked.append((order, torch.is_grad_enabled()))
        self.clock.now += 1e-6 * points[..., 0].numel()
        return (points[..., 0],)


def test_times_are_per_sample_of_the_asked_jet(monkeypatch):
    clock = Clock(monkeypatch)
    field = Counting(clock)
    build = clock.call("build", 7, 0.5)
    found = measure({"A": lambda: (build(), field)[1]}, torch.rand(10, 700, 3, requires_grad=True), order=2)
    assert set(field.asked) == {(2, False)}
    assert found["A"].build.median == 0.5
    assert found["A"].sample.median == pytest.approx(1000)


def test_a_slow_first_call_is_not_taken_for_the_usual_one(monkeypatch):
    """It compiles: by its time one call would fill a turn, and few rounds the budget."""
    clock = Clock(monkeypatch)
    field = Counting(clock)
    usual = field.jet

    def jet(points, order):
        clock.now += 0 if field.asked else 100
        return usual(points, order)

    field.jet = jet
    found = measure({"A": lambda: field}, torch.rand(100, 3), seconds=1e3)
    assert len(found["A"].rounds) == costs.ROUNDS
    assert len(field.asked) > 40 * costs.ROUNDS


def test_every_candidate_is_sampled_at_its_own_field(monkeypatch):
    clock, asked = Clock(monkeypatch), []

    class Named(Counting):
        def jet(self, points, order):
            asked.append((self.name, len(points)))
            return super().jet(points, order)

    def build(name):
        field = Named(clock)
        field.name = name
        return field

    points = {"A": torch.rand(10, 3), "B": torch.rand(20, 3)}
    measure({name: lambda name=name: build(name) for name in "AB"}, points, seconds=0)
    assert set(asked) == {("A", 10), ("B", 20)}


def test_another_clock_can_be_asked(monkeypatch):
    clock = Clock(monkeypatch)
    found = measure({"A": lambda: Counting(clock)}, torch.rand(10, 3), seconds=0.1, clock=lambda: 2 * clock.now)
    assert found["A"].sample.median == pytest.approx(2000)


def test_no_points_are_refused_before_anything_is_built():
    def build():
        raise AssertionError("built")

    with pytest.raises(ValueError, match=r"P ≥ 1 to sample A at; got shape \(0, 3\)"):
        measure({"A": build}, torch.empty(0, 3))


def test_every_candidate_may_have_points_of_its_own(monkeypatch):
    clock = Clock(monkeypatch)
    fields = {"A": Counting(clock), "B": Counting(clock)}
    points = {"A": torch.rand(10, 3), "B": torch.rand(1000, 3, dtype=torch.float64)}
    found = measure({name: lambda name=name: fields[name] for name in fields}, points, seconds=0.1)
    assert [found[name].sample.median for name in fields] == pytest.approx([1000, 1000])
    with pytest.raises(ValueError, match="to sample B at"):
        measure({"A": lambda: fields["A"], "B": lambda: fields["B"]}, {**points, "B": points["B"][:0]})
