"""Recovering a volume and a transfer function from images: records, what is found, resuming, and the parts alone."""

import copy
import dataclasses
import json
import math
from itertools import pairwise

import numpy as np
import pytest
import scipy.ndimage
import torch
import yaml

from experiments import descent, recovery
from experiments.__main__ import main
from experiments.config import Recipe
from experiments.descent import Stage, minimize, slowing
from experiments.errors import RunError
from experiments.inverse_dvr import Config, compute, groups, units
from experiments.recovery import (
    Bench,
    TransferFit,
    TransferProblem,
    Views,
    VolumeFit,
    VolumeProblem,
    blurred,
    directions,
    roughness,
)
from experiments.runs import Run, read_records
from filterlab import signals
from filterlab.fields.base import Domain

# linear, so that any control points can say it, with an opacity that rises, so that no descent gets stuck
POINTS = [
    {"value": 0.0, "color": [0.1, 0.2, 0.9], "opacity": 0.1},
    {"value": 1.0, "color": [0.9, 0.6, 0.1], "opacity": 0.6},
]
THIN, DENSE = {"unit": 1.0, "points": POINTS}, {"unit": 0.12, "points": POINTS}
TINY = {
    "experiment": "inverse_dvr",
    "description": "a tiny one",
    "threads": 1,
    "signal": {"name": "marschner-lobb", "parameters": {"frequency": 1}},
    "resolution": 6,
    "methods": ["triquadratic"],
    "images_of": "samples",
    "views": {"training": 8, "held_out": 2, "size": 12, "shown": 12},
    "volume": {
        "transfer": THIN,
        "stages": [
            {"resolution": 3, "iterations": 10, "learning_rate": 0.1},
            {"resolution": 6, "iterations": 40, "learning_rate": 0.1},
        ],
        "rays": 250,
        "smoothness": 1e-6,
    },
    "transfer_function": {
        "target": DENSE,
        "points": 5,
        "positions": ["fixed", "free"],
        "iterations": 80,
        "learning_rate": 0.3,
        "rays": 150,
    },
    "record_every": 10,
    "checkpoint_every": 8,
}


def tiny(**changes):
    """TINY with some keys set anew; `volume__rays` is the key rays of volume."""
    config = copy.deepcopy(TINY)
    for path, value in changes.items():
        *parents, last = path.split("__")
        section = config
        for name in parents:
            section = section[name]
        section[last] = value
    return config


def write(path, config):
    path.write_text(yaml.safe_dump(json.loads(json.dumps(config))))  # sections that are one object would be aliases


def run(folder, config, code=0):
    """Runs a config in a folder; gives the run folder."""
    folder.mkdir(exist_ok=True)
    write(folder / "inverse.yaml", config)
    assert main(["run", str(folder / "inverse.yaml"), "--runs", str(folder / "runs")]) == code
    (found,) = (folder / "runs").iterdir()
    return found


def compute_one(folder, config, key="volume/triquadratic"):
    """The record of one unit, and the run folder, without a report."""
    config = Config.model_validate_json(json.dumps(config))
    with Run.open(folder, config, {}) as opened:
        return compute(config, next(unit for unit in units(config) if unit.key == key), opened)


@pytest.fixture(scope="module", autouse=True)
def _threads():
    """Configs here set one thread, which holds for the process."""
    before = torch.get_num_threads()
    yield
    torch.set_num_threads(before)


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = run(tmp_path_factory.mktemp("inverse"), TINY)
    return folder, read_records(folder)[0]


def bench(resolution=6, recipe="trilinear", signal=None, seed=0, dtype=torch.float64, images_of="samples", **views):
    views = Views(**{"training": 6, "held_out": 2, "size": 6, **views})
    signal = signal or signals.gaussian(0.5)
    recipe = Recipe.model_validate(recipe)
    return Bench.of(signal, resolution, views, recipe, "reflect", images_of, seed=seed, dtype=dtype, device="cpu")


def volume_fit(**changes):
    return VolumeFit.model_validate({**TINY["volume"], **changes})


# ---- the experiment

SHORT = [
    {"resolution": 3, "iterations": 6, "learning_rate": 0.1},
    {"resolution": 6, "iterations": 8, "learning_rate": 0.1},
]


