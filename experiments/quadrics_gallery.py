"""What covers look like: materials, what culling leaves out, sharp edges, reflection lines beside a mesh.

Each picture is of points that are drawn here, on a torus or on a block with sharp edges, and covered by `fit_slim`:

    materials   the same cover in Phong, reflection lines and toon
    culling     the balls that are left for the eye, seen from there and from the side
    edges       the block, with the planes that cut balls at edges, and without any
    triangles   reflection lines of the cover, of its first hits alone, and of marching cubes that are as near

The mesh is that of the least grid of samples of the torus' distance whose vertices' triangles are as near.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from experiments import slim_error, triangles
from experiments.config import ExperimentConfig
from experiments.runs import Record, Run, Unit, timed
from experiments.slim_error import LIFT, SHAPES, along_normals, unblended
from filterlab.fields.base import Domain
from filterlab.render.camera import OrthographicCamera, PerspectiveCamera
from filterlab.render.materials import Material, Phong, ReflectionLines, Toon
from filterlab.render.raycast import raycast
from filterlab.render.shading import Light
from filterlab.surfaces import Quadrics, Slim, Spheres, Surface, fit_slim
from filterlab.volume import Volume

MATERIALS: Mapping[str, Material] = {
    "phong": Phong((0.82, 0.6, 0.35)),
    "reflection-lines": ReflectionLines((0.3, 0.2, 1.0), 10.0),
    "toon": Toon((0.9, 0.72, 0.45), 3, 0.3, 0.02),
}
PICTURES = {
    "materials": tuple(MATERIALS),
    "culling": ("all", "left", "left-from-the-side"),
    "edges": ("cut", "not-cut"),
    "triangles": ("cover", "first-hits", "mesh"),
}
"""What there is a picture of, by section."""
_DIRECTION = (-0.5, 0.7, -0.6)
_LIGHTS = (Light((0.5, -0.6, 0.8), (0.9, 0.88, 0.85)), Light(None, (0.3, 0.32, 0.36)))
_BACKGROUND = (0.02, 0.022, 0.03)
_BLOCK = (1.0, 0.7, 0.45)  # half sides
_HOLE = 0.35  # its radius
_FEWEST, _FINEST = 8, 96  # samples along an axis, of which triangles are made


class Config(ExperimentConfig):
    """Pictures of covers.

    Attributes:
        points: on each shape. tolerance: of covers. size: of pictures, (width, height).
    """

    experiment: Literal["quadrics_gallery"]
    points: Annotated[int, Field(ge=500, le=10**6)] = 12_000
    tolerance: Annotated[float, Field(gt=0, le=0.1)] = 3e-4
    size: tuple[Annotated[int, Field(ge=4, le=4096)], Annotated[int, Field(ge=4, le=4096)]] = (480, 400)


def units(config: Config) -> list[Unit]:
    """One per picture."""
    seconds = config.points * 1e-4 + config.size[0] * config.size[1] * 2e-5
    return [Unit(f"{part}/{name}", f"{part}, {name}", seconds) for part, names in PICTURES.items() for name in names]


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one picture, and its file."""
    part, name = unit.key.split("/")
    surface, material, camera, told = _PARTS[part](config, name, run)
    made, seconds = timed(
        lambda: raycast(surface, camera, material, size=config.size, lights=_LIGHTS, background=_BACKGROUND)
    )
    assert isinstance(made, Tensor)
    saved = run.save_image(f"{part}-{name}", made[..., :3])
    return {"part": part, "name": name, "image": saved, "files": [saved], "seconds": seconds, **told}


Made = tuple[Surface, Material, "PerspectiveCamera | OrthographicCamera", Record]


def _materials(config: Config, name: str, run: Run) -> Made:
    slim = _torus(config, run)
    return slim, MATERIALS[name], _camera(config, slim.domain), {"balls": len(slim)}


def _culling(config: Config, name: str, run: Run) -> Made:
    slim = _torus(config, run)
    camera = _camera(config, slim.domain)
    left = slim.seen_from(torch.tensor(camera.position, dtype=torch.float64))
    side = _camera(config, slim.domain, (0.7, 0.5, -0.6))
    surface = slim if name == "all" else left
    told = {"balls": len(slim), "left": int(_seen(slim, camera).sum())}
    return surface, MATERIALS["phong"], side if name == "left-from-the-side" else camera, told


def _seen(slim: Slim, camera: PerspectiveCamera) -> Tensor:
    """(M,) which balls are left for the eye."""
    each = Quadrics(slim.A, slim.b, slim.c, Spheres(slim.centers, slim.radii), slim.centers, faces=slim.faces)
    return each.facing(torch.tensor(camera.position, dtype=torch.float64))


