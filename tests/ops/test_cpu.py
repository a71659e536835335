"""The fused CPU implementation against the reference, and the laws that tie jet, splat and their derivatives."""

from __future__ import annotations

from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch
from torch import Tensor

from filterlab import ops
from filterlab.fields.ncrsi import NCRSI_TERMS
from filterlab.fields.tensor_product import Direct, same_kernel
from filterlab.kernels import CATMULL_ROM, CENTRAL_DIFFERENCE, KERNELS, LINEAR, TensorKernel, bspline
from filterlab.ops import Product, Stencil, cpu
from filterlab.ops.cpu import gather as fused
from filterlab.ops.differentiable.gather import gradient_to_points
from filterlab.ops.gather import MAX_ORDER
from filterlab.ops.reference import gather as reference
from tests.laws import assert_close

SHAPE = (9, 8, 7)
START = -2
TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-13}  # of the largest value
MIXED = {
    "ncrsi along x": (CATMULL_ROM, LINEAR, LINEAR),
    "central difference along z": (LINEAR, LINEAR, CENTRAL_DIFFERENCE),
    "5 1 6": (bspline(4), bspline(0), bspline(5)),
    "2 6 3": (LINEAR, bspline(5), bspline(2)),
}
SETTINGS = [(0, torch.float32), (1, torch.float64), (2, torch.float32), (3, torch.float64)]


def by_turns(names: Iterable[str]) -> list[tuple[str, int, torch.dtype]]:
    """Each name with both types, each order with every other name: a program takes a fifth of a second to compile."""
    return [(name, *SETTINGS[(i + j) % 4]) for i, name in enumerate(names) for j in (0, 1)]


STORED = [
    torch.float32,
    torch.float64,
    torch.float16,
    torch.bfloat16,
    torch.uint8,
    torch.int8,
    torch.int16,
    torch.int32,
]


def some_points(n: int, m: int, dtype: torch.dtype) -> Tensor:
    """Inside and up to three voxels outside."""
    return torch.rand((n, m, 3), dtype=dtype) * 13 - 5


def assert_same(actual: Tensor, expected: Tensor) -> None:
    assert actual.dtype == expected.dtype
    scale = float(expected.abs().max()) if expected.numel() else 1.0
    assert_close(actual, expected, TOLERANCE[actual.dtype], scale + 1e-30)


def assert_jet_and_splat_agree(kernels, order: int, dtype: torch.dtype, n=2, c=2, m=45) -> None:
    points = some_points(n, m, dtype)
    coefficients = torch.randn((n, c, *SHAPE), dtype=dtype)
    expected = ops.jet(coefficients, points, kernels, order, START)
    assert_same(ops.jet(coefficients, points, kernels, order, START, "cpu"), expected)
    cotangents = torch.randn_like(expected)
    assert_same(
        ops.splat(cotangents, points, kernels, order, SHAPE, START, "cpu"),
        ops.splat(cotangents, points, kernels, order, SHAPE, START),
    )


@pytest.mark.parametrize(("name", "order", "dtype"), by_turns(KERNELS))
def test_equals_the_reference(name: str, order: int, dtype: torch.dtype) -> None:
    assert_jet_and_splat_agree((KERNELS[name],) * 3, order, dtype)


@pytest.mark.parametrize(("name", "order", "dtype"), by_turns(MIXED))
def test_a_kernel_per_axis(name: str, order: int, dtype: torch.dtype) -> None:
    assert_jet_and_splat_agree(MIXED[name], order, dtype)


SUMS = {
    "ncrsi, central": Direct(NCRSI_TERMS, "fused", "central").stencils[1],
    "ncrsi, analytic": Direct(NCRSI_TERMS, "fused").stencils[2],
    "trilinear, central": Direct(same_kernel(LINEAR), "fused", "central").stencils[1],
    "holes": Stencil(
        (
            (Product((CENTRAL_DIFFERENCE, LINEAR, CATMULL_ROM), (0, 1, 2), -0.5), Product((LINEAR,) * 3, (2, 0, 0))),
            (Product((LINEAR, CATMULL_ROM, LINEAR), (1, 2, 0)), Product((LINEAR, CATMULL_ROM, LINEAR), (1, 2, 0), 2.0)),
            (Product((LINEAR,) * 3, (2, 0, 0)),),
        )
    ),
}


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("name", SUMS)
def test_sums_of_products(name: str, dtype: torch.dtype) -> None:
    stencil = SUMS[name]
    for s in (stencil, stencil.derivatives[0]):
        if s.order > MAX_ORDER:
            continue
        points, coefficients = some_points(2, 45, dtype), torch.randn((2, 2, *SHAPE), dtype=dtype)
        expected = ops.gather(coefficients, points, s, START)
        assert_same(ops.gather(coefficients, points, s, START, "cpu"), expected)
        cotangents = torch.randn_like(expected)
        spread = ops.scatter(cotangents, points, s, SHAPE, START)
        assert_same(ops.scatter(cotangents, points, s, SHAPE, START, "cpu"), spread)
        assert_close((spread * coefficients).sum(), (cotangents * expected).sum(), TOLERANCE[dtype] * 1e3)


