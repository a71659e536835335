"""`filterlab convert`: the same voxels at the same place in every format, and what is lost is told."""

from __future__ import annotations

import itertools
import json
import os
import subprocess
import sys
from pathlib import Path

import nibabel
import nrrd
import numpy as np
import pytest
import tifffile
import torch

from filterlab import Volume, load_volume, save_volume
from filterlab.cli import main
from filterlab.io import FORMATS, describe
from filterlab.world import LPS, RAS, World
from tests import resident
from tests.io.writers import AFFINE, ENDINGS, SAMPLES, write_any, write_nifti, write_nrrd

WRITTEN = [ending for known in FORMATS.values() for ending in known.written]
NAMES = "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64"
TYPES = [np.dtype(name) for name in NAMES]


def converted(source: Path, ending: str, *more: str, code: int = 0) -> Path:
    out = source.with_name(f"converted{ending}")
    assert main(["convert", str(source), str(out), *more]) == code
    return out


def extremes(dtype: np.dtype) -> np.ndarray:
    """Numbers that a wrong type loses: the least and largest, and for floats those that comparisons miss."""
    if dtype.kind == "f":
        values = [np.finfo(dtype).max, np.finfo(dtype).tiny, -0.0, np.inf, -np.inf, np.nan, 1 / 3]
    else:
        values = [np.iinfo(dtype).min, min(int(np.iinfo(dtype).max), 2**63 - 1), 0, 1]
    return np.resize(np.array(values, dtype), SAMPLES.shape)


@pytest.mark.parametrize("ending", WRITTEN)
@pytest.mark.parametrize("dtype", TYPES, ids=str)
def test_every_value_stays_bit_for_bit_in_its_type(tmp_path: Path, ending: str, dtype: np.dtype) -> None:
    samples = extremes(dtype)
    np.save(tmp_path / "in.npy", samples)
    out = converted(tmp_path / "in.npy", ending)
    assert describe(out).stored == dtype.name
    found = load_volume(out).samples.numpy().astype(dtype)
    assert found.tobytes() == samples.tobytes()


@pytest.mark.parametrize("source", [e for e in ENDINGS if e != ".tif"])
@pytest.mark.parametrize("ending", WRITTEN)
def test_every_format_becomes_every_other(tmp_path: Path, source: str, ending: str) -> None:
    path = write_any(tmp_path, source, SAMPLES.astype(np.uint16))
    out = converted(path, ending, *(["--nifti2"] if ".nii" in ending else []))
    before, after = load_volume(path), load_volume(out)
    assert torch.equal(after.samples, before.samples)
    assert np.array_equal(after.affine, before.affine)
    assert describe(out).stored == "uint16"


def test_other_peoples_tools_find_the_same(tmp_path: Path) -> None:
    path = write_nifti(tmp_path / "in.nii.gz", SAMPLES.astype(np.int16))
    data, header = nrrd.read(str(converted(path, ".nrrd")), index_order="C")
    assert np.array_equal(data, SAMPLES)
    assert header["space"] == RAS
    assert np.array_equal(header["space directions"].T, AFFINE[:3, :3])
    image = nibabel.load(converted(tmp_path / "converted.nrrd", ".nii"))
    assert np.array_equal(np.asarray(image.dataobj).T, SAMPLES)
    assert np.array_equal(image.affine, AFFINE)


def test_nothing_is_said_to_be_lost_where_nothing_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    image = nibabel.Nifti1Image(SAMPLES.T.astype(np.int16), AFFINE)
    image.header.set_xyzt_units("mm", "sec")
    image.set_sform(AFFINE, code=1)
    nibabel.save(image, tmp_path / "in.nii")
    out = nibabel.load(converted(tmp_path / "in.nii", ".nii.gz", "-q"))
    assert (int(out.header["sform_code"]), int(out.header["qform_code"])) == (1, int(image.header["qform_code"]))
    assert out.header.get_xyzt_units() == ("mm", "sec")
    for space in (None, LPS, RAS, "scanner-xyz"):
        save_volume(Volume(torch.rand(2, 3, 4), affine=AFFINE, world=World(space, "mm")), tmp_path / "in.nrrd")
        written = describe(converted(tmp_path / "in.nrrd", ".nrrd", "-q"))
        assert (written.world, written.affine.tolist()) == (World(space, "mm"), AFFINE.tolist())
    assert capsys.readouterr().err == ""


@pytest.fixture
def nifti(tmp_path: Path) -> Path:
    """Labels with a description, codes, and a unit."""
    image = nibabel.Nifti1Image(SAMPLES.T.astype(np.uint8), AFFINE + 1e-9)
    image.header.set_xyzt_units("mm")
    image.header.set_intent("label", allow_unknown=True)
    image.header["descrip"] = b"organs"
    nibabel.save(image, tmp_path / "in.nii")
    return tmp_path / "in.nii"


