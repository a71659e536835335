"""A method of another kind than a tensor product: everything that reads `METHODS` takes it, or says what it lacks."""

from __future__ import annotations

import json

import pytest
import torch
import yaml
from torch import Tensor

import filterlab as fl
from experiments.__main__ import main as run_experiments
from experiments.report import style
from filterlab.cli import main
from filterlab.fields.base import ClosedForm, Domain, Field, check_order, check_points
from filterlab.methods import METHODS, Asked, Facts, Method, tensor_product
from filterlab.prediction import predicted_error, spectrum_of
from filterlab.volume import Volume

NAME = "turned"


class Turned(Field):
    """The values of another field, and nothing to be seen of how they come about: no coefficients, no terms."""

    scheme = ClosedForm("pointwise")
    max_order = 1

    def __init__(self, inner: Field, domain: Domain) -> None:
        self.inner, self.domain, self.channels = inner, domain, inner.channels

    def jet(self, points: Tensor, order: int) -> tuple[Tensor, ...]:
        check_order(order, self.max_order)
        return self.inner.jet(check_points(points, self.channels), order)


class TurnedMethod(Method):
    """Facts and how to build, and nothing else."""

    gradients = ("analytic",)
    schemes = ("pointwise",)
    facts = Facts(2, 8, 2, 2, 0, True, True, False, gradients, schemes)

    def scheme(self, name, gradient, sampler):
        self._check_offered(name, gradient)
        return ClosedForm("pointwise")

    def reach(self, prefilter: bool) -> int:
        return 2

    def build(self, volume: Volume, asked: Asked) -> Field:
        if asked.storage is not None:
            raise ValueError(f"{self.name} keeps no coefficients; leave storage out")
        samples = Volume.with_geometry(asked.samples, volume.geometry)
        inner = fl.reconstruct(samples, "trilinear", boundary=asked.boundary, scheme="direct")
        return Turned(inner, inner.domain)


@pytest.fixture(autouse=True)
def _registered(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(METHODS, NAME, TurnedMethod(NAME, "a kind of its own"))
    looks = next(value for value in vars(style).values() if isinstance(value, dict) and "trilinear" in value)
    monkeypatch.setitem(looks, NAME, looks["trilinear"])


def samples(*shape: int) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(4), dtype=torch.float64)


def test_it_is_no_tensor_product() -> None:
    assert tensor_product(NAME) is None
    assert [name for name in METHODS if tensor_product(name) is None] == ["qss", "cubic-c1", "quadratic-c1", NAME]


def test_fields_and_their_options() -> None:
    field = fl.reconstruct(samples(5, 6, 7), NAME)
    assert field.scheme.name == "pointwise"
    assert fl.signals.marschner_lobb().scheme.name == "closed form"
    with pytest.raises(ValueError, match="offers the schemes pointwise; got 'fused'"):
        fl.reconstruct(samples(5, 6, 7), NAME, scheme="fused")
    with pytest.raises(ValueError, match="offers the gradients analytic; got 'central'"):
        fl.reconstruct(samples(5, 6, 7), NAME, gradient="central")


def test_resampling_is_pointwise() -> None:
    volume = Volume(samples(5, 6, 7), spacing=(1.0, 1.5, 2.0))
    found, expected = (fl.resample(volume, name, shape=(7, 5, 9), antialias=False) for name in (NAME, "trilinear"))
    torch.testing.assert_close(found.samples, expected.samples, rtol=0, atol=1e-12)
    batch = Volume(samples(2, 3, 5, 6, 7))
    assert fl.resample(batch, NAME, shape=(4, 4, 4), antialias=False).shape == (2, 3, 4, 4, 4)


def test_what_has_no_closed_form_is_measured_only() -> None:
    omega = torch.linspace(0, 6, 7, dtype=torch.float64)
    for closed in (fl.spectrum.axis_response, lambda m, w: fl.spectrum.response(m, w[:, None].expand(-1, 3))):
        with pytest.raises(TypeError, match=f"{NAME} has no closed form: it is measured only"):
            closed(NAME, omega)
    for measure in (fl.spectrum.smoothing, fl.spectrum.postaliasing):
        with pytest.raises(TypeError, match="measured only"):
            measure(NAME)
    with pytest.raises(TypeError, match=f"errors of {NAME} have no closed form: they are measured only"):
        predicted_error(spectrum_of(samples(8, 8, 8)), NAME)
    measured = fl.spectrum.measured_response(NAME, omega)
    torch.testing.assert_close(measured, fl.spectrum.axis_response("trilinear", omega), rtol=0, atol=1e-10)


def test_it_can_be_recommended() -> None:
    volume = fl.signals.gaussian().sample(16).samples
    answer = fl.recommend(volume, 0.05, methods=[NAME, "triquadratic"], seconds=0.01)
    found = {(c.method, c.scheme) for c in answer.candidates}
    assert (NAME, "pointwise") in found
    assert not [c for c in answer.candidates if c.method == NAME and c.storage is not None]
    only = fl.recommend(volume, 0.5, methods=[NAME], seconds=0.01)
    assert only.pick is not None
    assert isinstance(only.field(volume), Turned)


def test_commands(tmp_path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(fl.recommend.__kwdefaults__, "seconds", 0.02)
    monkeypatch.setattr("filterlab.recommendation.choice.METHODS", {NAME: METHODS[NAME], "qss": METHODS["qss"]})
    assert main(["methods"]) == 0
    assert NAME in capsys.readouterr().out
    path = tmp_path / "volume.nrrd"
    fl.save_volume(Volume(samples(5, 6, 7).float()), path)
    out = tmp_path / "fine.nrrd"
    assert main(["resample", str(path), "-o", str(out), "--method", NAME, "--shape", "6", "6", "6"]) == 0
    assert fl.load_volume(out).shape == (6, 6, 6)
    assert main(["recommend", str(path), "--max-error", "90%"]) in (0, 3)


EXPERIMENTS = {
    "frequency_response": {
        "methods": [NAME, "trilinear"],
        "figures": [{"title": "both", "methods": [NAME, "trilinear"], "caption": "two"}],
        "samples": 9,
        "markers": 5,
        "dimensions": [1],
    },
    "rms_error": {
        "studies": [{"signal": "gaussian", "resolutions": [4, 6], "fit_from": 4}],
        "methods": [NAME, "trilinear"],
        "points": 20,
    },
}


@pytest.mark.parametrize("name", EXPERIMENTS)
def test_experiments_run_and_draw(name: str, tmp_path) -> None:
    path = tmp_path / f"{name}.yaml"
    path.write_text(yaml.safe_dump({"experiment": name, "description": "another kind", **EXPERIMENTS[name]}))
    assert run_experiments(["run", str(path), "--runs", str(tmp_path / "runs")]) == 0
    (folder,) = (tmp_path / "runs").iterdir()
    records = [json.loads(line) for line in (folder / "records.jsonl").read_text().splitlines()]
    assert any(NAME in json.dumps(record) for record in records)
    assert (folder / "report.html").stat().st_size > 1000
