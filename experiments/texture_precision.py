"""What do a texture unit's 8-bit fractions cost?

Graphics hardware rounds the fractions of a trilinear sample to 1/256. The eight-trilinear scheme rests on such samples,
so its value and gradient inherit the rounding. Here it is measured against the direct sum in float64:

    float64 eight samples     the scheme itself: rounding errors of float64
    float32 direct            what float32 costs
    float32 eight samples     what float32 costs this scheme
    float32 8-bit fractions   what a texture unit gives

Errors of the value are relative to the range of the samples; errors of the gradient to the RMS length of the gradient.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Annotated, Any, Literal

import torch
from pydantic import AfterValidator, Field, model_validator
from torch import Tensor

import filterlab as fl
from experiments.config import (
    BoundaryName,
    ExperimentConfig,
    Recipe,
    Recipes,
    VolumeChoice,
    check_signal,
    distinct,
    number,
)
from experiments.dvr_signal import amplified_difference, image_errors
from experiments.errors import RunError
from experiments.rms_error import angles, evaluate, uniform_points
from experiments.runs import Record, Run, Unit
from experiments.views import View
from filterlab import metrics
from filterlab.fields.base import Domain
from filterlab.io.config import StrictModel
from filterlab.scenes.model import SignalModel

VARIANTS: dict[str, tuple[torch.dtype, str, str]] = {
    "float64 eight samples": (torch.float64, "sampled", "exact"),
    "float32 direct": (torch.float32, "direct", "exact"),
    "float32 eight samples": (torch.float32, "sampled", "exact"),
    "float32 8-bit fractions": (torch.float32, "sampled", "texture_unit"),
}


class Source(StrictModel):
    """What is reconstructed: a signal at a resolution, or a volume file; and a view, if images are to be compared."""

    title: str
    signal: SignalModel | None = None
    resolution: Annotated[int, Field(ge=2, le=1024)] | None = None
    volume: VolumeChoice | None = None
    view: View | None = None

    @model_validator(mode="after")
    def _one(self) -> Source:
        if (self.signal is None) == (self.volume is None):
            raise ValueError("expected either signal and resolution, or volume")
        if (self.signal is None) != (self.resolution is None):
            raise ValueError("expected signal and resolution together")
        return self

    def extent(self) -> float:
        """Voxels along an axis."""
        return self.volume.extent() if self.volume is not None else float(self.resolution or 1)

    def check(self, path: str) -> Domain:
        """The domain of the samples. Raises ConfigError, for the key at `path`, unless a volume file is sound."""
        if self.volume is not None:
            return self.volume.check(f"{path}.volume")
        assert self.signal is not None
        assert self.resolution is not None
        domain = check_signal(self.signal, f"{path}.signal").domain
        extent = max(b - a for a, b in zip(domain.lower, domain.upper, strict=True))
        return replace(domain, voxel_size=extent / self.resolution)

    def load(self, device: str) -> fl.Volume:
        """The samples, float64."""
        if self.signal is not None and self.resolution is not None:
            return self.signal.build().sample(self.resolution, device=device)
        assert self.volume is not None
        return self.volume.load().to(torch.float64).to(device)


class Config(ExperimentConfig):
    """Precision of the eight-trilinear scheme, for some methods and sources.

    Points are drawn from the box shrunk to `inner`, so that the ends of a signal do not hide its reconstruction. A
    recipe has the kind of gradient that the scheme gives: trilinear says `gradient: central`.
    """

    experiment: Literal["texture_precision"]
    sources: Annotated[list[Source], Field(min_length=1)]
    methods: Recipes
    image_methods: Annotated[list[Recipe], AfterValidator(distinct)] = Field(default_factory=list)
    boundary: BoundaryName = "mirror"
    points: Annotated[int, Field(ge=10, le=10**8)] = 50_000
    inner: Annotated[float, Field(gt=0, le=1)] = 0.8
    amplify: Annotated[float, Field(gt=0)] = 200.0

    @model_validator(mode="after")
    def _sampled(self) -> Config:
        for recipe in [*self.methods, *self.image_methods]:
            if (recipe.scheme, recipe.sampler) != (None, "exact"):
                raise ValueError(f"{recipe.key}: every scheme and sampler is measured; leave them out")
            if "sampled" not in fl.METHODS[recipe.name].facts.schemes:
                offering = [m for m, method in fl.METHODS.items() if "sampled" in method.facts.schemes]
                raise ValueError(f"{recipe.name} offers no scheme sampled; {', '.join(offering)} do")
            _variant(recipe, "sampled", "exact")
        return self


def check(config: Config, path: str = "") -> None:
    """Raises ConfigError unless the volume files are there and sound, and their images can be drawn."""
    for i, source in enumerate(config.sources):
        domain = source.check(f"{path}sources[{i}]")
        if source.view is not None and config.image_methods:
            source.view.check(domain, f"{path}sources[{i}].view", compared=True)


def units(config: Config) -> list[Unit]:
    """Per source: one per method, then one per pair of images."""
    work = []
    for i, source in enumerate(config.sources):
        seconds = 0.5 + config.points * 1e-4
        work += [Unit(f"{i}/points/{r.key}", f"{source.title}, {r.key}", seconds) for r in config.methods]
        if source.view is not None:
            seconds = 2 * source.view.seconds(source.extent(), "sampled")
            work += [
                Unit(f"{i}/image/{r.key}", f"{source.title}, {r.key}: images", seconds) for r in config.image_methods
            ]
    return work


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one unit."""
    index, what, key = unit.key.split("/")
    source = config.sources[int(index)]
    recipe = next(r for r in (config.methods if what == "points" else config.image_methods) if r.key == key)
    volume = run.memo(f"volume:{index}", lambda: source.load(config.device))
    common = {"source": int(index), "kind": what, **_variant(recipe, "sampled", "exact").record()}
    if what == "points":
        return {**common, **_precision(config, source, volume, recipe)}
    return {**common, **_images(config, source, volume, recipe, run)}


