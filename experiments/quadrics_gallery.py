"""What quadrics and covers look like: the pictures of paper 002, its figures 1, 3 and 7 to 12.

    materials   a cover in Phong, reflection lines and toon                                             (1, 7)
    culling     the balls that are left for the eye, seen from there and from the side                  (3)
    edges       a block, with the planes that cut balls at edges, and without any; two paraboloids      (8)
    quads       bilinear quads, and two triangles for each, with their outlines                         (9)
    levels      level sets of splines as quadrics in their tetrahedra, and walked through               (10)
    scan        a cover of points from a file, in all materials                                         (1, 7, 11)
    triangles   reflection lines of a cover, of its first hits alone, of a mesh that is simplified to as
                large an error, and of marching cubes with no larger one                                (12)

Points are drawn here, on a torus and on a block with sharp edges, and covered by `fit_slim`; samples of a jet of fuel
are made where there is no file of them. Marching cubes are those of the least grid of samples of the torus' distance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Annotated, Literal, NamedTuple

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

import filterlab as fl
from experiments import slim_error, triangles
from experiments.config import ExperimentConfig, VolumeChoice
from experiments.runs import Record, Run, Unit, timed
from experiments.simplified import SmoothTriangles, closed_grid, simplified
from experiments.slim_error import SHAPES, along_normals, unblended
from filterlab import signals
from filterlab.fields.base import Domain
from filterlab.fields.base import Field as FilterField
from filterlab.io.points import load_points
from filterlab.render.camera import OrthographicCamera, PerspectiveCamera
from filterlab.render.materials import Material, Phong, ReflectionLines, Toon
from filterlab.render.raycast import raycast
from filterlab.render.shading import Light
from filterlab.scenes.model import find_volume
from filterlab.surfaces import BilinearQuads, LevelSet, Quadrics, Slim, Spheres, Surface, fit_slim
from filterlab.volume import Volume

MATERIALS: Mapping[str, Callable[[float], Material]] = {
    "phong": lambda diagonal: Phong((0.82, 0.6, 0.35)),
    "reflection-lines": lambda diagonal: ReflectionLines((0.3, 0.2, 1.0), 10.0),
    "toon": lambda diagonal: Toon((0.9, 0.72, 0.45), 3, 0.3, 0.005 * diagonal),
}
PICTURES = {
    "materials": tuple(MATERIALS),
    "culling": ("all", "left", "left-from-the-side"),
    "edges": ("cut", "not-cut", "two-paraboloids"),
    "quads": ("bilinear", "two-triangles"),
    "levels": ("fuel-stored", "fuel-walked", "marschner-lobb-stored", "marschner-lobb-walked"),
    "scan": tuple(MATERIALS),
    "triangles": ("cover", "first-hits", "simplified", "marching-cubes"),
}
"""What there is a picture of, by section."""
_DIRECTION = (-0.5, 0.7, -0.6)
_LIGHTS = (Light((0.5, -0.6, 0.8), (0.9, 0.88, 0.85)), Light(None, (0.3, 0.32, 0.36)))
_BACKGROUND = (0.02, 0.022, 0.03)
_BLOCK = (1.0, 0.7, 0.45)  # half sides
_HOLE = 0.35  # its radius
_FEWEST, _FINEST = 8, 96  # samples along an axis, of which triangles are made
_FINER = 1.5  # times along both ways, than a grid that is as near, is one that is simplified
_PHONG, _LINES = (MATERIALS[name](0.0) for name in ("phong", "reflection-lines"))
_FEW_LINES = ReflectionLines((0.3, 0.2, 1.0), 4.0)  # of scans, which are bumpy
_CLOSE, _NEAR, _ALL = (0.5, 0.5, 0.72, 0.72), (0.2, 0.2, 0.8, 0.8), (0.0, 0.0, 1.0, 1.0)
_LOWER, _SCANNED = (0.2, 0.3, 0.8, 0.9), (0.12, 0.12, 0.88, 0.88)
_BLACK = Phong((0.004, 0.004, 0.004), specular=0.0)  # of outlines
_THIN = 0.018  # radius of outlines


class Config(ExperimentConfig):
    """Pictures of covers.

    Attributes:
        points: on each shape. tolerance: of covers. size: of pictures, (width, height).
        scan: a file of points, looked for like a volume. Left out where there is none of that name.
        scanned_along: the direction that it is looked at along.
        fuel: samples of a fuel jet; made ones where there are none. fuel_level: that is shown of them, of the largest.
        samples: along an axis, of made ones and of Marschner and Lobb's signal.
    """

    experiment: Literal["quadrics_gallery"]
    points: Annotated[int, Field(ge=500, le=10**6)] = 12_000
    tolerance: Annotated[float, Field(gt=0, le=0.1)] = 3e-4
    size: tuple[Annotated[int, Field(ge=4, le=4096)], Annotated[int, Field(ge=4, le=4096)]] = (480, 400)
    scan: str | None = None
    scanned_along: tuple[float, float, float] = (0.3, -0.25, -1.0)
    fuel: VolumeChoice | None = None
    fuel_level: Annotated[float, Field(gt=0, lt=1)] = 0.1
    samples: Annotated[int, Field(ge=6, le=256)] = 41


def units(config: Config) -> list[Unit]:
    """One per picture."""
    seconds = config.points * 1e-4 + config.size[0] * config.size[1] * 2e-5
    pictures = {part: names for part, names in PICTURES.items() if part != "scan" or _scan_file(config)}
    return [Unit(f"{part}/{name}", f"{part}, {name}", seconds) for part, names in pictures.items() for name in names]


class Shown(NamedTuple):
    """What a picture is of.

    Attributes:
        told: what its record says besides. outlines: lines upon the surface.
    """

    surface: Surface
    material: Material
    camera: PerspectiveCamera | OrthographicCamera
    told: Record
    outlines: Surface | None = None

    def image(self, size: tuple[int, int]) -> Tensor:
        """(H, W, 3) linear RGB."""
        seen = _cast(self.surface, self.camera, self.material, size)
        if self.outlines is None:
            return seen["color"][..., :3]
        lines = _cast(self.outlines, self.camera, _BLACK, size)
        return torch.where(lines["depth"] < seen["depth"], lines["color"], seen["color"])[..., :3]


def _cast(surface: Surface, camera: PerspectiveCamera | OrthographicCamera, material: Material, size: tuple[int, int]):
    shown = {"size": size, "lights": _LIGHTS, "background": _BACKGROUND, "channels": ("color", "depth")}
    made = raycast(surface, camera, material, **shown)
    assert isinstance(made, dict)
    return made


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one picture, and its file."""
    part, name = unit.key.split("/")
    shown = _PARTS[part](config, name, run)
    image, seconds = timed(lambda: shown.image(config.size))
    saved = run.save_image(f"{part}-{name}", image)
    return {"part": part, "name": name, "image": saved, "files": [saved], "seconds": seconds, **shown.told}


