"""Direct volume rendering of any Field: emission and absorption along rays, in plain torch.

    rays ─▶ (t_near, t_far) ─▶ samples ─▶ transfer function ─▶ shading ─▶ compositing

Letters: R rays, K samples of each ray in a block, S = samples of a block that exist (no more than R K), s the length of
a segment, τ its optical depth, T transmittance. Geometry (rays, distances) is float64; samples are `dtype`.

How work is cut up never changes a number: blocks have K consecutive segments of a ray wherever the tile's edge is, sums
over them have a fixed order, and jitter is a hash of the pixel number.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import SupportsFloat

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from filterlab.fields.base import Field
from filterlab.fields.grid import GridField
from filterlab.render.camera import Camera, check_size
from filterlab.render.rays import Region, check_rays, check_region, intersect, jitter, segment_count, segments
from filterlab.render.shading import Shading
from filterlab.render.transfer import TransferFunction

Rays = tuple[Tensor, Tensor]
Progress = bool | None | Callable[[int, int], None]

BLOCK = 32  # K, consecutive segments of a ray that are composited together; a power of two
_FLOATS_PER_SAMPLE = 160  # what a field of 27 taps and the marcher hold at a time, measured
_FLOATS_PER_SAMPLE_SAVED = 1000  # the same while autograd records them
_BYTES_PER_RAY = 256
_LARGEST_BLOCK = 2**18  # samples; more would only leave the caches


def render(
    field: Field,
    camera: Camera | Rays,
    transfer: TransferFunction,
    *,
    size: Sequence[int] | None = None,
    step: float = 0.5,
    shading: Shading | None = None,
    background: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
    region: Region | None = None,
    jitter_seed: int | None = None,
    termination: float | None = None,
    dtype: torch.dtype = torch.float32,
    device: torch.device | str | None = None,
    max_samples: int = 2**34,
    memory: int = 2**28,
    progress: Progress = False,
) -> Tensor:
    """The image of a field, by emission and absorption.

    Every ray is cut, between where it enters and leaves the field's domain, into ⌈length/step⌉ segments of which only
    the last is shorter; segment i is a homogeneous medium with what its midpoint has:

        C = Σ_i T_i (1 − e^{−τ_i}) c_i + T background,   T_i = exp(−Σ_{j<i} τ_j),   τ_i = −log1p(−α_i) s_i / unit

    so that a constant medium has opacity 1 − e^{−τ} at any step, and the error falls with the square of the step.

    Args:
        field: a field or signal. Of a batched one, (N, C), every entry and channel gives an image of its own, by the
            same camera, transfer function and lights.
        camera: a Camera, or (origins, directions) `(..., 3)` world rays; directions need not be unit vectors.
        transfer: scalar -> colour c and opacity α per unit.
        size: (width, height) of the image; only with a Camera.
        step: in voxels of the field (its `domain.voxel_size`).
        shading: lights; None is unlit, and then no gradient is computed. Lit, and without derivatives asked, gradients
            are computed only where a sample is visible.
        background: linear RGB behind the volume; may require grad.
        region: a world-space box (lower, upper) outside of which nothing is seen.
        jitter_seed: moves the segments of every pixel by its own fraction of a step, drawn by a hash of seed and pixel
            number: noise instead of rings, and the same image on every machine and for every `memory`.
        termination: stop a ray when no more than this much can change. The image differs by at most `termination` in
            every component. None never stops before a ray is exactly opaque. Ignored when derivatives are asked.
        dtype: float32 or float64, of samples and image.
        device: where to compute; default where the camera, rays or transfer function are.
        max_samples: refuse images of more samples (of all images together).
        memory: bytes that rays and samples in work may take, roughly.
        progress: True shows a progress bar on stderr, None only if that is a terminal; or a function (done, total).

    Returns:
        `(H, W, 4)` (or `(..., 4)` for rays): linear RGB *over the background*, and opacity 1 − T. The image over
        another background b is rgb + (1 − opacity) (b − background). A NaN of the field makes its pixel NaN. A batched
        field gives `(N, C, H, W, 4)` (or `(N, C, ..., 4)`), each image with the bits that its own volume would give.

        Differentiable (twice) in whatever the field was built from, camera pose or rays, transfer function, shading and
        background. Blocks of samples are recomputed in the backward pass, so that memory stays bounded then too.

        Differentiate with torch.autograd: the transforms `torch.func.grad`, `vjp` and `vmap` of `render` itself are not
        supported and raise torch's own RuntimeError. The first two do not allow the recomputation (it saves tensors
        through hooks); and how many samples exist and which are seen, hence the shapes, depends on the data, which vmap
        does not allow. Instead of vmap, give a batched field.

    Raises:
        TypeError: a field, camera, transfer function or shading of another type.
        ValueError: an empty batch, rays that are not finite, a step that is not positive, more than `max_samples`
            samples (found before anything is rendered), and other arguments out of range.

    Source: Max, Optical models for direct volume rendering, 1995; step and opacity as in Engel et al., Real-Time Volume
    Graphics, 2006.
    """
    _check_arguments(field, camera, transfer, shading, step, termination, dtype, max_samples, memory)
    device = torch.device(device or _device_of(camera, transfer))
    view = _View.of(camera, size, device)
    color = _check_background(background, dtype, device)
    box = None if region is None else check_region(region)
    differentiable = torch.is_grad_enabled() and (
        view.requires_grad
        or transfer.requires_grad
        or color.requires_grad
        or (shading is not None and shading.requires_grad)
        or _depends_on_parameters(field, dtype, device)
    )
    brightest = transfer.brightest if shading is None else shading.brightest(transfer.brightest)
    brightest = max(brightest, float(color.detach().max()), 1.0)
    marcher = _Marcher(
        field=field,
        transfer=transfer.to(dtype, device),
        shading=shading,
        step=step * field.domain.voxel_size,
        region=box,
        jitter_seed=jitter_seed,
        faint=0.0 if termination is None or differentiable else termination / brightest,
        dtype=dtype,
        differentiable=differentiable,
        rays_at_once=_rays_at_once(memory, dtype, differentiable),
    )
    tile = marcher.rays_at_once if differentiable else max(marcher.rays_at_once, memory // (4 * _BYTES_PER_RAY))
    fields = _unbatched(field)
    with torch.set_grad_enabled(differentiable):
        total = marcher.count(view, tile, len(fields), max_samples)
        with _reporting(progress, total) as report:
            done, tiles = 0, []
            for one in fields:
                marcher = replace(marcher, field=one)
                for pixels in view.pixels.split(tile):
                    emitted, depth = marcher.march(view, pixels, lambda n, done=done: report(done + n))
                    done += marcher.samples_done
                    tiles.append(_over(emitted, depth[:, None], color))
            report(total)
    return torch.cat(tiles).reshape(*(field.channels or ()), *view.shape, 4)


def _unbatched(field: Field) -> list[Field]:
    """The field, or those of all entries and channels of a batched one, in the order of (N, C)."""
    if field.channels is None:
        return [field]
    entries, channels = field.channels
    select = field.select if isinstance(field, GridField) else lambda n, c: _Selected(field, n, c)
    return [select(n, c) for n in range(entries) for c in range(channels)]


class _Selected(Field):
    """Entry n and channel c of any batched field; costs as much as the whole field."""

    def __init__(self, field: Field, n: int, c: int) -> None:
        self.field, self.n, self.c = field, n, c
        self.domain, self.max_order = field.domain, field.max_order

    def jet(self, points: Tensor, order: int) -> tuple[Tensor, ...]:
        return tuple(x[self.n, self.c] for x in self.field.jet(points[None], order))


@dataclass(frozen=True)
class _View:
    """The rays of an image, numbered; made where they are needed, a tile at a time."""

    shape: tuple[int, ...]
    pixels: Tensor
    rays: Callable[[Tensor], Rays]
    requires_grad: bool

    @classmethod
    def of(cls, camera: Camera | Rays, size: Sequence[int] | None, device: torch.device) -> _View:
        if isinstance(camera, Camera):
            if size is None:
                raise ValueError("size=(width, height) is needed with a camera")
            width, height = check_size(size)
            pixels = torch.arange(width * height, device=device)
            return cls((height, width), pixels, lambda p: camera.pixel_rays(p, width, height), camera.requires_grad)
        if size is not None:
            raise ValueError(f"size goes with a camera; rays bring their own shape; got size={size!r}")
        origins, directions = camera
        o, d = (r.reshape(-1, 3).to(device) for r in check_rays(origins, directions))
        requires_grad = o.requires_grad or d.requires_grad
        pixels = torch.arange(len(o), device=device)
        return cls(tuple(origins.shape[:-1]), pixels, lambda p: (o[p], d[p]), requires_grad)


@dataclass
class _Marcher:
    """Marches tiles of rays through a field; all lengths are world lengths here."""

    field: Field
    transfer: TransferFunction
    shading: Shading | None
    step: float
    region: Region | None
    jitter_seed: int | None
    faint: float  # transmittance below which a ray ends; 0: only at exactly 0
    dtype: torch.dtype
    differentiable: bool
    rays_at_once: int
    samples_done: int = 0

    def __post_init__(self) -> None:
        # gradients come in one pass with values when nearly every sample needs one: when derivatives are asked, or
        # when no value is transparent
        self.one_pass = self.shading is not None and (self.differentiable or not self.transfer.transparent_somewhere)

    def inside(self, view: _View, pixels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Where the rays of `pixels` `(R,)` enter the domain `(R, 3)`, their directions and lengths inside `(R,)`."""
        origins, directions = view.rays(pixels)
        near, far = intersect(origins, directions, self.field.domain, self.region)
        hit = far.detach() > near.detach()
        length = torch.where(hit, far - near, torch.zeros_like(far))
        near = torch.where(hit, near, torch.zeros_like(near))
        return origins + near[:, None] * directions, directions, length

    def offset(self, pixels: Tensor) -> Tensor:
        """How far into a step the first segment reaches, `(R,)`, in (0, 1]."""
        if self.jitter_seed is None:
            return torch.ones_like(pixels, dtype=torch.float64)
        return jitter(self.jitter_seed, pixels)

    @torch.no_grad()
    def count(self, view: _View, tile: int, images: int, limit: int) -> int:
        """How many samples the images take. Raises ValueError above `limit`."""
        total = 0.0
        for pixels in view.pixels.split(tile):
            total += float(segment_count(self.inside(view, pixels)[2], self.step, self.offset(pixels)).sum())
        total *= images
        if not total <= limit:
            raise ValueError(
                f"the image would take {total:.3g} samples; the limit is max_samples={limit:.3g}: "
                "use a longer step, a smaller image or region, or raise max_samples"
            )
        return int(total)

    def march(self, view: _View, pixels: Tensor, report: Callable[[int], None]) -> tuple[Tensor, Tensor]:
        """Emitted light `(R, 3)` and optical depth `(R,)` of the rays through `pixels`, float64."""
        if self.differentiable:
            entry, direction, length = checkpoint(self.inside, view, pixels, use_reentrant=False)  # type: ignore[misc]
        else:
            entry, direction, length = self.inside(view, pixels)
        offset = self.offset(pixels)
        count = segment_count(length, self.step, offset).long()
        light = torch.zeros_like(entry)
        depth = torch.zeros_like(length)
        alive = (count > 0).nonzero()[:, 0]
        first, self.samples_done = 0, 0
        while len(alive):
            for rays in alive.split(self.rays_at_once):
                block = (entry[rays], direction[rays], length[rays], offset[rays], count[rays], depth[rays], first)
                if self.differentiable:
                    more, after = checkpoint(self.block, *block, use_reentrant=False, preserve_rng_state=False)  # type: ignore[misc]
                    light, depth = light.index_add(0, rays, more), depth.index_copy(0, rays, after)
                else:
                    more, after = self.block(*block)
                    light.index_add_(0, rays, more)
                    depth.index_copy_(0, rays, after)
                self.samples_done += int((count[rays] - first).clamp_max(BLOCK).sum())
                report(self.samples_done)
            first += BLOCK
            alive = alive[self._goes_on(count[alive], depth[alive].detach(), first)]
        self.samples_done = int(count.sum())  # those that early termination saved count as done
        return light, depth

    def _goes_on(self, count: Tensor, depth: Tensor, first: int) -> Tensor:
        if self.differentiable:
            return count > first
        transmittance = torch.exp(-depth)
        return (count > first) & ~((transmittance < self.faint) | (transmittance == 0))  # NaN goes on

    def block(
        self,
        entry: Tensor,
        direction: Tensor,
        length: Tensor,
        offset: Tensor,
        count: Tensor,
        depth: Tensor,
        first: int,
    ) -> tuple[Tensor, Tensor]:
        """What K segments of every ray add to its light `(R, 3)`, and its optical depth behind them `(R,)`."""
        middle, thickness = segments(length, self.step, first, BLOCK, offset)
        real = torch.arange(first, first + BLOCK, device=count.device) < count[:, None]  # (R, K)
        kept = None if bool(real.all()) else real.reshape(-1).nonzero()[:, 0]
        direction = direction.to(self.dtype)
        middle = middle.to(self.dtype)[..., None]
        points = torch.addcmul(entry.to(self.dtype)[:, None], middle, direction[:, None])  # (R, K, 3)
        points = _pick(points.reshape(-1, 3), kept)  # (S, 3)
        thickness = _pick(thickness.to(self.dtype).reshape(-1), kept)

        jet = self.field.jet(points, 1 if self.one_pass else 0)
        located = self.transfer.locate(jet[0])
        tau = self.transfer.optical_depth(self.transfer.opacity(located), thickness)
        weight, after = _compose(_spread(tau, kept, real.shape), depth, self.faint)

        weight = _pick(weight.reshape(-1), kept)
        seen = None if self.differentiable else (weight != 0).nonzero()[:, 0]
        place = kept if seen is None else seen if kept is None else kept[seen]  # among all R K, of what is seen
        color = self.transfer.color(located if seen is None else located.at(seen))
        if self.shading is not None:
            gradient = _pick(jet[1], seen) if self.one_pass else self._gradient(_pick(points, seen))
            ray = (torch.arange(real.numel(), device=count.device) if place is None else place) // BLOCK
            color = self.shading(color, gradient, direction.index_select(0, ray))
        emitted = _pick(weight, seen)[:, None] * color
        return _sum_pairwise(_spread(emitted, place, real.shape)).double(), after

    def _gradient(self, points: Tensor) -> Tensor:
        return self.field.jet(points, 1)[1] if len(points) else torch.zeros_like(points)


