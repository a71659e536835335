"""Rays at level sets of tensor products, by classes, and what is found along them against the oracle.

`python -m tests.level_set_rays 1200 2000 7` judges for 1200 seconds of CPU, 2000 rays at a time, from seed 7 on.
"""

from __future__ import annotations

import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import count, product
from typing import NamedTuple, Protocol

import numpy as np
import scipy.optimize
import torch

import filterlab as fl
from filterlab.surfaces import LevelSet
from tests import ray_oracle
from tests.ray_oracle import DEGREES, Sum, Truth, crossings

SIZE = np.array([7, 6, 5])
SHEETS = 64
BOUNDARIES = [str(b) for b in fl.Boundary]
_NEAR = 1e-3
Rays = tuple[np.ndarray, np.ndarray]


class Aimed(Protocol):
    """What rays are aimed at."""

    @property
    def size(self) -> np.ndarray:
        """Voxels along x, y, z."""
        ...

    def truth(self, rays: Rays, close: float = 1e-11) -> list[Truth]: ...

    def gradient(self, points: np.ndarray) -> np.ndarray: ...


class Aim(NamedTuple):
    """A ray that crosses a level twice: between both places, its unit vector, d²f/dt² there, how far they are apart."""

    middle: np.ndarray
    along: np.ndarray
    bend: float
    apart: float


@dataclass(frozen=True)
class Case:
    """A method's function of samples, a level of it, and what rays are aimed at, if it matters."""

    name: str
    samples: np.ndarray
    boundary: str
    level: float
    aim: Aim | None = None

    @property
    def size(self) -> np.ndarray:
        return np.array(self.samples.shape[::-1])

    @property
    def sum(self) -> Sum:
        return Sum(self.name, self.samples, self.boundary)

    def truth(self, rays: Rays, close: float = 1e-11) -> list[Truth]:
        return crossings(self.sum, *rays, self.level, close)

    def gradient(self, points: np.ndarray) -> np.ndarray:
        """By central differences: good to 1e-8."""
        f, steps = self.sum, 1e-4 * np.eye(3)
        return np.stack([f(points + step) - f(points - step) for step in steps], -1) / 2e-4

    def surface(self, dtype: torch.dtype = torch.float64) -> LevelSet:
        gradient = "analytic" if self.name == "trilinear" else None
        volume = torch.from_numpy(self.samples).to(dtype)
        return LevelSet(fl.reconstruct(volume, self.name, boundary=self.boundary, gradient=gradient), self.level)


# ---- what level sets are of


def noise(rng: np.random.Generator, name: str, boundary: str) -> Case:
    return Case(name, rng.random(SIZE[::-1]), boundary, rng.uniform(0.2, 0.8))


def thin_shell(rng: np.random.Generator, name: str, boundary: str) -> Case:
    """At a level that a ray, the aim, crosses twice, 1e-5 … 0.1 apart."""
    case, line = noise(rng, name, boundary), np.zeros((0, 3))
    while not len(line):
        line = _to_an_extremum(rng, case.sum)
    (value, before, after), (middle, along) = case.sum(np.stack((line[0], line[1], line[2]))), line[[0, 3]]
    bend, apart = (before - 2 * value + after) / _NEAR**2, 10 ** rng.uniform(-5, -1)
    return replace(case, level=float(value + bend * apart**2 / 8), aim=Aim(middle, along, bend, apart))


def _to_an_extremum(rng: np.random.Generator, f: Sum) -> np.ndarray:
    """(4, 3): where f has an extremum along a line, a little before it and behind, the line's direction; or nothing."""
    along = rng.normal(size=3)
    along, middle = along / np.linalg.norm(along), rng.uniform(0.3, 0.7, 3) * (SIZE - 1)
    at = lambda t: middle + np.atleast_1d(t)[:, None] * along  # noqa: E731
    t = np.linspace(-1, 1, 101)
    v = f(at(t))
    peaks = np.nonzero((v[1:-1] - v[:-2]) * (v[2:] - v[1:-1]) < 0)[0] + 1
    if not len(peaks):
        return np.zeros((0, 3))
    sign = np.sign(v[peaks[0]] - v[peaks[0] - 1])
    own = scipy.optimize.minimize_scalar(
        lambda s: -sign * f(at(s))[0], bounds=t[peaks[0] + np.array([-1, 1])], method="bounded", options={"xatol": 1e-9}
    ).x
    return np.concatenate((at(own + np.array([0, -_NEAR, _NEAR])), along[None]))