def test_a_sum_of_products_is_the_sum_of_their_jets() -> None:
    """The reference against itself, term by term; inside, as a wider support extrapolates from elsewhere."""
    points, coefficients = torch.rand(1, 45, 3).double() * 4 - 1, torch.randn((1, 1, *SHAPE), dtype=torch.float64)
    for row, total in enumerate(ops.gather(coefficients, points, SUMS["ncrsi, analytic"], START).unbind(2)):
        orders = ops.multi_indices(2)[row]
        terms = [
            t.weight * ops.jet(coefficients, points, t.kernels, 2, START)[:, :, ops.multi_indices(2).index(orders)]
            for t in NCRSI_TERMS
        ]
        assert_close(total, torch.stack(terms).sum(0), 1e-13, 10)


def test_ncrsi_reads_32_coefficients() -> None:
    """Its 4×4×4 block has 32 corners and edges without a weight; what stands there does not matter, NaN included."""
    stencil, points = SUMS["ncrsi, central"], torch.full((1, 8, 3), 1.5, dtype=torch.float64)
    read = ops.scatter(torch.randn(1, 1, 4, 8, dtype=torch.float64), points, stencil, (4, 4, 4), 0, "cpu") != 0
    assert int(read.sum()) == 32
    coefficients = torch.where(read, torch.randn(1, 1, 4, 4, 4, dtype=torch.float64), torch.nan)
    assert ops.gather(coefficients, points, stencil, 0, "cpu").isfinite().all()


def test_supports_of_both_parities_do_not_mix() -> None:
    with pytest.raises(
        ValueError, match=r"supports along y must all be even or all be odd; got bspline2 \(3\), linear \(2\)"
    ):
        Stencil(((Product((LINEAR, bspline(2), LINEAR)),), (Product((LINEAR,) * 3),)))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("m", [0, 1, 7, 8, 9, 127, 128, 129, 1000])
def test_any_number_of_points(m: int, dtype: torch.dtype) -> None:
    assert_jet_and_splat_agree((bspline(2),) * 3, 1, dtype, n=3, c=2, m=m)


