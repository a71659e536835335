"""Every method against the direct float64 sum of the oracle, and every declared fact against a measurement."""

from __future__ import annotations

from collections.abc import Iterable
from functools import cache
from itertools import product

import numpy as np
import pytest
import torch
from scipy import ndimage

from filterlab.kernels import KERNELS
from filterlab.methods import METHODS, Method, named, reconstruct, tensor_product
from filterlab.volume import Boundary, Volume
from tests import laws, oracles
from tests.pairs import covering, in_pairs

SHAPES = ((5, 7, 6), (1, 2, 3), (4, 3, 1), (2, 1, 9))
TENSOR_PRODUCTS = tuple(name for name in METHODS if tensor_product(name))
CONTINUOUS = tuple(name for name in TENSOR_PRODUCTS if METHODS[name].facts.continuity >= 0)
every_method = pytest.mark.parametrize("method", METHODS)
every_boundary = pytest.mark.parametrize("boundary", Boundary)


def samples_of(shape: tuple[int, ...], seed: int = 0) -> np.ndarray:
    """Random samples in [−1, 1] that float32 holds exactly."""
    return np.random.default_rng(seed).uniform(-1, 1, shape).astype(np.float32).astype(np.float64)


def points_of(shape: tuple[int, ...], count: int = 40) -> np.ndarray:
    """Points inside and up to two and a half periods outside that float32 holds exactly; off the knots."""
    n, rng = np.array(shape[::-1]), np.random.default_rng(1)
    inside, around = rng.uniform(-0.5, n - 0.5, (count, 3)), rng.uniform(-2.5, 3.5, (count, 3)) * n
    points = np.concatenate([inside, around]).astype(np.float32).astype(np.float64)
    near = np.abs(2 * points - np.round(2 * points)) < 2e-4
    return np.where(near, points + 0.015625, points)


@cache
def truth(method: str, shape: tuple[int, ...], boundary: str, prefilter: bool, gradient: str, order: int):
    return oracles.reconstruct(method, samples_of(shape), points_of(shape), boundary, prefilter, gradient, order)


def ways() -> list[tuple[str, str, str, bool]]:
    """(method, scheme, gradient, prefilter): every combination that METHODS offers."""
    out = []
    for name, method in METHODS.items():
        for scheme, gradient in product(method.facts.schemes, method.facts.gradients):
            if scheme == "sampled" and gradient != method.sampled_gradient:
                continue
            out += [(name, scheme, gradient, p) for p in ((True, False) if method.facts.prefiltered else (True,))]
    return out


every_way = pytest.mark.parametrize(("method", "scheme", "gradient", "prefilter"), ways())


def in_ways(*more: Iterable[object]) -> list[tuple]:
    """(method, scheme, gradient, prefilter, …): all pairs of a method with or without prefilter, a scheme with its
    gradient, and each of `more`."""
    every = (((m, p), (s, g), *rest) for m, s, g, p in ways() for rest in product(*more))
    return [(m, s, g, p, *rest) for (m, p), (s, g), *rest in in_pairs(every)]


every_way_and_boundary = pytest.mark.parametrize(
    ("method", "scheme", "gradient", "prefilter", "boundary"), in_ways(Boundary)
)


def kind_of(method: str) -> str:
    """Programs of a kind are put together alike: what goes into them is met by the kind, not by each of its methods."""
    if method not in TENSOR_PRODUCTS:
        return "tetrahedra"
    return "terms" if method == "ncrsi" else "tensor product"


@pytest.mark.parametrize(
    ("method", "scheme", "gradient", "prefilter", "boundary", "dtype"),
    in_ways(Boundary, (torch.float64, torch.float32)),
)
def test_equals_the_direct_sum_of_the_oracle(method, scheme, gradient, prefilter, boundary, dtype):
    """Value, gradient and, where offered, Hessian; ≤ 1e-12 of the range in float64, ≤ 5e-6 in float32."""
    tolerance = 1e-12 if dtype == torch.float64 else 5e-6
    for shape in SHAPES:
        samples = torch.as_tensor(samples_of(shape)).to(dtype)
        field = reconstruct(samples, method, boundary=boundary, prefilter=prefilter, scheme=scheme, gradient=gradient)
        jet = field.jet(torch.as_tensor(points_of(shape)).to(dtype), field.max_order)
        expected = truth(method, shape, str(boundary), prefilter, gradient, field.max_order)
        assert len(jet) == field.max_order + 1
        for order, (actual, exact) in enumerate(zip(jet, expected, strict=True)):
            assert actual.dtype == dtype
            scale = np.ptp(samples_of(shape)) * max(1.0, np.abs(exact).max() / 2 if order == 2 else 1.0)
            laws.assert_close(actual, exact, tolerance, scale)


