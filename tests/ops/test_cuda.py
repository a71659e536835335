"""The Triton implementation against the reference: in Triton's interpreter everywhere, on a GPU where there is one."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

pytest.importorskip("triton", reason="the package triton is not installed")

from filterlab import ops
from filterlab.fields.ncrsi import NCRSI_TERMS
from filterlab.fields.tensor_product import Direct, same_kernel
from filterlab.kernels import CATMULL_ROM, CENTRAL_DIFFERENCE, KERNELS, LINEAR, TensorKernel, bspline
from filterlab.ops import Product, Stencil, cuda
from filterlab.ops.cuda import gather as fused
from filterlab.ops.cuda import launch, points
from filterlab.ops.reference import gather as reference
from tests.laws import assert_close

SHAPE = (9, 8, 7)
START = -2
TOLERANCE = {torch.float32: 1e-5, torch.float64: 1e-13}  # of the largest value
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
STENCILS = {
    "linear 3": Stencil.jet(LINEAR, 3),
    "bspline0 1": Stencil.jet(bspline(0), 1),
    "bspline2 1": Stencil.jet(bspline(2), 1),
    "bspline2 2": Stencil.jet(bspline(2), 2),
    "bspline3 1": Stencil.jet(bspline(3), 1),
    "bspline5 1, in a loop over planes": Stencil.jet(bspline(5), 1),
    "5 1 6": Stencil.jet((bspline(4), bspline(0), bspline(5)), 1),
    "2 6 3": Stencil.jet((LINEAR, bspline(5), bspline(2)), 2),
    "constants in a loop": Stencil(((Product((bspline(5), bspline(5), KERNELS["mitchell"]), (0, 0, 3)),),)),
    "ncrsi, central": Direct(NCRSI_TERMS, "fused", "central").stencils[1],
    "trilinear, central": Direct(same_kernel(LINEAR), "fused", "central").stencils[1],
    "holes": Stencil(
        (
            (Product((CENTRAL_DIFFERENCE, LINEAR, CATMULL_ROM), (0, 1, 2), -0.5), Product((LINEAR,) * 3, (2, 0, 0))),
            (Product((LINEAR, CATMULL_ROM, LINEAR), (1, 2, 0)), Product((LINEAR, CATMULL_ROM, LINEAR), (1, 2, 0), 2.0)),
            (Product((LINEAR,) * 3, (2, 0, 0)),),
        )
    ),
}


@pytest.fixture(params=["interpreter", "gpu"])
def device(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch, tmp_path_factory: pytest.TempPathFactory):
    """Where tensors go; the programs run in Triton's interpreter for tensors of the CPU."""
    if request.param == "gpu" and not torch.cuda.is_available():
        pytest.skip("no GPU that torch can use")
    monkeypatch.setenv("TRITON_INTERPRET", str(int(request.param == "interpreter")))
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path_factory.getbasetemp() / "triton"))
    return "cpu" if request.param == "interpreter" else "cuda"


def some_points(n: int, m: int, dtype: torch.dtype) -> Tensor:
    """Inside and up to three voxels outside."""
    return torch.rand((n, m, 3), dtype=dtype) * 13 - 5


def assert_same(actual: Tensor, expected: Tensor) -> None:
    actual, expected = actual.detach(), expected.detach()
    assert actual.dtype == expected.dtype
    scale = float(expected.abs().max()) if expected.numel() else 1.0
    assert_close(actual, expected, TOLERANCE[actual.dtype], scale + 1e-30)


def assert_agrees(stencil: Stencil, device: str, dtype: torch.dtype, n=2, c=2, m=45) -> None:
    """gather and scatter equal the reference's, and are each other's transpose."""
    x, p = torch.randn((n, c, *SHAPE), dtype=dtype).to(device), some_points(n, m, dtype).to(device)
    expected = ops.gather(x, p, stencil, START)
    gathered = ops.gather(x, p, stencil, START, "cuda")
    assert_same(gathered, expected)
    y = torch.randn_like(expected)
    spread = ops.scatter(y, p, stencil, SHAPE, START, "cuda")
    assert_same(spread, ops.scatter(y, p, stencil, SHAPE, START))
    tolerance = (1e-12 if dtype == torch.float64 else 1e-5) * float(gathered.norm() * y.norm())
    assert abs(float((gathered * y).sum() - (x * spread).sum())) <= tolerance


