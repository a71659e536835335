"""Rays at level sets of splines on tetrahedra, by classes, and what is found along them against the oracle.

`python -m tests.tetrahedral_rays 1200 1000 7 cuda` judges for 1200 seconds, 1000 rays at a time, from seed 7 on, on a
GPU: rays, seed and device may be left out.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from itertools import product

import numpy as np
import torch

import filterlab as fl
from filterlab.surfaces import LevelSet
from tests import level_set_rays, tetrahedral_oracle
from tests.level_set_rays import (
    BOUNDARIES,
    FAULTS,
    Rays,
    axis_parallel,
    from_far,
    grazing,
    in_last_faces,
    inside_out,
    random,
)
from tests.ray_oracle import Truth
from tests.tetrahedral_oracle import SPLINES
from tests.tetrahedral_ray_oracle import Polynomials, crossings

SIZE = level_set_rays.SIZE


@dataclass(frozen=True)
class Case:
    """A spline of samples, a level of it, and what rays are aimed at, if it matters."""

    name: str
    samples: np.ndarray
    boundary: str
    prefilter: bool
    level: float
    aim: np.ndarray | None = None

    @property
    def polynomials(self) -> Polynomials:
        return Polynomials(self.name, self.samples, self.boundary, self.prefilter)

    def jet(self, points: np.ndarray) -> tuple[np.ndarray, ...]:
        return tetrahedral_oracle.reconstruct(self.name, self.samples, points, self.boundary, self.prefilter)

    @property
    def size(self) -> np.ndarray:
        return np.array(self.samples.shape[::-1])

    def truth(self, rays: Rays, close: float = 1e-11) -> list[Truth]:
        return crossings(self.polynomials, *rays, self.level, close)

    def gradient(self, points: np.ndarray) -> np.ndarray:
        return self.jet(points)[1]


# ---- what level sets are of


def noise(rng: np.random.Generator, name: str, boundary: str, prefilter: bool) -> Case:
    return Case(name, rng.random(SIZE[::-1]), boundary, prefilter, rng.uniform(0.2, 0.8))


def thin_shell(rng: np.random.Generator, name: str, boundary: str, prefilter: bool) -> Case:
    """(n · x − c)² or |x − c|², at a level that two sheets have, or a small ball, 1e-5 … 1e-2 from where it is 0.

    Without a prefilter every x² gains ¼.
    """
    x = np.stack(np.meshgrid(*map(np.arange, SIZE[::-1]), indexing="ij")[::-1], -1)
    c, n = rng.uniform(1, 3, 3), rng.normal(size=3)
    n, flat = n / np.linalg.norm(n), rng.random() < 0.7
    samples = ((x - c) @ n) ** 2 if flat else ((x - c) ** 2).sum(-1)
    gained = 0 if prefilter else (1 if flat else 3) / 4
    return Case(name, samples, boundary, prefilter, 10 ** (2 * rng.uniform(-5, -2)) + gained)


def of_a_vertex(rng: np.random.Generator, name: str, boundary: str, prefilter: bool) -> Case:
    """At a level that a vertex of its partition has: rays that are aimed at it cross where many pieces end."""
    case, spline = noise(rng, name, boundary, prefilter), SPLINES[name]
    vertices = np.array(spline.tetrahedra[rng.integers(len(spline.tetrahedra))].vertices, dtype=float)
    aim = vertices[rng.integers(4)] + 2 + float(spline.shift)
    return replace(case, level=float(case.jet(aim[None])[0][0]), aim=aim)


# ---- rays, in voxel coordinates


def _tetrahedra(rng: np.random.Generator, rays: int) -> np.ndarray:
    """(R, 3, 3) three vertices of tetrahedra of either partition, somewhere in the volume, in any order."""
    out = np.empty((rays, 3, 3))
    for ray in range(rays):
        spline = SPLINES[("cubic-c1", "quadratic-c1")[ray % 2]]
        vertices = np.array(spline.tetrahedra[rng.integers(len(spline.tetrahedra))].vertices, dtype=float)
        cell = rng.integers(0, SIZE)
        cell = cell - (cell % 2) + rng.integers(2) if spline.body_centred else cell
        out[ray] = rng.permutation(vertices)[:3] + cell + float(spline.shift)
    return out


def within_faces(rng: np.random.Generator, _: Case, rays: int) -> Rays:
    """Steps are multiples of 1/64: nothing is rounded."""
    a, b, c = _tetrahedra(rng, rays).swapaxes(0, 1)
    u, v = rng.integers(-8, 9, (2, rays, 1)) / 8
    direction = u * (b - a) + v * (c - a)
    direction = np.where((direction == 0).all(1, keepdims=True), b - a, direction)
    s, t = rng.integers(1, 4, (2, rays, 1)) / 8
    return a + s * (b - a) + t * (c - a) - 16 * direction, direction


def along_edges(rng: np.random.Generator, _: Case, rays: int) -> Rays:
    a, b, _ = _tetrahedra(rng, rays).swapaxes(0, 1)
    return a - 32 * (b - a), b - a


def through_edges(rng: np.random.Generator, case: Case, rays: int) -> Rays:
    a, b, _ = _tetrahedra(rng, rays).swapaxes(0, 1)
    return _aimed(rng, a + rng.integers(0, 9, (rays, 1)) / 8 * (b - a), rays)


def through_vertices(rng: np.random.Generator, _: Case, rays: int) -> Rays:
    return _aimed(rng, _tetrahedra(rng, rays)[:, 0], rays)


def at_one_vertex(rng: np.random.Generator, case: Case, rays: int) -> Rays:
    assert case.aim is not None
    return _aimed(rng, case.aim, rays)


def _aimed(rng: np.random.Generator, target: np.ndarray, rays: int) -> Rays:
    """Half of them along small whole numbers, so that nothing is rounded."""
    directions = rng.normal(size=(rays, 3))
    whole = rng.integers(-3, 4, (rays, 3)).astype(float)
    some = (np.arange(rays) % 2 == 0) & (whole != 0).any(1)
    directions[some] = whole[some]
    return target - 16 * directions, directions


Make = Callable[[np.random.Generator, Case, int], Rays]
Of = Callable[[np.random.Generator, str, str, bool], Case]
CLASSES: dict[str, tuple[Of, Make]] = {
    "random": (noise, random),
    "axis-parallel": (noise, axis_parallel),
    "within faces": (noise, within_faces),
    "along edges": (noise, along_edges),
    "through edges": (noise, through_edges),
    "through vertices": (noise, through_vertices),
    "the level at a vertex": (of_a_vertex, at_one_vertex),
    "inside out": (noise, inside_out),
    "from far away": (noise, from_far),
    "grazing": (noise, grazing),
    "thin shells": (thin_shell, random),
    "in last faces": (noise, in_last_faces),
}

# ---- verdicts


def judged(case: Case, rays: Rays, far: bool = False, device: str = "cpu", **chosen: object) -> Counter[str]:
    """First hits and all hits of filterlab on rays: what is missed, invented, later than it is, out of place."""
    options = {"boundary": case.boundary, "prefilter": case.prefilter, **chosen}
    volume = torch.from_numpy(case.samples).to(device)
    surface = LevelSet(fl.reconstruct(volume, case.name, **options), case.level)  # type: ignore
    return level_set_rays.judged(case.truth(rays, 3e-8 if far else 1e-11), surface, rays, far)


def one(name: str, kind: str, boundary: str, prefilter: bool, rays: int, seed: int, **chosen: object) -> Counter[str]:
    """Rays of one class."""
    rng = np.random.default_rng(seed)
    of, make = CLASSES[kind]
    case = of(rng, name, boundary, prefilter)
    return judged(case, make(rng, case, rays), kind == "from far away", **chosen)


def campaign(seconds: float, rays: int = 1000, first: int = 0, **chosen: object) -> dict[tuple[str, str], Counter[str]]:
    """All splines, boundaries and classes, with and without prefilter, in turn, seed after seed until time is up.

    A device is chosen, options go to `reconstruct`.
    """

    def sweep(seed: int) -> Iterator[tuple]:
        for given in product(SPLINES, CLASSES, BOUNDARIES, (True, False)):
            yield *given, rays, seed

    return level_set_rays.in_turn(seconds, first, sweep, partial(one, **chosen))


if __name__ == "__main__":
    where = {"device": sys.argv[4]} if len(sys.argv) > 4 else {}
    for (spline, kind), verdict in campaign(*map(float, sys.argv[1:2]), *map(int, sys.argv[2:4]), **where).items():
        print(f"{spline:13}{kind:23}", *(f"{key} {verdict[key]}" for key in ("rays", "undecided", "hits", *FAULTS)))
