"""Files of heights: `load_heights`, `save_heights`, `describe_heights`; which formats there are is `HEIGHT_FORMATS`.

Heights are float32 (float64 where they are stored as integers of more than 16 bits, or as float64), NaN where the file
has none. Rows stay in the order of the file: from the north in most, so that the spacing along y is negative.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from filterlab.io.atomic import atomic_write
from filterlab.io.bounded import VolumeFileError, regular_file
from filterlab.io.formats import Format, function
from filterlab.names import unknown_name

if TYPE_CHECKING:
    from filterlab.heights import Heights
    from filterlab.io.heights_header import HeightsHeader

MAX_BYTES = 2**33  # that heights may take in memory, where nobody says otherwise


@dataclass(frozen=True)
class HeightFormat(Format):
    """A format of heights.

    Attributes:
        banded: whether a file may hold several bands.
        holds_heights: `module.function` that tells a file of heights from one of a volume; None: it is one.
    """

    banded: bool = False
    holds_heights: str | None = None


HEIGHT_FORMATS: dict[str, HeightFormat] = {
    known.name: known
    for known in (
        HeightFormat("GeoTIFF", (".tif", ".tiff"), "geotiff.read_header", "geotiff.write", True, "tiff_pages.is_map"),
        HeightFormat(
            "npy",
            (".npy",),
            "heights_numpy.read_npy_header",
            "heights_numpy.write_npy",
            holds_heights="heights_numpy.is_npy_of_heights",
        ),
        HeightFormat(
            "npz",
            (".npz",),
            "heights_numpy.read_npz_header",
            "heights_numpy.write_npz",
            holds_heights="heights_numpy.is_npz_of_heights",
        ),
        HeightFormat("PNG", (".png",), "heights_png.read_header", "heights_png.write"),
        HeightFormat("Arc/Info ASCII grid", (".asc",), "geotiff.read_header"),
        HeightFormat("SRTM", (".hgt",), "geotiff.read_header"),
    )
}


def format_of(path: Path) -> HeightFormat:
    """The format of a file by its ending. Raises VolumeFileError that lists the endings."""
    for known in HEIGHT_FORMATS.values():
        if path.name.lower().endswith(known.endings):
            return known
    endings = [ending for known in HEIGHT_FORMATS.values() for ending in known.endings]
    raise VolumeFileError(path, "a file of heights", unknown_name("ending", path.suffix, endings, alike=0.8))


def describe_heights(path: str | os.PathLike[str], *, band: int | None = None) -> HeightsHeader:
    """The checked header of a file of heights, without the heights.

    Args:
        path, band: as for `load_heights`.

    Raises:
        FileNotFoundError, VolumeFileError: as `load_heights`.
    """
    path = Path(path)
    known = format_of(path)
    regular_file(path, "a file of heights")
    if band is not None and not known.banded:
        raise VolumeFileError(path, f"no band: {known.name} has one", f"band {band!r}")
    return known.read_header(path, band) if known.banded else known.read_header(path)


def load_heights(path: str | os.PathLike[str], *, band: int | None = None, max_bytes: int = MAX_BYTES) -> Heights:
    """The heights in a file, and where they lie: what `surfaces.HeightField` is made of.

    Args:
        path: GeoTIFF (`.tif`, by the extra `terrain`), `.npy`, `.npz`, PNG of 16 bits, `.asc`, `.hgt`.
        band: of a GeoTIFF, from 1 as GDAL counts; needed where there are several.
        max_bytes: the most that the heights may take in memory; default 8 GiB. Integers are widened, see the head.

    Returns:
        heights, NaN where the file has none: its no-data value, its mask, NaN and infinities.

    Raises:
        FileNotFoundError: there is no such file.
        VolumeFileError: an unknown format, a damaged file, a raster that is turned against x and y, or one of several
            bands that nobody chose; raised before memory for the heights is asked for, but for damage within them.

    Warns:
        VolumeFileWarning: of degrees, in which slopes mean nothing; of a file that does not say where it lies.
    """
    return describe_heights(path, band=band).read(max_bytes)


def save_heights(heights: Heights, path: str | os.PathLike[str], *, stored: str | None = None) -> None:
    """Writes heights: `.tif` (GeoTIFF, deflated), `.npz`, `.npy` or `.png` of 16 bits (their place in NAME.yaml).

    The file appears whole or not at all. A round trip keeps every height bit for bit, with its place, unit and
    reference system; but a PNG has 65,535 steps between the lowest and the highest, and is off by half of one at most
    (by nothing where all are whole numbers that near to each other).

    Args:
        heights, path: what is written where; the ending tells the format.
        stored: the type in the file, a NumPy name such as int16; default the heights' own. It has to hold all of them.

    Raises:
        VolumeFileError: an ending that is not written, a type that does not hold the heights, or a missing package.
        OSError: the folder is missing or not writable.
    """
    path = Path(path)
    known = format_of(path)
    if known.writer is None:
        endings = [ending for one in HEIGHT_FORMATS.values() if one.writer for ending in one.endings]
        raise VolumeFileError(path, f"a name that ends in {', '.join(endings)}", repr(path.suffix))
    if known.name == "GeoTIFF":
        function("geotiff.require_rasterio")(path)
    with atomic_write(path) as temporary:
        try:
            known.write(heights, temporary, stored, path)
        except VolumeFileError as error:  # name the file that was asked for, not the temporary one
            raise VolumeFileError(path, error.expected, error.got) from None


def holds_heights(path: str | os.PathLike[str]) -> bool:
    """Whether a file holds heights rather than a volume, so far as its name and its first bytes tell.

    A TIFF of one page does, and one with tags of a map; of NumPy files those with two axes.
    """
    path = Path(path)
    named = (known for known in HEIGHT_FORMATS.values() if path.name.lower().endswith(known.endings))
    known = next(named, None)
    if known is None or not path.is_file():
        return False
    try:
        return known.holds_heights is None or function(known.holds_heights)(path)
    except VolumeFileError:
        return False
