"""NumPy volumes: `.npy`, and `.npz` with geometry.

The array is (D, H, W), x along the last axis, or (N, C, D, H, W). Objects are never unpickled.

* `.npz` holds `samples` (or one single array of three or five axes) and optionally `affine` (4×4), or `spacing` and
  `origin` (x, y, z).
* `.npy` holds samples only; geometry, where there is any, stands in a small file `NAME.npy.yaml` beside it, with the
  keys size, affine (4×4).
"""

from __future__ import annotations

import io
import math
import os
import warnings
import zipfile
import zlib
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, BinaryIO

import numpy as np

from filterlab.io.atomic import atomic_write
from filterlab.io.bounded import (
    EXPANSION,
    Choice,
    Outgoing,
    Stored,
    VolumeFileError,
    VolumeHeader,
    as_samples,
    check_geometry,
    check_size,
    native,
    read_array,
    read_exactly,
    sample_dtype,
    scaled,
)

if TYPE_CHECKING:
    from filterlab.volume import Volume

_GEOMETRY = ("affine", "spacing", "origin")
_SUFFIX = ".npy"
MAX_NPY_HEADER = 2**16
MAX_NPY_TEXT = 1024  # of it, padding aside, which NumPy evaluates as Python: 0.2 s and more for ten times that
MAX_DIRECTORY = 2**18  # bytes; of an entry, 46 and more, zipfile makes an object of 700


def sidecar_of(path: Path) -> Path:
    return path.with_name(path.name + ".yaml")


def array_header(path: Path, stream: BinaryIO) -> tuple[tuple[int, ...], bool, np.dtype]:
    """(shape, fortran order, dtype) of the array that begins at the stream's position."""
    start = stream.read(8)
    version = tuple(start[6:])
    if not start.startswith(b"\x93NUMPY") or version not in ((1, 0), (2, 0)):
        raise VolumeFileError(path, "a valid npy header, version 1.0 or 2.0", f"{start!r}")
    length = stream.read(2 * version[0])
    count = int.from_bytes(length, "little")
    if len(length) != 2 * version[0] or count > MAX_NPY_HEADER:
        raise VolumeFileError(path, f"a valid npy header of at most {MAX_NPY_HEADER} bytes", count)
    text = stream.read(count).strip()
    if len(text) > MAX_NPY_TEXT:
        raise VolumeFileError(path, f"a valid npy header of at most {MAX_NPY_TEXT} characters", len(text))
    header = io.BytesIO((len(text) + 1).to_bytes(len(length), "little") + text + b"\n")
    read = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            shape, fortran, dtype = read(header)
    except Exception as error:  # NumPy evaluates the header as a Python literal; damaged ones fail in many ways
        raise VolumeFileError(path, "a valid npy header", f"{type(error).__name__}: {error}"[:200]) from None
    if any(isinstance(n, bool) for n in shape):
        raise VolumeFileError(path, "integers as shape", shape)
    return shape, fortran, dtype


def _check_shape(path: Path, shape: tuple[int, ...]) -> tuple[int, ...]:
    if len(shape) not in (3, 5):
        raise VolumeFileError(path, "an array (D, H, W) or (N, C, D, H, W)", f"shape {shape}"[:100])
    return check_size(path, shape)


def stored_order(shape: tuple[int, ...], fortran: bool) -> tuple[int, ...]:
    return shape[::-1] if fortran else shape


