"""Many rays of every class at quadrics and at bilinear quads of every class, judged by 64 bits, and exactly where not.

python -m tests.quadric_many 600 [seed]     for so many seconds; prints what was missed or invented, and of how many

A ray is judged at once where numbers of 64 bits tell all that `quadric_oracle` would: its signs are certain by a
thousand times their rounding, or its hits are within what rounding of float64 may move. All that is left, and whatever
seems wrong, goes to the oracle's 400 bits, and only that may say that a hit is missed or invented.
"""

from __future__ import annotations

import itertools
import sys
import time
from collections.abc import Callable

import numpy as np
import torch

from filterlab.surfaces import BilinearQuads
from tests import quadric_oracle
from tests.quadric_oracle import EPS, ROUNDED, Quadric
from tests.quadric_rays import QUADRICS, SHEETS, surface_of

Rng = np.random.Generator
Rays = tuple[np.ndarray, np.ndarray]
Long = np.longdouble
CERTAIN = 1e-3  # of a slack, by which a number may be off that is compared with it
FAR = 2e-6  # of the distance, by up to which hits of float32 rays are off


# --- rays, many at one quadric ----------------------------------------------------------------------------------------


def ways(rng: Rng, count: int) -> np.ndarray:
    way = rng.normal(size=(count, 3))
    return way / np.linalg.norm(way, axis=1, keepdims=True)


def aimed(rng: Rng, quadric: Quadric, distance, at: np.ndarray) -> Rays:
    origin = quadric.center + np.asarray(distance).reshape(-1, 1) * ways(rng, len(at))
    return origin, (at - origin) * 10.0 ** rng.uniform(-6, 6, (len(at), 1))


def about(rng: Rng, quadric: Quadric, count: int) -> np.ndarray:
    return quadric.center + rng.uniform(-0.6, 0.6, (count, 3))


def inside(rng: Rng, quadric: Quadric, count: int) -> Rays:
    return quadric.center + rng.uniform(-0.5, 0.5, (count, 3)), rng.normal(size=(count, 3))


def eyes(rng: Rng, quadric: Quadric, count: int) -> Rays:
    """3 to 3,000 radii away."""
    return aimed(rng, quadric, 3 * 1000 ** rng.uniform(0, 1, count), about(rng, quadric, count))


def far(rng: Rng, quadric: Quadric, count: int) -> Rays:
    return aimed(rng, quadric, 10.0 ** rng.uniform(3, 6, count), about(rng, quadric, count))


def through_center(rng: Rng, quadric: Quadric, count: int) -> Rays:
    return aimed(rng, quadric, 10.0 ** rng.uniform(0.5, 3, count), np.tile(quadric.center, (count, 1)))


def along_axes(rng: Rng, quadric: Quadric, count: int) -> Rays:
    _, axes = np.linalg.eigh(quadric.A)
    direction = axes.T[rng.integers(3, size=count)] * rng.choice([-1, 1], (count, 1))
    return about(rng, quadric, count) - 5 * direction, direction


def asymptotic(rng: Rng, quadric: Quadric, count: int) -> Rays:
    """α from 1 to 1e-12 of |A| and less."""
    values, axes = np.linalg.eigh(quadric.A)
    low, high = max(-values[0], 0), max(values[2], 0)
    direction = axes[:, 0] * np.sqrt(high) + axes[:, 2] * np.sqrt(low) if low * high else axes[:, 1]
    direction = direction / max(np.linalg.norm(direction), 1e-300)
    direction = direction + 10.0 ** -rng.uniform(0, 16, (count, 1)) * rng.normal(size=(count, 3))
    return about(rng, quadric, count) - 4 * direction, direction


def tangent(rng: Rng, quadric: Quadric, count: int) -> Rays:
    """At right angles with the gradient at points of the surface, off by 1e-2 … 1e-18."""
    x = about(rng, quadric, count) - quadric.origin
    for _ in range(30):
        g = 2 * (x @ quadric.A + quadric.b)
        value = (x * (x @ quadric.A + 2 * quadric.b)).sum(1) + quadric.c
        x = x - g * (value / np.maximum((g * g).sum(1), 1e-300))[:, None]
    side = np.cross(x @ quadric.A + quadric.b, rng.normal(size=(count, 3)))
    side = side / np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-300)
    side[~side.any(1)] = ways(rng, int((~side.any(1)).sum()))
    return x + quadric.origin - 3 * side + 10.0 ** -rng.uniform(2, 18, (count, 1)) * rng.normal(size=(count, 3)), side


