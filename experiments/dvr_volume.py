"""What do the methods make of a real scan? (Figures 7-9 of the paper.)

One view of the volume, whole and through windows that magnify a part of it, with every method. There is no ground
truth: the images are for the eye. Zooming shows what the whole view hides: staircases, and detail smoothed away.
"""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from experiments.config import BoundaryName, Dtype, ExperimentConfig, Recipe, Recipes, VolumeChoice, torch_dtype
from experiments.runs import Record, Run, Unit, timed
from experiments.views import View, Window
from filterlab.io.config import StrictModel

WHOLE = "whole"


class Zoom(StrictModel):
    """A part of the view, rendered at full size: (left, top, right, bottom) in 0 … 1 of the whole view."""

    title: str
    window: Window


class Config(ExperimentConfig):
    """One volume, rendered whole and zoomed with every method."""

    experiment: Literal["dvr_volume"]
    volume: VolumeChoice
    methods: Recipes
    view: View
    zooms: list[Zoom] = Field(default_factory=list)
    boundary: BoundaryName = "mirror"
    dtype: Dtype = "float32"

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
        config.view.through(window).check(domain, f"{path}view")


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
    image, rendering = timed(lambda: view.draw(field, run, config.device, config.dtype))
    file = run.save_image(f"{key}-{name}", image)
    return {
        **recipe.record(),
        "view": name,
        "image": file,
        "files": [file],
        "build_seconds": building,
        "render_seconds": rendering,
    }


def _field(config: Config, recipe: Recipe, run: Run):
    volume = run.memo("volume:", lambda: config.volume.load())
    return recipe.build(volume.to(torch_dtype(config.dtype)).to(config.device), config.boundary)
