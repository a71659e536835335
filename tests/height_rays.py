"""Rays at splines of heights, by classes, and what is found along them against the oracle.

`python -m tests.height_rays 600 16000 7 40` judges for 600 seconds of CPU time, 4000 rays at a time, from seed 7 on:
their first hits, and of every fortieth ray all hits.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from itertools import count, product

import numpy as np
import torch

from filterlab.surfaces import HeightField
from tests.height_ray_oracle import NAMES, Crossings, Ground, crossings

SIZE = np.array([26, 21])
SHEETS = 64
BOUNDARIES = ("mirror", "reflect", "wrap", "border", "zeros")
FAULTS = ("missed", "invented", "later", "sheets missed", "sheets invented", "sheets misplaced")
Rng = np.random.Generator
Rays = tuple[np.ndarray, np.ndarray]


@dataclass(frozen=True)
class Case:
    """A spline of heights on a grid of steps 1."""

    name: str
    heights: np.ndarray
    boundary: str
    diagonal: str

    @property
    def ground(self) -> Ground:
        return Ground(self.name, self.heights, self.boundary, self.diagonal)

    @property
    def surface(self) -> HeightField:
        name, prefilter = self.name.split(",")[0], "prefiltered" in self.name
        own = {"boundary": self.boundary, "diagonal": self.diagonal, "prefilter": prefilter, "nan": "propagate"}
        return HeightField(torch.from_numpy(self.heights), name, **own)  # type: ignore[arg-type]

    @property
    def span(self) -> np.ndarray:
        """Of the domain, in steps."""
        return np.maximum(np.array(self.heights.shape[::-1]) - 1, 1)


# ---- what they are of


def noise(rng: Rng) -> np.ndarray:
    return rng.random(SIZE[::-1])


def hills(rng: Rng) -> np.ndarray:
    x, y = np.meshgrid(*map(np.arange, SIZE))
    a, b, c = rng.uniform(0.1, 0.5, 3)
    return 3 * np.sin(a * x + rng.uniform(0, 6)) * np.cos(b * y + c * x)


def steps_of_stairs(rng: Rng) -> np.ndarray:
    """Whole numbers: flat places, and rays that lie in them."""
    return np.floor(hills(rng) / 2)


def with_holes(rng: Rng) -> np.ndarray:
    heights = noise(rng)
    heights[rng.random(heights.shape) < 0.01] = np.nan
    return heights


def thin(rng: Rng) -> np.ndarray:
    """Of one row, or one column, or few."""
    return rng.random((rng.integers(1, 4), rng.integers(1, 6)))


# ---- rays


def _through(case: Case, rng: Rng, rays: int) -> np.ndarray:
    """Points near the ground."""
    low, high = np.nanmin(case.heights), np.nanmax(case.heights)
    return np.concatenate((rng.random((rays, 2)) * case.span, rng.uniform(low, high + 1e-3, (rays, 1))), 1)


def random(rng: Rng, case: Case, rays: int) -> Rays:
    aim = _through(case, rng, rays)
    directions = rng.normal(size=(rays, 3)) * np.array([1, 1, 10.0 ** rng.uniform(-1, 1)])
    return aim - directions * rng.uniform(0, 30, (rays, 1)), directions * 10.0 ** rng.uniform(-3, 3, (rays, 1))


def horizontal(rng: Rng, case: Case, rays: int) -> Rays:
    directions = rng.normal(size=(rays, 3))
    directions[:, 2] = 0
    return _through(case, rng, rays) - 20 * directions, directions


def vertical(rng: Rng, case: Case, rays: int) -> Rays:
    aim = _through(case, rng, rays)
    some = rng.random((rays, 2)) < 0.5
    aim[:, :2][some] = (np.floor(4 * aim[:, :2]) / 4)[some]
    up = rng.choice([-1.0, 1.0], rays)
    return aim * [1, 1, 0] - 50 * up[:, None] * [0, 0, 1], up[:, None] * rng.uniform(0.1, 10, (rays, 1)) * [0, 0, 1]


def through_vertices(rng: Rng, case: Case, rays: int) -> Rays:
    """Half of them along small whole numbers, so that nothing is rounded."""
    aim = np.floor(_through(case, rng, rays) * 4) / 4
    directions, whole = rng.normal(size=(rays, 3)), rng.integers(-3, 4, (rays, 3)).astype(float)
    some = (np.arange(rays) % 2 == 0) & (whole != 0).any(1)
    directions[some] = whole[some]
    return aim - 16 * directions, directions


def at_heights(rng: Rng, case: Case, rays: int) -> Rays:
    """Aimed at the surface above a vertex, or in an edge."""
    m = case.ground.steps
    at = m * np.floor(_through(case, rng, rays)[:, :2] / m)
    at += rng.integers(0, 5, (rays, 1)) / 4 * rng.integers(0, 2, (rays, 2)) * np.minimum(m, case.span - at)
    aim = np.concatenate((at, case.ground.at(at)[:, None]), 1)
    directions = rng.normal(size=(rays, 3))
    known = np.isfinite(aim).all(1)
    return (aim - 5 * directions)[known], directions[known]


def along_edges(rng: Rng, case: Case, rays: int) -> Rays:
    """In the vertical planes of edges, diagonals included, with any slope."""
    aim = np.floor(_through(case, rng, rays))
    aim[:, 2] = _through(case, rng, rays)[:, 2]
    side = -1 if case.diagonal == "anti" else 1
    flat = np.array([(1, 0), (0, 1), (side, 1)])[np.arange(rays) % 3] * rng.choice([-1.0, 1.0], (rays, 1))
    slope = rng.choice([0.0, 1.0], (rays, 1)) * rng.normal(size=(rays, 1))
    directions = np.concatenate((flat, slope), 1)
    return aim - 32 * directions, directions


def from_below(rng: Rng, case: Case, rays: int) -> Rays:
    aim = _through(case, rng, rays)
    origins = np.concatenate((rng.random((rays, 2)) * case.span, rng.uniform(-60, -20, (rays, 1))), 1)
    return origins, (aim - origins) * rng.uniform(0.1, 2, (rays, 1))


def within(rng: Rng, case: Case, rays: int) -> Rays:
    directions = rng.normal(size=(rays, 3)) * [1, 1, 0.1]
    return _through(case, rng, rays), directions


def from_far(rng: Rng, case: Case, rays: int) -> Rays:
    aim, directions = _through(case, rng, rays), rng.normal(size=(rays, 3))
    return aim - 1e6 * directions / np.linalg.norm(directions, axis=1, keepdims=True), directions


def grazing(rng: Rng, case: Case, rays: int) -> Rays:
    """Tangent to the surface, and 1e-9 … 1e-2 off to either side."""
    ground, x = case.ground, rng.random((rays, 2)) * case.span
    apart = 1e-6
    slope = [
        (ground.at(np.clip(x + e, 0, case.span)) - ground.at(np.clip(x - e, 0, case.span))) / (2 * apart)
        for e in apart * np.eye(2)
    ]
    flat = rng.normal(size=(rays, 2))
    directions = np.concatenate((flat, (slope[0] * flat[:, 0] + slope[1] * flat[:, 1])[:, None]), 1)
    off = rng.choice([-1.0, 1.0], rays) * 10 ** rng.uniform(-9, -2, rays)
    points = np.concatenate((x, (ground.at(x) + off)[:, None]), 1)
    known = np.isfinite(points).all(1) & np.isfinite(directions).all(1)
    return (points - 4 * directions)[known], directions[known]


Make = Callable[[Rng, Case, int], Rays]
CLASSES: dict[str, tuple[Callable[[Rng], np.ndarray], Make]] = {
    "random": (noise, random),
    "random, hills": (hills, random),
    "horizontal": (noise, horizontal),
    "vertical": (noise, vertical),
    "through vertices": (noise, through_vertices),
    "at heights of vertices": (noise, at_heights),
    "along edges": (noise, along_edges),
    "from below": (hills, from_below),
    "within the slab": (hills, within),
    "from far away": (noise, from_far),
    "grazing": (hills, grazing),
    "grazing noise": (noise, grazing),
    "stairs": (steps_of_stairs, random),
    "holes": (with_holes, random),
    "thin": (thin, random),
}


def judged(case: Case, rays: Rays, far: bool = False, every: int = 1) -> Counter[str]:
    """What filterlab finds on rays: first hits that are missed, invented, later than they are; and of every so many
    rays all hits that are, or that are out of place.
    """
    origins, directions = rays
    if not len(origins):
        return Counter()
    truth = crossings(case.ground, origins, directions, 1e-8 if far else 1e-11)
    surface, (o, d) = case.surface, map(torch.from_numpy, rays)
    tolerance = (1e-5 if far else 1e-7) / np.linalg.norm(directions, axis=1)
    found = of_first(truth, surface.hit(o, d).t.numpy(), tolerance)
    hits, tolerance = surface.hits(o[::every], d[::every], SHEETS).t.numpy(), tolerance[::every, None]
    return found + of_sheets(truth.chosen(slice(None, None, every)), apart(hits, 1e-4 * tolerance), tolerance)


def of_first(truth: Crossings, t: np.ndarray, tolerance: np.ndarray) -> Counter[str]:
    """Of first hits t (R,), ∞ where there is none; one that is earlier than all crossings is invented."""
    expected, decided = truth.first, ~truth.undecided
    with np.errstate(invalid="ignore"):
        off = np.where(t == expected, 0, t - expected)
    tolerance = tolerance + np.where(expected < np.inf, truth.loose[:, 0], 0)
    counted = {
        "undecided": truth.undecided,
        "hits": decided & (expected < np.inf),
        "missed": decided & (t == np.inf) & (expected < np.inf),
        "invented": decided & (off < -tolerance),
        "later": decided & (off > tolerance) & (t < np.inf),
    }
    return Counter({"rays": len(t)} | {name: int(which.sum()) for name, which in counted.items()})


def of_sheets(truth: Crossings, t: np.ndarray, tolerance: np.ndarray) -> Counter[str]:
    """Of all hits t (R, k)."""
    t, expected = (np.where(truth.undecided[:, None], np.inf, x) for x in (t, truth.t))
    more = (t < np.inf).sum(1) - (expected < np.inf).sum(1)
    width = min(t.shape[1], expected.shape[1])  # of rays with as many of them
    t, expected, loose = (x[:, :width] for x in (t, expected, truth.loose))
    with np.errstate(invalid="ignore"):
        off = np.where(t == expected, 0, np.abs(t - expected)) > tolerance + loose
    misplaced = off & (more == 0)[:, None]
    counts = {"missed": np.maximum(-more, 0), "invented": np.maximum(more, 0), "misplaced": misplaced}
    return Counter({f"sheets {name}": int(count.sum()) for name, count in counts.items()})


def apart(t: np.ndarray, tolerance: np.ndarray) -> np.ndarray:
    """Hits (R, k) in order, ∞ where there are no more, without those that are so near to the one before.

    A ray that nearly lies on the surface crosses it again where the oracle can't tell.
    """
    with np.errstate(invalid="ignore"):
        again = np.diff(t, axis=1, prepend=-np.inf) <= tolerance
    return np.sort(np.where(again, np.inf, t), axis=1)


def case_of(name: str, kind: str, boundary: str, diagonal: str, seed: int) -> tuple[Case, Rng]:
    rng = np.random.default_rng(seed)
    return Case(name, CLASSES[kind][0](rng), boundary, diagonal), rng


def one(name: str, kind: str, boundary: str, diagonal: str, rays: int, seed: int, every: int = 1) -> Counter[str]:
    """Rays of one class; `every` as of `judged`."""
    case, rng = case_of(name, kind, boundary, diagonal, seed)
    return judged(case, CLASSES[kind][1](rng, case, rays), kind == "from far away", every)


def campaign(seconds: float, rays: int = 16000, first: int = 0, every: int = 40) -> dict[tuple[str, str], Counter[str]]:
    """All splines and classes in turn, boundaries and diagonals by turns, seed after seed until time is up.

    What has a fault is printed as it is found: the arguments of `one`.
    """
    found: dict[tuple[str, str], Counter[str]] = {}
    begin, turns = time.process_time(), list(product(("main", "anti"), BOUNDARIES))
    for seed in count(first):
        for number, (name, kind) in enumerate(product(NAMES, CLASSES)):
            if time.process_time() - begin > seconds:
                return found
            diagonal, boundary = turns[(seed + number) % len(turns)]
            verdict = one(name, kind, boundary, diagonal, rays, seed, every)
            found.setdefault((name, kind), Counter()).update(verdict)
            if any(verdict[fault] for fault in FAULTS):
                print((name, kind, boundary, diagonal, rays, seed, every), dict(verdict), flush=True)
    raise AssertionError


if __name__ == "__main__":
    numbers = map(int, sys.argv[2:5])
    verdicts = campaign(float(sys.argv[1]), *numbers)
    for (spline, kind), verdict in (verdicts | {("all", ""): sum(verdicts.values(), Counter())}).items():
        print(f"{spline:17}{kind:24}", *(f"{key} {verdict[key]}" for key in ("rays", "undecided", "hits", *FAULTS)))
