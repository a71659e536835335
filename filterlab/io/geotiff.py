"""GeoTIFF files of heights, by rasterio (the extra `terrain`), which brings GDAL and PROJ in its wheel.

    affine of the raster ─▶ where samples stand: the middle of a pixel, whether the file says area or point
    coordinate reference system ─▶ metres, degrees or another unit
    no-data, mask bands, NaN ─▶ NaN        scale, offset of the band ─▶ heights

GDAL knows what writers of GeoTIFF have made of keys and compressions in thirty years; reading tags by tifffile would
leave codes of coordinate systems without names and units, LZW and LERC without a codec, and nothing to write them. Only
the drivers below are let in: others open files that the one at hand names.
"""

from __future__ import annotations

import importlib.util
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from filterlab.heights import DEGREE, METRE, METRES, Heights
from filterlab.io.bounded import VolumeFileError, check_exact, check_size
from filterlab.io.heights_header import HeightsHeader, band_of, blocks_of_rows, check_place, check_stored
from filterlab.io.warned import warn
from filterlab.io.watching import tell_done

if TYPE_CHECKING:
    from affine import Affine
    from rasterio import DatasetReader

DRIVERS = {".tif": "GTiff", ".tiff": "GTiff", ".asc": "AAIGrid", ".hgt": "SRTMHGT"}
"""Endings of what rasterio reads here, and GDAL's name of the driver."""

MAX_BLOCK = 2**28  # bytes of a strip or tile, which GDAL holds whole
_HEIGHT_UNITS = {"m": METRE, "meter": METRE, "metre": METRE, "meters": METRE, "metres": METRE} | {
    "ft": "foot",
    "feet": "foot",
    "foot": "foot",
    "us-ft": "US survey foot",
}
WRITTEN = ("float32", "float64", "int16", "uint16", "int32", "uint32", "uint8")


def require_rasterio(path: Path) -> None:
    """Raises VolumeFileError where it is not installed."""
    if importlib.util.find_spec("rasterio") is None:
        expected = "rasterio, which reads and writes maps (pip install 'filterlab[terrain]')"
        raise VolumeFileError(path, expected, "no such package")


@contextmanager
def _opened(path: Path) -> Iterator[DatasetReader]:
    """The file, by its own driver only; whatever GDAL makes of damage becomes VolumeFileError."""
    require_rasterio(path)
    import rasterio
    from rasterio.errors import NotGeoreferencedWarning, RasterioError

    driver = DRIVERS[path.suffix.lower()]
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", NotGeoreferencedWarning)
            with rasterio.Env(), rasterio.open(path.resolve(), driver=driver) as dataset:
                yield dataset
    except VolumeFileError:
        raise
    except (RasterioError, ValueError, OSError, MemoryError) as error:
        told = (str(error.__cause__ or error).splitlines() or [""])[0]
        got = f"{type(error).__name__}: {told}"[:200]
        raise VolumeFileError(path, f"an intact {driver} raster", got) from None


def read_header(path: Path, band: int | None = None) -> HeightsHeader:
    """The checked header. Raises VolumeFileError."""
    with _opened(path) as dataset:
        number = _band(path, dataset.count, band)
        rows, columns = check_size(path, (dataset.height, dataset.width))
        stored = check_stored(path, np.dtype(dataset.dtypes[number - 1]))
        high, wide = dataset.block_shapes[number - 1]
        if high * wide * stored.itemsize > MAX_BLOCK:
            raise VolumeFileError(path, f"strips or tiles of at most {MAX_BLOCK} bytes", f"{wide} × {high}")
        place = _place(path, dataset.transform)
        scaling = dataset.scales[number - 1], dataset.offsets[number - 1]
        compression = dataset.compression
        _check_length(path, dataset, stored)
        return HeightsHeader(
            path,
            "GeoTIFF" if dataset.driver == "GTiff" else dataset.driver,
            (rows, columns),
            stored.name,
            *place,
            *_units(dataset, number),
            *_reference(dataset),
            compression.value.lower() if compression else "raw",
            _fields(dataset, number),
            lambda samples: _read(path, number, high, scaling, samples),
        )


def _band(path: Path, count: int, band: int | None) -> int:
    """The number of the band, from 1 as GDAL counts. Raises VolumeFileError."""
    if band is None and count > 1:
        raise VolumeFileError(path, f"a choice among its {count} bands, band=1 to band={count}", "none")
    if band is not None and (isinstance(band, bool) or not isinstance(band, int) or not 1 <= band <= count):
        raise VolumeFileError(path, f"a band from 1 to {count}", f"band {band!r}")
    return band or 1


