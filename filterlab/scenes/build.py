"""Scenes built and rendered: what a file describes becomes the objects of this package.

scene = load_scene("engine.yaml", {"method": "notch"})
image = render_scene(scene)
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from filterlab.fields.base import Field
from filterlab.io.config import load_config
from filterlab.recommendation import recommend, report
from filterlab.render.camera import Camera
from filterlab.render.dvr import Frame, prepare
from filterlab.render.image import Progress
from filterlab.render.rays import Region
from filterlab.render.sampling import Sampling
from filterlab.render.shading import Shading
from filterlab.render.transfer import TransferFunction
from filterlab.scenes.model import Scene, SceneMethod, Vector
from filterlab.volume import Volume


@dataclass(frozen=True)
class Prepared:
    """A scene with everything built: what `render` takes.

    Attributes:
        scene: with `method: auto` replaced by what was found.
        size: (width, height) in pixels.
        sampling: how the picture is sampled.
        volume_bytes: of the samples; 0 for a signal that is not sampled.
        chosen: how `method: auto` came to its choice, in sentences; else nothing.
    """

    scene: Scene
    field: Field
    camera: Camera
    transfer: TransferFunction
    size: tuple[int, int]
    shading: Shading | None
    background: Vector
    region: Region | None
    sampling: Sampling
    device: str
    volume_bytes: int = 0
    chosen: tuple[str, ...] = ()

    def frame(self) -> Frame:
        """The image, ready to be marched."""
        return prepare(
            self.field,
            self.camera,
            self.transfer,
            size=self.size,
            shading=self.shading,
            background=self.background,
            region=self.region,
            sampling=self.sampling,
            device=self.device,
        )

    def render(self, progress: Progress = False) -> Tensor:
        """The image `(H, W, 4)`, as `filterlab.render.render` gives it."""
        return self.frame().run(progress)


def load_scene(path: str | os.PathLike[str], overrides: Mapping[str, str] | None = None) -> Scene:
    """The scene in a YAML file, with some of its keys set anew ({"camera.window": "[0, 0, 0.5, 0.5]"}).

    Raises:
        ConfigError: every problem with its line, the path of the key and, for names, the known ones. Volume files are
            found here, before anything is computed.
    """
    return load_config(path, Scene, overrides)


def build(scene: Scene) -> Prepared:
    """Loads or samples what the scene shows, reconstructs it and builds camera, transfer function and lights.

    Raises ValueError where `method: auto` finds nothing within its budget, with the best there is.
    """
    volume = _volume(scene)
    scene, chosen = settled(scene, volume)
    if volume is None:
        assert scene.signal is not None
        signal = scene.signal.build()
        field, value_range = signal, lambda: _range(signal.sample(64).samples)
    else:
        field = (scene.method or SceneMethod()).build(volume)
        value_range = partial(_range, volume.samples)
    transfer = scene.transfer.build(value_range, field.domain.voxel_size)
    camera = scene.camera.build(field.domain, scene.size)
    return Prepared(
        scene=scene,
        field=field,
        camera=camera,
        transfer=transfer,
        size=scene.size,
        shading=scene.lighting.build() if scene.lighting else None,
        background=scene.background,
        region=scene.region.build() if scene.region else None,
        sampling=Sampling(scene.step_or_default, scene.jitter, scene.termination, scene.dtype),
        device=scene.device,
        volume_bytes=0 if volume is None else volume.samples.nbytes,
        chosen=chosen,
    )


def render_scene(scene: Scene, progress: Progress = False) -> Tensor:
    """The picture `(H, W, 3)`: linear RGB over the scene's background, ready for `filterlab.io.save_image`.

    For its opacity as well: `build(scene).render()`.
    """
    return build(scene).render(progress)[..., :3]


def settled(scene: Scene, volume: Volume | None) -> tuple[Scene, tuple[str, ...]]:
    """The scene with `method: auto` replaced by what is found on the volume, and how, in sentences."""
    method = scene.method
    if volume is None or method is None or method.max_error is None:
        return scene, ()
    found = recommend(volume, method.max_error, task="dvr", boundary=method.boundary, nan=method.nan)
    if found.pick is None:
        best = report.sentences(found)[-1].removeprefix("The ").removesuffix(".")
        raise ValueError(f"method: found none within max_error {report.percent(method.max_error)}; the {best}")
    explicit = SceneMethod(
        name=found.pick.method,
        scheme=found.pick.scheme,
        storage=found.pick.storage,  # type: ignore[arg-type]
        boundary=method.boundary,
        nan=method.nan,
    )
    step = found.pick.step if scene.step is None else scene.step
    return scene.model_copy(update={"method": explicit, "step": step}), tuple(report.sentences(found))


def _volume(scene: Scene) -> Volume | None:
    """The samples, in the type and on the device of the scene; None for a signal that is shown as it is."""
    dtype = scene.dtype
    if scene.volume is not None:
        volume = scene.volume.load()
    else:
        assert scene.signal is not None
        if scene.signal.samples is None:
            return None
        volume = scene.signal.build().sample(scene.signal.samples, dtype=dtype)
    if dtype == torch.float64 or volume.dtype == torch.float64:
        volume = volume.to(dtype)
    return volume.to(scene.device)


def _range(samples: Tensor) -> tuple[float, float]:
    low, high = samples.aminmax()
    return float(low), float(high)
