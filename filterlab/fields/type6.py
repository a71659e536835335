"""Quadratic super splines and cubic C¹ splines on the type-6 partition: cubes about the samples, 24 tetrahedra each.

The planes x, y, z ∈ ℤ + ½ and x ± y, x ± z, y ± z ∈ ℤ cut space. A sample is the centre Q of its cube; a tetrahedron
has the vertices Q, the centre c of a face, and the ends a, b of one of that face's edges. Bernstein coefficients are
named by their blossom's arguments: aab stands at (2a + b) / 3, cQ at (c + Q) / 2.

    determining set     aa, ab;  aaa, aab, abc      means of samples
    all others          from the cube's surface to Q, by the rules that join pieces smoothly

Source: Kalbe and Zeilfelder, Hardware-accelerated, high-quality rendering based on trivariate splines approximating
volume data, 2008: section 3, figures 4 and 7. Of what is not printed there (the weights of the quadratic determining
set) the one solution with the cube's symmetry, supports in the 27 samples around, and C¹ across the faces of cubes.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from fractions import Fraction
from functools import cache
from itertools import product
from typing import Generic, Protocol, TypeVar

import torch
from torch import Tensor

from filterlab.bernstein import multi_indices
from filterlab.fields.determining import Determining
from filterlab.fields.tetrahedral import Mask, Shape, Spline, Vector, weighted

Corner = tuple[int, int, int]
"""Signs of its coordinates, ±½ each."""

Face = tuple[int, int]
"""Axis and sign of its outward normal."""

Linear = TypeVar("Linear")
"""What coefficients are made of: masks of samples, or numbers of many cubes."""


class Weighted(Protocol[Linear]):
    """Σ factor · part."""

    def __call__(self, *parts: tuple[Fraction, Linear]) -> Linear: ...


_CORNERS: tuple[Corner, ...] = tuple(product((1, -1), repeat=3))  # type: ignore[assignment]


def _turned(corner: Corner, *axes: int) -> Corner:
    """The corner across along some axes."""
    x, y, z = (-s if axis in axes else s for axis, s in enumerate(corner))
    return x, y, z


def _neighbours(corner: Corner) -> tuple[Corner, ...]:
    return tuple(_turned(corner, axis) for axis in range(3))


def _axis_of(a: Corner, b: Corner) -> int:
    """The axis along which an edge runs."""
    (axis,) = (i for i in range(3) if a[i] != b[i])
    return axis


def _faces_of(a: Corner, b: Corner) -> tuple[Face, Face]:
    """The two faces that meet in an edge."""
    first, second = ((i, a[i]) for i in range(3) if a[i] == b[i])
    return first, second


def _within(face: Face, a: Corner) -> tuple[Corner, Corner]:
    """The neighbours of a corner in a face."""
    first, second = (_turned(a, i) for i in range(3) if i != face[0])
    return first, second


def _opposite(face: Face, a: Corner) -> Corner:
    return _turned(a, *(i for i in range(3) if i != face[0]))


def _edges() -> Iterator[tuple[Corner, Corner]]:
    """Each of the twelve twice, from both of its ends."""
    return ((a, b) for a in _CORNERS for b in _neighbours(a))


def _box(weight: Fraction | int, *layers: tuple[int, ...]) -> Mask:
    """The same weight for all samples whose offsets along x, y, z are among these."""
    return {_vector(offset): Fraction(weight) for offset in product(*layers)}


def _vector(offset: tuple[int, ...]) -> Vector:
    x, y, z = map(Fraction, offset)
    return x, y, z


# --- the quadratic ----------------------------------------------------------------------------------------------------


@cache
def _aa(a: Corner) -> Mask:
    """The eight samples around a corner; of the cubic aaa too."""
    return _box(Fraction(1, 8), *((0, s) for s in a))


@cache
def _ab(a: Corner, b: Corner) -> Mask:
    """The four samples around an edge, in the layer of the cube."""
    axis = _axis_of(a, b)
    return _box(Fraction(1, 4), *((0,) if i == axis else (0, s) for i, s in enumerate(a)))


class _Rules(Generic[Linear]):
    """The rules by which all coefficients of a cube follow from its determining set: of masks, or of numbers.

    Args:
        weighted: Σ factor · what there is of a coefficient.
    """

    def __init__(self, weighted: Weighted[Linear]) -> None:
        self.weighted = weighted

    def mean(self, *parts: Linear) -> Linear:
        return self.weighted(*((Fraction(1, len(parts)), part) for part in parts))

    def inward(self, a: Corner, towards: Callable[[Corner, Corner], Linear], there: Linear) -> Linear:
        """From a corner towards Q: half of what lies on its three edges, less half of the corner."""
        return self.weighted(*((Fraction(1, 2), towards(a, b)) for b in _neighbours(a)), (Fraction(-1, 2), there))


class _Quadratic(_Rules[Linear]):
    """The rules of quadratic super splines, from aa and ab."""

    def __init__(
        self, weighted: Weighted[Linear], aa: Callable[[Corner], Linear], ab: Callable[[Corner, Corner], Linear]
    ) -> None:
        super().__init__(weighted)
        self.aa, self.ab = aa, ab
        self.aq = cache(self._aq)

    def ac(self, a: Corner, c: Face) -> Linear:
        return self.mean(*(self.ab(a, b) for b in _within(c, a)))

    def _aq(self, a: Corner) -> Linear:
        return self.inward(a, self.ab, self.aa(a))

    def qq(self) -> Linear:
        edges = ((Fraction(1, 8), self.ab(a, b)) for a, b in _edges() if a > b)
        return self.weighted(*edges, *((Fraction(-1, 16), self.aa(a)) for a in _CORNERS))

    def named(self, a: Corner, b: Corner, c: Face) -> dict[str, Linear]:
        """The coefficients of the tetrahedron Q c a b, by name."""
        opposite, ac = _opposite(c, a), self.ac(a, c)
        return {
            "aa": self.aa(a),
            "bb": self.aa(b),
            "ab": self.ab(a, b),
            "ac": ac,
            "bc": self.ac(b, c),
            "cc": self.mean(ac, self.ac(opposite, c)),
            "aQ": self.aq(a),
            "bQ": self.aq(b),
            "cQ": self.mean(*(self.aq(corner) for corner in (a, opposite, *_within(c, a)))),
            "QQ": self.qq(),
        }


# --- the cubic --------------------------------------------------------------------------------------------------------


@cache
def _aab(a: Corner, b: Corner) -> Mask:
    """The four samples around an edge, and the next ones towards the nearer end."""
    axis = _axis_of(a, b)
    parts = ((Fraction(5, 24), 0), (Fraction(1, 24), a[axis]))
    return weighted(
        *((w, _box(1, *((along,) if i == axis else (0, s) for i, s in enumerate(a)))) for w, along in parts)
    )


@cache
def _abc(a: Corner, b: Corner, c: Face) -> Mask:
    """Two layers of six samples: on both sides of the face, about the edge."""
    axis = _axis_of(a, b)
    (across,) = (i for i in range(3) if i not in (axis, c[0]))
    parts = (
        (Fraction(13, 48), (0,), (0,)),
        (Fraction(7, 48), (a[across],), (0,)),
        (Fraction(1, 32), (0,), (-1, 1)),
        (Fraction(1, 96), (a[across],), (-1, 1)),
    )
    layers = ({c[0]: (0, c[1]), across: out, axis: along} for _, out, along in parts)
    boxes = (_box(1, *(layer[i] for i in range(3))) for layer in layers)
    return weighted(*((part[0], box) for part, box in zip(parts, boxes, strict=True)))


class _Cubic(_Rules[Linear]):
    """The rules of cubic C¹ splines, from aaa, aab and abc."""

    def __init__(
        self,
        weighted: Weighted[Linear],
        aaa: Callable[[Corner], Linear],
        aab: Callable[[Corner, Corner], Linear],
        abc: Callable[[Corner, Corner, Face], Linear],
    ) -> None:
        super().__init__(weighted)
        self.aaa, self.aab, self.abc = aaa, aab, abc
        self.acc, self.aaq, self.acq, self.aqq = map(cache, (self._acc, self._aaq, self._acq, self._aqq))
        self._of_edge = cache(self._abq)

    def abq(self, a: Corner, b: Corner) -> Linear:
        return self._of_edge(max(a, b), min(a, b))

    def aac(self, a: Corner, c: Face) -> Linear:
        return self.mean(*(self.aab(a, other) for other in _within(c, a)))

    def _acc(self, a: Corner, c: Face) -> Linear:
        return self.mean(*(self.abc(a, b, c) for b in _within(c, a)))

    def _aaq(self, a: Corner) -> Linear:
        return self.inward(a, self.aab, self.aaa(a))

    def _abq(self, a: Corner, b: Corner) -> Linear:
        half = Fraction(-1, 2)
        faces = ((Fraction(1), self.abc(a, b, c)) for c in _faces_of(a, b))
        return self.weighted(*faces, (half, self.aab(a, b)), (half, self.aab(b, a)))

    def _acq(self, a: Corner, c: Face) -> Linear:
        return self.mean(*(self.abq(a, b) for b in _within(c, a)))

    def _aqq(self, a: Corner) -> Linear:
        b, half = _turned(a, 0), Fraction(-1, 2)  # any of the three edges at a gives the same
        faces = ((Fraction(1), self.acq(a, c)) for c in _faces_of(a, b))
        return self.weighted(*faces, (half, self.aaq(a)), (half, self.abq(a, b)))

    def qqq(self) -> Linear:
        corners = ((Fraction(1, 32), self.aaa(a)) for a in _CORNERS)
        faces = ((Fraction(1, 8), self.abc(a, b, c)) for a, b in _edges() if a > b for c in _faces_of(a, b))
        edges = ((Fraction(-3, 32), self.aab(a, b)) for a, b in _edges())
        return self.weighted(*corners, *faces, *edges)

    def named(self, a: Corner, b: Corner, c: Face) -> dict[str, Linear]:
        """The coefficients of the tetrahedron Q c a b, by name."""
        opposite = _opposite(c, a)
        return {
            "aaa": self.aaa(a),
            "bbb": self.aaa(b),
            "aab": self.aab(a, b),
            "abb": self.aab(b, a),
            "aac": self.aac(a, c),
            "bbc": self.aac(b, c),
            "abc": self.abc(a, b, c),
            "acc": self.acc(a, c),
            "bcc": self.acc(b, c),
            "ccc": self.mean(self.acc(a, c), self.acc(opposite, c)),
            "aaQ": self.aaq(a),
            "bbQ": self.aaq(b),
            "abQ": self.abq(a, b),
            "acQ": self.acq(a, c),
            "bcQ": self.acq(b, c),
            "ccQ": self.mean(self.acq(a, c), self.acq(opposite, c)),
            "aQQ": self.aqq(a),
            "bQQ": self.aqq(b),
            "cQQ": self.mean(self.aqq(a), self.aqq(opposite)),
            "QQQ": self.qqq(),
        }


# --- the tetrahedron of the cone --------------------------------------------------------------------------------------

_CONE: tuple[Corner, Corner, Face] = ((1, 1, -1), (1, 1, 1), (0, 1))
"""a, b and c of the face x = ½, and its edge at y = ½."""


def _shape(degree: int, named: Mapping[str, Mask]) -> Shape:
    half, zero = Fraction(1, 2), Fraction(0)
    vertices = ((zero, zero, zero), (half, zero, zero), (half, half, -half), (half, half, half))
    return Shape(vertices, {alpha: named[_name(alpha)] for alpha in multi_indices(degree, 3)})


def _name(alpha: tuple[int, ...]) -> str:
    """The blossom's arguments: vertices are Q, c, a, b."""
    return "".join(letter * alpha["Qcab".index(letter)] for letter in "abcQ")


