"""How far are covers of points from the surface the points were taken from, and how many balls does that need?

Points are drawn evenly on a closed surface, without noise, and covered at some tolerances, by graphs of second order
and by planes. Rays down the normals of other points of the surface meet the cover, blended and as its first hit alone:

    rms = √ mean (t̃ − t)²,    in parts of the diagonal of the surface's box

so that rms ∝ 1 / ballsᵖ has p = 3/2 for fits of second order (h³, with h² ∝ 1 / balls) and 1 for planes. Triangles
stand beside them: a grid in the surface's two parameters with all vertices on it, of as many triangles as there are
balls, and of as many as it takes to be as near as the blended cover. A scan in a file has no surface but its points:
their own distances are told, to first order.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from typing import Annotated, Literal, NamedTuple

import numpy as np
import torch
from pydantic import AfterValidator, Field, model_validator

from experiments.config import ExperimentConfig
from experiments.rms_error import slope
from experiments.runs import Record, Run, Unit, timed
from filterlab.io.config import ConfigError, Problem, StrictModel
from filterlab.io.points import load_points
from filterlab.scenes.model import find_volume
from filterlab.surfaces import Slim, fit_slim

SECONDS_PER_POINT = 4e-4
LIFT = 0.05  # diagonals above the surface, where rays begin
RING, TUBE = 1.0, 0.4  # radii of the torus
AXES = np.array([1.0, 0.7, 0.5])  # half axes of the ellipsoid
_SAMPLES = 20_000  # of the distance of triangles
_MOST = 4000  # quadrilaterals along the grid


def _falling(tolerances: list[float]) -> list[float]:
    if sorted(set(tolerances), reverse=True) != tolerances:
        raise ValueError(f"expected tolerances that fall; got {tolerances}")
    return tolerances


class Study(StrictModel):
    """One surface, or one scan.

    Attributes:
        shape: its name; or `file`, of points, looked for like a volume; left out where there is none of that name.
        points: that are drawn on the shape.
    """

    shape: Literal["torus", "ellipsoid"] | None = None
    file: str | None = None
    points: Annotated[int, Field(ge=100, le=10**7)] = 20_000
    tolerances: Annotated[list[float], Field(min_length=1), AfterValidator(_falling)]

    @model_validator(mode="after")
    def _one(self) -> Study:
        if (self.shape is None) == (self.file is None):
            raise ValueError("expected either a shape or a file")
        return self

    @property
    def label(self) -> str:
        """Its name."""
        return self.shape or str(self.file)


class Config(ExperimentConfig):
    """Distances of covers, by tolerance and order.

    Attributes:
        rays: that measure distances.
    """

    experiment: Literal["slim_error"]
    studies: Annotated[list[Study], Field(min_length=1)]
    orders: Annotated[list[Literal[1, 2]], Field(min_length=1, default_factory=lambda: [2, 1])]
    rays: Annotated[int, Field(ge=10, le=10**7)] = 5000


def check(config: Config, path: str = "") -> None:
    """Raises ConfigError unless every file is there."""
    for i, study in enumerate(config.studies):
        if study.file is not None:
            try:
                find_volume(study.file)
            except ValueError as error:
                raise ConfigError([Problem("", f"{path}studies[{i}].file", str(error))]) from None


def units(config: Config) -> list[Unit]:
    """One per study, order and tolerance, then one fit of orders per study and order."""
    work = []
    for i, study in enumerate(config.studies):
        for order in _orders(config, study):
            for k, tolerance in enumerate(study.tolerances):
                what = f"{study.label}, order {order}, tolerance {tolerance:g}"
                work.append(Unit(f"{i}/{order}/{k}", what, study.points * SECONDS_PER_POINT))
            if study.shape is not None and len(study.tolerances) > 1:
                work.append(Unit(f"{i}/{order}/fit", f"{study.label}, order of {order}", 0.01))
    return work


def _orders(config: Config, study: Study) -> list[Literal[1, 2]]:
    return config.orders if study.shape is not None else [2]


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one unit."""
    index, order, what = unit.key.split("/")
    study = config.studies[int(index)]
    common = {"study": int(index), "order": int(order)}
    if what == "fit":
        done = [run.records[f"{index}/{order}/{k}"] for k in range(len(study.tolerances))]
        balls = [r["balls"] for r in done]
        return {**common, "kind": "fit", **{f"{q}_slope": slope(balls, [r[q] for r in done]) for q in ("rms", "first")}}
    tolerance = study.tolerances[int(what)]
    found = _scan(config, study, tolerance) if study.shape is None else _shape(config, study, tolerance, int(order))
    return {**common, "kind": "cover", "tolerance": tolerance, **found}