@dataclass(frozen=True)
class Part:
    """What is read of an array (D, H, W) or (N, C, D, H, W): all of it, or one entry, one channel, or both.

    Attributes:
        choice: of the N frames and C channels.
        at: for each axis as it is stored, the index that is read of it; None: all of it.
        shape: of what is read.
        fortran: the array is stored with its axes turned round.
    """

    choice: Choice
    at: tuple[int | None, ...]
    shape: tuple[int, ...]
    fortran: bool

    @classmethod
    def of(cls, path: Path, shape: tuple[int, ...], fortran: bool, frame: int | None, channel: int | None) -> Part:
        """The part with that frame and channel. Raises VolumeFileError where it is not there."""
        n, c = shape[:-3] or (1, 1)
        choice = Choice.of(path, n, c, frame, channel)
        at: tuple[int | None, ...] = (None,) * len(shape)
        if len(shape) == 5 and (frame, channel) != (None, None):
            first, second = (0 if count == 1 else index for index, count in ((frame, n), (channel, c)))
            at = (first, second, None, None, None)
            batch = (n if first is None else 1, c if second is None else 1)
            shape = (*batch, *shape[2:]) if None in (first, second) else shape[2:]
        return cls(choice, at[::-1] if fortran else at, shape, fortran)

    def samples(self, path: Path, array: np.ndarray, target: np.dtype) -> np.ndarray:
        """What was read, its axes the right way round."""
        return as_samples(path, (array.T if self.fortran else array).reshape(self.shape), target)


def read_npy_header(path: Path, frame: int | None = None, channel: int | None = None) -> VolumeHeader:
    """The checked header of an .npy file (and of its sidecar). Raises VolumeFileError."""
    with path.open("rb") as file:
        shape, fortran, dtype = array_header(path, file)
        offset = file.tell()
    shape, target = _check_shape(path, shape), sample_dtype(path, dtype)
    stored = Stored(path, path, "raw", offset, 0, stored_order(shape, fortran), dtype)
    stored.check()
    affine, part = _sidecar_affine(path, shape), Part.of(path, shape, fortran, frame, channel)
    return VolumeHeader(
        path,
        "npy",
        part.shape,
        dtype.name,
        check_geometry(path, affine),
        "raw",
        {"order": "Fortran"} if fortran else {},
        target,
        part.choice,
        stored.held(part.at),
        lambda: part.samples(path, stored.read(part.at, target), target),
    )


def _sidecar_affine(path: Path, shape: tuple[int, ...]) -> np.ndarray:
    sidecar = sidecar_of(path)
    if not sidecar.exists():
        return np.eye(4)
    from filterlab.io.sidecars import GeometrySidecar, load_sidecar

    found = load_sidecar(sidecar, GeometrySidecar, "the geometry of the samples")
    if found.size[::-1] != shape[-3:]:
        raise VolumeFileError(sidecar, f"size {list(shape[:-4:-1])} as in {path.name}", f"size {list(found.size)}")
    return np.array(found.affine)


# --- npz --------------------------------------------------------------------------------------------------------------


class _Archive(io.FileIO):
    """A file of which no more than MAX_DIRECTORY bytes are read at once until its directory has been read.

    zipfile makes objects of all entries before anyone can ask how many there are.
    """

    directory_read = False

    def read(self, size: int | None = -1, /) -> bytes:
        size = -1 if size is None else size
        left = os.fstat(self.fileno()).st_size - self.tell()
        if not self.directory_read and min(left, left if size < 0 else size) > MAX_DIRECTORY:
            raise VolumeFileError(
                Path(str(self.name)), f"a directory of at most {MAX_DIRECTORY} bytes", min(left, size)
            )
        return super().read(size)


@contextmanager
def open_archive(path: Path) -> Iterator[tuple[zipfile.ZipFile, dict[str, zipfile.ZipInfo]]]:
    """The archive and its arrays by name; damage anywhere in it becomes VolumeFileError."""
    try:
        with _Archive(path) as file, zipfile.ZipFile(file) as archive:
            file.directory_read = True
            yield archive, {i.filename.removesuffix(_SUFFIX): i for i in archive.infolist()}
    except VolumeFileError:
        raise
    except (zipfile.BadZipFile, zlib.error, EOFError, RuntimeError, NotImplementedError, ValueError, OSError) as error:
        if isinstance(error, OSError) and error.errno not in (None, 22):  # 22: a seek to where no file can be
            raise
        raise VolumeFileError(path, "an intact npz archive", f"{type(error).__name__}: {error}"[:200]) from None