# ---- rays, in voxel coordinates


def random(rng: np.random.Generator, case: Aimed, rays: int) -> Rays:
    origins = rng.normal(size=(rays, 3)) * 10 + case.size / 2
    return origins, (rng.uniform(0, 1, (rays, 3)) * case.size - origins) * rng.uniform(0.1, 10, (rays, 1))


def axis_parallel(rng: np.random.Generator, case: Aimed, rays: int) -> Rays:
    origins, axis = rng.uniform(-0.4, 1, (rays, 3)) * (case.size - 1), np.arange(rays) % 3
    some = rng.random((rays, 3)) < 0.3
    origins[some] = (rng.integers(0, 4 * case.size, (rays, 3)) / 4)[some]
    sign = rng.choice([-1.0, 1.0], rays)
    origins[np.arange(rays), axis] -= sign * 12
    return origins, np.eye(3)[axis] * sign[:, None]


def on_faces(rng: np.random.Generator, case: Aimed, rays: int) -> Rays:
    """Within planes of knots, of either parity."""
    origins, directions = random(rng, case, rays)
    ray, axis = np.arange(rays), np.arange(rays) % 3
    origins[ray, axis] = rng.integers(0, 8, rays) % (2 * case.size[axis] - 1) / 2
    directions[ray, axis] = 0
    return origins, directions


def through_edges_and_corners(rng: np.random.Generator, case: Aimed, rays: int) -> Rays:
    steps = rng.integers(-2, 3, (rays, 3)).astype(float)
    steps[(steps == 0).all(1)] = 1
    through = rng.integers(0, 2 * case.size, (rays, 3)) / 2
    return through - 16 * steps, steps


def inside_out(rng: np.random.Generator, case: Aimed, rays: int) -> Rays:
    origins = rng.uniform(-0.5, 0.5, (rays, 3)) + rng.uniform(0, 1, (rays, 3)) * (case.size - 1)
    return origins, rng.normal(size=(rays, 3))


def from_far(rng: np.random.Generator, case: Aimed, rays: int) -> Rays:
    origins, directions = random(rng, case, rays)
    return origins - 1e6 * directions / np.linalg.norm(directions, axis=1, keepdims=True), directions


def in_last_faces(rng: np.random.Generator, case: Aimed, rays: int) -> Rays:
    """Across one axis, at the upper end of the domain."""
    origins, directions = random(rng, case, rays)
    ray, axis = np.arange(rays), np.arange(rays) % 3
    origins[ray, axis], directions[ray, axis] = (case.size - 0.5)[axis], 0
    return origins, directions


def grazing(rng: np.random.Generator, case: Aimed, rays: int) -> Rays:
    """Tangent to the level set where random rays hit it, and 1e-9 … 1e-2 off to either side."""
    origins, directions = random(rng, case, 3 * rays)
    truth = case.truth((origins, directions))
    hit = np.array([ray for ray, one in enumerate(truth) if len(one.t)], dtype=int)[:rays]
    t = np.array([truth[ray].t[0] for ray in hit]).reshape(-1, 1)
    points = origins[hit] + t * directions[hit]
    if not len(hit):
        return origins[:0], directions[:0]
    gradient = case.gradient(points)
    normal = gradient / np.maximum(np.linalg.norm(gradient, axis=1, keepdims=True), 1e-300)
    along = np.cross(normal, rng.normal(size=normal.shape))
    off = rng.choice([-1.0, 1.0], (len(hit), 1)) * 10 ** rng.uniform(-9, -2, (len(hit), 1))
    return points + off * normal - 16 * along, along


def at_a_shell(rng: np.random.Generator, case: Aimed, rays: int) -> Rays:
    """Near enough to the aim to cross twice as well, or just to miss."""
    assert isinstance(case, Case)
    assert case.aim is not None
    middle, along, bend, apart = case.aim
    slope = np.linalg.norm(case.gradient(middle[None]))
    off = rng.normal(size=(rays, 3)) * abs(bend) * apart**2 / 16 / max(slope, 1e-3)
    tilt = rng.normal(size=(rays, 3)) * abs(bend) * apart / 4 / max(slope, 1e-3)
    directions = along + np.minimum(tilt, 0.1)
    return middle + off - 16 * directions, directions


