"""Triangle meshes of surfaces: marching cubes says which triangles, the surface itself says where.

    grid points in the domain ─▶ signs of F, layers at a time ─▶ marching cubes ─▶ segments ─▶ roots of F ─▶ vertices

Every vertex lies on a segment whose ends lie on both sides of the surface: an edge of the grid, or, for the vertices
that marching cubes puts inside a cell, from the middle of the cell to one of its corners. On it the vertex is a root of
F itself, found by bracketing until floats end, not the linear guess of marching cubes. Triangles between vertices are
flat: a mesh is a picture of a surface at the resolution of its grid, and what is thinner than that is lost.

| case | what the mesh has |
|---|---|
| a closed surface, thicker than the grid | closed: every edge belongs to two triangles, which pass it both ways |
| F = 0 at a grid point | triangles without area: vertices of several edges lie at that point, and stay apart |
| the surface leaves the domain | it ends there, open |
| F is not finite at a corner of a cell, or on an edge | a hole |
| F jumps over 0 on an edge | the vertex lies at the jump; `residual` says how far from 0 F is |
| no F = 0 | no vertices |
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np
import torch
from torch import Tensor

from filterlab.fields.base import Domain
from filterlab.fields.crossings import root_between
from filterlab.surfaces.base import Surface

NODES_AT_ONCE = 1 << 22  # of the grid
NODE_BYTES = 60  # that each takes while it is looked at, at most about
BYTES_OF_TRIANGLE = 48  # of a mesh: three numbers, and half a vertex with its normal
MAX_PLANE = 1 << 26  # grid points of one layer
_POINTS = 1 << 18  # at a time
_FLATTENED = 1 / 256  # the power of |F| that marching cubes sees
_TIE = 2.0**-20  # by what every second grid point is preferred where the faces of cells are undecided
_CENTER = 3  # after the axes 0, 1, 2 of edges: the middle of a cell

Progress = Callable[[float], None]


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles on a surface.

    Attributes:
        vertices: (V, 3) float64, in the world.
        faces: (T, 3) int64, numbers of vertices; seen from outside they go round counterclockwise.
        normals: (V, 3), unit vectors towards outside, from the gradient that the field gives there; 0 where that is 0.
        residual: the largest |F| at a vertex, |f − level| of a level set; 0 of an empty mesh.
    """

    vertices: Tensor
    faces: Tensor
    normals: Tensor
    residual: float

    def __repr__(self) -> str:
        return f"Mesh({len(self.vertices)} vertices, {len(self.faces)} triangles, residual={self.residual:.1e})"


def mesh(
    surface: Surface,
    step: float = 1.0,
    *,
    outside: Literal["lower", "greater"] = "lower",
    progress: Progress | None = None,
) -> Mesh:
    """The triangle mesh of a surface, with vertices and normals that are exact.

    The grid has the multiples of `step` in the domain, with 1 the voxels, and the domain's ends. It is looked at some
    layers at a time: beside the mesh itself memory is that of `NODES_AT_ONCE` grid points, or of two layers.

    Args:
        surface: a level set, or another surface where F changes sign.
        step: between grid points, in voxels.
        outside: where F, or the field of a level set, has `lower` or `greater` values; in CT `lower` is air.
        progress: told what part is done, 0 … 1.

    Returns:
        the mesh, on the surface's device. Not differentiable.

    Raises:
        TypeError: no surface, or one in pieces. ValueError: a step that is no positive number, or of too many grid
            points.
    """
    if not isinstance(surface, Surface):
        raise TypeError(f"surface must be a Surface, such as a LevelSet(field, level); got {type(surface).__name__}")
    if surface.in_pieces:
        raise TypeError(f"a mesh is that of one function, as a level set has; got {type(surface).__name__}")
    if outside not in _OUTSIDE:
        raise ValueError(f"outside must be {' or '.join(_OUTSIDE)}; got {outside!r}")
    found = surface.detached
    grid = Grid.of(found.domain, step, found.device)
    parts = list(_parts(found, grid, progress or (lambda done: None)))
    keys, numbers = torch.cat([p.keys for p in parts]).unique(return_inverse=True)
    before = np.cumsum([0] + [len(p.keys) for p in parts])
    faces = numbers[torch.cat([p.faces + int(n) for p, n in zip(parts, before, strict=False)])]
    vertices = _placed(found, grid, keys)
    return _finished(found, vertices, faces, outside)


_OUTSIDE = ("lower", "greater")