@every_method
def test_the_direct_sum_keeps_its_digits_on_long_axes_in_float32(method):
    """The cell is split off before anything is computed: 5e-6 of the range holds at voxel 500 as at voxel 5."""
    f = samples_of((3, 2, 512))
    points = points_of((3, 2, 512))[:40]
    kind = METHODS[method].facts.gradients[0]
    jet = reconstruct(torch.as_tensor(f).float(), method).value_and_gradient(torch.as_tensor(points).float())
    for actual, expected in zip(jet, oracles.reconstruct(method, f, points, gradient=kind), strict=True):
        laws.assert_close(actual, expected, 5e-6, 2.0)


@every_way_and_boundary
def test_the_ends_of_the_box_and_of_a_period_are_right(method, scheme, gradient, prefilter, boundary):
    """Exactly on the first and last voxel, on the faces and on the turning points, where points are folded."""
    for shape in ((2, 3, 4), (1, 5, 2)):
        f = samples_of(shape)
        axes = [np.array([-n, -1, -0.5, 0, n - 1, n - 0.5, n, 2 * n - 2]) for n in shape[::-1]]
        points = np.stack(np.meshgrid(*axes), -1).reshape(-1, 3).astype(float)
        if METHODS[method].facts.continuity < 0:  # where it jumps, folded points are on either side
            points += 0.01
        field = reconstruct(
            torch.as_tensor(f), method, boundary=boundary, prefilter=prefilter, scheme=scheme, gradient=gradient
        )
        value, slopes = field.value_and_gradient(torch.as_tensor(points))
        expected = oracles.reconstruct(method, f, points, str(boundary), prefilter, gradient)
        laws.assert_close(value, expected[0], 1e-12, 2.0)
        if METHODS[method].facts.continuity >= 1 or gradient == "central":
            laws.assert_close(slopes, expected[1], 1e-12, 2.0)


@every_way
def test_the_jets_of_lower_order_are_the_first_parts_of_the_higher(method, scheme, gradient, prefilter):
    samples, points = torch.as_tensor(samples_of((5, 7, 6))), torch.as_tensor(points_of((5, 7, 6)))
    field = reconstruct(samples, method, scheme=scheme, gradient=gradient, prefilter=prefilter)
    jet = field.jet(points, field.max_order)
    laws.assert_close(field(points), jet[0], 1e-14)
    for actual, expected in zip(field.value_and_gradient(points), jet, strict=False):
        laws.assert_close(actual, expected, 1e-13)


@pytest.mark.parametrize(
    ("method", "prefilter", "boundary", "dtype"),
    in_pairs(product(METHODS, (True, False), Boundary, (torch.float64, torch.float32))),
)
def test_interpolating_methods_return_every_sample_and_the_others_do_not(method, prefilter, boundary, dtype):
    """n = 1 … 7 and 32 along each axis, first and last sample included."""
    facts = METHODS[method].facts
    interpolating = facts.interpolating if prefilter else facts.interpolating_without_prefilter
    for n in (1, 2, 3, 4, 5, 6, 7, 32):
        for axis in range(3) if n in (1, 2, 32) else (n % 3,):
            shape = tuple(np.roll((n, 3, 2), axis))
            f = torch.as_tensor(samples_of(shape, seed=n))
            z, y, x = np.indices(shape)
            points = torch.as_tensor(np.stack([x, y, z], -1).astype(float))
            field = reconstruct(f.to(dtype), method, boundary=boundary, prefilter=prefilter)
            if interpolating:
                laws.assert_close(field(points.to(dtype)), f, 1e-12 if dtype == torch.float64 else 5e-6, 2.0)
            else:
                assert float((field(points.to(dtype)) - f).abs().max()) > 1e-3


