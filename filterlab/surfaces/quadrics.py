"""Quadrics: many surfaces of second order, each where its bounds are, hit exactly along rays.

Every one is a function of its own, F(x) = y·A y + 2 b·y + c with y = x − o from an origin o, and a piece of the
surface: hits tell which. F > 0 is outside. Rays are solved from near what they hit, by root formulas in which nothing
cancels (`ops.quadrics`, `ops.reference.quadrics`), in float64 whatever the type of the rays.

| case | what is a hit |
|---|---|
| F = 0 within the bounds, edges included | one hit, a front where F goes from + to − along the ray, else a back |
| a ray touches, meets the apex of a cone or a double plane | one hit, a front, if within the rounding of α, β, γ |
| a ray lies on the surface | one hit, a front, where it enters the bounds |
| A = 0, or the ray is parallel to an asymptote | the one root that is left |
| a ray begins inside, or on the surface | as any other; t = 0 where F(o) = 0 within rounding |
| two quadrics at one place | two hits; the first is any of them |
| the gradient is 0 there, as at an apex | a hit with normal 0 and no derivatives |
"""

from __future__ import annotations

import copy
from collections.abc import Sequence

import torch
from torch import Tensor

from filterlab.fields.base import Field
from filterlab.ops import quadrics as description
from filterlab.surfaces import culling
from filterlab.surfaces import quadric_kinds as kinds
from filterlab.surfaces.bounds import Bounds, check_rows
from filterlab.surfaces.in_tree import InTree, domain_around

_ROUNDINGS = 16  # of the largest coordinate, by which bounds are larger: neighbours that share a face leave no gap