# --- the grid ---------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Grid:
    """The grid that a mesh is made on.

    Attributes:
        domain: what it lies in.
        axes: places of its points along x, y, z, float64, in voxels.
    """

    domain: Domain
    axes: tuple[Tensor, Tensor, Tensor]

    @classmethod
    def of(cls, domain: Domain, step: float, device: torch.device | None) -> Grid:
        """Raises ValueError for a step that is no positive number, or of too many grid points."""
        if isinstance(step, bool) or not isinstance(step, int | float) or not 0 < step < math.inf:
            raise ValueError(f"step must be a positive number of voxels; got {step!r}")
        ends = list(zip(domain.lower, domain.upper, strict=True))
        size = [(upper - lower) / step + 3 for lower, upper in ends]
        if max(size[0] * size[1], size[2]) > MAX_PLANE:
            raise ValueError(f"step must leave at most {MAX_PLANE:,} grid points in a layer; got {step:g} voxels")
        x, y, z = (_places(lower, upper, step).to(device) for lower, upper in ends)
        return cls(domain, (x, y, z))

    @property
    def size(self) -> tuple[int, int, int]:
        """Grid points along x, y, z."""
        x, y, z = (len(axis) for axis in self.axes)
        return x, y, z

    @property
    def layers_at_once(self) -> int:
        """Layers of cells that are looked at together."""
        nx, ny, _ = self.size
        return max(1, NODES_AT_ONCE // (nx * ny) - 1)

    def layer(self, k: int) -> Tensor:
        """World points (ny, nx, 3) of a layer."""
        x, y, z = self.axes
        return self.world(torch.stack(torch.broadcast_tensors(x, y[:, None], z[k]), -1))

    def world(self, voxels: Tensor) -> Tensor:
        """Of points in voxels."""
        return self.domain.geometry.to_world(voxels)

    def points(self, nodes: Tensor) -> Tensor:
        """World points (M, 3) of grid points i, j, k (M, 3)."""
        return self.world(torch.stack([axis[own] for axis, own in zip(self.axes, nodes.unbind(-1), strict=True)], -1))

    def keys(self, nodes: Tensor, axis: Tensor) -> Tensor:
        """One number (M,) for every edge: a grid point (M, 3) and an axis (M,), or `_CENTER`."""
        nx, ny, _ = self.size
        x, y, z = nodes.unbind(-1)
        return ((z * ny + y) * nx + x) * 4 + axis

    def edges(self, keys: Tensor) -> tuple[Tensor, Tensor]:
        """Of keys: the grid points (M, 3) and axes (M,)."""
        nx, ny, _ = self.size
        node, axis = keys.div(4, rounding_mode="floor"), keys % 4
        row = node.div(nx, rounding_mode="floor")
        return torch.stack((node % nx, row % ny, row.div(ny, rounding_mode="floor")), -1), axis


def _places(lower: float, upper: float, step: float) -> Tensor:
    """The multiples of a step between two ends, and the ends; none so near an end that a cell is a sliver."""
    first, last = math.ceil(lower / step + 1e-3), math.floor(upper / step - 1e-3)
    inner = torch.arange(first, last + 1, dtype=torch.float64) * step
    return torch.cat((inner.new_tensor([lower]), inner, inner.new_tensor([upper])))


# --- which triangles --------------------------------------------------------------------------------------------------


class _Part(NamedTuple):
    """What some layers of cells have: the edges (V,) that vertices lie on, and faces (T, 3) between them."""

    keys: Tensor
    faces: Tensor


def _parts(surface: Surface, grid: Grid, progress: Progress) -> Iterator[_Part]:
    layers = grid.size[2]
    below = _values(surface, grid.layer(0))[None]
    for first in range(0, layers - 1, grid.layers_at_once):
        above = range(first + 1, min(first + grid.layers_at_once, layers - 1) + 1)
        values = torch.cat((below, torch.stack([_values(surface, grid.layer(k)) for k in above])))
        yield _marched(values, grid, first)
        below = values[-1:]
        progress(above.stop / layers)


def _values(surface: Surface, points: Tensor) -> Tensor:
    """F (...) at points (..., 3), in bounded memory."""
    flat = points.reshape(-1, 3)
    return torch.cat([surface.jet(some, 0)[0] for some in flat.split(_POINTS)]).reshape(points.shape[:-1])


def _marched(values: Tensor, grid: Grid, first: int) -> _Part:
    """Marching cubes on the values (L, ny, nx) of layers of grid points, the first of which has a number."""
    cells = _straddling(values)
    nothing = values.new_zeros((0,), dtype=torch.int64)
    if not bool(cells.any()):
        return _Part(nothing, nothing.reshape(0, 3))
    vertices, faces = _marching_cubes(_flattened(values, first), cells)
    nodes, axis = _edges_of(vertices)
    nodes[:, 2] += first
    return _Part(grid.keys(nodes, axis).to(values.device), faces.to(values.device))


def _straddling(values: Tensor) -> Tensor:
    """Which cells have all corners finite, and some on either side (L, ny, nx): at the last corner of each."""
    inside, finite = values >= 0, values.isfinite()
    some, every = inside, inside
    for dim in range(3):
        low, high = (slice(None, -1), slice(1, None))
        a, b = ((*(slice(None),) * dim, part) for part in (low, high))
        some, every, finite = some[a] | some[b], every[a] & every[b], finite[a] & finite[b]
    cells = torch.zeros_like(values, dtype=torch.bool)
    cells[1:, 1:, 1:] = some & ~every & finite
    return cells


def _flattened(values: Tensor, first: int) -> Tensor:
    """±|F|^(1/256), float32, with + where F = 0: between 1/18 and 17, whatever F is.

    Signs stay, and so does which of two products on a face is larger, by which marching cubes joins its corners. But
    linear guesses on edges keep clear of the ends, so that vertices tell their edges. Where products are equal, as for
    volumes of two values, the cells on both sides of a face would be joined at odds: every second point is preferred.
    """
    least = torch.finfo(torch.float64).smallest_normal
    size = torch.where(values.isfinite(), values.double().abs(), 1).clamp_min(least) ** _FLATTENED
    k, j, i = (torch.arange(n, device=values.device) for n in values.shape)
    even = ((k[:, None, None] + first + j[:, None] + i) % 2 == 0).double()
    size = size * (1 + _TIE * even)
    return torch.where(values >= 0, size, -size).float()


def _marching_cubes(values: Tensor, cells: Tensor) -> tuple[Tensor, Tensor]:
    """Vertices (V, 3) x, y, z and faces (T, 3), counterclockwise seen from lower values.

    Source: Lewiner et al., Efficient implementation of marching cubes' cases with topological guarantees, 2003; as in
    scikit-image, which takes the mask of cells at their last corners.
    """
    from skimage.measure import marching_cubes

    vertices, faces, *_ = marching_cubes(values.cpu().numpy(), 0.0, mask=cells.cpu().numpy())
    return torch.from_numpy(vertices[:, ::-1].copy()), torch.from_numpy(faces.astype(np.int64))


def _edges_of(vertices: Tensor) -> tuple[Tensor, Tensor]:
    """The first grid points (V, 3) and the axes (V,) of the edges that vertices lie on; `_CENTER` for the others."""
    between = (vertices - vertices.round()).abs() > _FLATTENED / 4
    axis = torch.where(between.sum(-1) == 1, between.int().argmax(-1), _CENTER)
    return torch.where(between, vertices.floor(), vertices.round()).long(), axis


# --- where their vertices are -----------------------------------------------------------------------------------------


def _placed(surface: Surface, grid: Grid, keys: Tensor) -> Tensor:
    """World points (V, 3) of vertices on the surface; NaN where F is not finite on the way."""
    return torch.cat([_on_edges(surface, grid, *grid.edges(some)) for some in keys.split(_POINTS)])


def _on_edges(surface: Surface, grid: Grid, nodes: Tensor, axis: Tensor) -> Tensor:
    steps = torch.eye(4, 3, dtype=torch.int64, device=nodes.device)
    start, end = grid.points(nodes), grid.points(nodes + steps[axis])
    inner = (axis == _CENTER).nonzero()[:, 0]
    if len(inner):
        start[inner], end[inner] = _inside(surface, grid, nodes[inner])
    return _crossings(surface, start, end)


def _inside(surface: Surface, grid: Grid, nodes: Tensor) -> tuple[Tensor, Tensor]:
    """From the middles of cells to the corner beyond the surface that looks nearest from there."""
    corners = torch.cartesian_prod(*[torch.arange(2, device=nodes.device)] * 3)
    points = grid.points((nodes[:, None] + corners).reshape(-1, 3)).reshape(-1, 8, 3)
    middle = points.mean(1)
    own, others = _values(surface, middle)[:, None], _values(surface, points)
    share = torch.where((own >= 0) != (others >= 0), own.abs() / (own - others).abs(), torch.inf)
    return middle, points[torch.arange(len(points), device=nodes.device), share.argmin(-1)]


def _crossings(surface: Surface, start: Tensor, end: Tensor) -> Tensor:
    """Points (M, 3) on segments where F = 0, by `root_between`."""

    def value(t: Tensor, number: Tensor) -> Tensor:
        return _values(surface, torch.lerp(start[number], end[number], t[:, None]))

    return torch.lerp(start, end, root_between(value, len(start), start.device)[:, None])


def _finished(surface: Surface, vertices: Tensor, faces: Tensor, outside: str) -> Mesh:
    """With normals; without the faces at vertices that are not finite, and without vertices that have no face."""
    value, gradient = _jets(surface, vertices)
    faces = faces[(vertices.isfinite().all(-1) & value.isfinite())[faces].all(-1)]
    used, faces = faces.unique(return_inverse=True)
    vertices, value, gradient = vertices[used], value[used], gradient[used]
    sign = -1.0 if outside == "lower" else 1.0
    size = gradient.norm(dim=-1, keepdim=True)
    normals = sign * gradient / torch.where(size == 0, 1, size)
    turned = (np.linalg.det(np.asarray(surface.domain.geometry.matrix)) < 0) != (outside == "greater")
    residual = float(value.abs().max()) if len(value) else 0.0
    return Mesh(vertices, faces.flip(-1) if turned else faces, normals, residual)


def _jets(surface: Surface, points: Tensor) -> tuple[Tensor, Tensor]:
    value, gradient = zip(*(surface.jet(some, 1) for some in points.split(_POINTS)), strict=True)
    return torch.cat(value), torch.cat(gradient)
