"""A sum over taps along a part of a ray: the same sums as in `ops.cpu.taps`, of weights that are polynomials in t.

From u₀ to u₁ the weight of a tap, Σ_k a_k u^k of degree p, has the scaled Bernstein coefficients

    w_j = binom(p, j) Σ_k a_k E_jk / binom(p, k),    E_jk = Σ_i binom(j, i) binom(p − j, k − i) u₁^i u₀^(k − i)

(its blossom at u₀ p − j times and u₁ j times); in this form products of polynomials are convolutions, so that lines,
planes and the whole are summed as values are, with a convolution in place of every product of two packs. What comes
out is f at u₀ and u₁ to a rounding or two, with no cancellation but that of the taps (`ops.reference.pieces`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from math import comb

from filterlab.ops.cpu.lanes import I64, Lanes, Storage, Value
from filterlab.ops.cpu.taps import Grid, Taps
from filterlab.ops.stencil import Lowered, Table

Polynomial = list[Value]
"""Scaled Bernstein coefficients, packs."""

Weights = list[list[list[Polynomial | None]]]
"""[axis][function][t]: the weight of tap t; None where the function has none."""


@dataclass(frozen=True)
class Section:
    """A section of a ray's part in a cell.

    Attributes:
        mask: which lanes have one.
        start, end: packs in [0, 1], of the part's length; None: all of it.
        rows: n + 1 Bernstein coefficients.
    """

    mask: Value
    start: Value | None
    end: Value | None
    rows: list[Value]


class Restriction(Taps):
    """Writes restrictions of a stencil of one row to polynomials of a degree. Make it before any loop."""

    def __init__(self, lanes: Lanes, stencil: Lowered, degree: int, storage: Storage, grid: Grid, room: bool) -> None:
        super().__init__(lanes, stencil, storage, grid, room)
        self.degree = degree
        self.degrees = [[_degree(table) for table in functions] for functions in stencil.functions]
        self._numbers = max((d + 1 for d in self.degrees[2]), default=1)
        self._along_z = lanes.reserve(lanes.pack, self.supports[2] * len(self.degrees[2]) * self._numbers)
        with lanes.builder.goto_entry_block():
            self._total = [lanes.kept() for _ in range(self.degree + 1)]

    @contextmanager
    def every(
        self,
        taps: list[Value],
        cell: Sequence[Value],
        start: Sequence[Value],
        end: Sequence[Value],
        mask: Value,
        waiting: Callable[[], Value],
    ) -> Iterator[Section]:
        """The with-block, for each of the sections in which a ray's part in a cell is one polynomial: the whole.

        Args:
            taps: address of every lane's first tap.
            cell: its index along x, y, z, from the lattice's first one.
            start, end: where the part begins and ends, packs of x, y, z in [0, 1].
            mask: which lanes are asked for.
            waiting: a mask of lanes that need not go on.
        """
        e = self.lanes
        scaled = enumerate(self.restrict(taps, start, end))
        yield Section(mask, None, None, [e.multiply(c, e.constant(1 / comb(self.degree, i))) for i, c in scaled])

    def restrict(self, taps: list[Value], start: Sequence[Value], end: Sequence[Value]) -> Polynomial:
        """Σ over taps between two places in their cells, degree + 1 scaled coefficients.

        Args:
            taps: address of every lane's first tap.
            start, end: packs of x, y, z in [0, 1].
        """
        e = self.lanes
        weights = self._weights(start, end)
        for total in self._total:
            total.set_part(I64(0), e.constant(0))
        for planes in self._alike():
            with self._every(planes, I64(0)) as (plane_offset, wz):
                for place, sums in enumerate(self._of_plane(taps, plane_offset, weights, wz)):
                    total = self._total[place]
                    total.set_part(I64(0), e.add(total.all(e.count), sums))
        return [total.all(e.count) for total in self._total]

    # --- one plane ---

    def _of_plane(self, taps: list[Value], offset: Value, weights: Weights, wz: dict[int, Polynomial]) -> Polynomial:
        pairs = self.stencil.pairs(wz)
        planes: dict[tuple[int, int], Polynomial] = {}
        for y, line in self.lines.fetch(taps, offset, self._needed(pairs)):
            for a in sorted({a for a, _ in pairs}):
                along = self._along_x(line, weights[0][a])
                for own, b in pairs:
                    weight = weights[1][b][y]
                    if own == a and along is not None and weight is not None:
                        planes[a, b] = self._convolved(along, weight, planes.get((a, b)))
        found: Polynomial = [self.lanes.constant(0)] * (self.degree + 1)
        for product in self.stencil.rows[0]:
            factor, a, b, c = product
            if c in wz and (a, b) in planes:
                raised = self.degree - sum(self._degrees_of(product))
                own = self._convolved(planes[a, b], wz[c])
                found = self._convolved(own, [factor * comb(raised, i) for i in range(raised + 1)], found)
        return found

    def _along_x(self, line: dict[int, Value], weights: list[Polynomial | None]) -> Polynomial | None:
        found = None
        for x, value in line.items():
            if (weight := weights[x]) is not None:
                found = self._convolved(weight, [value], found)
        return found

    def _convolved(self, a: Polynomial, b: Sequence[Value | float], onto: Polynomial | None = None) -> Polynomial:
        """The product of two polynomials, added to another."""
        e = self.lanes
        out: list[Value | None] = [None] * (len(a) + len(b) - 1) if onto is None else list(onto)
        for i, left in enumerate(a):
            for j, right in enumerate(b):
                factor = e.constant(right) if isinstance(right, (int, float)) else right
                out[i + j] = e.multiply_add(left, factor, out[i + j])
        return out

    def _scaled(self, a: Value, factor: float, onto: Value | None) -> Value:
        return self.lanes.multiply_add(a, self.lanes.constant(factor), onto)

    def _degrees_of(self, product: tuple[float, int, int, int]) -> list[int]:
        return [self.degrees[axis][function] for axis, function in enumerate(product[1:])]

    # --- weights ---

    def _weights(self, start: Sequence[Value], end: Sequence[Value]) -> Weights:
        found = [self._of_axis(axis, u, v) for axis, (u, v) in enumerate(zip(start, end, strict=True))]
        for function, taps in enumerate(found[2]):
            for z, weight in enumerate(taps):
                for j, pack in enumerate(weight or ()):
                    self.lanes.store(pack, self._place_along_z(I64(z), function, j))
        return found

    def _of_axis(self, axis: int, start: Value, end: Value) -> list[list[Polynomial | None]]:
        symmetric = {p: self._symmetric(p, start, end) for p in set(self.degrees[axis])}
        return [
            [self._restricted(row, symmetric[p]) if any(row) else None for row in table]
            for table, p in zip(self.stencil.functions[axis], self.degrees[axis], strict=True)
        ]

    def _restricted(self, row: Sequence[float], symmetric: list[list[Value]]) -> Polynomial:
        """Σ_k a_k · `symmetric`[j][k] for j = 0 … p."""
        e, out = self.lanes, []
        for own in symmetric:
            total = e.constant(0)
            for a, power in zip(row, own, strict=False):
                total = self._scaled(power, a, total) if a else total
            out.append(total)
        return out

    def _symmetric(self, p: int, u: Value, v: Value) -> list[list[Value]]:
        """[j][k]: binom(p, j) E_jk / binom(p, k)."""
        e = self.lanes
        powers = [[e.constant(1)], [e.constant(1)]]
        for own, x in zip(powers, (u, v), strict=True):
            for _ in range(p):
                own.append(e.multiply(own[-1], x))
        products = {(i, k - i): e.multiply(powers[1][i], powers[0][k - i]) for k in range(p + 1) for i in range(k + 1)}
        found = []
        for j in range(p + 1):
            row = []
            for k in range(p + 1):
                total = None
                for i in range(max(0, k - (p - j)), min(j, k) + 1):
                    factor = comb(p, j) * comb(j, i) * comb(p - j, k - i) / comb(p, k)
                    total = self._scaled(products[i, k - i], factor, total)
                row.append(total)
            found.append(row)
        return found

    def _place_along_z(self, z: Value, function: int, j: int) -> Value:
        b = self.builder
        index = b.add(b.mul(z, I64(len(self.degrees[2]) * self._numbers)), I64(function * self._numbers + j))
        return self.lanes.advance(self._along_z, index, self.lanes.pack)

    def _plane(self, z: Value, functions: Sequence[int], here: Value) -> tuple[Value, dict[int, Polynomial]]:
        e, b, grid = self.lanes, self.builder, self.grid
        own = {
            c: [e.load(self._place_along_z(z, c, j), e.number, e.count) for j in range(self.degrees[2][c] + 1)]
            for c in functions
        }
        return e.opaque(b.add(here, b.mul(b.mul(z, grid.height), grid.width))), own


def _degree(table: Table) -> int:
    return max(len(row) for row in table) - 1
