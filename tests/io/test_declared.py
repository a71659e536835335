"""What files declare of their numbers: axes, units, codes, frames and channels. It is kept, chosen from, or refused."""

from __future__ import annotations

import bz2
import gzip
import itertools
import json
import struct
from collections.abc import Callable
from pathlib import Path

import nibabel
import nrrd
import numpy as np
import pytest
import tifffile
import torch
from PIL import Image

from filterlab import resample
from filterlab.io import VolumeFileError, describe, load_volume, save_volume
from filterlab.io.warned import VolumeFileWarning
from filterlab.volume import Volume
from filterlab.world import SPACES, NiftiForms, World
from tests.io.writers import AFFINE, SAMPLES, write_nifti, write_npy, write_npz, write_nrrd

SERIES = np.random.default_rng(0).integers(0, 60_000, (2, 3, 4, 5, 6)).astype(np.uint16)  # frames, channels, D, H, W


def check_parts(path: Path, expected: np.ndarray, spacing: tuple = (1, 1, 1), unit: str | None = None) -> None:
    """Every frame and channel of the file is that of (T, C, D, H, W)."""
    frames, channels = expected.shape[:2]
    choice = describe(path).choice
    assert (choice.frames, choice.channels) == (frames, channels)
    for t, c in itertools.product(range(frames), range(channels)):
        part = {"frame": t if frames > 1 else None, "channel": c if channels > 1 else None}
        volume = load_volume(path, **part)
        assert np.array_equal(volume.samples.numpy(), expected[t, c])
        assert volume.samples.is_contiguous()
        assert (volume.spacing, volume.world.unit) == (pytest.approx(spacing), unit)
    for what, count in (("frame", frames), ("channel", channels)):
        if count > 1:
            with pytest.raises(VolumeFileError, match=f"a choice among its {count} {what}s"):
                load_volume(path, **({"frame": 0, "channel": 0} | {what: None}))
        with pytest.raises(VolumeFileError, match=f"a {what} from 0 to {count - 1}; got {what} {count}"):
            describe(path, **{what: count})


# --- TIFF -------------------------------------------------------------------------------------------------------------


def subset(axes: str) -> np.ndarray:
    """SERIES with only the axes of those letters, in their order."""
    index = tuple(slice(None) if letter in axes else 0 for letter in "TCZYX")
    kept = "".join(letter for letter in "TCZYX" if letter in axes)
    return SERIES[index].transpose([kept.index(letter) for letter in axes])


def as_series(samples: np.ndarray, axes: str) -> np.ndarray:
    """(T, C, D, H, W) of an array with those axes."""
    missing = [letter for letter in "TCZYX" if letter not in axes]
    samples = samples.reshape(*samples.shape, *(1 for _ in missing))
    return samples.transpose([(axes + "".join(missing)).index(letter) for letter in "TCZYX"])


@pytest.mark.parametrize("axes", ["CZYX", "TZYX", "TCZYX", "ZCYX", "TZCYX", "CTZYX"])
@pytest.mark.parametrize("kind", ["ome", "shaped", "old shaped"])
def test_tiff_tells_frames_and_channels_from_slices(tmp_path: Path, axes: str, kind: str) -> None:
    samples, path = subset(axes), tmp_path / "a.tif"
    if kind == "ome":
        size = {"PhysicalSizeX": 0.5, "PhysicalSizeY": 0.25, "PhysicalSizeZ": 2000.0, "PhysicalSizeZUnit": "nm"}
        tifffile.imwrite(path, samples, photometric="minisblack", ome=True, metadata={"axes": axes, **size})
        check_parts(path, as_series(samples, axes), (0.5, 0.25, 2.0), "um")
        return
    if kind == "shaped":
        tifffile.imwrite(path, samples, photometric="minisblack", metadata={"axes": axes})
        with tifffile.TiffFile(path) as file:
            assert file.series[0].axes == axes
        check_parts(path, as_series(samples, axes))
        return
    tifffile.imwrite(path, samples, photometric="minisblack", metadata=None, description=f"shape={samples.shape}")
    with pytest.raises(VolumeFileError, match=r"axes that tell frames \(T\), channels \(C\) and slices \(Z\) apart"):
        describe(path)


