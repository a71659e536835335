"""How far are hits of reconstructed surfaces from those of the signal, and how fast does that fall with the resolution?

A signal is sampled at n³ cell centres and reconstructed; rays are cast at a level set of it and at that of the signal:

    distance: √ mean (t̃ − t)², along rays of unit directions;    normal: √ mean ∠(ñ, n)², in radians

The signal's own hits are found without any of the code that is judged: by many samples along a ray, and bisection. Rays
count where the signal has a hit that is no graze, and where its gradient is not next to 0, as at double points. A hit
more than two voxels away is another piece of surface: it is counted, and left out of the mean.

Marching cubes stands in the same table, its triangles met by the same rays.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal, NamedTuple

import torch
from pydantic import Field, model_validator
from torch import Tensor

from experiments import rms_error, triangles
from experiments.config import BoundaryName, ExperimentConfig, Recipe, Recipes, check_signal, number
from experiments.rms_error import slope
from experiments.runs import Record, Run, Unit, timed
from experiments.signal_surface import first_crossings
from filterlab import metrics
from filterlab.signals import Signal
from filterlab.surfaces import LevelSet, Surface

GRAZE = 0.3  # the least |n·d| of a hit that counts
ELSEWHERE = 2  # voxels between hits of different pieces of surface
SECONDS_PER_RAY = 4e-4


class Study(rms_error.Study):
    """A level set of one signal, at several resolutions.

    Attributes:
        level: of it.
        regular: hits count where the signal's gradient has at least this part of its largest length at hits.
    """

    level: float
    regular: Annotated[float, Field(ge=0, lt=1)] = 0.05


class Config(ExperimentConfig):
    """Errors of hits against resolution."""

    experiment: Literal["hit_error"]
    studies: Annotated[list[Study], Field(min_length=1)]
    methods: Recipes
    marching_cubes: bool = True
    boundary: BoundaryName = "reflect"
    rays: Annotated[int, Field(ge=10, le=10**7)] = 4000

    @model_validator(mode="after")
    def _meshed(self) -> Config:
        if self.marching_cubes and self.device != "cpu":
            raise ValueError("marching_cubes: its triangles are traced on the CPU; expected device: cpu with it")
        return self


def check(config: Config, path: str = "") -> None:
    """Raises ConfigError unless the signals can be evaluated."""
    for i, study in enumerate(config.studies):
        check_signal(study.signal, f"{path}studies[{i}].signal")


def units(config: Config) -> list[Unit]:
    """One per study, resolution and method, then one fit per study and method."""
    names = contenders(config)
    work = []
    for index, study in enumerate(config.studies):
        for n in study.resolutions:
            seconds = config.rays * SECONDS_PER_RAY * n / 64 + (n / 128) ** 3
            work += [Unit(f"{index}/{n}/{name}", f"{study.signal.name} {n}³, {name}", seconds) for name in names]
        fitted = names if study.fitted else []
        work += [Unit(f"{index}/fit/{name}", f"{study.signal.name}, order of {name}", 0.01) for name in fitted]
    return work


def contenders(config: Config) -> list[str]:
    """Keys of what is compared."""
    return [recipe.key for recipe in config.methods] + ([triangles.NAME] if config.marching_cubes else [])


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one unit."""
    index, what, name = unit.key.split("/")
    study, recipe = config.studies[int(index)], next((r for r in config.methods if r.key == name), None)
    own = triangles.RECORD if recipe is None else recipe.record()
    common = {"study": int(index), "signal": study.signal.label, **own}
    if what == "fit":
        return {**common, "kind": "fit", **_declared(recipe), **_fit(study, index, name, run)}
    return {**common, "kind": "error", "resolution": int(what), **_error(config, study, index, int(what), recipe, run)}


def _error(config: Config, study: Study, index: str, n: int, recipe: Recipe | None, run: Run) -> Record:
    signal = study.signal.build()
    truth = run.memo(f"truth:{index}", lambda: truth_of(config, study))
    volume = run.memo(f"volume:{index}/{n}", lambda: signal.sample(n, device=config.device))
    if recipe is None:
        surface, building = timed(lambda: triangles.marching_cubes(volume, study.level, config.boundary))
    else:
        surface, building = timed(lambda: LevelSet(recipe.build(volume, config.boundary), study.level))
    found, hitting = timed(lambda: truth.errors(surface, ELSEWHERE * signal.with_voxel_size(2 / n).domain.voxel_size))
    return {**found, "build_seconds": building, "hit_seconds": hitting}