def open_member(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo) -> BinaryIO:
    """An open member whose claimed sizes are plausible."""
    if info.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise VolumeFileError(path, f"{info.filename} stored or deflated", f"zip method {info.compress_type}")
    factor = EXPANSION["deflate"] if info.compress_type == zipfile.ZIP_DEFLATED else 1
    present = min(info.compress_size, path.stat().st_size)
    if info.file_size > factor * present:
        raise VolumeFileError(
            path, f"{info.file_size} bytes in {info.filename}", f"{present} bytes, which cannot hold that many"
        )
    return archive.open(info)  # type: ignore[return-value]


def read_npz_header(path: Path, frame: int | None = None, channel: int | None = None) -> VolumeHeader:
    """The checked header of an .npz file. Raises VolumeFileError."""
    with open_archive(path) as (archive, members):
        name = _samples_name(path, members)
        info = members[name]
        with open_member(path, archive, info) as stream:
            shape, fortran, dtype = array_header(path, stream)
            offset = stream.tell()
        shape, target = _check_shape(path, shape), sample_dtype(path, dtype)
        claimed = math.prod(shape) * dtype.itemsize
        if info.file_size - offset != claimed:
            expected = f"{claimed} bytes of samples for {shape} {dtype.name} in {info.filename}"
            raise VolumeFileError(path, expected, f"{info.file_size - offset}")
        affine = _npz_affine(path, archive, members)
    part = Part.of(path, shape, fortran, frame, channel)

    def read() -> np.ndarray:
        with open_archive(path) as (archive, _), open_member(path, archive, info) as stream:
            stream.read(offset)
            array = read_array(path, stream, stored_order(shape, fortran), dtype, part.at, raw=False, target=target)
        return part.samples(path, array, target)

    return VolumeHeader(
        path,
        "npz",
        part.shape,
        dtype.name,
        check_geometry(path, affine),
        "deflate" if info.compress_type == zipfile.ZIP_DEFLATED else "raw",
        {"array": name} | ({"order": "Fortran"} if fortran else {}),
        target,
        part.choice,
        math.prod(shape),
        read,
    )


def _samples_name(path: Path, members: dict[str, Any]) -> str:
    others = [name for name in members if name not in _GEOMETRY]
    if "samples" in members:
        return "samples"
    if len(others) != 1:
        raise VolumeFileError(path, "an array named samples, or one array only", f"{', '.join(others) or 'none'}"[:200])
    return others[0]


def small_numbers(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo, shape: tuple[int, ...]) -> np.ndarray:
    """The few numbers of that shape in a member, float64. Raises VolumeFileError."""
    return _numbers(path, archive, info, shape).astype(np.float64)


def _npz_affine(path: Path, archive: zipfile.ZipFile, members: dict[str, zipfile.ZipInfo]) -> np.ndarray:
    def small(name: str, shape: tuple[int, ...], default: np.ndarray) -> np.ndarray:
        return small_numbers(path, archive, members[name], shape) if name in members else default

    if "affine" in members:
        if "spacing" in members or "origin" in members:
            raise VolumeFileError(path, "an affine, or spacing and origin", "both")
        return small("affine", (4, 4), np.eye(4))
    spacing = small("spacing", (3,), np.ones(3))
    if not (spacing > 0).all():
        raise VolumeFileError(path, "a positive spacing", spacing.tolist())
    return scaled(spacing.tolist(), small("origin", (3,), np.zeros(3)).tolist())


def _numbers(path: Path, archive: zipfile.ZipFile, info: zipfile.ZipInfo, shape: tuple[int | None, ...]) -> np.ndarray:
    """A member of numbers, of a shape in which None is any length, in its own type and native byte order."""
    with open_member(path, archive, info) as stream:
        found, fortran, dtype = array_header(path, stream)
        fits = len(found) == len(shape) and all(n in (None, own) for n, own in zip(shape, found, strict=True))
        if not fits or dtype.kind not in "fiu" or dtype.itemsize > 8:
            name = info.filename.removesuffix(_SUFFIX)
            wanted = str(shape).replace("None", "…")
            raise VolumeFileError(path, f"numbers of shape {wanted} as {name}", f"{dtype} of shape {found}"[:100])
        buffer = read_exactly(path, stream, math.prod(found) * dtype.itemsize, allocate=False)
    array = native(buffer, dtype, stored_order(found, fortran))
    return np.ascontiguousarray(array.T) if fortran else array