def test_tiff_by_imagej_has_frames_and_channels(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    for axes in ("TZCYX", "TZYX", "ZCYX"):
        samples = subset(axes)
        metadata = {"axes": axes, "spacing": 1.5, "unit": "um"}
        tifffile.imwrite(path, samples, imagej=True, resolution=(4.0, 2.0), metadata=metadata)
        check_parts(path, as_series(samples, axes), (0.25, 0.5, 1.5), "um")


@pytest.mark.parametrize("kind", ["ome", "imagej", "shaped", "plain"])
@pytest.mark.parametrize(
    "options",
    [
        {},
        {"compression": "zlib", "predictor": 2},
        {"tile": (16, 16)},
        {"tile": (16, 16), "compression": "zlib"},
        {"planarconfig": "separate"},
        {"planarconfig": "separate", "tile": (16, 16), "compression": "zlib", "predictor": 2},
        {"planarconfig": "separate", "rowsperstrip": 2},
    ],
)
def test_colours_are_channels(tmp_path: Path, kind: str, options: dict) -> None:
    if kind == "imagej" and options:
        return  # which ImageJ does not write
    colours, path = np.random.default_rng(1).integers(0, 256, (4, 20, 21, 3)).astype(np.uint8), tmp_path / "a.tif"
    planar = options.get("planarconfig") == "separate"
    stored = colours.transpose(0, 3, 1, 2) if planar else colours
    axes = "ZSYX" if planar else "ZYXS"
    kinds = {"ome": {"ome": True, "metadata": {"axes": axes}}, "shaped": {"metadata": {"axes": axes}}}
    kinds |= {"imagej": {"imagej": True, "metadata": {"axes": "ZYXS"}}, "plain": {"metadata": None}}
    tifffile.imwrite(path, stored, photometric="rgb", **options, **kinds[kind])
    assert np.array_equal(tifffile.imread(path).reshape(stored.shape), stored)
    check_parts(path, colours.transpose(3, 0, 1, 2)[None])


@pytest.mark.parametrize("planarconfig", ["contig", "separate"])
def test_floats_of_several_values_with_predictor_3(tmp_path: Path, planarconfig: str) -> None:
    """Bytes are differenced between pixels, not between the values of one."""
    samples, path = np.random.default_rng(0).normal(size=(2, 5, 6, 2)).astype("<f4"), tmp_path / "a.tif"
    planar = planarconfig == "separate"
    options = {"planarconfig": planarconfig, "compression": "zlib", "predictor": 3, "metadata": None}
    stored = np.moveaxis(samples, -1, 1) if planar else samples
    tifffile.imwrite(path, stored, photometric="minisblack", **options)
    assert np.array_equal(tifffile.imread(path), stored)
    check_parts(path, samples.transpose(3, 0, 1, 2)[None])


def written_ome(path: Path, change: Callable[[str], str], samples: np.ndarray, axes: str) -> Path:
    """An OME-TIFF whose description was changed."""
    tifffile.imwrite(path, samples, photometric="minisblack", ome=True, metadata={"axes": axes})
    with tifffile.TiffFile(path) as file:
        text = change(file.pages[0].description)
    tifffile.imwrite(path, samples, photometric="minisblack", metadata=None, description=text.encode())
    return path


def test_ome_places_planes_where_it_says(tmp_path: Path) -> None:
    """Pages in reverse, each with an element of its own."""
    samples = subset("CZYX")

    def reversed_pages(text: str) -> str:
        pages = itertools.product(range(3), range(4))
        entries = [f'<TiffData IFD="{11 - i}" FirstC="{c}" FirstZ="{z}"/>' for i, (c, z) in enumerate(pages)]
        return text.replace('<TiffData IFD="0" PlaneCount="12"/>', "".join(entries))

    path = written_ome(tmp_path / "a.tif", reversed_pages, samples, "CZYX")
    check_parts(path, samples.reshape(12, 5, 6)[::-1].reshape(1, *samples.shape))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda t: t.replace('SizeZ="4"', 'SizeZ="5"'), "all 15 planes of its OME description in this file; got 12"),
        (lambda t: t.replace('SizeX="6"', 'SizeX="7"'), r"pages of \(5, 6\), as OME says; got \(5, 7\)"),
        (lambda t: t.replace("</Image>", '</Image><Image><Pixels SizeX="6"/></Image>'), "one image .*; got 2"),
        (lambda t: t.replace('IFD="0"', 'IFD="1"'), "TiffData within its 12 pages; got 12 from page 1"),
        (
            lambda t: t.replace('PlaneCount="12"/>', 'PlaneCount="12"><UUID FileName="b.tif">u</UUID></TiffData>'),
            "an OME-TIFF of one file; got planes in 'b.tif'",
        ),
        (lambda t: t.replace("<OME ", "<!DOCTYPE OME [<!ENTITY a 'b'>]><OME "), "without a document type"),
        (lambda t: t.replace("</Pixels>", ""), "well-formed OME-XML"),
        (lambda t: t.replace("XYZCT", "XYZQT"), "a DimensionOrder such as XYZCT; got 'XYZQT'"),
        (lambda t: t.replace("<Pixels ", '<Pixels PhysicalSizeX="-1" '), "positive numbers as PhysicalSize"),
        (lambda t: t.replace("<Pixels ", "<ModuloAlongZ/><Pixels "), "axes of space, time and channels"),
        (
            lambda t: t.replace('PlaneCount="12"/>', 'PlaneCount="12"/>' + 12 * "<TiffData/>"),
            "more TiffData than its 12",
        ),
    ],
)
def test_ome_that_is_not_read_is_refused(tmp_path: Path, change: Callable[[str], str], words: str) -> None:
    path = written_ome(tmp_path / "a.tif", change, subset("CZYX"), "CZYX")
    with pytest.raises(VolumeFileError, match=words):
        describe(path)


