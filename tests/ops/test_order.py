"""Sorting scattered points changes no result: gather bit by bit, scatter to rounding."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from filterlab import ops
from filterlab.kernels import bspline
from filterlab.ops.cpu import gather as cpu
from filterlab.ops.cpu import order
from tests.laws import assert_close

SHAPE, START = (40, 33, 50), -2


@pytest.fixture
def sorting(monkeypatch: pytest.MonkeyPatch):
    """sorting(False) as if it never paid, sorting(True) as if it always did."""

    def choose(always: bool) -> None:
        monkeypatch.setattr(cpu, "_sorting_pays", lambda *_: always)

    return choose


def some(n: int, m: int, dtype: torch.dtype) -> Tensor:
    points = torch.rand(n, m, 3, dtype=dtype) * 60 - 8
    for i, bad in enumerate((float("nan"), float("inf"), -float("inf"), 1e30, -1e30)):
        points[0, 2 * i, i % 3] = bad
    return points


@pytest.mark.parametrize("at_once", [1 << 22, 300])
@pytest.mark.parametrize("m", [16, 17, 23, 1000])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64], ids=str)
def test_gather_is_bit_equal_and_scatter_equal(sorting, monkeypatch, dtype: torch.dtype, m: int, at_once: int) -> None:
    monkeypatch.setattr(order, "POINTS_AT_ONCE", at_once)
    coefficients, points = torch.randn(2, 2, *SHAPE, dtype=dtype), some(2, m, dtype)
    sorting(False)
    expected = ops.jet(coefficients, points, bspline(2), 1, START, "cpu")
    cotangents = torch.randn_like(expected)
    spread = ops.splat(cotangents, points, bspline(2), 1, SHAPE, START, "cpu")
    sorting(True)
    assert torch.equal(ops.jet(coefficients, points, bspline(2), 1, START, "cpu").nan_to_num(7), expected.nan_to_num(7))
    again = [ops.splat(cotangents, points, bspline(2), 1, SHAPE, START, "cpu") for _ in range(2)]
    tolerance = {torch.float32: 1e-5, torch.float64: 1e-13}[dtype]
    finite = spread.isfinite()
    assert_close(again[0][finite], spread[finite], tolerance, float(spread[finite].abs().max()))
    assert torch.equal(again[0].nan_to_num(7), again[1].nan_to_num(7))


@pytest.mark.parametrize("stored", [torch.uint8, torch.int16, torch.bfloat16], ids=str)
def test_stored_coefficients_and_strided_points(sorting, stored: torch.dtype) -> None:
    coefficients = (torch.rand(1, 3, *SHAPE) * 100).to(stored)[:, ::2]
    points = some(1, 200, torch.float32)[:, ::2]
    results = []
    for always in (False, True):
        sorting(always)
        results.append(ops.jet(coefficients, points, bspline(3), 2, START, "cpu").nan_to_num(7))
    assert torch.equal(*results)


def test_sorted_by_bricks_and_stable() -> None:
    points = torch.rand(5000, 3) * torch.tensor([50.0, 33, 40])
    index = torch.arange(5000.0)
    ordered = order.Sorted(points, order.Bricks.of(SHAPE[::-1], (0,) * 3, (1,) * 3), 8)
    rows = torch.empty(1, 5000)
    ordered.arrange(index[None], rows)
    assert torch.equal(points[rows[0].long()], ordered.points)
    brick = (ordered.points / 8).floor() @ torch.tensor([1.0, 7, 35])
    key = brick * 5000 + rows[0]
    assert bool((key.diff() > 0).all())
    back = torch.empty(1, 5000)
    ordered.restore(rows, back)
    assert torch.equal(back[0], index)


def test_bricks_grow_until_there_are_few_enough(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(order, "_MOST_BRICKS", 60)
    points = torch.rand(100, 3) * torch.tensor([50.0, 33, 40])
    ordered = order.Sorted(points, order.Bricks.of(SHAPE[::-1], (0,) * 3, (1,) * 3), 8)
    assert 0 < len(ordered._begin) <= 60
    assert np.array_equal(np.sort(ordered.points.numpy(), axis=0), np.sort(points.numpy(), axis=0))


def test_it_pays_for_many_scattered_points_in_a_large_volume() -> None:
    large, many = cpu.SMALLEST_SORTED_IN, cpu.FEWEST_SORTED
    scattered = torch.rand(1, many, 3) * 100
    along_rays = torch.arange(float(many))[None, :, None].expand(1, many, 3) % 100 + 0.01
    assert cpu._sorting_pays(scattered, large)
    assert not cpu._sorting_pays(scattered, large - 1)
    assert not cpu._sorting_pays(scattered[:, 1:], large)
    assert not cpu._sorting_pays(along_rays, large)


def test_gather_and_scatter_ask(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(cpu, "_sorting_pays", lambda points, size: asked.append(size) or False)
    ops.jet(torch.zeros(1, 2, 4, 5, 6), torch.zeros(1, 8, 3), bspline(1), 0, 0, "cpu")
    ops.splat(torch.zeros(1, 1, 1, 8), torch.zeros(1, 8, 3), bspline(1), 0, (4, 5, 6), 0, "cpu")
    assert asked == [4 * 5 * 6 * 4] * 2
