"""Rays and the part of them that lies inside a field's domain, cut into segments.

A ray is o + t d with a unit direction d, so t is a world distance. Rays and distances are float64.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from filterlab.fields.base import Domain

Region = tuple[Sequence[float], Sequence[float]]

# so small a part of a direction's largest component is no motion: over any distance that float64 resolves, it stays put
_NO_MOTION = 1e-30


def check_rays(origins: Tensor, directions: Tensor) -> tuple[Tensor, Tensor]:
    """Origins and unit directions in float64, `(..., 3)` each; differentiable.

    Raises:
        TypeError: not two real tensors.
        ValueError: shapes that are not equal and (..., 3); a number that is not finite; a zero direction.
    """
    for name, x in (("origins", origins), ("directions", directions)):
        if not isinstance(x, Tensor) or not x.dtype.is_floating_point:
            found = getattr(x, "dtype", type(x).__name__)
            raise TypeError(f"{name} must be a floating-point torch.Tensor or NumPy array; got {found}")
    if origins.shape != directions.shape or origins.ndim == 0 or origins.shape[-1] != 3:
        raise ValueError(
            "origins and directions must have the same shape (..., 3) in x, y, z order; "
            f"got {tuple(origins.shape)} and {tuple(directions.shape)}"
        )
    for name, x in (("origins", origins), ("directions", directions)):
        if not x.detach().isfinite().all():
            raise ValueError(f"{name} must be finite; {int((~x.detach().isfinite()).any(-1).sum())} rays are not")
    directions = directions.double()
    largest = directions.detach().abs().amax(-1, keepdim=True)
    if not (largest > 0).all():
        raise ValueError(f"directions must not be zero; {int((largest == 0).sum())} rays have none")
    directions = directions / largest  # neither huge nor tiny ones leave the range of their squares
    x, y, z = directions.unbind(-1)
    return origins.double(), directions / (x * x + y * y + z * z).sqrt()[..., None]


def check_region(region: Region) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """A world-space box ((x, y, z) lower, (x, y, z) upper). Raises ValueError unless lower < upper along every axis."""
    try:
        lower, upper = (tuple(float(c) for c in corner) for corner in region)
        fine = len(lower) == len(upper) == 3 and all(a < b for a, b in zip(lower, upper, strict=True))
    except (TypeError, ValueError, OverflowError):
        fine, lower, upper = False, (), ()
    if not fine:
        raise ValueError(
            f"region must be two world corners (lower, upper) with lower < upper in x, y, z; got {region!r}"
        )
    return lower, upper  # type: ignore[return-value]


def slab(origins: Tensor, directions: Tensor, lower: Sequence[float], upper: Sequence[float]) -> tuple[Tensor, Tensor]:
    """Distances t between which o + t d lies in the closed box, `(...)` each, for rays `(..., 3)` and box in one frame.

    t_near = max_d min((l_d − o_d)/δ_d, (u_d − o_d)/δ_d), t_far = min_d max(…), δ the direction. An axis along which
    the ray does not move gives (−∞, ∞) inside or on the faces and (∞, −∞) outside; no NaN arises. Empty where
    t_far ≤ t_near. Differentiable in both.

    Source: Kay & Kajiya, Ray tracing complex scenes, 1986.
    """
    x, y, z = (direction.detach().abs() for direction in directions.unbind(-1))  # whole triples are slow
    least = _NO_MOTION * torch.maximum(torch.maximum(x, y), z)
    axes = [_slab(origins[..., d], directions[..., d], least, lower[d], upper[d]) for d in range(3)]
    (near, far), *others = axes
    for other_near, other_far in others:
        near, far = torch.maximum(near, other_near), torch.minimum(far, other_far)
    return near, far


def _slab(origin: Tensor, direction: Tensor, least: Tensor, low: float, high: float) -> tuple[Tensor, Tensor]:
    """The same of one axis, along which up to the `least` motion is none."""
    still = direction.abs() <= least
    inside = (origin >= low) & (origin <= high)
    speed = torch.where(still, 1.0, direction)
    a, b = (low - origin) / speed, (high - origin) / speed
    empty = torch.where(inside, -torch.inf, torch.inf).to(direction.dtype)  # t_near without motion; t_far is −t_near
    return torch.where(still, empty, torch.minimum(a, b)), torch.where(still, -empty, torch.maximum(a, b))


def intersect(
    origins: Tensor, directions: Tensor, domain: Domain, region: Region | None = None
) -> tuple[Tensor, Tensor]:
    """World distances t_near ≥ 0 and t_far between which rays `(..., 3)` are inside the domain (and the region).

    The domain's box is cut in voxel coordinates, where it is axis-aligned however its geometry turns, stretches or
    flips it; `region` is a box in the world. Nothing behind the origin is seen: from inside, t_near = 0. A ray that
    misses has t_far ≤ t_near. Differentiable in origins and directions.
    """
    geometry = domain.geometry
    near, far = slab(geometry.to_voxel(origins), geometry.direction_to_voxel(directions), domain.lower, domain.upper)
    if region is not None:
        region_near, region_far = slab(origins, directions, *check_region(region))
        near, far = torch.maximum(near, region_near), torch.minimum(far, region_far)
    return near.clamp_min(0), far


class Spans(NamedTuple):
    """The parts of rays in a domain: entries `(R, 3)`, unit directions `(R, 3)`, lengths `(R,)`; 0: it misses."""

    entry: Tensor
    direction: Tensor
    length: Tensor


def spans(origins: Tensor, directions: Tensor, domain: Domain, region: Region | None = None) -> Spans:
    """Where rays enter the domain (and the region), and how long they are inside; differentiable in both."""
    near, far = intersect(origins, directions, domain, region)
    hit = far.detach() > near.detach()
    length = torch.where(hit, far - near, torch.zeros_like(far))
    near = torch.where(hit, near, torch.zeros_like(near))
    return Spans(origins + near[:, None] * directions, directions, length)


def segment_count(length: Tensor, step: float, offset: Tensor | float = 1.0) -> Tensor:
    """How many segments a length is cut into, `(...)` float64: 0 for an empty one, else 1 + ⌈length/step − offset⌉."""
    count = 1 + torch.ceil(length.detach() / step - offset).clamp_min(0)
    return torch.where(length.detach() > 0, count, torch.zeros_like(count))


_MASK = 0xFFFFFFFF


def _mix(x: Tensor) -> Tensor:
    """A 32-bit integer hash in int64: products wrap, their low 32 bits are right. Source: Wellons, hash-prospector."""
    x = x ^ (x >> 16)
    x = (x * 0x7FEB352D) & _MASK
    x = x ^ (x >> 15)
    x = (x * 0x846CA68B) & _MASK
    return x ^ (x >> 16)


def jitter(seed: int, pixels: Tensor) -> Tensor:
    """One uniform number in (0, 1) per pixel number `(R,)`, float64: a hash of (seed, pixel) and of nothing else."""
    if not isinstance(seed, int) or isinstance(seed, bool) or not 0 <= seed < 2**63:
        raise ValueError(f"jitter_seed must be an integer from 0 to 2⁶³ − 1; got {seed!r}")
    x = torch.zeros_like(pixels)
    for word in (seed & _MASK, seed >> 32, pixels >> 32, pixels & _MASK):
        x = _mix((x ^ word) + 0x9E3779B9 & _MASK)
    return (x.double() + 0.5) / 2**32
