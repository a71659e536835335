"""A terrain as a picture: heights in a file, and how they are looked at, lit and coloured.

    Heights ─▶ metres, about the middle ─▶ HeightField ─┐
    TerrainLook ─▶ exaggeration, colours, sun, camera ──┴─▶ PreparedTerrain ─▶ raycast

Everything has a default, so that a file alone is a view. The world of a picture has its origin in the middle of the
map, in metres; `Terrain.place` leads there from the coordinates of the file.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from filterlab.heights import DEGREE, METRE, Heights
from filterlab.io.images import from_srgb, load_image
from filterlab.render import materials, relief
from filterlab.render.camera import Camera
from filterlab.render.colormaps import ColorScale
from filterlab.render.legend import Legend
from filterlab.render.materials import Coloring, Material
from filterlab.render.rays import Region
from filterlab.render.scenery import Block, Haze, Sky, Water, sun, toward
from filterlab.render.shading import Light
from filterlab.scenes.model import CameraView, Scene, TerrainLook
from filterlab.scenes.model.terrain import CLEAR, NO_SKY, QUANTITIES, MattModel, one_color
from filterlab.scenes.shown import Casting
from filterlab.surfaces import HeightField

COMPASS = (20.0, 33.0)
"""Where the camera looks where nobody says: clockwise from north, and down, in degrees."""
VIEW = CameraView(compass=COMPASS, field_of_view=25.0, margin=1.06)
"""That of a terrain alone."""
STEEP = 0.08
"""Height of what is seen, as part of how wide it is, that exaggeration is suggested for."""
_NICE = (1.0, 1.5, 2.0, 3.0, 4.0, 5.0, 7.0, 10.0, 15.0, 20.0)
_LEFT_OUT = 0.005  # of the heights at either end: tints and exaggeration are for the others
_SUN = (1.15, 1.06, 0.93)
_PAPER = (1.0, 1.0, 1.0)  # behind a legend
_SHORT = {METRE: "m", "kilometre": "km", "foot": "ft"}
_TABLE = (0.5, 0.54, 0.6)  # what a block stands before
_DEPTH = 0.03  # of the width, from the lowest height to the base of the block
_FRAMED = 48  # points along each side that the camera has in view

Place = tuple[float, float, float]


def local(heights: Heights, unit: str | None = None) -> tuple[Heights, Place, Place]:
    """Heights in metres about their middle: (heights, scale, shift), local = scale · (x, y, height) − shift.

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
    shift = ((left + right) / 2, (bottom + top) / 2, 0.0)
    along_x, along_y = (m / s for m, s in zip(metres.spacing, heights.spacing, strict=True))
    scale = (along_x, along_y, heights.height_in_metres)
    origin = tuple(o - s for o, s in zip(metres.origin, shift, strict=False))
    return replace(metres, origin=origin), scale, shift  # type: ignore[arg-type]


