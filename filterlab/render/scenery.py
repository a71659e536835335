"""What is around a surface out of doors: sky, haze, flat water, earth below, and a sun said by compass and altitude.

Letters: d the unit direction of a ray, s the world distance along it, z up. Colours are linear RGB.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from filterlab.arrays import Array
from filterlab.ops.reference.optics import dot, safe_normalize
from filterlab.render.rays import slab
from filterlab.render.shading import Light, like

Color = Sequence[float] | Array
Direction = tuple[float, float, float]
Around = Callable[[Tensor], Tensor]
"""Linear RGB (R, 3) of what lies infinitely far away in unit directions (R, 3)."""

_AT_NORMAL = 0.02  # of light that water reflects straight up


def toward(azimuth: float, altitude: float) -> Direction:
    """The unit vector to a place in the sky, as maps and almanacs say it: (sin α cos h, cos α cos h, sin h).

    Args:
        azimuth: α in degrees from north (+y), clockwise seen from above.
        altitude: h in degrees above the horizon, −90 … 90.
    """
    if not math.isfinite(azimuth) or not -90 <= altitude <= 90:
        raise ValueError(f"expected an azimuth and an altitude from −90° to 90°; got {azimuth} and {altitude}")
    a, h = math.radians(azimuth), math.radians(altitude)
    return math.sin(a) * math.cos(h), math.cos(a) * math.cos(h), math.sin(h)


def sun(azimuth: float = 315.0, altitude: float = 45.0, color: Color = (1.0, 1.0, 1.0)) -> Light:
    """A light at a place in the sky, see `toward`; by default where maps have it, in the north-west."""
    return Light(toward(azimuth, altitude), color)


@dataclass(frozen=True)
class Sky:
    """A clear sky over grey ground, with a soft sun.

    above(d) = horizon + (zenith − horizon) √max(d_z, 0),    ground below, blended by σ(40 d_z),
    + glow · exp(400 (d·l − 1)),    l the direction of the sun

    Attributes:
        sun: towards it, any length; None: there is none.
        zenith, horizon, ground: colours.
        glow: how bright the sun is.
    """

    sun: Sequence[float] | Array | None = (0.4, -0.5, 0.75)
    zenith: Color = (0.15, 0.35, 0.8)
    horizon: Color = (0.8, 0.88, 0.95)
    ground: Color = (0.25, 0.23, 0.2)
    glow: float = 3.0

    def __call__(self, directions: Tensor) -> Tensor:
        """Linear RGB (R, 3) in unit directions (R, 3)."""
        z = directions[:, 2:]
        zenith, horizon, ground = (like(c, z) for c in (self.zenith, self.horizon, self.ground))
        above = torch.lerp(horizon, zenith, z.clamp_min(0).sqrt())
        sky = torch.lerp(ground, above, torch.sigmoid(40 * z))
        if self.sun is None:
            return sky
        towards = safe_normalize(like(self.sun, z))
        return sky + self.glow * torch.exp(400 * (dot(directions, towards) - 1))[:, None]


@dataclass(frozen=True)
class Haze:
    """Air that hides what is far away: e^(−s / distance) of a colour is left at a distance s, the rest is the air's.

    Attributes:
        distance: world length at which 1/e is left, positive.
        color: of the air.
    """

    distance: float
    color: Color = (0.72, 0.8, 0.9)

    def __post_init__(self) -> None:
        if not 0 < self.distance < math.inf:
            raise ValueError(f"haze needs a positive world distance; got {self.distance!r}")

    def __call__(self, color: Tensor, distance: Tensor) -> Tensor:
        """Colours (…, 3) seen from distances (…)."""
        left = torch.exp(-distance / self.distance)[..., None]
        return like(self.color, color) + left * (color - like(self.color, color))


class Crossing(NamedTuple):
    """Where rays (R, 3) meet the face of the water: distance (R,), ∞ where they don't, and the share (R,) reflected."""

    distance: Tensor
    share: Tensor


