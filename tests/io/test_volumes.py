"""Valid volume files, written by pynrrd, nibabel, tifffile and NumPy, and round trips through our own writers."""

from __future__ import annotations

import os
import struct
import sys
import tracemalloc
from pathlib import Path

import nibabel
import nrrd
import numpy as np
import pytest
import tifffile
import torch
from PIL import Image

from filterlab.io import FORMATS, VolumeFileError, describe, load_volume, save_volume
from filterlab.io.bounded import Choice
from filterlab.io.tiff import natural_key
from filterlab.io.volumes import files_of
from filterlab.volume import Volume
from tests.io.writers import (
    AFFINE,
    ENDINGS,
    SAMPLES,
    write_any,
    write_nifti,
    write_npy,
    write_npz,
    write_nrrd,
    write_raw,
    write_tiff,
)

WIDER = {"uint16": torch.int32, "uint32": torch.int64, "uint64": torch.int64, "bool": torch.uint8}
TYPES = ("uint8", "int8", "int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64")
LPS = np.diag([-1.0, -1.0, 1.0, 1.0])
WRITTEN = [ending for known in FORMATS.values() for ending in known.written]


def check(path: Path, expected: np.ndarray, affine: np.ndarray | None = None) -> Volume:
    """The file holds these samples and this affine; its header says so without reading the voxels."""
    volume, header = load_volume(path), describe(path)
    dtype = WIDER.get(expected.dtype.name) or getattr(torch, expected.dtype.name)
    assert (volume.dtype, volume.shape) == (dtype, expected.shape)
    assert (volume.samples.numpy() == expected).all()
    assert volume.samples.is_contiguous()
    volume.samples += 1  # writable
    assert (header.shape, header.dtype, header.size) == (tuple(expected.shape), dtype, expected.shape[:-4:-1])
    assert header.stored == expected.dtype.name
    assert (header.affine == volume.affine).all()
    if affine is not None:
        assert (volume.affine == affine).all()
    return volume


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize("dtype", TYPES)
def test_types_and_byte_orders(tmp_path: Path, ending: str, order: str, dtype: str) -> None:
    samples = SAMPLES.astype(np.dtype(dtype).newbyteorder(order))
    samples.flat[0] = min(np.iinfo(dtype).max, 2**63 - 1) if samples.dtype.kind in "iu" else 0.1
    check(write_any(tmp_path, ending, samples), samples.astype(dtype))


@pytest.mark.parametrize("write", [write_npy, write_npz])
def test_numpy_half_and_bool(tmp_path: Path, write) -> None:
    for dtype in (np.float16, bool):
        path = tmp_path / f"{np.dtype(dtype).name}{'.npy' if write is write_npy else '.npz'}"
        check(write(path, SAMPLES.astype(dtype)), SAMPLES.astype(dtype))


# --- NRRD -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("encoding", ["raw", "gzip", "gz", "bzip2", "bz2"])
@pytest.mark.parametrize("ending", [".nrrd", ".nhdr"])
def test_nrrd_encodings(tmp_path: Path, encoding: str, ending: str) -> None:
    samples = SAMPLES.astype(np.int16)
    volume = check(write_nrrd(tmp_path / f"a{ending}", samples, encoding), samples, AFFINE)
    assert volume.spacing == (0.25, 0.5, 2.0)


@pytest.mark.parametrize(
    ("space", "to_ras"),
    [
        ("right-anterior-superior", np.eye(4)),
        ("RAS", np.eye(4)),
        ("left-posterior-superior", LPS),
        ("LPS", LPS),
        ("left-anterior-superior", np.diag([-1.0, 1.0, 1.0, 1.0])),
        ("scanner-xyz", np.eye(4)),
        ("3D-left-handed", np.eye(4)),
    ],
)
def test_nrrd_anatomical_spaces_become_ras(tmp_path: Path, space: str, to_ras: np.ndarray) -> None:
    path = write_nrrd(tmp_path / "a.nrrd", SAMPLES.astype(np.uint8), space=space)
    check(path, SAMPLES.astype(np.uint8), to_ras @ AFFINE)
    assert describe(path).world.axes == (space if space in ("scanner-xyz", "3D-left-handed") else "RAS")


def nrrd_text(path: Path, header: str, data: bytes = bytes(24)) -> Path:
    path.write_bytes(f"NRRD0004\n{header}\n\n".encode() + data)
    return path


MINIMAL = "type: unsigned char\ndimension: 3\nsizes: 4 3 2\nencoding: raw"


