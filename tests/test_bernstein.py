"""Bernstein form on the simplex: laws for every dimension and degree, against sums of exact fractions."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction

import pytest
import torch

from filterlab import bernstein

SIMPLICES = [(d, n) for d, n in itertools.product((1, 2, 3), range(6))] + [(1, 9), (2, 9)]
PAIRS = [(1, 2, 3), (1, 9, 4), (2, 2, 3), (2, 1, 1), (3, 1, 2), (3, 2, 2)]
EPS = 2**-52


def indices(dimension: int, degree: int) -> list[tuple[int, ...]]:
    """All multi-indices, the largest first."""
    every = itertools.product(range(degree + 1), repeat=dimension + 1)
    return sorted((alpha for alpha in every if sum(alpha) == degree), reverse=True)


def exact(coefficients, point) -> Fraction:
    """The sum of Bernstein polynomials times coefficients, as it is written in the definition."""
    dimension = len(point) - 1
    degree = next(n for n in range(20) if math.comb(n + dimension, dimension) == len(coefficients))
    total = Fraction(0)
    for c, alpha in zip(coefficients, indices(dimension, degree), strict=True):
        basis = Fraction(math.factorial(degree))
        for x, a in zip(point, alpha, strict=True):
            basis *= Fraction(x) ** a / math.factorial(a)
        total += Fraction(c) * basis
    return total


def random_coefficients(dimension, degree, *batch, seed=0):
    generator = torch.Generator().manual_seed(seed + 31 * degree + dimension)
    shape = (*batch, math.comb(degree + dimension, dimension))
    return torch.rand(shape, generator=generator, dtype=torch.float64) * 2 - 1


def random_points(dimension, *batch, seed=1):
    generator = torch.Generator().manual_seed(seed + dimension)
    weights = torch.rand(*batch, dimension + 1, generator=generator, dtype=torch.float64) + 0.01
    return weights / weights.sum(-1, keepdim=True)


def assert_exact(found, coefficients, points, roundings):
    """Of one polynomial at some points, to that many roundings of the largest coefficient."""
    size = float(coefficients.abs().max()) or 1.0
    for value, point in zip(found.tolist(), points.tolist(), strict=True):
        assert abs(Fraction(value) - exact(coefficients.tolist(), point)) <= roundings * EPS * size


@pytest.mark.parametrize(("dimension", "degree"), SIMPLICES)
def test_the_order_of_coefficients_is_that_of_the_head_of_the_file(dimension, degree):
    assert list(bernstein.multi_indices(degree, dimension)) == indices(dimension, degree)
    assert bernstein.degree_of(torch.zeros(math.comb(degree + dimension, dimension)), dimension) == degree


@pytest.mark.parametrize(("dimension", "degree"), SIMPLICES)
def test_values_are_the_sum_of_the_definition(dimension, degree):
    coefficients, points = random_coefficients(dimension, degree), random_points(dimension, 5)
    assert_exact(bernstein.evaluate(coefficients, points), coefficients, points, 2 * degree + 2)


@pytest.mark.parametrize(("dimension", "degree"), SIMPLICES)
def test_ones_make_one_and_vertices_are_interpolated(dimension, degree):
    ones = torch.ones(math.comb(degree + dimension, dimension), dtype=torch.float64)
    torch.testing.assert_close(bernstein.evaluate(ones, random_points(dimension, 7)), torch.ones(7).double())
    coefficients = random_coefficients(dimension, degree)
    for k, vertex in enumerate(torch.eye(dimension + 1, dtype=torch.float64)):
        alpha = tuple(degree * (j == k) for j in range(dimension + 1))
        corner = coefficients[indices(dimension, degree).index(alpha)]
        assert bernstein.evaluate(coefficients, vertex) == corner


@pytest.mark.parametrize(("dimension", "degree"), SIMPLICES)
def test_derivatives_are_those_of_autograd_and_of_differences(dimension, degree):
    coefficients, points = random_coefficients(dimension, degree), random_points(dimension, 6)
    direction = random_points(dimension, seed=3) - random_points(dimension, seed=4)
    found = bernstein.evaluate(bernstein.derivative(coefficients, direction), points)
    at = points.clone().requires_grad_()
    value = bernstein.evaluate(coefficients, at)
    (gradient,) = torch.autograd.grad(value.sum(), at) if degree else (torch.zeros_like(points),)
    torch.testing.assert_close(found, gradient @ direction, rtol=0, atol=1e-13)
    h = Fraction(1, 2**20)
    for value, point in zip(found.tolist(), points.tolist(), strict=True):
        ends = [
            [Fraction(x) + s * h * Fraction(v) for x, v in zip(point, direction.tolist(), strict=True)] for s in (1, -1)
        ]
        ahead, behind = (exact(coefficients.tolist(), end) for end in ends)
        assert value == pytest.approx(float((ahead - behind) / (2 * h)), abs=1e-9)


@pytest.mark.parametrize(("dimension", "degree"), SIMPLICES)
def test_elevation_changes_no_value(dimension, degree):
    coefficients, points = random_coefficients(dimension, degree), random_points(dimension, 4)
    raised = bernstein.elevate(coefficients, dimension)
    assert bernstein.degree_of(raised, dimension) == degree + 1
    assert_exact(bernstein.evaluate(raised, points), coefficients, points, 2 * degree + 6)


@pytest.mark.parametrize(("dimension", "m", "n"), PAIRS)
def test_the_value_of_a_product_is_the_product_of_values(dimension, m, n):
    a, b = random_coefficients(dimension, m, seed=5), random_coefficients(dimension, n, seed=6)
    both, points = bernstein.multiply(a, b, dimension), random_points(dimension, 4)
    assert bernstein.degree_of(both, dimension) == m + n
    for value, point in zip(bernstein.evaluate(both, points).tolist(), points.tolist(), strict=True):
        product = exact(a.tolist(), point) * exact(b.tolist(), point)
        assert float(abs(Fraction(value) - product)) <= 4 * (m + n) * EPS


@pytest.mark.parametrize(("dimension", "degree"), SIMPLICES)
def test_a_restriction_has_the_values_of_the_whole(dimension, degree):
    coefficients = random_coefficients(dimension, degree)
    start, end = random_points(dimension, 3, seed=7), random_points(dimension, 3, seed=8)
    along = bernstein.restrict(coefficients, start, end)
    assert along.shape == (3, degree + 1)
    for t in (0.0, 0.3, 1.0):
        values = bernstein.evaluate(along, torch.tensor([1 - t, t], dtype=torch.float64))
        assert_exact(values, coefficients, (1 - t) * start + t * end, 4 * degree + 4)


@pytest.mark.parametrize(("dimension", "degree"), SIMPLICES)
def test_neighbouring_segments_share_their_end_to_the_bit(dimension, degree):
    coefficients = random_coefficients(dimension, degree)
    first, shared, last = random_points(dimension, 3, seed=9)
    left, right = bernstein.restrict(coefficients, first, shared), bernstein.restrict(coefficients, shared, last)
    assert left[-1] == right[0] == bernstein.evaluate(coefficients, shared)


@pytest.mark.parametrize(("dimension", "degree"), SIMPLICES)
def test_values_keep_between_the_bounds(dimension, degree):
    coefficients, points = random_coefficients(dimension, degree, 3, 1), random_points(dimension, 50)
    low, high = bernstein.bounds(coefficients)
    values = bernstein.evaluate(coefficients, points)
    assert values.shape == (3, 50)
    assert bool(((low - 1e-15 <= values) & (values <= high + 1e-15)).all())


@pytest.mark.parametrize(("dimension", "degree"), SIMPLICES)
def test_vertices_may_be_renamed_and_values_shifted(dimension, degree):
    """Permuted vertices: the same polynomial with permuted multi-indices; a·p + b has the coefficients a·c + b."""
    coefficients, points = random_coefficients(dimension, degree), random_points(dimension, 4)
    order = indices(dimension, degree)
    values = bernstein.evaluate(coefficients, points)
    for permutation in itertools.permutations(range(dimension + 1)):
        moved = [order.index(tuple(alpha[k] for k in permutation)) for alpha in order]
        permuted = torch.empty_like(coefficients)
        permuted[moved] = coefficients
        torch.testing.assert_close(
            bernstein.evaluate(permuted, points[:, list(permutation)]), values, rtol=0, atol=1e-14
        )
    torch.testing.assert_close(bernstein.evaluate(3 * coefficients + 2, points), 3 * values + 2, rtol=0, atol=1e-13)


@pytest.mark.parametrize(("dimension", "degree"), [(1, 3), (2, 4), (3, 3)])
def test_the_polar_form_is_symmetric_and_affine(dimension, degree):
    coefficients = random_coefficients(dimension, degree)
    points = list(random_points(dimension, degree, seed=10))
    value = bernstein.blossom(coefficients, points)
    for order in itertools.permutations(points):
        torch.testing.assert_close(bernstein.blossom(coefficients, order), value, rtol=0, atol=1e-14)
    other = random_points(dimension, seed=11)
    mixed = bernstein.blossom(coefficients, [0.25 * points[0] + 0.75 * other, *points[1:]])
    parts = 0.25 * value + 0.75 * bernstein.blossom(coefficients, [other, *points[1:]])
    torch.testing.assert_close(mixed, parts, rtol=0, atol=1e-14)


@pytest.mark.parametrize("degree", range(10))
def test_powers_and_back(degree):
    coefficients = random_coefficients(1, degree, 2)
    powers = bernstein.to_monomial(coefficients)
    torch.testing.assert_close(bernstein.from_monomial(powers), coefficients, rtol=0, atol=1e-12)
    t = torch.tensor(0.375, dtype=torch.float64)
    value = sum(powers[..., j] * t**j for j in range(degree + 1))
    torch.testing.assert_close(bernstein.evaluate(coefficients, bernstein.on_interval(t)), value, rtol=0, atol=1e-12)


@pytest.mark.parametrize(("dimension", "degree"), [(1, 4), (2, 3), (3, 2)])
def test_everything_is_differentiable_twice(dimension, degree):
    coefficients = random_coefficients(dimension, degree).requires_grad_()
    start, end = (random_points(dimension, seed=s).requires_grad_() for s in (12, 13))

    def all_of_it(coefficients, start, end):
        along = bernstein.restrict(coefficients, start, end)
        square = bernstein.multiply(coefficients, bernstein.elevate(coefficients, dimension), dimension)
        slope = bernstein.derivative(square, start - end)
        return along, bernstein.evaluate(slope, end)

    assert torch.autograd.gradcheck(all_of_it, (coefficients, start, end))
    assert torch.autograd.gradgradcheck(all_of_it, (coefficients, start, end), fast_mode=dimension > 1)


def test_float32_stays_float32_and_axes_broadcast():
    coefficients = torch.rand(4, 1, 10)
    points = torch.rand(5, 3)
    assert bernstein.evaluate(coefficients, points).dtype == torch.float32
    assert bernstein.evaluate(coefficients, points).shape == (4, 5)
    assert bernstein.restrict(coefficients, points, points[:1]).shape == (4, 5, 4)
    assert bernstein.evaluate(torch.rand(2, 1), points[:, None]).shape == (5, 2)


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: bernstein.evaluate(torch.rand(5), torch.rand(3)), r"1, 3, 6, 10, … entries.*got \(5,\)"),
        (lambda: bernstein.evaluate(torch.rand(6), torch.rand(1)), r"`barycentric` must have shape.*got \(1,\)"),
        (lambda: bernstein.blossom(torch.rand(3), [torch.rand(3)] * 2), "1 arguments at most for degree 1; got 2"),
        (lambda: bernstein.restrict(torch.rand(3), torch.rand(3), torch.rand(2)), "points of one simplex"),
        (lambda: bernstein.elevate(torch.rand(()), 2), r"got \(\)"),
    ],
)
def test_what_fits_nothing_is_refused(call, words):
    with pytest.raises(ValueError, match=words):
        call()
