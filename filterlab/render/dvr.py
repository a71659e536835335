"""Direct volume rendering of any Field: emission and absorption along rays.

    rays ─▶ (t_near, t_far) ─▶ samples ─▶ transfer function ─▶ shading ─▶ compositing

What is done here: cameras and rays, and where rays enter and leave the field; parts of them; the background. Along the
rays goes a *marcher*: the fused one (`render.fused`, vector code) for fields whose scheme is "fused", where it can run
as asked, else the plain one (`render.plain`, torch) for any field. The image does not depend on which.

How work is cut up never changes a number: every ray is marched for itself, and jitter is a hash of the pixel number.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import SupportsFloat, SupportsIndex

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from filterlab.fields.base import Domain, Field
from filterlab.fields.grid import GridField
from filterlab.ops.march import Chords
from filterlab.ops.reference.march import rays_at_once
from filterlab.ops.reference.optics import absorbed
from filterlab.render.camera import Camera, check_size
from filterlab.render.fused import FusedMarcher, why_not_fused
from filterlab.render.plain import Marcher, Medium, PlainMarcher
from filterlab.render.rays import Region, check_rays, check_region, intersect, jitter, segment_count
from filterlab.render.shading import Shading
from filterlab.render.tiles import tiled_part
from filterlab.render.transfer import TransferFunction

Rays = tuple[Tensor, Tensor]
Progress = bool | None | Callable[[int, int], None]

_PART = 1 << 16  # rays that are cut at a time; more would only leave the caches
_PART_OF_GPU = 1 << 20  # fewer would leave it waiting for Python
_MOST_SEGMENTS = 2.0**62  # of a ray, that can be counted; no limit on the number of samples is as high
_BYTES_PER_RAY = 256
_BYTES_PER_RAY_SAVED = 2048  # of the fused marcher while autograd records


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
        background. Samples are recomputed in the backward pass, so that memory stays bounded then too; where the march
        is fused it does not grow with the number of steps at all.

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
    job = prepare(
        field,
        camera,
        transfer,
        size=size,
        step=step,
        shading=shading,
        background=background,
        region=region,
        jitter_seed=jitter_seed,
        termination=termination,
        dtype=dtype,
        device=device,
        max_samples=max_samples,
        memory=memory,
    )
    return job.run(progress)


def prepare(
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
) -> Job:
    """All that `render` decides before it marches; arguments and errors are those of `render`."""
    _check_arguments(field, camera, transfer, shading, step, termination, dtype, max_samples, memory)
    device = torch.device(device or _device_of(camera, transfer))
    view = _View.of(camera, size, device)
    color = _check_background(background, device)
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
    lengths = _lengths(field.domain, step, transfer.unit)
    _check_range(dtype, lengths | (shading.numbers if shading else {}) | {"the brightest colour": brightest})
    transfer, color = transfer.to(dtype, device), color.to(dtype)
    faint = 0.0 if termination is None or differentiable else termination / brightest
    asked = float(step) * field.domain.voxel_size
    length = lengths["the step"]
    media = [Medium(one, transfer, shading, length, faint, differentiable) for one in _unbatched(field)]
    cut = _Cut(field.domain, box, length, asked / length, jitter_seed, differentiable and view.requires_grad)
    marcher, at_once = _marcher(media[0], memory)
    parts = [_Part(range(i, min(i + at_once, view.count))) for i in range(0, view.count, at_once)]
    if view.count * _BYTES_PER_RAY <= memory:  # else rays are cut again for every image
        parts = [replace(part, chords=cut(view, view.pixels(part.order))) for part in parts]
    total = cut.count_all(view, parts, len(media), max_samples)
    return Job(media, marcher, view, cut, parts, total, color, field.channels)


@dataclass(frozen=True)
class _Part:
    """Pixels that are marched together: which in the order of marching, and their rays where they are kept."""

    order: range
    chords: Chords | None = None


@dataclass(frozen=True)
class Job:
    """An image that is ready to be marched.

    Attributes:
        media: what is marched through, one for every image of a batch.
        marcher: what marches.
        samples: how many segments all rays have together, before any is skipped or left out behind what is opaque.
    """

    media: list[Medium]
    marcher: Marcher
    _view: _View
    _cut: _Cut
    _parts: Sequence[_Part]
    samples: int
    _background: Tensor
    _channels: tuple[int, int] | None

    @property
    def pixels(self) -> int:
        """Rays of one image."""
        return self._view.count

    @property
    def image_bytes(self) -> int:
        """What all images take."""
        return self.pixels * len(self.media) * 4 * self.media[0].dtype.itemsize

    @property
    def ray_bytes(self) -> int:
        """What rays take, roughly: those that are kept, else those of a part at a time."""
        largest = max((len(part.order) for part in self._parts), default=0)
        kept = sum(part.chords.nbytes for part in self._parts if part.chords is not None)
        return kept + largest * _BYTES_PER_RAY

    def chords(self, pixels: Tensor) -> Chords:
        """The rays of some pixels, cut into segments."""
        return self._cut(self._view, pixels)

    def run(self, progress: Progress = False) -> Tensor:
        """The image, as `render` gives it."""
        with _reporting(progress, self.samples) as report:
            images = self._images(report)
            report(self.samples)
        return images.reshape(*(self._channels or ()), *self._view.shape, 4)

    def _images(self, report: Callable[[int], None]) -> Tensor:
        """(images, pixels, 4): without derivatives every part is written where it belongs, and nothing is copied."""
        background, everywhere = self._background, self._view.pixels
        if self.media[0].differentiable:
            marched = torch.cat([image for _, _, image in self._marched(report)] or [background.new_zeros(0, 4)])
            marched = marched.reshape(len(self.media), self.pixels, 4)
            return torch.empty_like(marched).index_copy(1, everywhere(range(self.pixels)), marched)
        images = background.new_empty(len(self.media), self.pixels, 4)
        for number, part, image in self._marched(report):
            images[number].index_copy_(0, everywhere(part.order), image)
        return images

    def _marched(self, report: Callable[[int], None]) -> Iterator[tuple[int, _Part, Tensor]]:
        """(number of the image, part, its pixels (R, 4)), one after the other."""
        done = 0
        for number, medium in enumerate(self.media):
            for part in self._parts:
                chords = part.chords or self.chords(self._view.pixels(part.order))
                light, depth = self.marcher.march(medium, chords, lambda n, done=done: report(done + n))
                done += int(chords.count.sum())  # with those that early termination saved
                yield number, part, _over(light, depth[:, None], self._background)


def _marcher(medium: Medium, memory: int) -> tuple[Marcher, int]:
    """The fused marcher where it can run as asked, else the plain one; and how many rays go to it at a time."""
    if why_not_fused(medium) is None:
        if medium.differentiable:  # derivatives by the volume are a volume for every part
            return FusedMarcher(memory), max(memory // _BYTES_PER_RAY_SAVED, 1)
        most = _PART_OF_GPU if medium.transfer.positions.device.type == "cuda" else _PART
        return FusedMarcher(memory), max(min(memory // _BYTES_PER_RAY, most), 1)
    at_once = rays_at_once(memory, medium.dtype, medium.differentiable)
    part = at_once if medium.differentiable else max(at_once, memory // (4 * _BYTES_PER_RAY))
    return PlainMarcher(memory), part


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
    """The rays of an image; made where they are needed, a part at a time.

    Attributes:
        shape: of the image.
        pixels: the numbers of those that stand at some places in the order in which they are marched.
        rays: the rays of some pixels.
        requires_grad: whether derivatives by the rays are asked.
    """

    shape: tuple[int, ...]
    pixels: Callable[[range], Tensor]
    rays: Callable[[Tensor], Rays]
    requires_grad: bool

    @property
    def count(self) -> int:
        """How many pixels there are."""
        return math.prod(self.shape)

    @classmethod
    def of(cls, camera: Camera | Rays, size: Sequence[int] | None, device: torch.device) -> _View:
        if isinstance(camera, Camera):
            if size is None:
                raise ValueError("size=(width, height) is needed with a camera")
            width, height = check_size(size)
            pixels = _tile_by_tile(height, width, device)
            return cls((height, width), pixels, lambda p: camera.pixel_rays(p, width, height), camera.requires_grad)
        if size is not None:
            raise ValueError(f"size goes with a camera; rays bring their own shape; got size={size!r}")
        origins, directions = camera
        o, d = (r.reshape(-1, 3).to(device) for r in check_rays(origins, directions))
        requires_grad = o.requires_grad or d.requires_grad
        shape = tuple(origins.shape[:-1])
        pixels = _tile_by_tile(*shape, device) if len(shape) == 2 else _one_by_one(device)
        return cls(shape, pixels, lambda p: (o[p], d[p]), requires_grad)


def _tile_by_tile(height: int, width: int, device: torch.device) -> Callable[[range], Tensor]:
    return lambda order: tiled_part(height, width, order.start, order.stop, device)


def _one_by_one(device: torch.device) -> Callable[[range], Tensor]:
    return lambda order: torch.arange(order.start, order.stop, device=device)


@dataclass(frozen=True)
class _Cut:
    """Cuts rays to a field's domain and into segments; all lengths are world lengths.

    The step that was asked for is `stretch` times `step`: more than 1 only where that is longer than any ray inside.
    """

    domain: Domain
    region: Region | None
    step: float
    stretch: float
    jitter_seed: int | None
    differentiable: bool

    def __call__(self, view: _View, pixels: Tensor) -> Chords:
        """The parts inside of the rays of `pixels` `(R,)`."""
        if self.differentiable:
            entry, direction, length = checkpoint(self.inside, view, pixels, use_reentrant=False)  # type: ignore[misc]
        else:
            entry, direction, length = self.inside(view, pixels)
        offset = self.offset(pixels)
        count = segment_count(length, self.step, offset).clamp_max(_MOST_SEGMENTS).long()
        return Chords(entry, direction, length, offset, count)

    def inside(self, view: _View, pixels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Where rays enter the domain `(R, 3)`, their directions and lengths inside `(R,)`."""
        origins, directions = view.rays(pixels)
        near, far = intersect(origins, directions, self.domain, self.region)
        hit = far.detach() > near.detach()
        length = torch.where(hit, far - near, torch.zeros_like(far))
        near = torch.where(hit, near, torch.zeros_like(near))
        return origins + near[:, None] * directions, directions, length

    def offset(self, pixels: Tensor) -> Tensor:
        """How far into a step the first segment reaches, `(R,)`, in (0, 1]."""
        if self.jitter_seed is None:
            return torch.ones_like(pixels, dtype=torch.float64)
        return (self.stretch * jitter(self.jitter_seed, pixels)).clamp_max(1)

    def count_all(self, view: _View, parts: Sequence[_Part], images: int, limit: int) -> int:
        """How many samples the images take. Raises ValueError above `limit`."""
        total = 0.0
        for part in parts:
            if part.chords is not None:
                total += float(part.chords.count.double().sum())
            else:
                pixels = view.pixels(part.order)
                total += float(segment_count(self.inside(view, pixels)[2], self.step, self.offset(pixels)).sum())
        total *= images
        if not total <= limit:
            more = "more than " if total >= _MOST_SEGMENTS else ""
            raise ValueError(
                f"the image would take {more}{total:.3g} samples; the limit is max_samples={limit:.3g}: "
                "use a longer step, a smaller image or region, or raise max_samples"
            )
        return int(total)


