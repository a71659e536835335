"""A sum over taps along a part of a ray, written in Triton: `ops.cpu.restriction` says what is computed.

Polynomials are names of_0, of_1, … of their scaled Bernstein coefficients, so that products are convolutions. Planes of
large stencils are a loop, as in `ops.cuda.taps`: Triton takes its time for programs of many loads.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from math import comb, prod

from filterlab.ops.cuda.source import Source, number
from filterlab.ops.cuda.taps import AXES
from filterlab.ops.stencil import Lowered, Table

WRITTEN_OUT = 8  # taps; larger stencils loop over planes

Polynomial = list[str]
"""Names of scaled Bernstein coefficients."""


@dataclass(frozen=True)
class Section:
    """Names of a section of a ray's part in a cell.

    Attributes:
        mask: which rays have one.
        near, far: where on the ray it begins and ends.
    """

    mask: str
    near: str
    far: str


class Restriction:
    """Writes restrictions of a stencil of one row to polynomials of a degree, at the end of a source.

    Names that the source must have: `width` and `height` as 64-bit integers, `arithmetic`, and `nothing`, zeros of it;
    of rays in cells `near`, `far`, `u_x` … and `v_x` …, where they are there, in [0, 1], and `first`, the address of
    the cell's first tap.
    """

    def __init__(self, source: Source, stencil: Lowered, degree: int) -> None:
        self.source, self.line, self.stencil, self.degree = source, source.line, stencil, degree
        self.degrees = [[_degree(table) for table in functions] for functions in stencil.functions]
        self.written_out = prod(stencil.supports) <= WRITTEN_OUT

    @contextmanager
    def every(self, into: str, mask: str, waiting: str) -> Iterator[Section]:
        """The with-block, for each of the sections in which a ray's part in a cell is one polynomial: the whole.

        Args:
            into: Bernstein coefficients are into_0 …
            mask: which rays are asked for.
            waiting: a mask of rays that need not go on.
        """
        self.restrict(into)
        for j in range(self.degree + 1):
            self.line(f"{into}_{j} = {into}_{j} * {number(1 / comb(self.degree, j))}")
        yield Section(mask, "near", "far")

    def restrict(self, into: str) -> None:
        """into_0 …: Σ over taps, from u_x, u_y, u_z to v_x, v_y, v_z, scaled coefficients."""
        for axis in range(3):
            self._weigh(axis)
        for j in range(self.degree + 1):
            self.line(f"{into}_{j} = nothing")
        for plane, wz in self._planes():
            self._of_plane(plane, wz, into)

    # --- weights ---

    def _weigh(self, axis: int) -> None:
        for p in set(self.degrees[axis]):
            self._symmetric(axis, p)
        for f, (table, p) in enumerate(zip(self.stencil.functions[axis], self.degrees[axis], strict=True)):
            for t, row in enumerate(table):
                if any(row):
                    for j in range(p + 1):
                        terms = [f"{number(a)} * {_of(axis, p, j, k)}" for k, a in enumerate(row) if a]
                        self.line(f"{_weight(axis, f, t)}_{j} = {' + '.join(terms)}")

    def _symmetric(self, axis: int, p: int) -> None:
        """binom(p, j) E_jk / binom(p, k) for all j and k."""
        u, v = f"u_{AXES[axis]}", f"v_{AXES[axis]}"
        for j in range(p + 1):
            self.line(f"{_of(axis, p, j, 0)} = nothing + {number(comb(p, j))}")
            for k in range(1, p + 1):
                terms = []
                for i in range(max(0, k - (p - j)), min(j, k) + 1):
                    factor = comb(p, j) * comb(j, i) * comb(p - j, k - i) / comb(p, k)
                    terms.append(" * ".join([number(factor), *[v] * i, *[u] * (k - i)]))
                self.line(f"{_of(axis, p, j, k)} = {' + '.join(terms)}")

    def _names(self, axis: int, function: int, tap: int) -> Polynomial:
        return [f"{_weight(axis, function, tap)}_{j}" for j in range(self.degrees[axis][function] + 1)]

    # --- planes ---

    def _planes(self) -> Iterator[tuple[str, dict[int, Polynomial]]]:
        """Every plane and the weights of the functions along z there; in a large stencil every run, within a loop."""
        for run, functions in self.stencil.runs():
            if self.written_out:
                for z in run:
                    yield str(z), {c: self._names(2, c, z) for c in functions}
            else:
                with self.source.block(f"for plane in range({run.start}, {run.stop})"):
                    for c in functions:
                        for j in range(self.degrees[2][c] + 1):
                            self.line(f"along_{c}_{j} = {self._chosen(c, j, run)}")
                    yield "plane", {c: [f"along_{c}_{j}" for j in range(self.degrees[2][c] + 1)] for c in functions}

    def _chosen(self, function: int, j: int, planes: range) -> str:
        """A coefficient of the weight of a function along z for the value of `plane`."""
        text = self._names(2, function, planes[-1])[j]
        for z in reversed(planes[:-1]):
            text = f"tl.where(plane == {z}, {self._names(2, function, z)[j]}, {text})"
        return text

    def _of_plane(self, plane: str, wz: dict[int, Polynomial], into: str) -> None:
        pairs = self.stencil.pairs(wz)
        sums = {(a, b): [] for a, b in pairs}
        for y in range(self.stencil.supports[1]):
            self._line(f"first + ({plane} * height + {y}) * width", y, pairs, sums)
        for factor, a, b, c in self.stencil.rows[0]:
            if c in wz and sums.get((a, b)):
                raised = self.degree - self.degrees[0][a] - self.degrees[1][b] - self.degrees[2][c]
                own = self._product(f"product_{a}_{b}_{c}", sums[a, b], wz[c])
                for i, name in enumerate(own):
                    for j in range(raised + 1):
                        times = factor * comb(raised, j)
                        self.line(f"{into}_{i + j} += {name if times == 1 else f'{number(times)} * {name}'}")

    def _line(self, at: str, y: int, pairs: Sequence[tuple[int, int]], sums: dict[tuple[int, int], Polynomial]) -> None:
        """Add line y to the sums over a plane."""
        pairs = [(a, b) for a, b in pairs if self.stencil.has(1, b, y)]
        if not (needed := self.stencil.taps({a for a, _ in pairs})):
            return
        self.line(f"at = {at}")
        for x in needed:
            self.line(f"tap_{x} = tl.load(at + {x}).to(arithmetic)")
        for a in dict.fromkeys(a for a, _ in pairs):
            for j in range(self.degrees[0][a] + 1):
                terms = [f"{_weight(0, a, x)}_{j} * tap_{x}" for x in needed if self.stencil.has(0, a, x)]
                self.line(f"line_{a}_{j} = {' + '.join(terms)}")
        for a, b in pairs:
            line = [f"line_{a}_{j}" for j in range(self.degrees[0][a] + 1)]
            sums[a, b] = self._product(f"plane_{a}_{b}", line, self._names(1, b, y), onto=sums[a, b])

    def _product(self, name: str, a: Polynomial, b: Polynomial, onto: Sequence[str] = ()) -> Polynomial:
        """The product of two polynomials, as new names or added to those."""
        for k in range(len(a) + len(b) - 1):
            terms = [f"{a[i]} * {b[k - i]}" for i in range(max(0, k - len(b) + 1), min(k, len(a) - 1) + 1)]
            self.line(f"{name}_{k} {'+=' if onto else '='} {' + '.join(terms)}")
        return [f"{name}_{k}" for k in range(len(a) + len(b) - 1)]


def _weight(axis: int, function: int, tap: int) -> str:
    return f"w{AXES[axis]}_{function}_{tap}"


def _of(axis: int, degree: int, j: int, k: int) -> str:
    return f"e{AXES[axis]}_{degree}_{j}_{k}"


def _degree(table: Table) -> int:
    return max(len(row) for row in table) - 1
