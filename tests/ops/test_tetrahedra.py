"""Sums of splines on tetrahedra: each implementation against plain torch as fields evaluate it, and their adjoints."""

from __future__ import annotations

import math
from itertools import cycle, product

import pytest
import torch
from torch import Tensor

import filterlab as fl
from filterlab import ops
from filterlab.fields.ranges import ranges
from filterlab.methods import METHODS, Tetrahedral
from filterlab.ops import TetrahedralStencil
from filterlab.ops.differentiable import operators
from filterlab.surfaces import LevelSet
from tests.laws import assert_close

SPLINES = {name: method.spline for name, method in METHODS.items() if isinstance(method, Tetrahedral)}
every_spline = pytest.mark.parametrize("name", SPLINES)
START = -5
TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-12}  # of the largest value
STORED = [torch.float16, torch.bfloat16, torch.uint8, torch.int8, torch.int16, torch.int32, torch.float64]


def stencil_of(name: str, order: int) -> TetrahedralStencil:
    return TetrahedralStencil(SPLINES[name].lowered, tuple(range(order + 1)))


def random(*shape: int, dtype: torch.dtype = torch.float64, seed: int = 0) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64).to(dtype)


def points(count: int, dtype: torch.dtype = torch.float64, entries: int = 1) -> Tensor:
    """In a domain of 5 × 6 × 7 voxels; some on faces, edges and vertices of both partitions."""
    size = torch.tensor([7.0, 6.0, 5.0], dtype=torch.float64)
    p = random(entries, count, 3, seed=1) * size - 0.5
    p[:, ::3] = (4 * p[:, ::3]).round() / 4
    return p.to(dtype)


def padded(entries: int = 1, channels: int = 1, dtype: torch.dtype = torch.float64) -> Tensor:
    return random(entries, channels, 15, 16, 17, dtype=dtype)


# ---- values


@every_spline
@pytest.mark.parametrize("implementation", ["reference", "cpu"])
def test_rows_are_those_of_the_field(name, implementation):
    """Beyond the ends of a volume samples go on as the padding does: the field in plain torch folds them itself."""
    volume = random(5, 6, 7)
    coefficients = volume[None, None]
    for dim in (-3, -2, -1):
        coefficients = fl.Boundary.MIRROR.extend(coefficients, dim, -START, -START)
    field = fl.reconstruct(volume, name, prefilter=False, scheme="direct")
    for dtype, tolerance in ((torch.float64, 1e-13), (torch.float32, 2e-6)):
        p = points(200, dtype)
        for order in range(3):
            rows = ops.gather(coefficients.to(dtype), p, stencil_of(name, order), START, implementation)
            jet = field.jet(p[0].double(), order)
            assert_close(rows[0, 0, 0].double(), jet[0], tolerance, 1.0)
            if order:
                assert_close(rows[0, 0, 1:4].T.double(), jet[1], tolerance, 8.0)
            inner = (p[0].double() * 4 % 1 != 0).all(-1)  # second derivatives jump on faces
            if order == 2:
                hessian = rows[0, 0, [4, 5, 6, 5, 7, 8, 6, 8, 9]].T.reshape(-1, 3, 3)
                assert_close(hessian[inner].double(), jet[2][inner], tolerance, 64.0)


@every_spline
def test_programs_equal_plain_torch_and_are_adjoint(name, device):
    """Triton in the interpreter, vector code on the CPU; derivatives of every order that a jet may be asked for."""
    orders = (0, 1), (0, 1, 2), (1, 2), (2, 3)
    for implementation in ("cuda",) if device == "cuda" else ("cuda", "cpu"):
        chosen = orders if implementation == "cpu" else orders[::3]
        cases = product(chosen, TOLERANCE)
        if device == "cpu":  # the interpreter takes its time, and so does compiling: the types by turns
            cases = zip(chosen, cycle(TOLERANCE), strict=False)
        for own, dtype in cases:
            stencil, tolerance = TetrahedralStencil(SPLINES[name].lowered, own), TOLERANCE[dtype]
            x, p = padded(2, 2, dtype).to(device), points(21, dtype, 2).to(device)
            expected = ops.gather(x, p, stencil, START)
            rows = ops.gather(x, p, stencil, START, implementation)
            scale = max(float(expected.abs().max()), 4.0 ** max(own))
            assert_close(rows, expected, tolerance, scale)
            y = random(*rows.shape, dtype=dtype, seed=3).to(device) - 0.5
            spread = ops.scatter(y, p, stencil, x.shape[2:], START, implementation)
            assert_close(spread, ops.scatter(y, p, stencil, x.shape[2:], START), 4 * tolerance, 8 * scale)
            difference = float((rows * y).sum() - (x * spread).sum())
            assert abs(difference) <= tolerance * float(rows.norm() * y.norm()) + 1e-12


@every_spline
@pytest.mark.parametrize("stored", STORED, ids=str)
def test_coefficients_are_converted_when_read(name, stored):
    values = ((padded() - (0 if stored == torch.uint8 else 0.5)) * 100).to(stored)
    for dtype, tolerance in TOLERANCE.items():
        p, stencil = points(30, dtype), stencil_of(name, 1)
        expected = ops.gather(values, p, stencil, START)
        assert_close(ops.gather(values, p, stencil, START, "cpu"), expected, tolerance, 100.0)


