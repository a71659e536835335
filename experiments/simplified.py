"""Triangles as most programs show them: a fine mesh, simplified until it is as far off as it may be, shaded smoothly.

    fine mesh ─▶ libigl's qslim ─▶ the fewest triangles whose rms distance is small enough ─▶ normals between corners

Rays hit the triangles exactly: each is a bilinear quad with two corners in one place. Normals at vertices are means of
those of the triangles around, weighted by area.

Source: Garland & Heckbert, Surface simplification using quadric error metrics, SIGGRAPH 1997.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from filterlab.signed_distances import libigl
from filterlab.surfaces import BilinearQuads, Hits, SurfacePoints

_ROUNDS = 3  # until the number of triangles is that of the distance that is asked for, to some percent


class SmoothTriangles(BilinearQuads):
    """Triangles (F, 3) between vertices (V, 3), whose normals are interpolated between normals (V, 3) at vertices."""

    max_order = 1

    def __init__(self, vertices: Tensor, faces: Tensor, normals: Tensor) -> None:
        super().__init__(vertices, torch.cat((faces, faces[:, 2:]), 1))
        self.normals = normals

    @classmethod
    def of(cls, vertices: np.ndarray, faces: np.ndarray) -> SmoothTriangles:
        """With normals of the mesh itself."""
        normals = libigl().per_vertex_normals(vertices, faces)
        return cls(*(torch.from_numpy(np.ascontiguousarray(x)) for x in (vertices, faces.astype(np.int64), normals)))

    @torch.no_grad()
    def at(self, origins: Tensor, directions: Tensor, hit: Hits, order: int = 1) -> SurfacePoints:
        """Points, and normals between those at corners."""
        found = super().at(origins, directions, hit, order=0)
        if not order or hit.piece is None:
            return found
        u, v = super().parameters(origins, directions, hit).unbind(-1)
        weights = torch.stack(((1 - u) * (1 - v), u * (1 - v), v), -1)
        corners = self.normals[self.quads[hit.piece.clamp_min(0), :3]].to(weights)
        normal = torch.nn.functional.normalize((weights[..., None] * corners).sum(-2), dim=-1)
        normal = torch.where(hit.valid[..., None], normal, 0)
        return SurfacePoints(found.point, normal, normal)


def as_near(
    vertices: np.ndarray, faces: np.ndarray, rms: float, off: Callable[[SmoothTriangles], float]
) -> tuple[SmoothTriangles, float]:
    """The fewest triangles, to some percent, that `off` says to be as near as `rms`, of a fine mesh; and how near.

    Distances go with 1 / number of triangles, so that each try tells the next. Raises ValueError: the fine mesh is no
    nearer.
    """
    fine = SmoothTriangles.of(vertices, faces)
    if (own := off(fine)) > rms:
        raise ValueError(f"expected a fine mesh nearer than {rms:g}; got one of {len(faces)} triangles, {own:g} off")
    best, count = (fine, own), len(faces) // 8
    for _ in range(_ROUNDS):
        simpler = SmoothTriangles.of(*libigl().qslim(vertices, faces.astype(np.int32), max_m=count)[:2])
        now = off(simpler)
        if now <= rms and len(simpler) < len(best[0]):
            best = simpler, now
        count = min(len(faces) - 1, round(1.02 * count * now / rms))
    return best
