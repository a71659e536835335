"""Splines of heights: the program against plain torch, the transpose against autograd."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

from filterlab.ops import cpu
from filterlab.ops.cpu import heights as cpu_heights
from filterlab.ops.cpu import order as cpu_order
from filterlab.ops.cpu import threads
from filterlab.ops.differentiable import heights as ops
from filterlab.ops.heights import DIAGONALS, Heights, differences, raised, rows
from filterlab.surfaces.quartic import SPLINES
from filterlab.volume import Boundary

F64 = torch.float64
pytestmark = pytest.mark.skipif(cpu.llvmlite_problem() is not None, reason="needs llvmlite")

PREFILTERED = SPLINES["c2"].with_prefilter()
ALL = [*SPLINES.values(), PREFILTERED]
every_spline = pytest.mark.parametrize("spline", ALL, ids=[*SPLINES, "c2 prefiltered"])


def random(*shape: int, seed: int = 0, dtype=F64) -> Tensor:
    return torch.rand(*shape, dtype=F64, generator=torch.Generator().manual_seed(seed)).to(dtype)


def given(spline, values: Tensor, boundary=Boundary.MIRROR, diagonal: str = "main") -> Heights:
    return Heights(values, spline.pattern(diagonal), boundary, (0.5, -0.25), (3.0, 2.0))


def places(entries: int, count: int, steps: float = 50.0, seed: int = 1) -> Tensor:
    """Points over grids of 10 steps and far beyond."""
    at = (random(entries, count, 2, seed=seed) - 0.5) * steps + 5
    return torch.tensor([3.0, 2.0], dtype=F64) + torch.tensor([0.5, -0.25], dtype=F64) * at


def close(found: Tensor, expected: Tensor, near: float) -> None:
    torch.testing.assert_close(found, expected, rtol=near, atol=near, equal_nan=True)


@pytest.mark.parametrize(
    ("spline", "order"),
    [*((spline, 2) for spline in ALL), (SPLINES["c1"], 0), (SPLINES["c1"], 1)],
    ids=[*SPLINES, "c2 prefiltered", "c1, 0", "c1, 1"],
)
def test_the_program_does_what_plain_torch_does(spline, order: int):
    """Under every boundary and along both diagonals, of few heights and more."""
    for n, boundary in enumerate(Boundary):
        for shape in ((1, 1, 1), (2, 5, 1), (1, 9, 7)):
            heights = given(spline, random(*shape), boundary, DIAGONALS[(n + order) % 2])
            points = places(shape[0], 37)
            close(ops.jet(heights, points, order, "cpu"), ops.jet(heights, points, order, "reference"), 1e-11)


@pytest.mark.parametrize("order", [3, 4])
def test_all_derivatives_that_a_quartic_has(order: int):
    heights, points = given(SPLINES["c1"], random(1, 9, 7)), places(1, 20)
    close(ops.jet(heights, points, order, "cpu"), ops.jet(heights, points, order, "reference"), 1e-9)


@pytest.mark.parametrize("count", [0, 1, 7, 8, 17])
def test_any_number_of_points(count: int):
    heights = given(SPLINES["c0"], random(2, 6, 6))
    points = places(2, count + 1)[:, :count]  # a view
    for dtype in (torch.float32, F64):
        own = points.to(dtype)
        close(ops.jet(heights, own, 2, "cpu"), ops.jet(heights, own, 2, "reference"), 1e-3 if dtype != F64 else 1e-11)


@pytest.mark.parametrize(
    "dtype",
    [*(torch.uint8, torch.int8, torch.int16, torch.int32), *(torch.float16, torch.bfloat16, torch.float32)],
)
def test_heights_as_they_are_stored_and_lie(dtype):
    values = (100 * random(2, 12, 20)).to(dtype)[:, ::2, 3:15]
    heights, points = given(SPLINES["c1"], values), places(2, 40, 20.0)
    close(ops.jet(heights, points, 1, "cpu"), ops.jet(heights, points, 1, "reference"), 1e-11)


def test_float32_is_as_exact_in_the_program_as_in_plain_torch():
    """Of heights about 3000: derivatives are those of their differences."""
    values, points = 3000 + random(1, 20, 20), places(1, 200, 10.0).float()
    heights = given(SPLINES["c1"], values.float())
    exact = ops.jet(given(SPLINES["c1"], values.float().double()), points.double(), 2, "reference")
    found = ops.jet(heights, points, 2, "cpu").double()
    assert float((found - exact)[:, 1:3].abs().max()) < 1e-4
    close(found[:, :1], exact[:, :1], 2e-7)


@every_spline
@pytest.mark.parametrize("boundary", [Boundary.WRAP, Boundary.ZEROS, Boundary.REFLECT])
def test_splat_is_the_transpose(spline, boundary: Boundary):
    values, points = random(2, 9, 7).requires_grad_(), places(2, 100)
    heights = given(spline, values, boundary, "anti" if boundary is Boundary.WRAP else "main")
    for order in (0, 2):
        cotangents = random(2, len(rows(order)), 100, seed=5) - 0.5
        found, expected = (
            torch.autograd.grad(ops.jet(heights, points, order, name), values, cotangents)[0]
            for name in ("cpu", "reference")
        )
        close(found, expected, 1e-10)


@pytest.mark.parametrize("wanted", ["heights", "points", "both"])
def test_derivatives_are_those_of_plain_torch_twice(wanted: str):
    """In heights and points, first and second, of jets of order 2; autograd differentiates the plain ones."""
    found = []
    for name in ("cpu", "reference"):
        values, points = random(1, 6, 7).requires_grad_(wanted != "points"), places(1, 10).requires_grad_(
            wanted != "heights"
        )  # fmt: skip
        asked = [x for x in (values, points) if x.requires_grad]
        jet = ops.jet(given(SPLINES["c1"], values), points, 2, name)
        first = torch.autograd.grad((jet * jet).sum(), asked, create_graph=True)
        total = sum((random(*x.shape, seed=9) * x).sum() for x in first)
        found.append([*first, *torch.autograd.grad(total, asked)])
    for own, other in zip(*found, strict=True):
        close(own, other, 1e-9)


def test_derivatives_beyond_the_degree_are_nothing():
    points = places(1, 5).requires_grad_()
    found = ops.jet(given(SPLINES["c0"], random(1, 9, 9)), points, 4, "cpu")
    (slope,) = torch.autograd.grad(found[:, -1].sum(), points)
    assert not slope.any()


def test_holes_are_the_same_and_give_nothing():
    """A row that would not need what is missing is NaN with the others; cotangents there count for nothing."""
    values = random(1, 16, 16)
    values[0, 6, 7] = torch.nan
    found = []
    for name in ("cpu", "reference"):
        own, points = values.clone().requires_grad_(), places(1, 500, 12.0).requires_grad_()
        jet = ops.jet(given(SPLINES["c1"], own), points, 2, name)
        found.append([jet.detach(), *torch.autograd.grad(jet, (own, points), torch.ones_like(jet))])
    for own, other in zip(*found, strict=True):
        close(own, other, 1e-9)
    assert 0 < int(found[0][0].isnan().any(1).sum()) < 500
    assert torch.equal(found[0][0].isnan().any(1), found[0][0].isnan().all(1))
    assert bool(found[0][1].isfinite().all())
    assert bool(found[0][2].isfinite().all())


def test_points_that_are_nowhere():
    points = torch.tensor([[[torch.inf, 1], [torch.nan, 1], [1, -torch.inf], [4, 1], [1e30, -1e30]]], dtype=F64)
    values = random(1, 9, 9).requires_grad_()
    heights = given(SPLINES["c1"], values)
    jet = ops.jet(heights, points, 1, "cpu")
    assert jet[0, 0].isnan().tolist() == [True, True, True, False, False]
    found, expected = (
        torch.autograd.grad(ops.jet(heights, points[:, :4], 1, name), values, torch.ones(1, 3, 4, dtype=F64))[0]
        for name in ("cpu", "reference")
    )
    close(found, expected, 1e-11)


def test_threads_change_nothing_but_the_order_of_sums(monkeypatch: pytest.MonkeyPatch):
    heights, points = given(SPLINES["c1"], random(2, 40, 40).requires_grad_()), places(2, 6000, 40.0)

    def both():
        jet = ops.jet(heights, points, 1, "cpu")
        return jet.detach(), torch.autograd.grad(jet, heights.values, torch.ones_like(jet))[0]

    alone = both()
    monkeypatch.setattr(torch, "get_num_threads", lambda: 3)
    seen = []
    run = threads.run
    monkeypatch.setattr("filterlab.ops.cpu.heights.pool.run", lambda f, jobs: (seen.append(len(jobs)), run(f, jobs)))
    together = both()
    assert seen == [3, 3]
    assert torch.equal(alone[0], together[0])
    close(alone[1], together[1], 1e-12)


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_scattered_points_are_sorted_without_a_bit_of_difference(monkeypatch, dtype):
    """Beyond the grid and nowhere too; transposes to rounding, for sums have another order."""
    values = random(2, 40, 50, dtype=dtype)
    points = places(2, 1000, 120.0).to(dtype)
    points[0, 3], points[1, 7, 1] = torch.nan, torch.inf
    heights, cotangents = given(SPLINES["c1"], values, Boundary.ZEROS), random(2, 3, 1000, seed=5, dtype=dtype) - 0.5
    monkeypatch.setattr(cpu_heights, "_TILE", (16, 4))
    monkeypatch.setattr(cpu_order, "POINTS_AT_ONCE", 600)
    found = []
    for sorted_ in (False, True):
        monkeypatch.setattr(cpu_heights, "_sorting_pays", lambda *_, own=sorted_: own)
        found.append((cpu_heights.jet(heights, points, 2), cpu_heights.splat(heights, points, cotangents, 1)))
    (jet, splat), (own, spread) = found
    assert torch.equal(own.nan_to_num(7), jet.nan_to_num(7))
    close(spread, splat, 1e-4 if dtype is torch.float32 else 1e-12)
    assert int(jet[:, 0].isnan().sum()) == 2


@pytest.mark.parametrize("spline", ["linear", "c2"])
def test_what_lies_near_in_memory_changes_no_bit(spline):
    """Packs are found some turns before they are summed, and ask memory for data only where these are far apart."""
    heights, points = given(SPLINES[spline], random(1, 60, 200).float()), places(1, 3003, 190.0).float()
    order = points[0, :, 0].argsort()
    jet = cpu_heights.jet(heights, points, 1)
    for count in (1, 8, 65, 3003):
        assert torch.equal(cpu_heights.jet(heights, points[:, order[:count]], 1), jet[..., order[:count]])
        assert torch.equal(cpu_heights.jet(heights, points[:, :count], 1), jet[..., :count])


def test_which_points_are_sorted():
    """Many that lie all over more data than caches hold, where patches are no planes."""
    values, many = torch.zeros(1, 950, 950), 1 << 16
    points, heights = places(1, many, 950.0).float(), given(SPLINES["c1"], values)
    assert cpu_heights._sorting_pays(heights, values, points)
    assert not cpu_heights._sorting_pays(given(SPLINES["c2"], values), values, points)
    assert not cpu_heights._sorting_pays(heights, values[:, :600], points)
    assert not cpu_heights._sorting_pays(heights, values, points[:, 1:])
    assert not cpu_heights._sorting_pays(heights, values, points.sort(1).values)
    wide = torch.zeros(1, 1, 1).expand(1, 2048, 4096)
    assert cpu_heights._sorting_pays(given(SPLINES["c2"], wide), wide, points)
    assert not cpu_heights._sorting_pays(given(SPLINES["linear"], wide), wide, points)


@pytest.mark.parametrize("boundary", list(Boundary))
@pytest.mark.parametrize("spline", ["linear", "c1"])
def test_points_farther_away_than_integers_count(spline, boundary):
    """Every boundary puts them somewhere, and never reads beside the grid."""
    far = torch.tensor([2.0**e * sign + off for e in (20, 31, 32, 40) for sign in (-1, 1) for off in (-300, 0.25, 5)])
    points = torch.stack((far, far.flip(0)), -1)[None].double()
    heights = given(SPLINES[spline], random(1, 6, 7), boundary)
    close(ops.jet(heights, points, 1, "cpu"), ops.jet(heights, points, 1, "reference"), 1e-6)


def test_what_runs_it():
    heights, points = given(SPLINES["c1"], random(1, 4, 4)), places(1, 3)
    assert ops.missing("cpu", heights, points) is None
    assert "stored as" in str(ops.missing("cpu", replace(heights, values=heights.values.to(torch.int64)), points))
    assert "float32 or float64; got torch.float16" in str(ops.missing("cpu", heights, points.half()))
    assert torch.equal(
        ops.jet(replace(heights, values=torch.ones(1, 4, 4, dtype=torch.int64)), points, 0), torch.ones(1, 1, 3)
    )
    batched = torch.func.vmap(lambda p: ops.jet(heights, p, 0))(points.expand(2, 1, 3, 2).contiguous())
    close(batched[0], ops.jet(heights, points, 0), 1e-13)


def test_rows_and_their_derivatives():
    assert rows(2) == ((0, 0), (1, 0), (0, 1), (2, 0), (1, 1), (0, 2))
    assert raised(1) == ((1, 3, 4), (2, 4, 5))
    assert differences(2, 0) == {0: 12, 1: -24, 3: 12}