def short(**changes):
    """A volume in 14 steps, with checkpoints after 4, 8, 12 and 14."""
    given = {"volume__stages": SHORT, "transfer_function": None, "checkpoint_every": 4, "record_every": 5}
    return tiny(**{**given, **changes})


def test_records_and_report_are_complete(tmp_path):
    config = short(methods=["trilinear", "triquadratic"], transfer_function={**TINY["transfer_function"]})
    config["transfer_function"].update(iterations=14, positions=["free"])
    folder = run(tmp_path, config)
    records = read_records(folder)[0]
    kinds = ["volume/{}", "transfer/free/{}"]
    assert list(records) == [kind.format(method) for kind in kinds for method in ("trilinear", "triquadratic")]
    common = {"key", "start", "kind", "method", "scheme", "misfits", "penalties", "observations", "images", "files"}
    for key, record in records.items():
        own = {"samples", "groups", "slices", "voxels"} if key[0] == "v" else {"exact", "curves", "histogram", "unit"}
        assert common | own <= set(record), key
        assert len(record["misfits"]) == len(record["penalties"]) == 14
        assert [o["iteration"] for o in record["observations"]] == [0, 5, 10, 14]
        means = [np.mean(record["misfits"][a:b]) for a, b in ((0, 5), (5, 10), (10, 14))]
        assert [o["misfit"] for o in record["observations"]] == [None, *(pytest.approx(m) for m in means)]
    page = (folder / "report.html").read_text()
    assert "4 of 4 units" in page
    assert "nan" not in (folder / "records.jsonl").read_text().lower()
    files = [f for record in records.values() for f in record["files"]]
    assert len(set(files)) == len(files) == 2 * (2 * 4 + 5 + 1) + 2 * 4
    assert page.count("data:image/png") == sum(f.endswith(".png") for f in files)
    for words in ("target", "start", "result, triquadratic", "A held-out view", "A training view", "Convergence"):
        assert words in page


def test_what_cannot_be_seen_at_all_has_a_report_too(tmp_path):
    """No image depends on a transparent volume: there is nothing to do, and nothing that a logarithm could show."""
    clear = {"points": [{**point, "opacity": 0.0} for point in POINTS]}
    folder = run(tmp_path, short(volume__transfer=clear))
    record = read_records(folder)[0]["volume/triquadratic"]
    assert not any(record["misfits"])
    assert not any(group["dependence"] for group in record["groups"])
    assert "1 of 1 units" in (folder / "report.html").read_text()


def test_the_volume_is_recovered(finished):
    folder, records = finished
    record = records["volume/triquadratic"]
    first, last = record["observations"][0], record["observations"][-1]
    assert last["misfit"] < 5e-3 * record["misfits"][0]
    assert [o["resolution"] for o in record["observations"]] == [3] * 2 + [6] * 4
    assert last["psnr"] > 38 > 25 > first["psnr"]  # of views that were never matched
    assert last["voxel_rms"] < 0.2 * first["voxel_rms"]
    assert last["field_rms"] < 0.2 * first["field_rms"]
    found = np.load(folder / record["voxels"])
    truth = signals.marschner_lobb(1.0).sample(6).samples.numpy()
    assert math.sqrt(np.mean((found - truth) ** 2)) == pytest.approx(last["voxel_rms"], rel=1e-4)
    assert record["samples"]["psnr"] is None  # the images show what the method makes of the samples: no difference
    assert record["images"]["held_out"]["psnr_result"] > record["images"]["held_out"]["psnr_start"] + 15


@pytest.mark.parametrize("positions", ["fixed", "free"])
def test_the_transfer_function_is_recovered(finished, positions):
    record = finished[1][f"transfer/{positions}/triquadratic"]
    first, last = record["observations"][0], record["observations"][-1]
    assert last["misfit"] < 5e-3 * record["misfits"][0]
    assert first["opacity_rms"] > 0.25 > 0.02 > last["opacity_rms"]
    assert first["color_rms"] > 0.15 > 0.02 > last["color_rms"]
    curve = record["curves"]["result"]
    expected = 0.1 + 0.5 * np.array(curve["positions"])
    np.testing.assert_allclose(curve["opacities"][:-1], expected[:-1], atol=0.06)  # few voxels have the largest value
    assert len(curve["positions"]) == 5
    even = np.linspace(*np.array(curve["positions"])[[0, -1]], 5)
    assert np.allclose(curve["positions"], even, atol=1e-5) == (positions == "fixed")
    assert sum(record["histogram"]["shares"]) == pytest.approx(1)
    assert record["exact"]["psnr"] is None