def _materials(config: Config, name: str, run: Run) -> Shown:
    slim = _torus(config, run)
    return Shown(slim, MATERIALS[name](slim.domain.diagonal), _camera(config, slim.domain), {"balls": len(slim)})


def _culling(config: Config, name: str, run: Run) -> Shown:
    slim = _torus(config, run)
    camera = _camera(config, slim.domain)
    left = slim.seen_from(torch.tensor(camera.position, dtype=torch.float64))
    side = _camera(config, slim.domain, (0.7, 0.5, -0.6))
    surface = slim if name == "all" else left
    told = {"balls": len(slim), "left": int(_seen(slim, camera).sum())}
    return Shown(surface, _PHONG, side if name == "left-from-the-side" else camera, told)


def _seen(slim: Slim, camera: PerspectiveCamera) -> Tensor:
    """(M,) which balls are left for the eye."""
    each = Quadrics(slim.A, slim.b, slim.c, Spheres(slim.centers, slim.radii), slim.centers, faces=slim.faces)
    return each.facing(torch.tensor(camera.position, dtype=torch.float64))


def _edges(config: Config, name: str, run: Run) -> Shown:
    if name == "two-paraboloids":
        surface = paraboloids()
        camera = _camera(config, surface.domain, (0.15, 0.75, -0.6), _LOWER)
        return Shown(surface, _PHONG, camera, {"balls": len(surface)})
    slim = run.memo("block", lambda: fit_slim(*block(config.points, config.seed), config.tolerance))
    surface = slim if name == "cut" else Slim(*slim.tensors)
    assert slim.fit is not None
    told = {"balls": len(slim), "sharp": slim.fit.sharp}
    return Shown(surface, _PHONG, _camera(config, slim.domain), told)


def _quads(config: Config, name: str, run: Run) -> Shown:
    vertices, quads = net(config.seed)
    outlines = _tubes(vertices, quads)
    if name == "two-triangles":
        quads = torch.cat((quads[:, [0, 1, 2, 2]], quads[:, [0, 2, 3, 3]]))
    surface = BilinearQuads(vertices, quads)
    camera = _camera(config, surface.domain, (-0.5, 0.75, -0.75), _ALL)
    return Shown(surface, _PHONG, camera, {name.split("-")[-1]: len(surface)}, outlines)