RAYS: dict[str, Callable[[Rng, Quadric, int], Rays]] = {
    f.__name__: f for f in (inside, eyes, far, through_center, along_axes, asymptotic, tangent)
}


# --- what is expected, in 64 bits -------------------------------------------------------------------------------------


class Expected:
    """Of rays (R, 3) at one quadric, as `quadric_oracle` has it for each.

    Attributes:
        t: (R, 2) of front and back; where a ray touches, the same twice.
        moved: (R, 2) by how much rounding may move it.
        there, surely: (R, 2) whether it may be, and surely is, within all bounds.
        touches: (R,). sure: (R,) whether all of this is certain.
    """

    def __init__(self, quadric: Quadric, origins: np.ndarray, directions: np.ndarray) -> None:
        e, v = origins.astype(Long), directions.astype(Long)
        A, b, o, center = (np.asarray(x, Long) for x in (quadric.A, quadric.b, quadric.origin, quadric.center))
        square = (v * v).sum(1)
        length = np.sqrt(square)
        behind = ((center - e) * v).sum(1) / square
        y = e + behind[:, None] * v - o
        turned = times(A, y)
        alpha, beta = (v * times(A, v)).sum(1), (v * (turned + b)).sum(1)
        gamma = (y * (turned + 2 * b)).sum(1) + Long(quadric.c)
        reach = np.abs(center - o) + np.abs(y + o - center)
        speed, bent = np.abs(v), times(np.abs(A), reach)
        place = ROUNDED * EPS * np.maximum(np.abs(e).max(1), max(np.abs(center).max(), np.abs(o).max()))
        norm, size = np.sqrt((A * A).sum()), ROUNDED * EPS
        force = norm * (np.sqrt((reach * reach).sum(1)) + place) + np.sqrt((b * b).sum())
        off_a = size * (speed * times(np.abs(A), speed)).sum(1)
        off_b = size * (speed * (bent + np.abs(b))).sum(1) + length * norm * place
        off_c = size * ((reach * (bent + 2 * np.abs(b))).sum(1) + abs(quadric.c)) + 2 * force * place
        a, h, g = np.abs(alpha), np.abs(beta), np.abs(gamma)
        slack = 2 * h * off_b + off_a * g + a * off_c + off_b**2 + off_a * off_c
        radicand = beta**2 - alpha * gamma
        self.touches = np.abs(radicand) <= slack
        none = radicand < -slack
        on = (a <= 2 * off_a) & (h <= 2 * off_b) & (g <= 2 * off_c)
        self.sure = (np.abs(np.abs(radicand) - slack) > CERTAIN * slack) & ~on
        with np.errstate(all="ignore"):
            s = np.sqrt(np.maximum(radicand, 0))
            sign = np.where(beta > 0, 1, -1)
            far_root, near_root = -(beta + sign * s) / alpha, -gamma / (beta + sign * s)  # one of them of each side
            front, back = np.where(beta > 0, far_root, near_root), np.where(beta > 0, near_root, far_root)
            one = -beta / alpha
            roots = np.where(self.touches[:, None], np.stack((one, one), 1), np.stack((front, back), 1))
            off = off_a[:, None] * roots**2 + 2 * off_b[:, None] * np.abs(roots) + off_c[:, None]
            moved = np.where(self.touches[:, None], (2 * np.sqrt(slack) / a)[:, None], off / s[:, None])
            moved = moved + size * (np.abs(roots) + (np.abs(behind) + quadric.radius / length)[:, None])
            self.t, self.moved = behind[:, None] + roots, moved
            margin = self._within(quadric, e, v, length)
            slack = moved * length[:, None] + size * (place / size + quadric.radius)[:, None]
            self.there = (margin >= -slack * (1 + CERTAIN)) & np.isfinite(roots) & ~none[:, None]
            self.surely = (margin > slack * (1 + CERTAIN)) & self.there

    def _within(self, quadric: Quadric, e: np.ndarray, v: np.ndarray, length: np.ndarray) -> np.ndarray:
        """(R, 2) by how far hits are within bounds."""
        x = e[:, None] + self.t[..., None] * v[:, None]
        from_center = x - np.asarray(quadric.center, Long)
        inner = quadric.radius - np.sqrt((from_center**2).sum(-1))
        inner = np.minimum(inner, self.t * length[:, None])
        for plane in quadric.planes:
            n = np.asarray(plane[:3], Long)
            inner = np.minimum(inner, -((x * n).sum(-1) + Long(plane[3])) / np.sqrt((n * n).sum()))
        return np.where(np.isnan(inner), -np.inf, inner)

    def met(self, found: np.ndarray, side: int, must: np.ndarray, far: np.ndarray | float = 0.0) -> np.ndarray:
        """Which rays (R,) are surely right: found t (R, k) of fronts, 0, or backs, 1, that are there if they `must`."""
        count = np.isfinite(found).sum(1)
        with np.errstate(all="ignore"):
            near = np.abs(found[:, 0] - self.t[:, side]) <= self.moved[:, side] * (1 - CERTAIN) + far
        right = (count == 0) | ((count == 1) & self.there[:, side] & near)
        return self.sure & right & ((count == 1) | ~(must & self.surely[:, side]))


