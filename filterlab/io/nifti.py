"""NIfTI volumes (`.nii`, `.nii.gz`), NIfTI-1 and -2, with nibabel reading the header (the extra `medical`).

World coordinates are the file's: right, anterior, superior (RAS), from the sform if it is set and not zero, else the
qform, else the voxel sizes. scl_slope and scl_inter are applied; the result is then float32 (float64 where 32 or 64
bits are stored). The voxels are read by our own bounded reader, never by nibabel. Of a time series (the fourth axis),
one frame is read; of vectors (the fifth) and colours, one channel. A volume that was read is written in its file's
version, with its codes and units.

Source: https://nifti.nimh.nih.gov/nifti-1 and the headers nifti1.h, nifti2.h.
"""

from __future__ import annotations

import gzip
import io
import math
import warnings
from collections.abc import Sequence
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from filterlab.io.bounded import (
    Choice,
    Stored,
    VolumeFileError,
    VolumeHeader,
    as_samples,
    check_geometry,
    check_size,
    damaged,
    rescaled,
    sample_dtype,
    storable,
)
from filterlab.world import RAS, NiftiForms, World

if TYPE_CHECKING:
    from filterlab.volume import Volume

MAX_NIFTI1_AXIS = 32767
HEADER_BYTES = {348: 352, 540: 544}  # sizeof_hdr -> bytes up to the first possible voxel
_WRITTEN = (
    *("uint8", "int8", "int16", "uint16", "int32", "uint32", "int64", "uint64"),
    *("float32", "float64"),
)
_UNITS = {"meter": "m", "mm": "mm", "micron": "um"}
_COLOURS = {128: 3, 2304: 4}  # data types RGB24 and RGBA32: bytes, one per channel
_LABELS = 1002  # the intent of a volume whose numbers are names
_OF_NUMBERS = (*range(2, 25), 1001, _LABELS)  # intents of single numbers: statistics, estimates, labels


def require_nibabel(path: Path) -> Any:
    """The package nibabel. Raises VolumeFileError that names the extra to install."""
    try:
        import nibabel
    except ImportError:
        raise VolumeFileError(
            path, "nibabel, which reads NIfTI (pip install 'filterlab[medical]')", "no such package"
        ) from None
    return nibabel


def read_header(path: Path, frame: int | None = None, channel: int | None = None) -> VolumeHeader:
    """The checked header of a NIfTI file. Raises VolumeFileError: also for a frame or channel that it has not."""
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
            return _checked(path, header, kind, compressed, (frame, channel))
        except VolumeFileError:
            raise
        except Exception as error:  # whatever nibabel makes of damaged fields
            raise VolumeFileError(path, "a valid NIfTI header", f"{type(error).__name__}: {error}"[:200]) from None


def _first_bytes(path: Path, compressed: bool) -> bytes:
    with path.open("rb") as file, ExitStack() as stack:
        stream = stack.enter_context(gzip.GzipFile(fileobj=file)) if compressed else file
        with damaged(path, "a NIfTI header"):
            return stream.read(max(HEADER_BYTES.values()))


def _checked(
    path: Path, header: Any, kind: int, compressed: bool, asked: tuple[int | None, int | None]
) -> VolumeHeader:
    magic = bytes(header["magic"].tobytes())
    if not magic.startswith((b"n+1", b"n+2")):
        raise VolumeFileError(path, "a single NIfTI file (magic n+1 or n+2)", repr(magic))
    size, frames, vectors = _size(path, [int(n) for n in header["dim"]])
    dtype, colours = _dtype(path, header)
    stored_dtype = sample_dtype(path, dtype)
    offset = float(header["vox_offset"])
    if not math.isfinite(offset) or offset != int(offset) or not HEADER_BYTES[kind] <= offset < 2**62:
        raise VolumeFileError(path, f"a vox_offset of at least {HEADER_BYTES[kind]}", offset)
    if vectors > 1 and colours > 1:
        raise VolumeFileError(path, "vectors or colours", f"{vectors} of {colours} values")
    start = int(offset)
    stored = Stored(
        *(path, path, "gzip" if compressed else "raw"), 0 if compressed else start, start if compressed else 0,
        *((vectors, frames, *size[::-1], colours), dtype),
    )  # fmt: skip
    stored.check()
    choice = Choice.of(path, frames, vectors * colours, *asked)
    t, c = choice.place
    at = (0 if colours > 1 else c, t, None, None, None, c if colours > 1 else 0)
    slope, intercept = (1.0, 0.0) if colours > 1 else _scaling(path, header)
    plain = (slope, intercept) == (1.0, 0.0)
    wide = np.dtype("float64" if dtype.itemsize > 2 and dtype.name != "float32" else "float32")
    target = stored_dtype if plain else wide
    affine, world, source = _place(header, kind)
    return VolumeHeader(
        path,
        "NIfTI",
        size[::-1],
        dtype.name,
        check_geometry(path, affine, world),
        stored.encoding,
        _fields(header, source, slope, intercept) | _other_sizes(header, affine),
        target,
        choice,
        stored.held(at),
        lambda: (
            as_samples(path, stored.read(at, target), target)
            if plain
            else rescaled(stored.read(at), slope, intercept, target)
        ),
    )


