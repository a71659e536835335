"""Casting rays at quadrics that are blended where their balls overlap, described (SLIM surfaces).

Letters: a ray meets quadric i at τᵢ, at xᵢ, with the unit normal nᵢ; cᵢ, rᵢ are its ball, ρᵢ = |xᵢ − cᵢ| / rᵢ. Hits of
a ray, of one side of the quadrics, make sheets. The first hit that is not behind any sheet before begins the next:

    end = min (τᵢ + offset · rᵢ)  over the hits behind the sheet before
    τ = Σ wᵢ τᵢ / Σ wᵢ,  n ∝ Σ wᵢ nᵢ  over those of them with τᵢ ≤ end

    w(ρ) = exp(−4 ρ²) for ρ ≤ ½, (4/e) (1 − ρ)² for ½ < ρ < 1, else 0

w is C¹ at ½ and at 1, the only such pair of a Gaussian and a parabola: so hits that come and go at the end of a ball
change nothing. Blended positions stay on the ray, at τ. Least weights keep the sum from 0.

Source: Ohtake, Belyaev & Alexa, Sparse low-degree implicit surfaces, 2005; Stoll, Gumhold & Seidel, Incremental
raycasting of piecewise quadratic surfaces on the GPU, 2006, section 5.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from filterlab.ops.quadrics import Quadrics, Rays
from filterlab.ops.tree import Tree

INNER = 0.5  # ρ up to which the weight is a Gaussian
STEEP = 4.0
OUTER = STEEP / math.e
LEAST_WEIGHT = 1e-60
"""Added to all: of a hit on the very end of a ball w is 0."""


@dataclass(frozen=True, eq=False)
class Cover:
    """Quadrics that are blended.

    Attributes:
        quadrics: faces tell which side is blended, "front" or "back".
        offset: of a ball's radius, along the ray, by which its hit reaches behind itself.
    """

    quadrics: Quadrics
    offset: float


class Sheets(NamedTuple):
    """What rays (R, 3) meet, k sheets in order; all of it float64.

    Attributes:
        t: (R, k) blended, in units of directions; ∞ where there are no more.
        begin, end: (R, k), between which τ were blended, ends included.
        normal: Σ w n (R, k, 3).
        piece: (R, k) int64, which quadric had the greatest weight; −1 where none is hit.
    """

    t: Tensor
    begin: Tensor
    end: Tensor
    normal: Tensor
    piece: Tensor

    @classmethod
    def none(cls, rays: Rays, count: int) -> Sheets:
        """What programs write τ and places of sheets into, in place of t and numbers."""
        tau = rays.first.new_full((len(rays.first), count), torch.inf)
        normal = tau.new_zeros(*tau.shape, 3)
        return cls(tau, tau.clone(), tau.clone(), normal, torch.full_like(tau, -1, dtype=torch.int64))

    def of_rays(self, rays: Rays, tree: Tree) -> Sheets:
        """What they have written, of rays as they were given."""
        begin, end = (-self.end, -self.begin) if rays.reversed else (self.begin, self.end)
        return Sheets(rays.t(self.t), begin, end, self.normal, tree.numbers(self.piece))


class Members(NamedTuple):
    """Hits that sheets were blended of.

    Attributes:
        row: (P,) int64, of which sheet. piece: (P,) int64, of which quadric. t: (P,) float64, in units of directions.
    """

    row: Tensor
    piece: Tensor
    t: Tensor


def members_of(rays: Rays, tree: Tree, row: Tensor, tau: Tensor, place: Tensor) -> Members:
    """From τ and places (P,) of hits, in the order of rays."""
    own = replace(rays, eye=rays.eye[row], length=rays.length[row])
    return Members(row, tree.numbers(place), own.t(tau[:, None])[:, 0])


def behind(end: Tensor) -> Tensor:
    """The first τ that is not in a sheet which ends there."""
    return torch.nextafter(end, end.new_tensor(torch.inf))
