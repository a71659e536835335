"""NumPy files of heights: `.npy`, and `.npz` with their place.

* `.npy` holds samples (H, W); where they lie stands in a small file `NAME.npy.yaml` beside it.
* `.npz` holds `heights` (or one single array of two axes) and optionally `spacing` and `origin` (x, y), and the texts
  `unit`, `height_unit`, `crs`, `crs_name`. The layout of matplotlib's sample of an elevation model is read too: edges
  of pixels lie at `xmin`, `xmax` (first and last column) and `ymin`, `ymax` (first and last row, in whichever order).
"""

from __future__ import annotations

import math
import zipfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from filterlab.heights import Heights
from filterlab.io.bounded import (
    Outgoing,
    Stored,
    VolumeFileError,
    check_exact,
    check_size,
    read_array,
)
from filterlab.io.heights_header import (
    MAX_TEXT,
    HeightsHeader,
    Pair,
    band_of,
    blocks_of_rows,
    check_place,
    check_stored,
)
from filterlab.io.numpy_files import (
    array_header,
    open_archive,
    open_member,
    small_numbers,
    stored_order,
    write_array,
)

Members = Mapping[str, zipfile.ZipInfo]
_TEXTS = ("unit", "height_unit", "crs", "crs_name")
_EDGES = ("xmin", "xmax", "ymin", "ymax")
_PLACE = {"spacing", "origin", *_TEXTS, *_EDGES, "dx", "dy"}


def is_npy_of_heights(path: Path) -> bool:
    """Whether the array has two axes. Raises VolumeFileError for what is no array."""
    with path.open("rb") as file:
        return len(array_header(path, file)[0]) == 2


def is_npz_of_heights(path: Path) -> bool:
    """Whether it holds `heights`, or one array of two axes and none of three. Raises VolumeFileError."""
    with open_archive(path) as (archive, members):
        return _name(path, archive, members) is not None


def read_npy_header(path: Path) -> HeightsHeader:
    """The checked header of an .npy file and of its sidecar. Raises VolumeFileError."""
    from filterlab.io.heights_sidecar import read_sidecar

    with path.open("rb") as file:
        shape, fortran, dtype = array_header(path, file)
        offset = file.tell()
    rows, columns = _check_shape(path, shape)
    stored = Stored(path, path, "raw", offset, 0, stored_order(shape, fortran), check_stored(path, dtype))
    stored.check()
    place = read_sidecar(path, (rows, columns)).place

    def read(samples: np.ndarray) -> None:
        _fill(samples, stored.read(), fortran)

    return HeightsHeader(path, "npy", (rows, columns), dtype.name, **place, _read=read)


def _check_shape(path: Path, shape: tuple[int, ...]) -> tuple[int, int]:
    if len(shape) != 2:
        raise VolumeFileError(path, "an array (H, W) of heights", f"shape {shape}"[:100])
    rows, columns = check_size(path, shape)
    return rows, columns


def _fill(samples: np.ndarray, array: np.ndarray, fortran: bool) -> None:
    array = array.T if fortran else array
    for rows in blocks_of_rows(samples.shape):  # type: ignore[arg-type]
        band_of(samples, rows, array[rows], None, (1.0, 0.0))


def read_npz_header(path: Path) -> HeightsHeader:
    """The checked header of an .npz file. Raises VolumeFileError."""
    with open_archive(path) as (archive, members):
        name = _name(path, archive, members)
        if name is None:
            raise VolumeFileError(path, "an array named heights, or one array (H, W) only", ", ".join(members)[:200])
        info = members[name]
        with open_member(path, archive, info) as stream:
            shape, fortran, dtype = array_header(path, stream)
            offset = stream.tell()
        rows, columns = _check_shape(path, shape)
        claimed = math.prod(shape) * check_stored(path, dtype).itemsize
        if info.file_size - offset != claimed:
            expected = f"{claimed} bytes of heights for {shape} {dtype.name} in {info.filename}"
            raise VolumeFileError(path, expected, info.file_size - offset)
        spacing, origin = _place(path, archive, members, (rows, columns))
        texts = _texts(path, archive, members)
    check_place(path, spacing, origin)

    def read(samples: np.ndarray) -> None:
        with open_archive(path) as (archive, _), open_member(path, archive, info) as stream:
            stream.read(offset)
            array = read_array(path, stream, stored_order(shape, fortran), dtype, (None, None), raw=False)
        _fill(samples, array, fortran)

    encoding = "deflate" if info.compress_type == zipfile.ZIP_DEFLATED else "raw"
    fields = {"array": name}
    return HeightsHeader(
        path, "npz", (rows, columns), dtype.name, spacing, origin, **texts, encoding=encoding, fields=fields, _read=read
    )