@pytest.mark.parametrize("kind", [{"ome": True}, {}, {"imagej": True}])
@pytest.mark.parametrize("axes", ["TYX", "CYX"])
def test_frames_and_channels_of_images_are_no_slices(tmp_path: Path, kind: dict, axes: str) -> None:
    tifffile.imwrite(tmp_path / "a.tif", subset(axes), photometric="minisblack", metadata={"axes": axes}, **kind)
    with pytest.raises(VolumeFileError, match=r"a stack of two or more slices; got . frames of . channels of a 2-D"):
        describe(tmp_path / "a.tif")


def test_tiff_that_declares_little_is_slices(tmp_path: Path) -> None:
    samples, path = subset("ZYX"), tmp_path / "a.tif"
    tifffile.imwrite(path, samples, photometric="minisblack")
    check_parts(path, samples[None, None])
    with tifffile.TiffWriter(path) as writer:  # page by page
        for plane in samples:
            writer.write(plane, photometric="minisblack")
    check_parts(path, samples[None, None])
    tifffile.imwrite(path, samples[None], photometric="minisblack")  # axes of one entry say nothing
    check_parts(path, samples[None, None])
    with tifffile.TiffWriter(path) as writer:
        for _ in range(2):
            writer.write(samples, photometric="minisblack")
    with pytest.raises(VolumeFileError, match="the 4 pages of its shape"):
        describe(path)
    description = json.dumps({"shape": [5, 6], "axes": 3})
    tifffile.imwrite(path, samples, photometric="minisblack", metadata=None, description=description)
    with pytest.raises(VolumeFileError, match="a letter for each axis"):
        describe(path)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"extratags": [(33550, "d", 3, (2.0, 2.0, 0.0), True)]}, "geography is not read"),
        ({"extratags": [(274, "H", 1, 3, True)]}, "orientation 3 is not applied"),
        ({"description": "SI.LINE_FORMAT = 1", "metadata": None}, "taken as slices; ScanImage"),
        ({"description": "ImageJ=1\nimages=4\ncf=0\nc0=-32768.0\nc1=1.0", "metadata": None}, "calibration .* not appl"),
    ],
)
def test_what_is_passed_over_is_told(tmp_path: Path, options: dict, words: str) -> None:
    samples = subset("ZYX")
    tifffile.imwrite(tmp_path / "a.tif", samples, photometric="minisblack", **options)
    with pytest.warns(VolumeFileWarning, match=rf"a\.tif: .*{words}"):
        volume = load_volume(tmp_path / "a.tif")
    assert np.array_equal(volume.samples.numpy(), samples)


