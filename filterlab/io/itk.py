"""Volumes that SimpleITK reads (the extra `itk`): MetaImage, DICOM series, Analyze, gipl, MINC, MRC, VTK.

ITK reads the header first; the claim is compared with the caller's `max_bytes` before the voxels are read. What ITK
itself does with a damaged file is not bounded as our own readers are. Rescaling, as of DICOM, is applied by ITK.

World frame: ITK's is left, posterior, superior, and becomes RAS, where the format says where a patient lies (MetaImage,
DICOM, Analyze, MINC); numbers of the others are taken as they are.
"""

from __future__ import annotations

import importlib
import itertools
import locale
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from filterlab.io.bounded import (
    Choice,
    VolumeFileError,
    VolumeHeader,
    as_samples,
    beside,
    check_geometry,
    check_size,
    sample_dtype,
)
from filterlab.world import ANATOMICAL, LPS, World

_KINDS = {
    ".mha": "MetaImage",
    ".mhd": "MetaImage",
    ".hdr": "Analyze",
    ".img": "Analyze",
    ".img.gz": "Analyze",
    ".dcm": "DICOM",
    ".mnc": "MINC",
    ".gipl": "gipl",
    ".gipl.gz": "gipl",
    ".mrc": "MRC",
    ".vtk": "VTK",
}
SUFFIXES = tuple(_KINDS)
_PATIENTS = ("MetaImage", "Analyze", "DICOM", "MINC")
_MAX_META = 2**16
_MAX_SLICES = 2**15
UNEVEN = 0.01  # by so much of their mean distance may slices of a series lie elsewhere


def require_simpleitk(path: Path, what: str) -> Any:
    """The package SimpleITK. Raises VolumeFileError that names the extra to install."""
    try:
        return importlib.import_module("SimpleITK")
    except ImportError:
        expected = f"SimpleITK, which reads {what} (pip install 'filterlab[itk]')"
        raise VolumeFileError(path, expected, "no such package") from None


@contextmanager
def _locale_kept() -> Iterator[None]:
    """ITK reads some formats in the locale "C" and leaves it so: files would be opened as ASCII from then on."""
    before = locale.setlocale(locale.LC_ALL)
    try:
        yield
    finally:
        locale.setlocale(locale.LC_ALL, before)


def is_dicom(path: Path) -> bool:
    """Whether a file says that it is DICOM."""
    if not path.is_file():
        return False
    with path.open("rb") as file:
        return file.read(132)[128:] == b"DICM"


def is_series(folder: Path) -> bool:
    """Whether there are DICOM files in a folder."""
    files = itertools.islice((f for f in sorted(folder.iterdir()) if not f.name.startswith(".")), 8)
    return any(is_dicom(file) for file in files)


def kind_of(path: Path) -> str:
    """What a file is by its ending; a folder is a DICOM series."""
    if path.is_dir():
        return "DICOM"
    return next(kind for ending, kind in _KINDS.items() if path.name.lower().endswith(ending))


def files_of(path: Path) -> list[Path]:
    """The files that a volume is read from."""
    if path.is_dir():
        return [Path(name) for name in _series(path, require_simpleitk(path, "DICOM"))]
    if path.name.lower().endswith((".hdr", ".img")):
        return [path.with_suffix(ending) for ending in (".hdr", ".img") if path.with_suffix(ending).exists()]
    data = _meta_data(path) if kind_of(path) == "MetaImage" else None
    return [path] if data is None else [path, data]


def read_header(path: Path, frame: int | None = None, channel: int | None = None) -> VolumeHeader:
    """The checked header, as ITK reads it. Raises VolumeFileError."""
    kind = kind_of(path)
    sitk = require_simpleitk(path, kind)
    if kind == "MetaImage":
        _meta_data(path)
    names = _series(path, sitk) if path.is_dir() else [str(path)]
    first = _information(path, sitk, names[0])
    size, frames = _size(path, first, len(names))
    channels = int(first.GetNumberOfComponents())
    stored = _stored(path, sitk, first)
    target = sample_dtype(path, stored)
    affine = _affine(path, sitk, names, first)
    world = World(LPS if kind in _PATIENTS else None)
    if world.space is not None:
        affine = np.diag([*ANATOMICAL[world.space], 1.0]) @ affine
    choice = Choice.of(path, frames, channels, frame, channel)
    t, c = choice.place

    def read() -> Any:
        array = _read(path, sitk, names).reshape(frames, *size[::-1], channels)
        return as_samples(path, array[t, ..., c], target)

    fields = {"kind": kind} | ({"files": str(len(names))} if path.is_dir() else {})
    held = frames * channels * math.prod(size)
    geometry = check_geometry(path, affine, world)
    return VolumeHeader(path, "ITK", size[::-1], stored.name, geometry, kind, fields, target, choice, held, read)


def read_nrrd(path: Path, shape: tuple[int, ...], dtype: np.dtype) -> np.ndarray:
    """The samples of an NRRD file of three axes. Raises VolumeFileError."""
    array = _read(path, require_simpleitk(path, "such NRRD data"), [str(path)])
    if array.shape != shape or array.dtype.name != dtype.name:
        raise VolumeFileError(path, f"samples {shape} {dtype.name}", f"{array.shape} {array.dtype.name}")
    return array


def _information(path: Path, sitk: Any, name: str) -> Any:
    """A reader that has read the header of a file."""
    reader = sitk.ImageFileReader()
    reader.SetFileName(name)
    try:
        with _locale_kept():
            reader.ReadImageInformation()
    except RuntimeError as error:
        raise VolumeFileError(path, f"{kind_of(path)} data that ITK reads", _reason(error)) from None
    return reader


