"""The quadratics near splines on cubes about samples: no spline is farther from its own than is told."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
import torch

from filterlab.methods import METHODS, Tetrahedral
from filterlab.ops.cubes import Cubes
from filterlab.ops.reference.tetrahedra import Tensors
from filterlab.ops.tetrahedra import Sum, TetrahedralStencil
from tests import tetrahedral_oracle as oracle

SPLINES = {name: method.spline for name, method in METHODS.items() if isinstance(method, Tetrahedral)}
every_spline = pytest.mark.parametrize("name", SPLINES)

WAYS, POINTS = 80, 15  # of a volume; of a way


def blocks_around(samples: np.ndarray, cells: np.ndarray, centres: tuple) -> list[dict]:
    """What `Cubes.trend` takes, of cubes about samples (M, 3)."""
    first = [cells - 1]
    if centres:
        first = [cells + (np.where(cells % 2, -1, 1) * centre - 1) // 2 for centre in centres]
    size = 2 if centres else 3
    found = []
    for corner in first:
        at = {d: (corner + d).T for d in product(range(size), repeat=3)}
        found.append({d: torch.from_numpy(samples[z, y, x]) for d, (x, y, z) in at.items()})
    return found


def near_and_apart(name: str, samples: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """|f − q| at points of ways (POINTS, WAYS), and what is told of them (WAYS)."""
    cells = rng.integers(3, 6, (WAYS, 3))
    start, end = rng.random((2, WAYS, 3))
    start[: WAYS // 2], end[: WAYS // 2] = start[: WAYS // 2].round(), end[: WAYS // 2].round()  # through corners
    spline = SPLINES[name].lowered
    like = torch.zeros(WAYS, 3, dtype=torch.float64)
    cubes = Cubes(Sum(Tensors(like), TetrahedralStencil(spline, (0,))))
    odd = [torch.from_numpy(own % 2 == 1) for own in cells.T]
    way = cubes.way([*torch.from_numpy(start.T)], [*torch.from_numpy(end.T)], odd)
    rows, apart = cubes.trend(blocks_around(samples, cells, spline.trend.centres), way)
    t = np.linspace(0, 1, POINTS)[:, None]
    q = sum(w * row.numpy() for w, row in zip(((1 - t) ** 2, 2 * t * (1 - t), t * t), rows, strict=True))
    points = (cells - 0.5 + start) + t[..., None] * (end - start)
    f = oracle.reconstruct(name, samples, points.reshape(-1, 3), "reflect", False)[0].reshape(q.shape)
    return np.abs(f - q), apart.numpy()


@every_spline
@pytest.mark.parametrize("data", ["noise", "smooth", "one sample"])
def test_no_spline_is_farther_from_its_quadratic(name, data):
    rng = np.random.default_rng(7)
    samples = rng.normal(size=(9, 9, 9))
    if data == "one sample":
        samples = np.where(np.arange(samples.size).reshape(samples.shape) == 364, 1.0, 0.0)
    if data == "smooth":
        z, y, x = np.indices(samples.shape)
        samples = np.sin(0.5 * x + 0.3 * y - 0.4 * z)
    distance, apart = near_and_apart(name, samples, rng)
    assert (distance <= apart + 1e-14).all()
    assert distance.max(0).sum() >= 0.05 * apart.sum()  # and some are nearly as far


@every_spline
def test_of_quadratics_nothing_is_apart(name):
    z, y, x = np.indices((9, 9, 9)).astype(float)
    samples = 1 + x - 2 * y + 0.5 * z + x * x - 0.3 * x * y + y * z - 0.7 * z * z + 0.2 * y * y
    distance, apart = near_and_apart(name, samples, np.random.default_rng(3))
    assert np.abs(distance).max() <= 1e-11
    assert apart.max() <= 1e-11


@every_spline
def test_the_tetrahedra_that_are_looked_at_fill_the_cube(name):
    volume = 0.0
    for vertices, _ in SPLINES[name]._pieces:
        assert np.abs(vertices).max() <= 0.5
        volume += abs(np.linalg.det(vertices[1:] - vertices[0])) / 6
    assert volume == pytest.approx(1, abs=1e-14)
