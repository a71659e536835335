"""What rays are cast at: the level set of a signal that everybody who casts rays understands, and an image's rays."""

from __future__ import annotations

from torch import Tensor

from benchmarks.peers.task import Casting
from benchmarks.scene import marschner_lobb
from benchmarks.settings import Settings
from filterlab.methods import reconstruct
from filterlab.surfaces import LevelSet, Surface

LEVEL = 0.5


def task_of(settings: Settings, size: int | None = None, voxels: int | None = None, device: str = "cpu") -> Casting:
    """Rays of size² pixels at a volume of voxels³."""
    scene = marschner_lobb(voxels or settings.image_voxels, size or 2 * settings.image)
    origins, directions = scene.camera.rays(scene.size, scene.size)
    origins, directions = (x.expand(directions.shape).float() for x in (origins, directions))
    volume, origins, directions = (x.contiguous().to(device) for x in (scene.volume, origins, directions))
    return Casting(volume, LEVEL, origins, directions, settings.threads)


def surface_of(task: Casting, method: str, scheme: str = "fused") -> LevelSet:
    """The level set of what a method makes of the volume."""
    gradient = "analytic" if method == "trilinear" else None
    return LevelSet(reconstruct(task.volume, method, scheme=scheme, gradient=gradient), task.level)


def hits_and_normals(surface: Surface, origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """t and n of first hits."""
    hit = surface.hit(origins, directions)
    normal = surface.at(origins, directions, hit).normal
    assert normal is not None
    return hit.t, normal
