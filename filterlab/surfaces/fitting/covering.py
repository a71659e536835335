"""Covers of scanned points by balls, as large as the tolerance lets them be.

From large to small, level by level: of the points that are not covered yet some are drawn that are well apart, balls of
the level's radius around them are fitted all at once, and those that meet the tolerance are kept; around the others
smaller ones are tried on later levels. A ball is never smaller than to the `least`-th neighbour of its centre: there it
is kept whatever its misfit. A point is covered when the weights of the balls that it is in sum up to ½.

A ball meets the tolerance if the root of the weighted mean of squared distances of its points is within it, and none
is further off than four times that. Points whose normals look the other way, as those of a wall behind, are not its
own. If one graph does not meet it, or goes on through points of another side, two that share a sharp edge are tried,
then three that share a corner (`surfaces.fitting.edges`).

Source: Ohtake, Belyaev & Alexa, Sparse low-degree implicit surfaces with applications to high quality rendering,
feature extraction, and smoothing, 2005, whose balls minimise an error instead.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from filterlab.ops.reference.slim import weight
from filterlab.surfaces.fitting.edges import (
    EDGES,
    by_normals,
    by_three_normals,
    corners_in,
    edges_in,
    ends_in,
    highest,
    none,
)
from filterlab.surfaces.fitting.graphs import Graphs, Pairs, fitted, summed, unit
from filterlab.surfaces.fitting.scans import Progress, Scan, tree_of

ENOUGH = 0.5
"""Sum of weights from which on a point is covered."""
LARGEST = 0.25
"""Radius of the first balls, in diagonals."""
_STEP = 2**-0.5  # from radius to radius
_SPREAD = 0.5  # of a radius between centres that are drawn together
_BESIDE = 0.35  # of a radius around those that failed, where no others are tried
_DRAWS = 3  # on a level
_WORST = 4.0  # times the tolerance
_ROOM = 1.1  # times the distance of the farthest of the fewest points
_FIRST = 60  # points, about, by which balls are tried at first
_DOUBTFUL = 1.3  # times the tolerance, by them
_LOOSE = 48  # points, from which on a ball may not reach across what was not scanned
_SLACK = 0.5  # spacings beyond a plane that a point at an edge of its side may be
_POOR = 4.0  # tolerances that one graph misses, where points rather lie at an edge than are noise
_UNSURE = 1.01  # tolerances that edges and corners miss at least, if a side of them has few points
_BEYOND = 1.5  # spacings from a graph, at most, points of another side are where it crosses a sharp edge
_AWAY = -0.5  # n·m of normals on both sides of an edge, at least


class Fits(NamedTuple):
    """Balls that are fitted.

    Attributes:
        graphs: M. pairs: of points with the graph they belong to. off: (P,) their distances.
        cuts: (M, K, 4), as in `surfaces.fitting.edges`.
    """

    graphs: Graphs
    pairs: Pairs
    off: Tensor
    cuts: Tensor


@dataclass
class Cover:
    """What covers a scan so far.

    Attributes:
        order: of the graphs.
        least_radius: (N,) of a ball around each point.
        weight, off: (N,) sums of weights, and of weights times distances.
        graphs, cuts: of the balls that were kept, part by part.
        counts, members: how many points each graph was fitted to, (m,), and their numbers, graph after graph.
        sharp, smallest: numbers of balls that share an edge or corner, and of those kept whatever their misfit.
    """

    scan: Scan
    tolerance: float
    order: int
    least_radius: Tensor
    weight: Tensor
    off: Tensor
    graphs: list[Graphs] = field(default_factory=list)
    cuts: list[Tensor] = field(default_factory=list)
    counts: list[Tensor] = field(default_factory=list)
    members: list[Tensor] = field(default_factory=list)
    sharp: int = 0
    smallest: int = 0

    @classmethod
    def of(cls, scan: Scan, tolerance: float, least: int, order: int, progress: Progress) -> Cover:
        """The whole cover."""
        farthest = scan.levels[0].tree.query(scan.points.numpy(), [least], workers=-1)[0][:, 0]
        zeros = torch.zeros(len(scan.points), dtype=torch.float64)
        cover = cls(scan, tolerance, order, _ROOM * torch.from_numpy(farthest), zeros, zeros.clone())
        cover._grow(progress)
        return cover

    def _grow(self, progress: Progress) -> None:
        drawn, radius = np.random.default_rng(self.scan.seed), LARGEST
        while bool((open_ := self.weight < ENOUGH).any()):
            for _ in range(_DRAWS):
                numbers = _apart(self.scan.points, (open_ & (self.weight < ENOUGH)).nonzero()[:, 0], radius, drawn)
                if not len(numbers):
                    break
                failed = self._take(numbers, radius)
                open_ &= ~_near(self.scan.points, failed, _BESIDE * radius)
                progress(float((self.weight >= ENOUGH).double().mean()))
            radius *= _STEP

    def _take(self, numbers: Tensor, radius: float) -> Tensor:
        """Tries balls around points; those that are kept count. Returns the numbers of the others."""
        radii = self.least_radius[numbers].clamp_min(radius)
        last = radii > radius
        hopeful = last | self._hopeful(numbers, radii)
        failed = [numbers[~hopeful]]
        numbers, radii, last = numbers[hopeful], radii[hopeful], last[hopeful]
        for some, pairs in self.scan.levels[0].parts(self.scan.points[numbers], radii):
            kept = self._take_part(numbers[some], radii[some], last[some], pairs)
            failed.append(numbers[some][~kept])
        return torch.cat(failed)

    def _hopeful(self, numbers: Tensor, radii: Tensor) -> Tensor:
        """(M,) which balls may meet the tolerance, by some of their points."""
        scan, hopeful = self.scan, torch.ones(len(numbers), dtype=torch.bool)
        count = float(np.median(scan.levels[0].counts(scan.points[numbers], radii)))
        level = min(len(scan.levels) - 1, int(np.log(max(count / _FIRST, 1)) / np.log(4)))
        if not level:
            return hopeful
        for some, pairs in scan.levels[level].parts(scan.points[numbers], radii):
            tried = _tried(scan, numbers[some], radii[some], pairs, _DOUBTFUL * self.tolerance, self.order)
            hopeful[some] = tried.met.any(1)
        return hopeful

    def _take_part(self, numbers: Tensor, radii: Tensor, last: Tensor, pairs: Pairs) -> Tensor:
        """(M,) which of the balls are kept."""
        tried = _tried(self.scan, numbers, radii, pairs, self.tolerance, self.order)
        chosen = tried.chosen(last)
        for kind, (fits, balls) in enumerate(tried.kinds):
            own = (chosen[balls] == kind).repeat_interleave(len(fits.graphs.centers) // max(len(balls), 1))
            self.sharp += self._keep(fits, own) * (kind > 0)
        self.smallest += int((last & ~tried.met.any(1)).sum())
        kept = chosen >= 0
        self.weight[numbers[kept]] = self.weight[numbers[kept]].clamp_min(ENOUGH)  # whatever its normal
        return kept

    def _keep(self, fits: Fits, kept: Tensor) -> int:
        """Those of a mask (M,) that have points; how many these are."""
        kept = kept & (torch.bincount(fits.pairs.ball, minlength=len(kept)) > 0)
        own = kept[fits.pairs.ball]
        w, point = weight(fits.pairs.square[own]), fits.pairs.point[own]
        self.weight.index_add_(0, point, w)
        self.off.index_add_(0, point, w * fits.off[own])
        self.graphs.append(fits.graphs[kept])
        self.cuts.append(fits.cuts[kept])
        self.counts.append(torch.bincount(fits.pairs.ball[own], minlength=len(kept))[kept])
        self.members.append(point[fits.pairs.ball[own].argsort(stable=True)])
        return int(kept.sum())


class Tried(NamedTuple):
    """What is known of balls (M,).

    Attributes:
        kinds: one graph for each; two for some, that share an edge; a corner for some: with the numbers of their balls.
        misfits: (M, 3) of these, in tolerances, more than one where a side has few points; ∞ where there are none.
    """

    kinds: list[tuple[Fits, Tensor]]
    misfits: Tensor

    @property
    def met(self) -> Tensor:
        """(M, 3) which meet the tolerance."""
        return self.misfits <= 1

    def chosen(self, last: Tensor) -> Tensor:
        """(M,) which kind is kept, −1 for none: the first that meets the tolerance; of the last balls one graph, or the
        best where that is poor."""
        best = torch.where(self.misfits[:, 0] > _POOR, self.misfits.argmin(1), 0)
        return torch.where(self.met.any(1), self.met.long().argmax(1), torch.where(last, best, -1))


def _tried(scan: Scan, numbers: Tensor, radii: Tensor, pairs: Pairs, tolerance: float, order: int) -> Tried:
    """One graph in each ball around points; an edge or a corner where that does not meet the tolerance."""
    centers, spacing = scan.points[numbers], scan.spacing[numbers]
    faces, mean = _facing(scan, numbers, pairs, 0.0)
    sides, _ = _facing(scan, numbers, pairs, _AWAY)
    own = pairs.where(faces)
    graphs = fitted(scan.points, own, centers, radii, mean, order)
    single, misfit = _judged(scan, spacing, graphs, own, tolerance, None)
    misfit[_crossing(scan, spacing, graphs, pairs.where(sides & ~faces))] = torch.inf
    tried = Tried([(single, torch.arange(len(numbers)))], torch.full((len(numbers), 3), torch.inf, dtype=misfit.dtype))
    tried.misfits[:, 0] = misfit
    own = pairs.where(sides)
    for kind, sides_of in enumerate((by_normals, by_three_normals), 1):
        rest = (~tried.met.any(1)).nonzero()[:, 0]
        some = own.of(_mask(rest, len(numbers)))
        side, bent = sides_of(scan.normals, some, len(rest))
        rest, some, side = rest[bent], some.of(bent), side[bent[some.ball]]
        given = scan.points, scan.normals, some, side
        at = centers[rest], radii[rest], order
        found = edges_in(*given, *at) if kind == 1 else corners_in(*given, _SLACK * spacing[rest], *at)
        each = spacing[rest].repeat_interleave(len(found.graphs.centers) // max(len(rest), 1))
        fits, misfit = _judged(scan, each, found.graphs, found.pairs, tolerance, found.cuts)
        misfit = misfit.reshape(len(rest), -1).amax(1) if len(rest) else misfit
        misfit = torch.where(found.sure, misfit, misfit.clamp_min(_UNSURE))
        tried.misfits[rest, kind] = torch.where(found.valid, misfit, torch.inf)
        tried.kinds.append((fits, rest))
    return tried


def _mask(numbers: Tensor, count: int) -> Tensor:
    return torch.zeros(count, dtype=torch.bool).index_fill(0, numbers, True)


def _judged(
    scan: Scan, spacing: Tensor, graphs: Graphs, pairs: Pairs, tolerance: float, cuts: Tensor | None
) -> tuple[Fits, Tensor]:
    """The fits, with planes at ends, and by how many tolerances (M,) they miss; ∞ where they reach across no points."""
    off, count = graphs.distances(scan.points[pairs.point], pairs.ball), len(graphs.centers)
    w = weight(pairs.square)
    sums = summed(torch.stack((w, w * off * off, torch.ones_like(w)), 1), pairs.ball, count)
    misfit = (sums[:, 1] / sums[:, 0].clamp_min(torch.finfo(w.dtype).tiny)).sqrt()
    misfit = torch.maximum(misfit, highest(off.abs(), pairs.ball, count) / _WORST) / tolerance
    planes, loose = ends_in(scan.points, scan.ends, spacing, graphs, pairs)
    misfit[(loose > 0) & (sums[:, 2] >= _LOOSE)] = torch.inf
    edges = none(planes).expand(count, EDGES, 4).clone()
    if cuts is not None:
        edges[:, : cuts.shape[1]] = cuts
    return Fits(graphs, pairs, off, torch.cat((planes, edges), 1)), misfit


def _facing(scan: Scan, numbers: Tensor, pairs: Pairs, least: float) -> tuple[Tensor, Tensor]:
    """(P,) which points have normals that agree with that of the ball's, and these, (M, 3): means, but of their
    centres'."""
    own = scan.normals[numbers]
    faces = (scan.normals[pairs.point] * own[pairs.ball]).sum(-1) > least
    some = pairs.where(faces)
    mean = unit(summed(weight(some.square)[:, None] * scan.normals[some.point], some.ball, len(numbers)))
    mean = torch.where((mean * own).sum(-1, keepdim=True) > 0, mean, own)
    return faces & ((scan.normals[pairs.point] * mean[pairs.ball]).sum(-1) > least), mean