def _scan(config: Config, study: Study, tolerance: float) -> Record:
    points, normals = load_points(find_volume(str(study.file)))
    slim, seconds = timed(lambda: fit_slim(points, normals, tolerance, seed=config.seed))
    return _told(slim, float(np.linalg.norm(np.ptp(points, 0))), seconds)


def _shape(config: Config, study: Study, tolerance: float, order: int) -> Record:
    shape = SHAPES[str(study.shape)]
    points = shape.draw(study.points, config.seed)
    slim, seconds = timed(lambda: fit_slim(points, tolerance=tolerance, order=order, seed=config.seed))
    own = _told(slim, shape.diagonal, seconds)
    seen = shape.draw(config.rays, config.seed + 1)
    own["rms"], own["missed"] = along_normals(shape, slim, seen)
    own["first"], _ = along_normals(shape, unblended(slim), seen)
    own["triangles_rms"] = off_grid(shape, own["balls"] // 2)
    own["triangles"] = 2 * int(np.prod(as_near(shape, own["rms"])))
    return own


def _told(slim: Slim, diagonal: float, seconds: float) -> Record:
    assert slim.fit is not None
    fit = slim.fit
    lengths = {"fit_rms": fit.rms / diagonal, "fit_worst": fit.worst / diagonal}
    counts = {name: getattr(fit, name) for name in ("balls", "points", "strays", "sharp", "smallest")}
    return {**counts, **lengths, "seconds": seconds}


def unblended(slim: Slim) -> Slim:
    """The same cover, of which the first hit alone counts."""
    return Slim(*slim.tensors, cuts=slim.cuts, offset=0.0, faces=slim.faces)


@torch.no_grad()
def along_normals(shape: Shape, slim: Slim, points: np.ndarray) -> tuple[float, int]:
    """The rms distance of hits of rays down the normals of points from them, in diagonals; how many rays miss."""
    lift = LIFT * shape.diagonal
    p, n = torch.from_numpy(points), torch.from_numpy(shape.normal(points))
    t = slim.hit(p + lift * n, -n).t
    hit = (t - lift).abs() < lift / 2
    return float((t[hit] - lift).square().mean().sqrt()) / shape.diagonal, int((~hit).sum())


# --- surfaces and triangles on them -----------------------------------------------------------------------------------


class Shape(NamedTuple):
    """A closed surface.

    Attributes:
        draw: points (N, 3), evenly, by their number and a seed.
        at: points (…, 3) at parameters (…, 2) in 0 … 1. normal: (N, 3), of length 1, at points near it.
        distance: of points (N, 3), to first order.
        stretched: how many times as many quadrilaterals a grid has along the first parameter.
    """

    draw: Callable[[int, int], np.ndarray]
    at: Callable[[np.ndarray], np.ndarray]
    normal: Callable[[np.ndarray], np.ndarray]
    distance: Callable[[np.ndarray], np.ndarray]
    stretched: float

    @property
    def diagonal(self) -> float:
        """Of its box."""
        return _diagonal(self)


@cache
def _diagonal(shape: Shape) -> float:
    return float(np.linalg.norm(np.ptp(shape.at(np.random.default_rng(0).uniform(size=(100_000, 2))), 0)))


def off_grid(shape: Shape, quads: int) -> float:
    """The rms distance of the triangles of a grid of about so many quadrilaterals from the surface, in diagonals."""
    return _off(shape, *_grid(shape, quads))


def as_near(shape: Shape, rms: float) -> tuple[int, int]:
    """The grid whose triangles are as near: their error goes with 1 / number, so a few steps find it."""
    rows, columns = _grid(shape, 500)
    for _ in range(4):
        more = math.sqrt(_off(shape, rows, columns) / rms)
        rows, columns = (min(_MOST, max(3, round(n * more))) for n in (rows, columns))
    return rows, columns


def _grid(shape: Shape, quads: int) -> tuple[int, int]:
    """Numbers of quadrilaterals along both parameters."""
    return (max(3, round(math.sqrt(quads * shape.stretched))), max(3, round(math.sqrt(quads / shape.stretched))))


def _off(shape: Shape, rows: int, columns: int) -> float:
    drawn = np.random.default_rng(0)
    cell = np.stack((drawn.integers(0, rows, _SAMPLES), drawn.integers(0, columns, _SAMPLES)), 1)
    weights = drawn.dirichlet((1.0, 1.0, 1.0), _SAMPLES)
    corners = np.where(drawn.uniform(size=(_SAMPLES, 1, 1)) < 0.5, _LOWER, _UPPER)
    vertices = shape.at((cell[:, None] + corners) / [rows, columns])
    sides = np.linalg.norm(np.cross(vertices[:, 1] - vertices[:, 0], vertices[:, 2] - vertices[:, 0]), axis=1)
    off = shape.distance((weights[..., None] * vertices).sum(1)) / shape.diagonal
    return float(math.sqrt((sides * off**2).sum() / sides.sum()))


_LOWER, _UPPER = np.array([[0.0, 0], [1, 0], [0, 1]]), np.array([[1.0, 1], [0, 1], [1, 0]])


def _torus(count: int, seed: int) -> np.ndarray:
    drawn = np.random.default_rng(seed)
    at = drawn.uniform(size=(3 * count, 2))
    kept = drawn.uniform(size=len(at)) * (RING + TUBE) < RING + TUBE * np.cos(2 * np.pi * at[:, 1])
    return _on_torus(at[kept][:count])


def _on_torus(at: np.ndarray) -> np.ndarray:
    a, b = 2 * np.pi * at[..., 0], 2 * np.pi * at[..., 1]
    ring = RING + TUBE * np.cos(b)
    return np.stack((ring * np.cos(a), ring * np.sin(a), TUBE * np.sin(b)), -1)


def _torus_normal(points: np.ndarray) -> np.ndarray:
    ring = points * [1, 1, 0]
    apart = points - RING * ring / np.linalg.norm(ring, axis=1, keepdims=True)
    return apart / np.linalg.norm(apart, axis=1, keepdims=True)


def _off_torus(points: np.ndarray) -> np.ndarray:
    return np.hypot(np.hypot(points[:, 0], points[:, 1]) - RING, points[:, 2]) - TUBE


def _ellipsoid(count: int, seed: int) -> np.ndarray:
    """Evenly over its area: those of a ball, kept by how much it is stretched there."""
    drawn = np.random.default_rng(seed)
    ball = drawn.standard_normal((4 * count, 3))
    ball /= np.linalg.norm(ball, axis=1, keepdims=True)
    stretch = np.linalg.norm(ball / AXES, axis=1) * AXES.min()
    return (ball * AXES)[drawn.uniform(size=len(ball)) < stretch][:count]


def _on_ellipsoid(at: np.ndarray) -> np.ndarray:
    a, b = 2 * np.pi * at[..., 0], np.pi * at[..., 1]
    return np.stack((np.sin(b) * np.cos(a), np.sin(b) * np.sin(a), np.cos(b)), -1) * AXES


def _ellipsoid_normal(points: np.ndarray) -> np.ndarray:
    gradient = points / AXES**2
    return gradient / np.linalg.norm(gradient, axis=1, keepdims=True)


def _off_ellipsoid(points: np.ndarray) -> np.ndarray:
    value = ((points / AXES) ** 2).sum(1) - 1
    return value / (2 * np.linalg.norm(points / AXES**2, axis=1))


SHAPES = {
    "torus": Shape(_torus, _on_torus, _torus_normal, _off_torus, RING / TUBE),
    "ellipsoid": Shape(_ellipsoid, _on_ellipsoid, _ellipsoid_normal, _off_ellipsoid, 1.5),
}
