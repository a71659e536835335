"""Many rays of every class at quadrics and at bilinear quads of every class, judged in float64, and exactly where not.

python -m tests.quadric_many 1e7 [seed] [quadrics | quads]     so many rays of each class; prints what was missed or
                                                                invented, of both or of one of them

A ray is judged at once where float64 tells all that `quadric_oracle` would. What that lets rounding move is 200 units
of the terms of a sum; what is computed here is off by ten at most, and a tenth is left on both sides of every bound:
signs and hits are certain beyond that. All that is left, and whatever seems wrong, goes to the oracle's 400 bits, and
only that may say that a hit is missed or invented. Rays at patches are judged in 64 bits; what those leave open is
counted.
"""

from __future__ import annotations

import sys
from collections.abc import Callable

import numpy as np
import torch

from filterlab.surfaces import BilinearQuads
from tests import quadric_oracle
from tests.quadric_oracle import EPS, ROUNDED, Quadric
from tests.quadric_rays import QUADRICS, SHEETS, surface_of

Rng = np.random.Generator
Rays = tuple[np.ndarray, np.ndarray]
Long = np.longdouble  # of patches
CERTAIN = 0.1  # of a slack, by which a number may be off that is compared with it
FAR = 2e-6  # of the distance, by up to which hits of float32 rays are off
WORST = "float32 worst"
Counts = dict[str, int | float]
AT_ONCE = 10_000  # rays at one quadric


# --- rays, many at one quadric ----------------------------------------------------------------------------------------


def ways(rng: Rng, count: int) -> np.ndarray:
    way = rng.normal(size=(count, 3))
    return way / np.linalg.norm(way, axis=1, keepdims=True)


def aimed(rng: Rng, quadric: Quadric, distance, at: np.ndarray) -> Rays:
    origin = quadric.center + np.asarray(distance).reshape(-1, 1) * ways(rng, len(at))
    return origin, (at - origin) * 10.0 ** rng.uniform(-6, 6, (len(at), 1))


def about(rng: Rng, quadric: Quadric, count: int) -> np.ndarray:
    return quadric.center + rng.uniform(-0.6, 0.6, (count, 3))


def anywhere(rng: Rng, quadric: Quadric, count: int) -> Rays:
    """Through two random points around."""
    origin, through = (quadric.center + rng.uniform(-2, 2, (count, 3)) for _ in range(2))
    return origin, through - origin


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
    f.__name__: f for f in (anywhere, inside, eyes, far, through_center, along_axes, asymptotic, tangent)
}


# --- what is expected, in float64 -------------------------------------------------------------------------------------


class Expected:
    """Of rays (R, 3) at one quadric, as `quadric_oracle` has it for each.

    Attributes:
        t: (R, 2) of front and back; where a ray touches, the same twice.
        moved: (R, 2) by how much rounding may move it.
        there, surely: (R, 2) whether it may be, and surely is, within all bounds.
        touches: (R,). sure: (R,) whether all of this is certain. on: (R,) whether the ray surely lies on the quadric.
    """

    def __init__(self, quadric: Quadric, origins: np.ndarray, directions: np.ndarray) -> None:
        e, v = origins, directions
        A, b, o, center = quadric.A, quadric.b, quadric.origin, quadric.center
        square = dot(v, v)
        length = np.sqrt(square)
        behind = dot(center - e, v) / square
        y = e + behind[:, None] * v - o
        turned = y @ A
        alpha, beta = dot(v, v @ A), dot(v, turned + b)
        gamma = dot(y, turned + 2 * b) + quadric.c
        reach = np.abs(center - o) + np.abs(y + o - center)
        speed, bent = np.abs(v), reach @ np.abs(A)
        size = ROUNDED * EPS
        place = size * np.maximum(np.abs(e).max(1), max(np.abs(center).max(), np.abs(o).max()))
        norm = np.sqrt((A * A).sum())
        force = norm * (np.sqrt(dot(reach, reach)) + place) + np.sqrt((b * b).sum())
        off_a = size * dot(speed, speed @ np.abs(A))
        off_b = size * dot(speed, bent + np.abs(b)) + length * norm * place
        off_c = size * (dot(reach, bent + 2 * np.abs(b)) + abs(quadric.c)) + 2 * force * place
        a, h, g = np.abs(alpha), np.abs(beta), np.abs(gamma)
        slack = 2 * h * off_b + off_a * g + a * off_c + off_b**2 + off_a * off_c
        radicand = beta**2 - alpha * gamma
        self.touches = np.abs(radicand) <= slack
        none = radicand < -slack
        pairs = ((a, off_a), (h, off_b), (g, off_c))
        self.on = np.logical_and.reduce([x <= (1 - CERTAIN) * off for x, off in pairs])
        beside = np.logical_or.reduce([x > (1 + CERTAIN) * off for x, off in pairs])
        self.sure = (np.abs(np.abs(radicand) - slack) > CERTAIN * slack) & beside
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
            self.surely = (margin > slack * (1 + CERTAIN)) & self.there & ~self.on[:, None]

    def _within(self, quadric: Quadric, e: np.ndarray, v: np.ndarray, length: np.ndarray) -> np.ndarray:
        """(R, 2) by how far hits are within bounds."""
        x = e[:, None] + self.t[..., None] * v[:, None]
        from_center = x - quadric.center
        inner = quadric.radius - np.sqrt(dot(from_center, from_center))
        inner = np.minimum(inner, self.t * length[:, None])
        for plane in quadric.planes:
            n = plane[:3]
            inner = np.minimum(inner, -(x @ n + plane[3]) / np.sqrt((n * n).sum()))
        return np.where(np.isnan(inner), -np.inf, inner)

    def met(self, found: np.ndarray, side: int, must: np.ndarray) -> np.ndarray:
        """Which rays (R,) are surely right: found t (R, k) of fronts, 0, or backs, 1, that are there if they `must`."""
        count = np.isfinite(found).sum(1)
        with np.errstate(all="ignore"):
            near = np.abs(found[:, 0] - self.t[:, side]) <= self.moved[:, side] * (1 - CERTAIN)
        right = (count == 0) | ((count == 1) & self.there[:, side] & near)
        return self.sure & right & ((count == 1) | ~(must & self.surely[:, side]))


