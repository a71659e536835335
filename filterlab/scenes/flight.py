"""A flight over a terrain: a smooth way through a few points, at a height above the ground, looking ahead.

Letters: k points p_k = (x, y, z); u the length of the way through them by straight lines; c(u) the cubic spline through
them (natural at its ends, periodic where the way is closed). Pictures are at equal steps of u.
"""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from pydantic import Field, model_validator

from filterlab.io.config import StrictModel, load_config
from filterlab.render.camera import Camera, PerspectiveCamera
from filterlab.scenes.build import AnyPrepared
from filterlab.scenes.model import Scene
from filterlab.scenes.terrain import PreparedTerrain, Terrain

SECONDS = 0.04
"""For which each picture of a flight is shown."""
Above = Annotated[float, Field(gt=0)]
Points = Annotated[list[tuple[float, float, Above]], Field(min_length=2, max_length=10_000)]
_AHEAD = 0.02  # of the way, that the camera looks to


class Flight(StrictModel):
    """The path in a file.

    Attributes:
        points: x, y in the coordinates of the heights' file, and metres above the ground.
        closed: whether the way leads back to its first point.
        pitch: degrees that the camera looks down from the way ahead.
        field_of_view: vertical, in degrees.
    """

    points: Points
    closed: bool = False
    pitch: Annotated[float, Field(ge=-89, le=89)] = 12.0
    field_of_view: Annotated[float, Field(gt=0, lt=180)] = 45.0

    @model_validator(mode="after")
    def _apart(self) -> Flight:
        ends = zip(self.points, self.points[1:] + self.points[: self.closed], strict=False)
        if any(a[:2] == b[:2] for a, b in ends):
            raise ValueError("points: expected neighbours at different places; got the same twice in a row")
        return self

    def views(self, prepared: AnyPrepared, count: int) -> list[AnyPrepared]:
        """A scene of a terrain from equal steps along the way. Raises ValueError as `check_flight`, `cameras`."""
        check_flight(prepared.scene)
        assert isinstance(prepared, PreparedTerrain)
        return [replace(prepared, camera=camera) for camera in self.cameras(prepared.terrain, count)]

    def cameras(self, terrain: Terrain, count: int) -> list[Camera]:
        """Cameras at equal steps along the way, never lower than a quarter of what is asked above the ground.

        Raises ValueError for a point that is not above known ground.
        """
        way = _Way(self, terrain)
        places = [k / count if self.closed else k / max(count - 1, 1) for k in range(count)]
        return [way.camera(part) for part in places]


class _Way:
    """The spline through the points in the world of a terrain."""

    def __init__(self, flight: Flight, terrain: Terrain) -> None:
        from scipy.interpolate import CubicSpline

        self.flight, self.terrain = flight, terrain
        given = np.array(flight.points)
        across = given[:, :2] * terrain.scale[:2] - np.array(terrain.shift[:2])
        ground = self._ground(across)
        if np.isnan(ground).any():
            where = flight.points[int(np.isnan(ground).argmax())]
            raise ValueError(f"expected points above known ground; got {where[0]:g}, {where[1]:g}, where there is none")
        above = given[:, 2] * terrain.exaggeration
        points = np.column_stack((across, ground + above, above))
        if flight.closed:
            points = np.concatenate([points, points[:1]])
        steps = np.hypot(*np.diff(points[:, :2], axis=0).T)
        u = np.concatenate([[0.0], np.cumsum(steps)])
        kind = "periodic" if flight.closed else "natural"
        self.length, self.spline = float(u[-1]), CubicSpline(u, points, bc_type=kind)  # type: ignore[arg-type]

    def _ground(self, across: np.ndarray) -> np.ndarray:
        left, bottom, right, top = self.terrain.heights.extent
        inside = (across >= (left, bottom)).all(-1) & (across <= (right, top)).all(-1)
        points = torch.from_numpy(np.ascontiguousarray(across)).to(self.terrain.device)
        z = self.terrain.surface.jet(points, 0)[0].cpu().numpy()
        return np.where(inside, z, np.nan)

    def camera(self, part: float) -> Camera:
        """At a part of the way, 0 … 1."""
        u = part * self.length
        x, y, z, above = self.spline(u)
        ground = self._ground(np.array([[x, y]]))[0]
        lowest = -math.inf if math.isnan(ground) else ground + 0.25 * above
        position = (float(x), float(y), float(max(z, lowest)))
        dx, dy = self._ahead(u)
        down = math.tan(math.radians(self.flight.pitch)) * math.hypot(dx, dy)
        target = (position[0] + dx, position[1] + dy, position[2] - down)
        return PerspectiveCamera(position=position, target=target, field_of_view=self.flight.field_of_view)

    def _ahead(self, u: float) -> tuple[float, float]:
        """Towards where the way goes, seen a little ahead, so that the camera turns before the way does."""
        step = _AHEAD * self.length
        last = not self.flight.closed and u + step > self.length
        ahead = (
            self.spline(u)[:2] + self.spline(u, 1)[:2] * step
            if last
            else self.spline((u + step) % self.length or u)[:2]
        )
        x, y = ahead - self.spline(u)[:2]
        return float(x), float(y)


def check_flight(scene: Scene) -> None:
    """Raises ValueError unless the scene has a ground to fly over."""
    if scene.terrain is None:
        raise ValueError("expected a terrain to fly over; the scene shows something else")


def load_flight(path: Path) -> Flight:
    """The flight in a YAML file. Raises ConfigError with file and line."""
    return load_config(path, Flight)