@pytest.mark.parametrize(
    ("fields", "spacing", "origin"),
    [
        ("", (1, 1, 1), (0, 0, 0)),
        ("spacings: 1 .5 2e0", (1, 0.5, 2), (0, 0, 0)),
        ("spacings: 1 .5 2\naxis mins: 10 20 nan", (1, 0.5, 2), (10.5, 20.25, 0)),
        ("spacings: 1 .5 2\naxismins: 10 20 30\ncenters: node cell node", (1, 0.5, 2), (10, 20.25, 30)),
        ("axis mins: 0 0 0\naxis maxs: 4 6 4\ncenterings: cell cell node", (1, 2, 4), (0.5, 1, 0)),
        ("spacings: 1 2 3\nspace dimension: 3\nspace origin: ( 4 , 5 , 6 )", (1, 2, 3), (4, 5, 6)),
    ],
)
def test_nrrd_per_axis_geometry(tmp_path: Path, fields: str, spacing: tuple, origin: tuple) -> None:
    header = MINIMAL + ("\n" + fields if fields else "")
    volume = load_volume(nrrd_text(tmp_path / "a.nrrd", header))
    assert (volume.spacing, volume.origin, volume.size) == (spacing, origin, (4, 3, 2))


def test_nrrd_skips_comments_key_values_and_bytes(tmp_path: Path) -> None:
    data = bytes(range(24))
    header = MINIMAL + "\n# a comment\nDICOM_0010:=x: y\nbyte skip: {}\ncontent: a thing"
    for skip, stored in ((3, b"abc" + data), (-1, b"any length" + data)):
        volume = load_volume(nrrd_text(tmp_path / "a.nrrd", header.format(skip), stored))
        assert volume.samples.flatten().tolist() == list(data)
    assert describe(tmp_path / "a.nrrd").fields["content"] == "a thing"


def test_nrrd_detached_below_and_crlf(tmp_path: Path) -> None:
    (tmp_path / "sub").mkdir()
    (tmp_path / "sub" / "d.raw").write_bytes(bytes(range(24)))
    (tmp_path / "a.nhdr").write_bytes((f"NRRD0004\n{MINIMAL}\ndatafile: sub/d.raw\n").replace("\n", "\r\n").encode())
    assert load_volume(tmp_path / "a.nhdr").samples.flatten().tolist() == list(range(24))


def test_nrrd_axes_of_one_entry_are_dropped(tmp_path: Path) -> None:
    header = MINIMAL.replace("dimension: 3", "dimension: 4").replace("sizes: 4 3 2", "sizes: 1 4 3 2")
    header += "\nspace: LPS\nspace directions: none (1,0,0) (0,1,0) (0,0,3)"
    volume = load_volume(nrrd_text(tmp_path / "a.nrrd", header))
    assert (volume.size, volume.spacing) == ((4, 3, 2), (1, 1, 3))


# --- NIfTI ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz", "a2.nii", "a2.nii.gz"])
def test_nifti_affine(tmp_path: Path, name: str) -> None:
    samples = SAMPLES.astype(np.int16)
    check(write_nifti(tmp_path / name, samples), samples, AFFINE)


