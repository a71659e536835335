"""place: points folded into the stored coefficients; the fused one against the plain one, and its derivative."""

from __future__ import annotations

from itertools import product

import pytest
import torch
from torch import Tensor

from filterlab.ops import Placement, place
from filterlab.volume import Boundary, Geometry

SHEARED = torch.tensor([[1, 0.2, 0, 3], [0, -1, 0.1, 2], [0.3, 0, 2, 1], [0, 0, 0, 1]], dtype=torch.float64)
GEOMETRIES = {
    "identity": Geometry(),
    "stretched": Geometry.of((0.5, 2, 3), (1, 2, 3)),
    "sheared": Geometry.of(affine=SHEARED),
}
PLACES = [
    Placement(geometry, boundary, size, tail, shift)
    for geometry, boundary, (size, tail, shift) in product(
        GEOMETRIES.values(), Boundary, [((5, 1, 2), 0, 0.0), ((7, 8, 100), 3, 0.5)]
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
