"""Very many steps of descent through the hits of small covers and of single quadrics: is any number ever not finite?

python -m tests.slim_descent 1e5 [seed]     so many steps of both; prints how many were made, and what was not finite

The target is the unit sphere. Ten scenes that are far apart go down at once: each number has its own moments, so each
goes as it would alone, and a step of all is ten steps of one. Every few hundred steps new starts are drawn, so that
most steps are made where hits still come and go.
All numbers are free: places, logarithms of radii, A, b and c of covers; A, b, c and origins of quadrics, whose balls
stay. Rays come from all around, some through centres, some that touch balls, some from inside.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from filterlab.surfaces import Quadrics, Slim, Spheres, Surface

SCENES, APART = 10, 100.0
BALLS, RAYS, STEPS = 24, 24, 250  # of each
PARTS = 20  # after each of which it is told how far it has come
RATE = 0.02
Numbers = dict[str, Tensor]


def places(each: int) -> Tensor:
    """(SCENES · each, 3) of the middles of scenes."""
    at = torch.arange(SCENES, dtype=torch.float64)
    return APART * torch.stack((at, at**2, at**3), 1).repeat_interleave(each, 0)


def start(rng: np.random.Generator) -> Numbers:
    """Discs in balls around unit spheres, off by noise, more in one scene than in another."""
    count = SCENES * BALLS
    rough = torch.from_numpy(10.0 ** rng.uniform(-1.5, 0.3, SCENES)).repeat_interleave(BALLS)[:, None]
    drawn = lambda *shape: torch.from_numpy(rng.normal(size=shape))  # noqa: E731
    normal = torch.nn.functional.normalize(drawn(count, 3), dim=1)
    bent = 0.5 * torch.eye(3, dtype=torch.float64).expand(count, 3, 3)
    return {
        "centers": places(BALLS) + normal + 0.1 * rough * drawn(count, 3),
        "sizes": np.log(0.6) + 0.2 * rough[:, 0] * drawn(count),
        "A": bent + 0.5 * rough[..., None] * drawn(count, 3, 3),
        "b": normal / 2 + 0.2 * rough * drawn(count, 3),
        "c": 0.05 * rough[:, 0] * drawn(count),
    }


def cover(numbers: Numbers) -> Surface:
    centers, sizes, *rest = numbers.values()
    return Slim(centers, sizes.exp(), *rest)


def quadrics(numbers: Numbers) -> Surface:
    centers, sizes, A, b, c = numbers.values()
    bounds = Spheres(centers.detach(), sizes.detach().exp())
    return Quadrics(A, b, c, bounds, centers, faces="front")


KINDS: dict[str, Callable[[Numbers], Surface]] = {"covers": cover, "quadrics": quadrics}


def rays(rng: np.random.Generator, numbers: Numbers) -> tuple[Tensor, Tensor]:
    """In each scene a quarter each: at random points near, through centres, that touch balls, from inside."""
    count = SCENES * RAYS
    way = rng.normal(size=(count, 3))
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    ball = np.arange(SCENES).repeat(RAYS) * BALLS + rng.integers(BALLS, size=count)
    centers, radii = numbers["centers"].detach().numpy()[ball], numbers["sizes"].detach().exp().numpy()[ball]
    side = np.cross(way, rng.normal(size=(count, 3)))
    side *= (radii / np.linalg.norm(side, axis=1))[:, None]
    kind, middle = np.arange(count)[:, None] % 4, places(RAYS).numpy()
    near = middle + rng.uniform(-1.2, 1.2, (count, 3))
    aim = np.select([kind == 0, kind == 1, kind == 2], [near, centers, centers + side], 0)
    origins = np.where(kind == 3, middle + rng.uniform(-0.3, 0.3, (count, 3)), aim - 4 * way)
    return torch.from_numpy(origins), torch.from_numpy(way)


def misfit(surface: Surface, origins: Tensor, directions: Tensor) -> Tensor:
    """Squares of what depths and normals are apart from those of unit spheres, where both are hit."""
    own = origins - places(RAYS)
    middle = (own * directions).sum(-1)
    half = (middle**2 - (own**2).sum(-1) + 1).clamp_min(0).sqrt()
    wanted = -middle - half
    found = surface.hit(origins, directions)
    at = surface.at(origins, directions, found)
    both = found.valid & (half > 0) & (wanted > 0)
    apart = torch.where(both, found.t, 0) - torch.where(both, wanted, 0)
    turned = torch.where(both[:, None], at.normal - (own + wanted[:, None] * directions), 0)
    return (apart.square().sum() + turned.square().sum()) / RAYS


def descended(kind: str, steps: int, seed: int) -> dict[str, int]:
    """Steps made, in how many scenes some gradient was not 0, in how many steps something was not finite: loss,
    gradients or numbers."""
    total = {"steps": 0, "starts": 0, "with gradient": 0, "not finite": 0}
    rng = np.random.default_rng([seed, sorted(KINDS).index(kind)])
    while total["steps"] < steps:
        total["starts"] += SCENES
        numbers = start(rng)
        adam = torch.optim.Adam([x.requires_grad_() for x in numbers.values()], RATE, betas=(0.9, 0.99), foreach=True)
        for _ in range(min(STEPS, math.ceil((steps - total["steps"]) / SCENES))):
            adam.zero_grad()
            loss = misfit(KINDS[kind](numbers), *rays(rng, numbers))
            total["steps"] += SCENES
            loss.backward()
            seen = [loss.detach(), *(x.grad for x in numbers.values() if x.grad is not None)]
            adam.step()
            seen += [x.detach() for x in numbers.values()]
            total["with gradient"] += int((numbers["c"].grad.reshape(SCENES, -1) != 0).any(1).sum())
            if not bool(torch.cat([x.reshape(-1) for x in seen]).isfinite().all()):
                total["not finite"] += 1
                break
    return total


def main(steps: int, seed: int = 0) -> None:
    torch.set_num_threads(1)
    for kind in KINDS:
        total: dict[str, int] = {}
        for part in range(PARTS):
            for name, n in descended(kind, steps // PARTS, seed + part).items():
                total[name] = total.get(name, 0) + n
            print(kind, total, flush=True)


if __name__ == "__main__":
    main(int(float(sys.argv[1])), *map(int, sys.argv[2:]))