@pytest.mark.parametrize(
    ("dtype", "wide"), [("uint8", torch.float32), ("int16", torch.float32), ("int32", torch.float64)]
)
def test_nifti_scaling_is_applied(tmp_path: Path, dtype: str, wide: torch.dtype) -> None:
    path = write_nifti(tmp_path / "a.nii.gz", SAMPLES.astype(dtype), slope=0.3, inter=-5.0)
    volume, other = load_volume(path), nibabel.load(path)
    assert volume.dtype == wide
    assert describe(path).dtype == wide
    assert float(volume.samples[1, 2, 3]) == pytest.approx(0.3 * SAMPLES[1, 2, 3] - 5, abs=1e-5)
    np.testing.assert_allclose(volume.samples.numpy(), other.get_fdata().T, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("slope", [0.0, float("nan"), 1.0])
def test_nifti_slopes_that_mean_none(tmp_path: Path, slope: float) -> None:
    inter = 0.0 if slope == 1 else 5.0  # the intercept counts only with a slope
    samples = SAMPLES.astype(np.int16)
    check(write_nifti(tmp_path / "a.nii", samples, slope=slope, inter=inter), samples, AFFINE)


def test_nifti_qform_and_bare_voxel_sizes(tmp_path: Path) -> None:
    rotated = np.array([[0.0, 2.0, 0.0, 1.0], [-1.0, 0.0, 0.0, 2.0], [0.0, 0.0, 3.0, 3.0], [0.0, 0.0, 0.0, 1.0]])
    image = nibabel.Nifti1Image(SAMPLES.T.astype(np.uint8), None)
    image.header.set_zooms((1, 2, 3))
    nibabel.save(image, tmp_path / "bare.nii")
    image.set_qform(rotated, code=1)
    nibabel.save(image, tmp_path / "qform.nii")
    for name in ("bare.nii", "qform.nii"):
        assert np.array_equal(load_volume(tmp_path / name).affine, nibabel.load(tmp_path / name).affine)
    np.testing.assert_allclose(load_volume(tmp_path / "qform.nii").affine, rotated, atol=1e-6)


def test_nifti_trailing_axes_of_one_entry_and_extensions(tmp_path: Path) -> None:
    image = nibabel.Nifti1Image(SAMPLES.T.astype(np.uint8)[..., None, None], AFFINE)
    image.header.extensions.append(nibabel.nifti1.Nifti1Extension("comment", b"a" * 100))
    nibabel.save(image, tmp_path / "a.nii.gz")
    check(tmp_path / "a.nii.gz", SAMPLES.astype(np.uint8), AFFINE)


@pytest.mark.parametrize("name", ["a.nii", "a.nii.gz", "a2.nii"])
@pytest.mark.parametrize("scaling", [None, 0.5])
def test_nifti_frames_of_a_time_series(tmp_path: Path, name: str, scaling: float | None) -> None:
    series = np.stack([SAMPLES + 100 * t for t in range(3)]).astype(np.int16)
    path = write_nifti(tmp_path / name, series, slope=scaling if name != "a2.nii" else None)
    other = nibabel.load(path)
    assert other.shape == (4, 3, 2, 3)
    for t in range(3):
        volume = load_volume(path, frame=t)
        assert np.array_equal(volume.samples.numpy(), other.get_fdata()[..., t].T)
        assert np.array_equal(volume.affine, other.affine)
        header = describe(path, frame=t)
        assert (header.shape, header.dtype) == (volume.shape, volume.dtype)
        assert header.choice == Choice(frames=3, frame=t)


def test_frames_that_cannot_be_chosen(tmp_path: Path) -> None:
    series = write_nifti(tmp_path / "series.nii", np.stack([SAMPLES] * 3).astype(np.uint8))
    single = write_nifti(tmp_path / "single.nii", SAMPLES[None].astype(np.uint8))
    plain = write_nifti(tmp_path / "plain.nii", SAMPLES.astype(np.uint8))
    other = write_nrrd(tmp_path / "a.nrrd", SAMPLES.astype(np.uint8))
    with pytest.raises(VolumeFileError, match=r"series\.nii: .*its 3 frames, frame=0 to frame=2.*; got none"):
        load_volume(series)
    assert describe(series).choice == Choice(frames=3)
    for read in (load_volume, describe):
        for frame in (3, -1, 1.0, True):
            with pytest.raises(VolumeFileError, match=rf"a frame from 0 to 2; got frame {frame}"):
                read(series, frame=frame)
        for path in (single, plain, other):
            with pytest.raises(VolumeFileError, match="a frame from 0 to 0; got frame 1"):
                read(path, frame=1)
            with pytest.raises(VolumeFileError, match="a channel from 0 to 0; got channel 1"):
                read(path, channel=1)
    for path in (single, plain, other):
        assert torch.equal(load_volume(path).samples, load_volume(path, frame=0, channel=0).samples)


def test_every_file_that_a_volume_comes_from_is_named(tmp_path: Path) -> None:
    def names(path: Path) -> list[str]:
        return [str(p.relative_to(tmp_path.resolve())) for p in files_of(path)]

    samples = SAMPLES.astype(np.uint8)
    assert names(write_nrrd(tmp_path / "a.nrrd", samples)) == ["a.nrrd"]
    assert names(write_nrrd(tmp_path / "b.nhdr", samples, encoding="raw")) == ["b.nhdr", "b.raw"]
    write_raw(tmp_path / "c.raw", samples)
    assert names(tmp_path / "c.raw") == names(tmp_path / "c.raw.yaml") == ["c.raw.yaml", "c.raw"]
    save_volume(Volume(torch.zeros(2, 3, 4), spacing=2.0), tmp_path / "d.npy")
    assert names(tmp_path / "d.npy") == ["d.npy", "d.npy.yaml"]
    save_volume(Volume(torch.zeros(2, 3, 4)), tmp_path / "d.npy")
    assert names(tmp_path / "d.npy") == ["d.npy"]
    (tmp_path / "stack").mkdir()
    for z in (10, 9):
        tifffile.imwrite(tmp_path / "stack" / f"slice{z}.tif", samples[0])
    assert names(tmp_path / "stack") == ["stack/slice9.tif", "stack/slice10.tif"]
    (tmp_path / "link.nrrd").symlink_to(tmp_path / "a.nrrd")
    assert names(tmp_path / "link.nrrd") == ["a.nrrd"]


def test_without_nibabel_the_error_names_the_extra(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write_nifti(tmp_path / "a.nii", SAMPLES.astype(np.uint8))
    monkeypatch.setitem(sys.modules, "nibabel", None)
    for action in (lambda: load_volume(path), lambda: save_volume(Volume(torch.zeros(1, 1, 1)), path)):
        with pytest.raises(VolumeFileError, match=r"filterlab\[medical\]"):
            action()


# --- TIFF -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        {},
        {"bigtiff": True},
        {"byteorder": ">"},
        {"compression": "zlib"},
        {"compression": "zlib", "predictor": 2},
        {"rowsperstrip": 2},
        {"rowsperstrip": 2, "compression": "zlib"},
        {"tile": (16, 16)},
        {"tile": (16, 16), "compression": "zlib"},
        {"tile": (16, 16), "compression": "zlib", "predictor": 2, "byteorder": ">", "bigtiff": True},
        {"tile": (32, 64)},
        {"rowsperstrip": 1, "bigtiff": True},
        {"ome": True, "metadata": {"axes": "ZYX"}},
        {"metadata": None, "description": "x" * 10**5},
        {"imagej": True, "metadata": {"axes": "ZYX"}},
        {"imagej": True, "metadata": {"axes": "ZYX"}, "byteorder": ">"},
        {"shaped": True, "contiguous": True},
    ],
)
def test_tiff_layouts(tmp_path: Path, options: dict) -> None:
    samples = np.random.default_rng(0).integers(0, 60_000, (3, 21, 18)).astype(np.uint16)
    check(write_tiff(tmp_path / "a.tiff", samples, **options), samples, np.eye(4))