@pytest.mark.parametrize(("method", "degree"), [("trilinear", 1), ("triquadratic", 2), ("tricubic", 3)])
@pytest.mark.parametrize("boundary", ["mirror", "reflect", "wrap"])
def test_agrees_with_scipy(method, degree, boundary):
    """On axes of 24 and more: scipy's own prefilter is inexact for reflect on short ones."""
    shape = (24, 26, 25)
    f, points = samples_of(shape), points_of(shape)
    expected = ndimage.map_coordinates(
        f, points[:, ::-1].T, order=degree, mode={"wrap": "grid-wrap"}.get(boundary, boundary)
    )
    laws.assert_close(
        reconstruct(torch.as_tensor(f), method, boundary=boundary)(torch.as_tensor(points)), expected, 1e-12
    )


@pytest.mark.parametrize("degree", range(6))
@pytest.mark.parametrize("prefilter", [True, False])
@every_boundary
def test_any_bspline_kernel_makes_a_method_that_agrees_with_scipy(degree, prefilter, boundary):
    shape = (24, 26, 25)
    f, points = samples_of(shape), points_of(shape)
    mode = {"wrap": "grid-wrap", "border": "nearest", "zeros": "grid-constant"}.get(boundary, str(boundary))
    field = reconstruct(torch.as_tensor(f), KERNELS[f"bspline{degree}"], boundary=boundary, prefilter=prefilter)
    if prefilter and boundary in ("border", "zeros"):  # scipy's prefilter does not know these two
        name = f"bspline{degree}"
        (expected,) = oracles.tensor_product(f, points, oracles.PIECES[name], (name,), boundary, 0)
    else:
        expected = ndimage.map_coordinates(f, points[:, ::-1].T, order=degree, mode=mode, prefilter=prefilter)
    laws.assert_close(field(torch.as_tensor(points)), expected, 1e-12, 2.0)


# ---- facts

# support, taps, approximation order with and without prefilter, continuity, interpolating with and without prefilter
PUBLISHED = {
    "trilinear": (2, 8, 2, 2, 0, True, True),
    "catmull-rom": (4, 64, 3, 3, 1, True, True),
    "ncrsi": (4, 32, 3, 3, 0, True, True),
    "triquadratic": (3, 27, 3, 2, 1, True, False),
    "notch": (4, 27, 3, 2, 1, False, False),
    "mitchell": (4, 64, 2, 2, 1, False, False),
    "tricubic": (4, 64, 4, 2, 2, True, False),
    "qss": (3, 27, 3, 2, 0, False, False),
    "cubic-c1": (3, 23, 3, 2, 1, False, False),
    "quadratic-c1": (5, 28, 3, 2, 1, False, False),
}


def test_the_registry_holds_the_ten_methods():
    assert set(PUBLISHED) <= set(METHODS)
    assert all(m.name == name for name, m in METHODS.items())


@pytest.mark.parametrize("method", PUBLISHED)
def test_declared_facts_are_the_published_ones(method):
    f = METHODS[method].facts
    declared = (
        f.support,
        f.taps,
        f.approximation_order,
        f.approximation_order_without_prefilter,
        f.continuity,
        f.interpolating,
        f.interpolating_without_prefilter,
    )
    assert declared == PUBLISHED[method]
    assert f.prefiltered == (method not in ("trilinear", "catmull-rom", "ncrsi", "mitchell"))
    assert f.gradients[0] == ("central" if method == "ncrsi" else "analytic")
    assert set(f.gradients) == ({"analytic", "central"} if method in ("trilinear", "ncrsi") else {"analytic"})
    assert ("sampled" in f.schemes) == (method in ("trilinear", "ncrsi", "triquadratic", "notch", "tricubic"))


def polynomial(degree: int, p: np.ndarray) -> np.ndarray:
    """Σ over all monomials of total degree ≤ `degree`, with fixed coefficients."""
    x, y, z = np.moveaxis(p, -1, 0)
    rng = np.random.default_rng(degree)
    return sum(
        rng.uniform(0.5, 1.5) * x**i * y**j * z**k
        for i, j, k in product(range(degree + 1), repeat=3)
        if i + j + k <= degree
    )


