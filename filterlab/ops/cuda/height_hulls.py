"""The program that bounds a spline of heights in Triton: a block of cells for each thread."""

from __future__ import annotations

from dataclasses import dataclass

from filterlab.ops.cuda.cells import larger, smaller
from filterlab.ops.cuda.height_cells import ARRAYS, LOWER, UPPER, coefficients
from filterlab.ops.cuda.source import Source, number
from filterlab.ops.height_hits import ROUNDING, SMALLEST, Cell

SIZES = ("width", "cells_x", "cells_y", "blocks_x", "blocks")
"""blocks: in all."""


@dataclass(frozen=True)
class HeightHullsVariant:
    """Everything the program depends on; can be hashed.

    Attributes:
        cell: what the coefficients are made of.
        zeros: whether beyond the data there are zeros.
    """

    cell: Cell
    zeros: bool

    def write(self) -> Source:
        """bounds (blocks, 2) float32 are written; slack (1,) float64 is by what they are wider, for rounding."""
        source, edge = (
            Source("height_hulls", (*ARRAYS, "bounds", "slack", *SIZES, "BLOCK: tl.constexpr")),
            self.cell.finest,
        )
        source.lines(f"""
            width, cells_x, cells_y = width.to(tl.int64), cells_x.to(tl.int64), cells_y.to(tl.int64)
            block = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
            inside = block < blocks
            block = tl.where(inside, block, 0)
            first_x, first_y = (block % blocks_x) << {edge}, (block // blocks_x) << {edge}
            slack = tl.load(slack)
            low = tl.full((BLOCK,), float("inf"), tl.float64)
            high = -low
        """)
        with source.block(f"for k in range({4**edge})"):
            source.lines(f"""
                cell_x = tl.minimum(first_x + k % {2**edge}, cells_x - 1)  # beyond the last one that one again
                cell_y = tl.minimum(first_y + k // {2**edge}, cells_y - 1)
            """)
            coefficients(source, self.cell, self.zeros, "cell_x", "cell_y")
            for triangle in (UPPER, LOWER):
                _enclose(source, [f"point_{n}" for n in triangle])
        for number_, (name, side) in enumerate((("low", "-"), ("high", "+"))):
            source.lines(f"""
                wide = {name} {side} (slack + {number(ROUNDING)} * tl.abs({name}) + {number(SMALLEST)})
                wide = tl.where(tl.abs({name}) < float("inf"), wide, {name})
                tl.store(bounds + 2 * block + {number_}, wide.to(tl.float32), inside)
            """)
        return source


def _enclose(source: Source, points: list[str]) -> None:
    """Widen `low` and `high`, but for a triangle that is a hole."""
    source.line(f"least, most, total = {points[0]}, {points[0]}, {points[0]}")
    for point in points[1:]:
        source.line(f"least, most, total = {smaller('least', point)}, {larger('most', point)}, total + {point}")
    source.lines("""
        whole = tl.abs(total) < float("inf")
        low = tl.where(whole & (least < low), least, low)
        high = tl.where(whole & (most > high), most, high)
    """)
