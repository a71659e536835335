"""What a ray can hit: the zeros of a function F, what is known of them, and how they move.

Letters: a ray is o + t d, t ≥ 0, with d of any length, so t is in units of d; g = ∇F.

A hit is found without derivatives and gets them from F(o + t d) = 0: with the slope s = g·d

    dt = −(dF + g·do + t g·dd) / s,    dF by whatever numbers F is made of, at the hit

which is evaluated once more, at a hit with derivatives, where derivatives of it are asked in turn: so they are exact to
any order, and t keeps its bits. Backward passes keep the rays and t; they cost a gather, a pull and a splat. Of
surfaces that cannot tell their numbers two steps of Newton's method are recorded instead, t ← t − F(o + t d) / s, each
right to one more order. s is the derivative of F along the ray itself, whatever a field gives as its gradient. Where it
is 0, at tangents, a hit has no derivative, and gets 0. The same where it is not known: at hits beside what is missing.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from filterlab.arrays import Array, as_tensor
from filterlab.fields.base import Domain, check_order, type_of_rays
from filterlab.ops.differentiable import hit_points, vectors
from filterlab.ops.differentiable.recording import plain, transforming
from filterlab.ops.reference.hit_points import along, chosen, length, spread

MAX_SHEETS = 4096
_STEPS = 2  # of Newton's method: derivatives up to the second
_FAR = 64  # diameters of the domain from which on o + t d is polished
_BESIDE = 1e-3  # voxels from a hit, along its ray, to where derivatives are looked for that are none at it
_LIFT = 1e-3  # voxels by which a ray to a light begins in front of the surface
_POLISH = 1e-3  # of a voxel, by at most: rays that are nearly tangents turn the rounding of o + t d into long ways


@dataclass(frozen=True)
class Hits:
    """Where rays meet a surface.

    Attributes:
        t: (...) in units of each ray's direction, ∞ where there is none; differentiable.
        piece: (...) int64, which piece of the surface is hit, −1 where none is; None: it has no pieces.
        blend: (..., 6) float64, of what a hit is blended, as `surfaces.slim` says; None: it is of no more than one.
    """

    t: Tensor
    piece: Tensor | None = None
    blend: Tensor | None = None

    @property
    def valid(self) -> Tensor:
        """(...) bool."""
        return self.t.detach() < torch.inf

    def places(self) -> Tensor:
        """(M,) int64, the flat places in t of rays that hit, ascending; `valid` need not be made for it."""
        t = self.t.detach()
        return torch.from_numpy(np.flatnonzero(t.numpy() < np.inf)) if t.device.type == "cpu" else _where(self.valid)

    def where(self, kept: Tensor) -> Hits:
        """Those of a mask that broadcasts to (...), none elsewhere."""
        piece = None if self.piece is None else torch.where(kept, self.piece, -1)
        return replace(self, t=torch.where(kept, self.t, torch.inf), piece=piece)

    def as_sheets(self) -> Hits:
        """(..., 1): the same as one sheet of hits."""
        piece = None if self.piece is None else self.piece[..., None]
        return Hits(self.t[..., None], piece, None if self.blend is None else self.blend[..., None, :])

    def of_rays(self, shape: Sequence[int], dtype: torch.dtype) -> Hits:
        """In another shape and type, without derivatives."""
        piece = None if self.piece is None else self.piece.reshape(tuple(shape))
        blend = None if self.blend is None else self.blend.detach().reshape(*shape, self.blend.shape[-1])
        return Hits(self.t.detach().reshape(tuple(shape)).to(dtype), piece, blend)

    def at(self, index: Tensor) -> Hits:
        """Those (M,) at flat places."""
        rows = (None if x is None else x.flatten().index_select(0, index) for x in (self.t, self.piece))
        return Hits(*rows, None if self.blend is None else self.blend.flatten(0, -2).index_select(0, index))  # type: ignore[arg-type]

    def with_at(self, index: Tensor, hits: Hits) -> Hits:
        """The same, with other t and blends at flat places."""
        t = self.t.flatten().index_copy(0, index, hits.t).reshape(self.t.shape)
        if self.blend is None or hits.blend is None:
            return replace(self, t=t)
        blend = self.blend.flatten(0, -2).index_copy(0, index, hits.blend).reshape(self.blend.shape)
        return replace(self, t=t, blend=blend)


class SurfacePoints(NamedTuple):
    """What is known of a surface where rays hit it; 0 where they don't.

    Attributes:
        point: (..., 3), in the world.
        gradient: ∇F (..., 3) per world unit, as the field gives it, and 0 where that is NaN; None for order 0.
        normal: ∇F / |∇F| (..., 3), towards greater values; 0 where the gradient is.
        curvatures: κ₁ ≥ κ₂ (..., 2) per world unit: along a principal direction v the normal n turns by ∂n/∂v = κ v, so
            that a ball of greater values than around it has −1/r twice; None below order 2.
        principal: v₁, v₂ (..., 2, 3), unit vectors, at right angles with each other and the normal.
    """

    point: Tensor
    gradient: Tensor | None = None
    normal: Tensor | None = None
    curvatures: Tensor | None = None
    principal: Tensor | None = None


class Surface(ABC):
    """The zeros of a function in a domain, or of one function for each of many pieces.

    Attributes:
        domain: the box that the surface lies in.
        max_order: of derivatives of F: 2 where curvatures can be given.
        in_pieces: whether F is another one for every piece: then hits tell theirs.
        tells_ends: whether `ends` is known of the pieces, as edges of images need.
    """

    domain: Domain
    max_order: int
    in_pieces: bool = False
    tells_ends: bool = False

    @property
    def device(self) -> torch.device | None:
        """Where what it was built from is; None: it is computed wherever the rays are."""
        return None

    @abstractmethod
    def jet(self, points: Tensor, order: int, piece: Tensor | None = None) -> tuple[Tensor, ...]:
        """F, and its gradient and Hessian up to an order, at world points (..., 3); of a piece for each, (...)."""

    def ends(self, points: Tensor, piece: Tensor) -> Tensor:
        """What no point of a piece has above 0: distances (..., K) of world points (..., 3) from what bounds theirs,
        (...), negative within; differentiable as hits are."""
        raise TypeError(f"{type(self).__name__} cannot tell where its pieces end")

    @property
    @abstractmethod
    def detached(self) -> Surface:
        """The same surface, of numbers that no derivatives are asked by: searching it records nothing."""

    @property
    def tensors(self) -> tuple[Tensor, ...] | None:
        """All numbers that F is made of and may have derivatives by; None: it cannot tell."""
        return None

    def with_tensors(self, tensors: Sequence[Tensor]) -> Surface:
        """The same surface, made of others in place of `tensors`."""
        raise TypeError(f"{type(self).__name__} cannot tell its tensors")

    @abstractmethod
    def _first(self, origins: Tensor, directions: Tensor) -> Hits:
        """The first hits (...) of rays (..., 3)."""

    @abstractmethod
    def _sheets(self, origins: Tensor, directions: Tensor, sheets: int, farthest: bool) -> Hits:
        """The first hits (..., sheets) of rays (..., 3) in order, or the last ones from the last on; or (R, sheets)."""

    def hit(self, origins: Array, directions: Array) -> Hits:
        """The first hit of every ray in the domain, t ≥ 0.

        Args:
            origins: world points (..., 3), float32 or float64.
            directions: (..., 3), of any length but 0; the leading axes broadcast.

        Returns:
            t (...), in the type of the rays. Differentiable twice in the rays and in whatever F depends on.

        Raises:
            TypeError, ValueError: no such rays: another type or shape, numbers that are not finite, no direction.
        """
        origins, directions = check_rays(origins, directions)
        return self._attached(self._searched(origins, directions), origins, directions)

    def met(self, origins: Array, directions: Array) -> Tensor:
        """Whether rays hit it at all, (...) bool; arguments and errors as for `hit`. Nothing is recorded."""
        return self._searched(*check_rays(origins, directions)).valid

    def hits(self, origins: Array, directions: Array, sheets: int, farthest: bool = False) -> Hits:
        """The first `sheets` hits of every ray in order; the last ones, from the last on, where `farthest`.

        Args:
            origins, directions: as for `hit`.
            sheets: k, at most `MAX_SHEETS`.

        Returns:
            t (..., k), ∞ where there are no more. Differentiable as that of `hit`.

        Raises:
            TypeError, ValueError: as `hit`; another number of sheets.
        """
        check_sheets(sheets)
        origins, directions = check_rays(origins, directions)
        found = self.detached._sheets(origins.detach(), directions.detach(), sheets, farthest)
        found = found.of_rays((*origins.shape[:-1], sheets), origins.dtype)
        return self._attached(found, origins[..., None, :], directions[..., None, :])

    def clearance(self, hit: Hits) -> Tensor:
        """How far off a hit (...) a ray to a light begins, in world units."""
        return torch.full_like(hit.t.detach(), _LIFT * self.domain.voxel_size)

    def at(self, origins: Array, directions: Array, hit: Hits, order: int = 1) -> SurfacePoints:
        """What is known of the surface at hits.

        Args:
            origins, directions: the rays (..., 3).
            hit: theirs: t (...), or (..., k) of k sheets.
            order: 0 points, 1 with gradients and normals, 2 with curvatures.

        Returns:
            tensors of the shape of t and their own. Differentiable as hit.t is: hits found without derivatives have
            none here either.

        Raises:
            ValueError: an order that the field cannot give; hits of other rays.
        """
        check_order(order, self.max_order)
        origins, directions = _broadcast(origins, directions)
        shape, rays = hit.t.shape, origins.shape[:-1]
        if shape == (*rays, *shape[len(rays) :]) and len(shape) == len(rays) + 1:
            origins, directions = origins[..., None, :], directions[..., None, :]
        elif shape != rays:
            raise ValueError(f"hits of rays {tuple(rays)} have t of that shape, or (..., k); got {tuple(shape)}")
        if self.in_pieces and hit.piece is None:
            raise ValueError(f"hits of {type(self).__name__} tell which piece is hit; got hits with piece=None")
        index = hit.places()
        if order == 1 and self._is_plain(origins, directions, hit):
            found = self._at_once(origins, directions, hit, index)
            if found is not None:
                return found
        o, d = chosen(index, shape, origins, directions)
        rows = self._known(o, d, hit.at(index), order)
        return SurfacePoints(*spread([row for row in rows if row is not None], index, shape))

    def _is_plain(self, origins: Tensor, directions: Tensor, hit: Hits) -> bool:
        """Whether no derivative is asked."""
        if not origins.numel() or not plain(origins, directions, hit.t):
            return False
        return not torch.is_grad_enabled() or not self._asked(origins, directions)

    def _at_once(self, origins: Tensor, directions: Tensor, hit: Hits, index: Tensor) -> SurfacePoints | None:
        """What is known up to order 1, of rows of hits that are made, and brought to the rays, in one pass each.

        None: some ray begins far away, or some gradient is not known, beside what is missing.
        """
        point, far = hit_points.points(origins, directions, hit.t, index, self._reach)
        if far:
            return None
        piece = None if hit.piece is None else hit.piece.flatten().index_select(0, index)
        found = hit_points.by_rays(index, hit.t.shape, point, self.jet(point, 1, piece)[1])
        return None if found.unknown else SurfacePoints(*found[:3])

    def _known(self, origins: Tensor, directions: Tensor, hit: Hits, order: int) -> SurfacePoints:
        """What is known at hits (M,) of rays (M, 3)."""
        point = self._polished(origins, directions, hit.t, hit.piece)
        return (
            geometry(point, self._derivatives(point, directions, order, hit.piece)) if order else SurfacePoints(point)
        )

    def _derivatives(self, points: Tensor, directions: Tensor, order: int, piece: Tensor | None) -> tuple[Tensor, ...]:
        """Gradient, and Hessian, at hits (M, 3); where they are NaN, beside what is missing, just before or behind."""
        rows = self.jet(points, order, piece)[1:]
        unknown = _unknown(rows)
        if not bool(unknown.any()):
            return rows
        apart = directions.detach() * (_BESIDE * self.domain.voxel_size / directions.detach().norm(dim=-1))[:, None]
        for step in (-apart, apart):
            points = torch.where(unknown[:, None], points + step, points)
            unknown = _unknown(self.detached.jet(points.detach(), order, piece)[1:])
            points = torch.where(unknown[:, None], points - step, points)
        known = _where(~unknown)  # 0 · NaN is NaN: the others must not be in the graph
        own = None if piece is None else piece.index_select(0, known)
        rows = self.jet(points.index_select(0, known), order, own)[1:]
        return tuple(row.new_zeros(len(points), *row.shape[1:]).index_copy(0, known, row) for row in rows)

    def _searched(self, origins: Tensor, directions: Tensor) -> Hits:
        """First hits (...) in the type of the rays, without derivatives."""
        found = self.detached._first(origins.detach(), directions.detach())
        return found.of_rays(origins.shape[:-1], origins.dtype)

    def _value(self, points: Tensor, piece: Tensor | None) -> Tensor:
        return self.jet(points, 0, piece)[0]

    def _differentiated(
        self, points: Tensor, piece: Tensor | None, tensors: Sequence[Tensor] | None = None
    ) -> tuple[Tensor, Tensor]:
        """F at points (M, 3), to be differentiated by its tensors (or these in their place), and its true gradient."""
        with torch.enable_grad():
            x = points.detach().requires_grad_()
            value = (self if tensors is None else self.with_tensors(tensors))._value(x, piece)
            (gradient,) = torch.autograd.grad(value.sum(), x, retain_graph=True)
        return value, gradient

    def _slope(self, points: Tensor, directions: Tensor, piece: Tensor | None) -> Tensor:
        return _along_rays(self._differentiated(points, piece)[1], directions.detach())

    def _attached(self, hit: Hits, origins: Tensor, directions: Tensor) -> Hits:
        """The same hits, with derivatives."""
        if not torch.is_grad_enabled() or not (transforming() or self._asked(origins, directions)):
            return hit
        index = hit.places()
        if not len(index) or not self._follows(index[:1], hit, origins, directions):
            return hit
        o, d = chosen(index, hit.t.shape, origins, directions)
        return hit.with_at(index, self._moving(o, d, hit.at(index)))

    def _asked(self, *rays: Tensor) -> bool:
        """Whether derivatives are asked by rays, or by what the surface is made of, as far as it can tell."""
        tensors = self.tensors
        return tensors is None or any(x.requires_grad for x in (*rays, *tensors))

    def _follows(self, index: Tensor, hit: Hits, origins: Tensor, directions: Tensor) -> bool:
        """Whether those hits move with anything that derivatives are asked by."""
        o, d = chosen(index, hit.t.shape, origins, directions)
        own = hit.at(index)
        return self._value(along(o, d, own.t), own.piece).requires_grad

    def _moving(self, origins: Tensor, directions: Tensor, hit: Hits) -> Hits:
        """Hits (M,) of rays (M, 3), with derivatives."""
        tensors = None if transforming() else self.tensors
        if tensors is None:
            return replace(hit, t=self._stepped(origins, directions, hit.t, hit.piece))
        return replace(hit, t=_Attached.apply(self, hit.piece, hit.t, origins, directions, *tensors))

    def _stepped(self, origins: Tensor, directions: Tensor, t: Tensor, piece: Tensor | None) -> Tensor:
        """t (M,) with the derivatives of steps of Newton's method."""
        slope = self._slope(along(origins, directions, t), directions, piece)
        for _ in range(_STEPS):
            value = self._value(along(origins, directions, t), piece)
            t = t - torch.where(value.isnan(), 0, value - value.detach()) / slope
        return t

    def _polished(self, origins: Tensor, directions: Tensor, t: Tensor, piece: Tensor | None) -> Tensor:
        """o + t d; far from where rays begin moved along them by what it was rounded by."""
        point = along(origins, directions, t)
        if not len(t) or not self._far_from(origins):
            return point
        far = origins.detach().abs().amax(-1) > self._reach  # t d leads as far, for what is hit is near
        own = None if piece is None else piece[far]
        moved = self.detached._nearer(point.detach()[far], directions.detach()[far], own).detach()
        return point.index_add(0, far.nonzero()[:, 0], moved)

    @property
    def _reach(self) -> float:
        """From the world's origin so far rays begin whose points need not be polished."""
        return _FAR * (self.domain.diagonal + max(map(abs, self.domain.center)))

    def _far_from(self, origins: Tensor) -> bool:
        """Whether any of some rays begins farther away."""
        return vectors.facts(origins).greatest > self._reach

    def _nearer(self, points: Tensor, directions: Tensor, piece: Tensor | None) -> Tensor:
        """By what points (M, 3) come nearer to the surface along rays: steps of Newton's method that lower |F|."""
        most = _POLISH * self.domain.voxel_size / directions.norm(dim=-1)
        moved = torch.zeros_like(points)
        for _ in range(_STEPS):
            value = self._value(points + moved, piece)
            step = -value / self._slope(points + moved, directions, piece)
            new = moved + step.clamp(-most, most)[:, None] * directions
            moved = torch.where((self._value(points + new, piece).abs() < value.abs())[:, None], new, moved)
        return moved


