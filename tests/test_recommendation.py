"""Recommendations: what is picked is within the budget, and nothing cheaper is; bad questions are refused."""

from __future__ import annotations

import functools
import json
import math
import os
from itertools import product

import pytest
import torch
import yaml

import filterlab as fl
from filterlab import costs
from filterlab.cli import main
from filterlab.cli.options import MEMORY, TIME, quantity
from filterlab.cli.outcome import UsageError
from filterlab.fields.base import Field
from filterlab.io.config import dump_data, loads_config
from filterlab.recommendation import ErrorEstimate, Recommendation, recommend, report, ways
from filterlab.recommendation.choice import IMAGE, Question, _marched, choose
from filterlab.recommendation.errors import Distance, MethodErrors, Yardstick
from filterlab.recommendation.survey import inner_box
from filterlab.recommendation.ways import WayCost
from filterlab.scenes.default import suggested
from filterlab.scenes.model import Scene
from filterlab.signals import Signal
from tests.pairs import covering

FAST = {"seconds": 0.05}
ONE_OF_EACH_KIND = ["trilinear", "mitchell", "ncrsi", "tricubic", "cubic-c1"]
"""Without and with prefilter, of terms, on tetrahedra: where it is not the choice among all that is asked for."""


@pytest.fixture
def quick(monkeypatch) -> None:
    """The command measures costs as briefly as the tests."""
    monkeypatch.setitem(recommend.__kwdefaults__, "seconds", FAST["seconds"])


@pytest.fixture(scope="module")
def samples() -> torch.Tensor:
    return fl.signals.marschner_lobb(frequency=4.0).sample(40).samples


@pytest.fixture(scope="module")
def found(samples) -> Recommendation:
    return recommend(samples, 0.02, **FAST)


def test_the_pick_is_the_cheapest_within_the_budget(found) -> None:
    assert found.pick is not None
    assert found.pick.error.likely <= 0.02
    for candidate in found.candidates:
        assert candidate.error.low <= candidate.error.measured <= candidate.error.likely <= candidate.error.high
        if candidate.seconds < found.pick.seconds:
            assert candidate.error.likely > 0.02
    assert [c.seconds for c in found.candidates] == sorted(c.seconds for c in found.candidates)
    assert found.best.error.likely == min(c.error.likely for c in found.candidates)


# --- the interval holds the truth -------------------------------------------------------------------------------------