def _levels(config: Config, name: str, run: Run) -> Shown:
    data, kind = name.rsplit("-", 1)
    field, level = run.memo(data, lambda: _FIELDS[data](config))
    camera = _camera(config, field.domain, *_LEVELS[data])
    walked = LevelSet(field, level)
    if kind == "walked":
        return Shown(walked, _PHONG, camera, {})
    stored, seconds = timed(lambda: Quadrics.of_level_set(field, level))
    told = {
        "tetrahedra": len(stored),
        "stored_seconds": seconds,
        "differ": _differ(walked, stored, camera, config.size),
    }
    return Shown(stored, _PHONG, camera, told)


def _differ(one: Surface, other: Surface, camera: PerspectiveCamera, size: tuple[int, int]) -> int:
    """How many pixels see one alone, or both at places more than 1e-9 of their distance apart."""
    rays = [x.double() for x in camera.rays(*size)]
    a, b = (surface.hit(*rays).t for surface in (one, other))
    return int(((a - b).abs() > 1e-9 * b.abs()).logical_or((a < torch.inf) != (b < torch.inf)).sum())


def _fuel(config: Config) -> tuple[FilterField, float]:
    given = config.fuel is not None and config.fuel.present
    volume = config.fuel.load() if config.fuel is not None and given else jet(config.samples)
    return fl.reconstruct(volume.to(torch.float64), "qss"), config.fuel_level * float(volume.samples.max())


def _marschner_lobb(config: Config) -> tuple[FilterField, float]:
    return fl.reconstruct(signals.marschner_lobb().sample(config.samples, dtype=torch.float64), "qss"), 0.5


_FIELDS = {"fuel": _fuel, "marschner-lobb": _marschner_lobb}
_LEVELS = {  # directions they are looked at along, and what is seen
    "fuel": ((-0.6, 0.7, -0.5), (0.28, 0.22, 0.82, 0.76)),
    "marschner-lobb": ((-0.3, 0.35, -0.9), (0.13, 0.13, 0.87, 0.87)),
}


def _scan(config: Config, name: str, run: Run) -> Shown:
    def made() -> Slim:
        points, normals = load_points(find_volume(str(config.scan)))
        return fit_slim(points, normals, config.tolerance, seed=config.seed)

    slim = run.memo("scan", made)
    material = _FEW_LINES if name == "reflection-lines" else MATERIALS[name](slim.domain.diagonal)
    up = (0.0, 1.0, 0.0)
    camera = PerspectiveCamera.framing(
        slim.domain, config.scanned_along, up=up, aspect=config.size[0] / config.size[1], window=_SCANNED
    )
    return Shown(slim, material, camera, {"balls": len(slim)})


def _scan_file(config: Config) -> bool:
    try:
        return config.scan is not None and find_volume(config.scan).exists()
    except ValueError:
        return False


def _triangles(config: Config, name: str, run: Run) -> Shown:
    slim, seen = _torus(config, run), SHAPES["torus"].draw(2000, config.seed + 1)
    rms = _off(slim, seen)
    surface = {
        "cover": lambda: slim,
        "first-hits": lambda: unblended(slim),
        "simplified": lambda: _simplified(rms, seen),
        "marching-cubes": lambda: mesh_as_near(rms, seen),
    }[name]()
    count = {"balls": len(surface)} if isinstance(surface, Slim) else {"triangles": _count(surface)}
    camera = _camera(config, slim.domain, window=_CLOSE)
    return Shown(surface, _LINES, camera, {**count, "rms": _off(surface, seen)})


def _count(mesh: triangles.Triangles | SmoothTriangles) -> int:
    return len(mesh.mesh.faces) if isinstance(mesh, triangles.Triangles) else len(mesh)


_PARTS = {
    "materials": _materials,
    "culling": _culling,
    "edges": _edges,
    "quads": _quads,
    "levels": _levels,
    "scan": _scan,
    "triangles": _triangles,
}


def _torus(config: Config, run: Run) -> Slim:
    def made() -> Slim:
        return fit_slim(SHAPES["torus"].draw(config.points, config.seed), tolerance=config.tolerance, seed=config.seed)

    return run.memo("torus", made)


