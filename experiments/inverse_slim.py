"""Can a rough cover be refined by what images show? By descent through blended hits, and edges.

The target is a torus, as a fine cover. What is recovered is one of two: all numbers of a cover, which starts as coarse
flat discs, off by noise in place, size and direction; or the points that a cover was fitted to, off by noise, whose
local fits are solved again at every step. Depths and normals are compared where both are hit: hits move smoothly with
all numbers of a cover, also while balls begin and cease to have a part in them. Where masks are compared, derivatives
are also those of what edges sweep over (`raycast(silhouettes=…)`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from torch import Tensor

from experiments import covers
from experiments.config import ExperimentConfig
from experiments.descent import OneStage, Parameters, Stage, course, descended
from experiments.inverse_dvr import files
from experiments.inverse_surface import Images, Views, Weights, compared, images_of, misfit, save_views
from experiments.runs import Record, Run, Unit
from filterlab.render import Camera, Silhouettes
from filterlab.surfaces import Slim, fit_slim

_SECONDS = 1e-4  # of a pixel that a step looks at; only expectations use it


class Config(ExperimentConfig):
    """One target, one start, and the descents between them.

    Attributes:
        target_balls, balls: of the target's cover and the one that is refined, about.
        noise: of the start: of a ball's radius, of places; and radians, of normals. Of points: of their distance.
        offset: of both covers.
        unknowns: what is recovered.
        points: that a cover is fitted to, with this tolerance and at least so many in a ball.
        weights: of what is compared, by name: a recovery each, of each of the unknowns.
        lines, parts: of silhouettes, which there are where masks are compared.
        keeping: λ of the penalty λ mean (log r / r₀)², r₀ the radii of the start; of points λ mean |x − x₀|² / their
            distance².
        record_every, checkpoint_every: steps.
    """

    experiment: Literal["inverse_slim"]
    target_balls: Annotated[int, Field(ge=100, le=10**6)] = 3000
    balls: Annotated[int, Field(ge=50, le=10**6)] = 400
    noise: Annotated[float, Field(ge=0, le=1)] = 0.2
    offset: Annotated[float, Field(ge=0)] = 0.5
    unknowns: Annotated[list[Literal["numbers", "points"]], Field(min_length=1)] = Field(
        default_factory=lambda: ["numbers"]
    )
    points: Annotated[int, Field(ge=100, le=10**6)] = 2000
    tolerance: Annotated[float, Field(ge=1e-6, le=0.1)] = 3e-3
    least: Annotated[int, Field(ge=6, le=1000)] = 24
    views: Views = Views()
    descent: Stage
    weights: Annotated[dict[str, Weights], Field(min_length=1)] = Field(
        default_factory=lambda: {"depths and normals": Weights(mask=0)}
    )
    lines: Annotated[int, Field(ge=1, le=64)] = 1
    parts: Annotated[int, Field(ge=1, le=64)] = 2
    keeping: Annotated[float, Field(ge=0)] = 1e-3
    record_every: Annotated[int, Field(ge=1)] = 20
    checkpoint_every: Annotated[int, Field(ge=1)] = 20


def units(config: Config) -> list[Unit]:
    """One for each of what is recovered and each way to compare."""
    pixels = config.descent.iterations * config.views.at_once * config.views.size**2
    return [
        Unit(f"{unknown}/{name}", f"{unknown}, by {name}", _SECONDS * pixels)
        for unknown in config.unknowns
        for name in config.weights
    ]


@dataclass(frozen=True)
class Numbers:
    """Discs: b along noisy normals, A and c 0; radii by their logarithms."""

    config: Config

    def start(self) -> Parameters:
        rough, noise = covers.torus(self.config.balls), self.config.noise
        draw = _drawn(self.config)
        normal = torch.nn.functional.normalize(rough.b + 0.5 * noise * draw(rough.b))
        return {
            "centers": rough.centers + noise * rough.radii[:, None] * draw(rough.centers) / math.sqrt(3),
            "sizes": rough.radii.log() + 0.5 * noise * draw(rough.radii),
            "A": torch.zeros_like(rough.A),
            "b": normal / 2,
            "c": torch.zeros_like(rough.c),
        }

    def cover(self, parameters: Parameters) -> Slim:
        centers, sizes, *rest = parameters.values()
        return Slim(centers, sizes.exp(), *rest, offset=self.config.offset)

    def strayed(self, parameters: Parameters) -> Tensor:
        return (parameters["sizes"] - self.start()["sizes"]).square().mean()


class Points:
    """Those that a cover was fitted to, off a torus by noise, moved in units of their distance: it is refitted."""

    def __init__(self, config: Config) -> None:
        even = covers.torus(config.points).centers
        self.apart = math.sqrt(4 * math.pi**2 * covers.MAJOR * covers.MINOR / len(even))
        self.points = even + config.noise * self.apart * _drawn(config)(even)
        self.fitted = fit_slim(self.points, tolerance=config.tolerance, least=config.least, seed=config.seed)
        self.fitted.offset = config.offset

    def start(self) -> Parameters:
        return {"moved": torch.zeros_like(self.points)}

    def cover(self, parameters: Parameters) -> Slim:
        return self.fitted.refitted(self.points + self.apart * parameters["moved"])

    def strayed(self, parameters: Parameters) -> Tensor:
        return parameters["moved"].square().sum(-1).mean()


def _drawn(config: Config) -> Callable[[Tensor], Tensor]:
    """Normal numbers, as many as of another tensor."""
    rng = torch.Generator().manual_seed(config.seed)
    return lambda like: torch.randn(like.shape, generator=rng, dtype=torch.float64)


@dataclass(frozen=True)
class CoverProblem(OneStage):
    """min over unknowns of the weighted mean squares of the differences of masks, depths, normals, + penalty."""

    config: Config
    unknown: Numbers | Points
    weights: Weights
    target: Slim
    training: list[Camera]
    held_out: list[Camera]
    wanted: Images
    judged: Images

    @classmethod
    def of(cls, config: Config, unknown: str, name: str) -> CoverProblem:
        """With all images of the target."""
        target = Slim(*covers.torus(config.target_balls), offset=config.offset)
        training, held_out = config.views.cameras(target.domain)
        with torch.no_grad():
            wanted, judged = (_images(config, target, cameras) for cameras in (training, held_out))
        own = {"numbers": Numbers, "points": Points}[unknown](config)
        return cls(config, own, config.weights[name], target, training, held_out, wanted, judged)

    def start(self) -> Parameters:
        return self.unknown.start()

    def loss(self, parameters: Parameters, stage: int, iteration: int) -> tuple[Tensor, Tensor]:
        config, views = self.config, self.config.views.of_step(iteration, self.config.seed)
        edges = {"silhouettes": Silhouettes(config.lines, config.parts), "seed": iteration} if self.weights.mask else {}
        images = _images(config, self.unknown.cover(parameters), [self.training[k] for k in views], **edges)
        penalty = config.keeping * self.unknown.strayed(parameters)
        return misfit(self.weights, images, Images(*(x[views] for x in self.wanted))), penalty

    @torch.no_grad()
    def observe(self, parameters: Parameters, stage: int) -> Record:
        found = self.unknown.cover(parameters)
        seen = compared(_images(self.config, found, self.held_out), self.judged)
        return {**seen, "distance": _distance(self.config, found, self.held_out)}


def _images(config: Config, surface: Slim, cameras: list[Camera], **options: Any) -> Images:
    return images_of(surface, cameras, config.views.size, dtype=torch.float64, **options)


def _distance(config: Config, surface: Slim, cameras: list[Camera]) -> float:
    """RMS distance from the torus of what is seen of a surface."""
    off = []
    for camera in cameras:
        origins, directions = (x.double() for x in camera.rays(config.views.size, config.views.size))
        hit = surface.hit(origins, directions)
        off.append(covers.distance(surface.at(origins, directions, hit, order=0).point[hit.valid]))
    return float(torch.cat(off).square().mean().sqrt())


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one recovery."""
    unknown, name = unit.key.split("/", 1)
    problem, key = CoverProblem.of(config, unknown, name), unit.key.replace(" ", "-").replace("/", "--")
    state = descended(problem, [config.descent], config, key, run)
    result = problem.unknown.cover({name: x.detach() for name, x in state.parameters.items()})
    surfaces = {"target": problem.target, "start": problem.unknown.cover(problem.start()), "result": result}
    cameras = {"training": problem.training[0], "held_out": problem.held_out[0]}
    images = save_views(surfaces, cameras, config.views.shown, key, run)
    seen = {"unknown": unknown, "compared": name, "balls": len(result)}
    return {**seen, **course(state), "images": images, "files": files(images)}
