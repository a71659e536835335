"""What does a whole method, prefilter and kernel, do to each frequency? (Figures 2-4 of the paper.)

The closed form P(ω)Φ(ω) along an axis, and markers *measured* on the implemented method: the transform of its own
impulse response. Smoothing and postaliasing of Marschner & Lobb summarise the distance from the ideal response, which
is 1 below the Nyquist frequency π and 0 above.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Annotated, Literal

import torch
from pydantic import Field, model_validator

from experiments.config import ExperimentConfig, Recipe, Recipes, number
from experiments.runs import Record, Run, Unit
from filterlab import spectrum
from filterlab.io.config import StrictModel
from filterlab.methods import tensor_product


class FigureChoice(StrictModel):
    """A figure of the report: which of the measured methods it shows."""

    title: str
    methods: Recipes
    caption: str


class Config(ExperimentConfig):
    """Frequency responses on [0, upper·π]."""

    experiment: Literal["frequency_response"]
    methods: Recipes
    figures: list[FigureChoice] = Field(default_factory=list)
    upper: Annotated[float, Field(gt=0, le=64)] = 4.0
    samples: Annotated[int, Field(ge=2, le=100_000)] = 1025
    markers: Annotated[int, Field(ge=2, le=10_000)] = 65
    dimensions: Annotated[tuple[Literal[1, 3], ...], Field(min_length=1)] = (1, 3)

    @model_validator(mode="after")
    def _measured(self) -> Config:
        measured = {recipe.key for recipe in self.methods}
        for recipe in self.methods:
            needless = recipe.gradient is not None and recipe.scheme != "sampled"
            if recipe.sampler != "exact" or needless:
                raise ValueError(f"{recipe.key}: a response belongs to the value; leave gradient and sampler out")
        for figure in self.figures:
            for recipe in figure.methods:
                if recipe.key not in measured:
                    raise ValueError(f"figure {figure.title!r} shows {recipe.key}, which is not among the methods")
        return self


def units(config: Config) -> list[Unit]:
    """One per method."""
    return [Unit(recipe.key, f"response of {recipe.key}", _seconds(recipe, config)) for recipe in config.methods]


def _seconds(recipe: Recipe, config: Config) -> float:
    """The measures of ncrsi, whose kernel is not separable, are integrals over a volume of frequencies."""
    return 20.0 if recipe.name == "ncrsi" and 3 in config.dimensions else 0.2


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one method: curves as arrays, measures as numbers."""
    recipe = next(r for r in config.methods if r.key == unit.key)
    closed_at = torch.linspace(0, config.upper * math.pi, config.samples, dtype=torch.float64, device=config.device)
    measured_at = torch.linspace(0, config.upper * math.pi, config.markers, dtype=torch.float64, device=config.device)
    measured = _measured(recipe, measured_at)
    files = {
        "omega": run.save_array(f"{recipe.key}-omega", closed_at),
        "measured_omega": run.save_array(f"{recipe.key}-measured-omega", measured_at),
        "measured": run.save_array(f"{recipe.key}-measured", measured),
    }
    found = {"at_nyquist": number(_measured(recipe, closed_at.new_tensor([math.pi]))[0]), "largest_difference": None}
    if tensor_product(recipe.name) is not None:
        files["closed"] = run.save_array(f"{recipe.key}-closed", _closed(recipe, closed_at))
        found["at_nyquist"] = number(_closed(recipe, closed_at.new_tensor([math.pi]))[0])
        found["largest_difference"] = number((measured - _closed(recipe, measured_at)).abs().max())
    return {
        **recipe.record(),
        **files,
        "files": list(files.values()),
        **found,
        **{f"{name}_{d}d": measure for name, d, measure in _measures(recipe, config.dimensions)},
    }


def _closed(recipe: Recipe, omega: torch.Tensor) -> torch.Tensor:
    return spectrum.axis_response(recipe.name, omega, prefilter=recipe.prefilter)


def _measured(recipe: Recipe, omega: torch.Tensor) -> torch.Tensor:
    return spectrum.measured_response(recipe.name, omega, prefilter=recipe.prefilter, scheme=recipe.scheme)


def _measures(recipe: Recipe, dimensions: Sequence[int]) -> list[tuple[str, int, float | None]]:
    """Smoothing and postaliasing; None of a method whose response is measured only."""

    def measured(measure: Callable[..., float], d: int) -> float | None:
        if tensor_product(recipe.name) is None:
            return None
        return number(measure(recipe.name, prefilter=recipe.prefilter, dimensions=d))

    measures = (("smoothing", spectrum.smoothing), ("postaliasing", spectrum.postaliasing))
    return [(name, d, measured(measure, d)) for name, measure in measures for d in dimensions]
