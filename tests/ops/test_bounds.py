"""The program that bounds polynomials on cells against its plain twin, which tests of pieces check against hulls."""

from __future__ import annotations

import math
import subprocess
import sys

import pytest
import torch
from torch import Tensor

import filterlab as fl
from filterlab.fields import ranges
from filterlab.kernels import KERNELS, LINEAR, TensorKernel
from filterlab.methods import from_kernel
from filterlab.ops import cpu
from filterlab.ops.bounds import CODES, Codes, of_pairs, tells_off_trend
from filterlab.ops.differentiable import bounds as bounds_of
from filterlab.ops.pieces import Lattice
from filterlab.ops.tetrahedra import AnyLattice
from tests.test_methods import TENSOR_PRODUCTS
from tests.tetrahedral_oracle import SPLINES


def samples(*shape: int) -> Tensor:
    return torch.rand(shape, generator=torch.Generator().manual_seed(2), dtype=torch.float64)


def assert_alike(lattice: AnyLattice) -> None:
    """The same but for what is rounded over the end of a code: at none of these ends lies a sample."""
    codes = Codes(-2.7312345, 1.31e-4)
    assert bounds_of.missing(lattice) is None
    for edge in (1, 2):
        plain, fused = (bounds_of.bounds(lattice, edge, codes, way) for way in ("reference", "cpu"))
        assert plain.ends == pytest.approx(fused.ends, abs=1e-12)
        for a, b in ((plain.low, fused.low), (plain.high, fused.high)):
            assert a.shape == b.shape
            difference = (a.int() - b.int()).abs()
            assert int(difference.max()) <= 1
            assert float((difference > 0).double().mean()) < 1e-3
        assert len(fused.high.unique()) > 20
        assert_off_alike(plain.off_trend, fused.off_trend, tells_off_trend(lattice))


def assert_off_alike(plain: Tensor | None, fused: Tensor | None, told: bool) -> None:
    """But for the last bit of a bfloat16."""
    assert (plain is not None) is (fused is not None) is told
    if plain is not None and fused is not None:
        assert plain.shape == fused.shape
        for a, b in zip(of_pairs(plain), of_pairs(fused), strict=True):
            assert torch.allclose(a, b, rtol=2.0**-7, atol=1e-12)


WITHOUT_LLVMLITE = """
import sys
sys.modules["llvmlite"] = None
import torch, filterlab as fl
from filterlab.surfaces import LevelSet
volume = torch.arange(6.0)[:, None, None].expand(6, 6, 6)
ray = torch.tensor([2.2, 2.1, -3.0]), torch.tensor([0.0, 0.0, 1.0])
print(float(LevelSet(fl.reconstruct(volume, "trilinear"), 2.5).hit(*ray).t))
"""


def test_level_sets_are_found_without_llvmlite():
    done = subprocess.run([sys.executable, "-c", WITHOUT_LLVMLITE], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert float(done.stdout) == 5.5


@pytest.mark.parametrize("boundary", ["mirror", "zeros"])
@pytest.mark.parametrize("method", [*TENSOR_PRODUCTS, *SPLINES])
def test_the_same_bounds(method, boundary):
    assert_alike(fl.reconstruct(samples(6, 5, 9), method, boundary=boundary).lattice)


@pytest.mark.parametrize("name", [name for name, kernel in KERNELS.items() if kernel.degree <= 3])
def test_every_kernel(name):
    assert_alike(fl.reconstruct(samples(5, 6, 7), from_kernel(KERNELS[name]), prefilter=False).lattice)


@pytest.mark.parametrize("storage", ["float16", "bfloat16", "float32", "int16", "uint8"])
def test_storage(storage):
    assert_alike(fl.reconstruct(samples(5, 6, 7), "triquadratic", storage=storage).lattice)


def test_volumes_that_are_dark_where_others_are_bright():
    """Numbers that stand for values in reverse."""
    lattice = fl.reconstruct(samples(5, 6, 7), "triquadratic").lattice
    turned = Lattice(lattice.coefficients, lattice.row, lattice.offset, lattice.lower, lattice.upper, -2.0, 3.0)
    assert_alike(turned)


@pytest.mark.parametrize(("method", "cells"), [("triquadratic", 27), ("cubic-c1", 27), ("quadratic-c1", 51)])
def test_what_is_not_finite_may_be_anything(method, cells):
    s = samples(10, 10, 11)
    s[3, 4, 5], s[6, 6, 6] = math.nan, -math.inf
    lattice = fl.reconstruct(s, method, prefilter=False, nan="propagate").lattice
    codes = Codes.of(lattice, 0.0, 1.0)
    plain, fused = (bounds_of.bounds(lattice, 1, codes, way) for way in ("reference", "cpu"))
    unknown = (fused.low == -CODES // 2) & (fused.high == CODES // 2 - 1)
    assert cells <= int(unknown.sum()) <= 2 * cells
    if fused.off_trend is not None:
        assert all(bool((own[unknown].isinf()).all()) for own in of_pairs(fused.off_trend))
    assert torch.equal(fused.low[~unknown], plain.low[~unknown])
    assert torch.equal(fused.high[~unknown], plain.high[~unknown])
    assert all(math.isfinite(x) for x in fused.ends)


def test_threads_change_no_bit(monkeypatch):
    lattice = fl.reconstruct(samples(9, 8, 7), "triquadratic").lattice
    found = []
    for threads in (1, 3):
        monkeypatch.setattr(torch, "get_num_threads", lambda threads=threads: threads)
        found.append(bounds_of.bounds(lattice, 2, Codes.of(lattice, 0.0, 1.0), "cpu"))
    assert torch.equal(found[0].low, found[1].low)
    assert torch.equal(found[0].high, found[1].high)
    assert found[0].ends == found[1].ends


def test_many_layers_are_joined_a_few_at_a_time(monkeypatch):
    lattice = fl.reconstruct(samples(40, 5, 6), "trilinear").lattice
    codes = Codes.of(lattice, 0.0, 1.0)
    whole = bounds_of.bounds(lattice, 2, codes, "cpu")
    monkeypatch.setattr("filterlab.ops.cpu.bounds._LAYERS", 6)
    parts = bounds_of.bounds(lattice, 2, codes, "cpu")
    assert torch.equal(whole.low, parts.low)
    assert torch.equal(whole.high, parts.high)


def test_what_cannot_run_is_said_and_runs_plainly(monkeypatch):
    lattice = fl.reconstruct(samples(9, 9, 9), "trilinear").lattice
    monkeypatch.setattr(bounds_of, "_FEWEST", 1)
    asked = []
    monkeypatch.setattr(bounds_of, "driver", lambda name, op: asked.append(name) or chosen(name, op))
    ranges._made(lattice, 2)
    narrow = fl.reconstruct(samples(9, 9, 1), "trilinear").lattice
    assert "cells of a row" in str(bounds_of.missing(narrow))
    ranges._made(narrow, 2)
    tensors = fl.reconstruct(samples(9, 9, 9), TensorKernel("own", LINEAR.table()), prefilter=False).lattice
    assert "tensors" in str(bounds_of.missing(tensors))
    ranges._made(tensors, 2)
    monkeypatch.setattr(cpu, "llvmlite_problem", lambda: "no llvmlite")
    assert bounds_of.missing(lattice) == "no llvmlite"
    ranges._made(lattice, 2)
    assert asked == ["cpu", "reference", "reference", "reference"]


chosen = bounds_of.driver
