"""Real roots in [0, 1] of polynomials in Bernstein form, of degree 1 to 9: the first one, or all of them.

Letters: p(t) = Σ_i c_i B_i(t), B_i(t) = binom(n, i) t^i (1 − t)^(n − i), i = 0 … n; c_i stands at index i of the last
axis. p̃(t) = Σ_i |c_i| B_i(t). ε: the spacing of floats at 1. τ = 3 n ε. u = t / (1 − t), or (1 − t) / t in the right
half.

**What a root is.** t counts as a root when |p(t)| ≤ τ p̃(t), which is: when some polynomial whose coefficients differ
from the given ones by no more than τ, relatively, vanishes there. So no root of p is ever lost, and a double root that
rounding has lifted off the axis is still there. Between τ and 2 τ the rounding of the search decides; beyond 2 τ
nothing counts.

| case | what is returned |
|---|---|
| several roots | the smallest t in the closed interval [0, 1] |
| double root, or two within rounding of one another | one root |
| c_0 = 0 | t = 0, exactly; c_0 ≠ 0 never |
| c_n = 0 | t = 1, exactly, unless there is an earlier root |
| all coefficients 0 | t = 0 |
| none | t = ∞ |
| a coefficient is NaN or infinite | t = ∞ |
| coefficients times a power of two | the same bits |

Only a polynomial's own coefficients decide, and its end values are c_0 and c_n to the bit: where two pieces share one,
both have the root there or neither has. A root at a dyadic number may be found on either side of it, not on neither.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from math import comb, inf
from typing import NamedTuple, Self

import torch
from torch import Tensor

MAX_DEGREE = 9
ROUNDINGS = 3  # τ = 3 n ε: in float32 the halves of some clusters of nine roots were wrong by 2.8 n ε p̃
_CHUNK = {"cpu": 2**16}  # polynomials at a time: enough to pay for the calls, few enough to stay in the caches
_LEVELS = 64  # halvings of [0, 1]; what is left then is narrower than floats can tell
_PASSES = 200  # of Newton's method and bisection
_USUAL = 4  # passes before anybody has arrived
_BY_MAGNITUDE = range(8, _PASSES, 3)  # passes in which a bracket is halved on the scale of logarithms


class _Layout(NamedTuple):
    """Of the bits of a float: an integer of the same width, digits after the first one, and the exponent's bias."""

    integer: torch.dtype
    digits: int
    bias: int


_FLOATS = {"float32": _Layout(torch.int32, 23, 127), "float64": _Layout(torch.int64, 52, 1023)}

Rows = list[Tensor]
"""A batch of polynomials, coefficient by coefficient: n + 1 tensors (B,)."""


class Roots(NamedTuple):
    """All roots in [0, 1].

    Attributes:
        t: (..., n), ascending, ∞ where there are no more.
        count: (...) int64, how many there are.
    """

    t: Tensor
    count: Tensor


def first_root(coefficients: Tensor) -> Tensor:
    """The smallest t in [0, 1] with p(t) = 0; ∞ where there is none.

    No coefficient of another sign than the first: no root, no work. One change of sign: one root, by Newton's method
    kept in its bracket. More: the interval is halved until each part has none or one, or has a single valley whose
    bottom tells.

    Args:
        coefficients: (..., n + 1) float32 or float64, Bernstein coefficients c_0 … c_n, 1 ≤ n ≤ 9.

    Returns:
        t (...), of the coefficients' type. Differentiable in the coefficients any number of times in reverse mode, once
        in forward mode (also of what reverse mode gives; forward within forward mode sees no second derivative), and
        under vmap: dt = −Σ_i B_i(t) dc_i / p′(t), and 0 where p′(t) is 0 within rounding (at double roots).

    Raises:
        ValueError: another degree. TypeError: another type.
    """
    _check(coefficients)
    return _Solve.apply(coefficients, _first)[..., 0]


def all_roots(coefficients: Tensor) -> Roots:
    """Every t in [0, 1] with p(t) = 0, a multiple one once.

    [0, 1] is cut at the roots of p′, which are found in the same way, into pieces where p is monotone; where the
    values at the ends of a piece differ in sign, Newton's method is kept between them. A cut at which p is 0 within
    rounding is a root, and stands for all in its neighbourhood that nothing but rounding tells apart.

    Args:
        coefficients: as for `first_root`.

    Returns:
        t and their count; t is differentiable as that of `first_root`.

    Raises:
        ValueError: another degree. TypeError: another type.
    """
    _check(coefficients)
    t = _Solve.apply(coefficients, _all)
    return Roots(t, (t < inf).sum(-1))


