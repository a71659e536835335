"""The pages of a TIFF file, one at a time: their tags, and the planes of values that their strips or tiles hold.

A directory of tags is read by ourselves, because of each tag the few bytes that matter here are all that may be
believed: a library that builds every value of every tag, of every page, can be made to fill memory by a small file.

What a page costs is bounded before it is read. The directories and the lists of strips do not overlap, so that
together they are no longer than the file. What strips hold, padding included, is at most what deflate can make of the
file, unless pages share strips: then it is a few times what they claim to be.

Source: TIFF 6.0 (Adobe, 1992), its Technical Note 3 (predictor 3), and the BigTIFF design by AWare Systems.
"""

from __future__ import annotations

import importlib.util
import math
import os
import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import BinaryIO

import numpy as np

from filterlab.io.bounded import BLOCK, EXPANSION, SAMPLE_TYPES, VolumeFileError, check_size, sample_dtype
from filterlab.io.warned import warn

MAX_PAGES = 2**20
MAX_TAGS = 2**12
MAX_TEXT = 10_000
MAX_SEGMENT = 2**26
MAX_SAMPLES = 2**12
SHARING = 4  # how often what pages claim may be read anew, because they share strips or pad their tiles
OVERHEAD = 16  # bytes of deflate data that hold nothing

WIDTH, LENGTH, BITS, COMPRESSION, FILL_ORDER, DESCRIPTION = 256, 257, 258, 259, 266, 270
STRIP_OFFSETS, SAMPLES_PER_PIXEL, ROWS_PER_STRIP, STRIP_COUNTS = 273, 277, 278, 279
X_RESOLUTION, Y_RESOLUTION, PLANAR, PREDICTOR = 282, 283, 284, 317
SUBFILE, PHOTOMETRIC, ORIENTATION = 254, 262, 274
TILE_WIDTH, TILE_LENGTH, TILE_OFFSETS, TILE_COUNTS, SAMPLE_FORMAT = 322, 323, 324, 325, 339
DEPTH, TILE_DEPTH = 32997, 32998
_WANTED = {WIDTH, LENGTH, BITS, COMPRESSION, FILL_ORDER, DESCRIPTION, STRIP_OFFSETS, SAMPLES_PER_PIXEL, ROWS_PER_STRIP}
_WANTED |= {STRIP_COUNTS, X_RESOLUTION, Y_RESOLUTION, PREDICTOR, TILE_WIDTH, TILE_LENGTH, TILE_OFFSETS, TILE_COUNTS}
_WANTED |= {SAMPLE_FORMAT, DEPTH, TILE_DEPTH, PLANAR, SUBFILE, PHOTOMETRIC, ORIENTATION}
_TYPE_BYTES = {1: 1, 2: 1, 3: 2, 4: 4, 5: 8, 6: 1, 7: 1, 8: 2, 9: 4, 10: 8, 11: 4, 12: 8, 13: 4, 16: 8, 17: 8, 18: 8}
_WHOLE = {1: "u1", 3: "u2", 4: "u4", 13: "u4", 16: "u8", 18: "u8"}  # types of tags that are whole numbers
_KINDS = {1: "u", 2: "i", 3: "f", 4: "u", 6: "c"}  # sample formats; 4 is "undefined": whole numbers
_COMPRESSIONS = {1: "raw", 8: "deflate", 32946: "deflate"}
# What tifffile reads with the codecs of the package imagecodecs.
_CODED = {5: "LZW", 6: "JPEG", 7: "JPEG", 32773: "PackBits", 33003: "JPEG 2000", 33004: "JPEG 2000", 33005: "JPEG 2000"}
_CODED |= {34712: "JPEG 2000", 34887: "LERC", 34892: "JPEG", 34925: "LZMA", 34926: "Zstandard", 34927: "WebP"}
_CODED |= {34933: "PNG", 34934: "JPEG XR", 50000: "Zstandard", 50001: "WebP", 50002: "JPEG XL", 52546: "JPEG XL"}
_NAMES = {2: "CCITT", 3: "CCITT", 4: "CCITT"}
# Tags of programs that order pages in ways of their own, and of maps.
_VENDORS = {34412: "LSM", 34361: "FluoView", 33628: "MetaMorph", 33629: "MetaMorph"}
_GEOGRAPHY = {33550, 33922, 34264}
_WANTED |= _VENDORS.keys() | _GEOGRAPHY
_PHOTOMETRIC = {0: "0 is white", 3: "numbers of a palette"}


