"""Direct volume rendering of any Field: emission and absorption along rays.

    rays ─▶ (t_near, t_far) ─▶ samples ─▶ transfer function ─▶ shading ─▶ compositing

What every renderer needs is in `render.image`; here rays are cut into segments. Along them goes a *marcher*: the fused
one (`render.fused`, vector code) for fields whose scheme is "fused", where it can run as asked, else the plain one
(`render.plain`, torch) for any field. The image does not depend on which.

How work is cut up never changes a number: every ray is marched for itself, and jitter is a hash of the pixel number.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from filterlab.fields.base import Domain, Field
from filterlab.ops.march import Chords
from filterlab.ops.reference.march import rays_at_once
from filterlab.render.camera import Camera
from filterlab.render.fused import FusedMarcher, why_not_fused
from filterlab.render.image import (
    CENTER,
    Canvas,
    PixelRays,
    Progress,
    RayTensors,
    check_background,
    check_camera,
    check_field,
    device_of,
    over,
    reporting,
    unbatched,
)
from filterlab.render.plain import Marcher, Medium, PlainMarcher
from filterlab.render.rays import Region, Spans, check_region, jitter, segment_count, spans
from filterlab.render.sampling import MOST_SEGMENTS, Sampling
from filterlab.render.shading import Shading
from filterlab.render.transfer import TransferFunction

_PART = 1 << 16  # rays that are cut at a time; more would only leave the caches
_PART_OF_GPU = 1 << 20  # fewer would leave it waiting for Python
_BYTES_PER_RAY = 256
"""While rays are cut and marched, roughly. Measured on a GPU, where torch counts every byte, of lit images of 2048² by
parts of 2¹⁸ and 2²⁰ rays: 298 and 282 beyond the image. Chords are 72 of them, in the grid 48, light and depth 32."""
_BYTES_PER_RAY_SAVED = 512
"""The same while autograd records, of the fused marcher: 442 of 2²⁰ rays, image and derivatives included."""
_DEFAULT = Sampling()


def render(
    field: Field,
    camera: Camera | RayTensors,
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
        another background b is rgb + (1 − opacity) (b − background). Where the field is NaN (missing voxels, under
        `nan="propagate"`), or the gradient that lights it, nothing is: such a segment has neither colour nor opacity. A
        batched field gives `(N, C, H, W, 4)` (or `(N, C, ..., 4)`), each image with the bits that its own volume would.

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
    sampling = Sampling(step, jitter_seed, termination, dtype, max_samples, memory)
    frame = prepare(
        field,
        camera,
        transfer,
        size=size,
        shading=shading,
        background=background,
        region=region,
        sampling=sampling,
        device=device,
    )
    return frame.run(progress)


def prepare(
    field: Field,
    camera: Camera | RayTensors,
    transfer: TransferFunction,
    *,
    size: Sequence[int] | None = None,
    shading: Shading | None = None,
    background: Sequence[float] | Tensor = (0.0, 0.0, 0.0),
    region: Region | None = None,
    sampling: Sampling = _DEFAULT,
    device: torch.device | str | None = None,
) -> Frame:
    """All that `render` decides before it marches; arguments and errors are those of `render`."""
    _check_arguments(field, camera, transfer, shading)
    asked = sampling.step_in(field.domain.voxel_size)
    device = torch.device(device or device_of(camera) or transfer.positions.device)
    seen = PixelRays.of(camera, size, device)
    color = check_background(background, device)
    box = None if region is None else check_region(region)
    differentiable = torch.is_grad_enabled() and any(
        x.requires_grad for x in (seen, transfer, color, field, shading) if x is not None
    )
    dtype = sampling.dtype
    brightest = transfer.brightest if shading is None else shading.brightest(transfer.brightest)
    brightest = max(brightest, float(color.detach().max()), 1.0)
    lengths = _lengths(field.domain, asked, transfer.unit)
    _check_range(dtype, lengths | (shading.numbers if shading else {}) | {"the brightest colour": brightest})
    transfer, color = transfer.to(dtype, device), color.to(dtype)
    termination = sampling.termination
    faint = 0.0 if termination is None or differentiable else termination / brightest
    step = lengths["the step"]
    media = [Medium(one, transfer, shading, step, faint, differentiable) for one in unbatched(field)]
    cut = Cut(field.domain, box, step, asked / step, sampling.jitter_seed, differentiable and seen.requires_grad)
    marcher, at_once = _marcher(media[0], sampling.memory)
    parts = [_Part(order) for order in seen.parts(at_once)]
    if seen.count * _BYTES_PER_RAY <= sampling.memory:  # else rays are cut again for every image
        parts = [replace(part, chords=cut(seen, seen.pixels(part.order))) for part in parts]
    total = sampling.check_count(_count(cut, seen, parts) * len(media))
    return Frame(media, marcher, Canvas(seen, field.channels, differentiable), cut, parts, total, color)


@dataclass(frozen=True)
class _Part:
    """Pixels that are marched together: which in the order of marching, and their rays where they are kept."""

    order: range
    chords: Chords | None = None


@dataclass(frozen=True)
class Frame:
    """An image that is ready to be marched.

    Attributes:
        media: what is marched through, one for every image of a batch.
        marcher: what marches.
        samples: how many segments all rays have together, before any is skipped or left out behind what is opaque.
    """

    media: list[Medium]
    marcher: Marcher
    _canvas: Canvas
    _cut: Cut
    _parts: Sequence[_Part]
    samples: int
    _background: Tensor

    @property
    def pixels(self) -> int:
        """Rays of one image."""
        return self._canvas.seen.count

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
        return self._cut(self._canvas.seen, pixels)

    def run(self, progress: Progress = False) -> Tensor:
        """The image, as `render` gives it."""
        with reporting(progress, self.samples) as report:
            images = self._canvas.filled(self._marched(report), self._background)
            report(self.samples)
        return images

    def _marched(self, report: Callable[[int], None]) -> Iterator[tuple[int, range, Tensor]]:
        """(number of the image, places, their pixels (R, 4)), one part after the other."""
        done = 0
        for number, medium in enumerate(self.media):
            for part in self._parts:
                chords = part.chords or self.chords(self._canvas.seen.pixels(part.order))
                light, depth = self.marcher.march(medium, chords, lambda n, done=done: report(done + n))
                done += int(chords.count.sum())  # with those that early termination saved
                yield number, part.order, over(light, depth[:, None], self._background)


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


@dataclass(frozen=True)
class Cut:
    """Cuts rays to a field's domain and into segments; all lengths are world lengths.

    The step that was asked for is `stretch` times `step`: more than 1 only where that is longer than any ray inside.
    """

    domain: Domain
    region: Region | None
    step: float
    stretch: float
    jitter_seed: int | None
    differentiable: bool

    def __call__(self, seen: PixelRays, pixels: Tensor) -> Chords:
        """The parts inside of the rays of `pixels` `(R,)`."""
        if self.differentiable:
            inside: Spans = checkpoint(self.inside, seen, pixels, use_reentrant=False)  # type: ignore[assignment]
        else:
            inside = self.inside(seen, pixels)
        offset = self.offset(pixels)
        count = segment_count(inside.length, self.step, offset).clamp_max(MOST_SEGMENTS).long()
        return Chords(inside.entry, inside.direction, inside.length, offset, count)

    def inside(self, seen: PixelRays, pixels: Tensor) -> Spans:
        """The parts of the rays that lie in the domain."""
        return spans(*seen.rays(pixels, CENTER), self.domain, self.region)

    def offset(self, pixels: Tensor) -> Tensor:
        """How far into a step the first segment reaches, `(R,)`, in (0, 1]."""
        if self.jitter_seed is None:
            return torch.ones_like(pixels, dtype=torch.float64)
        return (self.stretch * jitter(self.jitter_seed, pixels)).clamp_max(1)

    def count(self, seen: PixelRays, pixels: Tensor) -> float:
        """How many segments the rays of some pixels have together."""
        return float(segment_count(self.inside(seen, pixels).length, self.step, self.offset(pixels)).sum())


def _count(cut: Cut, seen: PixelRays, parts: Sequence[_Part]) -> float:
    """How many samples an image takes."""
    total = 0.0
    for part in parts:
        kept = part.chords
        total += cut.count(seen, seen.pixels(part.order)) if kept is None else float(kept.count.double().sum())
    return total


def _check_arguments(
    field: Field, camera: Camera | RayTensors, transfer: TransferFunction, shading: Shading | None
) -> None:
    check_field(field)
    check_camera(camera)
    if not isinstance(transfer, TransferFunction):
        raise TypeError(f"transfer must be a TransferFunction; got {type(transfer).__name__}")
    if not isinstance(shading, Shading | None):
        raise TypeError(f"shading must be a Shading, or None for unlit; got {type(shading).__name__}")


def _lengths(domain: Domain, step: float, unit: float) -> dict[str, float]:
    """World lengths and their inverses that a marcher computes with, by what they are."""
    longest = 2 * domain.diagonal  # beyond every end there is nothing to cut, only digits to lose
    length = min(step, longest)
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