def _variant(recipe: Recipe, scheme: Any, sampler: Any) -> Recipe:
    """The recipe with another scheme. Raises ValueError for a kind of gradient that the scheme does not give."""
    fl.METHODS[recipe.name].scheme(scheme, recipe.gradient, sampler)
    return recipe.model_copy(update={"scheme": scheme, "sampler": sampler})


def _precision(config: Config, source: Source, volume: fl.Volume, recipe: Recipe) -> Record:
    reference = recipe.build(volume, config.boundary)
    # points that float32 holds exactly, so that every variant is asked at the same ones
    points = uniform_points(reference, config.points, config.inner, config.seed, torch.float32, config.device).double()
    value, gradient = evaluate(reference, points)
    scale = float(volume.samples.max() - volume.samples.min())
    length = float(gradient.square().sum(-1).mean().sqrt())
    if not (scale > 0 and length > 0):
        raise RunError(f"{source.title}: expected samples that vary; all are {float(volume.samples.max())}")
    variants = {}
    for variant, (dtype, scheme, sampler) in VARIANTS.items():
        field = _variant(recipe, scheme, sampler).build(volume.to(dtype), config.boundary)
        v, g = (t.double() for t in evaluate(field, points.to(dtype)))
        variants[variant] = _errors(v, value, scale) | _gradient_errors(g, gradient, length)
    record: Record = {"variants": variants, "range": scale, "gradient_length": length, "points": config.points}
    if source.signal is not None:
        truth_value, truth_gradient = evaluate(source.signal.build(), points)
        record["method_error"] = _errors(value, truth_value, scale) | _gradient_errors(gradient, truth_gradient, length)
    return record


def _errors(value: Tensor, reference: Tensor, scale: float) -> Record:
    return {
        "value_rms": number(metrics.rms(value, reference) / scale),
        "value_max": number(metrics.max_error(value, reference) / scale),
    }


def _gradient_errors(gradient: Tensor, reference: Tensor, length: float) -> Record:
    return {
        "gradient_rms": number(metrics.rms(gradient, reference, vectors=True) / length),
        "gradient_max": number(metrics.max_error(gradient, reference, vectors=True) / length),
        **angles(gradient, reference),
    }


def _images(config: Config, source: Source, volume: fl.Volume, recipe: Recipe, run: Run) -> Record:
    assert source.view is not None
    single = volume.to(torch.float32)
    fields = [
        _variant(recipe, "sampled", sampler).build(single, config.boundary) for sampler in ("exact", "texture_unit")
    ]
    exact, rounded = (source.view.draw(field, run, config.device, "float32") for field in fields)
    stem = f"{config.sources.index(source)}-{recipe.key}"
    files = {
        "exact": run.save_image(f"{stem}-exact", exact),
        "rounded": run.save_image(f"{stem}-rounded", rounded),
        "difference": run.save_image(
            f"{stem}-difference", amplified_difference(rounded, exact, config.amplify), srgb=False
        ),
    }
    return {**files, "files": list(files.values()), **image_errors(rounded, exact)}
