"""The skin of balls: a smooth closed surface of pieces of spheres and hyperboloids around a molecule's atoms.

Letters: an atom is p with the weight w = r² / s, s the shrink factor; its power distance is |x − p|² − w. X is a
simplex of the regular (weighted Delaunay) triangulation, ν its dual in the power diagram, which stands at right angles
on it; c is where both meet, −W the power distance there of all of its atoms. In the cell (1 − s) X + s ν of the mixed
complex, with y = x − c and its parts along X and ν,

    F(x) = |y_ν|² / s − |y_X|² / (1 − s) − W

F of neighbours, X a facet of Y, differ by (m·x − e)² / (s (1 − s)), m the direction in Y at right angles with X: so F
is C¹ across the plane m·x = e between their cells, and the surface F = 0 is. For an atom it is a sphere of radius r,
for edges and triangles a hyperboloid of one or two sheets, for a tetrahedron a sphere seen from inside.

Source: Edelsbrunner, Deformable smooth surface design, Discrete & Computational Geometry 21, 1999; Kruithof & Vegter,
Meshing skin surfaces with certified topology, 2007.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from filterlab.arrays import Array, as_tensor
from filterlab.ops.tree import Boxes
from filterlab.surfaces.bounds import Bounds, check_positive, check_rows
from filterlab.surfaces.quadrics import Quadrics

_FLAT = 1e-9  # of the size, how far atoms lie off a plane, a line or a point that they lie in
_MOVED = (1e-10, 1e-9, 1e-8, 1e-7)  # of the size squared, by up to which weights are moved
_THIN = 1e-12  # of the product of its edges, the volume of a simplex that has none
_ABOVE = 20  # sizes squared, how high above all atoms at least a point stands that closes the hull
_UPRIGHT = 1e-4  # the inverse of how many sizes away an orthocentre is that none of the skin is near
_ROOM = 1.0001  # what fits in a ball is not cut by it
_NEVER = 1e-9  # of the terms of a test, by which it has to fail


def molecular_skin(centers: Array, radii: Array, shrink: float = 0.5, *, faces: str = "both") -> Quadrics:
    """The skin surface of atoms: where one is not covered it is its sphere, elsewhere it goes over smoothly.

    Args:
        centers: p (M, 3), float32 or float64, in the world.
        radii: r (M,), positive.
        shrink: s in (0, 1): the nearer to 1, the nearer to the union of the balls; the nearer to 0, the more is filled
            in between them. The balls of Edelsbrunner's definition have the radii r / √s.
        faces: as of `Quadrics`; outside is F > 0.

    Returns:
        a quadric for each cell of the mixed complex that the skin may meet, in no order. Atoms that others hide have
        none. Differentiable in centers and radii: walls move too, but across them F is C¹, so that nothing follows.

    Atoms in a plane or a line, on one sphere, or a single one are as good as any: r² is moved by up to 1e-10 s of the
    size of all, squared, which tells cells apart; by up to 1e-7 where many are alike, as in large grids.

    Raises:
        TypeError, ValueError: no such arrays; numbers that are not finite; no atoms, or two in one place, or so nearly
            in a plane that they could not be told apart; radii that are not positive; a factor not within (0, 1).
    """
    p = check_rows("centers", as_tensor(centers), (None, 3))
    r = check_rows("radii", as_tensor(radii), (len(p),))
    check_positive("radii", r.detach())
    if isinstance(shrink, bool) or not 0 < shrink < 1:
        raise ValueError(f"shrink must be between 0 and 1, both left out; got {shrink!r}")
    _check_places(p.detach())
    p, w = p.double(), r.double() ** 2 / shrink
    complex_ = _Complex.of(p.detach().cpu().numpy(), w.detach().cpu().numpy(), shrink)
    w = w + torch.from_numpy(complex_.moved).to(p.device)
    parts = [_Cells.of(p, w, torch.from_numpy(rows).to(p.device), shrink) for rows in complex_.simplices]
    bounds, kept = _bounded(parts, complex_, p.detach(), shrink)
    A, center, level = (torch.cat([getattr(cells, name) for cells in parts])[kept] for name in ("A", "center", "level"))
    y = bounds.centers - center
    turned = (A * y[:, None]).sum(-1)
    return Quadrics(A, turned, (y * turned).sum(-1) - level, bounds, bounds.centers, faces=faces)


def _check_places(p: Tensor) -> None:
    if not len(p):
        raise ValueError("atoms must be at least one; got none")
    if again := len(p) - len(p.unique(dim=0)):
        raise ValueError(f"centers must differ; {again} of {len(p)} are those of others")


# --- the triangulation ------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Complex:
    """A regular triangulation.

    Attributes:
        simplices: of dimension k = 0, 1, … the atoms of each, (N_k, k + 1), in ascending order.
        facets: of dimension k + 1 = 1, 2, …, (N_k+1, k + 2), which of dimension k is left without each of its atoms.
        moved: by what weights are, (M,).
    """

    simplices: list[np.ndarray]
    facets: list[np.ndarray]
    moved: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray, weights: np.ndarray, shrink: float) -> _Complex:
        found, moved = _regular(points, weights, shrink)
        rows = np.unique(np.sort(found, axis=1), axis=0)
        simplices, facets = [rows], []
        while (count := rows.shape[1]) > 1:
            every = np.concatenate([np.delete(rows, left, axis=1) for left in range(count)])
            below, index = np.unique(every, axis=0, return_inverse=True)
            facets.append(index.reshape(count, len(rows)).T)
            simplices.append(rows := below)
        return cls(simplices[::-1], facets[::-1], moved)

    def firsts(self) -> np.ndarray:
        """Of every dimension the number, among all simplices, of the first; and how many there are."""
        return np.cumsum([0, *map(len, self.simplices)])

    def farthest(self, centers: list[np.ndarray]) -> np.ndarray:
        """From the centres of all simplices how far their duals go: ∞ where these have no end."""
        most = [np.full(len(rows), np.inf) for rows in self.simplices]
        if len(centers) < 4:
            return np.concatenate(most)
        below = whole = np.arange(len(centers[3]))
        closed = np.ones(len(below), dtype=bool)
        for k in (2, 1, 0):  # pairs of simplices and tetrahedra that they are part of
            below, whole, facets = self.facets[k][below].ravel(), np.repeat(whole, k + 2), self.facets[k]
            if k == 2:
                closed = np.bincount(facets.ravel(), minlength=len(centers[2])) == 2
            else:
                inner = np.ones(len(centers[k]), dtype=bool)
                inner[facets[~closed].ravel()] = False
                closed = inner
            own = np.zeros(len(centers[k]))
            np.maximum.at(own, below, np.linalg.norm(centers[3][whole] - centers[k][below], axis=1))
            most[k] = np.where(closed, own, np.inf)
        return np.concatenate([*most[:3], np.zeros(len(centers[3]))])


def _regular(points: np.ndarray, weights: np.ndarray, shrink: float) -> tuple[np.ndarray, np.ndarray]:
    """The simplices of the highest dimension, that of the points, of atoms that are not hidden; and what weights are
    moved by, as little as tells all apart: where more power distances are alike than a simplex has, a flat one comes
    between any two ways to fill the place.

    They are the lower side of the hull of (x, |x|² − w), which a point far above closes.
    """
    own, size = _in_own_space(points)
    count, dimension = own.shape
    if not dimension:
        return np.array([[0]]), np.zeros(1)
    height = (own**2).sum(1) - weights / size**2
    reach = math.sqrt(weights.max() / shrink) / size  # of the skin from an atom to an orthocentre
    above = np.append(np.zeros(dimension), height.max() + _ABOVE + 4 * reach)
    for most in _MOVED:
        moved = np.random.default_rng(0).uniform(-most, most, count)
        found = _lower_side(np.vstack((np.column_stack((own, height - moved)), above)))
        edges = own[found[:, 1:]] - own[found[:, :1]]
        if (np.abs(np.linalg.det(edges)) > _THIN * np.linalg.norm(edges, axis=2).prod(1)).all():
            return found, moved * size**2
    raise ValueError(f"centers must span simplices; of {count} some are too near to a plane of others to tell how")


def _lower_side(lifted: np.ndarray) -> np.ndarray:
    """Of a hull whose last point is far above."""
    from scipy.spatial import ConvexHull

    hull = ConvexHull(lifted)
    below = (hull.simplices < len(lifted) - 1).all(1) & (hull.equations[:, -2] < -_UPRIGHT)
    return hull.simplices[below]


def _in_own_space(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Coordinates (M, d) in the space that they span, of size 1, and the size."""
    centered = points - points.mean(0)
    size = float(np.abs(centered).max()) or 1.0
    _, spread, axes = np.linalg.svd(centered / size, full_matrices=False)
    own = spread > _FLAT
    return (centered / size if own.sum() == 3 else centered / size @ axes[own].T), size


