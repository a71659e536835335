"""Rows of hits by rows of rays as programs: describes arrays to those of `ops.cpu.hit_rows`, and runs them.

Memory beyond the results: 8 bytes for every 4096 rays.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from filterlab.ops.cpu import compiler
from filterlab.ops.cpu import threads as pool
from filterlab.ops.cpu.hit_rows import FAR, UNKNOWN, HitRowsJob, HitRowsVariant
from filterlab.ops.cpu.machine import threads_for
from filterlab.ops.cpu.memory import ARITHMETIC, fresh
from filterlab.ops.hit_points import ByRays, OnRays

_CHUNK = 4096  # rays: what is written of them stays in the cache between its two passes
_RAYS_PER_THREAD = 16384  # fewer are not worth waking a thread for


def points(origins: Tensor, directions: Tensor, t: Tensor, index: Tensor, reach: float) -> OnRays:
    """`ops.reference.hit_points.points`, fused; of rays and t of one type, without derivatives."""
    out = fresh((len(index), 3), t.dtype)
    job = _job(index, t.numel())
    for name, x in (("origins", origins), ("directions", directions)):
        rows, step = _rows(x, t.shape)
        job.point(**{name: rows})
        setattr(job, f"{name}_step", step)
    job.point(t=t.contiguous(), points=out)
    job.reach = reach
    _run("points", job, t.dtype)
    return OnRays(out, bool(job.met & FAR))


def by_rays(index: Tensor, shape: torch.Size, point: Tensor, gradient: Tensor) -> ByRays:
    """`ops.reference.hit_points.by_rays`, fused; without derivatives."""
    written = {name: fresh((*shape, 3), point.dtype) for name in ("ray_point", "ray_gradient", "ray_normal")}
    job = _job(index, shape.numel())
    job.point(points=point.contiguous(), gradients=gradient, **written)
    job.gradients_step, job.gradients_axis = gradient.stride()
    _run("by_rays", job, point.dtype)
    return ByRays(written["ray_point"], written["ray_gradient"], written["ray_normal"], bool(job.met & UNKNOWN))


def _rows(x: Tensor, shape: torch.Size) -> tuple[Tensor, int]:
    """Rows (..., 3) that broadcast to a shape, and the step from one to the next: 0 where they are all the same."""
    if x.stride(-1) == 1 and not any(s for s, n in zip(x.stride()[:-1], x.shape[:-1], strict=True) if n > 1):
        return x, 0
    return x.expand(*shape, 3).contiguous(), 3


def _job(index: Tensor, rays: int) -> HitRowsJob:
    chunks = -(-rays // _CHUNK)
    begin = np.searchsorted(index.numpy(), np.arange(chunks + 1) * _CHUNK)
    job = HitRowsJob(rays=rays, chunk=_CHUNK, chunks=chunks)
    job.point(index=index, begin=begin.astype(np.int64, copy=False))
    return job


def _run(operation: str, job: HitRowsJob, dtype: torch.dtype) -> None:
    threads = threads_for(job.rays, _RAYS_PER_THREAD)
    pool.run(compiler.compiled(HitRowsVariant(operation, ARITHMETIC[dtype])), [job] * threads)
