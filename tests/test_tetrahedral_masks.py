"""The masks of splines on tetrahedra: what they promise, in rational arithmetic, and the oracle's numbers.

A Bernstein coefficient is named by its blossom's arguments, n vertices in any order, so that tetrahedra that share
vertices name what they share alike. Masks are compared as they are: what holds for them holds for all samples.
"""

from __future__ import annotations

from dataclasses import dataclass
from fractions import Fraction
from functools import cache
from itertools import combinations_with_replacement, product

import numpy as np
import pytest
import torch

from filterlab.fields.tetrahedral import Mask, Vector
from filterlab.methods import METHODS, Tetrahedral
from tests import tetrahedral_oracle as oracle

SPLINES = {name: method.spline for name, method in METHODS.items() if isinstance(method, Tetrahedral)}
every_spline = pytest.mark.parametrize("name", SPLINES)

SAMPLES = {"qss": (27, 27), "cubic-c1": (23, 27), "quadratic-c1": (28, 88)}  # of a tetrahedron, of a cell
KINDS = {"qss": "T", "cubic-c1": "T", "quadratic-c1": ("S", "HS", "HH")}  # of the shapes

Named = tuple[Vector, ...]  # the arguments of a blossom, sorted


@dataclass(frozen=True)
class Piece:
    """A tetrahedron of the cell about the origin, or of one moved by `at`.

    Attributes:
        kind: of its shape.
        vertices: v_0 … v_3.
        coefficients: masks by the arguments of the blossom.
    """

    kind: str
    vertices: tuple[Vector, ...]
    coefficients: dict[Named, Mask]

    def moved(self, at: Vector) -> Piece:
        coefficients = {
            tuple(_sum(v, at) for v in named): {_sum(o, at): w for o, w in mask.items()}
            for named, mask in self.coefficients.items()
        }
        return Piece(self.kind, tuple(_sum(v, at) for v in self.vertices), coefficients)


def _sum(v: Vector, w: Vector) -> Vector:
    return v[0] + w[0], v[1] + w[1], v[2] + w[2]


def _piece(t: oracle.Tetrahedron) -> Piece:
    coefficients = {
        tuple(sorted(v for v, power in zip(t.vertices, alpha, strict=True) for _ in range(power))): mask
        for alpha, mask in t.masks.items()
    }
    return Piece(t.kind, t.vertices, coefficients)


@cache
def images(name: str) -> tuple[Piece, ...]:
    """Every shape under every signed permutation: tetrahedra that are mapped to themselves stand there twice."""
    shapes = zip(KINDS[name], SPLINES[name].shapes, strict=True)
    canonical = [oracle.Tetrahedron(kind, shape.vertices, dict(shape.masks)) for kind, shape in shapes]  # type: ignore
    return tuple(_piece(one.image(m)) for one in canonical for m in oracle.signed_permutations())


@cache
def cell(name: str) -> dict[frozenset[Vector], Piece]:
    """The tetrahedra of a cell by their vertices."""
    return {frozenset(piece.vertices): piece for piece in reversed(images(name))}


def canonical(name: str) -> list[Piece]:
    """The shapes themselves."""
    return [cell(name)[frozenset(shape.vertices)] for shape in SPLINES[name].shapes]


@cache
def centres_around(name: str) -> list[Vector]:
    """The centres of a cell and of those that may touch it, relative to its own."""
    steps = [s for s in product((-2, -1, 0, 1, 2), repeat=3) if len({c % SPLINES[name].period for c in s}) == 1]
    return [(Fraction(x), Fraction(y), Fraction(z)) for x, y, z in steps]


def neighbour(name: str, piece: Piece, m: int) -> Piece:
    """The tetrahedron across the face that vertex m is opposite to."""
    face = set(piece.vertices) - {piece.vertices[m]}
    found = []
    for at in centres_around(name):
        moved_back = {_sum(v, (-at[0], -at[1], -at[2])) for v in face}
        there = [other for vertices, other in cell(name).items() if moved_back <= vertices]
        found += [other.moved(at) for other in there]
    (other,) = (t for t in found if set(t.vertices) != set(piece.vertices))
    return other


