"""`tetrahedral_table`: what is counted and extrapolated, what is quoted beside it, what is refused."""

import json

import numpy as np
import pytest
import torch
import yaml

import filterlab as fl
from experiments.__main__ import main
from experiments.registry import EXPERIMENTS
from experiments.report.tetrahedral_table import PRINTED_2008, PRINTED_2011
from experiments.runs import read_records

ZOOM = {"title": "the middle", "window": [0.25, 0.25, 0.75, 0.75]}
SIGNAL = {"title": "a signal", "signal": "torus", "resolution": 12, "level": 0, "zoom": ZOOM}
CONFIG = {
    "experiment": "tetrahedral_table",
    "description": "tiny",
    "methods": [{"name": name, "prefilter": False} for name in ("qss", "cubic-c1", "quadratic-c1")],
    "sizes": [[40, 20]],
    "scale": 0.5,
    "points": 10,
    "seconds": 0,
}


@pytest.fixture
def ran(tmp_path):
    def run(*sources):
        path = tmp_path / "table.yaml"
        path.write_text(yaml.safe_dump(json.loads(json.dumps({**CONFIG, "sources": sources}))))
        assert main(["run", str(path), "--runs", str(tmp_path / "runs")]) == 0
        (folder,) = (tmp_path / "runs").iterdir()
        return read_records(folder)[0], (folder / "report.html").read_text()

    return run


def test_counts_are_those_of_the_level_set_and_numbers_are_four_bytes(ran):
    records, page = ran(SIGNAL)
    volume = fl.signals.torus().sample(12, dtype=torch.float32)
    for name, numbers in (("qss", 20), ("cubic-c1", 56), ("quadratic-c1", 4)):
        record = records[f"0/{name}+unprefiltered"]
        field = fl.reconstruct(volume, name, prefilter=False, boundary="border")
        assert (record["cells"], record["tetrahedra"]) == tuple(field.relevant(0.0))
        samples, held = record["forms"]
        assert samples["bytes"] == field.coefficients.values.nbytes
        assert held["relevant_bytes"] == 4 * numbers * record["cells"]
        assert held["relevant_bytes"] <= held["held_bytes"] <= held["bytes"]
    assert "cubic-c1, no prefilter" in page


def test_frames_are_extrapolated_by_their_rays(ran):
    records, page = ran(SIGNAL)
    frames = records["0/qss+unprefiltered"]["frames"]
    assert [frame["view"] for frame in frames] == ["whole", "close-up"]
    for frame in frames:
        assert (frame["size"], frame["measured"]) == ([40, 20], [20, 10])
        assert frame["frames_per_second"] == pytest.approx(1 / (4 * frame["seconds"]))
    assert 0 < frames[0]["hit"] < frames[1]["hit"]
    assert "extrapolated by the number of rays" in page


def test_the_row_of_the_same_volume_is_quoted(ran, tmp_path):
    z, y, x = np.indices((9, 9, 9)) - 4
    path = tmp_path / "neghip.nrrd"
    fl.io.save_volume(fl.Volume(torch.from_numpy((255 * np.exp(-(x * x + y * y + z * z) / 9)).astype(np.uint8))), path)
    scan = {"title": "a scan", "volume": str(path), "level": 102, "published": "neghip", "zoom": ZOOM}
    _, page = ran(scan, SIGNAL)
    assert page.count("1.17E5") == 3  # of qss, of cubic-c1; and in the table as it was printed
    assert page.count("108.93") == 1


def test_printed_figures_agree_with_one_another():
    """20 and 56 numbers of 4 bytes a cube, in MB of 2²⁰ bytes: of cubes that are printed to two digits."""
    for row in PRINTED_2008.values():
        for name, numbers in (("D2", 20), ("D3", 56)):
            assert float(row[name]) == pytest.approx(4 * numbers * float(row["cubes"]) / 2**20, rel=0.06)
        assert float(row["tetrahedra"]) / float(row["cubes"]) == pytest.approx(11.7, abs=0.6)
    for line in PRINTED_2011:
        _, cubic, *_, octahedral, _, _ = line.replace("\u202f", "").replace(" ", "").split("|")
        assert 1.3 < int(octahedral) / int(cubic) < 1.6


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"methods": ["tricubic"]}, "unknown spline 'tricubic'"),
        ({"sources": [{**SIGNAL, "resolution": None}]}, "either a signal and its resolution, or a volume"),
        ({"clock": "cpu", "threads": 2}, "expected threads: 1"),
        ({"scale": 0}, "greater than 0"),
    ],
)
def test_what_cannot_be_measured_is_refused(changes, message):
    with pytest.raises(ValueError, match=message):
        EXPERIMENTS["tetrahedral_table"].config.model_validate({**CONFIG, "sources": [SIGNAL], **changes})
