"""What surfaces of quadrics look like, after the figures of the paper.

    materials    a cover in Phong, reflection lines and toon (figures 1, 7, 11)
    culling      the balls that are left for the eye, seen from there and from the side (3)
    edges        a block with the planes that cut balls at edges, and without any; two paraboloids, one plane (8)
    quads        bilinear quads of a twisted column, and two triangles in place of each (9)
    level-sets   quadrics in tetrahedra of a quadratic super spline, and the walk that stores none (10)
    triangles    reflection lines of a cover, of its first hits alone, and of a mesh that is simplified until it is as
                 far off as the cover: whole, and a part of each (12)

The cover of the first two is of a scan, where its file is there, else of points drawn on a torus, as that of the last.
The level sets are one of Marschner and Lobb's signal, and one of a volume: where its file is not there, of a jet of
droplets that stands in for it.

Source: Stoll, Gumhold & Seidel, Incremental raycasting of piecewise quadratic surfaces on the GPU, 2006.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Literal, NamedTuple

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

import filterlab as fl
from experiments import simplified, slim_error
from experiments.config import ExperimentConfig, VolumeChoice
from experiments.runs import Record, Run, Unit, timed
from experiments.slim_error import LIFT, SHAPES, along_normals, unblended
from filterlab.fields.base import Domain
from filterlab.fields.base import Field as Function
from filterlab.io.config import StrictModel
from filterlab.io.points import load_points
from filterlab.render.camera import PerspectiveCamera
from filterlab.render.materials import Material, Phong, ReflectionLines, Toon
from filterlab.render.raycast import raycast
from filterlab.render.shading import Light
from filterlab.scenes.model import find_volume
from filterlab.surfaces import BilinearQuads, LevelSet, Quadrics, Slim, Spheres, Surface, fit_slim
from filterlab.volume import Volume

MATERIALS: Mapping[str, Material] = {
    "phong": Phong((0.82, 0.6, 0.35)),
    "reflection-lines": ReflectionLines((0.3, 0.2, 1.0), 10.0),
    "toon": Toon((0.9, 0.72, 0.45), 3, 0.3),
}
PICTURES = {
    "materials": tuple(MATERIALS),
    "culling": ("all", "left", "left-from-the-side"),
    "edges": ("cut", "not-cut", "paraboloids-cut", "paraboloids-not-cut"),
    "quads": ("bilinear", "two-triangles", "bilinear-lines", "two-triangles-lines"),
    "level-sets": ("signal-quadrics", "signal-walk", "volume-quadrics", "volume-walk"),
    "triangles": ("cover", "simplified", "first-hits", "cover-part", "simplified-part", "first-hits-part"),
}
"""What there is a picture of, by section."""
_DIRECTION = (-0.5, 0.7, -0.6)
_LIGHTS = (Light((0.5, -0.6, 0.8), (0.9, 0.88, 0.85)), Light(None, (0.3, 0.32, 0.36)))
_BACKGROUND = (0.02, 0.022, 0.03)
_BLOCK = (1.0, 0.7, 0.45)  # half sides
_HOLE = 0.35  # its radius
_BALLS = (0.2, 0.2, 0.8, 0.8)  # of a picture that frames the box of all balls, what the surface takes
_WHOLE = (0.0, 0.0, 1.0, 1.0)
_NEARER = (0.12, 0.12, 0.88, 0.88)
_PART = (0.56, 0.5, 0.68, 0.62)
_CONTOUR = 3e-3  # of the diagonal
_FINER = 3  # times as many triangles as a grid has that is as near, before they are simplified
_TURNED, _STOREYS = 75.0, 3  # degrees that the column turns from one storey to the next
_LINE = 0.012  # radius of the lines along edges of quads


class ScanOf(StrictModel):
    """Points of a surface.

    Attributes:
        file: looked for like a volume. Where there is none, a torus is shown.
        tolerance: of its cover, which smooths its noise.
        up: the axis that points up in pictures.
    """

    file: str
    tolerance: Annotated[float, Field(gt=0, le=0.1)] = 1e-3
    up: Literal["y", "z"] = "y"

    def path(self) -> str | None:
        """Of the file; None where there is none."""
        try:
            return str(find_volume(self.file))
        except ValueError:
            return None


class VolumeShown(StrictModel):
    """A level set of a volume.

    Attributes:
        volume: its file; where it is optional and not there, another one is shown, at a level of its own.
        level: in its values.
    """

    volume: VolumeChoice
    level: float


class Config(ExperimentConfig):
    """Pictures of covers.

    Attributes:
        points: on each shape. tolerance: of covers. size: of pictures, (width, height).
        scan: that is covered; None: a torus.
        samples: of Marschner and Lobb's signal along an axis, and of the jet.
        volume: whose level set is shown; None: that of the jet.
    """

    experiment: Literal["quadrics_gallery"]
    points: Annotated[int, Field(ge=500, le=10**6)] = 12_000
    tolerance: Annotated[float, Field(gt=0, le=0.1)] = 3e-4
    size: tuple[Annotated[int, Field(ge=4, le=4096)], Annotated[int, Field(ge=4, le=4096)]] = (480, 400)
    scan: ScanOf | None = None
    samples: Annotated[int, Field(ge=8, le=512)] = 41
    volume: VolumeShown | None = None


def check(config: Config, path: str = "") -> None:
    """Raises ConfigError unless the volume is sound, or optional and not here."""
    if config.volume is not None and config.volume.volume.present:
        config.volume.volume.check(f"{path}volume.volume")


def units(config: Config) -> list[Unit]:
    """One per picture."""
    seconds = config.points * 1e-4 + config.size[0] * config.size[1] * 2e-5
    return [Unit(f"{part}/{name}", f"{part}, {name}", seconds) for part, names in PICTURES.items() for name in names]


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one picture, and its file."""
    part, name = unit.key.split("/")
    made = _PARTS[part](config, name, run)
    image, seconds = timed(lambda: _picture(config, made.surface, made.camera, made.material))
    saved = run.save_image(f"{part}-{name}", image if made.lines is None else _drawn_over(config, image, made))
    return {"part": part, "name": name, "image": saved, "files": [saved], "seconds": seconds, **made.told}


