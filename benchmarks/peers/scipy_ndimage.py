"""scipy.ndimage: map_coordinates for values, spline_filter for prefilters. One thread, sums in float64."""

from __future__ import annotations

import numpy as np
from torch import Tensor

from benchmarks.harness import Contestant
from benchmarks.peers.task import Sampling, without

NAME = "scipy.ndimage"
_ORDERS = {"linear": 1, "bspline2": 2, "bspline3": 3}


def missing() -> str | None:
    return without("scipy")


def offers(kernel: str, gradient: bool) -> bool:
    return kernel in _ORDERS and not gradient


def sampling(task: Sampling) -> Contestant:
    from scipy.ndimage import map_coordinates

    order = _ORDERS[task.kernel]
    coefficients = task.coefficients.numpy()
    zyx = np.ascontiguousarray(task.points.numpy()[:, ::-1].T)

    def call() -> tuple[np.ndarray, ...]:
        return (map_coordinates(coefficients, zyx, np.float32, order, mode="mirror", prefilter=False),)

    return Contestant(NAME, call, task.computes, samples=len(task.points))


def prefiltering(samples: Tensor, order: int, output: type, computes: str) -> Contestant:
    """spline_filter of a whole volume under the boundary `mirror`, result as `output`."""
    from scipy.ndimage import spline_filter

    array = samples.numpy()

    def call() -> tuple[np.ndarray, ...]:
        return (spline_filter(array, order, output=output, mode="mirror"),)

    return Contestant(f"{NAME} {np.dtype(output).name}", call, computes, samples=array.size)