def _check_length(path: Path, dataset: DatasetReader, stored: np.dtype) -> None:
    """Raises VolumeFileError where samples that are not compressed cannot be in a file so short."""
    claimed = dataset.height * dataset.width * stored.itemsize
    there = path.stat().st_size
    if dataset.driver == "GTiff" and dataset.compression is None and claimed > there:
        raise VolumeFileError(path, f"{claimed} bytes of heights, uncompressed", f"a file of {there} bytes")


def _place(path: Path, transform: Affine) -> tuple[tuple[float, float], tuple[float, float]]:
    """Spacing, and where the first sample stands: the middle of its pixel. GDAL's affine starts at pixels' corners."""
    if transform.b or transform.d:
        got = f"{transform.a:g}, {transform.b:g}; {transform.d:g}, {transform.e:g}"
        raise VolumeFileError(path, "rows and columns along x and y (gdalwarp turns rasters that do not)", got)
    spacing = (transform.a, transform.e)
    if transform.is_identity:  # of a file that says nothing: rows go down in it as in those that do
        warn(path, "it does not say where it lies: samples are taken to be 1 apart")
        return (1.0, -1.0), (0.0, 0.0)
    origin = (transform.c + transform.a / 2, transform.f + transform.e / 2)
    check_place(path, spacing, origin)
    return spacing, origin


def _units(dataset: DatasetReader, number: int) -> tuple[str | None, str | None]:
    """Of x and y, and of heights."""
    declared = (dataset.units[number - 1] or "").strip()
    upward = _HEIGHT_UNITS.get(declared.lower(), declared or None)
    crs = dataset.crs
    if not crs:
        return None, upward
    if crs.is_geographic:
        return DEGREE, upward
    name, factor = crs.units_factor
    return _length(name, factor), upward


def _length(name: str, factor: float) -> str:
    """The name of a unit so many metres long."""
    return next((known for known, metres in METRES.items() if abs(metres - factor) < 1e-9 * metres), name)


def _reference(dataset: DatasetReader) -> tuple[str | None, str | None]:
    """The coordinate reference system: a code or WKT, and its name."""
    crs = dataset.crs
    if not crs:
        return None, None
    wkt = crs.to_wkt()
    return crs.to_string(), wkt.partition('"')[2].partition('"')[0] or None


def _fields(dataset: DatasetReader, number: int) -> dict[str, str]:
    """What else there is to tell of a band."""
    nodata, scale, offset = (x[number - 1] for x in (dataset.nodatavals, dataset.scales, dataset.offsets))
    fields = {"pixel is": dataset.tags().get("AREA_OR_POINT", "Area").lower()}
    if dataset.count > 1:
        fields["bands"] = f"{dataset.count}; this is {number}"
    if nodata is not None:
        fields["no data"] = f"{nodata:g}"
    if (scale, offset) != (1.0, 0.0):
        fields["scaling"] = f"{scale:g} · number + {offset:g}"
    return fields


def _read(path: Path, number: int, high: int, scaling: tuple[float, float], samples: np.ndarray) -> None:
    """All heights, some rows of strips or tiles at a time."""
    from rasterio.enums import MaskFlags
    from rasterio.windows import Window

    with _opened(path) as dataset:
        whole = MaskFlags.all_valid in dataset.mask_flag_enums[number - 1]
        for rows in blocks_of_rows(samples.shape, high):  # type: ignore[arg-type]
            window = Window(0, rows.start, dataset.width, rows.stop - rows.start)  # type: ignore[call-arg]
            stored = dataset.read(number, window=window)
            missing = None if whole else dataset.read_masks(number, window=window) == 0
            band_of(samples, rows, stored, missing, scaling)
            tell_done(rows.stop / len(samples))


# --- writing ----------------------------------------------------------------------------------------------------------


