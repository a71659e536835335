"""1-D reconstruction kernels as exact rational piecewise polynomials.

A kernel φ of support S is zero outside [−S/2, S/2] and a polynomial on each of the S unit intervals between. It is
given by its table alone: `pieces[i][j]` is the coefficient of u^j on the interval i, x = −S/2 + i + u, u ∈ [0, 1).
Everything else (derivatives, integer samples, moments, Fourier transform, order, continuity, …) is derived from it.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property, lru_cache

import torch
from torch import Tensor

from filterlab.arrays import Array, as_tensor

Rational = int | float | Fraction
Pieces = tuple[tuple[Fraction, ...], ...]


class PiecewisePolynomial(ABC):
    """What every kernel has, whether its table is exact (`Kernel`) or a tensor (`TensorKernel`)."""

    name: str

    @abstractmethod
    def table(self, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None) -> Tensor:
        """The pieces as a tensor (support, degree + 1): coefficient of u^j on the interval i, from left to right."""

    @property
    @abstractmethod
    def support(self) -> int:
        """S: the width of the interval [−S/2, S/2] outside which φ = 0."""

    @property
    @abstractmethod
    def degree(self) -> int:
        """The highest power of any piece."""

    def taps(self, dtype: torch.dtype, device: torch.device | str | None = None) -> Tensor:
        """The table in the order an evaluator meets it: row t is the weight of tap t as a polynomial in u.

        At x the taps are k = base + t, t = 0 … S−1, base = ⌊x − S/2⌋ + 1 and u = x − S/2 − ⌊x − S/2⌋, and the weight of
        tap t is φ(x − k) = φ(S/2 − 1 − t + u): piece S − 1 − t.
        """
        return self.table(dtype, device).flip(0)

    def __call__(self, x: Array, derivative: int = 0) -> Tensor:
        """φ^(derivative)(x), elementwise; at a knot the piece to its right counts. Differentiable in x."""
        x = as_tensor(x)
        table = differentiate(self.table(x.dtype, x.device), derivative)
        shifted = x + self.support / 2
        piece = torch.nan_to_num(shifted.floor()).clamp(0, self.support - 1).long()
        u = shifted - piece
        value = horner(table[piece].movedim(-1, 0), u)
        return torch.where((shifted >= 0) & (shifted < self.support), value, 0 * value)

    def fourier(self, omega: Array) -> Tensor:
        """φ̂(ω) = ∫ φ(x) e^{−iωx} dx in closed form; complex, to rounding, for every ω (radians per voxel).

        Σ_i e^{−iω(i−S/2)} Σ_j a_ij E_j(ω) with E_j(ω) = ∫₀¹ u^j e^{−iωu} du: by its power series for |ω| < 4, by the
        recursion E_j = (j E_{j−1} − e^{−iω}) / (iω) beyond. Differentiable in ω and in the table.
        """
        omega = as_tensor(omega)
        omega = omega.to(torch.promote_types(omega.dtype, torch.float64))
        table = self.table(torch.float64, omega.device)
        basis = torch.stack(_exponential_moments(omega, self.degree))
        starts = torch.arange(self.support, dtype=torch.float64, device=omega.device) - self.support / 2
        phases = torch.exp(-1j * omega[..., None] * starts)
        return (phases[..., :, None] * table * basis.movedim(0, -1)[..., None, :]).sum((-2, -1))


def horner(coefficients: Sequence[Tensor] | Tensor, u: Tensor) -> Tensor:
    """Σ_j coefficients[j] u^j."""
    value = coefficients[-1] + 0 * u
    for c in reversed(coefficients[:-1]):
        value = value * u + c
    return value


def differentiate(table: Tensor, times: int) -> Tensor:
    """The table of the `times`-th derivative of every piece; one column of zeros when nothing is left."""
    for _ in range(times):
        if table.shape[1] == 1:
            return torch.zeros_like(table)
        table = table[:, 1:] * torch.arange(1, table.shape[1], dtype=table.dtype, device=table.device)
    return table


def _exponential_moments(omega: Tensor, degree: int) -> list[Tensor]:
    """E_j(ω) = ∫₀¹ u^j e^{−iωu} du for j = 0 … degree, complex128."""
    small = omega.abs() < 4
    s = -1j * torch.where(small, omega, torch.zeros_like(omega))
    term, series = torch.ones_like(s), [torch.zeros_like(s) for _ in range(degree + 1)]
    for m in range(45):  # the first term left out: 4^45 / 45! / 46 < 3e-31
        series = [e + term / (m + j + 1) for j, e in enumerate(series)]
        term = term * s / (m + 1)
    w = 1j * torch.where(small, torch.full_like(omega, 4.0), omega)
    end = torch.exp(-w)
    recursed = [(1 - end) / w]
    for j in range(1, degree + 1):
        recursed.append((j * recursed[-1] - end) / w)
    return [torch.where(small, a, b) for a, b in zip(series, recursed, strict=True)]


@dataclass(frozen=True)
class Factor:
    """A kernel as a discrete filter of a simpler one: φ(x) = Σ_k weights[k] · kernel(x − offsets[k])."""

    kernel: Kernel
    offsets: tuple[Fraction, ...]
    weights: tuple[Fraction, ...]


@dataclass(frozen=True, eq=False)
class Kernel(PiecewisePolynomial):
    """An exact kernel.

    Attributes:
        name: as in the registry.
        pieces: the table, exact rationals; all rows of one length.
        factor: when given, the cheaper way to evaluate it (the notch: two half-shifted quadratic B-splines).
    """

    name: str
    pieces: Pieces
    factor: Factor | None = None

    def __post_init__(self) -> None:
        if not self.pieces or len({len(p) for p in self.pieces}) != 1 or not self.pieces[0]:
            raise ValueError(f"a kernel needs pieces of one length; got {self.pieces}")

    @property
    def support(self) -> int:
        return len(self.pieces)

    @property
    def degree(self) -> int:
        return len(self.pieces[0]) - 1

    def table(self, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None) -> Tensor:
        return self._float64_table.to(device=device, dtype=dtype)

    @cached_property
    def _float64_table(self) -> Tensor:
        return torch.tensor([[float(c) for c in p] for p in self.pieces], dtype=torch.float64)

    @cached_property
    def sum_over_translates(self) -> Fraction | None:
        """Σ_k φ(x − k) where it is the same at every x: what samples that are all 1 give; None: it depends on x."""
        if self.approximation_order < 1:
            return None
        return sum((piece[0] for piece in self.pieces), Fraction(0))

    @property
    def start(self) -> Fraction:
        """−S/2, where the first piece begins."""
        return Fraction(-self.support, 2)

    def exact(self, x: Rational) -> Fraction:
        """φ(x) exactly; at a knot the piece to its right counts."""
        shifted = Fraction(x) - self.start
        piece = math.floor(shifted)
        if not 0 <= piece < self.support:
            return Fraction(0)
        return _value(self.pieces[piece], shifted - piece)

    def derivative(self, times: int = 1) -> Kernel:
        """φ^(times) as a kernel of its own."""
        pieces = self.pieces
        for _ in range(times):
            pieces = tuple(_derivative(p) for p in pieces)
        return Kernel(self.name + "'" * times, _trimmed(pieces))

    def integer_samples(self) -> dict[int, Fraction]:
        """φ(k) for every integer k inside the support: the discrete filter q that interpolation has to invert."""
        reach = (self.support - 1) // 2
        return {k: self.exact(k) for k in range(-reach, reach + 1)}

    def moment(self, power: int) -> Fraction:
        """∫ x^power φ(x) dx, exactly."""
        total = Fraction(0)
        for i, piece in enumerate(self.pieces):
            product = _multiply(_power_of_x(self.start + i, power), piece)
            total += sum((c / (j + 1) for j, c in enumerate(product)), Fraction(0))
        return total

    @cached_property
    def symmetric(self) -> bool:
        """True when φ(−x) = φ(x) (at every x that is no knot)."""
        mirrored = tuple(_compose_reflection(p) for p in reversed(self.pieces))
        return mirrored == self.pieces

    @cached_property
    def interpolating(self) -> bool:
        """True when φ(k) = 1 at 0 and 0 at every other integer."""
        return all(v == (k == 0) for k, v in self.integer_samples().items())

    @cached_property
    def continuity(self) -> int:
        """The largest m with φ in C^m; −1 for a discontinuous kernel."""
        zero = tuple(Fraction(0) for _ in self.pieces[0])
        pairs = list(zip((zero, *self.pieces), (*self.pieces, zero), strict=True))
        m = -1
        while m < self.degree and all(
            _value(_derivative(left, m + 1), Fraction(1)) == _value(_derivative(right, m + 1), Fraction(0))
            for left, right in pairs
        ):
            m += 1
        return m

    @cached_property
    def approximation_order(self) -> int:
        """L: with the right prefilter, every polynomial of degree < L is reproduced and the error falls as h^L.

        The Strang-Fix order: the largest L for which Σ_k (x−k)^j φ(x−k) does not depend on x, for all j < L.
        """
        order = 0
        while order <= self.degree + 1 and self._discrete_moment_is_constant(order):
            order += 1
        return order

    def _discrete_moment_is_constant(self, power: int) -> bool:
        total: tuple[Fraction, ...] = (Fraction(0),)
        for i, piece in enumerate(self.pieces):
            total = _add(total, _multiply(_power_of_x(self.start + i, power), piece))
        return not any(total[1:])

    @cached_property
    def direct_order(self) -> int:
        """The approximation order without any prefilter: how far φ̂(ω) = 1 + O(ω^p) and the Strang-Fix order reach."""
        order = self.approximation_order
        return next((p for p in range(order) if self.moment(p) != (p == 0)), order)


class TensorKernel(PiecewisePolynomial):
    """A kernel whose table is a tensor, differentiable: a kernel to be fitted.

    Args:
        name: what messages call it.
        table: (support, degree + 1), floating point; row i are the coefficients of u^j on [−S/2 + i, −S/2 + i + 1).
    """

    def __init__(self, name: str, table: Tensor) -> None:
        if table.ndim != 2 or not table.is_floating_point():
            raise ValueError(f"table must be floating point of shape (support, degree + 1); got {tuple(table.shape)}")
        self.name = name
        self._table = table

    @property
    def support(self) -> int:
        return self._table.shape[0]

    @property
    def degree(self) -> int:
        return self._table.shape[1] - 1

    def table(self, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None) -> Tensor:
        return self._table.to(device=device, dtype=dtype)


# --- exact polynomial arithmetic, coefficients from the constant term up ---------------------------------------------


def _value(p: Sequence[Fraction], u: Fraction) -> Fraction:
    return sum((c * u**j for j, c in enumerate(p)), Fraction(0))


def _derivative(p: tuple[Fraction, ...], times: int = 1) -> tuple[Fraction, ...]:
    for _ in range(times):
        p = tuple(j * c for j, c in enumerate(p))[1:] or (Fraction(0),)
    return p


def _add(p: Sequence[Fraction], q: Sequence[Fraction]) -> tuple[Fraction, ...]:
    n = max(len(p), len(q))
    return tuple((p[j] if j < len(p) else Fraction(0)) + (q[j] if j < len(q) else Fraction(0)) for j in range(n))


def _multiply(p: Sequence[Fraction], q: Sequence[Fraction]) -> tuple[Fraction, ...]:
    out = [Fraction(0)] * (len(p) + len(q) - 1)
    for i, a in enumerate(p):
        for j, b in enumerate(q):
            out[i + j] += a * b
    return tuple(out)


def _power_of_x(shift: Fraction, power: int) -> tuple[Fraction, ...]:
    """(u + shift)^power."""
    return tuple(Fraction(math.comb(power, j)) * shift ** (power - j) for j in range(power + 1))


def _compose_reflection(p: Sequence[Fraction]) -> tuple[Fraction, ...]:
    """p(1 − u)."""
    out: tuple[Fraction, ...] = (Fraction(0),) * len(p)
    for j, c in enumerate(p):
        out = _add(out, tuple(c * (-1) ** i * math.comb(j, i) for i in range(j + 1)))
    return out


def _trimmed(pieces: Sequence[Sequence[Fraction]]) -> Pieces:
    """Rows of one length, without the powers that no piece has."""
    width = max((j + 1 for p in pieces for j, c in enumerate(p) if c), default=1)
    return tuple(tuple((*p, *(Fraction(0) for _ in range(width)))[:width]) for p in pieces)


# --- the kernels ------------------------------------------------------------------------------------------------------


@lru_cache
def bspline(degree: int) -> Kernel:
    """The centred B-spline of a degree d.

    β⁰ is the box on [−½, ½); β^d(x) = (((d+1)/2 + x) β^{d−1}(x+½) + ((d+1)/2 − x) β^{d−1}(x−½)) / d.

    Source: de Boor's recursion; Unser, Splines: a perfect fit for signal and image processing, 1999.
    """
    if degree < 0:
        raise ValueError(f"degree must be an integer ≥ 0; got {degree}")
    pieces: list[tuple[Fraction, ...]] = [(Fraction(1),)]
    for d in range(1, degree + 1):
        # with y = x + (d+1)/2 = i + u: d · β^d = y · β^{d−1}[piece i] + (d + 1 − y) · β^{d−1}[piece i − 1]
        raised = []
        for i in range(d + 1):
            own = _multiply((Fraction(i), Fraction(1)), pieces[i]) if i < d else (Fraction(0),)
            previous = _multiply((Fraction(d + 1 - i), Fraction(-1)), pieces[i - 1]) if i > 0 else (Fraction(0),)
            raised.append(tuple(c / d for c in _add(own, previous)))
        pieces = raised
    return Kernel(f"bspline{degree}", _trimmed(pieces))


# φ_BC = base + B · by_b + C · by_c on |x| ∈ [0, 1] and [1, 2], coefficients of |x|^j (Mitchell & Netravali; eq. 11)
_BC_INNER = tuple(tuple(Fraction(c, 6) for c in row) for row in ((6, 0, -18, 12), (-2, 0, 12, -9), (0, 0, 6, -6)))
_BC_OUTER = tuple(tuple(Fraction(c, 6) for c in row) for row in ((0, 0, 0, 0), (8, -12, 6, -1), (24, -48, 30, -6)))


def _from_halves(halves: Sequence[Sequence[Fraction]]) -> Pieces:
    """The symmetric table whose piece on [h, h+1] is halves[h], a polynomial in |x|."""
    right = []
    for h, p in enumerate(halves):
        out: tuple[Fraction, ...] = (Fraction(0),) * len(p)
        for j, c in enumerate(p):
            out = _add(out, tuple(c * v for v in _power_of_x(Fraction(h), j)))
        right.append(out)
    return tuple(_compose_reflection(p) for p in reversed(right)) + tuple(right)


_BC_TABLES = tuple(_from_halves((inner, outer)) for inner, outer in zip(_BC_INNER, _BC_OUTER, strict=True))


def _exactly(value: Rational) -> Fraction:
    try:
        return Fraction(value) if isinstance(value, int | Fraction) else Fraction(str(float(value)))
    except (TypeError, ValueError):
        raise ValueError(f"B and C must be finite numbers or tensors of no axes; got {value!r}") from None


def bc(B: Rational | Tensor, C: Rational | Tensor, name: str | None = None) -> Kernel | TensorKernel:
    """The two-parameter cubic family of Mitchell & Netravali (paper, eq. 11).

    φ(x) = ⅙ { (12 − 9B − 6C)|x|³ + (−18 + 12B + 6C)|x|² + (6 − 2B)                      |x| ≤ 1
               (−B − 6C)|x|³ + (6B + 30C)|x|² + (−12B − 48C)|x| + (8B + 24C)            1 < |x| ≤ 2

    With numbers the result is an exact `Kernel` (floats count as the decimals they print as); with a 0-d tensor for B
    or C it is a `TensorKernel`, differentiable in them. B=1, C=0: cubic B-spline; B=0, C=½: Catmull-Rom.
    """
    if isinstance(B, Tensor) or isinstance(C, Tensor):
        if any(isinstance(w, Tensor) and (w.ndim or not w.is_floating_point()) for w in (B, C)):
            raise ValueError(f"B and C must be floating point tensors of no axes (0-d); got {B!r}, {C!r}")
        like = B if isinstance(B, Tensor) else C
        assert isinstance(like, Tensor)
        base, by_b, by_c = (
            torch.tensor([[float(c) for c in p] for p in table], dtype=like.dtype, device=like.device)
            for table in _BC_TABLES
        )
        weight_b, weight_c = (w if isinstance(w, Tensor) else float(w) for w in (B, C))
        return TensorKernel(name or "bc", base + weight_b * by_b + weight_c * by_c)
    b, c = _exactly(B), _exactly(C)
    pieces = tuple(
        tuple(p + b * q + c * r for p, q, r in zip(*rows, strict=True)) for rows in zip(*_BC_TABLES, strict=True)
    )
    return Kernel(name or f"bc({b}, {c})", _trimmed(pieces))


def _exact_bc(B: Rational, C: Rational, name: str, factor: Factor | None = None) -> Kernel:
    kernel = bc(B, C)
    assert isinstance(kernel, Kernel)
    return Kernel(name, kernel.pieces, factor)


_HALF = Fraction(1, 2)

LINEAR = Kernel("linear", bspline(1).pieces)
CATMULL_ROM = _exact_bc(0, _HALF, "catmull-rom")
MITCHELL = _exact_bc(Fraction(1, 3), Fraction(1, 3), "mitchell")
# paper, eq. 13: φ_notch(x) = ½ φ_quad(x − ½) + ½ φ_quad(x + ½)
NOTCH = _exact_bc(Fraction(3, 2), Fraction(-1, 4), "notch", Factor(bspline(2), (_HALF, -_HALF), (_HALF, _HALF)))
# ψ(x) = ½ (L(x+1) − L(x−1)): the central difference of the trilinear interpolant, as a kernel for the derivative
CENTRAL_DIFFERENCE = Kernel(
    "central-difference",
    tuple(tuple(_HALF * c for c in p) for p in ((0, 1), (1, -1), (0, -1), (-1, 1))),
)

KERNELS: dict[str, Kernel] = {
    "linear": LINEAR,
    **{f"bspline{d}": bspline(d) for d in range(6)},
    "catmull-rom": CATMULL_ROM,
    "mitchell": MITCHELL,
    "notch": NOTCH,
}
