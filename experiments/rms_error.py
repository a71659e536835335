"""How fast does the error of value and gradient fall with the resolution? (Figure 6 of the paper, extended.)

A signal is sampled at n³ cell centres of its box, reconstructed, and compared with itself at uniform random points:

    value:    √ mean (f̃(p) − f(p))²        gradient: √ mean |∇f̃(p) − ∇f(p)|²  (world units)

The order of a method is the slope of log error against log voxel size, fitted by least squares to the finest
resolutions. It shows only where the signal is resolved, so a study names the resolution the fit begins at.
"""

from __future__ import annotations

import math
from typing import Annotated, Any, Literal, NamedTuple, Protocol

import torch
from pydantic import AfterValidator, Field, model_validator
from torch import Tensor

from experiments.config import (
    BoundaryName,
    Dtype,
    ExperimentConfig,
    Recipe,
    Recipes,
    check_signal,
    increasing,
    number,
    torch_dtype,
)
from experiments.runs import Record, Run, Unit, timed
from filterlab import metrics
from filterlab.fields.base import Domain
from filterlab.io.config import StrictModel
from filterlab.scenes.model import SignalModel
from filterlab.signals import Signal

CHUNK = 2**14
STEEP = 0.01  # directions are compared where the gradient is longer than this part of the longest


class Study(StrictModel):
    """One signal, sampled at several resolutions.

    Attributes:
        signal: which signal.
        resolutions: voxels along each axis, increasing.
        fit_from: the order is fitted to resolutions from this one on; left out, none is fitted.
        inner: points are drawn from the box shrunk to this fraction about its centre, away from its ends.
    """

    signal: SignalModel
    resolutions: Annotated[list[Annotated[int, Field(ge=1, le=1024)]], Field(min_length=1), AfterValidator(increasing)]
    fit_from: Annotated[int, Field(ge=1)] | None = None
    inner: Annotated[float, Field(gt=0, le=1)] = 0.9

    @model_validator(mode="after")
    def _can_fit(self) -> Study:
        if self.fit_from is not None and len(self.fitted) < 2:
            raise ValueError(f"a fit needs two resolutions ≥ fit_from ({self.fit_from}); got {self.resolutions}")
        return self

    @property
    def fitted(self) -> list[int]:
        """The resolutions that orders are fitted to; none without `fit_from`."""
        return [] if self.fit_from is None else [n for n in self.resolutions if n >= self.fit_from]


class Config(ExperimentConfig):
    """Error against resolution."""

    experiment: Literal["rms_error"]
    studies: Annotated[list[Study], Field(min_length=1)]
    methods: Recipes
    boundary: BoundaryName = "reflect"
    points: Annotated[int, Field(ge=10, le=10**8)] = 100_000
    dtype: Dtype = "float64"


def check(config: Config, path: str = "") -> None:
    """Raises ConfigError unless the signals can be evaluated."""
    for i, study in enumerate(config.studies):
        check_signal(study.signal, f"{path}studies[{i}].signal")


def units(config: Config) -> list[Unit]:
    """One per study, resolution and method, then one fit per study and method."""
    work = []
    for index, study in enumerate(config.studies):
        for n in study.resolutions:
            seconds = 0.02 + (n / 128) ** 3 * 0.5 + config.points * 4e-6
            work += [
                Unit(_key(index, n, recipe), f"{study.signal.name} {n}³, {recipe.key}", seconds)
                for recipe in config.methods
            ]
        fitted = config.methods if study.fitted else []
        work += [Unit(f"{index}/fit/{r.key}", f"{study.signal.name}, order of {r.key}", 0.01) for r in fitted]
    return work