# --- cells ------------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class _Cells:
    """Of all simplices of one dimension k, N of them.

    Attributes:
        center: c (N, 3). level: W (N,). A: of F (N, 3, 3). Differentiable.
        corners: (1 − s) p + s c (N, k + 1, 3), where the part of the cell along X has corners.
        across: (N, 3) how long the parts across X of unit vectors along x, y, z are.
        widest: (N,) |y_ν| at most where F = 0; NaN where it never is.
    """

    center: Tensor
    level: Tensor
    A: Tensor
    corners: Tensor
    across: Tensor
    widest: Tensor

    @classmethod
    def of(cls, p: Tensor, w: Tensor, atoms: Tensor, shrink: float) -> _Cells:
        own, weight = p[atoms], w[atoms]
        frame, height = _orthocenter(own, weight)
        center = own[:, 0] + (height[..., None] * frame).sum(1)
        level = weight[:, 0] - (height**2).sum(1)
        outer = (frame[..., None] * frame[:, :, None]).sum(1)
        A = torch.eye(3, dtype=p.dtype, device=p.device) / shrink - outer / (shrink * (1 - shrink))
        place, still, size = own.detach(), center.detach()[:, None], weight.detach()
        most = (size - shrink * ((place - still) ** 2).sum(-1)).amax(1)  # W + |y_X|² / (1 − s) at the corners
        widest = (shrink * torch.where(most >= -_NEVER * size.amax(1), most.clamp_min(0), torch.nan)).sqrt()
        across = (1 - outer.detach().diagonal(dim1=1, dim2=2)).clamp_min(0).sqrt()
        corners = torch.lerp(place, still, shrink)
        return cls(center, level, A, corners, across, widest if own.shape[1] < 4 else 0 * widest)


