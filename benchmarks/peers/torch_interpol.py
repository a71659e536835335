"""torch-interpol: B-splines of any order in TorchScript; the gradient is a second call."""

# pyright: reportMissingImports=false

from __future__ import annotations

import warnings

import torch
from torch import Tensor

from benchmarks.harness import Contestant
from benchmarks.peers.task import Sampling, without

NAME = "torch-interpol"
_ORDERS = {"linear": 1, "bspline2": 2, "bspline3": 3}


def missing() -> str | None:
    return without("interpol", "torch-interpol")


def offers(kernel: str, gradient: bool) -> bool:
    return kernel in _ORDERS


def sampling(task: Sampling) -> Contestant:
    with warnings.catch_warnings():  # it compiles TorchScript, which newer versions of torch advise against
        warnings.simplefilter("ignore")
        from interpol import grid_grad, grid_pull

    options = {"interpolation": _ORDERS[task.kernel], "bound": "dct1", "extrapolate": True, "prefilter": False}
    zyx = task.points.flip(-1).contiguous()[:, None, None]

    def call() -> tuple[Tensor, ...]:
        with torch.no_grad():
            value = grid_pull(task.coefficients, zyx, **options).reshape(-1)
            if not task.gradient:
                return (value,)
            return value, grid_grad(task.coefficients, zyx, **options).reshape(-1, 3)

    return Contestant(NAME, call, task.computes, _parts, len(task.points))


def _parts(result: tuple[Tensor, ...]) -> list[Tensor]:
    value, *gradient = result
    return [value, *(g.flip(-1).T for g in gradient)]
