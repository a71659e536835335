"""The trends of splines in cubes about samples: no spline is farther off its own than is told."""

from __future__ import annotations

from itertools import product

import numpy as np
import pytest
import torch

import filterlab as fl
from filterlab.methods import METHODS, Tetrahedral
from filterlab.ops.bounds import Codes, in_pairs, of_pairs
from filterlab.ops.differentiable.bounds import bounds
from tests import tetrahedral_oracle as oracle

SPLINES = {name: method.spline for name, method in METHODS.items() if isinstance(method, Tetrahedral)}
every_spline = pytest.mark.parametrize("name", SPLINES)

CUBES, POINTS = 60, 40  # of a volume; in a cube


def trends(samples: np.ndarray, cells: np.ndarray, u: np.ndarray) -> np.ndarray:
    """t (P, M) at places u (P, M, 3) from the samples (M, 3): by differences, and Δ / 8."""

    def at(*step: int) -> np.ndarray:
        return samples[tuple((cells + step).T[::-1])]

    unit = np.eye(3, dtype=int)
    slope = np.empty((3, len(cells)))
    for axis, e in enumerate(unit):
        beside = [s * own for own in unit if own @ e == 0 for s in (1, -1)]
        central = [(at(*c + e) - at(*c - e)) / 2 for c in ([0, 0, 0], *beside)]
        slope[axis] = central[0] / 4 + sum(central[1:]) * 3 / 16
    bend = np.empty((3, 3, len(cells)))
    for i, j in product(range(3), repeat=2):
        a, b = unit[i], unit[j]
        mixed = (at(*a + b) + at(*-a - b) - at(*a - b) - at(*b - a)) / 4
        bend[i, j] = at(*a) + at(*-a) - 2 * at(0, 0, 0) if i == j else mixed
    value = at(0, 0, 0) + np.trace(bend) / 8
    return value + np.einsum("pmi,im->pm", u, slope) + np.einsum("pmi,ijm,pmj->pm", u, bend, u) / 2


def off_and_told(name: str, samples: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """f − t at points of cubes (POINTS, CUBES), and between what it is told to lie (CUBES)."""
    rng = np.random.default_rng(7)
    cells, u = rng.integers(3, 6, (CUBES, 3)), rng.random((POINTS, CUBES, 3)) - 0.5
    u[: POINTS // 2] = u[: POINTS // 2].round(1)  # in planes, on edges, at corners
    lattice = fl.reconstruct(torch.from_numpy(samples), name, boundary="reflect", prefilter=False).lattice
    found = bounds(lattice, 1, Codes(0.0, 1.0), "reference").off_trend
    assert found is not None
    low, high = of_pairs(found[tuple(torch.from_numpy(cells.T[::-1].copy()))])
    f = oracle.reconstruct(name, samples, (cells + u).reshape(-1, 3), "reflect", False)[0].reshape(POINTS, CUBES)
    return f - trends(samples, cells, u), low.numpy(), high.numpy()


@every_spline
@pytest.mark.parametrize("data", ["noise", "smooth", "one sample"])
def test_no_spline_is_farther_off_its_trend(name, data):
    samples = np.random.default_rng(7).normal(size=(9, 9, 9))
    if data == "one sample":
        samples = np.where(np.arange(samples.size).reshape(samples.shape) == 364, 1.0, 0.0)
    if data == "smooth":
        z, y, x = np.indices(samples.shape)
        samples = np.sin(0.5 * x + 0.3 * y - 0.4 * z)
    off, low, high = off_and_told(name, samples)
    assert (low - 1e-14 <= off).all()
    assert (off <= high + 1e-14).all()
    assert (off.max(0) - off.min(0)).sum() >= 0.25 * (high - low).sum()  # and some are not far from that


@every_spline
def test_quadratics_are_their_own_trends(name):
    z, y, x = np.indices((9, 9, 9)).astype(float)
    off, low, high = off_and_told(name, 1 + x - 2 * y + 0.5 * z + x * x - 0.3 * x * y + y * z - 0.7 * z * z)
    for what in (off, low, high):
        assert np.abs(what).max() <= 1e-11


@every_spline
def test_masks_that_are_left_out_are_of_no_bound(name):
    """Between the least and the greatest of the others, whatever the samples are."""
    spline = SPLINES[name]
    samples = np.random.default_rng(1).normal(size=(9, 9, 9))
    lattice = fl.reconstruct(torch.from_numpy(samples), name, boundary="reflect", prefilter=False).lattice
    found = bounds(lattice, 1, Codes(-3.0, 1e-4), "reference")
    index = np.array([4, 5, 4])
    low, high = np.inf, -np.inf
    for number, turn, shift in spline._about_sample:
        mine = [float(shift) * (1 - 2 * (k % 2) if spline.period == 2 else 1) for k in index]
        for mask in spline.shapes[number].masks.values():
            places = [np.array(turn(o), dtype=float) for o in mask]
            if spline.period == 2:  # cubes are turned round along axes of odd indices
                places = [(p + float(shift)) * (1 - 2 * (index % 2)) - mine for p in places]
            at = [tuple((index + p + mine).round().astype(int)[::-1]) for p in places]
            own = sum(float(w) * samples[place] for w, place in zip(mask.values(), at, strict=True))
            low, high = min(low, own), max(high, own)
    assert Codes(-3.0, 1e-4).of_number(low) == int(found.low[tuple(index[::-1])])
    assert Codes(-3.0, 1e-4).of_number(high) == int(found.high[tuple(index[::-1])])


@every_spline
def test_the_tetrahedra_that_are_looked_at_fill_the_cube(name):
    spline, volume = SPLINES[name], 0.0
    for number, turn, shift in spline._about_sample:
        vertices = np.array([turn(v) for v in spline.shapes[number].vertices], dtype=float) + float(shift)
        assert np.abs(vertices).max() <= 0.5
        volume += abs(np.linalg.det(vertices[1:] - vertices[0])) / 6
    assert volume == pytest.approx(1, abs=1e-14)


def test_pairs_of_short_numbers_are_rounded_away_from_each_other():
    g = torch.Generator().manual_seed(0)
    low = torch.randn(4000, generator=g, dtype=torch.float64) * 10.0 ** torch.randint(-30, 30, (4000,), generator=g)
    high = low + low.abs() * torch.rand(4000, generator=g, dtype=torch.float64)
    a, b = of_pairs(in_pairs(low, high))
    for given, kept, side in ((low, a.double(), -1), (high, b.double(), 1)):
        beyond = side * (kept - given) / given.abs()
        assert float(beyond.min()) >= 0
        assert float(beyond.max()) <= 2.0**-6
    none = torch.tensor([float("nan")], dtype=torch.float64)
    assert [float(x) for x in of_pairs(in_pairs(none, none))] == [-float("inf"), float("inf")]
