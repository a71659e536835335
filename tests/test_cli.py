"""The command: what it writes, what it prints, its exit codes, and that a mistake leaves nothing behind."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path

import nibabel
import nrrd
import numpy as np
import pytest
import torch

from filterlab import METHODS, Volume, load_volume, resample, save_volume, signals
from filterlab.cli import main
from filterlab.cli.outcome import UsageError
from filterlab.cli.render import Render
from filterlab.cli.scenes import split_overrides
from filterlab.io import describe, load_image

SCENE = """
signal: {name: marschner-lobb, samples: 12}
method: triquadratic
transfer:
  points:
  - {value: 0.0, color: [0, 0, 1], opacity: 0.0}
  - {value: 1.0, color: [1, 0.5, 0], opacity: 0.5}
camera: {direction: [1, 2, -1]}
size: [24, 16]
step: 1
"""


@pytest.fixture
def volume_file(tmp_path: Path) -> Path:
    path = tmp_path / "in.nrrd"
    samples = 100 * signals.marschner_lobb().sample((6, 5, 4)).samples
    save_volume(Volume(samples.round().to(torch.uint8), spacing=(1, 2, 3), origin=(10, 20, 30)), path)
    return path


@pytest.fixture
def scene_file(tmp_path: Path) -> Path:
    path = tmp_path / "scene.yaml"
    path.write_text(SCENE)
    return path


def fails(capsys: pytest.CaptureFixture[str], arguments: list[object], code: int, *words: str) -> None:
    """The command ends with that exit code and these words on stderr, without a traceback."""
    assert main([str(a) for a in arguments]) == code
    printed = capsys.readouterr()
    assert "Traceback" not in printed.err
    for word in words:
        assert word in printed.err, printed.err
    assert printed.out == ""


# --- help and usage ---------------------------------------------------------------------------------------------------


def test_version_and_help(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"filterlab {version('filterlab')}\n"
    for arguments in ([], ["--help"]):
        assert main(arguments) == 0
        printed = capsys.readouterr().out
        assert all(name in printed for name in ("render", "resample", "methods", "info"))
    for name in ("render", "resample", "info"):
        assert main([name, "--help"]) == 0
        assert f"filterlab {name} " in capsys.readouterr().out.split("examples:")[1]  # an example to copy


def test_a_line_that_makes_no_sense(capsys: pytest.CaptureFixture[str], volume_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "out.nrrd"
    known = "render, mesh, scene, terrain, sdf, slim, resample, convert, recommend, methods, info"
    fails(capsys, ["rendr"], 2, f"unknown command 'rendr'; did you mean 'render'? known commands: {known}")
    fails(capsys, ["resample", volume_file], 2, "--output")
    fails(capsys, ["resample", volume_file, "-o", out], 2, "one of --spacing, --shape and --like; got none")
    fails(capsys, ["resample", volume_file, "-o", out, "--spacing", "1", "1"], 2, "--spacing")
    fails(capsys, ["resample", volume_file, "-o", out, "--spacing", *"111", "--shape", *"222"], 2, "got several")
    fails(capsys, ["info"], 2, "FILE")
    fails(capsys, ["methods", "--size", "3"], 2, "--size")
    assert not out.exists()


def test_the_installed_command_in_its_own_process(tmp_path: Path) -> None:
    run = [sys.executable, "-m", "filterlab"]
    done = subprocess.run([*run, "info", str(tmp_path / "none.nrrd")], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr.startswith("filterlab: ")
    assert "Traceback" not in done.stderr


def test_what_needs_no_torch_does_not_wait_for_it(volume_file: Path) -> None:
    asked = [
        ["--help"],
        ["render", "--help"],
        ["rendr"],
        [
            "resample",
            str(volume_file),
            "-o",
            str(volume_file.with_name("o.nrrd")),
            *["--shape", "2", "2", "2", "--method", "no"],
        ],
        ["recommend", str(volume_file), "--max-error", "1%", "--task", "no"],
        ["info", str(volume_file)],
        ["info", str(volume_file.with_name("none.nrrd"))],
    ]
    code = f"""
