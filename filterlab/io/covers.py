"""SLIM surfaces in files: `.npz` of the arguments of `surfaces.Slim`.

Its arrays are `slim` (1, the version), `centers`, `radii`, `A`, `b`, `c`, `offset`, `faces` (a number, which of
`FACES`) and, where there are any, `cuts`. Nothing is unpickled.
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from filterlab.io.atomic import atomic_write, check_writable
from filterlab.io.bounded import VolumeFileError, regular_file
from filterlab.io.numpy_files import holds_array, read_arrays, write_arrays
from filterlab.surfaces.slim import FACES, Slim

SUFFIX = ".npz"
_VERSION = 1
_TENSORS = ("centers", "radii", "A", "b", "c", "cuts")
_SHAPES: Mapping[str, tuple[int | None, ...]] = {
    "slim": (),
    "centers": (None, 3),
    "radii": (None,),
    "A": (None, 3, 3),
    "b": (None, 3),
    "c": (None,),
    "cuts": (None, None, 4),
    "offset": (),
    "faces": (),
}


def check_slim_file(path: str | os.PathLike[str]) -> Path:
    """The path, once it is known that a cover can be written there. Call it before long work begins.

    Raises:
        ValueError: another ending than `.npz`. OSError: the folder is missing or not writable.
    """
    path = Path(path)
    if path.suffix.lower() != SUFFIX:
        raise ValueError(f"expected a name that ends in {SUFFIX} for a SLIM surface; got {path}")
    return check_writable(path)


def save_slim(slim: Slim, path: str | os.PathLike[str]) -> None:
    """Writes a cover, to the bit; the file appears whole or not at all.

    Raises:
        TypeError: no Slim. ValueError, OSError: as `check_slim_file`.
    """
    if not isinstance(slim, Slim):
        raise TypeError(f"expected a Slim; got {type(slim).__name__}")
    path = check_slim_file(path)
    arrays = {name: getattr(slim, name) for name in _TENSORS}
    numbers = {name: x.detach().cpu().numpy() for name, x in arrays.items() if x is not None}
    about = {"slim": _VERSION, "offset": slim.offset, "faces": FACES.index(slim.faces)}
    with atomic_write(path) as temporary:
        write_arrays(temporary, {name: np.array(x) for name, x in about.items()} | numbers)


def is_slim(path: str | os.PathLike[str]) -> bool:
    """Whether an .npz file says that it holds a cover. Raises VolumeFileError: it is damaged."""
    return holds_array(path, "slim")


def load_slim(path: str | os.PathLike[str]) -> Slim:
    """The cover in a file.

    Raises:
        FileNotFoundError: no such file. ValueError: it holds no cover, is damaged, or has numbers that `Slim` refuses.
    """
    path = regular_file(Path(path))
    found = read_arrays(path, _SHAPES)
    if missing := [name for name in _SHAPES if name not in (*found, "cuts")]:
        raise VolumeFileError(path, f"a SLIM surface with {', '.join(missing)}", "no such arrays")
    if (version := found["slim"].item()) != _VERSION:
        raise VolumeFileError(path, f"version {_VERSION} of SLIM surfaces", version)
    if (faces := found["faces"].item()) not in range(len(FACES)):
        raise VolumeFileError(path, f"faces from 0 to {len(FACES) - 1}", faces)
    tensors = {name: _tensor(path, name, found[name]) for name in _TENSORS if name in found}
    try:
        return Slim(**tensors, offset=float(found["offset"]), faces=FACES[int(faces)])
    except (TypeError, ValueError) as error:
        raise VolumeFileError(path, "a SLIM surface", str(error)) from None


def _tensor(path: Path, name: str, array: np.ndarray) -> Tensor:
    if array.dtype not in (np.float32, np.float64):
        raise VolumeFileError(path, f"float32 or float64 numbers as {name}", array.dtype)
    return torch.from_numpy(np.array(array))
