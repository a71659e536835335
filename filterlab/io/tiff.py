"""TIFF stacks: one file of many pages, or a folder of numbered slices (`slice2.tif` before `slice10.tif`).

Every page is one z-plane of one value per pixel; all have the same size and type. Uncompressed and deflate data, strips
or tiles. World coordinates are voxel indices; a file by ImageJ or Fiji also tells voxel sizes, and they are used.

Source: TIFF 6.0 (Adobe, 1992) and tifffile's BigTIFF notes.
"""

from __future__ import annotations

import logging
import re
import struct
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import tifffile
import torch

from filterlab.io.bounded import (
    BLOCK,
    VolumeFileError,
    VolumeHeader,
    check_geometry,
    check_size,
    regular_file,
    sample_dtype,
    scaled,
)

SUFFIXES = (".tif", ".tiff")
MAX_PAGES = 2**20
MAX_TAG_BYTES = 2**24
_TYPE_BYTES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
_COMPRESSIONS = {1: "raw", 8: "deflate", 32946: "deflate"}
_PLANE = tuple[tuple[int, int], np.dtype, str]  # (rows, columns), type, encoding


def read_header(path: Path) -> VolumeHeader:
    """The checked header of a multi-page file or of a folder of slices. Raises VolumeFileError."""
    files = slices(path) if path.is_dir() else [regular_file(path)]
    first: _PLANE | None = None
    pages = 0
    description, resolution = "", (1.0, 1.0)
    for file in files:
        with _opened(file) as tif:
            if path.is_dir() and len(tif.pages) != 1:
                raise VolumeFileError(file, "one page in every slice of a folder", len(tif.pages))
            for page in tif.pages:
                plane = _checked_plane(file, page)
                if first is None:
                    first, description, resolution = plane, str(getattr(page, "description", "")), _pixel_size(page)
                elif plane != first:
                    raise VolumeFileError(file, f"pages of {_told(first)}", f"page {pages} of {_told(plane)}")
                pages += 1
    if first is None or pages < 2:
        raise VolumeFileError(path, "a stack of two or more pages", f"{pages} (a 2-D image)")
    (rows, columns), dtype, encoding = first
    fields, spacing = _imagej(path, description, resolution, pages)
    shape = check_size(path, (pages, rows, columns))
    target = sample_dtype(path, dtype)
    return VolumeHeader(
        path,
        "TIFF",
        shape,
        dtype.name,
        check_geometry(path, scaled(spacing, (0, 0, 0))),
        encoding,
        None,
        fields | ({"files": str(len(files))} if path.is_dir() else {}),
        target,
        lambda: _read(files, shape, target),
    )


def slices(folder: Path) -> list[Path]:
    """The TIFF files of a folder in natural order of their names. Raises VolumeFileError if there are none."""
    files = [f for f in folder.iterdir() if f.suffix.lower() in SUFFIXES and not f.name.startswith(".")]
    if not files:
        raise VolumeFileError(folder, f"a folder of {' or '.join(SUFFIXES)} slices", "none")
    return [regular_file(f) for f in sorted(files, key=natural_key)]


def natural_key(path: Path) -> tuple[list[tuple[int, int | str]], str]:
    """Sorts digits by value: a2 < a10."""
    parts = re.findall(r"[0-9]+|[^0-9]+", path.name)
    return [(0, int(p)) if p[0] in "0123456789" else (1, p.lower()) for p in parts], path.name


def _told(plane: _PLANE) -> str:
    (rows, columns), dtype, encoding = plane
    return f"{columns} × {rows} {dtype.name} ({encoding})"


@contextmanager
def _opened(path: Path) -> Iterator[tifffile.TiffFile]:
    """The file, once its chain of pages is known to end; whatever tifffile makes of damage becomes VolumeFileError."""
    with path.open("rb") as file:
        _check_chain(path, file, path.stat().st_size)
    try:
        with _unlogged(), tifffile.TiffFile(path) as tif:
            yield tif
    except (VolumeFileError, MemoryError):
        raise
    except Exception as error:
        raise VolumeFileError(path, "an intact TIFF file", f"{type(error).__name__}: {error}"[:200]) from None


