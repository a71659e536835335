"""Rows of hits by rows of rays: programs where nothing is recorded and they can run, else plain torch."""

from __future__ import annotations

from types import ModuleType

import torch
from torch import Tensor

from filterlab.ops import cpu
from filterlab.ops.differentiable.drivers import driver
from filterlab.ops.differentiable.recording import plain
from filterlab.ops.hit_points import ByRays, OnRays
from filterlab.ops.reference import hit_points as reference

_COMPUTED = torch.float32, torch.float64


def points(origins: Tensor, directions: Tensor, t: Tensor, index: Tensor, reach: float) -> OnRays:
    """o + t d (M, 3) of those rays (..., 3) that hit at t (...), by their flat places (M,) in t, ascending; whether any
    of them begins farther away than `reach`."""
    return _driver(t, origins, directions).points(origins, directions, t, index, reach)


def by_rays(index: Tensor, shape: torch.Size, point: Tensor, gradient: Tensor) -> ByRays:
    """Point, gradient and normal of hits (M, 3) by rays of a shape."""
    return _driver(point, gradient).by_rays(index, shape, point, gradient)


def _driver(*tensors: Tensor) -> ModuleType:
    first, *_ = tensors
    alike = all(x.dtype == first.dtype and x.device.type == "cpu" and not x.is_neg() for x in tensors)
    fused = alike and first.dtype in _COMPUTED and plain(*tensors) and cpu.llvmlite_problem() is None
    return driver("cpu", "hit_points") if fused else reference