class _Attached(torch.autograd.Function):
    """(surface, piece, t (M,), origins, directions (M, 3), its tensors) -> t, which moves as F(o + t d) = 0 demands."""

    @staticmethod
    def forward(ctx, surface: Surface, piece: Tensor | None, t: Tensor, *moving: Tensor):
        ctx.surface, ctx.piece = surface, piece
        ctx.save_for_backward(t, *moving)
        return t.clone()

    @staticmethod
    def backward(ctx, *cotangents: Tensor):
        t, origins, directions, *tensors = ctx.saved_tensors
        needed = ctx.needs_input_grad[5:]
        if torch.is_grad_enabled():
            t = _Attached.apply(ctx.surface, ctx.piece, t, origins, directions, *tensors)
            tensors = [x.view_as(x) for x in tensors]  # t depends on them as well
            points = along(origins, directions, t)
            value = ctx.surface.with_tensors(tensors)._value(points, ctx.piece)
            (gradient,) = torch.autograd.grad(value.sum(), points, create_graph=True)
        else:
            tensors = [x.detach().requires_grad_(need) for x, need in zip(tensors, needed, strict=True)]
            points = along(origins, directions, t)
            value, gradient = ctx.surface._differentiated(points, ctx.piece, tensors)
        gradient = torch.where(gradient.isnan(), 0, gradient)
        weight = -cotangents[0] / _along_rays(gradient, directions)
        by_rays = weight[:, None] * gradient, (weight * t)[:, None] * gradient
        return None, None, None, *by_rays, *_by_tensors(value, tensors, needed, weight)