def _check(coefficients: Tensor) -> None:
    if str(coefficients.dtype).removeprefix("torch.") not in _FLOATS:
        raise TypeError(f"`coefficients` must be float32 or float64; got {coefficients.dtype}")
    if coefficients.ndim == 0 or not 2 <= coefficients.shape[-1] <= MAX_DEGREE + 1:
        raise ValueError(
            f"`coefficients` must have shape (..., n + 1) for a degree n of 1 to {MAX_DEGREE}; "
            f"got {tuple(coefficients.shape)}"
        )


# --- derivatives ------------------------------------------------------------------------------------------------------


class _Solve(torch.autograd.Function):
    """(coefficients (..., n + 1), search) -> t (..., k): k roots of each, found by `search`, with their derivatives."""

    @staticmethod
    def forward(coefficients: Tensor, search: Callable[[Rows], Tensor]) -> Tensor:
        return _in_chunks(coefficients.detach(), search)

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        ctx.save_for_backward(inputs[0], output)
        ctx.save_for_forward(inputs[0], output)

    @staticmethod
    def backward(ctx, *gradients: Tensor):
        coefficients, t = ctx.saved_tensors
        basis, weight = _sensitivity(coefficients, t)
        return ((gradients[0] * weight)[..., None] * basis).sum(-2), None

    @staticmethod
    def jvp(ctx, *tangents):
        coefficients, t = ctx.saved_tensors
        basis, weight = _sensitivity(coefficients, t)
        return (basis * tangents[0][..., None, :]).sum(-1) * weight

    @staticmethod
    def vmap(info, in_dims, coefficients: Tensor, search: Callable[[Rows], Tensor]):
        return _Solve.apply(coefficients.movedim(in_dims[0], 0), search), 0


