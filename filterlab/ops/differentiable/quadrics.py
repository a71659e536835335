"""Casting rays at quadrics, and at whatever else stands in the leaves of a tree: what runs it.

Derivatives of hits are `surfaces.base`'s, once for all surfaces.
"""

from __future__ import annotations

from torch import Tensor

from filterlab.ops import cpu, cuda
from filterlab.ops.differentiable.drivers import driver, room_of
from filterlab.ops.differentiable.recording import transforming
from filterlab.ops.quadrics import InLeaves


def missing(given: InLeaves, origins: Tensor) -> str | None:
    """What keeps the program from running here; None: nothing does."""
    if transforming():
        return "it has no transforms of torch.func"
    here = given.leaves.device
    if here != origins.device:
        return f"it works on tensors of one device; got {here} and {origins.device}"
    if here.type == "cuda":
        return cuda.device_problem(origins)
    return cpu.llvmlite_problem() if here.type == "cpu" else f"it works on tensors of the CPU or a GPU; got {here}"


def hits(
    given: InLeaves,
    origins: Tensor,
    directions: Tensor,
    sheets: int,
    farthest: bool = False,
    implementation: str | None = None,
) -> tuple[Tensor, Tensor]:
    """t (R, k) float64 of the first hits of rays (R, 3), or the last ones, and what they hit (R, k) int64.

    Args:
        sheets, farthest: k hits in order, or from the last on; t is ∞, the number −1 where there are no more.
        implementation: "reference", "cpu" or "cuda"; None: the fastest that can run.
    """
    driven = driver(implementation or implementation_for(given, origins), given.op)
    return driven.hits(given, origins, directions, sheets, farthest)


def implementation_for(given: InLeaves, origins: Tensor) -> str:
    """What casts these rays unasked: "cpu" (vector code), or "cuda" (Triton) on a GPU; else plain torch."""
    fused = room_of(given.leaves.device)
    return fused if missing(given, origins) is None else "reference"
