"""What every volume format shares: a header that is checked before it is believed, and reading that cannot run away.

A file is untrusted input. Before anything of the size that a header claims is allocated, the claim is compared with
the length of the file (or, deflated, with what that length can expand to) and with the caller's `max_bytes`. What is
decompressed grows as its data arrive, and ends with the first byte beyond the claim.
"""

from __future__ import annotations

import bz2
import gzip
import math
import os
import re
import zlib
from collections.abc import Callable, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch
from torch import Tensor

from filterlab.volume import Geometry, Volume

BLOCK = 2**20
MAX_HEADER_BYTES = 2**20
MAX_AXIS = 2**31 - 1

MAX_SKIP = 2**26  # bytes passed over in bzip2 data, of which a few hold any number

# The most that one compressed byte can become: of deflate 258 bytes per 2 bits. Of bzip2 a million and more (268 MB of
# zeros are 208 bytes): no ratio tells true claims from false ones.
EXPANSION = {"raw": 1, "deflate": 1032, "gzip": 1032}

# Stored type -> type of the samples. torch has no arithmetic for uint16 and uint32: they widen to the next signed type.
SAMPLE_TYPES = {
    "bool": "uint8",
    "uint8": "uint8",
    "int8": "int8",
    "int16": "int16",
    "uint16": "int32",
    "int32": "int32",
    "uint32": "int64",
    "int64": "int64",
    "float16": "float16",
    "float32": "float32",
    "float64": "float64",
}


class VolumeFileError(ValueError):
    """A volume file that cannot be read or written as asked; names the file, what was expected and what came."""

    def __init__(self, path: str | os.PathLike[str], expected: str, got: object) -> None:
        self.path, self.expected, self.got = Path(path), expected, got
        super().__init__(f"{path}: expected {expected}; got {got}")


@dataclass(frozen=True)
class VolumeHeader:
    """What a volume file says about itself, checked, without its voxels.

    Attributes:
        path: the file.
        format: "NRRD", "NIfTI", "TIFF", "npy", "npz" or "raw".
        shape: of the samples, (D, H, W) or (N, C, D, H, W).
        stored: the type in the file, a NumPy name: "uint16".
        geometry: voxel -> world.
        encoding: "raw", "gzip", … as the format calls it.
        world: what the file says its world axes are ("RAS"), or None.
        fields: other lines of the header, for people to read.
        dtype: of the samples; the stored type, or wider where torch lacks that or values are rescaled.
    """

    path: Path
    format: str
    shape: tuple[int, ...]
    stored: str
    geometry: Geometry
    encoding: str = "raw"
    world: str | None = None
    fields: dict[str, str] = field(default_factory=dict)
    dtype: torch.dtype = torch.uint8
    _read: Callable[[], Tensor] | None = field(default=None, repr=False, compare=False)

    @property
    def size(self) -> tuple[int, int, int]:
        """Voxels along x, y, z."""
        d, h, w = self.shape[-3:]
        return w, h, d

    @property
    def spacing(self) -> tuple[float, float, float]:
        return self.geometry.spacing

    @property
    def origin(self) -> tuple[float, float, float]:
        return self.geometry.origin

    @property
    def affine(self) -> np.ndarray:
        return self.geometry.affine

    @property
    def nbytes(self) -> int:
        """Bytes of the samples in memory."""
        return math.prod(self.shape) * max(self.dtype.itemsize, np.dtype(self.stored).itemsize)

    def read(self, max_bytes: int) -> Tensor:
        """The samples. Raises VolumeFileError if they need more than `max_bytes` or the file is damaged."""
        if self.nbytes > max_bytes:
            raise VolumeFileError(
                self.path, f"at most {max_bytes} bytes of samples (max_bytes)", f"{self.nbytes} bytes"
            )
        assert self._read is not None
        samples = self._read()
        assert samples.shape == self.shape
        assert samples.dtype == self.dtype
        return samples


def sample_dtype(path: Path, stored: np.dtype) -> torch.dtype:
    """The torch type for a stored NumPy type. Raises VolumeFileError for objects, records, complex numbers, text …"""
    name = SAMPLE_TYPES.get(stored.name)
    if name is None or stored.shape or stored.fields:
        raise VolumeFileError(path, f"samples of a type among {', '.join(SAMPLE_TYPES)}", f"{str(stored)[:80]}")
    return getattr(torch, name)


def check_size(path: Path, size: Sequence[int]) -> tuple[int, ...]:
    """Sizes of axes as positive ints. Raises VolumeFileError."""
    values = tuple(int(n) for n in size)
    if any(not 1 <= n <= MAX_AXIS for n in values):
        raise VolumeFileError(path, f"sizes from 1 to {MAX_AXIS} along every axis", f"{list(values)}")
    return values


