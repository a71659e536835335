"""Materials: what turns a hit into colour, deferred, so that nothing of a surface is computed but what is shown.

Letters: p a point of the surface, n its unit normal, d the unit direction of the ray, v = −d, r = d − 2 (d·n) n the
reflected ray; l, h as in `render.shading`. Everything is two-sided: n and −n look alike. Colours are linear RGB.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from filterlab.arrays import Array, as_numbers, as_tensor
from filterlab.fields.base import Field
from filterlab.ops.reference.optics import dot, safe_normalize
from filterlab.render.scenery import Sky
from filterlab.render.shading import Light, Shading, like
from filterlab.render.transfer import TransferFunction

Color = Sequence[float] | Array
Visibility = Callable[[Light], Tensor | None]
"""How much of a light reaches each point, (R,) in 0 … 1; None: all of it, everywhere."""


class Seen(NamedTuple):
    """Points of a surface as they are seen.

    Attributes:
        point, normal, direction: (R, 3), in the world.
        curvatures: κ₁ ≥ κ₂ (R, 2), and principal: their directions (R, 2, 3); None unless a material's order is 2.
        visibility: of lights.
    """

    point: Tensor
    normal: Tensor
    direction: Tensor
    curvatures: Tensor | None = None
    principal: Tensor | None = None
    visibility: Visibility = lambda light: None

    @property
    def reflected(self) -> Tensor:
        """r (R, 3)."""
        return self.direction - 2 * dot(self.direction, self.normal)[:, None] * self.normal


# --- the colour of a surface ------------------------------------------------------------------------------------------


class Coloring(ABC):
    """What gives every point of a surface a colour.

    Attributes:
        order: derivatives of the surface that it needs: 1 normals, 2 curvatures.
    """

    order: int = 1

    @abstractmethod
    def __call__(self, seen: Seen) -> Tensor:
        """Linear RGB (R, 3)."""

    @staticmethod
    def of(color: Color | Coloring) -> Coloring:
        """A colouring as it is, one colour as `Uniform`."""
        return color if isinstance(color, Coloring) else Uniform(color)


@dataclass(frozen=True)
class Uniform(Coloring):
    """One colour everywhere."""

    color: Color = (0.8, 0.8, 0.8)

    def __call__(self, seen: Seen) -> Tensor:
        return like(self.color, seen.point).expand_as(seen.point)


@dataclass(frozen=True)
class ByField(Coloring):
    """The colours that a transfer function gives the values of another field: an error, a second modality."""

    field: Field
    transfer: TransferFunction

    def __call__(self, seen: Seen) -> Tensor:
        return _mapped(self.transfer, self.field(seen.point))


@dataclass(frozen=True)
class ByCurvature(Coloring):
    """The colours that a transfer function gives curvatures.

    Attributes:
        kind: `mean` (κ₁ + κ₂) / 2, `gaussian` κ₁ κ₂, or `largest` max |κ|.
    """

    transfer: TransferFunction
    kind: str = "mean"
    order = 2

    def __post_init__(self) -> None:
        if self.kind not in _CURVATURES:
            raise ValueError(f"kind must be one of {', '.join(_CURVATURES)}; got {self.kind!r}")

    def __call__(self, seen: Seen) -> Tensor:
        assert seen.curvatures is not None
        return _mapped(self.transfer, _CURVATURES[self.kind](seen.curvatures))


_CURVATURES: dict[str, Callable[[Tensor], Tensor]] = {
    "mean": lambda k: k.mean(-1),
    "gaussian": lambda k: k.prod(-1),
    "largest": lambda k: k.abs().amax(-1),
}


@dataclass(frozen=True)
class Triplanar(Coloring):
    """A texture (H, W, 3) projected along x, y and z, blended by the squares of the normal's components.

    Attributes:
        size: world edge of one tile; it repeats.
    """

    texture: Array
    size: float = 1.0

    def __post_init__(self) -> None:
        check_picture("texture", self.texture)
        if not 0 < self.size < math.inf:
            raise ValueError(f"size must be a positive world length; got {self.size!r}")

    def __call__(self, seen: Seen) -> Tensor:
        weights = seen.normal.square()
        tiles = seen.point / self.size
        color = torch.zeros_like(seen.point)
        for axis, (u, v) in enumerate(((1, 2), (0, 2), (0, 1))):
            color = color + weights[:, axis, None] * looked_up(self.texture, tiles[:, u], tiles[:, v], (True, True))
        return color


def _mapped(transfer: TransferFunction, value: Tensor) -> Tensor:
    return transfer.to(value.dtype, value.device)(value)[0]


# --- materials --------------------------------------------------------------------------------------------------------


class Material(ABC):
    """What a surface is made of.

    Attributes:
        opacity: of one sheet, in 0 … 1; below 1 what lies behind shows through.
    """

    opacity: float

    @property
    @abstractmethod
    def order(self) -> int:
        """Derivatives of the surface that it needs: 1 normals, 2 curvatures."""

    @abstractmethod
    def __call__(self, seen: Seen, lights: Sequence[Light]) -> Tensor:
        """Linear RGB (R, 3)."""


@dataclass(frozen=True)
class Phong(Material):
    """Blinn-Phong, two-sided; see `render.Shading`. The default of everything.

    Attributes:
        color: of the surface: linear RGB, or a colouring.
        ambient, diffuse, specular, shininess: as there.
    """

    color: Color | Coloring = (0.8, 0.8, 0.8)
    ambient: float | Tensor = 0.2
    diffuse: float | Tensor = 0.7
    specular: float | Tensor = 0.3
    shininess: float | Tensor = 32.0
    opacity: float = 1.0

    def __post_init__(self) -> None:
        check_opacity(self.opacity)
        self._shading(())

    @property
    def order(self) -> int:
        return Coloring.of(self.color).order

    def __call__(self, seen: Seen, lights: Sequence[Light]) -> Tensor:
        shadows = [seen.visibility(light) for light in lights]
        return self._shading(lights)(Coloring.of(self.color)(seen), seen.normal, seen.direction, shadows)

    def _shading(self, lights: Sequence[Light]) -> Shading:
        return Shading(tuple(lights), self.ambient, self.diffuse, self.specular, self.shininess)


@dataclass(frozen=True)
class ReflectionLines(Material):
    """Mirrored parallel stripes of light infinitely far away: their kinks show where curvature jumps.

    stripe = ½ + ½ tanh(sharpness · sin(count · φ)),    φ the angle of r about `axis`

    Source: Klass, Correction of local surface irregularities using reflection lines, 1980.
    """

    axis: Sequence[float] = (0.0, 0.0, 1.0)
    count: float = 16.0
    sharpness: float = 8.0
    bright: Color = (0.95, 0.95, 0.95)
    dark: Color = (0.05, 0.05, 0.1)
    opacity: float = 1.0

    def __post_init__(self) -> None:
        check_opacity(self.opacity)
        _check_direction("axis", self.axis)

    @property
    def order(self) -> int:
        return 1

    def __call__(self, seen: Seen, lights: Sequence[Light]) -> Tensor:
        r = seen.reflected
        axis = safe_normalize(like(self.axis, r))
        first, second = _across(axis)
        angle = torch.atan2(dot(r, second), dot(r, first))
        stripe = 0.5 + 0.5 * torch.tanh(self.sharpness * torch.sin(self.count * angle))
        bright, dark = like(self.bright, r), like(self.dark, r)
        return torch.lerp(dark, bright, stripe[:, None])


@dataclass(frozen=True)
class Environment(Material):
    """A mirror of what is around, tinted, by Schlick's approximation more at grazing angles.

    reflected share = reflectivity + (1 − reflectivity) (1 − |n·v|)⁵; the rest is the colour of the surface, evenly lit.

    Attributes:
        picture: equirectangular (H, W, 3) linear RGB, its top row towards +z; None: `Sky()`.
        color: of the surface itself.
    """

    picture: Array | None = None
    color: Color | Coloring = (0.2, 0.2, 0.22)
    reflectivity: float = 0.4
    opacity: float = 1.0

    def __post_init__(self) -> None:
        check_opacity(self.opacity)
        if self.picture is not None:
            check_picture("picture", self.picture)
        if not 0 <= self.reflectivity <= 1:
            raise ValueError(f"reflectivity must be from 0 to 1; got {self.reflectivity!r}")

    @property
    def order(self) -> int:
        return Coloring.of(self.color).order

    def __call__(self, seen: Seen, lights: Sequence[Light]) -> Tensor:
        grazing = 1 - dot(seen.normal, seen.direction).abs().clamp(0, 1)
        share = (self.reflectivity + (1 - self.reflectivity) * grazing**5)[:, None]
        return share * self.around(seen.reflected) + (1 - share) * Coloring.of(self.color)(seen)

    def around(self, directions: Tensor) -> Tensor:
        """Linear RGB (R, 3) of what lies in some unit directions (R, 3)."""
        if self.picture is None:
            return Sky()(directions)
        x, y, z = directions.unbind(-1)
        u = torch.atan2(y, x) / (2 * math.pi) + 0.5
        return looked_up(self.picture, u, torch.acos(z.clamp(-1, 1)) / math.pi, (True, False))


@dataclass(frozen=True)
class Toon(Material):
    """A few bands of light, and contours: non-photorealistic.

    A contour is where |n·v| < √(T κ (2 − T κ)) with κ the size of the curvature along the view, so that it is about T
    wide everywhere in the world.

    Attributes:
        bands: of diffuse light.
        contour: T, in world units; 0: none, and no curvature is computed.

    Source: Kindlmann et al., Curvature-based transfer functions for direct volume rendering, 2003.
    """

    color: Color | Coloring = (0.9, 0.75, 0.5)
    bands: int = 3
    ambient: float = 0.3
    contour: float = 0.0
    ink: Color = (0.02, 0.02, 0.05)
    opacity: float = 1.0

    def __post_init__(self) -> None:
        check_opacity(self.opacity)
        if not isinstance(self.bands, int) or self.bands < 1:
            raise ValueError(f"bands must be an integer from 1 on; got {self.bands!r}")
        if not 0 <= self.contour < math.inf:
            raise ValueError(f"contour must be a world length ≥ 0; got {self.contour!r}")

    @property
    def order(self) -> int:
        return 2 if self.contour else Coloring.of(self.color).order

    def __call__(self, seen: Seen, lights: Sequence[Light]) -> Tensor:
        light = torch.zeros_like(seen.point)
        for source in lights:
            toward = -seen.direction if source.direction is None else source.toward(seen.point)
            facing = dot(seen.normal, toward).abs()
            visible = seen.visibility(source)
            facing = facing if visible is None else facing * visible
            tint = like(source.color, light)
            light = light + tint * (torch.ceil(facing * self.bands) / self.bands)[:, None]
        color = Coloring.of(self.color)(seen) * (self.ambient + (1 - self.ambient) * light)
        return torch.where(self._contour(seen)[:, None], like(self.ink, color), color) if self.contour else color

    def _contour(self, seen: Seen) -> Tensor:
        assert seen.curvatures is not None
        assert seen.principal is not None
        along = dot(seen.principal, seen.direction[:, None]).square()  # (R, 2)
        curvature = (seen.curvatures * along).sum(-1).abs() / along.sum(-1).clamp_min(1e-12)
        bent = (self.contour * curvature).clamp(max=1)
        return dot(seen.normal, seen.direction).abs() < (bent * (2 - bent)).sqrt()


# --- pictures and directions ------------------------------------------------------------------------------------------


def looked_up(picture: Array, u: Tensor, v: Tensor, wrapped: tuple[bool, bool]) -> Tensor:
    """Linear interpolation in a picture (H, W, 3) at u, v (R,) in 0 … 1 (across, down), which go round if `wrapped`."""
    height, width = picture.shape[:2]
    picture = as_tensor(picture).to(u)
    x, y = u * width - 0.5, v * height - 0.5
    left, top = x.floor(), y.floor()
    columns, rows = (
        [(first.long() + k) % n if around else (first.long() + k).clamp(0, n - 1) for k in range(2)]
        for first, n, around in ((left, width, wrapped[0]), (top, height, wrapped[1]))
    )
    above, below = (torch.lerp(picture[r, columns[0]], picture[r, columns[1]], (x - left)[:, None]) for r in rows)
    return torch.lerp(above, below, (y - top)[:, None])


def _across(axis: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors at right angles to a unit vector and each other."""
    other = torch.zeros_like(axis)
    other[int(axis.abs().argmin())] = 1
    first = safe_normalize(torch.linalg.cross(axis, other))
    return first, torch.linalg.cross(axis, first)


def check_opacity(opacity: float) -> None:
    """Raises ValueError unless it is from 0 to 1."""
    if not 0 <= opacity <= 1:
        raise ValueError(f"opacity must be from 0 to 1; got {opacity!r}")


def _check_direction(name: str, vector: Sequence[float]) -> None:
    given = as_numbers(vector)
    if given.shape != (3,) or not given.isfinite().all() or not given.any():
        raise ValueError(f"{name} must be three finite numbers, not all zero; got {vector!r}")


def check_picture(name: str, picture: Array) -> None:
    """Raises ValueError unless it is (H, W, 3)."""
    picture = as_tensor(picture)
    if not isinstance(picture, Tensor) or picture.ndim != 3 or picture.shape[-1] != 3 or 0 in picture.shape:
        raise ValueError(
            f"{name} must be a picture (H, W, 3) of linear RGB; got {tuple(getattr(picture, 'shape', ()))}"
        )
