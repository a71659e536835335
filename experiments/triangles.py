"""Marching cubes as rays see it: the usual way to a surface, beside which the exact ones are set.

    volume ─▶ trilinear field ─▶ mesh ─▶ triangles by cell ─▶ the nearest that a ray meets ─▶ normals between corners

The mesh of the trilinear field is that of Lorensen and Cline: a vertex lies where the samples at the ends of its edge,
interpolated linearly, have the level; its normal is that of their central differences. Rays meet triangles exactly, in
float64, so that what is measured is the triangles' error and no tracer's.

Source: Lorensen & Cline, Marching cubes, SIGGRAPH 1987; Möller & Trumbore, Fast, minimum storage ray-triangle
intersection, 1997.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import torch
from torch import Tensor

import filterlab as fl
from filterlab.fields.grid import GridField
from filterlab.ops.reference.pieces import Lines, cells_of, inside
from filterlab.surfaces import Hits, LevelSet, Mesh, Surface, SurfacePoints, mesh
from filterlab.surfaces.base import check_rays

NAME = "marching-cubes"
RECORD: dict[str, Any] = {
    "recipe": NAME,
    "method": NAME,
    "prefilter": True,
    "gradient": "central",
    "default_gradient": True,
}
"""What a record says of it, as of a recipe."""

_RAYS = 1 << 12  # at a time
_BRICK = 4  # cells along an edge of what is passed over where there are no triangles
_SLACK = 1e-12  # of a triangle: what counts as on its edge, so that no ray slips between two


class _Met(NamedTuple):
    """Of every ray: t (R,), ∞ where nothing is met, the triangle (R,), and the weights (R, 3) of its corners."""

    t: Tensor
    triangle: Tensor
    weights: Tensor


class Triangles(Surface):
    """The triangles of a mesh that was made with a step of one voxel; first hits, points and normals.

    Args:
        mesh: whose normals face lower values.
        field: the trilinear one that it was made of: every triangle lies in one of its cells.
    """

    max_order = 1

    def __init__(self, mesh: Mesh, field: GridField) -> None:
        self.domain, self.mesh, self._lattice = field.domain, mesh, field.lattice
        corners = self._of_cells(self.domain.geometry.to_voxel(mesh.vertices)[mesh.faces])
        cells = corners.mean(1).floor().long()
        number = self._number(cells)
        order = number.argsort(stable=True)
        self._faces, self._corners = mesh.faces[order], corners[order]
        self._begin = torch.searchsorted(number[order], torch.arange(math.prod(self._lattice.cells) + 1))
        self._occupied = torch.zeros([-(-n // _BRICK) for n in self._lattice.cells[::-1]], dtype=torch.bool)
        x, y, z = cells.div(_BRICK, rounding_mode="floor").unbind(-1)
        self._occupied[z, y, x] = True

    def _of_cells(self, voxels: Tensor) -> Tensor:
        """Coordinates of cells."""
        return voxels - voxels.new_tensor(self._lattice.offset)

    def _number(self, cells: Tensor) -> Tensor:
        nx, ny, _ = self._lattice.cells
        return (cells[:, 2] * ny + cells[:, 1]) * nx + cells[:, 0]

    def jet(self, points: Tensor, order: int, piece: Tensor | None = None) -> tuple[Tensor, ...]:
        """0, a number without derivatives: triangles are no zeros of a function that has any."""
        if order:
            raise ValueError("triangles have no gradient; ask `at` for normals")
        return (points.new_zeros(points.shape[:-1]),)

    @property
    def detached(self) -> Triangles:
        return self

    def _first(self, origins: Tensor, directions: Tensor) -> Hits:
        return Hits(self._met(origins, directions).t)

    def _sheets(self, origins: Tensor, directions: Tensor, sheets: int, farthest: bool) -> Hits:
        raise ValueError("triangles are met first ones only; expected sheets=1")

    @torch.no_grad()
    def at(self, origins: Tensor, directions: Tensor, hit: Hits, order: int = 1) -> SurfacePoints:
        """Points, and normals towards greater values, interpolated between corners; of first hits alone."""
        o, d = check_rays(origins, directions)
        met = self._met(o.reshape(-1, 3), d.reshape(-1, 3))
        normal = -(met.weights[..., None] * self.mesh.normals[self._faces[met.triangle]]).sum(1)
        normal = normal / normal.norm(dim=-1, keepdim=True).clamp_min(1e-300)
        t, shape, found = torch.where(met.t < math.inf, met.t, 0), (*hit.t.shape, 3), hit.valid[..., None]
        point = o.reshape(-1, 3) + t[:, None] * d.reshape(-1, 3)
        point, normal = (torch.where(found, x.reshape(shape), 0).to(o.dtype) for x in (point, normal))
        return SurfacePoints(point, normal, normal)

    def _met(self, origins: Tensor, directions: Tensor) -> _Met:
        geometry = self.domain.geometry
        own = self._of_cells(geometry.to_voxel(origins.double())), geometry.direction_to_voxel(directions.double())
        parts = [self._of(o, d) for o, d in zip(*(x.split(_RAYS) for x in own), strict=True)]
        return _Met(*(torch.cat(rows) for rows in zip(*parts, strict=True)))

    def _of(self, origins: Tensor, directions: Tensor) -> _Met:
        """Of rays in coordinates of cells: all triangles of all cells that they pass."""
        lines, ray, start = inside(origins, directions, self._lattice.lower, self._lattice.upper)
        line, triangle = self._pairs(lines)
        t, weights = _intersected(lines.origins[line], lines.directions[line], self._corners[triangle])
        t = t + start[ray[line]]
        best = t.new_full((len(origins),), math.inf).scatter_reduce(0, ray[line], t, "amin")
        first = (t == best[ray[line]]) & (t < math.inf)
        number = torch.zeros_like(ray.new_empty(len(origins))).index_put((ray[line][first],), triangle[first])
        corner = t.new_zeros(len(origins), 3).index_put((ray[line][first],), weights[first])
        return _Met(best, number, corner)

    def _pairs(self, lines: Lines) -> tuple[Tensor, Tensor]:
        """(lines, triangles) of the cells that lines pass."""
        passed = cells_of(lines, self._lattice, _BRICK, self._occupied)
        cell = self._number(passed.cells)
        count = self._begin[cell + 1] - self._begin[cell]
        line, first = passed.line.repeat_interleave(count), self._begin[cell].repeat_interleave(count)
        before = (count.cumsum(0) - count).repeat_interleave(count)
        return line, first + torch.arange(len(line)) - before


def _intersected(origins: Tensor, directions: Tensor, corners: Tensor) -> tuple[Tensor, Tensor]:
    """t (M,), ∞ where missed, and the weights (M, 3) of the corners (M, 3, 3)."""
    a, b, c = corners.unbind(1)
    p = torch.linalg.cross(directions, c - a)
    q = torch.linalg.cross(origins - a, b - a)
    volume = (p * (b - a)).sum(-1)
    size = torch.where(volume == 0, torch.inf, volume)
    u, v, t = (p * (origins - a)).sum(-1) / size, (q * directions).sum(-1) / size, (q * (c - a)).sum(-1) / size
    weights = torch.stack((1 - u - v, u, v), -1)
    hit = (weights >= -_SLACK).all(-1) & (t >= 0) & (volume != 0)
    return torch.where(hit, t, math.inf), weights


def marching_cubes(volume: fl.Volume, level: float, boundary: str) -> Triangles:
    """Those of a level in the samples of a volume."""
    field = fl.reconstruct(volume, "trilinear", boundary=boundary, gradient="central")
    assert isinstance(field, GridField)
    return Triangles(mesh(LevelSet(field, level)), field)
