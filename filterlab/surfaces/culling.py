"""Which quadrics show an eye no face that counts: by the polar plane of the eye, and the surface beyond it.

Letters: F(y) = y·A y + 2 b·y + c about the centre of the ball around what is kept, of radius r; e is the eye. Where the
surface is, F = 0, and

    P(y) = p·y + b·e + c,    p = b + A e,    is    P(y) = (A y + b)·(e − y) + F(y)

so that it faces the eye where P ≥ 0, on one side of a plane. A quadric shows no front if its bounds lie on the other
side: for balls and tetrahedra these are exact tests. Else a part of them is beyond the plane, and it is convex: where F
has one sign in it, no surface is there. Of a ball that part is in the cylinder between the plane and the top of the
cap, y = s p/|p| + x, with F split into its terms in s and x; of a tetrahedron it is the hull of the corners vᵢ that are
beyond the plane and of where edges cross it, and F is a mean of the values vᵢ·A vⱼ + b·(vᵢ + vⱼ) + c. Both are bounds:
what they leave in may show backs only, what they leave out shows no front.

Source: Stoll, Gumhold & Seidel, Incremental raycasting of piecewise quadratic surfaces on the GPU, 2006, equations 16
to 19, for the first test.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

_LEVEL = 1e-12  # of the terms of P: what may be 0
_CLEAR = 1e-7  # of the terms of F, the same: more than roots of what rounding leaves of differences, and slack
_AT_ONCE = 1 << 15  # tetrahedra
_EDGES = torch.triu_indices(4, 4, 1)


class Local(NamedTuple):
    """Quadrics about the centres of balls around them.

    Attributes:
        A, b, c: (M, 3, 3), (M, 3), (M,), float64. radii: r (M,).
        corners: (M, 4, 3) of tetrahedra, from the centres; None: balls.
    """

    A: Tensor
    b: Tensor
    c: Tensor
    radii: Tensor
    corners: Tensor | None

    def some(self, kept: Tensor) -> Local:
        corners = None if self.corners is None else self.corners[kept]
        return Local(self.A[kept], self.b[kept], self.c[kept], self.radii[kept], corners)


class Polar(NamedTuple):
    """P = p·y + value, p (M, 3), value (M,), larger by what may be 0."""

    p: Tensor
    value: Tensor

    @classmethod
    def of(cls, local: Local, eye: Tensor, slack: float) -> Polar:
        A, b, c, r, _ = local
        far = eye.norm(dim=1)
        p = b + (A * eye[:, None]).sum(-1)
        terms = c.abs() + b.norm(dim=1) * (far + r) + A.flatten(1).norm(dim=1) * far * r
        return cls(p, c + (b * eye).sum(-1) + slack * p.norm(dim=1) + _LEVEL * terms)


def facing(local: Local, eye: Tensor, slack: float) -> Tensor:
    """(M,) whether some point within the bounds, or a slack beyond, may face an eye (M, 3), from the centres."""
    polar = Polar.of(local, eye, slack)
    kept = polar.value + _reach(local, polar.p) >= 0
    rest = kept.nonzero()[:, 0]
    for some in rest.split(_AT_ONCE):
        own, beyond = local.some(some), Polar(*(x[some] for x in polar))
        kept[some] = _straddles(own, *(in_cap if own.corners is None else in_hull)(own, beyond))
    return kept


def _reach(local: Local, p: Tensor) -> Tensor:
    """The largest p·y within the bounds."""
    ball = local.radii * p.norm(dim=1)
    return ball if local.corners is None else torch.minimum(ball, (local.corners * p[:, None]).sum(-1).amax(1))


def _straddles(local: Local, lowest: Tensor, highest: Tensor) -> Tensor:
    A, b, c, r, _ = local
    room = _CLEAR * (c.abs() + r * (2 * b.norm(dim=1) + r * A.flatten(1).norm(dim=1)))
    return (lowest <= room) & (highest >= -room)


def in_cap(local: Local, polar: Polar) -> tuple[Tensor, Tensor]:
    """Bounds (M,) of F in the parts of balls that are beyond their planes."""
    A, b, c, r, _ = local
    size = polar.p.norm(dim=1)
    n = torch.where((size > 0)[:, None], polar.p / size[:, None], b.new_tensor([0.0, 0.0, 1.0]))
    low = torch.where(size > 0, -polar.value / size, -r).clamp(-r, r)
    middle, half, wide = (r + low) / 2, (r - low) / 2, (r.square() - low.clamp_min(0).square()).sqrt()
    turned = (A * n[:, None]).sum(-1)
    along = (turned * n).sum(-1)
    gradient = middle[:, None] * turned + b
    value = c + middle * ((gradient + b) * n).sum(-1)
    slope = (gradient * n).sum(-1)
    spread = 2 * (slope.abs() * half + _across(gradient, slope) * wide + _across(turned, along) * half * wide)
    least, most = _bends(A, turned, along)
    ends = (half.square() * along, wide.square() * least), (half.square() * along, wide.square() * most)
    return (
        value - spread + sum(x.clamp_max(0) for x in ends[0]),
        value + spread + sum(x.clamp_min(0) for x in ends[1]),
    )


def _across(vector: Tensor, along: Tensor) -> Tensor:
    """Lengths (M,) of what is left of vectors (M, 3) without their part along a unit vector."""
    return (vector.square().sum(-1) - along.square()).clamp_min(0).sqrt()


def _bends(A: Tensor, turned: Tensor, along: Tensor) -> tuple[Tensor, Tensor]:
    """The least and the largest x·A x (M,) of unit vectors x at right angles with n, given A n and n·A n."""
    trace = A.diagonal(dim1=1, dim2=2).sum(1) - along
    squares = A.square().sum((1, 2)) - 2 * turned.square().sum(1) + along.square()
    half = (2 * squares - trace.square()).clamp_min(0).sqrt() / 2
    return trace / 2 - half, trace / 2 + half


def in_hull(local: Local, polar: Polar) -> tuple[Tensor, Tensor]:
    """The same of tetrahedra; where F has both signs at corners of these parts, its range at them."""
    A, b, c, *_ = local
    points = _hull(local, polar)
    turned, slope = points @ A, (points @ b[:, :, None])[..., 0]
    lowest, highest = ((turned * points).sum(-1) + 2 * slope + c[:, None]).aminmax(dim=1)
    rest = (lowest * highest > 0).nonzero()[:, 0]  # of one sign at all points: means of two of them may have the other
    slope = slope[rest]
    means = turned[rest] @ points[rest].mT + slope[:, :, None] + slope[:, None] + c[rest, None, None]
    lowest[rest], highest[rest] = means.flatten(1).aminmax(dim=1)
    return lowest, highest


def _hull(local: Local, polar: Polar) -> Tensor:
    """(M, 10, 3) points, whose hulls are the parts of tetrahedra that are beyond their planes."""
    corners = local.corners
    assert corners is not None
    first, second = _EDGES
    height = (corners * polar.p[:, None]).sum(-1) + polar.value[:, None]
    beyond = height >= 0
    crossed = beyond[:, first] != beyond[:, second]
    part = torch.where(crossed, height[:, first] / (height[:, first] - height[:, second]), 0)
    points = torch.cat((corners, torch.lerp(corners[:, first], corners[:, second], part[..., None])), 1)
    some = points[torch.arange(len(points)), height.argmax(1)]  # stands for those that are not beyond
    return torch.where(torch.cat((beyond, crossed), 1)[..., None], points, some[:, None])
