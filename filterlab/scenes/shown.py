"""What every scene has once it is built, whatever it shows."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass

from torch import Tensor

from filterlab.fields.base import Domain, Field
from filterlab.render.camera import Camera
from filterlab.render.image import Progress
from filterlab.render.legend import Legend
from filterlab.render.rays import Region
from filterlab.scenes.model import Scene, Vector


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
