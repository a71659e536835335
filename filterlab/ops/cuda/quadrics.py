"""Casting rays at quadrics in Triton: describes the tree and rays to the programs of `ops.cuda.quadric_hits`.

Memory beyond the result: 850 bytes for every ray of a part, at most `_RAYS_AT_ONCE` of them, most of it stacks.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache
from typing import Any

import torch
from torch import Tensor

from filterlab.ops.cuda.launch import interpreting, launchable
from filterlab.ops.cuda.quadric_hits import QuadricsVariant
from filterlab.ops.cuda.tree_walk import BLOCK, DEEPEST, Variant
from filterlab.ops.quadrics import InLeaves, Quadrics, Rays, in_parts

RAYS_AT_ONCE = 1 << 17


def hits(
    given: Quadrics, origins: Tensor, directions: Tensor, sheets: int, farthest: bool = False
) -> tuple[Tensor, Tensor]:
    """`ops.reference.quadrics.hits`, fused."""
    return walked(given, variant_of("hits", given, farthest), origins, directions, sheets, farthest)


def variant_of(asked: str, given: Quadrics, reversed: bool) -> QuadricsVariant:
    """The program that is asked for."""
    return QuadricsVariant(asked, given.planes, given.kept(reversed), reversed)


def walked(
    given: InLeaves, variant: Variant, origins: Tensor, directions: Tensor, sheets: int, farthest: bool
) -> tuple[Tensor, Tensor]:
    """`ops.reference.quadrics.walked`, by the program of that variant."""
    cast = lambda o, d: _of_part(given, variant, o, d, sheets, farthest)  # noqa: E731
    t, piece = in_parts(cast, origins, directions, RAYS_AT_ONCE)
    return t, piece


def _of_part(
    given: InLeaves, variant: Variant, origins: Tensor, directions: Tensor, sheets: int, farthest: bool
) -> tuple[Tensor, Tensor]:
    rays = Rays.of(given.tree, origins, directions, farthest)
    tau = rays.first.new_full((len(origins), sheets), torch.inf)
    place = torch.full_like(tau, -1, dtype=torch.int64)
    launch(variant, given, rays, {"taus": tau, "places": place}, sheets=sheets)
    return rays.t(tau), given.tree.numbers(place)


def launch(variant: Variant, given: InLeaves, rays: Rays, own: Mapping[str, Tensor], **scalars: int | Tensor) -> None:
    """Run a program for all rays; `own` is what it reads and writes."""
    count = len(rays.first)
    if not count:
        return
    whole = {name: getattr(rays, name).contiguous() for name in ("start", "along", "first", "last")}
    arrays = {"boxes": given.tree.boxes, "children": given.tree.children, "leaves": given.leaves, **whole, **own}
    arrays["nodes"] = given.tree.children.new_empty(count, DEEPEST)
    arrays["nears"] = given.tree.boxes.new_empty(count, DEEPEST)
    handed = [arrays[name] for name in variant.arrays]
    program = _program(variant, interpreting())
    with torch.cuda.device_of(given.leaves):  # Triton launches on the current device
        numbers = [scalars[name] for name in variant.scalars]
        program[(-(-count // BLOCK),)](*handed, *numbers, count, BLOCK=BLOCK, num_warps=1)


@lru_cache(maxsize=256)
def _program(variant: Variant, interpreted: bool) -> Any:
    return launchable(variant.write())
