"""The independent truth: reconstruction written out from its definitions in numpy float64, slow and plain.

Nothing here imports filterlab. Letters: samples f are `(D, H, W)`; points are `(P, 3)` in x, y, z order, in voxels; x
runs along W, y along H, z along D. A reconstruction is f(x) = Σ_k c_k φ(x−k) along every axis, with c = f deconvolved
by the sampled kernel, both over ALL integers: the samples are continued by the boundary beyond every tail that matters.

Kernels are the textbook formulas in |x|: Mitchell & Netravali 1988 (the paper's eq. 11), eq. 12 and 14 of the
paper, and the centred B-splines as Unser and Thévenaz print them. Derivatives at knots are right-sided.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache

import numpy as np
from numpy.polynomial import Polynomial

BOUNDARIES = ("mirror", "reflect", "wrap", "border", "zeros")
REACH = 64  # voxels of tail that are written out: the slowest pole here is 0.4306 (degree 5), 0.4306^64 = 4e-24

Pieces = tuple[tuple[float, float, Polynomial], ...]


# ---- kernels, in |x|


def bc_pieces(b: float, c: float) -> Pieces:
    """Eq. 11 of the paper."""
    inner = Polynomial([6 - 2 * b, 0, -18 + 12 * b + 6 * c, 12 - 9 * b - 6 * c]) / 6
    outer = Polynomial([8 * b + 24 * c, -12 * b - 48 * c, 6 * b + 30 * c, -b - 6 * c]) / 6
    return ((0, 1, inner), (1, 2, outer))


PIECES: dict[str, Pieces] = {
    "bspline0": ((0, 0.5, Polynomial([1])),),
    "linear": ((0, 1, Polynomial([1, -1])),),
    "bspline1": ((0, 1, Polynomial([1, -1])),),
    "bspline2": ((0, 0.5, Polynomial([6, 0, -8]) / 8), (0.5, 1.5, Polynomial([9, -12, 4]) / 8)),  # eq. 14
    "bspline3": ((0, 1, Polynomial([4, 0, -6, 3]) / 6), (1, 2, Polynomial([8, -12, 6, -1]) / 6)),
    "bspline4": (
        (0, 0.5, Polynomial([115, 0, -120, 0, 48]) / 192),
        (0.5, 1.5, Polynomial([55, 20, -120, 80, -16]) / 96),
        (1.5, 2.5, Polynomial([5, -2]) ** 4 / 384),
    ),
    "bspline5": (
        (0, 1, Polynomial([66, 0, -60, 0, 30, -10]) / 120),
        (1, 2, Polynomial([51, 75, -210, 150, -45, 5]) / 120),
        (2, 3, Polynomial([3, -1]) ** 5 / 120),
    ),
    "catmull-rom": bc_pieces(0, 0.5),
    "mitchell": bc_pieces(1 / 3, 1 / 3),
    "notch": ((0, 1, Polynomial([2, 0, -1]) / 4), (1, 2, Polynomial([4, -4, 1]) / 4)),  # eq. 12
}


def evaluate(pieces: Pieces, x: np.ndarray, derivative: int = 0) -> np.ndarray:
    """φ^(derivative)(x); at a knot the value of the piece to its right."""
    x = np.asarray(x, dtype=np.float64)
    a, out = np.abs(x), np.zeros(np.shape(x))
    sign = np.where(x >= 0, 1.0, -1.0) ** derivative  # d|x|/dx, once per differentiation
    for low, high, polynomial in pieces:
        inside = np.where(x >= 0, (low <= a) & (a < high), (low < a) & (a <= high))
        p = polynomial.deriv(derivative) if derivative else polynomial
        out = np.where(inside, sign * p(a), out)
    return out


def kernel(name: str, x: np.ndarray, derivative: int = 0) -> np.ndarray:
    """The kernel of that name, or its derivative, at x."""
    return evaluate(PIECES[name], x, derivative)


def radius(pieces: Pieces) -> float:
    """φ(x) = 0 for |x| ≥ radius."""
    return pieces[-1][1]


def _quadrature(pieces: Pieces) -> tuple[np.ndarray, np.ndarray]:
    """Gauss-Legendre nodes and weights on every piece of both sides of a kernel."""
    t, w = np.polynomial.legendre.leggauss(48)
    intervals = [(s * lo, s * hi) for lo, hi, _ in pieces for s in (-1, 1)]
    nodes = np.concatenate([(a + b) / 2 + (b - a) / 2 * t for a, b in intervals])
    return nodes, np.concatenate([abs(b - a) / 2 * w for a, b in intervals])


def moment(pieces: Pieces, k: int) -> float:
    """∫ x^k φ(x) dx by quadrature."""
    x, w = _quadrature(pieces)
    return float(np.sum(w * x**k * evaluate(pieces, x)))


def fourier(pieces: Pieces, omega: np.ndarray) -> np.ndarray:
    """∫ φ(x) cos(ωx) dx by quadrature (φ is even)."""
    x, w = _quadrature(pieces)
    return np.cos(np.multiply.outer(np.asarray(omega, dtype=np.float64), x)) @ (w * evaluate(pieces, x))


# ---- samples, continued


def source(boundary: str, n: int, index: np.ndarray) -> np.ndarray:
    """Which of the samples 0 … n−1 stands at every integer `index`; −1 where a zero stands."""
    index = np.asarray(index)
    forth = list(range(n))
    match boundary:
        case "mirror":
            period = forth + forth[-2:0:-1]  # a b c d c b
        case "reflect":
            period = forth + forth[::-1]  # a b c d d c b a
        case "wrap":
            period = forth
        case "border":
            return np.clip(index, 0, n - 1)
        case "zeros":
            return np.where((index >= 0) & (index < n), index, -1)
        case _:
            raise ValueError(boundary)
    return np.asarray(period)[index % len(period)]


def extension_matrix(boundary: str, n: int, index: np.ndarray) -> np.ndarray:
    """E with (E f)_m = the sample that stands at index m."""
    return (source(boundary, n, index)[:, None] == np.arange(n)).astype(np.float64)


@lru_cache
def inverse_filter(name: str) -> np.ndarray:
    """h_{−R} … h_R, the infinite inverse of the kernel sampled at the integers: Σ_m h_{k−m} φ(m) = δ_k.

    Written as the inverse transform of 1/Q(ω), Q(ω) = Σ_m φ(m) cos(mω), on 1024 frequencies: what wraps round is below
    |pole|^900.
    """
    k = np.arange(-REACH, REACH + 1)
    omega = 2 * np.pi * np.arange(1024) / 1024
    m = np.arange(-3, 4)
    response = np.cos(np.multiply.outer(omega, m)) @ kernel(name, m)
    return np.cos(np.multiply.outer(k, omega)) @ (1 / response) / 1024


@dataclass(frozen=True)
class Recipe:
    """What a separable method is: its kernel, and the kernels whose samples its prefilter divides by."""

    kernel: str
    deconvolve: tuple[str, ...] = ()


RECIPES: dict[str, Recipe] = {
    "nearest": Recipe("bspline0"),
    "trilinear": Recipe("linear"),
    "catmull-rom": Recipe("catmull-rom"),
    "triquadratic": Recipe("bspline2", ("bspline2",)),
    "notch": Recipe("notch", ("bspline2", "bspline2")),
    "mitchell": Recipe("mitchell"),
    "tricubic": Recipe("bspline3", ("bspline3",)),
}
METHODS = (*RECIPES, "ncrsi")


def coefficient_matrix(deconvolve: Sequence[str], boundary: str, n: int, index: np.ndarray) -> np.ndarray:
    """C with c_k = (C f)_k for every k of `index` (consecutive integers): the deconvolved continuation of n samples."""
    reach = REACH * len(deconvolve)
    matrix = extension_matrix(boundary, n, np.arange(index[0] - reach, index[-1] + reach + 1))
    for name in deconvolve:
        h = inverse_filter(name)
        matrix = np.stack([np.convolve(column, h, mode="valid") for column in matrix.T], axis=-1)
    return matrix


def axis_weights(
    pieces: Pieces, deconvolve: Sequence[str], boundary: str, n: int, x: np.ndarray, derivative: int = 0
) -> np.ndarray:
    """W `(P, n)` with f^(derivative)(x_p) = Σ_i W_pi f_i along one axis of n samples."""
    reach = int(np.ceil(radius(pieces))) + 1
    index = np.arange(int(np.floor(x.min())) - reach, int(np.ceil(x.max())) + reach + 1)
    taps = evaluate(pieces, x[:, None] - index, derivative)
    return taps @ coefficient_matrix(deconvolve, boundary, n, index)


def tensor_product(
    samples: np.ndarray,
    points: np.ndarray,
    pieces: Pieces,
    deconvolve: Sequence[str] = (),
    boundary: str = "mirror",
    order: int = 1,
) -> tuple[np.ndarray, ...]:
    """(value (P), gradient (P, 3), Hessian (P, 3, 3)) up to `order`, per voxel, of Σ c_k φ(x−k) along every axis."""
    samples, points = np.asarray(samples, dtype=np.float64), np.asarray(points, dtype=np.float64)
    size = samples.shape[::-1]
    weights = [
        [axis_weights(pieces, deconvolve, boundary, size[d], points[:, d], j) for j in range(order + 1)]
        for d in range(3)
    ]

    def derivative(*axes: int) -> np.ndarray:
        wx, wy, wz = (weights[d][axes.count(d)] for d in range(3))
        rows = np.einsum("pz,zyx->pyx", wz, samples)
        return np.einsum("px,px->p", wx, np.einsum("py,pyx->px", wy, rows))

    out = [derivative()]
    if order >= 1:
        out.append(np.stack([derivative(d) for d in range(3)], -1))
    if order >= 2:
        out.append(np.stack([np.stack([derivative(d, e) for e in range(3)], -1) for d in range(3)], -2))
    return tuple(out)


# ---- trilinear with central differences, NCRSI


def trilinear(samples: np.ndarray, points: np.ndarray, boundary: str, order: int = 0) -> tuple[np.ndarray, ...]:
    """The trilinear interpolant T and its one-sided (right-hand) derivatives."""
    return tensor_product(samples, points, PIECES["linear"], (), boundary, order)


def central_difference(samples: np.ndarray, points: np.ndarray, boundary: str) -> np.ndarray:
    """(T(x + e_d) − T(x − e_d)) / 2 per voxel, `(P, 3)`."""
    steps = np.eye(3)
    plus = [trilinear(samples, points + e, boundary)[0] for e in steps]
    minus = [trilinear(samples, points - e, boundary)[0] for e in steps]
    return (np.stack(plus, -1) - np.stack(minus, -1)) / 2


def ncrsi(
    samples: np.ndarray, points: np.ndarray, boundary: str, gradient: str = "central", order: int = 1
) -> tuple[np.ndarray, ...]:
    """f = T − Σ_d ½ α_d (1−α_d) (T₊ − 2T + T₋), with its published central differences or its own derivatives.

    With D_d = T(x+e_d) − 2T(x) + T(x−e_d) and b(α) = ½α(1−α):
    ∂_e f = ∂_e T − b'(α_e) D_e − Σ_d b(α_d) ∂_e D_d, and once more for the Hessian:
    ∂_e∂_g f = ∂_e∂_g T − [e=g] b''(α_e) D_e − b'(α_e) ∂_g D_e − b'(α_g) ∂_e D_g − Σ_d b(α_d) ∂_e∂_g D_d.
    """
    points = np.asarray(points, dtype=np.float64)
    alpha = points - np.floor(points)
    b, db, ddb = alpha * (1 - alpha) / 2, (1 - 2 * alpha) / 2, -1.0
    depth = 0 if gradient == "central" else order
    t = trilinear(samples, points, boundary, depth)
    second = [  # second[d][j]: j-th derivatives of D_d
        [p - 2 * m + q for p, m, q in zip(*jets, strict=True)]
        for jets in (
            (trilinear(samples, points + e, boundary, depth), t, trilinear(samples, points - e, boundary, depth))
            for e in np.eye(3)
        )
    ]
    value = t[0] - sum(b[:, d] * second[d][0] for d in range(3))
    if order == 0:
        return (value,)
    if gradient == "central":
        if order > 1:
            raise ValueError("central differences stop at the gradient")
        return value, central_difference(samples, points, boundary)
    curvature = np.stack([second[d][0] for d in range(3)], -1)
    g = t[1] - db * curvature - sum(b[:, d, None] * second[d][1] for d in range(3))
    if order == 1:
        return value, g
    mixed = db[:, :, None] * np.stack([second[e][1] for e in range(3)], -2)  # [e, g]: b'(α_e) ∂_g D_e
    h = t[2] - mixed - mixed.swapaxes(-1, -2) - sum(b[:, d, None, None] * second[d][2] for d in range(3))
    h -= ddb * curvature[:, :, None] * np.eye(3)
    return value, g, h


def reconstruct(
    method: str,
    samples: np.ndarray,
    points: np.ndarray,
    boundary: str = "mirror",
    prefilter: bool = True,
    gradient: str = "analytic",
    order: int = 1,
) -> tuple[np.ndarray, ...]:
    """(value, gradient, Hessian) up to `order` of a method at `points` `(P, 3)`, everything per voxel."""
    if method == "ncrsi":
        return ncrsi(samples, points, boundary, gradient, order)
    if method not in RECIPES:
        from tests import tetrahedral_oracle  # which is built on this file

        return tetrahedral_oracle.reconstruct(method, samples, points, boundary, prefilter, order)
    recipe = RECIPES[method]
    deconvolve = recipe.deconvolve if prefilter else ()
    if gradient == "central":
        if method != "trilinear" or order != 1:
            raise ValueError("central differences are the gradient of the trilinear baseline and of ncrsi")
        return trilinear(samples, points, boundary)[0], central_difference(samples, points, boundary)
    return tensor_product(samples, points, PIECES[recipe.kernel], deconvolve, boundary, order)


# ---- the schemes of trilinear samples, sample by sample


def coefficients(samples: np.ndarray, deconvolve: Sequence[str], boundary: str, index: np.ndarray) -> np.ndarray:
    """c at every (z, y, x) of index³ (the same consecutive integers along each axis)."""
    c = np.asarray(samples, dtype=np.float64)
    for axis, n in enumerate(c.shape):
        c = np.moveaxis(np.tensordot(coefficient_matrix(deconvolve, boundary, n, index), c, (1, axis)), 0, axis)
    return c


def texture(c: np.ndarray, first: int, points: np.ndarray, steps: int | None) -> np.ndarray:
    """What a texture unit returns: 8 texels blended with fractions rounded to 1/steps (None: exact)."""
    i = np.floor(points).astype(int)
    fraction = points - i
    if steps is not None:
        fraction = np.floor(fraction * steps + 0.5) / steps
    i = i - first
    out = np.zeros(len(points))
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(np.array(corner), fraction, 1 - fraction), axis=-1)
        x, y, z = (i + np.array(corner)).T
        out += weight * c[z, y, x]
    return out


def linear_pairs(method: str, x: np.ndarray) -> tuple[list[tuple[np.ndarray, np.ndarray]], list]:
    """Two (weight, position) pairs for the value, and two for the derivative, along one axis.

    triquadratic: eq. 6, 7 and 9 of the paper. tricubic: eq. 2 and 3, and the same with the derivatives of eq. 2.
    """
    if method == "triquadratic":
        beta = x - np.floor(x + 0.5)
        at = (x - (0.25 + beta / 2), x + (0.25 - beta / 2))
        return [(0.5 - beta, at[0]), (0.5 + beta, at[1])], [(-2 + 0 * x, at[0]), (2 + 0 * x, at[1])]
    i = np.floor(x)
    a = x - i
    w = [(-(a**3) + 3 * a**2 - 3 * a + 1) / 6, (3 * a**3 - 6 * a**2 + 4) / 6]
    w += [(-3 * a**3 + 3 * a**2 + 3 * a + 1) / 6, a**3 / 6]
    d = [(-3 * a**2 + 6 * a - 3) / 6, (9 * a**2 - 12 * a) / 6, (-9 * a**2 + 6 * a + 3) / 6, 3 * a**2 / 6]
    return tuple(  # type: ignore[return-value]
        [(v[0] + v[1], i - 1 + v[1] / (v[0] + v[1])), (v[2] + v[3], i + 1 + v[3] / (v[2] + v[3]))] for v in (w, d)
    )


def trilinear_scheme(
    method: str,
    samples: np.ndarray,
    points: np.ndarray,
    boundary: str = "mirror",
    prefilter: bool = True,
    steps: int | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Value and gradient (per voxel) from trilinear samples whose fractions are rounded to 1/steps (None: exact).

    Eq. 24-25 for triquadratic and (on averages at half-integers, eq. 15) notch; Sigg & Hadwiger's 8 + 24 for tricubic;
    the seven samples for ncrsi and for trilinear with central differences.
    """
    points = np.asarray(points, dtype=np.float64)
    recipe = RECIPES.get(method, RECIPES["trilinear"])
    deconvolve = recipe.deconvolve if prefilter else ()
    first = int(np.floor(points.min())) - 5
    c = coefficients(samples, deconvolve, boundary, np.arange(first, int(np.ceil(points.max())) + 6))
    if method in ("trilinear", "ncrsi"):
        t = texture(c, first, points, steps)
        plus, minus = (np.stack([texture(c, first, points + s * e, steps) for e in np.eye(3)], -1) for s in (1, -1))
        alpha = points - np.floor(points)
        bend = (alpha * (1 - alpha) / 2 * (plus - 2 * t[:, None] + minus)).sum(-1)
        return (t - bend if method == "ncrsi" else t), (plus - minus) / 2
    if method == "notch":
        for axis in range(3):  # a_{k+½} = (c_k + c_{k+1}) / 2 stands at index k
            c = (np.delete(c, -1, axis) + np.delete(c, 0, axis)) / 2
        points, method = points - 0.5, "triquadratic"
    pairs = [linear_pairs(method, points[:, d]) for d in range(3)]

    def summed(orders: Sequence[int]) -> np.ndarray:
        total = np.zeros(len(points))
        for choice in np.ndindex(2, 2, 2):
            picked = [pairs[d][orders[d]][choice[d]] for d in range(3)]
            at = np.stack([position for _, position in picked], -1)
            total += np.prod([weight for weight, _ in picked], axis=0) * texture(c, first, at, steps)
        return total

    gradient = np.stack([summed(np.eye(3, dtype=int)[d]) for d in range(3)], -1)
    return summed((0, 0, 0)), gradient