def waves(bandwidth: float, n: int, offset: float = 0.0) -> Signal:
    """On voxel coordinates; 16 waves up to a part of the Nyquist frequency."""
    generator = torch.Generator().manual_seed(4)
    k = torch.randn(16, 3, generator=generator, dtype=torch.float64)
    k *= bandwidth * math.pi / k.norm(dim=-1, keepdim=True)
    phase = 2 * math.pi * torch.rand(16, generator=generator, dtype=torch.float64)

    def function(p: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        angle = p @ k.T + phase
        return offset + torch.cos(angle).sum(-1), -torch.sin(angle) @ k

    return Signal("waves", function, (-0.5,) * 3, (n - 0.5,) * 3)


def truths(answer: Recommendation, volume: torch.Tensor, signal: Signal, points: torch.Tensor) -> list[float]:
    """The true error of every candidate at float32 points, in parts of the range, as the task counts it."""
    low, high = answer.value_range
    value, gradient = signal.value_and_gradient(points.double())
    found = []
    for candidate in answer.candidates:
        field = fl.reconstruct(volume, boundary=answer.boundary, **candidate.options())
        v, g = (x.double() for x in field.value_and_gradient(points))
        errors = [float((v - value).square().mean().sqrt()), float((g - gradient).square().sum(-1).mean().sqrt())]
        found.append((errors[0] if answer.task == "resample" else max(errors)) / (high - low))
    return found


def inner(n: int, count: int = 8192) -> torch.Tensor:
    lower, upper = inner_box((n, n, n))
    return (lower + (upper - lower) * torch.quasirandom.SobolEngine(3, True, 1).draw(count)).float()


def check_held(answer: Recommendation, true: list[float]) -> None:
    for candidate, error in zip(answer.candidates, true, strict=True):
        assert candidate.error.low <= 1.02 * error, candidate
        assert error <= 1.02 * candidate.error.high, candidate


@pytest.mark.parametrize(
    ("boundary", "offset"),
    [*((str(b), 0.0) for b in fl.Boundary), ("zeros", 1000.0), ("border", 1000.0), ("mirror", 1000.0)],
)
def test_the_boundary_asked_for_counts(boundary, offset) -> None:
    """Outside is 0 under `zeros`: with an offset of 1000 that is what nearly all of the error comes from."""
    signal = waves(0.3, 20, offset)
    volume = signal.sample(20).samples
    task = "isosurface" if (boundary in ("mirror", "zeros")) == (offset > 0) else "resample"
    answer = recommend(volume, 1e-9, task=task, boundary=boundary, methods=ONE_OF_EACH_KIND, **FAST)
    true = truths(answer, volume, signal, inner(20))
    check_held(answer, true)
    if boundary == "zeros" and offset:
        assert min(t for c, t in zip(answer.candidates, true, strict=True) if c.method == "tricubic") > 1


def test_detail_in_one_corner_counts() -> None:
    """A hundredth of a percent of 112³ voxels."""
    n, center, ground = 112, torch.tensor([14.0, 97.0, 15.0], dtype=torch.float64), waves(0.01, 112)
    texture = waves(0.5, n)

    def function(p: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        window = torch.exp(-0.5 * (p - center).square().sum(-1) / 9)
        return ground(p) + window * texture(p), p

    signal = Signal("corner", function, (-0.5,) * 3, (n - 0.5,) * 3)
    volume = signal.sample(n, dtype=torch.float32).samples
    answer = recommend(volume, 1e-9, methods=["trilinear", "mitchell"], **FAST)
    unit = torch.quasirandom.SobolEngine(3, True, 1).draw(20000, dtype=torch.float64)
    points = (center - 9 + 18 * unit).float()  # what is outside of this cube adds nothing
    share = (18 / (0.9 * n)) ** 3
    span = answer.value_range[1] - answer.value_range[0]
    for candidate in answer.candidates:
        field = fl.reconstruct(volume, **candidate.options())
        true = (
            math.sqrt(share) * float((field(points).double() - signal(points.double())).square().mean().sqrt()) / span
        )
        assert 0.97 * candidate.error.low <= true <= 1.03 * candidate.error.high


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_arithmetic_counts(dtype) -> None:
    """Waves at an offset of a million: float32 points are computed with in float32, whatever the samples are."""
    signal = waves(0.2, 24, 1e6)
    volume = signal.sample(24, dtype=dtype).samples
    answer = recommend(volume, 1e-9, methods=ONE_OF_EACH_KIND, **FAST)
    check_held(answer, truths(answer, volume, signal, inner(24)))
    assert answer.best.error.low > 1e-4


@functools.cache
def in_unit(scale: float) -> Recommendation:
    samples = waves(0.3, 20).sample(20, dtype=torch.float32).samples
    return recommend(scale * samples, 0.2, task="dvr", methods=["trilinear", "tricubic"], **FAST)


@pytest.mark.parametrize("scale", [1e-30, 1e30])
def test_errors_and_steps_are_the_same_in_any_unit(scale) -> None:
    """Squares of 1e-30 underflow; a second derivative that is not taken by the range makes other steps."""
    one, other = in_unit(1.0), in_unit(scale)
    ways = {(c.method, c.scheme, c.storage): c for c in one.candidates if c.storage is None}
    for candidate in other.candidates:
        if candidate.storage is None:
            same = ways[candidate.method, candidate.scheme, None]
            assert candidate.step == same.step
            assert candidate.error.high == pytest.approx(same.error.high, rel=1e-3)


def test_steps_are_not_picked_below_their_error() -> None:
    """A ball of ones: what any method is off at its surface is in no sample."""
    n = 32
    ball = Signal("ball", lambda p: (((p - 15.3).norm(dim=-1) < 10.2).double(), p), (-0.5,) * 3, (n - 0.5,) * 3)
    volume = ball.sample(n).samples
    answer = recommend(volume, 1e-9, **FAST)
    assert not answer.best.resolved
    assert recommend(volume, 0.9 * min(truths(answer, volume, ball, inner(n))), **FAST).pick is None


@pytest.mark.parametrize("boundary", ["mirror", "border"])
def test_a_ramp_needs_no_more_than_trilinear(boundary) -> None:
    z, y, x = torch.meshgrid(*(torch.arange(n, dtype=torch.float64) for n in (20, 24, 28)), indexing="ij")
    answer = recommend(x - 2 * y + 0.5 * z, 1e-6, boundary=boundary, **FAST)
    assert answer.pick is not None
    assert answer.pick.method == "trilinear"


def test_of_a_level_the_errors_are_those_next_to_its_surface() -> None:
    """A ball whose surface is a tanh: most of the volume is even, and all errors are at the surface."""
    n, radius, width = 40, 11.3, 2.2
    center = torch.tensor([19.2, 20.4, 18.7], dtype=torch.float64)

    def function(p: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        d = p - center
        t = torch.tanh((radius - d.norm(dim=-1)) / width)
        return 0.5 + 0.5 * t, (-0.5 * (1 - t * t) / width / d.norm(dim=-1))[..., None] * d

    signal = Signal("ball", function, (-0.5,) * 3, (n - 0.5,) * 3)
    volume = signal.sample(n).samples
    directions = torch.nn.functional.normalize(torch.randn(4096, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    asked = {"task": "isosurface", "methods": ONE_OF_EACH_KIND, **FAST}
    answer = recommend(volume, 1e-9, level=0.5, **asked)
    check_held(answer, truths(answer, volume, signal, (center + radius * directions).float()))
    anywhere = recommend(volume, 1e-9, **asked)
    assert answer.best.error.measured > 1.5 * anywhere.best.error.measured
    assert "next to the surface of 0.5" in report.sentences(answer)[0]
    assert "next to" not in report.sentences(anywhere)[0]
    assert report.data(answer)["level"] == 0.5


def test_waves_near_the_nyquist_frequency() -> None:
    signal = waves(0.85, 32)
    volume = signal.sample(32).samples
    answer = recommend(volume, 1e-9, **FAST)
    check_held(answer, truths(answer, volume, signal, inner(32)))


def test_what_is_between_is_said_to_be_undecided() -> None:
    noise = torch.rand(20, 20, 20, generator=torch.Generator().manual_seed(0))
    asked = {"methods": ["tricubic"], **FAST}
    error = recommend(noise, 1e-9, **asked).best.error
    assert not recommend(noise, 1e-9, **asked).undecided or error.low <= 1e-9
    answer = recommend(noise, 0.5 * (error.low + error.likely), **asked)
    assert answer.pick is None
    assert answer.undecided
    assert "the samples do not tell" in report.sentences(answer)[1]


@pytest.mark.parametrize("task", ["resample", "dvr"])
def test_what_a_refusal_says_would_help_does(task: str) -> None:
    """The budget that is named is met."""
    noise = torch.rand(24, 24, 24, generator=torch.Generator().manual_seed(1))
    asked = {"task": task, "methods": ["triquadratic", "tricubic"], **FAST}
    refused = recommend(noise, 0.01, **asked)
    *_, best, helps = report.sentences(refused)
    assert refused.pick is None
    assert helps.startswith("What would help: a budget of ")
    assert "antialias=True" in helps
    assert not refused.best.resolved
    budget = float(helps.split("a budget of ")[1].split(" %")[0]) / 100
    assert refused.best.error.likely <= budget <= 1.01 * refused.best.error.likely
    met = recommend(noise, budget, **asked)
    assert met.pick is not None
    assert f"The most accurate: {refused.best.method}" in best
    assert all("help" not in line for line in report.sentences(met))


def test_a_refusal_says_where_the_value_alone_would_do(samples) -> None:
    every = recommend(samples, 1e-9, task="isosurface", methods=["tricubic"], **FAST)
    between = math.sqrt(every.of_value.likely * every.best.error.likely)
    assert every.of_value.likely < between < every.best.error.likely
    refused = recommend(samples, between, task="isosurface", methods=["tricubic"], **FAST)
    assert refused.pick is None
    assert "to count the value alone, as task resample does" in report.sentences(refused)[-1]
    assert recommend(samples, between, methods=["tricubic"], **FAST).pick is not None
    assert "the value alone" not in report.sentences(every)[-1]
    assert "finer voxels" in report.sentences(every)[-1]


def test_a_refusal_for_memory_alone_names_what_is_needed(samples) -> None:
    refused = recommend(samples, 0.5, max_memory=10, methods=["tricubic"], **FAST)
    assert refused.pick is None
    assert all("help" not in line for line in report.sentences(refused))


# --- what is recommended can be built ---------------------------------------------------------------------------------


def test_a_pick_is_built_of_all_of_the_volume() -> None:
    """The second channel does not fit into float16, and no smaller memory is asked for than that takes."""
    volume = torch.rand(1, 2, 16, 16, 16)
    volume[:, 1] *= 1e6
    answer = recommend(volume, 5.0, max_memory=40_000, methods=["trilinear"], **FAST)
    assert answer.pick is not None
    assert answer.pick.storage in ("int16", "uint8")
    answer.field(volume)


def test_what_only_the_whole_volume_tells_is_found_before_it_is_picked() -> None:
    """As if the parts that were looked at had fitted into float16."""
    volume = fl.Volume(1e6 * torch.rand(8, 8, 8))
    yardstick = Yardstick.of(volume.samples[None], None, fl.Boundary.MIRROR)
    plain, short = ("trilinear", "fused", None), ("trilinear", "fused", "float16")
    errors = dict.fromkeys((plain, short), yardstick.errors("trilinear"))
    question = Question("resample", 9.0, math.inf, math.inf, "mirror", "refuse")
    found = choose(question, volume, yardstick, errors, {plain: WayCost(1.0, 9.0, 8), short: WayCost(0.1, 1.0, 4)})
    assert [c.storage for c in found.candidates] == ["float16", None]
    assert found.pick is not None
    assert found.pick.storage is None


def test_the_best_is_the_one_with_the_least_upper_end_whatever_it_costs() -> None:
    """Both may be exact, as far as the samples tell; the cheaper one is three times as far from the reference."""
    volume = fl.Volume(torch.rand(8, 8, 8))
    doubts = {"value": 0.05, "gradient": 0.05, "bend": 0.0}
    yardstick = Yardstick(fl.Boundary.MIRROR, (0.0, 1.0), None, (), (), doubts, 0.0, 0.0, 0.0)
    cheap, best = ("trilinear", "fused", None), ("tricubic", "fused", None)
    errors = {way: MethodErrors(Distance(rms), Distance(rms)) for way, rms in ((cheap, 0.03), (best, 0.01))}
    question = Question("resample", 1e-9, math.inf, math.inf, "mirror", "refuse")
    found = choose(question, volume, yardstick, errors, {cheap: WayCost(1.0, 9.0, 8), best: WayCost(2.0, 9.0, 8)})
    assert [c.error.low for c in found.candidates] == [0, 0]
    assert found.best.method == "tricubic"


def test_no_integer_is_nan(samples) -> None:
    hole = samples[:20, :20, :20].clone()
    hole[3, 4, 5] = math.nan
    answer = recommend(hole, 0.9, nan="propagate", max_memory=30_000, methods=["trilinear"], **FAST)
    assert answer.pick is not None
    assert answer.pick.storage == "float16"
    answer.field(hole)


def test_large_values_are_refused_before_the_work() -> None:
    with pytest.raises(ValueError, match=r"expected samples within ±3\.32e\+35, as fields are evaluated in float32"):
        recommend(torch.rand(8, 8, 8, dtype=torch.float64) * 1e300, 0.1)


# --- the answer -------------------------------------------------------------------------------------------------------


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
        value, surface, picture = (errors[task][method].error.measured for task in ("resample", "isosurface", "dvr"))
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

    def estimate(step: float) -> ErrorEstimate:
        error = math.hypot(0.9, 0.5 * step**2)
        return ErrorEstimate(error, 0.0, error, 2 * error, error)

    step, error = _marched(estimate, budget)
    assert step == expected
    assert error == estimate(step)


def fixed_costs(monkeypatch, nanoseconds: float = 50.0) -> dict[str, tuple[Field, int]]:
    """Costs without a clock: so long for every sample, and a nanosecond for every voxel of a build.

    Returns what was measured: way -> the field, and the order of its jets.
    """
    measured = {}

    def measure(candidates, points, *, order, seconds, tick):
        found = {}
        for name, build in candidates.items():
            field = build()
            measured[name] = field, order
            voxels = math.prod(field.coefficients.size)
            quartiles = [costs.Quartiles(x / 2, x, 3 * x) for x in (1e-9 * voxels, nanoseconds)]
            found[name] = costs.Cost(*quartiles, 0, ())
        return found

    monkeypatch.setattr(ways.costs, "measure", measure)
    return measured


def test_seconds_and_bytes_are_those_of_the_whole_volume(monkeypatch) -> None:
    """Of a long one, of which only a part is measured; padded by two voxels at each end, and once more as a batch."""
    fixed_costs(monkeypatch)
    for shape in ((8, 8, 400), (2, 3, 8, 8, 400)):
        answer = recommend(torch.rand(shape), 1e-9, methods=["catmull-rom"])
        voxels, volumes = math.prod(shape), math.prod(shape[:-3])
        (found,) = answer.candidates
        pad = fl.reconstruct(torch.rand(8, 8, 8), "catmull-rom").coefficients.values.shape[0] - 8
        assert pad > 0
        assert found.memory == volumes * (8 + pad) * (8 + pad) * (400 + pad) * 4
        assert found.seconds == pytest.approx(1e-9 * voxels + 50e-9 * voxels)


@pytest.mark.parametrize(
    ("boundary", "shape"),
    covering(product(fl.Boundary, [(6, 1, 170), (1, 2, 2, 165, 5)]), lambda boundary, shape: (boundary, shape)),
)
def test_bytes_are_those_of_the_field_that_is_built(boundary, shape, monkeypatch) -> None:
    """Of every method and storage, though only the middle 160 voxels of an axis are looked at."""
    measured, volume = fixed_costs(monkeypatch), fl.Volume(torch.rand(shape))
    samples = volume.samples.reshape(-1, *shape[-3:])[0]
    asked = [way for method in fl.METHODS.values() for way in ways.ways_of(method, samples.dtype, True)]
    found = ways.costs_of(samples, volume, asked, boundary, 1, 0.0)
    assert set(fl.METHODS) == {method for method, _, _ in found}
    for (method, scheme, storage), cost in found.items():
        field = fl.reconstruct(volume, method, boundary=boundary, scheme=scheme, storage=storage)
        assert cost.memory == field.coefficients.values.nbytes, (method, storage)
        assert cost.build == pytest.approx(1e-9 * volume.samples.numel())
    part, _ = measured["nearest/fused/None"]
    long = max(range(3), key=lambda dim: shape[-3:][dim])
    low = (shape[-3:][long] - 160) // 2
    middle = fl.reconstruct(samples.narrow(long, low, 160).contiguous(), "nearest", boundary=boundary)
    assert torch.equal(part.coefficients.values, middle.coefficients.values)


@pytest.mark.parametrize(("task", "order"), [("resample", 0), ("isosurface", 1), ("dvr", 1)])
def test_what_is_timed_is_what_the_task_asks_for(task, order, monkeypatch) -> None:
    measured = fixed_costs(monkeypatch)
    recommend(torch.rand(8, 8, 8), 1e-9, task=task, methods=["trilinear"])
    assert [asked for _, asked in measured.values()] == [order]


@pytest.mark.parametrize("volumes", [1, 6])
def test_a_picture_takes_as_many_samples_as_its_pixels_see_of_the_volume(volumes, monkeypatch) -> None:
    """A box of 12 × 16 × 20 voxels fills their product of a cube that is as wide as its diagonal: of every volume."""
    fixed_costs(monkeypatch)
    samples = waves(0.3, 20).sample(20).samples[:12, :16].expand(volumes, 1, 12, 16, 20)
    volume = samples if volumes > 1 else samples[0, 0]
    answer = recommend(volume, 1e-9, task="dvr", methods=["trilinear", "tricubic"])
    voxels, diagonal = 12 * 16 * 20, math.sqrt(12**2 + 16**2 + 20**2)
    assert len({c.step for c in answer.candidates}) > 1
    for c in answer.candidates:
        assert c.step is not None
        samples = volumes * (IMAGE / diagonal) ** 2 * voxels / c.step
        assert c.seconds == pytest.approx(1e-9 * volumes * voxels + 50e-9 * samples)


def test_limits_of_time_are_seconds(monkeypatch) -> None:
    fixed_costs(monkeypatch)
    needed = 51e-9 * 16**3
    for limit, found in ((1.01 * needed, True), (0.99 * needed, False)):
        answer = recommend(torch.rand(16, 16, 16), 9.0, max_time=limit, methods=["trilinear"])
        assert (answer.pick is not None) == found


def test_an_interval_widens_with_doubt_spread_and_rounding() -> None:
    plain = Distance(1.0).between("value", 0.0, 20.0)
    assert plain == (1.0, 1.0, 1.0)
    for wider in (
        Distance(1.0, 0.1).between("value", 0.0, 20.0),
        Distance(1.0).between("value", 0.1, 20.0),
        Distance(1.0).between("value", 0.0, 20.0, rounding=0.5),
    ):
        assert wider[0] < 1 < wider[2] <= wider[1]
    assert Distance(1.0).between("value", 0.1, 0.0)[1] > Distance(1.0).between("value", 0.1, 40.0)[1]


def test_every_candidate_has_its_own_step(samples) -> None:
    """Less is left for the march where the method takes more of the budget."""
    answer = recommend(samples, 5.0, task="dvr", methods=["trilinear"], **FAST)
    assert answer.chosen.step == 1.0
    tight = 1.0001 * recommend(samples, 1e-9, task="isosurface", methods=["tricubic"], **FAST).chosen.error.likely
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
    assert all(c.resolved for c in in_unit(1.0).candidates)  # waves far below the Nyquist frequency


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
    answer = recommend(volume, 0.5, methods=["triquadratic"], **FAST)
    for candidate in answer.candidates:
        assert math.isfinite(candidate.error.high)
    assert answer.field(volume) is not None


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"max_error": 0.0}, "max_error must be positive; got 0.0"),
        ({"max_error": math.nan}, "max_error must be positive"),
        ({"max_memory": -1}, "max_memory must be positive; got -1"),
        ({"task": "print"}, "task must be one of resample, dvr, isosurface; got 'print'"),
        ({"methods": ["noch"]}, "unknown method 'noch'"),
        ({"level": 0.5}, "level is that of an isosurface; got level=0.5 for task 'resample'"),
        ({"level": 7.0, "task": "isosurface"}, "expected a level with a surface in the inner part .* got 7"),
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
    look = suggested(fl.reconstruct(samples, "trilinear"))
    scene = loads_config(dump_data(report.scene(found, str(tmp_path / "v.nrrd"), look)), Scene)
    assert scene.method is not None
    assert scene.method.name == found.chosen.method


def test_data_is_plain(found) -> None:
    assert json.loads(json.dumps(report.data(found), allow_nan=False))["pick"]["method"] == found.chosen.method


def test_the_command(samples, quick, tmp_path, capsys) -> None:
    file = tmp_path / "v.nrrd"
    fl.save_volume(fl.Volume(samples[:20, :20, :20].clone()), file)
    assert main(["recommend", str(file), "--max-error", "90%", "-o", str(tmp_path / "s.yaml"), "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert answer["max_error"] == 0.9
    assert yaml.safe_load((tmp_path / "s.yaml").read_text())["method"]["name"] == answer["pick"]["method"]
    assert main(["render", str(tmp_path / "s.yaml"), "-o", str(tmp_path / "p.png"), "--size", "8", "8"]) == 0
    surface = ["--task", "isosurface", "--level", "0.5"]
    assert main(["recommend", str(file), "--max-error", "90%", *surface, "-o", str(tmp_path / "t.yaml")]) == 0
    assert yaml.safe_load((tmp_path / "t.yaml").read_text())["surface"] == 0.5
    assert main(["render", str(tmp_path / "t.yaml"), "-o", str(tmp_path / "q.png"), "--size", "8", "8"]) == 0
    capsys.readouterr()
    assert main(["recommend", str(file), "--max-error", "0.000001%"]) == 3
    assert "Nothing is likely to meet the budget" in capsys.readouterr().out


@pytest.fixture
def no_work(monkeypatch) -> None:
    def refused(*_, **__):
        raise AssertionError("nothing is measured for a scene that can't be written")

    monkeypatch.setattr("filterlab.recommendation.recommend", refused)


@pytest.mark.parametrize(
    ("samples", "options", "message"),
    [
        (1e8 + 1e-3 * torch.rand(8, 8, 8, dtype=torch.float64), [], "control points of the transfer function coincide"),
        (torch.rand(8, 8, 8).where(torch.rand(8, 8, 8) > 0.1, math.nan), [], "NaN of 512"),
    ],
    ids=["nearly constant", "not a number"],
)
def test_a_scene_that_would_not_render_is_refused_before_the_work(
    samples, options, message, no_work, tmp_path, capsys
) -> None:
    fl.save_volume(fl.Volume(samples), tmp_path / "v.npy")
    asked = ["recommend", str(tmp_path / "v.npy"), "--max-error", "90%", "-o", str(tmp_path / "s.yaml"), *options]
    assert main(asked) == 1
    assert message in capsys.readouterr().err
    assert not (tmp_path / "s.yaml").exists()


def test_a_name_that_no_scene_can_hold_is_refused_before_the_work(no_work, tmp_path, capsys) -> None:
    fl.save_volume(fl.Volume(torch.rand(8, 8, 8)), tmp_path / "v.npy")
    name = os.fsdecode(os.fsencode(tmp_path) + b"/\xff.npy")
    os.rename(tmp_path / "v.npy", name)
    assert main(["recommend", name, "--max-error", "90%", "-o", str(tmp_path / "s.yaml")]) == 1
    assert "expected a name in UTF-8" in capsys.readouterr().err


@pytest.mark.parametrize("volume", [torch.full((8, 8, 8), 1e8), torch.rand(8, 8, 8)], ids=["constant", "dollar"])
def test_what_is_written_renders(volume, quick, monkeypatch, tmp_path) -> None:
    """A name with a $ in it stands for itself, and a constant far from zero has control points of its own."""
    monkeypatch.setattr("filterlab.recommendation.choice.METHODS", {"tricubic": fl.METHODS["tricubic"]})
    (tmp_path / "a$b").mkdir()
    file, scene = tmp_path / "a$b" / "v.npy", tmp_path / "s.yaml"
    fl.save_volume(fl.Volume(volume), file)
    assert main(["recommend", str(file), "--max-error", "90%", "-o", str(scene)]) == 0
    assert main(["render", str(scene), "-o", str(tmp_path / "p.png"), "--size", "8", "8"]) == 0


@pytest.mark.parametrize(
    ("arguments", "code", "message"),
    [
        (["--max-error", "much"], 2, "expected --max-error to be a positive number"),
        (["--max-error", "-1%"], 2, "expected --max-error to be a positive number"),
        (["--max-error", "1%", "--max-memory", "3 parsec"], 2, "expected --max-memory"),
        (["--max-error", "1%", "--task", "dwr"], 1, "unknown task 'dwr'; did you mean 'dvr'?"),
        (["--max-error", "1%", "-o", "scene.png"], 1, "ends in .yaml"),
        (["--max-error", "1%", "--level", "0.5"], 1, "expected --task isosurface, got resample"),
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
