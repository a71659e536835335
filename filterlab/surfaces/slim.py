"""SLIM surfaces: local quadrics in balls that overlap, blended along rays into one smooth surface.

Quadric i is Fᵢ(x) = y·A y + 2 b·y + c = 0, y = x − pᵢ from the centre pᵢ of its ball of radius rᵢ, with Fᵢ > 0 outside.
A ray hits those that show it their outsides at tᵢ, xᵢ, with unit normals nᵢ. Of these hits

    t = Σ wᵢ tᵢ / Σ wᵢ,    n ∝ Σ wᵢ nᵢ,    wᵢ = w(|xᵢ − pᵢ| / rᵢ)

over all up to min (tᵢ + `offset` · rᵢ): the first that is seen, if each is moved away from the eye. w is 1 at the
centre and 0 at the end of a ball (`ops.slim`). Hits behind begin the next sheet, which is blended and ends the same
way; pictures, transparency and shadows all ask these sheets.

| case | what is a hit |
|---|---|
| one ball, or balls that do not overlap | the hit of `Quadrics` with faces="front" |
| nearer walls than `offset` of a ball's radius, both seen from outside | one sheet, between both: choose less |
| offset = 0 | no blending: the first hit, as it is |
| fronts and backs, where faces="both" | sheets of their own, in order |
| a ray touches a quadric | a hit of it, a front |
| a hit on the very end of its ball, alone | a hit; beside others it has no weight |

As w is C¹, t and n move smoothly while hits come and go at the ends of balls: derivatives by places and radii are right
too. They are not where cuts end a quadric, or where another sheet comes first.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from filterlab.arrays import Array
from filterlab.fields.base import Domain
from filterlab.ops.differentiable import slim as ops
from filterlab.ops.reference.hit_points import length
from filterlab.ops.reference.slim import weight
from filterlab.ops.slim import Cover, Members
from filterlab.surfaces.base import Hits, Surface, SurfacePoints, geometry
from filterlab.surfaces.bounds import Spheres, check_rows, plane_distances
from filterlab.surfaces.quadrics import Quadrics

_T, _ENDS, _NORMAL = 0, slice(1, 3), slice(3, 6)  # of `Hits.blend`: t, begin and end (`ops.slim`), Σ w n
_LIFTS = {"front": 1e-3, "back": 0.03, "both": 0.03}
_SIDES = {"front": ("front",), "back": ("back",), "both": ("front", "back")}
FACES = tuple(_SIDES)


class Slim(Surface):
    """A cover: quadrics y·A y + 2 b·y + c = 0 in balls, y from their centres, blended where balls overlap.

    Args:
        centers: p (M, 3), in the world, float32 or float64. radii: r (M,), in world units, positive.
        A: (M, 3, 3); of another one than a symmetric matrix the symmetric part counts. b: (M, 3). c: (M,). All five
            are differentiable. F > 0 is outside.
        cuts: (M, K, 4) or (M, 4): n, d of halfspaces n·x + d ≤ 0 of the world that are kept, as at sharp edges.
        offset: of a ball's radius, along the ray, by which what is behind its hit is the same sheet. From 0.25 to 1 a
            torus looks the same.
        faces: "front", what is seen from outside, "back", or "both".

    Memory: 188 bytes of working data and index for each, and 32 for each plane. It is built at the first hit, and again
    when numbers were changed in place.

    Raises:
        TypeError, ValueError: no such tensors, or of other lengths or devices; numbers that are not finite; radii that
            are not positive; A and b that are both 0; an offset below 0; numbers changed in place into such.

    Source: Ohtake, Belyaev & Alexa, Sparse low-degree implicit surfaces with applications to high quality rendering,
    feature extraction, and smoothing, 2005; Stoll, Gumhold & Seidel, Incremental raycasting of piecewise quadratic
    surfaces on the GPU, 2006.
    """

    max_order = 2
    in_pieces = True
    tells_ends = True
    fit: Fit | None = None
    """How well it fits the points it was made for (`fit_slim`); None: it was made of numbers."""
    of_points: Callable[[Array], tuple[Tensor, ...]] | None = None
    """Its tensors when its fits are to other points than those it was made for (`fit_slim`); None: it was made of
    numbers."""

    def __init__(
        self,
        centers: Tensor,
        radii: Tensor,
        A: Tensor,
        b: Tensor,
        c: Tensor,
        *,
        cuts: Tensor | None = None,
        offset: float = 0.5,
        faces: str = "front",
    ) -> None:
        if faces not in FACES:
            raise ValueError(f"faces must be one of {', '.join(FACES)}; got {faces!r}")
        if isinstance(offset, bool) or not isinstance(offset, int | float) or not 0 <= offset < float("inf"):
            raise ValueError(f"offset must be a number from 0 on, of a ball's radius; got {offset!r}")
        self.centers, self.radii = check_rows("centers", centers, (None, 3)), radii
        check_rows("radii", radii, (len(centers),))
        self.A, self.b = check_rows("A", A, (len(centers), 3, 3)), check_rows("b", b, (len(centers), 3))
        self.c, self.cuts = check_rows("c", c, (len(centers),)), cuts
        self.offset, self.faces = float(offset), faces
        self._built: _Built | None = None
        self._now()

    def __len__(self) -> int:
        return len(self.centers)

    def __repr__(self) -> str:
        cut = "" if self.cuts is None else f", cuts={tuple(self.cuts.shape)}"
        return f"Slim({len(self)}{cut}, offset={self.offset:g}, faces={self.faces!r})"

    # --- what a surface is ---

    def jet(self, points: Tensor, order: int, piece: Tensor | None = None) -> tuple[Tensor, ...]:
        """F, 2 (A y + b) and 2 A of the quadrics numbered by `piece` (...), each for itself."""
        return self._local.jet(points, order, piece)

    def ends(self, points: Tensor, piece: Tensor) -> Tensor:
        """Distances (..., 1 + K) from balls, as they are now, and cuts of the quadrics numbered by `piece` (...)."""
        bounds = self._now().local.bounds
        off = (points.double() - self.centers[piece].double()).norm(dim=-1) - self.radii[piece].double()
        return torch.cat((off[..., None], plane_distances(points.double(), bounds.planes[piece])), -1)

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        return self.centers, self.radii, self.A, self.b, self.c

    def with_tensors(self, tensors: Sequence[Tensor]) -> Slim:
        other = copy.copy(self)
        other.centers, other.radii, other.A, other.b, other.c = tensors
        other._built = None
        return other

    def refitted(self, points: Array) -> Slim:
        """The cover of `fit_slim` with its local fits solved again for points that have moved.

        Every graph is again the weighted least-squares fit to its own points, z = h(u, v), weights w(|x − p| / r).
        Held are balls, offset and cuts, which points belong to which graph, and the planes that graphs stand on, so
        that for the points of the fit this is the same cover, and near them a smooth function of them.

        Args:
            points: (N, 3), as many as were fitted and in their order, float32 or float64. Of those that were left out,
                duplicates and strays, nothing depends.

        Returns:
            a `Slim` in float64 on the CPU, with `fit` None. A, b and c are differentiable in the points, twice: so are
            hits, depths, normals. Memory for that is bounded: fits are solved again in backward passes, part by part.

        Raises:
            TypeError: no such points. ValueError: another number of them, or not finite; a cover that was not fitted to
                points, as one that a file holds.
        """
        if self.of_points is None:
            raise ValueError("only covers made by fit_slim know their points; this one was made of numbers")
        other = self.with_tensors(self.of_points(points))
        other.fit = None
        return other

    @property
    def device(self) -> torch.device:
        return self.centers.device

    @property
    def domain(self) -> Domain:  # type: ignore[override]
        """The box around all balls, as they are now."""
        return self._now().local.domain

    @property
    def detached(self) -> Slim:
        other = self.with_tensors([x.detach() for x in self.tensors])
        other._built = self._now()._replace(versions=tuple(x._version for x in other.tensors))
        return other

    def _first(self, origins: Tensor, directions: Tensor) -> Hits:
        found = self._sheets(origins, directions, 1, False)
        assert found.piece is not None
        assert found.blend is not None
        return Hits(found.t[:, 0], found.piece[:, 0], found.blend[:, 0])

    def _sheets(self, origins: Tensor, directions: Tensor, sheets: int, farthest: bool) -> Hits:
        rays = origins.reshape(-1, 3), directions.reshape(-1, 3)
        found = [ops.sheets(side, *rays, sheets, farthest) for side in self.described]
        t, *rest, normal, piece = (torch.cat(rows, 1) for rows in zip(*found, strict=True))
        blend = torch.cat((torch.stack((t, *rest), -1), normal), -1)
        if len(found) > 1:
            key = torch.where(t < torch.inf, -t, torch.inf) if farthest else t
            order = key.argsort(dim=1, stable=True)[:, :sheets]
            t, piece = t.gather(1, order), piece.gather(1, order)
            blend = blend.gather(1, order[..., None].expand(-1, -1, blend.shape[-1]))
        return Hits(t, piece, blend)

    def clearance(self, hit: Hits) -> Tensor:
        """A part of the ball's radius: where backs count, what a hit is blended of has to be behind it."""
        assert hit.piece is not None
        return _LIFTS[self.faces] * self.radii.detach()[hit.piece]

    def seen_from(self, eye: Tensor) -> Slim:
        """For rays from a world point (3,): the same hits, without the quadrics that show it no face that counts.

        As `Quadrics.seen_from`, by the test for balls: for many rays from one place. With faces "both" nothing is left
        out.
        """
        if self.faces == "both":
            return self
        built, other = self._now(), copy.copy(self)
        local = copy.copy(built.local)
        local.faces = self.faces
        kept = local.facing(eye)
        sides = [replace(side, quadrics=side.quadrics.some(kept)) for side in built.sides]
        other._built = built._replace(sides=tuple(sides))
        return other

    # --- what is blended ---

    def _follows(self, index: Tensor, hit: Hits, origins: Tensor, directions: Tensor) -> bool:
        return True

    def _moving(self, origins: Tensor, directions: Tensor, hit: Hits) -> Hits:
        """Hits with the derivatives of all that they are blended of."""
        assert hit.blend is not None
        met = self._met(origins, directions, hit.blend, 1, True)
        normal = met.derivatives[0] / length(met.derivatives[0])[:, None]
        sums = met.sums(len(origins), met.t[:, None], normal)
        t = sums[:, 1] / sums[:, 0]
        t = hit.blend[:, _T] + (t - t.detach())  # it keeps its bits
        blend = torch.cat((t[:, None], hit.blend[:, _ENDS], sums[:, 2:]), 1)
        return replace(hit, t=t.to(hit.t.dtype), blend=blend)

    def _is_plain(self, origins: Tensor, directions: Tensor, hit: Hits) -> bool:
        return False  # gradients at hits are blended

    def _known(self, origins: Tensor, directions: Tensor, hit: Hits, order: int) -> SurfacePoints:
        """The point is on the ray; gradient and Hessian are means of unit normals and of H / |∇F|."""
        if hit.blend is None:
            raise ValueError("hits of Slim tell what they are blended of; got hits with blend=None")
        t, normal = hit.blend[:, _T, None], hit.blend[:, _NORMAL]
        point = (origins.double() + t * directions.double()).to(origins.dtype)
        if not order:
            return SurfacePoints(point)
        rows = [normal / length(normal)[:, None]]
        if order == 2:
            met = self._met(origins, directions, hit.blend, 2, moving=hit.blend.requires_grad)
            gradient, hessian = met.derivatives
            sums = met.sums(len(origins), (hessian / length(gradient)[:, None, None]).flatten(1))
            rows += [(sums[:, 1:] / sums[:, :1]).unflatten(1, (3, 3))]
        return geometry(point, tuple(row.to(point.dtype) for row in rows))

    def _met(self, origins: Tensor, directions: Tensor, blend: Tensor, order: int, moving: bool) -> _Met:
        """All that those of rays (M, 3) are blended of, whose t may have derivatives."""
        members = self._members(origins.detach(), directions.detach(), blend.detach())
        o, d = (x.double()[members.row] for x in (origins, directions))
        own = Hits(members.t, members.piece)
        t = self._local._moving(o, d, own).t if moving else own.t
        points = o + t[:, None] * d
        y = points - self.centers[members.piece].double()
        w = weight((y * y).sum(-1) / self.radii[members.piece].double() ** 2)
        return _Met(members.row, t, w, self._local.jet(points, order, members.piece)[1:])

    def _members(self, origins: Tensor, directions: Tensor, blend: Tensor) -> Members:
        """Hits that those of rays (M, 3) are blended of; all of a sheet face one way."""
        begin, end = blend[:, _ENDS].unbind(1)
        sides = self.described
        if len(sides) == 1:
            return ops.members(sides[0], origins, directions, begin, end)
        back = (blend[:, _NORMAL] * directions).sum(-1) > 0
        own = torch.where(back, -torch.inf, end), torch.where(back, end, -torch.inf)
        found = [ops.members(side, origins, directions, begin, end) for side, end in zip(sides, own, strict=True)]
        return Members(*(torch.cat(rows) for rows in zip(*found, strict=True)))

    # --- what is cast ---

    @property
    def described(self) -> tuple[Cover, ...]:
        """The index and the numbers in it, as they are now, for each side that counts."""
        return self._now().sides

    @property
    def _local(self) -> Quadrics:
        """All quadrics, each for itself, as they are given."""
        return self._now().local.with_tensors((self.A, self.b, self.c, self.centers))

    def _now(self) -> _Built:
        """The index and what is in it, of numbers as they are now."""
        versions = tuple(x._version for x in self.tensors)
        if self._built is None or self._built.versions != versions:
            centers, radii, A, b, c = (x.detach() for x in self.tensors)
            local = Quadrics(A, b, c, Spheres(centers, radii), origins=centers, cuts=self.cuts)
            sides = [Cover(replace(local.described, faces=side), self.offset) for side in _SIDES[self.faces]]
            self._built = _Built(versions, local, tuple(sides))
        return self._built