def test_another_seed_gives_other_batches_and_points(uninterrupted, tmp_path):
    other, whole = compute_one(tmp_path, short(seed=1)), uninterrupted[1]
    assert all(a != b for a, b in zip(other["misfits"], whole["misfits"], strict=True))
    assert other["samples"]["field_rms"] != whole["samples"]["field_rms"]


def interrupt(monkeypatch, at):
    """Ctrl-C in the midst of a step, the first time; returns the list of the steps that are made."""
    made, loss = [], VolumeProblem.loss

    def interrupted(self, parameters, stage, iteration):
        made.append(iteration)
        if iteration == at and made.count(at) == 1:
            raise KeyboardInterrupt
        return loss(self, parameters, stage, iteration)

    monkeypatch.setattr(VolumeProblem, "loss", interrupted)
    return made


@pytest.fixture(scope="module")
def uninterrupted(tmp_path_factory):
    folder = tmp_path_factory.mktemp("uninterrupted")
    return folder, compute_one(folder, short())


@pytest.mark.parametrize("at", [3, 5, 13])  # before any checkpoint, within the first stage, within the second
def test_an_interrupted_recovery_goes_on_with_the_same_bits(uninterrupted, tmp_path, monkeypatch, at):
    folder, whole = uninterrupted
    made = interrupt(monkeypatch, at)
    with pytest.raises(KeyboardInterrupt):
        compute_one(tmp_path, short())
    assert not list(tmp_path.rglob("*.npy"))
    record = compute_one(tmp_path, short())
    assert made == [*range(at + 1), *range(at // 4 * 4, 14)]  # from the last checkpoint on
    assert record == whole
    assert (tmp_path / record["voxels"]).read_bytes() == (folder / whole["voxels"]).read_bytes()
    assert not list(tmp_path.rglob(".tmp*"))


def test_the_command_goes_on_where_it_stopped(undrawn, uninterrupted, tmp_path, monkeypatch, capsys):
    made = interrupt(monkeypatch, 9)
    run(tmp_path, short(), code=130)
    assert "0 of 1 are done and kept" in capsys.readouterr().err
    record = read_records(run(tmp_path, short()))[0]["volume/triquadratic"]
    assert made == [*range(10), *range(8, 14)]
    assert record["misfits"] == uninterrupted[1]["misfits"]


def test_voxels_alone_would_not_go_on_with_the_same_bits(uninterrupted, monkeypatch, tmp_path):
    """What the tests above compare does depend on the moments of Adam."""
    interrupt(monkeypatch, 9)
    with pytest.raises(KeyboardInterrupt):
        compute_one(tmp_path, short())
    load = descent._load
    monkeypatch.setattr(descent, "_load", lambda *given: dataclasses.replace(load(*given), moments=None))
    assert compute_one(tmp_path, short())["misfits"] != uninterrupted[1]["misfits"]


def test_a_lit_volume_is_recovered_through_its_gradients(tmp_path):
    """From near by: from afar a descent in lit images ends in another volume that looks much the same."""
    config = tiny(
        transfer_function=None,
        views__lighting={"ambient": 0.7, "diffuse": 0.3},
        views__projection="orthographic",
        volume__start={"blur": 2},
        volume__smoothness=3e-3,
        volume__stages=[{"resolution": 6, "iterations": 40, "learning_rate": 0.01}],
    )
    record = compute_one(tmp_path, config)
    first, last = record["observations"][0], record["observations"][-1]
    assert last["misfit"] < 0.4 * record["misfits"][0]
    assert last["psnr"] > first["psnr"] + 1.5
    assert last["voxel_rms"] < 0.9 * first["voxel_rms"]


def test_the_signal_itself_is_what_images_are_of(tmp_path):
    """Then what a method makes of samples has an error, and so has the true transfer function with its field."""
    changes = {"images_of": "signal", "transfer_function": {**TINY["transfer_function"], "iterations": 1}}
    volume = compute_one(tmp_path / "a", short(**changes))
    transfer = compute_one(tmp_path / "b", short(**changes), "transfer/fixed/triquadratic")
    assert 20 < volume["samples"]["psnr"] < 50
    assert 20 < transfer["exact"]["psnr"] < 50


def test_the_fused_and_the_plain_renderer_find_the_same(tmp_path):
    found = {}
    for scheme in ("fused", "direct"):
        config = short(methods=[{"name": "triquadratic", "scheme": scheme}])
        record = compute_one(tmp_path / scheme, config, f"volume/triquadratic+{scheme}")
        assert record["scheme"] == scheme
        found[scheme] = record["misfits"]
    np.testing.assert_allclose(found["fused"], found["direct"], rtol=1e-3)


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"volume": None, "transfer_function": None}, ["volume or transfer_function", "neither"]),
        ({"volume__rays": 1153}, ["volume.rays", "1152 pixels", "1153"]),
        ({"volume__stages": [{"resolution": 4, "iterations": 1, "learning_rate": 1}]}, ["volume.stages", "6", "[4]"]),
        ({"volume__stages": []}, ["volume.stages", "at least 1"]),
        ({"volume__start": {"value": 0.5, "blur": 1}}, ["volume.start", "value or blur", "both"]),
        ({"volume__start": {}}, ["volume.start", "value or blur", "neither"]),
        ({"volume__transfer": {**THIN, "axis": "normalized"}}, ["volume.transfer.axis", "raw"]),
        ({"volume__transfer": {"points": POINTS[:1]}}, ["volume.transfer", "at least two"]),
        ({"transfer_function__positions": ["fixed", "fixed"]}, ["positions", "each once"]),
        ({"transfer_function__opacity": 1.0}, ["transfer_function.opacity", "less than 1"]),
        ({"transfer_function__points": 1}, ["transfer_function.points", "2"]),
        ({"views__step": 0.001}, ["views.step", "0.01"]),
        ({"views__size": 2048, "views__training": 4096, "views__step": 0.02}, ["views.size", "samples"]),
        ({"methods": ["trilinaer"]}, ["methods[0]", "trilinaer", "trilinear"]),
        ({"images_of": "volume"}, ["images_of", "signal", "samples"]),
        ({"learning_rate": 1}, ["learning_rate", "unknown key"]),
    ],
)
def test_a_mistake_in_the_config_ends_in_one_line(changes, words, tmp_path, capsys):
    write(tmp_path / "inverse.yaml", tiny(**changes))
    assert main(["run", str(tmp_path / "inverse.yaml"), "--runs", str(tmp_path / "runs")]) == 2
    message = capsys.readouterr().err
    assert len(message.splitlines()) == 1
    for word in words:
        assert word in message
    assert not (tmp_path / "runs").exists()