CLASSES: dict[str, tuple[Callable[..., Case], Callable[[np.random.Generator, Aimed, int], Rays]]] = {
    "random": (noise, random),
    "axis-parallel": (noise, axis_parallel),
    "on faces": (noise, on_faces),
    "edges and corners": (noise, through_edges_and_corners),
    "inside out": (noise, inside_out),
    "from far away": (noise, from_far),
    "grazing": (noise, grazing),
    "thin shells": (thin_shell, at_a_shell),
    "in last faces": (noise, in_last_faces),
}

# ---- verdicts

FAULTS = ("missed", "invented", "later", "sheets missed", "sheets invented", "sheets misplaced")


def of_first(truth: list[Truth], t: np.ndarray, tolerance: np.ndarray) -> dict[str, int]:
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


def judged(truth: list[Truth], surface: LevelSet, rays: Rays, loose: bool) -> Counter[str]:
    """First hits and all hits of filterlab on rays: what is missed, invented, later than it is, out of place.

    They may be off by 1e-8 voxels; by 1e-6 where `loose`, of rays from far away, or so nearly tangent that the rounding
    of f, some 1e-14, is a hundred million times as long a way along them.
    """
    o, d = (torch.from_numpy(x).to(surface.device) for x in rays)
    first, every = surface.hit(o, d).t.cpu().numpy(), surface.hits(o, d, SHEETS).t.cpu().numpy()
    tolerance = (1e-6 if loose else 1e-8) / np.linalg.norm(rays[1], axis=1)
    found = Counter(of_first(truth, first, tolerance))
    found.update({f"sheets {key}": n for key, n in ray_oracle.judged(truth, every, tolerance).items()})
    return found


def one(name: str, kind: str, boundary: str, rays: int, seed: int) -> Counter[str]:
    """Rays of one class; also at how many first hits f is more than 1e-12 of the samples' range off the level."""
    rng = np.random.default_rng(seed)
    of, make = CLASSES[kind]
    case, far = of(rng, name, boundary), kind == "from far away"
    own, surface = make(rng, case, rays), case.surface()
    found = judged(case.truth(own, 3e-8 if far else 1e-11), surface, own, far or kind in ("grazing", "thin shells"))
    o, d = map(torch.from_numpy, own)
    hit = surface.hit(o, d)
    values = case.sum(surface.at(o, d, hit).point[hit.valid].numpy())
    off = np.abs(values - case.level) / np.ptp(case.samples)
    found["off level by 1e-12"] = int((off > 1e-12).sum())
    return found


def in_turn(
    seconds: float, first: int, sweep: Callable[[int], Iterator[tuple]], one: Callable[..., Counter[str]]
) -> dict[tuple[str, str], Counter[str]]:
    """Verdicts of `one` on the arguments that `sweep` gives for a seed, added up by the first two, until time is up.

    What has a fault is printed as it is found: its arguments.
    """
    found: dict[tuple[str, str], Counter[str]] = {}
    begin = time.process_time()
    for seed in count(first):
        for given in sweep(seed):
            if time.process_time() - begin > seconds:
                return found
            verdict = one(*given)
            found.setdefault(given[:2], Counter()).update(verdict)
            if any(verdict[fault] for fault in (*FAULTS, "off level by 1e-12")):
                print(given, dict(verdict), flush=True)
    raise AssertionError


def campaign(seconds: float, rays: int = 2000, first: int = 0) -> dict[tuple[str, str], Counter[str]]:
    """All methods and classes in turn, boundaries by turns, seed after seed."""

    def sweep(seed: int) -> Iterator[tuple]:
        for number, (kind, name) in enumerate(product(CLASSES, DEGREES)):
            yield name, kind, BOUNDARIES[(seed + number) % len(BOUNDARIES)], rays, seed

    return in_turn(seconds, first, sweep, one)


if __name__ == "__main__":
    verdicts = campaign(*map(float, sys.argv[1:2]), *map(int, sys.argv[2:4]))
    keys = ("rays", "undecided", "hits", *FAULTS, "off level by 1e-12")
    for (method, kind), verdict in (verdicts | {("all", ""): sum(verdicts.values(), Counter())}).items():
        print(f"{method:13}{kind:23}", *(f"{key} {verdict[key]}" for key in keys))
