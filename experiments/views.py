"""A view: everything an image needs but the field. Its sections are those of scene files (`filterlab.scenes.model`)."""

from __future__ import annotations

from typing import Annotated, Protocol

import torch
from pydantic import AfterValidator, Field, model_validator
from torch import Tensor

import filterlab as fl
from experiments.config import Dtype, torch_dtype
from experiments.runs import timed
from filterlab.fields.base import Domain
from filterlab.io.config import ConfigError, Problem, StrictModel
from filterlab.render.dvr import render
from filterlab.render.rays import segment_count, spans
from filterlab.scenes import model as scene

SECONDS_PER_SAMPLE = {"fused": 1e-8, "plain": 3e-7}
"""Of the marchers, on one core and on two, for views that are mostly empty; only expectations use it.

`python -m benchmarks dvr` measures 5 to 7 ns a sample of the fused marcher.
"""
MAX_SAMPLES = 2**34  # of an image: hours of work
SSIM_WINDOW = 11  # pixels
_FIRST = (16, 16)  # pixels of an image that nobody looks at
_PROBE = 96  # pixels along the longer side, by which the samples of an image are estimated


def _part(window: list[float]) -> list[float]:
    left, top, right, bottom = window
    if not (0 <= left < right <= 1 and 0 <= top < bottom <= 1):
        raise ValueError(f"expected left, top, right, bottom with 0 ≤ left < right ≤ 1, likewise down; got {window}")
    if abs((right - left) - (bottom - top)) > 1e-6:
        raise ValueError(f"expected the same part of the width as of the height, so that the shape stays; got {window}")
    return window


Window = Annotated[list[float], Field(min_length=4, max_length=4), AfterValidator(_part)]


def magnified(camera: scene.CameraView, window: list[float] | None) -> scene.CameraView:
    """A camera that sees the part of a view in a window (left, top, right, bottom; 0 … 1 of it), at full size."""
    if window is None:
        return camera
    left, top, right, bottom = camera.window
    width, height = right - left, bottom - top
    inner = (left + window[0] * width, top + window[1] * height, left + window[2] * width, top + window[3] * height)
    return camera.model_copy(update={"window": inner})


class Progress(Protocol):
    """What an image tells how far it is; a `Run` is one."""

    def advance(self, fraction: float) -> None: ...


class Silent:
    """Nobody watches: the image is one of many."""

    def advance(self, fraction: float) -> None:
        pass


class View(StrictModel):
    """Camera, transfer function, lights and sampling of an image; each as in a scene file.

    Attributes:
        size: (width, height) in pixels.
        step: in voxels.
        camera, transfer, lighting, region, background, termination: as in a scene; `transfer.axis` is always raw here.
    """

    size: tuple[scene.Pixels, scene.Pixels] = (512, 512)
    step: scene.Positive = 0.5
    camera: scene.CameraView = scene.CameraView()
    transfer: scene.Transfer
    lighting: scene.Lighting | None = None
    region: scene.Region | None = None
    background: scene.Color = (0.0, 0.0, 0.0)
    termination: Annotated[float, Field(gt=0, lt=1)] | None = 0.002

    @model_validator(mode="after")
    def _raw(self) -> View:
        if self.transfer.axis != "raw":
            raise ValueError("transfer.axis: expected raw, so that all images of an experiment share the values")
        return self

    def through(self, window: list[float] | None) -> View:
        """The part of this view in a window (left, top, right, bottom; 0 … 1 of this view), at full size."""
        return self.model_copy(update={"camera": magnified(self.camera, window)})

    def check(self, domain: Domain, path: str, *, compared: bool = False) -> None:
        """Raises ConfigError, for the key of the view at `path`, where an image of a field there can't be drawn.

        That is: a camera that does not go with the domain, or more samples than `MAX_SAMPLES` (estimated with few
        rays); for images that are `compared`, too few pixels for SSIM.
        """
        if compared and min(self.size) < SSIM_WINDOW:
            message = f"expected at least {SSIM_WINDOW} pixels each way, the window of SSIM; got {self.size}"
            raise ConfigError([Problem("the view", f"{path}.size", message)])
        try:
            samples = self._samples(domain)
        except ValueError as error:
            raise ConfigError([Problem("the view", path, str(error))]) from None
        if not samples <= MAX_SAMPLES:
            message = (
                f"expected an image of at most {MAX_SAMPLES:.2g} samples; got about {samples:.2g} with step "
                f"{self.step:g} and size {list(self.size)}: use a longer step, or a smaller image or region"
            )
            raise ConfigError([Problem("the view", f"{path}.step", message)])

    def _samples(self, domain: Domain) -> float:
        """How many samples an image takes, about: those of the rays of a smaller one, times its share of the pixels."""
        scale = min(1.0, _PROBE / max(self.size))
        width, height = (max(round(scale * n), 1) for n in self.size)
        camera = self.camera.build(domain, self.size)
        origins, directions = camera.pixel_rays(torch.arange(width * height), width, height)
        inside = spans(origins, directions, domain, self.region.build() if self.region else None)
        count = segment_count(inside.length, self.step * domain.voxel_size).sum()
        return float(count) * (self.size[0] * self.size[1]) / (width * height)

    def seconds(self, voxels: float, scheme: str) -> float:
        """A rough expectation for an image of a volume with that many voxels along an axis, of a field's scheme."""
        width, height = self.size
        marcher = "fused" if scheme == "fused" else "plain"
        return width * height * voxels / self.step * SECONDS_PER_SAMPLE[marcher] + 0.2

    def timed(self, field: fl.Field, run: Progress, device: str, dtype: Dtype) -> tuple[Tensor, float]:
        """The image as of `draw`, and its seconds: not those of what is compiled or made once, at a first image."""
        self.model_copy(update={"size": _FIRST}).draw(field, Silent(), device, dtype)
        return timed(lambda: self.draw(field, run, device, dtype))

    def draw(self, field: fl.Field, run: Progress, device: str, dtype: Dtype) -> Tensor:
        """The image of a field over the background, linear RGB `(H, W, 3)`, float32, on the CPU."""
        with torch.no_grad():
            image = render(
                field,
                self.camera.build(field.domain, self.size),
                self.transfer.build(lambda: (0.0, 1.0), field.domain.voxel_size),
                size=self.size,
                step=self.step,
                shading=self.lighting.build() if self.lighting else None,
                background=self.background,
                region=self.region.build() if self.region else None,
                termination=self.termination,
                max_samples=MAX_SAMPLES,
                dtype=torch_dtype(dtype),
                device=device,
                progress=lambda done, total: run.advance(done / max(total, 1)),
            )
        return image[..., :3].to(torch.float32).cpu()
