"""Coarser grids: the projection that leaves aliasing out, against its definition by quadrature."""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest
import torch
from torch import Tensor

from filterlab.kernels import KERNELS, bc
from filterlab.methods import METHODS, reconstruct
from filterlab.resampling import AliasingWarning, resample
from filterlab.shrinking import correlations, inner_products
from filterlab.volume import Boundary, Volume
from tests import laws
from tests.test_volume import rotated

WAVES = 40  # voxels of a row that waves are sampled on


def row(samples: Tensor, **geometry) -> Volume:
    return Volume(samples.reshape(1, 1, -1), **geometry)


def coarser(n: int, size: int) -> Volume:
    """A grid of n voxels on the box of `size`."""
    return row(torch.zeros(n), spacing=(size / n, 1, 1), origin=((size / n - 1) / 2, 0, 0))


def noise(*shape: int) -> Tensor:
    return torch.from_numpy(np.random.default_rng(7).uniform(-1, 1, shape))


def gauss(low: float, high: float, knots: np.ndarray) -> tuple[Tensor, Tensor]:
    """Nodes and weights between all knots: exact for pieces of degree 15."""
    t, w = np.polynomial.legendre.leggauss(8)
    ends = np.unique(np.clip([low, *knots, high], low, high))
    parts = [((a + b) / 2 + (b - a) / 2 * t, (b - a) / 2 * w) for a, b in pairwise(ends)]
    nodes, weights = (torch.from_numpy(np.concatenate(p)) for p in zip(*parts, strict=True))
    return nodes, weights


@pytest.mark.parametrize("spline", ["linear", "bspline2", "bspline3", "catmull-rom"])
@pytest.mark.parametrize("kernel", ["linear", "bspline3", "notch", "mitchell"])
def test_inner_products_of_kernels(spline, kernel):
    first, second, step = KERNELS[spline], KERNELS[kernel], 2.7
    y = torch.linspace(-8, 8, 23, dtype=torch.float64)
    knots = np.concatenate([step * np.arange(-4, 4.5, 0.5), *(v + np.arange(-4, 4.5, 0.5) for v in y.numpy())])
    t, w = gauss(-12, 12, knots)
    expected = (first(t / step) * second(y[:, None] - t) * w).sum(-1) / step
    laws.assert_close(inner_products(y, step, first, second), expected, 1e-14)
    k = torch.arange(-first.support + 1, first.support).double()
    by_hand = (first(t) * first(t + k[:, None]) * w).sum(-1)  # knots of φ are among them
    laws.assert_close(np.array(list(correlations(first).values())), by_hand, 1e-14)


@pytest.mark.parametrize("method", ["trilinear", "catmull-rom", "triquadratic", "notch", "mitchell", "tricubic"])
@pytest.mark.parametrize("new", [5, 7, 11])
def test_what_is_left_out_is_orthogonal_to_the_splines_of_the_coarser_grid(method, new):
    """∫ (f − g) β((x − x_i) / s) dx = 0 for every i, f the method's field of the samples, g the result's spline."""
    n, kernel = 12, KERNELS["bspline3"]
    step, fine = n / new, row(noise(n))
    coarse = resample(fine, method, like=coarser(new, n), boundary="wrap", antialias=True)
    knots = np.concatenate((np.arange(0, n + 0.5, 0.5), coarse.origin[0] + step * np.arange(-1, new + 1, 0.5)))
    x, w = gauss(0, n, knots)
    points = torch.stack((x, 0 * x, 0 * x), -1)
    f, g = (reconstruct(v, m, boundary="wrap")(points) for v, m in ((fine, method), (coarse, "tricubic")))
    apart = (x - coarse.origin[0] - step * torch.arange(new).double()[:, None]) / step
    splines = sum(kernel(apart + k * new) for k in range(-2, 3))
    laws.assert_close((splines * (f - g) * w).sum(-1) / step, torch.zeros(new), 1e-14, 1.0)
    plain = resample(fine, method, like=coarser(new, n), boundary="wrap", antialias=False)
    off = reconstruct(plain, "tricubic", boundary="wrap")(points)
    assert float((w * (f - g).square()).sum()) < float((w * (f - off).square()).sum())


