"""Reports: one self-contained file, drawn from records alone."""

import re
import shutil
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
import torch

import filterlab as fl
from experiments import registry
from experiments.__main__ import main
from experiments.errors import RunError
from experiments.report import plots, style
from experiments.report.page import Column, Gallery, Picture, Plot, Section, Table, render
from experiments.report.write import write_report
from tests.experiments.conftest import TINY_RMS
from tests.experiments.test_runs import config


@pytest.fixture(scope="module")
def ran(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    (folder / "tiny.yaml").write_text(TINY_RMS)
    assert main(["run", str(folder / "tiny.yaml"), "--runs", str(folder / "runs")]) == 0
    (run,) = (folder / "runs").iterdir()
    return run


@pytest.fixture
def finished(ran, tmp_path):
    """The folder of a run, to do with as one likes."""
    return Path(shutil.copytree(ran, tmp_path / ran.name))


def rendered(section, **changes):
    defaults = {"title": "t", "config": config(), "section": section, "done": 1, "total": 1, "seconds": 1.0}
    return render(**{**defaults, "config_text": "a: <b>", "starts": [], **changes})


def test_a_report_needs_records_only(finished, monkeypatch):
    page = (finished / "report.html").read_text()
    (finished / "report.html").unlink()

    def fail(*_, **__):
        raise AssertionError("a report must not compute")

    for name in ("filterlab.reconstruct", "filterlab.methods.reconstruct", "experiments.rms_error.evaluate"):
        monkeypatch.setattr(name, fail)
    monkeypatch.setattr(torch.Tensor, "__add__", fail)
    assert main(["report", str(finished)]) == 0
    assert (finished / "report.html").read_text() == page


def test_a_report_refers_to_nothing_outside(finished):
    page = (finished / "report.html").read_text()
    assert "<svg" in page
    assert not re.findall(r"(?:src|href|url|@import)\s*[=(]?\s*[\"']?(?:https?:)?//", page)
    assert "<script" not in page
    assert '<link rel="stylesheet"' not in page


def test_numbers_methods_and_provenance_are_shown(finished):
    page = (finished / "report.html").read_text()
    for word in (
        "trilinear",
        "notch, no prefilter",
        "declared order",
        "boundary: reflect",
        "Provenance",
        "9 of 9 units",
    ):
        assert word in page
    assert "not finished" not in page


def test_an_unfinished_run_says_so(undrawn, finished):
    records = finished / "records.jsonl"
    records.write_bytes(b"".join(records.read_bytes().splitlines(keepends=True)[:4]))
    page = write_report(finished).read_text()
    assert "4 of 9 units" in page
    assert "not finished" in page


def test_a_run_without_records_has_a_report(undrawn, finished):
    (finished / "records.jsonl").unlink()
    assert "0 of 9 units" in write_report(finished).read_text()


def test_what_is_no_run_folder_is_refused(tmp_path, capsys):
    with pytest.raises(RunError, match="expected a run folder"):
        write_report(tmp_path)
    assert main(["report", str(tmp_path / "none")]) == 1
    assert "expected a run folder" in capsys.readouterr().err


def test_text_is_escaped():
    table = Table([Column("a<b"), Column("n", "s&t")], [["<i>", "1"]], "c & d")
    page = rendered(Section("x < y", ["<script>alert(1)</script>"], [table]))
    for word in ("x &lt; y", "a&lt;b", "s&amp;t", "&lt;i&gt;", "c &amp; d", "a: &lt;b&gt;"):
        assert word in page
    assert "<script>" not in page


def test_blocks_are_all_drawn():
    gallery = Gallery([Picture("data:image/png;base64,AAAA", "one", "2 s", [(0.1, 0.2, 0.5, 0.6)])], "side by side", 2)
    page = rendered(Section("all", (), [gallery], [Section("part", ["words"], [], [Section("inner", ["deep"])])]))
    assert 'src="data:image/png;base64,AAAA"' in page
    assert "left: 10.0%; top: 20.0%; width: 40.0%; height: 40" in page
    for word in ("side by side", "2 s", "part", "words", "inner", "deep"):
        assert word in page


def test_figures_follow_the_page_and_do_not_share_ids():
    def drawn(name):
        with plots.settings():
            figure = plots.canvas(3, 2)
            axes = figure.subplots()
            axes.plot([1, 10], [1, 2], color=style.LOOKS["notch"].light, label="notch")
            plots.logarithmic(axes)
            plots.legend_right(axes)
            return plots.svg(figure, name)

    first, second = drawn("one"), drawn("two")
    assert "currentColor" in first
    assert "var(--c-notch)" in first
    assert plots.INK not in first
    ids = [set(re.findall(r'\bid="([^"]+)"', svg)) for svg in (first, second)]
    assert ids[0]
    assert not ids[0] & ids[1]
    for svg, own in zip((first, second), ids, strict=True):
        assert set(re.findall(r'(?:href="#|url\(#)([^")]+)', svg)) <= own
    assert drawn("one") == first
    assert "<svg" in rendered(Section("x", (), [Plot(first, "caption")]))


@pytest.mark.parametrize(
    ("value", "shown"),
    [
        (None, "–"), (0.0, "0"), (0.0448, "0.0448"), (12.345, "12.3"), (4.8e-5, "4.80×10⁻⁵"), (-0.5, "−0.500"),
        (123456.0, "1.23×10⁵"), (999.6, "1000"), (0.99996, "1.00"), (1234.0, "1234"),
    ],
)  # fmt: skip
def test_numbers_have_three_digits(value, shown):
    assert style.text(value) == shown


def test_numbers_have_fixed_decimals():
    assert [style.fixed(x) for x in (None, float("inf"), -0.001, 2.345, -1.0)] == ["–", "–", "0.00", "2.35", "−1.00"]


def test_every_method_has_its_own_look():
    missing = [name for name in fl.METHODS if name not in style.LOOKS]
    assert not missing, f"give {', '.join(missing)} a colour and a marker in LOOKS of experiments/report/style.py"
    looks = [style.LOOKS[name] for name in fl.METHODS]
    for attribute in ("light", "dark", "marker"):
        assert len({getattr(own, attribute) for own in looks}) == len(looks)
    assert style.look("a method of the future") in style.OTHERS


@pytest.mark.parametrize("background", ["#ffffff", "#15171a"])
def test_colours_stand_out_from_the_page(background):
    """WCAG asks for a contrast of 3 for graphics; light colours on white, dark ones on black."""

    def luminance(color):
        c = np.array([int(color[i : i + 2], 16) for i in (1, 3, 5)]) / 255
        return np.where(c <= 0.04045, c / 12.92, ((c + 0.055) / 1.055) ** 2.4) @ (0.2126, 0.7152, 0.0722)

    for own in style.LOOKS.values():
        color = own.light if background == "#ffffff" else own.dark
        high, low = sorted((luminance(color), luminance(background)), reverse=True)
        assert (high + 0.05) / (low + 0.05) > 2.5


def test_the_registry_draws_every_experiment(monkeypatch, tmp_path):
    for name, experiment in registry.EXPERIMENTS.items():
        assert callable(import_module(f"experiments.report.{name}").draw)
        monkeypatch.setattr(f"experiments.report.{name}.draw", lambda *given, name=name: (name, *given))
        assert experiment.draw(None, {}, tmp_path) == (name, None, {}, tmp_path)
