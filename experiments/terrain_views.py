"""Real terrains as `filterlab terrain` shows them: by height, slope and light, from above and over water, as a flight.

What is not here is left out, and the report says so.
"""

from __future__ import annotations

import warnings
from typing import Annotated, Literal

import torch
from pydantic import Field

from experiments.config import ExperimentConfig, VolumeChoice
from experiments.runs import Record, Run, Unit, timed
from filterlab.heights import Heights
from filterlab.io.config import ConfigError, Problem, StrictModel
from filterlab.io.heights import describe_heights, load_heights
from filterlab.notices import Notice
from filterlab.scenes.build import picture
from filterlab.scenes.flight import Flight
from filterlab.scenes.model import Compass, Pixels, Scene, TerrainLook, TerrainModel
from filterlab.scenes.terrain import COMPASS, VIEW, PreparedTerrain, Terrain

ABSENT = "absent"
_SECONDS = 6e-6  # of a ray; only expectations use it


class HeightsChoice(VolumeChoice):
    """A file of heights; found as volumes are.

    Attributes:
        band: of a GeoTIFF.
    """

    band: Annotated[int, Field(ge=1)] | None = None

    def read(self) -> Heights:
        """The heights; what is odd of the file is not told again here."""
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Notice)
            return load_heights(self.path(), band=self.band)


class View(StrictModel):
    """A picture, or several along a flight.

    Attributes:
        terrain, size: as in a scene. compass: that of its camera.
        flight, frames: a path over the ground, and how many pictures there are of it.
    """

    title: Annotated[str, Field(min_length=1)]
    terrain: TerrainLook = TerrainLook()
    compass: Compass = COMPASS
    size: tuple[Pixels, Pixels] = (480, 300)
    flight: Flight | None = None
    frames: Annotated[int, Field(ge=1, le=100)] = 3


class Place(StrictModel):
    """A terrain and how it is looked at."""

    title: Annotated[str, Field(min_length=1)]
    heights: HeightsChoice
    views: Annotated[list[View], Field(min_length=1)]


class Config(ExperimentConfig):
    """Pictures of terrains."""

    experiment: Literal["terrain_views"]
    places: Annotated[list[Place], Field(min_length=1)]


def check(config: Config, path: str = "") -> None:
    """Raises ConfigError unless files, but for optional ones, are here and hold heights."""
    for i, place in enumerate(config.places):
        if place.heights.present:
            try:
                describe_heights(place.heights.path(), band=place.heights.band)
            except (ValueError, OSError) as error:
                raise ConfigError([Problem(place.title, f"{path}places[{i}].heights", str(error))]) from None


def _scene(place: Place, view: View) -> Scene:
    told = view.terrain.model_dump(mode="json", exclude_unset=True)
    terrain = TerrainModel(heights=str(place.heights.path()), band=place.heights.band, **told)
    return Scene(terrain=terrain, camera=VIEW.model_copy(update={"compass": view.compass}), size=view.size)


def units(config: Config) -> list[Unit]:
    """One per picture, and one for what is not here."""
    found = []
    for i, place in enumerate(config.places):
        if not place.heights.present:
            found.append(Unit(f"{i}/{ABSENT}/0", f"{place.title}: not here", 0.01))
            continue
        for j, view in enumerate(place.views):
            width, height = view.size
            seconds = _SECONDS * width * height * view.terrain.subpixels**2
            count = 1 if view.flight is None else view.frames
            found += [Unit(f"{i}/{j}/{k}", f"{place.title}, {view.title}", seconds) for k in range(count)]
    return found


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one picture."""
    i, j, k = unit.key.split("/")
    place = config.places[int(i)]
    if j == ABSENT:
        return {"kind": ABSENT, "place": int(i), "file": place.heights.file}
    view = place.views[int(j)]
    heights = run.memo(f"heights:{i}", place.heights.read)
    shown = run.memo(
        f"terrain:{i}/{j}", lambda: PreparedTerrain.of(_scene(place, view), Terrain.of(view.terrain, heights))
    )
    terrain = shown.terrain
    seen = shown if view.flight is None else view.flight.views(shown, view.frames)[int(k)]
    with torch.no_grad():
        image, seconds = timed(lambda: picture(seen, lambda done, total: run.advance(done / max(total, 1))))
    saved = run.save_image(f"{i}-{j}-{k}", image)
    left, bottom, right, top = terrain.heights.extent
    return {
        "kind": "picture",
        "place": int(i),
        "view": int(j),
        "frame": int(k),
        "image": saved,
        "files": [saved],
        "exaggeration": terrain.exaggeration,
        "size": list(heights.size),
        "missing": int(heights.missing.sum()),
        "kilometres": [(right - left) / 1000, (top - bottom) / 1000],
        "span": list(terrain.span),
        "seconds": seconds,
    }
