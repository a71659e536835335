"""Pictures: direct volume rendering of any Field, and ray casting of surfaces; cameras, lights, materials."""

from filterlab.render.camera import Camera, OrthographicCamera, PerspectiveCamera
from filterlab.render.colormaps import ColorScale
from filterlab.render.dvr import render
from filterlab.render.materials import Environment, Material, Phong, ReflectionLines, Toon
from filterlab.render.raycast import raycast
from filterlab.render.shading import Light, Shading
from filterlab.render.silhouettes import Silhouettes
from filterlab.render.transfer import TransferFunction
from filterlab.render.values import Plane, colored, maximum_projection, plane_values

__all__ = [
    "Camera",
    "ColorScale",
    "Environment",
    "Light",
    "Material",
    "OrthographicCamera",
    "PerspectiveCamera",
    "Phong",
    "Plane",
    "ReflectionLines",
    "Shading",
    "Silhouettes",
    "Toon",
    "TransferFunction",
    "colored",
    "maximum_projection",
    "plane_values",
    "raycast",
    "render",
]