def dot(u: np.ndarray, v: np.ndarray) -> np.ndarray:
    return np.einsum("...i,...i->...", u, v)


# --- verdicts ---------------------------------------------------------------------------------------------------------


def cast(quadric: Quadric, rays: Rays, faces: str, dtype: torch.dtype = torch.float64) -> np.ndarray:
    """t (R, k) of all hits."""
    surface = surface_of([quadric], faces)
    return surface.hits(*(torch.from_numpy(x).to(dtype) for x in rays), SHEETS).t.double().numpy()


def verdict(kind: str, rays: str, count: int, seed: int) -> Counts:
    """Of so many rays at one quadric: hits expected, judged exactly, missed, invented; of float32 rays `of_float32`."""
    rng = np.random.default_rng([seed, sorted(QUADRICS).index(kind), sorted(RAYS).index(rays)])
    quadric = QUADRICS[kind](rng)
    origins, directions = RAYS[rays](rng, quadric, count)
    expected, double = Expected(quadric, origins, directions), kind == "double_plane"
    found = [cast(quadric, (origins, directions), faces) for faces in ("front", "back")]
    must = [~expected.touches | double, ~expected.touches]
    right = expected.on | (expected.met(found[0], 0, must[0]) & expected.met(found[1], 1, must[1]))
    total = {"rays": count, "expected": int(expected.surely.sum()), "exactly": int((~right).sum())}
    total |= {"missed": 0, "invented": 0}
    for i in np.flatnonzero(~right):
        if quadric_oracle.lies_on(quadric, origins[i], directions[i]):
            continue
        known = quadric_oracle.crossings(quadric, origins[i], directions[i])
        for side, t in enumerate(found):
            for name, n in quadric_oracle.judged(known, t[i], side == 0, double).items():
                total[name] += n
    return total | of_float32(quadric, origins, directions)


def of_float32(quadric: Quadric, origins: np.ndarray, directions: np.ndarray) -> Counts:
    """Of the same rays in float32, hits that surely are there: how many, how many of them are not found to 2e-6 of the
    distance, and how far off, in units of that, are those at most that rounding moves by less than 1e-9 of it."""
    rays = origins.astype(np.float32).astype(np.float64), directions.astype(np.float32).astype(np.float64)
    given = (rays[1] != 0).any(1) & np.isfinite(rays[1]).all(1)
    rays = rays[0][given], rays[1][given]
    expected = Expected(quadric, *rays)
    distance = np.linalg.norm(rays[0] - quadric.center, axis=1) + quadric.radius
    far = FAR * distance / np.linalg.norm(rays[1], axis=1)
    total: Counts = {"float32": 0, "float32 off": 0, WORST: 0.0}
    for side, faces in enumerate(("front", "back")):
        t = cast(quadric, rays, faces, torch.float32)
        clear = expected.sure & ~expected.touches & expected.surely[:, side]
        with np.errstate(all="ignore"):
            off = np.abs(t - expected.t[:, side, None]).min(1, initial=np.inf)
        total["float32"] += int(clear.sum())
        total["float32 off"] += int((clear & ~(off <= far + expected.moved[:, side])).sum())
        steady = clear & (expected.moved[:, side] < 5e-4 * far)
        total[WORST] = max(total[WORST], float((off[steady] / far[steady]).max(initial=0.0)))
    return total


