"""Which volume has the level set that these depths, normals and silhouettes are of? Found by descent through hits.

The target is the level set of a sum of Gaussians, sampled finely. What is recovered is a coarser volume, which starts
as a ball. Each way of comparing images is tried twice: with the derivatives of edges (`raycast(silhouettes=…)`), and
with those of hits alone.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

import torch
from pydantic import Field, model_validator
from torch import Tensor

import filterlab as fl
from experiments.config import BoundaryName, Dtype, ExperimentConfig, Recipe, number, torch_dtype
from experiments.descent import OneStage, Parameters, Stage, course, descended
from experiments.inverse_dvr import files
from experiments.recovery import directions
from experiments.runs import Record, Run, Unit
from filterlab.fields.base import Domain
from filterlab.io.config import StrictModel
from filterlab.render import Camera, Light, PerspectiveCamera, Phong, Silhouettes, raycast
from filterlab.scenes.model import Positive
from filterlab.surfaces import LevelSet, Surface

WITH, WITHOUT = "with", "without"
_LIGHTS = (Light((-0.6, -0.5, 1.0)), Light(None, (0.3, 0.3, 0.3)))
_SECONDS = {WITH: 6e-5, WITHOUT: 3e-5}  # of a pixel that a step looks at; only expectations use it


class Ball(StrictModel):
    """exp(−|p − center|² / (2 sigma²)) of the target."""

    center: tuple[float, float, float]
    sigma: Positive


class Views(StrictModel):
    """The images: square, from directions that are spread evenly over the sphere, the whole box in view.

    Attributes:
        training, held_out: how many are matched, and how many are only looked at.
        size: pixels along an edge. shown: of the images for the report.
        at_once: training views that a step looks at.
    """

    training: Annotated[int, Field(ge=1, le=1024)] = 16
    held_out: Annotated[int, Field(ge=1, le=1024)] = 3
    size: Annotated[int, Field(ge=2, le=1024)] = 48
    shown: Annotated[int, Field(ge=2, le=1024)] = 192
    at_once: Annotated[int, Field(ge=1)] = 2

    @model_validator(mode="after")
    def _some_of_them(self) -> Views:
        if self.at_once > self.training:
            raise ValueError(f"at_once: expected at most the {self.training} training views; got {self.at_once}")
        return self

    def cameras(self, domain: Domain) -> tuple[list[Camera], list[Camera]]:
        """The training and the held-out cameras; the latter lie evenly among the former."""
        together = self.training + self.held_out
        apart = {int((k + 0.5) * together / self.held_out) for k in range(self.held_out)}
        listed = [_camera(domain, d) for d in directions(together)]
        return [c for i, c in enumerate(listed) if i not in apart], [listed[i] for i in sorted(apart)]

    def of_step(self, iteration: int, seed: int) -> list[int]:
        """Those that a step looks at: along a permutation, drawn anew when all have been seen."""
        first = iteration * self.at_once
        places = range(first, first + self.at_once)
        return [int(_permutation(self.training, seed, k // self.training)[k % self.training]) for k in places]


def _camera(domain: Domain, direction: tuple[float, float, float]) -> Camera:
    up = (0.0, 1.0, 0.0) if abs(direction[2]) > 0.9 else (0.0, 0.0, 1.0)
    return PerspectiveCamera.framing(domain, direction, up=up)


class Weights(StrictModel):
    """Of the squared differences: of masks, depths (world units) and normals."""

    mask: Annotated[float, Field(ge=0)] = 1.0
    depth: Annotated[float, Field(ge=0)] = 1.0
    normal: Annotated[float, Field(ge=0)] = 0.1


class Config(ExperimentConfig):
    """One target, one start, and the descent between them.

    Attributes:
        balls, level: the target is Σ balls = level in [−1, 1]³.
        target_resolution, resolution: voxels along an axis of the target and of what is recovered.
        method: makes fields of both.
        radius: of the ball at first, whose values fall by `slope` per world unit.
        weights: of what is compared, by name; each is a recovery with edges and one without.
        smoothness: λ of the penalty λ Σ_d mean (x_{k+1} − 2 x_k + x_{k−1})² along each axis d.
        lines, parts: of the silhouettes.
        record_every, checkpoint_every: steps.
    """

    experiment: Literal["inverse_surface"]
    balls: Annotated[list[Ball], Field(min_length=1)]
    level: Positive = 0.5
    target_resolution: Annotated[int, Field(ge=4, le=256)] = 48
    resolution: Annotated[int, Field(ge=4, le=256)] = 24
    method: Recipe
    radius: Positive = 0.3
    slope: Positive = 1.0
    views: Views = Views()
    descent: Stage
    weights: Annotated[dict[str, Weights], Field(min_length=1)] = Field(
        default_factory=lambda: {"everything": Weights()}
    )
    smoothness: Annotated[float, Field(ge=0)] = 0.1
    lines: Annotated[int, Field(ge=1, le=64)] = 1
    parts: Annotated[int, Field(ge=1, le=64)] = 1
    record_every: Annotated[int, Field(ge=1)] = 20
    checkpoint_every: Annotated[int, Field(ge=1)] = 20
    boundary: BoundaryName = "reflect"
    dtype: Dtype = "float32"


def units(config: Config) -> list[Unit]:
    """For all weights with the derivatives of edges, and without."""
    pixels = config.descent.iterations * config.views.at_once * config.views.size**2
    return [
        Unit(f"{name}/{kind}", f"{name}, {kind} silhouettes", _SECONDS[kind] * pixels)
        for name in config.weights
        for kind in (WITH, WITHOUT)
    ]


class Images(NamedTuple):
    """What is compared of views: masks (V, S, S), depths (V, S, S), ∞ where nothing is hit, normals (V, S, S, 3)."""

    mask: Tensor
    depth: Tensor
    normal: Tensor


@dataclass(frozen=True)
class SurfaceProblem(OneStage):
    """min over x of the weighted mean squares of the differences of masks, depths and normals, + penalty(x)."""

    config: Config
    weights: Weights
    silhouettes: Silhouettes | None
    target: fl.Field
    training: list[Camera]
    held_out: list[Camera]
    wanted: Images
    judged: Images

    @classmethod
    def of(cls, config: Config, name: str, kind: str) -> SurfaceProblem:
        """With all images of the target."""
        grid, target_grid = (_grid(n, config) for n in (config.resolution, config.target_resolution))
        value = sum(torch.exp(-_square(target_grid, ball) / (2 * ball.sigma**2)) for ball in config.balls)
        assert isinstance(value, Tensor)
        target = _field(value, config)
        training, held_out = config.views.cameras(_field(grid[..., 0], config).domain)
        own = Silhouettes(config.lines, config.parts) if kind == WITH else None
        with torch.no_grad():
            wanted, judged = (_images(config, target, cameras) for cameras in (training, held_out))
        return cls(config, config.weights[name], own, target, training, held_out, wanted, judged)

    def start(self) -> Parameters:
        distance = _grid(self.config.resolution, self.config).norm(dim=-1)
        return {"voxels": self.config.level + self.config.slope * (self.config.radius - distance)}

    def loss(self, parameters: Parameters, stage: int, iteration: int) -> tuple[Tensor, Tensor]:
        voxels, views = parameters["voxels"], self.config.views.of_step(iteration, self.config.seed)
        cameras = [self.training[k] for k in views]
        images = _images(self.config, _field(voxels, self.config), cameras, self.silhouettes, iteration)
        penalty = self.config.smoothness * bending(voxels)
        return misfit(self.weights, images, Images(*(x[views] for x in self.wanted))), penalty

    @torch.no_grad()
    def observe(self, parameters: Parameters, stage: int) -> Record:
        return compared(_images(self.config, _field(parameters["voxels"], self.config), self.held_out), self.judged)


def _permutation(count: int, seed: int, number: int) -> Tensor:
    return torch.randperm(count, generator=torch.Generator().manual_seed((seed + number) % 2**63))


def _grid(n: int, config: Config) -> Tensor:
    """Voxel centres (n, n, n, 3) in [−1, 1]³."""
    axis = (torch.arange(n, dtype=torch_dtype(config.dtype), device=config.device) + 0.5) * (2 / n) - 1
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    return torch.stack((x, y, z), -1)


def _square(points: Tensor, ball: Ball) -> Tensor:
    return (points - points.new_tensor(ball.center)).square().sum(-1)


def _field(voxels: Tensor, config: Config) -> fl.Field:
    h = 2 / len(voxels)
    volume = fl.Volume(voxels, spacing=(h, h, h), origin=(h / 2 - 1,) * 3)
    return config.method.build(volume, config.boundary)


def _images(
    config: Config, field: fl.Field, cameras: list[Camera], silhouettes: Silhouettes | None = None, seed: int = 0
) -> Images:
    options = {"silhouettes": silhouettes, "seed": seed, "dtype": torch_dtype(config.dtype), "device": config.device}
    return images_of(LevelSet(field, config.level), cameras, config.views.size, **options)


def images_of(surface: Surface, cameras: list[Camera], size: int, **options: Any) -> Images:
    """Of square views."""
    listed = [_channels(surface, camera, size=(size, size), **options) for camera in cameras]
    color, depth, normal = (torch.stack([image[name] for image in listed]) for name in ("color", "depth", "normal"))
    return Images(color[..., 3], depth[..., 0], normal)


def _channels(surface: Surface, camera: Camera, **options: Any) -> dict[str, Tensor]:
    images = raycast(surface, camera, channels=("color", "depth", "normal"), **options)
    assert isinstance(images, dict)
    return images


def misfit(weights: Weights, found: Images, wanted: Images) -> Tensor:
    """Means over all pixels; depths are compared where both hit."""
    both = found.depth.isfinite() & wanted.depth.isfinite()
    depth = (torch.where(both, found.depth, 0) - torch.where(both, wanted.depth, 0)).square().mean()
    mask, normal = (found.mask - wanted.mask).square().mean(), (found.normal - wanted.normal).square().sum(-1).mean()
    return weights.mask * mask + weights.depth * depth + weights.normal * normal


def bending(voxels: Tensor) -> Tensor:
    """Σ_d mean (x_{k+1} − 2 x_k + x_{k−1})² along each axis d."""
    return torch.stack([voxels.diff(n=2, dim=d).square().mean() for d in range(3)]).sum()


def compared(found: Images, wanted: Images) -> Record:
    """Intersection over union of masks; where both hit, RMS of depths and the mean angle of normals in degrees."""
    a, b = found.mask > 0.5, wanted.mask > 0.5
    both = found.depth.isfinite() & wanted.depth.isfinite()
    cosine = (found.normal * wanted.normal).sum(-1)[both].clamp(-1, 1)
    return {
        "iou": number((a & b).sum() / (a | b).sum()),
        "depth_rms": number((found.depth - wanted.depth)[both].square().mean().sqrt()),
        "normal_angle": number(cosine.double().acos().rad2deg().mean()),
    }


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one recovery."""
    name, kind = unit.key.rsplit("/", 1)
    problem = SurfaceProblem.of(config, name, kind)
    state = descended(problem, [config.descent], config, unit.key, run)
    found = state.parameters["voxels"].detach()
    shown = {
        "target": problem.target,
        "start": _field(problem.start()["voxels"], config),
        "result": _field(found, config),
    }
    surfaces = {name: LevelSet(field, config.level) for name, field in shown.items()}
    cameras = {"training": problem.training[0], "held_out": problem.held_out[0]}
    images = save_views(surfaces, cameras, config.views.shown, unit.key, run, device=config.device)
    array = run.save_array(unit.key, found)
    return {
        "kind": kind,
        "compared": name,
        **course(state),
        "images": images,
        "voxels": array,
        "files": [*files(images), array],
    }


