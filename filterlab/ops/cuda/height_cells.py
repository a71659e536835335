"""The Bernstein coefficients of cells of a spline of heights, in Triton: a cell for each thread.

Data are read through tables of which datum stands where (`ops.height_hits.data_of_windows`); only those that a
coefficient needs are read for it, so that a hole is as large as it should be.
"""

from __future__ import annotations

from filterlab import bernstein
from filterlab.ops.cuda.source import Source, number
from filterlab.ops.height_hits import DEGREE, POINTS, Cell

UPPER = tuple((DEGREE + 1) * k + j for _, j, k in bernstein.multi_indices(DEGREE, 2))
"""Numbers of the domain points of the upper triangle, in the order of its coefficients."""

LOWER = tuple(POINTS - 1 - n for n in UPPER)

ARRAYS = ("values", "lines", "columns")
"""values (H, W) in their storage, rows `width` numbers apart, a size; lines and columns are the tables."""


def coefficients(source: Source, cell: Cell, zeros: bool, x: str, y: str) -> None:
    """`point_0` … `point_24`, float64, of the cells (x, y), integers.

    Args:
        zeros: whether beyond the data there are zeros.
    """
    used = sorted({n for mask in cell.masks for n, _ in mask})
    tables = ("lines", y, {n // cell.size for n in used}), ("columns", x, {n % cell.size for n in used})
    places = {
        (table, n): source.named(f"tl.load({table} + ({at}).to(tl.int64) * {cell.steps} + {n})")
        for table, at, numbers in tables
        for n in sorted(numbers)
    }
    data = {}
    for n in used:
        row, column = places["lines", n // cell.size], places["columns", n % cell.size]
        there = f", ({row} >= 0) & ({column} >= 0), 0" if zeros else ""
        data[n] = source.named(f"tl.load(values + ({row} * width + {column}){there}).to(tl.float64)")
    for n, mask in enumerate(cell.masks):
        source.line(f"point_{n} = {' + '.join(f'{data[k]} * {number(weight)}' for k, weight in mask)}")