@pytest.mark.parametrize("predictor", [1, 2, 3])
def test_tiff_predictors_of_floats(tmp_path: Path, predictor: int) -> None:
    """libtiff writes them (through Pillow); tifffile alone does not read predictor 3."""
    samples = np.random.default_rng(0).normal(size=(3, 21, 18)).astype(np.float32)
    first, *others = (Image.fromarray(plane) for plane in samples)
    options = {"compression": "tiff_adobe_deflate", "tiffinfo": {317: predictor}}
    first.save(tmp_path / "a.tif", save_all=True, append_images=others, **options)
    check(tmp_path / "a.tif", samples, np.eye(4))


@pytest.mark.parametrize("dtype", ["u1", "<u2", ">u2", "<i4", ">i4", "<f2", ">f4", "<f8", ">f8"])
@pytest.mark.parametrize("options", [{}, {"compression": "zlib"}, {"compression": "zlib", "predictor": 2}])
def test_tiff_pages_equal_what_tifffile_reads(tmp_path: Path, dtype: str, options: dict) -> None:
    samples = np.random.default_rng(0).integers(0, 256, (2, 40, 30)).astype(dtype)
    if samples.dtype.kind == "f" and "predictor" in options:
        return  # tifffile differences floats as numbers, everyone else as integers
    path = write_tiff(tmp_path / "a.tif", samples, byteorder=">" if dtype[0] == ">" else "<", rowsperstrip=7, **options)
    assert (tifffile.imread(path) == samples).all()
    check(path, samples.astype(samples.dtype.newbyteorder("=")))


def test_tiff_of_one_page_with_planes_behind_it(tmp_path: Path) -> None:
    """ImageJ writes stacks beyond 4 GB like that."""
    samples = np.random.default_rng(0).integers(0, 60_000, (5, 6, 7)).astype(np.uint16)
    path = tmp_path / "a.tif"
    description = "ImageJ=1.53t\nimages=5\nslices=5\nunit=um\nspacing=2.5\nloop=false\n"
    options = {"description": description, "metadata": None, "resolution": (4.0, 2.0), "rowsperstrip": 4}
    tifffile.imwrite(path, samples[0], byteorder=">", photometric="minisblack", **options)
    with tifffile.TiffFile(path) as tif:
        end = tif.pages[0].dataoffsets[-1] + tif.pages[0].databytecounts[-1]
    assert end == path.stat().st_size  # the strips are what the file ends with
    with path.open("ab") as file:
        file.write(samples[1:].astype(">u2").tobytes())
    assert check(path, samples).spacing == (0.25, 0.5, 2.5)
    path.write_bytes(path.read_bytes()[:-1])
    with pytest.raises(VolumeFileError, match="expected 5 pages, as ImageJ says; got 1"):
        load_volume(path)


