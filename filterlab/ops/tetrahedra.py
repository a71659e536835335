"""Sums of splines on tetrahedra: stencils of another kind, described, and written once for every arithmetic.

A row of the stencil is a derivative of a spline at a point x, from samples at the integers. Where x is in its cell, of
which each has the same tetrahedra under the signed permutations of the axes, decides what is summed:

    u = x − centre of the cell ─▶ the cone a ≥ b ≥ c ≥ 0: signs, and three exchanges of neighbouring axes
      ─▶ one of the shapes there, barycentric λ ─▶ Bernstein coefficients, masks of samples along the turned axes
      ─▶ de Casteljau: value and derivatives along the cone's axes ─▶ turned back

`Sum` writes that, and its transpose, in an `Arithmetic`: instructions of a program, lines of another, or tensors.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property
from itertools import combinations, permutations, product
from typing import Any, Protocol

import numpy as np
from torch import Tensor

from filterlab.bernstein import Index
from filterlab.bernstein import multi_indices as bernstein_indices
from filterlab.ops.pieces import Lattice, Triple
from filterlab.ops.stencil import Lowered, MultiIndex, Stencil, multi_indices

Value = Any
"""Numbers of an arithmetic, one for each of the points that it works on at a time; masks and integers too."""

Steps = tuple[int, int, int]
Block = dict[Steps, Value]
"""Samples by their places along three axes."""

UNITS: tuple[Steps, ...] = ((1, 0, 0), (0, 1, 0), (0, 0, 1))

Rows = dict[MultiIndex, Value]
"""All partial derivatives of some orders, each order whole."""

QUADRATICS: tuple[MultiIndex, ...] = multi_indices(2)
"""Powers of x, y, z."""

_EXCHANGES = ((0, 1), (1, 2), (0, 1))
"""Of neighbours that stand in the wrong order, to sort three."""


class Arithmetic(Protocol):
    """What sums are written in."""

    def constant(self, value: float, /) -> Value: ...
    def add(self, a: Value, b: Value, /) -> Value: ...
    def subtract(self, a: Value, b: Value, /) -> Value: ...
    def multiply(self, a: Value, b: Value, /) -> Value: ...
    def multiply_add(self, a: Value, b: Value, c: Value | None, /) -> Value: ...
    def divide(self, a: Value, b: Value, /) -> Value: ...
    def negate(self, a: Value, /) -> Value: ...
    def absolute(self, a: Value, /) -> Value: ...
    def floor(self, a: Value, /) -> Value: ...
    def less(self, a: Value, b: Value, /) -> Value: ...
    def both(self, a: Value, b: Value, /) -> Value: ...
    def where(self, mask: Value, a: Value, b: Value, /) -> Value: ...


@dataclass(frozen=True)
class Tetrahedra:
    """A spline as numbers: what a generator of code needs to know, and nothing else.

    Attributes:
        octahedral: whether cells are the octahedra about (i, j, k) + ½, i, j, k all even or all odd, else cubes about
            the integers.
        degree: n.
        centres: of the blocks of size³ samples that one tetrahedron needs, in steps along the cone's axes from the
            centre of the cell.
        size: 3, or 2: of a block of 2³ all that counts is what it tells of its centre, eight times the value and four
            times the gradient there, by differences.
        inputs: the K numbers that coefficients are made of, each as the number of its block and, along the cone's axes,
            its place there, 0 … 2; or which of value and gradient, (0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1).
        masks: R different ones, of K weights each.
        rows: for every shape, which of the masks its B Bernstein coefficients are.
        barycentric: for every shape 4 rows (d, n), λ_k = d + n · x.
        norm: no value is larger than this times the largest sample.
        cuts: planes (n, d), n · v = d, that cut the cube |v| ≤ ½ about a sample into parts of one tetrahedron each; of
            octahedra about a sample at even indices, v turned round along the axes of odd ones.
    """

    octahedral: bool
    degree: int
    centres: tuple[Steps, ...]
    size: int
    inputs: tuple[tuple[int, Steps], ...]
    masks: tuple[tuple[float, ...], ...]
    rows: tuple[tuple[int, ...], ...]
    barycentric: tuple[tuple[tuple[float, ...], ...], ...]
    norm: float
    cuts: tuple[tuple[Steps, float], ...]

    @cached_property
    def shared(self) -> tuple[tuple[tuple[int, int, int], ...], tuple[tuple[float, ...], ...]]:
        """The masks with sums and differences that several of them have computed once.

        Returns:
            steps (i, j, ±1), each one input more, input i ± input j; and the masks of all of these.
        """
        masks, steps, count = [{k: w for k, w in enumerate(mask) if w} for mask in self.masks], [], len(self.inputs)
        while True:
            pairs = Counter(
                (i, j, 1 if mask[i] == mask[j] else -1)
                for mask in masks
                for i, j in combinations(sorted(mask), 2)
                if abs(mask[i]) == abs(mask[j])
            )
            (i, j, sign), times = max(pairs.items(), key=lambda item: (item[1], item[0]), default=((0, 0, 0), 0))
            if times < 2:
                return tuple(steps), tuple(tuple(mask.get(k, 0.0) for k in range(count)) for mask in masks)
            for mask in masks:
                if mask.get(i) and mask.get(j) == sign * mask[i]:
                    mask[count] = mask.pop(i)
                    del mask[j]
            steps.append((i, j, sign))
            count += 1

    @cached_property
    def masks_of_cube(self) -> tuple[tuple[float, ...], ...]:
        """The masks of coefficients of a cube, each once: weights of its block's samples, z running fastest.

        Those halfway between two others are left out: what they give is neither the least nor the greatest.
        """
        places, middle, found = list(product(range(self.size), repeat=3)), (self.size - 1) / 2, {}
        for mask, axes, signs in product(self.masks, permutations(range(3)), product((1, -1), repeat=3)):
            weights = {}
            for weight, (_, at) in zip(mask, self.inputs, strict=True):
                weights[tuple(int(middle + s * (at[a] - middle)) for a, s in zip(axes, signs, strict=True))] = weight
            found[tuple(weights.get(place, 0.0) for place in places)] = None
        every = list(found)
        return tuple(every[i] for i in _outermost(every))

    @cached_property
    def masks_of_octahedra(self) -> tuple[tuple[tuple[Steps, Steps, float], ...], ...]:
        """The same of octahedra in a cube about a sample at even indices.

        Returns:
            for each its terms: twice the centre of a block, from the sample; its number, as in `inputs`; the weight.
        """
        found = {}
        for mask, axes, side in product(self.masks, permutations(range(3)), (1, -1)):
            terms = {}
            for weight, (block, unit) in zip(mask, self.inputs, strict=True):
                if weight:  # the cone looks from the centre, at side · ½, towards the sample
                    x, y, z = (side - 2 * side * self.centres[block][axis] for axis in axes)
                    i, j, k = (unit[axis] for axis in axes)
                    terms[(x, y, z), (i, j, k)] = weight * (1 if unit == (0, 0, 0) else -side)
            found[tuple((*key, weight) for key, weight in sorted(terms.items()))] = None
        every = [{(centre, unit): weight for centre, unit, weight in terms} for terms in found]
        keys = sorted(set().union(*every))
        kept, masks = _outermost([[own.get(key, 0.0) for key in keys] for own in every]), list(found)
        return tuple(masks[i] for i in kept)

    @cached_property
    def moments(self) -> tuple[tuple[float, ...], ...]:
        """For each of `masks_of_cube`, or `masks_of_octahedra`, the Bernstein coefficients of `QUADRATICS` there.

        They are what the mask makes of their samples, less Δ / 8: of those of a quadratic q the spline is q + Δq / 8.
        """
        rows = []
        for mask in self._masks_about_sample:
            moments = [math.fsum(w * math.prod(map(pow, at, m)) for at, w in mask) for m in QUADRATICS]
            rows.append(tuple(own - (max(m) == 2) / 4 for own, m in zip(moments, QUADRATICS, strict=True)))
        return tuple(rows)

    @property
    def _masks_about_sample(self) -> Iterator[list[tuple[Steps, float]]]:
        """The same masks: weights of samples by their steps from the one in the middle; some come more than once."""
        if not self.octahedral:
            places = [(x - 1, y - 1, z - 1) for x, y, z in product(range(self.size), repeat=3)]
            yield from (list(zip(places, mask, strict=True)) for mask in self.masks_of_cube)
            return
        sides = [(x, y, z) for x, y, z in product((-1, 1), repeat=3)]
        for terms in self.masks_of_octahedra:
            yield [
                (_half_way(centre, side), weight * math.prod(map(pow, side, unit)))
                for centre, unit, weight in terms
                for side in sides
            ]

    @property
    def around(self) -> int:
        """Samples before and behind the one in the middle of a cube that its tetrahedra need, along any axis."""
        return 2 if self.octahedral else 1

    @property
    def before(self) -> int:
        """By how much a block at the centre begins before the cell's own index, along every axis of space."""
        return 0 if self.octahedral else self.size // 2

    @cached_property
    def reach(self) -> tuple[int, int]:
        """Samples before and behind that of a cell's own index, along any axis of space."""
        farthest = max(abs(step) for centre in self.centres for step in centre)
        return farthest + self.before, farthest + self.size - 1 - self.before


