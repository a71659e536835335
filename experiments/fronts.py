"""Pareto fronts: what is worth its cost."""

from __future__ import annotations

import math
from collections.abc import Mapping

TIE = 0.02


def front(points: Mapping[str, tuple[float | None, float | None]], tie: float = TIE) -> list[str]:
    """Who is worth the cost, cheapest first: the cheapest, then everyone more accurate than all who cost less.

    Args:
        points: name -> (cost, error), less is better. Those where either is missing or not finite take no part.
        tie: more accurate is who has an error smaller by more than this part: rounding decides nothing.
    """
    whole = {
        name: (cost, error)
        for name, (cost, error) in points.items()
        if cost is not None and error is not None and math.isfinite(cost) and math.isfinite(error)
    }
    members: list[str] = []
    for name in sorted(whole, key=lambda name: whole[name]):
        if not members or whole[name][1] < (1 - tie) * whole[members[-1]][1]:
            members.append(name)
    return members
