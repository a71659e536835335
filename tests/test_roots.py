"""Roots of Bernstein polynomials: against exact arithmetic, and the policy at every awkward place."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction

import pytest
import torch

from experiments.exact_roots import BAD, ExactPolynomial, judge
from experiments.polynomial_families import FAMILIES
from experiments.root_finding import suspicious, tolerance
from filterlab import roots
from filterlab.roots import all_roots, first_root
from tests.pairs import in_pairs

DTYPES = [torch.float64, torch.float32]
DIGITS = {torch.float64: 53, torch.float32: 24}
INF = math.inf


def made(family, degree, count, dtype=torch.float64, seed=0):
    c, _ = FAMILIES[family](degree, count, torch.Generator().manual_seed(seed + degree))
    return c.to(dtype)


def assert_right(c, t):
    """No root is lost, invented or later than the first one."""
    for coefficients, root in zip(c.tolist(), t.tolist(), strict=True):
        verdict = judge(coefficients, root, tolerance(c), digits=DIGITS[c.dtype])
        assert verdict not in BAD, (verdict, coefficients, root)


@pytest.mark.parametrize(("family", "degree", "dtype"), in_pairs(itertools.product(FAMILIES, range(2, 10), DTYPES)))
def test_first_roots_are_those_of_exact_arithmetic(family, degree, dtype):
    c = made(family, degree, 6, dtype)
    assert_right(c, first_root(c))
    assert_right(c, all_roots(c).t[:, 0])


# Each of them was lost, mixed up or inaccurate with an earlier version of the search.
FOUND = {
    "a valley between two floats near t = 1": (
        torch.float32,
        [-0.6719155311584473, -0.3113623559474945, -0.05548791214823723, 4.415763214637991e-06, -2.342495641904918e-10],
    ),
    "three roots within rounding of the first": (
        torch.float64,
        [
            -0.7636628779645965,
            0.0260205098976195,
            -0.0008866031423341342,
            3.020939800068482e-05,
            -1.0293290212370582e-06,
            3.5072417866046966e-08,
        ],
    ),
    "rounding of the halves": (
        torch.float32,
        [
            0.6653808951377869,
            -0.020622581243515015,
            0.0006233378080651164,
            -1.8326252757105976e-05,
            5.22017614912329e-07,
            -1.4313187968184593e-08,
            3.734704212554618e-10,
            -9.07104773240075e-12,
        ],
    ),
    "within rounding of 0 at the wrong end": (
        torch.float64,
        [0.0001512206961155588, -0.0010033035283720194, 0.006656614375698531, -0.04416461104245138, 0.2930187246205389],
    ),
    "the rounding of a derivative": (
        torch.float32,
        [
            *[-0.6120107769966125, 0.035179946571588516, -0.0019203199772164226, 9.848525951383635e-05],
            *[-4.674878709920449e-06, 2.006625976491705e-07, -7.474286078945624e-09, 2.214654848398112e-10],
        ],
    ),
    "near t = 0 by twenty-three orders": (torch.float32, [1.4510444712109716e-12, -47113433088.0, -5624.878, -1.4e-09]),
    "near t = 1 in a quadratic": (torch.float32, [312937248.0, -47.53073501586914, -5.746927200789287e-08]),
    "coefficients below the normal numbers": (
        torch.float32,
        [
            1.62844894539187e-41,
            -8.278160028130528e-38,
            -2.6121789546224794e-33,
            5.687966867967917e-29,
            9.696317343112538e-25,
            -7.213959090583448e-20,
            5.110356235066087e-16,
            1.2945274019404707e-10,
            -1.0016386113420594e-05,
            0.4880199432473047,
        ],
    ),
    "three roots between two floats next to 1": (
        torch.float32,
        [
            *[1.0916695325491332e-09, 476939616256.0, -17818.1171875],
            *[0.0003973136190325022, -2.6604309033562146e-12],
        ],
    ),
    "a last step that led back to the other side of what is no root": (
        torch.float32,
        [
            *[-0.00021697243209928274, 0.00037566880928352475, -0.000632843526545912, 0.0010263825533911586],
            *[-0.001583425560966134, 0.0022845829371362925, -0.0030024831648916006, 0.003404033835977316],
            *[-0.002808963181450963, -3.652159108469277e-08],
        ],
    ),
    "odd changes of sign in both halves": (torch.float64, [0.98868226, -0.52122521, 0.24551128, -0.00716032]),
}


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("degree", range(1, 10))
def test_between_ends_of_opposite_signs_there_is_a_root(degree, dtype):
    """However wide the scale of the coefficients: near either end several of them may lie between two floats."""
    sign = torch.where(torch.rand(3_000, degree + 1) < 0.5, -1.0, 1.0).double()
    sign[:, -1] = -sign[:, 0]
    top = 25 if dtype == torch.float32 else 200
    c = (sign * 10 ** ((2 * torch.rand(3_000, degree + 1, dtype=torch.float64) - 1) * top)).to(dtype)
    c = torch.cat((c, c.abs().sort(1).values * (-1.0) ** torch.arange(degree + 1).to(dtype)))  # falls by orders
    opposite = c[:, 0].sign() * c[:, -1].sign() < 0
    assert (first_root(c[opposite]) <= 1).all()
    assert (first_root(c[opposite].flip(1)) <= 1).all()


@pytest.mark.parametrize("name", FOUND)
def test_what_went_wrong_once(name):
    dtype, coefficients = FOUND[name]
    c = torch.tensor([coefficients], dtype=dtype)
    assert_right(c, first_root(c))
    assert_right(c, all_roots(c).t[:, 0])


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("degree", range(1, 10))
def test_all_roots_are_counted_as_exact_arithmetic_counts_them(degree, dtype):
    c = made("random", degree, 12, dtype, seed=3)
    t, count = all_roots(c)
    assert t.shape == (12, degree)
    assert count.dtype == torch.int64
    for coefficients, own, number in zip(c.tolist(), t.tolist(), count.tolist(), strict=True):
        exact = ExactPolynomial(coefficients)
        assert number == exact.roots_between(Fraction(0), Fraction(1)) == sum(x < INF for x in own)
        assert own == sorted(own)
        found = own[:number]
        for before, after in itertools.pairwise([0.0, *found, 1.0]):  # one root in the neighbourhood of each
            assert before <= after
        for x in found:
            near = Fraction(1, 10**5 if dtype == torch.float32 else 10**11)
            assert exact.roots_between(max(Fraction(x) - near, Fraction(0)), min(Fraction(x) + near, Fraction(1))) == 1


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("degree", range(1, 10))
def test_two_ways_find_the_same_first_root(degree, dtype):
    """Halving and cutting at extrema share next to nothing; where they differ p is 0 within rounding between them."""
    c = made("random", degree, 2000, dtype, seed=5)
    a, b = first_root(c), all_roots(c).t[:, 0]
    assert torch.equal(a < INF, b < INF)
    for coefficients, s, t in zip(c.tolist(), a.tolist(), b.tolist(), strict=True):
        if s < INF and abs(s - t) > 1e3 * torch.finfo(dtype).eps:
            assert judge(coefficients, max(s, t), tolerance(c), digits=DIGITS[dtype]) not in BAD


# --- policies ---------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("degree", range(1, 10))
def test_the_ends_belong_to_the_interval(degree, dtype):
    ones = torch.ones(degree + 1, dtype=dtype)
    start, end, both = ones.clone(), ones.clone(), ones.clone()
    start[0], end[-1], both[0], both[-1] = 0, 0, 0, 0
    assert first_root(start) == 0
    assert first_root(end) == 1
    assert first_root(torch.zeros(degree + 1, dtype=dtype)) == 0
    assert all_roots(start).t[0] == 0
    assert all_roots(end).t[0] == 1
    assert all_roots(torch.zeros(degree + 1, dtype=dtype)).count == 1
    if degree > 1:
        assert first_root(both) == 0
        assert all_roots(both).t[:2].tolist() == [0, 1]
    tiny = start.clone()
    tiny[0] = torch.finfo(dtype).tiny
    assert first_root(tiny) == INF
    tiny[0] *= -1
    assert 0 < first_root(tiny) < 1e-30


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("degree", range(2, 10))
def test_an_earlier_root_goes_before_the_one_at_the_end(degree, dtype):
    c = made("random", degree, 200, dtype, seed=7)
    c[:, -1] = 0
    inner = first_root(c)
    assert bool((inner <= 1).all())
    assert bool((inner < 1).any())
    assert bool((inner == 1).any())
    assert_right(c[:20], inner[:20])


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("degree", range(2, 10))
def test_a_touch_counts_once_and_a_gap_does_not(degree, dtype):
    """(t − ½)² + gap, raised to the degree."""
    eps = torch.finfo(dtype).eps

    def lifted(gap):
        c = [
            Fraction(i * (i - 1), degree * (degree - 1)) - Fraction(i, degree) + Fraction(1, 4)
            for i in range(degree + 1)
        ]
        return torch.tensor([float(x) + gap for x in c], dtype=dtype)

    for gap in (0.0, 0.1 * eps, -0.1 * eps):
        assert first_root(lifted(gap)) == pytest.approx(0.5, abs=10 * math.sqrt(degree * eps))
        assert all_roots(lifted(gap)).count == 1
    assert first_root(lifted(50 * degree * eps)) == INF
    assert all_roots(lifted(50 * degree * eps)).count == 0
    assert all_roots(lifted(-100 * degree * eps)).count == 2


@pytest.mark.parametrize("dtype", DTYPES)
@pytest.mark.parametrize("degree", range(1, 10))
def test_what_is_no_number_has_no_root_and_leaves_others_alone(degree, dtype):
    c = made("random", degree, 50, dtype, seed=9)
    alone, alone_all = first_root(c), all_roots(c).t
    broken = c.repeat(3, degree + 1, 1, 1)
    for kind, bad in enumerate((math.nan, INF, -INF)):
        for place in range(degree + 1):
            broken[kind, place, 10, place] = bad
            broken[kind, place, 11] = bad
    t, every = first_root(broken), all_roots(broken)
    assert (t[..., 10:12] == INF).all()
    assert (every.count[..., 10:12] == 0).all()
    keep = torch.arange(50) // 10 != 1
    assert torch.equal(t[..., keep], alone[keep].expand_as(t[..., keep]))
    assert torch.equal(every.t[..., keep, :], alone_all[keep].expand_as(every.t[..., keep, :]))


@pytest.mark.parametrize(
    ("dtype", "powers"), [(torch.float64, (-1000, -300, 7, 960)), (torch.float32, (-110, -30, 7, 110))]
)
@pytest.mark.parametrize("degree", range(1, 10))
def test_a_power_of_two_changes_no_bit(degree, dtype, powers):
    c = torch.cat([made(f, degree, 20, dtype) for f in ("random", "near-double", "root-at-end") if degree > 1] or
                  [made("random", 1, 60, dtype)])  # fmt: skip
    c = torch.where(c.abs() < 1e-4, 0, c)  # nothing that a factor takes below the normal numbers
    scaled = torch.stack([c * 2.0 ** (power // 2) * 2.0 ** (power - power // 2) for power in powers])
    first, every = first_root(torch.cat((scaled, -scaled))), all_roots(scaled).t
    assert torch.equal(first, first_root(c).expand_as(first))
    assert torch.equal(every, all_roots(c).t.expand_as(every))


@pytest.mark.parametrize("degree", range(1, 10))
def test_nobody_depends_on_the_company(degree):
    c = made("random", degree, 100, seed=11)
    together = first_root(c)
    assert torch.equal(torch.cat([first_root(part) for part in c.split(7)]), together)
    assert torch.equal(first_root(c.flip(0)).flip(0), together)


def test_no_ray_slips_between_two_pieces():
    """A row of pieces that share end values: whoever changes sign over the whole row has a root in some piece."""
    generator = torch.Generator().manual_seed(13)
    for degree in range(1, 10):
        ends = torch.rand(400, 5, generator=generator, dtype=torch.float64) - 0.5
        ends[::3, 2] = 0
        ends[1::3, 2] = 1e-300
        pieces = torch.rand(400, 4, degree + 1, generator=generator, dtype=torch.float64) - 0.5
        pieces[..., 0], pieces[..., -1] = ends[:, :-1], ends[:, 1:]
        hit = (first_root(pieces) < INF).any(-1)
        assert bool((hit | (ends[:, 0] * ends[:, -1] > 0)).all())


def test_shapes_and_types_are_kept():
    for dtype in DTYPES:
        c = torch.rand(2, 0, 3, 5, dtype=dtype)
        assert first_root(c).shape == (2, 0, 3)
        assert all_roots(c).t.shape == (2, 0, 3, 4)
        assert first_root(c).dtype == dtype
        c = torch.rand(2, 3, 4, dtype=dtype).movedim(-1, 0).movedim(0, -1) - 0.5
        assert torch.equal(first_root(c)[1, 2], first_root(c[1, 2].clone()))


def test_many_are_solved_in_chunks(monkeypatch):
    c = made("random", 5, 100)
    whole = first_root(c), all_roots(c).t
    monkeypatch.setitem(roots._CHUNK, "cpu", 7)
    assert torch.equal(first_root(c), whole[0])
    assert torch.equal(all_roots(c).t, whole[1])


@pytest.mark.parametrize("solve", [first_root, all_roots])
def test_what_is_no_polynomial_is_refused(solve):
    with pytest.raises(ValueError, match=r"degree n of 1 to 9; got \(3, 11\)"):
        solve(torch.rand(3, 11))
    with pytest.raises(ValueError, match=r"got \(1,\)"):
        solve(torch.rand(1))
    with pytest.raises(ValueError, match=r"got \(\)"):
        solve(torch.tensor(1.0))
    with pytest.raises(TypeError, match=r"float32 or float64; got torch\.float16"):
        solve(torch.rand(3, dtype=torch.float16))


# --- derivatives ------------------------------------------------------------------------------------------------------


def steep(degree):
    """One with a simple root, and one without any."""
    c = made("random", degree, 40, seed=17).requires_grad_()
    t = first_root(c)
    (gradient,) = torch.autograd.grad(torch.where(t < INF, t, 0).sum(), c)
    good = (t < INF) & (gradient.abs().sum(-1) < 20)
    return torch.cat((c.detach()[good][:1], torch.ones(1, degree + 1, dtype=torch.float64)))


@pytest.mark.parametrize("degree", [1, 2, 4])
def test_roots_are_differentiable_twice_in_every_mode(degree):
    c = steep(degree).requires_grad_()
    finite = lambda t: torch.where(t < INF, t, 0)  # noqa: E731
    for solve in (lambda x: finite(first_root(x)), lambda x: finite(all_roots(x).t)):
        assert torch.autograd.gradcheck(solve, c, check_forward_ad=True)
        assert torch.autograd.gradgradcheck(solve, c, atol=1e-4, rtol=1e-3, fast_mode=degree == 4)


@pytest.mark.parametrize("degree", range(1, 10))
def test_derivatives_say_where_the_root_goes(degree):
    """t(c + h d) = t + h t′ + ½ h² t″ along random directions d, by forward mode, alone and of the gradient."""
    c = steep(degree)[:1].repeat(4, 1)
    d = made("random", degree, 4, seed=31)
    first = torch.func.jvp(first_root, (c,), (d,))[1]
    slope = torch.func.grad(lambda x: first_root(x).sum())
    second = (torch.func.jvp(slope, (c,), (d,))[1] * d).sum(-1)
    h = 1e-4
    ahead, here, behind = (torch.stack([first_root(c + s * h * d) for s in (1, 0, -1)])).unbind()
    torch.testing.assert_close(first, (ahead - behind) / (2 * h), rtol=1e-4, atol=1e-4)
    torch.testing.assert_close(second, (ahead - 2 * here + behind) / h**2, rtol=1e-2, atol=1e-2)


def test_the_derivative_of_a_line_is_in_the_books():
    """t = a / (a − b): dt/da = −b / (a − b)², dt/db = a / (a − b)², and their derivatives."""
    c = torch.tensor([2.0, -3.0], dtype=torch.float64)
    a, b = c.tolist()
    gradient = torch.func.grad(first_root)(c)
    torch.testing.assert_close(gradient, torch.tensor([-b, a]).double() / (a - b) ** 2)
    expected = torch.tensor([[2 * b, -(a + b)], [-(a + b), 2 * a]]).double() / (a - b) ** 3
    torch.testing.assert_close(torch.func.hessian(first_root)(c), expected)


@pytest.mark.parametrize("degree", [1, 2, 5, 9])
def test_vmap_is_batching(degree):
    c = made("random", degree, 12, seed=19).reshape(3, 4, degree + 1)
    assert torch.equal(torch.func.vmap(first_root)(c), first_root(c))
    assert torch.equal(torch.func.vmap(first_root, in_dims=1, out_dims=1)(c), first_root(c))
    assert torch.equal(torch.func.vmap(lambda x: all_roots(x).t)(c), all_roots(c).t)
    single = torch.func.vmap(torch.func.vmap(torch.func.grad(lambda x: first_root(x).clamp_max(2))))(c)
    x = c.clone().requires_grad_()
    (together,) = torch.autograd.grad(first_root(x).clamp_max(2).sum(), x)
    torch.testing.assert_close(single, together)


@pytest.mark.parametrize("degree", range(2, 10))
def test_derivatives_are_finite_everywhere_and_zero_at_double_roots(degree):
    c = torch.cat([made(f, degree, 50) for f in FAMILIES]).requires_grad_()
    t = first_root(c)
    assert bool((t == INF).any())
    (gradient,) = torch.autograd.grad(torch.where(t < INF, t, 0).sum(), c)
    assert bool(gradient.isfinite().all())
    assert bool((gradient[t == INF] == 0).all())
    zero = torch.zeros(degree + 1, dtype=torch.float64, requires_grad=True)
    double = torch.tensor([1.0, -1.0, 1.0], dtype=torch.float64, requires_grad=True)
    for c in (zero, double):
        (gradient,) = torch.autograd.grad(first_root(c), c)
        assert bool((gradient == 0).all())


# --- the oracle, and what checks millions -----------------------------------------------------------------------------


def test_the_exact_oracle_counts_as_sympy_counts():
    sympy = pytest.importorskip("sympy")
    t = sympy.Symbol("t")
    generator = torch.Generator().manual_seed(23)
    for degree in range(1, 8):
        for _ in range(3):
            c = torch.randint(-8, 9, (degree + 1,), generator=generator).tolist()
            c[0] = c[0] or 1
            power = ExactPolynomial([float(x) for x in c]).power
            square = sympy.Poly(list(reversed(power)), t) ** 2 * sympy.Poly(4 * t - 1, t) if degree < 4 else None
            for f in [sympy.Poly(list(reversed(power)), t), *([square] if square else [])]:
                exact = ExactPolynomial([1.0])
                exact.power = [int(a) for a in reversed(f.all_coeffs())]
                n = len(exact.power) - 1
                scale = math.lcm(*(math.comb(n, j) for j in range(n + 1)))
                exact.bernstein = [
                    sum(scale * math.comb(i, j) // math.comb(n, j) * exact.power[j] for j in range(i + 1))
                    for i in range(n + 1)
                ]
                expected = sorted({root for root in sympy.real_roots(f) if 0 <= root <= 1}, key=float)
                assert exact.roots_between(Fraction(0), Fraction(1)) == len(expected)
                first = exact.first_root()
                assert (first is None) == (not expected)
                assert first is None or float(first) == pytest.approx(float(expected[0]), abs=1e-14)


def test_the_judge_tells_what_is_wrong():
    two = [3.0, -5.0, 4.0]
    first = float(first_root(torch.tensor(two, dtype=torch.float64)))
    second = float(all_roots(torch.tensor(two, dtype=torch.float64)).t[1])
    assert judge(two, first, 1e-15) == "right"
    assert judge(two, second, 1e-15) == "later"
    assert judge(two, INF, 1e-15) == "lost"
    assert judge(two, 0.9, 1e-15) == "invented"
    assert judge(two, first + 1e-8, 1e-15) == "inaccurate"
    assert judge([1.0, 1.0, 1.0], INF, 1e-15) == "right"
    assert judge([1.0, -1.0, 1.0 + 2**-52], 0.5, 1e-15) == "touch"
    assert judge([1.0, -1.0, 1.01], 0.5, 1e-15) == "invented"


def test_the_cheap_check_suspects_every_mistake():
    c, known = FAMILIES["near-double"](5, 300, torch.Generator().manual_seed(29))
    t = first_root(c)
    assert suspicious(c, t, known).double().mean() < 0.05
    assert bool(suspicious(c, torch.full_like(t, INF), known).all())
    assert bool(suspicious(c, t + 1e-3, known).all())
    later = all_roots(c).t[:, 1]
    wrong = (later < INF) & (later > known + 1e-6)
    assert bool(wrong.any())
    assert bool(suspicious(c, later, known)[wrong].all())
