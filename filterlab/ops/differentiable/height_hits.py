"""Casting rays at splines of heights: what runs it. Derivatives of hits are `surfaces.base`'s, as of all surfaces."""

from __future__ import annotations

from types import ModuleType

from torch import Tensor

from filterlab.ops import cpu, cuda
from filterlab.ops.differentiable.drivers import driver, room_of
from filterlab.ops.differentiable.recording import transforming
from filterlab.ops.gather import STORAGE
from filterlab.ops.height_hits import Cell, HeightHits
from filterlab.ops.heights import Heights
from filterlab.ops.raycast import Candidates, Sheets

_FEWEST = 1 << 14
"""Cells from which on a program is worth to be compiled for their bounds."""


def missing(heights: Heights) -> str | None:
    """What keeps the programs from running where the heights are; None: nothing does."""
    if transforming():
        return "it has no transforms of torch.func"
    values = heights.values
    if problem := cuda.device_problem(values) if room_of(values.device) == "cuda" else cpu.llvmlite_problem():
        return problem
    if values.device.type not in ("cpu", "cuda") or values.dtype not in STORAGE:
        return f"it reads {', '.join(STORAGE.values())} on the CPU or a GPU; got {values.dtype} on {values.device}"
    return None


def described(heights: Heights, implementation: str | None = None) -> HeightHits:
    """What is cast, of one grid: with bounds of all blocks, which are found here.

    Args:
        implementation: "reference", "cpu" or "cuda"; None: the fastest that can run.
    """
    cell, (columns, rows) = Cell.of(heights.pattern), heights.cells
    if implementation is None:
        implementation = _implementation_for(heights) if columns * rows >= _FEWEST else "reference"
    return HeightHits(heights, cell, driver(implementation, "height_hits").pyramid(heights, cell))


def first(given: HeightHits, origins: Tensor, directions: Tensor, implementation: str | None = None) -> Tensor:
    """t (R,) float64, where rays (R, 3) first meet the surface; ∞ where they don't. Without derivatives.

    Args:
        implementation: "reference", "cpu" or "cuda"; None: the fastest that can run.
    """
    return _driver(given, origins, implementation).first(given, origins, directions)


def met(given: HeightHits, origins: Tensor, directions: Tensor, implementation: str | None = None) -> Tensor:
    """(R,) bool, whether rays (R, 3) meet the surface at all; arguments as for `first`."""
    return _driver(given, origins, implementation).met(given, origins, directions)


def sheets(
    given: HeightHits, origins: Tensor, directions: Tensor, asked: Sheets, implementation: str | None = None
) -> Tensor:
    """t (R, k) float64, where rays (R, 3) meet the surface; ∞ where they no longer do. Arguments as for `first`."""
    return _driver(given, origins, implementation).sheets(given, origins, directions, asked)


def candidates(given: HeightHits, origins: Tensor, directions: Tensor, implementation: str | None = None) -> Candidates:
    """The pieces of rays (R, 3) that may hold a hit, those of a ray in order. Arguments as for `first`."""
    return _driver(given, origins, implementation).candidates(given, origins, directions)


def _driver(given: HeightHits, origins: Tensor, implementation: str | None) -> ModuleType:
    if implementation is None:
        together = given.heights.values.device == origins.device
        implementation = _implementation_for(given.heights) if together else "reference"
    return driver(implementation, "height_hits")


def _implementation_for(heights: Heights) -> str:
    """What casts rays at these unasked: "cpu" (vector code), or "cuda" (Triton) on a GPU; else plain torch."""
    fused = room_of(heights.values.device)
    return fused if missing(heights) is None else "reference"