@every_method
@pytest.mark.parametrize("prefilter", [True, False])
def test_polynomials_are_reproduced_up_to_the_declared_order_and_no_further(method, prefilter):
    """Of total degree L − 1, mixed terms included: value, analytic gradient; not of degree L."""
    facts = METHODS[method].facts
    order = facts.approximation_order if prefilter else facts.approximation_order_without_prefilter
    half = METHODS[method].reach(prefilter) + 2  # what lies further off is not seen, not even through the prefilter
    z, y, x = np.indices((2 * half + 1,) * 3) - half
    grid = np.stack([x, y, z], -1).astype(float)
    points = np.random.default_rng(5).uniform(-1, 1, (40, 3))

    def field(degree, **options):
        samples = torch.as_tensor(polynomial(degree, grid))
        at_the_middle = Volume(samples, origin=(-half, -half, -half))
        return reconstruct(at_the_middle, method, prefilter=prefilter, **options), float(samples.abs().max())

    def error(degree):
        found, _ = field(degree)
        return np.abs(found(torch.as_tensor(points)).numpy() - polynomial(degree, points)).max()

    exact, largest = field(order - 1, gradient="analytic", scheme="direct")
    rounding = 64 * np.finfo(float).eps * largest  # of samples as large, in sums of up to 64 taps
    assert error(order - 1) < rounding
    assert error(order) > 1e-3
    at = torch.as_tensor(points)
    slopes = laws.finite_difference(lambda p: torch.as_tensor(polynomial(order - 1, p.numpy())), at, 0.05)
    laws.assert_close(exact.value_and_gradient(at)[1], slopes, 1e-7)


@pytest.mark.parametrize("method", TENSOR_PRODUCTS)
def test_continuity_is_measured_and_not_exceeded(method):
    """Jumps of derivatives across the planes where two polynomial pieces meet, along lines in general position."""
    facts, f = METHODS[method].facts, samples_of((7, 7, 7))
    knots = np.arange(2, 5) + (facts.support % 2) / 2
    jumps = np.zeros(3)
    field = reconstruct(torch.as_tensor(f), method, gradient="analytic", scheme="direct")
    for axis, knot in product(range(3), knots):
        for others in ((3.21, 2.83), (2.45, 3.6)):
            point = np.insert(others, axis, knot)
            sides = [point + s * 1e-9 * np.eye(3)[axis] for s in (-1, 1)]
            jet = [field.jet(torch.as_tensor(p[None]), 2) for p in sides]
            for order in range(3):
                jumps[order] = max(jumps[order], float((jet[1][order] - jet[0][order]).abs().max()))
    smooth = [bool((jumps[: order + 1] < 1e-6).all()) for order in range(3)]
    assert smooth == [order <= facts.continuity for order in range(3)], jumps


@every_boundary
def test_gradients_at_knots_inside_are_right_sided(boundary):
    """At integers trilinear has two slopes; the right one counts, the last voxel aside (its right side is outside)."""
    f = samples_of((4, 5, 6))
    z, y, x = np.indices((3, 4, 5))
    points = np.stack([x, y, z], -1).reshape(-1, 3).astype(float)
    for method in ("trilinear", "ncrsi"):
        field = reconstruct(torch.as_tensor(f), method, boundary=boundary, gradient="analytic")
        _, gradient = field.value_and_gradient(torch.as_tensor(points))
        expected = oracles.reconstruct(method, f, points, str(boundary))[1]
        laws.assert_close(gradient, expected, 1e-12)


# ---- laws of space


@every_method
def test_axes_are_treated_alike(method):
    f, points = torch.as_tensor(samples_of((4, 5, 6))), torch.as_tensor(points_of((4, 5, 6)))
    value, gradient = reconstruct(f, method).value_and_gradient(points)
    for order in ((0, 2, 1), (1, 0, 2), (2, 1, 0), (1, 2, 0)):  # new axis i is old axis order[i], in x, y, z
        dims = [2 - order[2 - i] for i in range(3)]
        turned = reconstruct(f.permute(dims), method).value_and_gradient(points[:, order])
        laws.assert_close(turned[0], value, 1e-13)
        laws.assert_close(turned[1], gradient[:, order], 1e-12)