def _by_tensors(value: Tensor, tensors: Sequence[Tensor], needed: Sequence[bool], weight: Tensor):
    """Derivatives of Σ weight · value by the tensors that need them, None for the others."""
    if not any(needed):
        return [None] * len(needed)
    inputs = [x for x, need in zip(tensors, needed, strict=True) if need]
    graph = torch.is_grad_enabled()
    found = iter(torch.autograd.grad(value, inputs, weight, create_graph=graph, allow_unused=True))
    return [next(found) if need else None for need in needed]


def _along_rays(gradient: Tensor, directions: Tensor) -> Tensor:
    """s = g·d (M,); 1 / s is 0 where it is 0, or NaN: ∞ stands there."""
    slope = (gradient * directions).sum(-1)
    return torch.where(slope.abs() > 0, slope, torch.inf)


def check_sheets(sheets: int) -> None:
    """Raises ValueError unless so many hits of a ray can be asked for."""
    if isinstance(sheets, bool) or not isinstance(sheets, int) or not 1 <= sheets <= MAX_SHEETS:
        raise ValueError(f"sheets must be an integer from 1 to {MAX_SHEETS}; got {sheets!r}")


def check_rays(origins: Array, directions: Array) -> tuple[Tensor, Tensor]:
    """Both (..., 3), broadcast, in promote(origins, directions, float32). Raises what `Surface.hit` says."""
    origins, directions = as_tensor(origins), as_tensor(directions)
    rays = _broadcast(origins, directions)
    known = {"origins": vectors.facts(origins), "directions": vectors.facts(directions)}
    for name, x in (("origins", origins), ("directions", directions)):
        if not known[name].finite:
            wrong = int((~x.detach().isfinite()).any(-1).sum())
            raise ValueError(f"{name} must be finite; {wrong} rays are not")
    if known["directions"].none:
        none = int((directions.detach() == 0).all(-1).sum())
        raise ValueError(f"directions must not be zero; {none} rays have none")
    return rays


