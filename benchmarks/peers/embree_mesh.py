"""Marching cubes (scikit-image) and Embree (embreex): rays and the triangles of a level set, or of heights on a grid,
without normals."""

# pyright: reportMissingImports=false

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from skimage.measure import marching_cubes
from torch import Tensor

from benchmarks.harness import Contestant
from benchmarks.peers.task import Casting, without

NAME = "Embree"


def missing() -> str | None:
    """It has one thread only."""
    return without("embreex")


def casting(task: Casting) -> Contestant:
    """The rays alone: triangles and tree are made beforehand."""
    scene, rays = built(task, task.level), task.flat()
    return Contestant(NAME, lambda: _traced(scene, rays), samples=task.rays)


def built(task: Casting, level: float) -> Any:
    """Marching cubes, and the tree of what they give."""
    vertices, faces, *_ = marching_cubes(task.volume.numpy(), level)
    return scene_of(vertices[:, ::-1], faces)


def scene_of(vertices: np.ndarray, faces: np.ndarray) -> Any:
    """Triangles (T, 3) of vertices (V, 3), and the tree over them."""
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, np.ascontiguousarray(vertices, dtype=np.float32), faces.astype(np.int32))
    return scene


def of_heights(heights: np.ndarray, spacing: float) -> Any:
    """Two triangles for every four data of (H, W), cut from the datum (i, j) to (i + 1, j + 1), and their tree."""
    from embreex import rtcore_scene
    from embreex.mesh_construction import TriangleMesh

    rows, columns = heights.shape
    x, y = np.meshgrid(spacing * np.arange(columns), spacing * np.arange(rows))
    vertices = np.stack((x, y, heights), -1).reshape(-1, 3).astype(np.float32)
    first = (columns * np.arange(rows - 1)[:, None] + np.arange(columns - 1)).reshape(-1)
    beyond = first + columns + 1
    faces = np.concatenate((np.stack((first, first + 1, beyond), 1), np.stack((first, beyond, beyond - 1), 1)))
    scene = rtcore_scene.EmbreeScene()
    TriangleMesh(scene, vertices, faces.astype(np.int32))
    return scene


def depths(scene: Any, rays: tuple[Tensor, Tensor]) -> Tensor:
    """t (R,) of float32 rays (R, 3), float64; ∞ where nothing is hit."""
    found = scene.run(*(x.numpy() for x in rays), output=True)
    return torch.where(torch.from_numpy(found["primID"]) < 0, torch.inf, torch.from_numpy(found["tfar"]).double())


def new_level(task: Casting, level: Any) -> Contestant:
    """From `level()` to hits."""
    rays = task.flat()
    name = f"marching cubes + {NAME}"
    return Contestant(name, lambda: _traced(built(task, level()), rays), samples=task.rays)


def _traced(scene: Any, rays: tuple[np.ndarray, np.ndarray]) -> Any:
    return scene.run(*rays)
