"""The way of rays through the cells of a lattice in Triton: one ray for each thread of a warp.

The steps, letters and roundings of `ops.cpu.cells` (read it first): a ray in a brick that is clear of the level leaps
behind the cube of clear bricks around it; who has found a cell that may hold the level waits for the others of the
warp. Places are doubles, whatever polynomials are computed in.
"""

from __future__ import annotations

from contextlib import AbstractContextManager

from filterlab.ops.cuda.source import Source, any_of, number
from filterlab.ops.cuda.taps import AXES
from filterlab.ops.pieces import NO_MOTION

BLOCK = 32  # rays of a program; a warp

_TRIPLES = ("origin", "offset", "lower", "upper")
_MATRIX = tuple(f"matrix_{i}{k}" for i in range(3) for k in range(3))
NUMBERS = (*(f"{name}_{axis}" for name in _TRIPLES for axis in AXES), *_MATRIX, "infinity")
"""float64, in memory; see `ops.cpu.crossings.FIELDS`."""
SIZES = ("rays", *(f"{name}_{axis}" for name in ("cells", "bricks") for axis in AXES), "edge")
ARRAYS = ("origins", "directions", "marks", "numbers")

_EXPONENT = 0x7FF << 52
_FLIP = 2046 << 52  # 2^(e − 1023) and 2^(1023 − e) have exponents that add up to this


def smaller(a: str, b: str) -> str:
    """b where either is NaN."""
    return f"tl.where({a} < {b}, {a}, {b})"


def larger(a: str, b: str) -> str:
    """b where either is NaN."""
    return f"tl.where({a} > {b}, {a}, {b})"