def _name(path: Path, archive: zipfile.ZipFile, members: Members) -> str | None:
    """Of the array of heights; None where there is none, or several."""
    if "heights" in members:
        return "heights"
    found = []
    for name in members:
        if name not in _PLACE:
            with open_member(path, archive, members[name]) as stream:
                axes = len(array_header(path, stream)[0])
            if axes > 2:
                return None
            found += [name] * (axes == 2)
    return found[0] if len(found) == 1 and found[0] != "affine" else None


def _place(path: Path, archive: zipfile.ZipFile, members: Members, shape: tuple[int, int]) -> tuple[Pair, Pair]:
    """Spacing and origin."""
    if all(name in members for name in _EDGES):
        return _between_edges(path, archive, members, shape)
    return (
        _pair(path, archive, members, "spacing", (1.0, 1.0)),
        _pair(path, archive, members, "origin", (0.0, 0.0)),
    )


def _pair(path: Path, archive: zipfile.ZipFile, members: Members, name: str, default: Pair) -> Pair:
    if name not in members:
        return default
    x, y = small_numbers(path, archive, members[name], (2,)).tolist()
    return x, y


def _between_edges(path: Path, archive: zipfile.ZipFile, members: Members, shape: tuple[int, int]) -> tuple[Pair, Pair]:
    """Of edges of pixels: samples stand in their middles."""
    left, right, first, last = (float(small_numbers(path, archive, members[name], ())) for name in _EDGES)
    spacing = (right - left) / shape[1], (last - first) / shape[0]
    return spacing, (left + spacing[0] / 2, first + spacing[1] / 2)


def _texts(path: Path, archive: zipfile.ZipFile, members: Members) -> dict[str, str | None]:
    return {name: _text(path, archive, members[name]) if name in members else None for name in _TEXTS}


def _text(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> str | None:
    """A text that stands as an array of its own; None for an empty one. Raises VolumeFileError."""
    with open_member(path, archive, info) as stream:
        shape, _, dtype = array_header(path, stream)
        if shape != () or dtype.kind != "U" or dtype.itemsize > 4 * MAX_TEXT:
            raise VolumeFileError(path, f"a text of at most {MAX_TEXT} letters as {info.filename}", f"{dtype} {shape}")
        content = stream.read(dtype.itemsize)
    try:
        return content.decode("utf-32-be" if dtype.byteorder == ">" else "utf-32-le").rstrip("\0") or None
    except UnicodeDecodeError as error:
        raise VolumeFileError(path, f"a text as {info.filename}", str(error)[:100]) from None


# --- writing ----------------------------------------------------------------------------------------------------------


def write_npy(heights: Heights, path: Path, stored: str | None, final: Path) -> None:
    """The samples; their place goes into a sidecar of the final name, and first, so that no samples stand without."""
    outgoing = _outgoing(path, heights, stored)
    from filterlab.io.heights_sidecar import HeightsSidecar, write_sidecar

    write_sidecar(final, HeightsSidecar.of(heights))
    with path.open("wb") as file:
        write_array(file, outgoing)


def write_npz(heights: Heights, path: Path, stored: str | None, final: Path) -> None:
    """Everything, deflated."""
    texts = {name: np.array(getattr(heights, name) or "") for name in _TEXTS}
    place = {"spacing": np.array(heights.spacing), "origin": np.array(heights.origin)}
    outgoing = _outgoing(path, heights, stored)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=6) as archive:
        for name, array in {"heights": outgoing, **place, **texts}.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as stream:
                write_array(stream, array)  # type: ignore[arg-type]


def _outgoing(path: Path, heights: Heights, stored: str | None) -> Outgoing:
    """Samples in a type that has NaN where some are missing. Raises VolumeFileError."""
    samples = np.ascontiguousarray(heights.samples)
    if stored is not None:
        check_exact(path, samples, np.dtype(stored))
    return Outgoing(samples, np.dtype(stored or samples.dtype))
