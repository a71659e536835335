"""Volume files: `load_volume`, `save_volume`, `describe`; which formats there are is `FORMATS`.

Samples become torch tensors (D, H, W), x along W, in native byte order, contiguous and writable. Types: int8, int16,
int32, int64, uint8, float16, float32, float64 as stored; bool -> uint8, uint16 -> int32, uint32 and uint64 -> int64.
What int64 cannot hold is refused, and so are complex numbers and images. Of a time series, of vectors and of colours,
`frame` and `channel` choose one volume (`.npy` and `.npz` may hold (N, C, D, H, W): without a choice all is read).

Geometry is the 4×4 affine from voxel (x, y, z) to world. NIfTI is in RAS (x right, y anterior, z superior); NRRD files
that declare an anatomical space are converted to RAS; everything else is taken as it is. What a file declares of its
world (space, unit, codes of NIfTI) stays with the volume, and is written where the format has a place for it. A round
trip through any format that is written keeps the affine bit for bit, but NIfTI-1, which holds it in float32.
"""

from __future__ import annotations

import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from filterlab.io import itk
from filterlab.io.atomic import atomic_write
from filterlab.io.bounded import VolumeFileError, VolumeHeader, beside, regular_file
from filterlab.io.formats import Format, function
from filterlab.names import unknown_name

if TYPE_CHECKING:
    from torch import Tensor

    from filterlab.volume import Volume

MAX_BYTES = 2**33  # that samples may take in memory, where nobody says otherwise


@dataclass(frozen=True)
class VolumeFormat(Format):
    """A volume format.

    Attributes:
        written: endings under which volumes are written.
    """

    written: tuple[str, ...] = ()


FORMATS: dict[str, VolumeFormat] = {
    known.name: known
    for known in (
        VolumeFormat("NRRD", (".nrrd", ".nhdr"), "nrrd.read_header", "nrrd.write", (".nrrd",)),
        VolumeFormat("NIfTI", (".nii", ".nii.gz"), "nifti.read_header", "nifti.write", (".nii", ".nii.gz")),
        VolumeFormat("TIFF", (".tif", ".tiff"), "tiff.read_header"),
        VolumeFormat("npy", (".npy",), "numpy_files.read_npy_header", "numpy_files.write_npy", (".npy",)),
        VolumeFormat("npz", (".npz",), "numpy_files.read_npz_header", "numpy_files.write_npz", (".npz",)),
        VolumeFormat("raw", (".raw", ".raw.yaml"), "raw.read_header"),
        VolumeFormat("ITK", itk.SUFFIXES, "itk.read_header"),
    )
}


TYPED_WRONG = 0.8  # so similar is .nrd to .nrrd; .mgz to .npz, .vti to .vtk are not, which are formats of their own
BATCHED = ("npy", "npz")  # formats that hold (N, C, D, H, W)


def format_of(path: Path) -> VolumeFormat:
    """The format of a file by its ending; a folder is a TIFF stack, or a DICOM series.

    Raises VolumeFileError that lists the endings, FileNotFoundError for a folder that is not there.
    """
    if path.is_dir():
        return FORMATS["ITK" if itk.is_series(path) else "TIFF"]
    name = path.name.lower()
    for known in FORMATS.values():
        if name.endswith(known.endings):
            return known
    if not path.suffix and not path.exists():  # a folder, mostly
        raise FileNotFoundError(f"{path}: expected a volume file or a folder of slices; got nothing of this name")
    endings = [e for f in FORMATS.values() for e in f.endings]
    raise VolumeFileError(path, "a volume file", unknown_name("ending", path.suffix, endings, alike=TYPED_WRONG))


def check_saveable(path: str | os.PathLike[str], *, batched: bool = False, nifti2: bool = False) -> Path:
    """The path, once it is known that a volume can be written under such a name; for calls before long work.

    Raises:
        VolumeFileError: an ending that is not written (lists those that are), a batch (N, C, …) in a format that holds
            (D, H, W) only, NIfTI-2 under another ending, or a missing package.
    """
    path = Path(path)
    endings = [e for f in FORMATS.values() for e in f.written]
    if not path.name.lower().endswith(tuple(endings)):
        raise VolumeFileError(path, f"a name that ends in {', '.join(endings)}", repr(path.suffix))
    name = format_of(path).name
    if batched and name not in BATCHED:
        raise VolumeFileError(path, f"{' or '.join(BATCHED)} for samples (N, C, D, H, W)", name)
    if nifti2 and name != "NIfTI":
        raise VolumeFileError(path, f"a name that ends in {' or '.join(FORMATS['NIfTI'].written)} for NIfTI-2", name)
    if name == "NIfTI":
        function("nifti.require_nibabel")(path)
    return path