# --- bilinear quads ---------------------------------------------------------------------------------------------------

SURE = 1e-12  # of the size, and by how steeply a ray meets a patch, how far u and v have to be from 0 and 1


def patch(rng: Rng, height: float) -> np.ndarray:
    """A quarter of them parallelograms, an eighth triangles, but for their heights."""
    flat = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.0]]) + 0.12 * rng.normal(size=(4, 3))
    kind = rng.integers(8)
    flat[2] = flat[1] + flat[3] - flat[0] if kind < 2 else flat[1] if kind == 2 else flat[2]
    flat[:, 2] = height * (rng.uniform(size=4) - 0.5)
    return flat @ np.linalg.qr(rng.normal(size=(3, 3)))[0] + rng.uniform(-50, 50, 3)


def on_patch(corners: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    a, b, c, d = corners
    u, v = u[:, None], v[:, None]
    return (1 - u) * (1 - v) * a + u * (1 - v) * b + u * v * c + (1 - u) * v * d


def crossings_of_patch(corners: np.ndarray, rays: Rays) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """t (R, 2), by how much rounding may move it, and whether (R, 2) they surely are hits, and may be: by the lines of
    constant v that are met. A ray that touches, or may, has the same twice, that may be a hit; one that lies in a flat
    patch to within rounding may hit it anywhere."""
    e, v = (x.astype(Long) for x in rays)
    p1, p2, p3, p4 = corners.astype(Long)
    v = v / np.sqrt((v * v).sum(1, keepdims=True))
    start = ((corners.mean(0) - e) * v).sum(1)
    q = e + start[:, None] * v - p1
    a, d, h = p2 - p1, p4 - p1, p1 - p2 + p3 - p4
    moment, side = np.cross(q, v), np.cross(np.broadcast_to(d, v.shape), v)
    c0, c1, c2 = moment @ a, (moment @ h - side @ a) / 2, -(side @ h)
    slack = SURE * (np.abs(c0) + 2 * np.abs(c1) + np.abs(c2) + SURE)
    square = c1 * c1 - c0 * c2
    touches = (np.abs(square) <= slack)[:, None]
    with np.errstate(all="ignore"):
        s = np.sqrt(square)
        k = -(c1 + np.where(c1 > 0, s, -s))
        w = np.where(touches, (-c1 / c2)[:, None], np.stack((k / c2, c0 / k), 1))  # v of lines that are met
        line = a + w[..., None] * h
        n = np.cross(v[:, None], line)
        way = w[..., None] * d - q[:, None]
        square = (n * n).sum(-1)
        u = (np.cross(way, v[:, None]) * n).sum(-1) / square
        t = (np.cross(way, line) * n).sum(-1) / square + start[:, None]
        moved = np.where(touches, np.sqrt(2 * slack)[:, None] / np.abs(c2)[:, None], SURE / np.abs(s)[:, None])
        off = (SURE + moved) / np.sqrt(square) + SURE * np.abs(start)[:, None] * 1e-4
        inner = np.minimum(np.minimum(u, 1 - u), np.minimum(w, 1 - w))
        lies = (np.abs((c0, c1, c2)).max(0) <= 10 * SURE)[:, None]
        t, off = np.where(lies, start[:, None], t), np.where(lies, 2, off)
        nearest = np.clip(w, 0, 1)  # for one that touches: a ray may be at right angles with a flat patch's normal
        meets = np.abs((c2[:, None] * nearest + 2 * c1[:, None]) * nearest + c0[:, None]) <= 10 * SURE
        may = (inner > -off) & (t > -10 * off) & (meets | ~touches) | lies
        return t, 10 * off, (inner > off) & (t > 10 * off) & ~touches & ~lies, may


def at_points(rng: Rng, corners: np.ndarray, count: int) -> Rays:
    """From anywhere, 3 to 3,000 sizes away, at points of a patch and beside it."""
    aim = on_patch(corners, *rng.uniform(-0.2, 1.2, (2, count)))
    way = ways(rng, count)
    return aim - 3 * 1000 ** rng.uniform(0, 1, (count, 1)) * way, way


def glancing(rng: Rng, corners: np.ndarray, count: int) -> Rays:
    """In the tangent plane of a point, off by 1 to 1e-12 in place and way."""
    a, b, c, d = corners
    u, v = rng.uniform(-0.1, 1.1, (2, count, 1))
    line, other = (1 - v) * (b - a) + v * (c - d), (1 - u) * (d - a) + u * (c - b)
    turn, off = rng.uniform(0, 2 * np.pi, (count, 1)), 10.0 ** -rng.uniform(0, 12, (2, count, 1))
    way = np.cos(turn) * line + np.sin(turn) * other + off[0] * ways(rng, count)
    way /= np.linalg.norm(way, axis=1, keepdims=True)
    aim = on_patch(corners, u[:, 0], v[:, 0]) + off[1] * ways(rng, count)
    return aim - 3 * 1000 ** rng.uniform(0, 1, (count, 1)) * way, way


AT_PATCHES: dict[str, Callable[[Rng, np.ndarray, int], Rays]] = {f.__name__: f for f in (at_points, glancing)}


def patch_verdict(height: float, rays: str, count: int, seed: int) -> Counts:
    """Of so many rays at one patch: hits expected, left open, missed, invented; of float32 rays as of quadrics."""
    rng = np.random.default_rng([seed, int(-np.log10(height + 1e-20)), sorted(AT_PATCHES).index(rays)])
    corners = patch(rng, height)
    given = AT_PATCHES[rays](rng, corners, count)
    t, moved, surely, may = crossings_of_patch(corners, given)
    hits = cast_at_patch(corners, given)
    with np.errstate(all="ignore"):
        near = np.abs(hits[:, :, None] - np.where(may, t, np.nan)[:, None]) <= moved[:, None]
    total: Counts = {"rays": count, "expected": int(surely.sum()), "open": int((may & ~surely).sum())}
    total |= {"missed": int((surely & ~near.any(1)).sum()), "invented": int((np.isfinite(hits) & ~near.any(2)).sum())}
    return total | patch_in_float32(corners, given)


def patch_in_float32(corners: np.ndarray, rays: Rays) -> Counts:
    """`of_float32`, of a patch."""
    single = tuple(x.astype(np.float32) for x in rays)
    t, moved, surely, _ = crossings_of_patch(corners, single)
    hits = cast_at_patch(corners, single)
    far = FAR * (np.linalg.norm(single[0] - corners.mean(0), axis=1) + 1)[:, None]
    with np.errstate(all="ignore"):
        off = np.abs(hits[:, :, None] - t[:, None]).min(1, initial=np.inf)
    steady = surely & (moved < 5e-4 * far)
    missed = surely & ~(off <= far + moved)
    worst = float((off / far)[steady].max(initial=0.0))
    return {"float32": int(surely.sum()), "float32 off": int(missed.sum()), WORST: worst}


def cast_at_patch(corners: np.ndarray, rays: Rays) -> np.ndarray:
    """t (R, k) of all hits, in units of length."""
    surface = BilinearQuads(torch.from_numpy(corners), torch.tensor([[0, 1, 2, 3]]))
    origins, ways = (torch.from_numpy(x) for x in rays)
    return surface.hits(origins, ways, 3).t.double().numpy() * np.linalg.norm(rays[1].astype(float), axis=1)[:, None]


HEIGHTS = (1.0, 1e-1, 1e-2, 1e-3, 1e-4, 1e-6, 0.0)


def at_quadrics(count: int, seed: int) -> None:
    totals: dict[str, Counts] = {}
    for rays in RAYS:
        for number in range(seed, seed + max(1, count // (AT_ONCE * len(QUADRICS)))):
            for kind in QUADRICS:
                own = verdict(kind, rays, AT_ONCE, number)
                for name in (f"rays {rays}", f"quadrics {kind}", f"{rays} at {kind}"):
                    add(totals.setdefault(name, {}), own)
        print(f"rays {rays}", totals[f"rays {rays}"], flush=True)
    for name, total in totals.items():
        print(name, total)


def at_quads(count: int, seed: int) -> None:
    for rays in AT_PATCHES:
        for height in HEIGHTS:
            total: Counts = {}
            for number in range(seed, seed + max(1, count // AT_ONCE)):
                add(total, patch_verdict(height, rays, AT_ONCE, number))
            print(f"quads, height {height:g}, {rays}", total, flush=True)


SURFACES = {"quadrics": at_quadrics, "quads": at_quads}


def main(count: int, seed: int = 0, only: str | None = None) -> None:
    for name, many in SURFACES.items():
        if only in (None, name):
            many(count, seed)


def add(total: Counts, own: Counts) -> None:
    for name, n in own.items():
        total[name] = max(total.get(name, 0), n) if name == WORST else total.get(name, 0) + n


if __name__ == "__main__":
    main(int(float(sys.argv[1])), *map(int, sys.argv[2:3]), *sys.argv[3:])
