"""Casting rays at quadrics: what runs it. Derivatives of hits are `surfaces.base`'s, once for all surfaces."""

from __future__ import annotations

from torch import Tensor

from filterlab.ops.differentiable.drivers import driver
from filterlab.ops.quadrics import Quadrics


def hits(
    given: Quadrics,
    origins: Tensor,
    directions: Tensor,
    sheets: int,
    farthest: bool = False,
    implementation: str = "reference",
) -> tuple[Tensor, Tensor]:
    """t (R, k) float64 of the first hits of rays (R, 3), or the last ones, and which quadrics they hit (R, k) int64.

    Args:
        sheets, farthest: k hits in order, or from the last on; t is ∞, the number −1 where there are no more.
        implementation: "reference".
    """
    return driver(implementation, "quadrics").hits(given, origins, directions, sheets, farthest)
