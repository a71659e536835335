"""NRRD volumes (`.nrrd`, or `.nhdr` with a data file beside it).

Read: raw, gzip and bzip2 data, attached or in one data file in the same folder or below; both byte orders; data as text
and behind skipped lines, by SimpleITK (the extra `itk`); geometry from `space directions` and `space origin`, or
`spacings` (with `axis mins`). Three axes are of space; others, of time (kind `time`) or of the components of a voxel
(kinds such as `vector`, `RGB-color`, `list`), are chosen from. Written: attached gzip data.

World frame: where the file declares an anatomical space (RAS, LAS, LPS), world coordinates are RAS, as in NIfTI: x to
the right, y to the front, z to the head of the patient; LPS and LAS are converted. Other spaces are taken as they are.
What is written is in the space that was declared, and declares none where none was.

Source: the format's definition, https://teem.sourceforge.net/nrrd/format.html
"""

from __future__ import annotations

import gzip
import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from filterlab.io import itk
from filterlab.io.bounded import (
    MAX_HEADER_BYTES,
    Choice,
    Stored,
    VolumeFileError,
    VolumeHeader,
    as_samples,
    beside,
    check_geometry,
    check_size,
    integer,
    number,
    sample_dtype,
    storable,
)
from filterlab.world import ANATOMICAL, SPACES, UNIT, World

if TYPE_CHECKING:
    from filterlab.volume import Volume

_TYPES = {
    "int8": ("signed char", "int8", "int8_t"),
    "uint8": ("uchar", "unsigned char", "uint8", "uint8_t"),
    "int16": ("short", "short int", "signed short", "signed short int", "int16", "int16_t"),
    "uint16": ("ushort", "unsigned short", "unsigned short int", "uint16", "uint16_t"),
    "int32": ("int", "signed int", "int32", "int32_t"),
    "uint32": ("uint", "unsigned int", "uint32", "uint32_t"),
    "int64": (
        *("longlong", "long long", "long long int", "signed long long", "signed long long int"),
        *("int64", "int64_t"),
    ),
    "uint64": ("ulonglong", "unsigned long long", "unsigned long long int", "uint64", "uint64_t"),
    "float32": ("float",),
    "float64": ("double",),
}
TYPES = {alias: name for name, aliases in _TYPES.items() for alias in aliases}
_WRITTEN = {name: aliases[-1] for name, aliases in _TYPES.items()}
_BY_ITK = ("ascii", "text", "txt", "hex")
ENCODINGS = {"raw": "raw", "gzip": "gzip", "gz": "gzip", "bzip2": "bzip2", "bz2": "bzip2"}

_SHORT = {"ras": "right-anterior-superior", "las": "left-anterior-superior", "lps": "left-posterior-superior"}
_SPACES = {name.lower(): name for name in SPACES}
_SPATIAL_KINDS = ("domain", "space")
_UNKNOWN_KINDS = ("", "???", "none")
_ALIASES = {"datafile": "data file", "byteskip": "byte skip", "lineskip": "line skip", "axismins": "axis mins"}
_ALIASES |= {"axismaxs": "axis maxs", "centers": "centerings", "blocksize": "block size"}

PAIRS = "key/value pairs"
MAX_PAIRS = 200  # characters of their keys that are told
MAX_FIELDS = 1000
MAX_VALUE = 4096  # characters of a value that is taken apart; 16 vectors take a third of it
_TAKEN_APART = ("type", "dimension", "sizes", "encoding", "endian", "data file", "byte skip", "line skip", "centerings")
_TAKEN_APART += ("space", "space dimension", "space directions", "space origin", "spacings", "axis mins", "axis maxs")
_TAKEN_APART += ("kinds", "space units", "units")


