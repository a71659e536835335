"""Pictures of partitions: what is recorded of cells is right, and so is what is drawn."""

from __future__ import annotations

import math

import numpy as np
import pytest

from experiments import partitions
from experiments.partitions import SPLINES, Config, patch, pieces_of
from experiments.report.solids import Eye, Polygons
from tests import tetrahedral_oracle as oracle
from tests.laws import assert_close

every_spline = pytest.mark.parametrize("name", SPLINES)
EYE = Eye((0.5, -1.0, 0.4))


def config(name: str, **values) -> Config:
    return Config.model_validate({"experiment": "partitions", "description": "a cell", "splines": [name], **values})


def patches(name: str, asked: Config) -> tuple[float, list[np.ndarray]]:
    """The level, and the triangles in every tetrahedron."""
    samples, middle = partitions._samples(asked), partitions._middle(SPLINES[name])
    found = [(piece, piece.coefficients(samples, middle)) for piece in pieces_of(SPLINES[name])]
    level = found[0][1][0]
    return level, [patch(piece, b, level, asked.fineness) for piece, b in found]


def test_methods_that_are_no_splines_on_tetrahedra_are_refused():
    with pytest.raises(ValueError, match="unknown spline 'tricubic'"):
        config("tricubic")


@every_spline
def test_tetrahedra_are_the_oracles(name):
    expected = {frozenset(t.vertices) for t in oracle.SPLINES[name].tetrahedra}
    found = [frozenset(map(tuple, piece.vertices)) for piece in pieces_of(SPLINES[name])]
    assert len(found) == len(expected)
    assert set(found) == {frozenset(tuple(map(float, v)) for v in t) for t in expected}


@every_spline
def test_patches_of_a_slope_are_the_plane_through_the_cell(name):
    """x + y + z = const cuts a cube of edge 1 in a hexagon of edge √½, a truncated octahedron in one of edge ¾ √2."""
    edge = 0.75 * math.sqrt(2) if name == "quadratic-c1" else math.sqrt(0.5)
    _, found = patches(name, config(name, noise=0, fineness=3))
    triangles = np.concatenate(found)
    assert_close(triangles.sum(-1), np.zeros(triangles.shape[:2]), 1e-6)
    areas = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=-1) / 2
    assert areas.sum() == pytest.approx(1.5 * math.sqrt(3) * edge**2, rel=1e-6)


@every_spline
def test_patches_lie_on_the_level_set(name):
    """By the oracle, within what is lost between the points of the cubes."""
    asked = config(name, seed=3, fineness=12)
    level, found = patches(name, asked)
    samples, middle = partitions._samples(asked), partitions._middle(SPLINES[name])
    points = np.concatenate(found).reshape(-1, 3)[::7] + middle
    value, gradient = oracle.reconstruct(name, samples.T, np.concatenate([middle[None], points]), prefilter=False)
    assert value[0] == pytest.approx(level, abs=1e-13)
    assert_close(value[1:], np.full(len(points), level), 5e-3, float(np.abs(gradient).max()))


def test_faces_of_a_cube_that_are_seen_are_three():
    corners = np.array([[1, 1, 1], [-1, 1, 1], [-1, -1, 1], [1, -1, 1]])
    around = [corners, -corners[::-1], np.roll(corners, 1, 1), -np.roll(corners, 1, 1)[::-1]]
    around += [np.roll(corners, 2, 1), -np.roll(corners, 2, 1)[::-1]]
    cube = Polygons.of(np.array(around), "#ffffff")
    assert len(cube.facing(EYE).corners) == len(cube.facing(EYE, away=True).corners) == 3
    assert (EYE.seen(cube.facing(EYE).corners.mean(1))[:, 2] > 0).all()
    assert 0 < cube.shaded(EYE).min() < cube.shaded(EYE).max() <= 1
