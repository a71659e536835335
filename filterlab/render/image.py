"""What every renderer of images needs, whatever its rays meet: pixels and their rays, batches, output, progress.

    camera ─▶ PixelRays ─▶ parts, tile by tile ─▶ (the renderer) ─▶ light and opacity ─▶ over a background ─▶ Canvas

How work is cut up never changes a number: every ray is followed for itself.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import torch
from torch import Tensor

from filterlab.arrays import Array, as_numbers, as_tensor
from filterlab.fields.base import Field
from filterlab.ops.reference.optics import absorbed
from filterlab.render.camera import Camera, check_size
from filterlab.render.rays import check_rays
from filterlab.render.tiles import tiled_part

RayTensors = tuple[Tensor, Tensor]
"""Origins and directions, (..., 3) each."""

View = Camera | RayTensors | tuple[Array, Array]
"""What a renderer is given: a camera, or rays as tensors or NumPy arrays."""

Place = tuple[Tensor | float, Tensor | float]
CENTER = (0.5, 0.5)

Progress = bool | None | Callable[[int, int], None]
"""True: a progress bar on stderr; None: only if that is a terminal; or a function (done, total)."""


# --- what is seen, and from where -------------------------------------------------------------------------------------


def check_field(field: Field) -> None:
    """Raises TypeError or ValueError for what no image can be made of."""
    if not isinstance(field, Field):
        raise TypeError(f"field must be a Field (fl.reconstruct(volume, ...) or a signal); got {type(field).__name__}")
    if field.channels is not None and 0 in field.channels:
        raise ValueError(f"a batched field must have at least one entry and channel; got (N, C) = {field.channels}")
    if not 0 < field.domain.voxel_size < math.inf:
        raise ValueError(f"field.domain.voxel_size must be a positive world length; got {field.domain.voxel_size}")


def as_view(camera: View) -> Camera | RayTensors:
    """A camera as it is, or the two tensors of rays. Raises TypeError for anything else."""
    if isinstance(camera, Camera):
        return camera
    if not (isinstance(camera, tuple | list) and len(camera) == 2 and all(isinstance(r, Array) for r in camera)):
        raise TypeError(f"camera must be a Camera or two tensors (origins, directions); got {type(camera).__name__}")
    origins, directions = camera
    return as_tensor(origins), as_tensor(directions)


def device_of(camera: Camera | RayTensors) -> torch.device | None:
    """Where the camera's or the rays' tensors are; None: a camera without any."""
    return camera.device if isinstance(camera, Camera) else camera[0].device


def unbatched(field: Field) -> list[Field]:
    """The field, or those of all entries and channels of a batched one, in the order of (N, C)."""
    if field.channels is None:
        return [field]
    entries, channels = field.channels
    return [field.select(n, c) for n in range(entries) for c in range(channels)]


@dataclass(frozen=True)
class PixelRays:
    """The rays of an image's pixels; made where they are needed, a part at a time.

    Attributes:
        shape: of the image.
        pixels: the numbers of those that stand at some places in the order in which they are rendered.
        rays: the rays of some pixels, through a place within each (of a camera's image).
        requires_grad: whether derivatives by the rays are asked.
    """

    shape: tuple[int, ...]
    pixels: Callable[[range], Tensor]
    rays: Callable[[Tensor, Place], RayTensors]
    requires_grad: bool

    @property
    def count(self) -> int:
        """How many pixels there are."""
        return math.prod(self.shape)

    def parts(self, at_once: int) -> list[range]:
        """All places in the order of rendering, so many at a time."""
        return [range(i, min(i + at_once, self.count)) for i in range(0, self.count, at_once)]

    @classmethod
    def of(cls, camera: Camera | RayTensors, size: Sequence[int] | None, device: torch.device) -> PixelRays:
        """Those of a camera's image, or the rays themselves. Raises ValueError unless just a camera has a size."""
        if isinstance(camera, Camera):
            if size is None:
                raise ValueError("size=(width, height) is needed with a camera")
            width, height = check_size(size)
            pixels = _tile_by_tile(height, width, device)

            def rays(numbers: Tensor, place: Place) -> RayTensors:
                return camera.pixel_rays(numbers, width, height, place)

            return cls((height, width), pixels, rays, camera.requires_grad)
        if size is not None:
            raise ValueError(f"size goes with a camera; rays bring their own shape; got size={size!r}")
        origins, directions = camera
        o, d = (r.reshape(-1, 3).to(device) for r in check_rays(origins, directions))
        requires_grad = o.requires_grad or d.requires_grad
        shape = tuple(origins.shape[:-1])
        pixels = _tile_by_tile(*shape, device) if len(shape) == 2 else _one_by_one(device)
        return cls(shape, pixels, lambda p, _: (o[p], d[p]), requires_grad)


def _tile_by_tile(height: int, width: int, device: torch.device) -> Callable[[range], Tensor]:
    return lambda order: tiled_part(height, width, order.start, order.stop, device)


def _one_by_one(device: torch.device) -> Callable[[range], Tensor]:
    return lambda order: torch.arange(order.start, order.stop, device=device)


# --- what comes of it -------------------------------------------------------------------------------------------------


def check_background(background: Sequence[float] | Tensor, device: torch.device) -> Tensor:
    """Linear RGB (3,) float64. Raises ValueError unless it is three finite numbers ≥ 0."""
    try:
        color = as_numbers(background, device=device)
    except (TypeError, ValueError, ArithmeticError, RuntimeError):
        color = torch.empty(0)
    if color.shape != (3,) or not color.detach().isfinite().all() or (color.detach() < 0).any():
        raise ValueError(f"background must be three finite numbers ≥ 0 (linear RGB); got {background!r}")
    return color


def over(light: Tensor, depth: Tensor, background: Tensor) -> Tensor:
    """Emitted light `(R, 3)` of rays of optical depth `(R, 1)` over a background `(3,)`: RGB and opacity `(R, 4)`."""
    rgb = light + torch.exp(-depth) * background
    return torch.cat((rgb, absorbed(depth)), -1).to(background.dtype)


@dataclass(frozen=True)
class Canvas:
    """Where the parts of images come together.

    Attributes:
        seen: the pixels.
        channels: (N, C) of a batch of images; None: one image.
        differentiable: whether autograd records the parts.
        width: numbers of a pixel.
    """

    seen: PixelRays
    channels: tuple[int, int] | None
    differentiable: bool
    width: int = 4

    @property
    def images(self) -> int:
        """How many there are."""
        return math.prod(self.channels or ())

    def filled(self, parts: Iterable[tuple[int, range, Tensor]], like: Tensor) -> Tensor:
        """`(*channels, *shape, width)` of (number of the image, places in the order of rendering, pixels (R, width)).

        Without derivatives every part is written where it belongs, and nothing is copied.
        """
        fill = self._joined if self.differentiable else self._written
        return fill(parts, like).reshape(*(self.channels or ()), *self.seen.shape, self.width)

    def _joined(self, parts: Iterable[tuple[int, range, Tensor]], like: Tensor) -> Tensor:
        joined = torch.cat([part for _, _, part in parts] or [like.new_zeros(0, self.width)])
        joined = joined.reshape(self.images, self.seen.count, self.width)
        return torch.empty_like(joined).index_copy(1, self.seen.pixels(range(self.seen.count)), joined)

    def _written(self, parts: Iterable[tuple[int, range, Tensor]], like: Tensor) -> Tensor:
        images = like.new_empty(self.images, self.seen.count, self.width)
        for number, order, part in parts:
            images[number].index_copy_(0, self.seen.pixels(order), part)
        return images


@contextmanager
def reporting(progress: Progress, total: int) -> Iterator[Callable[[int], None]]:
    """A function to call with how much is done."""
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
