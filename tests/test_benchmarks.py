"""The benchmarks' own arithmetic: what they time is no test's business, that they time and compare rightly is."""

from __future__ import annotations

import getpass
import io
import json
import os
import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from pydantic import ValidationError

from benchmarks import __main__ as command
from benchmarks import floor, harness, peers, probe, registry, tables, workloads
from benchmarks.comparisons.scaling import thread_numbers
from benchmarks.harness import Comparison, Contestant, Item, Race, Ratio, run_race
from benchmarks.machine import describe
from benchmarks.peers import task
from benchmarks.records import Figure, Outcome, Report, Section, Spread, Timing, at_least, at_most, below
from benchmarks.registry import COMPARISONS, UnknownNameError, chosen
from benchmarks.scene import BRICK, blobs, marschner_lobb
from benchmarks.settings import Settings
from filterlab import costs, kernels
from filterlab.ops.cpu import compiler

TINY = Settings(
    repeats=1,
    seconds=0.01,
    voxels=12,
    points=300,
    image=8,
    image_voxels=12,
    prefilter_voxels=8,
    most_points=1000,
    quick=True,
)


@pytest.fixture(autouse=True)
def _environment(monkeypatch):
    for name in command._THREAD_VARIABLES:
        monkeypatch.setenv(name, "1")


# --- statistics ---


def test_quartiles_are_interpolated_between_sorted_values():
    assert Spread.of([4.0, 1.0, 3.0, 2.0]) == Spread(median=2.5, low=1.75, high=3.25)
    assert Spread.of([7.0]) == Spread(median=7, low=7, high=7)


@pytest.mark.parametrize(
    ("bar", "limit", "met", "missed", "written"),
    [
        (at_most("1/25"), 0.04, 0.04, 0.0401, "≤ 1/25"),
        (below("1"), 1.0, 0.999, 1.0, "< 1"),
        (at_least("1.65"), 1.65, 1.65, 1.64, "≥ 1.65"),
        (at_most("0.02 s"), 0.02, 0.019, 0.021, "≤ 0.02 s"),
    ],
)
def test_a_bar_is_met_on_its_own_side(bar, limit, met, missed, written):
    assert bar.limit == limit
    assert bar.met(met)
    assert not bar.met(missed)
    assert str(bar) == written


class Clock:
    """Time that passes only where a contestant says so."""

    def __init__(self, monkeypatch) -> None:
        self.now, self.calls = 0.0, []
        monkeypatch.setattr(harness.time, "perf_counter", lambda: self.now)
        monkeypatch.setitem(harness._CLOCKS, "wall", lambda: self.now)

    def contestant(self, name: str, *seconds: float, **options) -> Contestant:
        """Takes seconds[i] in its i-th call, the last of them ever after."""

        def call() -> tuple[np.ndarray, ...]:
            turn = self.calls.count(name)
            self.calls.append(name)
            self.now += seconds[min(turn, len(seconds) - 1)]
            return (np.ones(3),)

        return Contestant(name, call, **options)


def test_contestants_take_turns_and_the_first_call_stands_apart(monkeypatch):
    clock = Clock(monkeypatch)
    race = Race("", [clock.contestant("A", 9, 1), clock.contestant("B", 8, 2)])
    outcome = run_race("x", race, replace(TINY, repeats=3, seconds=100))
    assert clock.calls == ["A", "B"] * 5  # first calls, one to see how long they take, three rounds
    a, b = outcome.timings
    assert (a.first_call, b.first_call) == (9, 8)
    assert a.seconds == (1, 1, 1)
    assert b.spread.median == 2
    assert outcome.rounds == 3


def test_a_disturbed_round_does_not_count_and_a_slow_machine_cancels(monkeypatch):
    clock = Clock(monkeypatch)
    race = Race(
        "",
        [clock.contestant("A", 1, 1, 1, 2, 90, 4, 5), clock.contestant("B", 2, 2, 2, 4, 6, 8, 10)],
        [Ratio("A", "B", at_most("0.5")), Ratio("B", "A")],
    )
    half, twice = run_race("x", race, replace(TINY, repeats=5, seconds=1000)).figures
    assert half.name == "A ÷ B"
    assert (half.spread.median, half.spread.low, half.spread.high) == (0.5, 0.5, 0.5)
    assert half.met
    assert twice.spread.median == 2
    assert twice.met is None


