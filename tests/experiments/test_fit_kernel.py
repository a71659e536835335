"""Learned kernels and prefilters: the objective, known optima, members kept apart, the verdict, and the report."""

import math

import pytest
import torch
import yaml

import filterlab as fl
from experiments import fir
from experiments.__main__ import main
from experiments.comparison import BETTER, MIXED, WORSE, chosen, compared, pooled
from experiments.config import Recipe
from experiments.descent import Stage, minimize
from experiments.fit_kernel import Config, check, compute, units
from experiments.fitting import Candidate, Fit, Objective, parameters_of
from experiments.members import (
    MarschnerLobbClass,
    Members,
    Role,
    Sampling,
    Scan,
    WavesClass,
    least_extent,
    seed_of,
)
from experiments.report.fit_kernel import draw
from experiments.runs import Run, read_records
from filterlab import kernels, signals, spectrum
from filterlab.io.config import ConfigError
from filterlab.methods import from_kernel
from tests.experiments.conftest import figures_left_empty

SAMPLING = Sampling(resolution=12, inner=0.4)
WAVES = WavesClass(kind="waves", title="waves", bandwidth=0.6, waves=8)
TINY = {
    "experiment": "fit_kernel",
    "description": "a tiny one",
    "seed": 5,
    "threads": 1,
    "classes": [
        {"kind": "waves", "title": "waves", "bandwidth": 0.6, "waves": 6},
        {"kind": "marschner-lobb", "title": "rings", "frequency": [1, 1.5]},
    ],
    "candidates": [{"kernel": "bspline2", "prefilter": 3}, "bc"],
    "methods": ["triquadratic", "notch", "ncrsi", "tricubic"],
    "resolution": 8,
    "training": 2,
    "validation": 1,
    "test": 2,
    "points": 20,
    "test_points": 20,
    "repetitions": 2,
    "iterations": 6,
    "learning_rate": 0.6,  # so large that it goes past
    "record_every": 1,
}


def waves(role: Role = "training", seed=1):
    return WAVES.open(SAMPLING).members(role, 2, 60, seed)


def objective(members, reference="trilinear", weight=0.5):
    return Objective.of(members, "reflect", weight, Recipe(name=reference))


def learned(fit, tmp_path, steps=60, rate=0.1):
    state = minimize(
        fit,
        [Stage(iterations=steps, learning_rate=rate)],
        tmp_path / "state",
        observe_every=steps,
        checkpoint_every=steps,
    )
    return fit.parameters(state.parameters["z"].detach())


# --- prefilters -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("boundary", ["mirror", "reflect", "wrap"])
def test_a_short_prefilter_multiplies_a_wave_by_its_response(boundary):
    """On the whole periods that each boundary makes of its own kind of wave."""
    n, taps = 6, torch.tensor([-0.3, 0.07], dtype=torch.float64)
    i = torch.arange(n, dtype=torch.float64)
    omega, at = {
        "mirror": (2 * math.pi / (n - 1), i),
        "reflect": (2 * math.pi / n, i + 0.5),
        "wrap": (2 * math.pi / n, i + 0.2),
    }[boundary]
    wave = torch.cos(omega * at).expand(n, n, n)
    gain = fir.response(taps, torch.tensor(omega, dtype=torch.float64))
    torch.testing.assert_close(fir.convolve(wave, taps, boundary), gain * wave)
    torch.testing.assert_close(fir.convolve(wave.mT, taps, boundary), gain * wave.mT)


def test_a_short_prefilter_keeps_constants_and_refuses_boundaries_that_do_not_repeat():
    ones = torch.ones(3, 4, 5, dtype=torch.float64)
    torch.testing.assert_close(fir.convolve(ones, torch.tensor([0.4, -0.9]).double(), "mirror"), ones)
    with pytest.raises(ValueError, match="mirror, reflect or wrap; got zeros"):
        fir.convolve(ones, torch.zeros(1).double(), "zeros")


def test_the_low_pass_lets_low_frequencies_pass_and_no_others():
    taps = fir.low_pass(0.42 * math.pi, 12)
    gain = fir.response(taps, torch.tensor([0, 0.2 * math.pi, 0.42 * math.pi, 0.6 * math.pi, math.pi]).double())
    torch.testing.assert_close(gain, torch.tensor([1, 1, 0.5, 0, 0]).double(), atol=0.01, rtol=0)


