"""Surfaces: what a ray can hit, exactly.

    Field ────────────▶ LevelSet ──hit(rays)──▶ Hits ──at(rays, hits)──▶ points, normals, curvatures
    A, b, c in bounds ▶ Quadrics ──────┤
    corners ──▶ BilinearQuads ─────────┤
    heights on a grid ▶ HeightField ───┤
    … in balls        ▶ Slim ──────────┘   blended;  points ──fit_slim──▶ Slim
                        LevelSet ──mesh(…)────▶ triangles

Every surface finds its hits in its own way; derivatives of a hit, and what is known of the surface there, are written
once (`surfaces.base`).
"""

from filterlab.surfaces.base import Hits, Surface, SurfacePoints
from filterlab.surfaces.bilinear import BilinearQuads
from filterlab.surfaces.bounds import Bounds, Planes, Spheres, Tetrahedra
from filterlab.surfaces.fitting import fit_slim
from filterlab.surfaces.height_field import HeightField
from filterlab.surfaces.level_set import LevelSet
from filterlab.surfaces.meshes import Mesh, mesh
from filterlab.surfaces.molecular_skin import molecular_skin
from filterlab.surfaces.quadrics import Quadrics
from filterlab.surfaces.relief import Relief
from filterlab.surfaces.slim import Fit, Slim

__all__ = [
    "BilinearQuads",
    "Bounds",
    "Fit",
    "HeightField",
    "Hits",
    "LevelSet",
    "Mesh",
    "Planes",
    "Quadrics",
    "Relief",
    "Slim",
    "Spheres",
    "Surface",
    "SurfacePoints",
    "Tetrahedra",
    "fit_slim",
    "mesh",
    "molecular_skin",
]