@dataclass(frozen=True)
class Fit:
    """How well a cover fits the points it was made for; lengths are in their units.

    Attributes:
        balls: how many.
        points: that it was fitted to. duplicates, strays: that were left out.
        tolerance: asked for.
        rms, worst: of the distances of points from the blended surface, to first order.
        sharp: balls that a sharp edge cuts.
        smallest: balls of the fewest points that do not meet the tolerance: they follow noise, or too fine detail.
    """

    balls: int
    points: int
    duplicates: int
    strays: int
    tolerance: float
    rms: float
    worst: float
    sharp: int
    smallest: int


class _Built(NamedTuple):
    """What is cast.

    Attributes:
        versions: of the tensors that it was made of.
        local: all quadrics, without derivatives. sides: the same, described, for each side that counts.
    """

    versions: tuple[int, ...]
    local: Quadrics
    sides: tuple[Cover, ...]


class _Met(NamedTuple):
    """Hits of quadrics that others are blended of.

    Attributes:
        row: (P,) of which. t, w: (P,). derivatives: of F, from the first on, (P, …).
    """

    row: Tensor
    t: Tensor
    w: Tensor
    derivatives: tuple[Tensor, ...]

    def sums(self, count: int, *rows: Tensor) -> Tensor:
        """Of w and of w times rows (P, k), side by side, (count, 1 + …)."""
        w = self.w[:, None]
        own = torch.cat((w, *(w * row for row in rows)), 1)
        return own.new_zeros(count, own.shape[1]).index_add(0, self.row, own)