def read_arrays(path: Path, shapes: Mapping[str, tuple[int | None, ...]]) -> dict[str, np.ndarray]:
    """Those arrays of an .npz file that it has, by name; None in a shape is any length. Raises VolumeFileError."""
    with open_archive(path) as (archive, members):
        own = {name: members[name] for name in shapes if name in members}
        return {name: _numbers(path, archive, info, shapes[name]) for name, info in own.items()}


def holds_array(path: str | os.PathLike[str], name: str) -> bool:
    """Whether that is an .npz file with an array of that name. Raises VolumeFileError: it is damaged."""
    path = Path(path)
    if path.suffix.lower() != ".npz" or not path.is_file():
        return False
    with open_archive(path) as (_, members):
        return name in members


# --- writing ----------------------------------------------------------------------------------------------------------


def _samples(path: Path, volume: Volume, stored: str | None) -> Outgoing:
    return Outgoing.of(path, np.ascontiguousarray(volume.numpy()), stored)


def write_npy(volume: Volume, path: Path, stored: str | None = None) -> None:
    """Writes the samples; bfloat16 becomes float32. The geometry is written by `write_sidecar`."""
    with path.open("wb") as file:
        write_array(file, _samples(path, volume, stored))
        file.flush()
        os.fsync(file.fileno())  # a full disk may tell only now, and must before `write_sidecar`


def write_array(file: BinaryIO, array: np.ndarray | Outgoing) -> None:
    """An array as .npy. Unlike NumPy's own writer it says why where it fails (a full disk)."""
    if not isinstance(array, Outgoing):
        array = Outgoing(np.ascontiguousarray(array).reshape(array.shape), array.dtype)  # a number stays a number
    described = {"descr": np.lib.format.dtype_to_descr(array.dtype), "fortran_order": False, "shape": array.array.shape}
    np.lib.format.write_array_header_1_0(file, described)
    for block in array.blocks():  # what compresses it need not hold all of it
        file.write(block.view(np.uint8).data)


def write_sidecar(volume: Volume, path: Path) -> None:
    """Writes `path`.yaml for a volume with geometry; removes one that is there for a volume without.

    Where that changes what is there, the old samples go first: a process that is killed in between leaves no samples
    beside a geometry that is not theirs.
    """
    sidecar, text = sidecar_of(path), _described(volume)
    if text == (sidecar.read_text(encoding="utf-8") if sidecar.is_file() else None):
        return
    if text is None:
        path.resolve().unlink(missing_ok=True)
        sidecar.unlink()
        return
    with atomic_write(sidecar) as temporary:
        temporary.write_text(text, encoding="utf-8")
        path.resolve().unlink(missing_ok=True)


def _described(volume: Volume) -> str | None:
    """The text of a sidecar; None: voxel centres are the integers, and none is needed."""
    if volume.geometry.is_identity:
        return None
    from filterlab.io.config import dump_config
    from filterlab.io.sidecars import GeometrySidecar

    affine = tuple(map(tuple, volume.affine.tolist()))
    return dump_config(GeometrySidecar(size=volume.size, affine=affine))  # type: ignore[arg-type]


def write_npz(volume: Volume, path: Path, stored: str | None = None) -> None:
    """Writes `samples` and `affine`, compressed; bfloat16 becomes float32."""
    write_arrays(path, {"samples": _samples(path, volume, stored), "affine": volume.affine})


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray | Outgoing]) -> None:
    """Writes arrays by name, compressed."""
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=6) as archive:
        for name, data in arrays.items():
            with archive.open(name + _SUFFIX, "w", force_zip64=True) as stream:
                write_array(stream, data)  # type: ignore[arg-type]