@torch.no_grad()
def save_views(
    surfaces: Mapping[str, Surface], cameras: dict[str, Camera], size: int, key: str, run: Run, **options: Any
) -> Record:
    """Shaded images and normals of some views, and where all others differ from the target."""
    saved: Record = {}
    for view, camera in cameras.items():
        seen = {name: _picture(surface, camera, size, **options) for name, surface in surfaces.items()}
        saved[view] = {}
        for name, (color, normal, depth) in seen.items():
            saved[view][name] = run.save_image(f"{key}-{view}-{name}", color)
            saved[view][f"{name}_normal"] = run.save_image(f"{key}-{view}-{name}-normal", normal, srgb=False)
            if name != "target":
                error = _difference(depth, seen["target"][2])
                saved[view][f"{name}_error"] = run.save_image(f"{key}-{view}-{name}-error", error, srgb=False)
    return saved


def _picture(surface: Surface, camera: Camera, size: int, **options: Any) -> tuple[Tensor, Tensor, Tensor]:
    """Shaded (S, S, 3), the normal as ½ + ½ n, black where nothing is hit, and depth (S, S); float32, on the CPU."""
    given: dict[str, Any] = {"size": (size, size), "lights": _LIGHTS, **options}
    color = raycast(surface, camera, Phong((0.85, 0.72, 0.55)), subpixels=2, background=(0.05, 0.06, 0.08), **given)
    assert isinstance(color, Tensor)
    at = _channels(surface, camera, **given)
    depth = at["depth"][..., 0].cpu()
    normal = torch.where(depth.isfinite()[..., None], 0.5 + 0.5 * at["normal"].cpu(), 0)
    return color[..., :3].cpu(), normal, depth


def _difference(depth: Tensor, wanted: Tensor) -> Tensor:
    """Grey: |depth − wanted| / 0.1 where both hit. Red: hit in vain. Blue: missed."""
    hit, want = depth.isfinite(), wanted.isfinite()
    grey = torch.where(hit & want, (depth - wanted).abs() / 0.1, 0).nan_to_num(0).clamp(0, 1)
    only = lambda which: torch.where(which, 1.0, grey)  # noqa: E731
    return torch.stack((only(hit & ~want), grey, only(want & ~hit)), -1)