def _compose(tau: Tensor, depth: Tensor, faint: float) -> tuple[Tensor, Tensor]:
    """Weights T_i (1 − e^{−τ_i}) `(R, K)` of segments behind an optical depth `(R,)`, and the depth behind them.

    Segments where less than `faint` of the light still passes get weight 0.
    """
    sums = tau.cumsum(-1)
    before = torch.cat((torch.zeros_like(sums[:, :1]), sums[:, :-1]), -1) + depth.to(tau.dtype)[:, None]  # never ∞ − ∞
    transmittance = torch.exp(-before)
    weight = transmittance * -torch.expm1(-tau)
    if faint > 0:
        weight = torch.where(transmittance < faint, torch.zeros_like(weight), weight)
    return weight, depth + sums[:, -1].double()


def _over(light: Tensor, depth: Tensor, background: Tensor) -> Tensor:
    """Emitted light `(R, 3)` of rays of optical depth `(R, 1)` over a background `(3,)`: RGB and opacity `(R, 4)`."""
    rgb = light + torch.exp(-depth) * background
    return torch.cat((rgb, -torch.expm1(-depth)), -1).to(background.dtype)


def _pick(x: Tensor, index: Tensor | None) -> Tensor:
    """Rows of x; all of them for None."""
    return x if index is None else x.index_select(0, index)


