"""A volume on another grid, by any method: by rows of matrices where the grids are aligned and the method is separable,
else point by point.

The nearest sample is taken as it stands, in its own type.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from filterlab import prefilters
from filterlab.fields.base import Field
from filterlab.geometry import Geometry
from filterlab.kernels import PiecewisePolynomial, bspline
from filterlab.labels import strongest
from filterlab.methods import METHODS, Method, TensorProduct, Tetrahedral, checked, reconstruct
from filterlab.missing_values import resolved
from filterlab.notices import Notice
from filterlab.ops.contract import Axes, Contraction, Rows
from filterlab.ops.differentiable.contract import contract, fused
from filterlab.ops.differentiable.recording import plain
from filterlab.ops.gather import STORAGE
from filterlab.resampling_rows import Given, reached, rows_of
from filterlab.shrinking import projected, smoothing
from filterlab.sites import NEARER, Part, Sites
from filterlab.volume import Boundary, Volume, as_volume, exact_float

if TYPE_CHECKING:
    from numpy.typing import ArrayLike

Progress = Callable[[float], None]
PARTS = 16  # in which a result is made that needs more than one number a voxel
SMALLEST = 1 << 16  # voxels of one
UNTOLD = 1.25  # voxels of the old grid that a step may have before a warning


class AliasingWarning(Notice):
    """A grid is coarser than that of the samples, and nothing is said of what it does not hold."""

    def __init__(self, steps: float) -> None:
        self._what = (
            f"the new grid has steps of up to {steps:.3g} voxels: frequencies that it does not hold are aliased"
        )
        super().__init__(f"{self._what}; antialias=True leaves them out, antialias=False says that this is known")

    @property
    def on_command_line(self) -> str:
        return f"{self._what}; --antialias leaves them out"


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
    antialias: bool | None = None,
    progress: Progress | None = None,
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
        antialias: on a coarser grid, the values of the cubic spline of that grid which is nearest to the reconstruction
            in L², so that frequencies it does not hold are left out (`filterlab.shrinking`); along axes that do not
            shrink nothing changes. With `labels`, of their indicators. False: the reconstruction itself at the new
            voxels, in which such frequencies are aliased. Default: False, with a warning where steps are longer than
            1.25 voxels.
        progress: told what part is done, 0 … 1.

    Exactly one of spacing, shape and like must be given, or none with an affine. Memory beyond input and output, where
    no derivative is asked: on aligned grids a tenth of the output in float32, up to 0.7 of it where that is small or
    more than one number a voxel is needed; on turned grids and on tetrahedra the coefficients, too, with `antialias`
    the samples in float32.

    Returns:
        a Volume, differentiable in the samples.

    Raises:
        ValueError: also for integers that the type of the computation does not hold; and where no new voxel lies in the
            old box, unless the boundary is `wrap` or there is a `fill`.
    """
    volume, boundary, method = as_volume(volume), Boundary.named(boundary), checked(method, prefilter)
    if affine is not None and spacing is None and shape is None and like is None:
        like = volume
    target_shape, geometry = _target(volume, spacing, shape, None if like is None else as_volume(like))
    if affine is not None:
        volume = Volume.with_geometry(volume.samples, volume.geometry.moved(affine))
    sites = Sites.of(volume, target_shape, geometry)
    elsewhere = like is not None or affine is not None
    if elsewhere and fill is None and boundary is not Boundary.WRAP and not sites.meet_box:
        raise ValueError(
            f"expected grids that overlap; got {volume} and, with no voxel in its box, one of shape {target_shape}, "
            f"spacing {[float(f'{s:.6g}') for s in geometry.spacing]}, "
            f"origin {[float(f'{v:.6g}') for v in geometry.origin]} (or give fill)"
        )
    if not elsewhere:
        fill = None
    how = _How(method, prefilter, boundary, _antialiased(antialias, method, labels, sites))
    if labels or method is METHODS["nearest"]:
        if dtype not in (None, volume.dtype):
            raise ValueError(f"nearest samples and labels keep their type, {volume.dtype}; got dtype={dtype}")
        samples = volume.samples if nan == "propagate" else resolved(volume.samples, nan)[0]
        check_fill(fill, str(volume.dtype).removeprefix("torch."))
        take = _labelled(samples, how, sites, progress) if labels else _nearest(samples, boundary, sites)
        return Volume.with_geometry(_made(take, samples, sites, volume.dtype, fill, progress), geometry)
    dtype = _type_of_result(volume.samples, dtype)
    working = torch.promote_types(dtype, torch.float32)
    samples, unknown = resolved(volume.samples, nan)
    if how.antialias and not how.composed(sites):
        samples = contract(samples, _smoothing(how, sites, working), working)
    if sites.aligned and isinstance(method, TensorProduct):
        contraction = _contraction(how, sites, working)
        at_once = unknown is None and fill is None and progress is None
        if at_once and dtype == working and fused(samples, contraction):
            return Volume.with_geometry(contract(samples, contraction, working), geometry)
        take = _contracted(samples, contraction, working)
        if unknown is not None:
            take = _with_unknown(take, unknown, _reached(how, sites))
    else:
        samples = samples if torch.promote_types(samples.dtype, torch.float32) == working else samples.to(working)
        if unknown is not None:  # they were filled; the field is to know them
            samples = samples.masked_fill(unknown, torch.nan)
        take = _pointwise(reconstruct(samples, method, boundary=boundary, prefilter=prefilter, nan=nan), sites, working)
    return Volume.with_geometry(_made(take, samples, sites, dtype, fill, progress), geometry)


