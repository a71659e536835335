"""Casting rays at quadrics, alone and blended, and at bilinear quads, in Triton against plain torch: in its
interpreter, and on a GPU."""

from __future__ import annotations

from dataclasses import replace
from typing import TypeVar

import numpy as np
import pytest
import torch
from torch import Tensor

pytest.importorskip("triton", reason="the package triton is not installed")

from filterlab.ops.cuda import bilinear as patches
from filterlab.ops.cuda import launch
from filterlab.ops.cuda import quadrics as cuda
from filterlab.ops.cuda import slim as blended
from filterlab.ops.cuda.bilinear_hits import BilinearVariant
from filterlab.ops.cuda.quadric_hits import OWN, QuadricsVariant
from filterlab.ops.cuda.tree_walk import BLOCK, Variant
from filterlab.ops.differentiable import quadrics, slim
from filterlab.ops.quadrics import InLeaves, Kept
from filterlab.ops.slim import Cover
from filterlab.ops.tree import Boxes
from filterlab.surfaces import BilinearQuads
from tests import quadric_many
from tests.ops.front_end import intermediate
from tests.ops.test_quadrics import many, rows
from tests.test_bilinear import AT_EDGES, along_lines, ball

Given = TypeVar("Given", bound=InLeaves)
CASES = [(9, 0, "both", 2, False), (30, 1, "back", 1, True)]
ON_A_GPU = [(3000, 2, "front", 3, False), (3000, 1, "back", 8, True)]


def aimed(number: int, count: int) -> tuple[Tensor, Tensor]:
    """Rays at the balls of so many quadrics."""
    origins = 4 * rows(number, 3, seed=6)
    return origins, 3 * rows(count, 3)[torch.arange(number) % count] + 0.1 * rows(number, 3, seed=7) - origins


def sized(device: str, case: tuple) -> tuple[int, tuple]:
    """How many rays, and the case: the interpreter takes seconds for some."""
    return (24, case) if device == "cpu" else (20_000, ON_A_GPU[CASES.index(case)])


def on(device: str, given: Given) -> Given:
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


@pytest.mark.parametrize(("faces", "sheets", "farthest"), [("both", 3, False), ("front", 2, True)])
def test_hits_of_patches_are_those_of_plain_torch(faces, sheets, farthest, device):
    number, cells = (24, 2) if device == "cpu" else (20_000, 20)
    given = BilinearQuads(*ball(cells, 0.3), faces=faces).described
    o = 3 + 3 * rows(number, 3, seed=6)
    d = 3 + 0.6 * rows(number, 3, seed=7) - o
    expected, own = quadrics.hits(given, o, d, sheets, farthest, "reference")
    t, piece = patches.hits(on(device, given), o.to(device), d.to(device), sheets, farthest)
    assert torch.equal(piece.cpu(), own)
    torch.testing.assert_close(t.cpu(), expected, rtol=1e-9, atol=1e-9)
    assert int((piece >= 0).sum()) > 15


@pytest.mark.parametrize(("height", "aim"), [(1.0, "at_points"), (1e-3, "glancing"), (0.0, "glancing")])
def test_patches_are_hit_where_an_oracle_of_64_bits_says(height, aim, device, monkeypatch):
    def cast(corners: np.ndarray, rays: tuple[np.ndarray, np.ndarray]) -> np.ndarray:
        given = BilinearQuads(torch.from_numpy(corners), torch.tensor([[0, 1, 2, 3]])).described
        return patches.hits(on(device, given), *(torch.from_numpy(x).to(device) for x in rays), 3)[0].cpu().numpy()

    monkeypatch.setattr(quadric_many, "cast_at_patch", cast)
    monkeypatch.setattr(quadric_many, "patch_in_float32", lambda *_: {})
    found = quadric_many.patch_verdict(height, aim, 64 if device == "cpu" else 100_000, 2)
    assert (found["missed"], found["invented"]) == (0, 0)
    assert found["expected"] > 15


@pytest.mark.parametrize("cast", ["tilt 1e-09", "tips [0, 1, 1, 2]"])
def test_flat_patches_end_where_they_do(cast, device):
    given, *rays, expected = AT_EDGES[cast]
    number = 32 if device == "cpu" else len(expected)
    _, piece = patches.hits(on(device, given), *(x[:number].to(device) for x in rays), 1)
    assert torch.equal(piece[:, 0].cpu() >= 0, expected[:number])


def test_lines_of_a_triangle_that_a_ray_follows_are_seldom_hit(device):
    given, o, d, _ = along_lines(64)
    _, piece = patches.hits(on(device, given), o.to(device), d.to(device), 1)
    assert int((piece >= 0).sum()) < 8


def program_of(variant: Variant):
    """What Triton compiles."""
    from triton.compiler import ASTSource  # pyright: ignore[reportMissingImports]

    written = launch.launchable(variant.write())
    types = dict.fromkeys(("boxes", "nears"), "*fp32") | dict.fromkeys(("children", "nodes"), "*i32")
    types |= dict.fromkeys(("places_array", "count_array"), "*i64") | dict.fromkeys(("sheets", "writes", "rays"), "i32")
    signature = {p.name: types.get(p.name, "*fp64") for p in written.params} | {"BLOCK": "constexpr"}
    return ASTSource(written, signature, {"BLOCK": BLOCK})


@pytest.mark.parametrize("asked", OWN)
def test_the_compiler_takes_the_programs(asked, compiling):
    """Names keep their type in loops and branches, which the interpreter does not ask."""
    variant = QuadricsVariant(asked, 1, Kept(True, asked == "hits", True), False)
    assert "scf.while" in intermediate(program_of(variant))


@pytest.mark.parametrize("kept", [Kept(True, True, True), Kept(False, True, True)])
def test_the_compiler_takes_those_of_patches(kept, compiling):
    assert "scf.while" in intermediate(program_of(BilinearVariant(kept)))
