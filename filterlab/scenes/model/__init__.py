"""Models: what scene files and experiment configs say of volumes, signals, methods, cameras and lights.

Each is a strict section of a YAML file with a `build` that makes the object of this package it describes. A section
that is left out costs nothing: no lighting, no gradients. `scenes.build` puts them together, `scenes.reference` is
written from what stands here: the text under every key, its type, default and unit.
"""

from filterlab.scenes.model.colors import Color
from filterlab.scenes.model.materials import (
    EnvironmentModel,
    MaterialModel,
    PhongModel,
    ReflectionLinesModel,
    ToonModel,
)
from filterlab.scenes.model.quantities import Component, Opacity, Pixels, Positive, Section, Vector
from filterlab.scenes.model.reconstruction import AUTO, MethodName, Reconstruction, SceneMethod
from filterlab.scenes.model.scene import STEP, Scene
from filterlab.scenes.model.sources import VOLUMES_VARIABLE, SignalModel, SignalSource, VolumeFile, find_volume
from filterlab.scenes.model.surface import Cast, LevelSetModel, OnSurface, SurfaceOfItsOwn
from filterlab.scenes.model.terrain import TerrainLook, TerrainModel
from filterlab.scenes.model.transfer import ControlPoint, Peak, Transfer
from filterlab.scenes.model.values import MipModel, SliceModel
from filterlab.scenes.model.view import CameraView, Compass, Lighting, LightSource, Region

__all__ = [
    "AUTO",
    "STEP",
    "VOLUMES_VARIABLE",
    "CameraView",
    "Cast",
    "Color",
    "Compass",
    "Component",
    "ControlPoint",
    "EnvironmentModel",
    "LevelSetModel",
    "LightSource",
    "Lighting",
    "MaterialModel",
    "MethodName",
    "MipModel",
    "OnSurface",
    "Opacity",
    "Peak",
    "PhongModel",
    "Pixels",
    "Positive",
    "Reconstruction",
    "ReflectionLinesModel",
    "Region",
    "Scene",
    "SceneMethod",
    "Section",
    "SignalModel",
    "SignalSource",
    "SliceModel",
    "SurfaceOfItsOwn",
    "TerrainLook",
    "TerrainModel",
    "ToonModel",
    "Transfer",
    "Vector",
    "VolumeFile",
    "find_volume",
]