def test_tiff_without_lengths_of_strips(tmp_path: Path) -> None:
    """Old writers leave them out of uncompressed files of one strip."""
    samples = SAMPLES.astype(np.uint8)
    for z in range(2):
        path = write_tiff(tmp_path / f"a{z}.tif", samples[z])
        data = path.read_bytes()
        assert data.count(struct.pack("<H", 279)) == 1
        path.write_bytes(data.replace(struct.pack("<H", 279), struct.pack("<H", 65001)))
    check(tmp_path, samples)


def test_tiff_imagej_voxel_sizes(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(
        path,
        SAMPLES.astype(np.uint8),
        imagej=True,
        resolution=(4.0, 2.0),
        metadata={"axes": "ZYX", "spacing": 1.5, "unit": "um"},
    )
    assert check(path, SAMPLES.astype(np.uint8)).spacing == (0.25, 0.5, 1.5)


def test_tiff_folder_in_natural_order(tmp_path: Path) -> None:
    samples = np.arange(12 * 3 * 4).reshape(12, 3, 4).astype(np.int16)
    (tmp_path / "notes.txt").write_text("not a slice")
    for z in range(12):
        tifffile.imwrite(tmp_path / f"slice{z}.tif", samples[z])
    check(tmp_path, samples)
    assert [p.name for p in sorted(map(Path, ("b1", "a10", "a9", "A2b")), key=natural_key)] == [
        "A2b",
        "a9",
        "a10",
        "b1",
    ]


# --- NumPy and raw ----------------------------------------------------------------------------------------------------


def test_npy_fortran_order(tmp_path: Path) -> None:
    samples = np.asfortranarray(SAMPLES.astype(">f4"))
    check(write_npy(tmp_path / "a.npy", samples), SAMPLES.astype(np.float32), np.eye(4))
    check(write_npz(tmp_path / "a.npz", samples), SAMPLES.astype(np.float32), np.eye(4))


def test_npz_geometry_and_names(tmp_path: Path) -> None:
    samples = SAMPLES.astype(np.float32)
    check(write_npz(tmp_path / "a.npz", samples, affine=np.asfortranarray(AFFINE)), samples, AFFINE)
    volume = check(
        write_npz(tmp_path / "b.npz", samples, spacing=np.array([1, 2, 3]), origin=np.array([4.0, 5, 6])), samples
    )
    assert (volume.spacing, volume.origin) == ((1, 2, 3), (4, 5, 6))
    np.savez(tmp_path / "c.npz", anything=samples, spacing=np.array([1.0, 2, 3]))
    assert check(tmp_path / "c.npz", samples).spacing == (1, 2, 3)
    np.savez(tmp_path / "d.npz", samples=samples, other=np.zeros(3))
    check(tmp_path / "d.npz", samples, np.eye(4))


@pytest.mark.parametrize("ending", [".npy", ".npz"])
def test_numpy_batches(tmp_path: Path, ending: str) -> None:
    volume = Volume(torch.arange(2 * 3 * 4 * 5 * 6).reshape(2, 3, 4, 5, 6), affine=AFFINE)
    save_volume(volume, tmp_path / f"a{ending}")
    found = load_volume(tmp_path / f"a{ending}")
    assert torch.equal(found.samples, volume.samples)
    assert np.array_equal(found.affine, AFFINE)


def test_npy_sidecar_comes_and_goes(tmp_path: Path) -> None:
    path = tmp_path / "a.npy"
    save_volume(Volume(torch.zeros(2, 3, 4), spacing=2.0), path)
    assert sorted(os.listdir(tmp_path)) == ["a.npy", "a.npy.yaml"]
    assert load_volume(path).spacing == (2, 2, 2)
    np.save(path, np.zeros((2, 3, 5)))  # someone replaces the samples only
    with pytest.raises(
        VolumeFileError, match=r"a\.npy\.yaml: expected size \[5, 3, 2\] as in a\.npy; got size \[4, 3, 2\]"
    ):
        load_volume(path)
    save_volume(Volume(torch.zeros(2, 3, 5)), path)
    assert os.listdir(tmp_path) == ["a.npy"]


def test_samples_of_npy_never_lie_beside_a_geometry_that_is_not_theirs(tmp_path: Path, monkeypatch) -> None:
    """Whenever a name comes or goes: a process that is killed there leaves one volume or the other, or none."""
    path, samples, watched = tmp_path / "a.npy", torch.arange(24.0).reshape(2, 3, 4), []
    volumes = [Volume(samples, spacing=(1, 2, 3)), Volume(samples.flip(0), spacing=(3, 2, 1)), Volume(samples.flip(1))]

    def is_whole() -> bool:
        try:
            found = load_volume(path)
        except FileNotFoundError:
            return True
        return any(torch.equal(found.samples, v.samples) and found.geometry == v.geometry for v in volumes)

    def watching(own):
        def watched_call(*arguments, **options):
            watched.append(is_whole())
            own(*arguments, **options)
            watched.append(is_whole())

        return watched_call

    for name in ("replace", "unlink"):
        monkeypatch.setattr(os, name, watching(getattr(os, name)))
    for i in (0, 1, 2, 0, 2, 1):
        save_volume(volumes[i], path)
        assert torch.equal(load_volume(path).samples, volumes[i].samples)
    assert len(watched) > 24
    assert all(watched)


def test_raw_sidecar(tmp_path: Path) -> None:
    samples = SAMPLES.astype(">u2")
    path = write_raw(tmp_path / "a.raw", samples, "spacing: [1, 2, 3]\norigin: [4, 5, 6]\n")
    volume = check(path, SAMPLES.astype(np.uint16))
    assert (volume.spacing, volume.origin) == ((1, 2, 3), (4, 5, 6))
    path.write_bytes(b"head" + samples.tobytes())
    sidecar = tmp_path / "other.raw.yaml"
    rows = ", ".join(str(row) for row in AFFINE.tolist())
    sidecar.write_text(f"file: a.raw\nsize: [4, 3, 2]\ndtype: uint16\nbyte_order: big\noffset: 4\naffine: [{rows}]\n")
    check(sidecar, SAMPLES.astype(np.uint16), AFFINE)


# --- round trips ------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("ending", WRITTEN)
@pytest.mark.parametrize(
    "dtype", [torch.uint8, torch.int8, torch.int16, torch.int32, torch.int64, torch.float32, torch.float64]
)
def test_round_trips_are_exact(tmp_path: Path, ending: str, dtype: torch.dtype, rng: np.random.Generator) -> None:
    affine = np.eye(4)
    affine[:3] = rng.normal(size=(3, 4)) * [0.1, 1.0, 10.0, 1e3]
    volume = Volume((200 * torch.rand(3, 4, 5, dtype=torch.float64) - 100).to(dtype), affine=affine)
    path = tmp_path / f"a{ending}"
    save_volume(volume, path, nifti2=".nii" in ending)  # NIfTI-1 has an affine of float32
    found = load_volume(path)
    assert found.dtype == dtype
    assert torch.equal(found.samples, volume.samples)
    assert np.array_equal(found.affine, affine)


@pytest.mark.parametrize("ending", WRITTEN)
@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16])
def test_half_floats_keep_their_values(tmp_path: Path, ending: str, dtype: torch.dtype) -> None:
    volume = Volume(torch.randn(2, 3, 4).to(dtype).requires_grad_())
    save_volume(volume, tmp_path / f"a{ending}")
    assert torch.equal(load_volume(tmp_path / f"a{ending}").samples.double(), volume.samples.detach().double())