@every_method
@pytest.mark.parametrize("prefilter", [True, False])
def test_shifting_the_samples_shifts_the_field_under_wrap(method, prefilter):
    f, points = torch.as_tensor(samples_of((4, 5, 6))), torch.as_tensor(points_of((4, 5, 6)))
    field = reconstruct(f, method, boundary="wrap", prefilter=prefilter)
    z, y, x = (2, -2, 4) if method == "quadratic-c1" else (1, -2, 3)  # octahedra lie as they did after even steps only
    rolled = reconstruct(f.roll((z, y, x), (0, 1, 2)), method, boundary="wrap", prefilter=prefilter)
    shifted = points + torch.tensor([float(x), float(y), float(z)])
    for a, b in zip(rolled.value_and_gradient(shifted), field.value_and_gradient(points), strict=True):
        laws.assert_close(a, b, 1e-12)


@every_method
@pytest.mark.parametrize("boundary", ["mirror", "reflect", "wrap", "border"])
def test_a_constant_is_constant_everywhere_and_one_voxel_is_one(method, boundary):
    for shape in ((1, 1, 1), (3, 1, 4)):
        field = reconstruct(torch.full(shape, 3.5, dtype=torch.float64), method, boundary=boundary)
        value, gradient = field.value_and_gradient(torch.as_tensor(points_of((3, 3, 4))))
        laws.assert_close(value, np.full(80, 3.5), 1e-13)
        laws.assert_close(gradient, np.zeros((80, 3)), 1e-13)


@every_method
@pytest.mark.parametrize("boundary", ["border", "zeros"])
def test_far_outside_border_and_zeros_are_what_they_say(method, boundary):
    f = torch.as_tensor(samples_of((4, 5, 6)))
    far = torch.tensor([[-1e6, -1e6, -1e6], [1e6, 2.0, 1e9]], dtype=torch.float64)
    value, gradient = reconstruct(f, method, boundary=boundary).value_and_gradient(far)
    line = oracles.reconstruct(method, f.numpy(), np.array([[90.0, 2.0, 90.0]]), boundary, order=0)[0]
    expected = [float(f[0, 0, 0]), float(line[0])] if boundary == "border" else [0.0, 0.0]
    laws.assert_close(value, np.array(expected), 1e-12)
    laws.assert_close(gradient[:, [0, 2]], np.zeros((2, 2)), 1e-12)


@every_method
@pytest.mark.parametrize("boundary", ["mirror", "reflect", "wrap"])
def test_far_outside_the_others_are_periodic(method, boundary):
    shape = (4, 5, 6)
    n = torch.tensor(shape[::-1], dtype=torch.float64)
    period = {"mirror": 2 * n - 2, "reflect": 2 * n, "wrap": n}[boundary]
    points = torch.floor(torch.as_tensor(points_of(shape)) * 64) / 64 + 1 / 256  # so that the far points are exact
    field = reconstruct(torch.as_tensor(samples_of(shape)), method, boundary=boundary)
    for a, b in zip(field.value_and_gradient(points + 10**6 * period), field.value_and_gradient(points), strict=True):
        laws.assert_close(a, b, 1e-12)


@every_way_and_boundary
def test_nan_and_infinite_points_give_no_wrong_number(method, scheme, gradient, prefilter, boundary):
    field = reconstruct(
        torch.ones(3, 4, 5), method, scheme=scheme, gradient=gradient, prefilter=prefilter, boundary=boundary
    )
    nan, inf = float("nan"), float("inf")
    value, slopes = field.value_and_gradient(torch.tensor([[nan, 1.0, 1.0], [1.0, 1.0, nan], [1.0, 1.0, 1.0]]))
    assert torch.isnan(value[:2]).all()
    assert torch.isfinite(value[2])
    assert torch.isnan(slopes[:2]).any(-1).all()
    field(torch.tensor([[inf, 1.0, -inf]]))  # no exception, no read out of bounds


# ---- shapes, storage, batches


