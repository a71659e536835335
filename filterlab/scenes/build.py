"""Scenes built and rendered: what a file describes becomes the objects of this package.

scene = load_scene("engine.yaml", {"method": "notch"})
image = render_scene(scene)
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import torch
from torch import Tensor

from filterlab.fields.base import Domain
from filterlab.io.config import load_config, loads_data
from filterlab.recommendation import recommend, report
from filterlab.render.dvr import Frame, prepare
from filterlab.render.image import Progress
from filterlab.render.legend import Legend
from filterlab.render.sampling import Sampling
from filterlab.render.shading import Shading
from filterlab.render.transfer import TransferFunction
from filterlab.scenes.model import (
    LevelSetModel,
    Lighting,
    OnSurface,
    Scene,
    SceneMethod,
    SurfaceOfItsOwn,
    TerrainModel,
)
from filterlab.scenes.shown import Casting, OfField
from filterlab.scenes.terrain import VIEW, PreparedTerrain, Terrain
from filterlab.scenes.values import PreparedProjection, PreparedSlice, camera_of, projection, sliced
from filterlab.surfaces.level_set import LevelSet
from filterlab.volume import Volume


@dataclass(frozen=True, kw_only=True)
class Prepared(OfField):
    """A medium: what `render` takes.

    Attributes:
        sampling: how the picture is sampled.
    """

    transfer: TransferFunction
    shading: Shading | None
    sampling: Sampling

    @property
    def legend(self) -> Legend:
        return Legend.of_transfer(self.transfer, label=self.scene.legend_label)

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


@dataclass(frozen=True, kw_only=True)
class PreparedSurface(Casting, OfField):
    """The level set of a field."""

    surface: LevelSet


def load_scene(path: str | os.PathLike[str], overrides: Mapping[str, str] | None = None) -> Scene:
    """The scene in a YAML file, with some of its keys set anew ({"camera.window": "[0, 0, 0.5, 0.5]"}).

    Raises:
        ConfigError: every problem with its line, the path of the key and, for names, the known ones. Volume files are
            found here, before anything is computed.
    """
    return load_config(path, Scene, overrides)


def surface_scene(volume: str | os.PathLike[str], level: str, overrides: Mapping[str, str] | None = None) -> Scene:
    """The scene of a surface in a volume file with everything else left out: seen from the side, softly lit.

    Args:
        level: a number as text.
        overrides: as for `load_scene`.

    Raises:
        ConfigError: as `load_scene`.
    """
    content = {"volume": str(volume), "surface": {"level": _number(level), "subpixels": 2}, **_SURFACE}
    return loads_data(content, Scene, overrides, name="--level")


def alone_scene(path: str | os.PathLike[str], key: str, overrides: Mapping[str, str] | None = None) -> Scene:
    """The scene of a surface in a file of its own, seen whole, lit as that of a `surface_scene`.

    Args:
        key: of the surface that the file stands for: slim, quadrics, ….
        overrides: as for `load_scene`.

    Raises:
        ConfigError: as `load_scene`.
    """
    content = {"surface": {key: str(path), "subpixels": 2}, **_SURFACE, "camera": {"direction": _DIRECTION}}
    return loads_data(content, Scene, overrides, name=str(path))


def terrain_scene(heights: str | os.PathLike[str], overrides: Mapping[str, str] | None = None) -> Scene:
    """The scene of a terrain in a file with everything else left out: all of it from the south, lit from north-west.

    Raises:
        ConfigError: as `load_scene`.
    """
    content = {"terrain": {"heights": str(heights)}, **_TERRAIN}
    return loads_data(content, Scene, overrides, name=str(heights))


def values_scene(volume: str | os.PathLike[str], overrides: Mapping[str, str]) -> Scene:
    """The scene of a volume file whose values are shown: the overrides have a `mip` or a `slice`.

    Raises:
        ConfigError: as `load_scene`.
    """
    return loads_data({"volume": str(volume)}, Scene, overrides, name="the command line")


_DIRECTION = [-0.6, 0.75, -0.5]
_SURFACE: Mapping[str, Any] = {
    "camera": {"direction": _DIRECTION, "window": [0.12, 0.12, 0.88, 0.88]},
    "lighting": {"lights": [{"direction": [0.5, -0.6, 0.8], "color": [0.9, 0.88, 0.85]}, {"color": [0.3, 0.32, 0.36]}]},
    "background": [0.02, 0.022, 0.03],
}

_TERRAIN: Mapping[str, Any] = {
    "camera": VIEW.model_dump(mode="json", exclude_unset=True),
    "size": [960, 600],
}


def _number(text: str) -> float | str:
    """The number, or the text where it is none, for the model to refuse."""
    try:
        return float(text)
    except ValueError:
        return text


AnyPrepared = Prepared | Casting | PreparedProjection | PreparedSlice


def build(scene: Scene, volume: Volume | None = None) -> AnyPrepared:
    """Loads or samples what the scene shows, reconstructs it and builds camera, lights and what they fall on.

    Args:
        volume: that of the scene's file, where it has been read.

    Raises ValueError where `method: auto` finds nothing within its budget, with the best there is.
    """
    if scene.terrain is not None:
        return PreparedTerrain.of(scene, _terrain(scene.terrain, scene.device))
    if isinstance(scene.surface, SurfaceOfItsOwn):
        return _alone(scene, scene.surface)
    volume = _volume(scene, volume)
    scene, chosen = settled(scene, volume)
    if volume is None:
        assert scene.signal is not None
        signal = scene.signal.build()
        field, value_range = signal, lambda: _range(signal.sample(64).samples)
    else:
        field = (scene.method or SceneMethod()).build(volume)
        value_range = partial(_range, volume.samples)
    shown: dict[str, Any] = _shown(scene, field.domain) | {
        "field": field,
        "volume_bytes": 0 if volume is None else volume.samples.nbytes,
        "chosen": chosen,
    }
    if isinstance(scene.surface, LevelSetModel):
        surface = LevelSet(field, scene.surface.at(value_range))
        return PreparedSurface(**shown, surface=surface, **_lit(scene, scene.surface))
    if scene.mip is not None:
        return projection(scene.mip, shown, value_range)
    if scene.slice is not None:
        return sliced(scene.slice, shown, value_range)
    assert scene.transfer is not None
    return Prepared(
        **shown,
        transfer=scene.transfer.build(value_range, field.domain.voxel_size),
        shading=scene.lighting.build() if scene.lighting else None,
        sampling=Sampling(scene.step_or_default, scene.jitter, scene.termination, scene.dtype),
    )


def _shown(scene: Scene, domain: Domain) -> dict[str, Any]:
    """What every scene has."""
    return {
        "scene": scene,
        "camera": camera_of(scene, domain),
        "size": scene.size,
        "background": scene.background,
        "region": scene.region.build() if scene.region else None,
        "device": scene.device,
    }


def _terrain(asked: TerrainModel, device: str) -> Terrain:
    heights = asked.load()
    try:
        return Terrain.of(asked, heights, device)
    except ValueError as error:
        raise ValueError(f"{asked.heights}: {error}") from None


def _alone(scene: Scene, asked: SurfaceOfItsOwn) -> Casting:
    surface = asked.build()
    tensors = surface.tensors
    if tensors is not None and scene.device != "cpu":
        surface = surface.with_tensors([x.to(scene.device) for x in tensors])
    return Casting(**_shown(scene, surface.domain), surface=surface, **_lit(scene, asked))


def _lit(scene: Scene, asked: OnSurface) -> dict[str, Any]:
    """What a surface is made of, its lights, and rays for a pixel."""
    lights = (scene.lighting or Lighting()).build().lights
    return {"material": asked.material.build(), "lights": tuple(lights), "subpixels": asked.subpixels}


def render_scene(scene: Scene, progress: Progress = False) -> Tensor:
    """The picture `(H, W, 3)`: linear RGB over the scene's background, ready for `filterlab.io.save_image`.

    For its opacity as well: `build(scene).render()`.
    """
    return picture(build(scene), progress)


def picture(prepared: AnyPrepared, progress: Progress = False) -> Tensor:
    """The same of a scene that is built; with its legend, where the scene asks for one."""
    image, asked, legend = prepared.render(progress)[..., :3], prepared.scene.legend, prepared.legend
    return image if asked is None or legend is None else legend.beside(image, prepared.background, asked.side)


def settled(scene: Scene, volume: Volume | None) -> tuple[Scene, tuple[str, ...]]:
    """The scene with `method: auto` replaced by what is found on the volume, and how, in sentences."""
    method = scene.method
    if volume is None or method is None or method.max_error is None:
        return scene, ()
    use = _use(scene, volume)
    found = recommend(volume, method.max_error, **use, boundary=method.boundary, nan=method.nan)
    if found.pick is None:
        told = " ".join(report.sentences(found)[2:]).removeprefix("The ").removesuffix(".")
        raise ValueError(f"method: found none within max_error {report.percent(method.max_error)}; the {told}")
    explicit = SceneMethod(
        name=found.pick.method,
        scheme=found.pick.scheme,
        storage=found.pick.storage,  # type: ignore[arg-type]
        boundary=method.boundary,
        nan=method.nan,
    )
    step = found.pick.step if scene.stepped and scene.step is None else scene.step
    return scene.model_copy(update={"method": explicit, "step": step}), tuple(report.sentences(found))


def _use(scene: Scene, volume: Volume) -> dict[str, Any]:
    """What the scene shows of the volume, as `recommend` is asked: a surface, values, or all that rays go through."""
    if isinstance(scene.surface, LevelSetModel):
        return {"task": "isosurface", "level": scene.surface.at(partial(_range, volume.samples))}
    return {"task": "dvr" if scene.slice is None else "resample"}


def _volume(scene: Scene, loaded: Volume | None) -> Volume | None:
    """The samples, in the type and on the device of the scene; None for a signal that is shown as it is."""
    dtype = scene.dtype
    if scene.volume is not None:
        volume = loaded or scene.volume.load()
    else:
        assert scene.signal is not None
        if scene.signal.samples is None:
            return None
        volume = scene.signal.build().sample(scene.signal.samples, dtype=dtype)
    if dtype == torch.float64 or volume.dtype == torch.float64:
        volume = volume.to(dtype)
    return volume.to(scene.device)


def _range(samples: Tensor) -> tuple[float, float]:
    """Of the samples that have a value; as they are where none has."""
    low, high = samples.aminmax()
    if not (low.isfinite() and high.isfinite()) and bool((known := samples.isfinite()).any()):
        low, high = samples[known].aminmax()
    return float(low), float(high)
