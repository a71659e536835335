"""Rays at level sets of splines on tetrahedra, by classes, and what is found along them against the oracle.

`python -m tests.tetrahedral_rays 1200 1000 7 cuda` judges for 1200 seconds, 1000 rays at a time, from seed 7 on, on a
GPU: rays, seed and device may be left out.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import count, product

import numpy as np
import torch

import filterlab as fl
from filterlab.surfaces import LevelSet
from tests import ray_oracle, tetrahedral_oracle
from tests.tetrahedral_oracle import SPLINES
from tests.tetrahedral_ray_oracle import Polynomials, crossings

SIZE = np.array([7, 6, 5])
SHEETS = 64
BOUNDARIES = [str(b) for b in fl.Boundary]
Rays = tuple[np.ndarray, np.ndarray]


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


def random(rng: np.random.Generator, _: Case, rays: int) -> Rays:
    origins = rng.normal(size=(rays, 3)) * 10 + SIZE / 2
    return origins, (rng.uniform(0, 1, (rays, 3)) * SIZE - origins) * rng.uniform(0.1, 10, (rays, 1))


def axis_parallel(rng: np.random.Generator, _: Case, rays: int) -> Rays:
    origins, axis = rng.uniform(-0.4, 1, (rays, 3)) * (SIZE - 1), np.arange(rays) % 3
    some = rng.random((rays, 3)) < 0.3
    origins[some] = (rng.integers(0, 4 * SIZE, (rays, 3)) / 4)[some]
    sign = rng.choice([-1.0, 1.0], rays)
    origins[np.arange(rays), axis] -= sign * 12
    return origins, np.eye(3)[axis] * sign[:, None]


def in_last_faces(rng: np.random.Generator, case: Case, rays: int) -> Rays:
    """Across one axis, at the upper end of the domain."""
    origins, directions = random(rng, case, rays)
    ray, axis = np.arange(rays), np.arange(rays) % 3
    origins[ray, axis], directions[ray, axis] = (SIZE - 0.5)[axis], 0
    return origins, directions


def inside_out(rng: np.random.Generator, _: Case, rays: int) -> Rays:
    return rng.uniform(-0.5, 0.5, (rays, 3)) + rng.uniform(0, 1, (rays, 3)) * (SIZE - 1), rng.normal(size=(rays, 3))


def from_far(rng: np.random.Generator, case: Case, rays: int) -> Rays:
    origins, directions = random(rng, case, rays)
    return origins - 1e6 * directions / np.linalg.norm(directions, axis=1, keepdims=True), directions


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


def grazing(rng: np.random.Generator, case: Case, rays: int) -> Rays:
    """Tangent to the level set where random rays hit it, and 1e-9 … 1e-2 off to either side."""
    origins, directions = random(rng, case, 3 * rays)
    truth = crossings(case.polynomials, origins, directions, case.level)
    hit = np.array([ray for ray, one in enumerate(truth) if len(one.t)], dtype=int)[:rays]
    t = np.array([truth[ray].t[0] for ray in hit]).reshape(-1, 1)
    points = origins[hit] + t * directions[hit]
    if not len(hit):
        return origins[:0], directions[:0]
    gradient = case.jet(points)[1]
    normal = gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-300)
    along = np.cross(normal, rng.normal(size=normal.shape))
    off = rng.choice([-1.0, 1.0], (len(hit), 1)) * 10 ** rng.uniform(-9, -2, (len(hit), 1))
    return points + off * normal - 16 * along, along


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
    origins, directions = rays
    truth = crossings(case.polynomials, origins, directions, case.level, 3e-8 if far else 1e-11)
    options = {"boundary": case.boundary, "prefilter": case.prefilter, **chosen}
    volume, o, d = (torch.from_numpy(x).to(device) for x in (case.samples, *rays))
    surface = LevelSet(fl.reconstruct(volume, case.name, **options), case.level)  # type: ignore
    first, every = surface.hit(o, d).t.cpu().numpy(), surface.hits(o, d, SHEETS).t.cpu().numpy()
    tolerance = (1e-6 if far else 1e-8) / np.linalg.norm(directions, axis=1)
    found = Counter(of_first(truth, first, tolerance))
    found.update({f"sheets {key}": n for key, n in ray_oracle.judged(truth, every, tolerance).items()})
    return found


def of_first(truth: list[ray_oracle.Truth], t: np.ndarray, tolerance: np.ndarray) -> dict[str, int]:
    """Of first hits t (R,), ∞ where there is none; one that is earlier than all crossings is invented."""
    decided = np.array([one.undecided == np.inf for one in truth], dtype=bool)
    expected = np.array([one.t[0] if len(one.t) else np.inf for one in truth])
    with np.errstate(invalid="ignore"):
        apart = np.where(t == expected, 0, t - expected)
    return {
        "rays": len(truth),
        "undecided": int((~decided).sum()),
        "hits": int((decided & (expected < np.inf)).sum()),
        "missed": int((decided & (t == np.inf) & (expected < np.inf)).sum()),
        "invented": int((decided & (apart < -tolerance)).sum()),
        "later": int((decided & (apart > tolerance) & (t < np.inf)).sum()),
    }


FAULTS = ("missed", "invented", "later", "sheets missed", "sheets invented", "sheets misplaced")


def one(name: str, boundary: str, prefilter: bool, kind: str, rays: int, seed: int, **chosen: object) -> Counter[str]:
    """Rays of one class."""
    rng = np.random.default_rng(seed)
    of, make = CLASSES[kind]
    case = of(rng, name, boundary, prefilter)
    return judged(case, make(rng, case, rays), kind == "from far away", **chosen)


def campaign(seconds: float, rays: int = 1000, first: int = 0, **chosen: object) -> dict[tuple[str, str], Counter[str]]:
    """All splines, boundaries and classes, with and without prefilter, in turn, seed after seed until time is up.

    What has a fault is printed as it is found: the arguments of `one`. A device is chosen, options go to `reconstruct`.
    """
    found: dict[tuple[str, str], Counter[str]] = {}
    begin = time.perf_counter()
    for seed in count(first):
        for name, kind, boundary, prefilter in product(SPLINES, CLASSES, BOUNDARIES, (True, False)):
            if time.perf_counter() - begin > seconds:
                return found
            verdict = one(name, boundary, prefilter, kind, rays, seed, **chosen)
            found.setdefault((name, kind), Counter()).update(verdict)
            if any(verdict[fault] for fault in FAULTS):
                print((name, boundary, prefilter, kind, rays, seed), dict(verdict), flush=True)
    raise AssertionError


if __name__ == "__main__":
    where = {"device": sys.argv[4]} if len(sys.argv) > 4 else {}
    for (spline, kind), verdict in campaign(*map(float, sys.argv[1:2]), *map(int, sys.argv[2:4]), **where).items():
        print(f"{spline:13}{kind:23}", *(f"{key} {verdict[key]}" for key in ("rays", "undecided", "hits", *FAULTS)))
