"""Casting rays at quadrics, described: many of them, each in a ball cut by planes, in the leaves of a tree.

Letters: a quadric is q·A q + 2 b·q + c = 0 about the centre of its ball. A ray comes nearest to the centre of the tree
at Q and goes on along the unit vector u, Q + τ u, so that τ is measured from near what is hit, not from the eye; from
the point q of the ray nearest to the centre of a ball, ρ behind it:

    α ρ² + 2 β ρ + γ = 0,    α = u·A u,    β = u·(A q + b),    γ = q·A q + 2 b·q + c

and β² − αγ loses no digits to the distance of the eye. The ball is |ρ| ≤ √(r² − q·q), for u is at right angles with q.
`ops.reference.quadrics` says how roots are chosen; all of it is float64, whatever the type of the rays.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import ClassVar, NamedTuple, Self

import torch
from torch import Tensor

from filterlab.ops.tree import Boxes, Tree, in_leaves

FACES = ("both", "front", "back")

ROUNDINGS = 8
"""Of α, β, γ in units of the sizes of their terms, up to which they are 0."""

SMALLEST = 1e-30  # component of a unit vector, for it is divided by

# rows of `Quadrics.leaves`
MATRIX, VECTOR, CONSTANT = slice(0, 6), slice(6, 9), 9  # A: xx, yy, zz, xy, xz, yz
CENTER, SQUARE, SIZES = slice(10, 13), 13, slice(14, 16)
PLANES = 16


@dataclass(frozen=True, eq=False)
class InLeaves:
    """M surfaces in the leaves of a tree, all of one kind.

    Attributes:
        op: what finds hits of that kind.
        tree: where they are; leaves have eight places.
        leaves: (G, K, 8) float64, for every place K numbers; of places without a surface NaN.
        faces: of which hits there are: "front", where F goes from + to − along the ray, "back" or "both".
    """

    op: ClassVar[str]
    tree: Tree
    leaves: Tensor
    faces: str = "both"

    def some(self, kept: Tensor) -> Self:
        """Those of a mask (M,); they keep their numbers, and hits with them every bit."""
        rows = self.leaves.transpose(1, 2).flatten(0, 1)[: len(self.tree.order)]
        return type(self)(self.tree.some(kept), in_leaves(rows[kept[self.tree.order]], torch.nan), self.faces)

    def kept(self, reversed: bool) -> Kept:
        """Which hits count of rays that go as directions say, or the other way round."""
        falls, rises = self.faces != "back", self.faces != "front"
        return Kept(*((rises, falls) if reversed else (falls, rises)), falls)


@dataclass(frozen=True, eq=False)
class Quadrics(InLeaves):
    """M quadrics in balls cut by planes.

    Leaves have 16 + 4 H rows: A, b, c; the ball's centre from the tree's, r²; |A|, |b|; n, d of H planes n·q + d ≤ 0.
    """

    op = "quadrics"

    @classmethod
    def of(
        cls,
        boxes: Boxes,
        coefficients: tuple[Tensor, Tensor, Tensor],
        centers: Tensor,
        radii: Tensor,
        planes: Tensor,
        faces: str = "both",
    ) -> Quadrics:
        """From float64 rows: A (M, 3, 3), b (M, 3), c (M,) about centres (M, 3), radii (M,), planes (M, H, 4)."""
        tree = Tree.over(boxes)
        order, (matrix, vector, constant) = tree.order, coefficients
        entries = torch.stack([matrix[:, i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))], 1)
        sizes = torch.stack((matrix.flatten(1).norm(dim=1), vector.norm(dim=1)), 1)
        ball = torch.cat((centers - tree.center, radii[:, None] ** 2), 1)
        rows = torch.cat((entries, vector, constant[:, None], ball, sizes, planes.flatten(1)), 1)
        return cls(tree, in_leaves(rows[order], torch.nan), faces)

    @property
    def planes(self) -> int:
        """H."""
        return (self.leaves.shape[1] - PLANES) // 4


class Kept(NamedTuple):
    """Whether hits count where F falls along u, where it rises, and where both are one."""

    falls: bool
    rises: bool
    touches: bool


@dataclass(frozen=True)
class Rays:
    """Rays (R, 3) from where they come nearest to the centre of a tree, or the same the other way round.

    Attributes:
        start: Q (R, 3), from the tree's centre.
        along: u (R, 3), unit vectors.
        first, last: (R,) between which τ are hits: from the eye on.
        eye: (R,) where the eye is, τ.
        length: (R,) of the directions as they were given.
        reversed: whether u is the opposite of them.
    """

    start: Tensor
    along: Tensor
    first: Tensor
    last: Tensor
    eye: Tensor
    length: Tensor
    reversed: bool

    @classmethod
    def of(cls, tree: Tree, origins: Tensor, directions: Tensor, reversed: bool) -> Rays:
        """In float64. Rays that miss the tree have no τ."""
        o, d = origins.double() - tree.center, directions.double()
        largest = d.abs().amax(1, keepdim=True)
        d = d / largest  # neither huge nor tiny ones leave the range of their squares
        norm = torch.linalg.vector_norm(d, dim=1, keepdim=True)
        u = d / norm
        eye = _dot(o, u)
        start = o - eye[:, None] * u
        nearest = _dot(start, start)
        misses = nearest > (tree.radius * (1 + 1e-9)) ** 2
        first = eye - 4 * torch.finfo(torch.float64).eps * (eye.abs() + tree.radius)
        last = torch.where(misses, -torch.inf, torch.inf).to(first)
        if reversed:
            u, eye, first, last = -u, -eye, -last, -first
        return cls(start, u, first, last, eye, (largest * norm)[:, 0], reversed)

    def t(self, tau: Tensor) -> Tensor:
        """(R, k) in units of the directions as they were given; ∞ stays."""
        way = self.eye[:, None] - tau if self.reversed else tau - self.eye[:, None]
        return torch.where(tau < torch.inf, (way / self.length[:, None]).clamp_min(0), torch.inf)


def in_parts(
    cast: Callable[[Tensor, Tensor], Sequence[Tensor]], origins: Tensor, directions: Tensor, most: int
) -> Sequence[Tensor]:
    """What `cast` gives of rays (R, 3), at most so many at a time, joined."""
    found = [cast(*rays) for rays in zip(origins.split(most), directions.split(most), strict=True)]
    return [torch.cat(rows) for rows in zip(*found, strict=True)]


def _dot(x: Tensor, y: Tensor) -> Tensor:
    """Of vectors (R, 3); a sum over so short an axis takes torch twice as long."""
    return x[:, 0] * y[:, 0] + x[:, 1] * y[:, 1] + x[:, 2] * y[:, 2]
