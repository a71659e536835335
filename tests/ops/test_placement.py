"""place: points folded into the stored coefficients; the fused one against the plain one, and its derivative."""

from __future__ import annotations

import math
from fractions import Fraction
from itertools import product

import pytest
import torch
from torch import Tensor

from filterlab.geometry import Geometry
from filterlab.methods import reconstruct
from filterlab.ops import Placement, place
from filterlab.volume import Boundary, Volume

SHEARED = torch.tensor([[1, 0.2, 0, 3], [0, -1, 0.1, 2], [0.3, 0, 2, 1], [0, 0, 0, 1]], dtype=torch.float64)
GEOMETRIES = {
    "identity": Geometry(),
    "stretched": Geometry.of((0.5, 2, 3), (1, 2, 3)),
    "sheared": Geometry.of(affine=SHEARED),
}
PLACES = [
    Placement(geometry, boundary, size, tail, shift)
    for geometry, boundary, (size, tail, shift) in product(
        GEOMETRIES.values(), Boundary, [((5, 1, 2), 0, (0.0, 0.0, 0.0)), ((7, 8, 100), 3, (0.5, 17.0, 0.5))]
    )
]


def wild_points(dtype: torch.dtype, m: int = 37) -> Tensor:
    x = torch.randn(2, m, 3, dtype=dtype) * 20
    for i, bad in enumerate((float("nan"), float("inf"), -float("inf"))):
        x[0, 3 + i, i] = bad
    return x


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
@pytest.mark.parametrize("placement", PLACES, ids=lambda p: f"{p.boundary}-{p.geometry.spacing[0]:.2g}-{p.size[0]}")
def test_fused_equals_plain(placement: Placement, dtype: torch.dtype) -> None:
    points = wild_points(dtype)
    (expected, expected_sign), (located, sign) = place(points, placement), place(points, placement, "cpu")
    tolerance = {torch.float32: 2e-5, torch.float64: 1e-12}[dtype]
    torch.testing.assert_close(located, expected, rtol=tolerance, atol=tolerance, equal_nan=True)
    finite = points.isfinite().all(-1)
    sign = torch.ones_like(points) if sign is None else sign
    assert torch.equal(sign[finite], expected_sign[finite])


@pytest.mark.parametrize("boundary", Boundary)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_any_finite_coordinate_folds_exactly(boundary: Boundary, dtype: torch.dtype) -> None:
    placement = Placement(Geometry(), boundary, (5, 8, 1000))
    far = torch.logspace(0, 38, 400, dtype=dtype)
    points = torch.stack((far, -far, far * 0.7), -1)[None]
    assert torch.equal(place(points, placement, "cpu")[0], place(points, placement)[0])


@pytest.mark.parametrize("m", [1, 7, 8, 9, 5000])
def test_any_number_of_points_and_threads(m: int) -> None:
    placement, points = PLACES[2], wild_points(torch.float64, max(m, 6))[:, :m]
    expected, expected_sign = place(points, placement)
    threads = torch.get_num_threads()
    try:
        for number in (1, 2, 3):
            torch.set_num_threads(number)
            located, sign = place(points, placement, "cpu")
            torch.testing.assert_close(located, expected, rtol=1e-12, atol=1e-12, equal_nan=True)
            assert sign is not None
            finite = points.isfinite().all(-1)
            assert torch.equal(sign[finite], expected_sign[finite])
    finally:
        torch.set_num_threads(threads)


def test_no_sign_where_nothing_is_turned() -> None:
    points = torch.rand(1, 100, 3) * 4
    for boundary in Boundary:
        located, sign = place(points, Placement(Geometry(), boundary, (5, 5, 5)), "cpu")
        assert sign is None
        assert torch.equal(located, points)
    assert place(points[:, :0], PLACES[0], "cpu")[0].shape == (1, 0, 3)


@pytest.mark.parametrize("implementation", ["reference", "cpu"])
@pytest.mark.parametrize("placement", PLACES[::3], ids=lambda p: f"{p.boundary}-{p.geometry.spacing[0]:.2g}")
def test_derivative(placement: Placement, implementation: str) -> None:
    torch.manual_seed(1)
    points = (torch.randn(1, 6, 3, dtype=torch.float64) * 9).requires_grad_()

    def located(x: Tensor) -> Tensor:
        return place(x, placement, implementation)[0]

    assert torch.autograd.gradcheck(located, (points,), check_forward_ad=True)
    jacobian = torch.func.vmap(torch.func.jacrev(located))(points.detach()[:, :, None].movedim(1, 0))
    plain = torch.autograd.functional.jacobian(located, points.detach())
    for i in range(6):
        torch.testing.assert_close(jacobian[i, 0, 0, :, 0, 0, :], plain[0, i, :, 0, i, :])


# --- beyond the range of a type --------------------------------------------------------------------------------------

IMPLEMENTATIONS = ["reference", "cpu"]
LARGEST = {torch.float32: 3.4028234e38, torch.float64: 1.7e308}
SHEAR = [[1.0, 0.25, 0.0], [0.0, 1.0, 0.0], [0.5, 0.0, 1.0]]  # its inverse has the exact zeros that ∞ · 0 is about


def affine(matrix: list[list[float]]) -> Geometry:
    whole = torch.eye(4, dtype=torch.float64)
    whole[:3, :3] = torch.tensor(matrix, dtype=torch.float64)
    return Geometry.of(affine=whole)