def test_other_readers_agree_with_our_files(tmp_path: Path) -> None:
    volume = Volume(torch.randn(3, 4, 5).transpose(0, 2), affine=AFFINE)  # not contiguous
    save_volume(volume, tmp_path / "a.nrrd")
    data, header = nrrd.read(str(tmp_path / "a.nrrd"), index_order="C")
    assert (data == volume.samples.numpy()).all()
    assert "space" not in header
    assert (AFFINE[:3, :3] == header["space directions"].T).all()
    assert (header["space origin"] == AFFINE[:3, 3]).all()
    for name in ("a.nii", "a.nii.gz"):
        save_volume(volume, tmp_path / name)
        image = nibabel.load(tmp_path / name)
        assert type(image) is nibabel.Nifti1Image
        assert (volume.samples.numpy() == image.get_fdata().T).all()
        assert (image.affine == AFFINE).all()
        np.testing.assert_allclose(image.header.get_zooms(), volume.spacing)
    save_volume(volume, tmp_path / "a.npz")
    with np.load(tmp_path / "a.npz") as archive:
        assert (archive["affine"] == AFFINE).all()
        assert (archive["samples"] == volume.samples.numpy()).all()


@pytest.mark.parametrize("ending", [".nii", ".nii.gz"])
def test_nifti_1_with_the_nearest_float32_affine(tmp_path: Path, ending: str, rng: np.random.Generator) -> None:
    """What other tools open; nibabel finds every number of the affine rounded, and nothing else changed."""
    path = tmp_path / f"a{ending}"
    for _ in range(20):
        affine = np.eye(4)
        affine[:3] = rng.normal(size=(3, 4)) * [0.1, 1.0, 10.0, 1e3]
        volume = Volume(torch.randn(3, 4, 5), affine=affine)
        save_volume(volume, path)
        image = nibabel.load(path)
        assert type(image) is nibabel.Nifti1Image
        assert (image.affine == affine.astype(np.float32)).all()
        assert np.array_equal(image.get_fdata().T, volume.samples.numpy())
        assert (np.abs(image.affine - affine) <= 6e-8 * np.abs(affine)).all()
        assert (load_volume(path).affine == image.affine).all()
        save_volume(volume, path, nifti2=True)
        image = nibabel.load(path)
        assert type(image) is nibabel.Nifti2Image
        assert (image.affine == affine).all()
    turned = np.eye(4)
    turned[:2, :2] = [[6e-17, -0.1], [0.1, 1e-300]]  # a right angle, as cosines tell it
    save_volume(Volume(volume.samples, affine=turned), path)
    assert type(nibabel.load(path)) is nibabel.Nifti1Image


