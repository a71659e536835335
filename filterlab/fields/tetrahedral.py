"""Splines on tetrahedra: locate ▶ the samples a tetrahedron needs ▶ Bernstein coefficients ▶ value and derivatives.

A partition cuts space into cells that are alike (cubes, truncated octahedra), and each cell into tetrahedra that meet
in its centre. Signed permutations of the axes about a centre map the cell's tetrahedra onto one another. One of them
brings a point into the cone x ≥ y ≥ z ≥ 0, where there are few tetrahedra: the spline's `Shape`s, with one exact mask
for every Bernstein coefficient. With P the signed permutation that leads back from there,

    s(centre + P x) = Σ_|α|=n  b_α · n!/α! · λ(x)^α,        b_α = Σ_o mask_α(o) · f(centre + P o)

x in the cone, λ its barycentric coordinates, o where samples lie. Nothing else need be known to evaluate it.

Under a boundary the samples go on to all integers, and the partition with them: it is not reflected. So points are
moved by whole periods alone, of samples and partition both, and samples are found by tables of indices.

Letters: P points, C channels; S shapes, K samples that one tetrahedron needs, B coefficients of one. The last axis runs
over points.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from itertools import permutations, product
from typing import TypeVar

import numpy as np
import torch
from torch import Tensor

from filterlab import bernstein, ops
from filterlab.bernstein import Index, multi_indices
from filterlab.fields.grid import NO_AXIS, Axes, Coefficients, Evaluation, Term, implementation_of
from filterlab.geometry import Geometry
from filterlab.ops.differentiable.recording import plain, transformed
from filterlab.ops.place import InWorld, Placement
from filterlab.ops.reference.place import far_voxels
from filterlab.ops.tetrahedra import Tetrahedra, TetrahedralStencil
from filterlab.volume import Boundary, all_between

Vector = tuple[Fraction, Fraction, Fraction]

Mask = Mapping[Vector, Fraction]
"""Where samples lie, relative to the centre of a cell -> their weights."""


Key = TypeVar("Key", bound=Hashable)


Jets = Mapping[tuple[tuple[int, int, int], int], Fraction]
"""A centre, and which of (f, ∂_x f, ∂_y f, ∂_z f) there -> its weight."""

Weights = Mapping[tuple[int, tuple[int, int, int]], Fraction]
"""One of `Tetrahedra.inputs` -> its weight."""


def weighted(*parts: tuple[Fraction, Mapping[Key, Fraction]]) -> dict[Key, Fraction]:
    """Σ factor · mask, without the samples whose weights cancel."""
    total: dict[Key, Fraction] = {}
    for factor, mask in parts:
        for sample, weight in mask.items():
            total[sample] = total.get(sample, Fraction(0)) + factor * weight
    return {sample: weight for sample, weight in total.items() if weight}


Coordinate = TypeVar("Coordinate", int, float, Fraction)


@dataclass(frozen=True)
class Turn:
    """A signed permutation of the axes: what it makes of v has sign_a · v_rank(a) along axis a of space.

    Attributes:
        ranks: axis a of space is this one of the cone.
        signs: along the axes of space.
    """

    ranks: tuple[int, ...]
    signs: tuple[int, ...]

    def __call__(self, v: tuple[Coordinate, Coordinate, Coordinate]) -> tuple[Coordinate, Coordinate, Coordinate]:
        x, y, z = (sign * v[rank] for rank, sign in zip(self.ranks, self.signs, strict=True))
        return x, y, z


TURNS = tuple(Turn(ranks, signs) for ranks in permutations(range(3)) for signs in product((1, -1), repeat=3))
"""All 48."""


@dataclass(frozen=True, eq=False)
class Shape:
    """A tetrahedron that fills a part of the cone x ≥ y ≥ z ≥ 0, and the spline on it.

    Attributes:
        vertices: v_0 … v_3, relative to the centre of the cell.
        masks: for every multi-index α of the degree n, of the domain point Σ α_k v_k / n, its coefficient's samples.
    """

    vertices: tuple[Vector, Vector, Vector, Vector]
    masks: Mapping[Index, Mask]

    def row(self, alpha: Index, samples: Sequence[Vector]) -> tuple[float, ...]:
        """The weights of a mask, of all of these samples."""
        return tuple(float(self.masks[alpha].get(o, 0)) for o in samples)

    @cached_property
    def barycentric(self) -> tuple[tuple[Fraction, ...], ...]:
        """4 rows (d, n) with λ_k(x) = d + n · x: 1 at v_k, 0 on the plane of the other three."""
        return tuple(_plane(self.vertices[k], *(v for i, v in enumerate(self.vertices) if i != k)) for k in range(4))


def _plane(apex: Vector, a: Vector, b: Vector, c: Vector) -> tuple[Fraction, ...]:
    """(d, n) with d + n · x = 1 at the apex and 0 at a, b, c."""
    (x, y, z), (u, v, w) = (tuple(p - q for p, q in zip(end, a, strict=True)) for end in (b, c))
    normal = (y * w - z * v, z * u - x * w, x * v - y * u)
    height = sum((n * (p - q) for n, p, q in zip(normal, apex, a, strict=True)), Fraction(0))
    level = sum((n * p for n, p in zip(normal, a, strict=True)), Fraction(0))
    return -level / height, *(n / height for n in normal)


@dataclass(frozen=True, eq=False)
class Spline:
    """A spline on the tetrahedra of a partition.

    Attributes:
        name: of the spline.
        degree: n.
        shapes: the tetrahedra that fill the cone's part of a cell; all of them need the same samples.
        cells: voxel coordinates (..., 3) -> the cell of each, (..., 3) whole numbers of the same type.
        shift: the centre of a cell lies at cell + shift along every axis: 0 or ½.
        period: how far the partition has to be moved along an axis to lie on itself: 1 or 2.
        centres, size: of the cubes of size³ samples that all tetrahedra of the cone need, relative to the centre.
        jets: for every shape its coefficients by value and gradient at these centres, of cubes of 2³ samples.

    Raises ValueError where a shape has not a mask for every coefficient, or not the samples of the others.
    """

    name: str
    degree: int
    shapes: tuple[Shape, ...]
    cells: Callable[[Tensor], Tensor]
    shift: Fraction
    period: int
    centres: tuple[tuple[int, int, int], ...]
    size: int
    jets: tuple[Mapping[Index, Jets], ...] | None = None

    def __post_init__(self) -> None:
        for shape in self.shapes:
            if set(shape.masks) != set(multi_indices(self.degree, 3)):
                raise ValueError(f"{self.name}: expected a mask for every coefficient of degree {self.degree}")
            if {o for mask in shape.masks.values() for o in mask} != set(self.samples):
                raise ValueError(f"{self.name}: its tetrahedra need different samples")

    @cached_property
    def samples(self) -> tuple[Vector, ...]:
        """Where the samples lie that one tetrahedron needs, relative to the centre."""
        return tuple(sorted({o for mask in self.shapes[0].masks.values() for o in mask}))

    @cached_property
    def support(self) -> int:
        """Twice the farthest that a point is from a sample that it needs, along an axis."""
        corners = [v for shape in self.shapes for v in shape.vertices]
        return math.ceil(2 * max(abs(o[i] - v[i]) for o in self.samples for v in corners for i in range(3)))

    @cached_property
    def norm(self) -> Fraction:
        """max_α Σ_o |mask_α(o)|: no value is larger than this times the largest sample."""
        return max(sum(map(abs, mask.values()), Fraction(0)) for s in self.shapes for mask in s.masks.values())

    @cached_property
    def tetrahedra(self) -> tuple[tuple[int, Turn], ...]:
        """All of a cell, each once: the number of the shape that is turned, and how."""
        found: dict[frozenset[Vector], tuple[int, Turn]] = {}
        for number, shape in enumerate(self.shapes):
            for turn in TURNS:
                found.setdefault(frozenset(map(turn, shape.vertices)), (number, turn))
        return tuple(found.values())

    @cached_property
    def tables(self) -> Tables:
        """All of it in numbers, on the CPU."""
        return Tables.of(self)

    @cached_property
    def lowered(self) -> Tetrahedra:
        """All of it as `ops` sums it."""
        indices = multi_indices(self.degree, 3)
        inputs = sorted({key for rule in self._rules for mask in rule.values() for key in mask})
        masks: dict[tuple[float, ...], int] = {}
        weights = [[tuple(float(rule[a].get(key, 0)) for key in inputs) for a in indices] for rule in self._rules]
        rows = tuple(tuple(masks.setdefault(own, len(masks)) for own in shape) for shape in weights)
        return Tetrahedra(
            octahedral=self.period == 2,
            degree=self.degree,
            centres=self.centres,
            size=self.size,
            inputs=tuple(inputs),
            masks=tuple(masks),
            rows=rows,
            barycentric=tuple(tuple(tuple(map(float, row)) for row in s.barycentric) for s in self.shapes),
            norm=float(self.norm),
            cuts=tuple((normal, float(d)) for normal, d in sorted(self._cuts())),
        )

    @property
    def _rules(self) -> list[Mapping[Index, Weights]]:
        """For every shape its coefficients, of the numbers that `Tetrahedra.inputs` describes."""
        if self.jets is not None:
            return [{a: self._of_jets(jets) for a, jets in rules.items()} for rules in self.jets]
        return [{a: {(0, _place(o)): w for o, w in mask.items()} for a, mask in s.masks.items()} for s in self.shapes]

    def _of_jets(self, jets: Jets) -> Weights:
        numbers = {centre: number for number, centre in enumerate(self.centres)}
        parts = ((0, 0, 0), 8), ((1, 0, 0), 4), ((0, 1, 0), 4), ((0, 0, 1), 4)
        return {(numbers[c], parts[n][0]): weight / parts[n][1] for (c, n), weight in jets.items()}

    def _cuts(self) -> set[tuple[Normal, Fraction]]:
        """The planes of faces within the cube about the sample 0, in which no tetrahedron lies partly."""
        half, found = Fraction(1, 2), set()
        for number, turn, shift in self._about_sample:
            for row in self.shapes[number].barycentric:
                normal, d = primitive(row)
                normal = turn(normal)
                plane = upright(normal, sum(normal) * shift - d)
                if sum(map(abs, normal)) > 1 or abs(plane[1]) < half:
                    found.add(plane)
        return found

    @cached_property
    def _about_sample(self) -> list[tuple[int, Turn, Fraction]]:
        """Which tetrahedra fill the cube about the sample 0, and the place of their cells' centres along every axis."""
        return [
            (number, turn, shift)
            for (number, turn), shift in product(self.tetrahedra, sorted({self.shift, -self.shift}))
            if all(abs(c + shift) <= Fraction(1, 2) for v in self.shapes[number].vertices for c in turn(v))
        ]


