"""A volume on another grid, by any method: separable where the grids are aligned and the method is, else pointwise.

The nearest sample is taken as it stands, in its own type.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from filterlab.fields.base import Field
from filterlab.fields.grid import GridField, Term
from filterlab.kernels import PiecewisePolynomial
from filterlab.labels import strongest
from filterlab.methods import METHODS, Method, as_method, reconstruct
from filterlab.missing_values import resolved
from filterlab.ops.reference.gather import locate, tap_weights
from filterlab.volume import Boundary, Geometry, Volume, as_volume, exact_float

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

Progress = Callable[[float], None]
POINTS_AT_ONCE = 1 << 20
NEARER = 1e-9  # voxels within which two coordinates are the same: what is halfway between samples, or on the box


def resample(
    volume: Volume | Tensor,
    method: str | Method | PiecewisePolynomial = "triquadratic",
    *,
    spacing: Sequence[float] | float | None = None,
    shape: Sequence[int] | None = None,
    like: Volume | None = None,
    affine: ArrayLike | None = None,
    boundary: str | Boundary = Boundary.MIRROR,
    prefilter: bool = True,
    dtype: torch.dtype | None = None,
    nan: str = "refuse",
    labels: bool = False,
    fill: float | None = None,
    progress: Progress = lambda part: None,
) -> Volume:
    """The volume reconstructed by a method and sampled on another grid.

    Args:
        volume: a `Volume` or a bare tensor (D, H, W) or (N, C, D, H, W).
        method, boundary, prefilter, nan: as for `reconstruct`.
        spacing: new voxel edges along x, y, z (world units). The spacing is kept exactly and the new grid is centred on
            the old box of voxels; along an axis of length n·s it has max(1, round(n·s/spacing)) voxels.
        shape: new (D, H, W). The box of voxels is kept exactly, the spacing follows.
        like: a volume whose grid is taken over, wherever it lies (rotated too); outside the old box the boundary rules.
        affine: a 4×4 matrix that moves the volume first: what was at the world point p is at affine · (p, 1). The new
            grid is told as if nothing had moved; with none of spacing, shape and like it is the volume's own. A
            constant; `io.load_affine` reads those of ITK and FSL.
        dtype: floating type of the computation and the result; default promote(volume.dtype, float32), and float64 for
            integers that float32 does not hold. With `nearest` and with `labels`: the volume's.
        labels: every value is a name. Of each the indicator is resampled, and the one that is greatest wins, of equal
            ones the least: no value arises that the volume has not. Takes as long as resampling once for every label,
            in the memory of one. Not differentiable.
        fill: the value of new voxels whose centres lie outside of the old box of voxels, which ends half a voxel beyond
            the outermost centres; NaN too. Default: none, the boundary rules there.
        progress: told what part is done, 0 … 1.

    Exactly one of spacing, shape and like must be given, or none with an affine. This reconstructs, it does not
    anti-alias: when the new grid is coarser than the old one, blur first. Cost: one pass of S taps per axis; memory:
    about two volumes of the larger size.

    Returns:
        a Volume, differentiable in the samples.

    Raises:
        ValueError: also for integers that the type of the computation does not hold; and where no new voxel lies in the
            old box, unless the boundary is `wrap` or there is a `fill`.
    """
    volume, boundary = as_volume(volume), Boundary.named(boundary)
    if affine is not None and spacing is None and shape is None and like is None:
        like = volume
    target_shape, geometry = _target(volume, spacing, shape, None if like is None else as_volume(like))
    if affine is not None:
        volume = Volume.with_geometry(volume.samples, volume.geometry.moved(affine))
    outside = _outside(volume, target_shape, geometry) if like is not None or affine is not None else None
    if outside is not None and fill is None and boundary is not Boundary.WRAP and bool(outside.all()):
        raise ValueError(
            f"expected grids that overlap; got {volume} and, with no voxel in its box, one of shape {target_shape}, "
            f"spacing {[float(f'{s:.6g}') for s in geometry.spacing]}, "
            f"origin {[float(f'{v:.6g}') for v in geometry.origin]} (or give fill)"
        )
    if labels or as_method(method) is METHODS["nearest"]:
        if dtype not in (None, volume.dtype):
            raise ValueError(f"nearest samples and labels keep their type, {volume.dtype}; got dtype={dtype}")
        take = _labelled(method, prefilter, progress) if labels else _nearest
        complete = Volume.with_geometry(_complete(volume.samples, nan), volume.geometry)
        _check_fill(fill, volume.dtype)
        samples = take(complete, target_shape, geometry, boundary)
        progress(1.0)
        return Volume.with_geometry(_filled(samples, outside, fill), geometry)
    needed = exact_float(volume.samples)
    dtype = dtype or needed
    if not dtype.is_floating_point:
        raise ValueError(f"dtype must be a floating type (round and clip the result for {dtype}); got {dtype}")
    if needed == torch.float64 and dtype != needed and not volume.dtype.is_floating_point:
        raise ValueError(f"{dtype} does not hold the integers of this volume exactly; float64 does")
    working = torch.promote_types(dtype, torch.float32)
    field = reconstruct(
        volume if volume.dtype == working else volume.to(working),
        method,
        boundary=boundary,
        prefilter=prefilter,
        nan=nan,
    )
    samples = _sampled(field, volume, target_shape, geometry, working, progress)
    progress(1.0)
    return Volume.with_geometry(_filled(samples.to(dtype), outside, fill), geometry)


def _outside(volume: Volume, shape: tuple[int, int, int], geometry: Geometry) -> Tensor:
    """Which voxel centres of another grid lie outside of a volume's box of voxels, (D, H, W)."""
    device = volume.samples.device
    steps = _aligned(volume.geometry, geometry)
    if steps is not None:
        out = torch.zeros((1, 1, 1), dtype=torch.bool, device=device)
        for axis, (n, old) in enumerate(zip(shape[::-1], volume.size, strict=True)):
            x = float(steps[0][axis]) * torch.arange(n, dtype=torch.float64, device=device) + float(steps[1][axis])
            out = out | _beyond(x, old).reshape(-1, *(1 for _ in range(axis)))
        return out.expand(shape)
    parts = []
    for positions in _positions(volume, shape, geometry):
        x, y, z = (_beyond(p, n) for p, n in zip(positions, volume.size, strict=True))
        parts.append(x | y | z)
    return torch.cat(parts).reshape(shape)