@every_spline
def test_points_that_are_nowhere_and_far_away(name):
    """NaN stays NaN, adds nothing, and no point reads beyond the array: what lies there would be seen."""
    far = [1e30, -1e30, 0], [-40, 60, 3], [3, 2, -22], [3, 2, 25]
    p = torch.tensor([[math.nan, 1, 1], [1, math.inf, 1], *far], dtype=torch.float64)[None]
    room = torch.full((15 + 64, 16, 17), math.nan, dtype=torch.float64)
    room[32:47] = padded()[0, 0]
    inside = room[32:47][None, None]  # lies together: it is read in place
    for implementation in ("reference", "cpu"):
        for order in range(3):
            rows = ops.gather(inside, p, stencil_of(name, order), START, implementation)[0, 0]
            assert bool(rows[:, :2].isnan().all())
            assert bool(rows[:, 2:].isfinite().all())
        spread = ops.scatter(torch.ones_like(rows)[None, None, :, :2], p[:, :2], stencil_of(name, 2), (15, 16, 17))
        assert float(spread.abs().sum()) == 0


# ---- derivatives


@every_spline
@pytest.mark.parametrize("implementation", ["reference", "cpu"])
def test_derivatives(name, implementation):
    """In coefficients and points, twice, backwards and forwards; points keep away from faces."""
    x = padded()[:, :, :9, :9, :9].clone().requires_grad_()
    p = torch.tensor([[[0.31, 0.17, -0.08], [1.2, 0.55, 0.83]]], dtype=torch.float64, requires_grad=True)
    stencil = stencil_of(name, 1)

    def rows(x: Tensor, p: Tensor) -> Tensor:
        return ops.gather(x, p, stencil, -4, implementation)

    assert torch.autograd.gradcheck(rows, (x, p), check_forward_ad=True, fast_mode=True)
    assert torch.autograd.gradgradcheck(rows, (x, p), fast_mode=True)


@every_spline
def test_transforms_and_compiled_graphs(name):
    x, p, stencil = padded(), points(10), stencil_of(name, 1)
    many = torch.stack((p, p + 0.25))
    mapped = torch.vmap(lambda own: ops.gather(x, own, stencil, START, "cpu"))(many)
    assert_close(mapped[1], ops.gather(x, many[1], stencil, START), 1e-12)
    torch._dynamo.reset()
    whole = torch.compile(lambda q: ops.gather(x, q, stencil, START, "cpu"), fullgraph=True, backend="eager")
    assert torch.equal(whole(p), ops.gather(x, p, stencil, START, "cpu"))
    assert operators.stencil_of(operators.stencil_text(stencil)) == stencil


@every_spline
def test_fused_fields_are_the_direct_ones_inside_and_out(name):
    """With derivatives by samples and points that lie in the domain, beyond it, and nowhere."""
    volume, p = random(2, 2, 5, 6, 7).requires_grad_(), points(40, entries=2) + 0.01 * random(2, 40, 3, seed=6)
    p[:, ::5] = 20 * p[:, ::5] - 30
    p[:, 1] = math.nan
    found = []
    for scheme in ("fused", "direct"):
        own = p.clone().requires_grad_()
        field = fl.reconstruct(volume, name, scheme=scheme, boundary="reflect")
        value, gradient = field.jet(own, 1)
        total = (value.nan_to_num() ** 2).sum() + gradient.nan_to_num().sum()
        found.append((value.detach(), gradient.detach(), *torch.autograd.grad(total, (volume, own))))
    for fused, direct in zip(*found, strict=True):
        assert torch.equal(fused.isnan(), direct.isnan())
        assert_close(fused.nan_to_num(), direct.nan_to_num(), 1e-11, float(direct.nan_to_num().abs().max()))


# ---- level sets


@every_spline
@pytest.mark.parametrize("storage", ["float64", "int16"])
def test_bounds_of_cubes_leave_no_piece_out(name, storage):
    """Pieces of rays lie between the bounds of the cubes that they are in."""
    field = fl.reconstruct(random(5, 6, 7), name, storage=storage)
    found = ranges(field.lattice, 2)
    o, d = points(60)[0] - 20 * random(60, 3, seed=5), random(60, 3, seed=5)
    pieces = field.pieces_along(o, d)
    middle = pieces.start[pieces.ray] + (pieces.near + pieces.far) / 2
    cube = (o[pieces.ray] + middle[:, None] * d[pieces.ray] + 0.5).floor().long()
    x, y, z = cube.minimum(torch.tensor([6, 5, 4])).clamp_min(0).unbind(-1)
    low, high = found.codes.least(found.low[z, y, x]), found.codes.most(found.high[z, y, x])
    least, most = pieces.coefficients.aminmax(dim=-1)
    assert len(x) > 500
    assert bool(((low <= least + 1e-9) & (most <= high + 1e-9)).all())


@every_spline
@pytest.mark.parametrize("boundary", list(fl.Boundary))
def test_the_program_hits_what_plain_torch_hits(name, boundary):
    o = points(300)[0] + (random(300, 3, seed=7) - 0.5).round() * 12
    d = points(300)[0].flip(0) - o
    d[::4] = d[::4].sign() * (random(75, 3, seed=8) > 0.4)
    d[(d == 0).all(-1)] = 1.0
    volume = random(5, 6, 7, seed=9)
    for level in (0.3, 0.55):
        fused, direct = (fl.reconstruct(volume, name, boundary=boundary, scheme=s) for s in ("fused", "direct"))
        t, expected = (f.first_crossing(o, d, level) for f in (fused, direct))
        assert torch.equal(t.isinf(), expected.isinf())
        hit = t.isfinite()
        assert 0.3 < float(hit.double().mean()) < 1
        assert float((t - expected)[hit].abs().max()) < 1e-10
        every = [LevelSet(f, level).hits(o, d, 6).t for f in (fused, direct)]
        assert torch.equal(every[0].isinf(), every[1].isinf())
        assert float((every[0] - every[1])[every[0].isfinite()].abs().max()) < 1e-8
