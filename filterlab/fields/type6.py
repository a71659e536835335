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

from collections.abc import Callable, Iterator
from fractions import Fraction
from functools import cache
from itertools import product

from torch import Tensor

from filterlab.bernstein import multi_indices
from filterlab.fields.tetrahedral import Mask, Shape, Spline, Vector, weighted

Corner = tuple[int, int, int]
"""Signs of its coordinates, ±½ each."""

Face = tuple[int, int]
"""Axis and sign of its outward normal."""

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


def _mean(*masks: Mask) -> Mask:
    return weighted(*((Fraction(1, len(masks)), mask) for mask in masks))


def _inward(a: Corner, towards: Callable[[Corner, Corner], Mask]) -> Mask:
    """From a corner towards Q: half of what lies on its three edges, less half of the corner."""
    return weighted(*((Fraction(1, 2), towards(a, b)) for b in _neighbours(a)), (Fraction(-1, 2), _aa(a)))


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


@cache
def _ac(a: Corner, c: Face) -> Mask:
    return _mean(*(_ab(a, b) for b in _within(c, a)))


@cache
def _aq(a: Corner) -> Mask:
    return _inward(a, _ab)


def _qq() -> Mask:
    edges = ((Fraction(1, 16), _ab(a, b)) for a, b in _edges())  # twice the twelve
    return weighted(*edges, *((Fraction(-1, 16), _aa(a)) for a in _CORNERS))


def _quadratic(a: Corner, b: Corner, c: Face) -> dict[str, Mask]:
    """The coefficients of the tetrahedron Q c a b, by name."""
    opposite = _opposite(c, a)
    return {
        "aa": _aa(a),
        "bb": _aa(b),
        "ab": _ab(a, b),
        "ac": _ac(a, c),
        "bc": _ac(b, c),
        "cc": _mean(_ac(a, c), _ac(opposite, c)),
        "aQ": _aq(a),
        "bQ": _aq(b),
        "cQ": _mean(*(_aq(corner) for corner in (a, opposite, *_within(c, a)))),
        "QQ": _qq(),
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


@cache
def _acc(a: Corner, c: Face) -> Mask:
    return _mean(*(_abc(a, b, c) for b in _within(c, a)))


@cache
def _aaq(a: Corner) -> Mask:
    return _inward(a, _aab)


@cache
def _abq(a: Corner, b: Corner) -> Mask:
    half = Fraction(-1, 2)
    faces = ((Fraction(1), _abc(a, b, c)) for c in _faces_of(a, b))
    return weighted(*faces, (half, _aab(a, b)), (half, _aab(b, a)))


@cache
def _acq(a: Corner, c: Face) -> Mask:
    return _mean(*(_abq(a, b) for b in _within(c, a)))


@cache
def _aqq(a: Corner) -> Mask:
    b, half = _turned(a, 0), Fraction(-1, 2)  # any of the three edges at a gives the same
    faces = ((Fraction(1), _acq(a, c)) for c in _faces_of(a, b))
    return weighted(*faces, (half, _aaq(a)), (half, _abq(a, b)))


def _qqq() -> Mask:
    corners = ((Fraction(1, 32), _aa(a)) for a in _CORNERS)
    faces = ((Fraction(1, 16), _abc(a, b, c)) for a, b in _edges() for c in _faces_of(a, b))  # twice the 24
    edges = ((Fraction(-3, 32), _aab(a, b)) for a, b in _edges())
    return weighted(*corners, *faces, *edges)


def _cubic(a: Corner, b: Corner, c: Face) -> dict[str, Mask]:
    """The coefficients of the tetrahedron Q c a b, by name."""
    opposite = _opposite(c, a)
    return {
        "aaa": _aa(a),
        "bbb": _aa(b),
        "aab": _aab(a, b),
        "abb": _aab(b, a),
        "aac": _mean(*(_aab(a, other) for other in _within(c, a))),
        "bbc": _mean(*(_aab(b, other) for other in _within(c, b))),
        "abc": _abc(a, b, c),
        "acc": _acc(a, c),
        "bcc": _acc(b, c),
        "ccc": _mean(_acc(a, c), _acc(opposite, c)),
        "aaQ": _aaq(a),
        "bbQ": _aaq(b),
        "abQ": _abq(a, b),
        "acQ": _acq(a, c),
        "bcQ": _acq(b, c),
        "ccQ": _mean(_acq(a, c), _acq(opposite, c)),
        "aQQ": _aqq(a),
        "bQQ": _aqq(b),
        "cQQ": _mean(_aqq(a), _aqq(opposite)),
        "QQQ": _qqq(),
    }


# --- the tetrahedron of the cone --------------------------------------------------------------------------------------


def _shape(degree: int, coefficients: Callable[[Corner, Corner, Face], dict[str, Mask]]) -> Shape:
    """Q, the face x = ½, and its edge at y = ½."""
    half, zero = Fraction(1, 2), Fraction(0)
    a, b, c = (1, 1, -1), (1, 1, 1), (0, 1)
    named = coefficients(a, b, c)
    vertices = ((zero, zero, zero), (half, zero, zero), (half, half, -half), (half, half, half))
    return Shape(vertices, {alpha: named[_name(alpha)] for alpha in multi_indices(degree, 3)})


def _name(alpha: tuple[int, ...]) -> str:
    """The blossom's arguments: vertices are Q, c, a, b."""
    return "".join(letter * alpha["Qcab".index(letter)] for letter in "abcQ")


def _cubes(voxels: Tensor) -> Tensor:
    return (voxels + 0.5).floor()


QSS = Spline("qss", 2, (_shape(2, _quadratic),), _cubes, Fraction(0), 1, ((0, 0, 0),), 3)
"""Quadratic super splines: C¹ across the faces of cubes, C⁰ within."""

CUBIC_C1 = Spline("cubic-c1", 3, (_shape(3, _cubic),), _cubes, Fraction(0), 1, ((0, 0, 0),), 3)
"""Cubic splines, C¹ everywhere."""
