"""Small valid files of every volume format, written by other people's code: what the readers are tested on."""

from __future__ import annotations

import gzip
import struct
from pathlib import Path

import nibabel
import nrrd
import numpy as np
import tifffile

SAMPLES = np.arange(2 * 3 * 4).reshape(2, 3, 4)  # (D, H, W): every voxel different, every axis too
AFFINE = np.array([[0.0, -0.5, 0.0, 10.0], [0.25, 0.0, 0.0, -20.0], [0.0, 0.0, 2.0, 30.0], [0.0, 0.0, 0.0, 1.0]])


def write_nrrd(path: Path, samples: np.ndarray = SAMPLES, encoding: str = "gzip", **fields: object) -> Path:
    header = {"encoding": encoding, "space directions": AFFINE[:3, :3].T, "space origin": AFFINE[:3, 3]}
    header |= {"space dimension": 3} if "space" not in fields else {}
    nrrd.write(str(path), samples, {**header, **fields}, index_order="C", detached_header=path.suffix == ".nhdr")
    return path


def write_nifti(path: Path, samples: np.ndarray = SAMPLES, slope: float | None = None, inter: float = 0.0) -> Path:
    kind = nibabel.Nifti2Image if "2" in path.name else nibabel.Nifti1Image
    data = bytearray(kind(samples.T, AFFINE, dtype=samples.dtype).to_bytes())
    if slope is not None:  # scl_slope and scl_inter of NIfTI-1; nibabel would choose its own
        struct.pack_into("<ff", data, 112, slope, inter)
    path.write_bytes(gzip.compress(data) if path.suffix == ".gz" else data)
    return path


def write_tiff(path: Path, samples: np.ndarray = SAMPLES, **options: object) -> Path:
    tifffile.imwrite(path, samples, photometric="minisblack", **options)
    return path


def write_raw(path: Path, samples: np.ndarray = SAMPLES, extra: str = "") -> Path:
    samples.tofile(path)
    order = {"<": "little", ">": "big", "=": "little", "|": "little"}[samples.dtype.byteorder]
    path.with_name(path.name + ".yaml").write_text(
        f"size: {list(samples.shape[::-1])}\ndtype: {samples.dtype.name}\nbyte_order: {order}\n{extra}"
    )
    return path


def write_npz(path: Path, samples: np.ndarray = SAMPLES, **arrays: np.ndarray) -> Path:
    np.savez_compressed(path, samples=samples, **arrays)
    return path


def write_npy(path: Path, samples: np.ndarray = SAMPLES) -> Path:
    np.save(path, samples)
    return path


def write_any(folder: Path, ending: str, samples: np.ndarray) -> Path:
    """A file of that ending in the folder."""
    path = folder / f"volume{ending}"
    match ending:
        case ".nrrd" | ".nhdr":
            return write_nrrd(path, samples)
        case ".nii" | ".nii.gz":
            return write_nifti(path, samples)
        case ".tif":
            return write_tiff(path, samples)
        case ".npy":
            return write_npy(path, samples)
        case ".npz":
            return write_npz(path, samples, affine=AFFINE)
        case _:
            return write_raw(path, samples, "spacing: [1, 2, 0.5]\norigin: [4, 5, 6]\n")


ENDINGS = (".nrrd", ".nhdr", ".nii", ".nii.gz", ".tif", ".npy", ".npz", ".raw")
