"""Level sets of quadratic super splines as quadrics in tetrahedra: the picture of the walk that stores nothing."""

from __future__ import annotations

import math

import pytest
import torch

import filterlab as fl
from filterlab.surfaces import LevelSet, Quadrics

F64 = torch.float64


def numbers(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, dtype=F64, generator=torch.Generator().manual_seed(seed))


@pytest.fixture(scope="module")
def volume() -> fl.Volume:
    """Smooth and rough at once, 9 × 8 × 7 voxels, none of them a cube."""
    z, y, x = torch.meshgrid(*[torch.linspace(-1, 1, n, dtype=F64) for n in (7, 8, 9)], indexing="ij")
    return fl.Volume(x**2 + y**2 + z**2 + 0.1 * numbers(7, 8, 9), spacing=(0.5, 1.25, 2.0), origin=(3, -2, 9))


def rays(domain, count: int) -> tuple[torch.Tensor, torch.Tensor]:
    middle, size = torch.tensor(domain.center, dtype=F64), domain.diagonal
    aim = middle + 0.25 * size * numbers(count, 3, seed=1)
    origins = middle + size * torch.nn.functional.normalize(numbers(count, 3, seed=2), dim=-1)
    return origins, aim - origins


@pytest.mark.parametrize("level", [0.4, 0.9])
def test_hits_are_those_of_the_walk(volume, level):
    field = fl.reconstruct(volume, "qss")
    walked, stored = LevelSet(field, level), Quadrics.of_level_set(field, level)
    assert len(stored) == walked.relevant().pieces
    o, d = rays(field.domain, 3000)
    one, two = walked.hit(o, d), stored.hit(o, d)
    assert torch.equal(one.valid, two.valid)
    assert int(one.valid.sum()) > 300
    torch.testing.assert_close(one.t, two.t, rtol=1e-10, atol=1e-10)
    normals = [surface.at(o, d, hit).normal for surface, hit in ((walked, one), (stored, two))]
    torch.testing.assert_close(*normals, rtol=0, atol=1e-8)
    sheets = [surface.hits(o, d, 12).t for surface in (walked, stored)]
    torch.testing.assert_close(*sheets, rtol=1e-9, atol=1e-9)
    assert int(sheets[0].isfinite().sum(-1).max()) >= 4


def test_pieces_hold_the_field(volume):
    """Bernstein coefficients and corners say what the field says."""
    field = fl.reconstruct(volume, "qss")
    corners, coefficients = field.relevant_tetrahedra(0.6)
    weights = torch.rand(len(corners), 4, dtype=F64, generator=torch.Generator().manual_seed(3)) ** 2
    weights = weights / weights.sum(1, keepdim=True)
    x = (weights[..., None] * corners).sum(1)
    torch.testing.assert_close(fl.bernstein.evaluate(coefficients, weights), field(x), rtol=1e-10, atol=1e-12)


def test_outside_is_where_values_are_greater(volume):
    field = fl.reconstruct(volume, "qss")
    o, d = rays(field.domain, 500)
    front = Quadrics.of_level_set(field, 0.6, faces="front")
    hit = front.hit(o, d)
    at = front.at(o, d, hit)
    assert int(hit.valid.sum()) > 50
    assert ((at.normal * d).sum(-1) <= 1e-12).all()


def test_other_fields_and_levels_are_refused(volume):
    for method in ("quadratic-c1", "cubic-c1", "tricubic"):
        with pytest.raises(TypeError, match="quadrics are the pieces of quadratic super splines"):
            Quadrics.of_level_set(fl.reconstruct(volume, method), 0.5)
    field = fl.reconstruct(volume, "qss")
    with pytest.raises(ValueError, match="no piece of this field has the level 100"):
        Quadrics.of_level_set(field, 100.0)
    with pytest.raises(ValueError, match="level must be a finite number; got nan"):
        Quadrics.of_level_set(field, math.nan)
    with pytest.raises(ValueError, match="no piece of this field has the level 0"):
        Quadrics.of_level_set(fl.reconstruct(fl.Volume(torch.zeros(4, 4, 4)), "qss"), 0.0)
