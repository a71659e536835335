"""What rounding does to rays at quadrics: roots by three formulas, where rays are measured from, which quadrics are
left out, how flat bilinear quads may be; how hits are blended. In float32 and float64, by the library's own functions.

Letters: α λ² + 2 β λ + γ = 0 with s = √(β² − αγ) along a ray e + λ v; front is the root where F falls. The formulas:

    7           front: (−β − s) / α
    7, linear   the same, and −γ / (2 β) where |α| < 10⁻⁶
    15          the first positive root: 1 / λ = −β/γ + √((β/γ)² − α/γ)
    stable      `ops.reference.quadrics.stable_roots`

Source: Stoll, Gumhold & Seidel, Incremental raycasting of piecewise quadratic surfaces on the GPU, 2006, whose numbers
of equations these are. What is exact is computed in 64 bits (numpy.longdouble), or in float64 where float32 is judged.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import Field
from torch import Tensor

from experiments import covers
from experiments.config import Dtype, ExperimentConfig
from experiments.runs import Record, Run, Unit
from filterlab.ops import bilinear as patches
from filterlab.ops.quadrics import InLeaves, Kept, Quadrics
from filterlab.ops.reference import bilinear, quadrics
from filterlab.ops.reference.quadrics import Meets
from filterlab.ops.reference.slim import weight
from filterlab.ops.tree import Boxes
from filterlab.surfaces import Bounds, Slim, Spheres, Surface, Tetrahedra
from filterlab.surfaces import Quadrics as QuadricSurface

LINEAR = 1e-6  # |α| below which formula 7 is left, where it has a case of its own
_AIM = 0.7  # of the radius, within which rays are aimed
_APART = 4.0  # radii between the centres of quadrics that may be culled
_FAR = 3000.0  # radii, how far the eye is of which decisions are compared


class Config(ExperimentConfig):
    """What is measured, and how often.

    Attributes:
        dtypes: of the roots. alphas: α of them; β and γ are of size one.
        distances: of the eye from the middle of a ball, in radii.
        heights: of bilinear quads, in sizes.
        covers: numbers of balls that a torus is covered by. offsets: of a ball's radius, within which hits are blended.
        count: rays, or quadratics, of each. quadrics: that may be culled, of each kind of bounds. points: of each.
    """

    experiment: Literal["quadrics_numerics"]
    dtypes: Annotated[list[Dtype], Field(min_length=1)]
    alphas: Annotated[list[Annotated[float, Field(gt=0, le=1)]], Field(min_length=1)]
    distances: Annotated[list[Annotated[float, Field(gt=1)]], Field(min_length=1)]
    heights: Annotated[list[Annotated[float, Field(gt=0, le=1)]], Field(min_length=1)]
    covers: Annotated[list[Annotated[int, Field(ge=50, le=10**6)]], Field(min_length=1)]
    offsets: Annotated[list[Annotated[float, Field(ge=0)]], Field(min_length=1)]
    count: Annotated[int, Field(ge=10, le=10**7)]
    quadrics: Annotated[int, Field(ge=10, le=10**7)]
    points: Annotated[int, Field(ge=1, le=1000)]


def units(config: Config) -> list[Unit]:
    """One for every row of a table."""
    rows = [(f"roots/{d}/{a:g}", 2e-6 * config.count) for d in config.dtypes for a in config.alphas]
    rows += [(f"distance/{d:g}", 2e-5 * config.count) for d in config.distances]
    rows += [(f"culling/{kind}", 1e-6 * config.quadrics * config.points) for kind in ("spheres", "tetrahedra")]
    rows += [(f"quads/{h:g}", 2e-5 * config.count) for h in config.heights]
    rows += [(f"blending/{n}", 1e-5 * config.count * len(config.offsets)) for n in config.covers]
    return [Unit(key, key.replace("/", ", "), seconds) for key, seconds in rows]


def compute(config: Config, unit: Unit, _run: Run) -> Record:
    """The record of one row."""
    table, *rest = unit.key.split("/")
    rng = np.random.default_rng([config.seed, sum(map(ord, unit.key))])
    if table == "roots":
        return _roots(rng, rest[0], float(rest[1]), config.count)
    if table == "distance":
        return _distance(rng, float(rest[0]), config.count)
    if table == "blending":
        return _blending(rng, int(rest[0]), config.offsets, config.count)
    if table == "quads":
        return _quads(rng, float(rest[0]), config.count)
    return _culling(rng, rest[0], config.quadrics, config.points)


# --- roots ------------------------------------------------------------------------------------------------------------


def _seven(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    return (-b - np.sqrt(b * b - a * c)) / a


def _with_linear(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    return np.where(np.abs(a) < LINEAR, -c / (2 * b), _seven(a, b, c))


def _fifteen(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    slope = -b / c
    return 1 / (slope + np.sqrt(slope * slope - a / c))


def _stable(a: np.ndarray, b: np.ndarray, c: np.ndarray, side: int) -> np.ndarray:
    s = np.sqrt(b * b - a * c)
    return quadrics.stable_roots(*map(torch.from_numpy, (a, b, c, s)))[side].numpy()


def _roots(rng: np.random.Generator, dtype: str, alpha: float, count: int) -> Record:
    """Worst relative errors of roots below 1e3, radicands above 0.01."""
    a, b, c = (np.asarray(x, dtype) for x in (alpha * rng.choice([-1, 1], count), *rng.normal(size=(2, count))))
    a_, b_, c_ = (x.astype(np.longdouble) for x in (a, b, c))
    radicand = b_ * b_ - a_ * c_
    s = np.sqrt(np.maximum(radicand, 0))
    with np.errstate(all="ignore"):
        front, back = (_exact(a_, b_, c_, sign * s) for sign in (-1, 1))
        first = np.where((front > 0) & ~((back > 0) & (back < front)), front, back)
        good = radicand > 0.01
        record = {"dtype": dtype, "alpha": alpha}
        record |= {"7": _worst(_seven(a, b, c), front, good & (b < 0))}
        record |= {"7, linear": _worst(_with_linear(a, b, c), front, good & (b < 0))}
        record |= {"15": _worst(_fifteen(a, b, c), first, good)}
        stable = [_worst(_stable(a, b, c, side), root, good) for side, root in enumerate((front, back))]
    return record | {"stable": max(stable)}


def _exact(a: np.ndarray, b: np.ndarray, c: np.ndarray, s: np.ndarray) -> np.ndarray:
    """The root with α λ + β = s."""
    return np.where(b * s > 0, -c / (b + s), (s - b) / a)


def _worst(found: np.ndarray, exact: np.ndarray, which: np.ndarray) -> float:
    which = which & (exact > 0) & (exact < 1e3)
    off = np.abs(found - exact) / exact
    return float(np.where(np.isfinite(off), off, 1)[which].max(initial=0))


# --- where rays are measured from -------------------------------------------------------------------------------------


def _distance(rng: np.random.Generator, distance: float, count: int) -> Record:
    """Hits of rays of float32 with quadrics as bent as their balls, of radius 1."""
    A = rng.normal(size=(count, 3, 3))
    A, b, c = (A + A.swapaxes(1, 2)) / 2, rng.normal(size=(count, 3)), 0.5 * rng.normal(size=count)
    way = _units(rng, count)
    e = (distance * way).astype(np.float32)
    aim = _AIM * _units(rng, count) * rng.uniform(0, 1, (count, 1)) ** (1 / 3)
    v = _normed(aim - e).astype(np.float32)
    exact = _front_inside(A, b, c, e.astype(float), v.astype(float))
    own = np.isfinite(exact)
    zero, radii = torch.zeros(count, 3).double(), torch.ones(count).double()
    rows = torch.from_numpy(A), torch.from_numpy(b), torch.from_numpy(c)
    given = Quadrics.of(Boxes(zero - 1, zero + 1), rows, zero, radii, zero.new_zeros(count, 0, 4))
    record: Record = {"distance": distance, "rays": int(own.sum())}
    for name, found in {
        "7": _from_eye(A, b, c, e, v, _seven),
        "stable, fma": _from_eye(A, b, c, e, v, _fused),
        "recentred": _front(quadrics.intersections, given, e, v, torch.float32),
        "library": _front(quadrics.intersections, given, e, v, torch.float64),
    }.items():
        record |= _judged(name, np.abs(found - exact)[own])
    return record


def _units(rng: np.random.Generator, count: int) -> np.ndarray:
    return _normed(rng.normal(size=(count, 3)))


def _normed(x: np.ndarray) -> np.ndarray:
    return x / np.linalg.norm(x, axis=1, keepdims=True)


def _dot(x: np.ndarray, y: np.ndarray) -> np.ndarray:
    return (x * y).sum(-1)


def _times(A: np.ndarray, x: np.ndarray) -> np.ndarray:
    return (A * x[:, None]).sum(-1)


def _front_inside(A: np.ndarray, b: np.ndarray, c: np.ndarray, e: np.ndarray, v: np.ndarray) -> np.ndarray:
    """λ of fronts clearly within the ball, with radicands above 0.01; else NaN."""
    behind = -_dot(e, v) / _dot(v, v)
    q = e + behind[:, None] * v
    turned = _times(A, q)
    alpha, beta, gamma = _dot(v, _times(A, v)), _dot(v, turned + b), _dot(q, turned + 2 * b) + c
    radicand = beta**2 - alpha * gamma
    with np.errstate(all="ignore"):
        root = _exact(alpha, beta, gamma, -np.sqrt(radicand))
        x = q + root[:, None] * v
        return np.where((radicand > 0.01) & (_dot(x, x) < 0.9), behind + root, np.nan)


Formula = Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray]


def _fused(a: np.ndarray, b: np.ndarray, c: np.ndarray) -> np.ndarray:
    """Stable roots, the radicand as if by fused multiply-add: products of float32 are exact in float64."""
    w = a * c
    wide_a, wide_b, wide_c = (x.astype(np.float64) for x in (a, b, c))
    radicand = (wide_b * wide_b - w).astype(np.float32) - (wide_a * wide_c - w).astype(np.float32)
    return quadrics.stable_roots(*map(torch.from_numpy, (a, b, c, np.sqrt(radicand))))[0].numpy()


def _from_eye(A: np.ndarray, b: np.ndarray, c: np.ndarray, e: np.ndarray, v: np.ndarray, by: Formula) -> np.ndarray:
    """λ in float32 of coefficients about the eye, made in float64 (equations 9 and 10)."""
    e64 = e.astype(np.float64)
    turned = _times(A, e64)
    own = A, b + turned, c + _dot(e64, turned + 2 * b)
    A32, b32, c32 = (x.astype(np.float32) for x in own)
    with np.errstate(all="ignore"):
        return by(_dot(v, _times(A32, v)), _dot(b32, v), c32).astype(np.float64)


def _front(meets: Meets, given: InLeaves, e: np.ndarray, v: np.ndarray, dtype: torch.dtype) -> np.ndarray:
    """λ of the first front of every ray with a thing of its own, by the library's plain program; NaN where there is
    none."""
    rows = given.leaves.transpose(1, 2).flatten(0, 1)[: len(given.tree.order)]
    leaf = torch.full((len(rows), rows.shape[1], given.leaves.shape[2]), torch.nan, dtype=dtype)
    leaf[given.tree.order, :, 0] = rows.to(dtype)  # each the first in a leaf of its own
    start, along = (torch.from_numpy(x).to(dtype) for x in (e, v))
    ends = torch.full((len(e),), torch.inf, dtype=dtype)
    found = meets(leaf, start, along, -ends, ends, Kept(True, False, True), False)[:, 0].amin(-1)
    return torch.where(found.isfinite(), found, torch.nan).float().double().numpy()


def _judged(name: str, off: np.ndarray) -> Record:
    """The error that 99 % are within, of those that are found, and the share that is not."""
    found = off[np.isfinite(off)]
    error = float(np.quantile(found, 0.99)) if len(found) else None
    return {f"{name}: error": error, f"{name}: missed": 1 - len(found) / len(off)}


# --- culling ----------------------------------------------------------------------------------------------------------


def _culling(rng: np.random.Generator, kind: str, count: int, points: int) -> Record:
    """Quadrics in a grid, seen from within it: which of them show fronts or backs where lines meet them, which go."""
    side = math.ceil(count ** (1 / 3))
    centers = _APART * torch.cartesian_prod(*[torch.arange(side).double()] * 3)[:count]
    numbers = lambda *shape: torch.from_numpy(rng.normal(size=(count, *shape)))  # noqa: E731
    corners = torch.nn.functional.normalize(numbers(4, 3), dim=-1)
    bounds = Spheres(centers, 1.0) if kind == "spheres" else Tetrahedra(centers[:, None] + corners)
    A, b, c = 0.3 * numbers(3, 3), numbers(3), 0.3 * numbers()
    surface, front = (QuadricSurface(A, b, c, bounds, origins=centers, faces=faces) for faces in ("both", "front"))
    eye = centers.mean(0) + torch.from_numpy(rng.normal(size=3))
    kept, shown = front.facing(eye), torch.zeros(2, count, dtype=torch.bool)
    for _ in range(points):
        way = torch.nn.functional.normalize(numbers(3), dim=-1)
        aim = bounds.centers + 0.5 * bounds.radii[:, None] * torch.nn.functional.normalize(numbers(3), dim=-1)
        o = aim - 2 * bounds.radii[:, None] * way
        hits = surface.hits(o, way, 2)
        at = surface.at(o, way, hits)
        assert at.normal is not None
        own = hits.piece == torch.arange(count)[:, None]
        facing = ((at.point - eye) * at.normal).sum(-1)
        shown |= torch.stack(((own & (facing < 0)).any(1), (own & (facing > 0)).any(1)))
    away = shown[1] & ~shown[0]
    record = {"bounds": kind, "shown": int(shown.any(0).sum()), "fronts": int(shown[0].sum())}
    record |= {"lost": int((shown[0] & ~kept).sum()), "removed": float((~kept)[away].double().mean())}
    return record | _decisions(A, b, c, bounds, centers, rng)


def _decisions(A: Tensor, b: Tensor, c: Tensor, bounds: Bounds, centers: Tensor, rng: np.random.Generator) -> Record:
    """Shares of float32 decisions that are wrong, of an eye 3,000 radii away, in its coordinates and about centres."""
    way = torch.from_numpy(_units(rng, len(A)))
    A, local = (A + A.mT) / 2, bounds.centers - centers
    turned = (A * local[:, None]).sum(-1)
    b, c = b + turned, c + (local * (turned + 2 * b)).sum(-1)
    e, r = _FAR * way * bounds.radii[:, None], bounds.radii
    corners = None if bounds.corners is None else bounds.corners - bounds.centers[:, None]
    polar = b + (A * e[:, None]).sum(-1)
    value = c + (e * (polar + b)).sum(-1)
    exact = _about_center(A, b, c, e, r, corners)
    local = _about_center(*_singles(A, b, c, e, r, corners))
    seen = _about_eye(*_singles(polar, value, -e, r, corners))
    wrong = [(x != exact).double().mean().item() for x in (seen, local)]
    return {"wrong, eye": wrong[0], "wrong, local": wrong[1]}


def _singles(*rows: Tensor | None) -> list[Any]:
    return [None if x is None else x.float() for x in rows]


def _about_center(A, b, c, e, r, corners) -> Tensor:
    """Whether all that is in a ball (18) or a tetrahedron (19) faces away, without cancellation."""
    polar = b + (A * e[:, None]).sum(-1)
    reach = r * polar.norm(dim=-1) if corners is None else (corners * polar[:, None]).sum(-1).amax(1)
    return c + (b * e).sum(-1) + reach < 0


def _about_eye(polar, value, center, r, corners) -> Tensor:
    """The same in coordinates of the eye, as printed."""
    if corners is None:
        return value + (center * polar).sum(-1) + r * polar.norm(dim=-1) < 0
    return value + ((center[:, None] + corners) * polar[:, None]).sum(-1).amax(1) < 0


# --- bilinear quads ---------------------------------------------------------------------------------------------------


def _quads(rng: np.random.Generator, height: float, count: int) -> Record:
    """Rays of float32 at points of quads of size 1, from nine sizes away."""
    corners = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]) - 0.5 + 0.1 * rng.normal(size=(count, 4, 3))
    corners[..., 2] = height * (rng.uniform(size=(count, 4)) - 0.5)
    turn = np.linalg.qr(rng.normal(size=(count, 3, 3)))[0]
    corners = np.einsum("mci,mij->mcj", corners, turn)
    corners -= corners.mean(1, keepdims=True)
    u, v = rng.uniform(0.02, 0.98, (2, count, 1))
    p, a, d, h = (x.numpy() for x in patches.spanned(torch.from_numpy(corners)))
    point = p + u * a + v * d + u * v * h
    normal = _normed(np.cross(a + v * h, d + u * h))
    way = _normed(-normal + 0.4 * _units(rng, count))
    e, way = (point - 9 * way).astype(np.float32), way.astype(np.float32)
    given = patches.BilinearQuads.of(torch.from_numpy(corners))
    exact = _front(bilinear.intersections, given, *_from(given, e, way), torch.float64)
    A, b = _quadric(a, d, h)
    c = _dot(p, _times(A, p)) - 2 * _dot(b, p)
    about = A, b - _times(A, p), c
    record: Record = {"height": height, "distance": _off_quadric(A, b, point - p)}
    eye = _from_eye(*about, e, way, _seven)
    ball = np.linalg.norm(corners, axis=-1).max(1)
    zero = torch.zeros(count, 3).double()
    quadric = Quadrics.of(
        Boxes(zero - 2, zero + 2),
        (torch.from_numpy(A), torch.from_numpy(about[1]), torch.from_numpy(about[2])),
        zero,
        torch.from_numpy(ball),
        zero.new_zeros(count, 0, 4),
    )
    found = {
        "eye": eye,
        "recentred": _front(quadrics.intersections, quadric, e, way, torch.float32),
        "u-v": _front(bilinear.intersections, given, *_from(given, e, way), torch.float32),
    }
    for name, t in found.items():
        record |= _judged(name, np.abs(t - exact)[np.isfinite(exact)])
    return record | {"rays": int(np.isfinite(exact).sum())}


def _from(given: InLeaves, e: np.ndarray, v: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rays from the middle of a tree."""
    return e - given.tree.center.numpy(), v