@pytest.mark.parametrize("beyond", [1e39, 1e-46, 1e-40])
def test_nifti_2_for_what_nifti_1_cannot_hold(tmp_path: Path, beyond: float) -> None:
    save_volume(Volume(torch.zeros(1, 1, 32767, dtype=torch.uint8)), tmp_path / "a.nii")
    assert type(nibabel.load(tmp_path / "a.nii")) is nibabel.Nifti1Image
    long = Volume(torch.arange(32768, dtype=torch.int32)[None, None])
    save_volume(long, tmp_path / "a.nii")
    image = nibabel.load(tmp_path / "a.nii")
    assert (type(image), image.shape) == (nibabel.Nifti2Image, (32768, 1, 1))
    assert torch.equal(load_volume(tmp_path / "a.nii").samples, long.samples)
    save_volume(Volume(torch.zeros(2, 2, 2), spacing=beyond), tmp_path / "b.nii")
    image = nibabel.load(tmp_path / "b.nii")
    assert type(image) is nibabel.Nifti2Image
    assert image.affine[0, 0] == beyond


def test_nifti_2_is_asked_of_nifti_only(tmp_path: Path) -> None:
    with pytest.raises(VolumeFileError, match=r"a\.nrrd: expected a name that ends in \.nii or \.nii\.gz for NIfTI-2"):
        save_volume(Volume(torch.zeros(1, 2, 2)), tmp_path / "a.nrrd", nifti2=True)
    assert os.listdir(tmp_path) == []


def test_nrrd_and_nifti_describe_the_same_place(tmp_path: Path) -> None:
    """An LPS NRRD and the NIfTI of the same scan put every voxel at the same world point."""
    samples = SAMPLES.astype(np.int16)
    from_nrrd = load_volume(write_nrrd(tmp_path / "a.nrrd", samples, space="left-posterior-superior"))
    save_volume(from_nrrd, tmp_path / "a.nii")
    assert (nibabel.load(tmp_path / "a.nii").affine == LPS @ AFFINE).all()
    save_volume(load_volume(tmp_path / "a.nii"), tmp_path / "b.nrrd")
    assert (load_volume(tmp_path / "b.nrrd").affine == from_nrrd.affine).all()


OTHER_FORMATS = (
    ".mgz .mgh .vti .vtu .hdf .h5 .czi .nd2 .lif .lsm .jpg .png .par .rec .zarr .vol .dat .stl .zip .map .fits"
)
TYPED_WRONG = {".nrd": ".nrrd", ".nifti": ".nii", ".tff": ".tiff", ".nhd": ".nhdr", ".dicom": ".dcm", ".np": ".npz"}


def test_only_what_is_typed_wrong_is_guessed_at(tmp_path: Path) -> None:
    """The ending of another format is no mistake in typing one of ours."""
    for ending in OTHER_FORMATS.split():
        with pytest.raises(VolumeFileError, match=rf"unknown ending '{ending}'; known endings: \.nrrd, "):
            describe(tmp_path / f"a{ending}")
    for ending, meant in TYPED_WRONG.items():
        with pytest.raises(VolumeFileError, match=rf"unknown ending '{ending}'; did you mean '{meant}'\?"):
            describe(tmp_path / f"a{ending}")
    with pytest.raises(FileNotFoundError, match="a volume file or a folder of slices; got nothing of this name"):
        describe(tmp_path / "slices")


