"""Bernstein form on the interval, the triangle, the tetrahedron: one code for the simplex of any dimension.

Letters: d dimension, n degree, λ = (λ_0, …, λ_d) barycentric coordinates (Σ λ_k = 1, last axis), α = (α_0, …, α_d) a
multi-index with |α| = Σ α_k = n, e_k the one with a single 1 at k.

    p(λ) = Σ_α c_α B_α(λ),   B_α(λ) = n! / (α_0! … α_d!) · λ_0^α_0 … λ_d^α_d

Coefficients stand on the last axis, binom(n + d, d) of them, α descending lexicographically:

    interval     (n, 0) (n − 1, 1) … (0, n)                    c_i belongs to (n − i, i);  λ = (1 − t, t)
    triangle     (2, 0, 0) (1, 1, 0) (1, 0, 1) (0, 2, 0) (0, 1, 1) (0, 0, 2)                       for n = 2
    tetrahedron  (1, 0, 0, 0) (0, 1, 0, 0) (0, 0, 1, 0) (0, 0, 0, 1)                               for n = 1

The dimension is that of the barycentric coordinates, or is given; the degree follows from the number of coefficients.
Leading axes broadcast. Everything is differentiable any number of times in coefficients and coordinates.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import lru_cache
from math import comb, factorial, prod

import torch
from torch import Tensor

Index = tuple[int, ...]


def multi_indices(degree: int, dimension: int) -> tuple[Index, ...]:
    """Every α with |α| = degree, in the order of the coefficients."""
    return tuple(_descending(degree, dimension))


def _descending(total: int, dimension: int) -> Iterator[Index]:
    if dimension == 0:
        yield (total,)
        return
    for first in range(total, -1, -1):
        for rest in _descending(total - first, dimension - 1):
            yield (first, *rest)


def degree_of(coefficients: Tensor, dimension: int) -> int:
    """n of binom(n + d, d) coefficients. Raises ValueError where no degree has so many."""
    count = coefficients.shape[-1] if coefficients.ndim else 0
    degree = 0
    while comb(degree + dimension, dimension) < count:
        degree += 1
    if comb(degree + dimension, dimension) != count:
        raise ValueError(
            f"`coefficients` must have binom(n + {dimension}, {dimension}) = "
            f"{', '.join(str(comb(n + dimension, dimension)) for n in range(4))}, … entries on the last axis "
            f"for dimension {dimension}; got {tuple(coefficients.shape)}"
        )
    return degree


def _dimension_of(coordinates: Tensor, name: str) -> int:
    if coordinates.ndim == 0 or coordinates.shape[-1] < 2:
        raise ValueError(f"`{name}` must have shape (..., d + 1), d ≥ 1; got {tuple(coordinates.shape)}")
    return coordinates.shape[-1] - 1


def evaluate(coefficients: Tensor, barycentric: Tensor) -> Tensor:
    """p(λ), by de Casteljau's algorithm.

    Args:
        coefficients: (..., binom(n + d, d)).
        barycentric: λ (..., d + 1); it is extrapolated outside of the simplex.

    Returns:
        (...), the leading axes broadcast.

    Raises:
        ValueError: the number of coefficients is that of no degree.
    """
    degree = degree_of(coefficients, _dimension_of(barycentric, "barycentric"))
    shape = torch.broadcast_shapes(coefficients.shape[:-1], barycentric.shape[:-1])
    return blossom(coefficients, [barycentric] * degree)[..., 0].expand(shape)


def blossom(coefficients: Tensor, points: Sequence[Tensor]) -> Tensor:
    """The polar form after m ≤ n arguments: b[λ¹, …, λᵐ, ·], again in Bernstein form, of degree n − m.

    b is symmetric and affine in each argument, and b[λ, …, λ] = p(λ). One step of de Casteljau's algorithm takes one
    argument: c_β ← Σ_k λ_k c_(β + e_k), |β| = n − 1.

    Args:
        coefficients: (..., binom(n + d, d)).
        points: m times (..., d + 1).

    Returns:
        (..., binom(n − m + d, d)): with m = n one number, the value.

    Raises:
        ValueError: more arguments than the degree, or a number of coefficients of no degree.
    """
    if not points:
        return coefficients
    dimension = _dimension_of(points[0], "points")
    degree = degree_of(coefficients, dimension)
    if len(points) > degree:
        raise ValueError(f"`points` must be {degree} arguments at most for degree {degree}; got {len(points)}")
    for k, point in enumerate(points):
        coefficients = _step(coefficients, point, degree - k)
    return coefficients


def _step(coefficients: Tensor, weights: Tensor, degree: int) -> Tensor:
    """Σ_k weights_k c_(β + e_k) for every |β| = degree − 1.

    Taken together along the first axis, where what belongs to one β lies together: 3 to 10 times as fast.
    """
    tables = _raised_tables(degree, weights.shape[-1] - 1)
    leading, device = coefficients[(None,) * (weights.ndim - coefficients.ndim)].movedim(-1, 0), coefficients.device
    terms = [
        leading.index_select(0, torch.tensor(table, device=device)) * weight
        for table, weight in zip(tables, weights.unbind(-1), strict=True)
    ]
    return sum(terms[1:], terms[0]).movedim(0, -1)


_RAISED: dict[tuple[int, int], tuple[list[int], ...]] = {}
"""What `_raised_tables` found; kept here, since of `lru_cache` torch.compile warns."""


def _raised_tables(degree: int, dimension: int) -> tuple[list[int], ...]:
    """For every k the places of β + e_k, |β| = degree − 1."""
    if (degree, dimension) not in _RAISED:
        _RAISED[degree, dimension] = _made_raised_tables(degree, dimension)
    return _RAISED[degree, dimension]


def _made_raised_tables(degree: int, dimension: int) -> tuple[list[int], ...]:
    place = {alpha: i for i, alpha in enumerate(multi_indices(degree, dimension))}
    lower = multi_indices(degree - 1, dimension)
    return tuple([place[_plus(beta, k)] for beta in lower] for k in range(dimension + 1))


def _plus(alpha: Index, k: int, amount: int = 1) -> Index:
    return (*alpha[:k], alpha[k] + amount, *alpha[k + 1 :])


def derivative(coefficients: Tensor, direction: Tensor) -> Tensor:
    """The derivative along a direction, in Bernstein form of degree n − 1: n Σ_k v_k c_(β + e_k).

    Args:
        coefficients: (..., binom(n + d, d)).
        direction: v (..., d + 1), a difference of barycentric coordinates, Σ v_k = 0: on the interval (−1, 1) is d/dt.

    Returns:
        (..., binom(n − 1 + d, d)); of a constant one zero.

    Raises:
        ValueError: the number of coefficients is that of no degree.
    """
    degree = degree_of(coefficients, _dimension_of(direction, "direction"))
    if degree == 0:
        return 0 * (coefficients + direction[..., :1])
    return degree * _step(coefficients, direction, degree)


def elevate(coefficients: Tensor, dimension: int) -> Tensor:
    """The same polynomial written with degree n + 1: c′_α = Σ_k α_k c_(α − e_k) / (n + 1).

    Args:
        coefficients: (..., binom(n + d, d)).
        dimension: d.

    Returns:
        (..., binom(n + 1 + d, d)).

    Raises:
        ValueError: the number of coefficients is that of no degree.
    """
    degree = degree_of(coefficients, dimension)
    place = {alpha: i for i, alpha in enumerate(multi_indices(degree, dimension))}
    columns = []
    for alpha in multi_indices(degree + 1, dimension):
        terms = [a * coefficients[..., place[_plus(alpha, k, -1)]] for k, a in enumerate(alpha) if a]
        columns.append(sum(terms[1:], terms[0]) / (degree + 1))
    return torch.stack(columns, -1)


def multiply(a: Tensor, b: Tensor, dimension: int) -> Tensor:
    """The product, in Bernstein form of degree m + n.

    c_γ = Σ_(α + β = γ) a_α b_β · [m! / α!] [n! / β!] / [(m + n)! / γ!], with α! = α_0! … α_d!.

    Args:
        a: (..., binom(m + d, d)).
        b: (..., binom(n + d, d)).
        dimension: d.

    Returns:
        (..., binom(m + n + d, d)).

    Raises:
        ValueError: a number of coefficients is that of no degree.
    """
    m, n = degree_of(a, dimension), degree_of(b, dimension)
    scaled_a, scaled_b = (_scaled(c, k, dimension) for c, k in ((a, m), (b, n)))
    columns = []
    for pairs in _summands(m, n, dimension):
        terms = [scaled_a[..., i] * scaled_b[..., j] for i, j in pairs]
        columns.append(sum(terms[1:], terms[0]))
    return torch.stack(columns, -1) / _multinomials(a, m + n, dimension)


def _scaled(coefficients: Tensor, degree: int, dimension: int) -> Tensor:
    return coefficients * _multinomials(coefficients, degree, dimension)


def _multinomials(like: Tensor, degree: int, dimension: int) -> Tensor:
    """n! / α! for every α."""
    numbers = [multinomial(alpha) for alpha in multi_indices(degree, dimension)]
    return torch.tensor(numbers, dtype=like.dtype, device=like.device)


def multinomial(alpha: Index) -> int:
    """|α|! / (α_0! … α_d!)."""
    return factorial(sum(alpha)) // prod(map(factorial, alpha))


@lru_cache
def _summands(m: int, n: int, dimension: int) -> tuple[tuple[tuple[int, int], ...], ...]:
    """For every γ the places of all α, β with α + β = γ."""
    pairs: dict[Index, list[tuple[int, int]]] = {gamma: [] for gamma in multi_indices(m + n, dimension)}
    for i, alpha in enumerate(multi_indices(m, dimension)):
        for j, beta in enumerate(multi_indices(n, dimension)):
            pairs[tuple(x + y for x, y in zip(alpha, beta, strict=True))].append((i, j))
    return tuple(map(tuple, pairs.values()))


def restrict(coefficients: Tensor, start: Tensor, end: Tensor) -> Tensor:
    """p on the segment from `start` to `end` as a univariate polynomial in Bernstein form: c_j = b[start^(n − j),
    end^j].

    c_0 and c_n are the values at the ends, computed from that end alone as `evaluate` computes them: neighbouring
    segments share them to the bit. On the interval this is the part of p between two parameters.

    Args:
        coefficients: (..., binom(n + d, d)).
        start: λ (..., d + 1).
        end: λ (..., d + 1).

    Returns:
        (..., n + 1), leading axes broadcast.

    Raises:
        ValueError: the number of coefficients is that of no degree; ends of different dimensions.
    """
    dimension = _dimension_of(start, "start")
    if _dimension_of(end, "end") != dimension:
        raise ValueError(
            f"`start` and `end` must be points of one simplex; got {tuple(start.shape)} and {tuple(end.shape)}"
        )
    degree = degree_of(coefficients, dimension)
    from_end = [blossom(coefficients, [end] * j) for j in range(degree + 1)]
    columns = [blossom(c, [start] * (degree - j))[..., 0] for j, c in enumerate(from_end)]
    shape = torch.broadcast_shapes(coefficients.shape[:-1], start.shape[:-1], end.shape[:-1])
    return torch.stack([column.expand(shape) for column in columns], -1)


def bounds(coefficients: Tensor) -> tuple[Tensor, Tensor]:
    """Least and largest coefficient, (...) each: the polynomial keeps between them on its simplex."""
    low, high = coefficients.aminmax(dim=-1)
    return low, high


def on_interval(t: Tensor) -> Tensor:
    """The barycentric coordinates (1 − t, t) of t in [0, 1], (..., 2)."""
    return torch.stack((1 - t, t), -1)


def to_monomial(coefficients: Tensor) -> Tensor:
    """On the interval: (..., n + 1) Bernstein coefficients -> those of t^0 … t^n, a_j = binom(n, j) Δ^j c_0."""
    columns, binomials = [], [comb(coefficients.shape[-1] - 1, j) for j in range(coefficients.shape[-1])]
    for b in binomials:
        columns.append(b * coefficients[..., 0])
        coefficients = coefficients[..., 1:] - coefficients[..., :-1]
    return torch.stack(columns, -1)


def from_monomial(coefficients: Tensor) -> Tensor:
    """On the interval: (..., n + 1) coefficients of t^j -> Bernstein ones, c_i = Σ_j binom(i, j) / binom(n, j) a_j."""
    n = coefficients.shape[-1] - 1
    table = [[comb(i, j) / comb(n, j) for j in range(n + 1)] for i in range(n + 1)]
    weights = torch.tensor(table, dtype=coefficients.dtype, device=coefficients.device)
    return (weights * coefficients[..., None, :]).sum(-1)