def _quadric(a: np.ndarray, d: np.ndarray, h: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A and b about the first corner, F > 0 where S_u × S_v points, of size one."""
    nx, ny, nz = np.cross(d, h), np.cross(h, a), np.cross(a, d)
    det = _dot(nz, h)
    outer = nx[:, :, None] * ny[:, None]
    A, b = -(outer + outer.swapaxes(1, 2)) / 2, nz * det[:, None] / 2
    size = -np.sign(det) * np.linalg.norm(b, axis=1)
    size = np.where(size == 0, 1, -size)
    return A / size[:, None, None], b / size[:, None]


def _off_quadric(A: np.ndarray, b: np.ndarray, q: np.ndarray) -> float:
    """The distance that 99 % of points of patches have from their quadrics, in float64."""
    turned = _times(A, q)
    return float(np.quantile(np.abs(_dot(q, turned + 2 * b)) / (2 * np.linalg.norm(turned + b, axis=1)), 0.99))


# --- blending ---------------------------------------------------------------------------------------------------------


def _blending(rng: np.random.Generator, balls: int, offsets: Sequence[float], count: int) -> Record:
    """How far, rms, hits of a torus are from it, covered by graphs of second order; what the weight does at ½."""
    cover = covers.torus(balls)
    aim = torch.from_numpy(rng.normal(size=(count, 3))) * torch.tensor([0.7, 0.7, 0.2])
    o = 5 * torch.nn.functional.normalize(torch.from_numpy(rng.normal(size=(count, 3))), dim=-1)
    rays = o, torch.nn.functional.normalize(aim - o, dim=-1)
    nearest = QuadricSurface(
        cover.A, cover.b, cover.c, Spheres(cover.centers, cover.radii), origins=cover.centers, faces="front"
    )
    surfaces = {"nearest": nearest} | {f"{x:g}": Slim(*cover, offset=x) for x in offsets}
    record: Record = {"balls": len(cover.centers), "radius": float(cover.radii[0]), "jumps": _jumps()}
    return record | {"rms": {name: _rms(surface, *rays) for name, surface in surfaces.items()}}


def _rms(surface: Surface, origins: Tensor, directions: Tensor) -> float:
    hit = surface.hit(origins, directions)
    point = surface.at(origins, directions, hit, order=0).point[hit.valid]
    return float(covers.distance(point).square().mean().sqrt())


def _jumps() -> list[float]:
    """By how much w / w(½) and w′ / w′(½) jump at ½, and what they are at 1."""
    rho = torch.tensor([0.5, math.nextafter(0.5, 1), 1.0], dtype=torch.float64, requires_grad=True)
    w = weight(rho * rho)
    (slope,) = torch.autograd.grad(w.sum(), rho)
    w = w.detach()
    return [float(abs(x[1] / x[0] - 1)) for x in (w, slope)] + [float(w[2]), float(slope[2])]
