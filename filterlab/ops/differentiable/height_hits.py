"""Casting rays at splines of heights: what runs it. Derivatives of hits are `surfaces.base`'s, as of all surfaces."""

from __future__ import annotations

from torch import Tensor

from filterlab.ops import cpu
from filterlab.ops.differentiable.drivers import driver
from filterlab.ops.differentiable.recording import transforming
from filterlab.ops.gather import STORAGE
from filterlab.ops.height_hits import Cell, HeightHits
from filterlab.ops.heights import Heights
from filterlab.ops.raycast import Candidates

_FEWEST = 1 << 14
"""Cells from which on a program is worth to be compiled for their bounds."""


def missing(heights: Heights) -> str | None:
    """What keeps the programs from running here; None: nothing does."""
    if transforming():
        return "it has no transforms of torch.func"
    if problem := cpu.llvmlite_problem():
        return problem
    values = heights.values
    if values.device.type != "cpu" or values.dtype not in STORAGE:
        return f"it reads {', '.join(STORAGE.values())} on the CPU; got {values.dtype} on {values.device}"
    return None


def described(heights: Heights, implementation: str | None = None) -> HeightHits:
    """What is cast, of one grid: with bounds of all blocks, which are found here.

    Args:
        implementation: "reference", "cpu" or "cuda"; None: the faster one of the first two that can run.
    """
    cell, (columns, rows) = Cell.of(heights.pattern), heights.cells
    if implementation is None:
        implementation = "cpu" if columns * rows >= _FEWEST and missing(heights) is None else "reference"
    return HeightHits(heights, cell, driver(implementation, "height_hits").pyramid(heights, cell))


def first(given: HeightHits, origins: Tensor, directions: Tensor, implementation: str | None = None) -> Tensor:
    """t (R,) float64, where rays (R, 3) first meet the surface; ∞ where they don't. Without derivatives.

    Args:
        implementation: "reference", "cpu" or "cuda", which has only run in the interpreter yet; None: the faster one of
            the first two that can run.
    """
    return _driver(given, origins, implementation).first(given, origins, directions)


def met(given: HeightHits, origins: Tensor, directions: Tensor, implementation: str | None = None) -> Tensor:
    """(R,) bool, whether rays (R, 3) meet the surface at all; arguments as for `first`."""
    return _driver(given, origins, implementation).met(given, origins, directions)


def candidates(given: HeightHits, origins: Tensor, directions: Tensor, implementation: str | None = None) -> Candidates:
    """The pieces of rays (R, 3) that may hold a hit, those of a ray in order. Arguments as for `first`."""
    return _driver(given, origins, implementation).candidates(given, origins, directions)


def _driver(given: HeightHits, origins: Tensor, implementation: str | None):
    if implementation is None:
        here = origins.device.type == "cpu" and missing(given.heights) is None
        implementation = "cpu" if here else "reference"
    return driver(implementation, "height_hits")