def folded(x: Fraction, n: int, boundary: Boundary, tail: int) -> Fraction:
    """The fold of an exact coordinate, from the picture of each extension."""
    if boundary in (Boundary.BORDER, Boundary.ZEROS):
        return min(max(x, Fraction(-tail)), Fraction(n - 1 + tail))
    if boundary is Boundary.WRAP:
        return x % n
    if boundary is Boundary.MIRROR:
        x = x % (2 * n - 2)
        return min(x, 2 * n - 2 - x)
    x = (x + Fraction(1, 2)) % (2 * n)
    return min(x, 2 * n - x) - Fraction(1, 2)


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize("boundary", Boundary)
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_a_finite_point_folds_exactly_where_its_voxel_coordinate_is_not_finite(dtype, boundary, implementation) -> None:
    steps, size, tail = (0.5, 2.0**-40, 0.25), (5, 8, 1000), 3
    placement = Placement(Geometry.of(steps), boundary, size, tail)
    far = LARGEST[dtype] * torch.tensor([1.0, 0.7, 0.501, 0.26, 0.1, 1e-3], dtype=dtype)
    points = torch.stack((far, -far.flip(0), far * 0.9), -1)[None]
    located, sign = place(points, placement, implementation)
    assert not placement.geometry.to_voxel(points).isfinite().all()
    for row, found in zip(points[0].tolist(), located[0].tolist(), strict=True):
        for x, step, n, y in zip(row, steps, size, found, strict=True):
            assert y == float(folded(Fraction(x) / Fraction(step), n, boundary, tail))
    assert sign is None or sign.isfinite().all()


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize("boundary", Boundary)
@pytest.mark.parametrize("geometry", [Geometry(), Geometry.of((0.5, 2, 3), (1, 2, 3)), affine(SHEAR)], ids=range(3))
def test_a_point_at_infinity_is_where_the_points_before_it_go(geometry, boundary, implementation) -> None:
    """p + t s for a large t is there already where the extension is constant; NaN where it has a period."""
    inf, placement = math.inf, Placement(geometry, boundary, (5, 6, 7), 3)
    rows = [(a, b, c) for a in (-inf, 1.5, inf) for b in (-inf, 2.25, inf) for c in (-inf, 1.0, inf)]
    points = torch.tensor(rows, dtype=torch.float64)[None]
    infinite = points.isinf()
    before = torch.where(infinite, points.sign() * 2.0**40, points)
    located, sign = place(points, placement, implementation)
    expected, expected_sign = place(before, placement)
    if boundary.periodic:
        assert torch.equal(located.isnan().any(-1), infinite.any(-1))
        return
    torch.testing.assert_close(located, expected, rtol=0, atol=1e-3)  # 2⁴⁰ has so many digits left
    assert sign is not None
    assert torch.equal(sign, expected_sign)
    poisoned = torch.where(infinite[0, :, :1], points, torch.nan)  # whatever else is infinite, NaN stays NaN
    poisoned = place(torch.cat((points[..., :2], poisoned[..., 2:]), -1), placement, implementation)[0]
    assert torch.equal(poisoned.isnan().any(-1)[0], ~infinite[0, :, 0])


@pytest.mark.parametrize("implementation", IMPLEMENTATIONS)
@pytest.mark.parametrize("boundary", Boundary)
def test_a_sum_that_left_the_range_of_its_type_comes_back(boundary, implementation) -> None:
    """x − y of two huge equal numbers, each of them too large when multiplied: 2.5."""
    placement = Placement(affine([[0.125, 0.125, 0.0], [0.0, 0.125, 0.0], [0.0, 0.0, 1.0]]), boundary, (5, 6, 7), 3)
    points = torch.tensor([[[3e38, 3e38, 2.5]]])
    located, _ = place(points, placement, implementation)
    assert located[0, 0, [0, 2]].tolist() == [0.0, 2.5]
    y = float(torch.tensor(3e38)) * 8
    assert located[0, 0, 1] == float(folded(Fraction(y), 6, boundary, 3))


@pytest.mark.parametrize("scheme", ["direct", "fused"])
@pytest.mark.parametrize("boundary", Boundary)
def test_values_and_derivatives_are_finite_there(boundary, scheme) -> None:
    values = torch.rand(5, 6, 7, generator=torch.Generator().manual_seed(4))
    rows = [(3e38, 1.0, 2.0), (3e38, -3e38, 3e38), (1.0, 2.0, 3.0)]
    rows += [] if boundary.periodic else [(math.inf, 1.0, 2.0), (-math.inf, math.inf, 2.0), (math.inf,) * 3]
    for volume in (Volume(values, spacing=0.5), Volume(values, affine=affine(SHEAR).affine)):
        samples = values.clone().requires_grad_()
        field = reconstruct(Volume.with_geometry(samples, volume.geometry), boundary=boundary, scheme=scheme)
        points = torch.tensor(rows, requires_grad=True)
        value, gradient = field.value_and_gradient(points)
        assert value.isfinite().all()
        assert gradient.isfinite().all()
        if boundary is Boundary.ZEROS:
            torch.testing.assert_close(value[[0, *range(3, len(rows))]], torch.zeros(len(rows) - 2), rtol=0, atol=1e-6)
        found = torch.autograd.grad(value.sum() + gradient.square().sum(), (points, samples))
        assert all(x.isfinite().all() for x in found)