@every_way
def test_a_batch_is_a_loop(method, scheme, gradient, prefilter):
    f = torch.as_tensor(samples_of((2, 3, 4, 3, 5)))
    points = torch.as_tensor(points_of((4, 3, 5), count=6)).reshape(2, 6, 3).reshape(2, 3, 2, 3)
    options = {"scheme": scheme, "gradient": gradient, "prefilter": prefilter}
    field = reconstruct(f, method, **options)
    jet = field.jet(points, field.max_order)
    assert jet[0].shape == (2, 3, 3, 2)
    assert jet[1].shape == (2, 3, 3, 2, 3)
    for n, c in product(range(2), range(3)):
        single = reconstruct(f[n, c], method, **options).jet(points[n], field.max_order)
        for a, b in zip(jet, single, strict=True):
            laws.assert_close(a[n, c], b, 1e-13)
    shared = field.jet(points[:1], 1)
    assert shared[0].shape == (2, 3, 3, 2)
    repeated = field.jet(points[:1].expand(2, -1, -1, -1), 1)
    for a, b in zip(shared, repeated, strict=True):
        laws.assert_close(a, b, 1e-13)


@every_method
@pytest.mark.parametrize("lead", [(), (0,), (1,), (2, 0, 3), (3, 1, 2)])
def test_points_of_any_shape(method, lead):
    field = reconstruct(torch.as_tensor(samples_of((3, 4, 5))), method)
    points = torch.rand(*lead, 3, dtype=torch.float64)
    value, gradient = field.value_and_gradient(points)
    assert value.shape == lead
    assert gradient.shape == (*lead, 3)
    laws.assert_close(value.reshape(-1), field(points.reshape(-1, 3)), 1e-14)
    batched = reconstruct(torch.as_tensor(samples_of((2, 1, 3, 4, 5))), method)
    value, gradient = batched.value_and_gradient(points.expand(2, *lead, 3)) if lead else (None, None)
    if value is not None and gradient is not None:
        assert value.shape == (2, 1, *lead)
        assert gradient.shape == (2, 1, *lead, 3)


STORAGES = (torch.uint8, torch.int16, torch.float16, torch.bfloat16, torch.float32, torch.float64)
POINT_TYPES = (torch.float16, torch.float32, torch.float64, torch.int64)


@pytest.mark.parametrize(
    ("method", "storage", "point_type"),
    covering(product(METHODS, STORAGES, POINT_TYPES), lambda m, s, p: (m, (kind_of(m), s), (kind_of(m), p), (s, p))),
)
def test_every_storage_and_point_type(method, storage, point_type):
    """Compute type = promote(points, float32); the volume is read as it is stored and not touched."""
    f = (torch.as_tensor(samples_of((4, 3, 5))) * 100 + 120).to(storage)
    kept, points = f.clone(), torch.tensor([[1.25, 0.75, 2.5], [3.5, 1.0, -0.5]]).to(point_type)
    field = reconstruct(f, method)
    value, gradient = field.value_and_gradient(points)
    compute = torch.promote_types(point_type, torch.float32)
    assert value.dtype == gradient.dtype == compute
    exact = reconstruct(f.double(), method).value_and_gradient(points.double())
    tolerance = 1e-12 if (storage, compute) == (torch.float64, torch.float64) else 5e-6
    laws.assert_close(value, exact[0], tolerance, 220)
    laws.assert_close(gradient, exact[1], tolerance, 220)
    assert torch.equal(f, kept)


@pytest.mark.parametrize(
    ("method", "storage", "boundary"),
    covering(
        product(METHODS, (torch.int8, torch.int32, torch.int64), ("mirror", "zeros")),
        lambda m, s, b: (m, (kind_of(m), s), (kind_of(m), b), (s, b)),
    ),
)
def test_integers_of_any_width_are_the_numbers_that_they_are(method, storage, boundary):
    """Those that torch has, beside what `test_every_storage_and_point_type` takes."""
    f = (torch.as_tensor(samples_of((4, 3, 5))) * 50 + 60).round()
    points = torch.tensor([[1.25, 0.75, 2.5], [3.6, 1.1, -0.5]])
    expected = reconstruct(f.float(), method, boundary=boundary)(points)
    laws.assert_close(reconstruct(f.to(storage), method, boundary=boundary)(points), expected, 1e-6, 120)


