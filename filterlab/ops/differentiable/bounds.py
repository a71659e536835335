"""Bounds of the polynomials on cells: what computes them. They have no derivatives."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from filterlab.ops import cpu
from filterlab.ops.bounds import Bounds, Codes
from filterlab.ops.differentiable.drivers import driver
from filterlab.ops.gather import STORAGE
from filterlab.ops.tetrahedra import AnyLattice

_FEWEST = 1 << 16
"""Cells from which on a program is worth to be compiled: plain torch takes 20 ns to 2 µs for each."""


def missing(lattice: AnyLattice) -> str | None:
    """What keeps the program from running here; None: nothing does."""
    if problem := cpu.llvmlite_problem():
        return problem
    c = lattice.coefficients
    if c.device.type != "cpu" or c.dtype not in STORAGE:
        return f"it reads {', '.join(STORAGE.values())} on the CPU; got {c.dtype} on {c.device}"
    from filterlab.ops.cpu.machine import lanes_of  # it needs llvmlite, and has been imported with it

    least = lanes_of(torch.float64)
    if lattice.cells[0] < least:
        return f"it bounds {least} cells of a row at a time; got {lattice.cells[0]}"
    if not lattice.exact:
        return "its kernels are tables that are written into the program; got tensors"
    return None


def bounds(lattice: AnyLattice, edge: int, codes: Codes, implementation: str | None = None) -> Bounds:
    """Those of parts of `edge`³ cells, an edge of 1 or 2.

    Args:
        implementation: "reference" or "cpu"; None: the faster one that can run.
    """
    if implementation is None:
        many = math.prod(lattice.cells) >= _FEWEST
        implementation = "cpu" if many and missing(lattice) is None else "reference"
    return driver(implementation, "bounds").bounds(lattice, edge, codes)


def bits_of_blocks(
    low: Tensor,
    high: Tensor,
    least: Tensor,
    most: Tensor,
    below: int,
    above: int,
    implementation: str | None = None,
) -> Tensor:
    """Which parts of K blocks may hold a level, (K, 4, 4, 4) uint8; see `ops.reference.bounds.bits_of_blocks`."""
    if implementation is None:
        fused = low.device.type == "cpu" and low.numel() >= _FEWEST and cpu.llvmlite_problem() is None
        implementation = "cpu" if fused else "reference"
    return driver(implementation, "bounds").bits_of_blocks(low, high, least, most, below, above)