def test_fast_contestants_are_called_many_times_in_a_turn(monkeypatch):
    clock = Clock(monkeypatch)
    per_call = costs.SHORTEST / 4
    race = Race("", [clock.contestant("A", per_call), clock.contestant("B", 10 * per_call)], [Ratio("A", "B")])
    outcome = run_race("x", race, replace(TINY, repeats=2, seconds=100))
    assert [t.calls for t in outcome.timings] == [4, 1]
    assert outcome.timings[0].spread.median == pytest.approx(per_call)
    assert outcome.figures[0].spread.median == pytest.approx(0.1)


@pytest.mark.parametrize(("seconds", "rounds"), [(100, 9), (16, 5), (1, 3)])
def test_slow_races_have_fewer_rounds_but_never_too_few(monkeypatch, seconds, rounds):
    clock = Clock(monkeypatch)
    race = Race("", [clock.contestant("A", 1), clock.contestant("B", 2)])
    assert run_race("x", race, replace(TINY, repeats=9, seconds=seconds)).rounds == rounds


def test_fewer_rounds_than_the_least_are_taken_when_asked(monkeypatch):
    clock = Clock(monkeypatch)
    assert run_race("x", Race("", [clock.contestant("A", 5)]), replace(TINY, repeats=1, seconds=0.1)).rounds == 1


def test_progress_reaches_the_end(monkeypatch):
    clock, ticks = Clock(monkeypatch), []
    run_race("x", Race("", [clock.contestant("A", 1), clock.contestant("B", 1)]), TINY, ticks.append)
    assert ticks == [0.5, 1.0]


# --- agreement ---


def numbers_of(name: str, values, **options) -> Contestant:
    return Contestant(name, lambda: (np.asarray(values, dtype=float),), "numbers", **options)


def test_a_contestant_that_disagrees_has_no_time():
    race = Race(
        "",
        [numbers_of("A", [1, 100]), numbers_of("B", [1, 100.05]), numbers_of("C", [2, 100]), numbers_of("D", [1, 100])],
        [Ratio("C", "A"), Ratio("D", "A")],
        tolerance=1e-3,
    )
    outcome = run_race("x", race, TINY)
    assert [t.name for t in outcome.timings] == ["A", "B", "D"]
    assert outcome.timings[1].difference == pytest.approx(5e-4)
    assert outcome.timings[1].compared_with == "A"
    assert [f.name for f in outcome.figures] == ["D ÷ A"]
    assert "0.01 of the largest magnitude" in outcome.errors["C"]


@pytest.mark.parametrize("wrong", [[1, np.nan], [1, np.inf], [1, 2, 3], [2]])
def test_nothing_that_is_no_number_agrees(wrong):
    outcome = run_race("x", Race("", [numbers_of("A", [1, 2]), numbers_of("B", wrong)], tolerance=1e9), TINY)
    assert [t.name for t in outcome.timings] == ["A"]
    assert "B" in outcome.errors


def test_each_part_is_measured_by_its_own_magnitude():
    small, large = np.array([1e-3, 0.0]), np.array([1e3])
    assert harness.difference([small + 1e-6, large], [small, large]) == pytest.approx(1e-3)
    assert harness.difference([], []) == 0
    assert harness.difference([np.zeros(2)], [np.zeros(2)]) == 0


def test_a_reference_replaces_the_first_contestant():
    race = Race("", [numbers_of("A", [1]), numbers_of("B", [2])], references={"numbers": lambda: [np.array([2.0])]})
    outcome = run_race("x", race, TINY)
    assert [t.name for t in outcome.timings] == ["B"]
    assert outcome.timings[0].compared_with == "the direct sum"
    assert "A" in outcome.errors


def test_contestants_that_compute_other_things_are_not_compared():
    other = Contestant("B", lambda: (np.zeros(7),))
    outcome = run_race("x", Race("", [numbers_of("A", [1]), other]), TINY)
    assert not outcome.errors
    assert outcome.timings[1].difference is None


