"""Volume files forged field by field: every count, size, offset and payload written as it should be, or not.

Mutations of valid bytes hardly ever make a file whose parts agree about something false. Here a file is described as
its format describes it, and a pen writes the fields: in some files all of them truly (then the file must be read, with
the samples that went in), in others a few of them, or many, with numbers at which readers go wrong. Now and then a
file is heavy: as much of one thing as its format has room for.
"""

from __future__ import annotations

import bz2
import random
import struct
import zlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any, TypeVar

import numpy as np

T = TypeVar("T")

RATES = (0.0, 0.0, 0.02, 0.1, 0.4)  # of false fields, one of them for each file
HEAVY = 0.0005  # of all files
_EDGES = (0, 1, 2, 3, 7, 255, 256, 1000, 32767, 32768, 65535, 65536, 10**6, 2**24, 2**31 - 1, 2**31, 2**32 - 1, 2**40)
_EDGES += (2**62, 2**63 - 1)


@dataclass(frozen=True)
class Forged:
    """A forged volume.

    Attributes:
        files: name -> content.
        path: the name that is loaded.
        samples: what must be read, when nothing in the files is false; else None.
        frame: which volume of a time series is read.
        told: what is false, or heavy.
    """

    files: dict[str, bytes]
    path: str
    samples: np.ndarray | None
    frame: int | None = None
    told: str = ""

    @property
    def size(self) -> int:
        """Bytes of all files."""
        return sum(map(len, self.files.values()))


class Pen:
    """Writes fields: truly, or at a rate that is drawn for each file, falsely; remembers what was false."""

    def __init__(self, seed: int) -> None:
        self.random = random.Random(seed)
        self.rate = self.random.choice(RATES)
        self.heavy = self.random.random() < HEAVY
        self.told: list[str] = []

    def lies(self, what: str) -> bool:
        """Whether this field is false."""
        if self.rate and self.random.random() < self.rate:
            self.told.append(what)
            return True
        return False

    def any_of(self, *choices: T) -> T:
        """One of several true ways."""
        return self.random.choice(choices)

    def field(self, what: str, true: T, *false: Any) -> T:
        """A field with what it should hold, or one of the others."""
        return self.random.choice(false) if self.lies(what) else true

    def number(self, what: str, true: int, bits: int = 63, signed: bool = False) -> int:
        """A whole number, or one near it, or one at an edge, that fits so many bits."""
        if not self.lies(what):
            return true
        value = self.random.choice((true + 1, true - 1, 2 * true, -true, self.random.choice(_EDGES)))
        low, high = (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1) if signed else (0, 2**bits - 1)
        return min(max(value, low), high)

    def samples(self, types: Sequence[str]) -> np.ndarray:
        """A small volume (D, H, W), now and then a larger one, of random or equal samples."""
        size = [self.random.randint(1, 6) for _ in range(3)] if self.random.random() < 0.995 else [40, 30, 20]
        dtype = np.dtype(self.random.choice(types))
        count = size[0] * size[1] * size[2]
        flat = np.frombuffer(self.random.randbytes(count), np.int8) if self.random.random() < 0.8 else np.zeros(count)
        return np.abs(flat).astype(dtype).reshape(size)

    def forged(self, files: dict[str, bytes], path: str, samples: np.ndarray, frame: int | None = None) -> Forged:
        """The file, with what must be read if nothing was false."""
        told = ", ".join([*self.told, *(["heavy"] if self.heavy else [])])
        return Forged(files, path, None if self.told else samples, frame, told)


def order_of(dtype: np.dtype) -> str:
    """little or big"""
    return "big" if dtype.newbyteorder("=") != dtype else "little"


# --- compressed data --------------------------------------------------------------------------------------------------


@lru_cache
def _zeros(encoding: str) -> bytes:
    """16 MiB of them."""
    return _PACK[encoding](bytes(2**24))