def _size(path: Path, dim: list[int]) -> tuple[tuple[int, ...], int, int]:
    """Voxels along x, y, z, frames, and values per voxel."""
    rank = dim[0]
    if not 1 <= rank <= 7:
        raise VolumeFileError(path, "dim[0], the number of axes, from 1 to 7", rank)
    size = check_size(path, dim[1 : rank + 1])
    if rank < 3 or any(n != 1 for n in size[5:]):
        raise VolumeFileError(path, "three axes of space, then time, then the values of a voxel", f"sizes {size}")
    frames, vectors = (*size[3:5], 1, 1)[:2]
    return size[:3], frames, vectors


def _dtype(path: Path, header: Any) -> tuple[np.dtype, int]:
    """The type of one value, and how many a voxel of colours has."""
    colours = _COLOURS.get(int(header["datatype"]), 1)
    try:
        dtype = header.get_data_dtype() if colours == 1 else np.dtype(np.uint8)
    except Exception:
        raise VolumeFileError(path, "a known data type", f"code {int(header['datatype'])}") from None
    bits = 8 * dtype.itemsize * colours
    if int(header["bitpix"]) != bits:
        raise VolumeFileError(path, f"bitpix {bits} for {dtype.name}", int(header["bitpix"]))
    return dtype, colours


def _place(header: Any, kind: int) -> tuple[np.ndarray, World, str]:
    """The affine, what is declared of the world, and where the affine comes from."""
    sform, qform = int(header["sform_code"]), int(header["qform_code"])
    if sform > 0 and not np.any(header.get_sform()[:3, :3]):  # declared, and left empty
        sform = 0
    unit, time = header.get_xyzt_units()
    affine = header.get_sform() if sform > 0 else header.get_qform() if qform > 0 else header.get_base_affine()
    other = None
    if sform > 0 and qform > 0:
        qform, other = _other_place(header, affine, qform)
    source = "sform" if sform > 0 else "qform" if qform > 0 else "voxel sizes"
    told = _text(header, "descrip"), *_intent(header)
    nifti = NiftiForms(1 if kind == 348 else 2, max(sform, 0), max(qform, 0), time, other, *told)
    return affine, World(RAS, _UNITS.get(unit), nifti), source


def _text(header: Any, name: str) -> str:
    return bytes(header[name].tobytes()).split(b"\0")[0].decode("latin-1")


def _intent(header: Any) -> tuple[int, tuple[float, float, float], str]:
    """Code, parameters and name; 0 for what vectors, matrices, … are, of which a volume is one part."""
    code = int(header["intent_code"])
    x, y, z = (float(header[f"intent_p{i}"]) for i in (1, 2, 3))
    if code not in _OF_NUMBERS or not all(map(math.isfinite, (x, y, z))):
        return 0, (0.0, 0.0, 0.0), ""
    return code, (x, y, z), _text(header, "intent_name")


def _other_place(header: Any, affine: np.ndarray, code: int) -> tuple[int, tuple[tuple[float, ...], ...] | None]:
    """The code of a qform beside an sform (0 where it is damaged), and where it leads to, where that is elsewhere."""
    try:
        place = header.get_qform()
        if _same_place(affine, place, header["dim"][1:4]):
            return code, None
        return code, tuple(map(tuple, (place @ np.linalg.inv(affine)).tolist()))
    except (ValueError, np.linalg.LinAlgError):
        return 0, None


def _same_place(first: np.ndarray, second: np.ndarray, size: Sequence[int]) -> bool:
    """Whether two affines put every voxel within 1e-4 of a voxel of the same place."""
    corners = np.array([[x, y, z, 1] for x in (0, size[0]) for y in (0, size[1]) for z in (0, size[2])], np.float64)
    finest = np.sqrt((first[:3, :3] ** 2).sum(axis=0).min())
    return bool(np.abs(corners @ (first - second).T).max() <= 1e-4 * finest)


