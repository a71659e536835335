"""Rays against the box of a domain, segments and jitter."""

import itertools
import math

import pytest
import torch

from filterlab.fields.base import Domain
from filterlab.geometry import Geometry
from filterlab.ops.reference.march import segments
from filterlab.render.rays import check_rays, check_region, intersect, jitter, segment_count

UNIT = Domain((-1.0, -1.0, -1.0), (1.0, 1.0, 1.0))


def interval(origin, direction, domain=UNIT, region=None):
    o, d = check_rays(torch.tensor([origin], dtype=torch.float64), torch.tensor([direction], dtype=torch.float64))
    near, far = intersect(o, d, domain, region)
    assert not near.isnan().any()
    assert not far.isnan().any()
    return near.item(), far.item()


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("sign", [-1.0, 1.0])
def test_rays_parallel_to_an_axis(axis, sign):
    origin, direction = [0.25, -0.5, 0.75], [0.0, 0.0, 0.0]
    origin[axis], direction[axis] = -3 * sign, sign
    assert interval(origin, direction) == (2.0, 4.0)
    origin[axis] = 0.5 * sign  # from inside
    assert interval(origin, direction) == (0.0, 0.5)
    origin[axis] = 3 * sign  # box behind
    near, far = interval(origin, direction)
    assert far <= near
    origin[axis], origin[(axis + 1) % 3] = -3 * sign, 1.0  # on a face: still the box
    assert interval(origin, direction) == (2.0, 4.0)
    origin[(axis + 1) % 3] = math.nextafter(1.0, 2.0)  # just beside it
    near, far = interval(origin, direction)
    assert far <= near


def test_along_an_edge_through_a_corner_and_from_a_face():
    assert interval([1.0, -1.0, -5.0], [0.0, 0.0, 1.0]) == (4.0, 6.0)
    near, far = interval([2.0, 0.0, 0.0], [-1.0, 1.0, 0.0])  # touches the edge x = y = 1
    assert near == far == pytest.approx(math.sqrt(2))
    assert interval([-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]) == (0.0, 2.0)
    near, far = interval([1.0, 0.0, 0.0], [1.0, 0.0, 0.0])
    assert far <= near


def test_negative_zero_and_denormal_components_give_no_nan():
    for tiny in (-0.0, 5e-324, -1e-310):
        assert interval([1.0, 0.0, -5.0], [tiny, tiny, 1.0]) == (4.0, 6.0)


def test_against_a_brute_force_scan_of_points_on_the_ray():
    """A turned, stretched, flipped geometry and a region: the interval holds exactly the points that are inside."""
    c, s = math.cos(0.5), math.sin(0.5)
    geometry = Geometry(((2 * c, -s, 0.0), (2 * s, c, 0.0), (0.0, 0.0, -0.5)), (3.0, -1.0, 2.0))
    domain = Domain.of_grid((5, 6, 9), geometry)
    region = ((1.0, 0.0, -2.0), (7.0, 6.0, 1.5))
    generator = torch.Generator().manual_seed(5)
    center = torch.tensor(domain.center).double()
    o = center + 8 * torch.randn(200, 3, generator=generator, dtype=torch.float64)
    target = center + 3 * torch.randn(200, 3, generator=generator, dtype=torch.float64)
    o, d = check_rays(o, target - o)
    near, far = intersect(o, d, domain, region)
    t = torch.linspace(0, 40, 4001, dtype=torch.float64)
    p = o[:, None] + t[:, None] * d[:, None]
    voxels = (p - torch.tensor(geometry.origin).double()) @ torch.linalg.inv(torch.tensor(geometry.matrix).double()).T
    inside = ((voxels >= torch.tensor(domain.lower)) & (voxels <= torch.tensor(domain.upper))).all(-1)
    inside &= ((p >= torch.tensor(region[0])) & (p <= torch.tensor(region[1]))).all(-1)
    assert 20 < inside.any(-1).sum() < 180
    assert torch.equal(inside, (t >= near[:, None]) & (t <= far[:, None]))


