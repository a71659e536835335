"""The fused prefilter against the oracle's infinite deconvolution and the reference; derivatives, memory, threads."""

from __future__ import annotations

import mmap
import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from torch import Tensor

from filterlab.kernels import bspline
from filterlab.ops import cpu
from filterlab.ops.differentiable import prefilter as op
from filterlab.ops.differentiable.prefilter import implementation_for, missing, prefilter_axis, prefilter_samples
from filterlab.ops.gather import STORAGE
from filterlab.prefilters import PREFILTERS, Prefilter, interpolation
from filterlab.volume import Boundary
from tests import laws, oracles

FILTERS = [name for name, prefilter in PREFILTERS.items() if not prefilter.is_identity]
DECONVOLVES = {"cubic": ("bspline3",), "notch": ("bspline2", "bspline2")}
TOLERANCE = {torch.float32: 1e-6, torch.float64: 5e-15}  # of the largest coefficient
DTYPES = [torch.float32, torch.float64]
every_prefilter = pytest.mark.parametrize("name", FILTERS)
every_boundary = pytest.mark.parametrize("boundary", Boundary)


def values(*shape: int, dtype: torch.dtype = torch.float64) -> Tensor:
    return torch.rand(shape, dtype=dtype, generator=torch.Generator().manual_seed(sum(shape))) * 2 - 1


def assert_same(actual: Tensor, expected: Tensor) -> None:
    assert actual.dtype == expected.dtype
    scale = float(expected.detach().abs().max()) if expected.numel() else 1.0
    laws.assert_close(actual, expected, TOLERANCE[actual.dtype], scale)


def assert_volume_agrees(x: Tensor, prefilter: str | Prefilter, boundary: str = "mirror", tail: int = 0) -> None:
    expected = prefilter_samples(x, prefilter, boundary, tail)
    kept = x.clone()
    assert_same(prefilter_samples(x, prefilter, boundary, tail, "cpu"), expected)
    assert torch.equal(x, kept)


# --- values -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("name", DECONVOLVES)
@every_boundary
@pytest.mark.parametrize("n", [1, 2, 3, 7, 32])
def test_coefficients_are_the_infinite_deconvolution_tails_included(name: str, boundary: Boundary, n: int) -> None:
    f, tail = values(n, 3), 9
    matrix = oracles.coefficient_matrix(DECONVOLVES[name], boundary, n, torch.arange(-tail, n + tail).numpy())
    expected = torch.as_tensor(matrix @ f.numpy())
    for lines, dim in ((f, 0), (f.mT.contiguous(), 1)):
        for dtype, tolerance in ((torch.float64, 1e-13), (torch.float32, 1e-6)):
            c = prefilter_axis(lines.to(dtype), dim, name, boundary, tail, "cpu")
            laws.assert_close(c if dim == 0 else c.mT, expected, tolerance, float(expected.abs().max()))


@every_prefilter
@every_boundary
@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_equals_the_reference(name: str, boundary: Boundary, dtype: torch.dtype) -> None:
    for shape, tail in (((1, 2, 3), 6), ((4, 1, 7), 0), ((32, 9, 1), 6), ((2, 3, 4, 7, 32), 0)):
        x = values(*shape, dtype=dtype)
        assert_volume_agrees(x, name, boundary, tail)
        for dim in range(-1, x.ndim - 1):
            expected = prefilter_axis(x, dim, name, boundary, tail)
            assert_same(prefilter_axis(x, dim, name, boundary, tail, "cpu"), expected)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_any_number_of_lines_and_columns(dtype: torch.dtype) -> None:
    """Whole bundles, single packs and the rest of a pack: 64 lines and 8 with AVX2 and float32."""
    for count in [*range(1, 20), 31, 33, 63, 64, 65, 71, 72, 73, 127, 128, 129, 200]:
        for shape in ((4, 5, count), (4, count, 5), (count, 2, 3)):
            assert_volume_agrees(values(*shape, dtype=dtype), "cubic")


