"""Metrics against their definitions, and images against those of the papers."""

import math

import numpy as np
import pytest
import torch
from scipy import ndimage
from skimage.metrics import structural_similarity

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


def two_images(*shape: int) -> tuple[torch.Tensor, torch.Tensor]:
    """One with steps and a ramp in it, and what noise and a loss of contrast make of it."""
    generator = torch.Generator().manual_seed(0)
    a = torch.rand(*shape, generator=generator, dtype=torch.float64)
    a[8:20, 5:] = 0.9
    b = 0.8 * a + 0.1 * torch.rand(*shape, generator=generator, dtype=torch.float64)
    return a, b


def similarity(a: np.ndarray, b: np.ndarray, peak: float) -> float:
    """Wang et al. 2004, eq. 13, averaged: windows of 11², σ = 1.5, that lie within the image; population covariance."""

    def mean(x: np.ndarray) -> np.ndarray:
        return ndimage.gaussian_filter(x, 1.5, radius=5)[5:-5, 5:-5]

    mu, nu, c1, c2 = mean(a), mean(b), (0.01 * peak) ** 2, (0.03 * peak) ** 2
    variances, covariance = mean(a * a) - mu**2 + mean(b * b) - nu**2, mean(a * b) - mu * nu
    index = (2 * mu * nu + c1) * (2 * covariance + c2) / ((mu**2 + nu**2 + c1) * (variances + c2))
    return float(index.mean())


@pytest.mark.parametrize("peak", [1.0, 255.0, 0.02])
@pytest.mark.parametrize("shape", [(32, 40), (32, 40, 3)])
def test_images_are_compared_as_published(peak, shape):
    a, b = (peak * image for image in two_images(*shape))
    planes = zip(*(np.atleast_3d(image.numpy()).transpose(2, 0, 1) for image in (a, b)), strict=True)
    expected = np.mean([similarity(x, y, peak) for x, y in planes])
    assert 0.5 < expected < 0.95
    assert metrics.ssim(a, b, peak) == pytest.approx(expected, rel=1e-12)
    assert metrics.psnr(a, b, peak) == pytest.approx(20 * math.log10(peak / float(metrics.rms(a, b))), rel=1e-12)
    published = {"gaussian_weights": True, "sigma": 1.5, "use_sample_covariance": False, "data_range": peak}
    of_skimage = structural_similarity(a.numpy(), b.numpy(), channel_axis=2 if len(shape) == 3 else None, **published)
    assert metrics.ssim(a, b, peak) == of_skimage


def test_equal_images_are_as_like_as_can_be():
    a, _ = two_images(32, 40, 3)
    assert metrics.ssim(a, a) == pytest.approx(1.0)
    assert metrics.psnr(a, a) == math.inf


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
