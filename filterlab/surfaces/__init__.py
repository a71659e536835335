"""Surfaces: what a ray can hit, exactly.

    Field ──▶ LevelSet ──hit(rays)──▶ Hits ──at(rays, hits)──▶ points, normals, curvatures

Every surface finds its hits in its own way; derivatives of a hit, and what is known of the surface there, are written
once (`surfaces.base`).
"""

from filterlab.surfaces.base import Hits, Surface, SurfacePoints
from filterlab.surfaces.level_set import LevelSet

__all__ = ["Hits", "LevelSet", "Surface", "SurfacePoints"]