@pytest.mark.parametrize("name", STENCILS)
def test_equals_the_reference(name: str, device: str) -> None:
    for i, dtype in enumerate((torch.float64, torch.float32)):
        assert_agrees(STENCILS[name], device, dtype, n=2 - i, c=2 - i)


@pytest.mark.parametrize("m", [0, 1, 128, 129])
def test_any_number_of_points(m: int, device: str) -> None:
    assert_agrees(Stencil.jet(LINEAR, 1), device, torch.float64, n=3, c=2, m=m)


@pytest.mark.parametrize("stored", STORED, ids=str)
def test_coefficients_are_converted_when_read(stored: torch.dtype, device: str) -> None:
    values = torch.randn((1, 1, *SHAPE)) * 60
    coefficients = (values.abs() if stored == torch.uint8 else values).to(stored).to(device)
    for dtype in TOLERANCE:
        p = some_points(1, 20, dtype).to(device)
        expected = ops.jet(coefficients, p, LINEAR, 1, START)
        assert_same(ops.jet(coefficients, p, LINEAR, 1, START, "cuda"), expected)


def test_extreme_integers_survive(device: str) -> None:
    for stored in (torch.uint8, torch.int8, torch.int16, torch.int32):
        info = torch.iinfo(stored)
        coefficients = torch.tensor([info.min, info.max], dtype=stored).repeat(4).reshape(1, 1, 2, 2, 2).to(device)
        p = torch.tensor([[[0.0, 0, 0], [1, 1, 1]]], dtype=torch.float64).to(device)
        values = ops.jet(coefficients, p, LINEAR, 0, implementation="cuda")
        assert values.flatten().tolist() == [info.min, info.max]


def test_views_are_read_in_place_or_copied_never_misread(device: str) -> None:
    base = torch.randn(2, 3, *SHAPE, dtype=torch.float64).to(device)
    p = some_points(2, 11, torch.float64).to(device)
    for name, view in {
        "every other channel": base[:, ::2],
        "one volume for both entries": base[:1].expand(2, -1, -1, -1, -1),
        "cropped": base[:, :, 1:-1, 1:-1, 1:-1],
        "every other slice": base[:, :, ::2],
        "transposed": base.transpose(2, 4),
        "channels last": base.contiguous(memory_format=torch.channels_last_3d),
        "negated lazily": torch._neg_view(base),
    }.items():
        expected = ops.jet(view, p, LINEAR, 1, START)
        assert torch.allclose(ops.jet(view, p, LINEAR, 1, START, "cuda"), expected, atol=1e-12), name
    for view in (p[:1].expand(2, -1, -1), torch.randn(2, 11, 6, dtype=torch.float64).to(device)[..., ::2]):
        expected = ops.jet(base, view, LINEAR, 1, START)
        assert_same(ops.jet(base, view, LINEAR, 1, START, "cuda"), expected)
        y = torch.randn_like(expected).transpose(2, 3).contiguous().transpose(2, 3)
        spread = ops.splat(y, view, LINEAR, 1, SHAPE, START, "cuda")
        assert_same(spread, ops.splat(y, view, LINEAR, 1, SHAPE, START))


@pytest.mark.parametrize("name", ["linear", "bspline0", "bspline2"])
def test_nan_and_infinite_points_give_nan_and_add_nothing(name: str, device: str) -> None:
    coefficients = torch.randn((1, 1, *SHAPE)).to(device)
    good = some_points(1, 16, torch.float32).to(device)
    clean = ops.jet(coefficients, good, KERNELS[name], 1, START, "cuda")
    bad = good.clone()
    for i, value in enumerate((math.nan, math.inf, -math.inf)):
        bad[0, 3 + 5 * i, i] = value
    with np.errstate(invalid="ignore"):
        jet = ops.jet(coefficients, bad, KERNELS[name], 1, START, "cuda")
    hit = torch.isin(torch.arange(16, device=device), torch.tensor([3, 8, 13], device=device))
    assert jet[..., hit].isnan().all()
    assert torch.equal(jet[..., ~hit], clean[..., ~hit])
    with np.errstate(invalid="ignore"):
        spread = ops.splat(torch.ones_like(jet), bad, KERNELS[name], 1, SHAPE, START, "cuda")
    others = bad[:, ~hit]
    assert_same(spread, ops.splat(torch.ones_like(jet)[..., ~hit], others, KERNELS[name], 1, SHAPE, START))


