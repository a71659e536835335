"""Volumes: samples on a regular grid, with the geometry of the grid, and how it goes on beyond its ends.

Letters used in this file and everywhere else: samples are `(D, H, W)` or `(N, C, D, H, W)`; x runs along W, y along H,
z along D. Points, spacings and origins are in x, y, z order; only tensor shapes are in D, H, W order.
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from typing import TYPE_CHECKING

import numpy as np
import torch
from torch import Tensor

from filterlab.geometry import Geometry
from filterlab.world import UNDECLARED, World

if TYPE_CHECKING:
    from numpy.typing import ArrayLike


class Boundary(StrEnum):
    """How the samples a b c d of an axis go on beyond its ends. Prefilter and evaluator share it.

    ========  ===========================  ======================  ==============================================
    name      extension                    scipy.ndimage           torch grid_sample
    ========  ===========================  ======================  ==============================================
    mirror    d c b | a b c d | c b a      mirror                  reflection, align_corners=True
    reflect   d c b a | a b c d | d c b a  reflect                 reflection, align_corners=False
    wrap      a b c d | a b c d | a b c d  grid-wrap               -
    border    a a a a | a b c d | d d d d  nearest                 border
    zeros     0 0 0 0 | a b c d | 0 0 0 0  grid-constant           zeros
    ========  ===========================  ======================  ==============================================
    """

    MIRROR = "mirror"
    REFLECT = "reflect"
    WRAP = "wrap"
    BORDER = "border"
    ZEROS = "zeros"

    @classmethod
    def named(cls, name: str | Boundary) -> Boundary:
        """The boundary of that name. Raises ValueError that lists the known names."""
        try:
            return cls(name)
        except ValueError:
            raise ValueError(f"boundary must be one of {', '.join(cls)}; got {name!r}") from None

    @property
    def periodic(self) -> bool:
        """True where the extended samples repeat (mirror, reflect, wrap): points can be folded into one period."""
        return self in (Boundary.MIRROR, Boundary.REFLECT, Boundary.WRAP)

    def source(self, index: Tensor, n: int) -> Tensor:
        """The sample in 0 … n−1 that stands at each integer `index` of the extended axis (for zeros: the nearest)."""
        match self:
            case Boundary.MIRROR:
                period = max(2 * n - 2, 1)
                index = index.remainder(period)
                return torch.where(index < n, index, period - index)
            case Boundary.REFLECT:
                index = index.remainder(2 * n)
                return torch.where(index < n, index, 2 * n - 1 - index)
            case Boundary.WRAP:
                return index.remainder(n)
            case _:
                return index.clamp(0, n - 1)

    def extend(self, x: Tensor, dim: int, before: int, after: int) -> Tensor:
        """`x` with its axis `dim` extended by `before` and `after` samples; differentiable in `x`."""
        n = x.shape[dim]
        index = torch.arange(-before, n + after, device=x.device)
        out = x.index_select(dim, self.source(index, n))
        if self is Boundary.ZEROS:
            inside = ((index >= 0) & (index < n)).reshape([-1 if d == dim % x.ndim else 1 for d in range(x.ndim)])
            out = torch.where(inside, out, torch.zeros((), dtype=x.dtype, device=x.device))
        return out

    def period(self, n: int) -> float | None:
        """After how many voxels an axis of n repeats; None: it does not."""
        match self:
            case Boundary.MIRROR:
                return max(2.0 * n - 2, 1.0)
            case Boundary.REFLECT:
                return 2.0 * n
            case Boundary.WRAP:
                return float(n)
            case _:
                return None

    def interval(self, n: int, tail: int) -> tuple[float, float]:
        """(low, high) between which folded coordinates lie."""
        match self:
            case Boundary.MIRROR:
                return 0.0, n - 1.0
            case Boundary.REFLECT:
                return -0.5, n - 0.5
            case Boundary.WRAP:
                return 0.0, float(n)
            case _:
                return -float(tail), n - 1.0 + tail

    def fold(self, x: Tensor, n: int, tail: int) -> tuple[Tensor, Tensor]:
        """Coordinates folded or clamped to where coefficients are stored, and the derivative d folded / d x.

        Args:
            x: coordinates along one axis, in voxels; any finite value folds exactly (fmod); ±inf gives NaN under the
                periodic boundaries and clamps under border and zeros.
            n: voxels along the axis.
            tail: how far beyond the ends coefficients are stored (border and zeros).

        Returns:
            (folded, sign): folded lies in [0, n−1] (mirror), [−½, n−½] (reflect), [0, n] (wrap) or [−tail, n−1+tail];
            points already there are returned bit for bit. sign = d folded / d x, everywhere: +1, −1 where a reflection
            turned the axis round, 0 where the extension is constant.
        """
        low, high = self.interval(n, tail)
        one = x.new_ones(()).expand_as(x)
        if high > low and all_between(x, low, high):
            return x, one
        match self:
            case Boundary.MIRROR if n == 1:
                return torch.where(x.isfinite(), torch.zeros_like(x), torch.full_like(x, torch.nan)), 0 * one
            case Boundary.MIRROR | Boundary.REFLECT:
                return _reflect_at(x, low, high)
            case Boundary.WRAP:
                return torch.where((x >= low) & (x <= high), x, x.remainder(high)), one
            case _:
                return x.clamp(low, high), torch.where((x < low) | (x > high), 0 * one, one)


def all_between(x: Tensor, low: float, high: float) -> bool:
    """Whether every coordinate is known to lie inside: the common case, in which there is nothing to fold.

    Looked at on the CPU only: elsewhere the answer would have to be waited for. False where there is a NaN.
    """
    if x.device.type != "cpu" or x.numel() == 0:
        return False
    least, most = torch.aminmax(x)
    return low <= float(least) and float(most) <= high


def _reflect_at(x: Tensor, low: float, high: float) -> tuple[Tensor, Tensor]:
    """x reflected at `low` and `high` until it lies between, and the sign ±1 of d reflected / d x."""
    period = 2 * (high - low)
    outside = (x < low) | (x > high)
    w = x.fmod(period) - low  # fmod first: it is exact, so 1e8 folds as exactly as 1
    r = w.abs()
    other = (period - r).abs()
    turned = outside & ((w < 0) ^ (other < r) ^ (r > period))
    return torch.where(outside, torch.minimum(r, other) + low, x), 1 - 2 * turned.to(x.dtype)


class Volume:
    """Samples of a scalar (or C-channel) quantity on a regular grid, with geometry.

    Args:
        samples: `(D, H, W)` or `(N, C, D, H, W)`; real, any integer or floating dtype. Kept as it is: neither copied,
            converted nor moved; gradients flow back to it.
        spacing: world length of a voxel along x, y, z; default 1.
        origin: world position of the centre of voxel (0, 0, 0); default 0.
        affine: instead of both, a 4×4 matrix from voxel (x, y, z, 1) to world.
        world: what is declared of the world, for the files that the volume is written to.

    Raises:
        ValueError: wrong number of axes, an axis without voxels, non-positive spacing, singular affine.
        TypeError: samples are no tensor, or complex, boolean, floats of 8 bits or unsigned of more than 8 bits.
    """

    def __init__(
        self,
        samples: Tensor,
        spacing: Sequence[float] | float | None = None,
        origin: Sequence[float] | None = None,
        affine: ArrayLike | Tensor | None = None,
        world: World = UNDECLARED,
    ) -> None:
        self.samples = _checked_samples(samples)
        self.geometry = Geometry.of(spacing, origin, affine, world)

    @classmethod
    def with_geometry(cls, samples: Tensor, geometry: Geometry) -> Volume:
        """A volume on a known geometry."""
        return cls(samples, affine=geometry.affine, world=geometry.world)

    @property
    def shape(self) -> torch.Size:
        return self.samples.shape

    @property
    def size(self) -> tuple[int, int, int]:
        """Voxels along x, y, z (the reverse of the last three axes of `shape`)."""
        d, h, w = self.samples.shape[-3:]
        return w, h, d

    @property
    def batched(self) -> bool:
        """True for `(N, C, D, H, W)` samples."""
        return self.samples.ndim == 5

    @property
    def dtype(self) -> torch.dtype:
        return self.samples.dtype

    @property
    def device(self) -> torch.device:
        return self.samples.device

    @property
    def spacing(self) -> tuple[float, float, float]:
        return self.geometry.spacing

    @property
    def origin(self) -> tuple[float, float, float]:
        return self.geometry.origin

    @property
    def affine(self) -> np.ndarray:
        return self.geometry.affine

    @property
    def world(self) -> World:
        """What is declared of the world."""
        return self.geometry.world

    def to(self, *args, **kwargs) -> Volume:
        """The same volume with `samples.to(...)`."""
        return Volume.with_geometry(self.samples.to(*args, **kwargs), self.geometry)

    def voxel_to_world(self, voxels: Tensor) -> Tensor:
        return self.geometry.to_world(voxels)

    def world_to_voxel(self, points: Tensor) -> Tensor:
        return self.geometry.to_voxel(points)

    def __repr__(self) -> str:
        dtype = str(self.dtype).removeprefix("torch.")
        spacing, origin = ([float(f"{v:.6g}") for v in t] for t in (self.spacing, self.origin))
        return f"Volume(shape={tuple(self.shape)}, dtype={dtype}, spacing={spacing}, origin={origin})"


def _checked_samples(samples: Tensor) -> Tensor:
    if not isinstance(samples, Tensor):
        raise TypeError(f"samples must be a torch.Tensor; got {type(samples).__name__}")
    if samples.ndim not in (3, 5):
        raise ValueError(f"samples must have shape (D, H, W) or (N, C, D, H, W); got {tuple(samples.shape)}")
    if 0 in samples.shape[-3:]:
        raise ValueError(f"every axis of a volume needs at least one voxel; got shape {tuple(samples.shape)}")
    if samples.dtype.is_complex or samples.dtype == torch.bool:
        raise TypeError(f"samples must be real numbers; got {samples.dtype}")
    if samples.dtype in (torch.uint16, torch.uint32, torch.uint64):
        raise TypeError(f"torch cannot index {samples.dtype}; convert: samples.to(torch.int32), int64 or float32")
    if samples.dtype.is_floating_point and samples.dtype.itemsize == 1:
        raise TypeError(f"torch cannot add up {samples.dtype}; convert: samples.to(torch.float16), bfloat16 or float32")
    return samples


def exact_float(samples: Tensor) -> torch.dtype:
    """The smallest of float32 and float64 that holds every one of the samples: float64 for integers beyond 2²⁴.

    Raises:
        ValueError: integers beyond 2⁵³, which no floating type holds.
    """
    if samples.dtype not in (torch.int32, torch.int64) or samples.numel() == 0:
        return torch.promote_types(samples.dtype, torch.float32)
    least, most = (int(v) for v in samples.aminmax())
    if max(-least, most) > 2**53:
        raise ValueError(
            f"expected integers that float64 holds, up to 2⁵³, to compute with; got {most if most > 2**53 else least} "
            "(method 'nearest' and labels=True keep any)"
        )
    return torch.float64 if max(-least, most) > 2**24 else torch.float32


def as_volume(volume: Volume | Tensor) -> Volume:
    """A `Volume` as it is; a bare tensor with voxel centres at the integers. Raises TypeError for anything else."""
    if not isinstance(volume, Volume | Tensor):
        raise TypeError(f"expected a Volume or a torch.Tensor; got {type(volume).__name__}")
    return volume if isinstance(volume, Volume) else Volume(volume)


def from_grid_sample(points: Tensor, shape: Sequence[int], *, align_corners: bool) -> Tensor:
    """`torch.nn.functional.grid_sample` coordinates in [−1, 1] (x, y, z) to voxel coordinates.

    align_corners=True: x = (p+1)/2 · (n−1); False: x = ((p+1) · n − 1)/2. `shape` is (..., D, H, W).
    """
    n = points.new_tensor([int(k) for k in list(shape)[-3:]][::-1])
    return (points + 1) / 2 * (n - 1) if align_corners else ((points + 1) * n - 1) / 2


def from_zyx(points: Tensor) -> Tensor:
    """Points in z, y, x order (as NumPy and scipy index arrays) to x, y, z order."""
    return points.flip(-1)
