"""Casting rays at blended quadrics in Triton: describes them to the programs of `ops.cuda.quadric_hits`."""

from __future__ import annotations

import torch
from torch import Tensor

from filterlab.ops.cuda.quadrics import RAYS_AT_ONCE, launch, variant_of
from filterlab.ops.quadrics import Rays, in_parts
from filterlab.ops.slim import Cover, Members, Sheets, members_of


def sheets(given: Cover, origins: Tensor, directions: Tensor, count: int, farthest: bool = False) -> Sheets:
    """`ops.reference.slim.sheets`, fused."""
    cast = lambda o, d: _of_part(given, Rays.of(given.quadrics.tree, o, d, farthest), count)  # noqa: E731
    return Sheets(*in_parts(cast, origins, directions, RAYS_AT_ONCE))


def _of_part(given: Cover, rays: Rays, count: int) -> Sheets:
    found = Sheets.none(rays, count)
    own = {"taus": found.t, "begin": found.begin, "end": found.end, "normal": found.normal, "places": found.piece}
    program = variant_of("sheets", given.quadrics, rays.reversed)
    launch(program, given.quadrics, rays, own, sheets=count, offset=found.t.new_tensor(given.offset))
    return found.of_rays(rays, given.quadrics.tree)


def members(given: Cover, origins: Tensor, directions: Tensor, begin: Tensor, end: Tensor) -> Members:
    """`ops.reference.slim.members`, fused: counted first, then written."""
    rays, quadrics = Rays.of(given.quadrics.tree, origins, directions, False), given.quadrics
    own = {"begin": begin.contiguous(), "end": end.contiguous()}
    program = variant_of("members", quadrics, rays.reversed)
    count, nowhere = torch.zeros_like(begin, dtype=torch.int64), begin.new_empty(0)
    launch(program, quadrics, rays, {**own, "count": count, "taus": nowhere, "places": count[:0]}, writes=0)
    row = torch.arange(len(begin), device=begin.device).repeat_interleave(count)
    tau, place = begin.new_empty(len(row)), torch.empty_like(row)
    starts = count.cumsum(0) - count
    launch(program, quadrics, rays, {**own, "count": starts, "taus": tau, "places": place}, writes=1)
    return members_of(rays, quadrics.tree, row, tau, place)