def _place(sample: Vector) -> tuple[int, int, int]:
    """In the block of 3³ about the centre."""
    x, y, z = (int(o) + 1 for o in sample)
    return x, y, z


Normal = tuple[int, int, int]


def primitive(row: tuple[Fraction, ...]) -> tuple[Normal, Fraction]:
    """(n, d) of d + n · x, with integers n that have no factor in common."""
    d, *slopes = row
    factor = Fraction(math.lcm(*(s.denominator for s in slopes)), math.gcd(*(s.numerator for s in slopes)))
    x, y, z = (int(factor * s) for s in slopes)
    return (x, y, z), factor * d


def upright(normal: Normal, d: Fraction) -> tuple[Normal, Fraction]:
    """The same plane n · x = d, of both normals the greater."""
    x, y, z = normal
    return max((normal, d), ((-x, -y, -z), -d), key=lambda plane: plane[0])


# --- the spline in numbers --------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class Tables:
    """A spline as tensors.

    Attributes:
        axes: (3, 8), the cone's axes in space's, for every outcome of `_outcome`; ranks: space's in the cone's.
        pairs: (9,), of a pair of axes, 3 i + j, the row of a Hessian's xx, xy, xz, yy, yz, zz.
        barycentric: (S, 4, 4), see `Shape.barycentric`.
        masks: (R, K), those that differ, in the order of `Spline.samples`.
        rows: (B, S), which of them a shape's coefficients are, in the order of `multi_indices`.
        derivatives: of order r = 0, 1, 2: (S·J, B_r), from coefficients of degree r to the J rows of that order, along
            the axes of the cone.
        ahead, behind: for each axis of the cone the distinct coordinates of samples, as steps of the index from the
            cell's along an axis that has, or has not, its direction.
        which: for each axis of the cone (K,), which of these every sample has.
    """

    axes: Tensor
    ranks: Tensor
    pairs: Tensor
    barycentric: Tensor
    masks: Tensor
    rows: Tensor
    derivatives: tuple[Tensor, ...]
    ahead: tuple[Tensor, ...]
    behind: tuple[Tensor, ...]
    which: tuple[Tensor, ...]

    @classmethod
    def of(cls, spline: Spline) -> Tables:
        indices = multi_indices(spline.degree, 3)
        distinct: dict[tuple[float, ...], int] = {}
        rows = [[distinct.setdefault(s.row(a, spline.samples), len(distinct)) for s in spline.shapes] for a in indices]
        barycentric = np.array([shape.barycentric for shape in spline.shapes], dtype=np.float64)
        along = [sorted({o[axis] for o in spline.samples}) for axis in range(3)]
        orders = torch.tensor(_orders()).T
        return cls(
            orders,
            orders.argsort(0),
            torch.tensor([0, 1, 2, 1, 3, 4, 2, 4, 5]),
            torch.tensor(barycentric),
            torch.tensor(list(distinct), dtype=torch.float64),
            torch.tensor(rows),
            tuple(torch.tensor(_derivative_rows(barycentric, spline.degree, order)) for order in range(3)),
            tuple(torch.tensor([int(spline.shift + o) for o in row]) for row in along),
            tuple(torch.tensor([int(spline.shift - o) for o in row]) for row in along),
            tuple(torch.tensor([along[axis].index(o[axis]) for o in spline.samples]) for axis in range(3)),
        )

    def to(self, device: torch.device) -> Tables:
        """Copies on a device: of tables that were made in inference mode too, which autograd could not keep."""

        def moved(tensors: tuple[Tensor, ...]) -> tuple[Tensor, ...]:
            return tuple(t.to(device, copy=True) for t in tensors)

        axes, ranks, pairs, barycentric, masks, rows = moved(
            (self.axes, self.ranks, self.pairs, self.barycentric, self.masks, self.rows)
        )
        derivatives, ahead, behind, which = map(moved, (self.derivatives, self.ahead, self.behind, self.which))
        return Tables(axes, ranks, pairs, barycentric, masks, rows, derivatives, ahead, behind, which)