@dataclass(frozen=True)
class Plane:
    """What all pages of a stack have in common.

    Attributes:
        rows, columns, dtype: of the values.
        encoding: raw, deflate, or what tifffile reads.
        samples: values per pixel.
        planar: these lie in planes of their own, one behind the other; else next to each other.
    """

    rows: int
    columns: int
    dtype: np.dtype
    encoding: str
    samples: int = 1
    planar: bool = False

    @property
    def own(self) -> bool:
        """Whether it is read here, and not by tifffile."""
        return self.encoding in ("raw", "deflate")

    @property
    def interleaved(self) -> int:
        """Values of a pixel next to each other."""
        return 1 if self.planar else self.samples

    @property
    def nbytes(self) -> int:
        return self.rows * self.columns * self.samples * self.dtype.itemsize

    def __str__(self) -> str:
        samples = f" × {self.samples}" if self.samples > 1 else ""
        return f"{self.columns} × {self.rows}{samples} {self.dtype.name} ({self.encoding})"


@dataclass(frozen=True)
class Segments:
    """The strips or tiles of a page: `high` × `wide` values each, the last strip fewer rows, row by row over the page.

    Attributes:
        offsets, counts: where each begins in the file, and how many bytes it has there.
        tiled: whether they are tiles, which are padded at the ends.
    """

    high: int
    wide: int
    offsets: np.ndarray
    counts: np.ndarray
    tiled: bool

    def place(self, plane: Plane, index: int) -> tuple[int, int, int]:
        """Segment of a plane -> its first row, its first column, its rows."""
        top, left = divmod(index, -(-plane.columns // self.wide))
        rows = self.high if self.tiled else min(self.high, plane.rows - top * self.high)
        return top * self.high, left * self.wide, rows


@dataclass(frozen=True)
class Page:
    """One page, checked; `read` gives its values."""

    plane: Plane
    predictor: int
    segments: Segments
    directory: Directory

    def read(self, sample: int = 0) -> np.ndarray:
        """One of the values of every pixel, (rows, columns) in the byte order of the file.

        Raises VolumeFileError for damaged strips.
        """
        plane, segments = self.plane, self.segments
        if not plane.own:
            return self._decoded()[..., sample]
        values = np.empty((plane.rows, plane.columns), plane.dtype)
        places = list(zip(segments.offsets.tolist(), segments.counts.tolist(), strict=True))
        if plane.planar:
            count = len(places) // plane.samples
            places, sample = places[sample * count : (sample + 1) * count], 0
        for index, (at, count) in enumerate(places):
            top, left, rows = segments.place(plane, index)
            shape = (rows, segments.wide, plane.interleaved)
            content = self._content(at, count, math.prod(shape) * plane.dtype.itemsize)
            block = _unpredicted(content, shape, plane.dtype, self.predictor)[..., sample]
            target = values[top : top + rows, left : left + segments.wide]
            target[...] = block[: target.shape[0], : target.shape[1]]
        return values

    def _decoded(self) -> np.ndarray:
        """All values of every pixel, (rows, columns, samples), by tifffile and its codecs."""
        path, plane = self.directory.file.path, self.plane
        values = decoded_page(path, self.directory.index, plane.encoding)
        values = values.reshape(values.shape if plane.samples > 1 else (*values.shape[:2], 1))
        if plane.planar:
            values = np.moveaxis(values, 0, -1)
        if values.shape != (plane.rows, plane.columns, plane.samples) or values.dtype.name != plane.dtype.name:
            raise VolumeFileError(path, f"a page of {plane}", f"{values.shape} {values.dtype.name}")
        return values

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of a pixel, in the file's unit; 1 where it says nothing useful.

        It is read from the file, as `read` does, while that is open.
        """
        across, down = (self.directory.ratio(tag) or 1.0 for tag in (X_RESOLUTION, Y_RESOLUTION))
        return 1.0 / across, 1.0 / down

    def behind(self, count: int) -> Iterator[Page]:
        """So many planes like this one that lie right behind it, uncompressed, without pages of their own; or none."""
        plane, offsets, size = self.plane, self.segments.offsets.tolist(), self.plane.nbytes
        one_piece = all(
            a + n == b for a, n, b in zip(offsets, self.segments.counts.tolist(), offsets[1:], strict=False)
        )
        there = count <= MAX_PAGES and offsets[0] + (count + 1) * size <= self.directory.file.length
        if plane.encoding == "raw" and not self.segments.tiled and one_piece and there:
            for at in range(offsets[0] + size, offsets[0] + (count + 1) * size, size):
                whole = Segments(plane.rows, plane.columns, np.array([at]), np.array([size]), tiled=False)
                yield Page(plane, 1, whole, self.directory)

    def _content(self, at: int, count: int, wanted: int) -> bytes | bytearray:
        path, file = self.directory.file.path, self.directory.file.stream
        if self.plane.encoding == "deflate":
            content = _inflated(path, file, at, count, wanted)
        else:
            content = b"" if count != wanted else _exactly(file, at, count)
        if len(content) != wanted:
            got = count if self.plane.encoding == "raw" else len(content) if len(content) < wanted else "more than that"
            raise VolumeFileError(path, f"a strip or tile of {wanted} bytes", got)
        return content


def _inflated(path: Path, file: BinaryIO, at: int, count: int, wanted: int) -> bytearray:
    """What a strip holds, or the beginning of it, a little longer than `wanted`: more is not made of it."""
    inflate, content, pending = zlib.decompressobj(), bytearray(), b""
    file.seek(at)
    try:
        while len(content) <= wanted and not inflate.eof and (pending or count > 0):
            if not pending:
                pending = file.read(min(count, BLOCK))
                count = count - len(pending) if pending else 0
            content += inflate.decompress(pending, wanted + 1 - len(content))
            pending = inflate.unconsumed_tail
    except zlib.error as error:
        raise VolumeFileError(path, "intact deflate data", str(error)) from None
    if len(content) <= wanted and not inflate.eof:
        raise VolumeFileError(path, "complete deflate data", f"an end after {len(content)} bytes")
    return content


def _unpredicted(
    content: bytes | bytearray, shape: tuple[int, int, int], dtype: np.dtype, predictor: int
) -> np.ndarray:
    """The values of a strip or tile, (rows, columns, values of a pixel).

    2: every value is stored as the difference from its left neighbour's; 3: the bytes of a row are, after all first
    bytes of its floats come all second ones, and so on.
    """
    if predictor == 3:
        rows, columns, samples = shape
        stored = np.frombuffer(content, np.uint8).reshape(rows, -1, samples)
        bytewise = np.cumsum(stored, axis=1, dtype=np.uint8).reshape(rows, dtype.itemsize, columns * samples)
        values = np.ascontiguousarray(bytewise.swapaxes(1, 2)).view(dtype.newbyteorder(">"))
        return values.reshape(shape)
    values = np.frombuffer(content, dtype).reshape(shape)
    if predictor == 1:
        return values
    words = values.view(f"{dtype.byteorder}u{dtype.itemsize}").astype(f"=u{dtype.itemsize}")
    return np.cumsum(words, axis=1, dtype=words.dtype, out=words).view(dtype.newbyteorder("="))


def decoded_page(path: Path, index: int, encoding: str) -> np.ndarray:
    """A page as tifffile reads it. Raises VolumeFileError: also without the codecs."""
    import tifffile

    if importlib.util.find_spec("imagecodecs") is None:
        expected = f"imagecodecs, which reads {encoding} data (pip install 'filterlab[tiff]')"
        raise VolumeFileError(path, expected, "no such package")
    try:
        with tifffile.TiffFile(path) as file:
            return file.pages[index].asarray()
    except Exception as error:  # whatever codecs make of damaged data
        got = f"{type(error).__name__}: {error}"[:200]
        raise VolumeFileError(path, f"intact {encoding} data", got) from None


def as_text(content: bytes) -> str:
    """UTF-8, or what old writers on Windows used."""
    try:
        return content.decode("utf-8")
    except UnicodeDecodeError:
        return content.decode("cp1252", "replace")


@lru_cache
def _dtype(order: str, kind: str, itemsize: int) -> np.dtype:
    """The type of samples; nothing that anyone can add up, where NumPy has none."""
    try:
        return np.dtype(f"{order}{kind}{itemsize}")
    except TypeError:
        return np.dtype(f"V{itemsize}")


@lru_cache
def _known(dtype: np.dtype) -> bool:
    return dtype.name in SAMPLE_TYPES


def _exactly(file: BinaryIO, at: int, count: int) -> bytes:
    file.seek(at)
    return file.read(count)


@dataclass(frozen=True)
class Directory:
    """The tags of a page that matter here: tag -> (type, number of values, where the values stand)."""

    file: TiffFile
    tags: dict[int, tuple[int, int, int]]
    start: int
    entries: bytes
    last: bool
    index: int = 0

    def _bytes(self, at: int, count: int) -> bytes:
        """Bytes of the file; most values stand in the entries themselves, which have been read."""
        if self.start <= at and at + count <= self.start + len(self.entries):
            return self.entries[at - self.start : at - self.start + count]
        return _exactly(self.file.stream, at, count)

    def numbers(self, tag: int, count: int) -> np.ndarray:
        """So many whole numbers, at once. Raises VolumeFileError."""
        path, length = self.file.path, self.file.length
        kind, n, at = self.tags.get(tag, (0, 0, 0))
        if n != count or kind not in _WHOLE:
            raise VolumeFileError(path, f"{count} whole numbers in tag {tag}", f"{n} of type {kind}")
        dtype = np.dtype(self.file.order + _WHOLE[kind])
        if at + n * dtype.itemsize > length:
            raise VolumeFileError(path, f"tag {tag} within its {length} bytes", f"{n} values at {at}")
        if n * dtype.itemsize > 8:
            self.file.spend(n * dtype.itemsize)
        return np.frombuffer(self._bytes(at, n * dtype.itemsize), dtype)

    def number(self, tag: int, default: int | None = None) -> int:
        """One whole number. Raises VolumeFileError if there are more, or none and no default."""
        if tag not in self.tags and default is not None:
            return default
        kind, n, at = self.tags.get(tag, (0, 0, 0))
        if n != 1 or kind not in _WHOLE or at < self.start:
            return int(self.numbers(tag, 1)[0])
        return int.from_bytes(self._bytes(at, _TYPE_BYTES[kind]), "little" if self.file.order == "<" else "big")

    def ratio(self, tag: int) -> float | None:
        """A positive ratio; None where there is none."""
        kind, n, at = self.tags.get(tag, (0, 0, 0))
        if kind != 5 or n != 1 or at + 8 > self.file.length:
            return None
        above, below = struct.unpack(self.file.order + "II", _exactly(self.file.stream, at, 8))
        return above / below if above and below else None

    def alike(self, tag: int, default: int, count: int) -> int:
        """One whole number, or the same so many times. Raises VolumeFileError."""
        if count == 1 or self.tags.get(tag, (0, 1, 0))[1] == 1:
            return self.number(tag, default)
        values = set(self.numbers(tag, count).tolist())
        if len(values) != 1:
            raise VolumeFileError(self.file.path, f"the same for all {count} values of a pixel in tag {tag}", values)
        return int(values.pop())

    def check_vendor(self) -> None:
        """Raises VolumeFileError for pages in an order that only their own program knows; warns of what is not read."""
        path = self.file.path
        for tag, name in _VENDORS.items():
            if tag in self.tags:
                raise VolumeFileError(path, "a plain TIFF stack, or one by OME, ImageJ or tifffile", f"one of {name}")
        if _GEOGRAPHY & self.tags.keys():
            warn(path, "its geography is not read: world coordinates are voxel indices")
        if (turned := self.number(ORIENTATION, 1)) != 1:
            warn(path, f"rows and columns are as stored; orientation {turned} is not applied")
        if self.text(DESCRIPTION).startswith(("SI.", "scanimage.SI.", "state.config")):
            warn(path, "its pages are taken as slices; ScanImage may have stored channels between them")

    def remarks(self) -> dict[str, str]:
        """What the tags say of the meaning of values, for people."""
        meaning = _PHOTOMETRIC.get(self.number(PHOTOMETRIC, 1))
        return {"photometric": meaning} if meaning else {}

    def content(self, tag: int, most: int) -> bytes:
        """The beginning of a text, as it stands; empty where there is none. Raises VolumeFileError."""
        kind, n, at = self.tags.get(tag, (2, 0, 0))
        if kind not in (1, 2, 7) or at + n > self.file.length:
            raise VolumeFileError(
                self.file.path, f"tag {tag} within its {self.file.length} bytes", f"{n} values at {at}"
            )
        content = _exactly(self.file.stream, at, min(n, most))
        end = content.find(b"\0")
        return content if end < 0 else content[:end]

    def text(self, tag: int) -> str:
        """The beginning of a text; empty where there is none. Raises VolumeFileError."""
        return as_text(self.content(tag, MAX_TEXT))

    def page(self) -> Page:
        """The page, once its claims are known to be possible. Raises VolumeFileError."""
        path = self.file.path
        plane = self._plane()
        predictor = self.number(PREDICTOR, 1)
        known = (1, 2, 3) if plane.dtype.kind == "f" else (1, 2)
        if plane.own and predictor not in (known if plane.encoding == "deflate" else (1,)):
            expected = f"predictor {', '.join(map(str, known))}" if plane.encoding == "deflate" else "no predictor"
            raise VolumeFileError(path, f"{expected} for {plane.dtype.name} ({plane.encoding})", predictor)
        segments = self._segments(plane)
        self.file.claim(plane, segments)
        return Page(plane, predictor, segments, self)

    def _plane(self) -> Plane:
        path = self.file.path
        samples, depth = self.number(SAMPLES_PER_PIXEL, 1), self.number(DEPTH, 1)
        planar = self.number(PLANAR, 1)
        if not 1 <= samples <= MAX_SAMPLES or depth != 1 or planar not in (1, 2):
            expected = f"pages of 1 to {MAX_SAMPLES} whole numbers or floats per pixel"
            raise VolumeFileError(path, expected, f"{samples} per pixel" if depth == 1 else f"depth {depth}")
        if self.number(SUBFILE, 0) & 5:
            raise VolumeFileError(path, "pages in full resolution", "a smaller copy or a mask among them")
        bits = self.alike(BITS, 1, samples)
        if bits not in (8, 16, 32, 64, 128) or self.number(FILL_ORDER, 1) != 1:
            raise VolumeFileError(path, "whole bytes per pixel, in order", f"{bits} bits")
        kind = _KINDS.get(self.alike(SAMPLE_FORMAT, 1, samples), "V")
        dtype = _dtype(self.file.order, kind, bits // 8)
        if not _known(dtype):
            sample_dtype(path, dtype)
        code = self.number(COMPRESSION, 1)
        encoding = _COMPRESSIONS.get(code) or _CODED.get(code)
        if encoding is None:
            got = f"{_NAMES.get(code, f'compression {code}')} (save the file without compression)"
            raise VolumeFileError(path, f"data uncompressed, deflate, {', '.join(sorted(set(_CODED.values())))}", got)
        rows, columns = check_size(path, (self.number(LENGTH), self.number(WIDTH)))
        return Plane(rows, columns, dtype, encoding, samples, planar == 2 and samples > 1)

    def _segments(self, plane: Plane) -> Segments:
        path, tiled = self.file.path, TILE_WIDTH in self.tags
        if tiled:
            high, wide = self.number(TILE_LENGTH), self.number(TILE_WIDTH)
            size = high * wide * plane.interleaved * plane.dtype.itemsize
            if not 0 < size <= MAX_SEGMENT or self.number(TILE_DEPTH, 1) != 1:
                raise VolumeFileError(path, f"tiles of at most {MAX_SEGMENT} bytes", f"{wide} × {high}")
        else:
            high, wide = min(self.number(ROWS_PER_STRIP, plane.rows), plane.rows), plane.columns
            if high < 1:
                raise VolumeFileError(path, "one or more rows per strip", high)
        count = -(-plane.rows // high) * -(-plane.columns // wide) * (plane.samples if plane.planar else 1)
        offset_tag = TILE_OFFSETS if tiled and TILE_OFFSETS in self.tags else STRIP_OFFSETS
        count_tag = TILE_COUNTS if tiled and TILE_COUNTS in self.tags else STRIP_COUNTS
        offsets = self.numbers(offset_tag, count)
        if count == 1 and not tiled and count_tag not in self.tags and plane.encoding == "raw":
            counts = np.array([plane.nbytes])  # the lengths of uncompressed strips may be left out
        else:
            counts = self.numbers(count_tag, count)
        return Segments(high, wide, offsets, counts, tiled)


class TiffFile:
    """The chain of directories of an open file; iterate it once.

    Raises VolumeFileError: no TIFF file, a chain that does not end, or directories that overlap.
    """

    def __init__(self, path: Path, stream: BinaryIO) -> None:
        self.path, self.stream, self.length = path, stream, os.fstat(stream.fileno()).st_size
        start = _exactly(stream, 0, 16)
        self.order = {b"II": "<", b"MM": ">"}.get(start[:2], "")
        version = struct.unpack(self.order + "H", start[2:4])[0] if self.order and len(start) >= 8 else 0
        if version not in (42, 43) or (version == 43 and len(start) < 16):
            raise VolumeFileError(path, "a TIFF file (II or MM, then 42 or 43)", "something else")
        self._counter, self._entry, self._offset = ("Q", "HHQQ", "Q") if version == 43 else ("H", "HHII", "I")
        self._first = struct.unpack_from(self.order + self._offset, start, 8 if version == 43 else 4)[0]
        self._spent = self._read = self._stored = self._claimed = self._segments = 0

    def __iter__(self) -> Iterator[Directory]:
        offset, seen = self._first, set()
        while offset:
            if offset in seen or offset >= self.length or len(seen) >= MAX_PAGES:
                expected = f"a chain of pages that ends, within {self.length} bytes"
                raise VolumeFileError(self.path, expected, f"a page at {offset}")
            seen.add(offset)
            directory, offset = self._directory(offset, len(seen) - 1)
            yield directory

    def _directory(self, at: int, index: int) -> tuple[Directory, int]:
        """The directory at a place, and where the next one is."""
        head, size = struct.calcsize(self.order + self._counter), struct.calcsize(self.order + self._entry)
        count = self._unpacked(self._counter, at)
        if count > MAX_TAGS or at + head + count * size > self.length:
            raise VolumeFileError(
                self.path, f"at most {MAX_TAGS} tags within its {self.length} bytes", f"{count} of them"
            )
        self.spend(head + count * size)
        content = _exactly(self.stream, at + head, count * size)
        tags: dict[int, tuple[int, int, int]] = {}
        inline = struct.calcsize(self._offset)
        for i, (tag, kind, n, value) in enumerate(struct.iter_unpack(self.order + self._entry, content)):
            if tag in _WANTED:
                there = n * _TYPE_BYTES.get(kind, 1) <= inline
                tags.setdefault(tag, (kind, n, at + head + (i + 1) * size - inline if there else value))
        following = self._unpacked(self._offset, at + head + count * size)
        return Directory(self, tags, at + head, content, following == 0, index), following

    def _unpacked(self, layout: str, at: int) -> int:
        content = _exactly(self.stream, at, struct.calcsize(self.order + layout))
        if len(content) != struct.calcsize(self.order + layout):
            raise VolumeFileError(self.path, f"TIFF structures within its {self.length} bytes", f"one at {at}")
        return struct.unpack(self.order + layout, content)[0]

    def spend(self, count: int) -> None:
        """Counts bytes of directories and lists, which are all different bytes of the file. Raises VolumeFileError."""
        self._spent += count
        if self._spent > self.length:
            got = "directories or lists of strips that overlap"
            raise VolumeFileError(self.path, f"TIFF structures within its {self.length} bytes", got)

    def claim(self, plane: Plane, segments: Segments) -> None:
        """Counts what the strips of one more page hold; checks that the file can. Raises VolumeFileError."""
        counts, itemsize = segments.counts, plane.dtype.itemsize
        ends = segments.offsets.astype(np.float64) + counts
        if len(ends) and float(ends.max()) > self.length:
            expected = f"strips or tiles within its {self.length} bytes"
            raise VolumeFileError(self.path, expected, f"one that ends at {ends.max():.0f}")
        if not plane.own:  # of what codecs make of it no ratio is known
            return
        rows = len(counts) * segments.high if segments.tiled else plane.rows * plane.samples // plane.interleaved
        held = rows * segments.wide * plane.interleaved * itemsize
        stored = int(counts.sum(dtype=np.int64))
        factor = EXPANSION["deflate"] if plane.encoding == "deflate" else 1
        if held > factor * stored or (plane.encoding == "raw" and held != stored):
            got = f"{stored} bytes of {plane.encoding} data"
            raise VolumeFileError(self.path, f"strips or tiles of {held} bytes", got)
        self._claimed += plane.nbytes
        self._read += held
        self._stored += stored
        self._segments += len(counts)
        if self._read > EXPANSION["deflate"] * self.length + SHARING * self._claimed or (
            self._stored > self.length + 2 * self._read + OVERHEAD * self._segments
        ):
            expected = f"pages of {self._claimed} bytes from its {self.length} bytes"
            raise VolumeFileError(self.path, expected, f"strips or tiles of {self._read}, {self._stored} in the file")


def is_map(path: Path) -> bool:
    """Whether the first page has the tags of a map, or is the only one and has one value per pixel.

    Raises VolumeFileError for what is no TIFF file.
    """
    with path.open("rb") as stream:
        first = next(iter(TiffFile(path, stream)), None)
        if first is None:
            return False
        return bool(_GEOGRAPHY & first.tags.keys()) or (first.last and first.number(SAMPLES_PER_PIXEL, 1) == 1)
