"""isoray: bisection along rays in interval arithmetic, of functions that it knows by their values alone.

The function is SciPy's trilinear interpolation; its bounds are told the largest slope of any cell.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

from typing import Any

import numpy as np
from scipy.ndimage import map_coordinates

from benchmarks.harness import Contestant
from benchmarks.peers.task import Casting, without

NAME = "isoray"

_WIDTH = 1e-4  # voxels, of an interval that is taken for a hit
_DEPTH = 40


def missing() -> str | None:
    return without("isoray")


def bisecting(task: Casting) -> Contestant:
    """It has one thread only."""
    from isoray import SamplingInclusion, bisect_trace, ray_aabb_intersect

    samples = task.volume.double().numpy() - task.level
    slope = float(np.sqrt(sum(np.abs(np.diff(samples, axis=axis)).max() ** 2 for axis in range(3))))
    ends = np.zeros(3), np.array(samples.shape[::-1]) - 1.0
    origins, directions = (x.astype(np.float64) for x in task.flat())
    lengths = np.linalg.norm(directions, axis=1)
    unit = directions / lengths[:, None]

    def f(points: np.ndarray) -> tuple[np.ndarray, None]:
        return map_coordinates(samples, points.T[::-1], order=1, mode="nearest"), None

    def call() -> Any:
        met = ray_aabb_intersect(origins, unit, *ends)
        return bisect_trace(origins, unit, *met, SamplingInclusion(f, slope), f, _DEPTH, _WIDTH)

    return Contestant(NAME, call, task.computes, lambda found: task.summary(found.t / lengths), task.rays)