def _orders() -> list[tuple[int, int, int]]:
    """The axes by decreasing |coordinate|, for every `_outcome`; for what cannot be as they are."""
    rows = [(0, 1, 2)] * 8
    for x, y, z in product(range(3), repeat=3):
        order = sorted(range(3), key=lambda axis: (-(x, y, z)[axis], axis))
        rows[4 * (x < y) + 2 * (y < z) + (x < z)] = (order[0], order[1], order[2])
    return rows


def _derivative_rows(barycentric: np.ndarray, degree: int, order: int) -> np.ndarray:
    """(S·J, B_r): D^i s = n!/(n − r)! Σ_(k_1 … k_r) Π ∂_(i_j) λ_(k_j) · c_(e_k1 + … + e_kr), c of degree r."""
    place = {alpha: b for b, alpha in enumerate(multi_indices(order, 3))}
    axes = [pair for pair in product(range(3), repeat=order) if list(pair) == sorted(pair)]
    rows = np.zeros((len(barycentric), len(axes), len(place)))
    for (s, slopes), (j, along) in product(enumerate(barycentric[..., 1:]), enumerate(axes)):
        for vertices in product(range(4), repeat=order):
            alpha = tuple(vertices.count(k) for k in range(4))
            rows[s, j, place[alpha]] += math.prod(slopes[k, i] for k, i in zip(vertices, along, strict=True))
    return math.perm(degree, order) * rows.reshape(-1, len(place))