class Quadrics(InTree[description.Quadrics]):
    """Surfaces y·A y + 2 b·y + c = 0, y = x − o, each within its bounds.

    Args:
        A: (M, 3, 3), float32 or float64; of another one than a symmetric matrix the symmetric part counts.
        b: (M, 3). c: (M,). Differentiable, as A is.
        bounds: `Spheres(centers, radii)`, `Tetrahedra(corners)` or `Planes(halfspaces)`, of as many.
        origins: o (M, 3), in the world; None: its origin. Coefficients about a point nearby keep digits that those far
            away have lost. Differentiable.
        cuts: (M, K, 4) or (M, 4): n, d of more halfspaces n·x + d ≤ 0 that are kept, as at sharp edges.
        faces: which hits count: "front", from F > 0 to F < 0 along the ray, "back", or "both".

    Memory: 188 bytes of working data and index for each, and 32 for each plane. It is built at the first hit, and again
    when numbers were changed in place.

    Raises:
        TypeError, ValueError: no such tensors, or of other lengths or devices; numbers that are not finite; A and b
            that are both 0, of which nothing is a surface.
    """

    tells_ends = True

    def __init__(
        self,
        A: Tensor,
        b: Tensor,
        c: Tensor,
        bounds: Bounds,
        origins: Tensor | None = None,
        *,
        cuts: Tensor | None = None,
        faces: str = "both",
    ) -> None:
        if not isinstance(bounds, Bounds):
            raise TypeError(f"bounds must be Spheres, Tetrahedra or Planes; got {type(bounds).__name__}")
        if faces not in description.FACES:
            raise ValueError(f"faces must be one of {', '.join(description.FACES)}; got {faces!r}")
        count = len(bounds)
        self.A, self.b = check_rows("A", A, (count, 3, 3)), check_rows("b", b, (count, 3))
        self.c = check_rows("c", c, (count,))
        self.origins = b.new_zeros(count, 3) if origins is None else check_rows("origins", origins, (count, 3))
        self.bounds, self.faces = bounds if cuts is None else bounds.cut(cuts), faces
        self._check()
        self.domain = domain_around(self.bounds.boxes, self.bounds.radii)

    def _check(self) -> None:
        if not len(self):
            raise ValueError("quadrics must be at least one; got none")
        places = {x.device for x in (*self.tensors, self.bounds.centers)}
        if len(places) > 1:
            raise ValueError(f"quadrics and their bounds must be on one device; got {', '.join(map(str, places))}")
        nothing = (self.A.detach() == 0).flatten(1).all(1) & (self.b.detach() == 0).all(1)
        if n := int(nothing.sum()):
            raise ValueError(f"A and b must not both be 0, or F is constant; of {n} of {len(self)} quadrics they are")

    def __len__(self) -> int:
        return len(self.bounds)

    def __repr__(self) -> str:
        return f"Quadrics({self.bounds!r}, faces={self.faces!r})"

    # --- kinds ---

    @classmethod
    def ellipsoids(cls, centers: Tensor, semi_axes: Tensor, *, faces: str = "both") -> Quadrics:
        """Ellipsoids {x = p + L u, |u| = 1}: F = |L⁻¹ (x − p)|² − 1.

        Args:
            centers: p (M, 3), in the world.
            semi_axes: (M,) radii of balls, (M, 3) half lengths along x, y, z, or L (M, 3, 3), whose columns are half
                axes, or anything that maps the unit ball: √D of a diffusion tensor D. World units.
            faces: as of `Quadrics`.

        Differentiable in both. Raises TypeError, ValueError: no such tensors; a semi-axis that is not positive; an L
        that flattens space.
        """
        return cls(*kinds.ellipsoids(centers, semi_axes), faces=faces)

    @classmethod
    def cylinders(
        cls, starts: Tensor, ends: Tensor, radii: Tensor, *, caps: bool = False, faces: str = "both"
    ) -> Quadrics:
        """Round tubes between two points: F = |P y|² / ρ² − 1, y from the middle, P y its part across the axis.

        Args:
            starts, ends: (M, 3) middles of both ends, in the world.
            radii: ρ (M,), in world units.
            caps: whether ends are closed by discs: pieces M … 2 M − 1 at the starts, 2 M … 3 M − 1 at the ends.
            faces: as of `Quadrics`.

        Differentiable in all three; where a tube ends has none. Raises TypeError, ValueError: no such tensors; a radius
        that is not positive; a start that is the end.
        """
        parts = [kinds.cylinders(starts, ends, radii)]
        parts += [kinds.discs(starts, starts - ends, radii), kinds.discs(ends, ends - starts, radii)] if caps else []
        return cls(*kinds.joined(parts), faces=faces)

    @classmethod
    def cones(
        cls, apexes: Tensor, bases: Tensor, radii: Tensor, *, caps: bool = False, faces: str = "both"
    ) -> Quadrics:
        """Round cones: F = |P y|² / ρ² − (a·y / h)², y from the apex, a the unit axis, h the height.

        Args:
            apexes, bases: (M, 3), the tips and the middles of the circles they widen to, in the world.
            radii: ρ (M,) of the circles, in world units.
            caps: whether circles are closed by discs: pieces M … 2 M − 1.
            faces: as of `Quadrics`.

        Differentiable and raises as `cylinders`.
        """
        parts = [kinds.cones(apexes, bases, radii)]
        parts += [kinds.discs(bases, bases - apexes, radii)] if caps else []
        return cls(*kinds.joined(parts), faces=faces)

    @classmethod
    def paraboloids(
        cls, apexes: Tensor, bases: Tensor, radii: Tensor, *, caps: bool = False, faces: str = "both"
    ) -> Quadrics:
        """Round paraboloids: F = |P y|² / ρ² − a·y / h; arguments as of `cones`."""
        parts = [kinds.paraboloids(apexes, bases, radii)]
        parts += [kinds.discs(bases, bases - apexes, radii)] if caps else []
        return cls(*kinds.joined(parts), faces=faces)

    @classmethod
    def of_level_set(cls, field: Field, level: float, *, faces: str = "both") -> Quadrics:
        """The level set of a quadratic super spline as quadrics in its tetrahedra: F = f − level.

        Args:
            field: of the method `qss`, unbatched.
            level: a finite number.
            faces: as of `Quadrics`; outside is where values are greater, as of a `LevelSet`, which shows the same and
                stores nothing for it.

        Where a piece is on the level everywhere nothing is hit. Raises TypeError, ValueError: another field; a level
        that no piece has. No derivatives in what the field is made of: a `LevelSet` has them.

        Source: Stoll, Gumhold & Seidel, Incremental raycasting of piecewise quadratic surfaces on the GPU, 2006,
        sections 5 and 6.
        """
        return cls(*kinds.level_set(field, level), faces=faces)

    @classmethod
    def joined(cls, parts: Sequence[Quadrics]) -> Quadrics:
        """All in one surface; pieces are numbered one part after the other. Raises ValueError: faces that differ."""
        faces = {part.faces for part in parts}
        if len(faces) != 1:
            raise ValueError(
                f"quadrics that are joined must show the same faces; got {', '.join(sorted(faces)) or None}"
            )
        given = [kinds.Kind(part.A, part.b, part.c, part.bounds, part.origins) for part in parts]
        return cls(*kinds.joined(given), faces=faces.pop())

    # --- what a surface is ---

    def jet(self, points: Tensor, order: int, piece: Tensor | None = None) -> tuple[Tensor, ...]:
        """F, 2 (A y + b) and 2 A of the quadrics numbered by `piece` (...)."""
        if piece is None:
            raise ValueError("each quadric has a function of its own; expected which one as piece, got None")
        A, b, c, origin = (x[piece].double() for x in self.tensors)
        A, y = (A + A.mT) / 2, points.double() - origin
        turned = (A * y[..., None, :]).sum(-1)
        derivatives = (y * (turned + 2 * b)).sum(-1) + c, 2 * (turned + b), 2 * A
        return tuple(x.to(points.dtype) for x in derivatives[: order + 1])

    def ends(self, points: Tensor, piece: Tensor) -> Tensor:
        """Distances (..., 1 + H) from the balls and planes that bound the quadrics numbered by `piece` (...)."""
        return self.bounds.distances(points.double(), piece)

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        return self.A, self.b, self.c, self.origins

    def with_tensors(self, tensors: Sequence[Tensor]) -> Quadrics:
        other = copy.copy(self)
        other.A, other.b, other.c, other.origins = tensors
        other.bounds = self.bounds.to(other.A.device)
        other._built = None
        return other

    @property
    def device(self) -> torch.device:
        return self.bounds.centers.device

    # --- what is cast ---

    def _described(self) -> description.Quadrics:
        bounds, slack = self.bounds, self._slack
        planes = bounds.planes.clone()
        planes[..., 3] += (planes[..., :3] * bounds.centers[:, None]).sum(-1) - slack
        return description.Quadrics.of(
            bounds.boxes, self._about_centers(), bounds.centers, bounds.radii + slack, planes, self.faces
        )

    @property
    def _slack(self) -> float:
        """By how much bounds are larger."""
        lower, upper = self.bounds.boxes.around()
        return _ROUNDINGS * torch.finfo(torch.float64).eps * float(torch.maximum(lower.abs(), upper.abs()).amax())

    def _about_centers(self) -> tuple[Tensor, Tensor, Tensor]:
        """A, b, c in float64, about the centres of the bounds."""
        A, b, c, origin = (x.detach().double() for x in self.tensors)
        A, y = (A + A.mT) / 2, self.bounds.centers - origin
        turned = (A * y[:, None]).sum(-1)
        return A, b + turned, c + (y * (turned + 2 * b)).sum(-1)

    def seen_from(self, eye: Tensor) -> Quadrics:
        """For rays from a world point (3,): the same hits, without the quadrics that show it no face that counts.

        What faces a point is on one side of its polar plane. Where a ball or a tetrahedron lies on the other side, or F
        has one sign in what is left of it, the quadric is left out; cuts are not looked at (`surfaces.culling`).
        Numbers stay. With faces "both" nothing is left out. It takes as long as some frames gain: for many rays from
        one place.

        Source: Stoll, Gumhold & Seidel, Incremental raycasting of piecewise quadratic surfaces on the GPU, 2006,
        equations 16 to 19.
        """
        if self.faces == "both":
            return self
        return self._casting(self.described.some(self.facing(eye)))

    def facing(self, eye: Tensor) -> Tensor:
        """(M,) whether some point within the bounds may show the side that counts to a world point (3,)."""
        bounds, sign = self.bounds, 1 if self.faces == "front" else -1
        corners = None if bounds.corners is None else bounds.corners - bounds.centers[:, None]
        A, b, c = self._about_centers()
        local = culling.Local(sign * A, sign * b, sign * c, bounds.radii, corners)
        return culling.facing(local, eye.detach().to(bounds.centers) - bounds.centers, self._slack)
