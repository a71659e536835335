"""Affine maps between volumes in files, and what the tools that write them mean by the numbers.

world  leads from where a point of the volume is to where it goes, in world coordinates as they are here: RAS where a
       file declares anatomical axes, else the file's own.
itk    leads from points of the target to points of the volume, in ITK's coordinates: LPS where a file declares
       anatomical axes, else the file's own.
fsl    leads from the volume (FLIRT's -in) to the target (-ref), in voxel numbers times voxel sizes; x is counted from
       the other end where the affine of a volume has a positive determinant.

Files are text, four rows of four numbers (# begins a comment); for `itk` also what SimpleITK reads (the extra `itk`):
`.tfm`, `.txt`, `.mat`, `.h5`, as ITK, ANTs, 3D Slicer and elastix write them, of any linear transform.

Sources: FSL's user guide, FLIRT, FAQ (https://fsl.fmrib.ox.ac.uk/fsl/docs/#/registration/flirt/faq); The ITK Software
Guide, book 1, section 3.9.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from filterlab.geometry import Geometry
from filterlab.io import itk
from filterlab.io.bounded import VolumeFileError, VolumeHeader, number, regular_file
from filterlab.names import unknown_name

if TYPE_CHECKING:
    from filterlab.volume import Volume

    Grid = Volume | VolumeHeader
    Read = Callable[[Path], np.ndarray]
    Lead = Callable[[np.ndarray, Grid, Grid], np.ndarray]

MAX_BYTES = 2**16  # of a matrix as text
LPS = np.diag([-1.0, -1.0, 1.0, 1.0])


def load_affine(
    path: str | os.PathLike[str],
    convention: str = "world",
    *,
    volume: Grid,
    target: Grid,
    inverse: bool = False,
) -> np.ndarray:
    """The affine in a file as `resample(volume, like=target, affine=…)` takes it: world points to where they go, 4×4.

    Args:
        path: four rows of four numbers as text; for `itk` also what SimpleITK reads.
        convention: "world", "itk" or "fsl", see the head of this file.
        volume, target: the grids that the file was made for, or their headers: what moves, and what it is put upon.
            Only `itk` and `fsl` ask for them.
        inverse: the file leads from the target to the volume: it was made with both of them the other way round.

    Raises:
        FileNotFoundError: there is no such file.
        VolumeFileError: no 4×4 matrix, one that is not finite, not affine or singular, or a transform that is not
            linear; for `fsl` also a NIfTI file whose voxel sizes are not those of its affine.
        ValueError: an unknown convention.
    """
    path = Path(path)
    if convention not in CONVENTIONS:
        raise ValueError(unknown_name("convention", convention, CONVENTIONS))
    regular_file(path)
    read, lead = CONVENTIONS[convention]
    matrix = _checked(path, read(path))
    return np.linalg.inv(lead(matrix, target, volume)) if inverse else lead(matrix, volume, target)


def _checked(path: Path, matrix: np.ndarray) -> np.ndarray:
    """The matrix. Raises VolumeFileError unless it is affine and can be inverted."""
    if not np.allclose(matrix[3], (0, 0, 0, 1)):
        raise VolumeFileError(path, "an affine matrix, with the last row 0 0 0 1", matrix[3].tolist())
    try:
        return Geometry.of(affine=matrix).affine
    except ValueError:
        raise VolumeFileError(path, "a matrix that can be inverted", matrix.tolist()) from None


def _text(path: Path) -> np.ndarray:
    """Four rows of four numbers. Raises VolumeFileError."""
    if (size := path.stat().st_size) > MAX_BYTES:
        raise VolumeFileError(path, f"4 rows of 4 numbers in at most {MAX_BYTES} bytes", size)
    text = path.read_bytes().decode("utf-8", errors="replace")
    rows = [row for line in text.splitlines() if (row := line.partition("#")[0].replace(",", " ").split())]
    if [len(row) for row in rows] != 4 * [4]:
        hint = " (a transform of ITK: convention itk)" if text.startswith(_ITK_TEXT) else ""
        raise VolumeFileError(path, "4 rows of 4 numbers", f"{text.strip()[:40]!r}{hint}")
    return np.array([[number(path, "the matrix", entry) for entry in row] for row in rows])


_ITK_TEXT = "#Insight Transform File"


def _itk_file(path: Path) -> np.ndarray:
    """A matrix as text, or a transform that ITK wrote."""
    try:
        return _text(path)
    except VolumeFileError:
        return itk.read_affine(path)


def _world(matrix: np.ndarray, volume: Grid, target: Grid) -> np.ndarray:
    return matrix


def _itk(matrix: np.ndarray, volume: Grid, target: Grid) -> np.ndarray:
    return _itk_axes(target) @ np.linalg.inv(matrix) @ _itk_axes(volume)


def _itk_axes(grid: Grid) -> np.ndarray:
    """World coordinates here to ITK's, and back."""
    return LPS if grid.world.axes == "RAS" else np.eye(4)


def _fsl(matrix: np.ndarray, volume: Grid, target: Grid) -> np.ndarray:
    return _from_fsl(target) @ matrix @ np.linalg.inv(_from_fsl(volume))


def _from_fsl(grid: Grid) -> np.ndarray:
    """FSL's coordinates of a grid to world coordinates. Raises VolumeFileError where they are not known."""
    if isinstance(grid, VolumeHeader) and "pixdim" in grid.fields:
        got = f"{grid.fields['pixdim']} and an affine of {' '.join(f'{s:.6g}' for s in grid.spacing)}"
        raise VolumeFileError(grid.path, "one size of voxels, in which FSL measures", f"a pixdim of {got}")
    scaled = np.diag([*grid.spacing, 1.0])
    if np.linalg.det(grid.affine[:3, :3]) > 0:
        scaled[0] = -grid.spacing[0], 0.0, 0.0, grid.spacing[0] * (grid.size[0] - 1)
    return grid.affine @ np.linalg.inv(scaled)


CONVENTIONS: Mapping[str, tuple[Read, Lead]] = {
    "world": (_text, _world),
    "itk": (_itk_file, _itk),
    "fsl": (_text, _fsl),
}
"""Convention -> how its files are read, and the map of world points that a matrix makes."""
