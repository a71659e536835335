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
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, BinaryIO

import numpy as np

from filterlab.geometry import Geometry
from filterlab.io.warned import warn
from filterlab.io.watching import tell_done
from filterlab.world import UNDECLARED, World

if TYPE_CHECKING:
    import torch

    from filterlab.volume import Volume

BLOCK = 2**20
MAX_HEADER_BYTES = 2**20
MAX_AXIS = 2**31 - 1

MAX_SKIP = 2**26  # bytes passed over in bzip2 data, of which a few hold any number

# The most that one compressed byte can become: of deflate 258 bytes per 2 bits. Of bzip2 a million and more (268 MB of
# zeros are 208 bytes): no ratio tells true claims from false ones.
EXPANSION = {"raw": 1, "deflate": 1032, "gzip": 1032}

BYTE = np.dtype("uint8")

# Stored type -> type of the samples. torch has no arithmetic for uint16 to uint64: they widen to the next signed type,
# and what int64 cannot hold is refused.
SAMPLE_TYPES = {
    "bool": "uint8",
    "uint8": "uint8",
    "int8": "int8",
    "int16": "int16",
    "uint16": "int32",
    "int32": "int32",
    "uint32": "int64",
    "int64": "int64",
    "uint64": "int64",
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
class Choice:
    """How many volumes a file holds, and which of them is read.

    Attributes:
        frames, channels: how many there are, over time and of values per voxel.
        frame, channel: the chosen ones, from 0; None: none is, which only a file of one frame (channel) answers.
    """

    frames: int = 1
    channels: int = 1
    frame: int | None = None
    channel: int | None = None

    @classmethod
    def of(cls, path: Path, frames: int, channels: int, frame: int | None, channel: int | None) -> Choice:
        """The choice, checked. Raises VolumeFileError for a frame or channel that is not there."""
        for what, index, count in (("frame", frame, frames), ("channel", channel, channels)):
            if index is not None and (not isinstance(index, int) or isinstance(index, bool) or not 0 <= index < count):
                raise VolumeFileError(path, f"a {what} from 0 to {count - 1}", f"{what} {index!r}")
        return cls(frames, channels, frame, channel)

    @property
    def place(self) -> tuple[int, int]:
        """The frame and the channel that are read."""
        return self.frame or 0, self.channel or 0

    def check(self, path: Path) -> None:
        """Raises VolumeFileError where one of several volumes has to be chosen."""
        for what, index, count in (("frame", self.frame, self.frames), ("channel", self.channel, self.channels)):
            if index is None and count > 1:
                kind = "time series" if what == "frame" else "file of several values per voxel"
                choice = f"{what}=0 to {what}={count - 1}"
                raise VolumeFileError(path, f"a choice among its {count} {what}s, {choice}: this is a {kind}", "none")


@dataclass(frozen=True)
class VolumeHeader:
    """What a volume file says about itself, checked, without its voxels.

    Attributes:
        path: the file.
        format: "NRRD", "NIfTI", "TIFF", "npy", "npz", "raw" or "ITK".
        shape: of the samples, (D, H, W) or (N, C, D, H, W).
        stored: the type in the file, a NumPy name: "uint16".
        geometry: voxel -> world, and what the file declares of the world.
        encoding: "raw", "gzip", … as the format calls it.
        fields: other lines of the header, for people to read.
        sample_type: of the samples; the stored type, or wider where torch lacks that or values are rescaled.
        choice: which volume of several these samples are.
        held: values that are read to get at the samples, where they are more.
    """

    path: Path
    format: str
    shape: tuple[int, ...]
    stored: str
    geometry: Geometry
    encoding: str = "raw"
    fields: dict[str, str] = field(default_factory=dict)
    sample_type: np.dtype = BYTE
    choice: Choice = Choice()
    held: int = 0
    _read: Callable[[], np.ndarray] | None = field(default=None, repr=False, compare=False)

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
    def world(self) -> World:
        """What the file declares of its world."""
        return self.geometry.world

    @property
    def dtype(self) -> torch.dtype:
        """The type of the samples, as torch has it."""
        import torch

        return getattr(torch, self.sample_type.name)

    @property
    def nbytes(self) -> int:
        """Bytes of the samples in memory, or of what is read to get at them."""
        return max(math.prod(self.shape), self.held) * max(self.sample_type.itemsize, np.dtype(self.stored).itemsize)

    def check_choice(self) -> None:
        """Raises VolumeFileError where the file holds several volumes and none was chosen."""
        if len(self.shape) == 3:
            self.choice.check(self.path)

    def read(self, max_bytes: int) -> np.ndarray:
        """The samples, contiguous, writable, in native byte order.

        Raises VolumeFileError if they need more than `max_bytes`, none of several volumes was chosen, or the file is
        damaged.
        """
        self.check_choice()
        if self.nbytes > max_bytes:
            raise VolumeFileError(
                self.path, f"at most {max_bytes} bytes of samples (max_bytes)", f"{self.nbytes} bytes"
            )
        assert self._read is not None
        samples = self._read()
        assert samples.shape == self.shape
        assert samples.dtype == self.sample_type
        return samples


def sample_dtype(path: Path, stored: np.dtype) -> np.dtype:
    """The type that samples of a stored type are held as.

    Raises VolumeFileError for objects, records, complex numbers, text …
    """
    name = SAMPLE_TYPES.get(stored.name)
    if name is None or stored.shape or stored.fields:
        raise VolumeFileError(path, f"samples of a type among {', '.join(SAMPLE_TYPES)}", f"{str(stored)[:80]}")
    return np.dtype(name)


def check_size(path: Path, size: Sequence[int]) -> tuple[int, ...]:
    """Sizes of axes as positive ints. Raises VolumeFileError."""
    values = tuple(int(n) for n in size)
    if any(not 1 <= n <= MAX_AXIS for n in values):
        raise VolumeFileError(path, f"sizes from 1 to {MAX_AXIS} along every axis", f"{list(values)}")
    return values


def check_geometry(path: Path, affine: np.ndarray, world: World = UNDECLARED) -> Geometry:
    """The geometry of a 4×4 affine in a world. Raises VolumeFileError if it is not finite, absurd, or singular."""
    a = np.asarray(affine, dtype=np.float64)
    if a.shape != (4, 4) or not np.isfinite(a).all() or np.abs(a).max() > 1e60:
        raise VolumeFileError(path, "an affine of finite numbers", a.tolist())
    if a[3].tolist() != [0, 0, 0, 1]:
        raise VolumeFileError(path, "an affine with the last row 0 0 0 1", a[3].tolist())
    try:
        if np.abs(a[:3, :3]).max(axis=0).min() < 1e-60:
            raise ValueError
        return Geometry.of(affine=a + 0.0, world=world)  # + 0.0: no negative zeros
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


def regular_file(path: Path, what: str = "a volume file") -> Path:
    """The path, if it is a file (no folder, pipe or device). Raises FileNotFoundError or VolumeFileError."""
    if not path.exists():
        raise FileNotFoundError(f"{path}: expected {what}; got no file of this name")
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

    def check(self, *, exact: bool = False) -> None:
        """Compares the claimed bytes with the length of the file.

        Raises VolumeFileError; for bytes behind raw samples only if they have to end the file (`exact`).
        """
        available = max(self.file.stat().st_size - self.offset, 0)
        claimed = self.nbytes + self.skip
        expected = f"{claimed} bytes of samples for {self.shape} {self.dtype.name}"
        if self.encoding == "raw" and (available < claimed or (exact and available != claimed)):
            raise VolumeFileError(self.header, expected, f"{available} bytes")
        if self.encoding in EXPANSION and claimed > EXPANSION[self.encoding] * available:
            got = f"{available} bytes of {self.encoding} data, which cannot hold that many"
            raise VolumeFileError(self.header, expected, got)
        if self.encoding not in EXPANSION and self.skip > MAX_SKIP:
            raise VolumeFileError(self.header, f"at most {MAX_SKIP} bytes before the samples", self.skip)

    def read(self, at: Sequence[int | None] = (), target: np.dtype | None = None) -> np.ndarray:
        """The samples in native byte order, writable and contiguous.

        Args:
            at: for each of the first axes, the index that is read of it; None: all of it.
            target: the type that they are to have in the end. Wider integers are made in place, where all is read.
        """
        self.check()
        with self.file.open("rb") as file:
            file.seek(self.offset)
            with damaged(self.header, f"{self.encoding} data of {self.nbytes} bytes"):
                stream = decompressed(file, self.encoding)
                skip_bytes(self.header, stream, self.skip)
                raw = self.encoding == "raw"
                return read_array(self.header, stream, self.shape, self.dtype, at, raw=raw, target=target)

    def held(self, at: Sequence[int | None]) -> int:
        """How many values `read(at)` reads at once."""
        return math.prod(self.shape[_leading(at) :])


def _leading(at: Sequence[int | None]) -> int:
    """How many axes in front are read at an index: what is read of them lies in one piece."""
    return next((i for i, index in enumerate(at) if index is None), len(at))


def read_array(
    path: Path,
    stream: BinaryIO,
    shape: tuple[int, ...],
    dtype: np.dtype,
    at: Sequence[int | None],
    *,
    raw: bool,
    target: np.dtype | None = None,
) -> np.ndarray:
    """The array of that shape in a stream; of axes with an index in `at`, what lies there; see `Stored.read`.

    All of it is passed over, so that damage anywhere is found. What comes behind it is told (of raw data, elsewhere).
    """
    leading = _leading(at)
    first = int(np.ravel_multi_index(at[:leading], shape[:leading])) if leading else 0  # type: ignore[arg-type]
    parts, count = math.prod(shape[:leading]), math.prod(shape[leading:]) * dtype.itemsize
    skip_bytes(path, stream, first * count)
    rest = [*at, *[None] * (len(shape) - len(at))][leading:]
    left = [n for n, index in zip(shape[leading:], rest, strict=True) if index is None]
    whole = math.prod(left) == math.prod(shape[leading:])
    times = target.itemsize // dtype.itemsize if target is not None and whole and target.kind == "i" else 1
    buffer = read_exactly(path, stream, count, allocate=raw, progress=tell_done, times=times)
    skip_bytes(path, stream, (parts - 1 - first) * count)
    _tell_rest(path, stream, parts * count)
    array = native(buffer, dtype, shape[leading:])
    if whole:
        array = array.reshape(left)
        return array if times == 1 else _widened(array, np.frombuffer(buffer, target).reshape(left))
    return np.ascontiguousarray(array[tuple(slice(None) if index is None else index for index in rest)])


def _widened(array: np.ndarray, out: np.ndarray) -> np.ndarray:
    """The same numbers in a wider type, in the memory at whose front they lie: from the last to the first."""
    numbers, wide = array.reshape(-1), out.reshape(-1)
    step = BLOCK // array.itemsize
    for last in range(numbers.size, 0, -step):
        part = slice(max(last - step, 0), last)
        wide[part] = numbers[part].copy()  # it is written over
    return out


def _tell_rest(path: Path, stream: BinaryIO, count: int) -> None:
    """Warns where a stream goes on; it is not read on."""
    try:
        more = bool(stream.read(1))
    except gzip.BadGzipFile as error:
        if not str(error).startswith("Not a gzipped file"):  # a checksum that does not fit
            raise
        more = True
    if more:
        warn(path, f"passed over what comes behind its {count} bytes of samples")


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


def read_exactly(
    path: Path,
    stream: BinaryIO,
    count: int,
    *,
    allocate: bool,
    progress: Callable[[float], None] = lambda part: None,
    times: int = 1,
) -> bytearray | np.ndarray:
    """The next `count` bytes, with room behind them for `times` as many in all. Raises VolumeFileError if there are
    fewer.

    A length that was compared with the file's is allocated at once (`allocate`); else memory grows with what is really
    there, so that a header that lies costs no more than the data it has.
    """
    if allocate:
        whole = np.empty(times * count, np.uint8)
        done = 0
        while done < count and (n := stream.readinto(memoryview(whole)[done : min(done + 64 * BLOCK, count)])):  # type: ignore[attr-defined]
            done += n
            progress(done / count)
        buffer = whole
    else:
        buffer = bytearray()
        while len(buffer) < count and (block := stream.read(min(BLOCK, count - len(buffer)))):
            buffer += block
            progress(len(buffer) / count)
        done = len(buffer)
    if done < count:
        raise VolumeFileError(path, f"{count} bytes of samples", f"the end of the data after {done}")
    if not allocate and times > 1:
        buffer *= times  # grows where it is
    return buffer


def native(buffer: bytearray | np.ndarray, dtype: np.dtype, shape: tuple[int, ...]) -> np.ndarray:
    """The first bytes as an array in native byte order, swapped in place."""
    array = np.frombuffer(buffer, dtype, math.prod(shape))
    if not dtype.isnative:
        array = array.byteswap(inplace=True).view(dtype.newbyteorder("="))
    return array.reshape(shape)


def as_samples(path: Path, array: np.ndarray, dtype: np.dtype) -> np.ndarray:
    """A contiguous, writable array of that type; the same one where it can be.

    Raises VolumeFileError for unsigned integers of 64 bits that int64 cannot hold.
    """
    if array.dtype == np.uint64 and dtype == np.int64 and array.size and (top := int(array.max())) >= 2**63:
        raise VolumeFileError(path, "uint64 samples below 2⁶³, which int64 holds", top)
    array = np.ascontiguousarray(array, dtype)
    return array if array.flags.writeable else array.copy()


@dataclass(frozen=True)
class Outgoing:
    """Samples on their way into a file: held as they are, and turned block by block into the type that it has.

    `array` is contiguous, `dtype` holds all of its numbers.
    """

    array: np.ndarray
    dtype: np.dtype

    @classmethod
    def of(cls, path: Path, array: np.ndarray, name: str | None) -> Outgoing:
        """In the type of that name (None: their own). Raises VolumeFileError where it does not hold all samples."""
        outgoing = cls(array, array.dtype if name is None else np.dtype(name))
        if outgoing.dtype != array.dtype:
            for block in outgoing._blocks():
                check_exact(path, block, outgoing.dtype)
        return outgoing

    def blocks(self) -> Iterator[np.ndarray]:
        """The samples in their order and the type of the file, about a megabyte at a time; tells how far it is."""
        done = 0
        for block in self._blocks():
            yield block.astype(self.dtype, copy=False)
            done += block.size
            tell_done(done / self.array.size)

    def _blocks(self) -> Iterator[np.ndarray]:
        flat, step = self.array.reshape(-1), BLOCK // self.array.itemsize
        yield from (flat[first : first + step] for first in range(0, flat.size, step))


def storable(path: Path, volume: Volume, types: Sequence[str], stored: str | None = None) -> Outgoing:
    """The (D, H, W) samples of a volume in one of the types; float16 and bfloat16 widen to float32 where they must.

    Args:
        stored: the type that is asked for, by NumPy's name; default the samples' own.

    Raises VolumeFileError for a batch, any other type, or samples that the type that is asked for does not hold.
    """
    samples = volume.numpy()
    if samples.dtype == np.float16:
        samples = samples.astype(np.float32)
    name = stored or samples.dtype.name
    if samples.ndim != 3 or name not in types:
        got = f"{volume}" if stored is None else f"{stored} for {volume}"
        raise VolumeFileError(path, f"samples (D, H, W) of a type among {', '.join(types)}", got)
    return Outgoing.of(path, np.ascontiguousarray(samples), name)


def check_exact(path: Path, array: np.ndarray, dtype: np.dtype) -> None:
    """Raises VolumeFileError where another type does not hold all of these numbers."""
    with np.errstate(invalid="ignore", over="ignore"):
        converted = array.astype(dtype)
        back = converted.astype(array.dtype)
    kept = (back == array) | ((back != back) & (array != array))  # a NaN stays one
    if dtype.kind in "iu":
        kept &= (array >= np.iinfo(dtype).min) & (array <= np.iinfo(dtype).max)
    elif array.dtype.kind in "iu":
        kept &= converted < 2.0**63  # which comes back as something else, or as the largest int64
    if not kept.all():
        raise VolumeFileError(path, f"samples that {dtype.name} holds exactly", f"{array[~kept].flat[0]}")


def rescaled(array: np.ndarray, slope: float, intercept: float, dtype: np.dtype) -> np.ndarray:
    """slope · value + intercept, computed in float64 plane by plane and stored as `dtype`."""
    out = np.empty(array.shape, dtype)
    with np.errstate(over="ignore", invalid="ignore"):
        for source, target in zip(array, out, strict=True):
            target[...] = source.astype(np.float64) * slope + intercept
    return out
