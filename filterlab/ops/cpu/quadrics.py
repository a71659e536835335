"""Casting rays at quadrics as vector code: describes the tree and rays to the program of `ops.cpu.quadric_hits`.

Memory beyond the result: 80 bytes for every ray of a part, at most `RAYS_AT_ONCE` of them.
"""

from __future__ import annotations

import torch
from torch import Tensor

from filterlab.ops.cpu import compiler
from filterlab.ops.cpu import threads as pool
from filterlab.ops.cpu.quadric_hits import QuadricsJob, QuadricsVariant
from filterlab.ops.cpu.quadric_walk import RAYS_OF_A_CHUNK
from filterlab.ops.quadrics import Quadrics, Rays, in_parts

RAYS_AT_ONCE = 1 << 18


def hits(
    given: Quadrics, origins: Tensor, directions: Tensor, sheets: int, farthest: bool = False
) -> tuple[Tensor, Tensor]:
    """`ops.reference.quadrics.hits`, fused."""
    cast = lambda o, d: _of_part(given, o, d, sheets, farthest)  # noqa: E731
    t, piece = in_parts(cast, origins, directions, RAYS_AT_ONCE)
    return t, piece


def _of_part(
    given: Quadrics, origins: Tensor, directions: Tensor, sheets: int, farthest: bool
) -> tuple[Tensor, Tensor]:
    rays = Rays.of(given.tree, origins, directions, farthest)
    tau = rays.first.new_full((len(origins), sheets), torch.inf)
    place = torch.full_like(tau, -1, dtype=torch.int64)
    job = QuadricsJob(rays=len(origins), sheets=sheets, next=0, chunks=-(-len(origins) // RAYS_OF_A_CHUNK))
    job.point(boxes=given.tree.boxes, children=given.tree.children, leaves=given.leaves, tau=tau, place=place)
    job.point(**{name: getattr(rays, name).contiguous() for name in ("start", "along", "first", "last")})
    variant = QuadricsVariant(given.planes, given.kept(farthest), farthest, fused())
    pool.run(compiler.compiled(variant), [job] * max(1, min(torch.get_num_threads(), job.chunks)))
    return rays.t(tau), given.tree.numbers(place)


def fused() -> bool:
    """Whether the machine multiplies and adds with one rounding."""
    return bool({"fma", "neon"} & compiler.features())