def barycentric(vertices: tuple[Vector, ...], point: Vector) -> tuple[Fraction, ...]:
    """λ with Σ λ_k v_k = point, Σ λ_k = 1, by Cramer's rule."""
    volume = _volume(*vertices)
    return tuple(_volume(*(point if i == k else v for i, v in enumerate(vertices))) / volume for k in range(4))


def _volume(p: Vector, q: Vector, r: Vector, s: Vector) -> Fraction:
    """Six times the signed volume."""
    a, b, c = ([x - y for x, y in zip(v, p, strict=True)] for v in (q, r, s))
    return sum((a[i] * (b[i - 2] * c[i - 1] - b[i - 1] * c[i - 2]) for i in range(3)), Fraction())


@dataclass(frozen=True)
class Connection:
    """Two tetrahedra that share a face.

    Attributes:
        kinds: of both.
        opposite: the vertex of the first that is not on the face.
        weights: barycentric coordinates, in the first, of the vertex of the second that is not on the face.
        violated: the arguments of the blossom on the face, in numbers of the first's vertices, for which C¹ fails.
    """

    kinds: tuple[str, str]
    opposite: int
    weights: tuple[Fraction, ...]
    violated: tuple[tuple[int, ...], ...]


@cache
def connections(name: str) -> list[Connection]:
    """Over every face of every shape; those of their images are images of them."""
    return [_connection(name, piece, m) for piece in canonical(name) for m in range(4)]


def _connection(name: str, piece: Piece, m: int) -> Connection:
    """b_other[β, w] = Σ_k λ_k(w) b[β, v_k] for all β of n − 1 vertices of the face; raises unless C⁰."""
    degree, other, face = SPLINES[name].degree, neighbour(name, piece, m), [k for k in range(4) if k != m]
    (apex,) = set(other.vertices) - set(piece.vertices)
    weights = barycentric(piece.vertices, apex)

    def named(*vertices: Vector) -> Named:
        return tuple(sorted(vertices))

    for shared in combinations_with_replacement([piece.vertices[k] for k in face], degree):
        assert piece.coefficients[named(*shared)] == other.coefficients[named(*shared)]
    violated = []
    for beta in combinations_with_replacement(face, degree - 1):
        fixed = [piece.vertices[k] for k in beta]
        terms = [(w, piece.coefficients[named(*fixed, v)]) for w, v in zip(weights, piece.vertices, strict=True)]
        if _combined(terms) != other.coefficients[named(*fixed, apex)]:
            violated.append(beta)
    return Connection((piece.kind, other.kind), m, weights, tuple(violated))


def _combined(terms: list[tuple[Fraction, Mask]]) -> Mask:
    """Σ weight · mask, without what cancels."""
    places = {o for _, mask in terms for o in mask}
    total = {o: sum((w * mask.get(o, Fraction()) for w, mask in terms), Fraction()) for o in places}
    return {o: w for o, w in total.items() if w}


# ---- masks


@every_spline
def test_masks_are_the_oracles(name):
    """On every tetrahedron of a cell, though only the shapes of the cone are compared number by number in the code."""
    expected = {frozenset(t.vertices): _piece(t).coefficients for t in oracle.SPLINES[name].tetrahedra}
    assert {vertices: piece.coefficients for vertices, piece in cell(name).items()} == expected


@every_spline
def test_masks_sum_to_one(name):
    assert {sum(mask.values()) for piece in canonical(name) for mask in piece.coefficients.values()} == {1}


@every_spline
def test_masks_do_not_depend_on_the_permutation_that_leads_to_a_tetrahedron(name):
    """Nor on the tetrahedron of the cell that a coefficient is taken from."""
    found: dict[Named, Mask] = {}
    for piece in images(name):
        for named, mask in piece.coefficients.items():
            assert found.setdefault(named, mask) == mask


@every_spline
def test_tetrahedra_need_as_many_samples_as_is_known(name):
    needed = [{o for mask in piece.coefficients.values() for o in mask} for piece in images(name)]
    assert ({len(n) for n in needed}, len(set().union(*needed))) == ({SAMPLES[name][0]}, SAMPLES[name][1])