def test_far_points_are_extrapolated_like_the_reference(device: str) -> None:
    coefficients = torch.randn((1, 1, *SHAPE), dtype=torch.float64).to(device)
    p = torch.tensor([100.0, -1e4, 1e30], dtype=torch.float64)[:, None].repeat(1, 3).diag_embed()[None]
    p = torch.cat([p.flatten(1, 2), p.sum(2)], 1).to(device)
    expected = ops.jet(coefficients, p, LINEAR, 1, START)
    assert torch.allclose(ops.jet(coefficients, p, LINEAR, 1, START, "cuda"), expected, rtol=1e-12, atol=0)


def _edges(dtype: torch.dtype) -> Tensor:
    """Points whose taps are the outermost ones, and points that would have none."""
    ends = [-1e30, START - 0.5, START, START + 6.5, START + 9.0, 1e30, math.nan, math.inf, -math.inf]
    return torch.cartesian_prod(*[torch.tensor(ends, dtype=dtype)] * 3)[None]


@pytest.mark.parametrize("kernel", [LINEAR, bspline(2)], ids=lambda k: k.name)
def test_nothing_beyond_the_coefficients_is_read_or_written(kernel, device: str) -> None:
    """Coefficients between two walls: what stands in them matters to no result, and stays what it was."""
    dtype, volume, wall = torch.float64, math.prod(SHAPE), 4 * math.prod(SHAPE)
    p, stencil = _edges(dtype).to(device), Stencil.jet(kernel, 0)
    finite = (p.abs() < math.inf).all(-1)
    memory = torch.full((wall + volume + wall,), math.nan, dtype=dtype).to(device)
    walled = memory[wall : wall + volume].view(1, 1, *SHAPE)
    with np.errstate(invalid="ignore"):
        walled.fill_(1.0)
        assert torch.equal(ops.gather(walled, p, stencil, START, "cuda")[0, 0, 0].isfinite(), finite[0])
        memory.zero_()
        fused._launch("scatter", walled, p, torch.ones(1, 1, 1, p.shape[1], dtype=dtype).to(device), stencil, START)
    assert not memory[:wall].any()
    assert not memory[wall + volume :].any()
    assert walled.isfinite().all()
    assert walled.any()


def test_float32_points_keep_their_digits_whatever_the_start(device: str) -> None:
    coefficients = torch.randn((1, 1, *SHAPE), dtype=torch.float64).to(device)
    p = torch.rand((1, 50, 3)) * 3 + 2
    p[..., 0] = torch.rand(50) * 1e-6  # near 0 a float32 has digits that a sum with 50 would lose
    p = p.to(device)
    near = ops.jet(coefficients, p, LINEAR, 1, 0, "cuda")
    wide = torch.nn.functional.pad(coefficients, (50,) * 6)
    assert torch.equal(ops.jet(wide, p, LINEAR, 1, -50, "cuda"), near)


# --- derivatives ------------------------------------------------------------------------------------------------------


def _differentiable(device: str):
    """gather and scatter of a value and gradient, with inputs for each."""
    coefficients = torch.randn(1, 2, 3, 4, 3, dtype=torch.float64).to(device).requires_grad_()
    p = (torch.rand(1, 3, 3, dtype=torch.float64) + 0.6).to(device).requires_grad_()
    y = torch.randn(1, 2, 4, 3, dtype=torch.float64).to(device).requires_grad_()

    def jet(c: Tensor, p: Tensor, implementation: str = "cuda") -> Tensor:
        return ops.jet(c, p, bspline(2), 1, 0, implementation)

    def splat(y: Tensor, p: Tensor, implementation: str = "cuda") -> Tensor:
        return ops.splat(y, p, bspline(2), 1, (3, 4, 3), 0, implementation)

    return (jet, (coefficients, p)), (splat, (y, p))


def test_derivatives_of_first_and_second_order(device: str) -> None:
    for function, inputs in _differentiable(device):
        results = []
        for implementation in ("cuda", "reference"):
            value = function(*inputs, implementation)
            first = torch.autograd.grad(value.sin().sum(), inputs, create_graph=True)
            second = torch.autograd.grad(sum(f.square().sum() for f in first), inputs)
            results.append((value, *first, *second))
        for actual, expected in zip(*results, strict=True):
            assert_same(actual, expected)
        assert torch.autograd.gradcheck(function, inputs, fast_mode=True, nondet_tol=1e-12)


