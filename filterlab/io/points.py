"""Scanned points in: PLY, OBJ and STL, by trimesh and libigl (the extra `mesh`), and tables of numbers.

| ending | what is read |
|---|---|
| .xyz, .pts, .asc, .txt, .csv | x y z or x y z nx ny nz a line, with spaces or commas between; `#` begins a comment |
| .ply | points, with normals where it has them, or the vertices of triangles |
| .obj | all vertices, those of no triangle too |
| .stl, and what else trimesh reads | the vertices of triangles |

Normals that are not in the file are those of its triangles, which go round counter-clockwise as seen from outside: at a
vertex the sum of theirs, by area. A vertex of no triangle has that of the nearest one.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from filterlab.io.meshes import check_trimesh, load_mesh
from filterlab.signed_distances import libigl

TABLES = (".xyz", ".pts", ".asc", ".txt", ".csv")


class Points(NamedTuple):
    """Scanned points.

    Attributes:
        points: (N, 3) float64. normals: (N, 3), of any length; None: none are known.
    """

    points: np.ndarray
    normals: np.ndarray | None


def load_points(path: str | os.PathLike[str]) -> Points:
    """The points in a file, in its own units and order.

    Raises:
        FileNotFoundError: no such file. ValueError: it holds no points, or cannot be read; or no trimesh.
    """
    path = Path(path)
    if not path.is_file():
        got = "a folder" if path.is_dir() else "no file of this name"
        raise FileNotFoundError(f"{path}: expected a file of points; got {got}")
    read = _table if path.suffix.lower() in TABLES else _obj if path.suffix.lower() == ".obj" else _other
    found = read(path)
    if not len(found.points):
        raise ValueError(f"{path}: expected points; got none")
    return found


def _table(path: Path) -> Points:
    try:
        lines = path.read_text(encoding="utf-8").replace(",", " ").splitlines()
        rows = np.loadtxt(lines, dtype=np.float64, ndmin=2) if any(map(str.strip, lines)) else np.zeros((0, 3))
    except ValueError as error:  # also of letters that are none
        raise ValueError(f"{path}: expected lines of 3 or 6 numbers; got {error}") from None
    if rows.shape[1] not in (3, 6):
        raise ValueError(f"{path}: expected lines of 3 or 6 numbers; got {rows.shape[1]}")
    return Points(rows[:, :3].copy(), rows[:, 3:].copy() if rows.shape[1] == 6 else None)


def _obj(path: Path) -> Points:
    vertices, _, _, faces, _, _ = libigl().readOBJ(str(path))
    return _of_triangles(np.asarray(vertices, np.float64).reshape(-1, 3), np.asarray(faces, np.int64).reshape(-1, 3))


def _other(path: Path) -> Points:
    check_trimesh(path)
    if (cloud := _cloud(path)) is not None:
        return cloud
    triangles = load_mesh(path)
    return _of_triangles(triangles.vertices.numpy(), triangles.faces.numpy())


def _cloud(path: Path) -> Points | None:
    """Of a PLY file without faces; None of any other."""
    import trimesh

    if path.suffix.lower() != ".ply":
        return None
    try:
        found: Any = trimesh.load(path, process=False)
    except (OSError, MemoryError):
        raise
    except Exception as error:  # readers raise whatever they come upon
        raise ValueError(f"{path}: expected points; got {type(error).__name__}: {error}") from error
    elements = found.metadata.get("_ply_raw", {})
    if not isinstance(found, trimesh.PointCloud) or set(elements) - {"vertex"}:
        return None
    data = elements["vertex"]["data"]
    names = data.dtype.names or ()
    known = {"nx", "ny", "nz"} <= set(names)
    normals = np.stack([data[name].reshape(-1) for name in ("nx", "ny", "nz")], 1) if known else None
    return Points(np.array(found.vertices, np.float64), None if normals is None else normals.astype(np.float64))


def _of_triangles(points: np.ndarray, faces: np.ndarray) -> Points:
    """With normals, if there are triangles that have some."""
    if not len(faces) or not np.isfinite(points).all():
        return Points(points, None)
    a, b, c = (points[faces[:, k]] for k in range(3))
    area = np.cross(b - a, c - a)
    normals = np.stack([_summed(faces, area[:, k], len(points)) for k in range(3)], 1)
    length = np.linalg.norm(normals, axis=1)
    known = length > 0
    if not known.any():
        return Points(points, None)
    normals[known] /= length[known, None]
    return Points(points, _with_neighbors(points, normals, known))


def _summed(faces: np.ndarray, of_face: np.ndarray, count: int) -> np.ndarray:
    """(count,) sums over the faces of each vertex."""
    return np.bincount(faces.ravel(), np.repeat(of_face, 3), count)


def _with_neighbors(points: np.ndarray, normals: np.ndarray, known: np.ndarray) -> np.ndarray:
    from scipy.spatial import KDTree

    if known.all():
        return normals
    _, nearest = KDTree(points[known]).query(points[~known])
    normals[~known] = normals[known][nearest]
    return normals
