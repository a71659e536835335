"""Ray casting of surfaces: hits, then what is known of the surface there, then materials; no stepping.

    rays ─▶ spans in the domain ─▶ hits, one or k sheets ─▶ point, normal, curvature ─▶ material ─▶ over background

Rays begin where they enter the domain (and the region): t is measured from near what is hit, not from the eye.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple, TypedDict, Unpack, overload

import torch
from torch import Tensor

from filterlab.ops.reference.optics import dot
from filterlab.render.camera import Camera
from filterlab.render.image import (
    CENTER,
    Canvas,
    PixelRays,
    Place,
    Progress,
    View,
    as_view,
    check_background,
    device_of,
    reporting,
)
from filterlab.render.materials import Material, Phong, Seen
from filterlab.render.rays import Region, Spans, check_region, jitter, spans
from filterlab.render.scenery import Around, Block, Haze, Water
from filterlab.render.shading import Light, like
from filterlab.render.silhouettes import COUNTED, Eye, Silhouettes, swept
from filterlab.surfaces.base import Hits, Surface, SurfacePoints, check_sheets

_PART = 1 << 15  # rays at a time; what they meet is cut up further by the surface
_MOST_SUBPIXELS = 64

CHANNELS = {"color": 4, "depth": 1, "normal": 3, "position": 3, "sheets": 1}
"""What can be asked of a pixel, and how many numbers it is."""

_FRONTAL = (Light(),)


@dataclass(frozen=True)
class Casting:
    """What is cast, and how; see `raycast`."""

    surface: Surface
    material: Material
    lights: tuple[Light, ...]
    background: Tensor | Around
    region: Region | None
    sheets: int
    shadows: bool
    dtype: torch.dtype
    haze: Haze | None = None
    water: Water | None = None
    block: Block | None = None

    def __call__(self, origins: Tensor, directions: Tensor, channels: Sequence[str]) -> Tensor:
        """The channels of rays (R, 3), side by side (R, width)."""
        inside = spans(origins, directions, self.surface.domain, self.region)
        hits = self._hits(inside)
        needed = self.material.order if "color" in channels else 1
        at = self.surface.at(inside.entry.to(self.dtype), directions.to(self.dtype), hits, needed)
        parts = {
            "color": lambda: self._color(at, hits, origins, directions),
            "depth": lambda: _depth(origins, directions, at, hits),
            "normal": lambda: _first(at.normal),
            "position": lambda: _first(at.point),
            "sheets": lambda: hits.valid.sum(-1, keepdim=True).to(self.dtype),
        }
        return torch.cat([parts[name]() for name in channels], -1)

    def eye(self, seen: PixelRays, channels: Sequence[str]) -> Eye:
        """The same, for finding edges in those channels; in float64, or both sides of one would be the same ray."""
        exact = replace(self, dtype=torch.float64)
        searching = replace(exact, surface=self.surface.detached)  # nothing is recorded of a search
        counting = replace(searching, sheets=COUNTED)
        watching = searching if self.sheets == 1 else counting
        radiance = lambda o, d: exact(o, d, channels)  # noqa: E731
        return Eye(self.surface, self.region, seen.rays, counting._hits, watching._hits, radiance)

    def _hits(self, inside: Spans) -> Hits:
        """Those within the spans: t (R, k) from where rays enter."""
        entry, direction = (x.to(self.dtype) for x in (inside.entry, inside.direction))
        if self.sheets == 1:
            hits = self.surface.hit(entry, direction).as_sheets()
        else:
            hits = self.surface.hits(entry, direction, self.sheets)
        length = inside.length.detach().to(self.dtype)[:, None]
        slack = 8 * torch.finfo(self.dtype).eps * self.surface.domain.diagonal
        return hits.where((length > 0) & (hits.t.detach() <= length + slack))

    def _color(self, at: SurfacePoints, hits: Hits, origins: Tensor, directions: Tensor) -> Tensor:
        """Sheets in front of each other, from the eye on, over the background: RGB and opacity (R, 4)."""
        valid = hits.valid
        seen = self._seen(at, hits, directions)
        colors = at.point.new_zeros(at.point.shape).index_put((valid,), self.material(seen, self.lights))
        layers = Layers(
            colors, self.material.opacity * valid.to(colors), self._distances(at, valid, origins, directions)
        )
        if self.water is not None:
            layers = self._flooded(layers, self.water, origins, directions)
        if self.block is not None:
            layers = self._walled(layers, self.block, origins, directions)
        if self.haze is not None:
            layers = layers._replace(color=self.haze(layers.color, layers.distance))
        rgb, passing = at.point.new_zeros(len(valid), 3), at.point.new_ones(len(valid), 1)
        for k in range(self.sheets):
            opacity = layers.opacity[:, k, None]
            rgb, passing = rgb + passing * opacity * layers.color[:, k], passing * (1 - opacity)
        return torch.cat((rgb + passing * self._behind(directions.to(rgb)), 1 - passing), -1)

    def _behind(self, directions: Tensor) -> Tensor:
        """Of the background: (3,), or (R, 3) where it depends on directions."""
        return self.background.to(directions) if isinstance(self.background, Tensor) else self.background(directions)

    def _distances(self, at: SurfacePoints, valid: Tensor, origins: Tensor, directions: Tensor) -> Tensor:
        """(R, k): world distances along unit rays, 0 where nothing is hit; they are asked by haze and water alone."""
        if self.haze is None and self.water is None and self.block is None:
            return at.point.new_zeros(valid.shape)
        distance = dot(at.point.double() - origins[:, None], directions[:, None])
        return torch.where(valid, distance, 0).to(at.point)

    def _flooded(self, layers: Layers, water: Water, origins: Tensor, directions: Tensor) -> Layers:
        """The same where water covers it: what the water mirrors, and the ground through it."""
        lower, upper = self._box
        crossing = water.crossing(origins, directions, lower, upper)
        ground = torch.where(layers.opacity[:, 0] > 0, layers.distance[:, 0].double(), torch.inf)
        wet = (crossing.distance < ground).nonzero()[:, 0]
        if not len(wet):
            return layers
        face, own = crossing.distance[wet], layers.color[wet, 0]
        point = origins[wet] + face[:, None] * directions[wet]
        mirrored = directions[wet] * directions.new_tensor((1, 1, -1))
        dry = replace(self, water=None)
        around = dry(point, mirrored, ("color",))[:, :3]
        share = crossing.share[wet, None].to(own)
        color = share * around + (1 - share) * water.through(own, (ground[wet] - face).to(own))
        return layers.with_first(wet, color, face)

    def _walled(self, layers: Layers, block: Block, origins: Tensor, directions: Tensor) -> Layers:
        """The same where the walls of the block are in front: earth, and water where that stands at them."""
        lower, upper = self._box
        distance = block.entry(origins, directions, lower, upper)
        at = distance.isfinite().nonzero()[:, 0]
        points = origins[at] + distance[at, None] * directions[at]
        inside = self.surface.detached.jet(points, 0)[0] < 0
        color = block.lit(points, self.lights, lower, upper)
        if self.water is not None:
            under = ~inside & (points[:, 2] < self.water.level)
            color = torch.where(under[:, None], like(self.water.color, color), color)
            inside = inside | under
        return layers.with_first(at[inside], color[inside], distance[at][inside])

    @property
    def _box(self) -> tuple[list[float], list[float]]:
        """Least and greatest x, y, z of the domain."""
        lower, upper = self.surface.domain.corners().aminmax(dim=0)
        return lower.tolist(), upper.tolist()

    def _seen(self, at: SurfacePoints, hits: Hits, directions: Tensor) -> Seen:
        assert at.normal is not None
        valid = hits.valid
        direction = directions.to(self.dtype)[:, None].expand_as(at.point)[valid]
        point, normal = at.point[valid], at.normal[valid]
        curved = (None, None) if at.curvatures is None else (at.curvatures[valid], at.principal[valid])  # type: ignore[index]
        toward_eye = torch.where(dot(normal, direction)[:, None] > 0, -normal, normal).detach()
        lifted = point.detach() + self.surface.clearance(hits)[valid][:, None].to(point) * toward_eye

        def visibility(light: Light) -> Tensor | None:
            if not self.shadows or light.direction is None:  # a headlight shines wherever the eye sees
                return None
            toward = light.toward(point).detach().expand_as(point)
            return (~self.surface.met(lifted, toward)).to(point)

        return Seen(point, normal, direction, *curved, visibility)


class Layers(NamedTuple):
    """What a ray meets, from the eye on: colours (R, k, 3), opacities and world distances (R, k)."""

    color: Tensor
    opacity: Tensor
    distance: Tensor

    def with_first(self, rays: Tensor, color: Tensor, distance: Tensor) -> Layers:
        """The same with something opaque in front, of so many rays (M,): colours (M, 3) and distances (M,)."""
        put = lambda rows, new: rows.index_put((rays, torch.zeros_like(rays)), new.to(rows))  # noqa: E731
        solid = torch.ones_like(distance)
        return Layers(put(self.color, color), put(self.opacity, solid), put(self.distance, distance))


def _first(rows: Tensor | None) -> Tensor:
    assert rows is not None
    return rows[:, 0]


def _depth(origins: Tensor, directions: Tensor, at: SurfacePoints, hits: Hits) -> Tensor:
    """(R, 1): world distances along unit rays, ∞ where nothing is hit."""
    depth = dot(at.point[:, 0].double() - origins, directions)
    return torch.where(hits.valid[:, 0], depth, torch.inf).to(at.point)[:, None]


class Options(TypedDict, total=False):
    """Keywords of `raycast` that its result has the same type with."""

    size: Sequence[int] | None
    lights: Sequence[Light]
    background: Sequence[float] | Tensor | Around
    haze: Haze | None
    water: Water | None
    block: Block | None
    region: Region | None
    sheets: int
    shadows: bool
    subpixels: int
    silhouettes: Silhouettes | None
    seed: int
    dtype: torch.dtype
    device: torch.device | str | None
    progress: Progress


@overload
def raycast(
    surface: Surface, camera: View, material: Material | None = ..., *, channels: None = ..., **options: Unpack[Options]
) -> Tensor: ...


@overload
def raycast(
    surface: Surface,
    camera: View,
    material: Material | None = ...,
    *,
    channels: Sequence[str],
    **options: Unpack[Options],
) -> dict[str, Tensor]: ...


def raycast(
    surface: Surface,
    camera: View,
    material: Material | None = None,
    *,
    size: Sequence[int] | None = None,
    lights: Sequence[Light] = _FRONTAL,
    background: Sequence[float] | Tensor | Around = (0.0, 0.0, 0.0),
    haze: Haze | None = None,
    water: Water | None = None,
    block: Block | None = None,
    region: Region | None = None,
    sheets: int = 1,
    shadows: bool = False,
    subpixels: int = 1,
    silhouettes: Silhouettes | None = None,
    seed: int = 0,
    channels: Sequence[str] | None = None,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str | None = None,
    progress: Progress = False,
) -> Tensor | dict[str, Tensor]:
    """The image of a surface, hit exactly.

    Args:
        surface: a level set, or whatever else rays can hit.
        camera: a Camera, or (origins, directions) `(..., 3)` world rays.
        material: what turns hits into colour; default `Phong()`.
        size: (width, height) of the image; only with a Camera.
        lights: all of them; default a white headlight.
        background: linear RGB behind the surface, which may require grad; or a function of unit directions (R, 3), such
            as a `Sky()` or the `around` of an `Environment`.
        haze: what distance does to colours, but not to the background; None: nothing.
        water: a flat face of water within the domain's x and y, which mirrors the surface and the background; None:
            none. It is in the colour only: other channels are those of the surface. One sheet.
        block: walls of earth below a surface that ends at the sides of its domain; None: it is as thin as it is. In the
            colour only, too.
        region: a world-space box (lower, upper): what lies outside is cut away.
        sheets: how many hits of a ray are composited, in exact order; 1 unless the material is transparent.
        shadows: whether a second ray to every light that is no headlight asks what stands in between.
        subpixels: s: every pixel is the mean of s² rays, one at a place drawn in each of s × s parts of it.
        silhouettes: how the edges of what is seen are looked for, whose motion is then part of the derivatives; None:
            it is not. The image is the same. Edges are those of `filterlab.render.silhouettes`: not those of shadows,
            nor where a material or a normal jumps on the surface.
        seed: of those places and lines, which depend on it and the pixel's number alone.
        channels: some of `CHANNELS`, each as a tensor of its own: `color`; `depth`, the world distance, ∞ where nothing
            is hit; `normal` and `position`, of the first hit, 0 where none; `sheets`, how many were hit.
        dtype: float32 or float64, of hits and image.
        device: where to compute; default where the camera or the rays are.
        progress: True shows a progress bar on stderr, None only if that is a terminal; or a function (done, total).

    Returns:
        `(H, W, 4)` (or `(..., 4)` for rays): linear RGB over the background, and opacity. With `channels` a dictionary
        of `(H, W, n)`. Differentiable in whatever the surface, camera, lights, material and background depend on: a
        pixel's hit moves. It comes and goes only with `silhouettes`, of which there are first derivatives.

    Raises:
        TypeError: no surface, camera, material or silhouettes; silhouettes of a surface that cannot
            tell where its pieces end. ValueError: numbers
            out of range, channels that are not known, more than one ray a pixel for other channels than the colour,
            silhouettes of rays without a camera.
    """
    camera = as_view(camera)
    _check(surface, material, sheets, subpixels, channels, dtype, camera)
    _check_silhouettes(silhouettes, surface, camera)
    device = torch.device(device or device_of(camera) or "cpu")
    seen = PixelRays.of(camera, size, device)
    asked = ("color",) if channels is None else tuple(channels)
    cast = Casting(
        surface,
        material or Phong(),
        tuple(lights),
        background if callable(background) else check_background(background, device),
        None if region is None else check_region(region),
        sheets,
        shadows,
        dtype,
        haze,
        water,
        block,
    )
    if sheets > 1 and (water is not None or block is not None):
        raise ValueError(f"water and block go with one sheet, of an opaque surface; got {sheets} sheets")
    at_once = max(sheets, silhouettes.lines * silhouettes.parts if silhouettes else 1)
    canvas = Canvas(seen, None, torch.is_grad_enabled(), sum(CHANNELS[name] for name in asked))
    with reporting(progress, seen.count) as report:

        def parts() -> Iterator[tuple[int, range, Tensor]]:
            for order in seen.parts(max(_PART // at_once, 1)):
                yield 0, order, _mean(cast, seen, order, asked, subpixels, silhouettes, seed)
                report(order.stop)

        image = canvas.filled(parts(), torch.zeros(0, dtype=dtype, device=device))
    if channels is None:
        return image
    widths = [CHANNELS[name] for name in asked]
    return dict(zip(asked, image.split(widths, -1), strict=True))


def _mean(
    cast: Casting,
    seen: PixelRays,
    order: range,
    asked: Sequence[str],
    subpixels: int,
    silhouettes: Silhouettes | None,
    seed: int,
) -> Tensor:
    """Of all rays of some pixels, with the derivatives of their edges."""
    pixels = seen.pixels(order)
    total = torch.zeros((), dtype=cast.dtype, device=pixels.device)
    for place in _places(pixels, subpixels, seed):
        total = total + cast(*seen.rays(pixels, place), asked)
    mean = total / subpixels**2
    if silhouettes is None or not torch.is_grad_enabled():
        return mean
    return mean + swept(silhouettes, cast.eye(seen, asked), pixels, seed).to(mean)


def _places(pixels: Tensor, subpixels: int, seed: int) -> Iterator[Place]:
    """Where the rays of each pixel go through it: one place in each of its s × s parts."""
    if subpixels == 1:
        yield CENTER
        return
    for k in range(subpixels**2):
        across, down = (jitter(seed, pixels * (2 * subpixels**2) + 2 * k + axis) for axis in range(2))
        yield (k % subpixels + across) / subpixels, (k // subpixels + down) / subpixels


def _check(
    surface: Surface,
    material: Material | None,
    sheets: int,
    subpixels: int,
    channels: Sequence[str] | None,
    dtype: torch.dtype,
    camera: object,
) -> None:
    if not isinstance(surface, Surface):
        raise TypeError(f"surface must be a Surface, such as a LevelSet(field, level); got {type(surface).__name__}")
    if not isinstance(material, Material | None):
        raise TypeError(f"material must be a Material, or None for Phong(); got {type(material).__name__}")
    check_sheets(sheets)
    if not isinstance(subpixels, int) or not 1 <= subpixels**2 <= _MOST_SUBPIXELS:
        raise ValueError(f"subpixels must be an integer from 1 to 8, of rays per pixel and axis; got {subpixels!r}")
    if subpixels > 1 and not isinstance(camera, Camera):
        raise ValueError("subpixels go with a camera; rays bring their own places")
    if dtype not in (torch.float32, torch.float64):
        raise ValueError(f"dtype must be torch.float32 or torch.float64; got {dtype}")
    unknown = [name for name in channels or () if name not in CHANNELS]
    if unknown or (channels is not None and not channels):
        raise ValueError(f"channels must be some of {', '.join(CHANNELS)}; got {channels!r}")
    if subpixels > 1 and channels is not None and set(channels) != {"color"}:
        raise ValueError("one ray a pixel for other channels than the colour: depths and normals have no mean")


def _check_silhouettes(silhouettes: Silhouettes | None, surface: Surface, camera: object) -> None:
    if not isinstance(silhouettes, Silhouettes | None):
        raise TypeError(f"silhouettes must be Silhouettes(lines, parts), or None; got {type(silhouettes).__name__}")
    if silhouettes is not None and not isinstance(camera, Camera):
        raise ValueError("silhouettes go with a camera: rays alone have no pixels that edges could sweep over")
    if silhouettes is not None and surface.in_pieces and not surface.tells_ends:
        raise TypeError(f"silhouettes need a surface that tells where its pieces end; got {type(surface).__name__}")
