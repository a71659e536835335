"""Rows of hits by rows of rays: plain torch against a loop in NumPy, programs against both."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from filterlab.ops.cpu import hit_points as cpu
from filterlab.ops.differentiable import hit_points
from filterlab.ops.reference import hit_points as reference
from filterlab.surfaces import Quadrics

ROOMS = pytest.mark.parametrize("room", [reference, cpu], ids=["reference", "cpu"])
DTYPES = pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
SHAPES = pytest.mark.parametrize("shape", [(97, 131), (7,), (3, 0), ()], ids=str)  # several chunks of rays


def rays(shape: tuple[int, ...], dtype: torch.dtype) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Origins, which are all the same, directions, t of every second ray or so, and the places of these."""
    made = torch.Generator().manual_seed(len(shape))
    o, d = torch.randn(3, dtype=dtype, generator=made), torch.randn(*shape, 3, dtype=dtype, generator=made)
    t = torch.rand(shape, dtype=dtype, generator=made)
    t = torch.where(t < 0.5, t, torch.inf)
    return o.expand(*shape, 3), d, t, (t.flatten() < torch.inf).nonzero()[:, 0]


@ROOMS
@DTYPES
@SHAPES
def test_points_are_on_the_rays_that_hit(room, dtype, shape):
    o, d, t, index = rays(shape, dtype)
    flat_o, flat_d, flat_t = (x.reshape(-1, n).numpy() for x, n in ((o, 3), (d, 3), (t, 1)))
    expected = [flat_o[i] + flat_t[i] * flat_d[i] for i in range(len(flat_t)) if np.isfinite(flat_t[i])]
    found, far = room.points(o, d, t, index, math.inf)
    assert found.dtype == dtype
    assert not far
    assert np.array_equal(found, np.reshape(expected, (-1, 3)))


@ROOMS
@DTYPES
@SHAPES
@pytest.mark.parametrize("columns", [False, True])
def test_rows_of_hits_are_those_of_their_rays_and_others_are_0(room, dtype, shape, columns):
    *_, t, index = rays(shape, dtype)
    point = torch.arange(3.0 * len(index), dtype=dtype).view(-1, 3) + 1
    gradient = point.cos().T.contiguous().T if columns else point.cos()
    gradient[::5] = 0
    found = room.by_rays(index, t.shape, point, gradient)
    expected = np.zeros((3, t.numel(), 3))
    for i, p, g in zip(index.tolist(), point.double().numpy(), gradient.double().numpy(), strict=True):
        expected[:, i] = p, g, g / (np.linalg.norm(g) or 1)
    eps = torch.finfo(dtype).eps
    for own, other in zip(found[:3], expected, strict=True):
        assert own.shape == (*shape, 3)
        assert own.dtype == dtype
        np.testing.assert_allclose(own.double().numpy().reshape(-1, 3), other, rtol=4 * eps, atol=0)
    assert not found.unknown


@ROOMS
@pytest.mark.parametrize("axis", range(3))
def test_it_is_told_that_a_gradient_is_not_known(room, axis):
    gradient = torch.ones(5000, 3)
    gradient[4999, axis] = torch.nan
    assert room.by_rays(torch.arange(5000), torch.Size([5001]), gradient, gradient).unknown


@ROOMS
@DTYPES
@pytest.mark.parametrize("axis", range(3))
def test_it_is_told_that_a_ray_that_hits_begins_far_away(room, dtype, axis):
    origins, directions = torch.full((5000, 3), -2.0, dtype=dtype), torch.ones(5000, 3, dtype=dtype)
    t, index = torch.ones(5000, dtype=dtype), torch.arange(0, 5000, 2)
    for ray, component, far in ((4998, -3.5, True), (4998, 3.5, True), (4998, -3.0, False), (4999, -3.5, False)):
        o = origins.clone()
        o[ray, axis] = component
        assert room.points(o, directions, t, index, 3.0).far == far


def test_rays_in_steps_are_read_as_they_are():
    o, d, t, _ = rays((40, 50), torch.float32)
    o, d, t = o[:1, :1], d[:, ::2], t[:, ::2]
    index = (t.flatten() < torch.inf).nonzero()[:, 0]
    assert torch.equal(*(room.points(o, d, t, index, math.inf).point for room in (cpu, reference)))


def test_what_is_recorded_or_of_two_types_is_left_to_plain_torch():
    o, d, t, index = rays((20,), torch.float64)
    assert hit_points.points(o, d.clone().requires_grad_(), t, index, 1.0).point.requires_grad
    assert hit_points.points(o, d, t.float(), index, 1.0).point.dtype == torch.float64


def test_what_is_known_at_hits_is_the_same_with_and_without_derivatives():
    surface = Quadrics.ellipsoids(torch.zeros(1, 3, dtype=torch.float64), torch.eye(3, dtype=torch.float64)[None])
    o = torch.randn(200, 3, dtype=torch.float64)
    d = -o + torch.randn(200, 3, dtype=torch.float64) / 2
    hit = surface.hit(o, d)
    plain, recorded = surface.at(o, d, hit), surface.at(o.clone().requires_grad_(), d, hit)
    assert hit.valid.any()
    assert not hit.valid.all()
    assert recorded.point.requires_grad
    for one, other in zip(plain[:3], recorded[:3], strict=True):
        torch.testing.assert_close(one, other.detach(), rtol=1e-14, atol=1e-14)