@dataclass(frozen=True)
class Water:
    """A flat, still face of water, seen from above; light goes on straight through it.

    Of a ray that meets it at an angle with cosine c to the vertical

    0.02 + 0.98 (1 − c)⁵ is reflected (Schlick); the rest goes on to the ground, a way u farther, of which it sees
    e^(−u / clarity), and the water's own colour for what is left.

    Attributes:
        level: z of the face.
        color: of deep water.
        clarity: world length at which 1/e of the ground's colour is left, positive.
    """

    level: float
    color: Color = (0.01, 0.06, 0.09)
    clarity: float = 10.0

    def __post_init__(self) -> None:
        if not math.isfinite(self.level) or not 0 < self.clarity < math.inf:
            got = f"level {self.level!r} and clarity {self.clarity!r}"
            raise ValueError(f"water needs a finite level and a positive clarity; got {got}")

    def crossing(self, origins: Tensor, directions: Tensor, lower: Sequence[float], upper: Sequence[float]) -> Crossing:
        """Of rays (R, 3) from above, within a rectangle of x and y."""
        down = directions[:, 2] < 0
        distance = (self.level - origins[:, 2]) / torch.where(down, directions[:, 2], 1)
        x, y = (origins[:, k] + distance * directions[:, k] for k in range(2))
        inside = (lower[0] <= x) & (x <= upper[0]) & (lower[1] <= y) & (y <= upper[1])
        share = _AT_NORMAL + (1 - _AT_NORMAL) * (1 - directions[:, 2].abs()).clamp(0, 1) ** 5
        return Crossing(torch.where(down & inside & (distance > 0), distance, torch.inf), share)

    def through(self, ground: Tensor, way: Tensor) -> Tensor:
        """What is seen of the ground (R, 3) through ways (R,) of water; of none, ∞ far away, the water alone."""
        left = torch.exp(-way / self.clarity)[:, None]
        own = like(self.color, ground)
        return own + torch.where(left > 0, left * (ground - own), 0)


@dataclass(frozen=True)
class Block:
    """The walls of a block of earth, where a surface ends at the sides of its domain: the cut between it and a base.

    The earth is where F < 0, F the function whose zeros the surface is: below the ground of a height field.

    Attributes:
        base: z where the walls end, below the domain.
        color: of the earth, lit from all around and by every light that a wall faces.
    """

    base: float
    color: Color = (0.2, 0.16, 0.13)

    def entry(self, origins: Tensor, directions: Tensor, lower: Sequence[float], upper: Sequence[float]) -> Tensor:
        """World distances (R,) at which rays (R, 3) from outside go through a wall of a box; ∞ for others."""
        near, far = slab(origins, directions, (*lower[:2], self.base), upper)
        z = origins[:, 2] + near * directions[:, 2]
        top, bottom = upper[2] - z, z - self.base
        length = 1e-9 * (upper[2] - self.base)
        return torch.where((near > 0) & (near < far) & (top > length) & (bottom > length), near, torch.inf)

    def lit(self, points: Tensor, lights: Sequence[Light], lower: Sequence[float], upper: Sequence[float]) -> Tensor:
        """Linear RGB (R, 3) of points of walls."""
        outward = []
        for k in range(2):
            low, high = (points[:, k] - lower[k]).abs(), (upper[k] - points[:, k]).abs()
            outward.append((torch.minimum(low, high), torch.where(low < high, -1.0, 1.0).to(points)))
        along_x = outward[0][0] < outward[1][0]
        zero = torch.zeros_like(points[:, 0])
        normal = torch.stack(
            (torch.where(along_x, outward[0][1], zero), torch.where(along_x, zero, outward[1][1]), zero), -1
        )
        light = torch.full_like(points, 0.6)
        for source in lights:
            if source.direction is not None:
                light = light + dot(normal, source.toward(points)).clamp_min(0)[:, None] * like(source.color, points)
        return like(self.color, points) * light