def _spread(x: Tensor, index: Tensor | None, shape: Sequence[int]) -> Tensor:
    """Rows put back where `_pick` took them from, zeros elsewhere: `(S, *)` to `(*shape, *)`."""
    if index is not None:
        x = x.new_zeros((math.prod(shape), *x.shape[1:])).index_copy(0, index, x)
    return x.reshape(*shape, *x.shape[1:])


def _sum_pairwise(x: Tensor) -> Tensor:
    """Σ over axis 1 of `(R, K, 3)`, K a power of two, in one fixed order."""
    while x.shape[1] > 1:
        half = x.shape[1] // 2
        x = x[:, :half] + x[:, half:]
    return x[:, 0]


def _rays_at_once(memory: int, dtype: torch.dtype, differentiable: bool) -> int:
    floats = _FLOATS_PER_SAMPLE_SAVED if differentiable else _FLOATS_PER_SAMPLE
    samples = min(memory * 3 // 4 // (floats * dtype.itemsize), _LARGEST_BLOCK)
    return max(samples // BLOCK, 1)


def _check_arguments(
    field: Field,
    camera: Camera | Rays,
    transfer: TransferFunction,
    shading: Shading | None,
    step: float,
    termination: float | None,
    dtype: torch.dtype,
    max_samples: int,
    memory: int,
) -> None:
    if not isinstance(field, Field):
        raise TypeError(f"field must be a Field (fl.reconstruct(volume, ...) or a signal); got {type(field).__name__}")
    if field.channels is not None and 0 in field.channels:
        raise ValueError(f"a batched field must have at least one entry and channel; got (N, C) = {field.channels}")
    if not 0 < field.domain.voxel_size < math.inf:
        raise ValueError(f"field.domain.voxel_size must be a positive world length; got {field.domain.voxel_size}")
    pair = isinstance(camera, tuple | list) and len(camera) == 2 and all(isinstance(r, Tensor) for r in camera)
    if not (isinstance(camera, Camera) or pair):
        raise TypeError(f"camera must be a Camera or two tensors (origins, directions); got {type(camera).__name__}")
    if not isinstance(transfer, TransferFunction):
        raise TypeError(f"transfer must be a TransferFunction; got {type(transfer).__name__}")
    if not isinstance(shading, Shading | None):
        raise TypeError(f"shading must be a Shading, or None for unlit; got {type(shading).__name__}")
    if not isinstance(step, SupportsFloat) or not 0 < step < math.inf:
        raise ValueError(f"step must be a positive number of voxels; got {step!r}")
    if termination is not None and (not isinstance(termination, SupportsFloat) or not 0 < termination < 1):
        raise ValueError(f"termination must be a transmittance between 0 and 1, or None; got {termination!r}")
    if dtype not in (torch.float32, torch.float64):
        raise ValueError(f"dtype must be torch.float32 or torch.float64; got {dtype}")
    for name, value in (("max_samples", max_samples), ("memory", memory)):
        if not value > 0:
            raise ValueError(f"{name} must be positive; got {value}")


def _check_background(background: Sequence[float] | Tensor, dtype: torch.dtype, device: torch.device) -> Tensor:
    try:
        color = torch.as_tensor(background, dtype=dtype, device=device)
    except (TypeError, ValueError):
        color = torch.empty(0)
    if color.shape != (3,) or not color.detach().isfinite().all() or (color.detach() < 0).any():
        raise ValueError(f"background must be three finite numbers ≥ 0 (linear RGB); got {background!r}")
    return color


def _device_of(camera: Camera | Rays, transfer: TransferFunction) -> torch.device:
    device = camera.device if isinstance(camera, Camera) else camera[0].device
    return device or transfer.positions.device


def _depends_on_parameters(field: Field, dtype: torch.dtype, device: torch.device) -> bool:
    """Whether the field's values carry a gradient of their own: asked of one point, since fields are opaque here."""
    center = torch.tensor([field.domain.center], dtype=dtype, device=device)
    return field.jet(center if field.channels is None else center[None], 0)[0].requires_grad


@contextmanager
def _reporting(progress: Progress, total: int) -> Iterator[Callable[[int], None]]:
    """A function to call with the number of samples done."""
    if callable(progress):
        yield lambda done: progress(done, total)
    elif progress or (progress is None and sys.stderr.isatty()):
        from rich.console import Console
        from rich.progress import BarColumn, Progress, TaskProgressColumn, TextColumn, TimeRemainingColumn

        columns = (TextColumn("rendering"), BarColumn(), TaskProgressColumn(), TimeRemainingColumn())
        with Progress(*columns, console=Console(stderr=True)) as bar:
            task = bar.add_task("rendering", total=max(total, 1))
            yield lambda done: bar.update(task, completed=done if total else 1)
    else:
        yield lambda done: None