@pytest.mark.parametrize("support", [2, 3, 5])
@pytest.mark.parametrize("stored", STORED, ids=str)
def test_coefficients_are_converted_when_read(stored: torch.dtype, support: int) -> None:
    """Every pair of what is stored, what is computed in, and a support."""
    dtype = (torch.float32, torch.float64)[(STORED.index(stored) + support // 2) % 2]
    kernels = (bspline(support - 1),) * 3
    values = torch.randn((1, 1, *SHAPE)) * 60
    coefficients = (values.abs() if stored == torch.uint8 else values).to(stored)
    points = some_points(1, 20, dtype)
    expected = ops.jet(coefficients, points, kernels, 0, START)
    assert_same(ops.jet(coefficients, points, kernels, 0, START, "cpu"), expected)


def test_extreme_integers_survive() -> None:
    for stored in (torch.uint8, torch.int8, torch.int16, torch.int32):
        info = torch.iinfo(stored)
        coefficients = torch.tensor([info.min, info.max], dtype=stored).repeat(4).reshape(1, 1, 2, 2, 2)
        points = torch.tensor([[[0.0, 0, 0], [1, 1, 1]]], dtype=torch.float64)
        values = ops.jet(coefficients, points, LINEAR, 0, implementation="cpu")
        assert values.flatten().tolist() == [info.min, info.max]


def test_views_are_read_in_place_or_copied_never_misread() -> None:
    base = torch.randn(2, 3, *SHAPE, dtype=torch.float64)
    points = some_points(2, 11, torch.float64)
    views = {
        "every other channel": base[:, ::2],
        "one volume for both entries": base[:1].expand(2, -1, -1, -1, -1),
        "cropped": base[:, :, 1:-1, 1:-1, 1:-1],
        "transposed": base.transpose(2, 4),
        "channels last": base.contiguous(memory_format=torch.channels_last_3d),
        "negated lazily": torch._neg_view(base),
    }
    for name, view in views.items():
        expected = ops.jet(view, points, (bspline(2),) * 3, 1, START)
        assert torch.allclose(ops.jet(view, points, bspline(2), 1, START, "cpu"), expected, atol=1e-12), name
    shared = points[:1].expand(2, -1, -1)
    strided = torch.randn(2, 11, 6, dtype=torch.float64)[..., ::2]
    for p in (shared, strided):
        expected = ops.jet(base, p, (bspline(2),) * 3, 1, START)
        assert_same(ops.jet(base, p, bspline(2), 1, START, "cpu"), expected)
        cotangents = torch.randn_like(expected).transpose(2, 3).contiguous().transpose(2, 3)
        spread = ops.splat(cotangents, p, bspline(2), 1, SHAPE, START, "cpu")
        assert_same(spread, ops.splat(cotangents, p, (bspline(2),) * 3, 1, SHAPE, START))


@pytest.mark.parametrize(
    ("name", "dtype"),
    [("linear", torch.float32), ("bspline0", torch.float64), ("bspline2", torch.float32), ("bspline5", torch.float64)],
)
def test_nan_and_infinite_points_give_nan_and_leave_their_neighbours_alone(name: str, dtype: torch.dtype) -> None:
    coefficients = torch.randn((1, 1, *SHAPE), dtype=dtype)
    good = some_points(1, 16, dtype)
    clean = ops.jet(coefficients, good, KERNELS[name], 2, START, "cpu")
    for i, bad in enumerate((float("nan"), float("inf"), -float("inf"))):
        points = good.clone()
        points[0, 5, i] = bad
        jet = ops.jet(coefficients, points, KERNELS[name], 2, START, "cpu")
        assert jet[..., 5].isnan().all()
        others = torch.arange(16) != 5
        assert torch.equal(jet[..., others], clean[..., others])


@pytest.mark.parametrize("sorting", [False, True])
@pytest.mark.parametrize("m", [16, 17, 45])  # sorting needs a pack of points: 16 floats with AVX-512
@pytest.mark.parametrize("name", ["quadratic", "ncrsi, central", "trilinear, central"])
def test_pull_is_the_adjoint_to_the_points(name: str, m: int, sorting: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fused, "_sorting_pays", lambda *_: sorting)
    stencil = SUMS.get(name) or Stencil.jet(bspline(2), 1)
    for dtype in (torch.float32, torch.float64):
        coefficients, points = torch.randn(2, 3, *SHAPE, dtype=dtype), some_points(2, m, dtype)
        cotangents = torch.randn(2, 3, len(stencil.rows), m, dtype=dtype)
        raised = ops.gather(coefficients, points, stencil.derivatives[0], START)
        expected = gradient_to_points(raised, cotangents, stencil)
        assert_same(fused.pull(coefficients, points, cotangents, stencil, START), expected)
    assert fused.pull(coefficients, points[:, :0], cotangents[..., :0], stencil, START).shape == (2, 0, 3)


@pytest.mark.parametrize("implementation", ["reference", "cpu"])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_nan_and_infinite_points_add_nothing(dtype: torch.dtype, implementation: str) -> None:
    for i, bad in enumerate((float("nan"), float("inf"), -float("inf"))):
        points, keep = some_points(1, 16, dtype), torch.arange(16) != 5
        points[0, 5, i] = bad
        coefficients = torch.randn(1, 1, *SHAPE, dtype=dtype, requires_grad=True)
        at = points.clone().requires_grad_()
        ops.jet(coefficients, at, bspline(2), 1, START, implementation).sum().backward()
        others = torch.ones(1, 1, 4, 15, dtype=dtype)
        expected = ops.splat(others, points[:, keep], bspline(2), 1, SHAPE, START)
        assert coefficients.grad is not None
        assert at.grad is not None
        assert_same(coefficients.grad, expected)
        assert at.grad[0, 5].isnan().all()
        assert at.grad[0, keep].isfinite().all()


@pytest.mark.parametrize("far", [100.0, 1e4, -1e4])
def test_far_points_are_extrapolated_like_the_reference(far: float) -> None:
    coefficients = torch.randn((1, 1, *SHAPE), dtype=torch.float64)
    points = torch.full((1, 3, 3), far, dtype=torch.float64)
    points[0, 1, 0] = points[0, 2, 1] = 3.25
    expected = ops.jet(coefficients, points, (bspline(2),) * 3, 1, START)
    actual = ops.jet(coefficients, points, bspline(2), 1, START, "cpu")
    assert torch.allclose(actual, expected, rtol=1e-12, atol=0)


def test_float32_points_keep_their_digits_whatever_the_start() -> None:
    coefficients = torch.randn((1, 1, *SHAPE), dtype=torch.float64)
    points = torch.rand((1, 50, 3)) * 3 + 2
    points[..., 0] = torch.rand(50) * 1e-6  # near 0 a float32 has digits that a sum with 50 would lose
    kernels = (LINEAR,) * 3
    wide = torch.nn.functional.pad(coefficients, (50,) * 6)
    near = ops.jet(coefficients, points, kernels, 1, 0, "cpu")
    assert torch.equal(ops.jet(wide, points, kernels, 1, -50, "cpu"), near)


# --- laws -------------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "order"),
    [(name, (i + j) % 4) for i, name in enumerate(("linear", "bspline2", "bspline3", "bspline5")) for j in (1, 3)],
)
def test_splat_is_the_transpose_of_jet(name: str, order: int) -> None:
    kernel = KERNELS[name]
    points = some_points(2, 37, torch.float64)
    x = torch.randn((2, 3, *SHAPE), dtype=torch.float64)
    jet = ops.jet(x, points, kernel, order, START, "cpu")
    y = torch.randn_like(jet)
    spread = ops.splat(y, points, kernel, order, SHAPE, START, "cpu")
    assert abs((jet * y).sum() - (x * spread).sum()) <= 1e-12 * jet.norm() * y.norm()


def _differentiable(order: int):
    coefficients = torch.randn(1, 2, 5, 4, 4, dtype=torch.float64, requires_grad=True)
    points = (torch.rand(1, 3, 3, dtype=torch.float64) * 2 + 0.8).requires_grad_()
    cotangents = torch.randn(1, 2, len(ops.multi_indices(order)), 3, dtype=torch.float64, requires_grad=True)

    def jet(c: Tensor, p: Tensor) -> Tensor:
        return ops.jet(c, p, bspline(3), order, 0, "cpu")

    def splat(g: Tensor, p: Tensor) -> Tensor:
        return ops.splat(g, p, bspline(3), order, (5, 4, 4), 0, "cpu")

    return jet, (coefficients, points), splat, (cotangents, points)


@pytest.mark.parametrize("order", [0, 1])
def test_derivatives_of_first_and_second_order(order: int) -> None:
    jet, at, splat, spread_at = _differentiable(order)
    assert torch.autograd.gradcheck(jet, at, check_forward_ad=True)
    assert torch.autograd.gradcheck(splat, spread_at, check_forward_ad=True)
    for function, given in ((jet, at), (splat, spread_at)):
        assert torch.autograd.gradgradcheck(function, given, fast_mode=order > 0)


def test_derivatives_beyond_the_fused_orders() -> None:
    jet, at, *_ = _differentiable(2)
    assert torch.autograd.gradgradcheck(jet, at, fast_mode=True)  # needs the jet of order 4


def test_derivatives_stay_in_the_implementation(monkeypatch: pytest.MonkeyPatch) -> None:
    jet, at, splat, spread_at = _differentiable(1)
    for name in ("gather", "scatter"):
        monkeypatch.setattr(reference, name, lambda *a, **k: pytest.fail("the reference was asked"))
    for function, inputs in ((jet, at), (splat, spread_at)):
        first = torch.autograd.grad(function(*inputs).square().sum(), inputs, create_graph=True)
        torch.autograd.grad(sum(f.square().sum() for f in first), inputs)
        torch.func.jvp(function, tuple(i.detach() for i in inputs), tuple(torch.randn_like(i) for i in inputs))


def test_vmap_over_coefficients_points_and_both() -> None:
    c = torch.randn(4, 1, 2, *SHAPE, dtype=torch.float64)
    p = some_points(4, 9, torch.float64)[:, None]

    def jet(c: Tensor, p: Tensor) -> Tensor:
        return ops.jet(c, p, bspline(2), 1, START, "cpu")

    for dims in ((0, 0), (0, None), (None, 0)):
        a, b = (t if d == 0 else t[0] for t, d in zip((c, p), dims, strict=True))
        mapped = torch.func.vmap(jet, dims)(a, b)
        looped = torch.stack([jet(a[i] if dims[0] == 0 else a, b[i] if dims[1] == 0 else b) for i in range(4)])
        assert_same(mapped, looped)
    hessian = torch.func.hessian(lambda q: jet(c[0], q)[0, 0, 0].sum())(p[0])
    exact = ops.jet(c[0], p[0], bspline(2), 2, START)[0, 0, 4, 0]
    assert_close(hessian[0, 0, 0, 0, 0, 0], exact, 1e-12)


# --- threads ----------------------------------------------------------------------------------------------------------


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


def test_jet_does_not_depend_on_the_number_of_threads(threads) -> None:
    coefficients, points = torch.randn(2, 2, *SHAPE), some_points(2, 30_001, torch.float32)
    threads(1)
    alone = ops.jet(coefficients, points, bspline(2), 1, START, "cpu")
    for count in (2, 3, 7):
        threads(count)
        assert torch.equal(ops.jet(coefficients, points, bspline(2), 1, START, "cpu"), alone)


def test_splat_repeats_itself_and_agrees_between_numbers_of_threads(threads) -> None:
    points = some_points(2, 30_001, torch.float32)
    cotangents = torch.randn(2, 2, 4, 30_001)
    expected = ops.splat(cotangents.double(), points.double(), (bspline(2),) * 3, 1, SHAPE, START)
    for count in (1, 2, 3):
        threads(count)
        first = ops.splat(cotangents, points, bspline(2), 1, SHAPE, START, "cpu")
        for _ in range(3):
            assert torch.equal(ops.splat(cotangents, points, bspline(2), 1, SHAPE, START, "cpu"), first)
        assert_close(first, expected, 1e-5, float(expected.abs().max()))


def test_splat_keeps_to_its_memory(threads, monkeypatch: pytest.MonkeyPatch) -> None:
    threads(8)
    points, cotangents = some_points(1, 100_000, torch.float32), torch.randn(1, 1, 1, 100_000)
    volume = 4 * 9 * 8 * 7
    for limit, parts in ((0, 1), (volume, 2), (3 * volume + 5, 4), (1 << 30, 8)):
        monkeypatch.setattr(fused, "SPLAT_MEMORY", limit)
        asked = []
        run = fused.Program.divided
        monkeypatch.setattr(
            fused.Program, "divided", lambda *a, run=run, asked=asked: (asked.append(len(a[1])), run(*a))[1]
        )
        ops.splat(cotangents, points, bspline(2), 0, SHAPE, START, "cpu")
        monkeypatch.setattr(fused.Program, "divided", run)
        assert asked == [parts]


def test_callers_on_several_threads_do_not_disturb_each_other(threads) -> None:
    threads(2)
    cases = [(torch.randn(1, 1, *SHAPE), some_points(1, 20_000, torch.float32)) for _ in range(4)]
    expected = [ops.jet(c, p, bspline(3), 1, START, "cpu") for c, p in cases]
    with ThreadPoolExecutor(4) as pool:
        for _ in range(5):
            results = pool.map(lambda case: ops.jet(*case, bspline(3), 1, START, "cpu"), cases)
            assert all(torch.equal(a, b) for a, b in zip(results, expected, strict=True))


# --- where it can't run -----------------------------------------------------------------------------------------------


def test_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    c, p, k = torch.zeros(1, 1, *SHAPE), torch.zeros(1, 4, 3), bspline(2)
    value, seven = Stencil.jet(k, 0), bspline(6)
    assert cpu.missing(c, p, Stencil.jet(k, 3)) is None
    for reason, arguments in {
        "tensors of the CPU; got meta": (c.to("meta"), p, value),
        "points must be float32 or float64; got torch.float16": (c, p.half(), value),
        "got torch.int64": (c.long(), p, value),
        "fixed tables; got a TensorKernel": (c, p, Stencil.jet((k, TensorKernel("fitted", k.table()), k), 0)),
        "supports go up to 6; got 3, 7, 3": (c, p, Stencil.jet((k, seven, k), 0)),
        "orders go up to 3; got 4": (c, p, Stencil.jet(k, 4)),
        "indices along an axis must stay below 16777216": (c, p, value, None, -(1 << 24)),
    }.items():
        assert reason in (cpu.missing(*arguments) or "nothing"), reason
    with pytest.raises(ValueError, match=r"implementation 'cpu' can't run here: orders go up to 3; got 4; impl.*'ref"):
        ops.jet(c, p, k, 4, implementation="cpu")
    with pytest.raises(ValueError, match="can't run here: supports"):
        ops.splat(torch.zeros(1, 1, 1, 4), p, seven, 0, SHAPE, implementation="cpu")
    with pytest.raises(ValueError, match="implementation must be one of reference, cpu, cuda; got 'gpu'"):
        ops.jet(c, p, k, implementation="gpu")
    monkeypatch.setattr(cpu, "llvmlite_problem", lambda: "the package llvmlite can't be loaded")
    with pytest.raises(ValueError, match="llvmlite"):
        ops.jet(c, p, k, implementation="cpu")