def _cubes(voxels: Tensor) -> Tensor:
    return (voxels + 0.5).floor()


def _on_cubes(name: str, degree: int, coefficients: Mapping[str, Mask]) -> Spline:
    return Spline(name, degree, (_shape(degree, coefficients),), _cubes, Fraction(0), 1, ((0, 0, 0),), 3)


QSS = _on_cubes("qss", 2, _Quadratic(weighted, _aa, _ab).named(*_CONE))
"""Quadratic super splines: C¹ across the faces of cubes, C⁰ within."""

CUBIC_C1 = _on_cubes("cubic-c1", 3, _Cubic(weighted, _aa, _aab, _abc).named(*_CONE))
"""Cubic splines, C¹ everywhere."""


# --- determining sets -------------------------------------------------------------------------------------------------

_EDGES = tuple((a, b) for a, b in _edges() if a > b)
_ABC = {(frozenset((a, b)), c): (a, b, c) for a, b in _EDGES for c in _faces_of(a, b)}


def _sum(*parts: tuple[Fraction, Tensor]) -> Tensor:
    """Σ factor · x."""
    (factor, x), *others = parts
    total = x * float(factor)
    for factor, x in others:
        total = total.add(x, alpha=float(factor))
    return total


def _by_name(degree: int, named: Mapping[str, Tensor]) -> Tensor:
    """(B, P)."""
    return torch.stack([named[_name(alpha)] for alpha in multi_indices(degree, 3)])


