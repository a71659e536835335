"""NIfTI volumes (`.nii`, `.nii.gz`), NIfTI-1 and -2, with nibabel reading the header (the extra `medical`).

World coordinates are the file's: right, anterior, superior (RAS), from the sform if it is set, else the qform, else the
voxel sizes. scl_slope and scl_inter are applied; the result is then float32 (float64 where 32 or 64 bits are stored).
The voxels are read by our own bounded reader, never by nibabel. Of a time series (4-D), one frame is read.

Source: https://nifti.nimh.nih.gov/nifti-1 and the headers nifti1.h, nifti2.h.
"""

from __future__ import annotations

import gzip
import io
import math
import warnings
from contextlib import ExitStack
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import torch

from filterlab.io.bounded import (
    BLOCK,
    Stored,
    VolumeFileError,
    VolumeHeader,
    as_tensor,
    check_geometry,
    check_size,
    damaged,
    decompressed,
    native,
    rescaled,
    sample_dtype,
    skip_bytes,
    storable,
)
from filterlab.volume import Volume

MAX_NIFTI1_AXIS = 32767
HEADER_BYTES = {348: 352, 540: 544}  # sizeof_hdr -> bytes up to the first possible voxel
_WRITTEN = ("uint8", "int8", "int16", "int32", "int64", "float32", "float64")


def require_nibabel(path: Path) -> Any:
    """The package nibabel. Raises VolumeFileError that names the extra to install."""
    try:
        import nibabel
    except ImportError:
        raise VolumeFileError(
            path, "nibabel, which reads NIfTI (pip install 'filterlab[medical]')", "no such package"
        ) from None
    return nibabel


def read_header(path: Path, frame: int | None = None) -> VolumeHeader:
    """The checked header of a NIfTI file; of a time series, that of one frame, counted from 0.

    Raises VolumeFileError: also for a time series without a frame, a frame that it has not, or one of a 3-D file.
    """
    nibabel = require_nibabel(path)
    compressed = path.name.lower().endswith(".gz")
    block = _first_bytes(path, compressed)
    little, big = (int.from_bytes(block[:4], order) for order in ("little", "big"))
    kind = little if little in HEADER_BYTES else big
    if kind not in HEADER_BYTES or len(block) < HEADER_BYTES[kind]:
        raise VolumeFileError(path, "a NIfTI header (its first number 348 or 540)", f"{little} in {len(block)} bytes")
    cls = nibabel.Nifti1Header if kind == 348 else nibabel.Nifti2Header
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            header = cls(block[:kind], endianness="<" if kind == little else ">", check=False)
            return _checked(path, header, kind, compressed, frame)
        except VolumeFileError:
            raise
        except Exception as error:  # whatever nibabel makes of damaged fields
            raise VolumeFileError(path, "a valid NIfTI header", f"{type(error).__name__}: {error}"[:200]) from None


def _first_bytes(path: Path, compressed: bool) -> bytes:
    with path.open("rb") as file, ExitStack() as stack:
        stream = stack.enter_context(gzip.GzipFile(fileobj=file)) if compressed else file
        with damaged(path, "a NIfTI header"):
            return stream.read(max(HEADER_BYTES.values()))


def _checked(path: Path, header: Any, kind: int, compressed: bool, frame: int | None) -> VolumeHeader:
    magic = bytes(header["magic"].tobytes())
    if not magic.startswith((b"n+1", b"n+2")):
        raise VolumeFileError(path, "a single NIfTI file (magic n+1 or n+2)", repr(magic))
    size, frames = _size(path, [int(n) for n in header["dim"]])
    index = _frame(path, frames, frame)
    try:
        dtype = header.get_data_dtype()
    except Exception:
        raise VolumeFileError(path, "a known data type", f"code {int(header['datatype'])}") from None
    stored_dtype = sample_dtype(path, dtype)
    if int(header["bitpix"]) != 8 * dtype.itemsize:
        raise VolumeFileError(path, f"bitpix {8 * dtype.itemsize} for {dtype.name}", int(header["bitpix"]))
    offset = float(header["vox_offset"])
    if not math.isfinite(offset) or offset != int(offset) or not HEADER_BYTES[kind] <= offset < 2**62:
        raise VolumeFileError(path, f"a vox_offset of at least {HEADER_BYTES[kind]}", offset)
    start = int(offset)
    stored = Stored(
        *(path, path, "gzip" if compressed else "raw"), 0 if compressed else start, start if compressed else 0,
        *((frames or 1, *size[::-1]), dtype),
    )  # fmt: skip
    stored.check()
    slope, intercept = _scaling(path, header)
    plain = (slope, intercept) == (1.0, 0.0)
    wide = torch.float64 if dtype.itemsize > 2 and dtype.name != "float32" else torch.float32
    target = stored_dtype if plain else wide
    return VolumeHeader(
        path,
        "NIfTI",
        size[::-1],
        dtype.name,
        check_geometry(path, header.get_best_affine()),
        stored.encoding,
        "RAS",
        _fields(header, slope, intercept) | ({"frame": f"{index} of {frames}"} if frame is not None else {}),
        target,
        lambda: (
            as_tensor(_read_frame(stored, index), target)
            if plain
            else rescaled(_read_frame(stored, index), slope, intercept, target)
        ),
    )


def _size(path: Path, dim: list[int]) -> tuple[tuple[int, ...], int | None]:
    """Voxels along x, y, z, and how many frames there are: None for a file without a time axis."""
    rank = dim[0]
    if not 1 <= rank <= 7:
        raise VolumeFileError(path, "dim[0], the number of axes, from 1 to 7", rank)
    size = check_size(path, dim[1 : rank + 1])
    if rank < 3 or any(n != 1 for n in size[4:]):
        expected = "three axes of one value per voxel, or four of a time series (no images, no channels)"
        raise VolumeFileError(path, expected, f"sizes {size}")
    return size[:3], size[3] if rank > 3 else None


