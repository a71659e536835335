"""Transfer functions against numpy.interp and the optical model's closed forms."""

import math

import numpy as np
import pytest
import torch
from torch.autograd import gradcheck, gradgradcheck

from filterlab.render import TransferFunction

X = [-1.0, 0.1, 0.7, 3.0]
RGB = [[0.1, 0.2, 0.3], [0.9, 0.1, 0.4], [0.3, 0.33, 1.7], [0.0, 0.5, 1.0]]
ALPHA = [0.0, 0.3, 1e-7, 1.0]


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_linear_between_exact_at_and_constant_beyond_control_points(dtype):
    transfer = TransferFunction(X, RGB, ALPHA)
    v = torch.cat((torch.linspace(-3, 5, 1001, dtype=dtype), torch.tensor(X, dtype=dtype)))
    rgb, alpha = transfer(v)
    assert rgb.dtype == alpha.dtype == dtype
    tolerance = 1e-14 if dtype == torch.float64 else 1e-6
    np.testing.assert_allclose(alpha, np.interp(v, X, ALPHA), rtol=0, atol=tolerance)
    for c in range(3):
        np.testing.assert_allclose(rgb[:, c], np.interp(v, X, np.array(RGB)[:, c]), rtol=0, atol=2 * tolerance)
    assert torch.equal(alpha[-4:], torch.tensor(ALPHA, dtype=dtype))
    assert torch.equal(rgb[-4:], torch.tensor(RGB, dtype=dtype))


def test_one_control_point_is_constant_and_a_nan_is_nothing():
    v = torch.tensor([-5.0, 0.5, 9.0, math.nan])
    rgb, alpha = TransferFunction([0.5], [[1.0, 0.5, 0.0]], [0.25])(v)
    assert alpha[:3].tolist() == [0.25] * 3
    assert rgb[:3].tolist() == [[1.0, 0.5, 0.0]] * 3
    assert (*rgb[3].tolist(), alpha[3].item()) == (0, 0, 0, 0)
    tables = [torch.tensor(t, dtype=torch.float64, requires_grad=True) for t in (X, RGB, [0.1, 0.3, 0.5, 0.7])]
    v = v.double().requires_grad_()
    rgb, alpha = TransferFunction(*tables)(v)
    assert (*rgb[3].tolist(), alpha[3].item()) == (0, 0, 0, 0)
    known = TransferFunction(*tables)(v[:3])
    assert torch.equal(rgb[:3], known[0])
    assert torch.equal(alpha[:3], known[1])
    both = [torch.autograd.grad(c.sum() + a.sum(), [*tables, v]) for c, a in ((rgb, alpha), known)]
    assert all(torch.equal(found, expected) for found, expected in zip(*both, strict=True))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_optical_depth_keeps_the_digits_of_tiny_opacities_and_is_infinite_at_one(dtype):
    transfer = TransferFunction([0.0, 1.0], [[1.0, 1.0, 1.0]] * 2, [0.5, 1.0], unit=2.0)
    alpha = torch.tensor([1e-30, 1e-12, 1e-3, 0.5, 0.999], dtype=dtype)
    tau = transfer.optical_depth(alpha, torch.tensor(3.0, dtype=dtype))
    expected = [-math.log1p(-a) * 1.5 for a in alpha.tolist()]
    np.testing.assert_allclose(tau, expected, rtol=4 * torch.finfo(dtype).eps)
    opaque = torch.ones(2, dtype=dtype, requires_grad=True)
    length = torch.tensor([1e-9, 0.0], dtype=dtype, requires_grad=True)
    tau = transfer.optical_depth(opaque, length)
    assert tau.tolist() == [math.inf, 0.0]
    for derivative in torch.autograd.grad(torch.exp(-tau).sum(), (opaque, length)):
        assert derivative.isfinite().all()


def test_peaks_that_touch_up_to_rounding_share_a_point():
    """0.5 + 0.4 / 2 and 0.8 − 0.2 / 2 are two numbers in float64, and one in float32."""
    transfer = TransferFunction.triangle_peaks([(0.5, 0.4, 0.2, (1, 0, 0)), (0.8, 0.2, 0.3, (0, 1, 0))])
    assert len(transfer.positions) == 5
    color, opacity = transfer.to(torch.float32)(torch.tensor([0.5, 0.7, 0.8]))
    assert torch.equal(opacity, torch.tensor([0.2, 0.0, 0.3]))
    assert torch.equal(color[[0, 2]], torch.tensor([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]))


