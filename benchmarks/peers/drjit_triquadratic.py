"""Triquadratic value and gradient written by hand for Dr.Jit (LLVM backend), as one compiled kernel.

With β = x − ⌊x + ½⌋ per axis the weights of the taps −1, 0, 1 are ½(½ − β)², ¾ − β², ½(½ + β)², their derivatives
β − ½, −2β, β + ½. The 27 taps are summed along x, then y, then z, so that value and gradient share most of the work.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

from typing import Any

import numpy as np

from benchmarks.harness import Contestant
from benchmarks.peers.drjit_texture import arrays, missing, positions, started
from benchmarks.peers.task import Sampling

__all__ = ["NAME", "missing", "offers", "sampling"]

NAME = "Dr.Jit by hand"


def offers(kernel: str, gradient: bool) -> bool:
    return kernel == "bspline2" and gradient


def sampling(task: Sampling) -> Contestant:
    drjit = started(task.threads)
    from drjit.llvm import Float

    coefficients = Float(np.ascontiguousarray(task.coefficients.numpy().reshape(-1)))
    where = positions(task.points)
    n = task.coefficients.shape[-1]

    def call() -> tuple[Any, ...]:
        result = triquadratic(coefficients, where, n)
        drjit.eval(*result)
        drjit.sync_thread()
        return result

    return Contestant(NAME, call, task.computes, arrays, len(task.points))


def triquadratic(coefficients: Any, where: Any, n: int) -> tuple[Any, Any]:
    """Value and gradient at points in voxel coordinates, of n³ coefficients laid out along x, y, z."""
    import drjit as dr
    from drjit.llvm import Array3f, Float, UInt32

    nearest = [dr.floor(x + 0.5) for x in where]
    weights, slopes = zip(*(_weights(x - k) for x, k in zip(where, nearest, strict=True)), strict=True)
    i, j, k = (UInt32(center) - 1 for center in nearest)
    first = dr.fma(dr.fma(k, n, j), n, i)
    value, dx, dy, dz = (Float(0) for _ in range(4))
    for z in range(3):
        plane, plane_dx, plane_dy = (Float(0) for _ in range(3))
        for y in range(3):
            taps = [dr.gather(Float, coefficients, first + ((z * n + y) * n + x)) for x in range(3)]
            line = _dot(dr, weights[0], taps)
            plane = dr.fma(weights[1][y], line, plane)
            plane_dx = dr.fma(weights[1][y], _dot(dr, slopes[0], taps), plane_dx)
            plane_dy = dr.fma(slopes[1][y], line, plane_dy)
        value = dr.fma(weights[2][z], plane, value)
        dx = dr.fma(weights[2][z], plane_dx, dx)
        dy = dr.fma(weights[2][z], plane_dy, dy)
        dz = dr.fma(slopes[2][z], plane, dz)
    return value, Array3f(dx, dy, dz)


def _weights(beta: Any) -> tuple[list[Any], list[Any]]:
    low, high = 0.5 - beta, 0.5 + beta
    return [0.5 * low * low, 0.75 - beta * beta, 0.5 * high * high], [-low, -2 * beta, high]


def _dot(dr: Any, weights: list[Any], taps: list[Any]) -> Any:
    return dr.fma(weights[0], taps[0], dr.fma(weights[1], taps[1], weights[2] * taps[2]))
