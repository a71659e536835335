"""What do the methods make of a real scan? (Figures 7-9 of the paper.)

One view of the volume, whole and through windows that magnify a part of it, with every method. There is no ground
truth: the images are for the eye. Zooming shows what the whole view hides: staircases, and detail smoothed away.
Differences to the images of one of the methods (`reference`) show where the others say something else.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator
from torch import Tensor

import filterlab as fl
from experiments.config import BoundaryName, Dtype, ExperimentConfig, Recipe, Recipes, VolumeChoice, torch_dtype
from experiments.dvr_signal import amplified_difference, image_errors
from experiments.runs import Record, Run, Unit, timed
from experiments.views import Silent, View, Window
from filterlab.io.config import StrictModel
from filterlab.names import unknown_name

WHOLE = "whole"


class Zoom(StrictModel):
    """A part of the view, rendered at full size: (left, top, right, bottom) in 0 … 1 of the whole view."""

    title: str
    window: Window


class Config(ExperimentConfig):
    """One volume, rendered whole and zoomed with every method.

    Attributes:
        reference: the method that the others' images are compared with, as the report names it (`notch`,
            `trilinear.central`); left out: none are.
        amplify: differences are shown so many times larger.
    """

    experiment: Literal["dvr_volume"]
    volume: VolumeChoice
    methods: Recipes
    view: View
    zooms: list[Zoom] = Field(default_factory=list)
    boundary: BoundaryName = "mirror"
    dtype: Dtype = "float32"
    reference: str | None = None
    amplify: Annotated[float, Field(gt=0)] = 4.0

    @model_validator(mode="after")
    def _known_reference(self) -> Config:
        known = [recipe.key for recipe in self.methods]
        if self.reference is not None and self.reference not in known:
            raise ValueError(unknown_name("reference", self.reference, known))
        return self

    @model_validator(mode="after")
    def _titles(self) -> Config:
        titles = [zoom.title for zoom in self.zooms]
        if len(set(titles)) < len(titles):
            raise ValueError(f"expected zooms with different titles; got {titles}")
        return self

    @property
    def windows(self) -> dict[str, Window | None]:
        """Every view of the report: the whole one and the zooms, by a name for keys and files."""
        return {WHOLE: None, **{f"zoom-{i + 1}": zoom.window for i, zoom in enumerate(self.zooms)}}


def check(config: Config, path: str = "") -> None:
    """Raises ConfigError unless the volume file is there and sound, and its images can be drawn."""
    domain = config.volume.check(f"{path}volume")
    for window in config.windows.values():
        config.view.through(window).check(domain, f"{path}view", compared=config.reference is not None)


def units(config: Config) -> list[Unit]:
    """One per method and view."""
    voxels, file = config.volume.extent(), config.volume.file
    return [
        Unit(f"{recipe.key}/{name}", f"{file}, {recipe.key}, {name}", config.view.seconds(voxels, recipe.first_scheme))
        for recipe in config.methods
        for name in config.windows
    ]


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one image."""
    key, name = unit.key.split("/")
    recipe = next(r for r in config.methods if r.key == key)
    field, building = run.memo(f"field:{key}", lambda: timed(lambda: _field(config, recipe, run)))
    view = config.view.through(config.windows[name])
    image, rendering = view.timed(field, run, config.device, config.dtype)
    files = {"image": run.save_image(f"{key}-{name}", image)}
    errors: Record = {}
    if config.reference not in (None, key):
        other = run.memo(f"reference:{name}", lambda: _reference(config, view, run))
        difference = amplified_difference(image, other, config.amplify)
        files["difference"] = run.save_image(f"{key}-{name}-difference", difference, srgb=False)
        errors = image_errors(image, other)
    return {
        **recipe.record(),
        "view": name,
        **files,
        "files": list(files.values()),
        **errors,
        "build_seconds": building,
        "render_seconds": rendering,
    }


def _reference(config: Config, view: View, run: Run) -> Tensor:
    """The image that others are compared with."""
    recipe = next(r for r in config.methods if r.key == config.reference)
    field, _ = run.memo(f"field:{recipe.key}", lambda: timed(lambda: _field(config, recipe, run)))
    return view.draw(field, Silent(), config.device, config.dtype)


def _field(config: Config, recipe: Recipe, run: Run) -> fl.Field:
    volume = run.memo("volume:", lambda: config.volume.load())
    return recipe.build(volume.to(torch_dtype(config.dtype)).to(config.device), config.boundary)