def times(A: np.ndarray, x: np.ndarray) -> np.ndarray:
    """A x, of rows."""
    return (A * x[:, None]).sum(-1)


# --- verdicts ---------------------------------------------------------------------------------------------------------


def cast(quadric: Quadric, rays: Rays, faces: str, dtype: torch.dtype = torch.float64) -> np.ndarray:
    """t (R, k) of all hits."""
    surface = surface_of([quadric], faces)
    return surface.hits(*(torch.from_numpy(x).to(dtype) for x in rays), SHEETS).t.double().numpy()


def verdict(kind: str, rays: str, count: int, seed: int) -> dict[str, int]:
    """Of so many rays at one quadric: hits expected, judged exactly, missed, invented; of float32 rays missed."""
    rng = np.random.default_rng([seed, sorted(QUADRICS).index(kind), sorted(RAYS).index(rays)])
    quadric = QUADRICS[kind](rng)
    origins, directions = RAYS[rays](rng, quadric, count)
    expected, double = Expected(quadric, origins, directions), kind == "double_plane"
    found = [cast(quadric, (origins, directions), faces) for faces in ("front", "back")]
    must = [~expected.touches | double, ~expected.touches]
    right = expected.met(found[0], 0, must[0]) & expected.met(found[1], 1, must[1])
    total = {"rays": count, "expected": int(expected.surely.sum()), "exactly": int((~right).sum())}
    total |= {"missed": 0, "invented": 0} | of_float32(quadric, origins, directions)
    for i in np.flatnonzero(~right):
        if quadric_oracle.lies_on(quadric, origins[i], directions[i]):
            continue
        known = quadric_oracle.crossings(quadric, origins[i], directions[i])
        for side, t in enumerate(found):
            for name, n in quadric_oracle.judged(known, t[i], side == 0, double).items():
                total[name] += n
    return total


def of_float32(quadric: Quadric, origins: np.ndarray, directions: np.ndarray) -> dict[str, int]:
    """Of the same rays in float32: how many do not find a hit that is surely there, to 2e-6 of the distance."""
    rays = origins.astype(np.float32).astype(np.float64), directions.astype(np.float32).astype(np.float64)
    given = (rays[1] != 0).any(1) & np.isfinite(rays[1]).all(1)
    rays = rays[0][given], rays[1][given]
    expected = Expected(quadric, *rays)
    distance = np.linalg.norm(rays[0] - quadric.center, axis=1) + quadric.radius
    off = FAR * distance / np.linalg.norm(rays[1], axis=1)
    wrong, count = 0, 0
    for side, faces in enumerate(("front", "back")):
        t = cast(quadric, rays, faces, torch.float32)
        clear = expected.sure & ~expected.touches & expected.surely[:, side]
        with np.errstate(all="ignore"):
            near = np.abs(t - expected.t[:, side, None].astype(float)) <= (off + expected.moved[:, side])[:, None]
        wrong, count = wrong + int((clear & ~near.any(1)).sum()), count + int(clear.sum())
    return {"float32": count, "float32 off": wrong}


# --- bilinear quads ---------------------------------------------------------------------------------------------------

SURE = 1e-12  # of the size, and by how steeply a ray meets a patch, how far u and v have to be from 0 and 1


def patch(rng: Rng, height: float) -> np.ndarray:
    flat = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]]) + 0.12 * rng.normal(size=(4, 3))
    flat[:, 2] = height * (rng.uniform(size=4) - 0.5)
    return flat @ np.linalg.qr(rng.normal(size=(3, 3)))[0] + rng.uniform(-50, 50, 3)