def test_pages_that_are_no_slices_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(path, subset("ZYX"), photometric="minisblack", extratags=[(34412, "B", 4, b"1234", True)])
    with pytest.raises(VolumeFileError, match="one by OME, ImageJ or tifffile; got one of LSM"):
        describe(path)
    tifffile.imwrite(path, subset("ZYX"), photometric="minisblack", subfiletype=1)
    with pytest.raises(VolumeFileError, match="pages in full resolution"):
        describe(path)
    first, *others = (Image.fromarray(plane.astype(np.uint8)) for plane in subset("ZYX"))
    first.save(path, save_all=True, append_images=others, tiffinfo={262: 0})
    assert describe(path).fields["photometric"] == "0 is white"


# --- NRRD -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("kinds", "axes"),
    [
        (["vector", "domain", "domain", "domain"], "XYZ"),
        (["domain", "domain", "domain", "list"], "XYZ"),
        (["domain", "domain", "domain", "time"], "XYZ"),
        (["RGB-color", "space", "space", "space", "time"], "XYZ"),
        (["domain", "vector", "domain", "domain"], "XYZ"),
        (["???", "domain", "domain", "domain"], "XYZ"),
    ],
)
@pytest.mark.parametrize("encoding", ["raw", "gzip"])
def test_nrrd_tells_time_and_components_from_space(tmp_path: Path, kinds: list, axes: str, encoding: str) -> None:
    samples = subset({"time": "T"}.get(kinds[-1], "C") + "ZYX" if len(kinds) == 4 else "TCZYX")
    letters = [
        {"time": "T", "domain": "D", "space": "D"}.get(kind, "C") for kind in kinds
    ]  # fastest first; D for x, y, z
    names = iter("XYZ")
    order = "".join(next(names) if letter == "D" else letter for letter in letters)[::-1]
    present = "".join(letter for letter in "TCZYX" if letter in order)
    stored = samples.transpose([present.index(letter) for letter in order])
    directions = np.array([AFFINE[:3, "XYZ".index(k)] if k in "XYZ" else [np.nan] * 3 for k in order[::-1]])
    header = {"kinds": kinds, "space": "LPS", "space directions": directions, "space origin": AFFINE[:3, 3]}
    path = tmp_path / "a.nrrd"
    nrrd.write(str(path), stored, {**header, "encoding": encoding}, index_order="C")
    assert np.array_equal(nrrd.read(str(path), index_order="C")[0], stored)
    expected = as_series(stored, order)
    check_parts(path, expected, (0.25, 0.5, 2))
    assert np.array_equal(describe(path).affine, np.diag([-1, -1, 1, 1]) @ AFFINE)


