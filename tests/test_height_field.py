"""Height fields: against an oracle of their own, and by the laws of their splines."""

from __future__ import annotations

import math
from itertools import product

import numpy as np
import pytest
import torch
from torch import Tensor

from filterlab import bernstein
from filterlab.ops.heights import DIAGONALS
from filterlab.surfaces import HeightField
from filterlab.surfaces.quartic import SPLINES
from filterlab.volume import Boundary
from tests.pairs import in_pairs
from tests.quartic_oracle import Oracle

F64 = torch.float64
KINDS = [*SPLINES, "c2 prefiltered"]
ORDERS = {"linear": 2, "c0": 5, "c1": 4, "c2": 2, "c2 prefiltered": 4}
DEGREES = {"linear": 1, "c0": 4, "c1": 3, "c2": 1, "c2 prefiltered": 3}
CONTINUITY = {"linear": 0, "c0": 0, "c1": 1, "c2": 2, "c2 prefiltered": 2}
SPACING, ORIGIN = (0.5, -0.25), (3.0, 2.0)

every_kind = pytest.mark.parametrize("kind", KINDS)
every_diagonal = pytest.mark.parametrize("diagonal", DIAGONALS)


def field(heights, kind: str, spacing=SPACING, origin=ORIGIN, **options) -> HeightField:
    return HeightField(heights, kind.split()[0], spacing, origin, prefilter=kind == "c2 prefiltered", **options)


def rows(*shape: int, seed: int = 0, dtype=F64) -> Tensor:
    return torch.rand(*shape, dtype=F64, generator=torch.Generator().manual_seed(seed)).to(dtype)


def places(count: int, shape, seed: int = 1, beyond: float = 2.0) -> Tensor:
    """World points over the data of (H, W), and so many steps beyond."""
    h, w = shape
    steps = rows(count, 2, seed=seed) * torch.tensor([w - 1 + 2 * beyond, h - 1 + 2 * beyond]) - beyond
    return torch.tensor(ORIGIN, dtype=F64) + torch.tensor(SPACING, dtype=F64) * steps


def of(function, shape, spacing=SPACING, origin=ORIGIN) -> Tensor:
    """Heights of a function of (x, y)."""
    row, column = torch.meshgrid(*(torch.arange(n, dtype=F64) for n in shape), indexing="ij")
    return function(origin[0] + spacing[0] * column, origin[1] + spacing[1] * row)


@pytest.mark.parametrize(("kind", "diagonal", "boundary"), in_pairs(product(KINDS, DIAGONALS, Boundary)))
def test_jets_are_the_oracle_s(kind: str, diagonal: str, boundary: Boundary):
    for shape in ((1, 1), (1, 5), (2, 3), (4, 1), (9, 7)):
        heights, points = rows(*shape), places(8, shape)
        found = field(heights, kind, boundary=boundary, diagonal=diagonal).jet(points, 2)
        oracle = Oracle(heights, kind, SPACING, ORIGIN, str(boundary), diagonal)
        expected = zip(*(oracle.jet(p) for p in points.numpy()), strict=True)
        for own, other, scale in zip(found, expected, (1, 1e2, 1e4), strict=True):
            np.testing.assert_allclose(own.numpy(), np.array(other), rtol=1e-12, atol=1e-13 * scale)


@every_kind
@every_diagonal
def test_patches_are_the_oracle_s_and_share_their_edges_to_the_bit(kind: str, diagonal: str):
    """Of the main diagonal triangles are (1, 0) (0, 0) (1, 1) and (0, 1) (1, 1) (0, 0)."""
    heights = rows(7, 11)
    terrain, oracle = field(heights, kind, diagonal=diagonal), Oracle(heights, kind, diagonal=diagonal)
    columns, grid_rows = terrain.cells
    cells = torch.cartesian_prod(torch.arange(-1, columns + 1), torch.arange(-1, grid_rows + 1))
    found = terrain.patches(cells.reshape(columns + 2, grid_rows + 2, 2))
    for (i, j), pair in zip(cells.tolist(), found.flatten(0, 1), strict=True):
        for own, up in zip(pair, (True, False), strict=True):
            np.testing.assert_allclose(own.numpy(), oracle.patch((i, j), up), rtol=1e-13, atol=1e-13)
    edge = {(p, q): [n for n, a in enumerate(bernstein.multi_indices(4, 2)) if a[3 - p - q] == 0] for p in range(3)
            for q in range(3) if p != q}  # fmt: skip
    along = lambda x, p, q: x[..., edge[p, q]] if p < q else x[..., edge[p, q]].flip(-1)  # noqa: E731
    up, down = found.unbind(-2)
    assert torch.equal(along(up, 1, 2), along(down, 2, 1))
    assert torch.equal(along(up, 0, 1)[:, 1:], along(down, 1, 0)[:, :-1])
    beside = (up[1:], down[:-1]) if diagonal == "anti" else (up[:-1], down[1:])
    assert torch.equal(along(beside[0], 0, 2), along(beside[1], 2, 0))


