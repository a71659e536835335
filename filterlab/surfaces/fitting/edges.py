"""Where a ball of a cover ends: at sharp edges, which two graphs share, and at the ends of what was scanned.

At an edge, y₀ is the point near the centre on both graphs, F₁ = F₂ = 0, and n₁, n₂ are their normals there. The plane

    (n₁ − n₂)·(y − y₀) = 0

is where F₁ = F₂, to first order: it contains the edge, convex or concave, and each graph is kept on its own side of it.
At an end of the scan, planes at right angles to that of the graph are put one spacing beyond its outermost points.

Planes are (K, 4): n, d of n·y + d ≤ 0, y = (x − p) / r in a ball around p of radius r; 0 0 0 −1 is none.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor

from filterlab.ops.reference.slim import weight
from filterlab.surfaces.fitting.graphs import Graphs, Pairs, fitted, summed, unit

CUTS = 4
"""Planes at the ends of what was scanned; one more is at an edge."""
_DIRECTIONS = 8
_NEAR = 1.0  # spacings from a plane is what it explains
_SHARP = 0.77  # n₁·n₂ at most: 40°
_SPREAD = 0.5  # of normals of points, before an edge is looked for
_MIDDLE = 1 / 3  # of that range, in which
_FEW_BETWEEN = 0.25  # of them are, at most: a third are where a surface bends evenly
_ROUNDS = 3  # of fitting and dividing points by the plane
_STEPS = 4  # of Newton's method
_EACH = 6  # points, at least


class Edges(NamedTuple):
    """Pairs of graphs, numbers 2 i and 2 i + 1, that share an edge.

    Attributes:
        graphs: 2 M. pairs: of points with the graph on whose side they are.
        cuts: (2 M, 1, 4). valid: (M,) whether they meet at an angle in the ball, and have points.
    """

    graphs: Graphs
    pairs: Pairs
    cuts: Tensor
    valid: Tensor


def edges_in(
    points: Tensor, normals: Tensor, pairs: Pairs, side: Tensor, centers: Tensor, radii: Tensor, order: int
) -> Edges:
    """Two graphs in every ball, and the plane between, which is found from sides (P,) of points, 0 or 1."""
    count = len(centers)
    own = pairs._replace(ball=2 * pairs.ball + side)
    for turn in range(_ROUNDS):
        graphs = _halves(points, normals, own, centers, radii, order)
        place, both = _edge(graphs)
        across = unit(both[:, 0] - both[:, 1])
        y = (points[pairs.point] - centers[pairs.ball]) / radii[pairs.ball, None]
        height = (across[pairs.ball] * (y - place[pairs.ball])).sum(-1)
        turned = _turned(height, own.ball, count)
        if turn < _ROUNDS - 1:
            own = own._replace(ball=2 * pairs.ball + (height * turned[pairs.ball] < 0).long())
    across = across * turned[:, None]
    plane = torch.cat((-across, (across * place).sum(-1, keepdim=True)), 1)
    valid = ((both[:, 0] * both[:, 1]).sum(-1) < _SHARP) & (place.norm(dim=-1) < 1)
    valid &= torch.bincount(own.ball, minlength=2 * count).reshape(-1, 2).amin(1) >= _EACH
    return Edges(graphs, own, torch.stack((plane, -plane), 1).reshape(-1, 1, 4), valid)


def _halves(points: Tensor, normals: Tensor, pairs: Pairs, centers: Tensor, radii: Tensor, order: int) -> Graphs:
    """Two graphs around each centre; one without points is level."""
    rows = weight(pairs.square)[:, None] * normals[pairs.point]
    mean = unit(summed(rows, pairs.ball, 2 * len(centers)))
    mean[(mean == 0).all(1)] = mean.new_tensor([0.0, 0.0, 1.0])
    return fitted(points, pairs, centers.repeat_interleave(2, 0), radii.repeat_interleave(2), mean, order)


def ends_in(points: Tensor, ends: Tensor, spacing: Tensor, graphs: Graphs, pairs: Pairs) -> tuple[Tensor, Tensor]:
    """Planes (M, CUTS, 4), one spacing (M,) of points beyond the outermost of them; (M,) how many points at ends are
    near none."""
    count, spacing = len(graphs.centers), (spacing / graphs.radii)[:, None]
    flat = graphs.local(points[pairs.point], pairs.ball)[:, :2]
    middle = summed(flat, pairs.ball, count)
    first = torch.atan2(-middle[:, 1], -middle[:, 0])
    angle = first[:, None] + torch.arange(_DIRECTIONS) * (2 * math.pi / _DIRECTIONS)
    direction = torch.stack((angle.cos(), angle.sin()), -1)
    reach = (direction[pairs.ball] @ flat[..., None])[..., 0]
    limit = highest(reach, pairs.ball, count) + spacing
    limit, chosen = limit.sort(1)
    limit, chosen = limit[:, :CUTS], chosen[:, :CUTS]
    direction = direction.gather(1, chosen[..., None].expand(-1, -1, 2))
    reach = (direction[pairs.ball] @ flat[..., None])[..., 0]
    near = ((limit - (1 + _NEAR) * spacing)[pairs.ball] < reach) & (limit < 1)[pairs.ball]
    loose = ends[pairs.point] & ~near.any(1)
    normal = (direction[..., None] * graphs.frames[:, None, :2]).sum(2)
    planes = torch.cat((normal, -limit[..., None]), -1)
    return torch.where((limit < 1)[..., None], planes, none(planes)), summed(loose.to(reach), pairs.ball, count)


def none(planes: Tensor) -> Tensor:
    """The plane that is none, of the type of planes."""
    return planes.new_tensor([0.0, 0.0, 0.0, -1.0])


def highest(rows: Tensor, ball: Tensor, count: int) -> Tensor:
    """The largest (M, …) over the pairs of each ball, −∞ of none."""
    index = ball.reshape(-1, *[1] * (rows.ndim - 1)).expand_as(rows)
    start = rows.new_full((count, *rows.shape[1:]), -torch.inf)
    return start.scatter_reduce(0, index, rows, "amax")


def by_normals(normals: Tensor, pairs: Pairs, count: int) -> tuple[Tensor, Tensor]:
    """Sides of points (P,), 0 or 1, by where in the range of normals theirs is; (M,) whether few are in its middle."""
    own = normals[pairs.point]
    ones = torch.ones_like(pairs.square)
    inside = summed(ones, pairs.ball, count).clamp_min(1)
    mean = summed(own, pairs.ball, count) / inside[:, None]
    apart = own - mean[pairs.ball]
    i, j = torch.triu_indices(3, 3)
    spread = apart.new_zeros(count, 3, 3)
    spread[:, i, j] = spread[:, j, i] = summed(apart[:, i] * apart[:, j], pairs.ball, count)
    axis = torch.linalg.eigh(spread).eigenvectors[..., -1]
    along = (apart * axis[pairs.ball]).sum(-1)
    high, low = highest(along, pairs.ball, count), -highest(-along, pairs.ball, count)
    place = (along - low[pairs.ball]) / (high - low).clamp_min(1e-300)[pairs.ball]
    between = summed(((place - 0.5).abs() < _MIDDLE / 2).to(ones), pairs.ball, count)
    return (place < 0.5).long(), (high - low > _SPREAD) & (between < _FEW_BETWEEN * inside)


def _edge(graphs: Graphs) -> tuple[Tensor, Tensor]:
    """The point (M, 3) nearest to the centre on both of two graphs, in balls, and their normals (M, 2, 3) there."""
    count = len(graphs.centers) // 2
    place = graphs.centers.new_zeros(count, 3)
    both = torch.arange(2 * count)
    for step in range(_STEPS + 1):
        local = (graphs.frames * place.repeat_interleave(2, 0)[:, None]).sum(-1)
        value, gradient = graphs.jet(local, both)
        gradient = (gradient[:, :, None] * graphs.frames).sum(1).reshape(-1, 2, 3)
        if step < _STEPS:
            place = _nearest(gradient, (gradient * place[:, None]).sum(-1) - value.reshape(-1, 2))
    return place, unit(gradient)


def _nearest(gradient: Tensor, values: Tensor) -> Tensor:
    """The shortest y (M, 3) with gradients (M, 2, 3) · y = values (M, 2); bounded, where they are nearly parallel."""
    product = (gradient[:, :, None] * gradient[:, None]).sum(-1)
    product = product + 1e-6 * product.diagonal(dim1=1, dim2=2).sum(1)[:, None, None] * torch.eye(2).to(product)
    y = (gradient * torch.linalg.solve(product, values)[..., None]).sum(1)
    return y / y.norm(dim=-1, keepdim=True).clamp_min(1.0)


def _turned(height: Tensor, ball: Tensor, count: int) -> Tensor:
    """(M,) 1 where the points of the first graph are higher than those of the second, else −1."""
    ones = torch.ones_like(height)
    mean = (summed(height, ball, 2 * count) / summed(ones, ball, 2 * count).clamp_min(1)).reshape(-1, 2)
    return torch.where(mean[:, 0] < mean[:, 1], -1.0, 1.0).to(height)
