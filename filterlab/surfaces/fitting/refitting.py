"""What a cover was fitted to: with it the local fits are functions of the points, and so differentiable.

Held are the balls, which points each graph is fitted to, the planes that graphs stand on and the cuts; of those points

    c = argmin Σ w(|x − p| / r) (z − h(u, v; c))²,    A, b, c of F = z − h

is solved again (`surfaces.fitting.graphs`): linear least squares, whose weights move with the points too.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from filterlab.arrays import Array, as_tensor
from filterlab.surfaces.bounds import check_rows
from filterlab.surfaces.fitting.graphs import Graphs, Pairs, solved

_AT_ONCE = 1 << 17  # pairs of points and graphs


@dataclass(frozen=True, eq=False)
class Members:
    """Graphs of a cover, and the points that each was fitted to.

    Attributes:
        given: how many points there were.
        middle, diagonal: of the points' box: graphs are in units of it, about it.
        graphs: M.
        count: (M,) of points; point: (P,) int32, their numbers among those given, graph after graph.
        order: of the fits.
    """

    given: int
    middle: Tensor
    diagonal: float
    graphs: Graphs
    count: Tensor
    point: Tensor
    order: int

    def in_world(self, coefficients: Tensor) -> tuple[Tensor, ...]:
        """Centres, radii, A (M, 3, 3), b (M, 3) and c (M,) of a `Slim` of graphs with these (M, 6)."""
        centers, radii = self.middle + self.diagonal * self.graphs.centers, self.diagonal * self.graphs.radii
        return centers, radii, *self.graphs._replace(radii=radii, coefficients=coefficients).quadrics()

    def refitted(self, points: Array) -> tuple[Tensor, ...]:
        """The same of the fits to these points (N, 3); differentiable twice."""
        own, parts = (self._checked(points) - self.middle) / self.diagonal, list(self._parts())
        if len(parts) == 1:
            return self.in_world(self._coefficients(own, parts[0]))
        rows = [checkpoint(self._coefficients, own, some, use_reentrant=False) for some in parts]
        return self.in_world(torch.cat(rows))

    def _checked(self, points: Array) -> Tensor:
        return check_rows("points", as_tensor(points), (self.given, 3)).double().cpu()

    def _coefficients(self, points: Tensor, graphs: slice) -> Tensor:
        """(m, 6)."""
        ends = self.count.cumsum(0)
        first = int(ends[graphs.start] - self.count[graphs.start])
        point = self.point[first : int(ends[graphs.stop - 1])].long()
        own = Graphs(*(x[graphs] for x in self.graphs))
        ball = torch.arange(len(own.centers)).repeat_interleave(self.count[graphs])
        y = points[point] - own.centers[ball]
        square = (y * y).sum(-1) / own.radii[ball] ** 2
        return solved(points, Pairs(ball, point, square), own, self.order).coefficients

    def _parts(self) -> Iterator[slice]:
        """Graphs, so many at a time that memory is bounded."""
        ends, first = self.count.cumsum(0), 0
        while first < len(ends):
            before = int(ends[first - 1]) if first else 0
            last = max(first + 1, int(torch.searchsorted(ends, before + _AT_ONCE, right=True)))
            yield slice(first, last)
            first = last