@pytest.mark.parametrize("space", [None, *SPACES])
def test_nrrd_is_written_in_the_space_that_was_declared(tmp_path: Path, space: str | None) -> None:
    samples = SAMPLES.astype(np.uint8)
    declared = {"space": space} if space else {}
    path = write_nrrd(tmp_path / "a.nrrd", samples, **declared, **{"space units": ["mm", "mm", "mm"]})
    volume = load_volume(path)
    assert volume.world == World(space, "mm")
    save_volume(volume, tmp_path / "b.nrrd")
    save_volume(resample(volume, shape=samples.shape), tmp_path / "c.nrrd")
    for name in ("b.nrrd", "c.nrrd"):
        header = nrrd.read_header(str(tmp_path / name))
        assert header.get("space") == space
        assert header.get("space dimension") == (None if space else 3)
        assert header["space units"] == ["mm", "mm", "mm"]
        assert np.allclose(header["space directions"], AFFINE[:3, :3].T, atol=1e-15)
        assert np.allclose(header["space origin"], AFFINE[:3, 3], atol=1e-14)
        assert np.allclose(load_volume(tmp_path / name).affine, volume.affine, atol=1e-14)


def test_nothing_is_declared_of_a_volume_without_a_file(tmp_path: Path) -> None:
    save_volume(Volume(torch.zeros(2, 3, 4)), tmp_path / "a.nrrd")
    header = nrrd.read_header(str(tmp_path / "a.nrrd"))
    assert "space" not in header
    assert "space units" not in header
    declared = World("left-posterior-superior", "um")
    save_volume(Volume(torch.zeros(2, 3, 4), origin=(1, 2, 3), world=declared), tmp_path / "a.nrrd")
    header = nrrd.read_header(str(tmp_path / "a.nrrd"))
    assert (header["space"], header["space units"]) == ("left-posterior-superior", ["um"] * 3)
    assert header["space origin"].tolist() == [-1, -2, 3]
    for wrong in ({"space": "outer"}, {"unit": "two words"}, {"unit": ""}):
        with pytest.raises(ValueError, match="expected a"):
            World(**wrong)


# --- NIfTI ------------------------------------------------------------------------------------------------------------

OBLIQUE = np.eye(4)
OBLIQUE[:3, :3] = np.linalg.qr(np.random.default_rng(5).normal(size=(3, 3)))[0] * [0.9, 1.1, 2.5]
OBLIQUE[:3, 3] = [-90.1, 120.7, -70.3]
if np.linalg.det(OBLIQUE) < 0:
    OBLIQUE[:3, 0] *= -1
ELSEWHERE = np.array([[0, -1, 0, 5.0], [1, 0, 0, 6], [0, 0, 1, 7], [0, 0, 0, 1]]) @ OBLIQUE


def nifti(path: Path, sform: int, qform: int, place: np.ndarray = OBLIQUE, kind=nibabel.Nifti1Image) -> Path:
    image = kind(SAMPLES.T.astype(np.int16), None)
    image.header.set_xyzt_units("micron", "msec")
    image.header.set_zooms((0.9, 1.1, 2.5))
    if qform:
        image.set_qform(place, qform)
    if sform:
        image.set_sform(OBLIQUE, sform)
    image.header["sform_code"], image.header["qform_code"] = sform, qform
    nibabel.save(image, path)
    return path


@pytest.mark.parametrize("kind", [nibabel.Nifti1Image, nibabel.Nifti2Image])
@pytest.mark.parametrize(("sform", "qform"), [(1, 1), (4, 1), (0, 1), (3, 0), (2, 0), (0, 0)])
@pytest.mark.parametrize("work", [lambda v: v, lambda v: resample(v, shape=(3, 5, 7))])
def test_nifti_keeps_version_codes_and_units(tmp_path: Path, kind: type, sform: int, qform: int, work) -> None:
    volume = load_volume(nifti(tmp_path / "a.nii", sform, qform, kind=kind))
    assert np.array_equal(volume.affine, nibabel.load(tmp_path / "a.nii").affine)
    done = work(volume)
    save_volume(done, tmp_path / "b.nii")
    image = nibabel.load(tmp_path / "b.nii")
    assert type(image) is kind
    assert (int(image.header["sform_code"]), int(image.header["qform_code"])) == (sform, qform)
    assert image.header.get_xyzt_units() == ("micron", "msec")
    assert np.allclose(image.affine, done.affine, atol=1e-4)
    assert np.allclose(load_volume(tmp_path / "b.nii").affine, done.affine, atol=1e-4)
    if qform:
        assert np.allclose(image.get_qform(), done.affine, atol=1e-4)