def write(heights: Heights, path: Path, stored: str | None, _final: Path | None = None) -> None:
    """Deflated, in tiles of 256² (strips, where it is smaller), samples in the middle of pixels ("point")."""
    require_rasterio(path)
    import rasterio
    from affine import Affine
    from rasterio.crs import CRS
    from rasterio.windows import Window

    dtype = np.dtype(stored or heights.samples.dtype.name)
    samples, nodata = _stored(path, heights, dtype)
    (dx, dy), (x, y) = heights.spacing, heights.origin
    tiles: dict[str, Any] = {"tiled": True, "blockxsize": 256, "blockysize": 256} if min(heights.size) > 256 else {}
    profile: dict[str, Any] = {
        "driver": "GTiff",
        "dtype": dtype.name,
        "width": heights.size[0],
        "height": heights.size[1],
        "count": 1,
        "crs": None if heights.crs is None else CRS.from_user_input(heights.crs),
        "transform": Affine(dx, 0, x - dx / 2, 0, dy, y - dy / 2),
        "nodata": nodata,
        "compress": "deflate",
        "predictor": 3 if dtype.kind == "f" else 2,
        "BIGTIFF": "IF_SAFER",
    }
    with rasterio.Env(), rasterio.open(path, "w", **profile, **tiles) as dataset:
        dataset.update_tags(AREA_OR_POINT="Point")
        if heights.height_unit:
            dataset.units = (heights.height_unit,)
        for rows in blocks_of_rows(samples.shape, 256):
            window = Window(0, rows.start, dataset.width, rows.stop - rows.start)  # type: ignore[call-arg]
            dataset.write(samples[rows], 1, window=window)
            tell_done(rows.stop / len(samples))


def _stored(path: Path, heights: Heights, dtype: np.dtype) -> tuple[np.ndarray, float | None]:
    """Samples in the type of the file, and the number for none. Raises VolumeFileError where it does not hold them."""
    samples, missing = heights.samples, heights.missing
    some = bool(missing.any())
    if dtype.name not in WRITTEN:
        raise VolumeFileError(path, f"a type among {', '.join(WRITTEN)}", dtype.name)
    if dtype == samples.dtype:
        return samples, float("nan") if some else None
    check_exact(path, samples[~missing], dtype)
    if dtype.kind == "f":
        return samples.astype(dtype), float("nan") if some else None
    nodata = np.iinfo(dtype).max if dtype.kind == "u" else np.iinfo(dtype).min
    if not some:
        return samples.astype(dtype), None
    if (samples == nodata).any():
        raise VolumeFileError(path, f"{nodata} free to stand for no data in {dtype.name}", "a height of that number")
    return np.where(missing, nodata, samples).astype(dtype), float(nodata)


# --- pictures ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class MapPicture:
    """A picture that lies on a map.

    Attributes:
        rgb: (H, W, 3) uint8 of a screen, sRGB; the first row in the north.
        extent: (left, bottom, right, top) of its edges.
        crs: as that of `Heights`.
    """

    rgb: np.ndarray
    extent: tuple[float, float, float, float]
    crs: str | None


MAX_PIXELS = 2**28


def read_picture(path: Path) -> MapPicture:
    """The picture in a GeoTIFF: three bands (and more, which are left out) of 8 bits, or one that is grey or indexed.

    Raises VolumeFileError.
    """
    with _opened(path) as dataset:
        transform = dataset.transform
        if transform.is_identity or transform.b or transform.d or transform.a <= 0 or transform.e >= 0:
            raise VolumeFileError(
                path, "a picture that says where it lies, rows from the north", f"{transform!r}"[:200]
            )
        if dataset.width * dataset.height > MAX_PIXELS or set(dataset.dtypes) != {"uint8"}:
            got = f"{dataset.width} × {dataset.height} of {', '.join(sorted(set(dataset.dtypes)))}"
            raise VolumeFileError(path, f"at most {MAX_PIXELS} pixels of uint8", got)
        bands = dataset.read([1, 2, 3] if dataset.count >= 3 else [1])
        table = _colors(dataset) if dataset.count < 3 else None
        bounds, crs = dataset.bounds, _reference(dataset)[0]
    rgb = np.moveaxis(bands, 0, -1) if len(bands) == 3 else np.repeat(bands[0][..., None], 3, axis=-1)
    rgb = rgb if table is None else table[bands[0]]
    return MapPicture(np.ascontiguousarray(rgb), (bounds.left, bounds.bottom, bounds.right, bounds.top), crs)


def _colors(dataset: DatasetReader) -> np.ndarray | None:
    """(256, 3) of an indexed picture."""
    try:
        given = dataset.colormap(1)
    except ValueError:
        return None
    table = np.zeros((256, 3), np.uint8)
    for index, color in given.items():
        table[index] = color[:3]
    return table