class Made(NamedTuple):
    """What a picture is of, what its record tells, and lines that are drawn over it."""

    surface: Surface
    material: Material
    camera: PerspectiveCamera
    told: Record
    lines: Quadrics | None = None


def _picture(config: Config, surface: Surface, camera: PerspectiveCamera, material: Material) -> Tensor:
    image = raycast(surface, camera, material, size=config.size, lights=_LIGHTS, background=_BACKGROUND, subpixels=2)
    assert isinstance(image, Tensor)
    return image[..., :3]


def _drawn_over(config: Config, image: Tensor, made: Made) -> Tensor:
    """An image with black lines, where nothing of the surface is in front of them."""
    assert made.lines is not None
    surface, lines = (_depth(config, x, made.camera) for x in (made.surface, made.lines))
    return torch.where(lines < surface, 0.0, image)


def _depth(config: Config, surface: Surface, camera: PerspectiveCamera) -> Tensor:
    found = raycast(surface, camera, size=config.size, channels=("depth",))
    assert isinstance(found, dict)
    return found["depth"]


def _materials(config: Config, name: str, run: Run) -> Made:
    cover = _cover(config, run)
    material, size = MATERIALS[name], math.dist(cover.slim.domain.lower, cover.slim.domain.upper)
    if isinstance(material, Toon):
        material = replace(material, contour=_CONTOUR * size)
    return Made(cover.slim, material, cover.camera(config), {"shown": cover.name, **_balls(cover.slim)})


def _balls(slim: Slim) -> Record:
    return {"balls": len(slim)}


def _culling(config: Config, name: str, run: Run) -> Made:
    cover = _cover(config, run)
    slim, camera = cover.slim, cover.camera(config)
    left = slim.seen_from(torch.tensor(camera.position, dtype=torch.float64))
    side = cover.camera(config, (0.7, 0.5, -0.6))
    surface = slim if name == "all" else left
    told = {"shown": cover.name, **_balls(slim), "left": int(_seen(slim, camera).sum())}
    return Made(surface, MATERIALS["phong"], side if name == "left-from-the-side" else camera, told)


def _seen(slim: Slim, camera: PerspectiveCamera) -> Tensor:
    """(M,) which balls are left for the eye."""
    each = Quadrics(slim.A, slim.b, slim.c, Spheres(slim.centers, slim.radii), slim.centers, faces=slim.faces)
    return each.facing(torch.tensor(camera.position, dtype=torch.float64))


def _edges(config: Config, name: str, run: Run) -> Made:
    if name.startswith("paraboloids"):
        surface = paraboloids(cut=name == "paraboloids-cut")
        return Made(surface, MATERIALS["phong"], _camera(config, surface.domain, (-0.25, 0.9, -0.45)), {"quadrics": 2})
    slim = run.memo("block", lambda: fit_slim(*block(config.points, config.seed), config.tolerance))
    surface = slim if name == "cut" else Slim(*slim.tensors)
    assert slim.fit is not None
    return Made(surface, MATERIALS["phong"], _camera(config, slim.domain), {**_balls(slim), "sharp": slim.fit.sharp})


