"""Casting rays at blended quadrics as vector code: describes the tree and rays to the programs of `ops.cpu.slim_hits`.

Memory beyond the result: 80 bytes for every ray of a part, at most `RAYS_AT_ONCE` of them.
"""

from __future__ import annotations

import torch
from torch import Tensor

from filterlab.ops.cpu import compiler
from filterlab.ops.cpu import threads as pool
from filterlab.ops.cpu.quadric_walk import RAYS_OF_A_CHUNK
from filterlab.ops.cpu.quadrics import RAYS_AT_ONCE, fused
from filterlab.ops.cpu.slim_hits import MembersJob, MembersVariant, SheetsJob, SheetsVariant
from filterlab.ops.quadrics import Quadrics, Rays
from filterlab.ops.slim import Cover, Members, Sheets, members_of


def sheets(given: Cover, origins: Tensor, directions: Tensor, count: int, farthest: bool = False) -> Sheets:
    """`ops.reference.slim.sheets`, fused."""
    parts = zip(origins.split(RAYS_AT_ONCE), directions.split(RAYS_AT_ONCE), strict=True)
    found = [_of_part(given, Rays.of(given.quadrics.tree, o, d, farthest), count) for o, d in parts]
    return Sheets(*(torch.cat(rows) for rows in zip(*found, strict=True)))


def members(given: Cover, origins: Tensor, directions: Tensor, begin: Tensor, end: Tensor) -> Members:
    """`ops.reference.slim.members`, fused: counted first, then written."""
    rays, quadrics = Rays.of(given.quadrics.tree, origins, directions, False), given.quadrics
    program = compiler.compiled(MembersVariant(quadrics.planes, quadrics.kept(False), fused()))
    count = torch.zeros_like(begin, dtype=torch.int64)
    job = MembersJob(**_counted(rays), writes=0)
    _point(job, quadrics, rays)
    job.point(begin=begin.contiguous(), end=end.contiguous(), count=count)
    _run(program, job)
    row = torch.arange(len(begin)).repeat_interleave(count)
    tau, place = begin.new_empty(len(row)), torch.empty_like(row)
    job.next, job.writes = 0, 1
    job.point(count=count.cumsum(0) - count, tau=tau, place=place)
    _run(program, job)
    return members_of(rays, quadrics.tree, row, tau, place)


def _of_part(given: Cover, rays: Rays, count: int) -> Sheets:
    quadrics, found = given.quadrics, Sheets.none(rays, count)
    job = SheetsJob(**_counted(rays), sheets=count, offset=given.offset)
    _point(job, quadrics, rays)
    job.point(tau=found.t, begin=found.begin, end=found.end, normal=found.normal, place=found.piece)
    _run(compiler.compiled(SheetsVariant(quadrics.planes, quadrics.kept(rays.reversed), rays.reversed, fused())), job)
    return found.of_rays(rays, quadrics.tree)


def _counted(rays: Rays) -> dict[str, int]:
    return {"rays": len(rays.first), "next": 0, "chunks": -(-len(rays.first) // RAYS_OF_A_CHUNK)}


def _point(job: SheetsJob | MembersJob, given: Quadrics, rays: Rays) -> None:
    job.point(boxes=given.tree.boxes, children=given.tree.children, leaves=given.leaves)
    job.point(**{name: getattr(rays, name).contiguous() for name in ("start", "along", "first", "last")})


def _run(program, job: SheetsJob | MembersJob) -> None:
    pool.run(program, [job] * max(1, min(torch.get_num_threads(), job.chunks)))