@dataclass(frozen=True)
class _How:
    """A method and how it is used; see `resample`."""

    method: Method
    prefilter: bool
    boundary: Boundary
    antialias: bool

    def composed(self, sites: Sites) -> bool:
        """Whether values are rows of one kernel along each axis, of which a low-pass can be a part."""
        return sites.aligned and isinstance(self.method, TensorProduct) and self.method.terms is None

    def smooths(self, sites: Sites, axis: int) -> bool:
        """Whether an axis shrinks, and is not to be aliased."""
        return self.antialias and sites.size[axis] > 1 and sites.steps[axis] > 1 + NEARER

    def given(self, kernel: PiecewisePolynomial, dtype: torch.dtype) -> Given:
        """How samples are reconstructed along an axis by a kernel of the method."""
        own = self.method.prefilter if isinstance(self.method, TensorProduct | Tetrahedral) else prefilters.IDENTITY
        return Given(kernel, own if self.prefilter else prefilters.IDENTITY, self.boundary, dtype)


def _antialiased(antialias: bool | None, method: Method, labels: bool, sites: Sites) -> bool:
    """Raises ValueError where it is asked for and makes no sense; warns where it is not, and is likely to be missed."""
    taken = method is METHODS["nearest"] and not labels
    if antialias and taken:
        raise ValueError("antialias=True needs another method, or labels=True: nearest samples are taken as they stand")
    longest = max((s for s, n in zip(sites.steps, sites.size, strict=True) if n > 1), default=0.0)
    if antialias is None and not taken and longest > UNTOLD:
        warnings.warn(AliasingWarning(longest), stacklevel=3)
    return bool(antialias)


def _type_of_result(samples: Tensor, dtype: torch.dtype | None) -> torch.dtype:
    """Raises ValueError for a type that is none to compute in, or does not hold the samples."""
    needed = exact_float(samples)
    dtype = dtype or needed
    if not dtype.is_floating_point:
        raise ValueError(f"dtype must be a floating type (round and clip the result for {dtype}); got {dtype}")
    if needed == torch.float64 and dtype != needed and not samples.dtype.is_floating_point:
        raise ValueError(f"{dtype} does not hold the integers of this volume exactly; float64 does")
    return dtype