def test_what_is_lost_is_told(nifti: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    def told(source: Path, ending: str, *more: str) -> str:
        converted(source, ending, "-q", *more)
        return capsys.readouterr().err

    codes = "codes of NIfTI (sform 2, qform 0)"
    lost = f"not kept: axes (right-anterior-superior), unit (mm), {codes}, description, intent"
    assert told(nifti, ".npy") == f"filterlab: {tmp_path / 'converted.npy'}: {lost}\n"
    assert f"not kept: {codes}, description, intent\n" in told(nifti, ".nrrd")
    assert told(nifti, ".nii.gz") == ""
    plain = write_nrrd(tmp_path / "in.nrrd", units=["mm", "mm", "mm"], content="a scan", **{"sample units": "HU"})
    assert "NIfTI says that its axes are RAS; nothing was declared" in told(plain, ".nii")
    assert "not kept: content, sample units" in told(plain, ".nrrd")
    save_volume(Volume(torch.rand(2, 3, 4), spacing=0.7, world=World("scanner-xyz", "furlong")), plain)
    lines = told(plain, ".nii")
    assert "NIfTI says that its axes are RAS; scanner-xyz was declared" in lines
    assert "not kept: unit (furlong)" in lines
    assert "the affine is rounded to float32, by 2e-08 of itself; --nifti2 keeps it" in lines
    assert "rounded" not in told(plain, ".nii", "--nifti2")
    np.save(tmp_path / "half.npy", SAMPLES.astype(np.float16))
    assert "its type is float32; " in told(tmp_path / "half.npy", ".nrrd")
    assert told(tmp_path / "half.npy", ".npz") == ""
    np.save(tmp_path / "bool.npy", SAMPLES > 5)
    assert f"its type is uint8; {tmp_path / 'bool.npy'} has bool" in told(tmp_path / "bool.npy", ".npz")
    scaled = write_nifti(tmp_path / "scaled.nii", SAMPLES.astype(np.int16), slope=0.5, inter=3.0)
    assert "its values are scaled, 0.5 · stored + 3.0, and stored as float32" in told(scaled, ".nii.gz")
    assert torch.equal(load_volume(tmp_path / "converted.nii.gz").samples, load_volume(scaled).samples)
    size = {f"PhysicalSize{axis}": 0.5 for axis in "XYZ"}
    options = {"ome": True, "photometric": "minisblack", "metadata": {"axes": "ZYX", **size}}
    tifffile.imwrite(tmp_path / "a.tif", SAMPLES.astype(np.uint8), **options)
    assert "not kept: unit (um)" in told(tmp_path / "a.tif", ".npy")


@pytest.mark.parametrize(
    "line", ["IN -o OUT", "-o OUT IN", "IN --output OUT --frame 0 -q", "-q IN --dtype input -o OUT"]
)
def test_the_output_as_other_commands_take_it(nifti: Path, tmp_path: Path, line: str) -> None:
    names = {"IN": str(nifti), "OUT": str(tmp_path / "out.npy")}
    assert main(["convert", *(names.get(word, word) for word in line.split())]) == 0
    assert np.array_equal(np.load(tmp_path / "out.npy"), SAMPLES.astype(np.uint8))


def test_an_output_that_is_missing_is_asked_for(nifti: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["convert", str(nifti), "-o"]) == 2
    assert main(["convert", str(nifti)]) == 2
    assert "OUT" in capsys.readouterr().err


def test_pairs_of_nrrd_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_nrrd(tmp_path / "in.nrrd", SAMPLES.astype(np.uint8))
    text = path.read_bytes().replace(b"endian: little\n", b"").replace(b"\n\n", b"\nmodality:=CT\nowner:=us\n\n", 1)
    path.write_bytes(text)
    assert describe(path).fields["key/value pairs"] == "modality, owner"
    converted(path, ".nrrd")
    assert "not kept: key/value pairs" in capsys.readouterr().err


def test_one_of_many_volumes(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    samples = np.random.default_rng(0).integers(0, 100, (6, 5, 4, 2, 3)).astype(np.int16)
    nibabel.save(nibabel.Nifti1Image(samples, AFFINE), tmp_path / "in.nii")
    out = converted(tmp_path / "in.nii", ".nrrd", "--frame", "1", "--channel", "2")
    assert np.array_equal(load_volume(out).samples.numpy().T, samples[..., 1, 2])
    assert main(["convert", str(tmp_path / "in.nii"), str(out)]) == 1
    assert "a choice among its 2 frames" in capsys.readouterr().err
    batch = np.random.default_rng(0).random((2, 3, 4, 5, 6))
    np.save(tmp_path / "batch.npy", batch)
    assert np.array_equal(load_volume(converted(tmp_path / "batch.npy", ".npz")).samples.numpy(), batch)
    assert "2 × 3 volumes of 6 × 5 × 4 voxels" in capsys.readouterr().err
    converted(tmp_path / "batch.npy", ".nrrd", code=1)
    assert "npy or npz for samples (N, C, D, H, W)" in capsys.readouterr().err


def test_a_type_that_is_asked_for_holds_every_value_or_nothing_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """What was there stays as it was, whatever comes to light how late."""
    samples = np.zeros((200, 100, 100))
    np.save(tmp_path / "in.npy", samples)
    for ending, name in itertools.product(WRITTEN, ("uint8", "int64", "float32")):
        out = converted(tmp_path / "in.npy", ending, "--dtype", name)
        assert describe(out).stored == name
    before = {path.name: path.read_bytes() for path in tmp_path.iterdir() if path.stem.startswith("converted")}
    samples[-1, -1, -1] = 300.1
    np.save(tmp_path / "in.npy", samples)
    capsys.readouterr()
    for ending, name in itertools.product(WRITTEN, ("uint8", "int64", "float32")):
        converted(tmp_path / "in.npy", ending, "--dtype", name, code=1)
        assert f"expected samples that {name} holds exactly; got 300.1" in capsys.readouterr().err
    assert {name: (tmp_path / name).read_bytes() for name in before} == before
    assert sorted(os.listdir(tmp_path)) == sorted([*before, "in.npy"])


def test_mistakes_are_named_before_anything_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def never(*_: object, **__: object) -> None:
        pytest.fail("the voxels must not be read")

    monkeypatch.setattr("filterlab.io.volumes.load_volume", never)
    path = write_nrrd(tmp_path / "in.nrrd")
    (tmp_path / "link.nrrd").symlink_to(path)

    def refused(word: str, source: Path, out: str, *more: str) -> None:
        assert main(["convert", str(source), str(tmp_path / out), *more]) == 1
        printed = capsys.readouterr()
        assert (word in printed.err, printed.out, "Traceback" in printed.err) == (True, "", False), printed.err

    refused("no file of this name", tmp_path / "no.nrrd", "out.nii")
    refused("did you mean '.nrrd'", tmp_path / "in.nrd", "out.nii")
    refused("a name that ends in .nrrd", path, "out.tif")
    refused("existing folder", path, "no/out.nii")
    refused("other than the input", path, "in.nrrd")
    refused("other than the input", path, "link.nrrd")
    refused("for NIfTI-2; got npz", path, "out.npz", "--nifti2")
    refused("did you mean 'uint8'", path, "out.npz", "--dtype", "uint9")
    refused("--max-gigabytes", path, "out.npz", "--max-gigabytes", "0")
    path.write_bytes(b"NRRD0005\nnonsense\n")
    refused("every header line to be `field: value`", path, "out.nii")
    assert sorted(os.listdir(tmp_path)) == ["in.nrrd", "link.nrrd"]


PEAK = """
import json, sys
import nibabel, torch, filterlab.io.nifti, filterlab.io.volumes
from filterlab.cli import main
from tests import resident
for line in json.loads(sys.argv[1]):
    before = resident.begin()
    assert main(line) == 0
    print("peak", resident.highest() - before, file=sys.stderr)
"""


def extra_memory(lines: list[list[str]]) -> list[int]:
    """Bytes by which the most memory grows while each of the commands runs."""
    command = [sys.executable, "-c", PEAK, json.dumps(lines)]
    root = Path(__file__).parents[1]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=root, env=resident.ENVIRONMENT)
    return [int(line.split()[1]) for line in done.stderr.splitlines() if line.startswith("peak")]


@pytest.mark.skipif(not resident.CAN_BE_TOLD, reason="the system does not tell the peak of a part")
def test_converting_and_looking_take_the_memory_of_one_volume(tmp_path: Path) -> None:
    """Of one as it is held: uint16, which torch lacks, is held in 4 bytes, and 2 more while it is read."""
    count, volumes, lines = 200, {"uint8": 1.0, "float32": 1.0, "uint16": 3.0}, []
    for dtype in volumes:
        large = np.random.default_rng(0).integers(0, 100, (count, count, count)).astype(dtype)
        np.save(tmp_path / f"{dtype}.npy", large)
        np.save(tmp_path / f"small-{dtype}.npy", large[:2, :2, :2])
        for name in (f"small-{dtype}", dtype):
            lines += [
                ["convert", str(tmp_path / f"{name}.npy"), str(tmp_path / "out.nii")],
                ["info", str(tmp_path / f"{name}.npy")],
            ]
    taken = iter(extra_memory(lines))
    for dtype, most in volumes.items():
        small, large = (list(itertools.islice(taken, 2)) for _ in range(2))
        for command, before, peak in zip(("convert", "info"), small, large, strict=True):
            voxels = count**3 * np.dtype(dtype).itemsize
            assert peak - before <= most * voxels + 8 * 2**20, f"{command} of {dtype}: {peak / voxels:.2f} volumes"
            assert peak > 0.5 * voxels  # it is really measured