@dataclass(frozen=True)
class TetrahedralStencil:
    """Derivatives of a spline on tetrahedra that are computed together, as rows; a stencil like `ops.stencil.Stencil`.

    Attributes:
        spline: what is summed.
        orders: of the derivatives, ascending; each has all of its rows, in the order of `multi_indices`.
    """

    spline: Tetrahedra
    orders: tuple[int, ...]
    exact = True

    @property
    def rows(self) -> tuple[MultiIndex, ...]:
        """(m_x, m_y, m_z) of every row."""
        return tuple(m for m in multi_indices(max(self.orders)) if sum(m) in self.orders)

    @property
    def order(self) -> int:
        return max(self.orders)

    @property
    def supports(self) -> MultiIndex:
        """S: from ⌊x − S/2 + 1⌋ on, along any axis, S samples have all that a point x needs, whatever its cell."""
        size = 2 * math.ceil(max(self.spline.reach) + 0.5) if self.spline.octahedral else sum(self.spline.reach) + 1
        return size, size, size

    @cached_property
    def derivatives(self) -> tuple[TetrahedralStencil, tuple[tuple[int, ...], ...]]:
        """(stencil, raised): row raised[axis][r] of that one is the derivative along `axis` of row r of this one."""
        raised = TetrahedralStencil(self.spline, tuple(order + 1 for order in self.orders))
        numbers = {m: number for number, m in enumerate(raised.rows)}
        return raised, tuple(tuple(numbers[_raise_along(m, axis)] for m in self.rows) for axis in range(3))

    def up_to(self, order: int) -> TetrahedralStencil:
        """The rows of orders up to this one."""
        return TetrahedralStencil(self.spline, tuple(own for own in self.orders if own <= order))

    @property
    def lowered(self) -> TetrahedralStencil:
        """Itself: it is numbers already."""
        return self

    def __hash__(self) -> int:
        return self._hash

    @cached_property
    def _hash(self) -> int:
        return hash((self.spline, self.orders))