def _sensitivity(coefficients: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """B_i(t) (..., k, n + 1), and −1 / p′(t) (..., k): 0 at no root, and where p′ is 0 within rounding."""
    n = coefficients.shape[-1] - 1
    found = t < inf
    t = torch.where(found, t, 0)
    lower = _basis(t, n - 1)
    c = coefficients[..., None, :]
    slope = n * (lower * (c[..., 1:] - c[..., :-1])).sum(-1)
    size = n * (lower * (c[..., 1:].abs() + c[..., :-1].abs())).sum(-1)
    steep = found & (slope.abs() > _tolerance(n, t.dtype) * size)
    return _basis(t, n), torch.where(steep, -1 / torch.where(steep, slope, 1), 0)


def _basis(t: Tensor, n: int) -> Tensor:
    """B_0(t) … B_n(t), on a new last axis."""
    left, right = [torch.ones_like(t)], [torch.ones_like(t)]
    for _ in range(n):
        left.append(left[-1] * t)
        right.append(right[-1] * (1 - t))
    return torch.stack([comb(n, i) * left[i] * right[n - i] for i in range(n + 1)], -1)


def _tolerance(n: int, dtype: torch.dtype) -> float:
    """τ."""
    return ROUNDINGS * n * torch.finfo(dtype).eps


# --- batches ----------------------------------------------------------------------------------------------------------


def _in_chunks(coefficients: Tensor, search: Callable[[Rows], Tensor]) -> Tensor:
    """t (..., k), of a search that takes rows (B,) to t (k, B)."""
    flat = coefficients.reshape(-1, coefficients.shape[-1])
    step = _CHUNK.get(flat.device.type, max(len(flat), 1))
    found = [search(_scaled(list(part.T.contiguous()))) for part in flat.split(step)]
    t = torch.cat(found, 1)
    return t.T.reshape(*coefficients.shape[:-1], len(t)).contiguous()


def _scaled(rows: Rows) -> Rows:
    """The rows times a power of two, so large that nothing vanishes and no sum overflows; ones where one isn't finite.

    The products of a quadratic equation have the range of floats for twice as many digits: half as far up.
    """
    finfo = torch.finfo(rows[0].dtype)
    most = _largest(rows)
    finite = most < inf
    if not bool(finite.all()):
        rows = [torch.where(finite, r, 1) for r in rows]
        most = torch.where(finite, most, 1)
    last = _FLOATS[finfo.dtype].bias
    missing = (last // 2 - 4 if len(rows) <= 3 else last - 30) - torch.frexp(most).exponent
    half = missing // 2  # 2^1100 is no float, 2^550 is
    first, second = (_power_of_two(e, rows[0].dtype) for e in (half, missing - half))
    return [r * first * second for r in rows]


def _power_of_two(exponent: Tensor, dtype: torch.dtype) -> Tensor:
    """2^exponent to the bit, which exp2 and ldexp don't promise."""
    layout = _FLOATS[str(dtype).removeprefix("torch.")]
    return ((exponent.to(layout.integer) + layout.bias) << layout.digits).view(dtype)


def _largest(rows: Sequence[Tensor]) -> Tensor:
    """max_i |c_i|; NaN where one is."""
    most = rows[0].abs()
    for r in rows[1:]:
        most = torch.maximum(most, r.abs())
    return most


def _chosen(rows: Sequence[Tensor], index: Tensor) -> Rows:
    return [r.index_select(0, index) for r in rows]


def _where(mask: Tensor) -> Tensor:
    return mask.nonzero()[:, 0]


# --- the first root ---------------------------------------------------------------------------------------------------


def _first(rows: Rows) -> Tensor:
    """t (1, B)."""
    start, end = rows[0], rows[-1]
    t = torch.where(start == 0, 0, torch.where(end == 0, 1, inf).to(start.dtype))
    low, high = _range(rows)
    index = _where(torch.where(start > 0, low < 0, (high > 0) & (start < 0)))
    if len(index):
        chosen = _chosen(rows, index)
        turn = torch.where(chosen[0] < 0, -1, 1).to(start.dtype)
        found = _first_of_descending([r * turn for r in chosen])
        t[index] = torch.minimum(found, t.index_select(0, index))
    return t[None]


def _range(rows: Rows) -> tuple[Tensor, Tensor]:
    """min_i c_i and max_i c_i: p keeps between them."""
    low = high = rows[0]
    for r in rows[1:]:
        low, high = torch.minimum(low, r), torch.maximum(high, r)
    return low, high


def _first_of_descending(rows: Rows) -> Tensor:
    """t (B,) of polynomials with c_0 > 0 and some c_i < 0."""
    special = {2: _line, 3: _parabola}.get(len(rows))
    return special(rows) if special else _subdivision(rows)


def _line(rows: Rows) -> Tensor:
    a, b = rows
    return a / (a - b)


def _parabola(rows: Rows) -> Tensor:
    """a + 2 b u + c u² = 0 without cancellation, u = t / (1 − t); a discriminant that is 0 within rounding is 0."""
    a, b, c = rows
    squared, product = b * b, a * c
    discriminant = squared - product
    real = discriminant >= -_tolerance(2, a.dtype) * squared
    root = discriminant.clamp_min(0).sqrt()
    falling = b < 0
    return torch.where(real, _share(torch.where(falling, a, b + root), torch.where(falling, root - b, -c)), inf)


def _share(x: Tensor, y: Tensor) -> Tensor:
    """x / (x + y) of positive numbers, to a rounding or two also where it is near to 1."""
    ratio = torch.minimum(x, y) / torch.maximum(x, y)
    return torch.where(x < y, ratio, 1) / (1 + ratio)


class _Parts(NamedTuple):
    """Parts [a, a + h] of [0, 1] of some polynomials, each with a root at most on its right end.

    Attributes:
        rows: the Bernstein coefficients there.
        owner: (N,) which polynomial.
        a: (N,) where it begins.
    """

    rows: Rows
    owner: Tensor
    a: Tensor

    def chosen(self, mask: Tensor) -> _Parts:
        index = _where(mask)
        return _Parts(_chosen(self.rows, index), self.owner.index_select(0, index), self.a.index_select(0, index))


class _Brackets(NamedTuple):
    """Intervals: (N,) which polynomial, begin and end."""

    owner: Tensor
    a: Tensor
    b: Tensor

    @staticmethod
    def joined(several: Sequence[_Brackets]) -> _Brackets:
        return _Brackets(*(torch.cat(column) for column in zip(*several, strict=True)))

    def chosen(self, mask: Tensor) -> _Brackets:
        index = _where(mask)
        return _Brackets(*(column.index_select(0, index) for column in self))


def _subdivision(rows: Rows) -> Tensor:
    """t (B,): [0, 1] is halved until every part is decided, then the first one that holds a root is searched.

    Signs are those of p − τ p̃ (c_0 > 0): where it vanishes first, p counts as 0, and rounding, which is less than τ
    p̃, can't hide it.
    """
    everyone = torch.arange(len(rows[0]), device=rows[0].device)
    parts = _Parts(_lowered(rows), everyone, torch.zeros_like(rows[0]))
    crossings: list[_Brackets] = []
    valleys: list[_Brackets] = []
    sure = torch.full_like(rows[0], inf)  # before it there is a root
    h = 1.0
    for _ in range(_LEVELS):
        parts = _undecided(parts, h, sure, crossings, valleys)
        if not len(parts.owner):
            break
        parts, h = _halves(parts, h / 2), h / 2
    crossings.append(_Brackets(parts.owner, parts.a, parts.a + h))
    return _searched(rows, _Brackets.joined(crossings), _Brackets.joined(valleys))


def _lowered(rows: Rows) -> Rows:
    """p − τ p̃, and nothing at t = 1 where p is 0: who asks treats that end alone."""
    tolerance = _tolerance(len(rows) - 1, rows[0].dtype)
    lowered = [torch.sub(r, r.abs(), alpha=tolerance) for r in rows]
    lowered[-1] = torch.where(rows[-1] == 0, torch.finfo(rows[0].dtype).tiny, lowered[-1])
    return lowered


def _undecided(parts: _Parts, h: float, sure: Tensor, crossings: list[_Brackets], valleys: list[_Brackets]) -> _Parts:
    """The parts that must be halved; those with one crossing, and those with a valley, are put into the lists.

    Descartes: no change of sign among the coefficients, no root; one, one root. By the differences of the
    coefficients, p is monotone, or has one extremum: then the signs at the ends tell the rest, except for a valley
    between positive ends. Where floats can't tell the ends of a part from one another, a change of sign between them is
    a crossing, however often p changes its sign there.
    """
    rows = parts.rows
    negative = [r <= 0 for r in rows]
    changes = _changes(negative)
    falling = [right < left for left, right in pairwise(rows)]
    simple = _changes(falling) <= 1
    open_, ends = changes > 0, negative[-1]
    narrow = parts.a + h == parts.a
    _note(parts, ends & (simple | (changes == 1) | narrow), h, crossings)
    _note(parts, open_ & ~ends & simple & falling[0], h, valleys)
    sure.scatter_reduce_(0, parts.owner, torch.where(ends, parts.a + h, inf), "amin")
    before = parts.a < sure.index_select(0, parts.owner)
    return parts.chosen(open_ & ~simple & (changes != 1) & before)


def _changes(signs: Sequence[Tensor]) -> Tensor:
    """(N,) int8: how often neighbours differ."""
    count = torch.zeros_like(signs[0], dtype=torch.int8)
    for left, right in pairwise(signs):
        count += (left ^ right).view(torch.int8)
    return count


def _note(parts: _Parts, mask: Tensor, h: float, brackets: list[_Brackets]) -> None:
    index = _where(mask)
    a = parts.a.index_select(0, index)
    brackets.append(_Brackets(parts.owner.index_select(0, index), a, a + h))


def _halves(parts: _Parts, h: float) -> _Parts:
    """All left halves, then all right halves, of width h: de Casteljau at ½ by sums, divided by 2^j at the end."""
    n, size = len(parts.rows) - 1, len(parts.owner)
    both = torch.empty(n + 1, 2 * size, dtype=parts.a.dtype, device=parts.a.device)
    rows, left = [row[size:] for row in both], [row[:size] for row in both]
    for row, given in zip(rows, parts.rows, strict=True):
        row.copy_(given)
    left[0].copy_(rows[0])
    for j in range(1, n + 1):
        for i in range(n - j + 1):
            rows[i] += rows[i + 1]
        torch.mul(rows[0], 0.5**j, out=left[j])
    for j in range(1, n + 1):
        rows[n - j] *= 0.5**j
    return _Parts(list(both), parts.owner.repeat(2), torch.cat((parts.a, parts.a + h)))


def _searched(rows: Rows, crossings: _Brackets, valleys: _Brackets) -> Tensor:
    """t (B,) from all parts that hold a root, and those that may hold one because p has a valley there."""
    tolerance = _tolerance(len(rows) - 1, rows[0].dtype)
    touches, more = _bottoms(rows, valleys, 1.5 * tolerance)  # a bottom is found to the rounding of p′
    brackets = _Brackets.joined((crossings, more))
    first = torch.full_like(rows[0], inf)
    for found in (brackets, touches):
        first.scatter_reduce_(0, found.owner, found.a, "amin")
    t = torch.full_like(rows[0], inf)  # 1.5 τ below: where p rises to τ p̃ again, rounding must not make it a crossing
    touches, brackets = (found.chosen(found.a == first.index_select(0, found.owner)) for found in (touches, brackets))
    t[touches.owner] = touches.b
    t[brackets.owner] = _crossing(_chosen(rows, brackets.owner), brackets.a, brackets.b, 1.5 * tolerance)
    return t


def _bottoms(rows: Rows, valleys: _Brackets, tolerance: float) -> tuple[_Brackets, _Brackets]:
    """Valleys whose bottom is 0 within rounding, and those that go below, both cut off at the bottom.

    Judged before t is rounded: near t = 1 a whole valley can lie between two floats.
    """
    own = _chosen(rows, valleys.owner)
    falling = [left - right for left, right in pairwise(own)]
    chart = _chart(valleys.a, valleys.b, _positive(falling, 0.0))
    middle = 0.5 * (chart.low + chart.high)  # the chord may begin beyond a hill that rounding hides near an end
    bottom = _newton(chart.turned(chart.rows(falling)), chart.low, chart.high, middle)
    here = chart.rows(own)
    value, size = (chart.back(_horner(r, bottom)[0]) for r in (here, [r.abs() for r in here]))
    cut = valleys._replace(b=chart.t(bottom))
    below = value <= 0
    return cut.chosen(~below & (value <= tolerance * size)), cut.chosen(below)


def _value(rows: Rows, t: Tensor) -> Tensor:
    """p(t) by Horner's rule for homogeneous polynomials; wrong by less than τ p̃(t)."""
    n, s = len(rows) - 1, 1 - t
    value, power = rows[0], torch.ones_like(t)
    for i in range(1, n + 1):
        power = power * t
        value = torch.addcmul(value * s, rows[i], power, value=comb(n, i))
    return value


# --- one root in a bracket --------------------------------------------------------------------------------------------


class _Chart(NamedTuple):
    """Brackets in the coordinate of that half of [0, 1] where each lies: u = t / (1 − t), or (1 − t) / t in the right
    half.

    There p(t) = (1 − t)^n Σ_i binom(n, i) c_i u^i, u ≤ 1: as well conditioned as the Bernstein form, and evaluated by
    Horner's rule. In the right half the same from the other end.

    Attributes:
        left, right: which brackets are in which half; here those of the left half stand first.
        low, high: (N,) their ends.
    """

    left: Tensor
    right: Tensor
    low: Tensor
    high: Tensor

    def rows(self, rows: Rows) -> Rows:
        """binom(n, i) c_i, or binom(n, i) c_(n − i)."""
        pairs = zip(_chosen(rows, self.left), reversed(_chosen(rows, self.right)), strict=True)
        return [comb(len(rows) - 1, i) * torch.cat(pair) for i, pair in enumerate(pairs)]

    @property
    def turn(self) -> Tensor:
        """1 or −1: what is positive at the beginning of [a, b] is so at the low end, or not at the high end."""
        return torch.cat((torch.ones_like(self.left), -torch.ones_like(self.right))).to(self.low.dtype)

    def turned(self, rows: Rows) -> Rows:
        turn = self.turn
        return [r * turn for r in rows]

    def back(self, values: Tensor) -> Tensor:
        """In the order of the brackets."""
        out = torch.empty_like(values)
        out[torch.cat((self.left, self.right))] = values
        return out

    def t(self, u: Tensor) -> Tensor:
        """t in the order of the brackets."""
        near, far = u.split((len(self.left), len(self.right)))
        return self.back(torch.cat((near / (1 + near), 1 / (1 + far))))


def _chart(a: Tensor, b: Tensor, positive: Callable[[Tensor], Tensor]) -> _Chart:
    """Of brackets [a, b] whose polynomials are positive at a and not at b; `positive` tells it at any t."""
    both = (a < 0.5) & (b > 0.5)
    if bool(both.any()):
        half = torch.full_like(a, 0.5)
        beyond = positive(half)
        a, b = torch.where(both & beyond, half, a), torch.where(both & ~beyond, half, b)
    left, right = _where(a < 0.5), _where(a >= 0.5)
    ratio = lambda t: t / (1 - t)  # noqa: E731
    low = torch.cat((ratio(a[left]), ratio(1 - b[right])))
    return _Chart(left, right, low, torch.cat((ratio(b[left]), ratio(1 - a[right]))))


def _positive(rows: Rows, tolerance: float) -> Callable[[Tensor], Tensor]:
    """t -> whether p − tolerance · p̃ is positive there."""
    sizes = [r.abs() for r in rows] if tolerance else None
    return lambda t: _value(rows, t) > (tolerance * _value(sizes, t) if sizes else 0)


def _crossing(rows: Rows, a: Tensor, b: Tensor, tolerance: float = 0.0) -> Tensor:
    """t (N,) in [a, b] where p, positive at a (or just after it) and not at b, vanishes.

    With a tolerance p − tolerance · p̃ is what changes its sign, once; from there a step of Newton's method leads to
    p's own root.
    """
    chart = _chart(a, b, _positive(rows, tolerance))
    here = chart.turned(chart.rows(rows))
    if not tolerance:
        return chart.t(_newton(here, chart.low, chart.high))
    lean = -tolerance * chart.turn
    return chart.t(_polished(here, _newton([torch.addcmul(r, lean, r.abs()) for r in here], chart.low, chart.high)))


def _polished(rows: Rows, u: Tensor) -> Tensor:
    """One step of Newton's method, where p falls and it leads nearer to a root with nothing between."""
    f, slope = _horner(rows, u)
    new = u - f / slope
    f_new, slope_new = _horner(rows, new)
    change = slope_new / slope
    good = (slope < 0) & (f_new.abs() <= 0.5 * f.abs()) & (change > 0.5) & (change < 2) & (new >= 0)
    return torch.where(good, new, u)


def _newton(rows: Rows, low: Tensor, high: Tensor, start: Tensor | None = None) -> Tensor:
    """u (N,) in [low, high] where Σ_i rows[i] u^i, positive at `low` and not at `high`, vanishes.

    Starts at `start`, or where the chord between the ends vanishes. A step that leaves the bracket, or is not half as
    long as the one before, is replaced by bisection. Who has arrived stays where it is, so that nobody's digits depend
    on the company: after a step of no more than 2 ε u or, later on, where the polynomial is 0 within its rounding and
    falls. Where that hides its sign, it has the sign of the nearer end: it may vanish at an end as well.
    """
    eps, low = torch.finfo(low.dtype).eps, low.clamp_min(torch.finfo(low.dtype).tiny)
    sizes, centre = [r.abs() for r in rows], 0.5 * (low + high)
    u = _chord(rows, low, high) if start is None else start
    result, last, active = u.clone(), high - low, torch.ones_like(low, dtype=torch.bool)
    index = torch.arange(len(u), device=u.device)
    for k in range(_PASSES):
        f, slope = _horner(rows, u)
        clear = f.abs() > 0.5 * len(rows) * eps * _horner(sizes, u)[0]
        if k >= _USUAL:
            active &= clear | (slope >= 0)
        positive = torch.where(clear, f > 0, u < centre)
        low, high = torch.where(positive, u, low), torch.where(positive, high, u)
        middle = low.sqrt() * high.sqrt() if k in _BY_MAGNITUDE else 0.5 * (low + high)
        new = _step(u, f / slope, low, high, last, middle)
        last = (new - u).abs_()
        u = torch.where(active, new, u)
        active &= last > 2 * eps * new
        if k < _USUAL - 1:
            continue
        left = int(active.count_nonzero())
        if left < 0.6 * len(u):
            result[index] = u
            on = _where(active)
            rows, sizes = _chosen(rows, on), _chosen(sizes, on)
            low, high, centre, u, last, active, index = _chosen((low, high, centre, u, last, active, index), on)
        if not left:
            break
    result[index] = u
    return result


def _chord(rows: Rows, low: Tensor, high: Tensor) -> Tensor:
    """Where the chord crosses zero; not quite at an end."""
    above, below = _horner(rows, low)[0], _horner(rows, high)[0]
    part = torch.nan_to_num(above / (above - below), nan=0.5).clamp(0.02, 0.98)
    return low + part * (high - low)


def _step(u: Tensor, newton: Tensor, low: Tensor, high: Tensor, last: Tensor, middle: Tensor) -> Tensor:
    """u − newton, or the middle of the bracket."""
    new = u - newton
    good = (new >= low) & (new <= high) & (newton.abs() <= 0.5 * last)
    return torch.where(good, new, middle)


def _horner(rows: Rows, u: Tensor) -> tuple[Tensor, Tensor]:
    """Σ_i rows[i] u^i and its derivative."""
    slope = rows[-1]
    value = torch.addcmul(rows[-2], rows[-1], u) if len(rows) > 1 else rows[0]
    if len(rows) < 3:
        return value, slope if len(rows) == 2 else torch.zeros_like(u)
    for r in reversed(rows[:-2]):
        slope, value = torch.addcmul(value, slope, u), torch.addcmul(r, value, u)
    return value, slope


# --- all roots --------------------------------------------------------------------------------------------------------


def _all(rows: Rows) -> Tensor:
    """t (n, B), ascending, ∞ where there are no more."""
    n = len(rows) - 1
    binomial = [comb(n, i) * r for i, r in enumerate(rows)]
    left, right = _Cut.of([torch.cat(both) for both in zip(binomial, reversed(binomial), strict=True)]).halves()
    bounds = torch.cat((left.bounds / (1 + left.bounds), (1 / (1 + right.bounds)).flip(0)))
    zero = torch.cat((left.values == 0, (right.values == 0).flip(0)))
    first = zero.clone()
    first[1:] &= ~zero[:-1]  # neighbours that are all 0 within rounding are one root
    crossings = (left.crossings / (1 + left.crossings), 1 / (1 + right.crossings))
    crossings = [
        torch.where(u.isfinite(), t, inf) for u, t in zip((left.crossings, right.crossings), crossings, strict=True)
    ]
    return torch.cat((torch.where(first, bounds, inf), *crossings)).sort(0).values[:n]


class _Cut(NamedTuple):
    """q(u) = Σ_i rows[i] u^i on [0, 1], cut where it has its extrema.

    Attributes:
        bounds: (n + 1, B), 0, the cuts, 1; there are n − 1 of them, some of which may coincide.
        values: (n + 1, B), q there, 0 where it is 0 within rounding.
        crossings: (n, B), where q changes its sign between two bounds; ∞ where it does not.
    """

    bounds: Tensor
    values: Tensor
    crossings: Tensor

    @classmethod
    def of(cls, rows: Rows) -> Self:
        bounds = torch.stack((torch.zeros_like(rows[0]), torch.ones_like(rows[0])))
        if len(rows) > 2:
            upper = cls.of([i * r for i, r in enumerate(rows)][1:])
            cuts = torch.where(upper.crossings.isfinite(), upper.crossings, upper.bounds[:-1])
            bounds = torch.cat((bounds[:1], cuts, bounds[1:]))
        values = _horner(rows, bounds)[0]
        sizes = _horner([r.abs() for r in rows], bounds)[0]
        values = torch.where(values.abs() <= _tolerance(len(rows) - 1, sizes.dtype) * sizes, 0, values)
        return cls(bounds, values, _between(rows, bounds, values))

    def halves(self) -> tuple[Self, Self]:
        """Of the first and of the second half of the polynomials."""
        first, second = zip(*(part.chunk(2, 1) for part in self), strict=True)
        return type(self)(*first), type(self)(*second)


def _between(rows: Rows, bounds: Tensor, values: Tensor) -> Tensor:
    """(m, B): the root between neighbours of `bounds` (m + 1, B) whose values have opposite signs; ∞ elsewhere."""
    u = torch.full_like(bounds[1:], inf)
    piece, owner = (values[:-1].sign() * values[1:].sign() < 0).nonzero(as_tuple=True)
    turn = values[piece, owner].sign()
    own = [r * turn for r in _chosen(rows, owner)]
    u[piece, owner] = _newton(own, bounds[piece, owner], bounds[piece + 1, owner])
    return u