@pytest.mark.parametrize("kind", [nibabel.Nifti1Image, nibabel.Nifti2Image])
@pytest.mark.parametrize(("code", "kept"), [(3, True), (1001, True), (1002, True), (1007, False), (0, True)])
def test_nifti_keeps_description_and_intent(tmp_path: Path, kind: type, code: int, kept: bool) -> None:
    image = kind(np.arange(24, dtype=np.int16).reshape(4, 3, 2), OBLIQUE)
    image.header["intent_code"], image.header["intent_name"], image.header["intent_p1"] = code, b"of t", 7.5
    image.header["descrip"] = "Köpfe".encode("latin-1")
    nibabel.save(image, tmp_path / "a.nii")
    volume = load_volume(tmp_path / "a.nii")
    nearest, floating = resample(volume, "nearest", shape=(3, 5, 7)), volume.to(torch.float32)
    for work, whole in ((volume, True), (nearest, True), (floating, False)):
        save_volume(work, tmp_path / "b.nii.gz")
        found = nibabel.load(tmp_path / "b.nii.gz").header
        assert bytes(found["descrip"].tobytes()).rstrip(b"\0") == "Köpfe".encode("latin-1")
        told = (code, b"of t", 7.5) if kept and code and (whole or code != 1002) else (0, b"", 0.0)
        name = bytes(found["intent_name"].tobytes()).rstrip(b"\0")
        assert (int(found["intent_code"]), name, float(found["intent_p1"])) == told


def test_nifti_whose_forms_tell_different_places_keeps_both(tmp_path: Path) -> None:
    volume = load_volume(nifti(tmp_path / "a.nii", 4, 1, ELSEWHERE))
    assert np.allclose(volume.affine, OBLIQUE, atol=1e-5)
    fine = resample(volume, spacing=(0.5, 0.5, 0.5))
    save_volume(fine, tmp_path / "b.nii")
    image = nibabel.load(tmp_path / "b.nii")
    to_qform = ELSEWHERE @ np.linalg.inv(OBLIQUE)
    assert np.allclose(image.get_sform(), fine.affine, atol=1e-4)
    assert np.allclose(image.get_qform(), to_qform @ fine.affine, atol=1e-4)


def test_a_qform_that_cannot_hold_the_affine_gives_way_to_an_sform(tmp_path: Path) -> None:
    sheared = OBLIQUE.copy()
    sheared[:3, 1] += 0.3 * sheared[:3, 0]
    volume = load_volume(nifti(tmp_path / "a.nii", 0, 1))
    save_volume(Volume(volume.samples, affine=sheared, world=volume.world), tmp_path / "b.nii")
    image = nibabel.load(tmp_path / "b.nii")
    assert (int(image.header["sform_code"]), int(image.header["qform_code"])) == (1, 1)
    assert np.allclose(image.affine, sheared, atol=1e-5)


@pytest.mark.parametrize("qform", [0, 1])
def test_an_sform_of_zeros_is_none(tmp_path: Path, qform: int) -> None:
    path = nifti(tmp_path / "a.nii", 0, qform)
    expected = nibabel.load(path).affine
    data = bytearray(path.read_bytes())
    struct.pack_into("<h", data, 254, 2)  # the code; the rows are zeros
    path.write_bytes(data)
    assert not nibabel.load(path).header.get_sform()[:3].any()
    assert np.array_equal(load_volume(path).affine, expected)
    assert describe(path).fields["affine from"] == ("qform (the sform is zero)" if qform else "voxel sizes")


