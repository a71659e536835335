"""What a program that uses filterlab may write, for `test_wheel`: a type checker has to know the types named here."""

from typing import reveal_type

import numpy as np
import torch

import filterlab as fl
from filterlab.render import Light, PerspectiveCamera, Phong, TransferFunction, raycast, render
from filterlab.surfaces import HeightField, LevelSet, Quadrics, fit_slim, mesh

points = torch.zeros(5, 3)
volume = fl.load_volume("scan.nrrd")
field = fl.reconstruct(np.zeros((4, 4, 4)), boundary=fl.Boundary.MIRROR)
module = fl.nn.Reconstruction((4, 4, 4), "notch")
surface = LevelSet(field, level=0.5)
hits = surface.hit(points, points)
camera = PerspectiveCamera.framing(field.domain)

reveal_type(fl.__version__)  # str
reveal_type(volume)  # Volume
reveal_type(volume.samples)  # Tensor
reveal_type(field)  # Field
reveal_type(field(points))  # Tensor
reveal_type(field.value_and_gradient(points))  # tuple[Tensor, Tensor]
reveal_type(field.jet(points, 2))  # tuple[Tensor, ...]
reveal_type(module)  # Reconstruction
reveal_type(module(points))  # Tensor
reveal_type(module.field())  # Field
reveal_type(fl.resample(volume, spacing=0.5))  # Volume
reveal_type(fl.recommend(volume, max_error=0.01))  # Recommendation
reveal_type(fl.METHODS["notch"].facts.support)  # int
reveal_type(fl.KERNELS)  # dict[str, Kernel]
reveal_type(fl.signals.marschner_lobb())  # Signal
reveal_type(surface)  # LevelSet
reveal_type(hits)  # Hits
reveal_type(hits.t)  # Tensor
reveal_type(surface.at(points, points, hits))  # SurfacePoints
reveal_type(mesh(surface))  # Mesh
reveal_type(Quadrics.ellipsoids(points, torch.ones(5)))  # Quadrics
reveal_type(HeightField(torch.zeros(4, 4)).jet(points[:, :2], 1))  # tuple[Tensor, ...]
reveal_type(fl.load_heights("dem.tif"))  # Heights
reveal_type(fit_slim(points))  # Slim
reveal_type(camera)  # PerspectiveCamera
reveal_type(render(field, camera, TransferFunction.suggested(field), size=(4, 4)))  # Tensor
reveal_type(raycast(surface, camera, size=(4, 4))[..., :3])  # Tensor
reveal_type(raycast(surface, camera, channels=("depth", "normal")))  # dict[str, Tensor]
reveal_type(Phong((1, 1, 1)))  # Phong
reveal_type(Light(None))  # Light
reveal_type(fl.io.load_image("picture.png"))  # Tensor
