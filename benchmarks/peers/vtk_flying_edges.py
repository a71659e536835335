"""VTK's Flying Edges: from a level to triangles with normals, which nobody has drawn yet."""

# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from benchmarks.harness import Contestant
from benchmarks.peers.task import Casting, without

NAME = "VTK Flying Edges, triangles alone"


def missing() -> str | None:
    return without("vtk")


def new_level(task: Casting, level: Callable[[], float]) -> Contestant:
    from vtkmodules.util.numpy_support import numpy_to_vtk
    from vtkmodules.vtkCommonCore import vtkSMPTools
    from vtkmodules.vtkCommonDataModel import vtkImageData
    from vtkmodules.vtkFiltersCore import vtkFlyingEdges3D

    image = vtkImageData()
    image.SetDimensions(*reversed(task.volume.shape))
    image.GetPointData().SetScalars(numpy_to_vtk(task.volume.numpy().ravel()))
    contour = vtkFlyingEdges3D()
    contour.SetInputData(image)

    def call() -> Any:
        vtkSMPTools.Initialize(task.threads)
        contour.SetValue(0, level())
        contour.Update()
        return contour.GetOutput()

    return Contestant(NAME, call, samples=task.rays)