def _quads(config: Config, name: str, run: Run) -> Made:
    vertices, quads = column()
    shown = quads if name.startswith("bilinear") else torch.cat((quads[:, [0, 1, 2, 2]], quads[:, [0, 2, 3, 3]]))
    surface = BilinearQuads(vertices, shown)
    material = MATERIALS["reflection-lines" if name.endswith("lines") else "phong"]
    camera = _camera(config, surface.domain, (-0.5, 0.8, -0.35), _WHOLE)
    return Made(surface, material, camera, {"quads": len(shown)}, along_edges(vertices, quads))


def _level_sets(config: Config, name: str, run: Run) -> Made:
    which, how = name.split("-")
    field, level, told = run.memo(f"field:{which}", lambda: _field(config, which))
    made, seconds = run.memo(f"stored:{which}", lambda: timed(lambda: Quadrics.of_level_set(field, level)))
    camera = _camera(config, made.domain, (-0.5, 0.6, -0.45), _WHOLE if which == "signal" else _NEARER)
    if how == "walk":
        return Made(LevelSet(field, level), MATERIALS["phong"], camera, {**told, "walk": True})
    size = sum(x.numel() * x.element_size() for x in (*made.tensors, made.bounds.planes))
    return Made(made, MATERIALS["phong"], camera, {**told, "tetrahedra": len(made), "bytes": size, "stored": seconds})


def _field(config: Config, which: str) -> tuple[Function, float, Record]:
    """The spline, its level, and what is told of it."""
    if which == "signal":
        volume, level, shown = fl.signals.marschner_lobb().sample(config.samples), 0.5, "Marschner-Lobb"
    elif config.volume is not None and config.volume.volume.present:
        volume, level = config.volume.volume.load(), config.volume.level
        shown = Path(config.volume.volume.file).name
    else:
        volume, level, shown = jet(config.samples), 0.5, "jet"
    return fl.reconstruct(volume, "qss"), level, {"shown": shown, "samples": list(volume.size)}


def _triangles(config: Config, name: str, run: Run) -> Made:
    slim, shape = _torus(config, run), SHAPES["torus"]
    seen = shape.draw(2000, config.seed + 1)
    window = _PART if name.endswith("part") else _BALLS
    camera, material = _camera(config, slim.domain, window=window), MATERIALS["reflection-lines"]
    if not name.startswith("simplified"):
        surface = slim if name.startswith("cover") else unblended(slim)
        return Made(surface, material, camera, {**_balls(slim), "rms": along_normals(shape, surface, seen)[0]})
    rms = along_normals(shape, slim, seen)[0]
    fewest = lambda: simplified.as_near(*_fine(rms), rms, lambda mesh: _off(mesh, seen))  # noqa: E731
    mesh, off = run.memo("mesh", fewest)
    return Made(mesh, material, camera, {"triangles": len(mesh), "rms": off})


_PARTS = {
    "materials": _materials,
    "culling": _culling,
    "edges": _edges,
    "quads": _quads,
    "level-sets": _level_sets,
    "triangles": _triangles,
}


class _Cover(NamedTuple):
    """What is shown of materials and culling."""

    slim: Slim
    name: str
    up: str
    window: tuple[float, float, float, float]

    def camera(self, config: Config, direction: tuple[float, float, float] = _DIRECTION) -> PerspectiveCamera:
        return _camera(config, self.slim.domain, direction, self.window, self.up)


def _cover(config: Config, run: Run) -> _Cover:
    scan = config.scan
    path = None if scan is None else scan.path()
    if scan is None or path is None:
        return _Cover(_torus(config, run), "torus", "z", _BALLS)
    slim = run.memo("scan", lambda: fit_slim(*load_points(path), scan.tolerance, seed=config.seed))
    return _Cover(slim, Path(path).name, scan.up, _NEARER)


def _torus(config: Config, run: Run) -> Slim:
    def made() -> Slim:
        return fit_slim(SHAPES["torus"].draw(config.points, config.seed), tolerance=config.tolerance, seed=config.seed)

    return run.memo("torus", made)


def _camera(
    config: Config,
    domain: Domain,
    direction: tuple[float, float, float] = _DIRECTION,
    window: tuple[float, float, float, float] = _BALLS,
    up: str = "z",
) -> PerspectiveCamera:
    x, y, z = direction
    way, vertical = (direction, (0.0, 0.0, 1.0)) if up == "z" else ((x, z, -y), (0.0, 1.0, 0.0))
    return PerspectiveCamera.framing(domain, way, up=vertical, aspect=config.size[0] / config.size[1], window=window)


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