def _read(path: Path, sitk: Any, names: list[str]) -> np.ndarray:
    reader = sitk.ImageSeriesReader() if len(names) > 1 else sitk.ImageFileReader()
    if len(names) > 1:
        reader.SetFileNames(names)
    else:
        reader.SetFileName(names[0])
    try:
        with _locale_kept():
            return sitk.GetArrayFromImage(reader.Execute())
    except RuntimeError as error:
        raise VolumeFileError(path, "samples that ITK reads", _reason(error)) from None


def _reason(error: RuntimeError) -> str:
    """The last line of ITK's message, which says most."""
    return " ".join(str(error).split("\n")[-1].split() or ["an error"])[-200:]


def _size(path: Path, information: Any, slices: int) -> tuple[tuple[int, ...], int]:
    """Voxels along x, y, z, and frames."""
    size = check_size(path, information.GetSize())
    if slices > 1:
        size = (*size[:2], slices) if len(size) == 2 or size[2] == 1 else size
        if size[2] != slices:
            raise VolumeFileError(path, "a series of slices", f"files of {size[2]} of them")
    if len(size) not in (3, 4) or size[2] < 2:
        hint = "; give the folder of its series" if kind_of(path) == "DICOM" else ""
        raise VolumeFileError(path, f"three axes of two or more slices, and perhaps time{hint}", f"sizes {size}")
    return size[:3], size[3] if len(size) == 4 else 1


def _stored(path: Path, sitk: Any, information: Any) -> np.dtype:
    """The type of one value. Raises VolumeFileError for complex numbers."""
    name = sitk.GetPixelIDValueAsString(information.GetPixelID())  # "vector of 16-bit unsigned integer"
    words = name.split()
    bits = next((w.split("-")[0] for w in words if w.endswith("-bit")), "")
    kind = "float" if words[-1] == "float" else "uint" if "unsigned" in words else "int"
    if not bits or "complex" in name or words[-1] not in ("float", "integer"):
        raise VolumeFileError(path, "whole numbers or floats", name)
    return np.dtype(f"{kind}{bits}")


def _affine(path: Path, sitk: Any, names: list[str], first: Any) -> np.ndarray:
    """The 4×4 voxel -> world map in ITK's own frame."""
    n = first.GetDimension()
    direction = np.array(first.GetDirection()).reshape(n, n)
    affine = np.eye(4)
    k = min(n, 3)
    affine[:k, :k] = direction[:k, :k] * np.array(first.GetSpacing()[:k])
    affine[:k, 3] = first.GetOrigin()[:k]
    if len(names) > 1:
        origins = np.array([_information(path, sitk, name).GetOrigin()[:3] for name in names])
        steps = np.diff(origins, axis=0)
        step = steps.mean(axis=0)
        if np.linalg.norm(steps - step, axis=1).max() > UNEVEN * np.linalg.norm(step):
            lengths = np.linalg.norm(steps, axis=1)
            got = f"distances from {lengths.min():.6g} to {lengths.max():.6g}"
            raise VolumeFileError(path, "slices at even distances along a line", got)
        affine[:3, 2] = step
    return affine


def _series(folder: Path, sitk: Any) -> list[str]:
    """The files of the one DICOM series in a folder, in their order in space."""
    with _locale_kept():
        found = sitk.ImageSeriesReader.GetGDCMSeriesIDs(str(folder))
        if len(found) != 1:
            raise VolumeFileError(folder, "a folder of one DICOM series", f"{len(found)} of them")
        names = list(sitk.ImageSeriesReader.GetGDCMSeriesFileNames(str(folder), found[0]))
    if not 2 <= len(names) <= _MAX_SLICES:
        raise VolumeFileError(folder, f"a series of 2 to {_MAX_SLICES} slices", len(names))
    return names


def _meta_data(path: Path) -> Path | None:
    """The data file that a MetaImage header names; None: the data follow it. Raises VolumeFileError, as `beside`."""
    with path.open("rb") as file:
        for line in file.read(_MAX_META).split(b"\n"):
            name, equals, value = line.decode("latin-1").partition("=")
            if equals and name.strip() == "ElementDataFile":
                data = value.strip()
                if data.split()[:1] == ["LIST"] or "%" in data:
                    raise VolumeFileError(path, "one data file", f"a list of files: {data[:80]!r}")
                return None if data in ("LOCAL", "Local", "local") else beside(path, data)
    raise VolumeFileError(path, f"ElementDataFile in the first {_MAX_META} bytes of a MetaImage file", "none")


def read_affine(path: Path) -> np.ndarray:
    """The 4×4 matrix of a linear transform in ITK's own coordinates. Raises VolumeFileError."""
    sitk = require_simpleitk(path, "transforms")
    try:
        with _locale_kept():
            transform = sitk.ReadTransform(str(path))
    except RuntimeError as error:
        raise VolumeFileError(path, "4 rows of 4 numbers, or a transform that ITK reads", _reason(error)) from None
    if transform.GetDimension() != 3 or not transform.IsLinear():
        got = f"a {transform.GetName()} of {transform.GetDimension()} dimensions"
        raise VolumeFileError(path, "a linear transform of three dimensions", got)
    matrix = np.eye(4)
    matrix[:3, 3] = transform.TransformPoint((0.0, 0.0, 0.0))
    for axis in range(3):
        matrix[:3, axis] = np.subtract(transform.TransformPoint(tuple(np.eye(3)[axis])), matrix[:3, 3])
    return matrix