def test_a_scheme_that_cannot_run_is_refused_before_work(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("filterlab.methods._missing_for_fused", lambda *_: "no compiler")
    config = tiny(methods=["trilinear", {"name": "notch", "scheme": "fused"}])
    write(tmp_path / "inverse.yaml", config)
    assert main(["run", str(tmp_path / "inverse.yaml"), "--runs", str(tmp_path / "runs")]) == 2
    assert "methods[1]: scheme='fused' can't run here: no compiler" in capsys.readouterr().err
    assert not (tmp_path / "runs").exists()


# ---- the views


def test_directions_are_spread_evenly():
    for count in (1, 2, 7, 28, 200):
        found = np.array(directions(count))
        np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1, atol=1e-12)
    assert np.abs(found.mean(0)).max() < 0.01
    nearest = np.sort(found @ found.T, axis=1)[:, -2]
    # a cap for each of n points covers 4π/n: their centres are about √(4π/n) apart
    assert np.arccos(nearest).min() > 0.75 * math.sqrt(4 * math.pi / 200)


def test_held_out_views_lie_among_the_others_and_see_the_whole_box():
    domain = Domain((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))
    training, held_out = Views(training=10, held_out=3, size=40).cameras(domain)
    assert (len(training), len(held_out)) == (10, 3)
    positions = [tuple(np.round(camera.position, 9)) for camera in training + held_out]
    assert len(set(positions)) == 13
    heights = np.array([camera.position[2] for camera in held_out])
    assert heights.max() > 1 > -1 > heights.min()
    for camera in training + held_out:
        origins, ways = camera.rays(40, 40)
        t = -(origins * ways).sum(-1, keepdim=True)
        nearest = (origins + t * ways).norm(dim=-1)
        assert float(nearest.min()) < 0.2
        assert float(nearest.max()) > 1.0