def on_patch(corners: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    a, b, c, d = corners
    u, v = u[:, None], v[:, None]
    return (1 - u) * (1 - v) * a + u * (1 - v) * b + u * v * c + (1 - u) * v * d


def crossings_of_patch(corners: np.ndarray, rays: Rays) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """t (R, 2), by how much rounding may move it, and whether (R, 2) they surely are hits, and may be: by the lines of
    constant v that are met."""
    e, v = (x.astype(Long) for x in rays)
    p1, p2, p3, p4 = corners.astype(Long)
    v = v / np.sqrt((v * v).sum(1, keepdims=True))
    start = ((corners.mean(0) - e) * v).sum(1)
    q = e + start[:, None] * v - p1
    a, d, h = p2 - p1, p4 - p1, p1 - p2 + p3 - p4
    moment, side = np.cross(q, v), np.cross(np.broadcast_to(d, v.shape), v)
    c0, c1, c2 = moment @ a, moment @ h - side @ a, -(side @ h)
    with np.errstate(all="ignore"):
        s = np.sqrt(c1 * c1 - 4 * c0 * c2)
        k = -(c1 + np.where(c1 > 0, s, -s)) / 2
        w = np.stack((k / c2, c0 / k), 1)  # v of lines that are met
        line = a + w[..., None] * h
        n = np.cross(v[:, None], line)
        way = w[..., None] * d - q[:, None]
        square = (n * n).sum(-1)
        u = (np.cross(way, v[:, None]) * n).sum(-1) / square
        t = (np.cross(way, line) * n).sum(-1) / square + start[:, None]
        off = SURE * (1 + 1 / np.abs(s))[:, None] / np.sqrt(square) + SURE * np.abs(start)[:, None] * 1e-4
        inner = np.minimum(np.minimum(u, 1 - u), np.minimum(w, 1 - w))
        ahead = t > 1e-9
        return t, 10 * off, (inner > off) & ahead, (inner > -off) & ahead


def patch_verdict(height: float, count: int, seed: int) -> dict[str, int]:
    """Of rays at one patch, at points of it and beside it, 3 to 3,000 sizes away."""
    rng = np.random.default_rng([seed, int(-np.log10(height + 1e-20))])
    corners = patch(rng, height)
    aim = on_patch(corners, *rng.uniform(-0.2, 1.2, (2, count)))
    way = ways(rng, count)
    origins = aim - 3 * 1000 ** rng.uniform(0, 1, (count, 1)) * way
    t, moved, surely, may = crossings_of_patch(corners, (origins, way))
    surface = BilinearQuads(torch.from_numpy(corners), torch.tensor([[0, 1, 2, 3]]))
    hits = surface.hits(torch.from_numpy(origins), torch.from_numpy(way), 3).t.numpy()
    with np.errstate(all="ignore"):
        near = np.abs(hits[:, :, None] - np.where(may, t, np.nan)[:, None]) <= moved[:, None]
    missed = surely & ~near.any(1)
    invented = np.isfinite(hits) & ~near.any(2)
    undecided = (may & ~surely).sum()
    return {
        "rays": count,
        "expected": int(surely.sum()),
        "missed": int(missed.sum()),
        "invented": int(invented.sum()),
        "undecided": int(undecided),
    }


HEIGHTS = (1.0, 1e-1, 1e-2, 1e-3, 1e-4, 1e-6, 0.0)


def main(seconds: float, seed: int = 0) -> None:
    totals: dict[str, dict[str, int]] = {}
    kinds, end = list(itertools.product(QUADRICS, RAYS)), time.monotonic() + seconds
    for number in itertools.count(seed):
        if time.monotonic() > end:
            break
        for kind, rays in kinds:
            slow = rays == "tangent" and "plane" in kind  # most of these lie on it, but for rounding
            add(totals.setdefault(rays, {}), own := verdict(kind, rays, 400 if slow else 20_000, number))
            add(totals.setdefault(kind, {}), own)
        for height in HEIGHTS:
            add(totals.setdefault(f"quads, height {height:g}", {}), patch_verdict(height, 100_000, number))
    for name, total in totals.items():
        print(name, total)


def add(total: dict[str, int], own: dict[str, int]) -> None:
    for name, n in own.items():
        total[name] = total.get(name, 0) + n


if __name__ == "__main__":
    main(float(sys.argv[1]), *map(int, sys.argv[2:]))