def _broadcast(origins: Array, directions: Array) -> tuple[Tensor, Tensor]:
    """The same; whatever their numbers are."""
    origins, directions = as_tensor(origins), as_tensor(directions)
    for name, x in (("origins", origins), ("directions", directions)):
        if not isinstance(x, Tensor) or not x.dtype.is_floating_point:
            found = x.dtype if isinstance(x, Tensor) else type(x).__name__
            raise TypeError(f"{name} must be a floating-point torch.Tensor or NumPy array; got {found}")
        if x.ndim == 0 or x.shape[-1] != 3:
            raise ValueError(f"{name} must have shape (..., 3) in x, y, z order; got {tuple(x.shape)}")
    dtype = type_of_rays(origins, directions)
    try:
        o, d = torch.broadcast_tensors(origins.to(dtype), directions.to(dtype))
    except RuntimeError:
        raise ValueError(
            "origins and directions must have shapes (..., 3) that broadcast; "
            f"got {tuple(origins.shape)} and {tuple(directions.shape)}"
        ) from None
    return o, d


def _where(mask: Tensor) -> Tensor:
    """Places of what is true in the flat mask; numpy finds them in a tenth of torch's time."""
    flat = mask.flatten()
    return torch.from_numpy(np.flatnonzero(flat.numpy())) if flat.device.type == "cpu" else flat.nonzero()[:, 0]


