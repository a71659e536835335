"""What can be seen from a place of a terrain: viewsheds and horizons, by rays at the spline itself.

On a round earth the ground falls off below the horizontal plane through the observer, by d² / (2 R) at a distance d;
light that is bent downwards by refraction shows k of that less: heights count as h − (1 − k) d² / (2 R), and sight is
straight. Splines that reproduce quadratic polynomials follow that exactly; c2 without prefilter is off by one number
everywhere, observer included; linear by (1 − k) m² / (8 R) at most, for steps of m.

Source: the correction for curvature and refraction of levelling, as GIS apply it, with k = 0.13 (Gauss).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Protocol

import torch
from torch import Tensor

from filterlab.arrays import Array, as_tensor
from filterlab.ops.differentiable import height_hits as ops
from filterlab.ops.height_hits import HeightHits

EARTH_RADIUS = 6_371_008.8
"""Mean radius of the earth, in metres."""

REFRACTION = 0.13
"""k: by what part refraction straightens the earth."""

NEAR = 1e-9  # of the way to a target: what is hit that late is the target's own ground
_RAYS_AT_ONCE = 1 << 20
_HALVINGS = 60  # of the angle from the nadir to the zenith


class Terrain(Protocol):
    """What is asked of a `HeightField`, which says what each is."""

    heights: Tensor

    @property
    def places(self) -> Tensor: ...
    @property
    def cast(self) -> HeightHits: ...
    @property
    def device(self) -> torch.device: ...
    @property
    def detached(self) -> Any: ...
    def with_tensors(self, tensors: Sequence[Tensor]) -> Any: ...
    def jet(self, points: Array, order: int) -> tuple[Tensor, ...]: ...


def viewshed(
    surface: Terrain,
    observer: Array | Sequence[float],
    height: float,
    target: float,
    points: Array | None,
    earth_radius: float | None,
    refraction: float,
    implementation: str | None = None,
) -> Tensor:
    """`HeightField.viewshed`; `implementation` as of `ops.differentiable.height_hits.first`."""
    place = _observer(surface, observer)
    ground = _lowered(surface, place, earth_radius, refraction)
    eye = _above(ground, place, height)
    places = surface.places if points is None else as_tensor(points)
    flat = places.detach().double().reshape(-1, 2)
    parts = [_seen(ground, eye, part, target, implementation) for part in flat.split(_RAYS_AT_ONCE)]
    return torch.cat(parts).reshape(places.shape[:-1]) if parts else flat.new_zeros(places.shape[:-1], dtype=torch.bool)


def _seen(ground: Terrain, eye: Tensor, places: Tensor, target: float, implementation: str | None) -> Tensor:
    """(P,) of places (P, 2)."""
    aim = torch.cat((places, (ground.jet(places, 0)[0] + target)[:, None]), 1)
    way = aim - eye
    known = way.isfinite().all(1)
    here = (way == 0).all(1)
    way = torch.where((known & ~here)[:, None], way, 1)
    t = ops.first(ground.cast, eye.expand_as(way), way, implementation)
    return known & (here | (t >= 1 - NEAR))


def horizon(
    surface: Terrain,
    observer: Array | Sequence[float],
    azimuths: Array | Sequence[float],
    height: float,
    earth_radius: float | None,
    refraction: float,
    implementation: str | None = None,
) -> Tensor:
    """`HeightField.horizon`; `implementation` as of `ops.differentiable.height_hits.met`."""
    place = _observer(surface, observer)
    ground = _lowered(surface, place, earth_radius, refraction)
    eye = _above(ground, place, height)
    azimuths = torch.as_tensor(azimuths, dtype=torch.float64).detach().to(surface.device)
    turn = azimuths.reshape(-1)
    low, high = torch.full_like(turn, -math.pi / 2), torch.full_like(turn, math.pi / 2)
    for _ in range(_HALVINGS):
        middle = (low + high) / 2
        flat = middle.cos()
        way = torch.stack((flat * turn.sin(), flat * turn.cos(), middle.sin()), -1)
        met = ops.met(ground.cast, eye.expand_as(way), way, implementation)
        low, high = torch.where(met, middle, low), torch.where(met, high, middle)
    return ((low + high) / 2).reshape(azimuths.shape)


def _observer(surface: Terrain, observer: Array | Sequence[float]) -> Tensor:
    place = torch.as_tensor(observer, dtype=torch.float64)
    if place.shape != (2,):
        raise ValueError(f"observer must be x, y in the world, of shape (2,); got {tuple(place.shape)}")
    place = place.detach().to(surface.device)
    if not bool(surface.jet(place, 0)[0].isfinite()):
        raise ValueError(f"observer must stand on the ground; got {place.tolist()}, in a hole")
    return place


def _above(ground: Terrain, place: Tensor, height: float) -> Tensor:
    return torch.cat((place, ground.jet(place, 0)[0][None] + height))


def _lowered(surface: Terrain, place: Tensor, earth_radius: float | None, refraction: float) -> Terrain:
    """The ground as it appears from a place, in float64; the same one of a flat earth."""
    if earth_radius is None:
        return surface.detached
    if not earth_radius > 0:
        raise ValueError(f"earth_radius must be positive, in units of the heights; got {earth_radius!r}")
    square = ((surface.places - place) ** 2).sum(-1)
    return surface.with_tensors((surface.heights.detach().double() - (1 - refraction) / (2 * earth_radius) * square,))
