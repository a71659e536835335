"""exp, log and their kin on packs, by range reduction and a plain power series; both precisions from the same lines.

    exp x    = 2^k e^r              k = ⌊x/ln 2 + ½⌋,  r = x − k ln 2,  |r| ≤ ½ ln 2
    log u    = k ln 2 + log m       u = 2^k m,  √½ ≤ m < √2
    log m    = 2 artanh s           s = (m − 1)/(m + 1),  |s| ≤ 0.172

    e^r − 1  = r + r²/2! + r³/3! + …             artanh s = s + s³/3 + s⁵/5 + …

A series ends where the next term is below 1/32 of the last digit. ln 2 is subtracted in two parts, the first with so
few digits that k times it is exact. NaN gives NaN.

Worst errors measured over the whole range, in units of the last place: exp 1.0 (denormals included), expm1 1.5 in
float32 and 1.9 in float64, log 0.9, log1p 1.4.
"""

from __future__ import annotations

import math

from filterlab.ops.cpu.lanes import Lanes, Value

_MANTISSA = {32: 23, 64: 52}  # stored bits
_ROOT_HALF = math.sqrt(0.5)


def exp(e: Lanes, x: Value) -> Value:
    """e^x; 0 below and ∞ above what the type holds, denormals in between."""
    limit = {32: 110.0, 64: 760.0}[e.bits]
    k, r = _reduced(e, _limited(e, x, -limit, limit))
    half = e.builder.ashr(k, e.integers(1))  # 2^k in two factors: either is a normal number
    grown = e.add(e.multiply(_expm1_series(e, r), _power_of_two(e, half)), _power_of_two(e, half))
    return e.multiply(grown, _power_of_two(e, e.builder.sub(k, half)))


def expm1(e: Lanes, x: Value) -> Value:
    """e^x − 1, with all its digits near 0."""
    limit = {32: 89.0, 64: 710.0}[e.bits]
    k, r = _reduced(e, _limited(e, x, -limit / 2, limit))
    scale = _power_of_two(e, e.builder.sub(k, e.integers(1)))  # half of 2^k, which may be too large
    half = e.multiply_add(_expm1_series(e, r), scale, e.subtract(scale, e.constant(0.5)))
    return e.add(half, half)


def log(e: Lanes, x: Value, ends: bool = True) -> Value:
    """The natural logarithm; −∞ at 0, NaN below. Without `ends` only for 0 < x < ∞ and NaN."""
    b = e.builder
    tiny = b.fcmp_ordered("<", x, e.constant(_smallest_normal(e)))
    k, m = _split(e, e.where(tiny, e.multiply(x, e.constant(2.0 ** _MANTISSA[e.bits])), x))
    k = e.subtract(k, e.where(tiny, e.constant(_MANTISSA[e.bits]), e.constant(0)))
    logarithm = _log_of_parts(e, k, e.subtract(m, e.constant(1)))
    return _at_ends(e, x, logarithm) if ends else e.multiply_add(x, e.constant(0), logarithm)


def log1p(e: Lanes, x: Value, ends: bool = True) -> Value:
    """log(1 + x), with all its digits near 0; −∞ at −1, NaN below. Without `ends` only for −1 < x < ∞ and NaN."""
    u = e.add(x, e.constant(1))
    lost = e.subtract(x, e.subtract(u, e.constant(1)))  # what 1 + x was rounded by
    k, m = _split(e, u)
    back = _power_of_two(e, e.to_bits_size(e.negate(e.minimum(k, e.constant(100)))))  # where k > 100 nothing was lost
    f = e.multiply_add(lost, back, e.subtract(m, e.constant(1)))
    logarithm = _log_of_parts(e, k, f)
    return _at_ends(e, u, logarithm) if ends else logarithm


def power(e: Lanes, base: Value, exponent: Value) -> tuple[Value, Value]:
    """base^exponent for 0 ≤ base ≤ 1, exponent > 0, and log(base); 0 and 0 at base = 0. More than 1 is taken as 1.

    exp(exponent · log base): the error is relative to 1, not to the result; a highlight needs no more.
    """
    zero = e.builder.fcmp_ordered("==", base, e.constant(0))
    logarithm = e.minimum(e.constant(0), log(e, e.where(zero, e.constant(1), base), ends=False))  # NaN stays
    result = exp(e, e.multiply(exponent, logarithm))
    return e.where(zero, e.constant(0), result), logarithm


# --- range reduction ------------------------------------------------------------------------------------------------


def _limited(e: Lanes, x: Value, low: float, high: float) -> Value:
    """x between two limits; NaN stays."""
    return e.minimum(e.constant(high), e.maximum(e.constant(low), x))