@every_method
def test_float64_is_honoured_end_to_end(method):
    """A ripple of 1e-10 on 1000 is invisible to float32."""
    f = 1000 + 1e-10 * torch.as_tensor(samples_of((4, 5, 6)))
    points = torch.as_tensor(points_of((4, 5, 6)))
    gradient = reconstruct(f, method).value_and_gradient(points)[1]
    kind = METHODS[method].facts.gradients[0]
    expected = oracles.reconstruct(method, f.numpy() - 1000, points.numpy(), gradient=kind)[1]
    laws.assert_close(gradient, expected, 5e-12)


@every_method
def test_strides_do_not_matter(method):
    f = torch.as_tensor(samples_of((8, 10, 9)))[::2, 1::3].transpose(0, 2)
    points = torch.as_tensor(points_of((9, 3, 4))).expand(2, -1, 3)[..., [2, 0, 1]]
    assert not f.is_contiguous()
    dense = reconstruct(f.contiguous(), method).value_and_gradient(points.contiguous())
    for a, b in zip(reconstruct(f, method).value_and_gradient(points), dense, strict=True):
        laws.assert_close(a, b, 1e-14)


@every_method
def test_many_points_are_chunked_and_give_the_same(method):
    f = torch.as_tensor(samples_of((4, 5, 6))).float()
    points = torch.rand(70_001, 3) * 5
    whole = reconstruct(f, method)(points)
    laws.assert_close(whole[-1000:], reconstruct(f, method)(points[-1000:]), 1e-6)
    laws.assert_close(whole[32_000:33_000], reconstruct(f, method)(points[32_000:33_000]), 1e-6)


# ---- callers' mistakes


@pytest.mark.parametrize(
    ("options", "match"),
    [
        ({"method": "lanczos"}, "trilinear, catmull-rom, ncrsi"),
        ({"boundary": "clamp"}, "mirror, reflect, wrap, border, zeros"),
        ({"scheme": "fuzed"}, "fused, direct, sampled"),
        ({"method": "catmull-rom", "scheme": "sampled"}, "direct"),
        ({"gradient": "central"}, "analytic"),
        ({"gradient": "sobel"}, "analytic"),
        ({"sampler": "texture_unit"}, "sampled"),
        ({"sampler": "nearest", "scheme": "sampled"}, "exact, texture_unit"),
        ({"method": "ncrsi", "scheme": "sampled", "gradient": "analytic"}, "central"),
    ],
)
def test_unknown_names_and_combinations_list_the_known_ones(options, match):
    with pytest.raises(ValueError, match=match):
        reconstruct(torch.zeros(2, 2, 2), **options)


def test_wrong_arguments_say_what_was_expected_and_what_came():
    field = reconstruct(torch.zeros(2, 2, 2))
    with pytest.raises(ValueError, match=r"\(\.\.\., 3\).*\(5, 2\)"):
        field(torch.zeros(5, 2))
    with pytest.raises(TypeError, match="Tensor"):
        field([[0.0, 0.0, 0.0]])  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="order"):
        field.jet(torch.zeros(5, 3), 3)
    with pytest.raises(ValueError, match="order"):
        reconstruct(torch.zeros(2, 2, 2), "ncrsi").jet(torch.zeros(5, 3), 2)
    batched = reconstruct(torch.zeros(2, 1, 2, 2, 2))
    with pytest.raises(ValueError, match="N = 2"):
        batched(torch.zeros(3, 5, 3))
    with pytest.raises(TypeError, match="real"):
        field(torch.zeros(5, 3, dtype=torch.complex64))
    with pytest.raises(TypeError, match="method"):
        reconstruct(torch.zeros(2, 2, 2), 3)  # type: ignore[arg-type]


def test_a_method_is_data():
    assert named("notch") is METHODS["notch"]
    assert isinstance(named("notch"), Method)
    assert all(m.summary and "\n" not in m.summary for m in METHODS.values())
    volume = Volume(torch.as_tensor(samples_of((3, 3, 3))))
    points = torch.rand(5, 3, dtype=torch.float64)
    assert torch.equal(reconstruct(volume, METHODS["notch"])(points), reconstruct(volume, "notch")(points))
