"""Does culling ever lose a quadric that shows a face that counts? Of very many points of quadrics, each seen by an eye.

python -m tests.quadric_culling 1e6 [seed]      so many points that face the eye; prints what was lost, and what gained

Quadrics of every class (`quadric_rays.QUADRICS`) in balls and in tetrahedra; points of each are found along random
lines by schoolbook formulas; a point faces the eye where (A y + b)·(eye − x) > 0, by more than rounding.
"""

from __future__ import annotations

import sys

import numpy as np
import torch

from filterlab.surfaces import Quadrics, Spheres, Tetrahedra
from tests.quadric_rays import QUADRICS

COUNT, LINES = 400, 24  # quadrics of a class at once, lines through each
SURE = 1e-9  # of |∇F| |eye − x|, what is no rounding
_CORNERS = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3)
Counts = dict[str, int]


def verdict(kind: str, bounds: str, seed: int) -> Counts:
    """Of quadrics of one class: how many points face the eye, how many of them belong to quadrics that were left out,
    how many quadrics show backs only, and how many of those were left out."""
    rng = np.random.default_rng([seed, sorted(QUADRICS).index(kind), bounds == "balls"])
    quadrics = [QUADRICS[kind](rng) for _ in range(COUNT)]
    A, b, c, o, center = (
        np.array([getattr(q, name) for q in quadrics]) for name in ("A", "b", "c", "origin", "center")
    )
    turned = np.linalg.qr(rng.normal(size=(COUNT, 3, 3)))[0]
    corners = center[:, None] + np.einsum("kj,mij->mki", _CORNERS, turned)
    eye = center.mean(0) + 10.0 ** rng.uniform(0.5, 4) * np.array([0.6, -0.64, 0.48])
    t = torch.from_numpy
    bound = Spheres(t(center), torch.ones(COUNT, dtype=torch.float64)) if bounds == "balls" else Tetrahedra(t(corners))
    kept = Quadrics(t(A), t(b), t(c), bound, t(o), faces="front").facing(t(eye)).numpy()
    x, there = points(rng, (A, b, c, o), center, corners if bounds == "tetrahedra" else None)
    gradient = np.einsum("mij,mkj->mki", A, x - o[:, None]) + b[:, None]
    way = eye - x
    size = np.linalg.norm(gradient, axis=-1) * np.linalg.norm(way, axis=-1)
    facing = np.einsum("mki,mki->mk", gradient, way) / np.maximum(size, 1e-300)
    front, back = there & (facing > SURE), there & (facing < -SURE)
    only_backs = back.any(1) & ~(there & (facing > -SURE)).any(1)
    return {
        "points that face the eye": int(front.sum()),
        "lost": int((front & ~kept[:, None]).sum()),
        "show backs only": int(only_backs.sum()),
        "of these left out": int((only_backs & ~kept).sum()),
    }


def points(rng: np.random.Generator, quadric, center: np.ndarray, corners: np.ndarray | None):
    """(M, K, 3) of quadrics (M) on random lines through their bounds, and which (M, K) are there and within these."""
    A, b, c, o = quadric
    start = center[:, None] + rng.uniform(-0.6, 0.6, (COUNT, LINES, 3)) - o[:, None]
    way = rng.normal(size=(COUNT, LINES, 3))
    times = lambda v: np.einsum("mij,mkj->mki", A, v)  # noqa: E731
    alpha = np.einsum("mki,mki->mk", way, times(way))
    beta = np.einsum("mki,mki->mk", way, times(start) + b[:, None])
    gamma = np.einsum("mki,mki->mk", start, times(start) + 2 * b[:, None]) + c[:, None]
    with np.errstate(all="ignore"):
        s = np.sqrt(beta**2 - alpha * gamma)
        k = -(beta + np.where(beta > 0, s, -s))
        root = np.concatenate((k / alpha, gamma / k), 1)
    there = np.isfinite(root)
    x = np.tile(start, (1, 2, 1)) + np.where(there, root, 0)[..., None] * np.tile(way, (1, 2, 1)) + o[:, None]
    if corners is None:
        return x, there & (np.linalg.norm(x - center[:, None], axis=-1) < 1)
    sides = np.linalg.solve(
        (corners[:, :3] - corners[:, 3:]).transpose(0, 2, 1)[:, None], (x - corners[:, 3:])[..., None]
    )
    return x, there & (sides[..., 0] > 0).all(-1) & (sides[..., 0].sum(-1) < 1)


def main(count: int, seed: int = 0) -> None:
    total: Counts = {}
    while total.get("points that face the eye", 0) < count:
        for kind in QUADRICS:
            for bounds in ("balls", "tetrahedra"):
                for name, n in verdict(kind, bounds, seed).items():
                    total[name] = total.get(name, 0) + n
        seed += 1
    print(total)


if __name__ == "__main__":
    main(int(float(sys.argv[1])), *map(int, sys.argv[2:]))
