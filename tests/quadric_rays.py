"""Rays of every class at quadrics of every class, judged in exact arithmetic.

python -m tests.quadric_rays 600        for so many seconds; prints what was missed or invented, and of how many
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from filterlab.surfaces import Bounds, Quadrics
from tests import quadric_oracle
from tests.quadric_oracle import Quadric

Rng = np.random.Generator
SHEETS = 6


def turned(rng: Rng) -> np.ndarray:
    return np.linalg.qr(rng.normal(size=(3, 3)))[0]


def symmetric(a: np.ndarray) -> np.ndarray:
    return (a + a.T) / 2


def placed(rng: Rng, values, b=(0.0, 0.0, 0.0), c: float = 0.0) -> Quadric:
    """Turned at random, about a centre somewhere; coefficients about that."""
    q = turned(rng)
    center = rng.uniform(-50, 50, 3)
    a = symmetric(q @ np.diag(values) @ q.T)
    return Quadric(a, q @ np.array(b), c, origin=center, center=center, radius=1.0)


def ellipsoid(rng: Rng) -> Quadric:
    return placed(rng, 1 / rng.uniform(0.3, 0.9, 3) ** 2, c=-1.0)


def hyperboloid(rng: Rng) -> Quadric:
    values = rng.uniform(0.5, 8, 3) * rng.permutation([1, 1, -1])
    return placed(rng, values, c=rng.choice([-0.3, 0.3, 1e-6]))


def general(rng: Rng) -> Quadric:
    return placed(rng, rng.normal(size=3), rng.normal(size=3), 0.3 * rng.normal())


def cone(rng: Rng) -> Quadric:
    return placed(rng, (1.0, 1.0, -rng.uniform(0.2, 3)))


def cylinder(rng: Rng) -> Quadric:
    return placed(rng, (1 / 0.4**2, 1 / 0.4**2, 0.0), c=-1.0)


def paraboloid(rng: Rng) -> Quadric:
    return placed(rng, (2.0, rng.choice([2.0, -2.0]), 0.0), (0.0, 0.0, -0.5), 0.1)


def plane(rng: Rng) -> Quadric:
    return placed(rng, (0.0, 0.0, 0.0), rng.normal(size=3), 0.2 * rng.normal())


def two_planes(rng: Rng) -> Quadric:
    return placed(rng, (1.0, -rng.uniform(0.3, 3), 0.0))


def double_plane(rng: Rng) -> Quadric:
    n, d = rng.normal(size=3), 0.3 * rng.normal()
    return replace(placed(rng, (0.0, 0.0, 0.0)), A=np.outer(n, n), b=d * n, c=d * d)


def nearly_flat(rng: Rng) -> Quadric:
    """A graph, as local fits are: z = k x² + l y², bent from 1 to 1e-12."""
    bent = 10.0 ** -rng.uniform(0, 12, 2) * rng.choice([-1, 1], 2)
    return placed(rng, (*bent, 0.0), (0.0, 0.0, -0.5), 0.1 * rng.normal())


def far_away(rng: Rng) -> Quadric:
    """Coefficients about the world's origin, which lies a hundred radii off."""
    found = general(rng)
    b, o = found.b - found.A @ found.center, found.center
    return replace(found, b=b, c=found.c - 2 * found.b @ o + o @ found.A @ o, origin=np.zeros(3))


def cut(rng: Rng) -> Quadric:
    found = general(rng)
    normals = rng.normal(size=(2, 3))
    planes = [np.append(n, -n @ (found.center + rng.uniform(-0.5, 0.5, 3))) for n in normals]
    return replace(found, planes=planes)


QUADRICS: dict[str, Callable[[Rng], Quadric]] = {
    f.__name__: f
    for f in (
        *(ellipsoid, hyperboloid, general, cone, cylinder, paraboloid),
        *(plane, two_planes, double_plane, nearly_flat, far_away, cut),
    )
}


