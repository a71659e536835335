"""Signed distances from triangle meshes, as volumes: how far it is to the nearest point of any triangle, < 0 inside.

    d(x) = ± min_triangles |x − nearest point|,     − where |w(x)| > ½

w(x) is the winding number, the solid angle under which the triangles are seen from x, divided by 4π: 1 inside of a
closed mesh, 0 outside; −1 if its triangles go round clockwise. Where a mesh has holes w is no whole number, and |w| = ½
closes them by a surface of its own, on which d jumps. Signs need no closed mesh, but are best from one:
`Triangles.unbalanced_edges` counts what is in the way.

Both are computed by libigl (the extra `mesh`): distances by a tree of boxes, w by Barill et al., Fast winding numbers
for soups and clouds, 2018. Its own `signed_distance` is not used: it multiplies distances by 1 − 2w, which is not ±1.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from filterlab.geometry import Geometry
from filterlab.volume import Volume

Triple = tuple[float, float, float]

MARGIN = 3.0
"""Voxels that are kept free around a mesh: more than any method here needs on one side of a point."""

_POINTS = 1 << 15  # at a time
_ROUNDING = 1e-9  # of a voxel


@dataclass(frozen=True, eq=False)
class Triangles:
    """A triangle mesh as files have it.

    Attributes:
        vertices: (V, 3), in the world.
        faces: (T, 3) integers, numbers of vertices.

    Raises:
        ValueError: other shapes, no triangle, vertices that are not finite, numbers that no vertex has.
    """

    vertices: Tensor
    faces: Tensor

    def __post_init__(self) -> None:
        for name, tensor in (("vertices", self.vertices), ("faces", self.faces)):
            if tensor.ndim != 2 or tensor.shape[1] != 3:
                raise ValueError(f"{name} must have shape (·, 3); got {tuple(tensor.shape)}")
        if not len(self.faces):
            raise ValueError(f"expected triangles; got none, and {len(self.vertices)} vertices")
        if not self.vertices.isfinite().all():
            raise ValueError("expected finite vertices; got NaN or infinity")
        low, high = (int(n) for n in self.faces.aminmax())
        if low < 0 or high >= len(self.vertices):
            raise ValueError(f"expected numbers of {len(self.vertices)} vertices, from 0; got faces of {low} … {high}")

    def box(self) -> tuple[np.ndarray, np.ndarray]:
        """The least and largest coordinates of vertices that triangles have."""
        used = self.vertices[self.faces.flatten()].double()
        return used.amin(0).cpu().numpy(), used.amax(0).cpu().numpy()

    def unbalanced_edges(self) -> int:
        """Edges that triangles do not pass equally often both ways; 0 of a closed mesh that goes round one way.

        Around holes, and where a triangle is turned round. Vertices at the same place are one.
        """
        places, numbers = np.unique(self.vertices.cpu().numpy(), axis=0, return_inverse=True)
        faces = numbers.reshape(-1)[self.faces.cpu().numpy()]
        start, end = faces.reshape(-1).astype(np.int64), np.roll(faces, -1, axis=1).reshape(-1).astype(np.int64)
        edges, which = np.unique(np.minimum(start, end) * len(places) + np.maximum(start, end), return_inverse=True)
        balance = np.bincount(which, weights=np.sign(end - start), minlength=len(edges))
        return int(np.count_nonzero(balance))


@dataclass(frozen=True)
class Grid:
    """Where samples are taken.

    Attributes:
        size: voxels along x, y, z.
        geometry: voxel -> world.
    """

    size: tuple[int, int, int]
    geometry: Geometry

    @classmethod
    def with_size(cls, triangles: Triangles, size: int, margin: float = MARGIN) -> Grid:
        """`size` cubic voxels along the longest side of the mesh's box, and as many as needed along the others.

        Args:
            margin: distance from the box to the outermost voxel centres, in voxels, on each side.

        Raises:
            ValueError: no room between the margins, or for a mesh that is one point.
        """
        low, high = triangles.box()
        (spacing,) = _spacing(np.array([max(high - low)]), (size,), margin)
        return cls.with_spacing(triangles, (spacing, spacing, spacing), margin)

    @classmethod
    def with_shape(cls, triangles: Triangles, shape: tuple[int, int, int], margin: float = MARGIN) -> Grid:
        """So many voxels along x, y, z, of the size with which box and margins fit. Raises as `with_size`."""
        low, high = triangles.box()
        x, y, z = _spacing(high - low, shape, margin)
        return cls._around(triangles, shape, (x, y, z))

    @classmethod
    def with_spacing(cls, triangles: Triangles, spacing: Triple, margin: float = MARGIN) -> Grid:
        """Voxels of that size along x, y, z, as many as the box and its margins need.

        Raises:
            ValueError: a spacing that is not three positive numbers, a margin below 0.
        """
        spacing = Geometry.of(spacing).spacing
        low, high = triangles.box()
        voxels = (high - low) / np.array(spacing) + 2 * _checked_margin(margin)
        x, y, z = (math.ceil(n - _ROUNDING) + 1 for n in voxels)
        return cls._around(triangles, (x, y, z), spacing)

    @classmethod
    def _around(cls, triangles: Triangles, size: tuple[int, int, int], spacing: Triple) -> Grid:
        low, high = triangles.box()
        origin = (low + high) / 2 - np.array(spacing) * (np.array(size) - 1) / 2
        return cls(size, Geometry.of(spacing, origin.tolist()))


def _checked_margin(margin: float) -> float:
    if not 0 <= margin < math.inf:  # a NaN fails too
        raise ValueError(f"expected a margin of 0 or more voxels; got {margin:g}")
    return margin


def _spacing(extent: np.ndarray, size: tuple[int, ...], margin: float) -> list[float]:
    """Of voxels, so many along each side. Raises ValueError where these leave no room, or a side has no length."""
    between = [n - 1 - 2 * _checked_margin(margin) for n in size]
    if min(between) <= 0:
        raise ValueError(f"expected more than {2 * margin + 1:g} voxels with a margin of {margin:g}; got {min(size)}")
    if min(extent) <= 0:
        raise ValueError(f"expected a mesh of some extent along the sides that voxels divide; got {extent.tolist()}")
    return [float(e) / n for e, n in zip(extent, between, strict=True)]


def signed_distance(
    triangles: Triangles,
    grid: Grid,
    *,
    dtype: torch.dtype = torch.float32,
    progress: Callable[[float], None] | None = None,
) -> Volume:
    """The volume of signed distances on a grid: in world units, negative inside.

    Args:
        triangles: the mesh. It need not be closed, see above.
        grid: where samples are taken.
        dtype: of the samples; distances are computed in float64.
        progress: told what part is done, 0 … 1.

    Returns:
        the volume, on the CPU. Not differentiable.

    Raises:
        ValueError: libigl is missing.
    """
    mesh = _Searched(triangles)
    (w, h, d), done = grid.size, progress or (lambda part: None)
    samples = torch.empty(d * h * w, dtype=dtype)
    for begin, points in _points(grid):
        samples[begin : begin + len(points)] = torch.from_numpy(mesh.signed_distance(points))
        done((begin + len(points)) / len(samples))
    return Volume.with_geometry(samples.reshape(d, h, w), grid.geometry)


def _points(grid: Grid) -> Iterator[tuple[int, np.ndarray]]:
    """Voxel centres in the world, x fastest, some at a time; and how many came before."""
    w, h, d = grid.size
    for begin in range(0, w * h * d, _POINTS):
        flat = torch.arange(begin, min(begin + _POINTS, w * h * d))
        voxels = torch.stack([flat % w, flat // w % h, flat // (w * h)], -1)
        yield begin, grid.geometry.to_world(voxels.double()).numpy()


class _Searched:
    """A mesh in libigl's trees."""

    def __init__(self, triangles: Triangles) -> None:
        igl = libigl()
        self.vertices = np.ascontiguousarray(triangles.vertices.detach().cpu().numpy(), dtype=np.float64)
        self.faces = np.ascontiguousarray(triangles.faces.cpu().numpy(), dtype=np.int64)
        self.boxes, self.winding = igl.AABB(), igl.FastWindingNumberBVH()
        self.boxes.init(self.vertices, self.faces)
        self.winding.init(self.vertices, self.faces)

    def signed_distance(self, points: np.ndarray) -> np.ndarray:
        squared, _, _ = self.boxes.squared_distance(self.vertices, self.faces, points)
        distance = np.sqrt(squared)
        return np.where(np.abs(self.winding.winding_number(points)) > 0.5, -distance, distance)


def libigl() -> Any:
    """The package. Raises ValueError that names the extra to install."""
    try:
        import igl
    except ImportError:
        raise ValueError(
            "expected libigl, which computes distances to meshes (pip install 'filterlab[mesh]'); got no such package"
        ) from None
    return igl
