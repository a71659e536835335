"""Casting rays at quadrics as vector code: describes the tree and rays to the program of `ops.cpu.quadric_hits`.

Memory beyond the result: 80 bytes for every ray of a part, at most `RAYS_AT_ONCE` of them.
"""

from __future__ import annotations

import torch
from torch import Tensor

from filterlab.ops.cpu import compiler
from filterlab.ops.cpu import threads as pool
from filterlab.ops.cpu.job import Job
from filterlab.ops.cpu.quadric_hits import QuadricsVariant
from filterlab.ops.cpu.tree_walk import RAYS_OF_A_CHUNK, RowsJob
from filterlab.ops.quadrics import InLeaves, Quadrics, Rays, in_parts

RAYS_AT_ONCE = 1 << 18


def hits(
    given: Quadrics, origins: Tensor, directions: Tensor, sheets: int, farthest: bool = False
) -> tuple[Tensor, Tensor]:
    """`ops.reference.quadrics.hits`, fused."""
    variant = QuadricsVariant(given.kept(farthest), farthest, has_fma(), given.planes)
    return walked(given, variant, origins, directions, sheets, farthest)


def has_fma() -> bool:
    """Whether this machine multiplies and adds with one rounding."""
    return bool({"fma", "neon"} & compiler.features())


def walked(
    given: InLeaves, variant: compiler.Variant, origins: Tensor, directions: Tensor, sheets: int, farthest: bool
) -> tuple[Tensor, Tensor]:
    """`ops.reference.quadrics.walked`, by the program of that variant."""
    cast = lambda o, d: _of_part(given, variant, o, d, sheets, farthest)  # noqa: E731
    t, piece = in_parts(cast, origins, directions, RAYS_AT_ONCE)
    return t, piece


def _of_part(
    given: InLeaves, variant: compiler.Variant, origins: Tensor, directions: Tensor, sheets: int, farthest: bool
) -> tuple[Tensor, Tensor]:
    rays = Rays.of(given.tree, origins, directions, farthest)
    tau = rays.first.new_full((len(origins), sheets), torch.inf)
    place = torch.full_like(tau, -1, dtype=torch.int64)
    job = job_of(RowsJob, given, rays, sheets=sheets)
    job.point(tau=tau, place=place)
    run(variant, job)
    return rays.t(tau), given.tree.numbers(place)


def job_of(kind: type[Job], given: InLeaves, rays: Rays, **numbers: float) -> Job:
    """Of a walk for every ray."""
    chunks = -(-len(rays.first) // RAYS_OF_A_CHUNK)
    job = kind(rays=len(rays.first), next=0, chunks=chunks, **numbers)
    job.point(boxes=given.tree.boxes, children=given.tree.children, leaves=given.leaves)
    job.point(**{name: getattr(rays, name).contiguous() for name in ("start", "along", "first", "last")})
    return job


def run(variant: compiler.Variant, job: Job) -> None:
    """On as many threads as torch is set to."""
    pool.run(compiler.compiled(variant), [job] * max(1, min(torch.get_num_threads(), job.chunks)))
