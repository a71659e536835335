"""Where a ball of a cover ends: at sharp edges and corners, which two or three graphs share, and where the scan ends.

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
from filterlab.surfaces.bounds import plane_distances
from filterlab.surfaces.fitting.graphs import Graphs, Pairs, fitted, summed, unit

CUTS = 4
"""Planes at the ends of what was scanned."""
EDGES = 2
"""More of them, at edges: one, or two where three sides meet."""
_DIRECTIONS = 8
_NEAR = 1.0  # spacings from a plane is what it explains
_SHARP = 0.77  # n₁·n₂ at most: 40°
_SPREAD = 0.5  # of normals of points, before an edge is looked for
_MIDDLE = 1 / 3  # of that range, in which
_FEW_BETWEEN = 0.25  # of them are, at most: a third are where a surface bends evenly
_ROUNDS = 3  # of fitting and dividing points by the plane
_STEPS = 4  # of Newton's method
_FEWEST = 3  # points of a side
_ENOUGH = 6, 4  # of the sides of an edge, of a corner, to be sure of it
_AGREE = 0.9  # of their number, that their normals add up to at least


class Edges(NamedTuple):
    """Graphs that share edges, k of each ball, numbers k i to k i + k − 1.

    Attributes:
        graphs: k M. pairs: of points with the graph on whose side they are.
        cuts: (k M, 1 or 2, 4). valid: (M,) whether they meet at an angle in the ball, and have points.
        sure: (M,) whether all have enough of them.
    """

    graphs: Graphs
    pairs: Pairs
    cuts: Tensor
    valid: Tensor
    sure: Tensor


def edges_in(
    points: Tensor, normals: Tensor, pairs: Pairs, side: Tensor, centers: Tensor, radii: Tensor, order: int
) -> Edges:
    """Two graphs in every ball, and the plane between, which is found from sides (P,) of points, 0 or 1."""
    count = len(centers)
    own = pairs._replace(ball=2 * pairs.ball + side)
    for turn in range(_ROUNDS):
        graphs = _shared(points, normals, own, centers, radii, order, 2)
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
    fewest = torch.bincount(own.ball, minlength=2 * count).reshape(-1, 2).amin(1)
    cuts = torch.stack((plane, -plane), 1).reshape(-1, 1, 4)
    return Edges(graphs, own, cuts, valid & (fewest >= _FEWEST), fewest >= _ENOUGH[0])


def corners_in(
    points: Tensor,
    normals: Tensor,
    pairs: Pairs,
    side: Tensor,
    slack: Tensor,
    centers: Tensor,
    radii: Tensor,
    order: int,
) -> Edges:
    """Three graphs in every ball, 4 i … 4 i + 2, with two planes each, which are found from sides (P,), 0, 1 or 2.

    Each is kept on its own side of the planes through its edges, as at an edge, if these are all convex or all concave.
    If one of them is not as the other two, the side between these two lies around the others: it is kept on its own
    side of either plane, as two graphs that are the same, the second of them 4 i + 3, which elsewhere has no points.
    Points are divided by which graph is nearest; of those further than a slack (M,) on the wrong side there must be
    none.
    """
    count, own = len(centers), pairs._replace(ball=3 * pairs.ball + side)
    for turn in range(_ROUNDS):
        graphs = _shared(points, normals, own, centers, radii, order, 3)
        if turn < _ROUNDS - 1:
            off = [graphs.distances(points[pairs.point], 3 * pairs.ball + k).abs() for k in range(3)]
            own = own._replace(ball=3 * pairs.ball + torch.stack(off).argmin(0))
    fewest = torch.bincount(own.ball, minlength=3 * count).reshape(-1, 3).amin(1)
    valid = fewest >= _FEWEST
    y, side = (points[pairs.point] - centers[pairs.ball]) / radii[pairs.ball, None], own.ball % 3
    planes, convex = [], []
    for i in range(3):  # of the edge of sides i and i + 1, outside of the first of them
        j = (i + 1) % 3
        place, both = _edge(graphs[(3 * torch.arange(count)[:, None] + torch.tensor([i, j])).flatten()])
        across = unit(both[:, 0] - both[:, 1])
        height = (across[pairs.ball] * (y - place[pairs.ball])).sum(-1)
        part = 2 * pairs.ball + (side == j).long()
        some = side != 3 - i - j
        turned = _turned(height[some], part[some], count)
        planes.append(turned[:, None] * torch.cat((-across, (across * place).sum(-1, keepdim=True)), 1))
        convex.append(turned > 0)
        valid &= ((both[:, 0] * both[:, 1]).sum(-1) < _SHARP) & (place.norm(dim=-1) < 1)
    cuts = torch.stack([torch.stack((planes[k], -planes[k - 1]), 1) for k in range(3)], 1)
    around = _around(torch.stack(convex, 1))
    beyond = plane_distances(y, cuts[pairs.ball, side])
    beyond = torch.where(around[pairs.ball] == side, beyond.amin(1), beyond.amax(1))
    valid &= highest(beyond, pairs.ball, count) <= slack / radii
    return Edges(*_with_fourth(graphs, own, cuts, around), valid, fewest >= _ENOUGH[1])


def _around(convex: Tensor) -> Tensor:
    """Which side (M,) lies around the others, −1 for none, of the edges of sides 0 and 1, 1 and 2, 2 and 0 (M, 3)."""
    odd = convex != (convex.sum(1, keepdim=True) > 1)
    return torch.where(odd.any(1), (odd.long().argmax(1) + 2) % 3, -1)


def _with_fourth(graphs: Graphs, pairs: Pairs, cuts: Tensor, around: Tensor) -> tuple[Graphs, Pairs, Tensor]:
    """Four graphs for three of each ball: the fourth is that of the side around, and of their planes each has one."""
    ball, side = torch.div(pairs.ball, 3, rounding_mode="floor"), pairs.ball % 3
    again = around[ball] == side
    number = torch.cat((4 * ball + side, 4 * ball[again] + 3))
    pairs = Pairs(number, *(torch.cat((x, x[again])) for x in pairs[1:]))
    given = torch.arange(len(cuts))
    fourth = 3 * given + around.clamp_min(0)
    graphs = graphs[torch.cat((torch.arange(3 * len(cuts)).reshape(-1, 3), fourth[:, None]), 1).flatten()]
    cuts = torch.cat((cuts, cuts[given, around][:, None]), 1)
    mixed = given[around >= 0]
    cuts[mixed, around[mixed], 1] = cuts[mixed, 3, 0] = none(cuts)
    return graphs, pairs, cuts.flatten(0, 1)


def by_three_normals(normals: Tensor, pairs: Pairs, count: int) -> tuple[Tensor, Tensor]:
    """Which (P,) of three normals far from each other that of a point is nearest to; (M,) whether all agree.

    Agree: those of a side, added up, are nearly as long as they are many. Where a surface bends evenly, or normals are
    noise, they are not.
    """
    own = normals[pairs.point]
    mean = unit(summed(own, pairs.ball, count))
    chosen = [own[_farthest(1 - (own * mean[pairs.ball]).sum(-1), pairs.ball, count)]]
    apart = 1 - (own * chosen[0][pairs.ball]).sum(-1)
    for _ in range(2):
        chosen.append(own[_farthest(apart, pairs.ball, count)])
        apart = torch.minimum(apart, 1 - (own * chosen[-1][pairs.ball]).sum(-1))
    side = torch.stack([(own * normal[pairs.ball]).sum(-1) for normal in chosen]).argmax(0)
    sums = summed(torch.cat((own, torch.ones_like(own[:, :1])), 1), 3 * pairs.ball + side, 3 * count)
    agree = (sums[:, :3].norm(dim=1) >= _AGREE * sums[:, 3]) & (sums[:, 3] >= _FEWEST)
    pairwise = [(chosen[k - 1] * chosen[k]).sum(-1) for k in range(3)]
    return side, agree.reshape(-1, 3).all(1) & (torch.stack(pairwise).amax(0) < _SHARP)


def _farthest(apart: Tensor, ball: Tensor, count: int) -> Tensor:
    """The number (M,) of a pair of each ball in which this is largest."""
    place = torch.where(apart >= highest(apart, ball, count)[ball], torch.arange(len(apart)), 0)
    return place.new_zeros(count).scatter_reduce(0, ball, place, "amax")


def _shared(
    points: Tensor, normals: Tensor, pairs: Pairs, centers: Tensor, radii: Tensor, order: int, each: int
) -> Graphs:
    """So many graphs around each centre; one without points is level."""
    rows = weight(pairs.square)[:, None] * normals[pairs.point]
    mean = unit(summed(rows, pairs.ball, each * len(centers)))
    mean[(mean == 0).all(1)] = mean.new_tensor([0.0, 0.0, 1.0])
    return fitted(points, pairs, centers.repeat_interleave(each, 0), radii.repeat_interleave(each), mean, order)


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