def test_lights_and_projection_reach_the_images():
    plain, lit = bench(), bench(lighting={"ambient": 0.0, "diffuse": 0.5})
    transfer = VolumeProblem(plain, volume_fit(stages=SHORT[1:], rays=20)).transfer
    dark, bright = (b.image(b.field(b.samples.samples), transfer, b.training) for b in (lit, plain))
    assert float(dark.max()) <= 0.5 * float(bright.max())
    assert float(dark.max()) > 0.01
    parallel = bench(projection="orthographic").training[1].reshape(6, -1, 3)
    assert (parallel == parallel[:, :1]).all()
    assert not (plain.training[1].reshape(6, -1, 3) == plain.training[1].reshape(6, -1, 3)[:, :1]).all()


def test_batches_go_through_all_rays():
    b = bench()
    rays = len(b.training[0])
    assert rays == 6 * 36
    together = torch.cat([b.batch(i, 50) for i in range(rays)])
    assert (torch.bincount(together) == 50).all()
    assert len(b.batch(3, rays).unique()) == rays
    assert not torch.equal(b.batch(0, rays), bench(seed=1).batch(0, rays))


def test_all_fields_are_rendered_with_one_step_in_the_world(monkeypatch):
    """Else images would differ by the step as well: coarse volumes take a smaller part of their own voxels."""
    steps, render = [], recovery.render

    def noted(field, *given, **options):
        steps.append(options["step"] * field.domain.voxel_size)
        return render(field, *given, **options)

    monkeypatch.setattr(recovery, "render", noted)
    b = bench(8, step=0.5, images_of="signal")
    transfer = VolumeProblem(b, volume_fit(stages=SHORT[1:], rays=20)).transfer
    for n in (4, 8):
        b.image(b.field(b.signal.sample(n).samples), transfer, b.held_out)
    assert steps == pytest.approx([0.5 * 2 / 8] * 4)


# ---- the volume


def test_refining_keeps_the_field():
    b = bench(8)
    stages = [{"resolution": n, "iterations": 1, "learning_rate": 1} for n in (4, 8)]
    problem = VolumeProblem(b, volume_fit(stages=stages))
    x = torch.arange(4.0, dtype=torch.float64)
    plane = (0.1 * x[:, None, None] + 0.05 * x[:, None] + 0.02 * x).expand(4, 4, 4)
    fine = problem.refine({"voxels": plane}, 1)["voxels"]
    assert fine.shape == (8, 8, 8)
    axis = (torch.arange(8.0, dtype=torch.float64) - 0.5) / 2  # the fine centres in coarse voxels
    expected = 0.1 * axis[:, None, None] + 0.05 * axis[:, None] + 0.02 * axis
    torch.testing.assert_close(fine[1:-1, 1:-1, 1:-1], expected[1:-1, 1:-1, 1:-1])


def test_voxels_stay_where_the_transfer_function_tells_them_apart(tmp_path):
    b = bench()
    narrow = {"points": [{**p, "value": v} for p, v in zip(POINTS, (0.3, 0.6), strict=True)]}
    stages = [{"resolution": 6, "iterations": 30, "learning_rate": 0.3}]
    problem = VolumeProblem(b, volume_fit(transfer=narrow, stages=stages, rays=200, start={"value": 2.0}))
    assert problem.start()["voxels"].unique().tolist() == [0.6]
    state = minimize(problem, problem.fit.stages, tmp_path / "s", observe_every=30, checkpoint_every=30)
    low, high = state.parameters["voxels"].detach().aminmax()
    assert (float(low), float(high)) == (0.3, 0.6)


def test_blurring_is_that_of_scipy():
    voxels = torch.as_tensor(np.random.default_rng(0).uniform(size=(9, 10, 11)))
    expected = scipy.ndimage.gaussian_filter(voxels.numpy(), 2.0, mode="nearest", truncate=3.0)
    np.testing.assert_allclose(blurred(voxels, 2.0).numpy(), expected, atol=1e-12)


def test_roughness_is_its_formula():
    x = np.random.default_rng(0).uniform(size=(3, 4, 5))
    expected = sum(np.mean(np.diff(x, axis=d) ** 2) for d in range(3))
    assert float(roughness(torch.as_tensor(x))) == pytest.approx(expected, rel=1e-12)


