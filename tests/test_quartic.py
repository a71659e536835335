"""Laws of quartic splines on triangles, in exact rationals."""

from __future__ import annotations

from fractions import Fraction
from itertools import product

import pytest

from filterlab.bernstein import Index, multi_indices, multinomial
from filterlab.surfaces.quartic import RING, SPLINES, QuarticSpline, quartic_spline, weighted
from tests import quartic_oracle

ALL = {name: (spline, name) for name, spline in SPLINES.items()}
ALL["c2 prefiltered"] = SPLINES["c2"].with_prefilter(), "c2 prefiltered"
every_spline = pytest.mark.parametrize("spline", [spline for spline, _ in ALL.values()], ids=list(ALL))

OTHER: Index = (-1, 1, 1)  # the third corner of the triangle across the edge V1 V2


@pytest.mark.parametrize(("spline", "name"), list(ALL.values()), ids=list(ALL))
def test_masks_are_the_published_ones(spline: QuarticSpline, name: str):
    for alpha, mask in spline.masks.items():
        expected = quartic_oracle.mask(name, alpha)
        assert {offset: float(weight) for offset, weight in mask.items()} == pytest.approx(
            {offset: weight for offset, weight in expected.items() if abs(weight) > 1e-12}, rel=1e-13
        )


def coefficients(spline: QuarticSpline, data) -> dict[Index, Fraction]:
    """Of the triangle (0, 0), (m, 0), (0, m)."""
    read = {offset: data(*offset) for offset in spline.samples}
    return {a: sum((w * read[o] for o, w in mask.items()), Fraction(0)) for a, mask in spline.masks.items()}


def value(pieces: dict[Index, Fraction], point: tuple[Fraction, ...]) -> Fraction:
    """s at barycentric coordinates."""
    total = Fraction(0)
    for alpha, own in pieces.items():
        x, y, z = (p**a for p, a in zip(point, alpha, strict=True))
        total += multinomial(alpha) * x * y * z * own
    return total


def errors(spline: QuarticSpline, degree: int) -> list[Fraction]:
    """Of all monomials of a degree, at points that tell polynomials of degree 5 apart."""
    found = []
    for i in range(degree + 1):
        monomial = lambda x, y, i=i: Fraction(x) ** i * Fraction(y) ** (degree - i)  # noqa: E731
        pieces = coefficients(spline, monomial)
        for place in multi_indices(5, 2):
            point = tuple(Fraction(p, 5) for p in place)
            found.append(value(pieces, point) - monomial(spline.steps * point[1], spline.steps * point[2]))
    return found


@every_spline
def test_polynomials_come_back_up_to_the_degree_and_not_beyond(spline: QuarticSpline):
    for degree in range(spline.reproduces + 1):
        assert not any(errors(spline, degree))
    assert any(errors(spline, spline.reproduces + 1))


def across(spline: QuarticSpline, corners: tuple[int, int, int], order: int) -> bool:
    """Whether derivatives up to an order are the same on both sides of the edge of the last two corners.

    The polynomial of one side, written about the other triangle, has the coefficients b[V0′^i, V2^j, V1^k].
    """
    names = dict(enumerate(((0, 0), (spline.steps, 0), (0, spline.steps))))
    (u, v), (p, q) = (names[c] for c in corners[1:])
    turned = lambda a, b: (u + p - a, v + q - b)  # noqa: E731  # by a half turn about the middle of the edge
    own = {alpha: spline.masks[_permuted(alpha, corners)] for alpha in multi_indices(4, 2)}
    for i, j in product(range(order + 1), range(5)):
        if i + j > 4:
            continue
        polar = dict(own)
        for point in [OTHER] * i + [(0, 0, 1)] * j + [(0, 1, 0)] * (4 - i - j):  # V1, V2 change places
            polar = _step(polar, point)
        their = own[i, j, 4 - i - j]
        other = {turned(*offset): weight for offset, weight in their.items()}
        if weighted((1, polar[0, 0, 0]), (-1, other)):
            return False
    return True


def _permuted(alpha: Index, corners: tuple[int, ...]) -> Index:
    """The index by the spline's own order of corners, of one by these."""
    own = [0, 0, 0]
    for a, corner in zip(alpha, corners, strict=True):
        own[corner] = a
    return tuple(own)


def _step(polar, point: Index):
    degree = sum(next(iter(polar))) - 1
    raised = lambda beta, k: tuple(b + (n == k) for n, b in enumerate(beta))  # noqa: E731
    return {
        beta: weighted(*((point[k], polar[raised(beta, k)]) for k in range(3))) for beta in multi_indices(degree, 2)
    }


@every_spline
@pytest.mark.parametrize("corners", [(0, 1, 2), (1, 2, 0), (2, 0, 1)], ids=["across", "along rows", "along columns"])
def test_derivatives_are_continuous_up_to_the_order_and_not_beyond(spline: QuarticSpline, corners):
    assert across(spline, corners, spline.continuity)
    assert not across(spline, corners, spline.continuity + 1)


@every_spline
def test_facts_that_follow_from_masks(spline: QuarticSpline):
    outside = {"linear": 0, "c0": 0, "c1": 3, "c2": 2 if spline.prefiltered else 1}
    norms = {"linear": 1, "c0": Fraction(202, 9), "c1": 10, "c2": Fraction(14, 9) if spline.prefiltered else 1}
    assert (spline.rows_outside, spline.norm) == (outside[spline.name], norms[spline.name])
    assert all(sum(mask.values()) == 1 for mask in spline.masks.values())


def test_the_box_spline_refines_itself():
    """The two-scale relation: control values of half the step are 1/16 of {10; 1 or 2 ...} of the data."""
    spline, m = SPLINES["c2"], 2
    fine = {(0, 0): Fraction(10, 16)} | dict.fromkeys(RING, Fraction(6, 16))
    fine |= {(2 * a, 2 * b): Fraction(1, 16) for a, b in RING}
    fine |= {(a + c, b + d): Fraction(2, 16) for (a, b), (c, d) in zip(RING, (*RING[1:], RING[0]), strict=True)}
    hat = lambda x, y: Fraction((x, y) == (0, 0))  # noqa: E731
    refined = lambda x, y: fine.get((x, y), Fraction(0))  # noqa: E731
    for point in ((Fraction(1, 2), Fraction(1, 3), Fraction(1, 6)), (Fraction(1), Fraction(0), Fraction(0))):
        half = (Fraction(1) - (point[1] + point[2]) / m, point[1] / m, point[2] / m)
        assert value(coefficients(spline, hat), half) == value(coefficients(spline, refined), point)


def test_names_that_nobody_knows_and_prefilters_of_others():
    with pytest.raises(ValueError, match=r"unknown spline 'c3'; .*known splines: linear, c0, c1, c2"):
        quartic_spline("c3")
    with pytest.raises(ValueError, match="the prefilter is that of the spline c2; got c1"):
        quartic_spline("c1", prefilter=True)
    with pytest.raises(ValueError, match="a mask for every coefficient"):
        QuarticSpline("own", 1, 0, 1, 2, {(4, 0, 0): {(0, 0): Fraction(1)}})
    wrong = {alpha: {(0, 0): Fraction(1, 2)} for alpha in multi_indices(4, 2)}
    with pytest.raises(ValueError, match="add up to 1"):
        QuarticSpline("own", 1, 0, 1, 2, wrong)