def check_fill(fill: float | None, dtype: str, name: str = "fill") -> None:
    """Raises ValueError for a fill that no number of a type is: a name of NumPy's or torch's."""
    if fill is None or "float" in dtype:
        return
    info = np.iinfo(dtype)
    if not (math.isfinite(fill) and fill == int(fill) and info.min <= fill <= info.max):
        raise ValueError(f"expected a {name} that {dtype} holds; got {fill:g}")


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


# --- parts ------------------------------------------------------------------------------------------------------------

Take = Callable[[Part], Tensor]
"""A part of the new grid -> its samples (..., planes, lines, W)."""


def _made(
    take: Take,
    samples: Tensor,
    sites: Sites,
    dtype: torch.dtype,
    fill: float | None,
    progress: Progress | None = None,
) -> Tensor:
    """All parts of the result, one after the other where no derivative is asked: temporaries are those of a part."""
    if not plain(samples):
        return _finished(take, sites.everything, sites, dtype, fill)
    out = samples.new_empty((*samples.shape[:-3], *sites.shape), dtype=dtype)
    parts = list(sites.parts(max(SMALLEST, math.prod(sites.shape) // PARTS)))
    for done, part in enumerate(parts, start=1):
        out[(..., *part, slice(None))] = _finished(take, part, sites, dtype, fill)
        if progress is not None:
            progress(done / len(parts))
    return out


def _finished(take: Take, part: Part, sites: Sites, dtype: torch.dtype, fill: float | None) -> Tensor:
    samples = take(part).to(dtype)
    return samples if fill is None else samples.masked_fill(sites.outside(part), fill)


# --- separable methods on aligned grids -------------------------------------------------------------------------------


def _contraction(how: _How, sites: Sites, dtype: torch.dtype) -> Contraction:
    """The matrices that turn samples into values at the sites."""
    assert isinstance(how.method, TensorProduct)
    terms = []
    for term in how.method.separable:
        x, y, z = (_rows(how, sites, axis, how.given(kernel, dtype)) for axis, kernel in enumerate(term.kernels))
        terms.append((x.scaled(term.weight), y, z))
    return Contraction(terms)


def _rows(how: _How, sites: Sites, axis: int, given: Given) -> Rows:
    x, n = sites.along(axis), sites.size[axis]
    if how.smooths(sites, axis) and how.composed(sites):
        return projected(x, float(sites.matrix[axis, axis]), n, given)
    return rows_of(x, n, given)


def _smoothing(how: _How, sites: Sites, dtype: torch.dtype) -> Contraction:
    """The matrices of a low-pass of the samples where they are, for what comes after."""
    given = how.given(how.method.kernel if isinstance(how.method, TensorProduct) else bspline(2), dtype)
    x, y, z = (
        smoothing(sites.steps[axis], n, given) if how.smooths(sites, axis) else Rows.identity(n)
        for axis, n in enumerate(sites.size)
    )
    return Contraction([(x, y, z)])


def _contracted(samples: Tensor, contraction: Contraction, dtype: torch.dtype) -> Take:
    def take(part: Part) -> Tensor:
        own, (planes, lines) = contraction.part(*part)
        needed = samples[..., planes, lines, :]
        return contract(needed if needed.dtype in STORAGE else needed.to(dtype), own, dtype)

    return take


def _reached(how: _How, sites: Sites) -> Contraction:
    """The same with 1 for every coefficient that a kernel reaches, without prefilter: one of the coarser grid."""
    assert isinstance(how.method, TensorProduct)
    terms: list[Axes] = []
    for term in how.method.separable:
        widths = (k.support * (sites.steps[a] if how.smooths(sites, a) else 1) for a, k in enumerate(term.kernels))
        x, y, z = (reached(sites.along(a), sites.size[a], width, how.boundary) for a, width in enumerate(widths))
        terms.append((x, y, z))
    return Contraction(terms)


def _with_unknown(take: Take, unknown: Tensor, reached: Contraction) -> Take:
    """NaN where a kernel reaches a voxel that is unknown."""
    number = _contracted(unknown.view(torch.uint8), reached, torch.float32)
    return lambda part: take(part).masked_fill(number(part) > 0, torch.nan)


# --- other methods, and turned grids ----------------------------------------------------------------------------------


def _pointwise(field: Field, sites: Sites, dtype: torch.dtype) -> Take:
    """A field in voxel coordinates at the sites, a few lines at a time."""

    def take(part: Part) -> Tensor:
        points = (p.to(dtype) for p in sites.points(part))
        samples = torch.cat([field(p if field.channels is None else p[None]) for p in points], -1)
        return samples.reshape(*samples.shape[:-1], part[0].stop - part[0].start, -1, sites.shape[2])

    return take


# --- samples as they stand --------------------------------------------------------------------------------------------


def _nearest(samples: Tensor, boundary: Boundary, sites: Sites) -> Take:
    """The sample nearest to every site; halfway between two of them, the later."""

    def take_along_axes(part: Part) -> Tensor:
        out = samples
        for axis, own in ((2, part[0]), (1, part[1]), (0, slice(None))):
            index, inside = _chosen(sites.along(axis)[own].to(samples.device), sites.size[axis], boundary)
            out = out.index_select(-1 - axis, index)
            if not inside.all():
                out = out.masked_fill(~inside.reshape(-1, *(1 for _ in range(axis))), 0)
        return out

    def take_points(part: Part) -> Tensor:
        parts = []
        for points in sites.points(part):
            x, y, z = (_chosen(p, n, boundary) for p, n in zip(points.unbind(-1), sites.size, strict=True))
            parts.append(samples[..., z[0], y[0], x[0]].masked_fill(~(x[1] & y[1] & z[1]), 0))
        out = torch.cat(parts, -1)
        return out.reshape(*out.shape[:-1], part[0].stop - part[0].start, -1, sites.shape[2])

    return take_along_axes if sites.aligned else take_points


def _chosen(x: Tensor, n: int, boundary: Boundary) -> tuple[Tensor, Tensor]:
    """The sample of an axis of n that is nearest to each coordinate, and whether it is one: zeros has others beyond."""
    index = (x + (0.5 + NEARER)).floor().long()
    inside = (index >= 0) & (index < n) if boundary is Boundary.ZEROS else torch.ones_like(index, dtype=torch.bool)
    return boundary.source(index, n), inside


def _labelled(samples: Tensor, how: _How, sites: Sites, progress: Progress | None) -> Take:
    """The label that a method finds strongest at every site."""
    if isinstance(how.method, TensorProduct) and sites.aligned and (how.composed(sites) or not how.antialias):
        return _labelled_in_parts(samples, _contraction(how, sites, torch.float32), how.boundary)

    def resampled(indicator: Tensor) -> Tensor:
        values = indicator.float()
        if how.antialias:
            values = contract(values, _smoothing(how, sites, torch.float32), torch.float32)
        field = reconstruct(values, how.method, boundary=how.boundary, prefilter=how.prefilter)
        return _made(_pointwise(field, sites, torch.float32), indicator, sites, torch.float32, None)

    whole = strongest(samples, resampled, how.boundary, progress or (lambda part: None))
    return lambda part: whole[(..., *part, slice(None))]


def _labelled_in_parts(samples: Tensor, contraction: Contraction, boundary: Boundary) -> Take:
    """Of every part only the labels that it depends on."""

    def take(part: Part) -> Tensor:
        own, (planes, lines) = contraction.part(*part)
        needed = samples[..., planes, lines, :]
        return strongest(needed, lambda i: contract(i.view(torch.uint8), own, torch.float32), boundary)

    return take
