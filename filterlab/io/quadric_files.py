"""Quadrics in files: `.npz` of what `surfaces.Quadrics` is made of, the kinds of it, skins and stored level sets too.

Its arrays are `quadrics` (1, the version), `A`, `b`, `c`, `origins`, `faces` (a number, which of `FACES`), and of
bounds `centers`, `radii`, `planes`, `lower`, `upper`, and `corners` where there are any. Nothing is unpickled.
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
from filterlab.ops.quadrics import FACES
from filterlab.ops.tree import Boxes
from filterlab.surfaces.bounds import Bounds, check_positive, check_rows
from filterlab.surfaces.quadrics import Quadrics

SUFFIX = ".npz"
_VERSION = 1
_COEFFICIENTS = ("A", "b", "c", "origins")
_SHAPES: Mapping[str, tuple[int | None, ...]] = {
    "quadrics": (),
    "A": (None, 3, 3),
    "b": (None, 3),
    "c": (None,),
    "origins": (None, 3),
    "faces": (),
    "centers": (None, 3),
    "radii": (None,),
    "planes": (None, None, 4),
    "lower": (None, 3),
    "upper": (None, 3),
    "corners": (None, None, 3),
}


def save_quadrics(quadrics: Quadrics, path: str | os.PathLike[str]) -> None:
    """Writes quadrics and their bounds, to the bit; the file appears whole or not at all.

    Raises:
        TypeError: no Quadrics. ValueError: another ending than `.npz`. OSError: the folder is missing or not writable.
    """
    if not isinstance(quadrics, Quadrics):
        raise TypeError(f"expected Quadrics; got {type(quadrics).__name__}")
    path = Path(path)
    if path.suffix.lower() != SUFFIX:
        raise ValueError(f"expected a name that ends in {SUFFIX} for quadrics; got {path}")
    bounds = quadrics.bounds
    tensors = dict(zip(_COEFFICIENTS, quadrics.tensors, strict=True)) | bounds.boxes._asdict()
    tensors |= {name: getattr(bounds, name) for name in ("centers", "radii", "planes", "corners")}
    numbers = {name: x.detach().cpu().numpy() for name, x in tensors.items() if x is not None}
    about = {"quadrics": np.array(_VERSION), "faces": np.array(FACES.index(quadrics.faces))}
    with atomic_write(check_writable(path)) as temporary:
        write_arrays(temporary, about | numbers)


def is_quadrics(path: str | os.PathLike[str]) -> bool:
    """Whether an .npz file says that it holds quadrics. Raises VolumeFileError: it is damaged."""
    return holds_array(path, "quadrics")


def load_quadrics(path: str | os.PathLike[str]) -> Quadrics:
    """The quadrics in a file.

    Raises:
        FileNotFoundError: no such file. ValueError: it holds none, is damaged, or has numbers that `Quadrics` refuses.
    """
    path = regular_file(Path(path))
    found = read_arrays(path, _SHAPES)
    if missing := [name for name in _SHAPES if name not in (*found, "corners")]:
        raise VolumeFileError(path, f"quadrics with {', '.join(missing)}", "no such arrays")
    if (version := found["quadrics"].item()) != _VERSION:
        raise VolumeFileError(path, f"version {_VERSION} of quadrics", version)
    if (faces := found["faces"].item()) not in range(len(FACES)):
        raise VolumeFileError(path, f"faces from 0 to {len(FACES) - 1}", faces)
    tensors = {name: torch.from_numpy(np.array(x)) for name, x in found.items() if name not in ("quadrics", "faces")}
    try:
        A, b, c, origins = (tensors.pop(name) for name in _COEFFICIENTS)
        return Quadrics(A, b, c, _bounds(**tensors), origins, faces=FACES[int(faces)])
    except (TypeError, ValueError) as error:
        raise VolumeFileError(path, "quadrics", str(error)) from None


def _bounds(
    centers: Tensor, radii: Tensor, planes: Tensor, lower: Tensor, upper: Tensor, corners: Tensor | None = None
) -> Bounds:
    count = len(check_rows("centers", centers, (None, 3)))
    check_positive("radii", check_rows("radii", radii, (count,)))
    check_rows("planes", planes, (count, None, 4))
    check_rows("lower", lower, (count, 3))
    check_rows("upper", upper, (count, 3))
    if corners is not None:
        check_rows("corners", corners, (count, None, 3))
    if n := int((lower > upper).sum()):
        raise ValueError(f"lower corners of boxes must not lie beyond upper ones; {n} numbers do")
    rows = [None if x is None else x.double() for x in (centers, radii, planes, corners)]
    return Bounds(rows[0], rows[1], rows[2], Boxes(lower.double(), upper.double()), rows[3])  # type: ignore[arg-type]