def test_a_damaged_qform_beside_an_sform_is_passed_over(tmp_path: Path) -> None:
    path = nifti(tmp_path / "a.nii", 1, 1)
    data = bytearray(path.read_bytes())
    struct.pack_into("<3f", data, 256, 3.0, 3.0, 3.0)  # no quaternion
    path.write_bytes(data)
    volume = load_volume(path)
    assert np.allclose(volume.affine, OBLIQUE, atol=1e-5)
    assert volume.world.nifti == NiftiForms(1, 1, 0, "msec")


def test_oblique_nifti_1_stays_nifti_1(tmp_path: Path) -> None:
    for seed in range(50):
        random = np.random.default_rng(seed)
        affine = np.eye(4)
        affine[:3, :3] = np.linalg.qr(random.normal(size=(3, 3)))[0] * random.uniform(0.2, 3, 3)
        affine[:3, 3] = random.normal(size=3) * 100
        nibabel.save(nibabel.Nifti1Image(SAMPLES.T.astype(np.int16), affine), tmp_path / "a.nii")
        save_volume(resample(load_volume(tmp_path / "a.nii"), shape=(3, 4, 5)), tmp_path / "b.nii")
        assert type(nibabel.load(tmp_path / "b.nii")) is nibabel.Nifti1Image


def test_nifti_vectors_and_colours(tmp_path: Path) -> None:
    data = SERIES.transpose(4, 3, 2, 0, 1).astype(np.int16)  # x, y, z, t, v
    nibabel.save(nibabel.Nifti1Image(data, np.eye(4)), tmp_path / "a.nii.gz")
    check_parts(tmp_path / "a.nii.gz", SERIES.astype(np.int16))
    rgb = np.random.default_rng(0).integers(0, 256, (6, 5, 4, 3)).astype(np.uint8)
    colour = np.dtype([("R", "u1"), ("G", "u1"), ("B", "u1")])
    nibabel.save(nibabel.Nifti1Image(rgb.view(colour)[..., 0], np.eye(4)), tmp_path / "rgb.nii")
    check_parts(tmp_path / "rgb.nii", rgb.transpose(3, 2, 1, 0)[None])


# --- NumPy ------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("write", [write_npy, write_npz])
@pytest.mark.parametrize("order", ["C", "F"])
def test_entries_and_channels_of_a_batch(tmp_path: Path, write, order: str) -> None:
    path = write(tmp_path / f"a{'.npy' if write is write_npy else '.npz'}", np.array(SERIES, order=order))
    assert np.array_equal(load_volume(path).samples.numpy(), SERIES)
    for t, c in itertools.product(range(2), range(3)):
        assert np.array_equal(load_volume(path, frame=t, channel=c).samples.numpy(), SERIES[t, c])
    assert np.array_equal(load_volume(path, frame=1).samples.numpy(), SERIES[1:2])
    assert np.array_equal(load_volume(path, channel=2).samples.numpy(), SERIES[:, 2:])
    one = write(tmp_path / path.name, np.array(SERIES[:1], order=order))
    assert np.array_equal(load_volume(one, channel=2).samples.numpy(), SERIES[0, 2])
    with pytest.raises(VolumeFileError, match="a frame from 0 to 0; got frame 1"):
        load_volume(one, frame=1)


# --- what lies behind the samples, and integers of 64 bits ------------------------------------------------------------


def appended(path: Path, more: bytes) -> Path:
    path.write_bytes(path.read_bytes() + more)
    return path


BYTES = SAMPLES.astype(np.uint8)


def nrrd_of(path: Path, encoding: str, data: bytes) -> Path:
    header = f"NRRD0004\ntype: uint8\ndimension: 3\nsizes: 4 3 2\nencoding: {encoding}\n\n"
    path.write_bytes(header.encode() + data)
    return path


