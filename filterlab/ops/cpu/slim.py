"""Casting rays at blended quadrics as vector code: describes the tree and rays to the programs of `ops.cpu.slim_hits`.

Memory beyond the result: 80 bytes for every ray of a part, at most `RAYS_AT_ONCE` of them.
"""

from __future__ import annotations

import torch
from torch import Tensor

from filterlab.ops.cpu.quadrics import RAYS_AT_ONCE, has_fma, job_of, run
from filterlab.ops.cpu.slim_hits import MembersJob, MembersVariant, SheetsJob, SheetsVariant
from filterlab.ops.quadrics import Rays, in_parts
from filterlab.ops.slim import Cover, Members, Sheets, members_of


def sheets(given: Cover, origins: Tensor, directions: Tensor, count: int, farthest: bool = False) -> Sheets:
    """`ops.reference.slim.sheets`, fused."""
    cast = lambda o, d: _of_part(given, Rays.of(given.quadrics.tree, o, d, farthest), count)  # noqa: E731
    return Sheets(*in_parts(cast, origins, directions, RAYS_AT_ONCE))


def members(given: Cover, origins: Tensor, directions: Tensor, begin: Tensor, end: Tensor) -> Members:
    """`ops.reference.slim.members`, fused: counted first, then written."""
    rays, quadrics = Rays.of(given.quadrics.tree, origins, directions, False), given.quadrics
    variant = MembersVariant(quadrics.planes, quadrics.kept(False), has_fma())
    count = torch.zeros_like(begin, dtype=torch.int64)
    job = job_of(MembersJob, quadrics, rays, writes=0)
    job.point(begin=begin.contiguous(), end=end.contiguous(), count=count)
    run(variant, job)
    row = torch.arange(len(begin)).repeat_interleave(count)
    tau, place = begin.new_empty(len(row)), torch.empty_like(row)
    job.next, job.writes = 0, 1
    job.point(count=count.cumsum(0) - count, tau=tau, place=place)
    run(variant, job)
    return members_of(rays, quadrics.tree, row, tau, place)


def _of_part(given: Cover, rays: Rays, count: int) -> Sheets:
    quadrics, found = given.quadrics, Sheets.none(rays, count)
    job = job_of(SheetsJob, quadrics, rays, sheets=count, offset=given.offset)
    job.point(tau=found.t, begin=found.begin, end=found.end, normal=found.normal, place=found.piece)
    run(SheetsVariant(quadrics.planes, quadrics.kept(rays.reversed), rays.reversed, has_fma()), job)
    return found.of_rays(rays, quadrics.tree)
