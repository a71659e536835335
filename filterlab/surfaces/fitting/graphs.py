"""Second-order graphs over tangent planes, fitted to points in balls: one for each of many balls at once.

In a ball around p of radius r, with unit vectors a, b in the plane and n towards the outside, y = (x − p) / r is
u = a·y, v = b·y, z = n·y, and the graph is

    z = h(u, v) = c₀ + c₁ u + c₂ v + c₃ u² + c₄ u v + c₅ v²,    the c that make Σ w (z − h)² least

over the ball's points, w the weight by which covers are blended (`ops.slim`). F = z − h is a quadric with |∇F| ≥ 1 and
F > 0 outside, whose one sheet no ball can see twice: that is why it is a graph and no general quadric.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from filterlab.ops.reference.slim import weight

_TURNS = 2  # a plane is found, turned onto the fit, and fitted over again
_RIDGE = 1e-8  # of all weights, added to the squares of the coefficients: points on a line leave some of them open
_STIFF = 1e-2  # the same of second-order ones, where there are
_FEW = 10  # points or fewer
_ROWS = torch.triu_indices(6, 6)


class Pairs(NamedTuple):
    """Points in balls.

    Attributes:
        ball, point: (P,) int64, numbers of both. square: (P,), ρ² = |x − p|² / r².
    """

    ball: Tensor
    point: Tensor
    square: Tensor

    def where(self, kept: Tensor) -> Pairs:
        """Those of a mask (P,)."""
        return Pairs(*(x[kept] for x in self))

    def of(self, balls: Tensor) -> Pairs:
        """Those of a mask of balls (M,), which are numbered anew."""
        own = self.where(balls[self.ball])
        return own._replace(ball=(balls.cumsum(0) - 1)[own.ball])


class Graphs(NamedTuple):
    """Graphs over planes.

    Attributes:
        centers: p (M, 3). radii: (M,). frames: (M, 3, 3), rows a, b, n. coefficients: (M, 6).
    """

    centers: Tensor
    radii: Tensor
    frames: Tensor
    coefficients: Tensor

    def __getitem__(self, index: Tensor) -> Graphs:  # type: ignore[override]
        return Graphs(*(x[index] for x in self))

    def local(self, points: Tensor, ball: Tensor) -> Tensor:
        """u, v, z of points (P, 3) in balls (P,)."""
        y = (points - self.centers[ball]) / self.radii[ball, None]
        return (self.frames[ball] @ y[..., None])[..., 0]

    def distances(self, points: Tensor, ball: Tensor) -> Tensor:
        """Of points (P, 3) from the graphs of balls (P,), to first order: F / |∇F|, in units of the points."""
        value, gradient = self.jet(self.local(points, ball), ball)
        return self.radii[ball] * value / gradient.norm(dim=-1)

    def jet(self, local: Tensor, ball: Tensor) -> tuple[Tensor, Tensor]:
        """F and its gradient at local points (P, 3)."""
        u, v, z = local.unbind(-1)
        c = self.coefficients[ball]
        slopes = c[:, 1] + 2 * c[:, 3] * u + c[:, 4] * v, c[:, 2] + c[:, 4] * u + 2 * c[:, 5] * v
        gradient = torch.stack((-slopes[0], -slopes[1], torch.ones_like(u)), -1)
        return z - (_features(u, v) * c.T).sum(0), gradient

    def quadrics(self) -> tuple[Tensor, Tensor, Tensor]:
        """A, b, c of F = y·A y + 2 b·y + c, y = x − p, in units in which |∇F| is 1 where the slope is 0."""
        a, b, n = self.frames.unbind(1)
        c = self.coefficients[..., None]
        mixed = a[:, :, None] * b[:, None]
        A = -(c[:, 3, None] * a[:, :, None] * a[:, None] + c[:, 5, None] * b[:, :, None] * b[:, None])
        A = (A - c[:, 4, None] * (mixed + mixed.mT) / 2) / self.radii[:, None, None]
        return A, (n - c[:, 1] * a - c[:, 2] * b) / 2, -self.radii * self.coefficients[:, 0]


def fitted(points: Tensor, pairs: Pairs, centers: Tensor, radii: Tensor, normals: Tensor, order: int = 2) -> Graphs:
    """The graphs that fit best to the points of pairs.

    Args:
        points: (N, 3) float64.
        centers, radii: (M, 3), (M,).
        normals: (M, 3), of planes to begin with, towards the outside.
        order: 2, or 1: planes.
    """
    found = Graphs(centers, radii, frames_of(normals), centers.new_zeros(len(centers), 6))
    for turn in range(_TURNS):
        found = solved(points, pairs, found, order)
        if turn < _TURNS - 1:
            found = found._replace(frames=frames_of(_normals(found)))
    return found


def solved(points: Tensor, pairs: Pairs, graphs: Graphs, order: int = 2) -> Graphs:
    """Fitted over the planes they have; differentiable in the points."""
    u, v, z = graphs.local(points[pairs.point], pairs.ball).unbind(-1)
    w, X, count = weight(pairs.square), _features(u, v), len(graphs.centers)
    i, j = _ROWS
    rows = torch.cat(((w * X)[i] * X[j], w * z * X, w[None], torch.ones_like(w)[None]))
    sums = summed(rows.T, pairs.ball, count)
    matrix = sums.new_zeros(count, 6, 6)
    matrix[:, i, j] = matrix[:, j, i] = sums[:, :21]
    ridge = torch.full((count, 6), _RIDGE, dtype=sums.dtype)
    ridge[:, 3:] = torch.where(sums[:, 28:] <= _FEW, _STIFF, _RIDGE)
    matrix = matrix + torch.diag_embed(ridge * sums[:, 27:28] + torch.finfo(sums.dtype).tiny)
    known = 6 if order == 2 else 3
    found = torch.linalg.solve(matrix[:, :known, :known], sums[:, 21 : 21 + known])
    return graphs._replace(coefficients=torch.nn.functional.pad(found, (0, 6 - known)))


def summed(rows: Tensor, ball: Tensor, count: int) -> Tensor:
    """Sums (M, …) over the pairs of each ball."""
    return rows.new_zeros(count, *rows.shape[1:]).index_add(0, ball, rows)


def frames_of(normals: Tensor) -> Tensor:
    """Right-handed frames (M, 3, 3), the last row the normal (M, 3), of length 1.

    Source: Duff et al., Building an orthonormal basis, revisited, 2017.
    """
    x, y, z = normals.unbind(-1)
    sign = torch.where(z < 0, -1.0, 1.0).to(z)
    a = -1 / (sign + z)
    b = x * y * a
    first = torch.stack((1 + sign * x * x * a, sign * b, -sign * x), -1)
    return torch.stack((first, torch.stack((b, sign + y * y * a, -y), -1), normals), -2)


def unit(vectors: Tensor) -> Tensor:
    """Of length 1; 0 stays 0."""
    return vectors / vectors.norm(dim=-1, keepdim=True).clamp_min(torch.finfo(vectors.dtype).tiny)


def _normals(graphs: Graphs) -> Tensor:
    """Of the graphs above the centres, (M, 3)."""
    a, b, n = graphs.frames.unbind(1)
    c = graphs.coefficients[..., None]
    return unit(n - c[:, 1] * a - c[:, 2] * b)


def _features(u: Tensor, v: Tensor) -> Tensor:
    """(6, P), what the coefficients are of."""
    return torch.stack((torch.ones_like(u), u, v, u * u, u * v, v * v))