# --- where points are -------------------------------------------------------------------------------------------------


def _outcome(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """Of comparing |coordinates|: 4 for x < y, 2 for y < z, 1 for x < z."""
    return 4 * (x < y).long() + 2 * (y < z) + (x < z)


@dataclass(frozen=True, eq=False)
class Located:
    """Where points are.

    Attributes:
        cell: (3, P) integers.
        axes: (3, P), axis i of the cone is this one of space; ranks: the inverse.
        sign: (3, P) of the local coordinates, along the axes of space: −1 or 1.
        shape: (P,), which one; None where there is but one.
        barycentric: λ (4, P).
    """

    cell: Tensor
    axes: Tensor
    ranks: Tensor
    sign: Tensor
    shape: Tensor | None
    barycentric: Tensor


def locate(spline: Spline, tables: Tables, voxels: Tensor, dtype: torch.dtype) -> Located:
    """Where voxel coordinates (P, 3) are; local coordinates are taken in their type, and all others in `dtype`."""
    cell = spline.cells(voxels.detach())
    local = (voxels - (cell + float(spline.shift))).to(dtype).T
    outcome = _outcome(*local.abs())
    axes, ranks = tables.axes.index_select(1, outcome), tables.ranks.index_select(1, outcome)
    sign = torch.where(local < 0, -1, 1).to(dtype)
    a, b, c = (local * sign).gather(0, axes)
    m = tables.barycentric.to(dtype)[..., None]
    every = m[:, :, 0] + m[:, :, 1] * a + m[:, :, 2] * b + m[:, :, 3] * c  # (S, 4, P)
    shape = every.detach().amin(1).argmax(0) if len(every) > 1 else None
    return Located(cell.long().T, axes, ranks, sign, shape, _of_shape(every, shape))


def _of_shape(every: Tensor, shape: Tensor | None) -> Tensor:
    """(S, ..., P) to (..., P): of every point those of its own shape."""
    if shape is None:
        return every[0]
    return every.gather(0, shape.expand(1, *every.shape[1:]))[0]


@dataclass(frozen=True, eq=False)
class Folding:
    """Which sample stands where, under a boundary.

    Attributes:
        periods: of samples and partition both along x, y, z; None: samples are constant beyond the ends.
        ends: (3, 2) even numbers, beyond which points are told apart within one period of the partition only.
        period: of the partition.
        lookup: along x, then y, then z: what every index that a point can ask for adds to the flat index.
        zero: (3,), the place in `lookup` of index 0.
    """

    periods: Tensor | None
    ends: Tensor
    period: int
    lookup: Tensor
    zero: Tensor

    @classmethod
    def of(cls, coefficients: Coefficients, spline: Spline) -> Folding:
        device, boundary = coefficients.values.device, coefficients.boundary
        sizes, strides = coefficients.values.shape[:-4:-1], (1, coefficients.values.shape[-1])
        strides = (*strides, strides[1] * sizes[1])
        reach = spline.support + 1
        rows, zero, ends, periods, length = [], [], [], [], 0
        for n, size, stride, begin in zip(coefficients.size, sizes, strides, coefficients.first, strict=True):
            first = int(begin)
            if boundary.periodic:
                periods.append(math.lcm(round(boundary.period(n) or 0), spline.period))
                low, high = -periods[-1], periods[-1]
            else:
                low = -2 * math.ceil((coefficients.tail + reach) / 2)
                high = 2 * math.ceil((n - 1 + coefficients.tail + reach) / 2)
            ends.append((low, high))
            index = torch.arange(low - spline.period - reach, high + spline.period + reach + 1)
            if boundary.periodic:  # what is stored is read as programs read it: it may be rounded otherwise
                stored = (index >= first) & (index < first + size)
                index = torch.where(stored, index, boundary.source(index, n))
            rows.append(stride * (index - first).clamp(0, size - 1))
            zero.append(length + reach + spline.period - low)
            length += len(rows[-1])
        return cls(
            torch.tensor(periods, dtype=torch.float64, device=device) if boundary.periodic else None,
            torch.tensor(ends, dtype=torch.float64, device=device),
            spline.period,
            torch.cat(rows).to(device),
            torch.tensor(zero, device=device),
        )

    def near(self, points: Tensor, geometry: Geometry) -> Tensor:
        """Voxel coordinates of world points (..., 3), moved by whole periods to where `lookup` knows their samples.

        That is exact. Beyond the ends of border and zeros infinity is an even number, as all of the largest are; beyond
        2⁶⁰ voxels a coordinate has no derivative.
        """
        voxels = geometry.to_voxel(points)
        largest = torch.finfo(voxels.dtype).max
        if not (geometry.is_identity or (plain(points) and all_between(voxels, -largest, largest))):
            voxels = torch.where(voxels.isfinite(), voxels, far_voxels(points.detach(), geometry, self.periods))
        if self.periods is not None:
            return voxels.fmod(self.periods)
        voxels = torch.where(voxels.abs() > 2.0**60, 2.0**60 * voxels.sign(), voxels)
        (low, high), within = self.ends.T, voxels.fmod(self.period)
        return torch.where(voxels < low, low + within, torch.where(voxels > high, high + within, voxels))

    def flat(self, tables: Tables, at: Located) -> Tensor:
        """(K, P): the flat index of every sample that the points' tetrahedra need."""
        start = (self.zero[:, None] + at.cell).gather(0, at.axes)
        forwards = at.sign.gather(0, at.axes) > 0
        total: Tensor | None = None
        for axis in range(3):
            steps = torch.where(forwards[axis], tables.ahead[axis][:, None], tables.behind[axis][:, None])
            found = self.lookup.index_select(0, (start[axis] + steps).reshape(-1)).reshape(steps.shape)
            part = found.index_select(0, tables.which[axis])
            total = part if total is None else total + part
        assert total is not None
        return total


# --- the scheme -------------------------------------------------------------------------------------------------------

_BEYOND = 1
"""Voxels outside of the samples at both ends of an axis up to which programs evaluate: the domain goes to ½."""

AT_ONCE = 1 << 13
"""Points whose samples are read together: (K, P) numbers stay in cache."""
AT_ONCE_ON_A_GPU = 1 << 20


@dataclass(frozen=True)
class OnTetrahedra:
    """The sum over Bernstein coefficients, made of the samples for every point.

    `direct` computes it in plain torch, wherever points are; `fused` in vector code made for this processor, of points
    in the domain and a little beyond: others, and transforms of torch.func and torch.compile, it leaves to the former.

    Attributes:
        spline: what is summed.
        terms: none, the value is not separable.
        exact: not that of the terms.
        single: the axes of one voxel; what is constant along one gives what is not, as tetrahedra are, so that programs
            read as many coefficients there as elsewhere.
    """

    spline: Spline
    name: str = "direct"
    gradient: str = "analytic"
    max_order: int = 2
    terms: tuple[Term, ...] = ()
    exact: bool = False
    single: Axes = NO_AXIS

    def along(self, size: Sequence[int], boundary: Boundary) -> OnTetrahedra:
        """The same of a volume of so many voxels along x, y, z: axes of one that goes on as it is are single."""
        x, y, z = (n == 1 and boundary is not Boundary.ZEROS for n in size)
        return replace(self, single=(x, y, z))

    @property
    def reach(self) -> int:
        return _BEYOND + max(self.spline.lowered.reach)

    @property
    def around(self) -> int:
        return self.reach

    @property
    def period(self) -> int:
        return self.spline.period

    @cached_property
    def stencils(self) -> tuple[TetrahedralStencil, ...]:
        """What is summed for a jet of order 0, 1, … `max_order`."""
        return tuple(
            TetrahedralStencil(self.spline.lowered, tuple(range(order + 1))) for order in range(self.max_order + 1)
        )

    def evaluation(self, coefficients: Coefficients, placement: Placement, order: int) -> Evaluation:
        return self.evaluation_by(self.everywhere(coefficients, placement), coefficients, order)

    def evaluation_by(
        self, everywhere: JetOnTetrahedra, coefficients: Coefficients, order: int
    ) -> JetOnTetrahedra | FusedOnTetrahedra:
        """The same, of a jet of any order in plain torch: what it knows of samples under the boundary serves all."""
        everywhere = replace(everywhere, order=order)
        if self.name == "direct":
            return everywhere
        values, around = coefficients.values, replace(everywhere.placement, boundary=Boundary.BORDER, tail=_BEYOND)
        implementation = implementation_of(self.name, values.device)
        near = ops.Evaluation(values, around, self.stencils[order], coefficients.start, implementation)
        return FusedOnTetrahedra(near, everywhere)

    def everywhere(self, coefficients: Coefficients, placement: Placement) -> JetOnTetrahedra:
        """The jet of order 0 in plain torch."""
        tables = self.spline.tables.to(coefficients.values.device)
        folding = Folding.of(coefficients, self.spline)
        return JetOnTetrahedra(self.spline, tables, folding, coefficients.values, placement, 0)


@dataclass(frozen=True, eq=False)
class FusedOnTetrahedra:
    """A jet by programs where they know the samples, else in plain torch; see `Evaluation`.

    Attributes:
        near: of points up to `_BEYOND` voxels outside of the samples, which it does not fold; tells others by a sign 0.
        everywhere: of all points.
    """

    near: ops.Evaluation
    everywhere: JetOnTetrahedra

    def of(self, coefficients: Tensor) -> FusedOnTetrahedra:
        return FusedOnTetrahedra(self.near.of(coefficients), self.everywhere.of(coefficients))

    def in_world(self, points: Tensor, shape: Sequence[int]) -> InWorld | None:
        return self.near.in_world(points, shape, turned=False)

    def __call__(self, points: Tensor) -> tuple[Tensor, None]:
        if transformed():
            return self.everywhere(points)
        rows, sign = self.near(points)
        if sign is not None:
            beyond = (sign == 0).any(-1)  # (N, M)
            (some,) = beyond.any(0).nonzero(as_tuple=True)
            if len(some):
                folded = self.everywhere(points.index_select(1, some))[0]
                own = torch.where(beyond[:, None, None, some], folded, rows.index_select(-1, some))
                rows = rows.index_copy(-1, some, own)
        return rows, None


@dataclass(frozen=True, eq=False)
class JetOnTetrahedra:
    """The jet of a spline of coefficients `values` (N, C, D', H', W') at world points; see `Evaluation`."""

    spline: Spline
    tables: Tables
    folding: Folding
    values: Tensor
    placement: Placement
    order: int

    def of(self, coefficients: Tensor) -> JetOnTetrahedra:
        return replace(self, values=coefficients)

    def in_world(self, points: Tensor, shape: Sequence[int]) -> None:
        """Only by rows."""

    def __call__(self, points: Tensor) -> tuple[Tensor, None]:
        n, m = points.shape[:2]
        c = self.values.shape[1]
        flat = self.values.transpose(0, 1).reshape(c, n * math.prod(self.values.shape[2:]))
        at_once = AT_ONCE_ON_A_GPU if points.device.type == "cuda" else AT_ONCE
        parts = []
        for begin in range(0, max(n * m, 1), at_once):
            chunk = points.reshape(n * m, 3)[begin : begin + at_once]
            entry = torch.arange(begin, begin + len(chunk), device=points.device) // m if n > 1 else None
            parts.append(self._rows(flat, chunk, entry))
        out = torch.cat(parts, -1) if len(parts) > 1 else parts[0]
        return out.reshape(c, out.shape[1], n, m).permute(2, 0, 1, 3), None

    def _rows(self, flat: Tensor, points: Tensor, entry: Tensor | None) -> Tensor:
        """(C, J, P) of points (P, 3) of the entries (P,)."""
        voxels = self.folding.near(points.to(torch.float64), self.placement.geometry)
        unknown = voxels.isnan()
        at = locate(self.spline, self.tables, torch.where(unknown, 0.0, voxels), points.dtype)
        index = self.folding.flat(self.tables, at)
        if entry is not None:
            index = index + entry * math.prod(self.values.shape[2:])
        samples = flat.index_select(1, index.reshape(-1)).reshape(len(flat), *index.shape).to(points.dtype)
        rows = torch.cat(self.rows(self.coefficients(samples, at), at), 1)
        # NaN where a coordinate is, and its derivative by that one; no other has any, nor do the samples
        poison = (voxels * torch.where(unknown, torch.nan, 0.0)).sum(-1).to(rows.dtype)
        return torch.where(unknown.any(-1), 0.0, rows) + poison

    def coefficients(self, samples: Tensor, at: Located) -> Tensor:
        """(C, K, P) to the Bernstein coefficients (C, B, P) of every point's own shape."""
        found = product_of(self.tables.masks, samples)
        if at.shape is None:
            return found
        row = self.tables.rows.index_select(1, at.shape)
        return found.gather(1, row.expand(len(found), *row.shape))

    def _derivatives(self, order: int, coefficients: Tensor, at: Located) -> Tensor:
        """(C, B_r, P) to the rows (C, J, P) of that order along the axes of the cone."""
        found = product_of(self.tables.derivatives[order], coefficients)
        return _of_shape(found.unflatten(1, (len(self.spline.shapes), -1)).transpose(0, 1), at.shape)

    def rows(self, coefficients: Tensor, at: Located) -> list[Tensor]:
        """Rows (C, ·, P) of each order, of Bernstein coefficients (C, B, P)."""
        degree, rows = self.spline.degree, []
        pieces = coefficients.movedim(1, -1)
        weights = at.barycentric.T
        for order in range(min(self.order, degree), -1, -1):
            steps = bernstein.degree_of(pieces, 3) - order
            pieces = bernstein.blossom(pieces, [weights] * steps)
            along_cone = self._derivatives(order, pieces.movedim(-1, 1), at)
            rows.append(_turned(along_cone, at, order, self.tables.pairs))
        return rows[::-1]


def product_of(matrix: Tensor, columns: Tensor) -> Tensor:
    """(R, Q) times (C, Q, P): (C, R, P). What a point gets depends on no other point: BLAS does not promise that."""
    matrix = matrix.to(columns.dtype)
    total = matrix[:, 0, None] * columns[:, 0, None]
    for q in range(1, columns.shape[1]):
        total = torch.addcmul(total, matrix[:, q, None], columns[:, q, None])
    return total


def _turned(rows: Tensor, at: Located, order: int, row_of_pair: Tensor) -> Tensor:
    """Derivatives (C, J, P) of an order along the axes of the cone, along those of space."""
    if order == 0:
        return rows
    if order == 1:
        return rows.gather(1, at.ranks.expand(rows.shape)) * at.sign
    pairs = [(i, j) for i in range(3) for j in range(i, 3)]
    place = torch.stack([3 * at.ranks[i] + at.ranks[j] for i, j in pairs])
    row = row_of_pair.index_select(0, place.reshape(-1)).reshape(place.shape)
    return rows.gather(1, row.expand(rows.shape)) * torch.stack([at.sign[i] * at.sign[j] for i, j in pairs])
