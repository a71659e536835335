"""Stencils: the sums that every evaluation is made of, and what their derivatives are.

A row of a stencil is a number computed at a point x,

    row(x) = Σ_i weight_i · Σ_k c_k φ_x^(m_x)(x−k_x) φ_y^(m_y)(y−k_y) φ_z^(m_z)(z−k_z),

a sum of *products* of 1-D kernels, each differentiated m times. The jet of a tensor-product kernel has one product in
every row. NCRSI has four in its value, and a trilinear value with central differences other kernels in each row: as
stencils they are read in one pass over the taps too. Stencils are closed under differentiation: the derivatives of the
rows are the rows of another one.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from itertools import groupby

import torch

from filterlab.kernels import Kernel, PiecewisePolynomial, differentiate

Kernels = tuple[PiecewisePolynomial, PiecewisePolynomial, PiecewisePolynomial]
MultiIndex = tuple[int, int, int]

Table = tuple[tuple[float, ...], ...]
"""Row t: the weight of tap t as a polynomial in u, constant term first; (0.0,) where the tap has none."""


@lru_cache
def multi_indices(order: int) -> tuple[MultiIndex, ...]:
    """The rows of a jet: (m_x, m_y, m_z) with m_x + m_y + m_z ≤ order, graded.

    (0,0,0); (1,0,0) (0,1,0) (0,0,1); (2,0,0) (1,1,0) (1,0,1) (0,2,0) (0,1,1) (0,0,2); …
    """
    return tuple((total - j, j - k, k) for total in range(order + 1) for j in range(total + 1) for k in range(j + 1))


@dataclass(frozen=True)
class Product:
    """weight · φ_x^(m_x) φ_y^(m_y) φ_z^(m_z): kernels and orders m along x, y, z."""

    kernels: Kernels
    orders: MultiIndex = (0, 0, 0)
    weight: float = 1.0

    def derivative(self, axis: int) -> Product:
        """∂/∂x, ∂/∂y or ∂/∂z for axis 0, 1, 2."""
        orders = list(self.orders)
        orders[axis] += 1
        return replace(self, orders=tuple(orders))


Row = tuple[Product, ...]


@dataclass(frozen=True)
class Stencil:
    """Rows that are computed together.

    Raises ValueError where kernels of even and odd support meet along an axis: their knots do not coincide.
    """

    rows: tuple[Row, ...]

    def __post_init__(self) -> None:
        for axis, name in enumerate("xyz"):
            kernels = {product.kernels[axis] for row in self.rows for product in row}
            if len({k.support % 2 for k in kernels}) > 1:
                listed = ", ".join(sorted(f"{k.name} ({k.support})" for k in kernels))
                raise ValueError(f"supports along {name} must all be even or all be odd; got {listed}")

    @classmethod
    def jet(cls, kernels: PiecewisePolynomial | Sequence[PiecewisePolynomial], order: int) -> Stencil:
        """All partial derivatives up to `order` of one tensor product; rows as in `multi_indices(order)`."""
        kernels = per_axis(kernels)
        return _exact_jet(kernels, order) if all(isinstance(k, Kernel) for k in kernels) else _jet(kernels, order)

    @property
    def exact(self) -> bool:
        """True when every kernel is a fixed table."""
        return all(isinstance(k, Kernel) for row in self.rows for product in row for k in product.kernels)

    @cached_property
    def supports(self) -> MultiIndex:
        """Taps along x, y, z: those of the widest kernel."""
        x, y, z = (max(p.kernels[axis].support for row in self.rows for p in row) for axis in range(3))
        return x, y, z

    @cached_property
    def order(self) -> int:
        """The largest m_x + m_y + m_z."""
        return max(sum(product.orders) for row in self.rows for product in row)

    def up_to(self, order: int) -> Stencil:
        """Of a value and its derivatives those of orders up to this one."""
        return Stencil(self.rows[: len(multi_indices(order))])

    @cached_property
    def derivatives(self) -> tuple[Stencil, tuple[tuple[int, ...], ...]]:
        """(stencil, raised): row raised[axis][r] of that stencil is the derivative along `axis` of row r of this one.

        Equal derivatives are one row: a value and gradient have 9 distinct ones, not 12.
        """
        rows: dict[Row, int] = {}
        raised = tuple(
            tuple(rows.setdefault(tuple(p.derivative(axis) for p in row), len(rows)) for row in self.rows)
            for axis in range(3)
        )
        return Stencil(tuple(rows)), raised

    @cached_property
    def lowered(self) -> Lowered:
        """The same as numbers. Raises TypeError for a kernel that is not a fixed table."""
        if not self.exact:
            raise TypeError("only stencils of exact kernels can be lowered")
        functions: tuple[dict[Table, int], ...] = ({}, {}, {})
        rows = []
        for row in self.rows:
            products = []
            for p in row:
                tables = [_table(p.kernels[a], p.orders[a], self.supports[a]) for a in range(3)]  # type: ignore[arg-type]
                if all(any(map(any, table)) for table in tables):
                    x, y, z = (functions[a].setdefault(tables[a], len(functions[a])) for a in range(3))
                    products.append((p.weight, x, y, z))
            rows.append(tuple(products))
        x, y, z = (tuple(f) for f in functions)
        return Lowered(self.supports, (x, y, z), tuple(rows))

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        return hash(self.rows)


@dataclass(frozen=True)
class Lowered:
    """A stencil as numbers: what a generator of code needs to know, and nothing else.

    Attributes:
        supports: taps along x, y, z.
        functions: the distinct weight functions along x, y and z, each a table with one row for every tap.
        rows: for every row its products (weight, x, y, z), the last three being numbers of functions; products that are
            zero everywhere are left out.
    """

    supports: MultiIndex
    functions: tuple[tuple[Table, ...], tuple[Table, ...], tuple[Table, ...]]
    rows: tuple[tuple[tuple[float, int, int, int], ...], ...]

    def has(self, axis: int, function: int, tap: int) -> bool:
        """Whether that function has a weight for that tap at all."""
        return any(self.functions[axis][function][tap])

    def taps_of(self, axis: int, function: int) -> list[int]:
        """The taps that a function has a weight for."""
        return [tap for tap in range(self.supports[axis]) if self.has(axis, function, tap)]

    def runs(self) -> list[tuple[range, tuple[int, ...]]]:
        """Runs of planes for which the same functions along z have a weight, with those functions."""
        functions = range(len(self.functions[2]))
        live = [tuple(c for c in functions if self.has(2, c, z)) for z in range(self.supports[2])]
        runs = [(key, [z for z, _ in group]) for key, group in groupby(enumerate(live), key=lambda item: item[1])]
        return [(range(planes[0], planes[-1] + 1), key) for key, planes in runs if key]

    def pairs(self, functions: Collection[int]) -> list[tuple[int, int]]:
        """The distinct (a, b), functions along x and y, of products that have one of these functions along z."""
        return list(dict.fromkeys((a, b) for row in self.rows for _, a, b, c in row if c in functions))

    def taps(self, functions: Collection[int]) -> list[int]:
        """The taps along x that one of the functions has a weight for."""
        return [x for x in range(self.supports[0]) if any(self.has(0, a, x) for a in functions)]


def per_axis(kernels: PiecewisePolynomial | Sequence[PiecewisePolynomial]) -> Kernels:
    """Kernels along x, y, z, from one or three."""
    x, y, z = (kernels,) * 3 if isinstance(kernels, PiecewisePolynomial) else tuple(kernels)
    return x, y, z


def _jet(kernels: Kernels, order: int) -> Stencil:
    if order < 0:
        raise ValueError(f"order must be ≥ 0; got {order}")
    return Stencil(tuple((Product(kernels, orders),) for orders in multi_indices(order)))


_exact_jet = lru_cache(maxsize=1024)(_jet)


@lru_cache(maxsize=1024)
def _table(kernel: Kernel, order: int, support: int) -> Table:
    """Taps of a derivative, with empty ones on both sides up to `support`."""
    rows = differentiate(kernel.taps(torch.float64), order).tolist()
    pad = ((0.0,),) * ((support - kernel.support) // 2)
    return (*pad, *(_trimmed(row) for row in rows), *pad)


def _trimmed(row: Sequence[float]) -> tuple[float, ...]:
    """Without the zeros at the end."""
    degree = max((j for j, c in enumerate(row) if c), default=0)
    return tuple(row[: degree + 1])