def _over(light: Tensor, depth: Tensor, background: Tensor) -> Tensor:
    """Emitted light `(R, 3)` of rays of optical depth `(R, 1)` over a background `(3,)`: RGB and opacity `(R, 4)`."""
    rgb = light + torch.exp(-depth) * background
    return torch.cat((rgb, absorbed(depth)), -1).to(background.dtype)


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
    if not 0 < _number(step) < math.inf:
        raise ValueError(f"step must be a positive number of voxels; got {step!r}")
    if not float(step) * field.domain.voxel_size > 0:
        raise ValueError(f"step must be a world length in float64; got {step!r} voxels of {field.domain.voxel_size:g}")
    if termination is not None and not 0 < _number(termination) < 1:
        raise ValueError(f"termination must be a transmittance between 0 and 1, or None; got {termination!r}")
    if dtype not in (torch.float32, torch.float64):
        raise ValueError(f"dtype must be torch.float32 or torch.float64; got {dtype}")
    if not _number(max_samples) > 0:
        raise ValueError(f"max_samples must be a positive number; got {max_samples!r}")
    if not isinstance(memory, SupportsIndex) or memory <= 0:
        raise ValueError(f"memory must be a positive whole number of bytes; got {memory!r}")


def _lengths(domain: Domain, step: float, unit: float) -> dict[str, float]:
    """World lengths and their inverses that a marcher computes with, by what they are."""
    longest = 2 * domain.diagonal  # beyond every end there is nothing to cut, only digits to lose
    length = min(float(step) * domain.voxel_size, longest)
    return {
        "the step": length,
        "the length of a ray": longest,
        "1 / voxel size": 1 / domain.voxel_size,
        "1 / unit of the transfer function": 1 / unit,
        "the step in units of the transfer function": length / unit,
    }


def _check_range(dtype: torch.dtype, numbers: Mapping[str, float]) -> None:
    """Raises ValueError that names the number an image cannot be computed with: sums of two must not overflow."""
    limit = torch.finfo(dtype).max / 2
    for name, number in numbers.items():
        if not number <= limit:
            kind = str(dtype).removeprefix("torch.")
            wider = "" if dtype == torch.float64 else "; float64 reaches further"
            raise ValueError(
                f"an image in {kind} is computed with numbers up to {limit:.3g}; {name} is {number:.3g}{wider}"
            )


def _number(value: object) -> float:
    """The value as one number; NaN where it is none."""
    try:
        return float(value) if isinstance(value, SupportsFloat) else math.nan
    except (TypeError, ValueError, ArithmeticError, RuntimeError):  # a tensor of several, an integer beyond all floats
        return math.nan


def _check_background(background: Sequence[float] | Tensor, device: torch.device) -> Tensor:
    try:
        color = torch.as_tensor(background, dtype=torch.float64, device=device)
    except (TypeError, ValueError, ArithmeticError, RuntimeError):
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