# ---- frequency responses


def sampled_response(name: str, omega: np.ndarray) -> np.ndarray:
    """Q(ω) = Σ_m φ(m) cos(mω)."""
    m = np.arange(-3, 4)
    return np.cos(np.multiply.outer(np.asarray(omega, dtype=np.float64), m)) @ kernel(name, m)


def axis_response(method: str, omega: np.ndarray, prefilter: bool = True) -> np.ndarray:
    """P(ω)Φ(ω) along one axis. A wave along one axis meets ncrsi as a Catmull-Rom spline."""
    recipe = RECIPES["catmull-rom" if method == "ncrsi" else method]
    out = fourier(PIECES[recipe.kernel], omega)
    for name in recipe.deconvolve if prefilter else ():
        out = out / sampled_response(name, omega)
    return out


def textbook_response(method: str, omega: np.ndarray, prefilter: bool = True) -> np.ndarray:
    """The closed forms the paper prints: eq. 19, 20, and sinc powers (sinc(ω) = sin(ω/2)/(ω/2))."""
    omega = np.asarray(omega, dtype=np.float64)
    sinc = np.sinc(omega / (2 * np.pi))
    quad, cubic = (3 + np.cos(omega)) / 4, (2 + np.cos(omega)) / 3
    match method:
        case "trilinear":
            return sinc**2
        case "triquadratic":
            return sinc**3 / (quad if prefilter else 1)
        case "notch":
            return np.cos(omega / 2) * sinc**3 / (quad**2 if prefilter else 1)
        case "tricubic":
            return sinc**4 / (cubic if prefilter else 1)
    raise ValueError(f"the paper prints no closed form for {method}")


# ---- exact B-splines


def bspline_exact(degree: int, x: Fraction) -> Fraction:
    """Cox-de Boor: β^d(x) = [(h + x) β^{d−1}(x+½) + (h − x) β^{d−1}(x−½)] / d, h = (d+1)/2; β⁰ is 1 on [−½, ½)."""
    if degree == 0:
        return Fraction(int(-Fraction(1, 2) <= x < Fraction(1, 2)))
    h, half = Fraction(degree + 1, 2), Fraction(1, 2)
    left, right = bspline_exact(degree - 1, x + half), bspline_exact(degree - 1, x - half)
    return ((h + x) * left + (h - x) * right) / degree
