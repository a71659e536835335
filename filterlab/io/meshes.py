"""Triangle meshes out and in: PLY, OBJ and STL, by trimesh (the extra `mesh`).

| ending | what is written |
|---|---|
| .ply | binary: vertices and normals in float32, faces |
| .obj | text: vertices and normals with 17 decimals, faces |
| .stl | binary: the corners of every triangle for themselves, in float32; no normals of vertices |

Whatever else trimesh reads is read too (OFF, glTF, …), and so are PLY files of triangle strips, by libigl.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch

from filterlab.io.atomic import atomic_write, check_writable
from filterlab.signed_distances import Triangles, libigl
from filterlab.surfaces.meshes import Mesh

MESH_FORMATS: Mapping[str, Mapping[str, Any]] = {
    ".ply": {"vertex_normal": True},
    ".obj": {"include_normals": True, "digits": 17, "header": None},
    ".stl": {},
}
"""Endings of files that meshes are written to, with trimesh's options."""


def check_mesh_file(path: str | os.PathLike[str]) -> Path:
    """The path, once it is known that a mesh can be written there. Call it before long work begins.

    Raises:
        ValueError: another ending, or no trimesh. OSError: the folder is missing or not writable.
    """
    path = Path(path)
    if path.suffix.lower() not in MESH_FORMATS:
        raise ValueError(f"expected a mesh's name that ends in {', '.join(MESH_FORMATS)}; got {path}")
    _trimesh(path)
    return check_writable(path)


def save_mesh(mesh: Mesh, path: str | os.PathLike[str]) -> None:
    """Writes a mesh: `.ply`, `.obj` or `.stl`; the file appears whole or not at all.

    Args:
        mesh: its vertices are kept to the bit by OBJ, at lengths near 1, and rounded to float32 by the others.
        path: the ending tells the format.

    Raises:
        ValueError: another ending, or no trimesh. OSError: the folder is missing or not writable.
    """
    path = check_mesh_file(path)
    content = _content(mesh, path)
    with atomic_write(path) as temporary:
        temporary.write_bytes(content)


def _content(mesh: Mesh, path: Path) -> bytes:
    kind = path.suffix.lower()
    vertices, faces, normals = (x.cpu().numpy() for x in (mesh.vertices, mesh.faces, mesh.normals))
    if not len(faces):
        if kind == ".obj":  # trimesh would write a vertex without numbers
            return b"# no triangles\n"
        normals = None
    own = _trimesh(path)(vertices, faces, vertex_normals=normals, process=False)
    written = own.export(file_type=kind[1:], **MESH_FORMATS[kind])
    return written.encode() if isinstance(written, str) else written


def load_mesh(path: str | os.PathLike[str]) -> Triangles:
    """The triangles in a file: vertices as float64, in the file's own units; several meshes become one.

    Faces of more corners are cut into triangles. Vertices are neither merged nor moved.

    Raises:
        FileNotFoundError: no such file. ValueError: it holds no triangles, or cannot be read; or no trimesh.
    """
    path = Path(path)
    if not path.is_file():
        got = "a folder" if path.is_dir() else "no file of this name"
        raise FileNotFoundError(f"{path}: expected a mesh file; got {got}")
    _trimesh(path)
    try:
        return _read(path)
    except (OSError, MemoryError):
        raise
    except Exception as error:  # readers raise whatever they come upon
        raise ValueError(f"{path}: expected a triangle mesh; got {type(error).__name__}: {error}") from error


def _read(path: Path) -> Triangles:
    import trimesh

    loaded = trimesh.load_scene(path, process=False).to_mesh()
    vertices, faces = loaded.vertices, loaded.faces
    if not len(faces) and path.suffix.lower() == ".ply":  # strips, which trimesh leaves out
        vertices, faces = libigl().read_triangle_mesh(str(path))
    faces = torch.from_numpy(np.array(faces, np.int64)).reshape(-1, 3)
    return Triangles(torch.from_numpy(np.array(vertices, np.float64)), faces)


def check_trimesh(path: Path) -> None:
    """Raises ValueError that names the extra to install, if trimesh is missing."""
    _trimesh(path)


def _trimesh(path: Path) -> Callable[..., Any]:
    """The class of trimesh. Raises ValueError that names the extra to install."""
    try:
        from trimesh import Trimesh
    except ImportError:
        raise ValueError(
            f"{path}: expected trimesh, for files of meshes (pip install 'filterlab[mesh]'); got no such package"
        ) from None
    return Trimesh
