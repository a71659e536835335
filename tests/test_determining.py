"""Splines on tetrahedra held by determining sets and by jets: the same spline, from other numbers."""

from __future__ import annotations

from functools import cache
from itertools import product

import numpy as np
import pytest
import torch
from torch import Tensor

import filterlab as fl
from filterlab.bernstein import multi_indices
from filterlab.fields.determining import Determining, Held
from filterlab.fields.octahedral import JETS
from filterlab.fields.tetrahedral import locate
from filterlab.fields.tetrahedral_pieces import FieldOnTetrahedra
from filterlab.fields.type6 import D2, D3
from tests import laws, tetrahedral_oracle
from tests.pairs import in_pairs

FORMS = {"qss": D2, "cubic-c1": D3, "quadratic-c1": JETS}
every_form = pytest.mark.parametrize(("name", "given"), FORMS.items())
SHAPE = (5, 6, 7)


def field(name: str, boundary: str = "mirror", prefilter: bool = True, shape=SHAPE) -> FieldOnTetrahedra:
    samples = torch.from_numpy(np.random.default_rng(0).uniform(-1, 1, shape))
    made = fl.reconstruct(samples, name, boundary=boundary, prefilter=prefilter)
    assert isinstance(made, FieldOnTetrahedra)
    return made


def within(count: int, seed: int = 0, shape=SHAPE) -> Tensor:
    """Points of the domain, its ends among them."""
    points = np.random.default_rng(seed).uniform(-0.5, np.array(shape[::-1]) - 0.5, (count, 3))
    points[0], points[1] = -0.5, np.array(shape[::-1]) - 0.5
    return torch.from_numpy(points)


def test_sets_have_as_many_numbers_as_the_paper_says():
    assert [len(form.masks) for form in FORMS.values()] == [20, 56, 4]
    assert [len(form.needed) for form in FORMS.values()] == [20, 56, 16]
    assert len({frozenset(mask.items()) for mask in D3.masks}) == 56


@pytest.mark.parametrize(("name", "boundary", "prefilter"), in_pairs(product(FORMS, fl.Boundary, (True, False))))
def test_coefficients_are_those_of_the_oracles_masks(name, boundary, prefilter):
    """On every tetrahedron of the cells that the domain meets: ≤ 1e-13 of the range."""
    own, given = field(name, boundary, prefilter), FORMS[name]
    held, points = Held.of(own, given, torch.float64), within(40)
    at = locate(given.spline, own.evaluated.tables, points, torch.float64)
    coefficients = held.coefficients(at).T.numpy()
    expected = oracles(name, boundary, prefilter, points.numpy(), at)
    laws.assert_close(coefficients, expected, 1e-13, 2 * max(1, np.abs(expected).max() / 2))


def oracles(name: str, boundary: str, prefilter: bool, points: np.ndarray, at) -> np.ndarray:
    """(P, B) Σ mask · samples, of the shapes and turns that points were located in."""
    spline = tetrahedral_oracle.SPLINES[name]
    samples = np.random.default_rng(0).uniform(-1, 1, SHAPE)
    continued = tetrahedral_oracle.Samples.continued(samples, boundary, prefilter, points)
    which = np.zeros(len(points), dtype=int) if at.shape is None else at.shape.numpy()
    out = np.empty((len(points), len(multi_indices(spline.degree, 3))))
    for p, shape in enumerate(which.tolist()):
        masks = masks_of(name, shape, tuple(at.ranks[:, p].tolist()), tuple(at.sign[:, p].int().tolist()))
        cell = at.cell[:, p].numpy()
        out[p] = [weights @ continued.at(cell + index) for index, weights in masks]
    return out


