"""Scenes that show values: maximum intensity projections and slices."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from filterlab.fields.base import Domain
from filterlab.render.camera import Camera
from filterlab.render.colormaps import ColorScale
from filterlab.render.image import Progress
from filterlab.render.legend import Legend
from filterlab.render.sampling import Sampling
from filterlab.render.transfer import TransferFunction
from filterlab.render.values import (
    Plane,
    colored,
    maximum_projection,
    plane_values,
    samples_of_projection,
    work_of_plane,
    work_of_projection,
)
from filterlab.scenes.model import MipModel, Scene, SliceModel
from filterlab.scenes.model.values import ValueColors
from filterlab.scenes.shown import OfField

Range = Callable[[], tuple[float, float]]


@dataclass(frozen=True)
class TransferColors:
    """The colours of a transfer function, whatever its opacities."""

    transfer: TransferFunction

    def __call__(self, value: Tensor) -> Tensor:
        return self.transfer(value)[0]


@dataclass(frozen=True, kw_only=True)
class PreparedValues(OfField):
    """A picture of values.

    Attributes:
        colors: what a value looks like.
    """

    colors: ColorScale | TransferColors

    @property
    def legend(self) -> Legend:
        label = self.scene.legend_label
        if isinstance(self.colors, ColorScale):
            return Legend.of_scale(self.colors, label=label)
        return Legend.of_transfer(self.colors.transfer, opaque=True, label=label)

    @property
    @abstractmethod
    def work_bytes(self) -> int:
        """Of memory, for what is evaluated together, at most."""

    @abstractmethod
    def values(self, progress: Progress = False) -> Tensor:
        """The values `(H, W)`, NaN where there are none."""

    def render(self, progress: Progress = False) -> Tensor:
        """The image `(H, W, 4)`: linear RGB over the background, and opacity."""
        return colored(self.values(progress), self.colors, self.background)


@dataclass(frozen=True, kw_only=True)
class PreparedProjection(PreparedValues):
    """What `maximum_projection` takes."""

    sampling: Sampling

    @property
    def work_bytes(self) -> int:
        return work_of_projection(self.size[0] * self.size[1], self.sampling.memory)

    def values(self, progress: Progress = False) -> Tensor:
        return maximum_projection(
            self.field,
            self.camera,
            size=self.size,
            step=self.sampling.step,
            region=self.region,
            jitter_seed=self.sampling.jitter_seed,
            dtype=self.sampling.dtype,
            device=self.device,
            progress=progress,
        )


@dataclass(frozen=True, kw_only=True)
class PreparedSlice(PreparedValues):
    """What `plane_values` takes."""

    plane: Plane

    @property
    def work_bytes(self) -> int:
        return work_of_plane(self.size[0] * self.size[1])

    def values(self, progress: Progress = False) -> Tensor:
        return plane_values(
            self.field,
            self.plane,
            self.camera,
            size=self.size,
            region=self.region,
            dtype=self.scene.dtype,
            device=self.device,
            progress=progress,
        )


def projection(asked: MipModel, shown: dict[str, Any], value_range: Range) -> PreparedProjection:
    """The projection of a scene that is built otherwise."""
    scene: Scene = shown["scene"]
    sampling = Sampling(scene.step_or_default, scene.jitter, None, scene.dtype)
    return PreparedProjection(**shown, colors=_colors(asked, shown, value_range), sampling=sampling)


def samples_of(prepared: PreparedProjection) -> int:
    """How many a projection takes."""
    domain, camera = prepared.field.domain, prepared.camera
    return samples_of_projection(domain, camera, prepared.size, prepared.sampling, prepared.region)


def sliced(asked: SliceModel, shown: dict[str, Any], value_range: Range) -> PreparedSlice:
    """The slice of a scene that is built otherwise. Raises ValueError for a plane beside the domain."""
    plane, domain = asked.plane(shown["field"].domain), shown["field"].domain
    check_cut(plane, domain)
    return PreparedSlice(**shown, colors=_colors(asked, shown, value_range), plane=plane)


def check_cut(plane: Plane, domain: Domain) -> None:
    """Raises ValueError unless the plane meets the domain."""
    corners = domain.corners()
    point, normal = (torch.as_tensor(v, dtype=torch.float64) for v in (plane.point, plane.normal))
    distance = (corners - point) @ normal / normal.norm()
    slack = 1e-9 * domain.diagonal
    if not float(distance.min()) <= slack or not float(distance.max()) >= -slack:
        told = ", ".join(f"{float(x):g}" for x in point)
        ends = ", ".join(f"{a} {lo:g} … {hi:g}" for a, lo, hi in zip("xyz", *corners.aminmax(dim=0), strict=True))
        raise ValueError(f"slice: expected a plane through the volume ({ends}); got one through {told}")


def _colors(asked: ValueColors, shown: dict[str, Any], value_range: Range) -> ColorScale | TransferColors:
    transfer = shown["scene"].transfer
    if transfer is None:
        return asked.scale(value_range)
    return TransferColors(transfer.build(value_range, shown["field"].domain.voxel_size))


def camera_of(scene: Scene, domain: Domain) -> Camera:
    """The camera of a scene: of a slice one in front of it, unless the scene has another."""
    view = scene.camera
    if scene.slice is None or not view.framed:
        return view.build(domain, scene.size)
    plane = scene.slice.plane(domain)
    return plane.camera(domain, up=view.up, aspect=view.aspect(scene.size), margin=view.margin, window=view.window)