def test_triangle_peaks_are_the_sum_of_triangles():
    peaks = [(0.3, 0.2, 0.1, (1.0, 0.0, 0.0)), (0.5, 0.4, 0.6, (0.0, 0.0, 1.0)), (0.9, 0.1, 0.2, (0.0, 1.0, 0.0))]
    transfer = TransferFunction.triangle_peaks(peaks, unit=0.5)
    assert transfer.unit == 0.5
    v = torch.linspace(0, 1, 2001, dtype=torch.float64)
    shares = [h * (1 - (v - c).abs() / (w / 2)).clamp_min(0) for c, w, h, _ in peaks]
    rgb, alpha = transfer(v)
    torch.testing.assert_close(alpha, sum(shares), rtol=0, atol=1e-14)
    alone = shares[2] > 0
    torch.testing.assert_close(rgb[alone], torch.tensor([0.0, 1.0, 0.0]).double().expand(alone.sum(), 3))
    only_first = (v > 0.2) & (v < 0.3)
    torch.testing.assert_close(rgb[only_first], torch.tensor([1.0, 0.0, 0.0]).double().expand(only_first.sum(), 3))
    between = (v < 0.1999) | ((v > 0.7001) & (v < 0.8499)) | (v > 0.9501)
    assert set(alpha[between].tolist()) == {0.0}  # exactly, not the rounding of a difference
    # 0.4 is the foot of the first: there the second one alone; 0.3 is the apex of the first on the foot of the second
    assert transfer(torch.tensor(0.4).double())[0].tolist() == pytest.approx([0, 0, 1])


def test_touching_peaks_and_peaks_as_tensors():
    center = torch.tensor(0.25, dtype=torch.float64, requires_grad=True)
    transfer = TransferFunction.triangle_peaks([(center, 0.5, 0.4, (1, 0, 0)), (0.75, 0.5, 0.2, (0, 1, 0))])
    assert transfer.positions.tolist() == [0.0, 0.25, 0.5, 0.75, 1.0]
    assert transfer.opacities.tolist() == [0.0, 0.4, 0.0, 0.2, 0.0]
    _, alpha = transfer(torch.tensor(0.1, dtype=torch.float64))
    (slope,) = torch.autograd.grad(alpha, center)
    assert slope.item() == pytest.approx(-0.4 / 0.25)  # α = 0.4 (1 − (center − v)/0.25)


def test_differentiable_twice_in_tables_and_scalar():
    tables = [
        torch.tensor(t, dtype=torch.float64, requires_grad=True)
        for t in (X, [[c + 0.1 for c in rgb] for rgb in RGB], [0.1, 0.3, 0.5, 0.7])
    ]
    v = torch.tensor([-2.0, -0.5, 0.3, 1.0, 2.5, 4.0], dtype=torch.float64, requires_grad=True)

    def function(x, rgb, alpha, v):
        transfer = TransferFunction(x, rgb, alpha)
        located = transfer.locate(v)
        length = torch.full_like(v, 0.7)
        return transfer.color(located), transfer.optical_depth(transfer.opacity(located), length)

    assert gradcheck(function, (*tables, v))
    assert gradgradcheck(function, (*tables, v))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (([0.0, 0.0], RGB[:2], [0, 0]), "increase"),
        (([1.0, 0.0], RGB[:2], [0, 0]), "increase"),
        (([0.0, 1.0], RGB[:2], [0, 1.1]), "opacities must lie"),
        (([0.0, 1.0], RGB[:2], [-0.1, 1.0]), "opacities must lie"),
        (([0.0, 1.0], [[-1.0, 0, 0], [0, 0, 0]], [0, 1.0]), "negative"),
        (([0.0, 1.0], RGB[:3], [0, 1.0]), "control points with positions"),
        (([], [], []), "control points with positions"),
        (([0.0, math.nan], RGB[:2], [0, 1.0]), "finite"),
        (([0.0, 1.0], RGB[:2], [0, 1.0], 0.0), "unit"),
        (("ab", RGB[:2], [0, 1.0]), "must be numbers"),
    ],
)
def test_bad_tables(arguments, message):
    with pytest.raises(ValueError, match=message):
        TransferFunction(*arguments)


def test_bad_peaks_and_points_that_coincide_in_float32():
    for peaks, message in (
        ([], "one or more"),
        ([(0.5, 0.0, 0.1, (1, 1, 1))], "widths"),
        ([(0.5, 0.1, 0.6, (1, 1, 1)), (0.5, 0.2, 0.6, (1, 1, 1))], "opacities must lie"),
    ):
        with pytest.raises(ValueError, match=message):
            TransferFunction.triangle_peaks(peaks)
    close = TransferFunction([1000.0, 1000.00001], RGB[:2], [0.0, 1.0])
    with pytest.raises(ValueError, match="coincide"):
        close.to(torch.float32)
