"""Files of heights: what tifffile, Pillow and NumPy write by the formats' own rules is read, and comes back."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import tifffile
from matplotlib.cbook import get_sample_data
from PIL import Image

import filterlab as fl
from filterlab.heights import Heights, metres_per_degree
from filterlab.io import VolumeFileError, describe_heights, load_heights, save_heights
from filterlab.io.heights import holds_heights
from filterlab.io.warned import VolumeFileWarning

UTM, DEGREES, FEET = 32718, 4326, 2263
SCALING = (
    '<GDALMetadata><Item name="SCALE" sample="0" role="scale">0.1</Item>'
    '<Item name="OFFSET" sample="0" role="offset">-500</Item></GDALMetadata>'
)


def geotiff(
    path: Path, array, *, tie=(0, 0, 0, 1000.0, 2000.0, 0), scale=(30.0, 20.0, 0), epsg=UTM, point=False, **more
):
    """A GeoTIFF of a tie point and a scale, written tag by tag (OGC 19-008r4, requirement class TIFF and GeoKeys)."""
    geographic = epsg == DEGREES
    keys = [(1024, 2 if geographic else 1), (1025, 2 if point else 1), (2048 if geographic else 3072, epsg)]
    directory = [1, 1, 0, len(keys), *(n for key, value in keys for n in (key, 0, 1, value))]
    tags = [(33550, "d", 3, scale, True), (33922, "d", 6, tie, True), (34735, "H", len(directory), directory, True)]
    if "nodata" in more:
        tags.append((42113, "s", 0, str(more.pop("nodata")), True))
    if "metadata" in more:
        tags.append((42112, "s", 0, more.pop("metadata"), True))
    tifffile.imwrite(path, array, extratags=tags, photometric="minisblack", metadata=None, **more)
    return path


def ramp(rows=4, columns=5, dtype="float32"):
    return (np.arange(rows * columns).reshape(rows, columns) * 3 + 100).astype(dtype)


# --- GeoTIFF ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("point", [False, True])
def test_samples_stand_where_geotiff_says(tmp_path, point):
    """RasterPixelIsArea ties the corner of a pixel, RasterPixelIsPoint its middle; rows go down."""
    found = load_heights(geotiff(tmp_path / "a.tif", ramp(), point=point))
    assert found.origin == ((1000, 2000) if point else (1015, 1990))
    assert found.spacing == (30, -20)
    assert (found.unit, found.crs, found.crs_name) == ("metre", "EPSG:32718", "WGS 84 / UTM zone 18S")
    assert found.extent[2] == found.origin[0] + 4 * 30
    assert found.extent[1] == found.origin[1] - 3 * 20
    assert np.array_equal(found.samples, ramp())
    assert describe_heights(tmp_path / "a.tif").fields["pixel is"] == ("point" if point else "area")


@pytest.mark.parametrize("dtype", ["uint8", "int16", "uint16", "int32", "float32", "float64"])
@pytest.mark.parametrize("compression", [None, "zlib", "lzw"])
def test_types_and_no_data(tmp_path, dtype, compression):
    array = ramp(40, 50, dtype) % 200
    array[3, 4] = array[7, 7] = 199
    found = load_heights(geotiff(tmp_path / "a.tif", array, nodata=199, compression=compression))
    assert found.samples.dtype == ("float64" if dtype in ("int32", "float64") else "float32")
    assert np.array_equal(found.missing, array == 199)
    assert np.array_equal(found.samples[~found.missing], array[array != 199])


def test_infinities_are_missing_too(tmp_path):
    array = ramp()
    array[0, 0], array[1, 1] = np.inf, np.nan
    assert load_heights(geotiff(tmp_path / "a.tif", array)).missing.sum() == 2


def test_scaling(tmp_path):
    array = ramp(dtype="int16")
    array[1, 2] = -32768
    path = geotiff(tmp_path / "a.tif", array, nodata=-32768, metadata=SCALING)
    found = load_heights(path)
    assert found.missing.sum() == 1
    assert np.allclose(found.samples[~found.missing], array[array != -32768] * 0.1 - 500, atol=1e-4)
    assert describe_heights(path).fields["scaling"] == "0.1 · number + -500"


def test_degrees_are_told_and_converted(tmp_path):
    path = geotiff(
        tmp_path / "a.tif", ramp(), epsg=DEGREES, tie=(0, 0, 0, 7.0, 46.0, 0), scale=(0.01, 0.01, 0), point=True
    )
    with pytest.warns(VolumeFileWarning, match=r"degrees.*in_metres\(\)"):
        found = load_heights(path)
    assert (found.unit, found.crs) == ("degree", "EPSG:4326")
    metres = found.in_metres()
    across, along = metres_per_degree(46 - 0.015)
    assert metres.spacing == pytest.approx((0.01 * across, -0.01 * along))
    assert metres.unit == "metre"
    assert metres.crs is None
    assert metres.in_metres().spacing == metres.spacing


def test_metres_per_degree():
    """As the series 111132.954 − 559.822 cos 2φ + 1.175 cos 4φ and 111412.84 cos φ − 93.5 cos 3φ + 0.118 cos 5φ."""
    assert metres_per_degree(0) == pytest.approx((111319.49, 110574.28), abs=0.01)
    assert metres_per_degree(45) == pytest.approx((78846.84, 111131.78), abs=0.01)
    assert metres_per_degree(90) == pytest.approx((0, 111693.98), abs=0.02)


def test_feet(tmp_path):
    found = load_heights(geotiff(tmp_path / "a.tif", ramp(), epsg=FEET))
    assert found.unit == "US survey foot"
    assert found.in_metres().spacing == pytest.approx((30 * 1200 / 3937, -20 * 1200 / 3937))
    assert replace(found, height_unit="foot").in_metres().samples[0, 0] == pytest.approx(100 * 0.3048)
    with pytest.raises(ValueError, match="among metre, kilometre"):
        replace(found, unit="cubit").in_metres()


def test_a_file_that_does_not_say_where_it_lies(tmp_path):
    tifffile.imwrite(tmp_path / "a.tif", ramp(), metadata=None)
    with pytest.warns(VolumeFileWarning, match="does not say where it lies"):
        found = load_heights(tmp_path / "a.tif")
    assert found.spacing == (1, -1)


def test_bands(tmp_path):
    path = geotiff(tmp_path / "a.tif", np.stack([ramp(), ramp() + 1]), planarconfig="separate")
    with pytest.raises(VolumeFileError, match="a choice among its 2 bands"):
        load_heights(path)
    assert load_heights(path, band=2).samples[0, 0] == 101
    with pytest.raises(VolumeFileError, match="a band from 1 to 2; got band 3"):
        load_heights(path, band=3)


def test_turned_rasters_are_refused(tmp_path):
    matrix = (30.0, 5.0, 0, 1000, 5.0, -30.0, 0, 2000, 0, 0, 0, 0, 0, 0, 0, 1)
    tifffile.imwrite(tmp_path / "a.tif", ramp(), metadata=None, extratags=[(34264, "d", 16, matrix, True)])
    with pytest.raises(VolumeFileError, match="rows and columns along x and y"):
        load_heights(tmp_path / "a.tif")


def test_hostile_tiffs(tmp_path):
    good = geotiff(tmp_path / "a.tif", ramp(300, 200), compression="zlib").read_bytes()
    bad = tmp_path / "b.tif"
    bad.write_bytes(good[: len(good) // 2])
    with pytest.raises(VolumeFileError):
        load_heights(bad)
    bad.write_bytes(b"II*\0 no map at all")
    with pytest.raises(VolumeFileError, match="an intact GTiff raster"):
        load_heights(bad)
    for side in (40_000, 60_000):  # 6.4 GB, which max_bytes would allow, and 14 GB
        raw = geotiff(tmp_path / "c.tif", ramp(300, 200)).read_bytes()
        for tag, size in ((256, 200), (257, 300)):
            for kind, form in ((3, "<HHIHH"), (4, "<HHII")):
                entry = struct.pack(form, tag, kind, 1, size, *([0] if kind == 3 else []))
                raw = raw.replace(entry, struct.pack("<HHII", tag, 4, 1, side))
        bad.write_bytes(raw)
        with pytest.raises(VolumeFileError, match="bytes of heights"):
            load_heights(bad)
    with pytest.raises(VolumeFileError, match=r"at most 100 bytes of heights \(max_bytes\); got 240000"):
        load_heights(tmp_path / "a.tif", max_bytes=100)
    with pytest.raises(FileNotFoundError, match="a file of heights"):
        load_heights(tmp_path / "none.tif")
    with pytest.raises(VolumeFileError, match=r"unknown ending '.tfi'; known endings: .tif"):
        load_heights(tmp_path / "a.tfi")


def test_other_rasters(tmp_path):
    (tmp_path / "a.asc").write_text(
        "ncols 3\nnrows 2\nxllcorner 10\nyllcorner 20\ncellsize 5\nNODATA_value -1\n1 2 3\n4 -1 6\n"
    )
    found = load_heights(tmp_path / "a.asc")
    assert (found.spacing, found.origin) == ((5, -5), (12.5, 27.5))
    assert np.array_equal(found.samples, [[1, 2, 3], [4, np.nan, 6]], equal_nan=True)
    tile = np.arange(1201 * 1201, dtype=np.int64).reshape(1201, 1201) % 4000
    tile.astype(">i2").tofile(
        tmp_path / "N46E007.hgt"
    )  # samples from corner to corner of a degree, the outer ones included
    with pytest.warns(VolumeFileWarning, match="degrees"):
        found = load_heights(tmp_path / "N46E007.hgt")
    assert np.allclose(found.extent, (7, 46, 8, 47))
    assert np.array_equal(found.samples, tile)


# --- round trips ------------------------------------------------------------------------------------------------------


@pytest.fixture
def rough():
    samples = np.random.default_rng(1).normal(1500, 300, (31, 270)).astype(np.float32)
    samples[4, 5:9] = np.nan
    told = {"unit": "metre", "height_unit": "metre", "crs": "EPSG:32718", "crs_name": "WGS 84 / UTM zone 18S"}
    return Heights(samples, (30.0, -20.5), (627190.0, 4852070.0), **told)


@pytest.mark.parametrize("ending", ["tif", "npy", "npz", "png"])
def test_round_trip(tmp_path, rough, ending):
    path = tmp_path / f"a.{ending}"
    save_heights(rough, path)
    found = load_heights(path)
    for name in ("spacing", "origin", "unit", "height_unit", "crs", "crs_name"):
        assert getattr(found, name) == getattr(rough, name)
    assert np.array_equal(found.missing, rough.missing)
    step = (np.nanmax(rough.samples) - np.nanmin(rough.samples)) / 65534
    off = np.nanmax(abs(found.samples.astype(float) - rough.samples))
    assert off <= (0.5 * step + 2e-4 if ending == "png" else 0)
    assert not [p for p in tmp_path.iterdir() if p.name.startswith(".tmp")]
    assert holds_heights(path)


@pytest.mark.parametrize("ending", ["tif", "npz"])
def test_float64_and_rows_from_the_south(tmp_path, rough, ending):
    other = replace(rough, samples=rough.samples.astype(np.float64) / 3).upward
    save_heights(other, tmp_path / f"a.{ending}")
    found = load_heights(tmp_path / f"a.{ending}")
    assert found.spacing == (30, 20.5)
    assert np.array_equal(found.samples, other.samples, equal_nan=True)


def test_upward_turns_the_rows(rough):
    assert np.array_equal(rough.upward.samples, rough.samples[::-1], equal_nan=True)
    assert rough.upward.origin == (rough.origin[0], rough.origin[1] - 30 * 20.5)
    assert rough.upward.extent == rough.extent


def test_what_others_read_of_a_geotiff(tmp_path, rough):
    save_heights(rough, tmp_path / "a.tif")
    with tifffile.TiffFile(tmp_path / "a.tif") as file:
        page = file.pages[0]
        assert page.tags[33922].value[3:5] == rough.origin
        assert page.tags[33550].value[:2] == (30.0, 20.5)
        assert page.geotiff_tags["GTRasterTypeGeoKey"] == 2
        assert page.geotiff_tags["ProjectedCSTypeGeoKey"] == 32718
        assert page.tags[42113].value == "nan"


def test_integers(tmp_path, rough):
    whole = replace(rough, samples=np.rint(rough.samples))
    for ending, stored in (("tif", "int16"), ("tif", "uint16"), ("png", None)):
        save_heights(whole, tmp_path / f"a.{ending}", stored=stored)
        assert np.array_equal(load_heights(tmp_path / f"a.{ending}").samples, whole.samples, equal_nan=True)
    assert describe_heights(tmp_path / "a.tif").stored == "uint16"
    with pytest.raises(VolumeFileError, match="samples that int16 holds exactly"):
        save_heights(rough, tmp_path / "b.tif", stored="int16")
    with pytest.raises(VolumeFileError, match="a type among float32"):
        save_heights(rough, tmp_path / "b.tif", stored="complex64")
    with pytest.raises(VolumeFileError, match=r"a name that ends in \.tif, \.tiff, \.npy, \.npz, \.png"):
        save_heights(rough, tmp_path / "b.asc")
    assert not (tmp_path / "b.tif").exists()


# --- npy, npz, PNG ----------------------------------------------------------------------------------------------------


def test_bare_arrays_and_pictures(tmp_path):
    np.save(tmp_path / "a.npy", ramp(dtype=">i2").T.copy().T)  # Fortran order, and swapped
    np.savez(tmp_path / "a.npz", elevation=ramp())
    Image.fromarray(ramp(dtype="uint16")).save(tmp_path / "a.png")
    for ending, spacing in (("npy", (1, 1)), ("npz", (1, 1)), ("png", (1, -1))):
        found = load_heights(tmp_path / f"a.{ending}")
        assert np.array_equal(found.samples, ramp())
        assert found.spacing == spacing


def test_refused_arrays_and_pictures(tmp_path):
    np.save(tmp_path / "a.npy", np.zeros((2, 3, 4)))
    np.savez(tmp_path / "a.npz", a=np.zeros((2, 3)), b=np.zeros((2, 3)))
    np.save(tmp_path / "c.npy", np.zeros((2, 3), complex))
    Image.fromarray(np.zeros((2, 3, 3), np.uint8)).save(tmp_path / "a.png")
    for name, match in (
        ("a.npy", r"an array \(H, W\) of heights"),
        ("a.npz", "an array named heights, or one array"),
        ("c.npy", "samples of a type among"),
        ("a.png", "grey levels of 16 bits"),
    ):
        with pytest.raises(VolumeFileError, match=match):
            load_heights(tmp_path / name)
    save_heights(Heights(ramp()), tmp_path / "d.npy")
    np.save(tmp_path / "d.npy", ramp(3, 3))
    with pytest.raises(VolumeFileError, match=r"size \[3, 3\] as in d.npy"):
        load_heights(tmp_path / "d.npy")
    good = (tmp_path / "d.npy").read_bytes()
    (tmp_path / "e.npy").write_bytes(good[:-4])
    with pytest.raises(VolumeFileError, match="36 bytes of samples"):
        load_heights(tmp_path / "e.npy")


def test_the_sample_in_matplotlib():
    """3 arc seconds of Tennessee, rows from the north; its edges are printed in the file, and nothing of a unit."""
    path = get_sample_data("jacksboro_fault_dem.npz", asfileobj=False)
    with pytest.warns(VolumeFileWarning, match="look like degrees"):
        found = fl.load_heights(path)
    assert found.samples.shape == (344, 403)
    assert found.spacing == pytest.approx((1 / 1200, -1 / 1200))
    assert found.extent == pytest.approx(
        (-84.41375 + 1 / 2400, 36.44625 + 1 / 2400, -84.07791667 - 1 / 2400, 36.73291667 - 1 / 2400)
    )
    metres = replace(found, unit="degree").in_metres()
    assert metres.spacing == pytest.approx((74.573, -92.475), abs=1e-3)


def test_what_holds_heights(tmp_path):
    np.save(tmp_path / "volume.npy", np.zeros((2, 3, 4)))
    np.savez(tmp_path / "volume.npz", samples=np.zeros((2, 3, 4)), affine=np.eye(4))
    tifffile.imwrite(tmp_path / "stack.tif", np.zeros((3, 8, 8), np.uint8), photometric="minisblack")
    tifffile.imwrite(tmp_path / "photo.tif", np.zeros((8, 8, 3), np.uint8), photometric="rgb")
    assert not any(holds_heights(p) for p in [*tmp_path.iterdir(), tmp_path, tmp_path / "none.tif"])
    assert holds_heights(geotiff(tmp_path / "map.tif", ramp()))


def test_heights_are_checked():
    for wrong in (np.zeros((2, 3, 4)), np.zeros((2, 3), int), [[1.0]], np.zeros((0, 3))):
        with pytest.raises(ValueError, match="samples must be a NumPy array"):
            Heights(wrong)
    with pytest.raises(ValueError, match="spacing must not be 0"):
        Heights(ramp(), (1, 0))
    with pytest.raises(ValueError, match="origin must be two finite numbers"):
        Heights(ramp(), origin=(0, float("nan")))


def test_info_tells_of_heights(tmp_path, capsys, rough):
    from filterlab.cli import main

    save_heights(rough, tmp_path / "dem.tif")
    assert main(["info", str(tmp_path / "dem.tif")]) == 0
    out = capsys.readouterr().out
    for told in (
        "270 × 31",
        "30 -20.5 (rows from the north)",
        "WGS 84 / UTM zone 18S (EPSG:32718)",
        "not finite",
        "4",
        "point",
    ):
        assert told in out
    geotiff(tmp_path / "two.tif", np.stack([ramp(), ramp() + 1]), planarconfig="separate")
    assert main(["info", str(tmp_path / "two.tif"), "--channel", "1", "--header-only"]) == 0
    assert "2; this is 2" in capsys.readouterr().out
    assert main(["info", str(tmp_path / "two.tif")]) == 1
    assert "a choice among its 2 bands" in capsys.readouterr().err
