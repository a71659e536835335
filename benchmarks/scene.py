"""What is rendered: a volume, a camera, a transfer function and a light that filterlab and its peers all understand.

The transfer function is a table over equal steps from 0 to 1, linear in between, so that a one-dimensional texture
gives the same numbers; opacities are per voxel. The one light is the camera's own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from filterlab import signals
from filterlab.fields.base import Field
from filterlab.methods import reconstruct
from filterlab.render import PerspectiveCamera, Shading, TransferFunction, fused, render
from filterlab.render.dvr import prepare
from filterlab.render.rays import Region, spans
from filterlab.render.sampling import Sampling

DIRECTION = (0.62, 0.77, -0.5)
FIELD_OF_VIEW = 18.0  # degrees; with 30 the corners of the volume touch the edges of the image
BRICK = 8  # voxels
LIGHTING = Shading()


@dataclass(frozen=True)
class Scene:
    """A volume in voxel coordinates and how it is looked at.

    Attributes:
        volume: (n, n, n) float32 in 0 … 1.
        table: (K, 4) linear RGB and opacity per voxel, at j / (K − 1).
        size: edge of the image in pixels.
        step: voxels between samples.
        lit: with the headlight, or plain emission.
        threads: how many a renderer may use.
    """

    volume: Tensor
    table: Tensor
    size: int
    step: float = 0.5
    lit: bool = True
    threads: int = 1

    @cached_property
    def camera(self) -> PerspectiveCamera:
        """So near that the volume fills most of the image."""
        whole = PerspectiveCamera.framing(self.field("trilinear", "direct").domain, DIRECTION)
        return replace(whole, field_of_view=FIELD_OF_VIEW)

    @property
    def transfer(self) -> TransferFunction:
        return _transfer(self.table)

    @property
    def shading(self) -> Shading | None:
        return LIGHTING if self.lit else None

    def field(self, method: str, scheme: str, volume: Tensor | None = None) -> Field:
        """Of the volume, or of another one of its size."""
        return reconstruct(self.volume if volume is None else volume, method, boundary="reflect", scheme=scheme)

    def image(self, field: Field, table: Tensor | None = None, **options: Any) -> Tensor:
        """(size, size, 4) by filterlab's renderer; the field's scheme decides which marcher works."""
        transfer = self.transfer if table is None else _transfer(table)
        return render(field, self.camera, transfer, step=self.step, **self._seen, **options)

    def samples(self, field: Field, region: Region | None = None, **options: Any) -> int:
        """Of all rays together, as the renderer counts them before it leaves any out."""
        sampling = Sampling(self.step, **options)
        return prepare(field, self.camera, self.transfer, **self._seen, region=region, sampling=sampling).samples

    @property
    def _seen(self) -> dict[str, Any]:
        return {
            "size": (self.size, self.size),
            "shading": self.shading,
            "device": self.volume.device,
        }


def _transfer(table: Tensor) -> TransferFunction:
    positions = torch.linspace(0, 1, len(table), dtype=torch.float64)
    return TransferFunction(positions, table[:, :3].double(), table[:, 3].double())


def entering_rays(scene: Scene) -> tuple[Tensor, Tensor, Tensor]:
    """Where every ray enters, its direction, and its length inside (0 where it misses), voxel coordinates."""
    field = scene.field("trilinear", "direct")
    origins, directions = (r.reshape(-1, 3) for r in scene.camera.rays(scene.size, scene.size))
    return spans(origins, directions, field.domain)


def marschner_lobb(n: int, size: int, **options: Any) -> Scene:
    """A translucent shell of the Marschner-Lobb signal in a haze: no sample is empty, no ray ends before the volume."""
    samples = signals.marschner_lobb().sample(n, dtype=torch.float32).samples
    return Scene(samples, _shell(0.5, 0.06, 0.25, haze=0.005), size, **options)


def blobs(n: int, size: int, empty: float = 0.8, **options: Any) -> Scene:
    """Three soft balls, and a transfer function under which a fraction `empty` of all bricks has nothing to see."""
    axis = torch.linspace(-1, 1, n)
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    samples = torch.zeros(n, n, n)
    for center, radius in (((-0.3, 0.2, 0.1), 0.35), ((0.4, -0.3, -0.2), 0.3), ((0.1, 0.4, -0.5), 0.2)):
        squared = (x - center[0]) ** 2 + (y - center[1]) ** 2 + (z - center[2]) ** 2
        samples = torch.maximum(samples, torch.exp(-squared / (2 * radius**2)))
    threshold = float(torch.quantile(_brick_maxima(samples), empty))
    v = torch.linspace(0, 1, 257)
    opacity = torch.where(v > threshold, 0.05 * (v - threshold) / (1 - threshold), torch.zeros_like(v))
    return Scene(samples, torch.stack((v, 0.6 + 0 * v, 1 - v, opacity), -1), size, **options)


def _brick_maxima(samples: Tensor) -> Tensor:
    """The largest sample in every brick of 8³ voxels and the voxel around it."""
    return torch.nn.functional.max_pool3d(samples[None, None], BRICK + 2, BRICK, 1).flatten()


def _shell(center: float, width: float, height: float, haze: float) -> Tensor:
    v = torch.linspace(0, 1, 129)
    opacity = height * (1 - (v - center).abs() / width).clamp_min(0) + haze
    return torch.stack((v, 0.6 + 0 * v, 1 - v, opacity), -1)


def without_skipping(call: Callable[[], Any]) -> Callable[[], Any]:
    """The call, with empty bricks marched through as well."""

    def wrapped() -> Any:
        before, fused.SKIPPING = fused.SKIPPING, False
        try:
            return call()
        finally:
            fused.SKIPPING = before

    return wrapped
