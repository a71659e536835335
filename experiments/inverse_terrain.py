"""Which heights do these shaded images and depths belong to? Found by descent through hits.

The target is a spline of samples of Franke's function. What is recovered are heights on the same
grid, flat at first, from depths, from shaded images under three suns, or from both. Rays are cast, and
hits move with the heights: nothing is meshed, and nothing but heights is a parameter.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal, NamedTuple

import torch
from pydantic import Field, model_validator
from torch import Tensor

from experiments.config import Dtype, ExperimentConfig, number, torch_dtype
from experiments.descent import OneStage, Parameters, Stage, descended
from experiments.inverse_dvr import files
from experiments.runs import Record, Run, Unit
from experiments.terrain_error import franke
from filterlab.io.config import StrictModel
from filterlab.render import ByHeight, Camera, Lambertian, Light, PerspectiveCamera, raycast, sun
from filterlab.render.scenery import toward
from filterlab.scenes.model import Positive
from filterlab.surfaces import HeightField

SKYLIGHT = (0.15, 0.15, 0.15)
_SECONDS = 4e-5  # of a pixel that a step looks at; only expectations use it

SplineName = Literal["linear", "c0", "c1", "c2"]


class Views(StrictModel):
    """The images: square, all around, from above.

    Attributes:
        count: of views, at equal angles; one between the first two is held out.
        down: degrees that the cameras look down.
        size: pixels along an edge. shown: of the images for the report.
    """

    count: Annotated[int, Field(ge=2, le=64)] = 5
    down: Annotated[float, Field(gt=0, lt=90)] = 55.0
    size: Annotated[int, Field(ge=4, le=1024)] = 40
    shown: Annotated[int, Field(ge=4, le=2048)] = 240


class Weights(StrictModel):
    """Of the squared differences: of depths, in parts of the relief, and of shaded images."""

    depth: Annotated[float, Field(ge=0)] = 1.0
    shade: Annotated[float, Field(ge=0)] = 1.0

    @model_validator(mode="after")
    def _some(self) -> Weights:
        if not self.depth and not self.shade:
            raise ValueError("expected a weight above 0 of depth, of shade, or of both")
        return self


class Config(ExperimentConfig):
    """One target, and a recovery for each set of weights.

    Attributes:
        samples: of the heights along an axis of the unit square, of the target and of what is recovered.
        relief: height of the target from its lowest to its highest.
        spline: of both.
        suns: azimuths and altitudes; each is one colour channel of an image, so three of them.
        descent: steps of Adam; its rate is in parts of the relief.
        weights: of what is compared, by name.
        smoothness: λ of the penalty λ Σ_d mean (h_{k+1} − 2 h_k + h_{k−1})² along each axis, in parts of the relief.
    """

    experiment: Literal["inverse_terrain"]
    samples: Annotated[int, Field(ge=4, le=512)] = 25
    relief: Positive = 0.35
    spline: SplineName = "c1"
    suns: tuple[tuple[float, float], tuple[float, float], tuple[float, float]] = (
        (0.0, 40.0),
        (120.0, 40.0),
        (240.0, 40.0),
    )
    views: Views = Views()
    descent: Stage
    weights: Annotated[dict[str, Weights], Field(min_length=1)] = Field(default_factory=lambda: {"both": Weights()})
    smoothness: Annotated[float, Field(ge=0)] = 0.01
    record_every: Annotated[int, Field(ge=1)] = 20
    checkpoint_every: Annotated[int, Field(ge=1)] = 20
    dtype: Dtype = "float32"


def units(config: Config) -> list[Unit]:
    """A recovery for each set of weights."""
    pixels = config.descent.iterations * config.views.size**2
    return [Unit(name, f"heights from {name}", _SECONDS * pixels) for name in config.weights]


class Images(NamedTuple):
    """Of views: depths (V, S, S), ∞ where nothing is hit, and a channel of each sun (V, S, S, 3)."""

    depth: Tensor
    shade: Tensor


@dataclass(frozen=True)
class HeightProblem(OneStage):
    """min over h of the weighted mean squares of the differences of depths and shaded images, + penalty(h)."""

    config: Config
    weights: Weights
    target: Tensor
    training: list[Camera]
    held_out: Camera
    wanted: Images
    judged: Images

    @classmethod
    def of(cls, config: Config, name: str) -> HeightProblem:
        """With all images of the target."""
        target = heights_of(config)
        cameras = [_camera(config, 360 * k / config.views.count) for k in range(config.views.count)]
        held_out = _camera(config, 180 / config.views.count)
        with torch.no_grad():
            wanted, judged = (_images(config, target, listed) for listed in (cameras, [held_out]))
        return cls(config, config.weights[name], target, cameras, held_out, wanted, judged)

    def start(self) -> Parameters:
        """Flat ground in the middle of the relief."""
        return {"heights": torch.full_like(self.target, 0.5 * self.config.relief)}

    def loss(self, parameters: Parameters, stage: int, iteration: int) -> tuple[Tensor, Tensor]:
        heights, view = parameters["heights"], iteration % len(self.training)
        found = _images(self.config, heights, [self.training[view]])
        wanted = Images(*(x[view : view + 1] for x in self.wanted))
        parts = torch.stack([heights.diff(n=2, dim=d).square().mean() for d in range(2)])
        return self._misfit(found, wanted), self.config.smoothness * parts.sum() / self.config.relief**2

    def _misfit(self, found: Images, wanted: Images) -> Tensor:
        both = found.depth.isfinite() & wanted.depth.isfinite()
        depth = torch.where(both, found.depth, 0) - torch.where(both, wanted.depth, 0)
        shade = torch.where(both[..., None], found.shade - wanted.shade, 0)
        scaled = depth.square().mean() / self.config.relief**2
        return self.weights.depth * scaled + self.weights.shade * shade.square().mean()

    @torch.no_grad()
    def observe(self, parameters: Parameters, stage: int) -> Record:
        return compared(self, parameters["heights"])


def heights_of(config: Config) -> Tensor:
    """Franke's function at (n, n) places of the unit square, from 0 to the relief."""
    axis = torch.linspace(0, 1, config.samples, dtype=torch.float64, device=config.device)
    z = franke(axis[None, :], axis[:, None])
    z = (z - z.min()) / (z.max() - z.min()) * config.relief
    return z.to(torch_dtype(config.dtype))


