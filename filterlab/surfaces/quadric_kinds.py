"""Quadrics by what they look like: coefficients about a point of each, and bounds that are as near as they can be.

Letters: a the unit axis, P y = y − (a·y) a the part of y at right angles with it, ρ a radius, h a height. F has no
unit: it is −1 on the axis of a tube, 0 at a tip. Coefficients are differentiable in what they are made of; bounds are
not.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from filterlab.bernstein import multi_indices
from filterlab.fields.base import Field
from filterlab.fields.tetrahedral_pieces import FieldOnTetrahedra
from filterlab.ops.tree import Boxes
from filterlab.surfaces.bounds import Bounds, Tetrahedra, check_positive, check_rows

_ROOM = 1.01  # what fits in a ball is not cut by it
_FLAT = 1e-12  # of the product of half axes, a volume that is none


class Kind(NamedTuple):
    """Arguments of `Quadrics`."""

    A: Tensor
    b: Tensor
    c: Tensor
    bounds: Bounds
    origins: Tensor


class _Axis(NamedTuple):
    """Of round things: a (M, 3), h (M, 1), a aᵀ and P (M, 3, 3)."""

    along: Tensor
    height: Tensor
    outer: Tensor
    across: Tensor

    @classmethod
    def between(cls, starts: Tensor, ends: Tensor) -> _Axis:
        way = ends - starts
        height = way.norm(dim=1, keepdim=True)
        along = way / height
        outer = along[:, :, None] * along[:, None]
        return cls(along, height, outer, torch.eye(3, dtype=way.dtype, device=way.device) - outer)


def ellipsoids(centers: Tensor, semi_axes: Tensor) -> Kind:
    """See `Quadrics.ellipsoids`."""
    centers = check_rows("centers", centers, (None, 3))
    shape = (len(centers), 3, 3)
    given = check_rows("semi_axes", semi_axes, shape[: getattr(semi_axes, "ndim", 0)] or (None,))
    if given.ndim < 3:
        check_positive("semi_axes", given)
        given = torch.diag_embed(given[:, None].expand(-1, 3) if given.ndim == 1 else given)
    flat = torch.linalg.det(given.detach()).abs() <= _FLAT * given.detach().norm(dim=1).prod(1)
    if n := int(flat.sum()):
        raise ValueError(f"semi_axes must span space; {n} of {len(given)} do not")
    inverse = torch.linalg.inv(given)
    wide = (given @ given.mT).detach().double()
    reach = wide.diagonal(dim1=1, dim2=2).sqrt()
    radii = wide.abs().sum(2).amax(1).sqrt()
    p = centers.detach().double()
    bounds = Bounds(p, _ROOM * radii, boxes=Boxes(p - reach, p + reach))
    return Kind(inverse.mT @ inverse, torch.zeros_like(centers), -torch.ones_like(centers[:, 0]), bounds, centers)


def cylinders(starts: Tensor, ends: Tensor, radii: Tensor) -> Kind:
    """See `Quadrics.cylinders`."""
    axis = _checked_axis(starts, ends, radii, ("starts", "ends"))
    boxes = _around(_circle(starts, axis, radii), _circle(ends, axis, radii))
    bounds = _between(starts, ends, radii, boxes).cut(_planes(starts, ends, both=True))
    c = -torch.ones_like(radii)
    return Kind(axis.across / radii[:, None, None] ** 2, torch.zeros_like(starts), c, bounds, (starts + ends) / 2)


def cones(apexes: Tensor, bases: Tensor, radii: Tensor) -> Kind:
    """See `Quadrics.cones`."""
    axis = _checked_axis(apexes, bases, radii, ("apexes", "bases"))
    A = axis.across / radii[:, None, None] ** 2 - axis.outer / axis.height[..., None] ** 2
    boxes = _around(_point(apexes), _circle(bases, axis, radii))
    bounds = _between(apexes, bases, radii, boxes).cut(_planes(apexes, bases, both=True))
    return Kind(A, torch.zeros_like(apexes), torch.zeros_like(radii), bounds, apexes)


def paraboloids(apexes: Tensor, bases: Tensor, radii: Tensor) -> Kind:
    """See `Quadrics.paraboloids`."""
    axis = _checked_axis(apexes, bases, radii, ("apexes", "bases"))
    place = apexes.detach().double()
    around = _circle(bases, axis, radii)
    # the whole circle, moved to the apex: the bowl is wider near its rim than a cone
    boxes = _around(_circle(apexes, axis, radii), around, _point(place))
    bounds = _between(apexes, bases, radii, boxes).cut(_planes(apexes, bases, both=False))
    A = axis.across / radii[:, None, None] ** 2
    return Kind(A, -axis.along / (2 * axis.height), torch.zeros_like(radii), bounds, apexes)


def discs(centers: Tensor, normals: Tensor, radii: Tensor) -> Kind:
    """Flat discs: F = n·y / ρ, n the unit normal, towards F > 0."""
    along = normals / normals.norm(dim=1, keepdim=True)
    lower, upper = _circle(centers, _Axis.between(torch.zeros_like(along), along), radii)
    bounds = Bounds(centers.detach().double(), radii.detach().double(), boxes=Boxes(lower, upper))
    A = along.new_zeros(len(along), 3, 3)
    return Kind(A, along / (2 * radii[:, None]), torch.zeros_like(radii), bounds, centers)


def level_set(field: Field, level: float) -> Kind:
    """See `Quadrics.of_level_set`."""
    if not isinstance(field, FieldOnTetrahedra) or (spline := field.scheme.spline).degree != 2 or spline.period != 1:
        raise TypeError(f"quadrics are the pieces of quadratic super splines (method 'qss'); got {field!r}")
    if not math.isfinite(level):
        raise ValueError(f"level must be a finite number; got {level!r}")
    corners, coefficients = field.relevant_tetrahedra(level)
    some = (coefficients != coefficients[:, :1]).any(1)
    corners, coefficients = corners[some], coefficients[some]
    if not len(corners):
        raise ValueError(f"no piece of this field has the level {level:g}")
    place = {alpha: n for n, alpha in enumerate(multi_indices(2, 3))}
    unit = [tuple(int(i == k) for i in range(4)) for k in range(4)]
    pairs = [[place[tuple(a + b for a, b in zip(p, q, strict=True))] for q in unit] for p in unit]
    blossom = coefficients[:, pairs]  # f = λ·B λ
    rows = torch.linalg.inv((corners[:, 1:] - corners[:, :1]).mT)
    slopes = torch.cat((-rows.sum(1, keepdim=True), rows), 1)  # λ = ¼ + slopes y, y from the middle
    along = (blossom[..., None] * slopes[:, None]).sum(2)
    A = (slopes[:, :, :, None] * along[:, :, None]).sum(1)
    return Kind(A, along.sum(1) / 4, blossom.sum((1, 2)) / 16 - level, Tetrahedra(corners), corners.mean(1))


def joined(parts: Sequence[Kind]) -> Kind:
    """One after the other."""
    A, b, c, origins = (torch.cat([getattr(part, name) for part in parts]) for name in ("A", "b", "c", "origins"))
    return Kind(A, b, c, Bounds.joined([part.bounds for part in parts]), origins)


def _checked_axis(starts: Tensor, ends: Tensor, radii: Tensor, names: tuple[str, str]) -> _Axis:
    count = len(check_rows(names[0], starts, (None, 3)))
    check_rows(names[1], ends, (count, 3))
    check_positive("radii", check_rows("radii", radii, (count,)))
    if n := int((starts.detach() == ends.detach()).all(1).sum()):
        raise ValueError(f"{names[0]} and {names[1]} must differ; {n} of {count} do not")
    return _Axis.between(starts, ends)


def _between(starts: Tensor, ends: Tensor, radii: Tensor, boxes: Boxes) -> Bounds:
    """Balls about the middles, which hold circles at both ends."""
    a, b, r = (x.detach().double() for x in (starts, ends, radii))
    return Bounds((a + b) / 2, _ROOM * torch.hypot((b - a).norm(dim=1) / 2, r), boxes=boxes)


def _planes(starts: Tensor, ends: Tensor, both: bool) -> Tensor:
    """(M, 2, 4), or (M, 1, 4): at right angles with the axis, at the ends, or at the last."""
    a, b = starts.detach().double(), ends.detach().double()
    along = torch.nn.functional.normalize(b - a, dim=1)
    last = torch.cat((along, -(along * b).sum(1, keepdim=True)), 1)
    first = torch.cat((-along, (along * a).sum(1, keepdim=True)), 1)
    return torch.stack((first, last) if both else (last,), 1)


def _point(place: Tensor) -> tuple[Tensor, Tensor]:
    return place.detach().double(), place.detach().double()


def _circle(center: Tensor, axis: _Axis, radii: Tensor) -> tuple[Tensor, Tensor]:
    """Lower and upper corners of the box around it."""
    reach = (1 - axis.along**2).clamp_min(0).sqrt() * radii[:, None]
    reach, center = reach.detach().double(), center.detach().double()
    return center - reach, center + reach


def _around(*boxes: tuple[Tensor, Tensor]) -> Boxes:
    lower, upper = zip(*boxes, strict=True)
    return Boxes(torch.stack(lower).amin(0), torch.stack(upper).amax(0))
