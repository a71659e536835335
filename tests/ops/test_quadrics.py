"""Casting rays at quadrics: the program against plain torch, trees against all boxes."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from filterlab.ops import cpu
from filterlab.ops.differentiable import quadrics
from filterlab.ops.quadrics import FACES, Quadrics
from filterlab.ops.tree import WIDTH, Boxes, Tree

F64 = torch.float64
needs_llvmlite = pytest.mark.skipif(cpu.llvmlite_problem() is not None, reason="needs llvmlite")


def rows(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, dtype=F64, generator=torch.Generator().manual_seed(seed))


def many(count: int, planes: int = 0, faces: str = "both") -> Quadrics:
    centers, radii = 3 * rows(count, 3), 0.3 + 0.5 * rows(count, seed=1).abs()
    A = rows(count, 3, 3, seed=2)
    cut = rows(count, planes, 4, seed=5)
    boxes = Boxes(centers - radii[:, None], centers + radii[:, None])
    coefficients = A + A.mT, rows(count, 3, seed=3), 0.2 * rows(count, seed=4)
    return Quadrics.of(boxes, coefficients, centers, radii, cut, faces)


def rays(count: int) -> tuple[Tensor, Tensor]:
    return 4 * rows(count, 3, seed=6), rows(count, 3, seed=7) * 10 ** rows(count, 1, seed=8)


@needs_llvmlite
@pytest.mark.parametrize("farthest", [False, True], ids=["first", "last"])
@pytest.mark.parametrize(("count", "planes", "faces", "sheets"), [(1, 0, "both", 1), (300, 2, "front", 3)])
def test_the_program_does_what_plain_torch_does(count, planes, faces, sheets, farthest):
    given, (o, d) = many(count, planes, faces), rays(500)
    (t, piece), (expected, own) = (quadrics.hits(given, o, d, sheets, farthest, name) for name in ("cpu", "reference"))
    assert torch.equal(piece, own)
    torch.testing.assert_close(t, expected, rtol=1e-9, atol=1e-9)
    assert int((piece >= 0).sum()) > 0


@needs_llvmlite
@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_rays_of_either_type_and_none_at_all(dtype):
    given, (o, d) = many(100), (x.to(dtype) for x in rays(200))
    for count in (0, 1, 200):
        t, piece = quadrics.hits(given, o[:count], d[:count], 2, implementation="cpu")
        expected, own = quadrics.hits(given, o[:count], d[:count], 2, implementation="reference")
        assert t.shape == piece.shape == (count, 2)
        assert torch.equal(piece, own)
        torch.testing.assert_close(t, expected, rtol=1e-9, atol=1e-9)


@needs_llvmlite
def test_rays_along_axes_and_at_the_ends_of_boxes():
    """Where 1 / u is not finite, and products of it would be none."""
    given = many(300)
    lower, upper = given.tree.own
    corner = torch.cat((lower, upper))[:200]
    axis = torch.eye(3, dtype=F64)[torch.arange(200) % 3] * torch.where(torch.arange(200) % 2 == 0, 1, -1)[:, None]
    o = corner - 20 * axis
    (t, piece), (expected, own) = (quadrics.hits(given, o, axis, 4, implementation=i) for i in ("cpu", "reference"))
    assert torch.equal(piece, own)
    torch.testing.assert_close(t, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("faces", FACES)
def test_those_that_are_kept_keep_bits_and_numbers(faces):
    given, (o, d) = many(200, faces=faces), rays(300)
    kept = rows(200, seed=9) > 0
    t, piece = quadrics.hits(given.some(kept), o, d, 40, implementation="reference")
    all_t, all_piece = quadrics.hits(given, o, d, 80, implementation="reference")
    for i in range(300):
        mine = (all_piece[i] >= 0) & kept[all_piece[i]]
        n = int(mine.sum())
        assert torch.equal(t[i, :n], all_t[i, mine])
        assert torch.equal(piece[i, :n], all_piece[i, mine])
        assert (piece[i, n:] == -1).all()


def leaves_below(tree: Tree, node: int, lower: Tensor, upper: Tensor) -> list[int]:
    """The leaves under a node, whose boxes lie in those on the way down."""
    found, first = [], int(tree.children[node])
    for child in range(WIDTH):
        low, high = tree.boxes[node, :3, child].double(), tree.boxes[node, 3:, child].double()
        if (low > high).any():
            continue
        assert (low >= lower).all()
        assert (high <= upper).all()
        found += leaves_below(tree, first + child, low, high) if first >= 0 else [-1 - first + child]
        if first < 0:
            own = slice(WIDTH * found[-1], WIDTH * (found[-1] + 1))
            assert (tree.own.lower[own] - tree.center >= low).all()
            assert (tree.own.upper[own] - tree.center <= high).all()
    return found


@pytest.mark.parametrize("count", [1, 8, 9, 64, 65, 512, 513, 5000])
def test_every_thing_is_in_one_leaf_below_boxes_that_hold_it(count):
    lower = rows(count, 3)
    tree = Tree.over(Boxes(lower, lower + rows(count, 3, seed=1).abs()))
    everywhere = torch.full((3,), torch.inf, dtype=F64)
    assert leaves_below(tree, 0, -everywhere, everywhere) == list(range(-(-count // WIDTH)))
    assert tree.order.sort().values.tolist() == list(range(count))
    assert tree.boxes.shape == (len(tree.children), 6, WIDTH)


def test_neighbours_stand_together():
    """Leaves are small: of 4096 points in a cube those of one take two of 512 parts of it."""
    points = torch.rand(4096, 3, dtype=F64, generator=torch.Generator().manual_seed(0))
    tree = Tree.over(Boxes(points, points))
    own = points[tree.order].view(-1, WIDTH, 3)
    volume = (own.amax(1) - own.amin(1)).prod(-1)
    assert volume.mean() < 3 / 512


def test_things_in_one_place_make_a_tree():
    same = torch.zeros(100, 3, dtype=F64)
    tree = Tree.over(Boxes(same, same))
    assert tree.radius == 0
    assert leaves_below(tree, 0, torch.full((3,), -torch.inf).double(), torch.full((3,), torch.inf).double())