def _unknown(rows: Sequence[Tensor]) -> Tensor:
    """(M,) whether any number of rows (M, …) is NaN."""
    return torch.stack([row.detach().flatten(1).isnan().any(1) for row in rows]).any(0)


# --- the geometry of a level set --------------------------------------------------------------------------------------


def geometry(point: Tensor, derivatives: tuple[Tensor, ...]) -> SurfacePoints:
    gradient, *hessian = derivatives
    size = length(gradient)
    normal = gradient / size[..., None]
    if not hessian:
        return SurfacePoints(point, gradient, normal)
    return SurfacePoints(point, gradient, normal, *_curvatures(normal, hessian[0] / size[..., None, None]))


def _curvatures(normal: Tensor, hessian: Tensor) -> tuple[Tensor, Tensor]:
    """(κ₁, κ₂) (M, 2) and v₁, v₂ (M, 2, 3) from n and H / |g|: eigenvalues and -vectors of H on the tangent plane.

    With a, b, c the entries of H in a basis of it: κ = (a + c)/2 ± r, r = hypot((a − c)/2, b), and v₁ at half the angle
    of ((a − c)/2, b). Where r = 0 every direction is principal; the basis is returned, with derivative 0.
    """
    first, second = _tangents(normal)
    bend = lambda u, v: (u[..., :, None] * hessian * v[..., None, :]).sum((-2, -1))  # noqa: E731
    a, b, c = bend(first, first), bend(first, second), bend(second, second)
    middle, x = (a + c) / 2, (a - c) / 2
    square = x * x + b * b
    round_ = square == 0
    r = torch.where(round_, 0, torch.where(round_, 1, square).sqrt())
    angle = torch.where(round_, 0, torch.atan2(torch.where(round_, 0, b), torch.where(round_, 1, x)) / 2)
    cos, sin = angle.cos()[..., None], angle.sin()[..., None]
    principal = torch.stack((cos * first + sin * second, cos * second - sin * first), -2)
    return torch.stack((middle + r, middle - r), -1), principal


def _tangents(normal: Tensor) -> tuple[Tensor, Tensor]:
    """Two unit vectors at right angles to a unit vector and each other.

    Source: Duff et al., Building an orthonormal basis, revisited, JCGT 2017.
    """
    x, y, z = normal.unbind(-1)
    sign = torch.where(z < 0, -1.0, 1.0).to(normal)
    a = -1 / (sign + z)
    b = x * y * a
    first = torch.stack((1 + sign * x * x * a, sign * b, -sign * x), -1)
    return first, torch.stack((b, sign + y * y * a, -y), -1)
