"""The prefilter in Triton against the reference: in Triton's interpreter everywhere, on a GPU where there is one."""

from __future__ import annotations

import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import Tensor

pytest.importorskip("triton", reason="the package triton is not installed")

from filterlab.fields.grid import Coefficients
from filterlab.kernels import bspline
from filterlab.ops import cuda
from filterlab.ops.cuda import launch
from filterlab.ops.cuda import prefilter as fused
from filterlab.ops.cuda.recursion import BLOCK, Columns, Program, Rows, steps_of
from filterlab.ops.differentiable import prefilter as op
from filterlab.ops.differentiable.drivers import driver
from filterlab.ops.differentiable.prefilter import implementation_for, missing, prefilter_axis, prefilter_samples
from filterlab.ops.gather import STORAGE
from filterlab.prefilters import PREFILTERS, Prefilter, interpolation
from filterlab.volume import Boundary
from tests import laws, oracles

FILTERS = [name for name, prefilter in PREFILTERS.items() if not prefilter.is_identity]
TOLERANCE = {torch.float32: 1e-6, torch.float64: 1e-14}  # of the largest coefficient
STEPS = steps_of(1)
LENGTHS = [1, 2, 3, STEPS - 1, STEPS, STEPS + 1, 3 * STEPS + 2]
every_boundary = pytest.mark.parametrize("boundary", Boundary)


def values(*shape: int, dtype: torch.dtype = torch.float64, device: str = "cpu") -> Tensor:
    generator = torch.Generator().manual_seed(sum(shape))
    return (torch.rand(shape, dtype=torch.float64, generator=generator) * 2 - 1).to(dtype).to(device)


def assert_same(actual: Tensor, expected: Tensor) -> None:
    assert actual.dtype == expected.dtype
    scale = float(expected.detach().abs().max()) if expected.numel() else 1.0
    laws.assert_close(actual, expected, TOLERANCE[actual.dtype], scale)


def assert_volume_agrees(x: Tensor, prefilter: str | Prefilter, boundary: str = "mirror", tail: int = 0) -> None:
    kept = x.clone()
    found = prefilter_samples(x, prefilter, boundary, tail, "cuda")
    assert found.is_contiguous()
    assert_same(found, prefilter_samples(x, prefilter, boundary, tail))
    assert torch.equal(x, kept)


# --- values -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", FILTERS)
@every_boundary
def test_equals_the_reference(name: str, boundary: Boundary, device: str) -> None:
    """Every prefilter under every boundary, along both kinds of lines."""
    cases = [((2, 3), torch.float64, 5), ((STEPS + 1, 2), torch.float32, 0)]
    if device == "cpu":  # the interpreter takes its time: one or the other
        cases = [cases[(FILTERS.index(name) + list(Boundary).index(boundary)) % 2]]
    else:
        cases += [((n, 3), dtype, tail) for n in LENGTHS for dtype in TOLERANCE for tail in (0, 1, 20)]
    for shape, dtype, tail in cases:
        x = values(*shape, dtype=dtype, device=device)
        expected = prefilter_axis(x, 0, name, boundary, tail)
        assert_same(prefilter_axis(x, 0, name, boundary, tail, "cuda"), expected)
        assert_same(prefilter_axis(x.mT.contiguous(), 1, name, boundary, tail, "cuda"), expected.mT)


@pytest.mark.parametrize("n", LENGTHS)
def test_any_length_of_a_line(n: int, device: str) -> None:
    for boundary, tail in (("mirror", 0), ("zeros", 1)):
        for shape, dim in (((n, 2), 0), ((2, n), 1)):
            x = values(*shape, device=device)
            found = prefilter_axis(x, dim, "cubic", boundary, tail, "cuda")
            assert_same(found, prefilter_axis(x, dim, "cubic", boundary, tail))


@pytest.mark.parametrize("n", [1, 2, 7])
def test_coefficients_are_the_infinite_deconvolution_tails_included(n: int, device: str) -> None:
    f, tail = values(n, 3), 9
    for boundary in ("border", "wrap"):
        matrix = oracles.coefficient_matrix(("bspline2",) * 2, boundary, n, np.arange(-tail, n + tail))
        found = prefilter_axis(f.to(device), 0, "notch", boundary, tail, "cuda")
        laws.assert_close(found, matrix @ f.numpy(), 1e-13, float(np.abs(matrix).sum(1).max()))


