"""Casting rays at splines of heights in Triton against plain torch: in its interpreter, and on a GPU."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor

pytest.importorskip("triton", reason="the package triton is not installed")

from filterlab.ops.cuda import height_hits as cuda
from filterlab.ops.cuda import height_rays, launch
from filterlab.ops.cuda.height_hulls import HeightHullsVariant
from filterlab.ops.cuda.height_rays import HeightRaysVariant
from filterlab.ops.differentiable import height_hits as ops
from filterlab.ops.height_hits import Cell, HeightHits
from filterlab.ops.raycast import Candidates, Sheets
from filterlab.surfaces.quartic import SPLINES
from tests import height_rays as classes
from tests.ops.front_end import intermediate

CASES = [
    ("c1", "holes", "mirror", "main"),
    ("linear", "along edges", "zeros", "anti"),
    ("c2", "from below", "wrap", "main"),
    ("c0", "vertical", "border", "anti"),
]


@pytest.fixture
def rays(device: str, monkeypatch: pytest.MonkeyPatch) -> int:
    """How many. The interpreter takes as long for many at a time as for a few, and longer for larger grids."""
    if device != "cpu":
        return 20_000
    monkeypatch.setattr(cuda, "BLOCK", 64)
    monkeypatch.setattr(classes, "SIZE", np.array([5, 5]))
    return 40


def cast(case: tuple[str, str, str, str], rays: int) -> tuple[HeightHits, tuple[Tensor, Tensor]]:
    """What is hit, and rays at it, which see only a part of all splines, boundaries and classes."""
    (name, kind, boundary, diagonal), make = case, classes.CLASSES[case[1]][1]
    own, rng = classes.case_of(name, kind, boundary, diagonal, 3)
    origins, directions = make(rng, own, rays)
    return own.surface.cast, (torch.from_numpy(origins), torch.from_numpy(directions))


def on(device: str, given: HeightHits) -> HeightHits:
    """With bounds that are found there, the same."""
    moved = described(given, given.heights.values.to(device), "cuda")
    torch.testing.assert_close(moved.pyramid.numbers.cpu(), given.pyramid.numbers, rtol=3e-7, atol=1e-12)
    return moved


@pytest.mark.parametrize("case", CASES[1:])
def test_bounds_and_hits_are_those_of_plain_torch(case, rays, device):
    given, (o, d) = cast(case, rays)
    expected = ops.first(given, o, d, "reference")
    found = ops.first(on(device, given), o.to(device), d.to(device), "cuda").cpu()
    hit = expected < torch.inf
    assert int(hit.sum()) > rays / 4
    assert torch.equal(found < torch.inf, hit)
    torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)


def test_sheets_are_those_of_plain_torch(rays, device):
    """The first ones and the last ones; the first of all is the first hit, bit by bit."""
    given, (o, d) = cast(("linear", "horizontal", "reflect", "anti"), rays)
    there, far = on(device, given), (o.to(device), d.to(device))
    for asked in (Sheets(3, False, 30.0), Sheets(2, True, 30.0)):
        expected, found = ops.sheets(given, o, d, asked, "reference"), ops.sheets(there, *far, asked, "cuda").cpu()
        assert torch.equal(found < torch.inf, expected < torch.inf)
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9)
        assert int((found < torch.inf).all(1).sum()) > rays / 10
        if not asked.farthest:
            assert torch.equal(found[:, 0], ops.first(there, *far, "cuda").cpu())


@pytest.mark.parametrize("case", CASES[:2])
def test_pieces_are_those_of_plain_torch(case, rays, device):
    given, (o, d) = cast(case, rays)
    expected = in_order(ops.candidates(given, o, d, "reference"))
    found = in_order(ops.candidates(on(device, given), o.to(device), d.to(device), "cuda"))
    assert torch.equal(found.ray, expected.ray)
    assert torch.equal(found.repeated, expected.repeated)
    for name in ("start", "near", "far", "coefficients"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), rtol=1e-9, atol=1e-9)


def in_order(found: Candidates) -> Candidates:
    """By rays: those of many pieces are written last."""
    order = found.ray.argsort(stable=True)
    return Candidates(*(column[order].cpu() for column in found))


def test_whether_there_is_a_hit_and_heights_as_they_are_stored(rays, device):
    given, (o, d) = cast(("linear", "random", "reflect", "main"), rays)
    o, d = (x * x.new_tensor([1, 1, 40]) for x in (o, d))
    values = (40 * given.heights.values).to(torch.int16)
    apart = values.repeat_interleave(2, -1)[..., ::2].to(device)  # in memory
    expected = ops.first(described(given, values.double(), "reference"), o, d, "reference") < torch.inf
    stored = described(given, apart, "cuda")
    assert torch.equal(ops.met(stored, o.to(device), d.to(device), "cuda").cpu(), expected)
    rounded = ops.met(stored, o.float().to(device), d.float().to(device), "cuda").cpu()
    assert int((rounded != expected).sum()) <= rays / 50
    assert int(expected.sum()) > rays / 4


def described(given: HeightHits, values: Tensor, implementation: str) -> HeightHits:
    return ops.described(replace(given.heights, values=values), implementation)


@pytest.mark.parametrize("asked", ["first", "candidates", "sheets", "bounds"])
def test_the_compiler_takes_the_programs(asked, compiling):
    """Names keep their type in loops and branches, which the interpreter does not ask."""
    from triton.compiler import ASTSource  # pyright: ignore[reportMissingImports]

    cell = Cell.of(SPLINES["linear"].pattern("main"))
    variant = HeightHullsVariant(cell, True) if asked == "bounds" else HeightRaysVariant(asked, cell, True)
    written = launch.launchable(variant.write())
    types = dict.fromkeys(("lines", "columns", "starts", "widths", "count"), "*i64") | {
        "values": "*i16",
        "flags": "*u8",
    }
    types |= dict.fromkeys((*height_rays.SIZES, "blocks", "blocks_x"), "i32") | {"bounds": "*fp32", "flags": "*u8"}
    signature = {p.name: types.get(p.name, "*fp64") for p in written.params} | {"BLOCK": "constexpr"}
    text = intermediate(ASTSource(written, signature, {"BLOCK": 32}))
    assert ("scf.while" in text) == (asked != "bounds")
