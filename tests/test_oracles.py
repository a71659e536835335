"""The oracles against scipy, exact rationals and algebra; the assertion helpers against what they must reject."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import torch
from scipy import interpolate, ndimage

from tests import laws, oracles
from tests.oracles import BOUNDARIES, PIECES

SCIPY_MODE = {
    "mirror": "mirror",
    "reflect": "reflect",
    "wrap": "grid-wrap",
    "border": "nearest",
    "zeros": "grid-constant",
}
SHAPE = (5, 7, 6)


def volume(shape: tuple[int, ...] = SHAPE, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-1, 1, shape)


def scattered(shape: tuple[int, ...] = SHAPE, count: int = 60, beyond: float = 2.5, seed: int = 1) -> np.ndarray:
    """Points inside and up to `beyond` periods outside, in x, y, z order."""
    n = np.array(shape[::-1])
    return (np.random.default_rng(seed).uniform(-beyond, 1 + beyond, (count, 3))) * n


@pytest.mark.parametrize("degree", range(6))
def test_bsplines_equal_exact_recursion_and_scipy(degree):
    x = np.arange(-60, 61) / 16
    exact = [float(oracles.bspline_exact(degree, Fraction(k, 16))) for k in range(-60, 61)]
    laws.assert_close(oracles.kernel(f"bspline{degree}", x), np.array(exact), 4e-15)
    basis = interpolate.BSpline.basis_element(np.arange(degree + 2) - (degree + 1) / 2, extrapolate=False)
    for derivative in range(degree + 1):
        expected = np.nan_to_num(basis.derivative(derivative)(x) if derivative else basis(x))
        inner = np.abs(np.abs(x) - (degree + 1) / 2) > 1e-9  # scipy closes the last interval
        actual = oracles.kernel(f"bspline{degree}", x, derivative)
        laws.assert_close(actual[inner], expected[inner], 1e-12)


@pytest.mark.parametrize("name", PIECES)
def test_kernels_are_even_sum_to_one_and_differentiate(name):
    pieces = PIECES[name]
    laws.assert_partition_of_unity(lambda x: oracles.kernel(name, x), oracles.radius(pieces))
    laws.assert_symmetric(lambda x: oracles.kernel(name, x), oracles.radius(pieces))
    x, h = np.linspace(-2.9, 2.9, 41) + 0.0123, 1e-6
    for k in range(3):
        slope = (oracles.kernel(name, x + h, k) - oracles.kernel(name, x - h, k)) / (2 * h)
        laws.assert_close(oracles.kernel(name, x, k + 1), slope, 1e-8)


@pytest.mark.parametrize(("name", "order"), {**{f"bspline{d}": d + 1 for d in range(6)}, "notch": 3}.items())
def test_strang_fix_order_of_known_kernels(name, order):
    assert laws.strang_fix_order(lambda x: oracles.kernel(name, x), oracles.radius(PIECES[name])) == order


def test_notch_is_the_mean_of_two_shifted_quadratics_and_a_bc_kernel():
    x = np.linspace(-2.5, 2.5, 101)
    mean = (oracles.kernel("bspline2", x - 0.5) + oracles.kernel("bspline2", x + 0.5)) / 2
    laws.assert_close(oracles.kernel("notch", x), mean, 1e-15)
    laws.assert_close(oracles.evaluate(oracles.bc_pieces(1.5, -0.25), x), mean, 1e-15)
    laws.assert_close(oracles.evaluate(oracles.bc_pieces(1, 0), x), oracles.kernel("bspline3", x), 1e-15)


@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("n", [1, 2, 3, 5])
def test_extension_equals_numpy_pad(boundary, n):
    f = np.arange(1.0, n + 1)
    mode = {"mirror": "reflect", "reflect": "symmetric", "wrap": "wrap", "border": "edge", "zeros": "constant"}[
        boundary
    ]
    extended = oracles.extension_matrix(boundary, n, np.arange(-11, n + 11)) @ f
    laws.assert_close(extended, np.pad(f, 11, mode), 0.0)


@pytest.mark.parametrize(("name", "pole"), [("bspline2", 2 * np.sqrt(2) - 3), ("bspline3", np.sqrt(3) - 2)])
def test_inverse_filter_is_c_z_to_the_k_and_solves_the_dense_system(name, pole):
    k = np.arange(-oracles.REACH, oracles.REACH + 1)
    h = oracles.inverse_filter(name)
    outer = oracles.kernel(name, np.array(1.0))
    laws.assert_close(h, -pole / (outer * (1 - pole**2)) * pole ** np.abs(k), 1e-14)
    wide = np.arange(-200, 201)
    dense = oracles.kernel(name, wide[:, None] - wide)
    laws.assert_close(
        h, np.linalg.solve(dense, (wide == 0).astype(float))[200 - oracles.REACH : 201 + oracles.REACH], 1e-14
    )


@pytest.mark.parametrize("name", ["bspline2", "bspline3", "bspline4", "bspline5"])
@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("n", [1, 2, 3, 8])
def test_coefficients_solve_the_long_dense_system(name, boundary, n):
    """The samples continued by 150 voxels on both sides, Q c = f solved densely; seen up to 20 voxels outside."""
    long, looked_at = np.arange(-150, n + 150), np.arange(-20, n + 20)
    f = oracles.extension_matrix(boundary, n, long)
    solved = np.linalg.solve(oracles.kernel(name, long[:, None] - long), f)[130:-130]
    laws.assert_close(oracles.coefficient_matrix((name,), boundary, n, looked_at), solved, 1e-13)


@pytest.mark.parametrize("degree", range(1, 6))
@pytest.mark.parametrize("boundary", ["mirror", "reflect", "wrap"])
def test_prefiltered_bsplines_equal_scipy(degree, boundary):
    """Only there: under nearest and grid-constant scipy pads by 12 and mirrors.

    Its start for reflect is off by |pole|^2n (3e-4 for n = 2 and degree 3, against a dense solve), hence the long axes.
    """
    shape, name = (24, 26, 25), f"bspline{degree}"
    f, points = volume(shape), scattered(shape)
    (value,) = oracles.tensor_product(f, points, PIECES[name], (name,), boundary, 0)
    expected = ndimage.map_coordinates(f, points[:, ::-1].T, order=degree, mode=SCIPY_MODE[boundary])
    laws.assert_close(value, expected, 1e-12)


@pytest.mark.parametrize("degree", range(6))
@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_bsplines_of_samples_equal_scipy(degree, boundary):
    f, points, name = volume(), scattered(), f"bspline{degree}"
    (value,) = oracles.tensor_product(f, points, PIECES[name], (), boundary, 0)
    expected = ndimage.map_coordinates(f, points[:, ::-1].T, order=degree, mode=SCIPY_MODE[boundary], prefilter=False)
    laws.assert_close(value, expected, 1e-12)


@pytest.mark.parametrize("method", ["trilinear", "catmull-rom", "ncrsi", "triquadratic", "tricubic"])
@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_interpolating_methods_return_the_samples(method, boundary):
    for shape in ((1, 2, 3), (4, 1, 7), (5, 6, 2)):
        f = volume(shape)
        z, y, x = np.indices(shape).reshape(3, -1)
        (value,) = oracles.reconstruct(method, f, np.stack([x, y, z], -1).astype(float), boundary, order=0)
        laws.assert_close(value, f.ravel(), 1e-13)


def test_notch_and_mitchell_do_not_interpolate():
    f = volume()
    for method in ("notch", "mitchell"):
        (value,) = oracles.reconstruct(method, f, np.array([[2.0, 3.0, 2.0]]), order=0)
        assert abs(value[0] - f[2, 3, 2]) > 1e-3


def test_ncrsi_is_a_catmull_rom_spline_on_grid_lines_and_reproduces_quadratics():
    f = volume((9, 9, 9))
    t = np.linspace(2, 6, 23)
    for d in range(3):
        line = np.tile([3.0, 4.0, 5.0], (t.size, 1))
        line[:, d] = t
        along = oracles.reconstruct("catmull-rom", f, line, order=0)[0]
        laws.assert_close(oracles.ncrsi(f, line, "mirror", order=0)[0], along, 1e-14)
    z, y, x = np.indices((9, 9, 9)).astype(float)

    def quadratic(x, y, z):
        return 1 + x - 2 * y + 0.5 * z + x * y - y * z + 0.3 * x * x + 0.2 * y * y - 0.7 * z * z

    points = np.random.default_rng(3).uniform(2, 6, (40, 3))
    laws.assert_close(oracles.ncrsi(quadratic(x, y, z), points, "mirror")[0], quadratic(*points.T), 1e-12)


@pytest.mark.parametrize("method", oracles.METHODS)
@pytest.mark.parametrize("boundary", BOUNDARIES)
def test_gradient_and_hessian_are_differences(method, boundary):
    f, h = volume(), 1e-5
    points = np.floor(scattered(count=12)) + np.random.default_rng(4).choice([0.13, 0.31, 0.66, 0.88], (12, 3))
    _, gradient, hessian = oracles.reconstruct(method, f, points, boundary, order=2)
    for d, e in enumerate(np.eye(3) * h):
        up, down = (oracles.reconstruct(method, f, points + s, boundary, order=1) for s in (e, -e))
        laws.assert_close(gradient[:, d], (up[0] - down[0]) / (2 * h), 1e-8)
        laws.assert_close(hessian[:, d], (up[1] - down[1]) / (2 * h), 1e-8)


def test_derivatives_at_knots_are_right_sided():
    f = np.array([0.0, 1.0, 5.0, 2.0]).reshape(1, 1, 4)
    _, gradient = oracles.reconstruct("trilinear", f, np.array([[0.0, 0, 0], [1, 0, 0], [3, 0, 0], [-1, 0, 0]]))
    laws.assert_close(gradient[:, 0], np.array([1.0, 4.0, 3.0, -1.0]), 1e-15)  # mirror: f(4) = f(2) = 5, f(−1) = 1
    assert oracles.kernel("bspline0", np.array([-0.5, 0.5])).tolist() == [1, 0]


@pytest.mark.parametrize("method", ["triquadratic", "notch", "tricubic", "ncrsi"])
@pytest.mark.parametrize("boundary", BOUNDARIES)
@pytest.mark.parametrize("prefilter", [True, False])
def test_trilinear_schemes_equal_direct_sums(method, boundary, prefilter):
    f, points = volume(), scattered(count=20, beyond=0.5)
    value, gradient = oracles.trilinear_scheme(method, f, points, boundary, prefilter)
    expected = oracles.reconstruct(
        method, f, points, boundary, prefilter, "central" if method == "ncrsi" else "analytic"
    )
    laws.assert_close(value, expected[0], 1e-13)
    laws.assert_close(gradient, expected[1], 1e-12)


def test_texture_rounds_fractions():
    c = np.zeros((4, 4, 4))
    c[1, 1, 2] = 256
    at = np.array([[1 + 0.4 / 256, 1, 1], [1 + 0.6 / 256, 1, 1], [1 + 255.7 / 256, 1, 1]])
    assert oracles.texture(c, 0, at, 256).tolist() == [0, 1, 256]
    laws.assert_close(oracles.texture(c, 0, at, None), np.array([0.4, 0.6, 255.7]), 1e-12)


@pytest.mark.parametrize("method", ["trilinear", "triquadratic", "notch", "tricubic"])
@pytest.mark.parametrize("prefilter", [True, False])
def test_quadrature_responses_equal_the_printed_ones(method, prefilter):
    omega = np.linspace(0, 4 * np.pi, 201)
    laws.assert_close(
        oracles.axis_response(method, omega, prefilter), oracles.textbook_response(method, omega, prefilter), 1e-13
    )


def test_moments_of_the_quadratic_bspline():
    """Mean 0, variance (d+1)/12, integral 1."""
    assert [round(oracles.moment(PIECES["bspline2"], k), 14) for k in range(4)] == [1, 0, 0.25, 0]


def broken(x: np.ndarray) -> np.ndarray:
    """The quadratic B-spline, 1e-6 too high in the middle piece on its right side."""
    return oracles.kernel("bspline2", x) + 1e-6 * ((x > 0) & (x < 0.5))


@pytest.mark.parametrize(
    "assertion",
    [
        lambda: laws.assert_close(np.array([1.0, np.nan]), np.array([1.0, 1.0]), 1e9),
        lambda: laws.assert_close(np.array([1.0]), np.array([1.0 + 1e-9]), 1e-10),
        lambda: laws.assert_close(np.zeros((2, 1)), np.zeros((1, 2)), 1),
        lambda: laws.assert_partition_of_unity(broken, 1.5),
        lambda: laws.assert_symmetric(broken, 1.5),
        lambda: laws.assert_symmetric(lambda x: oracles.kernel("bspline3", x), 1.5),
        lambda: laws.assert_linear(lambda x: x + 1, torch.ones(2), torch.ones(2)),
        lambda: laws.assert_adjoint(WrongTranspose.apply, torch.arange(5.0, dtype=torch.float64)),
    ],
)
def test_assertions_reject_what_they_must(assertion):
    with pytest.raises(AssertionError):
        assertion()


class WrongTranspose(torch.autograd.Function):
    """A cumulative sum whose backward forgets to run the other way."""

    @staticmethod
    def forward(ctx, x):
        return x.cumsum(0)

    @staticmethod
    def backward(ctx, g):  # type: ignore[override]
        return g.cumsum(0)


def test_measurements_see_a_small_break():
    assert laws.strang_fix_order(broken, 1.5) == 0
    knots = np.array([-1.5, -0.5, 0.5, 1.5])
    assert laws.continuity_order(lambda x, k: oracles.kernel("bspline2", x, k), knots, 2) == 1
    assert laws.continuity_order(lambda x, k: oracles.kernel("bspline0", x, k), knots / 3, 2) == -1
    h = np.array([1 / 16, 1 / 32, 1 / 64])
    assert laws.fitted_order(h, 7 * h**3) == pytest.approx(3)


def test_adjoint_accepts_the_right_transpose():
    laws.assert_adjoint(lambda x: x.cumsum(0), torch.arange(5.0, dtype=torch.float64))


def test_finite_difference_is_of_fourth_order():
    p = torch.tensor([[0.3, -0.2, 0.5]], dtype=torch.float64)
    exact = torch.stack([p[:, 0].cos(), 2 * p[:, 1], torch.ones(1, dtype=torch.float64)], -1)
    laws.assert_close(laws.finite_difference(lambda q: q[:, 0].sin() + q[:, 1] ** 2 + q[:, 2], p), exact, 1e-11)