@pytest.mark.parametrize("shape", [(1, 2, 3), (2, BLOCK + 1, 3), (2, 2, 3, 1, 4), (3, 2, BLOCK)], ids=str)
def test_any_number_of_lines_of_a_volume_or_a_batch(shape: tuple[int, ...], device: str) -> None:
    assert_volume_agrees(values(*shape, device=device), "cubic", "border", 2)
    if device == "cuda" or math.prod(shape) < 10:
        assert_volume_agrees(values(*shape, device=device), "cubic")


@pytest.mark.parametrize("degree", [7, 9])
def test_any_number_of_poles(degree: int, device: str) -> None:
    prefilter = interpolation(bspline(degree))
    x = values(3, 4, 5, device=device)
    expected = prefilter_samples(x, prefilter)
    found = prefilter_samples(x, prefilter, implementation="cuda")
    laws.assert_close(found, expected, 1e-12, float(expected.abs().max()))


@pytest.mark.parametrize("stored", STORAGE, ids=str)
def test_samples_are_read_as_they_are_stored(stored: torch.dtype, device: str) -> None:
    x = (values(3, 4, 5) * 60 + (60 if stored == torch.uint8 else -7)).to(stored).to(device)
    assert_volume_agrees(x, "cubic", "zeros", 1)
    for dim in (0, 2):
        assert_same(prefilter_axis(x, dim, "cubic", implementation="cuda"), prefilter_axis(x, dim, "cubic"))


def test_extreme_integers_survive(device: str) -> None:
    for stored in (torch.uint8, torch.int8, torch.int16, torch.int32):
        info = torch.iinfo(stored)
        x = torch.tensor([info.min, info.max], dtype=stored).repeat(4).reshape(2, 4).to(device)
        for dim in (0, 1):
            assert_same(prefilter_axis(x, dim, "cubic", implementation="cuda"), prefilter_axis(x, dim, "cubic"))


def test_views_are_read_in_place_or_copied_never_misread(device: str) -> None:
    base = values(2, 3, 4, 5, 6, device=device)
    kept = base.clone()
    for view in (
        base[:, ::2],
        base[:1, :1].expand(2, 2, -1, -1, -1),
        base[0, :, 1:-1, 2:-1, 3:-1],
        base[0, ..., ::2],
        base[0].contiguous().permute(3, 1, 0, 2),
        base[0, 0, 0, 0, 0].expand(3, 4, 3),
        torch._neg_view(base[0, 0]),
    ):
        for dim in (-2, -1):
            found = prefilter_axis(view, dim, "cubic", "reflect", 1, "cuda")
            assert_same(found, prefilter_axis(view, dim, "cubic", "reflect", 1))
    assert torch.equal(base, kept)


def test_the_identity_only_extends(device: str) -> None:
    x = values(2, 3, 4, dtype=torch.float32, device=device)
    expected = x
    for dim in range(3):
        expected = Boundary.REFLECT.extend(expected, dim, 2, 2)
    assert torch.equal(prefilter_samples(x, "identity", "reflect", 2, "cuda"), expected)


def test_no_samples_give_no_coefficients(device: str) -> None:
    for x in (torch.zeros(0, 3, 4, 5, 6), torch.zeros(2, 0, 4, 5, 6, dtype=torch.float64)):
        c = prefilter_samples(x.to(device), "cubic", "zeros", 2, "cuda")
        assert c.shape == (*x.shape[:2], 8, 9, 10)
        assert c.dtype == x.dtype
    assert prefilter_axis(torch.zeros(4, 0).to(device), 0, "cubic", implementation="cuda").shape == (4, 0)


def test_a_nan_stays_on_its_lines(device: str) -> None:
    def along(x: Tensor, dim: int) -> Tensor:
        return prefilter_axis(x, dim, "cubic", implementation="cuda")

    laws.assert_a_nan_stays_on_its_lines(along, values(3, 4, 20, dtype=torch.float32, device=device))