def read_header(path: Path, frame: int | None = None, channel: int | None = None) -> VolumeHeader:
    """The checked header of an NRRD file. Raises VolumeFileError."""
    with path.open("rb") as file:
        fields = _fields(path, file)
        end = file.tell()
    dimension = integer(path, "dimension", _required(path, fields, "dimension"))
    if not 1 <= dimension <= 16:
        raise VolumeFileError(path, "a dimension from 1 to 16", dimension)
    sizes = check_size(path, [integer(path, "sizes", t) for t in _items(path, fields, "sizes", dimension)])
    axes = _axes(path, sizes, fields)
    size = tuple(sizes[a] for a in axes.space)
    dtype = _dtype(path, fields)
    by_itk = dimension == 3 and _is_exotic(fields)
    stored = None if by_itk else _stored(path, fields, end, sizes[::-1], dtype)
    if stored is None:
        _check_exotic(path, fields, sizes)
    else:
        stored.check()
    affine, world = _affine(path, fields, dimension, axes.space, sizes)
    target = sample_dtype(path, dtype)
    choice = Choice.of(path, *axes.counts(sizes), frame, channel)
    at = axes.at(dimension, choice)[::-1]
    return VolumeHeader(
        path,
        "NRRD",
        size[::-1],
        dtype.name,
        check_geometry(path, affine, world),
        fields["encoding"].lower() if stored is None else stored.encoding,
        {k: v for k, v in fields.items() if k not in ("sizes", "dimension", "type", "encoding")},
        target,
        choice,
        0 if stored is None else stored.held(at),
        lambda: as_samples(
            path, itk.read_nrrd(path, size[::-1], dtype) if stored is None else stored.read(at, target), target
        ),
    )


def _fields(path: Path, file: BinaryIO) -> dict[str, str]:
    """The `field: value` lines up to the empty line (or, detached, the end), names in lower case."""
    magic = file.readline(16)
    if not re.fullmatch(rb"NRRD000[1-5]\r?\n", magic):
        raise VolumeFileError(path, "a first line NRRD0001 … NRRD0005", repr(magic))
    fields: dict[str, str] = {}
    while line := file.readline(MAX_HEADER_BYTES):
        if file.tell() > MAX_HEADER_BYTES:
            raise VolumeFileError(path, f"a header of at most {MAX_HEADER_BYTES} bytes, ended by an empty line", "more")
        text = line.decode("latin-1").rstrip("\r\n")
        if not text:
            return fields
        if text.startswith("#"):
            continue
        if ":=" in text:  # told, not taken: no key changes what is read
            if len(fields.get(PAIRS, "")) < MAX_PAIRS:
                key = text.partition(":=")[0][:MAX_PAIRS]
                fields[PAIRS] = f"{fields[PAIRS]}, {key}" if PAIRS in fields else key
            continue
        name, colon, value = text.partition(": ")
        name = _ALIASES.get(name.lower(), name.lower())
        if not colon or name in fields:
            raise VolumeFileError(path, "every header line to be `field: value`, once", repr(text[:80]))
        if len(fields) == MAX_FIELDS:
            raise VolumeFileError(path, f"at most {MAX_FIELDS} fields in the header", "more")
        if name in _TAKEN_APART and len(value) > MAX_VALUE:
            raise VolumeFileError(path, f"at most {MAX_VALUE} characters in `{name}`", len(value))
        fields[name] = value.strip()
    if "data file" not in fields:
        raise VolumeFileError(path, "an empty line after the header, then samples", "the end of the file")
    return fields


def _required(path: Path, fields: dict[str, str], name: str) -> str:
    if name not in fields:
        raise VolumeFileError(path, f"a header field `{name}`", f"only {', '.join(fields) or 'none'}"[:300])
    return fields[name]


def _items(path: Path, fields: dict[str, str], name: str, count: int) -> list[str]:
    items = _required(path, fields, name).split()
    if len(items) != count:
        raise VolumeFileError(path, f"{count} values in `{name}`", f"{len(items)}: {' '.join(items)[:80]!r}")
    return items


