"""Casting rays at a level: what runs it. Derivatives of hits are `surfaces.base`'s, once for all surfaces."""

from __future__ import annotations

import torch
from torch import Tensor

from filterlab.ops import cpu, cuda
from filterlab.ops import raycast as description
from filterlab.ops.differentiable.drivers import driver, room_of
from filterlab.ops.differentiable.recording import transforming
from filterlab.ops.raycast import Candidates, Raycast, Sheets
from filterlab.ops.tetrahedra import AnyLattice

_FEWEST = 1 << 13
"""Bricks from which on a program is worth to be compiled for their marks."""


def missing(given: Raycast, origins: Tensor) -> str | None:
    """What keeps the program from running here as asked; None: nothing does."""
    if problem := missing_for(given.lattice, given.dtype, origins):
        return problem
    if given.marks.numel() >= 1 << 31:
        return f"up to {1 << 31} bricks; got {given.marks.numel()}"
    return None


def missing_for(lattice: AnyLattice, dtype: torch.dtype, origins: Tensor) -> str | None:
    """The same, as far as bounds do not decide it."""
    if transforming():
        return "it has no transforms of torch.func"
    points = torch.empty(1, 0, 3, dtype=dtype, device=origins.device)
    room = cuda if _implementation_for(lattice) == "cuda" else cpu
    return room.missing(lattice.coefficients.detach()[None, None], points, lattice.stencil)


def first(given: Raycast, origins: Tensor, directions: Tensor, implementation: str | None = None) -> Tensor:
    """t (...) float64, where rays (..., 3) first meet the level; ∞ where they don't. Without derivatives.

    Args:
        origins, directions: those that lie near each other along the last two axes of an image are cast together.
        implementation: "reference", "cpu" or "cuda"; None: the fastest that can run.
    """
    return _driver(given, origins, implementation).first(given, origins, directions)


def sheets(
    given: Raycast, origins: Tensor, directions: Tensor, asked: Sheets, implementation: str | None = None
) -> Tensor:
    """t (..., k) float64, where rays (..., 3) meet the level; ∞ where they no longer do. Arguments as for `first`."""
    return _driver(given, origins, implementation).sheets(given, origins, directions, asked)


def candidates(given: Raycast, origins: Tensor, directions: Tensor, implementation: str | None = None) -> Candidates:
    """The pieces of rays (R, 3) that may hold a crossing, those of a ray in order. Arguments as for `first`."""
    return _driver(given, origins, implementation).candidates(given, origins, directions)


def marks_of_bits(bits: Tensor, implementation: str | None = None) -> Tensor:
    """`ops.raycast.marks_of_bits`; `implementation` "reference" or "cpu", None: the faster one that can run."""
    if implementation is None:
        many = bits.numel() >= _FEWEST and bits.device.type == "cpu"
        implementation = "cpu" if many and cpu.llvmlite_problem() is None else "reference"
    return (
        description.marks_of_bits(bits)
        if implementation == "reference"
        else driver("cpu", "raycast").marks_of_bits(bits)
    )


def _driver(given: Raycast, origins: Tensor, implementation: str | None):
    if implementation is None:
        implementation = _implementation_for(given.lattice) if missing(given, origins) is None else "reference"
    return driver(implementation, "raycast")


def _implementation_for(lattice: AnyLattice) -> str:
    """What casts rays at these coefficients: "cpu" (vector code), or "cuda" (Triton) on a GPU."""
    return room_of(lattice.coefficients.device)
