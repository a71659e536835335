"""Direct volume rendering: cameras, rays, transfer functions, shading and the marcher over any Field."""

from filterlab.render.camera import Camera, OrthographicCamera, PerspectiveCamera
from filterlab.render.dvr import render
from filterlab.render.shading import Light, Shading
from filterlab.render.transfer import TransferFunction

__all__ = [
    "Camera",
    "Light",
    "OrthographicCamera",
    "PerspectiveCamera",
    "Shading",
    "TransferFunction",
    "render",
]
