"""A scene seen from all around: the camera goes round its target, lights and field stay as they are."""

from __future__ import annotations

from dataclasses import replace

import torch

from filterlab.render.camera import Camera, OrthographicCamera
from filterlab.scenes.build import AnyPrepared
from filterlab.scenes.model import Scene

TURN = 4.0
"""Seconds that a turn takes in a picture that moves."""
_VERTICAL = (0.0, 0.0, 1.0)
_SHORTEST = 0.02
"""Seconds for which viewers show a picture at least; shorter ones they slow down."""


def turntable(prepared: AnyPrepared, count: int) -> list[AnyPrepared]:
    """The views of a whole turn about the axis along `up` through the target, at equal angles, the first ahead.

    A compass that looks straight down or up turns on the spot, about the vertical. The field is that of `prepared`,
    built once. A camera that frames what is shown keeps the distance from which all of it is in view all the way round:
    it neither comes nearer nor cuts anything off.

    Raises:
        ValueError: fewer than two views; a slice, of which nothing is seen from its side.
    """
    check_turn(prepared.scene, count)
    view, angles = prepared.scene.camera, [360 * k / count for k in range(count)]
    axis = _VERTICAL if view.straight else None
    turned = [prepared.camera.turned(angle, axis) for angle in angles]
    if view.position is None:
        framed = [_framed(prepared, camera, angle) for camera, angle in zip(turned, angles, strict=True)]
        first = max(range(count), key=lambda k: _reach(framed[k]))
        turned = [framed[first].turned(360 * (k - first) / count, axis) for k in range(count)]
    return [replace(prepared, camera=camera) for camera in turned]


def check_turn(scene: Scene, count: int) -> None:
    """Raises ValueError as `turntable` does, before anything is built."""
    if count < 2:
        raise ValueError(f"expected a turntable of at least 2 pictures; got {count}")
    if scene.slice is not None:
        raise ValueError("a slice has no other sides: expected a medium, a surface or a mip on a turntable")


def _framed(prepared: AnyPrepared, camera: Camera, angle: float) -> Camera:
    """The camera that looks in the same direction, as near as all that is shown can be seen from there."""
    view = prepared.scene.camera
    if view.compass is not None and view.straight:
        return prepared.framed(view.model_copy(update={"compass": (view.compass[0] - angle, view.compass[1])}))
    position, target = (torch.as_tensor(v, dtype=torch.float64) for v in (camera.position, camera.target))
    looking = {"direction": tuple((target - position).tolist()), "compass": None}
    return prepared.framed(view.model_copy(update=looking))


def _reach(camera: Camera) -> float:
    """How far away it is; how much an orthographic one sees."""
    if isinstance(camera, OrthographicCamera):
        return float(camera.height)
    position, target = (torch.as_tensor(v, dtype=torch.float64) for v in (camera.position, camera.target))
    return float((position - target).norm())


def seconds_of_each(count: int) -> float:
    """For how long each of the pictures of a turn is shown."""
    return max(TURN / count, _SHORTEST)