def _key(study: int, n: int, recipe: Recipe) -> str:
    return f"{study}/{n}/{recipe.key}"


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one unit."""
    index, what, name = unit.key.split("/")
    study, recipe = config.studies[int(index)], next(r for r in config.methods if r.key == name)
    common = {"study": int(index), "signal": study.signal.label, **recipe.record()}
    if what == "fit":
        return {**common, "kind": "fit", **_fit(study, int(index), recipe, run)}
    return {**common, "kind": "error", "resolution": int(what), **_error(config, study, index, int(what), recipe, run)}


def _error(config: Config, study: Study, index: str, n: int, recipe: Recipe, run: Run) -> Record:
    signal = study.signal.build()
    truth = run.memo(f"truth:{index}", lambda: _truth(config, study))
    dtype = torch_dtype(config.dtype)
    volume = run.memo(f"volume:{index}/{n}", lambda: signal.sample(n, dtype=dtype, device=config.device))
    field, building = timed(lambda: recipe.build(volume, config.boundary))
    (v, g), evaluating = timed(lambda: evaluate(field, truth.points))
    return {
        "voxel_size": 1.0 / n,
        **truth.errors(v, g),
        "build_seconds": building,
        "evaluate_seconds": evaluating,
        "points": config.points,
    }


def _truth(config: Config, study: Study) -> Truth:
    dtype = torch_dtype(config.dtype)
    return Truth.of(study.signal.build(), config.points, study.inner, config.seed, dtype, config.device)


class Truth(NamedTuple):
    """A signal at uniform random points of its shrunk box.

    Attributes:
        points: `(P, 3)`.
        value: of the signal there, `(P)`.
        gradient: `(P, 3)`, per world unit.
    """

    points: Tensor
    value: Tensor
    gradient: Tensor

    @classmethod
    def of(cls, signal: Signal, count: int, inner: float, seed: int, dtype: torch.dtype, device: str) -> Truth:
        """At `count` points of the box shrunk to `inner`; see `uniform_points`."""
        points = uniform_points(signal, count, inner, seed, dtype, device)
        return cls(points, *evaluate(signal, points))

    def errors(self, value: Tensor, gradient: Tensor) -> Record:
        """RMS and largest errors of values and gradients at these points."""
        return {
            "value_rms": number(metrics.rms(value, self.value)),
            "value_max": number(metrics.max_error(value, self.value)),
            "gradient_rms": number(metrics.rms(gradient, self.gradient, vectors=True)),
            "gradient_max": number(metrics.max_error(gradient, self.gradient, vectors=True)),
        }


class Known(Protocol):
    """What is known exactly: a signal, or a scan held out from itself."""

    @property
    def domain(self) -> Domain: ...

    def value_and_gradient(self, points: Tensor, /) -> tuple[Tensor, Tensor]: ...


def uniform_points(field: Known, count: int, inner: float, seed: int, dtype: torch.dtype, device: str) -> Tensor:
    """`count` uniform world points `(count, 3)` in the field's box shrunk to `inner`; the same on any device."""
    generator = torch.Generator().manual_seed(seed)
    unit = torch.rand(count, 3, generator=generator, dtype=torch.float64)
    lower, upper = (torch.tensor(c, dtype=torch.float64) for c in (field.domain.lower, field.domain.upper))
    center, half = (lower + upper) / 2, (upper - lower) / 2
    return field.domain.geometry.to_world(center + inner * half * (2 * unit - 1)).to(dtype=dtype, device=device)


def evaluate(field: Known, points: Tensor) -> tuple[Tensor, Tensor]:
    """Values `(P)` and gradients `(P, 3)` at the points `(P, 3)`, in bounded memory."""
    with torch.no_grad():
        parts = [field.value_and_gradient(chunk) for chunk in points.split(CHUNK)]
    return torch.cat([v for v, _ in parts]), torch.cat([g for _, g in parts])


def angles(gradient: Tensor, reference: Tensor) -> Record:
    """Mean and largest angle between gradients `(P, 3)` in degrees, where the reference has a direction to speak of."""
    lengths = reference.norm(dim=-1)
    angle = metrics.angular_error(gradient, reference)[lengths > STEEP * lengths.max()]
    angle = angle[angle.isfinite()]
    return {"angle_mean": number(math.degrees(angle.mean())), "angle_max": number(math.degrees(angle.max()))}


def _fit(study: Study, index: int, recipe: Recipe, run: Run) -> Record:
    used = study.fitted
    records = [run.records[_key(index, n, recipe)] for n in used]
    return {
        "resolutions": used,
        "declared_order": recipe.declared_order,
        "value_order": slope(used, [r["value_rms"] for r in records]),
        "gradient_order": slope(used, [r["gradient_rms"] for r in records]),
    }


def slope(resolutions: list[int], errors: list[Any]) -> float | None:
    """Least-squares slope of log error against log voxel size; None where an error is zero or missing."""
    if any(e is None or e <= 0 for e in errors):
        return None
    x = [-math.log(n) for n in resolutions]
    y = [math.log(e) for e in errors]
    mean_x, mean_y = sum(x) / len(x), sum(y) / len(y)
    covariance = sum((a - mean_x) * (b - mean_y) for a, b in zip(x, y, strict=True))
    return covariance / sum((a - mean_x) ** 2 for a in x)