def side(terrain: HeightField, cell: tuple[int, int], up: int, points: Tensor, order: int) -> Tensor:
    """All derivatives of an order of the polynomial of one triangle, anywhere; along λ1 and λ2, which are its own."""
    m, corner = terrain.spline.steps, torch.tensor(cell, dtype=F64)
    s, t = (points / m - corner).unbind(-1)
    s = 1 - s if terrain.diagonal == "main" else s
    s, t = (s, t) if up else (1 - s, 1 - t)
    pieces = terrain.patches(torch.tensor(cell))[0 if up else 1]
    sign = (1.0 if up else -1.0) ** order
    for _ in range(order):
        pieces = bernstein.derivative(
            pieces, torch.tensor([-2.0, 1.5, 0.5], dtype=F64)
        )  # one direction across all edges
    return sign * bernstein.evaluate(pieces, torch.stack((1 - s - t, s, t), -1))


@every_kind
@every_diagonal
def test_derivatives_jump_beyond_the_declared_order_only(kind: str, diagonal: str):
    """Across all three kinds of edges, of random heights; the direction of the derivative is across all of them."""
    terrain = field(rows(25, 25, seed=4), kind, 1.0, (0, 0), diagonal=diagonal)
    m, u, declared = terrain.spline.steps, rows(20), CONTINUITY[kind]
    main = diagonal == "main"
    across = torch.stack((2 + u, 2 + u if main else 3 - u), -1)
    edges = (
        (across, ((2, 2), 1), ((2, 2), 0)),
        (torch.stack((2 + u, torch.full_like(u, 2)), -1), ((2, 2), 1), ((2, 1), 0)),
        (torch.stack((torch.full_like(u, 2), 2 + u), -1), ((2, 2), int(not main)), ((1, 2), int(main))),
    )
    for points, *sides in edges:
        for order in range(declared + 2):
            one, other = (side(terrain, cell, up, m * points, order) for cell, up in sides)
            jump = float((one - other).abs().max()) / 4.0**order
            assert jump > 1e-3 if order > declared else jump < 1e-13


@every_kind
@every_diagonal
def test_polynomials_come_back_with_their_derivatives(kind: str, diagonal: str):
    polynomial = lambda x, y: sum(  # noqa: E731
        (0.3 + 0.1 * i - 0.2 * j) * ((x - 8) / 4) ** i * ((y + 1) / 4) ** j
        for i in range(DEGREES[kind] + 1)
        for j in range(DEGREES[kind] + 1 - i)
    )
    terrain = field(of(polynomial, (29, 33)), kind, diagonal=diagonal)
    points = places(200, (29, 33), beyond=-6).requires_grad_()
    expected = polynomial(*points.unbind(-1))
    (slope,) = torch.autograd.grad(expected.sum(), points, create_graph=True)
    z, gradient, hessian = terrain.jet(points, 2)
    torch.testing.assert_close(z, expected, rtol=0, atol=1e-13)
    torch.testing.assert_close(gradient, slope, rtol=0, atol=1e-12)
    if DEGREES[kind] > 1:
        bent = torch.stack([torch.autograd.grad(slope[:, i].sum(), points, retain_graph=True)[0] for i in range(2)], -2)
        torch.testing.assert_close(hessian, bent, rtol=0, atol=1e-10)


def falling(kind: str, order: int) -> float:
    """The slope of log error over log step, of a derivative of an order."""
    wave = lambda x, y: torch.sin(1.5 * x + 0.4) * torch.cos(y - 0.2 * x)  # noqa: E731
    points = 1 + 2 * rows(2000, 2)
    x = points.clone().requires_grad_()
    expected = wave(*x.unbind(-1))
    for _ in range(order):
        (expected,) = torch.autograd.grad(expected.sum(), x, create_graph=True)
        expected = expected[..., 0]
    errors = []
    for n in (12, 48):
        m = SPLINES[kind.split()[0]].steps
        spacing, size = 4 / (n * m), n * m + 1
        terrain = field(of(wave, (size, size), (spacing, spacing), (0, 0)), kind, spacing, (0, 0))
        jet = terrain.jet(points, order)
        own = (jet[0], *(d[..., 0] for d in jet[1:2]), *(d[..., 0, 0] for d in jet[2:]))[order]
        errors.append(float((own - expected.detach()).square().mean().sqrt()))
    return math.log(errors[0] / errors[1], 4)