@pytest.mark.parametrize("boundary", ["mirror", "wrap"])
def test_a_spline_of_the_coarser_grid_comes_back(boundary):
    """Twice as fine and back: its knots are among those of the finer grid, and what is projected is itself."""
    samples = noise(1, 1, 9)
    fine = Volume(torch.zeros(1, 1, 17 if boundary == "mirror" else 18), spacing=(0.5, 1, 1))
    up = resample(samples, "tricubic", like=fine, boundary=boundary)
    for given, tolerance in ((up, 1e-13), (up.to(torch.float32), 1e-6)):
        back = resample(given, "tricubic", like=Volume(samples), boundary=boundary, antialias=True)
        laws.assert_close(back.samples, samples, tolerance)


@pytest.mark.parametrize("method", [m for m in METHODS if m != "nearest"])
@pytest.mark.parametrize("how", ["aligned", "turned"])
def test_waves_that_the_grid_does_not_hold_are_left_out(method, how):
    """Steps of 2.5 voxels: a wave at 1.7 of the new Nyquist frequency is left out, one at 0.4 of it stays."""
    step, n = 2.5, WAVES
    x = torch.arange(n, dtype=torch.float64)
    kept, lost = (torch.cos(f * math.pi / step * x + 0.3).expand(24, 24, n) for f in (0.4, 1.7))
    turn = rotated(spacing=(1, 1, 1), origin=(0, 0, 0))[:3, :3] if how == "turned" else np.eye(3)
    affine = np.eye(4)
    affine[:3, :3] = step * turn
    affine[:3, 3] = np.array([n / 2, 12, 12]) - affine[:3, :3] @ [2.0, 1.0, 1.0]
    like = Volume(torch.zeros(3, 3, 5), affine=affine)
    inner = like.voxel_to_world(torch.cartesian_prod(*(torch.arange(k).double() for k in (5, 3, 3))))
    expected = torch.cos(0.4 * math.pi / step * inner[:, 0] + 0.3).reshape(5, 3, 3).permute(2, 1, 0)
    found = resample(kept, method, like=like, antialias=True).samples
    left, aliased = (resample(lost, method, like=like, antialias=a).samples.abs().max() for a in (True, False))
    assert float((found - expected).abs().max()) < 0.2
    assert float(left) < 0.16
    assert float(aliased) > 0.5


@pytest.mark.parametrize("boundary", Boundary)
def test_constants_stay_and_axes_that_do_not_shrink_are_untouched(boundary):
    if boundary is not Boundary.ZEROS:
        flat = resample(torch.full((1, 9, 13), 3.0), "tricubic", shape=(1, 4, 3), boundary=boundary, antialias=True)
        laws.assert_close(flat.samples, torch.full((1, 4, 3), 3.0), 1e-6)
    samples = noise(5, 6, 7)
    finer = [resample(samples, "notch", shape=(5, 9, 8), boundary=boundary, antialias=a).samples for a in (True, False)]
    assert torch.equal(*finer)
    how = {"boundary": boundary, "antialias": True}
    both, z_and_x = (resample(samples, "tricubic", shape=(9, n, 9), **how).samples for n in (3, 6))
    laws.assert_close(both, resample(z_and_x, "tricubic", shape=(9, 3, 9), **how).samples, 1e-12)