def test_derivatives_stay_in_the_implementation(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("gather", "scatter"):
        monkeypatch.setattr(reference, name, lambda *a, **k: pytest.fail("the reference was asked"))
    for function, inputs in _differentiable(device):
        first = torch.autograd.grad(function(*inputs).square().sum(), inputs, create_graph=True)
        torch.autograd.grad(sum(f.square().sum() for f in first), inputs)


def test_scatter_leaves_it_to_the_reference_to_be_deterministic(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fused, "_launch", lambda *a: pytest.fail("atomic additions were launched"))
    y, p = torch.ones(1, 1, 1, 4).to(device), torch.zeros(1, 4, 3).to(device)
    torch.use_deterministic_algorithms(True)
    try:
        spread = ops.splat(y, p, LINEAR, 0, SHAPE, START, "cuda")
    finally:
        torch.use_deterministic_algorithms(False)
    assert torch.equal(spread, ops.splat(y, p, LINEAR, 0, SHAPE, START))


# --- compilation, and where it can't run ------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("name", "operation", "taps"),
    [
        ("bspline2 1", "scatter", 27),
        ("constants in a loop", "gather", 36),
        ("ncrsi, central", "gather", 32),
    ],
)
def test_compiles_for_a_gpu_that_need_not_be_there(name, operation, taps, monkeypatch, tmp_path) -> None:
    """The interpreter takes what the compiler would refuse; machine code needs no GPU to be made."""
    from triton.backends.compiler import GPUTarget  # pyright: ignore[reportMissingImports]
    from triton.compiler import ASTSource, compile  # pyright: ignore[reportMissingImports]

    monkeypatch.setenv("TRITON_INTERPRET", "0")
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    stencil = STENCILS[name].lowered
    program = launch.launchable(getattr(points, operation)(stencil))
    types = {"coefficients": "*fp64", "points": "*fp64", "rows": "*fp64", "BLOCK": "constexpr"}
    signature = {p.name: types.get(p.name, "i32") for p in program.params}
    made = compile(ASTSource(program, signature, {"BLOCK": fused.BLOCK}), target=GPUTarget("cuda", 80, 32))
    lines = [line for line in made.asm["ptx"].splitlines() if ".global" in line]
    loads, additions = (sum(word in line for line in lines) for word in ("ld.global", "atom.global"))
    rows = len(stencil.rows)
    assert (loads, additions) == ((3 + taps, 0) if operation == "gather" else (3 + rows, taps))


def test_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    c, p, k = torch.zeros(1, 1, *SHAPE), torch.zeros(1, 4, 3), bspline(2)
    value, seven = Stencil.jet(k, 0), bspline(6)
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    assert cuda.missing(c, p, Stencil.jet(k, 3)) is None
    for reason, arguments in {
        "tensors of one device; got meta and cpu": (c.to("meta"), p, value),
        "tensors of a GPU (of the CPU with TRITON_INTERPRET=1); got meta": (c.to("meta"), p.to("meta"), value),
        "points must be float32 or float64; got torch.float16": (c, p.half(), value),
        "bfloat16, uint8, int8, int16, int32; got torch.int64": (c.long(), p, value),
        "fixed tables; got a TensorKernel": (c, p, Stencil.jet((k, TensorKernel("fitted", k.table()), k), 0)),
        "supports go up to 6; got 3, 7, 3": (c, p, Stencil.jet((k, seven, k), 0)),
        "orders go up to 3; got 4": (c, p, Stencil.jet(k, 4)),
        "indices along an axis must stay below 16777216": (c, p, value, None, -(1 << 24)),
    }.items():
        assert reason in (cuda.missing(*arguments) or "nothing"), reason
    with pytest.raises(ValueError, match=r"implementation 'cuda' can't run here: orders go up to 3; got 4; impl.*'ref"):
        ops.jet(c, p, k, 4, implementation="cuda")
    with pytest.raises(ValueError, match="can't run here: supports"):
        ops.splat(torch.zeros(1, 1, 1, 4), p, seven, 0, SHAPE, implementation="cuda")
    monkeypatch.setenv("TRITON_INTERPRET", "0")
    with pytest.raises(ValueError, match=r"tensors of a GPU \(of the CPU with TRITON_INTERPRET=1\); got cpu"):
        ops.jet(c, p, k, implementation="cuda")
    monkeypatch.setattr(cuda, "_triton_problem", lambda: "the package triton can't be loaded")
    with pytest.raises(ValueError, match="triton"):
        ops.jet(c, p, k, implementation="cuda")
