"""The reference of scenes: complete, true of the models, and the page that is printed."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
import torch
from pydantic import create_model

from filterlab.cli import main
from filterlab.io import save_image
from filterlab.io.config import loads_config
from filterlab.scenes import reference
from filterlab.scenes.model import Scene, Section

PAGE = Path(__file__).resolve().parent.parent / "docs" / "scenes.md"
SECTIONS = reference.sections()


def test_the_page_is_what_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scene", "--reference"]) == 0
    assert capsys.readouterr().out == PAGE.read_text(encoding="utf-8"), "filterlab scene --reference > docs/scenes.md"


@pytest.mark.parametrize(("heading", "model"), SECTIONS, ids=[heading for heading, _ in SECTIONS])
def test_every_key_is_described_and_has_an_example(
    heading: str, model: type[Section], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Examples are valid sections; together they set every key."""
    for name in ("engine.nrrd", "head.nii.gz", "series.nii.gz", "dem.tif", "photo.jpg", "caffeine.xyz"):
        (tmp_path / name).touch()
    save_image(torch.rand(4, 8, 3), tmp_path / "sky.png")
    np.savez(tmp_path / "bunny.npz", slim=1)
    np.savez(tmp_path / "glyphs.npz", quadrics=1)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("SCANS", str(tmp_path))
    assert set(reference.described(model)) == set(model.model_fields)
    assert all(text.endswith(".") for text in reference.described(model).values())
    assert model.__doc__
    set_keys: set[str] = set()
    for example in model.examples:
        text = example if model is Scene else f"it: {example}"
        found = loads_config(text, Scene) if model is Scene else _inside(model, text)
        set_keys |= found.model_fields_set
    assert set_keys == set(model.model_fields)


def _inside(model: type[Section], text: str) -> Section:
    return loads_config(text, create_model("Holder", it=(model, ...))).it  # type: ignore[attr-defined]


def test_links_lead_to_headings() -> None:
    page = reference.reference()
    anchors = {reference.anchor(heading) for heading in re.findall(r"^#+ (.*)$", page, re.MULTILINE)}
    linked = set(re.findall(r"\]\(#([^)]*)\)", page))
    assert linked
    assert linked <= anchors
    assert {reference.anchor(heading) for heading, _ in SECTIONS[1:]} <= linked


def test_rows_say_what_the_models_say() -> None:
    page = reference.reference()
    for row in (
        "| `shininess` | Exponent of the highlights: the higher, the smaller. | number ≥ 1 | `32.0` |",
        "| `size` | Of the picture. | [width, height]; pixels | `[512, 512]` |",
        "| `precision` | Of samples and arithmetic. | `float32`, `float64` | `float32` |",
    ):
        assert row in page
    assert re.search(r"\| `step` \|.*\| number > 0; voxels \|  \|", page)
    assert re.search(r"\| `lower` \|.*\| \*required\* \|", page)
    assert re.search(r"\| `name` \|.*`triquadratic`.*`auto` \| `triquadratic` \|", page)


def test_a_scene_is_shown_with_all_that_it_leaves_out(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text("signal: {name: sphere, samples: 8}\nsurface: 0.5\n")
    assert main(["scene", str(path), "--background", "#ff8800"]) == 0
    shown = loads_config(capsys.readouterr().out, Scene)
    assert shown == loads_config(path.read_text() + "background: '#ff8800'\n", Scene)
    assert shown.model_fields_set == set(Scene.model_fields)
    for wrong in ([], [str(path), "--reference"]):
        assert main(["scene", *wrong]) == 2
    assert "expected either a scene or --reference; got both" in capsys.readouterr().err