@dataclass(frozen=True)
class Axes:
    """Which axes are of space, which one of time and which one of a voxel's components (None: there is none)."""

    space: tuple[int, int, int]
    time: int | None = None
    components: int | None = None

    def counts(self, sizes: tuple[int, ...]) -> tuple[int, int]:
        """How many frames and channels there are."""
        frames, channels = (1 if axis is None else sizes[axis] for axis in (self.time, self.components))
        return frames, channels

    def at(self, dimension: int, choice: Choice) -> tuple[int | None, ...]:
        """The index that is read of each axis; None: all of it."""
        chosen = dict(zip((self.time, self.components), choice.place, strict=True))
        return tuple(None if a in self.space else chosen.get(a, 0) for a in range(dimension))


def _axes(path: Path, sizes: tuple[int, ...], fields: dict[str, str]) -> Axes:
    """The axes by their kinds and directions; where these say nothing, all three, or those of more than one entry."""
    dimension = len(sizes)
    kinds = [k.lower() for k in _items(path, fields, "kinds", dimension)] if "kinds" in fields else [""] * dimension
    directions: list[list[float] | None] = [None] * dimension
    if "space directions" in fields:
        directions = _vectors(path, fields, "space directions")
        if len(directions) != dimension:
            raise VolumeFileError(path, f"{dimension} space directions", len(directions))
    declared = [a for a in range(dimension) if directions[a] is not None or kinds[a] in _SPATIAL_KINDS]
    others = [a for a in range(dimension) if a not in declared and kinds[a] not in _UNKNOWN_KINDS]
    space = declared if len(declared) == 3 else [a for a in range(dimension) if a not in others]
    if len(space) != 3:  # axes of one entry, of no direction, are of anything
        space = [a for a in range(dimension) if sizes[a] > 1 and a not in others]
    if len(space) != 3:
        got = f"sizes {sizes}, kinds {' '.join(kinds)!r}"[:200]
        raise VolumeFileError(path, "three axes of space, told from others by `kinds` or `space directions`", got)
    rest = [a for a in range(dimension) if a not in space and sizes[a] > 1]
    time = [a for a in rest if kinds[a] == "time"]
    components = [a for a in rest if kinds[a] != "time"]
    if len(time) > 1 or len(components) > 1:
        got = f"sizes {sizes}, kinds {' '.join(kinds)!r}"[:200]
        raise VolumeFileError(path, "at most one axis of time and one of components beside those of space", got)
    return Axes((space[0], space[1], space[2]), next(iter(time), None), next(iter(components), None))


def _is_exotic(fields: dict[str, str]) -> bool:
    """Whether samples are stored in a way that we leave to ITK."""
    return fields.get("encoding", "").lower() in _BY_ITK or fields.get("line skip", "0") != "0"


def _check_exotic(path: Path, fields: dict[str, str], sizes: tuple[int, ...]) -> None:
    """Raises VolumeFileError where there is no SimpleITK, or data that are not here or cannot hold the samples."""
    itk.require_simpleitk(path, f"NRRD data of encoding {fields.get('encoding', 'none')[:40]} and line skips")
    file = beside(path, fields["data file"]) if "data file" in fields else path
    if (length := file.stat().st_size) < math.prod(sizes) and fields["encoding"].lower() in _BY_ITK:
        raise VolumeFileError(path, f"{math.prod(sizes)} numbers as text", f"{length} bytes")


def _dtype(path: Path, fields: dict[str, str]) -> np.dtype:
    name = " ".join(_required(path, fields, "type").lower().split())
    if name not in TYPES:
        raise VolumeFileError(path, f"a type among {', '.join(_WRITTEN.values())}", repr(name[:40]))
    dtype = np.dtype(TYPES[name])
    if dtype.itemsize == 1 or fields.get("encoding", "").lower() in _BY_ITK[:3]:  # text has no order of bytes
        return dtype
    endian = _required(path, fields, "endian").lower()
    if endian not in ("little", "big"):
        raise VolumeFileError(path, "endian: little or big", repr(endian[:40]))
    return dtype.newbyteorder("<" if endian == "little" else ">")


