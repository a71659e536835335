"""What every scene has once it is built, whatever it shows."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Any

from torch import Tensor

from filterlab.fields.base import Domain, Field
from filterlab.render.camera import Camera
from filterlab.render.image import Progress
from filterlab.render.legend import Legend
from filterlab.render.materials import Material
from filterlab.render.raycast import raycast
from filterlab.render.rays import Region
from filterlab.render.shading import Light
from filterlab.scenes.model import CameraView, Scene, Vector
from filterlab.surfaces.base import Surface


@dataclass(frozen=True, kw_only=True)
class Shown(ABC):
    """A scene with everything built that all of them have in common.

    Attributes:
        scene: with `method: auto` replaced by what was found.
        size: (width, height) in pixels.
        volume_bytes: of the samples; 0 for a signal that is not sampled.
        chosen: how `method: auto` came to its choice, in sentences; else nothing.
    """

    scene: Scene
    camera: Camera
    size: tuple[int, int]
    background: Vector
    region: Region | None
    device: str
    volume_bytes: int = 0
    chosen: tuple[str, ...] = ()

    @property
    @abstractmethod
    def domain(self) -> Domain:
        """What is framed."""

    @property
    def legend(self) -> Legend | None:
        """What stands for what values, where there is such a thing."""
        return None

    @property
    def told(self) -> str:
        """What a person may want to know of the picture, beside its size."""
        return ""

    def framed(self, view: CameraView) -> Camera:
        """The camera of a view, with all in it where it says no place."""
        return view.build(self.domain, self.size)

    @abstractmethod
    def render(self, progress: Progress = False) -> Tensor:
        """The image `(H, W, 4)`: linear RGB over the background, and opacity."""


@dataclass(frozen=True, kw_only=True)
class OfField(Shown):
    """A scene of a field."""

    field: Field

    @property
    def domain(self) -> Domain:
        return self.field.domain


@dataclass(frozen=True, kw_only=True)
class Casting(Shown):
    """A surface that rays are cast at.

    Attributes:
        subpixels: s: a pixel is the mean of s² rays.
    """

    surface: Surface
    material: Material
    lights: tuple[Light, ...]
    subpixels: int

    @property
    def domain(self) -> Domain:
        return self.surface.domain

    def options(self) -> dict[str, Any]:
        """What `raycast` takes beside the surface and what is seen of it."""
        cast = self.scene.cast
        assert cast is not None
        return {"background": self.background, "region": self.region, "sheets": cast.sheets, "shadows": cast.shadows}

    def render(self, progress: Progress = False) -> Tensor:
        """The image `(H, W, 4)`, as `filterlab.render.raycast.raycast` gives it."""
        image = raycast(
            self.surface,
            self.camera,
            self.material,
            size=self.size,
            lights=self.lights,
            subpixels=self.subpixels,
            seed=self.scene.jitter or 0,
            dtype=self.scene.dtype,
            device=self.device,
            progress=progress,
            **self.options(),
        )
        assert isinstance(image, Tensor)
        return image
