"""Casting rays at blended quadrics: what runs it. Derivatives are `surfaces.slim`'s, of the members of a sheet."""

from __future__ import annotations

from types import ModuleType

from torch import Tensor

from filterlab.ops.differentiable import quadrics
from filterlab.ops.differentiable.drivers import driver
from filterlab.ops.slim import Cover, Members, Sheets


def sheets(
    given: Cover,
    origins: Tensor,
    directions: Tensor,
    count: int,
    farthest: bool = False,
    implementation: str | None = None,
) -> Sheets:
    """The first sheets of rays (R, 3) in order, or the last ones, from the last on.

    Args:
        implementation: "reference", "cpu" or "cuda"; None: the fastest that can run.
    """
    return _driver(given, origins, implementation).sheets(given, origins, directions, count, farthest)


def members(
    given: Cover, origins: Tensor, directions: Tensor, begin: Tensor, end: Tensor, implementation: str | None = None
) -> Members:
    """All hits of rays (R, 3) with begin ≤ τ ≤ end (R,), in the order of rays."""
    return _driver(given, origins, implementation).members(given, origins, directions, begin, end)


def _driver(given: Cover, origins: Tensor, implementation: str | None) -> ModuleType:
    return driver(implementation or quadrics.implementation_for(given.quadrics, origins), "slim")
