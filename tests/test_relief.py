"""Slope, aspect and curvatures: against surfaces for which they are known."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from filterlab.surfaces import HeightField, Relief
from filterlab.surfaces.base import geometry

F64 = torch.float64


def jet_of(surface, points: Tensor) -> Relief:
    """The exact jet of z(x, y)."""
    points = points.clone().requires_grad_()
    z = surface(*points.unbind(-1))
    (slope,) = torch.autograd.grad(z.sum(), points, create_graph=True)
    rows = [torch.autograd.grad(slope[..., i].sum(), points, retain_graph=True, allow_unused=True)[0] for i in (0, 1)]
    rows = [torch.zeros_like(points) if row is None else row for row in rows]
    return Relief(z.detach(), slope.detach(), torch.stack(rows, -2))


def somewhere(count: int = 50) -> Tensor:
    return torch.rand(count, 2, dtype=F64, generator=torch.Generator().manual_seed(3)) - 0.5


def close(found: Tensor, expected, near: float = 1e-12) -> None:
    torch.testing.assert_close(found, torch.as_tensor(expected, dtype=F64).expand_as(found), rtol=0, atol=near)


def test_a_ball_has_the_same_curvature_along_every_line():
    found = jet_of(lambda x, y: (4 - x * x - y * y).sqrt(), points := somewhere())
    radius = points.norm(dim=-1)
    for curvature in (found.profile_curvature, found.tangential_curvature, found.mean_curvature):
        close(curvature, 0.5)
    close(found.gaussian_curvature, 0.25)
    close(found.plan_curvature, 1 / radius, 1e-10)
    close(found.slope, (radius / 2).asin())
    x, y = points.unbind(-1)
    close(found.aspect, torch.atan2(x, y).remainder(2 * math.pi))


def test_a_cylinder_is_bent_across_its_axis_alone():
    found = jet_of(lambda x, y: -(4 - x * x).sqrt() + 0 * y, somewhere())
    close(found.profile_curvature, -0.5)  # a valley
    close(found.tangential_curvature, 0.0)
    close(found.plan_curvature, 0.0)
    close(found.mean_curvature, -0.25)


def test_a_plane_faces_one_way():
    for angle in (0.0, 0.3, 2.0, 4.0, 6.0):
        down = math.sin(angle), math.cos(angle)  # to the east, to the north
        found = jet_of(lambda x, y: -2 * (down[0] * x + down[1] * y) + 0 * x * y, somewhere(5))  # noqa: B023
        close(torch.cos(found.aspect - angle), 1.0)
        close(found.slope, math.atan(2))
        for curvature in (found.mean_curvature, found.plan_curvature, found.profile_curvature):
            close(curvature, 0.0)


def test_profile_and_tangential_curvature_are_those_of_the_surface_in_space():
    """Mean and Gaussian curvature by principal ones, which `surfaces.base` finds; n points up, so signs turn round."""
    found = jet_of(lambda x, y: torch.sin(3 * x + 1) * torch.cos(2 * y) + x * y, somewhere())
    gradient = torch.cat((-found.gradient, torch.ones(50, 1, dtype=F64)), -1)
    hessian = torch.nn.functional.pad(-found.hessian, (0, 1, 0, 1))  # type: ignore[operator]
    curvatures = geometry(torch.zeros(50, 3), (gradient, hessian)).curvatures
    assert curvatures is not None
    close(found.mean_curvature, curvatures.sum(-1) / 2)
    close(found.gaussian_curvature, curvatures.prod(-1))
    close((found.profile_curvature + found.tangential_curvature) / 2, found.mean_curvature)


def test_where_it_is_level_there_is_no_way_down():
    gradient = torch.zeros(2, 2, dtype=F64, requires_grad=True)
    hessian = torch.eye(2, dtype=F64).expand(2, 2, 2)
    found = Relief(torch.zeros(2, dtype=F64), gradient, hessian)
    assert bool(found.aspect.isnan().all())
    for curvature in (found.profile_curvature, found.tangential_curvature, found.plan_curvature, found.slope):
        close(curvature.detach(), 0.0)
        assert bool(torch.autograd.grad(curvature.sum(), gradient, retain_graph=True)[0].isfinite().all())
    close(found.mean_curvature.detach(), -1.0)


def test_a_height_field_tells_its_relief():
    """Of the cubic that c1 gives back, in metres, with rows that go south."""
    cubic = lambda x, y: 0.01 * x**3 - 0.02 * x * y * y + 0.3 * x - 0.4 * y  # noqa: E731
    row, column = torch.meshgrid(torch.arange(31.0, dtype=F64), torch.arange(31.0, dtype=F64), indexing="ij")
    heights = cubic(0.2 * column - 3, 3 - 0.2 * row)
    points = 2 * somewhere()
    found, expected = HeightField(heights, "c1", (0.2, -0.2), (-3, 3)).relief(points), jet_of(cubic, points)
    for name in ("slope", "aspect", "profile_curvature", "plan_curvature", "mean_curvature", "tangential_curvature"):
        close(getattr(found, name), getattr(expected, name), 1e-10)
    terrain = HeightField(heights, "c1", 0.2)
    with pytest.raises(ValueError, match="curvatures need a relief of order 2; got one of order 1"):
        _ = terrain.relief(points, 1).mean_curvature
    with pytest.raises(ValueError, match="order must be 1 or 2; got 0"):
        terrain.relief(points, 0)
    with pytest.raises(ValueError, match=r"shape \(..., 2\): x, y; got \(4, 3\)"):
        terrain.relief(torch.zeros(4, 3))