def test_the_smoothness_weighs_the_penalty():
    b = bench()
    voxels = {"voxels": b.samples.samples}
    stage = [{"resolution": 6, "iterations": 1, "learning_rate": 1}]
    for weight in (0.0, 0.25):
        misfit, penalty = VolumeProblem(b, volume_fit(stages=stage, smoothness=weight, rays=20)).loss(voxels, 0, 0)
        assert float(misfit) == pytest.approx(0, abs=1e-20)
        assert float(penalty) == pytest.approx(weight * float(roughness(voxels["voxels"])), rel=1e-12)


def test_the_dependence_is_the_norm_of_the_derivative():
    """The estimate against the whole Jacobian; with 24 views its error is some 20 % for each voxel."""
    b = bench(3, training=24, size=4)
    problem = VolumeProblem(b, volume_fit(stages=[{"resolution": 3, "iterations": 1, "learning_rate": 1}], rays=20))
    voxels = b.samples.samples

    def images(x):
        return b.image(b.field(voxels + 1e-5 * x.reshape(3, 3, 3)), problem.transfer, b.training)

    columns = [(images(e) - images(-e)) / 2e-5 for e in torch.eye(27, dtype=torch.float64)]
    exact = torch.stack([column.norm() for column in columns]).reshape(3, 3, 3)
    shares = []
    found = problem.dependence(0, shares.append)
    np.testing.assert_allclose(found.numpy(), exact.numpy(), rtol=0.6)
    assert float(found.square().mean().sqrt()) == pytest.approx(float(exact.square().mean().sqrt()), rel=0.15)
    assert shares[-1] == 1
    assert torch.equal(found, problem.dependence(0, shares.append))


def test_images_do_not_depend_on_what_is_transparent():
    clear = {"points": [{**p, "opacity": o} for p, o in zip(POINTS, (0.0, 0.7), strict=True)]}
    clear["points"].insert(1, {"value": 0.4, "color": [0, 0, 0], "opacity": 0.0})
    b = bench(8, signal=signals.gaussian(0.3))
    stage = [{"resolution": 8, "iterations": 1, "learning_rate": 1}]
    found = VolumeProblem(b, volume_fit(transfer=clear, stages=stage, rays=20)).dependence(0, lambda _: None)
    assert float(found[0, 0, 0]) == 0.0
    assert float(found[4, 4, 4]) > 0.01
    assert (found[b.samples.samples > 0.4] > 0).all()
    assert float((found == 0).double().mean()) > 0.7


def test_groups_are_ordered_by_dependence():
    dependence = torch.tensor([3.0, 1.0, 2.0, 4.0]).reshape(1, 2, 2)
    error = torch.tensor([0.3, -0.1, 0.2, 0.4]).reshape(1, 2, 2)
    low, high = groups(dependence, error, 2)
    assert low == pytest.approx({"dependence": math.sqrt(2.5), "rms": math.sqrt(0.025)})
    assert high == pytest.approx({"dependence": math.sqrt(12.5), "rms": math.sqrt(0.125)})


# ---- the transfer function


def transfer_problem(positions, **changes):
    fit = {**TINY["transfer_function"], **changes}
    return TransferProblem(bench(), TransferFit.model_validate(fit), positions)


@pytest.mark.parametrize("positions", ["fixed", "free"])
def test_control_points_begin_evenly_spaced_with_what_was_asked(positions):
    problem = transfer_problem(positions, opacity=0.2, color=[0.1, 0.5, 0.9])
    transfer = problem.transfer(problem.start())
    samples = problem.bench.samples.samples
    expected = torch.linspace(float(samples.min()), float(samples.max()), 5, dtype=torch.float64)
    torch.testing.assert_close(transfer.positions, expected)
    torch.testing.assert_close(transfer.opacities, torch.full((5,), 0.2, dtype=torch.float64))
    torch.testing.assert_close(transfer.colors, torch.tensor([[0.1, 0.5, 0.9]], dtype=torch.float64).expand(5, 3))
    assert transfer.unit == 0.12


