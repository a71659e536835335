"""Very many steps of descent through the hits of small covers and of single quadrics: is any number ever not finite?

python -m tests.slim_descent 1e5 [seed] [KIND …]    so many steps of each kind; prints how many were made, and what was
                                                    not finite

The target is the unit sphere. Scenes that are apart go down at once, ten, or 40 in an image: each number has its own
moments, so each goes as it would alone, and a step of all is as many steps of one. Every few hundred steps new starts
are drawn, so that most steps are made where hits still come and go.
What is free are all numbers of covers, places, logarithms of radii, A, b and c; A, b, c and origins of quadrics, whose
balls stay; or the points that covers were fitted to, off spheres by noise, and each step fits them again. Rays come
from all around, some through centres, some that touch balls, some from inside. Images are small ones, of scenes in a
row, from a direction that is drawn for each step; compared are depths, normals and masks, whose derivatives are those
of silhouettes.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from filterlab.render import OrthographicCamera, Silhouettes, raycast
from filterlab.surfaces import Quadrics, Slim, Spheres, Surface, fit_slim

APART, BESIDE = 100.0, 4.0  # of scenes, far apart and in a row
BALLS, RAYS, STEPS = 24, 24, 250  # of each
PARTS = 5  # after each of which it is told how far it has come
POINTS, LEAST, TOLERANCE = 150, 12, 0.1  # of a sphere, of a ball, and of a fit, in the world
PIXELS = 5  # of an image, a scene's height
Numbers = dict[str, Tensor]
Rng = np.random.Generator
Build = Callable[[Numbers], Surface]


_NUMBER = torch.arange(10, dtype=torch.float64)
FAR = APART * torch.stack((_NUMBER, _NUMBER**2, _NUMBER**3), 1)
"""(S, 3) middles of scenes."""
ROW = torch.zeros(40, 3, dtype=torch.float64)
ROW[:, 0] = BESIDE * torch.arange(40)


def rough(rng: Rng, scenes: int) -> Tensor:
    """(S, 1) how far off starts are."""
    return torch.from_numpy(10.0 ** rng.uniform(-1.5, 0.3, (scenes, 1)))


def start(rng: Rng, places: Tensor) -> Numbers:
    """Discs in balls around unit spheres, off by noise, more in one scene than in another."""
    count, off = len(places) * BALLS, rough(rng, len(places)).repeat_interleave(BALLS, 0)
    drawn = lambda *shape: torch.from_numpy(rng.normal(size=shape))  # noqa: E731
    normal = torch.nn.functional.normalize(drawn(count, 3), dim=1)
    bent = 0.5 * torch.eye(3, dtype=torch.float64).expand(count, 3, 3)
    return {
        "centers": places.repeat_interleave(BALLS, 0) + normal + 0.1 * off * drawn(count, 3),
        "sizes": np.log(0.6) + 0.2 * off[:, 0] * drawn(count),
        "A": bent + 0.5 * off[..., None] * drawn(count, 3, 3),
        "b": normal / 2 + 0.2 * off * drawn(count, 3),
        "c": 0.05 * off[:, 0] * drawn(count),
    }


def cover(numbers: Numbers) -> Slim:
    centers, sizes, *rest = numbers.values()
    return Slim(centers, sizes.exp(), *rest)


def quadrics(numbers: Numbers) -> Surface:
    centers, sizes, A, b, c = numbers.values()
    bounds = Spheres(centers.detach(), sizes.detach().exp())
    return Quadrics(A, b, c, bounds, centers, faces="front")


def fitted(rng: Rng, places: Tensor) -> tuple[Numbers, Build]:
    """Points of unit spheres, off by noise, and the cover that was fitted to them."""
    way = torch.nn.functional.normalize(torch.from_numpy(rng.normal(size=(len(places), POINTS, 3))), dim=-1)
    off = 0.1 * rough(rng, len(places))[..., None] * torch.from_numpy(rng.normal(size=way.shape))
    points, way = (places[:, None] + way + off).flatten(0, 1), way.flatten(0, 1)
    diagonal = float((points.amax(0) - points.amin(0)).norm())
    slim = fit_slim(points, way, TOLERANCE / diagonal, least=LEAST)
    return {"points": points}, lambda numbers: slim.refitted(numbers["points"])


def balls_of(surface: Surface) -> tuple[Tensor, Tensor]:
    """Centres and radii."""
    own = surface.bounds if isinstance(surface, Quadrics) else surface
    assert isinstance(own, Slim | Spheres)
    return own.centers.detach(), own.radii.detach()


def rays(rng: Rng, surface: Surface) -> tuple[Tensor, Tensor]:
    """In each scene a quarter each: at random points near, through centres, that touch balls, from inside."""
    count = len(FAR) * RAYS
    way = rng.normal(size=(count, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    every, sizes = balls_of(surface)
    scene = torch.cdist(every, FAR).argmin(1).numpy()
    ball = np.concatenate([rng.choice(np.flatnonzero(scene == k), RAYS) for k in range(len(FAR))])
    centers, radii = every.numpy()[ball], sizes.numpy()[ball]
    side = np.cross(way, rng.normal(size=(count, 3)))
    side *= (radii / np.linalg.norm(side, axis=1))[:, None]
    kind, middle = np.arange(count)[:, None] % 4, FAR.repeat_interleave(RAYS, 0).numpy()
    near = middle + rng.uniform(-1.2, 1.2, (count, 3))
    aim = np.select([kind == 0, kind == 1, kind == 2], [near, centers, centers + side], 0)
    origins = np.where(kind == 3, middle + rng.uniform(-0.3, 0.3, (count, 3)), aim - 4 * way)
    return torch.from_numpy(origins), torch.from_numpy(way)


def misfit(rng: Rng, surface: Surface) -> Tensor:
    """Squares of what depths and normals are apart from those of unit spheres, where both are hit."""
    origins, directions = rays(rng, surface)
    own = origins - FAR.repeat_interleave(RAYS, 0)
    middle = (own * directions).sum(-1)
    half = (middle**2 - (own**2).sum(-1) + 1).clamp_min(0).sqrt()
    wanted = -middle - half
    found = surface.hit(origins, directions)
    at = surface.at(origins, directions, found)
    both = found.valid & (half > 0) & (wanted > 0)
    apart = torch.where(both, found.t, 0) - torch.where(both, wanted, 0)
    turned = torch.where(both[:, None], at.normal - (own + wanted[:, None] * directions), 0)
    return (apart.square().sum() + turned.square().sum()) / RAYS


def unlike(rng: Rng, surface: Surface) -> Tensor:
    """Squares of what images are apart from those of unit spheres: of masks, and of depths and normals of both."""
    turn, tilt = rng.uniform(0, 2 * np.pi), rng.uniform(-0.3, 0.3)
    up = np.array([0, -np.sin(turn), np.cos(turn)])
    way = np.array([np.sin(tilt), *(np.cos(tilt) * np.array([np.cos(turn), np.sin(turn)]))])
    middle, high = ROW.mean(0).numpy(), 1.3 * BESIDE / 2
    camera = OrthographicCamera(position=tuple(middle - 40 * way), target=tuple(middle), up=tuple(up), height=high)
    size = round(len(ROW) * PIXELS * BESIDE / high), PIXELS
    given = {"size": size, "channels": ("color", "depth", "normal"), "dtype": torch.float64}
    edges = {"silhouettes": Silhouettes(), "seed": int(rng.integers(1 << 30))}
    found = raycast(surface, camera, **given, **edges)
    wanted = raycast(Quadrics.ellipsoids(ROW, torch.ones(len(ROW), dtype=torch.float64)), camera, **given)
    mask = (found["color"] - wanted["color"])[..., 3].square().sum()
    both = found["depth"].isfinite() & wanted["depth"].isfinite()
    depth = torch.where(both, found["depth"], 0) - torch.where(both, wanted["depth"], 0)
    turned = torch.where(both, found["normal"] - wanted["normal"], 0)
    return (mask + depth.square().sum() + turned.square().sum()) / PIXELS**2


class Kind(NamedTuple):
    """What goes down.

    Attributes:
        begun: numbers to start from, and the surface of them, for scenes in places.
        places: (S, 3).
        apart: what is made small.
        rate: of steps, at most.
    """

    begun: Callable[[Rng, Tensor], tuple[Numbers, Build]]
    places: Tensor
    apart: Callable[[Rng, Surface], Tensor]
    rate: float


KINDS = {
    "covers": Kind(lambda *given: (start(*given), cover), FAR, misfit, 0.02),
    "quadrics": Kind(lambda *given: (start(*given), quadrics), FAR, misfit, 0.02),
    "points": Kind(fitted, FAR, misfit, 0.005),
    "images of covers": Kind(lambda *given: (start(*given), cover), ROW, unlike, 0.02),
    "images of points": Kind(fitted, ROW, unlike, 0.005),
}


def descended(kind: str, steps: int, seed: int) -> dict[str, int]:
    """Steps made, in how many scenes some gradient was not 0, in how many steps something was not finite: loss,
    gradients or numbers."""
    total = {"steps": 0, "starts": 0, "with gradient": 0, "not finite": 0}
    rng = np.random.default_rng([seed, list(KINDS).index(kind)])
    begun, places, apart, rate = KINDS[kind]
    while total["steps"] < steps:
        total["starts"] += len(places)
        numbers, build = begun(rng, places)
        adam = torch.optim.Adam([x.requires_grad_() for x in numbers.values()], rate, betas=(0.9, 0.99), foreach=True)
        for _ in range(min(STEPS, math.ceil((steps - total["steps"]) / len(places)))):
            adam.zero_grad()
            loss = apart(rng, build(numbers))
            total["steps"] += len(places)
            loss.backward()
            gradients = [x.grad for x in numbers.values() if x.grad is not None]
            adam.step()
            seen = [loss.detach(), *gradients, *(x.detach() for x in numbers.values())]
            total["with gradient"] += int((gradients[-1].reshape(len(places), -1) != 0).any(1).sum())
            if not bool(torch.cat([x.reshape(-1) for x in seen]).isfinite().all()):
                total["not finite"] += 1
                break
    return total


def main(steps: int, seed: int = 0, *kinds: str) -> None:
    torch.set_num_threads(1)
    for kind in kinds or KINDS:
        total: dict[str, int] = {}
        for part in range(PARTS):
            for name, n in descended(kind, steps // PARTS, seed + part).items():
                total[name] = total.get(name, 0) + n
            print(kind, total, flush=True)


if __name__ == "__main__":
    main(int(float(sys.argv[1])), *map(int, sys.argv[2:3]), *sys.argv[3:])