@cache
def masks_of(name: str, shape: int, ranks: tuple, sign: tuple) -> list[tuple[np.ndarray, np.ndarray]]:
    """Of every coefficient of a turned tetrahedron: which samples from its cell on, and their weights."""
    spline = tetrahedral_oracle.SPLINES[name]
    kinds = [t for t in spline.tetrahedra if all(x >= abs(y) and y >= z for x, y, z in t.vertices)]
    shapes = list({t.kind: t for t in reversed(kinds)}.values())[::-1]
    turn = np.zeros((3, 3), dtype=int)
    turn[range(3), ranks] = sign
    image = shapes[shape].image(turn)
    masks = [image.masks[alpha] for alpha in tetrahedral_oracle.indices(spline.degree)]
    return [
        (np.array([[int(c + spline.shift) for c in o] for o in mask]), np.array([float(w) for w in mask.values()]))
        for mask in masks
    ]


@every_form
def test_values_and_gradients_are_those_of_the_field(name, given):
    own, points = field(name), within(200, seed=1)
    for order, (rows, expected) in enumerate(
        zip(Held.of(own, given, torch.float64).jet(points, 1), own.jet(points, 1), strict=True)
    ):
        laws.assert_close(rows.T if order else rows[0], expected, 1e-12)


@every_form
@pytest.mark.parametrize("shape", [(1, 2, 3), (4, 1, 8)])
def test_axes_of_any_length(name, given, shape):
    own, points = field(name, shape=shape), within(60, shape=shape)
    (value,) = Held.of(own, given, torch.float64).jet(points, 0)
    laws.assert_close(value[0], own(points), 1e-12)


@every_form
def test_cells_that_cannot_hold_a_level_need_not_be_held(name, given):
    axis = torch.arange(24, dtype=torch.float64) - 11.5
    z, y, x = torch.meshgrid(axis, axis, axis, indexing="ij")
    own = fl.reconstruct(x * x + y * y + z * z, name)
    assert isinstance(own, FieldOnTetrahedra)
    whole, some = (Held.of(own, given, torch.float64, level) for level in (None, 9.0))
    assert 0 < len(some.numbers) < len(whole.numbers) / 2
    assert some.bytes == (8 * len(given.masks) * len(some.numbers), 4 * len(whole.numbers))
    directions = torch.nn.functional.normalize(torch.randn(80, 3, generator=torch.Generator().manual_seed(0)), dim=-1)
    points = 11.5 + 3 * directions.double()
    for a, b in zip(some.jet(points, 1), whole.jet(points, 1), strict=True):
        laws.assert_close(a, b, 1e-12)


@every_form
def test_memory_is_what_numbers_take(name, given):
    n = 16
    held = Held.of(field(name, shape=(n, n, n)), given, torch.float32)
    every = (n + 2) ** 3 if name != "quadratic-c1" else 2 * (n // 2 + 2) ** 3
    assert held.bytes == (4 * len(given.masks) * every, 0)


def test_numbers_that_no_turn_leads_to_are_refused():
    one_corner = Determining.of_cell(D2.spline, D2.masks[:1], D2.rule)
    with pytest.raises(KeyError):
        one_corner.tables  # noqa: B018


def test_bad_input_is_refused():
    own = field("qss")
    held = Held.of(own, D2, torch.float64)
    with pytest.raises(ValueError, match="points of the domain, in voxels; 1 lie outside"):
        held.jet(torch.tensor([[0.0, 0.0, 0.0], [7.0, 0.0, 0.0]]), 0)
    with pytest.raises(ValueError, match="expected a field of cubic-c1"):
        Held.of(own, D3, torch.float64)
    with pytest.raises(ValueError, match="select"):
        Held.of(field("qss", shape=(2, 1, 4, 4, 4)), D2, torch.float64)
    axis = torch.arange(24, dtype=torch.float64)
    steps = fl.reconstruct(axis.expand(24, 24, 24).contiguous(), "qss")
    assert isinstance(steps, FieldOnTetrahedra)
    with pytest.raises(ValueError, match="whose numbers are held; 1 are not"):
        Held.of(steps, D2, torch.float64, 5.0).jet(torch.tensor([[5.0, 9.0, 9.0], [20.0, 9.0, 9.0]]), 0)