def _camera(
    config: Config,
    domain: Domain,
    direction: tuple[float, float, float] = _DIRECTION,
    window: tuple[float, float, float, float] = _NEAR,
) -> PerspectiveCamera:
    """The box that is framed may be that of balls: as a rule less of it is looked at."""
    aspect = config.size[0] / config.size[1]
    return PerspectiveCamera.framing(domain, direction, aspect=aspect, window=window)


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


def paraboloids() -> Slim:
    """Two balls at one place, each with a paraboloid that a plane between them cuts off: figure 8."""
    bent = torch.diag(torch.tensor([0.35, 0.35, 0.0], dtype=torch.float64))
    side = torch.tensor([[0.45, 0.0, 0.5], [-0.45, 0.0, 0.5]], dtype=torch.float64)
    cuts = torch.tensor([[[-1.0, 0, 0, 0]], [[1.0, 0, 0, 0]]], dtype=torch.float64)
    one = torch.ones(2, dtype=torch.float64)
    return Slim(cuts[:, 0, :3] * 0, one, bent.expand(2, 3, 3), side, 0 * one, cuts=cuts, faces="both")


def net(seed: int) -> tuple[Tensor, Tensor]:
    """Vertices and quads of a net of four by three, bent at random."""
    drawn = np.random.default_rng(seed)
    x, y = np.meshgrid(np.arange(5.0), np.arange(4.0), indexing="ij")
    corners = np.stack((x, y, 1.1 * drawn.uniform(-0.5, 0.5, x.shape)), -1)
    corners[..., :2] += drawn.uniform(-0.15, 0.15, (*x.shape, 2))
    number = np.arange(x.size).reshape(x.shape)
    quads = np.stack((number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]), -1)
    return torch.from_numpy(corners.reshape(-1, 3)), torch.from_numpy(quads.reshape(-1, 4))


def _tubes(vertices: Tensor, quads: Tensor) -> Quadrics:
    """Thin ones along all edges."""
    edges = torch.stack((quads, quads.roll(-1, 1)), -1).reshape(-1, 2).sort(1).values.unique(dim=0)
    return Quadrics.cylinders(vertices[edges[:, 0]], vertices[edges[:, 1]], vertices.new_full((len(edges),), _THIN))


def jet(n: int) -> fl.Volume:
    """n³ samples in [-1, 1]³ of what a jet of fuel may look like: a cone along x that breaks up into drops."""
    axis = torch.linspace(-1, 1, n, dtype=torch.float64)
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    along = x + 0.7
    width = 0.06 + 0.28 * along.clamp_min(0)
    drops = 1 + 0.45 * torch.sin(9 * x) * torch.cos(7 * torch.atan2(y, z)) * (along / 1.4).clamp(0, 1)
    value = torch.exp(-(y * y + z * z) / width**2) * drops * torch.exp(-((along.clamp_min(0) / 0.9) ** 4))
    value = value * torch.sigmoid(30 * along)
    return fl.Volume(value, spacing=(2 / (n - 1),) * 3, origin=(-1.0,) * 3)


def _simplified(rms: float, seen: np.ndarray) -> SmoothTriangles:
    """Edges of a fine grid on the torus collapse until it is as far off."""
    shape = SHAPES["torus"]
    rows, columns = (math.ceil(_FINER * n) for n in slim_error.as_near(shape, rms))
    at = np.stack(np.meshgrid(np.arange(rows) / rows, np.arange(columns) / columns, indexing="ij"), -1)
    return simplified(*closed_grid(torch.from_numpy(shape.at(at))), lambda mesh: _off(mesh, seen), rms)


def mesh_as_near(rms: float, seen: np.ndarray) -> triangles.Triangles:
    """Marching cubes of the least number of samples whose rms distance, in diagonals, is at most that."""
    low, high = _FEWEST, _FINEST
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if _off(_mesh(middle), seen) <= rms else (middle, high)
    return _mesh(high)


def _mesh(n: int) -> triangles.Triangles:
    half = 1.1 * (slim_error.RING + slim_error.TUBE)
    axis = np.linspace(-half, half, n)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    off = SHAPES["torus"].distance(np.stack((x, y, z), -1).reshape(-1, 3)).reshape(n, n, n)
    spacing = 2 * half / (n - 1)
    volume = Volume(torch.from_numpy(-off), spacing=(spacing,) * 3, origin=(-half,) * 3)
    return triangles.marching_cubes(volume, 0.0, "border")


def _off(surface: Surface, seen: np.ndarray) -> float:
    """The rms distance from the torus, in diagonals."""
    return along_normals(SHAPES["torus"], surface, seen)[0]
