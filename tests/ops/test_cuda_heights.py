"""Splines of heights in Triton against plain torch: in Triton's interpreter everywhere, on a GPU where there is one."""

from __future__ import annotations

import pytest
import torch

pytest.importorskip("triton", reason="the package triton is not installed")

from filterlab.ops.differentiable import heights as ops
from filterlab.ops.heights import Heights
from filterlab.surfaces.quartic import SPLINES
from filterlab.volume import Boundary
from tests.ops.test_cuda import device  # noqa: F401
from tests.ops.test_heights import close, given, places, random

F64 = torch.float64
CASES = [
    ("c1", Boundary.MIRROR, "main", 2),
    ("c0", Boundary.ZEROS, "anti", 1),
    ("c2", Boundary.BORDER, "main", 3),
    ("linear", Boundary.WRAP, "anti", 0),
]


@pytest.mark.parametrize(("spline", "boundary", "diagonal", "order"), CASES)
def test_jets_and_their_derivatives_are_those_of_plain_torch(spline, boundary, diagonal, order, device):  # noqa: F811
    """And in heights as they are stored, with a hole, of points beyond the data and nowhere."""
    values, points = random(2, 9, 7), places(2, 150, 40.0)
    values[0, 4, 4], points[1, 3, 0] = torch.nan, torch.inf
    found = []
    for name in ("cuda", "reference"):
        own, at = (x.to(device).clone().requires_grad_() for x in (values, points))
        heights: Heights = given(SPLINES[spline], own, boundary, diagonal)
        jet = ops.jet(heights, at, order, name)
        known = torch.where(jet.isnan(), 0, jet)
        found.append([jet.detach(), *torch.autograd.grad((known * known).sum(), (own, at))])
    for own, other in zip(*found, strict=True):
        close(own.nan_to_num(), other.nan_to_num(), 1e-9)
    assert torch.equal(found[0][0].isnan(), found[1][0].isnan())


def test_heights_are_read_as_they_are_stored(device):  # noqa: F811
    for stored in (torch.uint8, torch.int16, torch.float16):
        heights = given(SPLINES["c1"], (100 * random(1, 9, 14)).to(stored).to(device)[:, :, ::2])
        points = places(1, 20, 12.0).to(device)
        for dtype, near in ((F64, 1e-11), (torch.float32, 1e-3)):
            own = points.to(dtype)
            close(ops.jet(heights, own, 1, "cuda"), ops.jet(heights, own, 1, "reference"), near)