@pytest.mark.parametrize(
    "written",
    [
        lambda p: nrrd_of(p / "a.nrrd", "raw", BYTES.tobytes() + b"more"),
        lambda p: nrrd_of(p / "a.nrrd", "gzip", gzip.compress(BYTES.tobytes() + b"more")),
        lambda p: nrrd_of(p / "a.nrrd", "gzip", 2 * gzip.compress(BYTES.tobytes())),
        lambda p: nrrd_of(p / "a.nrrd", "gzip", gzip.compress(BYTES.tobytes()) + b"junk"),
        lambda p: nrrd_of(p / "a.nrrd", "gzip", gzip.compress(BYTES.tobytes() + bytes(2**26))),  # it is not inflated
        lambda p: nrrd_of(p / "a.nrrd", "bzip2", bz2.compress(BYTES.tobytes() + b"more")),
        lambda p: appended(write_nifti(p / "a.nii", BYTES), b"more"),
        lambda p: appended(write_npy(p / "a.npy", BYTES), b"more"),
    ],
)
def test_what_lies_behind_the_samples_is_told(tmp_path: Path, written) -> None:
    path = written(tmp_path)
    with pytest.warns(VolumeFileWarning, match=r"passed over what comes behind its 24 bytes of samples"):
        volume = load_volume(path)
    assert np.array_equal(volume.samples.numpy(), BYTES)


def test_uint64_is_read_where_int64_holds_it(tmp_path: Path) -> None:
    samples = np.full((2, 3, 4), 2**63, np.uint64)
    save = {
        "a.nrrd": write_nrrd,
        "a.nii": write_nifti,
        "a.npy": write_npy,
        "a.npz": write_npz,
    }
    for name, write in save.items():
        path = write(tmp_path / name, samples)
        assert describe(path).stored == "uint64"
        with pytest.raises(VolumeFileError, match=rf"uint64 samples below 2⁶³, which int64 holds; got {2**63}"):
            load_volume(path)


@pytest.mark.parametrize("ending", [".nrrd", ".nii", ".npy", ".npz"])
@pytest.mark.parametrize("stored", ["uint8", "uint16", "uint32", "uint64", "int64", "float64"])
def test_samples_are_stored_in_the_type_that_is_asked_for(tmp_path: Path, ending: str, stored: str) -> None:
    path, largest = tmp_path / f"a{ending}", 2**63 - 1 if stored[:4] == "uint" else 2**53
    top = min(largest, np.iinfo(stored).max if stored[0] != "f" else largest)
    volume = Volume(torch.tensor([[[0, 1, top]]], dtype=torch.int64))
    save_volume(volume, path, stored=stored)
    assert describe(path).stored == stored
    assert load_volume(path).samples.tolist() == [[[0, 1, top]]]
    for wrong in (-1, 0.5) if stored[0] == "u" else (0.5,) if stored == "int64" else ():
        with pytest.raises(VolumeFileError, match=f"samples that {stored} holds exactly; got {wrong}"):
            save_volume(Volume(torch.tensor([[[0.0, wrong]]])), path, stored=stored)
    if stored[0] == "u":
        with pytest.raises(VolumeFileError, match=f"samples that {stored} holds exactly; got -1"):
            save_volume(Volume(torch.tensor([[[-1]]])), path, stored=stored)  # of int64
    with pytest.raises(VolumeFileError, match=f"samples that float64 holds exactly; got {2**63 - 1}"):
        save_volume(Volume(torch.tensor([[[2**60, 2**63 - 1]]])), path, stored="float64")
    with pytest.raises(VolumeFileError, match="samples that float32 holds exactly; got 16777217"):
        save_volume(Volume(torch.tensor([[[16777216, 2**60, 16777217]]])), path, stored="float32")
    assert load_volume(path).samples.tolist() == [[[0, 1, top]]]
