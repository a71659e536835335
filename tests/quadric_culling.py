"""Does culling ever lose a quadric that shows a face that counts? Of very many points of quadrics, each seen by an eye.

python -m tests.quadric_culling 1e6 [seed]      so many points that face the eye; prints what was lost, and what gained

Quadrics of every class (`quadric_rays.QUADRICS`) in balls and in tetrahedra; points of each are found along random
lines by schoolbook formulas; a point faces the eye where (A y + b)·(eye − x) > 0, by more than rounding. Where only
backs are found, lines near the point that faces away least climb towards the eye: many of these show fronts after all.
What is counted as showing backs only is all the rest, so that what is left out of them is at least the share that is
printed.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
import torch

from filterlab.surfaces import Quadrics, Spheres, Tetrahedra
from tests.quadric_rays import QUADRICS

COUNT, LINES = 400, 24  # quadrics of a class at once, lines through each
TURNS, ANYWHERE = 40, 8  # of looking for fronts, of these by lines through all of the bounds
NARROWER = 0.7  # after a turn that found nothing better
SURE = 1e-9  # of |∇F| |eye − x|, what is no rounding
_CORNERS = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3)
Counts = dict[str, int]


@dataclass
class Seen:
    """Quadrics (M), in balls of radius 1 around their centers, or in tetrahedra, and where the eye is."""

    A: np.ndarray
    b: np.ndarray
    c: np.ndarray
    origin: np.ndarray
    center: np.ndarray
    corners: np.ndarray | None
    eye: np.ndarray

    @classmethod
    def of(cls, kind: str, bounds: str, count: int, rng: np.random.Generator) -> Self:
        quadrics = [QUADRICS[kind](rng) for _ in range(count)]
        *given, center = (
            np.array([getattr(q, name) for q in quadrics]) for name in ("A", "b", "c", "origin", "center")
        )
        turned = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
        corners = center[:, None] + np.einsum("kj,mij->mki", _CORNERS, turned)
        eye = center.mean(0) + 10.0 ** rng.uniform(0.5, 4) * np.array([0.6, -0.64, 0.48])
        return cls(*given, center, corners if bounds == "tetrahedra" else None, np.broadcast_to(eye, center.shape))

    def some(self, rows: np.ndarray) -> Seen:
        return Seen(*(x if (x := getattr(self, field.name)) is None else x[rows] for field in fields(self)))

    def kept(self) -> np.ndarray:
        t = torch.from_numpy
        bound = Spheres(t(self.center), 1.0) if self.corners is None else Tetrahedra(t(self.corners))
        quadrics = Quadrics(t(self.A), t(self.b), t(self.c), bound, t(self.origin), faces="front")
        return quadrics.facing(t(self.eye[0].copy())).numpy()

    def points(self, start: np.ndarray, way: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(M, 2 K, 3) where lines through world points (M, K, 3) meet the quadrics, and the cosine (M, 2 K) of the
        angle between normal and way to the eye there; NaN where there is nothing within the bounds."""
        x = self._met(start - self.origin[:, None], way) + self.origin[:, None]
        gradient = np.einsum("mij,mkj->mki", self.A, x - self.origin[:, None]) + self.b[:, None]
        to_eye = self.eye[:, None] - x
        size = np.linalg.norm(gradient, axis=-1) * np.linalg.norm(to_eye, axis=-1)
        facing = np.einsum("mki,mki->mk", gradient, to_eye) / np.maximum(size, 1e-300)
        return x, np.where(self._within(x), facing, np.nan)

    def _met(self, start: np.ndarray, way: np.ndarray) -> np.ndarray:
        alpha = np.einsum("mki,mij,mkj->mk", way, self.A, way, optimize=True)
        turned = np.einsum("mij,mkj->mki", self.A, start) + self.b[:, None]
        beta = np.einsum("mki,mki->mk", way, turned)
        gamma = np.einsum("mki,mki->mk", start, turned + self.b[:, None]) + self.c[:, None]
        with np.errstate(all="ignore"):
            s = np.sqrt(beta**2 - alpha * gamma)
            k = -(beta + np.where(beta > 0, s, -s))
            root = np.concatenate((k / alpha, gamma / k), 1)
            return np.tile(start, (1, 2, 1)) + root[..., None] * np.tile(way, (1, 2, 1))

    def _within(self, x: np.ndarray) -> np.ndarray:
        """(M, K) of points (M, K, 3)."""
        with np.errstate(all="ignore"):
            if self.corners is None:
                return np.linalg.norm(x - self.center[:, None], axis=-1) < 1
            last = self.corners[:, 3:]
            sides = np.einsum("mij,mkj->mki", np.linalg.inv((self.corners[:, :3] - last).transpose(0, 2, 1)), x - last)
            return (sides > 0).all(-1) & (sides.sum(-1) < 1)

    def anywhere(self, rng: np.random.Generator, lines: int) -> tuple[np.ndarray, np.ndarray]:
        """Random lines through the bounds, (M, K, 3) twice."""
        shape = (len(self.center), lines, 3)
        return self.center[:, None] + rng.uniform(-0.6, 0.6, shape), rng.normal(size=shape)

    def highest(self, rng: np.random.Generator) -> np.ndarray:
        """(M,) the largest cosine of all that is found by climbing towards the eye."""
        best, at = np.full(len(self.center), -np.inf), self.center.copy()
        width = np.full(len(self.center), 0.5)
        for turn in range(TURNS):
            start, way = self.anywhere(rng, 2 * LINES)
            if turn >= ANYWHERE:
                start = at[:, None] + width[:, None, None] * rng.normal(size=start.shape)
            x, facing = self.points(start, way)
            facing = np.nan_to_num(facing, nan=-np.inf)
            chosen = facing.argmax(1)[:, None]
            found, better = facing.max(1), facing.max(1) > best
            at = np.where(better[:, None], np.take_along_axis(x, chosen[..., None], 1)[:, 0], at)
            best = np.maximum(best, found)
            width *= np.where(better | (turn < ANYWHERE), 1, NARROWER)
        return best


def verdict(kind: str, bounds: str, seed: int, count: int = COUNT) -> Counts:
    """Of quadrics of one class: how many points face the eye, how many of them belong to quadrics that were left out,
    how many quadrics show backs only as far as can be found, and how many of those were left out."""
    rng = np.random.default_rng([seed, sorted(QUADRICS).index(kind), bounds == "balls"])
    seen = Seen.of(kind, bounds, count, rng)
    kept = seen.kept()
    _, facing = seen.points(*seen.anywhere(rng, LINES))
    front = facing > SURE
    backs = np.nonzero((facing < -SURE).any(1) & ~(facing > -SURE).any(1))[0]
    highest = seen.some(backs).highest(rng)
    lost = int((front & ~kept[:, None]).sum()) + int(((highest > SURE) & ~kept[backs]).sum())
    backs = backs[highest < -SURE]
    return {
        "points that face the eye": int(front.sum()),
        "lost": lost,
        "show backs only": len(backs),
        "of these left out": int((~kept[backs]).sum()),
    }


def main(count: int, seed: int = 0) -> None:
    total: dict[str, Counts] = {"balls": {}, "tetrahedra": {}}
    while sum(own.get("points that face the eye", 0) for own in total.values()) < count:
        for kind in QUADRICS:
            for bounds, own in total.items():
                for name, n in verdict(kind, bounds, seed).items():
                    own[name] = own.get(name, 0) + n
        seed += 1
    print(total)


if __name__ == "__main__":
    main(int(float(sys.argv[1])), *map(int, sys.argv[2:]))