def test_differentiable_and_batched():
    def shrunk(f: Tensor) -> Tensor:
        return resample(f, "tricubic", shape=(2, 5, 2), boundary="border", antialias=True).samples

    laws.assert_adjoint(shrunk, noise(4, 5, 6))
    b, c = (torch.tensor(v, dtype=torch.float64, requires_grad=True) for v in (0.3, 0.2))
    how = {"shape": (2, 1, 2), "prefilter": False, "antialias": True}
    assert torch.autograd.gradcheck(lambda b, c: resample(noise(3, 2, 4), bc(b, c), **how).samples, (b, c))
    batch = noise(2, 2, 4, 5, 6)
    laws.assert_close(shrunk(batch)[1, 0], shrunk(batch[1, 0]), 1e-14)


def test_labels_are_those_of_the_greatest_share():
    samples = torch.tensor([7, 7, 7, 5, 5, 5, 7, 5, 7, 7, 5, 5]).reshape(1, 1, 12).expand(3, 3, 12).contiguous()
    found = resample(samples, "trilinear", shape=(1, 1, 4), labels=True, antialias=True).samples.flatten().tolist()
    assert found == [7, 5, 7, 5]
    assert resample(samples, "trilinear", shape=(1, 1, 4), labels=True, antialias=False).samples[0, 0, 2] == 5
    turned = Volume(torch.zeros(1, 1, 4), affine=rotated(spacing=(3, 3, 3), origin=(6, 1, 1)))
    assert set(resample(samples, "qss", like=turned, labels=True, antialias=True).samples.unique().tolist()) <= {5, 7}


def test_unknown_voxels_are_told_where_the_wider_kernel_reaches_them():
    samples = noise(1, 1, 24)
    samples[..., 11] = torch.nan
    found = resample(samples, "trilinear", shape=(1, 1, 8), antialias=True, nan="propagate").samples.isnan()
    assert found.flatten().nonzero().flatten().tolist() == [3, 4]  # at 10 and 13, by kernels of 6 voxels
    finer = resample(samples, "trilinear", shape=(1, 1, 48), antialias=True, nan="propagate").samples.isnan()
    assert torch.equal(finer, resample(samples, "trilinear", shape=(1, 1, 48), nan="propagate").samples.isnan())


@pytest.mark.parametrize("antialias", [True, False])
def test_unknown_voxels_are_missing_on_turned_grids_too(antialias):
    samples = noise(6, 7, 8)
    samples[2, 3, 4] = torch.nan
    affine = rotated((1.5, 1.5, 1.5), (0, 0, 0))
    affine[:3, 3] = np.array([4, 3, 2]) - affine[:3, :3] @ [1.5, 1.5, 1.5]
    for method in ("tricubic", "qss"):
        how = {"like": Volume(torch.zeros(4, 4, 4), affine=affine), "antialias": antialias}
        found = resample(samples, method, nan="propagate", **how).samples.isnan()
        assert 0 < int(found.sum()) < found.numel()
        assert not resample(samples, method, nan="fill", **how).samples.isnan().any()


def test_shrinking_without_a_word_is_told_once_per_place():
    samples = noise(4, 5, 13)
    turned = Volume(samples[..., :3], affine=rotated((2, 1, 1), (0, 0, 0)))
    for grid in ({"shape": (4, 5, 8)}, {"spacing": (1.3, 1, 1)}, {"like": turned}):
        with pytest.warns(AliasingWarning, match=r"steps of up to .* voxels: .*antialias=True") as told:
            resample(samples, **grid)
        assert told[0].filename == __file__
        assert len(told) == 1
    resample(samples, shape=(4, 4, 11))  # 1.25
    resample(samples, shape=(1, 5, 8), antialias=False)
    resample(samples, "nearest", shape=(1, 2, 3))
    resample(samples[:1], like=Volume(samples[:1], spacing=(1, 1, 5)))  # one plane has nothing to alias


def test_nearest_samples_are_not_averaged():
    samples = noise(4, 5, 6)
    with pytest.raises(ValueError, match=r"antialias=True needs another method, or labels=True"):
        resample(samples, "nearest", shape=(2, 2, 2), antialias=True)