@every_kind
def test_errors_fall_with_the_declared_order(kind: str):
    assert falling(kind, 0) == pytest.approx(ORDERS[kind], abs=0.1)


def test_slopes_and_curvatures_of_c1_fall_with_orders_three_and_two():
    assert falling("c1", 1) == pytest.approx(3, abs=0.1)
    assert falling("c1", 2) == pytest.approx(2, abs=0.1)


@every_kind
def test_derivatives_of_jets_are_those_of_finite_differences(kind: str):
    """In heights and points, twice; the jet's own rows among them."""
    heights, points = rows(2, 3).requires_grad_(), places(2, (2, 3)).requires_grad_()
    terrain = lambda h, p, order: field(h, kind).jet(p, order)  # noqa: E731
    assert torch.autograd.gradcheck(lambda h, p: terrain(h, p, 2), (heights, points))
    assert torch.autograd.gradgradcheck(lambda h, p: terrain(h, p, 1), (heights, points), fast_mode=True)


@every_kind
def test_float32_keeps_the_digits_that_heights_do_not_share(kind: str):
    """Of heights about 3000, with steps of 1: coordinates in millions, and derivatives of differences."""
    heights = (3000 + rows(30, 30)).float()
    points = places(300, (30, 30)).float()
    single = field(heights, kind).jet(points, 2)
    double = field(heights.double(), kind).jet(points.double(), 2)
    for own, other, near in zip(single, double, (4e-4, 1e-4, 3e-3), strict=True):
        torch.testing.assert_close(own.double(), other, rtol=0, atol=near)


@pytest.mark.parametrize("dtype", [torch.uint8, torch.float16, torch.uint16])
def test_heights_are_read_as_they_are_stored(dtype):
    heights, points = (200 * rows(9, 8)).to(dtype), places(50, (9, 8))
    assert torch.equal(field(heights, "c1").jet(points)[0], field(heights.double(), "c1").jet(points)[0])
    assert field(heights, "c1").jet(points.float())[0].dtype is torch.float32


def test_many_grids_and_numpy():
    heights, points = rows(3, 6, 7), places(20, (6, 7)).reshape(5, 4, 2)
    each = torch.stack([points + 0.01 * n for n in range(3)])
    together = field(heights, "c1").jet(each, 2)
    for n in range(3):
        alone = field(heights[n].numpy(), "c1").jet(each[n].numpy(), 2)
        assert all(torch.equal(own[n], other) for own, other in zip(together, alone, strict=True))
    assert field(heights, "c1").patches(torch.tensor([[0, 0], [1, 1]])).shape == (3, 2, 2, 15)
    assert field(heights[0], "c1").jet(torch.zeros(0, 2))[1].shape == (0, 2)


def test_in_space_it_is_the_zero_of_height_above_ground():
    terrain, points = field(rows(6, 7), "c1"), torch.cat((places(9, (6, 7)), rows(9, 1)), -1)
    value, gradient, hessian = terrain.jet(points, 2)
    z, slope, bend = terrain.jet(points[:, :2], 2)
    assert torch.equal(value, points[:, 2] - z)
    assert torch.equal(gradient, torch.cat((-slope, torch.ones(9, 1, dtype=F64)), -1))
    assert torch.equal(hessian[:, :2, :2], -bend)
    assert not hessian[:, 2].any()
    assert not hessian[:, :, 2].any()


@every_kind
@every_diagonal
def test_a_hole_is_every_patch_that_needs_what_is_missing_and_no_other(kind: str, diagonal: str):
    m = SPLINES[kind.split()[0]].steps
    size, (column, row) = (5 * m if m > 1 else 10) + 1, (2 * m + 1, 2 * m) if m > 1 else (6, 5)
    heights = rows(size, size)
    heights[row, column] = torch.nan
    terrain = field(heights, kind, 1.0, (0, 0), nan="propagate", diagonal=diagonal)
    oracle = Oracle(heights.nan_to_num(), kind, diagonal=diagonal)
    cells = torch.cartesian_prod(*(torch.arange(n) for n in terrain.cells))
    every = [(tuple(cell), up) for cell in cells.tolist() for up in (True, False)]
    expected = torch.tensor([(column, row) in {(int(a), int(b)) for a, b in oracle.read_at(*one)} for one in every])
    assert 0 < int(expected.sum()) < len(every)
    middles = torch.from_numpy(np.array([oracle.corners(*one).mean(0) for one in every]))
    for found in (terrain.patches(cells).flatten(0, 1), *terrain.jet(middles, 2)):
        missing = found.isnan().reshape(len(every), -1)
        assert torch.equal(missing.any(1), expected)
        assert torch.equal(missing.all(1), expected)