@dataclass(frozen=True)
class TetrahedralLattice:
    """Cubes |x − i| ≤ ½ about the samples i of a domain, on parts of which a spline is one polynomial; see `Lattice`.

    Attributes:
        coefficients: (D, H, W), any real type: the samples that all cubes need, and no more.
        spline: what is summed.
        offset, lower, upper, scale, shift: as of a `Lattice`; offset is −½ along every axis.
    """

    coefficients: Tensor
    spline: Tetrahedra
    offset: Triple
    lower: Triple
    upper: Triple
    scale: float = 1.0
    shift: float = 0.0
    exact = True
    continuous = True

    @cached_property
    def stencil(self) -> TetrahedralStencil:
        """Its value."""
        return TetrahedralStencil(self.spline, (0,))

    @property
    def supports(self) -> MultiIndex:
        """Samples along x, y, z that a cube needs, the same number before and behind its own."""
        size = 2 * self.spline.around + 1
        return size, size, size

    @property
    def degree(self) -> int:
        """n, along a ray."""
        return self.spline.degree

    @property
    def cells(self) -> MultiIndex:
        """Cubes along x, y, z."""
        x, y, z = (n - s + 1 for n, s in zip(self.coefficients.shape[::-1], self.supports, strict=True))
        return x, y, z


AnyStencil = Stencil | TetrahedralStencil
LoweredStencil = Lowered | TetrahedralStencil
AnyLattice = Lattice | TetrahedralLattice