def _of_d2(numbers: Tensor, _: Tensor | None) -> Tensor:
    aa = dict(zip(_CORNERS, numbers, strict=False))
    ab = dict(zip(map(frozenset, _EDGES), numbers[8:], strict=True))
    rules = _Quadratic(_sum, aa.__getitem__, lambda a, b: ab[frozenset((a, b))])
    return _by_name(2, rules.named(*_CONE))


def _of_d3(numbers: Tensor, _: Tensor | None) -> Tensor:
    aaa = dict(zip(_CORNERS, numbers, strict=False))
    aab = dict(zip(_edges(), numbers[8:], strict=False))
    abc = dict(zip(_ABC, numbers[32:], strict=True))
    rules = _Cubic(_sum, aaa.__getitem__, lambda a, b: aab[a, b], lambda a, b, c: abc[frozenset((a, b)), c])
    return _by_name(3, rules.named(*_CONE))


D2 = Determining.of_cell(QSS, (*map(_aa, _CORNERS), *(_ab(*edge) for edge in _EDGES)), _of_d2)
"""20 numbers of a cube: aa at its corners, ab on its edges."""

D3 = Determining.of_cell(
    CUBIC_C1,
    (*map(_aa, _CORNERS), *(_aab(*edge) for edge in _edges()), *(_abc(*place) for place in _ABC.values())),
    _of_d3,
)
"""56 numbers of a cube: aaa at its corners, aab on its edges, abc on its faces."""
