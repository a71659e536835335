"""A volume on another grid, by any method: separable where the grids are aligned and the method is, else pointwise."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from filterlab.fields.base import Field
from filterlab.fields.grid import GridField, Term
from filterlab.kernels import PiecewisePolynomial
from filterlab.methods import Method, reconstruct
from filterlab.ops.reference.gather import locate, tap_weights
from filterlab.volume import Boundary, Geometry, Volume, as_volume

POINTS_AT_ONCE = 1 << 20


def resample(
    volume: Volume | Tensor,
    method: str | Method | PiecewisePolynomial = "triquadratic",
    *,
    spacing: Sequence[float] | float | None = None,
    shape: Sequence[int] | None = None,
    like: Volume | None = None,
    boundary: str | Boundary = Boundary.MIRROR,
    prefilter: bool = True,
    dtype: torch.dtype | None = None,
    nan: str = "refuse",
) -> Volume:
    """The volume reconstructed by a method and sampled on another grid.

    Args:
        volume: a `Volume` or a bare tensor (D, H, W) or (N, C, D, H, W).
        method, boundary, prefilter, nan: as for `reconstruct`.
        spacing: new voxel edges along x, y, z (world units). The spacing is kept exactly and the new grid is centred on
            the old box of voxels; along an axis of length n·s it has max(1, round(n·s/spacing)) voxels.
        shape: new (D, H, W). The box of voxels is kept exactly, the spacing follows.
        like: a volume whose grid is taken over, wherever it lies (rotated too); outside the old box the boundary rules.
        dtype: floating type of the computation and the result; default promote(volume.dtype, float32).

    Exactly one of spacing, shape and like must be given. This reconstructs, it does not anti-alias: when the new grid
    is coarser than the old one, blur first. Cost: one pass of S taps per axis; memory: about two volumes of the larger
    size.

    Returns:
        a Volume, differentiable in the samples.
    """
    volume = as_volume(volume)
    target_shape, geometry = _target(volume, spacing, shape, None if like is None else as_volume(like))
    dtype = dtype or torch.promote_types(volume.dtype, torch.float32)
    if not dtype.is_floating_point:
        raise ValueError(f"dtype must be a floating type (round and clip the result for {dtype}); got {dtype}")
    working = torch.promote_types(dtype, torch.float32)
    field = reconstruct(
        volume if volume.dtype == working else volume.to(working),
        method,
        boundary=boundary,
        prefilter=prefilter,
        nan=nan,
    )
    steps = np.linalg.solve(volume.affine, geometry.affine)  # new voxel -> old voxel
    off_axis = np.abs(steps[:3, :3] - np.diag(np.diag(steps[:3, :3]))).max()
    if isinstance(field, GridField) and field.scheme.terms and off_axis <= 1e-12 * np.abs(steps[:3, :3]).max():
        samples = _separable(field, target_shape, np.diag(steps)[:3], steps[:3, 3], working)
    else:
        samples = _pointwise(field, volume.samples.device, target_shape, geometry, working)
    return Volume.with_geometry(samples.to(dtype), geometry)


def _target(
    volume: Volume, spacing: Sequence[float] | float | None, shape: Sequence[int] | None, like: Volume | None
) -> tuple[tuple[int, int, int], Geometry]:
    """(D, H, W) and geometry of the new grid."""
    if sum(x is not None for x in (spacing, shape, like)) != 1:
        raise ValueError("give exactly one of spacing, shape and like")
    if like is not None:
        return (like.size[2], like.size[1], like.size[0]), like.geometry
    extent = np.multiply(volume.size, volume.spacing)
    if spacing is not None:
        new = np.asarray(Geometry.of(spacing).spacing)
        size = np.maximum(1, np.round(extent / new)).astype(np.int64)
    else:
        assert shape is not None
        if not isinstance(shape, Sequence) or len(shape) != 3 or any(int(n) != n or n < 1 for n in shape):
            raise ValueError(f"shape must be three integers ≥ 1 in D, H, W order; got {shape!r}")
        size = np.asarray(shape[::-1], dtype=np.int64)
        new = extent / size
    direction = np.asarray(volume.geometry.matrix) / volume.spacing
    center = volume.affine[:3] @ [*((np.asarray(volume.size) - 1) / 2), 1.0]
    affine = np.eye(4)
    affine[:3, :3] = direction * new
    affine[:3, 3] = center - affine[:3, :3] @ ((size - 1) / 2)
    w, h, d = (int(n) for n in size)
    return (d, h, w), Geometry.of(affine=affine, world=volume.world)


def _separable(
    field: GridField, shape: tuple[int, int, int], scale: np.ndarray, start: np.ndarray, dtype: torch.dtype
) -> Tensor:
    """Σ over the field's separable terms of one pass per axis; old voxel = scale · new voxel + start."""
    stored = field.coefficients
    values = stored.decoded(dtype)
    positions = []
    for axis, n in enumerate(shape[::-1]):
        # float64 positions: the weights are exact however large the grid, and they are few
        x = float(scale[axis]) * torch.arange(n, dtype=torch.float64, device=values.device) + float(start[axis])
        positions.append(stored.boundary.fold(x, stored.size[axis], stored.tail)[0] - stored.shift)
    total = None
    for term in field.scheme.terms:
        part = _along_axes(values, term, positions, stored.start)
        total = part if total is None else total + part
    assert total is not None
    return total


def _along_axes(values: Tensor, term: Term, positions: list[Tensor], start: int) -> Tensor:
    """One separable term; the axis that shrinks most goes first, so that the passes after it have less to do."""
    axes = sorted(range(3), key=lambda a: positions[a].numel() / values.shape[-1 - a])
    for axis in axes:
        values = _along_axis(values, -1 - axis, positions[axis], term.kernels[axis], start)
    return values if term.weight == 1 else term.weight * values


def _along_axis(values: Tensor, dim: int, positions: Tensor, kernel: PiecewisePolynomial, start: int) -> Tensor:
    """Σ_t weight_t(position) · values[first tap + t] along one axis."""
    first, u = locate(positions, kernel.support, values.shape[dim], start)
    total = None
    for t, weight in tap_weights(u, (kernel, 0), kernel.support).items():
        weight = weight.to(values.dtype).reshape(-1, *(1 for _ in range(-1 - dim)))
        part = weight * values.index_select(dim, first + t)
        total = part if total is None else total + part
    assert total is not None
    return total


def _pointwise(
    field: Field, device: torch.device, shape: tuple[int, int, int], geometry: Geometry, dtype: torch.dtype
) -> Tensor:
    """The field at every voxel centre of an arbitrary grid, in blocks of about a million points."""
    d, h, w = shape
    voxels = d * h * w
    parts = []
    for begin in range(0, voxels, POINTS_AT_ONCE):
        i = torch.arange(begin, min(begin + POINTS_AT_ONCE, voxels), device=device)
        points = geometry.to_world(torch.stack((i % w, i // w % h, i // (w * h)), -1).to(torch.float64)).to(dtype)
        parts.append(field(points if field.channels is None else points[None]))
    samples = torch.cat(parts, -1)
    return samples.reshape(*samples.shape[:-1], *shape)