def _stored(path: Path, fields: dict[str, str], end: int, shape: tuple[int, ...], dtype: np.dtype) -> Stored:
    encoding = ENCODINGS.get(_required(path, fields, "encoding").lower())
    if encoding is None:
        expected = f"encoding {', '.join(ENCODINGS)} ({', '.join(_BY_ITK)} for three axes)"
        raise VolumeFileError(path, expected, repr(fields["encoding"][:40]))
    if integer(path, "line skip", fields.get("line skip", "0")) != 0:
        raise VolumeFileError(path, "line skip: 0", fields["line skip"])
    file, offset = path, end
    if "data file" in fields:
        name = fields["data file"]
        if name.split()[:1] == ["LIST"] or "%" in name:
            raise VolumeFileError(path, "one data file", f"a list of files: {name[:80]!r}")
        file, offset = beside(path, name), 0
    skip = integer(path, "byte skip", fields.get("byte skip", "0"))
    stored = Stored(path, file, encoding, offset, max(skip, 0), shape, dtype)
    if skip == -1 and encoding == "raw":  # the samples end where the file ends
        offset = max(offset, file.stat().st_size - stored.nbytes)
        return Stored(path, file, encoding, offset, 0, shape, dtype)
    if skip < 0:
        raise VolumeFileError(path, "a byte skip of 0 or more (or -1 for raw data)", skip)
    return stored


def _affine(
    path: Path, fields: dict[str, str], dimension: int, axes: tuple[int, int, int], sizes: tuple[int, ...]
) -> tuple[np.ndarray, World]:
    """The 4×4 voxel -> world map, and what is declared of the world."""
    if "space" in fields and "space dimension" in fields:
        raise VolumeFileError(path, "`space` or `space dimension`", "both")
    affine = np.eye(4)
    if "space directions" in fields:
        directions = _vectors(path, fields, "space directions")
        for column, axis in enumerate(axes):
            direction = directions[axis]
            if direction is None:
                raise VolumeFileError(path, f"a space direction for axis {axis}", "none")
            affine[:3, column] = direction
    else:
        affine = _per_axis(path, fields, dimension, axes, sizes)
    if "space origin" in fields:
        origin = _vectors(path, fields, "space origin")
        if len(origin) != 1 or origin[0] is None:
            raise VolumeFileError(path, "one vector as space origin", repr(fields["space origin"][:80]))
        affine[:3, 3] = origin[0]
    space = _space(path, fields)
    if space in ANATOMICAL:
        affine = np.diag([*ANATOMICAL[space], 1.0]) @ affine
    return affine, World(space, _unit(path, fields, axes))


def _space(path: Path, fields: dict[str, str]) -> str | None:
    """The space that is declared, by its whole name."""
    if "space" not in fields:
        if integer(path, "space dimension", fields.get("space dimension", "3")) != 3:
            raise VolumeFileError(path, "space dimension: 3", fields["space dimension"])
        return None
    space = fields["space"].lower()
    name = _SPACES.get(_SHORT.get(space, space))
    if name is None:
        raise VolumeFileError(path, f"a space among {', '.join(SPACES)}", repr(fields["space"][:40]))
    return name


def _unit(path: Path, fields: dict[str, str], axes: tuple[int, int, int]) -> str | None:
    """The unit of length, where all axes declare the same; else None."""
    found: set[str] = set()
    if "space units" in fields:
        found = set(_quoted(path, fields, "space units", 3))
    elif "units" in fields and "space" not in fields:
        listed = _quoted(path, fields, "units", integer(path, "dimension", fields["dimension"]))
        found = {listed[a] for a in axes}
    return next(iter(found)) or None if len(found) == 1 else None