def _orthocenter(own: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """Of atoms (N, k + 1, 3): a frame m₁ … m_k (N, k, 3), the last at right angles with all but the last atom; and
    h (N, k): the place p₀ + Σ h m with the same power distance to all."""
    frame: list[Tensor] = []
    height: list[Tensor] = []
    for k in range(1, own.shape[1]):
        edge = own[:, k] - own[:, 0]
        m = edge
        for _ in range(2):  # Gram and Schmidt's method: twice is enough
            for other in frame:
                m = m - _dot(m, other) * other
        m = m / m.norm(dim=-1, keepdim=True)
        known = sum((_dot(edge, other) * h for other, h in zip(frame, height, strict=True)), torch.zeros_like(m[:, :1]))
        wanted = (_dot(edge, edge) - weight[:, k, None] + weight[:, :1]) / 2
        height.append((wanted - known) / _dot(edge, m))
        frame.append(m)
    if not frame:
        return own[:, :0], weight[:, :0]
    return torch.stack(frame, 1), torch.cat(height, 1)


def _dot(x: Tensor, y: Tensor) -> Tensor:
    return (x * y).sum(-1, keepdim=True)


# --- bounds -----------------------------------------------------------------------------------------------------------


def _bounded(parts: list[_Cells], complex_: _Complex, p: Tensor, shrink: float) -> tuple[Bounds, Tensor]:
    """Of the cells that the skin may meet; and which of all they are (N,)."""
    lower, upper, middle, radius = (torch.cat(rows) for rows in zip(*map(_around, parts), strict=True))
    level = torch.cat([cells.level.detach() for cells in parts])
    dual = complex_.farthest([cells.center.detach().cpu().numpy() for cells in parts])
    outward = shrink * torch.from_numpy(dual).to(p.device) ** 2
    kept = ~radius.isnan() & (outward - level >= -_NEVER * (outward + level.abs()))
    cell, planes = _walls(parts, complex_, p, shrink)
    off = (planes[:, :3] * middle[cell]).sum(-1) + planes[:, 3]
    kept[cell[off > radius[cell]]] = False  # they have left nothing of the ball
    cuts = kept[cell] & (off > -radius[cell])
    number = kept.cumsum(0) - 1
    own = _gathered(number[cell[cuts]], planes[cuts], int(kept.sum()))
    return Bounds(middle[kept], radius[kept], own, Boxes(lower[kept], upper[kept])), kept


def _around(cells: _Cells) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Boxes, and balls, around the skin in cells; NaN where there is none."""
    reach = cells.widest[:, None] * cells.across
    middle = cells.corners.mean(1)
    beside = (cells.corners - middle[:, None]).norm(dim=-1).amax(1)
    radius = _ROOM * torch.hypot(beside, cells.widest)
    return cells.corners.amin(1) - reach, cells.corners.amax(1) + reach, middle, radius


def _walls(parts: list[_Cells], complex_: _Complex, p: Tensor, shrink: float) -> tuple[Tensor, Tensor]:
    """Numbers of cells and their planes n·x + d ≤ 0 (·, 4): each twice, from both of its sides."""
    first, cells, planes = complex_.firsts(), [], []
    for k, facets in enumerate(complex_.facets):
        rows = torch.from_numpy(complex_.simplices[k + 1]).to(p.device)
        for left in range(k + 2):
            below = torch.from_numpy(facets[:, left]).to(p.device)
            own = p[rows.roll(-1 - left, 1)]  # the atom that X is without comes last
            m = _orthocenter(own, torch.zeros_like(own[..., 0]))[0][:, -1]
            place = torch.lerp(parts[k].center[below], parts[k + 1].center, shrink).detach()
            plane = torch.cat((m, -_dot(m, place)), 1)
            cells += [below + int(first[k]), torch.arange(len(rows), device=p.device) + int(first[k + 1])]
            planes += [plane, -plane]
    if not cells:
        return torch.zeros(0, dtype=torch.int64, device=p.device), p.new_zeros(0, 4)
    return torch.cat(cells), torch.cat(planes)


def _gathered(cell: Tensor, planes: Tensor, count: int) -> Tensor:
    """(count, H, 4), those of each cell."""
    order = cell.argsort(stable=True)
    cell, planes = cell[order], planes[order]
    rank = torch.arange(len(cell), device=cell.device) - torch.searchsorted(cell, cell)
    most = int(rank.max()) + 1 if len(rank) else 0
    own = planes.new_tensor([0.0, 0.0, 0.0, -1.0]).repeat(count, most, 1)
    return own.index_put((cell, rank), planes)
