"""What maps show of the ground: its height, its slope and where that faces, light from a corner, a picture on it.

Letters: n the unit normal turned upwards, (n_x, n_y, n_z); x to the east, y to the north, z up. Where a surface stands
`exaggeration` e times as high as it is, that of the ground is (n_x, n_y, e n_z) made a unit vector: slopes are those of
the ground. Angles are degrees; azimuths go from north clockwise.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import torch
from torch import Tensor

from filterlab.arrays import Array
from filterlab.io.images import from_srgb
from filterlab.ops.reference.optics import dot, safe_normalize
from filterlab.render.colormaps import HYPSOMETRIC, ColorScale
from filterlab.render.materials import Color, Coloring, Material, Seen, check_opacity, check_picture, looked_up
from filterlab.render.scenery import toward
from filterlab.render.shading import Light, like


def upward(normal: Tensor) -> Tensor:
    """n: a normal (R, 3), or its opposite."""
    return torch.where(normal[..., 2:] < 0, -normal, normal)


def ground_normal(normal: Tensor, exaggeration: float) -> Tensor:
    """n of the ground, of normals (R, 3) of a surface that stands `exaggeration` times as high as it."""
    n = upward(normal)
    return n if exaggeration == 1 else safe_normalize(n * n.new_tensor((1, 1, exaggeration)))


def slope(normal: Tensor) -> Tensor:
    """Degrees (R,) from the horizontal: atan(√(n_x² + n_y²) / n_z), of normals (R, 3)."""
    n = upward(normal)
    return torch.rad2deg(torch.atan2(_across(n), n[..., 2]))


def aspect(normal: Tensor) -> Tensor:
    """Azimuth (R,) of where a slope faces, downhill: atan2(n_x, n_y), 0 … 360; 0 where it faces nowhere."""
    n = upward(normal)
    flat = (n[..., 0] == 0) & (n[..., 1] == 0)
    return torch.rad2deg(torch.atan2(n[..., 0], torch.where(flat, 1, n[..., 1]))) % 360


def _across(n: Tensor) -> Tensor:
    """√(n_x² + n_y²), with a finite derivative at 0."""
    square = n[..., 0] ** 2 + n[..., 1] ** 2
    return torch.where(square == 0, 0, torch.where(square == 0, 1, square).sqrt())


# --- colours ----------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class ByHeight(Coloring):
    """Hypsometric tints: the colours that a scale gives z / exaggeration.

    Attributes:
        scale: from the lowest height to the highest; its colormap `hypsometric` is that of an atlas.
    """

    scale: ColorScale
    exaggeration: float = 1.0

    @classmethod
    def between(cls, low: float, high: float, colormap: str = HYPSOMETRIC, exaggeration: float = 1.0) -> ByHeight:
        """Tints of a colormap, from one height to another."""
        return cls(ColorScale(low, high, colormap), exaggeration)

    def __call__(self, seen: Seen) -> Tensor:
        return self.scale(seen.point[:, 2] / self.exaggeration)


@dataclass(frozen=True)
class BySlope(Coloring):
    """The colours that a scale gives slopes, in degrees."""

    scale: ColorScale = field(default_factory=lambda: ColorScale(0, 60, "magma"))
    exaggeration: float = 1.0

    def __call__(self, seen: Seen) -> Tensor:
        return self.scale(slope(ground_normal(seen.normal, self.exaggeration)))


@dataclass(frozen=True)
class ByAspect(Coloring):
    """The colours that a scale gives azimuths, best of a colormap that ends as it begins; grey where it is flat.

    Attributes:
        flat: slope in degrees below which the ground faces nowhere.
    """

    scale: ColorScale = field(default_factory=lambda: ColorScale(0, 360, "hsv"))
    exaggeration: float = 1.0
    flat: float = 0.5

    def __call__(self, seen: Seen) -> Tensor:
        n = ground_normal(seen.normal, self.exaggeration)
        nowhere = (slope(n) < self.flat)[:, None]
        return torch.where(nowhere, 0.4, self.scale(aspect(n)))


@dataclass(frozen=True)
class ByNormal(Coloring):
    """½ + ½ n, as digits of a picture: they are the numbers of a normal map, in sRGB."""

    exaggeration: float = 1.0

    def __call__(self, seen: Seen) -> Tensor:
        return from_srgb(0.5 + 0.5 * ground_normal(seen.normal, self.exaggeration))


@dataclass(frozen=True)
class Hillshade(Coloring):
    """Grey as analytical hillshading has it: max(n·l, 0) of 255 digits, l towards the light.

    Attributes:
        azimuth, altitude: of the light; 315° and 45° unless a map says otherwise.

    Source: Horn, Hill shading and the reflectance map, 1981.
    """

    azimuth: float = 315.0
    altitude: float = 45.0
    exaggeration: float = 1.0

    def __call__(self, seen: Seen) -> Tensor:
        n = ground_normal(seen.normal, self.exaggeration)
        light = n.new_tensor(toward(self.azimuth, self.altitude))
        return ColorScale(0, 1)(dot(n, light).clamp_min(0))


@dataclass(frozen=True)
class Draped(Coloring):
    """A picture that lies on the ground.

    Attributes:
        picture: (H, W, 3) linear RGB, its first row in the north.
        extent: (left, bottom, right, top), world x and y of its edges.
        outside: the colour where there is none of it.
    """

    picture: Array
    extent: tuple[float, float, float, float]
    outside: Color = (0.5, 0.5, 0.5)

    def __post_init__(self) -> None:
        check_picture("picture", self.picture)
        left, bottom, right, top = self.extent
        if not (left < right and bottom < top and math.isfinite(right - left) and math.isfinite(top - bottom)):
            raise ValueError(
                f"extent must be (left, bottom, right, top), left < right, bottom < top; got {self.extent}"
            )

    def __call__(self, seen: Seen) -> Tensor:
        left, bottom, right, top = self.extent
        u, v = (seen.point[:, 0] - left) / (right - left), (top - seen.point[:, 1]) / (top - bottom)
        inside = (u >= 0) & (u <= 1) & (v >= 0) & (v <= 1)
        color = looked_up(self.picture, u.clamp(0, 1), v.clamp(0, 1), (False, False))
        return torch.where(inside[:, None], color, like(self.outside, color))


# --- light ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Lambertian(Material):
    """Matt ground under the sky: lit by lights that it faces, and evenly by the sky, of which it sees a part.

    rgb · (skylight (1 + n_z) / 2 + Σ_k I_k max(n·l_k, 0)),    n turned upwards, l_k towards light k of colour I_k

    The back of a slope is dark, where `Phong`, which is two-sided, lights it.

    Attributes:
        color: of the ground: linear RGB, or a colouring.
        skylight: linear RGB.

    Source: Lambert, Photometria, 1760; Moon and Spencer, Illumination from a non-uniform sky, 1942, for (1 + n_z) / 2.
    """

    color: Color | Coloring = (0.8, 0.8, 0.8)
    skylight: Color = (0.3, 0.33, 0.4)
    opacity: float = 1.0

    def __post_init__(self) -> None:
        check_opacity(self.opacity)

    @property
    def order(self) -> int:
        return Coloring.of(self.color).order

    def __call__(self, seen: Seen, lights: Sequence[Light]) -> Tensor:
        n = upward(seen.normal)
        arriving = like(self.skylight, n) * (0.5 + 0.5 * n[:, 2:])
        for light in lights:
            towards = -seen.direction if light.direction is None else light.toward(n)
            facing, visible = dot(n, towards).clamp_min(0), seen.visibility(light)
            arriving = arriving + like(light.color, n) * (facing if visible is None else facing * visible)[:, None]
        return Coloring.of(self.color)(seen) * arriving


@dataclass(frozen=True)
class Unlit(Material):
    """The colour of the surface as it is, whatever the lights: for maps and values."""

    color: Color | Coloring = (0.8, 0.8, 0.8)
    opacity: float = 1.0

    def __post_init__(self) -> None:
        check_opacity(self.opacity)

    @property
    def order(self) -> int:
        return Coloring.of(self.color).order

    def __call__(self, seen: Seen, lights: Sequence[Light]) -> Tensor:
        return Coloring.of(self.color)(seen)
