"""Fewer rows of a sweep, with every pair in them: where two things meet is where nearly all faults are."""

from __future__ import annotations

import heapq
from collections.abc import Callable, Hashable, Iterable
from itertools import combinations
from typing import TypeVar

Row = TypeVar("Row", bound=tuple[Hashable, ...])


def in_pairs(rows: Iterable[Row]) -> list[Row]:
    """Some of the rows: any two values that stand side by side in one of all rows stand so in one of these."""
    return covering(rows, lambda *row: (*row, *combinations(enumerate(row), 2)))


def covering(rows: Iterable[Row], shown: Callable[..., Iterable[Hashable]]) -> list[Row]:
    """Some of the rows, in their order, that show all that all of them show.

    Always the row that shows most new is taken, the first of those. What a row would add only shrinks: most need not be
    counted again.

    Args:
        shown: the values of a row -> what it shows, entry by entry: (method, (scheme, boundary)) asks for each method
            and for each pair of scheme and boundary.
    """
    left: dict[Row, set[Hashable]] = {row: set(enumerate(shown(*row))) for row in rows}
    order = {row: i for i, row in enumerate(left)}
    queue = [(-len(new), i, row) for (row, new), i in zip(left.items(), order.values(), strict=True)]
    heapq.heapify(queue)
    met: set[Hashable] = set()
    chosen: list[Row] = []
    while queue:
        counted, i, row = heapq.heappop(queue)
        left[row] -= met
        if len(left[row]) == -counted:
            met |= left[row]
            chosen.append(row)
        elif left[row]:
            heapq.heappush(queue, (-len(left[row]), i, row))
    return sorted(chosen, key=order.__getitem__)
