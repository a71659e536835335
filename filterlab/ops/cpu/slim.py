"""Casting rays at blended quadrics as vector code: describes the tree and rays to the programs of `ops.cpu.slim_hits`.

Memory beyond the result: 80 bytes for every ray of a part, at most `RAYS_AT_ONCE` of them.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from filterlab.ops.cpu.quadrics import RAYS_AT_ONCE, has_fma, job_of, run
from filterlab.ops.cpu.slim_hits import MembersJob, MembersVariant, SheetsJob, SheetsVariant
from filterlab.ops.quadrics import Rays
from filterlab.ops.slim import Cover, Members, Sheets


def sheets(given: Cover, origins: Tensor, directions: Tensor, count: int, farthest: bool = False) -> Sheets:
    """`ops.reference.slim.sheets`, fused."""
    parts = zip(origins.split(RAYS_AT_ONCE), directions.split(RAYS_AT_ONCE), strict=True)
    found = [_of_part(given, Rays.of(given.quadrics.tree, o, d, farthest), count) for o, d in parts]
    return Sheets(*(torch.cat(rows) for rows in zip(*found, strict=True)))


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
    own = replace(rays, eye=rays.eye[row], length=rays.length[row])
    return Members(row, quadrics.tree.numbers(place), own.t(tau[:, None])[:, 0])


def _of_part(given: Cover, rays: Rays, count: int) -> Sheets:
    quadrics, number = given.quadrics, len(rays.first)
    tau = rays.first.new_full((number, count), torch.inf)
    begin, end, normal = torch.full_like(tau, torch.inf), tau.clone(), tau.new_zeros(number, count, 3)
    place = torch.full_like(tau, -1, dtype=torch.int64)
    job = job_of(SheetsJob, quadrics, rays, sheets=count, offset=given.offset)
    job.point(tau=tau, begin=begin, end=end, normal=normal, place=place)
    run(SheetsVariant(quadrics.planes, quadrics.kept(rays.reversed), rays.reversed, has_fma()), job)
    begin, end = (-end, -begin) if rays.reversed else (begin, end)
    return Sheets(rays.t(tau), begin, end, normal, quadrics.tree.numbers(place))