def test_a_line_is_filtered_alike_wherever_it_stands(device: str) -> None:
    """Bit by bit among its neighbours."""
    line = values(19, dtype=torch.float32, device=device)
    rows = prefilter_axis(line.expand(BLOCK + 3, 19), 1, "quintic", implementation="cuda")
    columns = prefilter_axis(line[:, None].expand(19, BLOCK + 3), 0, "quintic", implementation="cuda")
    assert torch.equal(rows, rows[:1].expand_as(rows))
    assert torch.equal(columns, columns[:, :1].expand_as(columns))
    assert_same(rows[0], columns[:, 0])


@pytest.mark.parametrize("shape", [(3, STEPS + 1, 2), (3, 2, STEPS + 1)], ids=str)
def test_nothing_outside_the_arrays_is_read_or_written(shape: tuple[int, ...], device: str) -> None:
    """Samples and coefficients between two walls: what stands in them matters to no result, and stays what it was."""
    how = op.Filtering((-2,), PREFILTERS["cubic"], Boundary.ZEROS, 3)
    wall = 8 * math.prod(shape)

    def between_walls(shape: tuple[int, ...], of: float) -> tuple[Tensor, Tensor]:
        memory = torch.full((2 * wall + math.prod(shape),), of, dtype=torch.float64).to(device)
        return memory, memory[wall:-wall].view(shape)

    _, source = between_walls(shape, 1e3)
    memory, target = between_walls((shape[0], shape[1] + 6, shape[2]), math.nan)
    source.copy_(values(*shape))
    fused._launch(source, target, how)
    assert_same(target, prefilter_axis(source.clone(), 1, "cubic", "zeros", 3))
    assert memory[:wall].isnan().all()
    assert memory[-wall:].isnan().all()


# --- derivatives ------------------------------------------------------------------------------------------------------


@every_boundary
def test_derivatives_of_first_and_second_order_and_forwards(boundary: Boundary, device: str) -> None:
    x, y = (values(2, 3, 2, device=device) * factor for factor in (1.0, 0.3))
    for dim in (1, 2) if device == "cuda" else [1 + list(Boundary).index(boundary) % 2]:
        results = []
        for implementation in ("cuda", "reference"):

            def curved(x: Tensor, dim: int = dim, implementation: str = implementation) -> Tensor:
                return prefilter_axis(x, dim, "cubic", boundary, 1, implementation).pow(3).sum()

            leaf = x.clone().requires_grad_()
            (first,) = torch.autograd.grad(curved(leaf), leaf, create_graph=True)
            (second,) = torch.autograd.grad(first.square().sum(), leaf)
            results.append((first, second, torch.func.jvp(curved, (x,), (y,))[1][None]))
        for actual, expected in zip(*results, strict=True):
            laws.assert_close(actual, expected, 1e-12, float(expected.detach().abs().max()))


