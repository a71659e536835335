"""FAMILIES of polynomials in Bernstein form that root finders fail on, each with what is known of its first root.

Letters: n degree, N how many. Coefficients (N, n + 1) float64; known (N,): a root in [0, 1] by construction, the first
one unless the polynomial has another before it; NaN where none is known. Rounding the coefficients may move it.
"""

from __future__ import annotations

from collections.abc import Callable
from math import comb, nan

import torch
from torch import Generator, Tensor

Made = tuple[Tensor, Tensor]
Family = Callable[[int, int, Generator], Made]


def _uniform(shape: tuple[int, ...], low: float, high: float, generator: Generator) -> Tensor:
    return low + (high - low) * torch.rand(shape, generator=generator, dtype=torch.float64)


def _powers_of_ten(count: int, low: float, high: float, generator: Generator) -> Tensor:
    return 10 ** _uniform((count,), low, high, generator)


def _unknown(count: int) -> Tensor:
    return torch.full((count,), nan, dtype=torch.float64)


def product(a: Tensor, b: Tensor) -> Tensor:
    """The Bernstein coefficients of a product: scaled by binomials they are convolved."""
    m, n = a.shape[-1] - 1, b.shape[-1] - 1
    out = torch.zeros(*a.shape[:-1], m + n + 1, dtype=a.dtype)
    for i in range(m + 1):
        for j in range(n + 1):
            out[..., i + j] += comb(m, i) * comb(n, j) / comb(m + n, i + j) * a[..., i] * b[..., j]
    return out


def factor(root: Tensor) -> Tensor:
    """t − root."""
    return torch.stack((-root, 1 - root), -1)


def pair(real: Tensor, imaginary: Tensor) -> Tensor:
    """(t − real)² + imaginary²."""
    rest = imaginary**2
    return torch.stack((real**2 + rest, real**2 - real + rest, (1 - real) ** 2 + rest), -1)


def _random(n: int, count: int, generator: Generator) -> Made:
    return _uniform((count, n + 1), -1, 1, generator), _unknown(count)


def _with_roots(roots: Tensor, n: int, generator: Generator) -> Made:
    """Of those roots (N, k), times a random polynomial of degree n − k."""
    c, _ = _random(n - roots.shape[1], len(roots), generator)
    for root in roots.unbind(1):
        c = product(c, factor(root))
    known = torch.where((roots >= 0) & (roots <= 1), roots, 2).amin(1)
    return c, torch.where(known <= 1, known, nan)


def _clustered(n: int, count: int, generator: Generator) -> Made:
    """n roots within 10⁻⁴ to 10⁻¹."""
    middle, spread = _uniform((count, 1), 0, 1, generator), _powers_of_ten(count, -4, -1, generator)
    return _with_roots(middle + spread[:, None] * _uniform((count, n), -0.5, 0.5, generator), n, generator)


def _double(n: int, count: int, generator: Generator) -> Made:
    root = _uniform((count, 1), 0, 1, generator)
    return _with_roots(root.expand(-1, 2), n, generator)


def _near_double(n: int, count: int, generator: Generator) -> Made:
    """Two roots 10⁻⁷ to 10⁻² apart."""
    root, gap = _uniform((count,), 0, 0.99, generator), _powers_of_ten(count, -7, -2, generator)
    return _with_roots(torch.stack((root, root + gap), 1), n, generator)


def _small_leading(n: int, count: int, generator: Generator) -> Made:
    """The coefficient of t^n is 10⁻¹⁴ to 10⁻⁵."""
    c, known = _raised(n, n - 1, count, generator)
    c[:, -1] += _powers_of_ten(count, -14, -5, generator) * (1 - 2 * (_uniform((count,), 0, 1, generator) < 0.5))
    return c, known


def _raised(n: int, degree: int, count: int, generator: Generator) -> Made:
    c, known = _random(degree, count, generator)
    return product(c, torch.ones(count, n - degree + 1, dtype=c.dtype)), known


def _degree_raised(n: int, count: int, generator: Generator) -> Made:
    """Of degree 1 to n − 1, written with n + 1 coefficients."""
    degrees = range(1, n)
    sizes = [count // len(degrees) + (k < count % len(degrees)) for k in range(len(degrees))]
    parts = [_raised(n, d, size, generator) for d, size in zip(degrees, sizes, strict=True)]
    return torch.cat([c for c, _ in parts]), torch.cat([known for _, known in parts])


def _wide_scale(n: int, count: int, generator: Generator) -> Made:
    """Coefficients from 10⁻¹² to 10¹²."""
    c, known = _random(n, count, generator)
    return c.sign() * 10 ** _uniform((count, n + 1), -12, 12, generator), known


def _no_root(n: int, count: int, generator: Generator) -> Made:
    """Pairs of complex roots 10⁻⁶ to 1 from the axis, and one real root outside where n is odd."""
    outside = 1 + _powers_of_ten(count, -6, 0, generator)
    c = factor(outside) if n % 2 else torch.ones(count, 1, dtype=torch.float64)
    for _ in range(n // 2):
        c = product(c, pair(_uniform((count,), 0, 1, generator), _powers_of_ten(count, -6, 0, generator)))
    return c * (1 - 2 * (_uniform((count, 1), 0, 1, generator) < 0.5)), _unknown(count)


def _root_at_end(n: int, count: int, generator: Generator) -> Made:
    """c_0 = 0, or c_n = 0, or both."""
    c, _ = _random(n, count, generator)
    which = torch.randint(3, (count,), generator=generator)
    c[which != 1, 0] = 0
    c[which != 0, -1] = 0
    return c, torch.where(which != 1, 0, torch.ones(count, dtype=torch.float64))


FAMILIES: dict[str, Family] = {
    "random": _random,
    "clustered": _clustered,
    "double": _double,
    "near-double": _near_double,
    "small-leading": _small_leading,
    "degree-raised": _degree_raised,
    "wide-scale": _wide_scale,
    "no-root": _no_root,
    "root-at-end": _root_at_end,
}