@dataclass(frozen=True)
class Terrain:
    """A ground and what is around it, made ready.

    Attributes:
        look: what was asked.
        heights: local, see `local`.
        scale, shift: from coordinates of the file to local ones.
        unit: of heights in the file; "" where none is declared.
        crs: of the file.
        device: where it is cast.
    """

    look: TerrainLook
    heights: Heights
    scale: Place
    shift: Place
    unit: str = ""
    crs: str | None = None
    device: str = "cpu"

    @classmethod
    def of(cls, look: TerrainLook, heights: Heights, device: str = "cpu") -> Terrain:
        """Raises ValueError: no height at all; a unit that is none."""
        if heights.missing.all():
            raise ValueError(f"expected a height somewhere; all {heights.missing.size} are missing")
        own, scale, shift = local(heights, look.unit)
        return cls(look, own, scale, shift, heights.height_unit or "", heights.crs, device)

    def place(self, point: Sequence[float]) -> Place:
        """A point of the file, x, y and height, where it is in the picture's world."""
        x, y, z = (s * c - o for c, s, o in zip(point, self.scale, self.shift, strict=True))
        return x, y, z * self.exaggeration

    @cached_property
    def span(self) -> tuple[float, float]:
        """The lowest and the highest height of the file, but for half a percent at either end."""
        known = self.heights.samples[~self.heights.missing]
        low, high = np.quantile(known[:: max(1, known.size // 2**20)], (_LEFT_OUT, 1 - _LEFT_OUT)) / self.scale[2]
        return float(low), float(high)

    @cached_property
    def width(self) -> float:
        """The longer side, in metres; 1 for a point."""
        left, bottom, right, top = self.heights.extent
        return max(right - left, top - bottom) or 1.0

    @cached_property
    def exaggeration(self) -> float:
        """That of the scene, or the one that makes the relief `STEEP`, from 1 to 20."""
        if self.look.exaggeration is not None:
            return self.look.exaggeration
        low, high = (end * self.scale[2] for end in self.span)
        wanted = STEEP * self.width / (high - low) if high > low else 1.0
        return max((nice for nice in _NICE if nice <= wanted), default=1.0)

    @cached_property
    def surface(self) -> HeightField:
        """The ground, exaggerated."""
        high = self.heights.samples
        samples = high if self.exaggeration == 1 else high * high.dtype.type(self.exaggeration)
        return HeightField(
            torch.from_numpy(samples).to(self.device),
            self.look.spline,
            self.heights.spacing,
            self.heights.origin,
            prefilter=self.look.prefilter,
            nan="fill" if self.look.fill else "propagate",
        )

    @cached_property
    def framed(self) -> Tensor:
        """World points (M, 3) of the ground, and of the base of the block below its edges."""
        rows, columns = (
            np.unique(np.linspace(0, n - 1, _FRAMED).round().astype(int)) for n in self.heights.samples.shape
        )
        z = self.heights.samples[np.ix_(rows, columns)] * self.exaggeration
        x = self.heights.origin[0] + self.heights.spacing[0] * columns
        y = self.heights.origin[1] + self.heights.spacing[1] * rows
        points = np.stack([*np.broadcast_arrays(x, y[:, None]), z], -1).reshape(-1, 3)
        points = points[np.isfinite(points).all(-1)]
        edges = np.concatenate([points, *([points * (1, 1, 0) + (0, 0, self.base)] if self.look.block else [])])
        return torch.from_numpy(edges if len(edges) else np.zeros((1, 3)))

    @cached_property
    def base(self) -> float:
        """z of the foot of the block."""
        return self.surface.domain.lower[2] - _DEPTH * self.width

    @cached_property
    def lights(self) -> tuple[Light, ...]:
        """The sun."""
        return (sun(*self.look.sun, color=_SUN),)

    @cached_property
    def material(self) -> Material:
        """What the ground is made of."""
        asked = self.look.material
        if isinstance(asked, MattModel) and self.look.drape is None and self.look.color in QUANTITIES:
            return relief.Unlit(self.coloring, asked.opacity)
        made = asked.build(self.coloring)
        if isinstance(made, materials.Environment) and made.picture is None:
            return replace(made, picture=self._around)
        return made

    @cached_property
    def _around(self) -> Tensor | None:
        return None if self.look.sky in (CLEAR, NO_SKY) else load_image(self.look.sky)

    @cached_property
    def sky(self) -> Callable[[Tensor], Tensor] | None:
        """What is behind the ground; None: a background."""
        if self.look.sky == NO_SKY:
            return None
        if self._around is not None:
            return materials.Environment(self._around).around
        return Sky(toward(*self.look.sun), ground=_TABLE if self.haze is None else self.haze.color)

    @property
    def haze(self) -> Haze | None:
        """The air, which hides what is beyond the map as well."""
        return None if self.look.haze is None else Haze(self.look.haze)

    @cached_property
    def coloring(self) -> Coloring:
        """The colours of the ground."""
        if self.look.drape is not None:
            return self._draped(Path(self.look.drape))
        name, e = self.look.color, self.exaggeration
        if name == "hillshade":
            return relief.Hillshade(*self.look.sun, e)
        if name == "normal":
            return relief.ByNormal(e)
        single = one_color(name)
        if single is not None:
            return materials.Uniform(single)
        if name == "slope":
            return relief.BySlope(self.scale_shown, e)
        if name == "aspect":
            return relief.ByAspect(self.scale_shown, e)
        return relief.ByHeight(self.scale_shown, e * self.scale[2])

    @cached_property
    def scale_shown(self) -> ColorScale:
        """The colours of values."""
        name, ends = str(self.look.color), self.look.range
        if name == "slope":
            return ColorScale(*(ends or (0.0, 60.0)), "magma")
        if name == "aspect":
            return ColorScale(*(ends or (0.0, 360.0)), "hsv")
        return ColorScale(*(ends or self.span), name)

    def legend(self, label: str = "") -> Legend | None:
        """That of the colours, if they stand for values."""
        if not self.look.shows_values:
            return None
        labels = {"slope": "slope in degrees", "aspect": "faces to, degrees from north"}
        height = f"height in {_SHORT.get(self.unit, self.unit)}" if self.unit else "height"
        return Legend.of_scale(self.scale_shown, label=label or labels.get(str(self.look.color), height))

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
        if self.look.water is None:
            return None
        level = self.look.water * self.scale[2] * self.exaggeration
        return Water(level, clarity=max(0.004 * self.width, 1e-6))

    def options(self) -> dict[str, Any]:
        """What `raycast` takes to show what is around."""
        around = {"haze": self.haze, "water": self.water, "block": Block(self.base) if self.look.block else None}
        return around if self.sky is None else around | {"background": self.sky}


@dataclass(frozen=True, kw_only=True)
class PreparedTerrain(Casting):
    """A scene of a terrain. Its world has its origin in the middle of the map, in metres."""

    terrain: Terrain
    surface: HeightField

    @classmethod
    def of(cls, scene: Scene, terrain: Terrain) -> PreparedTerrain:
        """Raises ValueError for pictures that can't be read, or that lie in another reference system."""
        look = scene.cast
        assert look is not None
        return cls(
            scene=scene,
            camera=_framed(scene.camera, scene.size, terrain),
            size=scene.size,
            background=scene.background if terrain.sky is None else _PAPER,
            region=_region(scene, terrain),
            device=scene.device,
            surface=terrain.surface,
            material=terrain.material,
            lights=terrain.lights if scene.lighting is None else tuple(scene.lighting.build().lights),
            subpixels=look.subpixels,
            terrain=terrain,
        )

    @property
    def legend(self) -> Legend | None:
        return self.terrain.legend(self.scene.legend_label)

    @property
    def told(self) -> str:
        return f"{self.terrain.exaggeration:g} times as high as it is"

    def framed(self, view: CameraView) -> Camera:
        return _framed(view, self.size, self.terrain)

    def options(self) -> dict[str, Any]:
        return super().options() | self.terrain.options()


def _framed(view: CameraView, size: tuple[int, int], terrain: Terrain) -> Camera:
    """The camera of a view: at its place in the file, or with the whole map in view, as near as can be."""
    if view.position is not None and view.target is not None:
        moved = {"position": terrain.place(view.position), "target": terrain.place(view.target)}
        return view.model_copy(update=moved).build(terrain.surface.domain, size)
    seen = view.model_copy(update={"compass": COMPASS}) if view.framed else view
    return seen.build(terrain.surface.domain, size, terrain.framed)


def _region(scene: Scene, terrain: Terrain) -> Region | None:
    return None if scene.region is None else tuple(map(terrain.place, scene.region.build()))  # type: ignore[return-value]
