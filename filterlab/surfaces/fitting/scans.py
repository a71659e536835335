"""Scanned points: their neighbours, spacing, normals and ends, and which of them are strays.

Everything is in units of the diagonal of the points' box, about its middle. Neighbours are found in trees of all
points, and of every fourth, every sixteenth, … of them, in which large balls hold few.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
import torch
from torch import Tensor

from filterlab.surfaces.fitting.graphs import Graphs, Pairs, fitted, unit
from filterlab.surfaces.fitting.orienting import oriented

NEIGHBORS = 16  # of a point, by which its normal is found
_NEAREST = 6  # by which its spacing is
_AROUND = 20  # that tell whether it is at an end
_GAP = 0.8 * np.pi  # between directions to them, at an end
_ALONG = 2  # of them that are at an end too
_APART = 5.0  # spacings of its neighbours: further from them is a stray
_OFF = 10.0  # times as far from the graph of its neighbours as most of them are from theirs
_MOST = 0.75  # of them
_BETTER = 0.25  # of the misfit of its own graph, that of another one whose normal a point takes
_FEWEST = 400  # points in a tree
_AT_ONCE = 1 << 15  # pairs of balls and points: what is computed of them stays in a cache
_HALF_OCTAVE = 2**0.5

Progress = Callable[[float], None]


@dataclass(frozen=True, eq=False)
class Scan:
    """Points of a surface, in units of the diagonal of their box.

    Attributes:
        points: (N, 3) float64.
        normals: (N, 3), of length 1, towards the outside.
        spacing: (N,) between neighbours: √ of the area that each of the nearest six has.
        ends: (N,) whether the surface ends there: nothing is on one side.
        seed: of what is drawn.
    """

    points: Tensor
    normals: Tensor
    spacing: Tensor
    ends: Tensor
    seed: int

    @cached_property
    def levels(self) -> list[Level]:
        """All points, every fourth, every sixteenth, …"""
        order = np.random.default_rng(self.seed).permutation(len(self.points))
        counts = [len(order)]
        while counts[-1] // 4 >= _FEWEST:
            counts.append(counts[-1] // 4)
        return [Level.of(self.points, np.sort(order[:n])) for n in counts]


@dataclass(frozen=True, eq=False)
class Level:
    """Some of the points of a scan, in a tree.

    Attributes:
        numbers: (n,) which of them.
    """

    tree: Any
    numbers: Tensor

    @classmethod
    def of(cls, points: Tensor, numbers: np.ndarray) -> Level:
        return cls(tree_of(points[torch.from_numpy(numbers)]), torch.from_numpy(numbers))

    def counts(self, centers: Tensor, radii: Tensor) -> np.ndarray:
        """Of points in balls, (M,)."""
        return self.tree.query_ball_point(centers.numpy(), radii.numpy(), return_length=True)

    def parts(self, centers: Tensor, radii: Tensor) -> Iterator[tuple[slice, Pairs]]:
        """Some balls after the other, so few that memory is bounded, and the points in them."""
        ends = np.cumsum(self.counts(centers, radii))
        first = 0
        while first < len(centers):
            before = ends[first - 1] if first else 0
            last = max(first + 1, int(np.searchsorted(ends, before + _AT_ONCE, "right")))
            some = slice(first, last)
            yield some, self.pairs(centers[some], radii[some])
            first = last

    def pairs(self, centers: Tensor, radii: Tensor) -> Pairs:
        """The points in balls (M, 3), (M,)."""
        classes = (radii / radii.min()).log2().mul(2).floor().long()  # one search for what differs little
        found = []
        for own in (classes == k for k in classes.unique()):
            index = own.nonzero()[:, 0]
            reach = float(radii[index].max())
            near = tree_of(centers[index]).sparse_distance_matrix(self.tree, reach, output_type="ndarray")
            ball = index[torch.from_numpy(near["i"].astype(np.int64))]
            square = (torch.from_numpy(near["v"].copy()) / radii[ball]) ** 2
            pairs = Pairs(ball, self.numbers[torch.from_numpy(near["j"].astype(np.int64))], square)
            found.append(pairs.where(square < 1))
        return Pairs(*(torch.cat(rows) for rows in zip(*found, strict=True)))


def scan_of(points: Tensor, normals: Tensor | None, seed: int, progress: Progress) -> tuple[Scan, Tensor]:
    """What is known of points (N, 3), and the numbers of those that are kept; normals are found where there are none.

    Two kinds are left out: those far from all others, alone or in groups too small for a ball, and those far from the
    surface that their neighbours lie on.
    """
    kept = _near_others(points).nonzero()[:, 0]
    near, far = _neighbors(points[kept], max(NEIGHBORS, _AROUND))
    progress(0.1)
    graphs = _graphs(points[kept], near, far, progress)
    on = _on_surface(points[kept], near, graphs)
    own = graphs.frames[:, 2]
    if normals is None:
        own = oriented(points[kept], own, near[:, 1:NEIGHBORS])
    else:
        given = unit(normals[kept])
        own = torch.where(((own * given).sum(-1) < 0)[:, None], -own, own)
    own = _sharpened(points[kept], own, near, graphs)
    ends = _ends(graphs.frames, points[kept], near)
    spacing = far[:, _NEAREST] * (np.pi / (_NEAREST + 1)) ** 0.5
    return Scan(points[kept][on], own[on], spacing[on], ends[on], seed), kept[on]


def tree_of(points: Tensor) -> Any:
    from scipy.spatial import KDTree

    return KDTree(points.numpy())


def _neighbors(points: Tensor, count: int) -> tuple[Tensor, Tensor]:
    """Numbers and distances (N, count + 1) of the nearest points, each first its own."""
    distance, number = tree_of(points).query(points.numpy(), min(count + 1, len(points)), workers=-1)
    return torch.from_numpy(number), torch.from_numpy(distance)


def _near_others(points: Tensor) -> Tensor:
    """(N,) whether a point has neighbours that are as near to each other as to it, and enough of them."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    near, distance = _neighbors(points, _NEAREST)
    spacing = distance[:, -1]
    usual = spacing[near[:, 1:]].median(1).values
    close = distance[:, 1:] <= _APART * torch.minimum(usual[:, None], usual[near[:, 1:]])
    row = torch.arange(len(points))[:, None].expand_as(close)[close]
    graph = coo_matrix((np.ones(len(row)), (row.numpy(), near[:, 1:][close].numpy())), shape=(len(points),) * 2)
    _, group = connected_components(graph, directed=False)
    return torch.from_numpy(np.bincount(group)[group] >= NEIGHBORS)


