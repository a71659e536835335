"""Metrics against their definitions, and images against scikit-image's and kornia's own conventions."""

import math

import pytest
import torch

from filterlab import metrics


def test_rms_and_largest_error():
    a, b = torch.tensor([1.0, 2.0, 5.0]), torch.tensor([1.0, 0.0, 1.0])
    assert float(metrics.rms(a, b)) == pytest.approx(math.sqrt(20 / 3))
    assert float(metrics.max_error(a, b)) == 4
    v, w = torch.tensor([[3.0, 4.0, 0.0]]), torch.zeros(1, 3)
    assert float(metrics.rms(v, w, vectors=True)) == 5
    assert float(metrics.max_error(v, w, vectors=True)) == 5


def test_unsigned_integers_do_not_wrap_around():
    a, b = torch.tensor([1], dtype=torch.uint8), torch.tensor([2], dtype=torch.uint8)
    assert float(metrics.max_error(a, b)) == 1
    assert float(metrics.rms(a, b)) == 1


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.3, math.pi / 2, 3.0, math.pi])
def test_angular_error(angle):
    a = torch.tensor([2.0, 0.0, 0.0], dtype=torch.float64)
    b = torch.tensor([math.cos(angle), math.sin(angle), 0.0], dtype=torch.float64)
    assert float(metrics.angular_error(a, 5 * b)) == pytest.approx(angle, rel=1e-12, abs=1e-15)
    assert metrics.angular_error(a, 0 * b).isnan()


def test_images():
    a = torch.rand(32, 40, 3, dtype=torch.float64)
    b = (a + 0.1).clamp(0, 2)
    assert metrics.psnr(a, b) == pytest.approx(20.0)
    assert metrics.ssim(a, a) == pytest.approx(1.0)
    assert metrics.ssim(a, b) < 0.999


def test_shapes_must_agree():
    with pytest.raises(ValueError, match=r"same shape; got \(2,\) and \(3,\)"):
        metrics.rms(torch.zeros(2), torch.zeros(3))


@pytest.mark.parametrize("scale", [5e-324, 1e-300, 1e-160, 1e160, 1e300])
def test_metrics_do_not_leave_the_range_of_their_squares(scale):
    a = torch.tensor([[3.0, 4.0, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
    b = torch.tensor([[0.0, 0.0, 0.0], [0.0, 1.0, 1.0]], dtype=torch.float64)
    for metric in (metrics.rms, metrics.max_error):
        for vectors in (False, True):
            assert float(metric(scale * a, scale * b, vectors)) == pytest.approx(scale * float(metric(a, b, vectors)))
    assert metrics.angular_error(scale * a[1], b[1] * min(1 / scale, 1e300)) == pytest.approx(math.pi / 4, rel=1e-12)
    assert metrics.rms(scale * a, scale * a) == 0
