"""Bounds of the polynomials on cells as vector code: describes lattices to the program of `ops.cpu.hulls`.

Memory beyond the result: for parts of more than one cell 4 bytes for every cell of a few layers.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from filterlab.ops.bounds import Bounds, Codes, of_pairs, tells_off_trend
from filterlab.ops.cpu import compiler
from filterlab.ops.cpu import threads as pool
from filterlab.ops.cpu.block_bits import BlockBitsJob, BlockBitsVariant
from filterlab.ops.cpu.hulls import HullsJob, HullsVariant
from filterlab.ops.cpu.machine import lanes_of
from filterlab.ops.gather import STORAGE, in_whole_rows
from filterlab.ops.pieces import Lattice
from filterlab.ops.tetrahedra import AnyLattice

_LAYERS = 32  # of cells at a time, where they are joined to parts
_BLOCKS = 256  # of a chunk


def bounds(lattice: AnyLattice, edge: int, codes: Codes) -> Bounds:
    """`ops.reference.bounds.bounds`, fused."""
    coefficients, depth = in_whole_rows(lattice.coefficients), lattice.cells[2]
    step = depth if edge == 1 else _LAYERS
    layers = [_of_layers(lattice, coefficients[z:], codes, min(step, depth - z)) for z in range(0, depth, step)]
    lows, highs, ends, off = zip(*layers, strict=True)
    low, high = (
        np.concatenate([_joined(x, edge, least) for x in own])
        for own, least in ((lows, np.minimum), (highs, np.maximum))
    )
    ends = min(e[0] for e in ends), max(e[1] for e in ends)
    off_trend = torch.from_numpy(np.concatenate([_joined_pairs(x, edge) for x in off])) if off[0] is not None else None
    return Bounds(torch.from_numpy(low), torch.from_numpy(high), ends, off_trend)


def _of_layers(
    lattice: AnyLattice, coefficients: Tensor, codes: Codes, depth: int
) -> tuple[np.ndarray, np.ndarray, tuple[float, float], np.ndarray | None]:
    """Of single cells, whose first taps are the first of the coefficients."""
    plane, row, _ = coefficients.stride()
    width, height, _ = lattice.cells
    lanes = lanes_of(torch.float64)
    job = HullsJob(
        width=row,
        height=plane // row,
        cells_x=width,
        cells_y=height,
        factor=lattice.scale / codes.step,
        offset=(lattice.shift - codes.start) / codes.step,
        scale=lattice.scale,
        next=0,
        chunks=depth,
    )
    low, high = (np.empty((depth, height, width), np.int16) for _ in range(2))
    off_trend = np.empty(low.shape, np.int32) if tells_off_trend(lattice) else None
    ends = np.empty((2, depth, lanes))
    arrays = {} if off_trend is None else {"off_trend": off_trend}
    job.point(coefficients=coefficients, low=low, high=high, least=ends[0], most=ends[1], **arrays)
    function = compiler.compiled(_variant(lattice, coefficients, lanes))
    pool.run(function, [job] * max(1, min(torch.get_num_threads(), depth)))
    least, most = sorted(lattice.scale * float(x) + lattice.shift for x in (ends[0].min(), ends[1].max()))
    return low, high, (least, most), off_trend


def _variant(lattice: AnyLattice, coefficients: Tensor, lanes: int) -> HullsVariant:
    degrees = lattice.degrees if isinstance(lattice, Lattice) else (lattice.degree, lattice.degree, lattice.degree)
    return HullsVariant(lattice.stencil.lowered, degrees, STORAGE[coefficients.dtype], lanes)


def _joined(cells: np.ndarray, edge: int, least: np.ufunc) -> np.ndarray:
    """The least (or greatest) of every `edge`³ cells, an edge of 1 or 2; fewer at the ends."""
    for axis in range(3 if edge == 2 else 0):
        rows = cells.swapaxes(0, axis)
        joined = rows[::2].copy()
        second = rows[1::2]
        least(joined[: len(second)], second, out=joined[: len(second)])
        cells = joined.swapaxes(0, axis)
    return cells


def _joined_pairs(cells: np.ndarray, edge: int) -> np.ndarray:
    """The same of `ops.bounds.in_pairs`, the least of the low ones and the greatest of the high ones."""
    low, high = (
        _joined(own.numpy(), edge, least)
        for own, least in zip(of_pairs(torch.from_numpy(cells)), (np.minimum, np.maximum), strict=True)
    )
    return (low.view(np.int32) >> 16 & 0xFFFF) | high.view(np.int32)


def bits_of_blocks(low: Tensor, high: Tensor, least: Tensor, most: Tensor, below: int, above: int) -> Tensor:
    """`ops.reference.bounds.bits_of_blocks`, fused."""
    bits = np.empty((len(low), 4, 4, 4), np.uint8)
    job = BlockBitsJob(below=below, above=above, blocks=len(low), chunk=_BLOCKS, chunks=-(-len(low) // _BLOCKS))
    codes = {"low": low, "high": high, "least": least, "most": most}
    job.point(bits=bits, **{name: own.contiguous() for name, own in codes.items()})
    pool.run(compiler.compiled(BlockBitsVariant()), [job] * max(1, min(torch.get_num_threads(), job.chunks)))
    return torch.from_numpy(bits)