def check_geometry(path: Path, affine: np.ndarray) -> Geometry:
    """The geometry of a 4×4 affine. Raises VolumeFileError if it is not finite, absurd in size, or singular."""
    a = np.asarray(affine, dtype=np.float64)
    if a.shape != (4, 4) or not np.isfinite(a).all() or np.abs(a).max() > 1e60:
        raise VolumeFileError(path, "an affine of finite numbers", a.tolist())
    if a[3].tolist() != [0, 0, 0, 1]:
        raise VolumeFileError(path, "an affine with the last row 0 0 0 1", a[3].tolist())
    try:
        if np.abs(a[:3, :3]).max(axis=0).min() < 1e-60:
            raise ValueError
        return Geometry.of(affine=a + 0.0)  # + 0.0: no negative zeros
    except ValueError:
        what = "voxel steps along x, y, z that span space (an invertible affine)"
        raise VolumeFileError(path, what, a.tolist()) from None


def scaled(spacing: Sequence[float], origin: Sequence[float]) -> np.ndarray:
    """The 4×4 affine of a spacing and an origin."""
    affine = np.diag([*spacing, 1.0])
    affine[:3, 3] = origin
    return affine


def number(path: Path, what: str, text: str) -> float:
    """A finite decimal number. Raises VolumeFileError."""
    if not re.fullmatch(r"[-+]?(\d{1,400}\.?\d{0,400}|\.\d{1,400})([eE][-+]?\d{1,4})?", text, re.ASCII):
        raise VolumeFileError(path, f"a finite number for {what}", repr(text[:40]))
    value = float(text)
    if not math.isfinite(value):
        raise VolumeFileError(path, f"a finite number for {what}", repr(text[:40]))
    return value


def integer(path: Path, what: str, text: str) -> int:
    """A decimal integer of at most 18 digits. Raises VolumeFileError."""
    if not re.fullmatch(r"[-+]?\d{1,18}", text, re.ASCII):
        raise VolumeFileError(path, f"an integer of at most 18 digits for {what}", repr(text[:40]))
    return int(text)


def regular_file(path: Path) -> Path:
    """The path, if it is a file (no folder, pipe or device). Raises FileNotFoundError or VolumeFileError."""
    if not path.exists():
        raise FileNotFoundError(f"{path}: expected a volume file; got no file of this name")
    if not path.is_file():
        raise VolumeFileError(path, "a file", "a folder, pipe or device")
    return path


def beside(header: Path, name: str) -> Path:
    """The data file that a header names: in the header's folder or below, links followed.

    Raises:
        VolumeFileError: an absolute path, one that leaves the folder (by `..` or a link), or no file.
    """
    folder = Path(os.path.realpath(header)).parent
    expected = "a data file in the same folder or below"
    if not name or "\0" in name or Path(name).is_absolute() or ".." in Path(name).parts:
        raise VolumeFileError(header, expected, repr(name[:200]))
    try:
        data = Path(os.path.realpath(folder / name))
        inside, there = data.is_relative_to(folder), data.is_file()
    except OSError as error:  # a name that is too long
        raise VolumeFileError(header, expected, f"{name[:200]!r} ({error.strerror})") from None
    if not inside:
        raise VolumeFileError(header, expected, f"{name[:200]!r}, a link to a place outside")
    if not there:
        raise VolumeFileError(header, expected, f"{name[:200]!r}, which is no file")
    return data


@dataclass(frozen=True)
class Stored:
    """Where the samples lie: their bytes, row-major in `shape`, in a file from `offset` on.

    `encoding` is raw, gzip or bzip2; `offset` counts bytes of the file. `skip` counts bytes after decompression.
    """

    header: Path
    file: Path
    encoding: str
    offset: int
    skip: int
    shape: tuple[int, ...]
    dtype: np.dtype

    @property
    def nbytes(self) -> int:
        return math.prod(self.shape) * self.dtype.itemsize

    def check(self) -> None:
        """Compares the claimed bytes with the length of the file. Raises VolumeFileError."""
        available = max(self.file.stat().st_size - self.offset, 0)
        claimed = self.nbytes + self.skip
        expected = f"{claimed} bytes of samples for {self.shape} {self.dtype.name}"
        if self.encoding == "raw" and available != claimed:
            raise VolumeFileError(self.header, expected, f"{available} bytes")
        if self.encoding in EXPANSION and claimed > EXPANSION[self.encoding] * available:
            got = f"{available} bytes of {self.encoding} data, which cannot hold that many"
            raise VolumeFileError(self.header, expected, got)
        if self.encoding not in EXPANSION and self.skip > MAX_SKIP:
            raise VolumeFileError(self.header, f"at most {MAX_SKIP} bytes before the samples", self.skip)

    def read(self) -> np.ndarray:
        """The samples in native byte order, writable and contiguous."""
        self.check()
        with self.file.open("rb") as file:
            file.seek(self.offset)
            with damaged(self.header, f"{self.encoding} data of {self.nbytes} bytes"):
                stream = decompressed(file, self.encoding)
                skip_bytes(self.header, stream, self.skip)
                buffer = read_exactly(self.header, stream, self.nbytes, exact_length=self.encoding == "raw")
        return native(buffer, self.dtype, self.shape)