def test_free_positions_keep_their_order_and_their_ends():
    problem = transfer_problem("free")
    parameters = problem.start()
    parameters["gaps"] = torch.tensor([-80.0, 90.0, -80.0, 0.0], dtype=torch.float64, requires_grad=True)
    x = problem.transfer(parameters).positions
    span = problem.high - problem.low
    assert x[[0, -1]].tolist() == pytest.approx([problem.low, problem.high], rel=1e-12)
    assert x.detach().diff().tolist() == pytest.approx([span * g / 1.1 for g in (0.025, 1.025, 0.025, 0.025)])
    assert torch.autograd.grad(x[1], parameters["gaps"])[0].isfinite().all()


def test_errors_are_over_the_values_that_occur():
    problem = transfer_problem("fixed")
    target = problem.target
    assert problem.errors(target) == {"opacity_rms": 0.0, "color_rms": 0.0}
    off = type(target)([0.0, 1.0], target.colors + 0.1, [0.15, 0.65], 0.12)
    found = problem.errors(off)
    assert found["opacity_rms"] == pytest.approx(0.05, rel=1e-6)
    assert found["color_rms"] == pytest.approx(0.1, rel=1e-6)
    beyond = type(target)([0.0, 1.0, 1.5], [*target.colors.tolist(), [0, 0, 0]], [0.1, 0.6, 0.0], 0.12)
    assert problem.errors(beyond)["opacity_rms"] == pytest.approx(0, abs=1e-12)


# ---- the descent


class Bowl:
    """min |p − stage|²; `broken_at` an iteration, the loss is not a number."""

    def __init__(self, broken_at=None):
        self.broken_at = broken_at

    def start(self):
        return {"p": torch.tensor([3.0, -2.0], dtype=torch.float64)}

    def refine(self, parameters, stage):
        return {"p": parameters["p"].detach() + 1}

    def loss(self, parameters, stage, iteration):
        misfit = (parameters["p"] - stage).square().sum()
        return (misfit * math.nan if iteration == self.broken_at else misfit), 0 * misfit

    def project(self, parameters):
        pass

    def observe(self, parameters, stage):
        return {"stage": stage, "p": parameters["p"].tolist()}


STAGES = [Stage(iterations=150, learning_rate=0.2), Stage(iterations=150, learning_rate=0.2)]


def test_a_descent_goes_through_its_stages(tmp_path):
    seen = []
    state = minimize(Bowl(), STAGES, tmp_path / "s", observe_every=60, checkpoint_every=40, progress=seen.append)
    assert [(o["iteration"], o["stage"]) for o in state.observations] == [
        (0, 0), (60, 0), (120, 0), (180, 1), (240, 1), (300, 1)
    ]  # fmt: skip
    np.testing.assert_allclose(state.parameters["p"].detach(), [1, 1], atol=1e-3)
    assert seen == pytest.approx([(i + 1) / 300 for i in range(300)])
    again = minimize(Bowl(broken_at=0), STAGES, tmp_path / "s", observe_every=60, checkpoint_every=40)
    assert again.observations == state.observations  # read, not computed


def test_a_loss_that_is_no_number_ends_the_descent_and_keeps_the_checkpoint(tmp_path):
    with pytest.raises(ValueError, match=r"expected a finite loss; got nan at iteration 97: use a smaller learning"):
        minimize(Bowl(broken_at=97), STAGES, tmp_path / "s", observe_every=60, checkpoint_every=40)
    state = minimize(Bowl(), STAGES, tmp_path / "s", observe_every=60, checkpoint_every=40)
    whole = minimize(Bowl(), STAGES, tmp_path / "t", observe_every=60, checkpoint_every=40)
    assert state.observations == whole.observations


@pytest.mark.parametrize("content", [b"", b"not a state", None])
def test_a_file_that_is_no_state_is_named(content, tmp_path):
    path = tmp_path / "s"
    if content is None:
        torch.save({"unknown": 1}, path)
    else:
        path.write_bytes(content)
    with pytest.raises(RunError, match=r"s is no state of a descent .*; remove it, or use --fresh"):
        minimize(Bowl(), STAGES, path, observe_every=60, checkpoint_every=40)


def test_steps_become_smaller():
    shares = [slowing(i, 200) for i in range(201)]
    assert (shares[0], shares[100], shares[200]) == pytest.approx((1.0, 0.525, 0.05))
    assert all(b < a for a, b in pairwise(shares))
