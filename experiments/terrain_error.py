"""How far are quartic splines of heights from what was sampled? (Table I of paper 004, with derivatives and orders.)

Franke's function on [0, 1]² is sampled every 1/n along both axes, and beyond as far as a spline's patches need, so that
no boundary counts; splines are compared with it, their gradients and Hessians with its own, at uniform random points:

    √ mean |error|² and max |error|, as parts of the greatest value of the function

Heights, gradients and Hessians (by their Frobenius norm) each; the order is the slope of log error against log step.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Literal, NamedTuple

import torch
from pydantic import AfterValidator, Field, model_validator
from torch import Tensor

from experiments.config import ExperimentConfig, increasing, number
from experiments.rms_error import slope
from experiments.runs import Record, Run, Unit, timed
from filterlab import metrics
from filterlab.surfaces import HeightField
from filterlab.surfaces.quartic import QuarticSpline, quartic_spline

CHUNK = 2**16
KINDS = ("linear", "c0", "c1", "c2", "c2 prefiltered")
ROWS = ("value", "gradient", "hessian")

Kind = Literal["linear", "c0", "c1", "c2", "c2 prefiltered"]


def distinct_kinds(kinds: list[str]) -> list[str]:
    """The splines. Raises ValueError where one comes twice."""
    if len(set(kinds)) < len(kinds):
        raise ValueError(f"expected different splines; got {', '.join(kinds)}")
    return kinds


def spline_of(kind: str) -> QuarticSpline:
    """Of a name in `KINDS`."""
    name, *more = kind.split()
    return quartic_spline(name, prefilter=bool(more))


class Config(ExperimentConfig):
    """Errors of splines of heights.

    Attributes:
        steps: of the data along an axis of the unit square, increasing; multiples of 12, so that all splines have
            whole cells.
        fit_from: orders are fitted to steps from these on.
        points: where errors are measured.
        diagonal: of the cells.
    """

    experiment: Literal["terrain_error"]
    splines: Annotated[list[Kind], Field(min_length=1), AfterValidator(distinct_kinds)]
    steps: Annotated[
        list[Annotated[int, Field(ge=12, le=4096, multiple_of=12)]], Field(min_length=1), AfterValidator(increasing)
    ]
    fit_from: Annotated[int, Field(ge=1)] = 1
    points: Annotated[int, Field(ge=10, le=10**8)] = 10**6
    diagonal: Literal["main", "anti"] = "main"

    @model_validator(mode="after")
    def _can_fit(self) -> Config:
        if len(self.fitted) < 2:
            raise ValueError(f"a fit needs two numbers of steps ≥ fit_from ({self.fit_from}); got {self.steps}")
        return self

    @property
    def fitted(self) -> list[int]:
        """The numbers of steps that orders are fitted to."""
        return [n for n in self.steps if n >= self.fit_from]


def units(config: Config) -> list[Unit]:
    """One per spline and number of steps, then one fit per spline."""
    seconds = 0.1 + config.points * 1e-6
    work = [Unit(_key(k, n), f"{k}, {n} × {n} steps", seconds) for k in config.splines for n in config.steps]
    return work + [Unit(f"{k}/fit", f"order of {k}", 0.01) for k in config.splines]


def _key(kind: str, steps: int) -> str:
    return f"{kind}/{steps}"


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one unit."""
    kind, what = unit.key.split("/")
    common = {"spline": kind, "declared_order": spline_of(kind).order}
    if what == "fit":
        return {**common, "kind": "fit", **_fit(config, kind, run)}
    return {**common, "kind": "error", "steps": int(what), **_error(config, kind, int(what), run)}


def _fit(config: Config, kind: str, run: Run) -> Record:
    found = [run.records[_key(kind, n)] for n in config.fitted]
    orders = {f"{row}_order": slope(config.fitted, [r[f"{row}_rms"] for r in found]) for row in ROWS}
    return {"fitted": config.fitted, **orders}


def _error(config: Config, kind: str, steps: int, run: Run) -> Record:
    truth = run.memo("truth", lambda: Truth.of(franke, config.points, config.seed, config.device))
    terrain = sampled(franke, kind, steps, config.diagonal, config.device)
    with torch.no_grad():
        jets, seconds = timed(lambda: [terrain.jet(points, 2) for points in truth.points.split(CHUNK)])
    own = [torch.cat(rows) for rows in zip(*jets, strict=True)]
    record: Record = {
        "triangles": 2 * (steps // terrain.spline.steps) ** 2,
        "seconds": seconds,
        "points": config.points,
    }
    for name, found, expected in zip(ROWS, own, truth[1:], strict=True):
        apart = (found - expected).reshape(len(found), -1) / truth.greatest
        zero, vectors = torch.zeros_like(apart), name != "value"
        apart, zero = (apart, zero) if vectors else (apart[:, 0], zero[:, 0])
        record |= {
            f"{name}_rms": number(metrics.rms(apart, zero, vectors=vectors)),
            f"{name}_max": number(metrics.max_error(apart, zero, vectors=vectors)),
        }
    return record


Function = Callable[[Tensor, Tensor], Tensor]


def franke(x: Tensor, y: Tensor) -> Tensor:
    """Franke's function: four bumps on the unit square, of which one is a dent.

    Source: Franke, Scattered data interpolation: tests of some methods, 1982.
    """
    a, b = 9 * x, 9 * y
    return (
        0.75 * torch.exp(-((a - 2) ** 2 + (b - 2) ** 2) / 4)
        + 0.75 * torch.exp(-((a + 1) ** 2) / 49 - (b + 1) / 10)
        + 0.5 * torch.exp(-((a - 7) ** 2 + (b - 3) ** 2) / 4)
        - 0.2 * torch.exp(-((a - 4) ** 2) - (b - 7) ** 2)
    )


def sampled(function: Function, kind: str, steps: int, diagonal: str = "main", device: str = "cpu") -> HeightField:
    """The spline of a function's values every 1/steps on the unit square, and around it as far as patches reach."""
    spline = spline_of(kind)
    outside = spline.steps * math.ceil(spline.rows_outside / spline.steps)
    place = torch.arange(-outside, steps + outside + 1, dtype=torch.float64, device=device) / steps
    origin = (-outside / steps, -outside / steps)
    heights = function(place[None, :], place[:, None])
    return HeightField(heights, spline.name, 1 / steps, origin, diagonal=diagonal, prefilter=spline.prefiltered)


class Truth(NamedTuple):
    """A function at uniform random points of the unit square.

    Attributes:
        points: (P, 2).
        value, gradient, hessian: (P), (P, 2), (P, 2, 2).
    """

    points: Tensor
    value: Tensor
    gradient: Tensor
    hessian: Tensor

    @property
    def greatest(self) -> float:
        """Of the values there."""
        return float(self.value.max())

    @classmethod
    def of(cls, function: Function, count: int, seed: int, device: str) -> Truth:
        generator = torch.Generator().manual_seed(seed)
        points = torch.rand(count, 2, generator=generator, dtype=torch.float64).to(device)
        parts = [_derivatives(function, part) for part in points.split(CHUNK)]
        return cls(points, *(torch.cat(rows) for rows in zip(*parts, strict=True)))


def _derivatives(function: Function, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    points = points.clone().requires_grad_()
    value = function(*points.unbind(-1))
    (gradient,) = torch.autograd.grad(value.sum(), points, create_graph=True)
    rows = [torch.autograd.grad(gradient[:, i].sum(), points, retain_graph=True)[0] for i in range(2)]
    return value.detach(), gradient.detach(), torch.stack(rows, -2)