def test_an_exception_is_a_row_of_its_own_and_names_no_folder():
    def fails() -> None:
        raise OSError("cannot open /some/where/secret/file.bin: no")

    outcome = run_race("x", Race("", [Contestant("A", fails), numbers_of("B", [1])], [Ratio("A", "B")]), TINY)
    assert outcome.errors == {"A": "OSError: cannot open …: no"}
    assert not outcome.figures
    assert [t.name for t in outcome.timings] == ["B"]


def test_a_ratio_of_an_unknown_contestant_is_our_mistake():
    with pytest.raises(AssertionError, match="names nobody"):
        run_race("x", Race("", [numbers_of("A", [1])], [Ratio("A", "nobody")]), TINY)


def test_threads_and_cores_are_given_back():
    cores = harness.usable_cores()
    torch.set_num_threads(2)
    try:
        with harness.limited(1):
            assert torch.get_num_threads() == 1
            if hasattr(os, "sched_setaffinity"):
                assert harness.usable_cores() == 1
        assert torch.get_num_threads() == 2
        assert harness.usable_cores() == cores
    finally:
        torch.set_num_threads(1)


def test_the_core_that_idles_most_is_taken(monkeypatch):
    monkeypatch.setattr(harness.time, "sleep", lambda _: None)
    watched = [{0: 10, 1: 10, 2: 10}, {0: 30, 1: 12, 2: 20}]
    seen = iter(watched * 3)
    monkeypatch.setattr(harness, "_idle", lambda: next(seen))
    assert harness.quietest_cores({0, 1, 2}, 1) == [0]
    assert harness.quietest_cores({1, 2}, 1) == [2]
    assert harness.quietest_cores({0, 1, 2}, 2) == [0, 2]
    assert harness.quietest_cores({0, 1}, 2) == [0, 1]
    monkeypatch.setattr(harness, "_idle", dict)
    assert harness.quietest_cores({0, 1, 2}, 1) == [2]


# --- what is evaluated ---


@pytest.mark.parametrize("arrangement", workloads.ARRANGEMENTS)
def test_points_stay_inside_and_off_the_grid(arrangement):
    points = workloads.points(arrangement, 32, 5000)
    assert points.shape == (5000, 3)
    assert points.dtype == torch.float32
    assert points.is_contiguous()
    assert points.min() >= workloads.MARGIN - 1e-3
    assert points.max() <= 31 - workloads.MARGIN + 1e-3
    fraction = points - points.floor()
    assert fraction.min() > 0.9e-3
    assert fraction.max() < 1 - 0.9e-3
    assert torch.equal(points, workloads.points(arrangement, 32, 5000))
    assert (points.amax(0) - points.amin(0)).min() > 15, "they see most of the volume"


def test_coherent_points_are_half_a_voxel_apart():
    points = workloads.points("coherent", 32, 5000)
    steps = (points[1:] - points[:-1]).norm(dim=-1)
    assert 0.5 < steps.median() < 0.52
    assert (steps > 1).float().mean() < 0.03, "rays end seldom"


def test_a_volume_without_an_inside_is_refused():
    with pytest.raises(ValueError, match="more than 6 voxels along an axis; got 6"):
        workloads.points("random", 6, 10)