@contextmanager
def _unlogged() -> Iterator[None]:
    """Keeps tifffile from logging what is wrong with a file: our own error says it once."""
    logger = logging.getLogger("tifffile")
    before, logger.disabled = logger.disabled, True
    try:
        yield
    finally:
        logger.disabled = before


def _check_chain(path: Path, file: BinaryIO, length: int) -> None:
    """Walks the pages and their tags: no loops, no tag whose values lie outside the file or fill memory."""

    def unpacked(layout: str, at: int) -> tuple[int, ...]:
        file.seek(at)
        data = file.read(struct.calcsize(order + layout))
        if len(data) != struct.calcsize(order + layout):
            raise VolumeFileError(path, f"TIFF structures within its {length} bytes", f"one at {at}")
        return struct.unpack(order + layout, data)

    order = {b"II": "<", b"MM": ">"}.get(file.read(2), "")
    version = unpacked("H", 2)[0] if order else 0
    if version not in (42, 43):
        raise VolumeFileError(path, "a TIFF file (II or MM, then 42 or 43)", "something else")
    big = version == 43
    counter, entry, offset_code, inline = ("Q", "HHQQ", "Q", 8) if big else ("H", "HHII", "I", 4)
    offset = unpacked(offset_code, 8 if big else 4)[0]
    seen: set[int] = set()
    while offset:
        if offset in seen or offset >= length or len(seen) >= MAX_PAGES:
            raise VolumeFileError(path, f"a chain of pages that ends, within {length} bytes", f"a page at {offset}")
        seen.add(offset)
        count = unpacked(counter, offset)[0]
        offset += struct.calcsize(order + counter)
        size = struct.calcsize(order + entry)
        if count * size > length - offset:
            raise VolumeFileError(path, f"tags within its {length} bytes", f"{count} of them")
        for tag, kind, n, at in struct.iter_unpack(order + entry, bytes(_exactly(file, offset, count * size))):
            nbytes = n * _TYPE_BYTES.get(kind, 1)
            if nbytes > inline and (nbytes > MAX_TAG_BYTES or at + nbytes > length):
                raise VolumeFileError(path, f"tag {tag} within its {length} bytes", f"{n} values at {at}")
        offset = unpacked(offset_code, offset + count * size)[0]


def _exactly(file: BinaryIO, at: int, count: int) -> bytes:
    file.seek(at)
    return file.read(count)


def _checked_plane(path: Path, page: Any) -> _PLANE:
    """Size, type and encoding of a page, once its strips or tiles are known to hold exactly that."""
    expected = "pages of one whole number or float per pixel"
    if page.samplesperpixel != 1 or page.imagedepth != 1 or page.dtype is None or len(page.shape) != 2:
        raise VolumeFileError(path, expected, f"{page.samplesperpixel} per pixel, shape {page.shape}"[:100])
    if page.bitspersample != 8 * page.dtype.itemsize or page.fillorder != 1:
        raise VolumeFileError(path, "whole bytes per pixel, in order", f"{page.bitspersample} bits")
    encoding = _COMPRESSIONS.get(int(page.compression))
    if encoding is None:
        name = getattr(page.compression, "name", page.compression)
        raise VolumeFileError(path, "uncompressed or deflate data", f"{name} (save the file without compression)")
    if int(page.predictor) not in (1, 2, 3):
        raise VolumeFileError(path, "predictor 1, 2 or 3", int(page.predictor))
    sample_dtype(path, page.dtype)
    check_size(path, page.shape)
    _check_segments(path, page, encoding)
    return (int(page.shape[0]), int(page.shape[1])), page.dtype, encoding


