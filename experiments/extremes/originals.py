"""Small valid volume files of every format and encoding, and where in them damage is done.

Compressed data are damaged from the inside as well: behind a checksum a mutation of the file hardly ever reaches the
header that it is about.
"""

from __future__ import annotations

import bz2
import gzip
import io
import struct
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import tifffile
import torch

from filterlab.io import save_volume
from filterlab.volume import Volume

SAMPLES = np.arange(2 * 3 * 4, dtype=np.int16).reshape(2, 3, 4)
AFFINE = np.array([[0.0, -0.5, 0.0, 10.0], [0.25, 0.0, 0.0, -20.0], [0.0, 0.0, 2.0, 30.0], [0.0, 0.0, 0.0, 1.0]])

Packer = Callable[[bytes], bytes]


@dataclass(frozen=True)
class Original:
    """A valid volume file.

    Attributes:
        name: of its format and encoding.
        path: the name that is loaded, of a file or of a folder.
        files: name -> content of everything that it is read from.
        changed: which of them is damaged.
        content: what is damaged of it: itself, or what is inside.
        pack: puts the damaged content back to where it was.
        frame: which volume of a time series is read.
    """

    name: str
    path: str
    files: dict[str, bytes]
    changed: str
    content: bytes
    pack: Packer = field(default=bytes, repr=False)
    frame: int | None = None

    def write(self, folder: Path) -> None:
        """Writes all of its files."""
        for name, content in self.files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)

    def damage(self, folder: Path, content: bytes) -> None:
        """Writes the damaged file only."""
        (folder / self.changed).write_bytes(self.pack(content))


def originals() -> dict[str, Original]:
    """All of them by name. NIfTI only where nibabel is there."""
    found = [*_nrrd(), *_numpy(), *_raw(), *_tiff(), *_nifti()]
    return {original.name: original for original in found}


def _plain(name: str, path: str, content: bytes, **files: bytes) -> Original:
    return Original(name, path, {path: content, **files}, path, content)


def _inside(outer: Original, name: str, content: bytes, pack: Packer) -> Original:
    return replace(outer, name=name, content=content, pack=pack)


def _saved(name: str, **options: Any) -> dict[str, bytes]:
    """The files that `save_volume` writes."""
    with TemporaryDirectory() as folder:
        save_volume(Volume(torch.from_numpy(SAMPLES.copy()), affine=AFFINE), Path(folder) / name, **options)
        return {path.name: path.read_bytes() for path in Path(folder).iterdir()}


# --- NRRD -------------------------------------------------------------------------------------------------------------

_NRRD = b"""NRRD0004
# a comment
type: short
dimension: 3
space: left-posterior-superior
sizes: 4 3 2
space directions: (0.25,0,0) (0,0.5,0) (0,0,2)
kinds: domain domain domain
endian: big
encoding: %s
space origin: (10,-20,30)
"""
_OLD_NRRD = b"NRRD0001\ntype: short\ndimension: 4\nsizes: 1 4 3 2\nspacings: nan 1 2 0.5\naxis mins: nan 0 0 1\n"
_OLD_NRRD += b"centerings: none cell node cell\nendian: big\nencoding: raw\nbyte skip: 2\n"


def _nrrd() -> list[Original]:
    data = SAMPLES.astype(">i2").tobytes()
    packed = _saved("a.nrrd")["a.nrrd"]
    start = packed.index(b"\n\n") + 2
    whole = _plain("NRRD gzip", "a.nrrd", packed)
    detached = {"a.nhdr": _NRRD % b"raw" + b"data file: a.data\n", "a.data": data}
    return [
        _plain("NRRD raw", "a.nrrd", _NRRD % b"raw" + b"\n" + data),
        _plain("NRRD bzip2", "a.nrrd", _NRRD % b"bzip2" + b"\n" + bz2.compress(data)),
        _plain("NRRD without a space", "a.nrrd", _OLD_NRRD + b"\n??" + data),
        whole,
        _inside(whole, "NRRD inside gzip", gzip.decompress(packed[start:]), lambda b: packed[:start] + _gzip(b)),
        Original("NRRD detached, header", "a.nhdr", detached, "a.nhdr", detached["a.nhdr"]),
        Original("NRRD detached, data", "a.nhdr", detached, "a.data", data),
    ]


_gzip = partial(gzip.compress, compresslevel=1, mtime=0)


# --- NumPy, raw -------------------------------------------------------------------------------------------------------


