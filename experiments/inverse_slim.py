"""Can a rough cover be refined by what images show? Places, radii and quadrics by descent through blended hits.

The target is a torus, as a fine cover; the start a coarse one of flat discs, off by noise in place, size and direction.
Depths and normals are compared where both are hit: hits move smoothly with all numbers of a cover, also while balls
begin and cease to have a part in them. At the outlines of what is seen derivatives of hits say nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import torch
from pydantic import Field
from torch import Tensor

from experiments import covers
from experiments.config import ExperimentConfig
from experiments.descent import Parameters, Stage, minimize
from experiments.inverse_dvr import files
from experiments.inverse_surface import Images, Views, Weights, compared, course, images_of, misfit, save_views
from experiments.runs import Record, Run, Unit
from filterlab.render import Camera
from filterlab.surfaces import Slim

_SECONDS = 1e-4  # of a pixel that a step looks at; only expectations use it


class Config(ExperimentConfig):
    """One target, one start, and the descents between them.

    Attributes:
        target_balls, balls: of the target's cover and the one that is refined, about.
        noise: of the start: of a ball's radius, of places; and radians, of normals.
        offset: of both covers.
        weights: of what is compared, by name: a recovery each. Masks have no derivatives here.
        keeping: λ of the penalty λ mean (log r / r₀)², r₀ the radii of the start.
        record_every, checkpoint_every: steps.
    """

    experiment: Literal["inverse_slim"]
    target_balls: Annotated[int, Field(ge=100, le=10**6)] = 3000
    balls: Annotated[int, Field(ge=50, le=10**6)] = 400
    noise: Annotated[float, Field(ge=0, le=1)] = 0.2
    offset: Annotated[float, Field(ge=0)] = 0.5
    views: Views = Views()
    descent: Stage
    weights: Annotated[dict[str, Weights], Field(min_length=1)] = Field(
        default_factory=lambda: {"depths and normals": Weights(mask=0)}
    )
    keeping: Annotated[float, Field(ge=0)] = 1e-3
    record_every: Annotated[int, Field(ge=1)] = 20
    checkpoint_every: Annotated[int, Field(ge=1)] = 20


def units(config: Config) -> list[Unit]:
    """One for each way to compare."""
    pixels = config.descent.iterations * config.views.at_once * config.views.size**2
    return [Unit(name, name, _SECONDS * pixels) for name in config.weights]


@dataclass(frozen=True)
class CoverProblem:
    """min over a cover of the weighted mean squares of the differences of depths and normals, + penalty."""

    config: Config
    weights: Weights
    target: Slim
    training: list[Camera]
    held_out: list[Camera]
    wanted: Images
    judged: Images

    @classmethod
    def of(cls, config: Config, name: str) -> CoverProblem:
        """With all images of the target."""
        target = Slim(*covers.torus(config.target_balls), offset=config.offset)
        training, held_out = config.views.cameras(target.domain)
        with torch.no_grad():
            wanted, judged = (_images(config, target, cameras) for cameras in (training, held_out))
        return cls(config, config.weights[name], target, training, held_out, wanted, judged)

    def start(self) -> Parameters:
        """Discs: b along noisy normals, A and c 0; radii by their logarithms."""
        rough, noise = covers.torus(self.config.balls), self.config.noise
        rng = torch.Generator().manual_seed(self.config.seed)
        draw = lambda like: torch.randn(like.shape, generator=rng, dtype=torch.float64)  # noqa: E731
        normal = torch.nn.functional.normalize(rough.b + 0.5 * noise * draw(rough.b))
        return {
            "centers": rough.centers + noise * rough.radii[:, None] * draw(rough.centers) / math.sqrt(3),
            "sizes": rough.radii.log() + 0.5 * noise * draw(rough.radii),
            "A": torch.zeros_like(rough.A),
            "b": normal / 2,
            "c": torch.zeros_like(rough.c),
        }

    def refine(self, parameters: Parameters, stage: int) -> Parameters:
        raise AssertionError("there is one stage")

    def loss(self, parameters: Parameters, stage: int, iteration: int) -> tuple[Tensor, Tensor]:
        views = self.config.views.of_step(iteration, self.config.seed)
        images = _images(self.config, cover(self.config, parameters), [self.training[k] for k in views])
        penalty = self.config.keeping * (parameters["sizes"] - self.start()["sizes"]).square().mean()
        return misfit(self.weights, images, Images(*(x[views] for x in self.wanted))), penalty

    def project(self, parameters: Parameters) -> None:
        """Nothing: every number is allowed."""

    @torch.no_grad()
    def observe(self, parameters: Parameters, stage: int) -> Record:
        found = cover(self.config, parameters)
        seen = compared(_images(self.config, found, self.held_out), self.judged)
        return {**seen, "distance": _distance(self.config, found, self.held_out)}


def cover(config: Config, parameters: Parameters) -> Slim:
    """The surface that parameters stand for."""
    centers, sizes, *rest = parameters.values()
    return Slim(centers, sizes.exp(), *rest, offset=config.offset)


def _images(config: Config, surface: Slim, cameras: list[Camera]) -> Images:
    return images_of(surface, cameras, config.views.size, dtype=torch.float64)


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
    problem = CoverProblem.of(config, unit.key)
    state = minimize(
        problem,
        [config.descent],
        run.folder / "files" / f"{run.prefix}{unit.key}.state.pt".replace(" ", "-"),
        observe_every=config.record_every,
        checkpoint_every=config.checkpoint_every,
        progress=run.advance,
    )
    found = {name: x.detach() for name, x in state.parameters.items()}
    surfaces = {
        "target": problem.target,
        "start": cover(config, problem.start()),
        "result": cover(config, found),
    }
    cameras = {"training": problem.training[0], "held_out": problem.held_out[0]}
    images = save_views(surfaces, cameras, config.views.shown, unit.key.replace(" ", "-"), run)
    return {"compared": unit.key, "balls": len(found["c"]), **course(state), "images": images, "files": files(images)}
