"""Casting rays at blended quadrics: the programs against plain torch."""

from __future__ import annotations

import pytest
import torch

from filterlab.ops import cpu
from filterlab.ops.differentiable import slim
from filterlab.ops.slim import Cover
from tests.ops.test_quadrics import many, rays

needs_llvmlite = pytest.mark.skipif(cpu.llvmlite_problem() is not None, reason="needs llvmlite")


def both(given: Cover, *arguments):
    return (slim.sheets(given, *arguments, implementation=name) for name in ("cpu", "reference"))


@needs_llvmlite
@pytest.mark.parametrize("farthest", [False, True], ids=["first", "last"])
@pytest.mark.parametrize(
    ("count", "planes", "faces", "sheets"), [(1, 0, "front", 1), (300, 2, "front", 3), (300, 0, "back", 2)]
)
def test_the_program_does_what_plain_torch_does(count, planes, faces, sheets, farthest):
    given, (o, d) = Cover(many(count, planes, faces), 0.5), rays(400)
    found, expected = both(given, o, d, sheets, farthest)
    assert torch.equal(found.piece, expected.piece)
    for name in ("t", "begin", "end", "normal"):
        torch.testing.assert_close(getattr(found, name), getattr(expected, name), rtol=1e-9, atol=1e-9, msg=name)
    assert int((found.piece >= 0).sum()) > 0


@needs_llvmlite
@pytest.mark.parametrize("planes", [0, 1])
def test_members_are_the_same(planes):
    given, (o, d) = Cover(many(300, planes, "front"), 0.7), rays(400)
    found = slim.sheets(given, o, d, 2)
    for k in range(2):
        ours, theirs = (
            slim.members(given, o, d, found.begin[:, k], found.end[:, k], name) for name in ("cpu", "reference")
        )
        assert len(ours.row) > 10
        order = [torch.argsort(m.row * 1000 + m.piece) for m in (ours, theirs)]
        for name in ("row", "piece"):
            assert torch.equal(getattr(ours, name)[order[0]], getattr(theirs, name)[order[1]])
        torch.testing.assert_close(ours.t[order[0]], theirs.t[order[1]], rtol=1e-9, atol=1e-9)
        hit = torch.zeros(len(o), dtype=torch.bool).index_fill(0, ours.row, True)
        assert torch.equal(hit, found.t[:, k] < torch.inf)
