"""Voxels that are NaN or infinite: refused, kept to where the kernel reaches them, or filled."""

from __future__ import annotations

import math

import pytest
import torch

import filterlab as fl
from filterlab.methods import tensor_product
from filterlab.missing_values import filled, resolved

NAN = math.nan


def samples(*shape: int, dtype=torch.float64) -> torch.Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(5), dtype=torch.float64).to(dtype)


def with_holes(*shape: int) -> torch.Tensor:
    volume = samples(*shape)
    volume[..., 2, 3, 4] = NAN
    volume[..., 5, 1, 0] = math.inf
    return volume


def test_they_are_refused_with_their_number() -> None:
    with pytest.raises(ValueError, match=r"got 1 NaN and 1 infinite of 504: nan='fill' .* nan='propagate'"):
        fl.reconstruct(with_holes(7, 8, 9))
    batch = torch.full((2, 3, 2, 2, 2), NAN)
    with pytest.raises(ValueError, match=r"got 48 NaN of 48"):
        fl.reconstruct(batch, "trilinear")
    with pytest.raises(ValueError, match=r"nan must be one of refuse, propagate, fill; got 'ignore'"):
        fl.reconstruct(samples(3, 3, 3), nan="ignore")
    with pytest.raises(ValueError, match=r"at least one finite voxel to fill from"):
        fl.reconstruct(torch.stack((samples(3, 3, 3), NAN * samples(3, 3, 3)))[:, None], nan="fill")


def test_numbers_whose_sum_overflows_are_no_reason_to_refuse() -> None:
    volume = torch.full((8, 8, 8), 3e38)
    assert resolved(volume, "refuse")[0] is volume
    assert fl.reconstruct(volume, "trilinear")(torch.tensor([3.0, 3, 3])) == 3e38


def test_a_volume_without_holes_is_not_copied() -> None:
    for choice in ("refuse", "propagate", "fill"):
        volume = samples(4, 5, 6)
        found, unknown = resolved(volume, choice)
        assert found is volume
        assert unknown is None


@pytest.mark.parametrize("boundary", list(fl.Boundary))
@pytest.mark.parametrize(
    ("method", "scheme"), [(name, s) for name, m in fl.METHODS.items() for s in m.schemes if s != "sampled"]
)
def test_a_hole_reaches_as_far_as_the_kernel(method, boundary, scheme) -> None:
    """NaN exactly where a derivative by the hole exists; elsewhere what the filled volume gives, bit for bit."""
    volume = samples(8, 9, 10)
    hole = volume.clone()
    hole[4, 0, 6] = NAN
    points = torch.rand(600, 3, generator=torch.Generator().manual_seed(1), dtype=torch.float64) * 16 - 4
    options = {"boundary": boundary, "scheme": scheme}
    field = fl.reconstruct(hole, method, nan="propagate", **options)
    other = fl.reconstruct(hole, method, nan="fill", **options)
    reach = fl.METHODS[method].facts.support / 2
    near = torch.ones(600, dtype=torch.bool)
    for axis, at in enumerate((6, 0, 4)):
        distance = _distance(points[:, axis], at, (10, 9, 8)[axis], boundary)
        near &= distance < reach
    value, gradient = field.jet(points, 1)
    expected, slope = other.jet(points, 1)
    assert near.any()
    if method not in ("ncrsi", "cubic-c1", "quadratic-c1"):  # their reach is no box
        assert bool(value[near].isnan().all())
    if tensor_product(method) is None:
        one = torch.zeros_like(volume)
        one[4, 0, 6] = 1
        weight = fl.reconstruct(one, method, prefilter=False, **options)(points)
        assert bool(value[weight != 0].isnan().all())
        if boundary != "border":  # of the copies that it makes weights can cancel
            assert torch.equal(value.isnan(), weight != 0)
    assert torch.equal(value[~near], expected[~near])
    assert torch.equal(gradient[~near], slope[~near])


def _distance(x: torch.Tensor, at: int, n: int, boundary) -> torch.Tensor:
    """From the nearest copy of voxel `at` in the extension of the axis."""
    index = torch.arange(-n - 8, 2 * n + 8)
    copies = index[boundary.source(index, n) == at]
    if boundary == "zeros":
        copies = torch.tensor([at])
    return (x[:, None] - copies).abs().amin(-1)


def test_filling_keeps_the_known_and_stays_between_them() -> None:
    volume = samples(9, 6, 13)
    unknown = torch.rand(9, 6, 13, generator=torch.Generator().manual_seed(2)) < 0.6
    found = filled(volume.masked_fill(unknown, NAN), unknown)
    assert torch.equal(found[~unknown], volume[~unknown])
    low, high = volume[~unknown].aminmax()
    assert bool(((found >= low) & (found <= high)).all())


def test_a_hole_in_a_constant_is_that_constant() -> None:
    unknown = torch.zeros(20, 17, 9, dtype=torch.bool)
    unknown[3:15, 2:14, :] = True
    volume = torch.full((20, 17, 9), 7.5).masked_fill(unknown, NAN)
    torch.testing.assert_close(filled(volume, unknown), torch.full((20, 17, 9), 7.5), rtol=1e-6, atol=0)


def test_entries_of_a_batch_are_filled_by_themselves() -> None:
    batch = samples(2, 2, 5, 6, 7)
    unknown = torch.rand(batch.shape, generator=torch.Generator().manual_seed(3)) < 0.3
    found = filled(batch.masked_fill(unknown, NAN), unknown)
    for n in range(2):
        for c in range(2):
            assert torch.equal(found[n, c], filled(batch[n, c].masked_fill(unknown[n, c], NAN), unknown[n, c]))


@pytest.mark.parametrize("choice", ["fill", "propagate"])
def test_derivatives_go_to_the_known_voxels(choice) -> None:
    volume = with_holes(6, 6, 6).requires_grad_()
    points = torch.tensor([[1.2, 3.3, 3.9], [0.4, 0.9, 4.6], [4.0, 1.0, 1.5]], dtype=torch.float64)
    field = fl.reconstruct(volume, "triquadratic", nan=choice)
    value = field(points).nan_to_num(nan=0)
    value.sum().backward()
    assert volume.grad is not None
    assert bool(volume.grad.isfinite().all())
    assert volume.grad[2, 3, 4] == volume.grad[5, 1, 0] == 0
    assert float(volume.grad.abs().max()) > 0.1


def test_the_derivative_of_filling_is_that_of_differences() -> None:
    unknown = torch.zeros(5, 4, 6, dtype=torch.bool)
    unknown[1:4, 1:3, 2:5] = True
    volume = samples(5, 4, 6).requires_grad_()
    assert torch.autograd.gradcheck(lambda v: filled(v, unknown), volume)


def test_transforms_go_through() -> None:
    points = torch.rand(4, 3, dtype=torch.float64) * 4
    values = torch.func.vmap(lambda v: fl.reconstruct(v, "triquadratic")(points))(samples(3, 5, 5, 5))
    assert values.shape == (3, 4)


def test_resampling_takes_the_choice() -> None:
    volume = with_holes(8, 8, 8)
    with pytest.raises(ValueError, match="1 NaN and 1 infinite"):
        fl.resample(volume, shape=(4, 4, 4), antialias=False)
    assert bool(fl.resample(volume, shape=(9, 9, 9), nan="fill").samples.isfinite().all())
    assert 0 < int(fl.resample(volume, shape=(9, 9, 9), nan="propagate").samples.isnan().sum()) < 729