def test_beside_holes_derivatives_are_finite():
    heights, points = rows(20, 20), places(200, (20, 20)).requires_grad_()
    heights[10, 10] = torch.nan
    heights.requires_grad_()
    z, slope = field(heights, "c1", nan="propagate").jet(points)
    hole = z.isnan()
    assert 0 < int(hole.sum()) < 200
    total = torch.where(hole, 0, z).sum() + torch.where(hole[:, None], 0, slope).sum()
    assert all(bool(x.isfinite().all()) for x in torch.autograd.grad(total, (heights, points)))


def test_what_is_missing_is_refused_or_filled():
    heights = rows(8, 8)
    heights[3, 4], heights[0, 0] = torch.nan, torch.inf
    with pytest.raises(ValueError, match="got 2 of 64 that are not: nan='fill'"):
        field(heights, "c1")
    filled = field(heights, "c1", nan="fill")
    assert bool(filled.heights.isfinite().all())
    assert torch.equal(filled.heights[4:], heights[4:])
    assert bool(field(heights, "c1", nan="propagate").heights[0, 0].isnan())
    with pytest.raises(ValueError, match="at least one finite height"):
        field(torch.full((3, 3), torch.nan), "c1", nan="fill")


def test_the_domain_holds_the_surface():
    for kind in KINDS:
        terrain = field(rows(9, 12), kind)
        domain = terrain.domain
        assert (domain.lower[:2], domain.upper[:2]) == ((3.0, 0.0), (8.5, 2.0))
        z = terrain.jet(places(500, (9, 12), beyond=0))[0]
        assert domain.lower[2] <= float(z.min())
        assert float(z.max()) <= domain.upper[2]
    terrain = field(rows(1, 1), "c1")
    assert (terrain.domain.lower[:2], terrain.domain.upper[:2], terrain.cells) == ((3.0, 1.75), (3.5, 2.0), (1, 1))


def test_points_at_infinity_have_no_height():
    points = torch.tensor([[torch.inf, 1.0], [torch.nan, 1.0], [1.0, -torch.inf], [3.5, 1.5]])
    z = field(rows(9, 9), "c1").jet(points)[0]
    assert z.isnan().tolist() == [True, True, True, False]


def test_what_is_refused():
    good = rows(4, 4)
    for wrong, told in (
        ((good[0],), r"shape \(H, W\) or \(N, H, W\), of at least one; got \(4,\)"),
        ((good[:0],), r"of at least one; got \(0, 4\)"),
        ((good, "c3"), "unknown spline 'c3'"),
        ((good, "c1", 0.0), "spacing must not be 0"),
        ((good, "c1", (1.0, 2.0, 3.0)), "spacing must be two finite numbers"),
        ((good, "c1", 1.0, (0.0, math.nan)), "origin must be two finite numbers"),
    ):
        with pytest.raises(ValueError, match=told):
            HeightField(*wrong)
    for options, told in (
        ({"diagonal": "left"}, "diagonal must be one of main, anti; got 'left'"),
        ({"boundary": "round"}, "boundary must be one of"),
        ({"prefilter": True}, "the prefilter is that of the spline c2; got c1"),
        ({"nan": "keep"}, "nan must be one of refuse, propagate, fill"),
    ):
        with pytest.raises(ValueError, match=told):
            HeightField(good, **options)
    for wrong in ([[1.0]], torch.zeros(2, 2, dtype=torch.bool), torch.zeros(2, 2, dtype=torch.complex64)):
        with pytest.raises(TypeError, match=r"heights must be a torch.Tensor or NumPy array of real numbers; got"):
            HeightField(wrong)  # type: ignore[arg-type]
    terrain = HeightField(good)
    with pytest.raises(ValueError, match=r"points must have shape \(..., 2\): x, y, or"):
        terrain.jet(torch.zeros(4))
    with pytest.raises(TypeError, match="points must be a real"):
        terrain.jet("here")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="order"):
        terrain.jet(torch.zeros(4, 2), 3)
    with pytest.raises(ValueError, match=r"cells must be int64 of shape \(..., 2\); got torch.float32 \(4, 2\)"):
        terrain.patches(torch.zeros(4, 2))
    with pytest.raises(ValueError, match=r"points of 2 grids have shape \(N, ..., 2\)"):
        HeightField(rows(2, 4, 4)).jet(torch.zeros(3, 2))
