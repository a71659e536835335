"""A terrain as a picture: heights in a file, and how they are looked at, lit and coloured; or a flight over them.

    Heights ─▶ metres, about the middle ─▶ HeightField ─┐
    TerrainScene ─▶ exaggeration, colours, sun, camera ─┴─▶ raycast

Everything has a default, so that a file alone is a view. The world of a scene has its origin in the middle of the map,
in metres; `shift` leads there from the coordinates of the file.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field, field_validator
from pydantic_core import to_jsonable_python
from torch import Tensor

from filterlab.heights import DEGREE, Heights
from filterlab.io.config import StrictModel, loads_config
from filterlab.io.images import from_srgb, load_image
from filterlab.render import materials, relief
from filterlab.render.camera import Camera, PerspectiveCamera
from filterlab.render.colormaps import HYPSOMETRIC, ColorScale, check_colormap
from filterlab.render.image import Progress
from filterlab.render.legend import Legend
from filterlab.render.materials import Coloring, Material
from filterlab.render.raycast import raycast
from filterlab.render.scenery import Block, Haze, Sky, Water, sun, toward
from filterlab.render.shading import Light
from filterlab.scenes.model.colors import parsed
from filterlab.scenes.model.quantities import Positive
from filterlab.surfaces import HeightField

QUANTITIES = ("slope", "aspect", "normal", "hillshade")
"""What may be asked for as colours, beside colormaps by height and one colour."""
MATERIALS = ("matt", "reflection_lines", "mirror")

STEEP = 0.08
"""Height of what is seen, as part of how wide it is, that exaggeration is suggested for."""
_NICE = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0, 10.0, 15.0, 20.0)
_LEFT_OUT = 0.005  # of the heights at either end: tints and exaggeration are for the others
_SUN, _SKYLIGHT = (1.15, 1.06, 0.93), (0.26, 0.31, 0.4)
_TABLE = (0.5, 0.54, 0.6)  # what a block stands before
_DEPTH = 0.03  # of the width, from the lowest height to the base of the block
_FRAMED = 48  # points along each side that the camera has in view

Ends = tuple[float, float]
Degrees = Annotated[float, Field(ge=-360, le=360)]


class TerrainScene(StrictModel):
    """How heights are shown.

    Attributes:
        spline: of the surface.
        exaggeration: how many times as high as it is the ground stands; None: as its relief suggests.
        view: azimuth that the camera looks to, and how many degrees it looks down.
        field_of_view: of the camera, vertical.
        sun: azimuth and altitude of the sun.
        color: a colormap, by height; "slope", "aspect", "normal" or "hillshade"; or one colour.
        range: heights, slopes or azimuths at both ends of the colours; None: those that there are.
        drape: a picture instead: PNG or JPEG that covers the whole map, or a GeoTIFF with its own extent.
        material: "matt"; "reflection_lines" or "mirror", which show how smooth a surface is.
        sky: an equirectangular picture of what is around; None: a clear sky.
        water: the level of still water, in the unit of the heights; None: there is none.
        haze: distance in metres at which 1/e of a colour is left; None: there is none.
        block: whether there are walls of earth where the ground ends.
        fill: whether heights that are missing are made from those around; else they are holes.
        unit: of x and y, where the file declares none.
    """

    spline: Literal["linear", "c0", "c1", "c2"] = "c1"
    exaggeration: Annotated[float, Field(gt=0, le=1000)] | None = None
    view: tuple[Degrees, Annotated[float, Field(ge=1, le=89)]] = (20.0, 33.0)
    field_of_view: Annotated[float, Field(gt=0, lt=180)] = 25.0
    sun: tuple[Degrees, Annotated[float, Field(gt=0, le=90)]] = (315.0, 38.0)
    color: str = HYPSOMETRIC
    range: Ends | None = None
    drape: Path | None = None
    material: Literal["matt", "reflection_lines", "mirror"] = "matt"
    sky: Path | None = None
    water: float | None = None
    haze: Positive | None = None
    block: bool = True
    fill: bool = False
    shadows: bool = True
    size: tuple[Annotated[int, Field(ge=1, le=65536)], Annotated[int, Field(ge=1, le=65536)]] = (960, 600)
    subpixels: Annotated[int, Field(ge=1, le=8)] = 2
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    unit: str | None = None

    @field_validator("color")
    @classmethod
    def _known_color(cls, name: str) -> str:
        if name not in QUANTITIES and _one_color(name) is None:
            try:
                check_colormap(name)
            except ValueError as error:
                raise ValueError(f"{error}; or {', '.join(QUANTITIES)}, or a colour by name") from None
        return name

    @field_validator("range")
    @classmethod
    def _increasing(cls, ends: Ends | None) -> Ends | None:
        if ends is not None and not ends[0] < ends[1]:
            raise ValueError(f"expected the lower end first; got {ends[0]:g} and {ends[1]:g}")
        return ends


def scene_of(given: Mapping[str, Any]) -> TerrainScene:
    """The scene of options, by their names. Raises ConfigError that tells of `--name`."""
    asked = {name: json.dumps(to_jsonable_python(value)) for name, value in given.items() if value is not None}
    return loads_config("{}", TerrainScene, asked)


def _one_color(name: str) -> tuple[float, float, float] | None:
    """The colour of that name; None for a quantity, and for a colormap, which `gray` and `pink` are as well."""
    if name in QUANTITIES:
        return None
    try:
        check_colormap(name)
    except ValueError:
        try:
            return parsed(name)[0]
        except ValueError:
            return None
    return None


def local(heights: Heights, unit: str | None = None) -> tuple[Heights, tuple[float, float], tuple[float, float]]:
    """Heights in metres about their middle: (heights, scale, shift), local = scale · coordinate − shift.

    Args:
        unit: of x and y, where none is declared; None there: degrees where the numbers look like them.

    Raises:
        ValueError: an unknown unit, or one against what the file declares.
    """
    if unit is not None and heights.unit is not None and unit != heights.unit:
        raise ValueError(f"expected the unit that the file declares, {heights.unit}; got {unit}")
    guessed = DEGREE if heights.looks_like_degrees else None
    metres = replace(heights, unit=heights.unit or unit or guessed).in_metres()
    left, bottom, right, top = metres.extent
    shift = ((left + right) / 2, (bottom + top) / 2)
    scale = (metres.spacing[0] / heights.spacing[0], metres.spacing[1] / heights.spacing[1])
    origin = tuple(o - s for o, s in zip(metres.origin, shift, strict=True))
    return replace(metres, origin=origin), scale, shift  # type: ignore[arg-type]


@dataclass(frozen=True)
class Terrain:
    """A scene of heights, made ready.

    Attributes:
        scene: what was asked.
        heights: local, see `local`.
        scale, shift: from coordinates of the file to local ones.
        crs: of the file.
    """

    scene: TerrainScene
    heights: Heights
    scale: tuple[float, float]
    shift: tuple[float, float]
    crs: str | None = None

    @classmethod
    def of(cls, scene: TerrainScene, heights: Heights) -> Terrain:
        """Raises ValueError: no height at all; units, colours and ranges that are none."""
        if heights.missing.all():
            raise ValueError("expected a height somewhere; got none")
        own, scale, shift = local(heights, scene.unit)
        return cls(scene, own, scale, shift, heights.crs)

    @cached_property
    def span(self) -> tuple[float, float]:
        """The lowest and the highest height, but for half a percent at either end."""
        known = self.heights.samples[~self.heights.missing]
        low, high = np.quantile(known[:: max(1, known.size // 2**20)], (_LEFT_OUT, 1 - _LEFT_OUT))
        return float(low), float(high)

    @cached_property
    def width(self) -> float:
        """The longer side, in metres; 1 for a point."""
        left, bottom, right, top = self.heights.extent
        return max(right - left, top - bottom) or 1.0

    @cached_property
    def exaggeration(self) -> float:
        """That of the scene, or the one that makes the relief `STEEP`, from 1 to 20."""
        if self.scene.exaggeration is not None:
            return self.scene.exaggeration
        low, high = self.span
        wanted = STEEP * self.width / (high - low) if high > low else 1.0
        return max((nice for nice in _NICE if nice <= wanted), default=1.0)

    @cached_property
    def surface(self) -> HeightField:
        """The ground, exaggerated."""
        high = self.heights.samples
        samples = high if self.exaggeration == 1 else high * high.dtype.type(self.exaggeration)
        return HeightField(
            torch.from_numpy(samples),
            self.scene.spline,
            self.heights.spacing,
            self.heights.origin,
            nan="fill" if self.scene.fill else "propagate",
        )

    @cached_property
    def camera(self) -> Camera:
        """The whole map in view, as near as can be."""
        return self._looking(*self.scene.view)

    def _looking(self, azimuth: float, down: float) -> PerspectiveCamera:
        across, size = toward(azimuth, -down), self.scene.size
        return PerspectiveCamera.of_points(
            self._framed(), across, field_of_view=self.scene.field_of_view, aspect=size[0] / size[1], margin=1.06
        )

    def _framed(self) -> Tensor:
        """World points (M, 3) of the ground, and of the base of the block below its edges."""
        rows, columns = (
            np.unique(np.linspace(0, n - 1, _FRAMED).round().astype(int)) for n in self.heights.samples.shape
        )
        z = self.heights.samples[np.ix_(rows, columns)] * self.exaggeration
        x = self.heights.origin[0] + self.heights.spacing[0] * columns
        y = self.heights.origin[1] + self.heights.spacing[1] * rows
        points = np.stack([*np.broadcast_arrays(x, y[:, None]), z], -1).reshape(-1, 3)
        points = points[np.isfinite(points).all(-1)]
        edges = np.concatenate([points, *([points * (1, 1, 0) + (0, 0, self.base)] if self.scene.block else [])])
        return torch.from_numpy(edges if len(edges) else np.zeros((1, 3)))

    @cached_property
    def base(self) -> float:
        """z of the foot of the block."""
        return self.surface.domain.lower[2] - _DEPTH * self.width

    @cached_property
    def lights(self) -> tuple[Light, ...]:
        """The sun."""
        return (sun(*self.scene.sun, color=_SUN),)

    @cached_property
    def material(self) -> Material:
        """What the ground is made of."""
        if self.scene.material == "reflection_lines":
            return materials.ReflectionLines((1.0, 0.0, 0.0), 12.0)
        if self.scene.material == "mirror":
            return materials.Environment(self._around, self.coloring, 0.5)
        plain = self.scene.drape is None and self.scene.color in QUANTITIES
        return relief.Unlit(self.coloring) if plain else relief.Lambertian(self.coloring, _SKYLIGHT)

    @cached_property
    def _around(self) -> Tensor | None:
        return None if self.scene.sky is None else load_image(self.scene.sky)

    @cached_property
    def sky(self) -> Callable[[Tensor], Tensor]:
        """What is behind the ground."""
        if self._around is not None:
            return materials.Environment(self._around).around
        return Sky(toward(*self.scene.sun), ground=_TABLE if self.haze is None else self.haze.color)

    @property
    def haze(self) -> Haze | None:
        """The air, which hides what is beyond the map as well."""
        return None if self.scene.haze is None else Haze(self.scene.haze)

    @cached_property
    def coloring(self) -> Coloring:
        """The colours of the ground."""
        if self.scene.drape is not None:
            return self._draped(self.scene.drape)
        name, e = self.scene.color, self.exaggeration
        if name == "hillshade":
            return relief.Hillshade(*self.scene.sun, e)
        if name == "normal":
            return relief.ByNormal(e)
        if name in QUANTITIES:
            assert self.scale_shown is not None
            return (relief.BySlope if name == "slope" else relief.ByAspect)(self.scale_shown, e)
        single = _one_color(name)
        if single is not None:
            return materials.Uniform(single)
        assert self.scale_shown is not None
        return relief.ByHeight(self.scale_shown, e)

    @cached_property
    def scale_shown(self) -> ColorScale | None:
        """The colours of values; None where there are no values to be told."""
        name = self.scene.color
        if self.scene.drape is not None or name in ("hillshade", "normal") or _one_color(name) is not None:
            return None
        if name == "slope":
            return ColorScale(*(self.scene.range or (0.0, 60.0)), "magma")
        if name == "aspect":
            return ColorScale(*(self.scene.range or (0.0, 360.0)), "hsv")
        return ColorScale(*(self.scene.range or self.span), name)

    @property
    def legend(self) -> Legend | None:
        """That of the colours."""
        if self.scale_shown is None:
            return None
        labels = {"slope": "slope in degrees", "aspect": "faces to, degrees from north"}
        unit = "m" if self.heights.height_unit else ""
        label = labels.get(self.scene.color, f"height in {unit}" if unit else "height")
        return Legend.of_scale(self.scale_shown, label=label)

    def _draped(self, path: Path) -> Coloring:
        """A picture of the whole map, or one with its own place."""
        left, bottom, right, top = self._pixel_edges
        if path.suffix.lower() not in (".tif", ".tiff"):
            return relief.Draped(load_image(path), (left, bottom, right, top))
        from filterlab.io.geotiff import read_picture

        picture = read_picture(path)
        if self.crs is not None and picture.crs is not None and picture.crs != self.crs:
            raise ValueError(
                f"{path}: expected a picture in the reference system of the heights, {self.crs}; got {picture.crs}"
            )
        linear = from_srgb(torch.from_numpy(picture.rgb.astype(np.float32) / 255))
        place = [c * self.scale[k % 2] - self.shift[k % 2] for k, c in enumerate(picture.extent)]
        return relief.Draped(linear, tuple(place))  # type: ignore[arg-type]

    @property
    def _pixel_edges(self) -> tuple[float, float, float, float]:
        """Half a step around the samples."""
        (left, bottom, right, top), (dx, dy) = self.heights.extent, map(abs, self.heights.spacing)
        return left - dx / 2, bottom - dy / 2, right + dx / 2, top + dy / 2

    @property
    def water(self) -> Water | None:
        """At its level, exaggerated as the ground is."""
        if self.scene.water is None:
            return None
        return Water(self.scene.water * self.exaggeration, clarity=max(0.004 * self.width, 1e-6))

    def options(self) -> dict[str, Any]:
        """What `raycast` takes beside the surface."""
        scene = self.scene
        return {
            "material": self.material,
            "size": scene.size,
            "lights": self.lights,
            "background": self.sky,
            "haze": self.haze,
            "water": self.water,
            "block": Block(self.base) if scene.block else None,
            "shadows": scene.shadows and scene.material == "matt",
            "subpixels": scene.subpixels,
            "seed": scene.seed,
        }

    def render(self, progress: Progress = False, camera: Camera | None = None) -> Tensor:
        """The picture (H, W, 3), linear RGB, by another camera where one is given."""
        image = raycast(self.surface, camera or self.camera, progress=progress, **self.options())
        assert isinstance(image, Tensor)
        return image[..., :3].clamp(0, 1)

    def around(self, count: int) -> list[Camera]:
        """So many cameras of a whole turn, all as far away as the farthest that has everything in view."""
        azimuth, down = self.scene.view
        cameras = [self._looking(azimuth - 360 * k / count, down) for k in range(count)]
        farthest = max(cameras, key=_distance)
        return [farthest.turned(360 * (k - cameras.index(farthest)) / count) for k in range(count)]


def _distance(camera: Camera) -> float:
    return math.dist([float(v) for v in camera.position], [float(v) for v in camera.target])
