"""The scene of a volume alone: what nobody said is suggested, and written out as a scene has it.

volume file ──load──▶ field ──render.suggestion──▶ transfer function, camera ──▶ dictionary ──model──▶ Scene
"""

from __future__ import annotations

import os
from collections.abc import Mapping
from typing import Any

from filterlab import missing_values
from filterlab.fields.base import Field
from filterlab.io.config import loads_data
from filterlab.render.camera import PerspectiveCamera
from filterlab.render.suggestion import direction_for, sampled
from filterlab.render.transfer import TransferFunction
from filterlab.scenes.model import Scene, SceneMethod
from filterlab.volume import Volume

STEP = 0.35  # voxels; with jitter no rings of segments are left to be seen
_DIGITS = 6  # of what is suggested
_SIZE = (768, 768)
_FIRST = ("volume", "method", "size")  # keys that what is suggested depends on


def default_scene(volume: str | os.PathLike[str], overrides: Mapping[str, str] | None = None) -> Scene:
    """The scene that just shows a volume file: method, transfer function, camera and lights as they are suggested.

    `filterlab.io.config.dump_config` writes it as YAML, which renders the same picture.

    Args:
        volume: a file that `filterlab.load_volume` reads; NaN voxels in it are transparent.
        overrides: as for `load_scene`. What is suggested follows from `volume`, `method` and `size` among them, all
            others change what was.

    Raises:
        ConfigError: as `load_scene`. VolumeFileError: a damaged file. ValueError: a volume without a finite voxel.
    """
    return default_view(volume, overrides)[0]


def default_view(volume: str | os.PathLike[str], overrides: Mapping[str, str] | None = None) -> tuple[Scene, Volume]:
    """`default_scene`, and the volume that was read to find it, for `filterlab.scenes.build.build`."""
    overrides = dict(overrides or {})
    first = {key: text for key, text in overrides.items() if key.split(".")[0] in _FIRST}
    bare = {"volume": str(volume), "size": list(_SIZE), "surface": 0}
    asked = loads_data(bare, Scene, first, name=str(volume))
    assert asked.volume is not None
    samples = asked.volume.load()
    method = asked.method or SceneMethod()
    propagated = method.nan == "refuse" and "nan" not in method.model_fields_set
    _, unknown = missing_values.resolved(samples.samples, "propagate" if propagated else method.nan)
    content: dict[str, Any] = {"volume": str(volume), "method": {"name": method.name}}
    if unknown is not None:
        content["method"]["nan"] = "propagate"
    # classes and framing do not hang on the method: trilinear is soonest done
    field = SceneMethod(name="trilinear", boundary=method.boundary).build(samples, nan="propagate")
    scene = loads_data(content | suggested(field, asked.size), Scene, overrides, name=str(volume))
    return scene, samples


def suggested(field: Field, size: tuple[int, int] = _SIZE, level: float | None = None) -> dict[str, Any]:
    """All of a scene but its volume and method, for a field, an image of (width, height), a level to show."""
    samples, direction = sampled(field), direction_for(field)
    transfer = TransferFunction.suggested(field, samples)
    camera = PerspectiveCamera.suggested(field, transfer, direction, aspect=size[0] / size[1], samples=samples)
    return {
        **(_medium(transfer) if level is None else {"surface": level}),
        "camera": {
            "position": _rounded(camera.position),
            "target": _rounded(camera.target),
            "field_of_view": camera.field_of_view,
        },
        "lighting": {
            "lights": [
                {"direction": [0.35, -0.5 if direction[1] > 0 else 0.5, 0.8], "color": [0.95, 0.93, 0.9]},
                {"color": [0.35, 0.37, 0.4]},
            ],
            "ambient": 0.25,
            "specular": 0.25,
            "shininess": 24.0,
        },
        "size": list(size),
        "background": [0.02, 0.022, 0.03],
    }


def _medium(transfer: TransferFunction) -> dict[str, Any]:
    """How it is marched through."""
    return {
        "transfer": {"unit": transfer.unit, "points": _points(transfer)},
        "step": STEP,
        "jitter": 1,
        "termination": 0.002,
    }


def _points(transfer: TransferFunction) -> list[dict[str, Any]]:
    rows = zip(transfer.positions.tolist(), transfer.colors.tolist(), transfer.opacities.tolist(), strict=True)
    return [{"value": x, "color": rgb, "opacity": float(f"{alpha:.3g}")} for x, rgb, alpha in rows]


def _rounded(numbers: Any) -> list[float]:
    return [float(f"{float(x):.{_DIGITS}g}") for x in numbers]