import sys
from filterlab.cli import main
codes = [main(asked) for asked in {asked!r}]
assert codes == [0, 0, 2, 1, 1, 0, 1], codes
slow = {{"torch", "pydantic", "yaml", "typeguard", "scipy", "skimage", "matplotlib", "tifffile", "nibabel", "rich"}}
slow |= {{"filterlab.io.nifti", "filterlab.io.tiff_pages", "filterlab.io.geotiff", "filterlab.io.numpy_files"}}
assert not slow & set(sys.modules), slow & set(sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_showing_a_volume_reads_and_samples_it_once(volume_file: Path, tmp_path: Path, monkeypatch) -> None:
    from filterlab.render import suggestion
    from filterlab.scenes.model import sources

    done = []

    def counted(name: str, function):
        return lambda *args, **options: done.append(name) or function(*args, **options)

    monkeypatch.setattr(sources, "load_volume", counted("read", sources.load_volume))
    monkeypatch.setattr(suggestion, "tables", counted("tables", suggestion.tables))
    monkeypatch.setattr("filterlab.scenes.default.sampled", counted("sampled", suggestion.sampled))
    monkeypatch.setattr(suggestion, "sampled", counted("sampled", suggestion.sampled))
    assert main(["render", str(volume_file), "-o", str(tmp_path / "o.png"), "--size", "8", "8", "-q"]) == 0
    assert sorted(done) == ["read", "sampled", "tables"]


def test_what_resamples_and_renders_imports_no_library_that_it_does_not_use(volume_file: Path, tmp_path: Path) -> None:
    resample = ["resample", str(volume_file), "-o", str(tmp_path / "o.nrrd"), "--shape", "3", "3", "3"]
    render = ["render", str(volume_file), "-o", str(tmp_path / "o.png"), "--size", "8", "8"]
    code = f"""
import sys
from filterlab.cli import main
assert main({resample!r}) == 0
assert not {{"pydantic", "yaml", "typeguard", "PIL"}} & set(sys.modules)
assert main({render!r}) == 0
assert not {{"typeguard", "scipy", "skimage", "kornia", "matplotlib", "tifffile"}} & set(sys.modules)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_convert_does_not_wait_for_torch_to_refuse(tmp_path: Path) -> None:
    np.save(tmp_path / "in.npy", np.zeros((2, 3, 4)))
    lines = [["out.tif"], ["out.npz", "--dtype", "uint9"], ["out.npz", "--frame", "3"], ["no/out.npz"]]
    lines = [["convert", str(tmp_path / "in.npy"), str(tmp_path / out), *more] for out, *more in lines]
    code = f"import sys; from filterlab.cli import main; print([main(a) for a in {lines}], 'torch' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout == "[1, 1, 1, 1] False\n"


def test_split_overrides() -> None:
    line = "render s.yaml --size 512 512 -o a.png --method notch --camera.position -1 2.5 -.5 --lit --name=a b.yaml"
    known, overrides = split_overrides(Render, line.split())
    assert known == ["render", "s.yaml", "-o", "a.png", "b.yaml"]
    assert overrides == {
        "size": "[512, 512]",
        "method": "notch",
        "camera.position": "[-1, 2.5, -.5]",
        "lit": "true",
        "name": "a",
    }
    assert split_overrides(Render, ["render", "--help"]) == (["render", "--help"], {})
    assert split_overrides(Render, ["render", "s", "--output=a.png"]) == (["render", "s", "--output=a.png"], {})
    with pytest.raises(UsageError, match="--size again"):
        split_overrides(Render, ["render", "--size", "1", "--size", "2"])


@pytest.mark.parametrize(
    ("error", "code", "word"), [(KeyboardInterrupt(), 130, "interrupted"), (MemoryError(), 1, "memory")]
)
def test_interrupted_and_out_of_memory(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    volume_file: Path,
    error: BaseException,
    code: int,
    word: str,
) -> None:
    def stop(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("filterlab.resampling.resample", stop)
    fails(capsys, ["resample", volume_file, "-o", volume_file.with_name("out.nrrd"), "--shape", *"222"], code, word)
    assert os.listdir(volume_file.parent) == ["in.nrrd"]


def test_our_own_mistakes_keep_their_traceback(monkeypatch: pytest.MonkeyPatch, volume_file: Path) -> None:
    def stop(*_: object, **__: object) -> None:
        raise TypeError("a defect")

    monkeypatch.setattr("filterlab.resampling.resample", stop)
    with pytest.raises(TypeError, match="a defect"):
        main(["resample", str(volume_file), "-o", str(volume_file.with_name("out.nrrd")), "--shape", *"222"])


# --- methods and info -------------------------------------------------------------------------------------------------


def test_methods_shows_every_fact(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["methods"]) == 0
    rows = {line.split("│")[1].strip(): line.split("│") for line in capsys.readouterr().out.splitlines() if "│" in line}
    assert set(rows) == set(METHODS)
    for name, method in METHODS.items():
        cells = [cell.strip() for cell in rows[name][1:-1]]
        f = method.facts
        assert cells[1:3] == [str(f.support), str(f.taps)]
        assert cells[3].startswith(str(f.approximation_order))
        assert (f"({f.approximation_order_without_prefilter})" in cells[3]) == f.prefiltered
        assert cells[4] == f"C{f.continuity}"
        assert cells[5].startswith("yes") == f.interpolating
        assert cells[6] == ", ".join(f.gradients)
        assert cells[7] == ", ".join(f.schemes)
        assert cells[8] == method.summary


def test_methods_help_is_true_of_prefiltered_methods(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["methods", "--help"]) == 0
    words = " ".join(capsys.readouterr().out.replace("│", " ").split())
    assert "support: width of the kernel along an axis" in words
    assert "with a prefilter the influence of a sample goes on beyond it and decays" in words
    assert "whose kernel has 64 taps, is evaluated with 27 after averaging neighbours" in words
    assert METHODS["notch"].facts.support ** 3 == 64
    assert METHODS["notch"].facts.taps == 27


def facts(text: str) -> dict[str, str]:
    """Lines of two columns as a dict."""
    rows = [line.strip().split("  ", 1) for line in text.splitlines() if "  " in line.strip()]
    return {name.strip(): value.strip() for name, value in rows}


def test_info(capsys: pytest.CaptureFixture[str], volume_file: Path) -> None:
    assert main(["info", str(volume_file)]) == 0
    found = facts(capsys.readouterr().out)
    samples = load_volume(volume_file).samples
    assert found["size (x, y, z)"] == "6 × 5 × 4"
    assert found["type"] == "uint8"
    assert (found["spacing"], found["origin"], found["extent"]) == ("1 2 3", "10 20 30", "6 10 12")
    assert found["range"] == f"{samples.min()} … {samples.max()}"
    assert found["mean"] == f"{samples.double().mean():.6g}"
    assert found["world axes"] == "not declared"
    assert main(["info", str(volume_file), "--header-only"]) == 0
    assert "range" not in facts(capsys.readouterr().out)


@pytest.mark.parametrize(
    ("samples", "shares", "extra"),
    [
        (np.array([0, 0, 0, 1, 2, 2, 3, 3], np.uint8), [37.5, 12.5, 25, 25], {"range": "0 … 3"}),
        (np.array([-128, 127, 127, 127], np.int8), [25] + 14 * [0] + [75], {"range": "-128 … 127"}),
        (np.array([-(2**63), 2**63 - 1]), [50] + 14 * [0] + [50], {}),
        (np.array([0, 0.5, 1, np.nan, -np.inf]), [33.33] + 7 * [0] + [33.33] + 6 * [0] + [33.33], {"not finite": "2"}),
        (np.array([7.0, 7.0]), [], {"range": "7 … 7", "mean": "7"}),
        (np.array([np.nan]), [], {"range": "no finite values"}),
    ],
)
def test_info_histograms(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, samples: np.ndarray, shares: list[float], extra: dict[str, str]
) -> None:
    np.save(tmp_path / "a.npy", samples.reshape(1, 1, -1))
    assert main(["info", str(tmp_path / "a.npy")]) == 0
    found = facts(capsys.readouterr().out)
    assert [float(v.split("%")[0]) for k, v in found.items() if k.startswith("from ")] == shares
    assert {k: found[k] for k in extra} == extra


def test_info_shows_a_rotated_affine_and_odd_names(capsys: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    affine = np.array([[0, -1, 0, 5.0], [1, 0, 0, 6], [0, 0, 2, 7], [0, 0, 0, 1]])
    path = tmp_path / "[red]a.npz"
    save_volume(Volume(torch.zeros(2, 3, 4), affine=affine), path)
    assert main(["info", str(path)]) == 0
    printed = capsys.readouterr().out
    assert facts(printed)["affine"] == "0 -1 0 5"
    assert "[red]a.npz" in printed


@pytest.fixture
def series_file(tmp_path: Path) -> Path:
    """Two frames of three channels each, in a NIfTI file."""
    path = tmp_path / "series.nii"
    samples = np.random.default_rng(0).integers(0, 100, (6, 5, 4, 2, 3)).astype(np.int16)
    image = nibabel.Nifti1Image(samples, np.diag([1.0, 2, 3, 1]))
    image.header.set_xyzt_units("mm", "sec")
    nibabel.save(image, path)
    return path


def test_info_shows_every_header(capsys: pytest.CaptureFixture[str], series_file: Path) -> None:
    assert main(["info", str(series_file)]) == 0
    printed = capsys.readouterr()
    found = facts(printed.out)
    assert (found["frames"], found["channels"], found["size (x, y, z)"]) == ("2", "3", "6 × 5 × 4")
    assert found["codes"] == "NIfTI-1, sform 2, qform 0, time in sec"
    assert (found["world axes"], found["unit"]) == ("RAS", "mm")
    assert "range" not in found
    assert "no voxels are read" in printed.err
    assert "a choice among its 2 frames, frame=0 to frame=1" in printed.err
    assert main(["info", str(series_file), "--frame", "1", "--channel", "2"]) == 0
    printed = capsys.readouterr()
    found, samples = facts(printed.out), load_volume(series_file, frame=1, channel=2).samples
    assert (found["frames"], found["channels"]) == ("2; this is 1", "3; this is 2")
    assert found["range"] == f"{samples.min()} … {samples.max()}"
    assert printed.err == ""
    fails(capsys, ["info", series_file, "--frame", "2"], 1, "a frame from 0 to 1; got frame 2")


def test_frames_and_channels_are_chosen_everywhere(
    capsys: pytest.CaptureFixture[str], series_file: Path, tmp_path: Path
) -> None:
    part, out = ["--frame", "1", "--channel", "2"], tmp_path / "out.nrrd"
    expected = load_volume(series_file, frame=1, channel=2)
    line = ["resample", str(series_file), "-o", str(out), "--shape", "6", "5", "4"]
    assert main([*line, *part]) == 0
    assert torch.equal(load_volume(out).samples, resample(expected, shape=(4, 5, 6)).samples)
    fails(capsys, line, 1, "a choice among its 2 frames")
    surface = [str(series_file), "--level", "50", "-o", str(tmp_path / "a.png"), "--size", "12", "8"]
    save_volume(expected, tmp_path / "one.nii")
    assert main(["render", *surface, *part]) == 0
    assert main(["render", str(tmp_path / "one.nii"), *surface[1:3], "-o", str(tmp_path / "b.png"), *surface[5:]]) == 0
    assert torch.equal(load_image(tmp_path / "a.png"), load_image(tmp_path / "b.png"))
    fails(capsys, ["render", *surface], 1, "a choice among its 2 frames")
    scene = tmp_path / "scene.yaml"
    for volume in (series_file.name, f"{{file: {series_file.name}, channel: 0}}"):
        scene.write_text(f"volume: {volume}\nsurface: {{level: 50}}\n")
        assert main(["mesh", str(scene), "-o", str(tmp_path / "a.ply"), *part]) == 0
    assert main(["mesh", str(tmp_path / "one.nii"), "--level", "50", "-o", str(tmp_path / "b.ply")]) == 0
    assert (tmp_path / "a.ply").read_bytes() == (tmp_path / "b.ply").read_bytes()
    capsys.readouterr()
    recommended = ["recommend", str(series_file), "--max-error", "50%", "-o", str(tmp_path / "found.yaml")]
    assert main([*recommended, *part]) == 0
    text = (tmp_path / "found.yaml").read_text()
    assert "frame: 1" in text
    assert "channel: 2" in text
    capsys.readouterr()
    fails(capsys, recommended, 1, "a choice among its 2 frames")


def test_what_is_odd_about_a_file_is_told_in_a_line(
    capsys: pytest.CaptureFixture[str], series_file: Path, tmp_path: Path
) -> None:
    series_file.write_bytes(series_file.read_bytes() + b"more")
    resampled = ["resample", str(series_file), "-o", "out.nii", "--quiet", "--antialias", "--shape", *"222"]
    for command in (["info", str(series_file)], resampled):
        command = [str(tmp_path / a) if a == "out.nii" else a for a in command]
        assert main([*command, "--frame", "0", "--channel", "0"]) == 0
        told = f"filterlab: {series_file}: passed over what comes behind its 1440 bytes of samples\n"
        assert capsys.readouterr().err == told


def test_info_of_a_damaged_file(capsys: pytest.CaptureFixture[str], volume_file: Path) -> None:
    volume_file.write_bytes(volume_file.read_bytes()[:-4])
    fails(capsys, ["info", volume_file.with_name("none.nrrd")], 1, "none.nrrd")
    assert main(["info", str(volume_file), "-H"]) == 0
    capsys.readouterr()
    assert main(["info", str(volume_file)]) == 1
    assert "in.nrrd: expected gzip data" in capsys.readouterr().err


def test_a_bare_tensor_is_saved_with_centres_at_the_integers(tmp_path: Path) -> None:
    samples = torch.rand(2, 3, 4)
    save_volume(samples, tmp_path / "a.nrrd")
    found = load_volume(tmp_path / "a.nrrd")
    assert torch.equal(found.samples, samples)
    assert np.array_equal(found.affine, np.eye(4))
    save_volume(torch.rand(1, 2, 3, 4, 5), tmp_path / "b.npy")
    assert load_volume(tmp_path / "b.npy").shape == (1, 2, 3, 4, 5)
    save_volume(samples.numpy(), tmp_path / "array.npy")
    assert torch.equal(load_volume(tmp_path / "array.npy").samples, samples)
    for wrong in (samples[0], samples.tolist()):
        with pytest.raises((ValueError, TypeError), match=r"shape|Tensor"):
            save_volume(wrong, tmp_path / "c.npy")  # type: ignore[arg-type]
    assert not (tmp_path / "c.npy").exists()


# --- resample ---------------------------------------------------------------------------------------------------------


def test_resample_is_the_library_s(volume_file: Path, tmp_path: Path) -> None:
    volume, out = load_volume(volume_file), tmp_path / "out.npz"
    line = ["resample", str(volume_file), "-o", str(out), "--method", "notch"]
    assert main([*line, "--spacing", "0.5", "1", "1.5", "--boundary", "reflect"]) == 0
    expected = resample(volume, "notch", spacing=(0.5, 1, 1.5), boundary="reflect")
    assert torch.equal(load_volume(out).samples, expected.samples)
    assert np.array_equal(load_volume(out).affine, expected.affine)
    assert main([*line, "--shape", "7", "8", "9", "--dtype", "float64"]) == 0
    found = load_volume(out)
    assert (found.size, found.dtype) == ((7, 8, 9), torch.float64)
    assert torch.equal(found.samples, resample(volume, "notch", shape=(9, 8, 7), dtype=torch.float64).samples)


def test_resample_like_another_volume(volume_file: Path, tmp_path: Path) -> None:
    affine = np.array([[0.5, 0.1, 0, 11.0], [-0.1, 0.5, 0, 22], [0, 0, 1, 31], [0, 0, 0, 1]])
    like, out = tmp_path / "like.nii.gz", tmp_path / "out.nii.gz"
    save_volume(Volume(torch.zeros(3, 4, 5, dtype=torch.uint8), affine=affine), like)
    assert main(["resample", str(volume_file), "-o", str(out), "--like", str(like)]) == 0
    expected = resample(load_volume(volume_file), like=load_volume(like))
    assert torch.equal(load_volume(out).samples, expected.samples)
    assert np.array_equal(load_volume(out).affine, load_volume(like).affine)


def test_resample_fills_what_lies_outside(
    capsys: pytest.CaptureFixture[str], volume_file: Path, tmp_path: Path
) -> None:
    like, out = tmp_path / "like.nrrd", tmp_path / "out.nrrd"
    source = load_volume(volume_file)
    save_volume(Volume(torch.zeros(4, 5, 6), spacing=source.spacing, origin=(13, 20, 30)), like)
    line = ["resample", str(volume_file), "-o", str(out), "--like", str(like)]
    assert main([*line, "--fill", "-5"]) == 0
    found = load_volume(out).samples
    assert (found[..., 3:] == -5).all()
    assert torch.allclose(found[..., :3], source.samples[..., 3:].float(), atol=1e-4)
    assert main([*line, "--fill", "nan"]) == 0
    assert load_volume(out).samples[..., 3:].isnan().all()
    assert main([*line, "--fill", "250", "--dtype", "input"]) == 0
    assert (load_volume(out).samples[..., 3:] == 250).all()
    fails(capsys, [*line, "--fill", "nan", "--dtype", "input"], 1, "expected a --fill that uint8 holds; got nan")
    save_volume(Volume(torch.zeros(4, 5, 6), origin=(1000, 0, 0)), like)
    fails(capsys, line, 1, "expected grids that overlap")
    assert main([*line, "--fill", "0"]) == 0


def test_resample_tells_what_nifti_1_rounds(
    volume_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, line = tmp_path / "out.nii.gz", ["resample", str(volume_file), "-o", str(tmp_path / "out.nii.gz"), "--spacing"]
    assert main([*line, "0.7", "0.7", "0.7"]) == 0
    assert re.search(
        r"out\.nii\.gz: the affine is rounded to float32, by \de-08 of itself; --nifti2", capsys.readouterr().err
    )
    exact = resample(load_volume(volume_file), spacing=(0.7, 0.7, 0.7)).affine
    assert np.array_equal(load_volume(out).affine, exact.astype(np.float32))
    assert main([*line, "0.7", "0.7", "0.7", "--nifti2"]) == 0
    assert np.array_equal(load_volume(out).affine, exact)
    capsys.readouterr()
    assert main([*line, "0.5", "0.5", "0.5", "-q"]) == 0  # exact in float32
    assert "rounded" not in capsys.readouterr().err
    assert main(["resample", str(volume_file), "-o", str(tmp_path / "a.nrrd"), "--shape", *"345", "--nifti2"]) == 1
    assert "for NIfTI-2; got NRRD" in capsys.readouterr().err


def test_resample_to_integers_rounds_and_clips(tmp_path: Path) -> None:
    step = Volume(torch.tensor([0, 0, 0, 255, 255, 255], dtype=torch.uint8).expand(2, 2, 6).contiguous())
    save_volume(step, tmp_path / "in.nrrd")
    line = ["resample", str(tmp_path / "in.nrrd"), "-o", str(tmp_path / "out.nrrd"), "--shape", "24", "2", "2"]
    assert main([*line, "--method", "tricubic", "--dtype", "input"]) == 0
    found = load_volume(tmp_path / "out.nrrd").samples
    exact = resample(step, "tricubic", shape=(2, 2, 24)).samples
    assert exact.min() < -1  # the prefiltered cubic overshoots
    assert exact.max() > 256
    assert found.dtype == torch.uint8
    assert torch.equal(found, exact.clamp(0, 255).round().to(torch.uint8))
    for dtype in ("int64", "int32"):
        save_volume(Volume(torch.full((1, 1, 2), 1e30)), tmp_path / "big.nrrd")
        line = ["resample", str(tmp_path / "big.nrrd"), "-o", str(tmp_path / "out.nrrd"), "--shape", *"211"]
        assert main([*line, "--dtype", dtype]) == 0
        assert (load_volume(tmp_path / "out.nrrd").samples == torch.iinfo(getattr(torch, dtype)).max).all()


@pytest.fixture
def label_file(tmp_path: Path) -> Path:
    """Balls of the labels 0, 2, 4 in uint16."""
    z, y, x = np.indices((12, 12, 12)) - 5.5
    radius = np.sqrt(x**2 + y**2 + z**2)
    samples = np.select([radius < 2.5, radius < 4.5], [4, 2], 0).astype(np.uint16)
    nrrd.write(str(tmp_path / "labels.nrrd"), samples, index_order="C")
    return tmp_path / "labels.nrrd"


@pytest.mark.parametrize("how", [["--labels"], ["--labels", "--method", "notch"], ["--method", "nearest"]])
def test_labels_stay_labels(capsys: pytest.CaptureFixture[str], label_file: Path, tmp_path: Path, how: list) -> None:
    out = tmp_path / "out.nrrd"
    line = ["resample", str(label_file), "-o", str(out), "--shape", "19", "18", "17"]
    assert main(line) == 0
    assert "labels.nrrd: its values look like labels" in capsys.readouterr().err
    assert len(load_volume(out).samples.unique()) > 100
    assert main([*line, *how, "--quiet"]) == 0
    assert capsys.readouterr().err == ""
    assert load_volume(out).samples.unique().tolist() == [0, 2, 4]
    assert describe(out).stored == "uint16"
    method = how[-1] if "--method" in how else "triquadratic"
    expected = resample(load_volume(label_file), method, shape=(17, 18, 19), labels="--labels" in how)
    assert torch.equal(load_volume(out).samples, expected.samples)


@pytest.mark.parametrize("dtype", [np.uint8, np.int8, np.uint16, np.int16, np.uint32, np.int32, np.uint64, np.int64])
@pytest.mark.parametrize("method", ["nearest", "trilinear"])
def test_integers_come_out_as_they_went_in(tmp_path: Path, dtype: type, method: str) -> None:
    """To the last digit, in their own type; what float64 cannot hold, and is computed with, is refused."""
    info, out = np.iinfo(dtype), tmp_path / "out.nrrd"
    largest = min(info.max, 2**63 - 1)
    for top in {largest, min(largest, 2**53), min(largest, 16_777_217)}:
        samples = np.array([[[info.min, 0, 1, top]]]) if info.min > -(2**53) else np.array([[[-5, 0, 1, top]]])
        nrrd.write(str(tmp_path / "in.nrrd"), samples.astype(dtype), index_order="C")
        line = ["resample", str(tmp_path / "in.nrrd"), "-o", str(out), "--shape", "4", "1", "1", "--method", method]
        code = main([*line, "--dtype", "input"])
        assert code == (1 if method == "trilinear" and top > 2**53 else 0)
        if code == 0:
            assert describe(out).stored == np.dtype(dtype).name
            assert load_volume(out).samples.tolist() == samples.tolist()
        if code == 0 and method == "trilinear" and top > 2**24:
            assert main(line) == 0
            assert describe(out).stored == "float64"
            assert load_volume(out).samples.tolist() == samples.tolist()
            assert main([*line, "--dtype", "float32"]) == 1


def test_results_are_rounded_and_clipped_to_every_integer_type(tmp_path: Path) -> None:
    save_volume(Volume(torch.tensor([[[-1e30, -1.4, 0.6, 1e30]]])), tmp_path / "in.nrrd")
    line = ["resample", str(tmp_path / "in.nrrd"), "-o", str(tmp_path / "out.nrrd"), "--shape", "4", "1", "1"]
    for name in ("uint8", "int8", "uint16", "int16", "uint32", "int32", "uint64", "int64"):
        assert main([*line, "--method", "nearest", "--dtype", name]) == 0
        least, most = np.iinfo(name).min, min(np.iinfo(name).max, 2**63 - 1)
        assert load_volume(tmp_path / "out.nrrd").samples.tolist() == [[[least, max(least, -1), 1, most]]]
        assert describe(tmp_path / "out.nrrd").stored == name


def test_resample_refuses_before_it_works(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], volume_file: Path, tmp_path: Path
) -> None:
    def never(*_: object, **__: object) -> None:
        pytest.fail("the voxels must not be read")

    monkeypatch.setattr("filterlab.io.volumes.load_volume", never)
    (tmp_path / "link.nrrd").symlink_to(volume_file)
    batch = tmp_path / "batch.npy"
    np.save(batch, np.zeros((1, 2, 3, 4, 5)))
    before = sorted(os.listdir(tmp_path))
    out, shape = tmp_path / "out.nrrd", ["--shape", 2, 2, 2]

    def refused(*words: str, source: Path = volume_file, to: Path = out, more: list | None = None) -> None:
        fails(capsys, ["resample", source, "-o", to, *(shape if more is None else more)], 1, *words)

    refused("unknown method 'noch'; did you mean 'notch'?", "triquadratic", more=[*shape, "--method", "noch"])
    refused("unknown boundary 'miror'; did you mean 'mirror'?", more=[*shape, "--boundary", "miror"])
    refused("unknown dtype 'uint9'; did you mean 'uint8'?", more=[*shape, "--dtype", "uint9"])
    refused("other than the input", to=volume_file)
    refused("other than the input", to=tmp_path / "link.nrrd")
    refused("other than the input", more=["--like", out])
    refused("existing folder", to=tmp_path / "missing" / "out.nrrd")
    refused("a name that ends in .nrrd", to=tmp_path / "out.tif")
    refused("npy or npz", source=batch)
    refused("no file", source=tmp_path / "none.nrrd")
    refused("did you mean '.nrrd'", source=tmp_path / "none.nrd")
    refused("no file", more=["--like", tmp_path / "none.nrrd"])
    refused("positive", more=["--spacing", 1, 0, 1])
    refused("positive", more=["--spacing", 1, "nan", 1])
    refused("1 or more", more=["--shape", 1, 0, 1])
    refused("--max-gigabytes", "GiB", more=["--spacing", 1e-5, 1e-5, 1e-5])
    refused("--max-gigabytes", more=["--shape", 300, 300, 300, "--max-gigabytes", 0.1])
    for limit in ("nan", "inf", "0", "-1"):
        refused(f"--max-gigabytes to be a positive number; got {float(limit)}", more=[*shape, "--max-gigabytes", limit])
    much = [*shape[:1], 10**6, 10**6, 10**4, "--max-gigabytes", "1e9"]
    refused("GiB of this machine; got 1e+06 × 1e+06 × 10000 voxels of 4 bytes", more=much)
    assert sorted(os.listdir(tmp_path)) == before


@pytest.mark.parametrize(
    ("dtype", "stored", "itemsize"),
    [
        ("float32", torch.uint8, 4),
        ("float64", torch.uint8, 8),
        ("int64", torch.uint8, 8),  # computed in 4 bytes, written in 8
        ("uint8", torch.uint8, 4),  # computed in 4 bytes, written in 1
        ("float32", torch.float64, 8),  # computed in 8 bytes, written in 4
        ("input", torch.float64, 8),
    ],
)
def test_the_memory_limit_counts_the_bytes_of_the_type(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, dtype: str, stored: torch.dtype, itemsize: int
) -> None:
    save_volume(torch.ones(2, 2, 2, dtype=stored), tmp_path / "in.nrrd")
    line = ["resample", tmp_path / "in.nrrd", "-o", tmp_path / "out.nrrd", "--shape", 16, 16, 16, "--dtype", dtype]
    exact = 16**3 * itemsize / 2**30
    assert main([str(a) for a in [*line, "--quiet", "--max-gigabytes", exact]]) == 0
    assert capsys.readouterr().err == ""
    fails(capsys, [*line, "--max-gigabytes", exact * 0.999], 1, "--max-gigabytes", f"voxels of {itemsize} bytes")


def test_an_allocation_that_fails_has_no_traceback(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], volume_file: Path
) -> None:
    out = volume_file.with_name("out.nrrd")
    line = ["resample", volume_file, "-o", out, "--spacing", "1e-14", 1, 1, "--max-gigabytes", "1e9"]
    monkeypatch.setattr("filterlab.cli.memory._installed_memory", lambda: float("inf"))  # torch has to find out itself
    fails(capsys, line, 1, "expected more memory than there is; torch could not get another", "bytes")
    line[5:8] = ["1e-17", 100, 100]
    fails(capsys, [*line[:-1], "1e12"], 1, "expected more memory than there is")
    assert not out.exists()

    def defect(*_: object, **__: object) -> None:
        raise RuntimeError("shapes do not match")

    monkeypatch.setattr("filterlab.resampling.resample", defect)
    with pytest.raises(RuntimeError, match="shapes do not match"):
        main(["resample", str(volume_file), "-o", str(out), "--shape", *"222"])


# --- render -----------------------------------------------------------------------------------------------------------


def test_render(scene_file: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "a.png"
    assert main(["render", str(scene_file), "-o", str(out)]) == 0
    image = load_image(out)
    assert image.shape == (16, 24, 3)
    assert image.max() > 0.2
    assert image.std() > 0.01
    capfd.readouterr()
    assert main(["render", str(scene_file), "-q", "-o", str(out), "--method", "notch", "--size", "8", "6"]) == 0
    assert load_image(out).shape == (6, 8, 3)
    assert capfd.readouterr() == ("", "")  # no bar where nobody looks
    assert sorted(os.listdir(tmp_path)) == ["a.png", "scene.yaml"]


def test_render_of_a_volume_file(scene_file: Path, volume_file: Path, tmp_path: Path) -> None:
    text = SCENE.replace("signal: {name: marschner-lobb, samples: 12}", f"volume: {volume_file.name}")
    scene_file.write_text(text.replace("value: 1.0", "value: 100"))
    assert main(["render", str(scene_file), "-o", str(tmp_path / "a.png")]) == 0
    assert load_image(tmp_path / "a.png").std() > 0.01


def test_render_of_a_surface_needs_a_volume_and_a_level(
    volume_file: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "a.png"
    line = ["render", str(volume_file), "--level", "40", "-o", str(out), "--size", "24", "16"]
    assert main([*line, "--surface.subpixels", "1"]) == 0
    image = load_image(out)
    assert image.shape == (16, 24, 3)
    assert image.std() > 0.02
    assert main(["render", str(volume_file), "--level", "40", "--size", "8", "6", "--explain"]) == 0
    assert "cells may hold the level" in capfd.readouterr().out


def test_a_volume_is_shown_as_it_is_and_its_scene_printed(
    volume_file: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pictures = tmp_path / "a.png", tmp_path / "b.png"
    assert main(["render", str(volume_file), "-o", str(pictures[0]), "--size", "24", "16"]) == 0
    assert load_image(pictures[0]).std() > 0.02
    capsys.readouterr()
    assert main(["scene", str(volume_file), "--size", "24", "16"]) == 0
    scene = tmp_path / "a.yaml"
    scene.write_text(capsys.readouterr().out)
    assert main(["render", str(scene), "-o", str(pictures[1])]) == 0
    assert torch.equal(*map(load_image, pictures))


def test_mistakes_about_levels_are_named(capsys: pytest.CaptureFixture[str], volume_file: Path, tmp_path: Path) -> None:
    out = tmp_path / "a.png"
    fails(capsys, ["mesh", volume_file, "-o", out.with_suffix(".ply")], 1, "a volume and --level; got neither")
    fails(capsys, ["render", volume_file, "--level", "high", "-o", out], 1, "surface.level: expected a valid number")
    fails(capsys, ["render", tmp_path / "no.nrrd", "--level", "1", "-o", out], 1, "found none at")
    fails(capsys, ["render", volume_file, "--level", "1", "--step", "1", "-o", out], 1, "hit exactly")
    fails(capsys, ["render", volume_file, "--level", "1", "--surface.material", "tooon", "-o", out], 1, "'toon'")
    assert not out.exists()
    volume_file.write_bytes(volume_file.read_bytes()[:-4])  # no voxel is read to say so
    fails(capsys, ["mesh", volume_file, "-o", out.with_suffix(".ply")], 1, "a volume and --level; got neither")


def test_render_refuses_before_it_works(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], scene_file: Path, tmp_path: Path
) -> None:
    def never(*_: object, **__: object) -> None:
        pytest.fail("nothing must be rendered")

    monkeypatch.setattr("filterlab.scenes.build.build", never)
    out = tmp_path / "a.png"
    fails(capsys, ["render", scene_file, "-o", out, "--method", "noch"], 1, "did you mean 'notch'?", "tricubic")
    fails(capsys, ["render", scene_file, "-o", out, "--camera.fov", "3"], 1, "--camera.fov: camera.fov: unknown key")
    fails(capsys, ["render", scene_file, "-o", out, "--size", "8"], 1, "--size: size")
    fails(capsys, ["render", scene_file, "-o", out, "--device", "moon"], 1, "device", "'moon'")
    fails(capsys, ["render", scene_file, "-o", out, "--device", "meta"], 1, "device", "'meta'")
    wave = "{name: plane-wave, samples: 8, parameters: {wave_vector: 3}}"
    fails(capsys, ["render", scene_file, "-o", out, "--signal", wave], 1, "signal.parameters: wave_vector: expected")
    fails(capsys, ["render", scene_file, "-o", tmp_path / "a.gif"], 1, "ends in .png or .jpg")
    fails(capsys, ["render", scene_file, "-o", tmp_path / "no" / "a.png"], 1, "existing folder")
    fails(capsys, ["render", tmp_path / "no.yaml", "-o", out], 1, "no.yaml")
    fails(capsys, ["render", tmp_path, "-o", out], 1, "a folder")
    fails(capsys, ["render", scene_file, "-o", out, "--size", "8", "8", "--size", "9", "9"], 2, "--size again")
    scene_file.write_text(SCENE + "colour: red\n")
    fails(capsys, ["render", scene_file, "-o", out], 1, "scene.yaml:11: colour: unknown key 'colour'")
    picture = tmp_path / "scene.png"
    scene_file.rename(picture)
    fails(capsys, ["render", picture, "-o", picture], 1, "other than the input")
    assert sorted(os.listdir(tmp_path)) == ["scene.png"]


@pytest.mark.parametrize("limit", ["1e300", "1.7e308", "5e-324"])
def test_any_positive_limit_of_memory_works_or_is_said_to_be_too_small(limit, volume_file, tmp_path, capsys):
    line = ["resample", str(volume_file), "-o", str(tmp_path / "out.npy"), "--shape", "3", "3", "3"]
    code = main([*line, "--max-gigabytes", limit])
    assert code == (1 if limit == "5e-324" else 0)
    assert "GiB" in capsys.readouterr().err or code == 0


@pytest.mark.parametrize("size", ["1" + "0" * 20, "1" + "0" * 400])
def test_a_shape_beyond_all_numbers_is_refused(size, volume_file, tmp_path, capsys):
    line = ["resample", str(volume_file), "-o", str(tmp_path / "out.npy"), "--shape", "3", size, "3"]
    fails(capsys, line, 1, "expected a result of at most 8 GiB")


def test_the_package_tells_the_version_that_the_command_tells(capsys):
    import filterlab

    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"filterlab {filterlab.__version__}\n"
    with pytest.raises(AttributeError, match="nothing_of_that_name"):
        getattr(filterlab, "nothing_of" + "_that_name")