def test_derivatives_stay_in_the_implementation(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    asked = []
    monkeypatch.setattr(op.reference, "filter_axes", lambda *a: pytest.fail("the reference was asked"))
    monkeypatch.setattr(op, "driver", lambda implementation, name: asked.append(implementation) or driver("cuda", name))
    x = values(1, 2, 2, device=device).requires_grad_()

    def squared(x: Tensor) -> Tensor:
        return prefilter_samples(x, "cubic", "reflect", 1, "cuda").square().sum()

    (first,) = torch.autograd.grad(squared(x), x, create_graph=True)
    torch.autograd.grad(first.square().sum(), x)
    torch.func.jvp(squared, (x.detach(),), (torch.ones_like(x),))
    assert set(asked) == {"cuda"}


def test_a_gradient_comes_in_the_dtype_of_the_samples(device: str) -> None:
    x = values(3, 4, 5, dtype=torch.float16, device=device).requires_grad_()
    prefilter_samples(x, "cubic", implementation="cuda").square().sum().backward()
    assert x.grad is not None
    assert x.grad.dtype == torch.float16


@pytest.mark.parametrize("boundary", ["mirror", "zeros"])
def test_vmap_equals_a_loop(boundary: str, device: str) -> None:
    x = values(2, 1, 2, 3, device=device)

    def filtered(v: Tensor) -> Tensor:
        return prefilter_axis(v, 1, "cubic", boundary, 1, "cuda")

    def gradient(v: Tensor) -> Tensor:
        return torch.func.grad(lambda v: filtered(v).pow(3).sum())(v)

    for dim in (0, 2) if device == "cuda" else [0 if boundary == "mirror" else 2]:
        for function in (filtered, gradient):
            mapped = torch.func.vmap(function, in_dims=dim)(x)
            assert_same(mapped, torch.stack([function(v) for v in x.unbind(dim)]))


# --- compilation, choice, and where it can't run ----------------------------------------------------------------------


@pytest.mark.parametrize(
    ("lines", "places", "stored", "real"),
    [(Rows, (1, steps_of(2)), "u8", "fp32"), (Columns, (steps_of(2),), "fp64", "fp64")],
)
def test_compiles_for_a_gpu_that_need_not_be_there(
    lines: type[Program], places: tuple[int, ...], stored: str, real: str, monkeypatch: pytest.MonkeyPatch, tmp_path
) -> None:
    """The loads and stores of a thread: samples and their places before the line's end and behind it, coefficients, w;
    the two poles, gain, T. Of the places of a tile a thread reads one or all, as Triton likes.
    """
    from triton.backends.compiler import GPUTarget  # pyright: ignore[reportMissingImports]
    from triton.compiler import ASTSource, compile  # pyright: ignore[reportMissingImports]

    monkeypatch.setenv("TRITON_INTERPRET", "0")
    monkeypatch.setenv("TRITON_CACHE_DIR", str(tmp_path))
    program, steps = launch.launchable(lines(2).write()), steps_of(2)
    types = {"source": f"*{stored}", "target": f"*{real}", "places": "*i64", "numbers": f"*{real}"}
    signature = {p.name: types.get(p.name, "i32") for p in program.params} | {"BLOCK": "constexpr"}
    made = compile(
        ASTSource(program, signature, {"BLOCK": BLOCK}), target=GPUTarget("cuda", 90, 32), options={"num_warps": 1}
    )
    text = made.asm["ptx"].splitlines()
    loads, stores = (sum(word in line for line in text) for word in ("ld.global", "st.global"))
    assert loads in [2 * (steps + n) + steps + 2 * steps + 2 + 1 + 4 for n in places]
    assert stores == 2 * steps


def test_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    x = values(2, 2, 2)
    monkeypatch.setenv("TRITON_INTERPRET", "1")
    assert missing(x, "cuda") is None
    for reason, samples in {
        "tensors of a GPU (of the CPU with TRITON_INTERPRET=1); got meta": x.to("meta"),
        "dense tensors; got torch.sparse_coo": x.to_sparse(),
        "bfloat16, uint8, int8, int16, int32; got torch.int64": x.long(),
    }.items():
        assert reason in (missing(samples, "cuda") or "nothing")
    with pytest.raises(ValueError, match=r"'cuda' can't run here: .* got torch.int64; implementation='reference' can"):
        prefilter_axis(x.long(), 0, "cubic", implementation="cuda")
    monkeypatch.setenv("TRITON_INTERPRET", "0")
    with pytest.raises(ValueError, match=r"tensors of a GPU \(of the CPU with TRITON_INTERPRET=1\); got cpu"):
        prefilter_samples(x, "cubic", implementation="cuda")
    monkeypatch.setattr(cuda, "_triton_problem", lambda: "the package triton can't be loaded")
    with pytest.raises(ValueError, match="triton"):
        prefilter_samples(x, "cubic", implementation="cuda")


def test_every_device_has_its_own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(op, "missing", lambda *_: None)
    for device, expected in {"cpu": "cpu", "cuda": "cuda", "meta": "reference"}.items():
        samples: Any = SimpleNamespace(device=torch.device(device))
        assert implementation_for(samples) == expected


def test_fields_of_a_gpu_are_prefiltered_there(device: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if device == "cpu":
        monkeypatch.setitem(op.FUSED, "cpu", "cuda")
    x = values(3, 4, 5, device=device)
    assert implementation_for(x) == "cuda"
    monkeypatch.setattr(op.reference, "filter_axes", lambda *a: pytest.fail("the reference was asked"))
    kept = Coefficients.of(x, PREFILTERS["cubic"], Boundary.MIRROR, 1).values
    assert_same(kept[1:-1, 1:-1, 1:-1], prefilter_samples(x, "cubic", implementation="cuda"))