# --- refusals of what is asked ----------------------------------------------------------------------------------------


def test_names_and_places(tmp_path: Path) -> None:
    volume = Volume(torch.zeros(2, 2, 2))
    with pytest.raises(VolumeFileError, match=r"unknown ending '\.nrd'; did you mean '\.nrrd'\?"):
        load_volume(tmp_path / "a.nrd")
    with pytest.raises(FileNotFoundError, match="no file"):
        load_volume(tmp_path / "a.nrrd")
    with pytest.raises(VolumeFileError, match=r"a name that ends in \.nrrd, \.nii"):
        save_volume(volume, tmp_path / "a.tif")
    with pytest.raises(FileNotFoundError, match="existing folder"):
        save_volume(volume, tmp_path / "b" / "a.nrrd")
    with pytest.raises(VolumeFileError, match=rf"{tmp_path}/a\.nrrd: expected npy or npz"):
        save_volume(Volume(torch.zeros(1, 2, 2, 2, 2)), tmp_path / "a.nrrd")
    with pytest.raises(VolumeFileError, match=rf"{tmp_path}/a\.nii: expected samples .* got float16 for Volume"):
        save_volume(volume, tmp_path / "a.nii", stored="float16")
    (tmp_path / "a.raw").write_bytes(b"1")
    with pytest.raises(VolumeFileError, match="no such file"):
        load_volume(tmp_path / "a.raw")
    os.mkfifo(tmp_path / "pipe.nrrd")
    with pytest.raises(VolumeFileError, match="pipe"):
        load_volume(tmp_path / "pipe.nrrd")
    assert sorted(os.listdir(tmp_path)) == ["a.raw", "pipe.nrrd"]


def test_max_bytes(tmp_path: Path) -> None:
    path = write_nrrd(tmp_path / "a.nrrd", SAMPLES.astype(np.uint16))  # int32 in memory
    assert load_volume(path, max_bytes=96).size == (4, 3, 2)
    with pytest.raises(VolumeFileError, match="at most 95 bytes"):
        load_volume(path, max_bytes=95)


# --- real scans -------------------------------------------------------------------------------------------------------


def scans() -> list[Path]:
    folder = os.environ.get("FILTERLAB_VOLUMES")
    return sorted(p for p in Path(folder).iterdir() if p.name.endswith((".nrrd", ".nii.gz"))) if folder else []


def test_real_scans_equal_what_other_readers_find() -> None:
    if not scans():
        pytest.skip("FILTERLAB_VOLUMES does not name a folder of scans")
    for path in scans():
        volume = load_volume(path)
        if path.name.endswith(".nrrd"):
            assert (nrrd.read(str(path), index_order="C")[0] == volume.samples.numpy()).all()
        else:
            image = nibabel.load(path)
            assert (volume.samples.numpy() == np.asarray(image.dataobj).T).all()
            assert (image.affine == volume.affine).all()


@pytest.mark.parametrize(
    ("ending", "dtype"),
    [
        *((ending, "uint16") for ending in (".npy", ".npz", ".nrrd", ".nrrd.gz", ".nii", ".nii.gz")),
        *((".npy", ">u2"), (".npz", ">u4"), (".nrrd", "uint32"), (".nrrd.gz", "uint32")),
    ],
)
def test_wider_integers_are_made_in_the_memory_that_they_take(tmp_path: Path, ending: str, dtype: str) -> None:
    """Not beside what was read, which took half as much again."""
    samples = (np.arange(6_000_000) // 50).reshape(200, 300, 100).astype(dtype)
    samples[-1, -1, -3:] = np.iinfo(dtype).max, 0, np.iinfo(dtype).max - 1
    path = tmp_path / ("a" + (ending.removesuffix(".gz") if "nrrd" in ending else ending))
    if ending == ".npy":
        np.save(path, samples)
    elif ending == ".npz":
        np.savez_compressed(path, samples=samples)
    elif "nrrd" in ending:
        write_nrrd(path, samples, encoding="gzip" if ending.endswith("gz") else "raw")
    else:
        nibabel.save(nibabel.Nifti1Image(samples.T, np.eye(4)), path)
    wide = 2 * samples.nbytes
    load_volume(path)  # imports are not counted
    tracemalloc.start()
    volume = load_volume(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert np.array_equal(volume.samples.numpy(), samples)
    assert volume.samples.nbytes == wide
    assert wide <= peak < 1.2 * wide  # 1.5 times as much before
