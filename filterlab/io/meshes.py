"""Triangle meshes out: PLY, OBJ and STL, written by trimesh (the extra `mesh`).

| ending | what is written |
|---|---|
| .ply | binary: vertices and normals in float32, faces |
| .obj | text: vertices and normals with 17 decimals, faces |
| .stl | binary: the corners of every triangle for themselves, in float32; no normals of vertices |
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from filterlab.io.atomic import atomic_write, check_writable
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


def _trimesh(path: Path) -> Callable[..., Any]:
    """The class of trimesh. Raises ValueError that names the extra to install."""
    try:
        from trimesh import Trimesh
    except ImportError:
        raise ValueError(
            f"{path}: expected trimesh, which writes meshes (pip install 'filterlab[mesh]'); got no such package"
        ) from None
    return Trimesh