def _beyond(x: Tensor, n: int) -> Tensor:
    return (x < -0.5 - NEARER) | (x > n - 0.5 + NEARER)


def _positions(
    volume: Volume, shape: tuple[int, int, int], geometry: Geometry
) -> Iterator[tuple[Tensor, Tensor, Tensor]]:
    """Voxel coordinates x, y, z in a volume of the voxel centres of another grid, a million at a time."""
    d, h, w = shape
    device = volume.samples.device
    matrix = torch.from_numpy(np.linalg.solve(volume.affine, geometry.affine)).to(device)
    for begin in range(0, d * h * w, POINTS_AT_ONCE):
        i = torch.arange(begin, min(begin + POINTS_AT_ONCE, d * h * w), device=device)
        voxels = torch.stack((i % w, i // w % h, i // (w * h)), -1).to(torch.float64)
        x, y, z = (voxels @ matrix[:3, :3].T + matrix[:3, 3]).unbind(-1)
        yield x, y, z


def _check_fill(fill: float | None, dtype: torch.dtype) -> None:
    """Raises ValueError for a fill that the type of the result does not hold."""
    if fill is None or dtype.is_floating_point:
        return
    info = torch.iinfo(dtype)
    if fill != fill or fill in (math.inf, -math.inf) or fill != int(fill) or not info.min <= fill <= info.max:
        raise ValueError(f"expected a fill that {dtype} holds; got {fill!r}")


def _filled(samples: Tensor, outside: Tensor | None, fill: float | None) -> Tensor:
    return samples if outside is None or fill is None else samples.masked_fill(outside, fill)


def _sampled(
    field: Field,
    volume: Volume,
    shape: tuple[int, int, int],
    geometry: Geometry,
    dtype: torch.dtype,
    progress: Progress = lambda part: None,
) -> Tensor:
    """The field of a volume at the voxel centres of another grid."""
    steps = _aligned(volume.geometry, geometry)
    if isinstance(field, GridField) and field.scheme.terms and steps is not None:
        return _separable(field, shape, *steps, dtype)
    return _pointwise(field, volume.samples.device, shape, geometry, dtype, progress)


def _aligned(old: Geometry, new: Geometry) -> tuple[np.ndarray, np.ndarray] | None:
    """(scale, start) with old voxel = scale · new voxel + start, along each axis; None: axes are mixed."""
    steps = np.linalg.solve(old.affine, new.affine)
    off_axis = np.abs(steps[:3, :3] - np.diag(np.diag(steps[:3, :3]))).max()
    if off_axis > 1e-12 * np.abs(steps[:3, :3]).max():
        return None
    return np.diag(steps)[:3], steps[:3, 3]


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
    field: Field,
    device: torch.device,
    shape: tuple[int, int, int],
    geometry: Geometry,
    dtype: torch.dtype,
    progress: Progress,
) -> Tensor:
    """The field at every voxel centre of an arbitrary grid, in blocks of about a million points."""
    d, h, w = shape
    voxels = d * h * w
    parts = []
    for begin in range(0, voxels, POINTS_AT_ONCE):
        i = torch.arange(begin, min(begin + POINTS_AT_ONCE, voxels), device=device)
        points = geometry.to_world(torch.stack((i % w, i // w % h, i // (w * h)), -1).to(torch.float64)).to(dtype)
        parts.append(field(points if field.channels is None else points[None]))
        progress(min(begin + POINTS_AT_ONCE, voxels) / voxels)
    samples = torch.cat(parts, -1)
    return samples.reshape(*samples.shape[:-1], *shape)


# --- samples as they stand --------------------------------------------------------------------------------------------


def _complete(samples: Tensor, nan: str) -> Tensor:
    """The samples with those that are missing filled in, or as they are where they may stay. Raises ValueError."""
    return samples if nan == "propagate" else resolved(samples, nan)[0]


def _nearest(volume: Volume, shape: tuple[int, int, int], geometry: Geometry, boundary: Boundary) -> Tensor:
    """The sample nearest to every voxel centre of another grid; halfway between two of them, the later."""
    steps = _aligned(volume.geometry, geometry)
    if steps is not None:
        return _nearest_along_axes(volume, shape, steps, boundary)
    parts = []
    for positions in _positions(volume, shape, geometry):
        found = [_chosen(p, n, boundary) for p, n in zip(positions, volume.size, strict=True)]
        part = volume.samples[..., found[2][0], found[1][0], found[0][0]]
        parts.append(part * (found[0][1] & found[1][1] & found[2][1]))
    samples = torch.cat(parts, -1)
    return samples.reshape(*samples.shape[:-1], *shape)


def _nearest_along_axes(
    volume: Volume, shape: tuple[int, int, int], steps: tuple[np.ndarray, np.ndarray], boundary: Boundary
) -> Tensor:
    samples = volume.samples
    for axis, n in enumerate(shape[::-1]):
        x = float(steps[0][axis]) * torch.arange(n, dtype=torch.float64, device=samples.device) + float(steps[1][axis])
        index, inside = _chosen(x, volume.size[axis], boundary)
        samples = samples.index_select(-1 - axis, index) * inside.reshape(-1, *(1 for _ in range(axis)))
    return samples


def _chosen(x: Tensor, n: int, boundary: Boundary) -> tuple[Tensor, Tensor]:
    """The sample of an axis of n that is nearest to each coordinate, and whether it is one: zeros has others beyond."""
    index = (x + (0.5 + NEARER)).floor().long()
    inside = (index >= 0) & (index < n) if boundary is Boundary.ZEROS else torch.ones_like(index, dtype=torch.bool)
    return boundary.source(index, n), inside


def _labelled(
    method: str | Method | PiecewisePolynomial, prefilter: bool, progress: Progress
) -> Callable[[Volume, tuple[int, int, int], Geometry, Boundary], Tensor]:
    """What takes, at every voxel of another grid, the label that a method finds strongest."""

    def labelled(volume: Volume, shape: tuple[int, int, int], geometry: Geometry, boundary: Boundary) -> Tensor:
        def resampled(indicator: Tensor) -> Tensor:
            field = reconstruct(
                Volume.with_geometry(indicator, volume.geometry), method, boundary=boundary, prefilter=prefilter
            )
            return _sampled(field, volume, shape, geometry, torch.float32)

        return strongest(volume.samples, resampled, boundary, progress)

    return labelled