def test_blobs_leave_the_asked_fraction_of_bricks_empty():
    scene = blobs(64, 8, empty=0.8)
    opacity = scene.table[:, 3]
    seen = torch.zeros(64 // BRICK, 64 // BRICK, 64 // BRICK)
    for z in range(0, 64, BRICK):
        for y in range(0, 64, BRICK):
            for x in range(0, 64, BRICK):
                brick = scene.volume[z : z + BRICK, y : y + BRICK, x : x + BRICK]
                seen[z // BRICK, y // BRICK, x // BRICK] = opacity[int(brick.max() * 256)] > 0
    assert 0.1 < seen.mean() < 0.21
    image = scene.image(scene.field("trilinear", "direct"))
    assert image[..., 3].max() > 0.1


def test_the_shell_has_no_empty_space_and_hides_nothing():
    scene = marschner_lobb(24, 12)
    assert scene.table[:, 3].min() > 0
    opacity = scene.image(scene.field("triquadratic", "direct"))[..., 3]
    assert (opacity > 0).float().mean() > 0.8, "most rays meet the volume"
    assert opacity.max() < 0.999


# --- the floor ---


def test_multiply_adds_are_counted_from_the_loops():
    assert [floor.sums(s) for s in (2, 3, 4)] == [36, 93, 192]
    assert floor.sums(3, 0) == 39
    assert [floor.weights(kernels.bspline(d)) for d in (1, 2, 3)] == [6, 27, 60]


def test_the_floor_programs_do_what_they_say():
    width, steps = floor.lanes(), 5
    buffer = floor.multiply_adds(steps * floor.ACCUMULATORS * width)()
    sums = buffer[2 * width :].reshape(floor.ACCUMULATORS, width)
    expected = torch.arange(floor.ACCUMULATORS) / 2.0**steps + 2 * (1 - 0.5**steps)
    torch.testing.assert_close(sums, expected[:, None].expand_as(sums))

    step = floor.PACKS * width
    words = torch.randint(-(2**31), 2**31, (3, step), dtype=torch.int32)
    for times in (1, 2):
        seen = floor._call(floor.Program("read", width), words.flatten().clone(), 3, times)()
        assert torch.equal(seen[:step], times % 2 * (words[0] ^ words[1] ^ words[2]))

    copied = floor._call(floor.Program("copy", width), torch.cat((words.flatten(), 0 * words.flatten())), 3, 1)()
    assert torch.equal(copied[3 * step :], words.flatten())


def test_thread_numbers_double_up_to_the_cores():
    assert [thread_numbers(n) for n in (1, 2, 6)] == [[1], [1, 2], [1, 2, 4, 6]]


# --- peers ---


def test_what_is_not_installed_says_how_to_install_it(monkeypatch):
    monkeypatch.setattr(task, "find_spec", lambda name: None)
    for peer in (*peers.samplers("bspline3", False), *peers.marchers(), *peers.casters()):
        assert "pip install" in (peer.missing.__wrapped__() if hasattr(peer.missing, "__wrapped__") else peer.missing())


def test_peers_are_asked_only_for_what_they_have():
    assert {p.NAME for p in peers.samplers("linear", True)} == {"torch grid_sample", "torch-interpol"}
    assert {p.NAME for p in peers.samplers("bspline2", True)} == {"torch-interpol", "Dr.Jit by hand"}
    assert {p.NAME for p in peers.marchers()} == {"Dr.Jit loop", "VTK fixed-point"}
    assert {p.NAME for p in peers.casters()} == {"Mitsuba sdfgrid", "Embree"}


# --- every item, tiny ---

PROCESSES = {
    "startup/triquadratic-first", "startup/tricubic-first", "startup/torch.compile", "dvr/memory", "surfaces/memory",
    "steadiness/renders",
}  # fmt: skip
EVERY = [
    (f"{comparison.name}/{item.name}", item) for comparison in COMPARISONS.values() for item in comparison.items(TINY)
]


@pytest.mark.parametrize("item", [pytest.param(item, id=name) for name, item in EVERY if name not in PROCESSES])
def test_every_item_runs_and_its_contestants_agree(item):
    outcome = item.run(TINY, lambda _: None)
    assert outcome.name == item.name
    assert not outcome.errors, outcome.errors
    assert outcome.timings or "no GPU that torch can use" in outcome.absent.values()
    assert outcome.figures or outcome.absent
    assert all(t.difference is None or t.difference <= t.tolerance for t in outcome.timings)


def test_each_item_has_a_name_of_its_own():
    names = [name for name, _ in EVERY]
    assert len(set(names)) == len(names)
    assert all(item.seconds > 0 for _, item in EVERY)


@contextmanager
def unpinned() -> Iterator[None]:
    """Every thread of this process goes back to the cores it could use."""
    if sys.platform != "linux":
        yield
        return
    before = {int(task): os.sched_getaffinity(int(task)) for task in os.listdir("/proc/self/task")}
    try:
        yield
    finally:
        for task in map(int, os.listdir("/proc/self/task")):
            os.sched_setaffinity(task, before.get(task, before[os.getpid()]))


def test_probes_measure_in_this_process_too():
    found = probe.memory(threads=1, voxels=10, size=3, steps=4)
    assert 2**20 < found["before"] <= found["peak"]
    cast = probe.casting_memory(threads=1, voxels=10, size=3)
    assert 2**20 < cast["before"] <= cast["peak"]
    with unpinned():
        steady = probe.steadiness(threads=1, voxels=10, size=3, renders=3)
    assert 0 < steady["median"] <= steady["slowest"]
    assert min(steady.values()) > 0
    calls = probe.first_call(["trilinear", "triquadratic"])
    assert set(calls) == {"trilinear", "triquadratic", "again"}
    assert min(calls.values()) > 0


def test_what_torch_compile_is_given_runs(monkeypatch):
    asked = []
    monkeypatch.setattr(torch, "compile", lambda step, fullgraph: asked.append(step) or step)
    for method in ("triquadratic", None):
        assert probe.torch_compile(threads=1, method=method)["seconds"] >= 0
        with pytest.raises(RuntimeError, match="does not require grad"), torch.no_grad():
            asked[-1]().backward()
        assert asked[-1]().requires_grad


def test_a_probe_runs_in_a_process_of_its_own(forks, tmp_path, monkeypatch):
    monkeypatch.setattr(compiler, "_programs", {})
    cache = tmp_path / "programs"
    found = probe.measured("first_call", {"FILTERLAB_CACHE": str(cache)}, methods=["trilinear"])
    assert found["trilinear"] > 0
    assert list(cache.iterdir()), "the program was compiled there"


def test_a_probe_that_fails_says_why(forks):
    with pytest.raises(probe.ProbeError, match=r"memory: TypeError: .*voxels"):
        probe.measured("memory")


# --- tables ---


def a_report(**changes) -> Report:
    timing = Timing(
        name="fused", first_call=0.2, seconds=(1e-3, 2e-3), spread=Spread.of([1e-3, 2e-3]), calls=1, samples=1000,
        compared_with="direct", difference=2e-7, tolerance=1e-5,
    )  # fmt: skip
    figures = (
        Figure(name="fused ÷ direct", spread=Spread.of([0.03]), bar=at_most("1/25")),
        Figure(name="fused | slow", spread=Spread.of([2.0]), bar=at_most("1")),
        Figure(name="read", spread=Spread.of([150.0]), unit="GB/s"),
    )
    outcome = Outcome(
        name="tiny", what="a thing", rounds=2, share_of_core=0.97, timings=(timing,), figures=figures,
        absent={"VTK": "not installed"}, errors={"bad": "differs"},
    )  # fmt: skip
    section = Section(name="jets", summary="fused against plain", outcomes=(outcome,))
    return Report(machine=describe(), settings=TINY.record(), complete=True, sections=(section,)).model_copy(
        update=changes
    )


def test_tables_say_what_was_met_and_what_was_missed():
    text = tables.as_text(a_report())
    rows = {line.split("  ")[1]: line for line in text.splitlines() if line.startswith("  ")}
    assert rows["fused ÷ direct"].split()[3:] == [
        "0.03",
        "(1/33.3)",
        *["0.03", "(1/33.3)", "…", "0.03", "(1/33.3)", "≤", "1/25", "met"],
    ]
    assert rows["fused | slow"].endswith("≤ 1  MISSED")
    assert rows["read"].split()[1:3] == ["150", "GB/s"]
    assert "1.5 ms" in rows["fused"]
    assert "1.5 µs" in rows["fused"], "per sample"
    assert "2.0e-07 from direct" in rows["fused"]
    assert "not taking part: VTK (not installed)" in text
    assert "ERROR bad: differs" in text
    assert "97 % of the cores' time" in text
    assert "Interrupted" not in text
    assert "Interrupted" in tables.as_text(a_report(complete=False))


def test_columns_line_up():
    lines = tables.table(("a", "b"), [("x", "1"), ("ratio ÷", "1234")]).splitlines()
    assert lines == ["  a           b", "  -------  ----", "  x           1", "  ratio ÷  1234"]


def test_markdown_keeps_its_columns():
    text = tables.as_markdown(a_report())
    assert "| tiny | fused \\| slow | 2 | 2 … 2 | ≤ 1 | MISSED |" in text
    assert "### jets: fused against plain" in text
    assert "* ERROR bad: differs" in text
    assert "Interrupted" in tables.as_markdown(a_report(complete=False))


@pytest.mark.parametrize(
    ("value", "unit", "text"),
    [(1.5, "s", "1.5 s"), (0.0123, "s", "12.3 ms"), (4.56e-5, "s", "45.6 µs"), (7e-10, "s", "0.7 ns"),
     (0.04, "", "0.04 (1/25)"), (0.73, "", "0.73"), (0, "", "0"), (1234.5, "MiB", "1234 MiB")],
)  # fmt: skip
def test_quantities_have_three_digits(value, unit, text):
    assert tables.quantity(value, unit) == text


# --- the record ---


def test_the_record_survives_json_and_refuses_what_is_not_a_number():
    report = a_report()
    assert Report.model_validate_json(report.model_dump_json()) == report
    with pytest.raises(ValidationError):
        Spread(median=float("nan"), low=0, high=0)
    with pytest.raises(ValidationError):
        Report.model_validate({**json.loads(report.model_dump_json()), "more": 1})


def test_the_machine_is_described_without_names():
    text = describe().model_dump_json()
    for secret in (socket.gethostname(), str(Path.cwd()), str(Path.home()), getpass.getuser()):
        assert len(secret) < 4 or secret not in text
    assert describe().versions["torch"] == torch.__version__


# --- the command ---


def test_a_typo_is_one_line_with_the_nearest_name(capsys):
    assert command.main(["jest"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.count("\n") == 1
    assert "unknown comparison 'jest'; did you mean jets?" in err
    assert command.main(["jets/tricubik"]) == 2
    assert "did you mean jets/tricubic" in capsys.readouterr().err


def test_names_choose_comparisons_and_items():
    (comparison, items), (other, _) = chosen(["derivatives", "jets/tricubic"], TINY)
    assert (comparison.name, other.name) == ("jets", "derivatives")
    assert [i.name for i in items] == ["tricubic-coherent", "tricubic-random"]
    assert [c.name for c, _ in chosen([], TINY)] == list(COMPARISONS)
    with pytest.raises(UnknownNameError):
        chosen(["jet"], TINY)


def test_the_list_has_every_item(capsys):
    assert command.main(["--list"]) == 0
    out = capsys.readouterr().out
    assert all(name in out for name, _ in EVERY)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--threads", "3"], "--threads must not exceed the 2 cores there are; got 3"),
        (["--threads", "2", "--clock", "cpu"], "--clock cpu adds up all threads, expected --threads 1 with it; got 2"),
        (["--output", "no/such/folder/x.json"], "cannot write no/such/folder/x.json"),
        (["--show", "no-such.json"], "no-such.json"),
    ],
)
def test_mistakes_are_one_line_before_anything_runs(arguments, message, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(harness, "usable_cores", lambda: 2)
    monkeypatch.setattr(registry, "COMPARISONS", fake(GOOD))
    assert command.main(arguments) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert message in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("arguments", [["--threads", "0"], ["--repeats", "x"], ["--clock", "sun"], ["--qui"]])
def test_wrong_options_are_refused(arguments, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(registry, "COMPARISONS", fake(GOOD))
    with pytest.raises(SystemExit) as end:
        command.main(arguments)
    assert end.value.code == 2
    assert "expected" in capsys.readouterr().err or arguments[0] in ("--clock", "--qui")


def test_a_file_that_is_no_record_is_refused(tmp_path, capsys):
    file = tmp_path / "other.json"
    file.write_text('{"schema_version": 1}')
    assert command.main(["--show", str(file)]) == 2
    assert "is no record of this program: machine" in capsys.readouterr().err


def fake(*outcomes) -> dict[str, Comparison]:
    """One comparison whose items return, or raise, what is given."""

    def item(i: int, result) -> Item:
        def run(settings, tick):
            tick(1.0)
            if isinstance(result, BaseException):
                raise result
            return result

        return Item(f"item{i}", 1.0, run)

    comparison = Comparison("fake", "nothing", lambda settings: [item(i, r) for i, r in enumerate(outcomes)])
    return {"fake": comparison}


GOOD = Outcome(name="item0", what="fine", figures=(Figure(name="x", spread=Spread.of([1.0])),))


def test_a_run_prints_tables_and_leaves_a_record(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(registry, "COMPARISONS", fake(GOOD))
    file = tmp_path / "out.json"
    assert command.main(["--quick", "--repeats", "2", "--output", str(file)]) == 0
    report = Report.model_validate_json(file.read_bytes())
    assert report.complete
    assert report.settings["quick"] is True
    assert report.settings["repeats"] == 2
    assert report.sections[0].outcomes == (GOOD,)
    out = capsys.readouterr().out
    assert "item0: fine" in out
    assert command.main(["--show", str(file), "--markdown"]) == 0
    assert "| item0 | x | 1 |" in capsys.readouterr().out
    assert os.listdir(tmp_path) == ["out.json"], "no temporary file stays"


def test_without_a_name_the_record_goes_to_runs(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(registry, "COMPARISONS", fake(GOOD))
    assert command.main([]) == 0
    (file,) = (tmp_path / "runs").glob("benchmarks-*.json")
    assert Report.model_validate_json(file.read_bytes()).complete


def test_an_item_that_fails_is_a_row_and_the_run_goes_on(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(registry, "COMPARISONS", fake(ValueError("no such thing"), GOOD))
    file = tmp_path / "out.json"
    assert command.main(["--output", str(file)]) == 1
    bad, good = Report.model_validate_json(file.read_bytes()).sections[0].outcomes
    assert bad.errors == {"item0": "ValueError: no such thing"}
    assert good == GOOD


def test_an_item_on_more_threads_is_timed_by_the_wall(tmp_path, capsys, monkeypatch):
    seen = []

    def run(settings, tick):
        seen.append((settings.threads, settings.clock))
        return GOOD

    items = [Item("a", 1.0, run, threads=2), Item("b", 1.0, run)]
    monkeypatch.setattr(registry, "COMPARISONS", {"fake": Comparison("fake", "", lambda settings: items)})
    assert command.main(["--clock", "cpu", "--output", str(tmp_path / "out.json")]) == 0
    assert seen == [(2, "wall"), (1, "cpu")]


def test_the_bars_stand_once_more_at_the_end(tmp_path, capsys, monkeypatch):
    barred = Outcome(name="item0", what="x", figures=(Figure(name="y", spread=Spread.of([2.0]), bar=at_most("1")),))
    monkeypatch.setattr(registry, "COMPARISONS", fake(barred))
    assert command.main(["--output", str(tmp_path / "out.json")]) == 0
    last = capsys.readouterr().out.splitlines()[-1]
    assert last.split() == ["fake/item0", "y", "2", "2", "…", "2", "≤", "1", "MISSED"]


def test_an_interrupted_run_keeps_what_is_done(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(registry, "COMPARISONS", fake(GOOD, KeyboardInterrupt()))
    file = tmp_path / "out.json"
    assert command.main(["--output", str(file)]) == 130
    report = Report.model_validate_json(file.read_bytes())
    assert not report.complete
    assert report.sections[0].outcomes == (GOOD,)
    assert "stopped" in capsys.readouterr().err


def test_a_terminal_gets_a_progress_bar(monkeypatch):
    import rich.console

    shown = io.StringIO()
    console = rich.console.Console(file=shown, force_terminal=True, width=100)
    monkeypatch.setattr(rich.console, "Console", lambda **_: console)
    comparison = fake(GOOD, GOOD)["fake"]
    items = comparison.items(TINY)
    with command._progress([(comparison, items)]) as begin:
        for item in items:
            begin(comparison, item)(1.0)
    assert "fake/item1" in shown.getvalue()
    assert "left" in shown.getvalue()