def _check_segments(path: Path, page: Any, encoding: str) -> None:
    """Every strip or tile lies within the file and, when decompressed, fills its rows: no more, no less."""
    rows, columns = page.shape
    length = path.stat().st_size
    offsets, counts = page.dataoffsets, page.databytecounts
    expected = _segment_bytes(path, page, rows, columns)
    if not len(offsets) == len(counts) == expected[0]:
        raise VolumeFileError(path, f"{expected[0]} strips or tiles", f"{len(offsets)}")
    if any(at < 0 or n < 0 or at + n > length for at, n in zip(offsets, counts, strict=True)) or sum(counts) > length:
        raise VolumeFileError(path, f"strips or tiles within its {length} bytes", f"{sum(counts)} bytes of them")
    with path.open("rb") as file:
        for at, n, wanted in zip(offsets, counts, expected[1], strict=True):
            got = n if encoding == "raw" else _inflated_bytes(path, _exactly(file, at, n), wanted)
            if got != wanted:
                raise VolumeFileError(path, f"a strip or tile of {wanted} bytes", f"{got}")


def _segment_bytes(path: Path, page: Any, rows: int, columns: int) -> tuple[int, Iterable[int]]:
    """(number of strips or tiles, bytes of each)."""
    itemsize = page.dtype.itemsize
    if page.is_tiled:
        high, wide = int(page.tilelength), int(page.tilewidth)
        if not (high > 0 and wide > 0 and high * wide * itemsize <= 64 * BLOCK and page.tiledepth == 1):
            raise VolumeFileError(path, f"tiles of at most {64 * BLOCK} bytes", f"{wide} × {high}")
        count = -(-rows // high) * -(-columns // wide)
        return count, (high * wide * itemsize for _ in range(count))
    high = min(int(page.rowsperstrip), rows)
    if high < 1:
        raise VolumeFileError(path, "one or more rows per strip", high)
    count = -(-rows // high)
    return count, (min(high, rows - i * high) * columns * itemsize for i in range(count))


def _inflated_bytes(path: Path, data: bytes, limit: int) -> int:
    """The length of the decompressed data, counted in blocks; stops soon after `limit`."""
    inflate, total = zlib.decompressobj(), 0
    try:
        while total <= limit and not inflate.eof and (block := inflate.decompress(data, BLOCK)):
            total += len(block)
            data = inflate.unconsumed_tail
    except zlib.error as error:
        raise VolumeFileError(path, "intact deflate data", str(error)) from None
    if total <= limit and not inflate.eof:
        raise VolumeFileError(path, "complete deflate data", f"an end after {total} bytes")
    return total


def _pixel_size(page: Any) -> tuple[float, float]:
    """Width and height of a pixel from the resolution tags, in the file's unit; 1 where they say nothing useful."""
    sizes = []
    for name in ("XResolution", "YResolution"):
        tag = page.tags.get(name)
        numerator, denominator = tag.value if tag is not None and isinstance(tag.value, tuple) else (1, 1)
        sizes.append(denominator / numerator if numerator and denominator else 1.0)
    return sizes[0], sizes[1]


def _imagej(
    path: Path, description: str, pixel: tuple[float, float], pages: int
) -> tuple[dict[str, str], tuple[float, float, float]]:
    """Voxel sizes of an ImageJ stack: pixel width and height from the resolution, depth from `spacing=`."""
    if not description.startswith("ImageJ="):
        return {}, (1.0, 1.0, 1.0)
    entries = dict(line.split("=", 1) for line in description[:10_000].splitlines() if "=" in line)
    images = entries.get("images", str(pages))
    if images != str(pages):
        raise VolumeFileError(path, f"{images} pages, as ImageJ says", pages)
    if any(entries.get(k, "1") != "1" for k in ("channels", "frames")):
        raise VolumeFileError(path, "one channel and one frame", f"{entries}"[:100])
    try:
        depth = float(entries.get("spacing", "1"))
    except ValueError:
        raise VolumeFileError(path, "a number as ImageJ spacing", entries["spacing"][:40]) from None
    return {"unit": entries["unit"]} if "unit" in entries else {}, (*pixel, depth)


def _read(files: list[Path], shape: tuple[int, ...], target: torch.dtype) -> torch.Tensor:
    samples, z = torch.empty(shape, dtype=target), 0
    for file in files:
        with _opened(file) as tif:
            for page in tif.pages:
                _checked_plane(file, page)
                plane = np.asarray(page.asarray())
                samples[z] = torch.from_numpy(plane.astype(samples.numpy().dtype))
                z += 1
    return samples