def reads_more(stencil: LoweredStencil) -> bool:
    """Whether other rows read taps that the first one does not."""
    if isinstance(stencil, TetrahedralStencil):
        return False
    first, *others = [
        {tap for _, *own in row for tap in product(*(stencil.taps_of(axis, own[axis]) for axis in range(3)))}
        for row in stencil.rows
    ]
    return any(not taps <= first for taps in others)


def _outermost(masks: Sequence[Sequence[float]]) -> list[int]:
    """Numbers of those that are not halfway between two others."""
    rows = np.array(masks)
    numbers = {row.tobytes(): i for i, row in enumerate(_told_apart(2 * rows))}
    sums = (_told_apart(rows[:i] + rows[i]) for i in range(len(rows)))
    halfway = {numbers.get(row.tobytes()) for own in sums for row in own}
    return [i for i in range(len(rows)) if i not in halfway]


def _told_apart(rows: np.ndarray) -> np.ndarray:
    """As integers: what rounding alone has apart is equal, but for few."""
    return np.rint(rows * 2.0**30).astype(np.int64)


def _half_way(a: Steps, b: Steps) -> Steps:
    x, y, z = ((i + j) // 2 for i, j in zip(a, b, strict=True))
    return x, y, z


def _exchange(along: Steps, axes: tuple[int, int]) -> Steps:
    own, (i, j) = list(along), axes
    own[i], own[j] = own[j], own[i]
    return own[0], own[1], own[2]


def _mirror(at: Steps, axis: int, last: int) -> Steps:
    x, y, z = (last - k if i == axis else k for i, k in enumerate(at))
    return x, y, z


def _raise_along(m: MultiIndex, axis: int) -> MultiIndex:
    x, y, z = (order + (i == axis) for i, order in enumerate(m))
    return x, y, z


@cache
def _derivative_weights(slopes: tuple[tuple[float, ...], ...], degree: int, along: MultiIndex) -> dict[Index, float]:
    """D^m s = n!/(n − r)! Σ_(k_1 … k_r) Π ∂_(i_j) λ_(k_j) · c_(e_k1 + … + e_kr), c of degree r = |m|: its weights."""
    axes = [axis for axis, order in enumerate(along) for _ in range(order)]
    weights: dict[Index, float] = {}
    for vertices in product(range(4), repeat=len(axes)):
        alpha = tuple(vertices.count(k) for k in range(4))
        weights[alpha] = weights.get(alpha, 0.0) + math.prod(slopes[k][i] for k, i in zip(vertices, axes, strict=True))
    return {alpha: math.perm(degree, len(axes)) * w for alpha, w in weights.items() if w}


@cache
def _steps(degree: int) -> tuple[tuple[int, ...], ...]:
    """For every |β| = degree − 1 the numbers of β + e_0 … β + e_3 among those of the degree."""
    numbers = {alpha: i for i, alpha in enumerate(bernstein_indices(degree, 3))}
    raised = (
        tuple(tuple(b + (i == k) for i, b in enumerate(beta)) for k in range(4))
        for beta in bernstein_indices(degree - 1, 3)
    )
    return tuple(tuple(numbers[alpha] for alpha in row) for row in raised)


@dataclass(frozen=True)
class Turned:
    """Points brought into the cone, and how.

    Attributes:
        negative: masks along x, y, z: where u < 0.
        exchanged: masks of `_EXCHANGES`.
        shapes: masks of the shapes but the first; a point is in the last of those that hold for it, or in the first.
        barycentric: λ_0 … λ_3.
        nothing: 0, or NaN where the point is.
    """

    negative: list[Value]
    exchanged: list[Value]
    shapes: list[Value]
    barycentric: list[Value]
    nothing: Value


def at_centre(arithmetic: Arithmetic, block: Block) -> Rows:
    """Eight times the value and four times the gradient at the centre of 2³ samples."""
    total, rows = None, {}
    for axis, unit in enumerate(UNITS):
        ends: list[Value] = [None, None]
        for at, sample in block.items():
            own = ends[at[axis]]
            ends[at[axis]] = sample if own is None else arithmetic.add(own, sample)
        rows[unit] = arithmetic.subtract(ends[1], ends[0])
        total = arithmetic.add(ends[0], ends[1]) if total is None else total
    return {(0, 0, 0): total, **rows}


def trend_of(arithmetic: Arithmetic, at: Callable[[Steps], Value]) -> Rows:
    """Coefficients of `QUADRATICS` of t, which is near the spline in the cube about a sample.

    Of samples of a quadratic q the spline is q + Δq / 8, and so is t. Second derivatives are differences of samples; a
    slope is ¼ of the central difference in the middle and 3/16 of each of the four beside it: of samples of x y² the
    spline is about x y² + x / 4, to which 3/8 x is nearest.

    Args:
        at: samples by their steps from the one in the middle.
    """
    e, middle = arithmetic, at((0, 0, 0))
    number, slopes, rows = middle, {}, {}
    for unit in UNITS:
        ahead, behind = at(unit), at(_moved_by(unit, unit, -2))
        slopes[unit] = e.multiply(e.subtract(ahead, behind), e.constant(1 / 8))
        rows[_moved_by(unit, unit)] = bend = e.subtract(e.multiply(e.add(ahead, behind), e.constant(1 / 2)), middle)
        number = e.multiply_add(bend, e.constant(1 / 4), number)
    for first, second in combinations(UNITS, 2):
        corner, beside = _moved_by(first, second), _moved_by(first, second, -1)
        (a, b), (c, d) = ((at(x), at(_moved_by(x, x, -2))) for x in (corner, beside))
        diagonals = e.subtract(a, b), e.subtract(c, d)
        for unit, write in ((first, e.add), (second, e.subtract)):
            slopes[unit] = e.multiply_add(write(*diagonals), e.constant(3 / 32), slopes[unit])
        rows[corner] = e.multiply(e.subtract(e.add(a, b), e.add(c, d)), e.constant(1 / 4))
    return {(0, 0, 0): number, **slopes, **rows}


def _moved_by(at: Steps, by: Steps, times: int = 1) -> Steps:
    x, y, z = (i + times * j for i, j in zip(at, by, strict=True))
    return x, y, z


class Sum:
    """Writes the sums of a stencil.

    Args:
        arithmetic: what they are written in.
        stencil: what is summed.
    """

    def __init__(self, arithmetic: Arithmetic, stencil: TetrahedralStencil) -> None:
        self.arithmetic, self.stencil, self.spline = arithmetic, stencil, stencil.spline
        x = range(self.spline.size)
        self.places: list[Steps] = [(i, j, k) for k in x for j in x for i in x]

    # --- where points are ---

    def cells(self, points: Sequence[Value]) -> list[Value]:
        """The index of the cell of every point, a whole number along each axis."""
        e = self.arithmetic
        if not self.spline.octahedral:
            return [e.floor(e.add(x, e.constant(0.5))) for x in points]
        y = [e.subtract(x, e.constant(0.5)) for x in points]
        even = [self._doubled(e.floor(e.multiply_add(own, e.constant(0.5), e.constant(0.5)))) for own in y]
        odd = [e.add(self._doubled(e.floor(e.multiply(own, e.constant(0.5)))), e.constant(1)) for own in y]
        distance = None
        for own, centre in zip(y, even, strict=True):
            away = e.absolute(e.subtract(own, centre))
            distance = away if distance is None else e.add(distance, away)
        beyond = e.less(e.constant(1.5), distance)
        return [e.where(beyond, b, a) for a, b in zip(even, odd, strict=True)]

    def _doubled(self, a: Value) -> Value:
        return self.arithmetic.add(a, a)

    def local(self, point: Value, cell: Value) -> Value:
        """u along an axis."""
        e = self.arithmetic
        u = e.subtract(point, cell)
        return e.subtract(u, e.constant(0.5)) if self.spline.octahedral else u

    def turn(self, u: Sequence[Value], negative: Sequence[Value] | None = None) -> Turned:
        """Bring points into the cone.

        Args:
            u: along x, y, z.
            negative: which sides they belong to, also those with u = 0; None: it does not matter.
        """
        e = self.arithmetic
        nothing = None
        for own in u:
            nothing = e.multiply_add(own, e.constant(0), nothing)
        sides = [e.less(x, e.constant(0)) for x in u] if negative is None else list(negative)
        place, exchanged = [e.where(side, e.negate(x), x) for side, x in zip(sides, u, strict=True)], []
        for i, j in _EXCHANGES:
            mask = e.less(place[i], place[j])
            exchanged.append(mask)
            place[i], place[j] = e.where(mask, place[j], place[i]), e.where(mask, place[i], place[j])
        shapes, barycentric = self._chosen(self._every_barycentric(place))
        return Turned(sides, exchanged, shapes, barycentric, nothing)

    def barycentric(self, turned: Turned, u: Sequence[Value]) -> list[Value]:
        """λ of other points, in the tetrahedra of those that were turned."""
        e = self.arithmetic
        signed = [e.where(negative, e.negate(x), x) for negative, x in zip(turned.negative, u, strict=True)]
        every = self._every_barycentric(self.along_cone(turned, signed))
        return [self.by_shape(turned, own) for own in zip(*every, strict=True)]

    def _every_barycentric(self, place: Sequence[Value]) -> list[list[Value]]:
        """λ of places in the cone, in each of the shapes."""
        return [[self._affine(row, place) for row in shape] for shape in self.spline.barycentric]

    def _affine(self, row: Sequence[float], place: Sequence[Value]) -> Value:
        e, total = self.arithmetic, None
        for slope, x in zip(row[1:], place, strict=True):
            if slope:
                total = e.multiply_add(x, e.constant(slope), e.constant(row[0]) if total is None else total)
        return total

    def _chosen(self, every: list[list[Value]]) -> tuple[list[Value], list[Value]]:
        """Of every shape's λ: masks of the shapes but the first, and the λ of the one with the largest least λ."""
        e, (barycentric, *others) = self.arithmetic, every
        least, better = self._least(barycentric), []
        for other in others:
            own = self._least(other)
            mask = e.less(least, own)
            least = e.where(mask, own, least)
            barycentric = [e.where(mask, b, a) for a, b in zip(barycentric, other, strict=True)]
            better.append(mask)
        return better, barycentric

    def _least(self, numbers: Sequence[Value]) -> Value:
        e, (least, *others) = self.arithmetic, numbers
        for other in others:
            least = e.where(e.less(other, least), other, least)
        return least

    def by_shape(self, turned: Turned, values: Sequence[Value]) -> Value:
        """Of one value for every shape that of the point's own; values that are the same thing are chosen once."""
        chosen = values[0]
        for mask, value in zip(turned.shapes, values[1:], strict=True):
            chosen = chosen if value is chosen else self.arithmetic.where(mask, value, chosen)
        return chosen

    def along_cone(self, turned: Turned, space: Sequence[Value]) -> list[Value]:
        """What belongs to the axes of space, in the order of the cone's."""
        along, e = list(space), self.arithmetic
        for mask, (i, j) in zip(turned.exchanged, _EXCHANGES, strict=True):
            along[i], along[j] = e.where(mask, along[j], along[i]), e.where(mask, along[i], along[j])
        return along

    # --- between the axes of the cone and those of space: what is known by three numbers, one for each axis ---

    def _sorted(self, rows: Rows, turned: Turned) -> Rows:
        """By axes of space, the signs settled: by axes of the cone."""
        for mask, axes in zip(turned.exchanged, _EXCHANGES, strict=True):
            rows = self._exchanged(rows, mask, axes)
        return rows

    def _unsorted(self, rows: Rows, turned: Turned) -> Rows:
        """The inverse."""
        for mask, axes in zip(reversed(turned.exchanged), reversed(_EXCHANGES), strict=True):
            rows = self._exchanged(rows, mask, axes)
        return rows

    def _exchanged(self, rows: Rows, mask: Value, axes: tuple[int, int]) -> Rows:
        return {m: self._either(mask, rows, _exchange(m, axes), m) for m in rows}

    def _mirrored(self, block: Block, turned: Turned) -> Block:
        """Turned round along the axes of space along which u is negative; its own inverse."""
        last = self.spline.size - 1
        for axis, negative in enumerate(turned.negative):
            block = {at: self._either(negative, block, _mirror(at, axis, last), at) for at in block}
        return block

    def _either(self, mask: Value, values: Mapping[Steps, Value], a: Steps, b: Steps) -> Value:
        """Of a where the mask holds, else of b; None where there is neither."""
        e, first, second = self.arithmetic, values[a], values[b]
        if first is second:
            return second
        first, second = (e.constant(0) if own is None else own for own in (first, second))
        return e.where(mask, first, second)

    def _signed(self, rows: Rows, turned: Turned) -> Rows:
        return {m: self._with_signs(row, m, turned) for m, row in rows.items()}

    def _with_signs(self, row: Value, m: MultiIndex, turned: Turned) -> Value:
        for axis, order in enumerate(m):
            if order % 2:
                row = self.arithmetic.where(turned.negative[axis], self.arithmetic.negate(row), row)
        return row

    # --- the sums ---

    def contract(self, blocks: Sequence[Block], turned: Turned) -> list[Value]:
        """The rows of the stencil, from blocks of samples along the axes of space."""
        e, rows, pieces = self.arithmetic, {}, self._coefficients(blocks, turned)
        for order in range(self.spline.degree, -1, -1):
            if order < self.spline.degree:
                pieces = [self._step(pieces, row, turned.barycentric) for row in _steps(order + 1)]
            if order in self.stencil.orders:
                rows |= {m: self._derivative(pieces, m, turned) for m in self.stencil.rows if sum(m) == order}
        found = self._signed(self._unsorted(rows, turned), turned)
        return [e.add(found[m], turned.nothing) if m in found else turned.nothing for m in self.stencil.rows]

    def restrict(
        self, blocks: Sequence[Block], turned: Turned, start: Sequence[Value], end: Sequence[Value]
    ) -> list[Value]:
        """The n + 1 Bernstein coefficients of the value between two points, λ in the tetrahedra of those turned.

        They are the blossom n − j times at the start and j times at the end, for j = 0 … n.
        """
        degree = self.spline.degree
        found = {(0, 0): self._coefficients(blocks, turned)}

        def blossom(a: int, b: int) -> list[Value]:
            if (a, b) not in found:  # of both the one that is asked more often comes first: fewer are needed
                at_end = a == 0 or 0 < b <= a
                before, weights = (blossom(a, b - 1), end) if at_end else (blossom(a - 1, b), start)
                found[a, b] = [self._step(before, row, weights) for row in _steps(degree - a - b + 1)]
            return found[a, b]

        return [blossom(degree - j, j)[0] for j in range(degree + 1)]

    def _coefficients(self, blocks: Sequence[Block], turned: Turned) -> list[Value]:
        along = [self._along_cone(block, turned) for block in blocks]
        inputs = [along[block][at] for block, at in self.spline.inputs]
        steps, shared = self.spline.shared
        for first, second, sign in steps:
            inputs.append(
                (self.arithmetic.add if sign > 0 else self.arithmetic.subtract)(inputs[first], inputs[second])
            )
        masks = [self.weighted(mask, inputs) for mask in shared]
        return [self.by_shape(turned, [masks[r] for r in own]) for own in zip(*self.spline.rows, strict=True)]

    def _along_cone(self, block: Block, turned: Turned) -> Rows:
        if self.spline.size == 2:
            return self._sorted(self._signed(at_centre(self.arithmetic, block), turned), turned)
        return self._sorted(self._mirrored(block, turned), turned)

    def _from_centre(self, rows: Rows) -> Block:
        """The transpose."""
        e, block = self.arithmetic, {}
        for at in self.places:
            total = rows[0, 0, 0]
            for axis, unit in enumerate(UNITS):
                total = (e.add if at[axis] else e.subtract)(total, rows[unit])
            block[at] = total
        return block

    def weighted(self, weights: Sequence[float], values: Sequence[Value]) -> Value:
        """Σ weight · value; None where there is no weight."""
        e, total = self.arithmetic, None
        for weight, value in zip(weights, values, strict=True):
            if weight and value is not None:
                total = e.multiply_add(value, e.constant(weight), total)
        return total

    def _step(self, pieces: Sequence[Value], numbers: Sequence[int], barycentric: Sequence[Value]) -> Value:
        total = None
        for number, weight in zip(numbers, barycentric, strict=True):
            total = self.arithmetic.multiply_add(weight, pieces[number], total)
        return total

    def _derivative(self, pieces: Sequence[Value], m: MultiIndex, turned: Turned) -> Value:
        if sum(m) == 0:
            return pieces[0]
        every = [self.weighted(row, pieces) for row in self._derivatives(m)]
        return self.by_shape(turned, [self.arithmetic.constant(0) if own is None else own for own in every])

    def _derivatives(self, m: MultiIndex) -> list[list[float]]:
        """For every shape the weights of the coefficients of degree |m|."""
        indices, degree = bernstein_indices(sum(m), 3), self.spline.degree
        slopes = [tuple(row[1:] for row in shape) for shape in self.spline.barycentric]
        found = [_derivative_weights(own, degree, m) for own in slopes]
        return [[weights.get(alpha, 0.0) for alpha in indices] for weights in found]

    def spread(self, cotangents: Sequence[Value], turned: Turned) -> list[Block]:
        """The transpose of `contract`: what is added to blocks of samples; None where that is nothing."""
        units = ((0, 0, 0), *UNITS) if self.spline.size == 2 else self.places
        along: list[Rows] = [dict.fromkeys(units) for _ in self.spline.centres]  # type: ignore[misc]
        for (block, at), value in zip(self.spline.inputs, self._spread_inputs(cotangents, turned), strict=True):
            along[block][at] = value
        return [self._from_cone(own, turned) for own in along]

    def _from_cone(self, along: Rows, turned: Turned) -> Block:
        if self.spline.size == 2:
            zero = self.arithmetic.constant(0)
            whole = {m: zero if row is None else row for m, row in along.items()}
            return self._from_centre(self._signed(self._unsorted(whole, turned), turned))
        return self._mirrored(self._unsorted(along, turned), turned)

    def _spread_inputs(self, cotangents: Sequence[Value], turned: Turned) -> list[Value]:
        degree = self.spline.degree
        given = {m: own for m, own in zip(self.stencil.rows, cotangents, strict=True) if sum(m) <= degree}
        rows = self._sorted(self._signed(given, turned), turned)
        pieces: list[Value] = [None]
        for order in range(degree + 1):
            if order:
                pieces = self._step_back(pieces, order, turned.barycentric)
            for m, row in rows.items():
                if sum(m) == order:
                    self._derivative_back(pieces, row, m, turned)
        masks: list[Value] = [None] * len(self.spline.masks)
        for piece, own in zip(pieces, zip(*self.spline.rows, strict=True), strict=True):
            if piece is not None:
                for r, part in self._to_shapes(piece, own, turned):
                    self._add(masks, r, part)
        steps, shared = self.spline.shared
        inputs = [self.weighted(column, masks) for column in zip(*shared, strict=True)]
        for first, second, sign in reversed(steps):
            own = inputs.pop()
            if own is not None:
                self._add(inputs, first, own)
                self._add(inputs, second, own if sign > 0 else self.arithmetic.negate(own))
        return inputs

    def _add(self, sums: list[Value], place: int, value: Value) -> None:
        sums[place] = value if sums[place] is None else self.arithmetic.add(sums[place], value)

    def _step_back(self, pieces: Sequence[Value], degree: int, barycentric: Sequence[Value]) -> list[Value]:
        raised: list[Value] = [None] * len(bernstein_indices(degree, 3))
        for piece, numbers in zip(pieces, _steps(degree), strict=True):
            if piece is not None:
                for number, weight in zip(numbers, barycentric, strict=True):
                    raised[number] = self.arithmetic.multiply_add(weight, piece, raised[number])
        return raised

    def _derivative_back(self, pieces: list[Value], row: Value, m: MultiIndex, turned: Turned) -> None:
        e = self.arithmetic
        if sum(m) == 0:
            return self._add(pieces, 0, row)
        every = self._derivatives(m)
        for shape, part in self._to_shapes(row, range(len(every)), turned):
            for place, weight in enumerate(every[shape]):
                if weight:
                    pieces[place] = e.multiply_add(part, e.constant(weight), pieces[place])
        return None

    def _to_shapes(self, value: Value, own: Sequence[int], turned: Turned) -> list[tuple[int, Value]]:
        """The transpose of `by_shape`, of shapes that are these numbers: the value for its own, 0 for the others."""
        e, parts, left = self.arithmetic, [], value
        if len(set(own)) == 1:
            return [(own[0], value)]
        for mask, number in zip(reversed(turned.shapes), reversed(own[1:]), strict=True):
            parts.append((number, e.where(mask, left, e.constant(0))))
            left = e.where(mask, e.constant(0), left)
        return [*parts, (own[0], left)]
