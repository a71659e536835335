"""Bilinear quadrilaterals: smooth patches through four corners each, flat or not, hit exactly along rays.

Letters: a patch is S(u, v) = p₁ + u a + v d + u v h, u and v in [0, 1], with a = p₂ − p₁, d = p₄ − p₁ and
h = p₁ − p₂ + p₃ − p₄; N = S_u × S_v.

Where (u, v) is known of a hit, F is the way from the patch along m = N / |N| there: x = S(u, v) + F m, a function of x
and of the corners that is as smooth for flat patches as for others. It is 0 on the patch, and that is all that
derivatives of hits, normals and curvatures depend on. (u, v) of other points are those of the nearest ones.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from filterlab.arrays import Array, as_tensor
from filterlab.ops import bilinear as described
from filterlab.ops.quadrics import FACES
from filterlab.ops.reference.quadrics import stable_roots
from filterlab.ops.tree import Boxes
from filterlab.surfaces.base import Hits
from filterlab.surfaces.bounds import check_rows
from filterlab.surfaces.in_tree import InTree, domain_around

_STEPS = 2  # of Newton's method: derivatives up to the third
_NEARER = 3  # steps towards the nearest point
_NO_AREA = 1e-12  # of the product of its diagonals, the area of a quad that has none


class BilinearQuads(InTree[described.BilinearQuads]):
    """Patches S(u, v) = (1−u)(1−v) p₁ + u (1−v) p₂ + u v p₃ + (1−u) v p₄ through the corners of quadrilaterals.

    Args:
        vertices: (V, 3), float32 or float64, in the world. Differentiable.
        quads: (Q, 4) integers, which vertices are p₁ … p₄, in the order around each. Flat ones, rectangles, two corners
            in one place (a triangle) are as good as any.
        faces: which hits count: "front", from the side that S_u × S_v points to, "back", or "both". Neighbours in a
            mesh have one outside if they go round the same way: two go along the edge between them in opposite ways.

    Pieces are the quads. Edges belong to the patches, so that no ray slips through between two. A ray that lies in a
    flat patch, or on a line of a bent one, does not hit it.

    Raises:
        TypeError, ValueError: no such arrays; numbers that are not finite; vertices that there are not; quads without
            an area, whose diagonals are parallel.

    Source: Stoll, Gumhold & Seidel, Incremental raycasting of piecewise quadratic surfaces on the GPU, 2006, section
    4.5: they are quadrics within the tetrahedra of their corners. What is computed here is `ops.bilinear`.
    """

    def __init__(self, vertices: Array, quads: Array, *, faces: str = "both") -> None:
        if faces not in FACES:
            raise ValueError(f"faces must be one of {', '.join(FACES)}; got {faces!r}")
        self.vertices = check_rows("vertices", as_tensor(vertices), (None, 3))
        self.quads, self.faces = _checked_quads(as_tensor(quads), self.vertices), faces
        corners = self._corners.detach()
        _check_areas(corners)
        boxes = Boxes(corners.amin(1), corners.amax(1))
        self.domain = domain_around(boxes, (boxes.upper - boxes.lower).norm(dim=1) / 2)

    def __len__(self) -> int:
        return len(self.quads)

    def __repr__(self) -> str:
        return f"BilinearQuads({len(self)}, faces={self.faces!r})"

    @property
    def _corners(self) -> Tensor:
        """(Q, 4, 3) float64."""
        return self.vertices.double()[self.quads]

    # --- what a surface is ---

    def jet(self, points: Tensor, order: int, piece: Tensor | None = None) -> tuple[Tensor, ...]:
        """F, N / N·m, and −(N·h / N·m) (∇u ∇vᵀ + ∇v ∇uᵀ) of the patches numbered by `piece` (...)."""
        at = self._near(points, piece)
        derivatives = [at.height]
        if order >= 1:
            derivatives.append(at.normal / at.facing)
        if order >= 2:
            by_u, by_v = (side[..., None] / at.facing[..., None] for side in at.sides)
            bend = (at.normal * at.patch.twist).sum(-1, keepdim=True) / at.facing
            derivatives.append(-bend[..., None] * (by_u * by_v.mT + by_v * by_u.mT))
        return tuple(x.to(points.dtype) for x in derivatives)

    def parameters(self, origins: Array, directions: Array, hit: Hits) -> Tensor:
        """(u, v) of hits, (..., 2); 0 where there is none.

        Args:
            origins, directions, hit: as of `Surface.at`.

        Differentiable as hit.t is. Raises ValueError as `Surface.at` does.
        """
        point = self.at(origins, directions, hit, order=0).point
        u, v = torch.zeros((2, *point.shape[:-1], 1), dtype=torch.float64, device=point.device)
        if bool(hit.valid.any()) and hit.piece is not None:
            at = self._near(point[hit.valid], hit.piece[hit.valid])
            u, v = (x.index_put((hit.valid,), own) for x, own in ((u, at.u), (v, at.v)))
        return torch.cat((u, v), -1).to(point.dtype)

    def _near(self, points: Tensor, piece: Tensor | None) -> _Near:
        if piece is None:
            raise ValueError("each patch has a function of its own; expected which one as piece, got None")
        corners = self.vertices[self.quads[piece]].double()
        return _Near.of(points.double(), _Patch.of(corners))

    @property
    def tensors(self) -> tuple[Tensor, ...]:
        return (self.vertices,)

    def with_tensors(self, tensors: Sequence[Tensor]) -> BilinearQuads:
        other = copy.copy(self)
        (other.vertices,) = tensors
        other.quads = self.quads.to(other.vertices.device)
        other._built = None
        return other

    @property
    def device(self) -> torch.device:
        return self.vertices.device

    def _described(self) -> described.BilinearQuads:
        return described.BilinearQuads.of(self._corners.detach(), self.faces)


class _Patch(NamedTuple):
    """p₁, a, d, h (..., 3)."""

    corner: Tensor
    across: Tensor
    up: Tensor
    twist: Tensor

    @classmethod
    def of(cls, corners: Tensor) -> _Patch:
        """Of corners (..., 4, 3)."""
        return cls(*(x.view(*corners.shape[:-2], 3) for x in described.spanned(corners.reshape(-1, 4, 3))))

    def detached(self) -> _Patch:
        return _Patch(*(x.detach() for x in self))

    def point(self, u: Tensor, v: Tensor) -> Tensor:
        """S, of u and v (..., 1)."""
        return self.corner + u * self.across + v * (self.up + u * self.twist)

    def tangents(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """S_u and S_v."""
        return self.across + v * self.twist, self.up + u * self.twist

    def nearest(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """(u, v) of points near it: where a line through them hits it, and steps to where it is nearest from there."""
        u, v = self._seen(points)
        for _ in range(_NEARER):
            first, second = self.tangents(u, v)
            rest = points - self.point(u, v)
            normal = torch.linalg.cross(first, second)
            square = _not_zero(_dot(normal, normal))
            u = u + _dot(torch.linalg.cross(second, normal), rest) / square
            v = v + _dot(torch.linalg.cross(normal, first), rest) / square
        return u, v

    def _seen(self, points: Tensor) -> tuple[Tensor, Tensor]:
        """Along the normal in the middle; of both hits the one nearer to the points."""
        middle = torch.linalg.cross(*self.tangents(*points.new_full((2,), 0.5)))
        way = middle / middle.norm(dim=-1, keepdim=True)
        moment, side = torch.linalg.cross(points - self.corner, way), torch.linalg.cross(self.across, way)
        gamma, alpha = _dot(moment, self.up), -_dot(side, self.twist)
        beta = (_dot(moment, self.twist) - _dot(side, self.up)) / 2
        s = (beta * beta - alpha * gamma).clamp_min(0).sqrt()
        found = [self._on_line(points, u) for u in stable_roots(alpha, beta, gamma, s)]
        apart = [(self.point(*at) - points).norm(dim=-1, keepdim=True) for at in found]
        first = apart[0] <= apart[1]
        return torch.where(first, found[0][0], found[1][0]), torch.where(first, found[0][1], found[1][1])

    def _on_line(self, points: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
        u = u.nan_to_num(0.5).clamp(0, 1)
        line = self.up + u * self.twist
        v = _dot(points - self.corner - u * self.across, line) / _not_zero(_dot(line, line))
        return u, v.clamp(0, 1)


class _Near(NamedTuple):
    """Points x = S(u, v) + F m, near a patch.

    Attributes:
        patch: it. u, v, height: u, v, F (..., 1).
        normal: N (..., 3) at (u, v), which moves with x. facing: N·m (..., 1); ∞ where it is 0.
        sides: S_v × m and m × S_u, so that ∇u and ∇v are these divided by N·m.
    """

    patch: _Patch
    u: Tensor
    v: Tensor
    way: Tensor
    normal: Tensor
    facing: Tensor
    sides: tuple[Tensor, Tensor]

    @property
    def height(self) -> Tensor:
        return self.way[..., 0]

    @classmethod
    def of(cls, points: Tensor, patch: _Patch) -> _Near:
        """With derivatives in points and patch: m, and where the steps begin, have none."""
        still, x = patch.detached(), points.detach()
        u, v = still.nearest(x)
        normal = torch.linalg.cross(*still.tangents(u, v))
        m = normal / _not_zero(normal.norm(dim=-1, keepdim=True))
        at = cls._seen(patch, u, v, _dot(m, x - still.point(u, v)), m)
        for _ in range(_STEPS):
            rest = points - patch.point(at.u, at.v) - at.way * m
            steps = [_dot(side, rest) / at.facing for side in (*at.sides, at.normal)]
            at = cls._seen(patch, at.u + steps[0], at.v + steps[1], at.way + steps[2], m)
        return at

    @classmethod
    def _seen(cls, patch: _Patch, u: Tensor, v: Tensor, way: Tensor, m: Tensor) -> _Near:
        first, second = patch.tangents(u, v)
        normal = torch.linalg.cross(first, second)
        facing = _dot(normal, m)
        facing = torch.where(facing.abs() > 0, facing, torch.inf)
        return cls(patch, u, v, way, normal, facing, (torch.linalg.cross(second, m), torch.linalg.cross(m, first)))


def _dot(x: Tensor, y: Tensor) -> Tensor:
    """(..., 1)."""
    return (x * y).sum(-1, keepdim=True)


def _not_zero(x: Tensor) -> Tensor:
    return torch.where(x == 0, 1, x)


def _checked_quads(quads: Tensor, vertices: Tensor) -> Tensor:
    """In int64, where the vertices are. Raises unless it is (Q, 4), Q ≥ 1, of numbers of vertices."""
    if not isinstance(quads, Tensor) or quads.dtype.is_floating_point or quads.dtype in (torch.bool, torch.complex64):
        raise TypeError(f"quads must be integers; got {getattr(quads, 'dtype', type(quads).__name__)}")
    if quads.ndim != 2 or quads.shape[1] != 4 or not len(quads):
        raise ValueError(f"quads must have shape (Q, 4), of one quad at least; got {tuple(quads.shape)}")
    if n := int(((quads < 0) | (quads >= len(vertices))).sum()):
        raise ValueError(f"quads must be numbers of vertices, from 0 to {len(vertices) - 1}; {n} of them are not")
    return quads.to(vertices.device, torch.int64)


def _check_areas(corners: Tensor) -> None:
    first, second = corners[:, 2] - corners[:, 0], corners[:, 3] - corners[:, 1]
    area = torch.linalg.cross(first, second).norm(dim=1)
    if n := int((~(area > _NO_AREA * first.norm(dim=1) * second.norm(dim=1))).sum()):
        raise ValueError(f"quads must have an area; the diagonals of {n} of {len(corners)} are parallel")