@every_spline
def test_quadratics_gain_an_eighth_of_their_laplacian(name):
    """Linear functions and harmonic quadratics are reproduced, and no other quadratics are."""
    for power in (p for p in product(range(3), repeat=3) if sum(p) <= 2):
        for named, mask in ((n, m) for piece in canonical(name) for n, m in piece.coefficients.items()):
            assert _applied(mask, power) == _polar(power, named) + Fraction(max(power) == 2, 4)


def _applied(mask: Mask, power: tuple[int, ...]) -> Fraction:
    """Σ w x^i y^j z^k."""
    return sum((w * o[0] ** power[0] * o[1] ** power[1] * o[2] ** power[2] for o, w in mask.items()), Fraction())


def _polar(power: tuple[int, ...], arguments: Named) -> Fraction:
    """The blossom of a monomial of degree 2 at most: the mean over pairs of arguments."""
    axes = [axis for axis in range(3) for _ in range(power[axis])]
    if len(axes) < 2:
        return sum((v[axes[0]] if axes else Fraction(1) for v in arguments), Fraction()) / len(arguments)
    pairs = [(v, w) for i, v in enumerate(arguments) for j, w in enumerate(arguments) if i != j]
    return sum((v[axes[0]] * w[axes[1]] for v, w in pairs), Fraction()) / len(pairs)


# ---- smoothness


@pytest.mark.parametrize("name", ["cubic-c1", "quadratic-c1"])
def test_gradients_are_continuous_across_every_kind_of_face(name):
    assert [c.violated for c in connections(name)] == [()] * (4 * len(SPLINES[name].shapes))


def test_quadratic_super_splines_are_smooth_across_cubes_and_not_within():
    """Across v_0's face all conditions hold; across the others, which meet in v_0, all but those of β = v_0."""
    assert [(c.opposite, c.violated) for c in connections("qss")] == [(0, ()), (1, ((0,),)), (2, ((0,),)), (3, ((0,),))]


def test_octahedra_meet_in_eight_ways():
    ways = {(*c.kinds, c.opposite): tuple(map(str, c.weights)) for c in connections("quadratic-c1")}
    assert ways == {
        ("S", "S", 0): ("-1", "2", "0", "0"),
        ("HS", "HH", 0): ("-1", "2", "0", "0"),
        ("HH", "HS", 0): ("-1", "2", "0", "0"),
        ("S", "HS", 1): ("1/2", "-3/2", "2", "0"),
        ("HS", "S", 1): ("1/3", "-2/3", "4/3", "0"),
        ("HH", "HH", 1): ("2/3", "-1", "4/3", "0"),
        ("S", "S", 2): ("0", "1", "-1", "1"),
        ("HS", "HH", 2): ("0", "1/2", "-1", "3/2"),
        ("HH", "HS", 2): ("0", "1/2", "-1", "3/2"),
        ("S", "S", 3): ("0", "0", "2", "-1"),
        ("HS", "HS", 3): ("0", "0", "2", "-1"),
        ("HH", "HH", 3): ("0", "0", "2", "-1"),
    }


# ---- cells


@every_spline
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_cells_are_those_of_the_nearest_centres(name, dtype):
    points = torch.rand(4000, 3, generator=torch.Generator().manual_seed(0), dtype=dtype) * 40 - 20
    cells = SPLINES[name].cells(points)
    assert cells.dtype == dtype
    np.testing.assert_array_equal(cells.numpy(), oracle.SPLINES[name].centres(points.double().numpy()))


@every_spline
def test_cells_on_their_faces_are_one_of_those_that_meet_there(name):
    """Faces, edges, vertices, centres: quarters hold them all."""
    spline = SPLINES[name]
    points = torch.cartesian_prod(*[torch.arange(-10, 11, dtype=torch.float64) / 4] * 3)
    found = np.asarray(spline.cells(points)) + float(spline.shift)
    nearest = oracle.SPLINES[name].centres(points.numpy()) + float(spline.shift)
    x = points.numpy()
    np.testing.assert_array_equal(((x - found) ** 2).sum(-1), ((x - nearest) ** 2).sum(-1))
    assert SPLINES[name].cells(torch.full((1, 3), torch.nan)).isnan().all()