@pytest.mark.parametrize(("lanes", "dtype"), [(4, torch.float32), (16, torch.float32), (8, torch.float64)], ids=str)
def test_any_width_of_a_pack(lanes: int, dtype: torch.dtype, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on machines with other vectors than this one; LLVM splits what is too wide."""
    monkeypatch.setattr("filterlab.ops.cpu.prefilter.lanes_of", lambda _: lanes)
    for shape in ((3, 4, 5), (17, 33, 37), (2, 5, 270)):
        assert_volume_agrees(values(*shape, dtype=dtype), "cubic", "zeros", 3)
        assert_volume_agrees(values(*shape, dtype=dtype), "cubic")


@pytest.mark.parametrize("degree", [6, 7, 9])
def test_any_number_of_poles(degree: int) -> None:
    prefilter = interpolation(bspline(degree))
    assert len(prefilter.poles) == degree // 2
    x = values(6, 5, 40)
    expected = prefilter_samples(x, prefilter)
    laws.assert_close(
        prefilter_samples(x, prefilter, implementation="cpu"), expected, 1e-12, float(expected.abs().max())
    )


@pytest.mark.parametrize("stored", [*STORAGE, torch.int64], ids=str)
def test_samples_are_read_as_they_are_stored(stored: torch.dtype) -> None:
    for shape in ((3, 4, 5), (5, 6, 75)):
        x = (values(*shape) * 60 + (60 if stored == torch.uint8 else -7)).to(stored)
        if stored == torch.int64:
            with pytest.raises(ValueError, match=r"stored as float32.*; got torch\.int64"):
                prefilter_samples(x, "cubic", implementation="cpu")
            continue
        assert_volume_agrees(x, "cubic", "border", 2)
        for dim in range(3):
            assert_same(prefilter_axis(x, dim, "cubic", implementation="cpu"), prefilter_axis(x, dim, "cubic"))


def test_views_are_read_in_place_or_copied_never_misread() -> None:
    base = values(3, 4, 12, 10, 20)
    kept = base.clone()
    for view in (
        base[:, ::2],
        base[:1].expand(3, -1, -1, -1, -1),
        base[:, :, 1:-1, 2:-1, 3:-1],
        base[..., ::2],
        base.transpose(2, 4),
        base.transpose(0, 2),
        base.contiguous(memory_format=torch.channels_last_3d),
        base[0, 0, 0, 0, 0].expand(5, 5, 5),
        torch._neg_view(base),
        base[1, 2],
        base[1],
    ):
        assert_volume_agrees(view, "cubic", "reflect", 3)
        for dim in (-3, -2, -1):
            expected = prefilter_axis(view, dim, "cubic")
            assert_same(prefilter_axis(view, dim, "cubic", implementation="cpu"), expected)
    assert torch.equal(base, kept)


def test_no_samples_give_no_coefficients() -> None:
    for x in (torch.zeros(0, 3, 4, 5, 6), torch.zeros(2, 0, 4, 5, 6, dtype=torch.float64)):
        c = prefilter_samples(x, "cubic", "zeros", 2, "cpu")
        assert c.shape == (*x.shape[:2], 8, 9, 10)
        assert c.dtype == x.dtype
    assert prefilter_axis(torch.zeros(4, 0), 0, "cubic", implementation="cpu").shape == (4, 0)


def test_a_nan_stays_on_its_lines() -> None:
    def along(x: Tensor, dim: int) -> Tensor:
        return prefilter_axis(x, dim, "cubic", implementation="cpu")

    laws.assert_a_nan_stays_on_its_lines(along, values(5, 6, 70, dtype=torch.float32))


# --- independence of how the work is divided --------------------------------------------------------------------------


@pytest.fixture
def threads():
    before = torch.get_num_threads()
    yield torch.set_num_threads
    torch.set_num_threads(before)


@pytest.mark.parametrize("name", ["cubic", "quintic"])
def test_a_line_is_filtered_alike_wherever_it_stands(name: str) -> None:
    """Bit by bit: in a bundle, in a single pack, in the rest of a pack, along any axis."""
    line = values(37, dtype=torch.float32)
    expected = prefilter_axis(line, 0, name, implementation="cpu")
    assert torch.equal(prefilter_axis(line.expand(101, 37), 1, name, implementation="cpu"), expected.expand(101, 37))
    columns = prefilter_axis(line[:, None].expand(37, 101), 0, name, implementation="cpu")
    assert torch.equal(columns, expected[:, None].expand(37, 101))


def test_does_not_depend_on_the_number_of_threads(threads) -> None:
    volumes = [values(*shape, dtype=torch.float32) for shape in ((90, 70, 75), (3, 2, 40, 33, 41), (1, 700, 900))]
    threads(1)
    alone = [prefilter_samples(x, "quintic", "wrap", 2, "cpu") for x in volumes]
    axes = [[prefilter_axis(x, dim, "cubic", implementation="cpu") for dim in (-3, -2, -1)] for x in volumes]
    for count in (2, 3, 7):
        threads(count)
        for x, whole, single in zip(volumes, alone, axes, strict=True):
            assert torch.equal(prefilter_samples(x, "quintic", "wrap", 2, "cpu"), whole)
            for dim in (-3, -2, -1):
                assert torch.equal(prefilter_axis(x, dim, "cubic", implementation="cpu"), single[dim])


# --- memory -----------------------------------------------------------------------------------------------------------

GUARDED = r'''
import ctypes, itertools, mmap
import numpy as np
import torch
from filterlab.ops.cpu import prefilter as driver
from filterlab.ops.differentiable.prefilter import prefilter_axis, prefilter_samples

PAGE = mmap.PAGESIZE
libc = ctypes.CDLL(None, use_errno=True)
keep = []

def guarded(shape, dtype, at_end):
    """Memory between two pages without access, touching the second (at_end) or the first."""
    size = int(np.prod(shape)) * dtype.itemsize
    inner = -(-size // PAGE) * PAGE
    region = mmap.mmap(-1, inner + 2 * PAGE)
    address = ctypes.addressof(ctypes.c_char.from_buffer(region))
    array = torch.frombuffer(region, dtype=dtype, count=int(np.prod(shape)), offset=PAGE + (inner - size) * at_end)
    for page in (address, address + PAGE + inner):
        assert libc.mprotect(ctypes.c_void_p(page), ctypes.c_size_t(PAGE), 0) == 0
    keep.append(region)
    return array.reshape(shape)

shapes = [(1, 1, 1), (2, 3, 5), (9, 8, 7), (3, 65, 4), (4, 3, 79), (2, 2, 3, 3, 17)]
for at_end in (True, False):
    driver.fresh = lambda shape, dtype, room=0: guarded(shape, dtype, at_end)
    driver._scratch = lambda size: guarded((size,), torch.uint8, at_end).numpy()
    for shape, stored, (boundary, tail) in itertools.product(
        shapes, (torch.float32, torch.float64, torch.uint8), (("mirror", 0), ("zeros", 3))
    ):
        x = guarded(shape, stored, at_end).copy_(torch.rand(shape) * 100)
        c = prefilter_samples(x, "cubic", boundary, tail, "cpu")
        assert torch.allclose(c, prefilter_samples(x.clone(), "cubic", boundary, tail), rtol=1e-4, atol=1e-2)
        for dim in range(x.ndim):
            prefilter_axis(x, dim, "cubic", boundary, tail, "cpu")
        keep.clear()
print("nothing outside was touched")
'''


@pytest.mark.skipif(sys.platform == "win32", reason="guard pages are made with mprotect")
def test_nothing_outside_the_arrays_is_touched(forks: None) -> None:
    result = subprocess.run(
        [sys.executable, "-c", GUARDED], env=os.environ | {"OMP_NUM_THREADS": "1"}, capture_output=True, text=True
    )
    assert result.returncode == 0, f"exit status {result.returncode}: {result.stderr}"
    assert "nothing outside was touched" in result.stdout


@pytest.mark.skipif(sys.platform == "win32", reason="needs a file with holes")
@pytest.mark.parametrize("dim", [-4, -3, -2])
def test_more_samples_than_32_bits_count(dim: int, tmp_path: Path) -> None:
    """Two entries, planes or rows that lie 2³² samples apart."""
    far, shape, strides = (1 << 32) + 8, [1, 3, 3, 5], [0, 64, 8, 1]
    shape[dim], strides[dim] = 2, far
    with open(tmp_path / "holes", "w+b") as file:
        file.truncate(far + 4096)
        region = mmap.mmap(file.fileno(), 0)
    x = torch.frombuffer(region, dtype=torch.uint8).as_strided(shape, strides)
    x.copy_(values(*shape) * 100 + 110)
    near = x.clone()
    assert_same(prefilter_samples(x, "cubic", implementation="cpu"), prefilter_samples(near, "cubic"))
    lines, near = x.select(dim + 1 if dim < -2 else -3, 0), near.select(dim + 1 if dim < -2 else -3, 0)
    for axis in range(-lines.ndim, 0):
        assert_same(prefilter_axis(lines, axis, "cubic", implementation="cpu"), prefilter_axis(near, axis, "cubic"))


# --- derivatives ------------------------------------------------------------------------------------------------------


@every_prefilter
@every_boundary
def test_linear_with_an_exact_adjoint(name: str, boundary: Boundary) -> None:
    for shape, tail in (((1, 2, 3), 0), ((4, 5, 3), 4)):

        def forward(x: Tensor, tail: int = tail) -> Tensor:
            return prefilter_samples(x, name, boundary, tail, "cpu")

        laws.assert_adjoint(forward, values(*shape))
        laws.assert_linear(forward, values(*shape), values(*shape[::-1]).reshape(shape))


@pytest.mark.parametrize(("name", "tail"), [("cubic", 0), ("notch", 1)])
@every_boundary
def test_derivatives_of_first_and_second_order(name: str, tail: int, boundary: Boundary) -> None:
    x = values(2, 1, 3 - tail).requires_grad_()

    def squared(x: Tensor) -> Tensor:
        return prefilter_samples(x, name, boundary, tail, "cpu") ** 2

    assert torch.autograd.gradcheck(squared, (x,), check_forward_ad=True)
    assert torch.autograd.gradgradcheck(squared, (x,), fast_mode=tail > 0)


@every_boundary
def test_gradients_equal_those_of_the_reference(boundary: Boundary) -> None:
    x = values(2, 6, 5, 40).requires_grad_()
    weights = values(2, 12, 11, 46)
    fused, plain = (
        torch.autograd.grad(prefilter_samples(x, "quintic", boundary, 3, i), x, weights)[0]
        for i in ("cpu", "reference")
    )
    assert_same(fused, plain)
    axis = [
        torch.autograd.grad(prefilter_axis(x, 1, "quintic", boundary, 0, i), x, values(2, 6, 5, 40))[0]
        for i in ("cpu", "reference")
    ]
    assert_same(*axis)


def test_derivatives_stay_in_the_implementation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(op.reference, "filter_axes", lambda *a: pytest.fail("the reference was asked"))
    x = values(3, 4, 5).requires_grad_()

    def squared(x: Tensor) -> Tensor:
        return prefilter_samples(x, "cubic", "reflect", 1, "cpu").square().sum()

    (first,) = torch.autograd.grad(squared(x), x, create_graph=True)
    torch.autograd.grad(first.square().sum(), x)
    torch.func.hessian(squared)(values(2, 1, 2))
    torch.func.jvp(squared, (x.detach(),), (torch.ones_like(x),))


def test_a_gradient_comes_in_the_dtype_of_the_samples() -> None:
    for dtype in (torch.float16, torch.bfloat16):
        x = values(3, 4, 5).to(dtype).requires_grad_()
        prefilter_samples(x, "cubic", implementation="cpu").square().sum().backward()
        assert x.grad is not None
        assert x.grad.dtype == dtype
        wide = x.detach().float().requires_grad_()
        prefilter_samples(wide, "cubic").square().sum().backward()
        assert wide.grad is not None
        laws.assert_close(x.grad.float(), wide.grad, 1e-2, float(wide.grad.abs().max()))


@every_boundary
def test_vmap_equals_a_loop(boundary: Boundary) -> None:
    x = values(3, 4, 2, 5)
    for dim in (0, 1, 3):

        def filtered(v: Tensor) -> Tensor:
            return prefilter_samples(v, "cubic", boundary, 1, "cpu")

        def gradient(v: Tensor) -> Tensor:
            return torch.func.grad(lambda v: prefilter_samples(v, "cubic", boundary, 1, "cpu").pow(3).sum())(v)

        for function in (filtered, gradient):
            mapped = torch.func.vmap(function, in_dims=dim)(x)
            assert_same(mapped, torch.stack([function(v) for v in x.unbind(dim)]))


# --- where it can't run, and callers' mistakes ------------------------------------------------------------------------


def test_says_what_is_missing(monkeypatch: pytest.MonkeyPatch) -> None:
    x = values(3, 4, 5)
    assert missing(x, "cpu") is None
    assert implementation_for(x) == implementation_for(torch.nn.Parameter(x)) == "cpu"

    class Wrapped(Tensor):
        pass

    for reason, samples in {
        "tensors of the CPU; got meta": x.to("meta"),
        "dense tensors; got torch.sparse_coo": x.to_sparse(),
        "a Wrapped may not have": x.as_subclass(Wrapped),
        "got torch.int64": x.long(),
    }.items():
        assert reason in (missing(samples, "cpu") or "nothing")
        assert implementation_for(samples) == "reference"
    with pytest.raises(ValueError, match=r"'cpu' can't run here: .* got torch.int64; implementation='reference' can"):
        prefilter_axis(x.long(), 0, "cubic", implementation="cpu")
    monkeypatch.setattr(cpu, "llvmlite_problem", lambda: "the package llvmlite can't be loaded")
    assert implementation_for(x) == "reference"
    with pytest.raises(ValueError, match="llvmlite can't be loaded"):
        prefilter_samples(x, "cubic", implementation="cpu")


@pytest.mark.parametrize("implementation", op.IMPLEMENTATIONS)
def test_callers_mistakes(implementation: str) -> None:
    x = values(2, 3, 4)
    for match, call in {
        "boundary must be one of": lambda: prefilter_samples(x, "cubic", "mirrored", 0, implementation),
        "known prefilters: identity, quad": lambda: prefilter_samples(x, "cubik", implementation=implementation),
        r"shape \(\.\.\., D, H, W\)": lambda: prefilter_samples(x[0], "cubic", implementation=implementation),
        "tail must be ≥ 0; got -1": lambda: prefilter_axis(x, 0, "cubic", tail=-1, implementation=implementation),
        r"an axis of the samples, -3 … 2; got 3": lambda: prefilter_axis(x, 3, "cubic", implementation=implementation),
        r"at least one sample; got shape \(2, 0, 4\)": lambda: prefilter_samples(
            x[:, :0], "cubic", implementation=implementation
        ),
        "one of reference, cpu, cuda; got 'gpu'": lambda: prefilter_axis(x, 0, "cubic", implementation="gpu"),
    }.items():
        with pytest.raises(ValueError, match=match):
            call()


@pytest.mark.parametrize("implementation", ["reference", "cpu"])
def test_the_identity_only_extends(implementation: str) -> None:
    x = values(2, 3, 4, dtype=torch.float32)
    assert torch.equal(prefilter_samples(x, "identity", implementation=implementation), x)
    expected = x
    for dim in range(3):
        expected = Boundary.REFLECT.extend(expected, dim, 2, 2)
    assert torch.equal(prefilter_samples(x, "identity", "reflect", 2, implementation), expected)
