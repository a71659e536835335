"""The sums over taps, written in Triton for any stencil.

Letters, as in `ops.reference`: x, y, z along W, H, D; S taps per axis; u the local coordinate; a, b, c number the
weight functions along x, y, z that the stencil's products are made of. Every name of the program below stands for a
block of numbers, one for each point, if not for one number that serves them all.

The sums are those of `ops.cpu.taps`, x first, so that a line of taps read once serves every function along y and z:

    at          = address of tap (0, y, z)                                for every plane z and line y
    line_a      = Σ_x wx_a_x · tap_x
    plane_a_b  += wy_b_y · line_a
    row_r      += wz_c · Σ weight · plane_a_b                             after every plane, over products that have c

and `spread`, the adjoint of `contract`, runs them backwards. Each thread reads its own taps, one by one: the loads of
neighbouring threads meet in the caches. Taps without a weight are neither read nor multiplied.

Small stencils are written out in full. Of large ones a run of planes becomes a loop in which the weights along z are
chosen by a comparison with z, because the time that Triton takes to compile grows faster than the number of loads: for
a 6×6×6 value and gradient 13.5 s of one core written out, 1.1 s as a loop (Triton 3.7.1, for sm_90).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence

from filterlab.ops.cuda.source import Source, number, polynomial
from filterlab.ops.stencil import Lowered

AXES, SIZES = "xyz", ("width", "height", "depth")
WRITTEN_OUT = 64  # taps; larger stencils loop over planes

Plane = tuple[str, dict[int, str]]
"""The number of a plane, and the weight of every function along z that has one there; as text."""


def first_taps(source: Source, supports: Sequence[int]) -> None:
    """From x, y, z: the number of the first tap along every axis, ix, iy, iz, and the local coordinates ux, uy, uz."""
    line = source.line
    for axis, size, support in zip(AXES, SIZES, supports, strict=True):
        line(f"shifted = {axis} - {number(support / 2 - 1)}")
        line("base = tl.floor(shifted)")
        line("base = tl.where(base > start, base, start)  # NaN too: no comparison with it is true")
        line(f"base = tl.where(base < start + {size} - {support}, base, start + {size} - {support})")
        line(f"u{axis} = shifted - base")
        line(f"i{axis} = base.to(tl.int64) - start")


class Taps:
    """Writes the sums of a stencil at the end of a source.

    Names that the source must have: `width`, `height`, `depth`, `start` (the coordinate of coefficient 0) as 64-bit
    integers, and `arithmetic`, the dtype of points and sums.

    Args:
        written_out: the largest number of taps whose planes are written out.
    """

    def __init__(self, source: Source, stencil: Lowered, written_out: int = WRITTEN_OUT) -> None:
        self.source, self.stencil = source, stencil
        self.written_out = math.prod(stencil.supports) <= written_out

    # --- where the points read, and with which weights ---

    def locate(self, volume: str) -> None:
        """From x, y, z: the number of the first tap, `cell`, and its address `first` in the channel at `volume`; the
        local coordinates ux, uy, uz; and `nothing`, which is 0 where the point is finite and NaN elsewhere."""
        line = self.source.line
        first_taps(self.source, self.stencil.supports)
        line("cell = (iz * height + iy) * width + ix")
        line(f"first = {volume} + cell")
        line("nothing = ux * 0.0 + uy * 0.0 + uz * 0.0")

    def weigh(self) -> None:
        """The weights of all taps, but for those that are constants."""
        for axis, functions in enumerate(self.stencil.functions):
            for f, table in enumerate(functions):
                for t, row in enumerate(table):
                    if any(row[1:]):
                        self.source.line(f"w{AXES[axis]}_{f}_{t} = {polynomial(row, f'u{AXES[axis]}')}")

    def _weight(self, axis: int, function: int, tap: int) -> str:
        row = self.stencil.functions[axis][function][tap]
        return f"w{AXES[axis]}_{function}_{tap}" if any(row[1:]) else number(row[0])

    # --- the sums ---

    def contract(self, tap: str, rows: str = "row") -> None:
        """row_0, row_1, …: the rows of the stencil.

        Args:
            tap: address of the first tap in the channel.
            rows: what they are called.
        """
        for r in range(len(self.stencil.rows)):
            self.source.line(f"{rows}_{r} = nothing")
        for plane in self._planes():
            self._contract_plane(tap, plane, rows)

    def _contract_plane(self, tap: str, plane: Plane, rows: str) -> None:
        z, wz = plane
        sums = _Sums(self.source)
        for y in range(self.stencil.supports[1]):
            self._contract_line(f"{tap} + ({z} * height + {y}) * width", y, self.stencil.pairs(wz), sums)
        for r, products in enumerate(self.stencil.rows):
            for c, weight in wz.items():
                own = [(factor, f"plane_{a}_{b}") for factor, a, b, function in products if function == c]
                if own := [term for term in own if term[1] in sums]:
                    self.source.line(f"{rows}_{r} += {weight} * {_combined(own)}")

    def _contract_line(self, at: str, y: int, pairs: Iterable[tuple[int, int]], planes: _Sums) -> None:
        """Add line y to the sums over a plane."""
        pairs = [(a, b) for a, b in pairs if self.stencil.has(1, b, y)]
        needed = self.stencil.taps({a for a, _ in pairs})
        if not needed:
            return
        self.source.line(f"at = {at}")
        for x in needed:
            self.source.line(f"tap_{x} = tl.load(at + {x}).to(arithmetic)")
        lines = _Sums(self.source)
        for a in dict.fromkeys(a for a, _ in pairs):
            for x in self.stencil.taps({a}):
                lines.add(f"line_{a}", f"{self._weight(0, a, x)} * tap_{x}")
        for a, b in pairs:
            if f"line_{a}" in lines:
                planes.add(f"plane_{a}_{b}", f"{self._weight(1, b, y)} * line_{a}")

    def spread(self, tap: str, mask: str, rows: str = "row") -> None:
        """Add row_0, row_1, …, weighted, to the coefficients: the three sums backwards.

        Args:
            tap: address of the first tap in the channel.
            mask: which points count.
            rows: what they are called.
        """
        for z, wz in self._planes():
            planes = _Sums(self.source)
            for r, products in enumerate(self.stencil.rows):
                for factor, a, b, c in products:
                    if c in wz:
                        planes.add(f"plane_{a}_{b}", _combined([(factor, f"{wz[c]} * {rows}_{r}")]))
            for y in range(self.stencil.supports[1]):
                self._spread_line(f"{tap} + ({z} * height + {y}) * width", y, planes, mask)

    def _spread_line(self, at: str, y: int, planes: _Sums, mask: str) -> None:
        """Line y of a plane. Several points may share a coefficient: the additions are atomic."""
        lines = _Sums(self.source)
        for a, b in self.stencil.pairs(range(len(self.stencil.functions[2]))):
            if self.stencil.has(1, b, y) and f"plane_{a}_{b}" in planes:
                lines.add(f"line_{a}", f"{self._weight(1, b, y)} * plane_{a}_{b}")
        functions = [a for a in range(len(self.stencil.functions[0])) if f"line_{a}" in lines]
        if needed := self.stencil.taps(functions):
            self.source.line(f"into = {at}")
        values = _Sums(self.source)
        for x in needed:
            for a in functions:
                if self.stencil.has(0, a, x):
                    values.add(f"tap_{x}", f"{self._weight(0, a, x)} * line_{a}")
            self.source.line(f'tl.atomic_add(into + {x}, tap_{x}, {mask}, sem="relaxed")')

    # --- which taps there are ---

    def _planes(self) -> Iterator[Plane]:
        """Every plane of taps; in a large stencil every run of planes, within a loop over it."""
        for run, functions in self.stencil.runs():
            if self.written_out:
                for z in run:
                    yield str(z), {c: self._weight(2, c, z) for c in functions}
            else:
                with self.source.block(f"for plane in range({run.start}, {run.stop})"):
                    for c in functions:
                        self.source.line(f"wz_{c} = {self._chosen(c, run)}")
                    yield "plane", {c: f"wz_{c}" for c in functions}

    def _chosen(self, function: int, planes: range) -> str:
        """The weight of a function along z for the value of `plane`."""
        text = _typed(self._weight(2, function, planes[-1]))
        for z in reversed(planes[:-1]):
            text = f"tl.where(plane == {z}, {_typed(self._weight(2, function, z))}, {text})"
        return text


class _Sums:
    """Sums under names: the first term makes a sum, every other is added to it."""

    def __init__(self, source: Source) -> None:
        self.source = source
        self._names: set[str] = set()

    def add(self, name: str, term: str) -> None:
        self.source.line(f"{name} {'+=' if name in self._names else '='} {term}")
        self._names.add(name)

    def __contains__(self, name: str) -> bool:
        return name in self._names


def _combined(terms: Sequence[tuple[float, str]]) -> str:
    """Σ factor · name."""
    text = " + ".join(name if factor == 1 else f"{number(factor)} * {name}" for factor, name in terms)
    return text if len(terms) == 1 else f"({text})"


def _typed(weight: str) -> str:
    """A weight that can be chosen: two literals on their own would be float32."""
    return weight if weight.startswith("w") else f"tl.full((), {weight}, arithmetic)"
