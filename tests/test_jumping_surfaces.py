"""Level sets of fields that jump: every crossing of a knot is a hit, and no cell that could hold one is left out.

The oracle cuts rays where they pass planes of knots, and evaluates the sum over taps from either side of each.
"""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise, product

import numpy as np
import pytest
import torch

import filterlab as fl
from filterlab.fields import ranges
from filterlab.kernels import Kernel
from filterlab.methods import from_kernel
from filterlab.surfaces import LevelSet

SIZE = (9, 7, 8)  # x, y, z
TABLES = {
    "nearest": ((Fraction(1),),),
    "broken": ((Fraction(1, 5), Fraction(4, 5)), (Fraction(1), Fraction(-4, 5))),  # from 0 to 0.2 at both ends
}


def samples(seed: int) -> torch.Tensor:
    return torch.rand(SIZE[::-1], dtype=torch.float64, generator=torch.Generator().manual_seed(seed))


def field_of(name: str, volume: torch.Tensor, **options: object):
    method = name if name == "nearest" else from_kernel(Kernel(name, TABLES[name]))
    return fl.reconstruct(volume, method, prefilter=False, boundary="border", **options)


def value(name: str, volume: np.ndarray, cell: np.ndarray, x: np.ndarray) -> float:
    """By the polynomial of a cell, counted by its first tap."""
    table = np.array(TABLES[name], dtype=float)
    first = cell + (0.5 if name == "nearest" else 0)  # where the cell begins
    weights = [[np.polyval(row[::-1], u) for row in table[::-1]] for u in x - first + (name == "nearest")]
    total = 0.0
    for taps in product(range(len(table)), repeat=3):
        index = np.clip(cell + np.array(taps) + (name == "nearest"), 0, np.array(SIZE) - 1)
        total += np.prod([w[t] for w, t in zip(weights, taps, strict=True)]) * volume[tuple(index[::-1])]
    return total


def crossings(name: str, volume: np.ndarray, level: float, o: np.ndarray, d: np.ndarray) -> list[float]:
    """t of all, in order."""
    shift, ends = 0.5 if name == "nearest" else 0.0, np.array(SIZE) - 0.5
    near, far = np.sort(np.stack([(-0.5 - o) / d, (ends - o) / d]), axis=0)
    begin, end = max(0.0, near.max()), far.min()
    planes = [(np.arange(-2, max(SIZE) + 2) + shift - o[a]) / d[a] for a in range(3)]
    knots = np.unique(np.concatenate([[begin, end], *planes]))
    knots = knots[(knots >= begin) & (knots <= end)]
    found, before = [], None
    for a, z in pairwise(knots):
        cell = np.floor(o + (a + z) / 2 * d - shift).astype(int)
        t = np.linspace(a, z, 4)  # of degree 3
        f = np.array([value(name, volume, cell, o + own * d) for own in t]) - level
        if before is not None and before * f[0] < 0 and abs(before - f[0]) > 1e-12:
            found.append(a)
        inner = np.polynomial.Polynomial.fit(t, f, 3).roots() if name != "nearest" else []
        found += sorted(r.real for r in inner if abs(r.imag) < 1e-9 and a < r.real < z)
        before = f[-1]
    return found


@pytest.mark.parametrize("name", TABLES)
@pytest.mark.parametrize("scheme", ["fused", "direct"])
def test_every_crossing_is_found(name, scheme):
    rng, volume = np.random.default_rng(5), samples(5)
    level = 0.55 if name == "nearest" else 0.8
    surface = LevelSet(field_of(name, volume, scheme=scheme), level)
    o = rng.normal(size=(40, 3)) * 8 + np.array(SIZE) / 2
    d = (rng.random((40, 3)) * SIZE - o) * rng.uniform(0.2, 3, (40, 1))
    first = surface.hit(torch.from_numpy(o), torch.from_numpy(d)).t.numpy()
    every = surface.hits(torch.from_numpy(o), torch.from_numpy(d), 64).t.numpy()
    hits = 0
    for ray in range(len(o)):
        expected = crossings(name, volume.numpy(), level, o[ray], d[ray])
        own = every[ray][np.isfinite(every[ray])]
        assert own == pytest.approx(expected, abs=1e-9)
        assert first[ray] == pytest.approx(expected[0] if expected else np.inf, abs=1e-9)
        hits += len(expected)
    assert hits > 100


@pytest.mark.parametrize("name", TABLES)
def test_cells_far_from_the_level_are_left_out(name):
    """As many as hold a voxel of either side, and those around: not all, as once."""
    volume = torch.zeros(SIZE[::-1], dtype=torch.float64)
    volume[4, 3, 4] = 1
    kept = ranges.ranges(field_of(name, volume).lattice, 2).may_hold(0.5, torch.float64)
    assert 0 < int(kept.sum()) <= 4**3
