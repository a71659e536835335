"""What SimpleITK and the codecs of TIFF read: the same values, places and channels; or the extra that reads them."""

from __future__ import annotations

import locale
import sys
from pathlib import Path

import nibabel
import nrrd
import numpy as np
import pytest
import SimpleITK as sitk  # noqa: N813
import tifffile

from filterlab.io import VolumeFileError, describe, load_volume, save_volume
from filterlab.io.itk import SUFFIXES
from filterlab.io.volumes import files_of
from filterlab.world import LPS
from tests.io.test_declared import SERIES, check_parts

SAMPLES = np.random.default_rng(0).integers(-1000, 3000, (4, 5, 6)).astype(np.int16)
TURN = (0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0)
SPACING, ORIGIN = (0.5, 0.25, 2.0), (1.0, 2.0, 3.0)
TO_RAS = np.diag([-1.0, -1.0, 1.0, 1.0])


def image_of(samples: np.ndarray, vector: bool = False, direction: tuple = TURN) -> sitk.Image:
    image = sitk.GetImageFromArray(samples, isVector=vector)
    image.SetSpacing(SPACING)
    image.SetOrigin(ORIGIN)
    image.SetDirection(direction)
    return image


def affine_of(image: sitk.Image) -> np.ndarray:
    """Voxel -> world as ITK has it."""
    affine = np.eye(4)
    affine[:3, :3] = np.array(image.GetDirection()).reshape(3, 3) * image.GetSpacing()
    affine[:3, 3] = image.GetOrigin()
    return affine


