"""Casting rays at quadrics, alone and blended, in Triton against plain torch: in its interpreter, and on a GPU."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch
from torch import Tensor

pytest.importorskip("triton", reason="the package triton is not installed")

from filterlab.ops.cuda import launch
from filterlab.ops.cuda import quadrics as cuda
from filterlab.ops.cuda import slim as blended
from filterlab.ops.cuda.quadric_hits import OWN, QuadricsVariant
from filterlab.ops.cuda.quadric_walk import BLOCK
from filterlab.ops.differentiable import quadrics, slim
from filterlab.ops.quadrics import Kept, Quadrics
from filterlab.ops.slim import Cover
from filterlab.ops.tree import Boxes
from tests.ops.front_end import intermediate
from tests.ops.test_quadrics import many, rows

CASES = [(9, 0, "both", 2, False), (30, 1, "back", 1, True)]
ON_A_GPU = [(3000, 2, "front", 3, False), (3000, 1, "back", 8, True)]


def aimed(number: int, count: int) -> tuple[Tensor, Tensor]:
    """Rays at the balls of so many quadrics."""
    origins = 4 * rows(number, 3, seed=6)
    return origins, 3 * rows(count, 3)[torch.arange(number) % count] + 0.1 * rows(number, 3, seed=7) - origins


def sized(device: str, case: tuple) -> tuple[int, tuple]:
    """How many rays, and the case: the interpreter takes seconds for some."""
    return (24, case) if device == "cpu" else (20_000, ON_A_GPU[CASES.index(case)])


def on(device: str, given: Quadrics) -> Quadrics:
    tree = given.tree
    moved = {name: getattr(tree, name).to(device) for name in ("order", "center", "boxes", "children")}
    own = Boxes(*(x.to(device) for x in tree.own))
    return replace(given, tree=replace(tree, own=own, **moved), leaves=given.leaves.to(device))


@pytest.mark.parametrize("case", CASES)
def test_hits_are_those_of_plain_torch(case, device):
    number, (count, planes, faces, sheets, farthest) = sized(device, case)
    given, (o, d) = many(count, planes, faces), aimed(number, count)
    expected, own = quadrics.hits(given, o, d, sheets, farthest, "reference")
    t, piece = cuda.hits(on(device, given), o.to(device), d.to(device), sheets, farthest)
    assert torch.equal(piece.cpu(), own)
    torch.testing.assert_close(t.cpu(), expected, rtol=1e-9, atol=1e-9)
    assert int((piece >= 0).sum()) > 0


@pytest.mark.parametrize("case", CASES)
def test_sheets_and_members_are_those_of_plain_torch(case, device):
    number, (count, planes, faces, sheets, farthest) = sized(device, case)
    faces, sheets = ("front", sheets) if faces == "both" else (faces, min(sheets, 3))
    given, (o, d) = Cover(many(count, planes, faces), 0.7), aimed(number, count)
    moved, there = Cover(on(device, given.quadrics), 0.7), [x.to(device) for x in (o, d)]
    expected = slim.sheets(given, o, d, sheets, farthest, "reference")
    found = blended.sheets(moved, *there, sheets, farthest)
    assert torch.equal(found.piece.cpu(), expected.piece)
    for name in ("t", "begin", "end", "normal"):
        torch.testing.assert_close(getattr(found, name).cpu(), getattr(expected, name), rtol=1e-9, atol=1e-9)
    theirs = slim.members(given, o, d, expected.begin[:, 0], expected.end[:, 0], "reference")
    ours = blended.members(moved, *there, found.begin[:, 0], found.end[:, 0])
    order = [torch.argsort(m.row.cpu() * 10_000 + m.piece.cpu()) for m in (ours, theirs)]
    for name in ("row", "piece"):
        assert torch.equal(getattr(ours, name).cpu()[order[0]], getattr(theirs, name)[order[1]])
    torch.testing.assert_close(ours.t.cpu()[order[0]], theirs.t[order[1]], rtol=1e-9, atol=1e-9)
    assert len(theirs.row) >= int((expected.piece[:, 0] >= 0).sum()) > 0


def program_of(asked: str):
    """What Triton compiles."""
    from triton.compiler import ASTSource  # pyright: ignore[reportMissingImports]

    written = launch.launchable(QuadricsVariant(asked, 1, Kept(True, asked == "hits", True), False).write())
    types = dict.fromkeys(("boxes", "nears"), "*fp32") | dict.fromkeys(("children", "nodes"), "*i32")
    types |= dict.fromkeys(("places_array", "count_array"), "*i64") | dict.fromkeys(("sheets", "writes", "rays"), "i32")
    signature = {p.name: types.get(p.name, "*fp64") for p in written.params} | {"BLOCK": "constexpr"}
    return ASTSource(written, signature, {"BLOCK": BLOCK})


@pytest.mark.parametrize("asked", OWN)
def test_the_compiler_takes_the_programs(asked, compiling):
    """Names keep their type in loops and branches, which the interpreter does not ask."""
    assert "scf.while" in intermediate(program_of(asked))