def _quoted(path: Path, fields: dict[str, str], name: str, count: int) -> list[str]:
    """`"mm" "mm" "mm"` as texts; ??? and none are empty, and so is what is no quoted text of a few letters."""
    items = re.findall(r'"([^"]*)"|(\S+)', fields[name])
    if len(items) != count:
        raise VolumeFileError(path, f"{count} values in `{name}`", f"{len(items)}: {fields[name][:80]!r}")
    return [quoted if re.fullmatch(UNIT, quoted) else "" for quoted, _ in items]


def _vectors(path: Path, fields: dict[str, str], name: str) -> list[list[float] | None]:
    """`(1,0,0) none (0,1,0)` as lists of three numbers; None for none."""
    text = fields[name]
    if not re.fullmatch(r"\s*((\([^()]*\)|none)\s*)+", text):
        raise VolumeFileError(path, f"vectors (a,b,c) in `{name}`", repr(text[:80]))
    vectors: list[list[float] | None] = []
    for item in re.findall(r"\([^()]*\)|none", text):
        parts = item.strip("()").split(",")
        if item != "none" and len(parts) != 3:
            raise VolumeFileError(path, f"vectors of three numbers in `{name}`", repr(item[:80]))
        vectors.append(None if item == "none" else [number(path, name, p.strip()) for p in parts])
    return vectors


def _per_axis(
    path: Path, fields: dict[str, str], dimension: int, axes: tuple[int, int, int], sizes: tuple[int, ...]
) -> np.ndarray:
    """From spacings and axis mins (or axis mins and maxs); a cell-centred axis begins half a voxel after its min."""

    def values(name: str) -> dict[int, float]:
        if name not in fields:
            return {}
        items = _items(path, fields, name, dimension)
        return {a: number(path, name, items[a]) for a in axes if items[a].lower() != "nan" or name == "spacings"}

    mins, maxs, spacings = values("axis mins"), values("axis maxs"), values("spacings")
    centerings = _items(path, fields, "centerings", dimension) if "centerings" in fields else ["cell"] * dimension
    affine = np.eye(4)
    for column, axis in enumerate(axes):
        node = centerings[axis].lower() == "node"
        if axis in spacings:
            spacing = spacings[axis]
        elif axis in mins and axis in maxs:
            spacing = (maxs[axis] - mins[axis]) / max(sizes[axis] - node, 1)
        else:
            spacing = 1.0
        affine[column, column] = spacing
        affine[column, 3] = mins[axis] + (0.0 if node else 0.5 * spacing) if axis in mins else 0.0
    return affine


def write(volume: Volume, path: Path, stored: str | None = None) -> None:
    """Writes one attached NRRD file, gzip. float16 and bfloat16, which the format lacks, become float32."""
    samples = storable(path, volume, tuple(_WRITTEN), stored)
    affine, world = volume.affine, volume.world
    if world.space in ANATOMICAL:
        affine = np.diag([*ANATOMICAL[world.space], 1.0]) @ affine + 0.0
    vectors = ["(" + ",".join(repr(float(v)) for v in column) + ")" for column in affine[:3].T]
    lines = [
        "NRRD0005",
        "# https://teem.sourceforge.net/nrrd/format.html",
        f"type: {_WRITTEN[samples.dtype.name]}",
        "dimension: 3",
        f"space: {world.space}" if world.space else "space dimension: 3",
        f"sizes: {' '.join(map(str, volume.size))}",
        f"space directions: {' '.join(vectors[:3])}",
        "kinds: domain domain domain",
        f"endian: {'little' if np.little_endian else 'big'}",
        "encoding: gzip",
        *([" ".join(["space units:", *3 * [f'"{world.unit}"']])] if world.unit else []),
        f"space origin: {vectors[3]}",
    ]
    with path.open("wb") as file:
        file.write(("\n".join(lines) + "\n\n").encode("ascii"))
        with gzip.GzipFile(filename="", fileobj=file, mode="wb", compresslevel=6, mtime=0) as stream:
            for block in samples.blocks():
                stream.write(block.data)