@pytest.mark.parametrize(
    "ending", [".mha", ".mhd", ".img", ".hdr", ".img.gz", ".gipl", ".gipl.gz", ".vtk", ".mnc", ".mrc"]
)
def test_values_and_places_are_itk_s(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"a{ending}"
    sitk.WriteImage(image_of(SAMPLES), str(path))
    found = sitk.ReadImage(str(path))
    anatomical = ending in (".mha", ".mhd", ".img", ".hdr", ".img.gz", ".mnc")
    volume = load_volume(path)
    assert np.array_equal(volume.samples.numpy(), sitk.GetArrayFromImage(found))
    assert np.allclose(volume.affine, (TO_RAS if anatomical else np.eye(4)) @ affine_of(found), atol=1e-12)
    assert volume.world.space == (LPS if anatomical else None)
    assert describe(path).affine.tolist() == volume.affine.tolist()
    assert path.resolve() in files_of(path)


def test_the_locale_stays_as_it_is(tmp_path: Path) -> None:
    """ITK reads VTK files in the locale "C"; left so, Python would open files as ASCII from then on."""
    before = locale.setlocale(locale.LC_ALL)
    sitk.WriteImage(image_of(SAMPLES), str(tmp_path / "a.vtk"))
    locale.setlocale(locale.LC_ALL, before)
    load_volume(tmp_path / "a.vtk")
    assert locale.setlocale(locale.LC_ALL) == before


@pytest.mark.parametrize(
    "dtype", ["uint8", "int8", "uint16", "int16", "uint32", "int32", "uint64", "int64", "float32", "float64"]
)
def test_every_type_of_metaimage(tmp_path: Path, dtype: str) -> None:
    samples = np.arange(24).reshape(2, 3, 4).astype(dtype)
    samples[0, 0, 0] = min(np.iinfo(dtype).max, 2**63 - 1) if dtype[0] != "f" else 0.1
    sitk.WriteImage(image_of(samples), str(tmp_path / "a.mha"))
    assert describe(tmp_path / "a.mha").stored == dtype
    assert load_volume(tmp_path / "a.mha").samples.tolist() == samples.tolist()


def test_itk_agrees_on_where_our_files_lie(tmp_path: Path) -> None:
    """MetaImage in; NRRD and NIfTI out: ITK finds every voxel where it was."""
    image = image_of(SAMPLES)
    sitk.WriteImage(image, str(tmp_path / "a.mha"))
    for name in ("b.nrrd", "b.nii"):
        save_volume(load_volume(tmp_path / "a.mha"), tmp_path / name)
        found = sitk.ReadImage(str(tmp_path / name))
        assert np.allclose(affine_of(found), affine_of(image), atol=1e-6)
        assert np.array_equal(sitk.GetArrayFromImage(found), SAMPLES)
    assert nrrd.read_header(str(tmp_path / "b.nrrd"))["space"] == "left-posterior-superior"


def test_nrrd_and_nifti_of_itk_lie_where_itk_says(tmp_path: Path) -> None:
    image = image_of(SAMPLES)
    for name in ("a.nrrd", "a.nii", "a.nhdr"):
        sitk.WriteImage(image, str(tmp_path / name))
        volume = load_volume(tmp_path / name)
        assert np.allclose(volume.affine, TO_RAS @ affine_of(image), atol=1e-6)
        assert np.array_equal(volume.samples.numpy(), SAMPLES)


def test_vectors_and_series_are_chosen_from(tmp_path: Path) -> None:
    vectors = np.ascontiguousarray(SERIES[0].transpose(1, 2, 3, 0))
    sitk.WriteImage(image_of(vectors, vector=True), str(tmp_path / "a.mha"))
    check_parts(tmp_path / "a.mha", SERIES[:1], SPACING)
    series = sitk.JoinSeries([image_of(frame) for frame in SERIES[:, 0]])
    sitk.WriteImage(series, str(tmp_path / "b.mha"))
    check_parts(tmp_path / "b.mha", SERIES[:, :1], SPACING)


def write_dicom(folder: Path, samples: np.ndarray, places: np.ndarray, uid: str = "1.2.3") -> None:
    """One file per slice, named in an order that is not theirs in space."""
    folder.mkdir(exist_ok=True)
    writer = sitk.ImageFileWriter()
    writer.KeepOriginalImageUIDOn()
    for z, place in enumerate(places):
        image = sitk.GetImageFromArray(samples[z : z + 1])
        image.SetSpacing(SPACING)
        tags = {"0008|0060": "CT", "0020|000e": uid, "0020|000d": "1.2", "0020|0013": str(z)}
        tags |= {
            "0020|0032": f"1\\2\\{place}",
            "0020|0037": "0\\1\\0\\-1\\0\\0",
            "0028|1052": "-1024",
            "0028|1053": "1",
        }
        tags |= {"0008|0018": f"{uid}.{z}", "0018|0050": "2"}
        for tag, value in tags.items():
            image.SetMetaData(tag, value)
        writer.SetFileName(str(folder / f"{uid}-{9 - z}.dcm"))
        writer.Execute(image)


def test_dicom_series(tmp_path: Path) -> None:
    folder = tmp_path / "series"
    write_dicom(folder, SAMPLES, 3 + 2.0 * np.arange(4))
    names = sitk.ImageSeriesReader.GetGDCMSeriesFileNames(str(folder))
    expected = sitk.ReadImage(names)
    volume = load_volume(folder)
    assert np.array_equal(volume.samples.numpy(), sitk.GetArrayFromImage(expected))
    assert np.array_equal(volume.samples.numpy(), SAMPLES)
    assert np.allclose(volume.affine, TO_RAS @ affine_of(expected), atol=1e-9)
    assert volume.spacing == pytest.approx(SPACING)
    assert len(files_of(folder)) == 4
    with pytest.raises(VolumeFileError, match="give the folder of its series"):
        load_volume(Path(names[0]))
    with pytest.raises(VolumeFileError, match="at most 239 bytes"):
        load_volume(folder, max_bytes=239)
    write_dicom(folder, SAMPLES, 3 + 2.0 * np.arange(4), uid="1.2.4")
    with pytest.raises(VolumeFileError, match="a folder of one DICOM series; got 2 of them"):
        describe(folder)


def test_slices_that_are_missing_are_told(tmp_path: Path) -> None:
    write_dicom(tmp_path / "series", SAMPLES, np.array([3.0, 5.0, 9.0, 11.0]))
    with pytest.raises(VolumeFileError, match="slices at even distances along a line; got distances from 2 to 4"):
        describe(tmp_path / "series")


@pytest.mark.parametrize("encoding", ["ascii", "txt", "hex"])
def test_nrrd_of_text(tmp_path: Path, encoding: str) -> None:
    samples, path = np.arange(24, dtype=np.uint8).reshape(2, 3, 4), tmp_path / "a.nrrd"
    data = samples.tobytes().hex() if encoding == "hex" else " ".join(map(str, samples.ravel()))
    header = f"NRRD0004\ntype: uint8\ndimension: 3\nsizes: 4 3 2\nspacings: 1 2 3\nencoding: {encoding}\n\n{data}\n"
    path.write_text(header)
    volume = load_volume(path)
    assert np.array_equal(volume.samples.numpy(), samples)
    assert (volume.spacing, volume.world.space) == ((1, 2, 3), None)
    path.write_text(header[:-20])
    with pytest.raises(VolumeFileError, match="samples that ITK reads"):
        load_volume(path)


def test_headers_that_lie_to_itk(tmp_path: Path) -> None:
    path = tmp_path / "a.mhd"
    text = "ObjectType = Image\nNDims = 3\nDimSize = 4 3 2\nElementType = MET_UCHAR\nElementDataFile = {}\n"
    (tmp_path / "a.raw").write_bytes(bytes(24))
    for name, words in (
        ("/etc/passwd", "same folder or below"),
        ("../a.raw", "same folder"),
        ("LIST", "one data file"),
    ):
        path.write_text(text.format(name))
        with pytest.raises(VolumeFileError, match=words):
            load_volume(path)
    path.write_text(text.format("a.raw").replace("4 3 2", "40000 30000 20000"))
    with pytest.raises(VolumeFileError, match="at most 8589934592 bytes"):
        load_volume(path)
    path.write_text(text.format("a.raw"))
    assert load_volume(path).size == (4, 3, 2)
    assert [p.name for p in files_of(path)] == ["a.mhd", "a.raw"]
    path.write_text(text.format("a.raw").replace("4 3 2", "4 3 3"))
    with pytest.raises(VolumeFileError, match="samples that ITK reads"):
        load_volume(path)
    (tmp_path / "b.mha").write_bytes(b"no header")
    with pytest.raises(VolumeFileError, match="ElementDataFile"):
        load_volume(tmp_path / "b.mha")
    (tmp_path / "b.gipl").write_bytes(b"no header")
    with pytest.raises(VolumeFileError, match="gipl data that ITK reads"):
        load_volume(tmp_path / "b.gipl")


@pytest.mark.parametrize("ending", SUFFIXES)
def test_without_simpleitk_the_error_names_the_extra(tmp_path: Path, monkeypatch, ending: str) -> None:
    path = tmp_path / f"a{ending}"
    path.write_bytes(b"x")
    monkeypatch.setitem(sys.modules, "SimpleITK", None)
    with pytest.raises(
        VolumeFileError, match=r"SimpleITK, which reads \w+ \(pip install 'filterlab\[itk\]'\)"
    ) as caught:
        load_volume(path)
    assert "did you mean" not in str(caught.value)
    (tmp_path / "a.nrrd").write_text("NRRD0004\ntype: uint8\ndimension: 3\nsizes: 1 1 2\nencoding: ascii\n\n1 2\n")
    with pytest.raises(VolumeFileError, match=r"SimpleITK, which reads NRRD data of encoding ascii.*filterlab\[itk\]"):
        load_volume(tmp_path / "a.nrrd")


# --- compressed TIFF --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "options",
    [
        {"compression": "lzw"},
        {"compression": "lzw", "predictor": 2, "rowsperstrip": 5},
        {"compression": "packbits"},
        {"compression": "zstd", "tile": (16, 16)},
        {"compression": "lzma"},
        {"compression": "jpeg2000"},
        {"compression": "zstd", "photometric": "rgb"},
        {"compression": "lzw", "photometric": "rgb", "planarconfig": "separate"},
    ],
)
def test_compressed_tiff_is_what_tifffile_reads(tmp_path: Path, options: dict) -> None:
    rgb = options.get("photometric") == "rgb"
    planar = options.get("planarconfig") == "separate"
    shape = (3, 3, 21, 18) if planar else (3, 21, 18, 3) if rgb else (3, 21, 18)
    samples, path = np.random.default_rng(0).integers(0, 60_000, shape).astype(np.uint16), tmp_path / "a.tif"
    tifffile.imwrite(path, samples, **({"photometric": "minisblack"} | options))
    assert np.array_equal(tifffile.imread(path), samples)
    expected = samples.transpose(1, 0, 2, 3) if planar else samples.transpose(3, 0, 1, 2) if rgb else samples[None]
    check_parts(path, expected[None])