def terrain_of(config: Config, heights: Tensor) -> HeightField:
    return HeightField(heights, config.spline, 1 / (config.samples - 1))


def _camera(config: Config, azimuth: float) -> Camera:
    corners = torch.cartesian_prod(*(torch.tensor([0.0, 1.0]),) * 2, torch.tensor([0.0, config.relief]))
    return PerspectiveCamera.of_points(corners, toward(azimuth, -config.views.down), margin=1.0)


def _suns(config: Config) -> list[Light]:
    """One for every channel."""
    return [sun(*place, color=tuple(float(k == j) for j in range(3))) for k, place in enumerate(config.suns)]


def _images(config: Config, heights: Tensor, cameras: Sequence[Camera]) -> Images:
    terrain, size = terrain_of(config, heights), config.views.size
    seen = []
    for camera in cameras:
        image = raycast(
            terrain,
            camera,
            Lambertian((1.0, 1.0, 1.0), SKYLIGHT),
            size=(size, size),
            lights=_suns(config),
            channels=("color", "depth"),
            dtype=torch_dtype(config.dtype),
            device=config.device,
        )
        assert isinstance(image, dict)
        seen.append(image)
    return Images(
        torch.stack([image["depth"][..., 0] for image in seen]),
        torch.stack([image["color"][..., :3] for image in seen]),
    )


def compared(problem: HeightProblem, heights: Tensor) -> Record:
    """RMS of the surfaces' heights, of the data, and of depths and shades of the held-out view; in parts of the relief.

    Data may differ where surfaces do not: of the nine data of a cell of `c1` its patches depend on five combinations.
    """
    config = problem.config
    found = _images(config, heights, [problem.held_out])
    both = found.depth.isfinite() & problem.judged.depth.isfinite()
    rms = lambda x: x.square().mean().sqrt()  # noqa: E731
    return {
        "height_rms": number(rms(_fine(config, heights) - _fine(config, problem.target)) / config.relief),
        "data_rms": number(rms(heights - problem.target) / config.relief),
        "depth_rms": number(rms((found.depth - problem.judged.depth)[both]) / config.relief),
        "shade_rms": number(rms((found.shade - problem.judged.shade)[both])),
    }


def _fine(config: Config, heights: Tensor) -> Tensor:
    """Of the surface, at places four times as near to each other as the data."""
    axis = torch.linspace(0, 1, 4 * (config.samples - 1) + 1, dtype=torch.float64, device=config.device)
    return terrain_of(config, heights).jet(torch.cartesian_prod(axis, axis), 0)[0]


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one recovery."""
    problem = HeightProblem.of(config, unit.key)
    stage = config.descent.model_copy(update={"learning_rate": config.descent.learning_rate * config.relief})
    state = descended(problem, [stage], config, unit.key, run)
    found = state.parameters["heights"].detach()
    shown = {"target": problem.target, "result": found}
    images = {name: _shown(config, problem, heights, f"{unit.key}-{name}", run) for name, heights in shown.items()}
    array = run.save_array(unit.key, found)
    return {
        "compared": unit.key,
        "misfits": state.misfits,
        "observations": state.observations,
        "images": images,
        "heights": array,
        "files": [*files(images), array],
    }


@torch.no_grad()
def _shown(config: Config, problem: HeightProblem, heights: Tensor, key: str, run: Run) -> Record:
    """The held-out view as a picture by height and light, and as it is compared: a channel for each sun."""
    terrain, size = terrain_of(config, heights), (config.views.shown,) * 2
    tints = Lambertian(ByHeight.between(0.0, config.relief), (0.3, 0.32, 0.36))
    given: dict[str, Any] = {"size": size, "subpixels": 2, "seed": config.seed, "background": (1.0, 1.0, 1.0)}
    looked = raycast(terrain, problem.held_out, tints, lights=[sun(-40.0, 40.0)], device=config.device, **given)
    shaded = raycast(
        terrain, problem.held_out, Lambertian((1, 1, 1), SKYLIGHT), lights=_suns(config), device=config.device, **given
    )
    assert isinstance(looked, Tensor)
    assert isinstance(shaded, Tensor)
    return {
        "tinted": run.save_image(f"{key}-tinted", looked[..., :3].cpu()),
        "shaded": run.save_image(f"{key}-shaded", shaded[..., :3].cpu()),
    }
