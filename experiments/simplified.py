"""Meshes that are simplified to an error: edges collapse where quadric errors are least (libigl), normals are shaded.

Rays meet the triangles exactly; normals go from vertex to vertex, as in any picture of a mesh.

Source: Garland & Heckbert, Surface simplification using quadric error metrics, SIGGRAPH 1997.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from filterlab.arrays import Array, as_tensor
from filterlab.signed_distances import libigl
from filterlab.surfaces import BilinearQuads, Hits, SurfacePoints

_APART = 1.05  # two numbers of triangles that are as good as one
_FEWER = 16  # times, at most


class SmoothTriangles(BilinearQuads):
    """Triangles with normals between those of vertices, which are the means of their triangles' by area.

    Args:
        vertices: (V, 3) float64. triangles: (T, 3) int64, counterclockwise from outside.
    """

    max_order = 1

    def __init__(self, vertices: np.ndarray, triangles: np.ndarray) -> None:
        super().__init__(torch.from_numpy(vertices), torch.from_numpy(triangles[:, [0, 1, 2, 2]]))
        igl = libigl()
        self._normals = torch.from_numpy(
            igl.per_vertex_normals(vertices, triangles, igl.PER_VERTEX_NORMALS_WEIGHTING_TYPE_AREA)
        )

    def at(self, origins: Array, directions: Array, hit: Hits, order: int = 1) -> SurfacePoints:
        """Points, and normals between vertices; of first hits alone."""
        known = super().at(origins, directions, hit, 0)
        if not order or hit.piece is None:
            return known
        u, v = self.parameters(as_tensor(origins), as_tensor(directions), hit).double()[..., None].unbind(-2)
        a, b, c, _ = self._normals[self.quads[hit.piece.clamp_min(0)]].unbind(-2)
        normal = torch.nn.functional.normalize((1 - v) * ((1 - u) * a + u * b) + v * c, dim=-1)
        normal = torch.where(hit.valid[..., None], normal, 0).to(known.point.dtype)
        return SurfacePoints(known.point, normal, normal)


def simplified(
    vertices: np.ndarray, triangles: np.ndarray, error: Callable[[SmoothTriangles], float], wanted: float
) -> SmoothTriangles:
    """A mesh with about the fewest triangles whose error is no larger than wanted; the given one if its own is.

    Args:
        vertices, triangles: of a fine closed mesh. error: falls as triangles become more.
    """
    found, low = SmoothTriangles(vertices, triangles), len(triangles) / _FEWER
    while len(found) > _APART * low:
        middle = math.sqrt(low * len(found))
        mesh = _collapsed(found, int(middle))
        if error(mesh) > wanted:
            low = middle
        elif len(mesh) < len(found):
            found = mesh
        else:
            break
    return found


def _collapsed(mesh: SmoothTriangles, count: int) -> SmoothTriangles:
    vertices = np.asfortranarray(mesh.vertices.numpy())
    triangles = np.asfortranarray(mesh.quads[:, :3].numpy(), dtype=np.int32)
    left, own, *_ = libigl().qslim(vertices, triangles, count)
    return SmoothTriangles(np.ascontiguousarray(left), np.ascontiguousarray(own))


def closed_grid(points: Tensor) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and triangles of a grid (N, M, 3) that goes round both ways."""
    rows, columns = points.shape[:2]
    number = torch.arange(rows * columns).reshape(rows, columns)
    right, below = number.roll(-1, 1), number.roll(-1, 0)
    across = below.roll(-1, 1)
    corners = torch.stack((number, below, across, number, across, right), -1)
    return points.reshape(-1, 3).numpy(), corners.reshape(-1, 3).numpy()