def test_products_per_voxel():
    assert [fir.multiplications(n) for n in (1, 3, 5, 7)] == [0, 6, 9, 12]
    assert [fir.multiplications(fl.PREFILTERS[n]) for n in ("identity", "quadratic", "notch")] == [0, 9, 15]


@pytest.mark.parametrize("name", ["triquadratic", "catmull-rom", "notch"])
def test_error_kernel_and_measures_are_those_of_the_method(name):
    """Measured: a wave is reconstructed and compared with itself, over a voxel and all phases."""
    method, n = fl.METHODS[name], 16
    omega = torch.tensor(2 * math.pi * 5 / n, dtype=torch.float64)
    i = torch.arange(n, dtype=torch.float64)
    samples = torch.stack([torch.cos(omega * i), torch.sin(omega * i)])[None, :, None, None]
    x = (torch.arange(100 * n, dtype=torch.float64) + 0.5) / 100
    points = torch.stack((x, 0 * x, 0 * x), -1)[None]
    found = fl.reconstruct(samples, method, boundary="wrap")(points)[0]
    wanted = torch.stack([torch.cos(omega * x), torch.sin(omega * x)])
    measured = (found - wanted).square().sum(0).mean().sqrt()
    prefiltering = method.prefilter.response(omega)
    torch.testing.assert_close(fir.error_kernel(method.kernel, prefiltering, omega), measured, rtol=1e-4, atol=0)
    measures = fir.measures(method.kernel, method.prefilter.response)
    assert measures["smoothing"] == pytest.approx(spectrum.smoothing(name), abs=1e-9)
    assert measures["postaliasing"] == pytest.approx(spectrum.postaliasing(name), abs=1e-7)


# --- members ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("drawn", [WAVES, MarschnerLobbClass(kind="marschner-lobb", title="m", frequency=(2, 3))])
def test_members_are_repeatable_apart_and_know_their_gradient(drawn):
    source = drawn.open(SAMPLING)
    first, again, other = (source.members("training", 2, 9, s) for s in (1, 1, 2))
    test = source.members("test", 2, 9, 1)
    assert torch.equal(first.points, again.points)
    assert torch.equal(first.volume.samples, again.volume.samples)
    for apart in (other, test):
        assert (first.points != apart.points).all()
        assert (first.volume.samples != apart.volume.samples).all()
    signal = drawn.draw(torch.Generator().manual_seed(3), 12)
    points = first.points[0].requires_grad_()
    value, gradient = signal.value_and_gradient(points)
    torch.testing.assert_close(torch.autograd.grad(value.sum(), points)[0], gradient)


def test_waves_stay_below_their_bandwidth():
    n = 16
    signal = WavesClass(kind="waves", title="w", bandwidth=0.5, waves=40).draw(torch.Generator().manual_seed(1), n)
    fine = signal.sample(n).samples  # a voxel is what the bandwidth is meant for
    window = torch.hann_window(n, periodic=False, dtype=torch.float64)
    power = torch.fft.fftn(fine * window * window[:, None] * window[:, None, None]).abs() ** 2
    frequency = torch.fft.fftfreq(n).double() * 2
    radius = torch.stack(torch.meshgrid(frequency, frequency, frequency, indexing="ij")).norm(dim=0)
    assert power[radius > 0.5 + 4 / n].sum() < 1e-4 * power.sum()
    assert power[radius > 0.35].sum() > 0.3 * power.sum()


@pytest.fixture(scope="module")
def scan():
    generator = torch.Generator().manual_seed(2)
    return Scan.of(torch.rand(20, 24, 60, generator=generator, dtype=torch.float64), Sampling(20, 1))


def test_a_scan_is_known_where_it_was_decimated(scan):
    assert scan.coarse.shape == (10, 12, 30)
    at = torch.tensor([[0.0, 0, 0], [3, 4, 5], [29, 11, 9]], dtype=torch.float64)
    torch.testing.assert_close(scan.truth(2 * at), scan.coarse[[0, 5, 9], [0, 4, 11], [0, 3, 29]])
    members = scan.members("training", 3, 50, 1)
    assert members.volume.samples.shape[-3:] == (20, 20, 20)
    # the truth there is what all of the scan gives: a piece knows the samples around it
    field = fl.reconstruct(members.volume, "tricubic", boundary="reflect")
    whole = members.errors(field)
    assert max(whole["value"]) < 0.5 * float(members.values.std())
    assert max(whole["gradient"]) < 0.7 * members.scales[1]


