"""The program that casts rays at a spline of heights in Triton: a ray for each thread of a warp.

The plan is that of `ops.cpu.height_rays` (read it first): every ray walks to its next cell whose block it may meet, the
quartics of both triangles there are restricted to the ray's parts in them, and what becomes of these `hits` says.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from filterlab import bernstein
from filterlab.ops.cuda import height_cells
from filterlab.ops.cuda.cells import larger, smaller
from filterlab.ops.cuda.height_cells import LOWER, UPPER
from filterlab.ops.cuda.hits import straddle, taker
from filterlab.ops.cuda.source import Source, any_of, number
from filterlab.ops.height_hits import DEGREE, Cell
from filterlab.ops.pieces import NO_MOTION
from filterlab.ops.raycast import Written

BLOCK = 32
NUMBERS = ("shift_x", "shift_y", "spacing_x", "spacing_y", "end_x", "end_y", "low_z", "high_z", "extent")
"""float64, in memory: of cells in the world; of the box around all, from (0, 0); extent: its diagonal, in the world."""

ARRAYS = (*height_cells.ARRAYS, "bounds", "starts", "widths", "origins", "directions", "numbers")
"""bounds: `ops.height_hits.Pyramid.numbers`; starts, widths: int64 of every level, the latter blocks of a row."""

SIZES = ("width", "rays", "cells_x", "cells_y", "highest", "capacity", "most")
"""capacity: candidates or sheets of a ray that there is room for; most: sheets behind which no more are looked for."""

_ROWS = [f"row_{n}" for n in range(DEGREE + 1)]
_INSIDE = ("u", "v", "w")


@dataclass(frozen=True)
class HeightRaysVariant:
    """Everything the program depends on; can be hashed.

    Attributes:
        asked: "first", "met", "sheets" or "candidates".
        cell: what the coefficients of a cell are made of.
        zeros: whether beyond the data there are zeros.
    """

    asked: str
    cell: Cell
    zeros: bool

    @property
    def own(self) -> tuple[str, ...]:
        """Arrays that are written: t (R,), or (R, k), and count (R,); or those of `ops.raycast.Written`."""
        return {"sheets": ("t", "count"), "candidates": Written._fields}.get(self.asked, ("t",))

    def write(self) -> Source:
        return _Program(self).write()


class _Program:
    def __init__(self, variant: HeightRaysVariant) -> None:
        self.variant, self.cell = variant, variant.cell
        parameters = (*ARRAYS, *variant.own, *SIZES, "BLOCK: tl.constexpr")
        self.source = Source(f"height_rays_{variant.asked}", parameters)
        self.line, self.lines = self.source.line, self.source.lines
        self.taker = taker(self.source, variant.asked, DEGREE, "float64")

    def write(self) -> Source:
        block, searching = self.source.block, f"going & ~{self.taker.waiting}"
        self._rays()
        self.taker.begin()
        with self.taker.rounds(), block(f"while {any_of(searching)}"):
            self._next_cells(searching)
            with block(f"if {any_of('found')}"):
                self._in_cells()
        self.taker.end()
        return self.source

    # --- the way ---

    def _rays(self) -> None:
        """As `ops.reference.height_hits.entered` says: in coordinates of cells, from where they enter the box."""
        self.lines("""
            width, rays = width.to(tl.int64), rays.to(tl.int64)
            ray = tl.program_id(0).to(tl.int64) * BLOCK + tl.arange(0, BLOCK)
            inside = ray < rays
            nothing = tl.full((BLOCK,), 0.0, tl.float64)
            infinity = nothing + float("inf")
            start, end = nothing, infinity
        """)
        for k, name in enumerate(NUMBERS):
            self.line(f"{name} = tl.load(numbers + {k})")
        for k, a in enumerate("xyz"):
            self.line(f"own_{a} = tl.load(origins + 3 * ray + {k}, inside, 0.0).to(tl.float64)")
            self.line(f"way_{a} = tl.load(directions + 3 * ray + {k}, inside, 1.0).to(tl.float64)")
            self.line(f"speed_{a} = way_{a}")
        for a in "xy":
            self.line(f"own_{a}, speed_{a} = (own_{a} - shift_{a}) / spacing_{a}, speed_{a} / spacing_{a}")
        self.line("longest = tl.abs(speed_x)")
        for a in "yz":
            self.line(f"longest = {larger('longest', f'tl.abs(speed_{a})')}")
        self.line("scale = 1.0 / longest")
        box = {"x": ("nothing", "end_x"), "y": ("nothing", "end_y"), "z": ("low_z", "high_z")}
        for a, (low, high) in box.items():
            self._within(a, low, high)
        for a, (low, high) in box.items():
            self.line(f"entry_{a} = start * speed_{a} + own_{a}")
            self.line(f"entry_{a} = {larger(f'entry_{a}', low)}")
            self.line(f"entry_{a} = {smaller(f'entry_{a}', high)}")
        self.lines("""
            going = inside & (start <= end)
            end = end - start
            s, ended_at, before = nothing, nothing - 1.0, nothing
            level = highest + (ray * 0).to(tl.int32)
        """)
        for a in "xy":
            self.lines(f"""
                forward_{a} = (speed_{a} > 0.0).to(tl.int32)
                safe_{a} = tl.where(speed_{a} == 0.0, 1.0, speed_{a})
                cell_{a} = tl.minimum(tl.maximum(tl.floor(entry_{a}).to(tl.int32), 0), cells_{a} - 1)
            """)

    def _within(self, a: str, low: str, high: str) -> None:
        """Along an axis: `start` and `end`, and a speed of 0 of what hardly moves."""
        self.lines(f"""
            speed_{a} = speed_{a} * scale
            still = tl.abs(speed_{a}) <= {number(NO_MOTION)}
            among = (own_{a} >= {low}) & (own_{a} <= {high})
            first = ({low} - own_{a}) / tl.where(still, 1.0, speed_{a})
            last = ({high} - own_{a}) / tl.where(still, 1.0, speed_{a})
            near, far = {smaller("first", "last")}, {larger("first", "last")}
            near = tl.where(still, tl.where(among, -infinity, infinity), near)
            far = tl.where(still, tl.where(among, infinity, -infinity), far)
            start, end = {larger("near", "start")}, {smaller("far", "end")}
            speed_{a} = tl.where(still, 0.0, speed_{a})
        """)

    def _next_cells(self, searching: str) -> None:
        """Let rays go on until each has come to a cell where it may meet something, or to its end.

        Then `found` are those that have, `at_x`, `at_y` the cells, `near` and `far` where rays enter and leave them; a
        ray is behind its cell.
        """
        self.lines(f"""
            on = {searching}
            found = on & (ray < 0)
            near, far = s, s
            at_x, at_y = tl.where(on, cell_x, 0), tl.where(on, cell_y, 0)  # cells that there are
        """)
        with self.source.block(f"while {any_of('on')}"):
            self._relevant()
            self.lines("""
                down = relevant & (level > 0)
                here = relevant & (level == 0)
                found = found | here
                near, far = tl.where(here, s, near), tl.where(here, out, far)
                at_x, at_y = tl.where(here, cell_x, at_x), tl.where(here, cell_y, at_y)
                ahead = on & ~down
            """)
            self._advance()
            self.line("on = (down | (ahead & ~here)) & going")

    def _relevant(self) -> None:
        """`relevant`: who may meet something in its block; `out`: where it is left, along y or x."""
        for a in "xy":
            self.lines(f"""
                plane = ((cell_{a} >> level) + forward_{a}) << level
                exit_{a} = (plane.to(tl.float64) - entry_{a}) / safe_{a}
                exit_{a} = tl.where(speed_{a} == 0.0, infinity, exit_{a})
            """)
        self.lines(f"""
            out = {smaller("exit_x", "exit_y")}
            out = {smaller("out", "end")}
            out = {larger("out", "s")}
            along_y = exit_y < exit_x
            own = tl.maximum(level - {self.cell.finest}, 0)
            block = (cell_y >> level).to(tl.int64) * tl.load(widths + own) + (cell_x >> level) + tl.load(starts + own)
            bounded = on & (level >= {self.cell.finest})
            low = tl.load(bounds + 2 * block, bounded, 0.0).to(tl.float64)
            high = tl.load(bounds + 2 * block + 1, bounded, 0.0).to(tl.float64)
            z_near, z_far = s * speed_z + entry_z, out * speed_z + entry_z
            relevant = ({smaller("z_near", "z_far")} <= high) & ({larger("z_near", "z_far")} >= low)
            relevant = on & (relevant | ~bounded)
        """)

    def _advance(self) -> None:
        """Who is `ahead` goes to the beginning of the next block."""
        self.line("leaves, fits = ahead & (ray < 0), ahead")
        self.line(f"up = tl.where(level >= {self.cell.finest}, level + 1, {self.cell.finest})")
        for a, across in (("x", "~along_y"), ("y", "along_y")):
            self.lines(f"""
                least = (cell_{a} >> level) << level
                next_ = least + (1 << level)
                greatest = tl.where(speed_{a} < 0.0, cell_{a}, tl.minimum(next_ - 1, cells_{a} - 1))
                place = tl.floor(out * speed_{a} + entry_{a}).to(tl.int32)
                place = tl.minimum(tl.maximum(place, tl.where(forward_{a} > 0, cell_{a}, least)), greatest)
                new = tl.where({across}, tl.where(forward_{a} > 0, next_, least - 1), place)
                leaves = leaves | ((new >> up) != (cell_{a} >> up))
                fits = fits & (new >= 0) & (new < cells_{a})
                cell_{a} = tl.where(ahead, new, cell_{a})
            """)
        self.lines(f"""
            higher = tl.where(leaves, tl.minimum(up, highest), level)
            lower = tl.where(level > {self.cell.finest}, level - 1, 0)
            level = tl.where(ahead, higher, tl.where(down, lower, level))
            s = tl.where(ahead, out, s)
            going = going & (~ahead | (fits & (out < end)))
        """)

    # --- cells ---

    def _in_cells(self) -> None:
        """Both pieces of the rays under `found`, one after the other."""
        self._diagonal()
        height_cells.coefficients(self.source, self.cell, self.variant.zeros, "at_x", "at_y")
        with self.source.block("for which in range(2)"):
            self.lines(f"""
                second = which == 1
                piece_near, piece_far = tl.where(second, between, near), tl.where(second, far, between)
                passed = found & tl.where(second, crossing <= far, crossing >= near) & ~{self.taker.done}
                upper = upper_first != second
            """)
            for n, numbers in enumerate(zip(UPPER, LOWER, strict=True)):
                self.line(f"b_{n} = tl.where(upper, {', '.join(f'point_{m}' for m in numbers)})")
            self._restrict()
            self._piece()
            with self.source.block(f"if {any_of('holds')}"):
                self.taker.take(_ROWS, "piece_near", "piece_far")

    def _diagonal(self) -> None:
        """`crossing`, where rays cross the diagonals of their cells, ±∞ beside them; `upper_first`, `between`."""
        sign, level = ("-", "at_y - at_x") if self.cell.mirrored else ("+", "at_x + at_y + 1")
        self.lines(f"""
            place = entry_y {sign} entry_x
            turn = speed_y {sign} speed_x
            line_ = ({level}).to(tl.float64)
            beside = tl.where(place <= line_, infinity, -infinity)
            crossing = tl.where(turn == 0.0, beside, (line_ - place) / tl.where(turn == 0.0, 1.0, turn))
            upper_first = turn >= 0.0
            between = {larger("crossing", "near")}
            between = {smaller("between", "far")}
        """)

    def _restrict(self) -> None:
        """The surface less the ray, in the triangle with coefficients b_0 … b_14, on `piece_near` … `piece_far`."""
        for end, at in (("p", "piece_near"), ("q", "piece_far")):
            for a, name in (("x", "v"), ("y", "w")):
                self.line(f"{end}_{name} = {at} * speed_{a} + (entry_{a} - at_{a}.to(tl.float64))")
                self.line(f"{end}_{name} = {larger(f'{end}_{name}', '0.0')}")
                self.line(f"{end}_{name} = {smaller(f'{end}_{name}', '1.0')}")
                turned = "~upper" if name == "w" or not self.cell.mirrored else "upper"
                self.line(f"{end}_{name} = tl.where({turned}, 1.0 - {end}_{name}, {end}_{name})")
            self.line(f"{end}_u = 1.0 - {end}_v - {end}_w")
            self.line(f"{end}_z = {at} * speed_z + entry_z")
        corners = [f"b_{n}" for n in range(len(UPPER))]
        first = self._toward("p", "q", corners)
        last = self._toward("q", "p", corners)
        for n, (row, value) in enumerate(zip(_ROWS, (*first, *last[1::-1]), strict=True)):
            self.line(f"{row} = {value} - ((q_z - p_z) * {number(n / DEGREE)} + p_z)")

    def _toward(self, own: str, other: str, corners: Sequence[str]) -> tuple[str, str, str]:
        """b[p, p, p, p], b[p, p, p, q], b[p, p, q, q] of own and other ends p and q."""
        twice = self._step(self._step(corners, own, 3), own, 2)
        thrice, mixed = self._step(twice, own, 1), self._step(twice, other, 1)
        (a,), (b,), (c,) = self._step(thrice, own, 0), self._step(thrice, other, 0), self._step(mixed, other, 0)
        return a, b, c

    def _step(self, rows: Sequence[str], end: str, degree: int) -> list[str]:
        """A step of de Casteljau's algorithm, to so low a degree."""
        place = {alpha: n for n, alpha in enumerate(bernstein.multi_indices(degree + 1, 2))}
        found = []
        for i, j, k in bernstein.multi_indices(degree, 2):
            corners = zip(((i + 1, j, k), (i, j + 1, k), (i, j, k + 1)), _INSIDE, strict=True)
            found.append(self.source.named(" + ".join(f"{rows[place[c]]} * {end}_{name}" for c, name in corners)))
        return found

    def _piece(self) -> None:
        """Join it to the piece before; `holds`, `repeated`."""
        self.lines(f"""
            whole = tl.abs({" + ".join(_ROWS)}) < infinity
            joined = passed & (piece_near == ended_at) & (tl.abs(before) < infinity) & (tl.abs(row_0) < infinity)
            ended_at = tl.where(passed, piece_far, ended_at)
            repeated = joined & (before == 0.0)
            row_0 = tl.where(joined, before, row_0)
            before = tl.where(passed, {_ROWS[-1]}, before)
        """)
        straddle(self.source, _ROWS)
        self.line("holds = passed & whole & straddles")