def test_intersect_is_differentiable_even_for_parallel_and_missing_rays():
    o = torch.tensor([[0.3, 0.2, -5.0], [0.0, 0.0, -5.0], [9.0, 0.0, -5.0]], dtype=torch.float64, requires_grad=True)
    d = torch.tensor([[0.1, -0.05, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]], dtype=torch.float64, requires_grad=True)
    near, far = intersect(o, d, UNIT)
    for x in torch.autograd.grad((far - near)[:2].sum() + near[2].clamp(max=5), (o, d)):
        assert x.isfinite().all()
    rays = [x[:1].detach().requires_grad_() for x in (o, d)]
    assert torch.autograd.gradcheck(lambda o, d: intersect(o, d, UNIT), rays)
    assert torch.autograd.gradgradcheck(lambda o, d: intersect(o, d, UNIT), rays)


def test_bad_rays_and_regions():
    good = torch.ones(2, 3)
    for o, d, message in (
        (good, torch.zeros(2, 3), "zero; 2 rays"),
        (good, good * math.nan, "finite; 2 rays"),
        (good * math.inf, good, "finite"),
        (good, torch.ones(2, 2), "same shape"),
        (torch.ones(2), torch.ones(2), "same shape"),
    ):
        with pytest.raises(ValueError, match=message):
            check_rays(o, d)
    with pytest.raises(TypeError, match="floating-point"):
        check_rays(torch.ones(2, 3, dtype=torch.int32), good)
    for region in (((0, 0, 0), (1, 1, 0)), ((0, 0), (1, 1)), (0, 1), ((0, 0, 0), (1, 1, math.nan))):
        with pytest.raises(ValueError, match="region must be two world corners"):
            check_region(region)  # type: ignore[arg-type]


@pytest.mark.parametrize("offset", [1.0, 0.3])
@pytest.mark.parametrize("step", [0.05, 0.5, 1.0, 3.0, 8.0])
def test_segments_tile_the_length(step, offset):
    length = torch.tensor([0.0, 1e-9, 0.7, 1.0, 5.0, 17.3], dtype=torch.float64)
    count = segment_count(length, step, offset)
    middle, thickness = segments(length, step, 0, int(count.max()) + 3, torch.full_like(length, offset))
    torch.testing.assert_close(thickness.sum(-1), length, rtol=1e-14, atol=0)
    assert torch.equal((thickness > 1e-12 * step).sum(-1).double()[length != 1e-9], count[length != 1e-9])
    ends = thickness.cumsum(-1)
    real = thickness > 0
    torch.testing.assert_close(middle[real], (ends - thickness / 2)[real], rtol=0, atol=1e-13)
    whole = thickness[-1, 1 : int(count[-1]) - 1]
    torch.testing.assert_close(whole, torch.full_like(whole, step), rtol=0, atol=1e-14)
    if offset == 1.0:
        assert count.tolist() == [math.ceil(x / step - 1e-12) if x > 1e-6 else float(x > 0) for x in length.tolist()]


def test_blocks_of_segments_are_the_same_segments():
    length = torch.tensor([17.3, 4.0], dtype=torch.float64)
    whole = segments(length, 0.31, 0, 64)
    for block, all_of_them in zip(segments(length, 0.31, 32, 32), whole, strict=True):
        assert torch.equal(block, all_of_them[:, 32:])


def test_jitter_is_uniform_uncorrelated_and_a_function_of_seed_and_pixel_only():
    u = jitter(7, torch.arange(40000))
    assert u.min() > 0
    assert u.max() < 1
    histogram = torch.histc(u, 20, 0, 1)
    assert ((histogram - 2000) ** 2 / 2000).sum() < 50  # χ² with 19 degrees of freedom: P ≈ 1e-4
    for lag in (1, 200, 512):
        r = torch.corrcoef(torch.stack((u[lag:], u[:-lag])))[0, 1]
        assert abs(r) < 0.025  # 5 σ
    assert torch.equal(jitter(7, torch.tensor([39999, 3])), u[[39999, 3]])
    others = [jitter(seed, torch.arange(40000)) for seed in (8, 7 + 2**32, 7 + 2**62)]
    others += [jitter(7, torch.arange(40000) + further) for further in (2**32, 2**33, 2**61)]
    for a, b in itertools.combinations([u, *others], 2):
        assert abs(torch.corrcoef(torch.stack((a, b)))[0, 1]) < 0.025
        assert len(torch.cat((a, b)).unique()) > 80000 - 10  # of 2³² numbers; nor are they the same in another order
    for seed in (-1, 2**63, 1.5, True):
        with pytest.raises(ValueError, match="jitter_seed"):
            jitter(seed, torch.arange(2))  # type: ignore[arg-type]
