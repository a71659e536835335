"""What the fused march is made of: exponentials and logarithms on packs, and the program's own promises."""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass

import numpy as np
import pytest
import torch
from llvmlite import ir

from filterlab.kernels import LINEAR, TensorKernel, bspline
from filterlab.ops import Stencil, march
from filterlab.ops.cpu import compiler, mathematics
from filterlab.ops.cpu.lanes import I64, POINTER, Lanes
from filterlab.ops.differentiable.march import adjoint, missing, run
from filterlab.ops.reference import march as reference

LANES = {"float32": 8, "float64": 4}


@dataclass(frozen=True)
class OnPacks:
    """A program that applies a function of `mathematics` to an array: {source, target, count}."""

    name: str
    arithmetic: str

    def write(self, function: ir.Function) -> None:
        b = ir.IRBuilder(function.append_basic_block("entry"))
        e = Lanes(b, self.arithmetic, LANES[self.arithmetic])
        source, target = (b.load(e.advance(function.args[0], I64(i), I64), typ=POINTER) for i in range(2))
        count = b.load(e.advance(function.args[0], I64(2), I64), typ=I64)
        with e.repeat(I64(0), count, e.count) as i:
            x = e.load(e.advance(source, i, e.number), e.number, e.count)
            if self.name == "power":
                y, _ = mathematics.power(e, x, e.constant(7.5))
            else:
                y = getattr(mathematics, self.name)(e, x)
            e.store(y, e.advance(target, i, e.number))
        b.ret_void()


def on_packs(name: str, x: np.ndarray) -> np.ndarray:
    assert x.size % 8 == 0
    out = np.empty_like(x)
    job = (ctypes.c_int64 * 3)(x.ctypes.data, out.ctypes.data, x.size)
    compiler.compiled(OnPacks(name, str(x.dtype)))(ctypes.addressof(job), 0, 1)
    return out


def arguments(dtype: str, rng: np.random.Generator) -> np.ndarray:
    """Any bit pattern; the range that matters, evenly; close to 0 and 1; the ends."""
    bits = rng.integers(0, 2**32 if dtype == "float32" else 2**64, 40_000, dtype=f"u{4 if dtype == 'float32' else 8}")
    edge = 110 if dtype == "float32" else 760
    near = np.exp(rng.uniform(-40, 0, 8_000))
    ends = [0, -0.0, np.inf, -np.inf, np.nan, 1, -1, -1.5, 2, 0.5, 0.7071, 88.72, 88.73, 709.78, 709.79, -708.4]
    parts = (rng.uniform(-edge, edge, 40_000), near, -near, 1 - near, near - 1, 1 + near, ends)
    return np.concatenate([np.asarray(x, dtype) for x in parts] + [bits.view(dtype)])


EXACT = {"exp": np.exp, "expm1": np.expm1, "log": np.log, "log1p": np.log1p}
WORST = {"exp": 1.0, "expm1": 1.9, "log": 0.9, "log1p": 1.4}  # as the docstring says


@pytest.mark.parametrize("dtype", ["float32", "float64"])
@pytest.mark.parametrize("name", EXACT)
def test_functions_on_packs(name: str, dtype: str, rng: np.random.Generator) -> None:
    with np.errstate(all="ignore"):
        x = arguments(dtype, rng)
        y = on_packs(name, x)
        exact = EXACT[name](x.astype(np.longdouble))  # where a long double is a double, its error counts as ours
        rounded = exact.astype(dtype)
        errors = np.abs(y.astype(np.longdouble) - exact) / np.spacing(np.abs(rounded)).astype(np.longdouble)
        ours = WORST[name] if np.finfo(np.longdouble).eps < 1e-17 or dtype == "float32" else WORST[name] + 0.6
        denormal = (np.abs(rounded) < np.finfo(dtype).tiny) & (name == "expm1")
        finite = np.isfinite(rounded) & ~denormal
    assert finite.sum() > 10_000
    assert errors[finite].max() <= ours
    assert errors[denormal].max(initial=0) <= 1
    special = ~np.isfinite(rounded)
    assert special.sum() > 100
    np.testing.assert_array_equal(y[special], rounded[special])


def test_power_of_what_shading_needs(rng: np.random.Generator) -> None:
    for dtype, tolerance in (("float32", 3e-7), ("float64", 5e-16)):
        base = np.concatenate([[0.0, 1.0], rng.uniform(0, 1, 8_000), np.exp(rng.uniform(-60, 0, 1_998))]).astype(dtype)
        power = on_packs("power", base)
        assert power[0] == 0
        assert power[1] == 1
        np.testing.assert_allclose(power, base.astype(np.float64) ** 7.5, rtol=0, atol=tolerance)


def test_missing_says_what() -> None:
    volume, jet = torch.zeros(4, 4, 4), Stencil.jet(LINEAR, 1)

    def why(volume=volume, stencil=jet, dtype=torch.float32, lights=1) -> str | None:
        return missing(volume, stencil, 0, dtype, lights)

    assert why() is None
    assert "up to 8 lights; got 9" in str(why(lights=9))
    assert "TensorKernel" in str(why(stencil=Stencil.jet(TensorKernel("b", torch.ones(2, 1)), 0)))
    assert "supports go up to 6; got 7" in str(why(stencil=Stencil.jet(bspline(6), 0)))
    assert "got torch.int64" in str(why(volume=torch.zeros(4, 4, 4, dtype=torch.int64)))
    assert "got torch.float16" in str(why(dtype=torch.float16))


