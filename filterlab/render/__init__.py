"""Pictures: direct volume rendering of any Field, and ray casting of surfaces; cameras, lights, materials."""

from filterlab.render.camera import Camera, OrthographicCamera, PerspectiveCamera
from filterlab.render.colormaps import ColorScale
from filterlab.render.dvr import render
from filterlab.render.materials import Environment, Material, Phong, ReflectionLines, Toon
from filterlab.render.raycast import raycast
from filterlab.render.relief import ByAspect, ByHeight, ByNormal, BySlope, Draped, Hillshade, Lambertian, Unlit
from filterlab.render.scenery import Block, Haze, Sky, Water, sun
from filterlab.render.shading import Light, Shading
from filterlab.render.silhouettes import Silhouettes
from filterlab.render.transfer import TransferFunction
from filterlab.render.values import Plane, colored, maximum_projection, plane_values

__all__ = [
    "Block",
    "ByAspect",
    "ByHeight",
    "ByNormal",
    "BySlope",
    "Camera",
    "ColorScale",
    "Draped",
    "Environment",
    "Haze",
    "Hillshade",
    "Lambertian",
    "Light",
    "Material",
    "OrthographicCamera",
    "PerspectiveCamera",
    "Phong",
    "Plane",
    "ReflectionLines",
    "Shading",
    "Silhouettes",
    "Sky",
    "Toon",
    "TransferFunction",
    "Unlit",
    "Water",
    "colored",
    "maximum_projection",
    "plane_values",
    "raycast",
    "render",
    "sun",
]