def files_of(path: str | os.PathLike[str]) -> tuple[Path, ...]:
    """Every file that the volume at `path` is read from, resolved: sidecars, detached data, the slices of a folder.

    Raises as `describe`, for what it reads of them.
    """
    from filterlab.io import numpy_files, raw, tiff

    path = Path(path)
    name, found = format_of(path).name, [path]
    if name == "ITK":
        found = itk.files_of(path)
    elif path.is_dir():
        found = tiff.slices(path)
    elif name == "npy" and numpy_files.sidecar_of(path).exists():
        found.append(numpy_files.sidecar_of(path))
    elif name == "NRRD" and (data := describe(path).fields.get("data file")):
        found.append(beside(path, data))
    elif name == "raw":
        describe(path)
        sidecar = path if path.name.lower().endswith(".yaml") else path.with_name(path.name + ".yaml")
        data = raw.read_sidecar(sidecar).file or sidecar.name[: -len(".yaml")]
        found = [sidecar, beside(sidecar, data)]
    return tuple(file.resolve() for file in found)


def describe(path: str | os.PathLike[str], *, frame: int | None = None, channel: int | None = None) -> VolumeHeader:
    """The checked header of a volume file, without its voxels; `header.choice` says how many volumes it holds.

    Args:
        path, frame, channel: as for `load_volume`, but that a choice may be left open.

    Raises:
        FileNotFoundError: there is no such file.
        VolumeFileError: no known format, a header that cannot be true of this file, or no such frame or channel.
    """
    path = Path(path)
    known = format_of(path)
    if not path.is_dir():
        regular_file(path)
    return known.read_header(path, frame, channel)


def load_volume(
    path: str | os.PathLike[str], *, frame: int | None = None, channel: int | None = None, max_bytes: int = MAX_BYTES
) -> Volume:
    """The volume in a file (or in a folder of TIFF slices).

    Args:
        path: NRRD, NIfTI, TIFF, .npy, .npz, or .raw with a sidecar, or what SimpleITK reads (`FORMATS`); or the folder
            of a DICOM series.
        frame: which volume of a time series (or entry of a batch), from 0; needed where there are several.
        channel: which of several values per voxel, from 0: components of vectors, colours, dyes; needed likewise.
        max_bytes: the most that the samples may take in memory; default 8 GiB. Reading takes at most 4 MiB + 2 × the
            file + 3 × `max_bytes` of memory and 1 s + 4 µs × the file + 50 ns × `max_bytes` of one core, whatever the
            file says (`docs/extremes.md`), but for what SimpleITK and the codecs of TIFF read.

    Raises:
        FileNotFoundError: there is no such file.
        VolumeFileError: an unknown format, a damaged file, or a header that promises what the file cannot hold; raised
            before anything of the claimed size is allocated. Also where one of several volumes has to be chosen.

    Warns:
        VolumeFileWarning: of what is odd and passed over, such as bytes behind the samples.
    """
    header = describe(path, frame=frame, channel=channel)
    import torch

    from filterlab.volume import Volume

    return Volume.with_geometry(torch.from_numpy(header.read(max_bytes)), header.geometry)


def save_volume(
    volume: Volume | Tensor, path: str | os.PathLike[str], *, stored: str | None = None, nifti2: bool = False
) -> None:
    """Writes a volume: `.nrrd` (gzip), `.nii`, `.nii.gz`, `.npy` (geometry in NAME.npy.yaml), `.npz`.

    A bare tensor (D, H, W) or (N, C, D, H, W) is a volume whose voxel centres are the integers.

    The file appears whole or not at all. A round trip keeps samples and affine bit for bit; but NIfTI-1 rounds every
    entry of the affine to float32, which changes it by at most 6e-8 of itself. float16 (in NRRD, NIfTI) and bfloat16
    come back as float32. What is declared of the world is written where the format has a place for it: space and unit
    in NRRD; unit, codes of both forms and version in NIfTI, whose space is always RAS. Gradients are not saved.

    Args:
        volume, path: what is written where; the ending tells the format.
        stored: the type in the file, a NumPy name such as uint16; default the samples' own. It has to hold all of them.
        nifti2: write NIfTI-2, which keeps the affine bit for bit and which fewer tools open. Without it NIfTI-1 is
            written wherever it can hold the volume (up to 32767 voxels along an axis, an affine within float32), unless
            it comes from NIfTI-2.

    Raises:
        VolumeFileError: an ending that is not written, a type or batch (N, C, …) that the format cannot hold, samples
            that `stored` cannot hold, or NIfTI-2 under another ending.
        ValueError, TypeError: a bare tensor that is no volume.
        OSError: the folder is missing or not writable.
    """
    from filterlab.volume import as_volume

    volume = as_volume(volume)
    path = check_saveable(path, batched=volume.batched, nifti2=nifti2)
    known = format_of(path)
    options = {"nifti2": nifti2} if known.name == "NIfTI" else {}
    with atomic_write(path) as temporary:
        try:
            known.write(volume, temporary, stored, **options)
        except VolumeFileError as error:  # name the file that was asked for, not the temporary one
            raise VolumeFileError(path, error.expected, error.got) from None
        if path.name.lower().endswith(".npy"):
            function("numpy_files.write_sidecar")(volume, path)