def _crossing(scan: Scan, spacing: Tensor, graphs: Graphs, others: Pairs) -> Tensor:
    """(M,) whether a graph goes on through points of another side: beyond a sharp edge."""
    near = graphs.distances(scan.points[others.point], others.ball).abs() < _BEYOND * spacing[others.ball]
    return torch.bincount(others.ball[near], minlength=len(spacing)) > 0


def _apart(points: Tensor, numbers: Tensor, radius: float, drawn: np.random.Generator) -> Tensor:
    """Some of the points of those numbers, further from each other than a part of the radius."""
    apart = _SPREAD * radius
    cell = (points[numbers] / apart).floor().long()
    cell -= cell.amin(0) if len(cell) else 0
    order = drawn.permutation(len(numbers))
    key = (cell * cell.new_tensor([1 << 42, 1 << 21, 1])).sum(-1).numpy()[order]
    numbers = numbers[torch.from_numpy(order[np.unique(key, return_index=True)[1]])]
    return numbers[
        _independent(tree_of(points[numbers]).query_pairs(apart, output_type="ndarray"), len(numbers), drawn)
    ]


def _independent(pairs: np.ndarray, count: int, drawn: np.random.Generator) -> Tensor:
    """(count,) a largest set of which no two are a pair: by lots, the lowest first."""
    lot = drawn.permutation(count)
    left, chosen = np.ones(count, bool), np.zeros(count, bool)
    while left.any():
        first = left.copy()
        first[np.where(lot[pairs[:, 0]] < lot[pairs[:, 1]], pairs[:, 1], pairs[:, 0])] = False
        chosen |= first
        left &= ~first
        left[pairs[first[pairs].any(1)]] = False
        pairs = pairs[left[pairs].all(1)]
    return torch.from_numpy(chosen)


def _near(points: Tensor, numbers: Tensor, distance: float) -> Tensor:
    """(N,) which points are so near to some of those numbers."""
    if not len(numbers):
        return torch.zeros(len(points), dtype=torch.bool)
    nearest = tree_of(points[numbers]).query(points.numpy(), distance_upper_bound=distance)[0]
    return torch.from_numpy(np.isfinite(nearest))