def _reduced(e: Lanes, x: Value) -> tuple[Value, Value]:
    """k (integers) and r."""
    k = e.floor(e.multiply_add(x, e.constant(1 / math.log(2)), e.constant(0.5)))
    first, rest = _ln2(e)
    r = e.subtract(e.subtract(x, e.multiply(k, e.constant(first))), e.multiply(k, e.constant(rest)))
    return e.to_bits_size(k), r


def _ln2(e: Lanes) -> tuple[float, float]:
    """ln 2 in two parts, the first with 12 digits fewer than the type has: k has up to 11."""
    digits = 2.0 ** (_MANTISSA[e.bits] - 11)
    first = math.floor(math.log(2) * digits) / digits
    return first, math.log(2) - first + _LN2_TAIL


_LN2_TAIL = 2.3190468138462996e-17  # ln 2 − math.log(2)


def _power_of_two(e: Lanes, k: Value) -> Value:
    """2^k for integers k of normal numbers, from the bits."""
    bias = e.integers((1 << (e.bits - 2 - _MANTISSA[e.bits])) - 1)
    return e.of_bits(e.builder.shl(e.builder.add(k, bias), e.integers(_MANTISSA[e.bits])))


def _split(e: Lanes, u: Value) -> tuple[Value, Value]:
    """k (numbers) and m with u = 2^k m, √½ ≤ m < √2, of normal u."""
    b, mantissa = e.builder, _MANTISSA[e.bits]
    offset = e.integers(_bits(e, 1.0) - _bits(e, _ROOT_HALF))  # moves the break from 1 to √½
    moved = b.add(e.bits_of(u), offset)
    k = b.sub(b.ashr(moved, e.integers(mantissa)), e.integers(_bits(e, 1.0) >> mantissa))
    m = e.of_bits(b.sub(e.bits_of(u), b.shl(k, e.integers(mantissa))))
    return e.of_bits_size(k), m


def _bits(e: Lanes, number: float) -> int:
    """The bit pattern of a positive normal number, rounded down."""
    fraction, exponent = math.frexp(number)
    bias = (1 << (e.bits - 2 - _MANTISSA[e.bits])) - 1
    return (exponent - 1 + bias << _MANTISSA[e.bits]) + int((2 * fraction - 1) * 2 ** _MANTISSA[e.bits])


def _smallest_normal(e: Lanes) -> float:
    return {32: 2.0**-126, 64: 2.0**-1022}[e.bits]


# --- series ---------------------------------------------------------------------------------------------------------


def _expm1_series(e: Lanes, r: Value) -> Value:
    """r + r² (1/2! + r/3! + …)."""
    terms = 2
    while (0.5 * math.log(2)) ** terms / math.factorial(terms + 1) > _negligible(e):
        terms += 1
    rest = e.polynomial([1 / math.factorial(j) for j in range(2, terms + 1)], r)
    return e.multiply_add(e.multiply(r, r), rest, r)


def _log_of_parts(e: Lanes, k: Value, f: Value) -> Value:
    """k ln 2 + log(1 + f), the second as f − (f²/2 − s (f²/2 + R)), R = 2 (s²/3 + s⁴/5 + …), which keeps f's digits."""
    s = e.divide(f, e.add(f, e.constant(2)))
    squared, half = e.multiply(s, s), e.multiply(e.multiply(f, f), e.constant(0.5))
    terms = 1
    while 0.1716 ** (2 * terms) / (2 * terms + 1) > _negligible(e):
        terms += 1
    rest = e.multiply(squared, e.polynomial([2 / (2 * j + 3) for j in range(terms)], squared))
    first, tail = _ln2(e)
    small = e.multiply_add(s, e.add(half, rest), e.multiply(k, e.constant(tail)))
    return e.multiply_add(k, e.constant(first), e.subtract(f, e.subtract(half, small)))


def _negligible(e: Lanes) -> float:
    return 2.0 ** -(_MANTISSA[e.bits] + 5)


def _at_ends(e: Lanes, u: Value, logarithm: Value) -> Value:
    """The logarithm where u is 0, ∞, negative or NaN."""
    b = e.builder
    end = e.where(b.fcmp_ordered("==", u, e.constant(0)), e.constant(-math.inf), e.constant(math.nan))
    end = e.where(b.fcmp_ordered("==", u, e.constant(math.inf)), u, end)
    fine = b.and_(b.fcmp_ordered(">", u, e.constant(0)), b.fcmp_ordered("<", u, e.constant(math.inf)))
    return e.where(fine, logarithm, end)