def _scaling(path: Path, header: Any) -> tuple[float, float]:
    """(slope, intercept); a slope of 0 or NaN means none."""
    slope, intercept = float(header["scl_slope"]), float(header["scl_inter"])
    if slope == 0 or math.isnan(slope):
        return 1.0, 0.0
    if not (math.isfinite(slope) and math.isfinite(intercept)):
        raise VolumeFileError(path, "finite scl_slope and scl_inter", f"{slope} and {intercept}")
    return slope, intercept


def _fields(header: Any, source: str, slope: float, intercept: float) -> dict[str, str]:
    fields = {
        "description": _text(header, "descrip"),
        "affine from": source,
    }
    if source == "qform" and header["sform_code"] > 0:
        fields["affine from"] = "qform (the sform is zero)"
    if code := int(header["intent_code"]):
        fields["intent"] = " ".join(("labels" if code == _LABELS else str(code), _text(header, "intent_name"))).strip()
    if (slope, intercept) != (1.0, 0.0):
        fields["scaling"] = f"{slope} · stored + {intercept}"
    return {k: v for k, v in fields.items() if v}


def _other_sizes(header: Any, affine: np.ndarray) -> dict[str, str]:
    """The voxel sizes of the header where those of the affine are others, by more than a thousandth."""
    pixdim = np.abs(header["pixdim"][1:4].astype(np.float64))
    same = np.allclose(pixdim, np.sqrt((affine[:3, :3] ** 2).sum(axis=0)), rtol=1e-3, atol=0)
    return {} if same else {"pixdim": " ".join(f"{size:.6g}" for size in pixdim)}


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


def version_for(volume: Volume, nifti2: bool = False) -> int:
    """1, or 2 where that is asked for, where the volume comes from NIfTI-2, or where NIfTI-1 cannot hold it."""
    forms = volume.world.nifti
    return 2 if nifti2 or (forms is not None and forms.version == 2) or not fits_nifti1(volume) else 1


def write(volume: Volume, path: Path, stored: str | None = None, nifti2: bool = False) -> None:
    """Writes `.nii` or `.nii.gz`: NIfTI-1, which every tool opens, with the nearest float32 affine.

    NIfTI-2, which holds the affine bit for bit, as `version_for` says. A volume that comes from a NIfTI file keeps its
    codes, units and description, and the intent of single numbers (labels only where they are integers); others have an
    sform, "aligned". float16 and bfloat16, which the format lacks, become float32.
    """
    nibabel = require_nibabel(path)
    samples = storable(path, volume, _WRITTEN, stored)
    first = version_for(volume, nifti2) == 1
    header = nibabel.Nifti1Header() if first else nibabel.Nifti2Header()
    header.set_data_shape(volume.size)
    header.set_data_dtype(samples.dtype)
    header.set_zooms(volume.spacing)
    _set_place(header, volume)
    _set_meaning(header, volume.world.nifti or NiftiForms(), samples.dtype)
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
        for block in samples.blocks():
            stream.write(block.data)


def _set_meaning(header: Any, told: NiftiForms, dtype: np.dtype) -> None:
    """Description and intent."""
    header["descrip"] = told.description.encode("latin-1")
    if told.intent and (told.intent != _LABELS or dtype.kind in "iu"):
        header["intent_code"], header["intent_name"] = told.intent, told.intent_name.encode("latin-1")
        for i, parameter in enumerate(told.intent_parameters, start=1):
            header[f"intent_p{i}"] = parameter


def _set_place(header: Any, volume: Volume) -> None:
    """Forms, codes and units; a form that cannot hold the affine gives way to an sform of the same code."""
    world, affine = volume.world, volume.affine
    forms = world.nifti or NiftiForms()
    header.set_xyzt_units(next((k for k, v in _UNITS.items() if v == world.unit), "unknown"), forms.time)
    place = affine if forms.to_qform is None else np.array(forms.to_qform) @ affine
    if forms.qform > 0:
        header.set_qform(place, forms.qform, strip_shears=True)
    held = header.get_qform() if forms.qform > 0 else header.get_base_affine()
    if forms.sform > 0 or not _same_place(affine, held, volume.size):
        header.set_sform(affine, code=forms.sform or forms.qform or "aligned")