def test_parts_of_a_scan_are_apart(scan):
    ends = {}
    for role in ("training", "validation", "test"):
        boxes = [scan._box(role, torch.Generator().manual_seed(s)) for s in range(20)]
        ends[role] = (min(b[0][2] for b in boxes), max(b[0][2] + b[1][2] for b in boxes))
    assert ends["training"][1] <= ends["validation"][0] < ends["validation"][1] <= ends["test"][0]
    assert ends["test"][1] <= 30
    assert least_extent((20, 24, 60)) == 5


def test_pieces_of_a_scan_have_something_in_them():
    samples = torch.zeros(16, 16, 80, dtype=torch.float64)
    samples[:, :, 68:] = torch.rand(16, 16, 12, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    members = Scan.of(samples, Sampling(18, 1)).members("test", 12, 200, 1)
    assert (members.values.std(1) > 0.01).all()
    empty = Scan.of(torch.zeros(8, 8, 20, dtype=torch.float64), Sampling(18, 1)).members("test", 1, 5, 1)
    assert (empty.values == 0).all()


# --- objective and known optima ---------------------------------------------------------------------------------------


@pytest.mark.parametrize("candidate", [Candidate(kernel="bc", prefilter=3), Candidate(kernel="notch", prefilter=5)])
def test_the_derivative_of_the_objective_is_its_slope(candidate):
    f = objective(waves())
    start = {k: p + 0.1 for k, p in candidate.start((0.2, 0.3)).items()}
    parameters = {k: p.clone().requires_grad_() for k, p in start.items()}
    f(candidate, parameters).backward()
    step = 1e-6
    for name, p in start.items():
        for i in range(len(p)):
            ahead, behind = (
                {**start, name: p.index_add(0, torch.tensor([i]), p.new_tensor([s]))} for s in (step, -step)
            )
            slope = (f(candidate, ahead) - f(candidate, behind)) / (2 * step)
            torch.testing.assert_close(parameters[name].grad[i], slope, rtol=1e-5, atol=1e-7)


def test_the_objective_is_one_for_its_reference():
    members = waves()
    f = objective(members, "catmull-rom")
    named = {"bc": torch.tensor([0, 0.5], dtype=torch.float64)}
    assert float(f(Candidate(kernel="bc"), named)) == pytest.approx(1)
    value, gradient = members.errors(fl.reconstruct(members.volume, "catmull-rom", boundary="reflect")).values()
    assert (pooled(value) ** 2, pooled(gradient) ** 2) == pytest.approx(f.reference)


def test_a_reference_without_an_error_is_refused():
    linear = [signals.polynomial({(1, 0, 0): 1.0})]
    with pytest.raises(ValueError, match="trilinear is not exact for"):
        objective(Members(*_exact(Members.of_signals(linear, SAMPLING, 5, 1))))


def _exact(members):
    """The members with what trilinear interpolation makes of them as the truth."""
    value, gradient = fl.reconstruct(members.volume, "trilinear", boundary="reflect").value_and_gradient(members.points)
    return members.volume, members.points, value[:, 0], gradient[:, 0]


def made_by(candidate, parameters, members):
    """The same volumes, but with the field of a known filter as the truth."""
    field = candidate.reconstruct(parameters, members.volume, "reflect")
    value, gradient = field.value_and_gradient(members.points)
    return Members(members.volume, members.points, value[:, 0], gradient[:, 0])


@pytest.mark.parametrize(
    ("candidate", "known"),
    [
        (Candidate(kernel="bc"), {"bc": [0.2, 0.6]}),
        (Candidate(kernel="bspline2", prefilter=5), {"taps": [-0.28, 0.05]}),
    ],
)
def test_the_filter_that_made_the_data_is_found(candidate, known, tmp_path):
    truth = parameters_of(known)
    training, validation = (objective(made_by(candidate, truth, waves(role))) for role in ("training", "validation"))
    found = learned(Fit.of(candidate, training, validation, candidate.start((1 / 3, 1 / 3))), tmp_path, 150)
    for name, value in truth.items():
        torch.testing.assert_close(found[name], value, atol=2e-3, rtol=0)


@pytest.mark.parametrize(
    ("candidate", "condition"),
    [
        # paper, eq. 12: B and C with which quadratics are reproduced
        (Candidate(kernel="bc"), lambda p: 2 * p["bc"][1] + p["bc"][0] - 1),
        # φ̂ = 1 − ω²/8 + …, so the prefilter must be 1 + ω²/8 + …: −h₁ = 1/8
        (Candidate(kernel="bspline2", prefilter=3), lambda p: p["taps"][0] + 1 / 8),
    ],
)
def test_on_quadratics_the_conditions_of_quasi_interpolation_are_learned(candidate, condition, tmp_path):
    terms = {(2, 0, 0): 1.0, (0, 2, 0): -0.7, (0, 0, 2): 0.4, (1, 1, 0): 0.5, (0, 0, 1): 1.0}
    f = objective(Members.of_signals([signals.polynomial(terms)], SAMPLING, 60, 1), weight=0)
    found = learned(Fit.of(candidate, f, f, candidate.start((0.0, 0.0))), tmp_path, 150)
    assert float(condition(found)) == pytest.approx(0, abs=2e-3)


# --- candidates and comparison ----------------------------------------------------------------------------------------


def test_candidates_say_what_they_cost():
    taps = {k: Candidate(kernel=k, prefilter=3).taps for k in ("bspline2", "notch", "bspline3", "bc")}
    assert taps == {"bspline2": 27, "notch": 27, "bspline3": 64, "bc": 64}
    for bad, message in (
        ({"kernel": "bspline2"}, "nothing to learn"),
        ({"kernel": "bspline2", "prefilter": 4}, "odd number"),
        ({"kernel": "bsplin2", "prefilter": 3}, "did you mean"),
    ):
        with pytest.raises(ValueError, match=message):
            Candidate.model_validate(bad)


def test_verdicts():
    named = {"value": [1.0, 2.0], "gradient": [1.0, 1.0]}
    half = compared([{"value": [0.5, 1.0]}, {"value": [0.5, 1.0]}], named, "value")
    assert half["ratio"] == pytest.approx(0.5)
    assert (half["wins"], half["comparisons"]) == (4, 4)
    assert half["verdict"] == BETTER
    assert compared([{"value": [2.0, 4.0]}], named, "value")["verdict"] == WORSE
    assert compared([{"value": [0.999, 1.999]}], named, "value")["verdict"] == MIXED  # too little
    assert compared([{"value": [1.1, 1.0]}], named, "value")["verdict"] == MIXED  # not on every member
    assert compared([{"value": [0.5, 1.0]}, {"value": [1.1, 2.1]}], named, "value")["verdict"] == MIXED
    assert compared([{"value": [0.0, 0.0]}], {"value": [0.0, 0.0]}, "value")["verdict"] == MIXED
    assert pooled([3.0, 4.0]) == pytest.approx(math.sqrt(12.5))


def test_the_choice_is_by_validation_alone():
    fits = [
        {"taps": 27, "candidate": "a", "validation": 1.0, "test": {"value": [9.0]}},
        {"taps": 27, "candidate": "a", "validation": 3.0, "test": {"value": [9.0]}},
        {"taps": 27, "candidate": "b", "validation": 2.1, "test": {"value": [1.0]}},
        {"taps": 64, "candidate": "c", "validation": 5.0, "test": {"value": [9.0]}},
    ]
    assert chosen(fits) == {27: "a", 64: "c"}


# --- the run ----------------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fit")
    path = folder / "fit.yaml"
    path.write_text(yaml.safe_dump(TINY))
    with figures_left_empty():
        assert main(["run", str(path), "--runs", str(folder / "runs")]) == 0
    (run,) = (folder / "runs").iterdir()
    return run, read_records(run)[0]


def test_records_can_be_had_again_from_the_parameters(ran):
    """The test errors of a fit, recomputed from its record; the same bits from another run."""
    folder, records = ran
    config = Config(**TINY)
    fit = records["0/fit/1/bc"]
    run = Run(folder, dict(records))
    again = compute(config, next(u for u in units(config) if u.key == "0/named"), run)
    assert again["methods"] == records["0/named"]["methods"]
    fits = [r for r in records.values() if r["kind"] == "fit"]
    assert all(f["validation"] == min(o["validation"] for o in f["observations"]) for f in fits)
    assert any(f["iteration"] < config.iterations for f in fits)
    B, C = parameters_of(fit["parameters"])["bc"].unbind()
    kernel = kernels.bc(B, C)
    test = config.classes[0].open(Sampling(8, config.inner)).members("test", 2, 20, seed_of(config.seed, 0, 0))
    errors = test.errors(fl.reconstruct(test.volume, kernel, boundary="reflect", prefilter=False))
    assert errors["value"] == pytest.approx(fit["test"]["value"])
    assert records["0/fit/0/bc"]["parameters"] != fit["parameters"]


def test_the_same_seed_gives_the_same_bits(ran, tmp_path):
    _, records = ran
    config = Config(**TINY)
    for key in ("0/fit/1/bc", "0/fit/1/bspline2+fir3"):
        (tmp_path / key.replace("/", "-") / "files").mkdir(parents=True)
        again = compute(
            config, next(u for u in units(config) if u.key == key), Run(tmp_path / key.replace("/", "-"), {})
        )
        assert {k: records[key][k] for k in again} == again


def test_verdicts_follow_from_the_records(ran):
    _, records = ran
    for verdict in (r for r in records.values() if r["kind"] == "verdict"):
        named = {m["recipe"]: m for m in records[f"{verdict['class']}/named"]["methods"]}
        assert [c["taps"] for c in verdict["choices"]] == [27, 64]
        for choice in verdict["choices"]:
            tests = [records[f"{verdict['class']}/fit/{r}/{choice['candidate']}"]["test"] for r in (0, 1)]
            for against in choice["against"]:
                rival = named[against["recipe"]]
                assert against["equal_cost"] == (rival["taps"] == choice["taps"])
                assert against["value"] == compared(tests, rival["test"], "value")
    own = next(f for f in records["1/elsewhere"]["filters"] if f["learned_on"] == 1 and f["taps"] == 64)
    assert own["value"]["rival"] == "tricubic"
    against = next(a for a in records["1/verdict"]["choices"][1]["against"] if a["recipe"] == "tricubic")
    assert own["value"]["ratio"] == pytest.approx(against["value"]["ratio"])


def test_the_report_says_what_the_records_say(ran, undrawn):
    """Records with another outcome give another sentence: nothing is written beforehand."""
    folder, records = ran
    config = Config(**TINY)
    turned = {k: dict(r) for k, r in records.items()}
    for word, ratio in ((BETTER, 0.5), (WORSE, 2.0)):
        for i in (0, 1):
            choice = dict(records[f"{i}/verdict"]["choices"][0])
            outcome = {"ratio": ratio, "ratios": [ratio], "wins": 0, "comparisons": 4, "verdict": word}
            choice["against"] = [{**a, "value": outcome, "gradient": outcome} for a in choice["against"]]
            turned[f"{i}/verdict"]["choices"] = [choice]
        said = " ".join(draw(config, turned, folder).sections[0].lead)
        expected = "better in 2 (error −50 % … −50 %)" if word == BETTER else "better in 0, worse in 2 (error +100 %"
        assert expected in said


def test_an_unfinished_run_is_drawn_as_far_as_it_is(ran):
    folder, records = ran
    config = Config(**TINY)
    for count in (0, 1, 2, 5, 6):
        draw(config, dict(list(records.items())[:count]), folder)


def test_a_scan_from_a_file_is_a_class_too(undrawn, tmp_path):
    path = tmp_path / "scan.npy"
    generator = torch.Generator().manual_seed(4)
    fl.io.save_volume(fl.Volume(torch.randint(0, 255, (9, 12, 41), dtype=torch.uint8, generator=generator)), path)
    source = {"kind": "scan", "title": "scan", "volume": str(path)}
    config = Config(**{**TINY, "classes": [source], "candidates": [{"kernel": "notch", "prefilter": 3}]})
    check(config)
    with Run.open(tmp_path / "run", config, {}) as run:
        for unit in units(config):
            run.append(unit.key, compute(config, unit, run))
        assert run.records["0/fit/0/notch+fir3"]["parameters"]["taps"][0] < 0
        assert "Verdict" in [s.title for s in draw(config, run.records, run.folder).sections]


def test_a_scan_that_cannot_be_parted_is_refused(tmp_path):
    path = tmp_path / "small.npy"
    fl.io.save_volume(fl.Volume(torch.zeros(2, 9, 9)), path)
    config = Config(**{**TINY, "classes": [{"kind": "scan", "title": "small", "volume": str(path)}]})
    with pytest.raises(ConfigError, match="halved and parted"):
        check(config)


def test_truths_between_voxels_are_exact_to_a_few_thousandths():
    """What is said of the quintic B-spline at half the Nyquist frequency."""
    quintic = from_kernel(kernels.bspline(5))
    at = torch.tensor(math.pi / 2, dtype=torch.float64)
    assert fir.error_kernel(quintic.kernel, quintic.prefilter.response(at), at) < 0.005