def aimed(rng: Rng, quadric: Quadric, distance: float, at: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    way = rng.normal(size=3)
    origin = quadric.center + distance * way / np.linalg.norm(way)
    return origin, (at - origin) * 10.0 ** rng.uniform(-6, 6)


def inside(rng: Rng, quadric: Quadric):
    return quadric.center + rng.uniform(-0.5, 0.5, 3), rng.normal(size=3)


def near(rng: Rng, quadric: Quadric):
    return aimed(rng, quadric, 3.0, quadric.center + rng.uniform(-0.6, 0.6, 3))


def far(rng: Rng, quadric: Quadric):
    return aimed(rng, quadric, 10.0 ** rng.uniform(1, 6), quadric.center + rng.uniform(-0.6, 0.6, 3))


def through_center(rng: Rng, quadric: Quadric):
    """Apices of cones, edges of pairs of planes."""
    return aimed(rng, quadric, 10.0 ** rng.uniform(0.5, 3), quadric.center)


def along_axes(rng: Rng, quadric: Quadric):
    """Along the directions where the quadric is least and most bent: rulings, axes."""
    _, axes = np.linalg.eigh(quadric.A)
    direction = axes[:, rng.integers(3)] * rng.choice([-1, 1])
    return quadric.center + rng.uniform(-0.6, 0.6, 3) - 5 * direction, direction


def asymptotic(rng: Rng, quadric: Quadric):
    """α from 1 to 1e-12 of |A| and less, where A has values of both signs."""
    values, axes = np.linalg.eigh(quadric.A)
    low, high = max(-values[0], 0), max(values[2], 0)
    direction = axes[:, 0] * np.sqrt(high) + axes[:, 2] * np.sqrt(low) if low * high else axes[:, 1]
    direction = direction / max(np.linalg.norm(direction), 1e-300) + 10.0 ** -rng.uniform(0, 16) * rng.normal(size=3)
    return quadric.center + rng.uniform(-0.5, 0.5, 3) - 4 * direction, direction


def tangent(rng: Rng, quadric: Quadric):
    """At right angles with the gradient at a point of the surface, off by 1e-4 … 1e-18."""
    x = rng.uniform(-0.5, 0.5, 3) + quadric.center - quadric.origin
    for _ in range(30):
        g = 2 * (quadric.A @ x + quadric.b)
        x = x - g * (x @ quadric.A @ x + 2 * quadric.b @ x + quadric.c) / max(g @ g, 1e-300)
    side = np.cross(2 * (quadric.A @ x + quadric.b), rng.normal(size=3))
    side = side / max(np.linalg.norm(side), 1e-300) if side.any() else rng.normal(size=3)
    return x + quadric.origin - 3 * side + 10.0 ** -rng.uniform(4, 18) * rng.normal(size=3), side


RAYS = {f.__name__: f for f in (inside, near, far, through_center, along_axes, asymptotic, tangent)}


def surface_of(quadrics: list[Quadric], faces: str) -> Quadrics:
    stack = lambda name: torch.tensor(np.array([getattr(q, name) for q in quadrics]))  # noqa: E731
    most = max(len(q.planes) for q in quadrics)
    none = [np.array([0.0, 0.0, 0.0, -1.0])]
    planes = np.array([[*q.planes, *none * (most - len(q.planes))] for q in quadrics]).reshape(len(quadrics), most, 4)
    bounds = Bounds(stack("center"), stack("radius"), torch.from_numpy(planes))
    return Quadrics(stack("A"), stack("b"), stack("c"), bounds, origins=stack("origin"), faces=faces)


def cast(
    quadrics: list[Quadric], origins: np.ndarray, directions: np.ndarray, faces: str, farthest: bool = False
) -> list[np.ndarray]:
    """t of all hits of each ray with its own quadric."""
    surface = surface_of(quadrics, faces)
    hits = surface.hits(torch.from_numpy(origins), torch.from_numpy(directions), SHEETS, farthest)
    own = hits.piece == torch.arange(len(quadrics))[:, None]
    return [t[mine].numpy() for t, mine in zip(hits.t, own, strict=True)]


def verdict(quadric: str, rays: str, count: int, seed: int) -> dict[str, int]:
    """Of so many rays, each at a quadric of its own: hits expected, missed, invented, of fronts and backs."""
    rng = np.random.default_rng([seed, sorted(QUADRICS).index(quadric), sorted(RAYS).index(rays)])
    quadrics = [QUADRICS[quadric](rng) for _ in range(count)]
    origins, directions = map(np.array, zip(*(RAYS[rays](rng, q) for q in quadrics), strict=True))
    found = {faces: cast(quadrics, origins, directions, faces) for faces in ("front", "back", "both")}
    found |= {f"{faces}, farthest": cast(quadrics, origins, directions, faces, True) for faces in ("front", "back")}
    total = {"expected": 0, "missed": 0, "invented": 0, "inconsistent": 0}
    for i, own in enumerate(quadrics):
        if quadric_oracle.lies_on(own, origins[i], directions[i]):
            continue
        expected = quadric_oracle.crossings(own, origins[i], directions[i])
        total["expected"] += len(expected)
        for faces in ("front", "back"):
            touching = quadric == "double_plane"
            for t in (found[faces][i], found[f"{faces}, farthest"][i]):
                for name, n in quadric_oracle.judged(expected, t, faces == "front", touching).items():
                    total[name] += n
        total["inconsistent"] += not np.array_equal(
            found["both"][i], np.sort(np.concatenate([found[f][i] for f in ("front", "back")]))
        )
    return total


def main(seconds: float) -> None:
    totals: dict[str, dict[str, int]] = {}
    end, seed = time.monotonic() + seconds, 1000
    while time.monotonic() < end:
        for quadric in QUADRICS:
            for rays in RAYS:
                for name, n in (verdict(quadric, rays, 50, seed) | {"rays": 50}).items():
                    own = totals.setdefault(quadric, {})
                    own[name] = own.get(name, 0) + n
        seed += 1
    for quadric, total in totals.items():
        print(quadric, total)


if __name__ == "__main__":
    main(float(sys.argv[1]))