def _gzip(content: bytes, level: int = 1, flags: int = 0, front: bytes = b"") -> bytes:
    pack = zlib.compressobj(level, zlib.DEFLATED, -15)
    body = pack.compress(content) + pack.flush()
    tail = struct.pack("<II", zlib.crc32(content), len(content) & 0xFFFFFFFF)
    return b"\x1f\x8b\x08" + bytes([flags]) + bytes(6) + front + body + tail


_PACK: dict[str, Callable[[bytes], bytes]] = {
    "raw": bytes,
    "gzip": _gzip,
    "bzip2": bz2.compress,
    "deflate": lambda content: zlib.compress(content, 9 if len(content) < 2000 else 1),
}


def packed(pen: Pen, content: bytes, encoding: str) -> bytes:
    """The content, compressed; in one piece or several, and sometimes damaged, cut, continued, or a bomb."""
    match encoding:
        case "gzip" if pen.heavy:
            many = pen.any_of(_gzip(b"") * 20_000, _gzip(b"", 1, 8, b"n" * 500_000 + b"\0"))
            data = many + _gzip(content)
        case "gzip":
            cut = pen.any_of(0, 0, len(content) // 2)
            named = pen.any_of((0, b""), (8, b"name\0"), (4, struct.pack("<H", 5) + b"extra"), (16, b"\0"))
            data = (_gzip(content[:cut]) if cut else b"") + _gzip(content[cut:], pen.any_of(0, 1, 9), *named)
        case "bzip2" if pen.heavy:
            data = bz2.compress(b"") * 10_000 + bz2.compress(content)
        case "bzip2":
            cut = pen.any_of(0, 0, len(content) // 2)
            data = (bz2.compress(content[:cut], 1) if cut else b"") + bz2.compress(content[cut:], pen.any_of(1, 9))
        case _:
            data = _PACK[encoding](content)
    if not pen.lies("payload"):
        return data
    at = pen.random.randrange(len(data) + 1)
    return pen.any_of(
        lambda: data[:at],
        lambda: data[:-1],
        lambda: data + pen.any_of(b"?", bytes(1000), data),
        lambda: data[:at] + pen.random.randbytes(3) + data[at + 3 :],
        lambda: _PACK[encoding](content[:-1]),
        lambda: _PACK[encoding](content + b"?"),
        lambda: _zeros(encoding) if encoding != "raw" else content * 20,
        lambda: content,
    )()


# --- NRRD -------------------------------------------------------------------------------------------------------------

_NRRD_TYPES = {"i1": "signed char", "u1": "uchar", "i2": "short", "u2": "ushort", "i4": "int", "u4": "uint32_t"}
_NRRD_TYPES |= {"i8": "longlong", "f4": "float", "f8": "double"}
_TEXTS = ("", "x", "nan", "-1", "1e999", "9" * 40, "0", "none", "(1,2,3)", "()", "(" * 50, "1 " * 3000, "x" * 10**5)


def nrrd(pen: Pen, encoding: str) -> Forged:
    """Attached or detached, three axes or four, any geometry that the format knows."""
    samples = pen.samples(list(_NRRD_TYPES))
    dtype = samples.dtype.newbyteorder(pen.any_of("<", ">"))
    skip = pen.any_of(0, 0, 5)
    one = pen.any_of(None, None, 0, 3)
    sizes = [pen.number("size", n) for n in samples.shape[::-1]]
    if one is not None:
        sizes.insert(one, 1)
    dimension = len(sizes)
    fields = [
        ("type", pen.field("type", _NRRD_TYPES[samples.dtype.str[1:]], "block", "uint64", "double", *_TEXTS)),
        ("dimension", str(pen.number("dimension", dimension))),
        ("sizes", pen.field("sizes", " ".join(map(str, sizes)), "4 3", *_TEXTS)),
        ("endian", pen.field("endian", order_of(dtype), "middle", *_TEXTS)),
        ("encoding", pen.field("encoding", encoding, "raw", "gzip", "bzip2", "hex", "ascii", *_TEXTS)),
        *([("byte skip", str(pen.number("byte skip", skip, signed=True)))] if skip else []),
        *_nrrd_geometry(pen, dimension, one, plain=one is None or min(samples.shape) > 1),
        *pen.any_of([], [("content", "c" * 2000)], [("centerings", " ".join(["cell"] * dimension))]),
    ]
    body = packed(pen, bytes(skip) + samples.astype(dtype).tobytes(), encoding)
    files = {}
    if pen.random.random() < 0.2:
        files["d.data"] = body
        fields.append(("data file", pen.field("data file", "d.data", "../d.data", "/", "LIST", "a%d 1 2 3", *_TEXTS)))
        body = b""
    if pen.lies("twice"):
        fields.append(pen.random.choice(fields))
    if pen.lies("left out"):
        del fields[pen.random.randrange(len(fields))]
    end = pen.any_of("\n", "\n", "\r\n")
    lines = [f"{name}: {value}" for name, value in fields]
    lines += pen.any_of([], ["# comment"], ["key:=value: x"])
    lines += pen.any_of(["#" * 10**6], ["k:=v"] * 10**5, [f"f{i}: 1" for i in range(900)]) if pen.heavy else []
    magic = pen.field("magic", f"NRRD000{pen.any_of(1, 4, 5)}", "NRRD0006", "nrrd")
    head = end.join([magic, *lines]) + end + pen.field("empty line", end, "")
    return pen.forged({"a.nrrd": head.encode() + body, **files}, "a.nrrd", samples)


def _nrrd_geometry(pen: Pen, dimension: int, one: int | None, plain: bool) -> list[tuple[str, str]]:
    """Spacings or directions; unless it is plain, only directions tell which axis is none of space."""

    def per_axis(what: str, along: str) -> str:
        return pen.field(what, " ".join("nan" if a == one else along for a in range(dimension)), *_TEXTS)

    def spacings() -> list[tuple[str, str]]:
        return [("spacings", " ".join("1" if a == one else "0.5" for a in range(dimension)))]

    vectors = iter(["(1,0,0)", "(0,2,0)", "(0,0,0.5)"])
    directions = " ".join("none" if a == one else next(vectors) for a in range(dimension))
    if not plain or pen.random.random() < 0.4:
        return [
            ("space", pen.field("space", pen.any_of("LPS", "right-anterior-superior", "scanner-xyz"), *_TEXTS)),
            ("space directions", pen.field("directions", directions, "(0,0,0) " * dimension, *_TEXTS)),
            ("space origin", pen.field("origin", "(1,2.5,-3e2)", *_TEXTS)),
        ]
    return pen.any_of([], spacings(), [*spacings(), ("axis mins", per_axis("axis mins", "3"))])


# --- NIfTI ------------------------------------------------------------------------------------------------------------

_NIFTI_TYPES = {"u1": 2, "i2": 4, "i4": 8, "f4": 16, "f8": 64, "i1": 256, "u2": 512, "u4": 768, "i8": 1024}
# of version 1 and 2: bytes of the header, then where and how each field stands
_NIFTI_FIELDS = {
    1: (348, {"dim": (40, "8h"), "datatype": (70, "2h"), "pixdim": (76, "8f"), "vox_offset": (108, "f")}),
    2: (540, {"dim": (16, "8q"), "datatype": (12, "2h"), "pixdim": (104, "8d"), "vox_offset": (168, "q")}),
}
_NIFTI_FIELDS[1][1].update(slope=(112, "2f"), codes=(252, "2h"), quatern=(256, "6f"), srow=(280, "12f"))
_NIFTI_FIELDS[2][1].update(slope=(176, "2d"), codes=(344, "2i"), quatern=(352, "6d"), srow=(400, "12d"))
_FLOATS = (0.0, -1.0, 1e30, -1e30, 1e-30, float("nan"), float("inf"))


def nifti(pen: Pen, version: int, encoding: str) -> Forged:
    """A volume or a time series, with extensions, a slope, an sform, a qform or neither."""
    samples = pen.samples(list(_NIFTI_TYPES))
    frames = pen.any_of(None, None, 1, 3)
    frame = None if frames is None else pen.random.randrange(frames)
    order = pen.any_of("<", ">")
    size, places = _NIFTI_FIELDS[version]
    bits = {1: 16, 2: 64}[version]
    extension = pen.any_of(b"", b"", struct.pack(order + "ii", 32, 6) + b"a comment that is 24 byte")
    extension = extension.ljust(500_000, b"\0") if pen.heavy else extension
    start = size + 4 + len(extension)
    dim = [3 if frames is None else 4, *samples.shape[::-1], frames or 1, 1, 1, 1]
    dim = [pen.number("dim", n, bits, signed=True) for n in dim]
    slope = pen.any_of((0.0, 0.0), (1.0, 0.0), (2.0, -1.0))
    values: dict[str, Sequence[float]] = {
        "dim": dim,
        "datatype": (
            pen.field("datatype", _NIFTI_TYPES[samples.dtype.str[1:]], 0, 1, 32, 128, 1280, 1536, 9999, -1),
            pen.number("bitpix", 8 * samples.dtype.itemsize, 16, signed=True),
        ),
        "pixdim": [pen.field("pixdim", x, *_FLOATS) for x in (1, 0.5, 2, 1.5, 1, 1, 1, 1)],
        "vox_offset": [pen.field("vox_offset", start, 0, -352, start + 1, start - 4, 10**6, 2**60, 2**62)],
        "slope": [pen.field("slope", x, float("nan"), float("inf"), 1e300 if version == 2 else 1e38) for x in slope],
        "codes": [pen.field("code", pen.any_of(0, 1, 2), 9, -1, 999) for _ in range(2)],
        "quatern": [pen.field("quatern", x, *_FLOATS) for x in (0.0, 0.6, 0.0, 1.0, 2.0, 3.0)],
        "srow": [pen.field("srow", x, *_FLOATS) for x in (0.5, 0, 0, 1, 0, 2, 0, -5, 0, 0, 1.5, 9)],
    }
    head = bytearray(size)
    struct.pack_into(order + "i", head, 0, pen.number("sizeof_hdr", size, 32, signed=True))
    for name, (at, layout) in places.items():
        struct.pack_into(order + layout, head, at, *values[name])
    magic = pen.field("magic", b"n+1\0" if version == 1 else b"n+2\0\r\n\x1a\n", b"ni1\0", b"n+3\0", b"????")
    struct.pack_into(f"{len(magic)}s", head, 344 if version == 1 else 4, magic)
    body = samples.astype(order + samples.dtype.str[1:]).tobytes() * (frames or 1)
    content = bytes(head) + (b"\1\0\0\0" if extension else bytes(4)) + extension + body
    name = "a.nii.gz" if encoding == "gzip" else "a.nii"
    return pen.forged({name: packed(pen, content, encoding)}, name, _scaled(samples, *slope), frame)


def _scaled(samples: np.ndarray, slope: float, inter: float) -> np.ndarray:
    if slope in (0.0, 1.0):
        return samples
    wide = np.float64 if samples.dtype.itemsize > 2 and samples.dtype != np.float32 else np.float32
    return (slope * samples.astype(np.float64) + inter).astype(wide)


# --- TIFF -------------------------------------------------------------------------------------------------------------

_TIFF_TYPES = ("u1", "i1", "u2", "i2", "u4", "i4", "f4", "f8", "i8", "f2")
_NOISE = (330, 34665, 33000, 34118, 50838, 50839, 65426, 42113, 37706, 34853)  # tags of many vendors


@dataclass
class _Tiff:
    """A TIFF file in the making: a pen, the order of its bytes, classic or big, and what there is of it."""

    pen: Pen
    order: str
    big: bool
    content: bytearray

    def put(self, data: bytes) -> int:
        """Appends data at an even place; tells where that is."""
        self.content += bytes(len(self.content) % 2)
        self.content += data
        return len(self.content) - len(data)

    def entry(self, tag: int, kind: int, values: Sequence[int]) -> bytes:
        """One tag; values that do not fit are put elsewhere."""
        pen, inline, layout = self.pen, 8 if self.big else 4, {1: "B", 2: "B", 3: "H", 4: "I", 5: "I", 16: "Q"}[kind]
        bits = 8 * struct.calcsize("<" + layout)
        values = [pen.number(f"tag {tag}", v, bits) for v in values] if len(values) < 4 else values
        data = struct.pack(f"{self.order}{len(values)}{layout}", *values)
        if len(data) > inline:
            at = pen.number(f"place of {tag}", self.put(data), 8 * inline)
            data = at.to_bytes(inline, "little" if self.order == "<" else "big")
        count = pen.number(f"count of {tag}", len(values) // (2 if kind == 5 else 1), 8 * inline)
        kind = pen.field(f"type of {tag}", kind, 1, 2, 3, 4, 5, 7, 12, 13, 16, 18, 99)
        return struct.pack(self.order + ("HHQ" if self.big else "HHI"), tag, kind, count) + data.ljust(inline, b"\0")

    def directory(self, tags: dict[int, tuple[int, Sequence[int]]], link_at: int) -> int:
        """A directory, linked from a place; tells where its own link stands."""
        entries = [self.entry(tag, *tags[tag]) for tag in sorted(tags)]
        if self.pen.lies("a tag left out"):
            del entries[self.pen.random.randrange(len(entries))]
        count = self.pen.number("tags", len(entries), 64 if self.big else 16)
        at = self.put(struct.pack(self.order + ("Q" if self.big else "H"), count) + b"".join(entries))
        self.link(link_at, self.pen.field("link", at, 0, 8, at + 2, 2**31, link_at))
        return self.put_link()

    def put_link(self) -> int:
        self.content += bytes(8 if self.big else 4)
        return len(self.content) - (8 if self.big else 4)

    def link(self, at: int, value: int) -> None:
        struct.pack_into(self.order + ("Q" if self.big else "I"), self.content, at, value)


def tiff(pen: Pen, encoding: str, big: bool) -> Forged:
    """Strips or tiles, alone or shared, of pages in a chain or of one page by ImageJ; predictors; tags of others."""
    samples = pen.samples(_TIFF_TYPES)
    samples = np.concatenate([samples] * 2) if len(samples) == 1 else samples
    order = pen.any_of("<", ">")
    file = _Tiff(pen, order, big, bytearray({"<": b"II", ">": b"MM"}[order]))
    version = pen.number("version", 43 if big else 42, 16)
    file.content += struct.pack(order + ("HHH" if big else "H"), *((version, 8, 0) if big else (version,)))
    link = file.put_link()
    tiled = pen.random.random() < 0.3
    high, wide = (
        pen.any_of((16, 16), (32, 16)) if tiled else (pen.random.randint(1, samples.shape[1]), samples.shape[2])
    )
    predictor = pen.any_of(1, 2, 3 if samples.dtype.kind == "f" else 2) if encoding == "deflate" else 1
    behind = encoding == "raw" and not tiled and pen.random.random() < 0.1
    shared: dict[bytes, tuple[int, int]] | None = {} if pen.random.random() < 0.3 else None
    samples = np.concatenate([samples] * 300) if pen.heavy and samples.nbytes < 500 and not behind else samples
    description = _imagej(pen, len(samples)) if behind or pen.random.random() < 0.2 else None
    planes = samples[:1] if behind else samples
    for plane in planes:
        if behind:
            strips = _in_one_piece(file, samples, high)
        else:
            pieces = _segments(plane.astype(order + plane.dtype.str[1:]), high, wide, predictor, tiled)
            strips = [_place(file, packed(pen, piece, encoding), shared) for piece in pieces]
        tags: dict[int, tuple[int, Sequence[int]]] = {
            256: (4, [plane.shape[1]]),
            257: (4, [plane.shape[0]]),
            258: (3, [8 * plane.dtype.itemsize]),
            259: (
                3,
                [pen.field("compression", {"raw": 1}.get(encoding, pen.any_of(8, 32946)), 1, 5, 7, 8, 34925, 50000)],
            ),
            262: (3, [1]),
            277: (3, [1]),
            339: (3, [{"u": 1, "i": 2, "f": 3}[plane.dtype.kind]]),
            324 if tiled else 273: (16 if big else 4, [at for at, _ in strips]),
            325 if tiled else 279: (4, [length for _, length in strips]),
        }
        tags |= {322: (4, [wide]), 323: (4, [high])} if tiled else {278: (4, [high])}
        tags |= {317: (3, [predictor])} if predictor > 1 else {}
        if description is not None:
            tags[270] = (2, list(description))
            tags |= {282: (5, [2, 1]), 283: (5, [4, 1])}
        if pen.random.random() < 0.1:
            tags[pen.any_of(*_NOISE)] = (4, [pen.random.randrange(2**32)])
        if pen.lies("depth"):
            tags[32997] = (4, [2] * pen.any_of(1, 2, 300))
        link = file.directory(tags, link)
    return pen.forged({"a.tif": bytes(file.content)}, "a.tif", samples)


def _in_one_piece(file: _Tiff, samples: np.ndarray, high: int) -> list[tuple[int, int]]:
    """Puts all planes, one behind the other; (place, bytes) of the strips of the first."""
    whole = samples.astype(file.order + samples.dtype.str[1:]).tobytes()
    first = file.put(file.pen.field("planes behind", whole, whole[:-1], whole[: len(whole) // len(samples)]))
    row = samples.shape[2] * samples.dtype.itemsize
    strips = range(0, samples.shape[1], high)
    return [(first + top * row, min(high, samples.shape[1] - top) * row) for top in strips]


def _imagej(pen: Pen, planes: int) -> bytes:
    images = pen.number("images", planes, signed=True)
    spacing = pen.field("spacing", "1.5", "nan", "-0", "x", "1e999")
    channels = pen.field("channels", "1", "2", "x", str(2**70))
    return f"ImageJ=1.53t\nimages={images}\nchannels={channels}\nslices={planes}\nspacing={spacing}\n\0".encode()


def _segments(plane: np.ndarray, high: int, wide: int, predictor: int, tiled: bool) -> list[bytes]:
    """The bytes of strips or (padded) tiles, differenced as the predictor says."""
    if tiled:
        rows, columns = plane.shape
        plane = np.pad(plane, ((0, -rows % high), (0, -columns % wide)))
    found = []
    for top in range(0, plane.shape[0], high):
        for left in range(0, plane.shape[1], wide):
            block = np.ascontiguousarray(plane[top : top + high, left : left + wide])
            if predictor == 2:
                words = block.view(block.dtype.str.replace("i", "u").replace("f", "u"))
                block = np.concatenate([words[:, :1], words[:, 1:] - words[:, :-1]], axis=1).astype(words.dtype)
            elif predictor == 3:
                big = block.astype(block.dtype.newbyteorder(">")).view(np.uint8)
                bytewise = big.reshape(*block.shape, -1).swapaxes(1, 2).reshape(len(block), -1)
                block = np.concatenate([bytewise[:, :1], bytewise[:, 1:] - bytewise[:, :-1]], axis=1)
            found.append(block.tobytes())
    return found


def _place(file: _Tiff, data: bytes, shared: dict[bytes, tuple[int, int]] | None) -> tuple[int, int]:
    """Where a strip is put, and its length; equal ones share a place where that is wanted."""
    if shared is None:
        return file.put(data), len(data)
    if data not in shared:
        shared[data] = file.put(data), len(data)
    return shared[data]


# --- NumPy ------------------------------------------------------------------------------------------------------------

_NUMPY_TYPES = ("u1", "i1", ">u2", "<i2", ">i4", "<u4", "<i8", "f2", "<f4", ">f8", "?")
_NOT_SHAPES = ("()", "(1,)", "(-1, 2, 3)", "(True, 2, 3)", "(2**9, 1, 1)", "(" * 3000, "(1,) * 10**9", "[1, 2, 3]")
_NOT_TYPES = ("|O", "<c8", "|S9999999", "<U3", "<M8[s]", "i4,f4", "(1000000,)i4", "<u8", "", "x" * 5000)


def _npy(pen: Pen, samples: np.ndarray) -> bytes:
    dtype, fortran = samples.dtype, pen.any_of(False, True)
    shape = str(tuple(pen.number("shape", n, signed=True) for n in samples.shape))
    fields = {
        "descr": repr(pen.field("descr", dtype.str, *_NOT_TYPES)),
        "fortran_order": pen.field("order", str(fortran), "1", "None", "[]"),
        "shape": pen.field("shape", shape, *_NOT_SHAPES),
    }
    if pen.lies("left out"):
        del fields[pen.random.choice(list(fields))]
    text = "{" + ", ".join(f"'{name}': {value}" for name, value in fields.items()) + "}"
    text = pen.field("header", text, "[]", "{" * 4000, "1" * 9000, "(" + "1," * 4000 + ")", "x" * 70_000)
    text = text.ljust(pen.any_of(0, 118, 9000)) + "\n"
    version = pen.any_of(1, 2)
    if len(text) > 65535:
        version = 2
    length = pen.number("header length", len(text), 16 * version)
    head = (
        b"\x93NUMPY"
        + bytes([pen.number("version", version, 8), 0])
        + struct.pack("<H" if version == 1 else "<I", length)
    )
    return head + text.encode() + samples.tobytes("F" if fortran else "C")


def npy(pen: Pen) -> Forged:
    """An array in either order; now and then of five axes."""
    samples = pen.samples(_NUMPY_TYPES)
    samples = samples[None, None] if pen.random.random() < 0.1 else samples
    content = _npy(pen, samples)
    if pen.lies("payload"):
        content = pen.any_of(content[:-1], content + b"?", content[:20], b"", content + bytes(10_000))
    return pen.forged({"a.npy": content}, "a.npy", samples)


def npz(pen: Pen, encoding: str) -> Forged:
    """An archive of samples and perhaps geometry, of whose entries every number may be false, and which may overlap."""
    samples = pen.samples(_NUMPY_TYPES)
    members = {"samples.npy": _npy(pen, samples)}
    if pen.random.random() < 0.5:
        members["affine.npy"] = _npy(pen, np.diag([1.0, 2.0, 3.0, 1.0]))
    elif pen.random.random() < 0.5:
        members |= {"spacing.npy": _npy(pen, np.array([1.0, 2.0, 0.5])), "origin.npy": _npy(pen, np.zeros(3, "f4"))}
    content, entries = bytearray(), []
    for name, member in members.items():
        entries.append(_zip_entry(pen, content, name.encode(), member, encoding))
    for i in range(2500 if pen.heavy else pen.any_of(0, 0, 0, 5)):  # other names of the same data
        entries.append(_renamed(entries[0], b"other%04d.n" % i))
    if pen.lies("order of entries"):
        pen.random.shuffle(entries)
    directory = b"".join(entries)
    counts = [pen.number("entries", len(entries), 16) for _ in range(2)]
    sizes = (pen.number("directory", len(directory), 32), pen.number("place of directory", len(content), 32))
    comment = pen.any_of(b"", b"", b"a comment")
    end = b"PK\5\6" + struct.pack("<HHHHIIH", 0, 0, *counts, *sizes, pen.number("comment", len(comment), 16)) + comment
    return pen.forged({"a.npz": bytes(content) + directory + end}, "a.npz", samples)


def _zip_entry(pen: Pen, content: bytearray, name: bytes, member: bytes, encoding: str) -> bytes:
    """Appends a member; tells its entry in the directory."""
    method = pen.field("method", 8 if encoding == "deflate" else 0, 0, 8, 12, 14, 99)
    data = packed(pen, member, encoding)
    data = data[2:-4] if encoding == "deflate" and len(data) > 6 else data  # no header and checksum of zlib
    wide = pen.any_of(False, True)  # sizes in an extra field, as for members beyond 4 GB
    true = len(member), len(data)
    told = [pen.number("size", n, 32) for n in true]
    extra = struct.pack("<HHQQ", 1, 16, *told) if wide else b""
    sizes = (2**32 - 1,) * 2 if wide else (told[1], told[0])
    at = pen.number("place of a member", len(content), 32)
    flags = pen.field("flags", 0, 1, 8, 64, 2**15)
    both = struct.pack(
        "<HHHHIIIHH", flags, method, 0, 33, pen.number("crc", zlib.crc32(member), 32), *sizes, len(name), len(extra)
    )
    content += b"PK\3\4" + struct.pack("<H", 45) + both + name + extra + data
    return b"PK\1\2" + struct.pack("<HH", 45, 45) + both + struct.pack("<HHHII", 0, 0, 0, 0, at) + name + extra


def _renamed(entry: bytes, name: bytes) -> bytes:
    """The entry of samples.npy under another name of as many bytes, with geometry's place in `npz` left alone."""
    return entry.replace(b"samples.npy", name[:11], 1)


# --- raw --------------------------------------------------------------------------------------------------------------

_RAW_TYPES = ("uint8", "int8", "uint16", "int16", "uint32", "int32", "int64", "float16", "float32", "float64")
_YAML = (
    "[",
    "&a [*a]",
    "!!python/name:os.system",
    ".nan",
    "1e999",
    "[1, 2]",
    "{a: 1}",
    "''",
    "9" * 500,
    "[" * 100,
    "\t",
)
_YAML += ("[" + "1," * 300 + "]", "- " * 50, "x" * 1000, "\x01")


def raw(pen: Pen) -> Forged:
    """Samples with a sidecar, of which every value may be false."""
    samples = pen.samples(_RAW_TYPES)
    dtype, offset = samples.dtype.newbyteorder(pen.any_of("<", ">")), pen.any_of(0, 0, 7)
    lines = {
        "size": str([pen.number("size", n, signed=True) for n in samples.shape[::-1]]),
        "dtype": samples.dtype.name,
        "byte_order": order_of(dtype),
        "offset": str(pen.number("offset", offset, signed=True)),
    }
    lines |= pen.any_of(
        {}, {"spacing": "[1, 2, 0.5]"}, {"spacing": "[1, 1, 1]", "origin": "[4, -5, 1e-3]"}, {"file": "a.raw"}
    )
    lines = {name: pen.field(name, value, *_YAML) for name, value in lines.items()}
    if pen.lies("unknown key"):
        lines[pen.any_of("sizes", "x" * 9000, "<<", "1")] = "1"
    if pen.lies("left out"):
        del lines[pen.random.choice(list(lines))]
    if pen.heavy:
        pen.told.append("many keys")
        lines |= pen.any_of({f"k{i}": "1" for i in range(1500)}, {"size": "[" + "1," * 8000 + "]"}, {"x": "x" * 15_000})
    text = "".join(f"{name}: {value}\n" for name, value in lines.items())
    body = packed(pen, bytes(offset) + samples.astype(dtype).tobytes(), "raw")
    return pen.forged({"a.raw": body, "a.raw.yaml": text.encode()}, "a.raw", samples)


FORGERS: dict[str, Callable[[Pen], Forged]] = {
    **{f"NRRD {encoding}": partial(nrrd, encoding=encoding) for encoding in ("raw", "gzip", "bzip2")},
    **{
        f"NIfTI-{version} {encoding}": partial(nifti, version=version, encoding=encoding)
        for version in (1, 2)
        for encoding in ("raw", "gzip")
    },
    **{
        f"{'BigTIFF' if big else 'TIFF'} {encoding}": partial(tiff, encoding=encoding, big=big)
        for big in (False, True)
        for encoding in ("raw", "deflate")
    },
    "npy": npy,
    **{f"npz {encoding}": partial(npz, encoding=encoding) for encoding in ("raw", "deflate")},
    "raw": raw,
}
