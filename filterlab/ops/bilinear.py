"""Casting rays at bilinear quadrilaterals, described: the patches of four corners each, in the leaves of a tree.

Letters: a patch is S(u, v) = p + u a + v d + u v h, u and v in [0, 1], with a = p₂ − p₁, d = p₄ − p₁ and
h = p₁ − p₂ + p₃ − p₄. A ray q + ρ D, D of length 1, meets the line v ↦ S(u, v) if, with Q = q − p,

    α u² + 2 β u + γ = 0,    γ = (Q × D)·d,    2 β = (Q × D)·h − (a × D)·d,    α = −(a × D)·h

and then, with w = d + u h and n = D × w, v = ((u a − Q) × D)·n / n·n and ρ = (u a + v w − Q)·D. Nothing in it
is divided by how much a patch is bent, so that flat ones are no case of their own. a and d, u and v may change places:
lines are taken of that family whose edges the ray is less parallel to, for triangles the one whose lines all have a
length. q is nearest to the middle of the corners, as quadrics are recentred.

The edges are kept. u and v are off by rounding, and up to that count as within [0, 1], so that no ray slips through
between two patches with an edge in common. Where all of α, β, γ are small, u and v may be off by much; but then the ray
meets the edge: the volume that D, the edge and the way between them span is 0 to within rounding. Points that are hit
are S(u, v) with u and v in [0, 1], ρ where the ray is nearest to them.

Source: Ramsey, Potter & Hansen, Ray bilinear patch intersections, 2004; Reshetov, Cool patches, 2019.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from filterlab.ops.quadrics import InLeaves
from filterlab.ops.tree import Boxes, Tree, in_leaves

# rows of `BilinearQuads.leaves`
CORNER, ACROSS, UP, TWIST = slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12)
CENTER, SQUARE, LENGTH, PLACE = slice(12, 15), 15, 16, 17

ROUNDINGS = 8
"""Of the sizes of terms, up to which α, β, γ and places are off."""

MEETING = 8
"""Of L and by what places are off, up to which α u² + 2 β u + γ is 0: it is off by (1 + u)² at most, and twice that."""

_BALL = 1 + 1e-9  # of the farthest corner, the radius of a ball that is never touched


@dataclass(frozen=True, eq=False)
class BilinearQuads(InLeaves):
    """M patches.

    Leaves have 18 rows: p from the centre, a, d, h; the centre from the tree's, r² of a ball that holds the patch; L,
    no shorter than a, d and h; by what places are off. Outside is where s_u × s_v points.
    """

    op = "bilinear"

    @classmethod
    def of(cls, corners: Tensor, faces: str = "both") -> BilinearQuads:
        """From corners (M, 4, 3) float64 in the world, in the order around each."""
        tree = Tree.over(Boxes(corners.amin(1), corners.amax(1)))
        own = corners - tree.center  # what is a corner of two has the same numbers in both
        center = own.mean(1)
        p, a, d, h = spanned(own)
        largest = corners.abs().amax() + tree.radius
        reach = _BALL * (own - center[:, None]).norm(dim=-1).amax(1)
        length = torch.stack((a, d, h)).norm(dim=-1).amax(0)
        place = ROUNDINGS * torch.finfo(own.dtype).eps * (8 * length + largest)
        sizes = torch.stack(((reach + place) ** 2, length, place), 1)
        rows = torch.cat((p - center, a, d, h, center, sizes), 1)
        return cls(tree, in_leaves(rows[tree.order], torch.nan), faces)


def spanned(corners: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """p, a, d, h (M, 3) of corners (M, 4, 3)."""
    first, second, third, fourth = corners.unbind(1)
    a, d = second - first, fourth - first
    return first, a, d, (third - fourth) - a
