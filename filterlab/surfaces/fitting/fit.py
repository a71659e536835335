"""`fit_slim`: what is checked, what is done in turn, and what is told of it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from filterlab.arrays import Array, as_tensor
from filterlab.surfaces.bounds import check_rows
from filterlab.surfaces.fitting.covering import Cover
from filterlab.surfaces.fitting.graphs import Graphs
from filterlab.surfaces.fitting.refitting import Members
from filterlab.surfaces.fitting.scans import NEIGHBORS, scan_of
from filterlab.surfaces.slim import Fit, Slim

LEAST = 12
"""Points in a ball, at least."""
TOLERANCE = 1e-4
"""Of the diagonal of the points' box."""
_RANGE = (1e-12, 0.1)  # of tolerances
_FLAT = 1e-9  # of the first extent of points is none
_SCAN = 0.3  # of the work


def fit_slim(
    points: Array,
    normals: Array | None = None,
    tolerance: float = TOLERANCE,
    *,
    least: int = LEAST,
    order: int = 2,
    seed: int = 0,
    progress: Callable[[float], None] | None = None,
) -> Slim:
    """The cover of scanned points by balls as large as a local fit of second order meets the tolerance in.

    Args:
        points: (N, 3), float32 or float64.
        normals: (N, 3), of any length, towards the outside; only their sides count. None: they are found
            (`surfaces.fitting.orienting`).
        tolerance: of the diagonal of the points' box, for the root mean square of distances in every ball.
        least: points in a ball, at least: more of them smooth more where noise is larger than the tolerance.
        order: of the local fits: 2, or 1 for planes, to compare with.
        seed: of the order in which places are tried; the same one gives the same cover.
        progress: told what part is done, 0 … 1.

    Returns:
        a `Slim` in float64 on the CPU, whose `fit` tells how well it fits. Holes stay open where they are wider than
        some spacings of points. Where derivatives are asked by the points it has them, as `Slim.refitted` says; by
        normals there are none.

    Raises:
        TypeError: no such tensors. ValueError: other shapes; numbers that are not finite; fewer than `least` distinct
            points, or all of them on a line; another tolerance than 1e-12 … 0.1, or order; normals that
            are 0.

    Source: Ohtake, Belyaev & Alexa, Sparse low-degree implicit surfaces with applications to high quality rendering,
    feature extraction, and smoothing, 2005.
    """
    told = progress or (lambda part: None)
    if order not in (1, 2):
        raise ValueError(f"order must be 1 or 2; got {order!r}")
    given, sides = _checked(points, normals, tolerance, least)
    kept = _distinct(given)
    own, sides = given[kept], None if sides is None else sides[kept]
    low, high = own.aminmax(dim=0)
    middle, diagonal = (low + high) / 2, float((high - low).norm())
    _check_extent(own - middle, least)
    scan, on = scan_of((own - middle) / diagonal, sides, seed, lambda part: told(_SCAN * part))
    if len(on) < least:
        raise ValueError(f"expected points close to others; of {len(own)} all but {len(on)} are strays")
    cover = Cover.of(scan, tolerance, least, order, lambda part: told(_SCAN + (1 - _SCAN) * part))
    graphs, numbers = Graphs(*(torch.cat(rows) for rows in zip(*cover.graphs, strict=True))), kept[on].int()
    counts, point = torch.cat(cover.counts), numbers[torch.cat(cover.members)]
    slim = _slim(Members(len(given), middle, diagonal, graphs, counts, point, order), torch.cat(cover.cuts))
    fit = _told(cover, len(given) - len(own), len(own) - len(on), diagonal)
    if isinstance(points, Tensor) and points.requires_grad and torch.is_grad_enabled():
        slim = slim.refitted(points)
    slim.fit = fit
    return slim


def _slim(members: Members, cuts: Tensor) -> Slim:
    """In the world."""
    centers, radii, *numbers = members.in_world(members.graphs.coefficients)
    slim = Slim(centers, radii, *numbers, cuts=_in_world(cuts, centers, radii))
    slim.of_points = members.refitted
    return slim


def _in_world(cuts: Tensor, centers: Tensor, radii: Tensor) -> Tensor | None:
    """Planes in balls as halfspaces of the world, as few as there are; no plane is one that holds all of its ball."""
    no = (cuts[..., :3] == 0).all(-1)
    most = int((~no).sum(1).max())
    if not most:
        return None
    cuts = cuts.gather(1, no.long().argsort(dim=1, stable=True)[:, :most, None].expand(-1, -1, 4))
    no = (cuts[..., :3] == 0).all(-1, keepdim=True)
    normal, d = torch.where(no, cuts.new_tensor([0.0, 0.0, 1.0, -2.0]), cuts).split((3, 1), -1)
    return torch.cat((normal, radii[:, None, None] * d - (normal * centers[:, None]).sum(-1, keepdim=True)), -1)


def _told(cover: Cover, duplicates: int, strays: int, diagonal: float) -> Fit:
    off = diagonal * (cover.off / cover.weight.clamp_min(torch.finfo(torch.float64).tiny))
    return Fit(
        balls=sum(len(part.centers) for part in cover.graphs),
        points=len(off),
        duplicates=duplicates,
        strays=strays,
        tolerance=cover.tolerance * diagonal,
        rms=float(off.square().mean().sqrt()),
        worst=float(off.abs().max()),
        sharp=cover.sharp,
        smallest=cover.smallest,
    )


def check_settings(tolerance: float, least: int) -> None:
    """Raises ValueError for a tolerance or a least number of points that `fit_slim` refuses."""
    if isinstance(tolerance, bool) or not isinstance(tolerance, int | float) or not _RANGE[0] <= tolerance <= _RANGE[1]:
        raise ValueError(f"tolerance must be a part of the diagonal, 1e-12 … 0.1; got {tolerance!r}")
    if isinstance(least, bool) or not isinstance(least, int) or not 6 <= least <= 1000:
        raise ValueError(f"least must be a whole number of points, 6 … 1000; got {least!r}")


def _checked(points: Array, normals: Array | None, tolerance: float, least: int) -> tuple[Tensor, Tensor | None]:
    """Both in float64, on the CPU, without derivatives."""
    check_settings(tolerance, least)
    own = check_rows("points", as_tensor(points), (None, 3)).detach().double().cpu()
    if normals is None:
        return own, None
    sides = check_rows("normals", as_tensor(normals), (len(own), 3)).detach().double().cpu()
    if n := int((sides == 0).all(1).sum()):
        raise ValueError(f"normals must not be 0; {n} of {len(sides)} are")
    return own, sides


def _distinct(points: Tensor) -> Tensor:
    """Numbers of points, each place once."""
    return torch.from_numpy(np.sort(np.unique(points.numpy(), axis=0, return_index=True)[1]))


def _check_extent(points: Tensor, least: int) -> None:
    """Raises ValueError unless there are enough, and not all on a line."""
    if len(points) < (fewest := max(least, NEIGHBORS + 1)):
        raise ValueError(f"expected at least {fewest} points at different places; got {len(points)}")
    _, extent, _ = torch.linalg.svd(points - points.mean(0), full_matrices=False)
    if float(extent[1]) <= _FLAT * float(extent[0]):
        raise ValueError(f"expected points on a surface; all {len(points)} lie on one line")
