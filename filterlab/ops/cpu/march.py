"""The march and its adjoint as vector code: describes rays and tables to the programs of `ops.cpu.compositing`.

Memory beyond the result: 48 bytes per interval of the transfer function and 32 per bucket (at most 4096) in float32;
for the adjoint 8 · (9 + 12 K) bytes per ray, K lights, and for derivatives by the coefficients one volume of them per
thread (within `SPLAT_MEMORY`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from torch import Tensor

from filterlab.ops.cpu import compiler
from filterlab.ops.cpu import threads as pool
from filterlab.ops.cpu.compositing import TABLES, MarchJob, MarchVariant
from filterlab.ops.cpu.gather import SPLAT_MEMORY
from filterlab.ops.cpu.job import AXES, Function
from filterlab.ops.cpu.machine import lanes_of
from filterlab.ops.cpu.memory import ARITHMETIC, has_room, zeros
from filterlab.ops.cpu.traversal import RAYS_OF_A_BLOCK
from filterlab.ops.gather import STORAGE
from filterlab.ops.march import March, Steps
from filterlab.ops.march_derivatives import TABLE_ROW, by_name, columns_of_rays
from filterlab.ops.tetrahedra import AnyStencil

RAYS_AT_ONCE = 1 << 13  # then progress is reported, and Ctrl-C heard

Report = Callable[[int], None]


def march(given: March, report: Report = lambda rays: None) -> tuple[Tensor, Tensor]:
    """`ops.reference.march.march`, fused, without derivatives: light (R, 3) and optical depth (R,), float64."""
    rays = len(given.chords.count)
    light, depth = torch.zeros(rays, 3, dtype=torch.float64), torch.zeros(rays, dtype=torch.float64)
    if rays:
        run = _Run(given, (), {"light": light, "depth": depth})
        in_blocks(run.function, run.job, rays, report)
    return light, depth


def adjoint(
    given: March, gradients: tuple[str, ...], arrays: Mapping[str, Tensor], report: Report = lambda rays: None
) -> dict[str, Tensor]:
    """Derivatives of Σ light · its cotangent + Σ depth · its cotangent; see `ops.differentiable.march.adjoint`.

    The same bits for one number of threads: every thread has rays of its own and adds into partial results of its own,
    which are summed in order. Those by rays and shading do not depend on the threads at all.

    Args:
        gradients: of `ops.march_derivatives.GRADIENTS`.
        arrays: light, light_cotangent, depth_cotangent.
    """
    rays, points = len(given.chords.count), len(given.transfer.positions)
    threads = _threads_of_adjoint(given, "coefficients" in gradients)
    by_ray = torch.zeros(rays, columns_of_rays(given.lights), dtype=torch.float64)
    tables = torch.zeros(threads, TABLES, max(points - 1, 1), TABLE_ROW, dtype=torch.float64)
    volumes = []
    if "coefficients" in gradients:
        volumes = [zeros((1, *given.coefficients.shape), given.dtype)[0] for _ in range(threads)]
    if rays:
        _Run(given, gradients, {"ray_gradient": by_ray, **arrays}).own_rays(tables, volumes, report)
    for part in volumes[1:]:
        volumes[0] += part
    volume = volumes[0] if volumes else None
    return by_name(gradients, volume, by_ray, tables.sum((0, 1)), points, given.lights)


def _threads_of_adjoint(given: March, with_volumes: bool) -> int:
    """One for every so many rays, and no more volumes of derivatives than memory allows."""
    threads = max(1, min(torch.get_num_threads(), len(given.chords.count) // RAYS_OF_A_BLOCK))
    if with_volumes:
        threads = min(threads, 1 + SPLAT_MEMORY // (given.coefficients.numel() * given.dtype.itemsize))
    return threads


def in_blocks(function: Function, job: Any, rays: int, report: Report) -> None:
    """Let the threads loose on one portion of the rays after the other."""
    for first in range(0, rays, RAYS_AT_ONCE):
        job.first, job.last = first, min(first + RAYS_AT_ONCE, rays)
        job.stride = job.chunks = -(-(job.last - first) // RAYS_OF_A_BLOCK)
        job.next = 0
        pool.run(function, [job] * max(1, min(torch.get_num_threads(), job.chunks)))
        report(job.last)


def lie(job: Any, coefficients: Tensor, start: int, stencil: AnyStencil) -> None:
    """Writes how coefficients lie in memory and in space into the fields of `ops.cpu.taps.Grid`."""
    d, h, w = coefficients.shape
    job.width, job.height, job.start = w, h, start
    for axis, size, support in zip(AXES, (w, h, d), stencil.supports, strict=True):
        setattr(job, f"low_{axis}", start)
        setattr(job, f"high_{axis}", start + size - support)


class _Run:
    """A march and the arrays that it reads and writes, as a job."""

    def __init__(self, given: March, gradients: tuple[str, ...], arrays: Mapping[str, Tensor]) -> None:
        self.rays = len(given.chords.count)
        coefficients = given.coefficients.detach().resolve_neg().contiguous()
        self.function = compiler.compiled(_variant(given, gradients, coefficients))
        inputs = {"coefficients": coefficients, **given.inputs, **arrays}
        self.job = _job(given)
        if (steps := given.transfer.steps) is not None and steps.buckets is not None:
            inputs["buckets"] = steps.buckets
        self.job.point(**{name: tensor.detach().resolve_neg().contiguous() for name, tensor in inputs.items()})

    def own_rays(self, tables: Tensor, volumes: list[Tensor], report: Report) -> None:
        """The same with a job for each of `tables`: thread i takes blocks i, i + threads, … of the rays."""
        jobs = [self.job.copy() for _ in tables]
        for i, job in enumerate(jobs):
            job.point(table_gradient=tables[i])
            if volumes:
                job.point(coefficient_gradient=volumes[i])
        for first in range(0, self.rays, RAYS_AT_ONCE):
            for i, job in enumerate(jobs):
                job.first, job.last = first, min(first + RAYS_AT_ONCE, self.rays)
                job.next, job.chunks, job.stride = i, i + 1, len(jobs)
            pool.run(self.function, jobs)
            report(min(first + RAYS_AT_ONCE, self.rays))


def _job(given: March) -> MarchJob:
    """With every number, and no address."""
    job = MarchJob(
        step=given.step,
        per_unit=1 / given.transfer.unit,
        faint=given.faint,
        opaque=given.opaque,
        intervals=max(len(given.transfer.positions) - 1, 1),
    )
    lie(job, given.coefficients, given.start, given.stencil)
    if (steps := given.transfer.steps) is not None:
        job.steps_low, job.steps_scale, job.steps_last = steps.low, steps.scale, steps.count - 1
    if given.bricks is not None:
        job.edge, job.slack = given.bricks.edge, given.slack
        for axis, count in zip(AXES, given.bricks.distance.shape[::-1], strict=True):
            setattr(job, f"bricks_{axis}", count)
    return job


def _variant(given: March, gradients: tuple[str, ...], coefficients: Tensor) -> MarchVariant:
    raised = given.stencil.derivatives if "rays" in gradients else None
    return MarchVariant(
        gradients,
        given.stencil.lowered,
        None if raised is None else (raised[0].lowered, raised[1]),
        given.lighting is not None,
        given.lights or 0,
        given.bricks is not None,
        _way_to_intervals(given.transfer.steps),
        ARITHMETIC[given.dtype],
        STORAGE[coefficients.dtype],
        has_room(coefficients),
        lanes_of(given.dtype),
    )


def _way_to_intervals(steps: Steps | None) -> str:
    """One of `ops.cpu.optics.WAYS`."""
    if steps is None:
        return "compared"
    return "even" if steps.buckets is None else "bucketed"