def paraboloids(cut: bool) -> Quadrics:
    """Two that meet at an angle above the y axis, in a ball each, cut by the plane between them or not."""
    A = torch.diag(torch.tensor([0.35, 0.35, 0.0], dtype=torch.float64)).expand(2, 3, 3)
    b = torch.tensor([[0.3, 0.0, 0.5], [-0.3, 0.0, 0.5]], dtype=torch.float64)
    centers = torch.tensor([[0.35, 0.0, -0.2], [-0.35, 0.0, -0.2]], dtype=torch.float64)
    planes = torch.tensor([[[-1.0, 0, 0, 0]], [[1.0, 0, 0, 0]]], dtype=torch.float64)
    radii = torch.full((2,), 0.9, dtype=torch.float64)
    return Quadrics(A, b, torch.zeros(2), Spheres(centers, radii), cuts=planes if cut else None)


def column() -> tuple[Tensor, Tensor]:
    """Vertices (V, 3) and quads (Q, 4), all around outside, of a square column that turns from storey to storey."""
    angles = torch.arange(4) * (torch.pi / 2) + torch.arange(_STOREYS + 1)[:, None] * math.radians(_TURNED)
    height = torch.arange(_STOREYS + 1.0)[:, None].expand(-1, 4)
    vertices = torch.stack((angles.cos(), angles.sin(), 0.9 * height), -1).double().flatten(0, 1)
    at = lambda storey, corner: 4 * storey + corner % 4  # noqa: E731
    sides = [[at(s, k), at(s, k + 1), at(s + 1, k + 1), at(s + 1, k)] for s in range(_STOREYS) for k in range(4)]
    ends = [[at(0, k) for k in (3, 2, 1, 0)], [at(_STOREYS, k) for k in range(4)]]
    return vertices, torch.tensor(sides + ends)


def along_edges(vertices: Tensor, quads: Tensor) -> Quadrics:
    """Thin tubes."""
    ends = torch.stack((quads, quads.roll(-1, 1)), -1).flatten(0, 1).sort(1).values.unique(dim=0)
    starts, stops = vertices[ends].unbind(1)
    return Quadrics.cylinders(starts, stops, torch.full((len(ends),), _LINE, dtype=torch.float64))


def jet(n: int) -> Volume:
    """n³ samples of a cone of spray that breaks up into droplets, where no file of a volume is here."""
    drawn = np.random.default_rng(4)
    axis = np.linspace(-1, 1, n)
    z, y, x = np.meshgrid(axis, axis, axis, indexing="ij")
    spread = 0.1 + 0.22 * (z + 1)
    value = np.exp(-((np.hypot(x, y) - spread) ** 2) / (2 * 0.07**2)) * (z < 0.3)
    for height in drawn.uniform(0.0, 0.9, 60):
        angle, away = drawn.uniform(0, 2 * np.pi), (0.1 + 0.22 * (height + 1)) * drawn.normal(1, 0.12)
        at = (x - away * np.cos(angle)) ** 2 + (y - away * np.sin(angle)) ** 2 + (z - height) ** 2
        value = np.maximum(value, np.exp(-at / (2 * drawn.uniform(0.04, 0.09) ** 2)))
    return Volume(torch.from_numpy(value), spacing=(2 / (n - 1),) * 3, origin=(-1.0,) * 3)


def _fine(rms: float) -> tuple[np.ndarray, np.ndarray]:
    """A grid of triangles on the torus, all vertices on it, that is closer to it by far."""
    rows, columns = (max(3, round(n * math.sqrt(_FINER))) for n in slim_error.as_near(SHAPES["torus"], rms))
    i, k = np.meshgrid(np.arange(rows), np.arange(columns), indexing="ij")
    at = lambda i, k: (i % rows) * columns + k % columns  # noqa: E731
    corners = at(i, k), at(i + 1, k), at(i + 1, k + 1), at(i, k + 1)
    faces = np.stack([np.stack([corners[n] for n in some], -1) for some in ((0, 1, 2), (0, 2, 3))], 2).reshape(-1, 3)
    vertices = SHAPES["torus"].at(np.stack((i / rows, k / columns), -1).reshape(-1, 2))
    return np.asfortranarray(vertices), np.asfortranarray(faces)


def _off(mesh: Surface, seen: np.ndarray) -> float:
    shape = SHAPES["torus"]
    lift = LIFT * shape.diagonal
    p, n = torch.from_numpy(seen), torch.from_numpy(shape.normal(seen))
    t = mesh.hit(p + lift * n, -n).t
    off = t[t < torch.inf] - lift
    return float(off.square().mean().sqrt()) / shape.diagonal