@pytest.mark.parametrize(("points", "dtype"), [(2, torch.float32), (256, torch.float32), (129, torch.float64)])
def test_equal_steps_put_no_value_on_the_wrong_side_of_a_control_point(points: int, dtype: torch.dtype) -> None:
    x = torch.linspace(0, 1, points, dtype=torch.float64).to(dtype)
    steps = march.Transfer(x, x.new_zeros(points, 3), x, 1.0).steps
    assert steps is not None
    assert steps.buckets is None
    assert steps.count == points - 1
    below, above = (torch.nextafter(x[1:-1], torch.full_like(x[1:-1], to)) for to in (-math.inf, math.inf))
    t = torch.stack([(v - steps.low) * steps.scale for v in (below, x[1:-1], above)])
    own = torch.arange(1, points - 1)
    assert torch.equal(t[1], own.to(dtype))  # at a control point the fraction is 0, its opacity exact
    assert bool((t[0] <= own).all())
    assert bool((t[2] >= own).all())


@pytest.mark.parametrize(
    "x",
    [
        torch.linspace(0, 1, 100),  # 7/99 · 99 is not 7 in float32
        torch.linspace(-1000, 3000, 256),
        torch.tensor([0.0, 0.25, 0.75, 1.0]),
        torch.tensor([0.5]),
    ],
)
def test_steps_that_are_not_equal_exactly_are_not_taken_for_equal(x: torch.Tensor) -> None:
    assert march._equal_steps(x) is None


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize("spacing", ["equal", "random", "clustered"])
def test_buckets_find_the_interval_that_comparing_finds(spacing: str, dtype: torch.dtype) -> None:
    generator = torch.Generator().manual_seed(3)
    x = {
        "equal": torch.linspace(-1, 2, 129, dtype=torch.float64),
        "random": torch.rand(40, generator=generator, dtype=torch.float64).sort().values,
        "clustered": torch.cat((torch.linspace(0, 1e-6, 20, dtype=torch.float64), torch.tensor([1.0, 2.0]))),
    }[spacing].to(dtype)
    alpha = torch.rand(len(x), generator=generator).to(dtype)
    buckets = march._buckets(x, alpha)
    if spacing == "clustered":
        assert buckets is None  # compared one by one
        return
    assert buckets is not None
    near = torch.cat([torch.nextafter(x, torch.full_like(x, to)) for to in (-math.inf, math.inf)])
    wild = torch.tensor([math.nan, math.inf, -math.inf, 1e30, -1e30], dtype=dtype)
    v = torch.cat((x, near, wild, torch.rand(5000, generator=generator).to(dtype) * 4 - 1.5))
    assert buckets.buckets is not None
    assert len(buckets.buckets) == buckets.count
    number = ((v - buckets.low) * buckets.scale).nan_to_num(0).clamp(0, buckets.count - 1).long()
    row = buckets.buckets[number]
    beyond = (v >= row[:, 1]).long()
    found = row[:, 3].long() + beyond
    expected = (v[:, None] >= x[1:-1]).sum(-1)
    assert torch.equal(found, expected)
    ends = torch.stack((x[expected], x[expected + 1], alpha[expected], alpha[expected + 1]), -1)
    index = torch.tensor([0, 1, 4, 5]) + beyond[:, None]
    assert torch.equal(row.gather(1, index), ends)


# --- segments ---------------------------------------------------------------------------------------------------------


def segment_without_length(dtype: torch.dtype = torch.float64) -> march.March:
    """A ray of three steps, and at its end one more segment, of no length, in what is opaque; 0.25 everywhere else.

    So rounding leaves them: a length of 3 steps over the step may be just above 3.
    """
    row = torch.tensor([0.0, 0.0, 0.0, 1.0], dtype=dtype)
    x, alpha = torch.tensor([0.5, 1.0], dtype=dtype), torch.tensor([0.25, 1.0], dtype=dtype)
    table = march.Transfer(x, torch.ones(2, 3, dtype=dtype), alpha, 1.0)
    entry, along = torch.tensor([[0.0, 0.5, 0.5]]).double(), torch.tensor([[1.0, 0.0, 0.0]]).double()
    one = torch.ones(1, dtype=torch.float64)
    chords = march.Chords(entry, along, 3 * one, one, torch.tensor([4]))
    return march.March(row.expand(2, 2, 4).clone(), 0, Stencil.jet(LINEAR, 0), chords, table, None, 1.0)


@pytest.mark.parametrize("dtype", LANES, ids=str)
@pytest.mark.parametrize("implementation", ["cpu", "reference"])
def test_a_segment_without_length_adds_nothing_however_opaque(implementation: str, dtype: str) -> None:
    given = segment_without_length(getattr(torch, dtype))
    light, depth = reference.march(given) if implementation == "reference" else run(given, implementation="cpu")
    tolerance = 100 * torch.finfo(getattr(torch, dtype)).eps
    assert depth.item() == pytest.approx(-3 * math.log1p(-0.25), rel=tolerance)
    assert light.tolist() == [pytest.approx([1 - 0.75**3] * 3, rel=tolerance)]
    cotangents = torch.ones_like(light), torch.ones_like(depth)
    found = adjoint(given, light, *cotangents, ["coefficients", "rays", "table"], implementation="cpu")
    assert all(x.isfinite().all() for x in found.values())
