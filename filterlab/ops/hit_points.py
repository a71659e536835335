"""What is known where rays hit, described: rows of hits by rows of rays.

    points     o + t d of the rays that hit, one after the other: (M, 3)
    by_rays    point, gradient and normal by rays again, 0 of those that do not hit: (..., 3) each

A normal is g / |g|, and 0 where g is. `ops.reference.hit_points` says what is computed, and can be differentiated;
programs make one pass over the hits of each, of what no derivative is asked by.
"""

from __future__ import annotations

from typing import NamedTuple

from torch import Tensor


class OnRays(NamedTuple):
    """Where rays hit.

    Attributes:
        point: (M, 3).
        far: whether a component of the origin of any of these rays is beyond what was asked about.
    """

    point: Tensor
    far: bool


class ByRays(NamedTuple):
    """What is known at hits, by rays.

    Attributes:
        point, gradient, normal: (..., 3), 0 where there is no hit.
        unknown: whether a gradient at a hit is NaN.
    """

    point: Tensor
    gradient: Tensor
    normal: Tensor
    unknown: bool