def _declared(recipe: Recipe | None) -> Record:
    """Orders of distance and normal: L and L − 1; those of central differences are 2, of either kind."""
    if recipe is None:
        return {"declared_distance": 2, "declared_normal": 2}
    order = recipe.declared_order
    return {"declared_distance": order, "declared_normal": 2 if recipe.gradient_kind == "central" else order - 1}


def _fit(study: Study, index: str, name: str, run: Run) -> Record:
    used = study.fitted
    records = [run.records[f"{index}/{n}/{name}"] for n in used]
    orders = {f"{q}_order": slope(used, [r[f"{q}_rms"] for r in records]) for q in ("distance", "normal")}
    return {"resolutions": used, **orders}


# --- the signal's own hits --------------------------------------------------------------------------------------------


class Truth(NamedTuple):
    """Rays, and where they hit the level set of a signal.

    Attributes:
        origins, directions: (R, 3), float64; of unit length.
        t: (R,) of the first hit.
        normal: (R, 3), towards greater values.
        left_out: rays that hit it, but graze it, or where the gradient is next to 0.
    """

    origins: Tensor
    directions: Tensor
    t: Tensor
    normal: Tensor
    left_out: int

    @torch.no_grad()
    def errors(self, surface: Surface, far: float) -> Record:
        """Of the hits of a surface; `far` is the distance from which on a hit is elsewhere."""
        hit = surface.hit(self.origins, self.directions)
        normal = surface.at(self.origins, self.directions, hit).normal
        assert normal is not None
        near = (hit.t - self.t).abs() < far
        distance, angle = (hit.t - self.t)[near], metrics.angular_error(normal[near], self.normal[near])
        angle = angle[angle.isfinite()]
        zero = torch.zeros_like
        return {
            "rays": len(near),
            "left_out": self.left_out,
            "elsewhere": int((~near).sum()),
            "distance_rms": number(metrics.rms(distance, zero(distance))) if len(distance) else None,
            "distance_max": number(distance.abs().max()) if len(distance) else None,
            "normal_rms": number(metrics.rms(angle, zero(angle))) if len(angle) else None,
            "normal_max": number(angle.max()) if len(angle) else None,
        }


def truth_of(config: Config, study: Study) -> Truth:
    """The signal's hits of the rays of a study."""
    signal = study.signal.build()
    origins, directions, length = rays_through(signal, config.rays, study.inner, config.seed)
    t, doubtful = first_crossings(signal, study.level, origins, directions, length)
    points = origins + torch.where(t < math.inf, t, 0)[:, None] * directions
    gradient = signal.value_and_gradient(points)[1]
    size = gradient.norm(dim=-1)
    normal = gradient / size.clamp_min(1e-300)[:, None]
    hit = (t < math.inf) & ~doubtful
    steep = size >= study.regular * torch.where(hit, size, 0).max()
    kept = hit & steep & ((normal * directions).sum(-1).abs() >= GRAZE)
    rows = (x[kept].to(config.device) for x in (origins, directions, t, normal))
    return Truth(*rows, left_out=int((hit & ~kept).sum()))


def rays_through(signal: Signal, count: int, inner: float, seed: int) -> tuple[Tensor, Tensor, Tensor]:
    """Rays (R, 3) of random directions through random points of the shrunk box, from where they enter it on; lengths
    (R,) within."""
    points = rms_error.uniform_points(signal, count, inner, seed, torch.float64, "cpu")
    generator = torch.Generator().manual_seed(seed + 1)
    directions = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    directions = directions / directions.norm(dim=-1, keepdim=True)
    lower, upper = (torch.tensor(c, dtype=torch.float64) for c in (signal.domain.lower, signal.domain.upper))
    center, half = (lower + upper) / 2, inner * (upper - lower) / 2
    ends = torch.stack(((center - half - points) / directions, (center + half - points) / directions))
    near, far = ends.amin(0).amax(-1), ends.amax(0).amin(-1)
    return points + near[:, None] * directions, directions, far - near
