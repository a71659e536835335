"""Laws of kernels, swept over KERNELS: everything derived from a table against textbook formulas and measurements."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import torch

from filterlab.kernels import KERNELS, Kernel, TensorKernel, bc, bspline
from tests import laws, oracles

# name: (support, degree, continuity, Strang-Fix order, interpolating); Unser 1999, Mitchell & Netravali 1988, the paper
TEXTBOOK = {
    "linear": (2, 1, 0, 2, True),
    "bspline0": (1, 0, -1, 1, True),
    "bspline1": (2, 1, 0, 2, True),
    "bspline2": (3, 2, 1, 3, False),
    "bspline3": (4, 3, 2, 4, False),
    "bspline4": (5, 4, 3, 5, False),
    "bspline5": (6, 5, 4, 6, False),
    "catmull-rom": (4, 3, 1, 3, True),
    "mitchell": (4, 3, 1, 3, False),
    "notch": (4, 2, 1, 3, False),
}
every_kernel = pytest.mark.parametrize("name", KERNELS)


def evaluate(kernel: Kernel, derivative: int = 0):
    return lambda x: kernel(torch.as_tensor(x, dtype=torch.float64), derivative).numpy()


def test_registry_holds_the_kernels_of_the_textbooks():
    assert set(TEXTBOOK) <= set(KERNELS)
    assert all(kernel.name == name for name, kernel in KERNELS.items())


@pytest.mark.parametrize("name", TEXTBOOK)
def test_declared_facts_are_the_textbook_ones(name):
    k = KERNELS[name]
    assert (k.support, k.degree, k.continuity, k.approximation_order, k.interpolating) == TEXTBOOK[name]


@every_kernel
def test_partition_of_unity(name):
    kernel = KERNELS[name]
    laws.assert_partition_of_unity(evaluate(kernel), kernel.support / 2)
    for x in (Fraction(0), Fraction(1, 2), Fraction(3, 7)):  # and exactly
        assert sum(kernel.exact(x - k) for k in range(-8, 9)) == 1


@every_kernel
def test_even_and_zero_outside_the_support(name):
    kernel = KERNELS[name]
    assert kernel.symmetric
    laws.assert_symmetric(evaluate(kernel), kernel.support / 2)


def test_an_uneven_kernel_is_not_symmetric():
    assert not KERNELS["bspline2"].derivative().symmetric


@every_kernel
def test_equals_the_textbook_with_every_derivative(name, rng):
    kernel = KERNELS[name]
    x = np.concatenate([rng.uniform(-4, 4, 200), np.arange(-8, 9) / 2])  # the knots too: their right side counts
    for m in range(kernel.degree + 2):
        expected = oracles.kernel(name, x, m)
        laws.assert_close(evaluate(kernel, m)(x), expected, 1e-12, max(1, np.abs(expected).max()))
        laws.assert_close(evaluate(kernel.derivative(m))(x), expected, 1e-12, max(1, np.abs(expected).max()))


@every_kernel
def test_approximation_order_is_measured_and_not_exceeded(name):
    kernel = KERNELS[name]
    assert laws.strang_fix_order(evaluate(kernel), kernel.support / 2) == kernel.approximation_order


@every_kernel
def test_continuity_is_measured_and_not_exceeded(name):
    kernel = KERNELS[name]
    knots = np.arange(kernel.support + 1) - kernel.support / 2
    measured = laws.continuity_order(lambda x, m: evaluate(kernel, m)(x), knots, kernel.degree + 1)
    assert measured == kernel.continuity


@every_kernel
def test_integer_samples(name):
    kernel = KERNELS[name]
    samples = kernel.integer_samples()
    assert all(isinstance(v, Fraction) for v in samples.values())
    k = np.arange(-5, 6)
    stored = np.array([float(samples.get(int(i), 0)) for i in k])
    laws.assert_close(stored, oracles.kernel(name, k), 1e-15)
    assert sum(samples.values()) == 1
    assert kernel.interpolating == bool(np.all(stored == (k == 0)))


@every_kernel
def test_moments_equal_quadrature(name):
    for power in range(7):
        moment = KERNELS[name].moment(power)
        assert isinstance(moment, Fraction)
        assert float(moment) == pytest.approx(oracles.moment(oracles.PIECES[name], power), abs=1e-12)


@every_kernel
def test_fourier_transform_equals_quadrature(name):
    omega = np.concatenate([np.linspace(-15, 15, 121), [0.0, 1e-9, 3.9999, 4.0, 4.0001, 2 * np.pi, 4 * np.pi]])
    transform = KERNELS[name].fourier(torch.as_tensor(omega))
    laws.assert_close(transform.real, oracles.fourier(oracles.PIECES[name], omega), 1e-13)
    laws.assert_close(transform.imag, np.zeros_like(omega), 1e-13)


@pytest.mark.parametrize("degree", range(6))
def test_fourier_transform_of_a_bspline_is_a_power_of_sinc(degree):
    omega = torch.tensor([0.0, 0.5, 3.0, 10.0, 100.0, 1e4], dtype=torch.float64)
    expected = torch.sinc(omega / (2 * torch.pi)) ** (degree + 1)
    laws.assert_close(bspline(degree).fourier(omega).real, expected, 1e-13)


@pytest.mark.parametrize("degree", range(6))
def test_bsplines_are_exactly_the_recursion(degree):
    for k in range(-50, 51):
        x = Fraction(k, 14)
        assert bspline(degree).exact(x) == oracles.bspline_exact(degree, x)


def test_members_of_the_bc_family_are_exactly_the_named_kernels():
    assert bc(1, 0).pieces == bspline(3).pieces
    assert bc(0, Fraction(1, 2)).pieces == KERNELS["catmull-rom"].pieces
    assert bc(0, 0.5).pieces == KERNELS["catmull-rom"].pieces
    assert bc(Fraction(1, 3), Fraction(1, 3)).pieces == KERNELS["mitchell"].pieces
    assert bc(Fraction(3, 2), Fraction(-1, 4)).pieces == KERNELS["notch"].pieces
    assert KERNELS["linear"].pieces == bspline(1).pieces


def test_the_notch_is_two_shifted_quadratics_exactly():
    quad, half = bspline(2), Fraction(1, 2)
    for k in range(-40, 41):
        x = Fraction(k, 12)
        assert KERNELS["notch"].exact(x) == (quad.exact(x - half) + quad.exact(x + half)) / 2


@pytest.mark.parametrize(("b", "c"), [(0.3, 0.2), (-1.0, 2.0), (1.5, -0.25), (0.0, 1.0)])
def test_any_bc_kernel(b, c):
    x = np.linspace(-3, 3, 121) + 1e-3
    expected = oracles.evaluate(oracles.bc_pieces(b, c), x)
    laws.assert_close(evaluate(bc(b, c))(x), expected, 1e-14)
    tensor = bc(torch.tensor(b, dtype=torch.float64), torch.tensor(c, dtype=torch.float64))
    assert isinstance(tensor, TensorKernel)
    laws.assert_close(tensor(torch.as_tensor(x)), expected, 1e-14)
    laws.assert_partition_of_unity(evaluate(tensor), 2)  # type: ignore[arg-type]
    one_tensor = bc(torch.tensor(b, dtype=torch.float64), c)
    laws.assert_close(one_tensor(torch.as_tensor(x)), expected, 1e-14)


def test_bc_kernels_reproduce_quadratics_only_where_b_plus_2c_is_one():
    for b in (Fraction(-1), Fraction(1, 5), Fraction(2)):
        on_the_line, off_it = bc(b, (1 - b) / 2), bc(b, (1 - b) / 2 + Fraction(1, 10))
        assert on_the_line.approximation_order == laws.strang_fix_order(evaluate(on_the_line), 2) == 3
        assert off_it.approximation_order == laws.strang_fix_order(evaluate(off_it), 2) == 1


@pytest.mark.parametrize("b", [Fraction(b) for b in ("-1", "0", "1/3", "1", "3/2", "2")])
@pytest.mark.parametrize("off", [Fraction(0), Fraction(1, 7)])
def test_the_order_without_a_prefilter_is_how_far_samples_of_polynomials_give_them_back(b, off):
    """Exactly: Σ_k k^j φ(x−k) = x^j for all j < L, and not for L. BC(−1, 1) has the moments 1, 0, −1/3: L is 2."""
    kernel = bc(b, (1 - b) / 2 + off)

    def gives_back(j: int) -> bool:
        at = (Fraction(1, 7), Fraction(2, 5), Fraction(-3, 4))
        return all(sum(k**j * kernel.exact(x - k) for k in range(-4, 5)) == x**j for x in at)

    order = next(j for j in range(9) if not gives_back(j))
    assert kernel.direct_order == order
    assert bc(Fraction(-1), Fraction(1)).direct_order == 2


def test_a_kernel_that_does_not_give_back_constants_has_no_order_without_a_prefilter():
    """A box of height 2 sums to a constant that is 2, a ramp of area 1 to none."""
    for pieces, order in ((((2,),), 1), (((0, 2),), 0)):
        kernel = Kernel("no", tuple(tuple(map(Fraction, piece)) for piece in pieces))
        assert (kernel.approximation_order, kernel.direct_order) == (order, 0)


@pytest.mark.parametrize("derivative", range(3))
def test_tensor_kernels_are_differentiable_twice(derivative):
    x = torch.tensor([-1.7, -0.4, 0.2, 0.9, 1.3], dtype=torch.float64, requires_grad=True)
    b, c = (torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (0.4, 0.1))

    def function(x, b, c):
        return bc(b, c)(x, derivative)

    assert torch.autograd.gradcheck(function, (x, b, c))
    assert torch.autograd.gradgradcheck(function, (x, b, c))


@every_kernel
def test_autograd_of_the_value_is_the_derivative(name, rng):
    x = torch.tensor(rng.uniform(-3.3, 3.3, 50), requires_grad=True)
    kernel = KERNELS[name]
    value = kernel(x)
    (gradient,) = torch.autograd.grad(value.sum(), x) if value.requires_grad else (torch.zeros_like(x),)
    laws.assert_close(gradient, kernel(x.detach(), 1), 1e-13)


@every_kernel
def test_taps_are_the_weights_of_the_samples_around_a_point(name):
    kernel = KERNELS[name]
    taps, half = kernel.taps(torch.float64), kernel.support / 2
    for x in (0.0, 0.3, 0.5, 2.75, -1.2):
        base = int(np.floor(x - half)) + 1
        u = (x - half) - np.floor(x - half)
        weights = [sum(float(c) * u**j for j, c in enumerate(row)) for row in taps]
        expected = oracles.kernel(name, x - np.arange(base, base + kernel.support))
        laws.assert_close(np.array(weights), expected, 1e-14)


@every_kernel
def test_dtype_and_shape_follow_the_argument(name):
    x = torch.linspace(-2, 2, 12, dtype=torch.float32).reshape(3, 4)
    value = KERNELS[name](x)
    assert value.dtype == torch.float32
    laws.assert_close(value, oracles.kernel(name, x.numpy().astype(np.float64)), 1e-6)
    assert torch.isnan(KERNELS[name](torch.tensor([torch.nan]))).all()


def test_callers_mistakes():
    with pytest.raises(ValueError, match="degree"):
        bspline(-1)
    with pytest.raises(ValueError, match="pieces"):
        Kernel("ragged", ((Fraction(1),), (Fraction(1), Fraction(0))))
    with pytest.raises(ValueError, match="table"):
        TensorKernel("flat", torch.zeros(4))