class Walk:
    """Writes the walk of a warp's rays at the end of a source that has `ARRAYS`, `NUMBERS` and `SIZES`.

    What others find: `ray`, `inside` (whether there is such a ray), `going` (which rays have not ended), `start` (where
    they enter the domain), `scale` (from lengths along the walk to units of the direction).
    """

    def __init__(self, source: Source) -> None:
        self.source, self.line = source, source.line

    def if_any(self, mask: str) -> AbstractContextManager[None]:
        return self.source.block(f"if {any_of(mask)}")

    def while_any(self, mask: str) -> AbstractContextManager[None]:
        return self.source.block(f"while {any_of(mask)}")

    # --- rays ---

    def begin(self) -> None:
        """Put the rays where they enter the domain."""
        line = self.line
        for size in SIZES:
            line(f"{size} = {size}.to(tl.{'int64' if size == 'rays' else 'int32'})")
        for k, name in enumerate(NUMBERS):
            line(f"{name} = tl.load(numbers + {k})")
        line("ray = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)")
        line("inside = ray < rays")
        self._in_cells()
        self._span()
        for a in AXES:
            line(f"direction_{a} = tl.where(still_{a}, 0.0, speed_{a})")
            line(f"entry_{a} = tl.where(going, start * direction_{a} + own_{a}, lower_{a})")
            line(f"entry_{a} = {larger(f'entry_{a}', f'lower_{a}')}")
            line(f"entry_{a} = {smaller(f'entry_{a}', f'upper_{a}')}")
            line(f"from_{a} = tl.where(still_{a}, -infinity, entry_{a})")
            line(f"inverse_{a} = 1.0 / speed_{a}")
            line(f"backward_{a} = tl.where(speed_{a} < 0.0, -1, 0)")
            line(f"cell_{a} = tl.floor(entry_{a}).to(tl.int32)")
            line(f"cell_{a} = {self._within(f'cell_{a}', '0', f'cells_{a} - 1')}")

    def _in_cells(self) -> None:
        """World to coordinates of cells, with directions as long as is told by `scale`, a power of two."""
        line = self.line
        for k, a in enumerate(AXES):
            line(f"from_{a} = tl.load(origins + 3 * ray + {k}, inside, 0.0).to(tl.float64) - origin_{a}")
            line(f"way_{a} = tl.load(directions + 3 * ray + {k}, inside, 0.0).to(tl.float64)")
        for i, a in enumerate(AXES):
            own, way = (" + ".join(f"matrix_{i}{k} * {x}_{b}" for k, b in enumerate(AXES)) for x in ("from", "way"))
            line(f"own_{a} = {own} - offset_{a}")
            line(f"speed_{a} = {way}")
        self._longest()
        line(f"scale = ({_FLIP} - (longest.to(tl.int64, bitcast=True) & {_EXPONENT})).to(tl.float64, bitcast=True)")
        for a in AXES:
            line(f"speed_{a} = speed_{a} * scale")
        self._longest()
        for a in AXES:
            line(f"still_{a} = tl.abs(speed_{a}) <= longest * {number(NO_MOTION)}")
            line(f"speed_{a} = tl.where(still_{a}, 1.0, speed_{a})")

    def _longest(self) -> None:
        self.line("longest = tl.abs(speed_x)")
        for a in "yz":
            self.line(f"longest = {larger('longest', f'tl.abs(speed_{a})')}")

    def _span(self) -> None:
        """From where to where rays are in the domain, from 0 on."""
        line = self.line
        line("start = tl.full((BLOCK,), 0.0, tl.float64)")
        line("end = start + infinity")
        for a in AXES:
            line(f"low = (lower_{a} - own_{a}) / speed_{a}")
            line(f"high = (upper_{a} - own_{a}) / speed_{a}")
            line(f"among = (own_{a} >= lower_{a}) & (own_{a} <= upper_{a})")
            line(f"low, high = {smaller('low', 'high')}, {larger('low', 'high')}")
            line(f"low = tl.where(still_{a}, tl.where(among, -infinity, infinity), low)")
            line(f"high = tl.where(still_{a}, tl.where(among, infinity, -infinity), high)")
            line(f"start = {larger('low', 'start')}")
            line(f"end = {smaller('high', 'end')}")
        line("going = inside & (start <= end)")
        line("start = tl.where(going, start, 0.0)")
        line("end = tl.where(going, end - start, 0.0)")
        line("s = tl.full((BLOCK,), 0.0, tl.float64)")

    # --- steps ---

    def next_cells(self, searching: str) -> None:
        """Let rays go on until each has come to a cell that may hold the level, or to its end.

        Then `found` are those that have, `at_x`, `at_y`, `at_z` the cells, `near` and `far` where rays enter and leave
        them; a ray is behind its cell.
        """
        line = self.line
        line(f"on = {searching}")
        line("found = on & (ray < 0)")
        self._look()
        with self.while_any("on"):
            self._leap()
            self._look()
        for a in AXES:
            line(f"at_{a} = tl.where(found, cell_{a}, 0)")
            line(f"plane_{a} = at_{a} + backward_{a} + 1")
        self._cross()
        line("near = s")
        line(f"far = {larger('least', 's')}")
        line("over = ~(far < end)")
        for a in AXES:
            line(f"next_{a} = tl.where(through_{a}, plane_{a} + backward_{a}, at_{a})")
            line(f"over = over | {self._outside(a)}")
            line(f"cell_{a} = tl.where(found, next_{a}, cell_{a})")
        line("s = tl.where(found, far, s)")
        line("going = going & ~(found & over)")
        line(f"far = {smaller('far', 'end')}")

    def _look(self) -> None:
        """Whoever is in a part of a brick that may hold the level has found its cell."""
        line = self.line
        for a in AXES:
            line(f"brick_{a} = cell_{a} >> edge")
            line(f"part_{a} = (cell_{a} >> (edge - 1)) & 1")
        line("mark = tl.load(marks + (brick_z * bricks_y + brick_y) * bricks_x + brick_x, on, 0).to(tl.int32)")
        line("holds = on & (mark > 0) & (((mark >> (part_x + 2 * part_y + 4 * part_z)) & 1) > 0)")
        line("found = found | holds")
        line("on = on & ~holds")

    def _leap(self) -> None:
        """Over the clear bricks around, or the clear part of a brick."""
        line = self.line
        line("shift_by = tl.where(mark < 0, edge, edge - 1)")
        line("radius = tl.where(mark < 0, -1 - mark, 0)")
        for a in AXES:
            line(f"brick_{a} = cell_{a} >> shift_by  # or the part, as a brick of half the edge")
            line(f"plane_{a} = (brick_{a} + (backward_{a} ^ radius) + 1) << shift_by")
        self._cross()
        line(f"reached = {larger('least', 's')}")
        line("over = ~(reached < end)")
        for a in AXES:
            line(f"place = tl.floor(reached * direction_{a} + entry_{a})")
            line(f"lowest = (brick_{a} - radius) << shift_by")
            line(f"highest = (brick_{a} + radius + 1) << shift_by")
            line(f"highest = tl.minimum(highest - 1, cells_{a} - 1)  # also on the domain's end")
            line(f"whole_place = {self._within('place.to(tl.int32)', 'lowest', 'highest')}")
            line(f"next_{a} = tl.where(through_{a}, plane_{a} + backward_{a}, whole_place)")
            line(f"over = over | {self._outside(a)}")
            line(f"cell_{a} = tl.where(on, next_{a}, cell_{a})")
        line("s = tl.where(on, reached, s)")
        line("going = going & ~(on & over)")
        line("on = on & ~over")

    def _cross(self) -> None:
        """`least`, where rays cross the nearest of the planes, and `through_x` … which one (the first of equals).

        At infinity where they don't move along an axis.
        """
        line = self.line
        for a in AXES:
            line(f"crossed_{a} = (plane_{a}.to(tl.float64) - from_{a}) * inverse_{a}")
        line(f"least = {smaller('crossed_x', 'crossed_y')}")
        line(f"least = {smaller('least', 'crossed_z')}")
        line("through_x = (crossed_x <= crossed_y) & (crossed_x <= crossed_z)")
        line("through_y = ~through_x & (crossed_y <= crossed_z)")
        line("through_z = ~(through_x | through_y)")

    def _outside(self, axis: str) -> str:
        return f"(next_{axis} < 0) | (next_{axis} >= cells_{axis})"

    def _within(self, value: str, low: str, high: str) -> str:
        return f"tl.minimum(tl.maximum({value}, {low}), {high})"
