"""Files: volumes in and out, images, strict configurations, and writing that is whole or not at all.

Names are loaded when they are first used, so that reading a configuration does not wait for torch.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from filterlab.io.atomic import atomic_write
    from filterlab.io.bounded import VolumeFileError, VolumeHeader
    from filterlab.io.config import ConfigError, StrictModel, dump_config, load_config
    from filterlab.io.images import load_image, save_image
    from filterlab.io.volumes import FORMATS, describe, load_volume, save_volume

_HOMES = {
    "atomic_write": "atomic",
    "VolumeFileError": "bounded",
    "VolumeHeader": "bounded",
    "ConfigError": "config",
    "StrictModel": "config",
    "dump_config": "config",
    "load_config": "config",
    "load_image": "images",
    "save_image": "images",
    "FORMATS": "volumes",
    "describe": "volumes",
    "load_volume": "volumes",
    "save_volume": "volumes",
}

__all__ = [
    "FORMATS",
    "ConfigError",
    "StrictModel",
    "VolumeFileError",
    "VolumeHeader",
    "atomic_write",
    "describe",
    "dump_config",
    "load_config",
    "load_image",
    "load_volume",
    "save_image",
    "save_volume",
]


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