def test_damaged_and_unknown_compression(tmp_path: Path, monkeypatch) -> None:
    path = tmp_path / "a.tif"
    tifffile.imwrite(
        path, np.arange(3 * 20 * 30, dtype=np.uint16).reshape(3, 20, 30), compression="zstd", photometric="minisblack"
    )
    with tifffile.TiffFile(path) as file:
        at = file.pages[1].dataoffsets[0]
    whole = path.read_bytes()
    path.write_bytes(whole[:at] + bytes(16) + whole[at + 16 :])
    with pytest.raises(VolumeFileError, match="intact Zstandard data"):
        load_volume(path)
    path.write_bytes(whole)
    monkeypatch.setattr("filterlab.io.tiff_pages.importlib.util.find_spec", lambda name: None)
    assert describe(path).encoding == "Zstandard"
    with pytest.raises(
        VolumeFileError, match=r"imagecodecs, which reads Zstandard data \(pip install 'filterlab\[tiff\]'\)"
    ):
        load_volume(path)


def test_analyze_of_nibabel(tmp_path: Path) -> None:
    """Values as nibabel has them; the place as ITK has it, which reads more of the header."""
    nibabel.save(nibabel.Nifti1Pair(SAMPLES.T, np.diag([0.5, 0.25, 2, 1])), tmp_path / "a.img")
    volume = load_volume(tmp_path / "a.img")
    assert np.array_equal(volume.samples.numpy(), SAMPLES)
    assert np.allclose(volume.affine, nibabel.load(tmp_path / "a.img").affine, atol=1e-6)
    assert [p.name for p in files_of(tmp_path / "a.img")] == ["a.hdr", "a.img"]