def _frame(path: Path, frames: int | None, frame: int | None) -> int:
    """Which frame to read of so many (None: no time axis). Raises VolumeFileError."""
    if frame is None:
        if frames is not None and frames > 1:
            expected = f"a choice among its {frames} frames, frame=0 to frame={frames - 1}: this is a time series"
            raise VolumeFileError(path, expected, "none")
        return 0
    if frames is None:
        raise VolumeFileError(path, "no frame, because it has three axes and no time", f"frame {frame!r}")
    if not isinstance(frame, int) or isinstance(frame, bool) or not 0 <= frame < frames:
        raise VolumeFileError(path, f"a frame from 0 to {frames - 1}", f"frame {frame!r}")
    return frame


def _read_frame(series: Stored, frame: int) -> np.ndarray:
    """One volume (D, H, W) of `series`, (T, D, H, W). All is passed over, so that damage anywhere is found."""
    if series.shape[0] == 1:
        return series.read()[0]
    series.check()
    count = series.nbytes // series.shape[0]
    with series.file.open("rb") as file:
        file.seek(series.offset)
        with damaged(series.header, f"{series.encoding} data of {series.nbytes} bytes"):
            stream = decompressed(file, series.encoding)
            skip_bytes(series.header, stream, series.skip + frame * count)
            buffer = _exactly(series.header, stream, count)
            skip_bytes(series.header, stream, (series.shape[0] - 1 - frame) * count)
            if stream.read(1):
                raise VolumeFileError(series.header, f"{series.nbytes} bytes of samples", "more than that")
    return native(buffer, series.dtype, series.shape[1:])


def _exactly(path: Path, stream: BinaryIO, count: int) -> bytearray:
    """The next `count` bytes; memory grows with what is really there."""
    buffer = bytearray()
    while len(buffer) < count and (block := stream.read(min(BLOCK, count - len(buffer)))):
        buffer += block
    if len(buffer) < count:
        raise VolumeFileError(path, f"{count} bytes of samples", f"the end of the data after {len(buffer)}")
    return buffer


def _scaling(path: Path, header: Any) -> tuple[float, float]:
    """(slope, intercept); a slope of 0 or NaN means none."""
    slope, intercept = float(header["scl_slope"]), float(header["scl_inter"])
    if slope == 0 or math.isnan(slope):
        return 1.0, 0.0
    if not (math.isfinite(slope) and math.isfinite(intercept)):
        raise VolumeFileError(path, "finite scl_slope and scl_inter", f"{slope} and {intercept}")
    return slope, intercept


def _fields(header: Any, slope: float, intercept: float) -> dict[str, str]:
    fields = {
        "description": bytes(header["descrip"].tobytes()).split(b"\0")[0].decode("latin-1"),
        "units": header.get_xyzt_units()[0],
        "affine from": "sform" if header["sform_code"] > 0 else "qform" if header["qform_code"] > 0 else "voxel sizes",
    }
    if (slope, intercept) != (1.0, 0.0):
        fields["scaling"] = f"{slope} · stored + {intercept}"
    return {k: v for k, v in fields.items() if v}


def rounding(affine: np.ndarray) -> float:
    """How much the nearest float32 affine differs: the largest change of an entry ÷ that entry, at most 2⁻²⁴ = 6e-8.

    Entries far below the smallest voxel size, of which float32 may hold nothing, count relative to that; what float32
    cannot hold at all is infinitely far.
    """
    with np.errstate(over="ignore"):
        change = np.abs(affine.astype(np.float32).astype(np.float64) - affine)
    finest = np.sqrt((affine[:3, :3] ** 2).sum(axis=0).min())
    return float((change / np.maximum(np.abs(affine), finest)).max())


def fits_nifti1(volume: Volume) -> bool:
    """Whether NIfTI-1 holds the volume: no axis beyond 32767 voxels, no number of the affine beyond float32."""
    return max(volume.size) <= MAX_NIFTI1_AXIS and rounding(volume.affine) <= 2**-24


def write(volume: Volume, path: Path, nifti2: bool = False) -> None:
    """Writes `.nii` or `.nii.gz` with an sform: NIfTI-1, which every tool opens, with the nearest float32 affine.

    NIfTI-2, which holds the affine bit for bit, where it is asked for or NIfTI-1 cannot hold the volume (see
    `fits_nifti1`). float16 and bfloat16, which the format lacks, become float32.
    """
    nibabel = require_nibabel(path)
    array = storable(path, volume, _WRITTEN)
    affine = volume.affine
    first = not nifti2 and fits_nifti1(volume)
    header = nibabel.Nifti1Header() if first else nibabel.Nifti2Header()
    header.set_data_shape(volume.size)
    header.set_data_dtype(array.dtype)
    header.set_zooms(volume.spacing)
    header.set_sform(affine, code="aligned")
    header["magic"] = b"n+1" if first else b"n+2\0\r\n\x1a\n"
    header["vox_offset"] = HEADER_BYTES[348 if first else 540]
    front = io.BytesIO()
    header.write_to(front)
    start = front.getvalue().ljust(int(header["vox_offset"]), b"\0")
    with path.open("wb") as file, ExitStack() as stack:
        stream = file
        if path.name.lower().endswith(".gz"):
            stream = stack.enter_context(gzip.GzipFile(filename="", fileobj=file, mode="wb", compresslevel=6, mtime=0))
        stream.write(start)
        for plane in array:
            stream.write(plane.data)
