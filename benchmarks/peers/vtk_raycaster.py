"""VTK's fixed-point volume ray caster: trilinear, 15-bit arithmetic, gradients from a precomputed table.

It draws into an off-screen window, and its image is bytes: its numbers are not compared.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

import subprocess
import sys
from functools import cache
from typing import Any

import numpy as np

from benchmarks.harness import Contestant
from benchmarks.peers.task import without
from benchmarks.scene import LIGHTING, Scene

NAME = "VTK fixed-point"

_PROBE = """
import vtk
vtk.vtkLogger.SetStderrVerbosity(vtk.vtkLogger.VERBOSITY_OFF)
window = vtk.vtkRenderWindow()
window.SetOffScreenRendering(1)
window.SetSize(4, 4)
window.AddRenderer(vtk.vtkRenderer())
window.Render()
raise SystemExit(not window.SupportsOpenGL())
"""


@cache
def missing() -> str | None:
    """Without the package, or without a library to draw off the screen; asked in a process of its own: VTK aborts."""
    if why := without("vtk"):
        return why
    try:
        done = subprocess.run([sys.executable, "-c", _PROBE], capture_output=True, timeout=120, check=False)
    except subprocess.TimeoutExpired:
        return "it opens no window off the screen (no answer after two minutes)"
    return (
        None
        if done.returncode == 0
        else "it opens no window off the screen (needs EGL or OSMesa; Debian: libegl-mesa0)"
    )


def marching(scene: Scene) -> Contestant:
    import vtk

    vtk.vtkLogger.SetStderrVerbosity(vtk.vtkLogger.VERBOSITY_OFF)
    mapper = _mapper(vtk, scene)
    volume = vtk.vtkVolume()
    volume.SetMapper(mapper)
    volume.SetProperty(_property(vtk, scene))
    renderer = vtk.vtkRenderer()
    renderer.AddVolume(volume)
    _aim(renderer.GetActiveCamera(), scene)
    renderer.ResetCameraClippingRange()
    window = vtk.vtkRenderWindow()
    window.SetOffScreenRendering(1)
    window.SetMultiSamples(0)
    window.SetSize(scene.size, scene.size)
    window.AddRenderer(renderer)

    def call() -> Any:
        volume.Modified()
        window.Render()
        return renderer  # keeps the whole chain alive

    return Contestant(NAME, call, samples=scene.size**2)


def _mapper(vtk: Any, scene: Scene) -> Any:
    from vtkmodules.util.numpy_support import numpy_to_vtk

    samples = np.ascontiguousarray(scene.volume.numpy())
    image = vtk.vtkImageData()
    image.SetDimensions(*samples.shape[::-1])
    image.GetPointData().SetScalars(numpy_to_vtk(samples.reshape(-1), deep=1))
    mapper = vtk.vtkFixedPointVolumeRayCastMapper()
    mapper.SetInputData(image)
    mapper.SetNumberOfThreads(scene.threads)
    mapper.SetAutoAdjustSampleDistances(0)
    mapper.SetImageSampleDistance(1)
    mapper.SetSampleDistance(scene.step)
    return mapper


def _property(vtk: Any, scene: Scene) -> Any:
    opacity, color = vtk.vtkPiecewiseFunction(), vtk.vtkColorTransferFunction()
    for j, (red, green, blue, alpha) in enumerate(scene.table.tolist()):
        position = j / (len(scene.table) - 1)
        opacity.AddPoint(position, alpha)
        color.AddRGBPoint(position, red, green, blue)
    look = vtk.vtkVolumeProperty()
    look.SetScalarOpacity(opacity)
    look.SetColor(color)
    look.SetScalarOpacityUnitDistance(1)
    look.SetInterpolationTypeToLinear()
    if scene.lit:
        look.ShadeOn()
        look.SetAmbient(LIGHTING.ambient)
        look.SetDiffuse(LIGHTING.diffuse)
        look.SetSpecular(LIGHTING.specular)
        look.SetSpecularPower(LIGHTING.shininess)
    return look


def _aim(camera: Any, scene: Scene) -> None:
    camera.SetPosition(*scene.camera.position)
    camera.SetFocalPoint(*scene.camera.target)
    camera.SetViewUp(*scene.camera.up)
    camera.SetViewAngle(float(scene.camera.field_of_view))