def _edges(config: Config, name: str, run: Run) -> Made:
    slim = run.memo("block", lambda: fit_slim(*block(config.points, config.seed), config.tolerance))
    surface = slim if name == "cut" else Slim(*slim.tensors)
    assert slim.fit is not None
    told = {"balls": len(slim), "sharp": slim.fit.sharp}
    return surface, MATERIALS["phong"], _camera(config, slim.domain), told


def _triangles(config: Config, name: str, run: Run) -> Made:
    slim, shape = _torus(config, run), SHAPES["torus"]
    seen = shape.draw(2000, config.seed + 1)
    camera = _camera(config, slim.domain)
    if name != "mesh":
        surface = slim if name == "cover" else unblended(slim)
        told = {"balls": len(slim), "rms": along_normals(shape, surface, seen)[0]}
        return surface, MATERIALS["reflection-lines"], camera, told
    rms = along_normals(shape, slim, seen)[0]
    mesh, n, off = run.memo("mesh", lambda: mesh_as_near(rms, seen))
    told = {"triangles": len(mesh.mesh.faces), "samples": n, "rms": off}
    return mesh, MATERIALS["reflection-lines"], camera, told


_PARTS = {"materials": _materials, "culling": _culling, "edges": _edges, "triangles": _triangles}


def _torus(config: Config, run: Run) -> Slim:
    def made() -> Slim:
        return fit_slim(SHAPES["torus"].draw(config.points, config.seed), tolerance=config.tolerance, seed=config.seed)

    return run.memo("torus", made)


def _camera(config: Config, domain: Domain, direction: tuple[float, float, float] = _DIRECTION) -> PerspectiveCamera:
    window = (0.2, 0.2, 0.8, 0.8)  # the box that is framed is that of the balls
    return PerspectiveCamera.framing(domain, direction, aspect=config.size[0] / config.size[1], window=window)


# --- what is shown ----------------------------------------------------------------------------------------------------


def block(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals (N, 3) of a block with a round hole along z, evenly over its area."""
    drawn = np.random.default_rng(seed)
    sides = np.array(_BLOCK)
    areas = np.array([sides[1] * sides[2], sides[0] * sides[2], sides[0] * sides[1]]) * 8
    wall = 4 * np.pi * _HOLE * sides[2]
    on = drawn.choice(4, count, p=np.append(areas, wall) / (areas.sum() + wall))
    points, normals = drawn.uniform(-1, 1, (count, 3)) * sides, np.zeros((count, 3))
    flat = on < 3
    sign = drawn.choice([-1.0, 1.0], count)
    rows = np.nonzero(flat)[0]
    points[rows, on[flat]], normals[rows, on[flat]] = (sign * sides[on % 3])[flat], sign[flat]
    angle = drawn.uniform(0, 2 * np.pi, count)
    round_ = np.stack((np.cos(angle), np.sin(angle), 0 * angle), 1)
    points[~flat, :2], normals[~flat] = _HOLE * round_[~flat, :2], -round_[~flat]
    kept = (np.hypot(points[:, 0], points[:, 1]) >= _HOLE * (1 - 1e-9)) | (on < 2)
    return points[kept], normals[kept]


def mesh_as_near(rms: float, seen: np.ndarray) -> tuple[triangles.Triangles, int, float]:
    """Marching cubes of the least number of samples whose rms distance, in diagonals, is at most that; with both."""
    low, high = _FEWEST, _FINEST
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if _off(_mesh(middle), seen) <= rms else (middle, high)
    found = _mesh(high)
    return found, high, _off(found, seen)


def _mesh(n: int) -> triangles.Triangles:
    half = 1.1 * (slim_error.RING + slim_error.TUBE)
    axis = np.linspace(-half, half, n)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    off = SHAPES["torus"].distance(np.stack((x, y, z), -1).reshape(-1, 3)).reshape(n, n, n)
    spacing = 2 * half / (n - 1)
    volume = Volume(torch.from_numpy(-off), spacing=(spacing,) * 3, origin=(-half,) * 3)
    return triangles.marching_cubes(volume, 0.0, "border")


def _off(mesh: triangles.Triangles, seen: np.ndarray) -> float:
    shape = SHAPES["torus"]
    lift = LIFT * shape.diagonal
    p, n = torch.from_numpy(seen), torch.from_numpy(shape.normal(seen))
    t = mesh.hit(p + lift * n, -n).t
    off = t[t < torch.inf] - lift
    return float(off.square().mean().sqrt()) / shape.diagonal