def _graphs(points: Tensor, near: Tensor, distance: Tensor, progress: Progress) -> Graphs:
    """Of the neighbours of each point, around it; the point itself has no part in its own, only in its plane."""
    parts, count = [], near.shape[1]
    step = max(1, _AT_ONCE // NEIGHBORS)
    for first in range(0, len(points), step):
        some = slice(first, first + step)
        own, radii = near[some, 1 : NEIGHBORS + 1], 1.1 * distance[some, min(NEIGHBORS, count - 1)]
        square = (distance[some, 1 : NEIGHBORS + 1] / radii[:, None]) ** 2
        ball = torch.arange(len(own))[:, None].expand_as(own)
        pairs = Pairs(ball.flatten(), own.flatten(), square.flatten())
        parts.append(fitted(points, pairs, points[some], radii, _plane_normals(points, near[some, : NEIGHBORS + 1])))
        progress(0.1 + 0.1 * min(1.0, (first + step) / len(points)))
    return Graphs(*(torch.cat(rows) for rows in zip(*parts, strict=True)))


def _plane_normals(points: Tensor, near: Tensor) -> Tensor:
    """Of the planes that lie best in groups of points (M, k)."""
    y = points[near] - points[near].mean(1, keepdim=True)
    return torch.linalg.eigh(y.mT @ y).eigenvectors[:, :, 0]


def _on_surface(points: Tensor, near: Tensor, graphs: Graphs) -> Tensor:
    """(N,) whether a point is as near to the graph of its neighbours as they are to theirs."""
    off = graphs.distances(points, torch.arange(len(points))).abs()
    usual = off[near[:, 1:]].quantile(_MOST, dim=1)
    return off <= _OFF * usual + 1e-12


def _sharpened(points: Tensor, normals: Tensor, near: Tensor, graphs: Graphs) -> Tensor:
    """Normals (N, 3) at sharp edges, which neighbours on both sides blur: of the graph of a neighbour on one side.

    A graph is as bad for a point as its own points are far from it, or as this one is; another one is taken where it is
    much better than that of the point itself. Elsewhere normals stay.
    """
    near, found = near[:, : NEIGHBORS + 1], normals.clone()
    parts = torch.arange(len(points)).split(_AT_ONCE // NEIGHBORS)
    spread = torch.cat([_off(points, graphs, near[some], some[:, None]).square().mean(1).sqrt() for some in parts])
    for some in parts:
        bad = torch.maximum(spread[near[some]], _off(points, graphs, some[:, None], near[some]).abs())
        least, k = bad.min(1)
        better = least < _BETTER * bad[:, 0]
        own, ball = some[better], near[some, k][better]
        _, gradient = graphs.jet(graphs.local(points[own], ball), ball)
        frames = graphs.frames[ball]
        normal = unit((gradient[:, :, None] * frames).sum(1))
        side = (frames[:, 2] * normals[ball]).sum(-1, keepdim=True)
        found[own] = torch.where(side < 0, -normal, normal)
    return found


def _off(points: Tensor, graphs: Graphs, point: Tensor, ball: Tensor) -> Tensor:
    """Distances (m, k) of points from graphs, by numbers of both that broadcast to it."""
    point, ball = torch.broadcast_tensors(point, ball)
    return graphs.distances(points[point.flatten()], ball.flatten()).reshape(ball.shape)


def _ends(frames: Tensor, points: Tensor, near: Tensor) -> Tensor:
    """(N,) whether all neighbours are on one side, and some of them at an end as well."""
    y = points[near[:, 1:]] - points[:, None]
    u, v = ((frames[:, None, k] * y).sum(-1) for k in (0, 1))
    angle = torch.atan2(v, u).sort(1).values
    gap = torch.cat((angle.diff(dim=1), (angle[:, :1] + 2 * np.pi - angle[:, -1:])), 1).amax(1)
    ends = gap > _GAP
    return ends & (ends[near[:, 1:]].sum(1) >= _ALONG)