def decompressed(file: BinaryIO, encoding: str) -> BinaryIO:
    match encoding:
        case "gzip":
            return gzip.GzipFile(fileobj=file)  # type: ignore[return-value]
        case "bzip2":
            return bz2.BZ2File(file)  # type: ignore[return-value]
        case _:
            return file


@contextmanager
def damaged(path: Path, expected: str):
    """Turns what decompressors raise on damaged data into VolumeFileError."""
    try:
        yield
    except (EOFError, OSError, zlib.error) as error:
        if isinstance(error, OSError) and error.errno is not None:  # the disk's fault, not the file's
            raise
        raise VolumeFileError(path, expected, f"damaged or truncated data ({error})") from None


def skip_bytes(path: Path, stream: BinaryIO, count: int) -> None:
    while count > 0:
        block = stream.read(min(count, BLOCK))
        if not block:
            raise VolumeFileError(path, f"{count} more bytes before the samples", "the end of the data")
        count -= len(block)


def read_exactly(path: Path, stream: BinaryIO, count: int, *, exact_length: bool) -> bytearray | np.ndarray:
    """`count` bytes and then the end of the stream. Raises VolumeFileError if it is shorter or longer.

    A length that was compared with the file's (`exact_length`) is allocated at once; else memory grows with what is
    really there, so that a header that lies costs no more than the data it has.
    """
    if exact_length:
        whole = np.empty(count, np.uint8)
        done = 0
        while done < count and (n := stream.readinto(memoryview(whole)[done : done + 64 * BLOCK])):  # type: ignore[attr-defined]
            done += n
        buffer = whole
    else:
        buffer = bytearray()
        while len(buffer) < count and (block := stream.read(min(BLOCK, count - len(buffer)))):
            buffer += block
        done = len(buffer)
    if done < count:
        raise VolumeFileError(path, f"{count} bytes of samples", f"the end of the data after {done}")
    if stream.read(1):
        raise VolumeFileError(path, f"{count} bytes of samples", "more than that")
    return buffer


def native(buffer: bytearray | np.ndarray, dtype: np.dtype, shape: tuple[int, ...]) -> np.ndarray:
    """The bytes as an array in native byte order, swapped in place."""
    array = np.frombuffer(buffer, dtype=dtype)
    if not dtype.isnative:
        array = array.byteswap(inplace=True).view(dtype.newbyteorder("="))
    return array.reshape(shape)


def as_tensor(array: np.ndarray, dtype: torch.dtype) -> Tensor:
    """A contiguous, writable tensor of that type; shares the array's memory where it can."""
    wanted = np.dtype(str(dtype).removeprefix("torch."))
    array = np.ascontiguousarray(array if array.dtype == wanted else array.astype(wanted))
    return torch.from_numpy(array if array.flags.writeable else array.copy())


def storable(path: Path, volume: Volume, types: Sequence[str]) -> np.ndarray:
    """The (D, H, W) samples of a volume in one of the types; float16 and bfloat16 widen to float32 where they must.

    Raises VolumeFileError for a batch and for any other type.
    """
    samples = volume.samples.detach().cpu()
    if samples.dtype in (torch.float16, torch.bfloat16):
        samples = samples.float()
    name = str(samples.dtype).removeprefix("torch.")
    if samples.ndim != 3 or name not in types:
        raise VolumeFileError(path, f"samples (D, H, W) of a type among {', '.join(types)}", f"{volume}")
    return samples.contiguous().numpy()


def rescaled(array: np.ndarray, slope: float, intercept: float, dtype: torch.dtype) -> Tensor:
    """slope · value + intercept, computed in float64 plane by plane and stored as `dtype`."""
    out = torch.empty(array.shape, dtype=dtype)
    with np.errstate(over="ignore", invalid="ignore"):
        for source, target in zip(array, out, strict=True):
            target.copy_(torch.from_numpy(source.astype(np.float64) * slope + intercept))
    return out