def _numpy() -> list[Original]:
    npy = _saved("a.npy")
    fortran = io.BytesIO()
    np.save(fortran, np.asfortranarray(SAMPLES.astype(">i2")))
    npz = _plain("npz", "a.npz", _saved("a.npz")["a.npz"])
    members = {name: _npy(array) for name, array in (("samples", SAMPLES), ("affine", AFFINE))}
    spaced = {"samples": members["samples"], "spacing": _npy(np.ones(3)), "origin": _npy(np.zeros(3, np.float32))}
    return [
        Original("npy", "a.npy", npy, "a.npy", npy["a.npy"]),
        Original("npy, sidecar", "a.npy", npy, "a.npy.yaml", npy["a.npy.yaml"]),
        _plain("npy in Fortran's order", "a.npy", fortran.getvalue()),
        npz,
        _plain("npz stored", "a.npz", _zip(members, zipfile.ZIP_STORED)),
        *(
            _inside(npz, f"npz inside {name}", these[name], lambda b, these=these, name=name: _zip(these | {name: b}))
            for these, name in ((members, "samples"), (members, "affine"), (spaced, "spacing"))
        ),
    ]


def _npy(array: np.ndarray) -> bytes:
    stream = io.BytesIO()
    np.save(stream, array)
    return stream.getvalue()


def _zip(members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    stream = io.BytesIO()
    with zipfile.ZipFile(stream, "w", method, compresslevel=1) as archive:
        for name, content in members.items():
            archive.writestr(zipfile.ZipInfo(f"{name}.npy"), content, method)
    return stream.getvalue()


def _raw() -> list[Original]:
    sidecar = b"size: [4, 3, 2]\ndtype: int16\nbyte_order: big\noffset: 2\nspacing: [1, 2, 0.5]\norigin: [4, 5, 6]\n"
    files = {"a.raw": b"??" + SAMPLES.astype(">i2").tobytes(), "a.raw.yaml": sidecar}
    return [
        Original("raw, sidecar", "a.raw", files, "a.raw.yaml", sidecar),
        Original("raw, data", "a.raw", files, "a.raw", files["a.raw"]),
    ]


# --- TIFF -------------------------------------------------------------------------------------------------------------


def _tiff() -> list[Original]:
    slices = {f"slices/a{z}.tif": _written(SAMPLES[z]) for z in range(2)}
    kinds = {
        "TIFF": {},
        "TIFF big-endian": {"byteorder": ">"},
        "BigTIFF": {"bigtiff": True},
        "TIFF deflate": {"compression": "zlib", "predictor": True},
        "TIFF tiled": {"tile": (16, 16), "compression": "zlib"},
        "TIFF by OME": {"ome": True, "metadata": {"axes": "ZYX", **{f"PhysicalSize{axis}": 0.5 for axis in "XYZ"}}},
        "TIFF by ImageJ": {"imagej": True, "resolution": (2.0, 4.0), "metadata": {"spacing": 3.0, "axes": "ZYX"}},
    }
    return [
        *(_plain(name, "a.tif", _written(SAMPLES, **options)) for name, options in kinds.items()),
        Original("TIFF slices", "slices", slices, "slices/a1.tif", slices["slices/a1.tif"]),
    ]


def _written(samples: np.ndarray, **options: object) -> bytes:
    stream = io.BytesIO()
    tifffile.imwrite(stream, samples, photometric="minisblack", **options)  # type: ignore[arg-type]
    return stream.getvalue()


# --- NIfTI ------------------------------------------------------------------------------------------------------------


def _nifti() -> list[Original]:
    try:
        import nibabel  # noqa: F401
    except ImportError:
        return []
    plain = _plain("NIfTI-1", "a.nii", _saved("a.nii")["a.nii"])
    packed = _plain("NIfTI-1 gzip", "a.nii.gz", _gzip(plain.content))
    second = _saved("a.nii", nifti2=True)["a.nii"]
    scaled = bytearray(plain.content)
    struct.pack_into("<ff", scaled, 112, 2.0, -1.0)
    series = bytearray(plain.content + SAMPLES.tobytes())
    struct.pack_into("<5h", series, 40, 4, 4, 3, 2, 2)
    time = replace(_plain("NIfTI-1 time series", "a.nii", bytes(series)), frame=1)
    return [
        plain,
        packed,
        _inside(packed, "NIfTI-1 inside gzip", plain.content, _gzip),
        _plain("NIfTI-2", "a.nii", second),
        _plain("NIfTI-1 scaled", "a.nii", bytes(scaled)),
        time,
        _inside(
            replace(_plain("", "a.nii.gz", _gzip(bytes(series))), frame=1),
            "NIfTI-1 time series inside gzip",
            bytes(series),
            _gzip,
        ),
    ]
