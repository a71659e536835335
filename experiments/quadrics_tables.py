"""How many rays, quadrics and frames a second? (Tables 1 to 3 of paper 002.)

Table 1: rays against quadrics, each ray with each of a few, by the formulas of the paper in plain torch and by ours;
and what the program makes of it, with its tree; quadrics by how long it takes to build what is cast, and to cull it.
Tables 2 and 3: pictures of covers of a torus, and of a sphere whose quadrics are clipped by tetrahedra. Pictures are
whole ones, normals and a headlight included.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from torch import Tensor

from experiments import covers
from experiments.runs import Record, Run, Unit
from experiments.timing import CLOCKS, TimedConfig, quartile_record
from filterlab.costs import Quartiles, take_turns
from filterlab.ops.quadrics import Kept, Rays
from filterlab.ops.reference.quadrics import intersections
from filterlab.render import PerspectiveCamera, raycast
from filterlab.surfaces import Quadrics, Slim, Spheres, Tetrahedra

RATES, COVERS, SETS = "rates", "cover", "set"
_DIRECTION = (0.3, 1.0, 0.6)
_SECONDS = {RATES: 20.0, COVERS: 5e-5, SETS: 8e-5}  # of a quadric, or of all; only expectations use it

Size = tuple[Annotated[int, Field(ge=1, le=8192)], Annotated[int, Field(ge=1, le=8192)]]


class Config(TimedConfig):
    """Numbers of quadrics, and pictures of them.

    Attributes:
        covers: how many balls each cover has, about. sets: how many tetrahedra each set has, about.
        sizes: (width, height) of pictures.
        rays, quadrics: of table 1, each with each.
        offset: of covers.
        seconds: about, that each picture and rate is measured for.
    """

    experiment: Literal["quadrics_tables"]
    covers: Annotated[list[Annotated[int, Field(ge=10, le=10**7)]], Field(min_length=1)]
    sets: Annotated[list[Annotated[int, Field(ge=60, le=10**7)]], Field(min_length=1)]
    sizes: Annotated[list[Size], Field(min_length=1)]
    rays: Annotated[int, Field(ge=1)] = 4096
    quadrics: Annotated[int, Field(ge=8)] = 64
    offset: Annotated[float, Field(ge=0)] = 0.5
    seconds: Annotated[float, Field(ge=0)] = 2.0


def units(config: Config) -> list[Unit]:
    """The rates, then every cover and every set."""
    found = [Unit(RATES, "rays and quadrics per second", _SECONDS[RATES])]
    for kind, counts in ((COVERS, config.covers), (SETS, config.sets)):
        seconds = [_SECONDS[kind] * n + 2 * len(config.sizes) * config.seconds for n in counts]
        found += [Unit(f"{kind}/{n}", f"{n:,} quadrics", s) for n, s in zip(counts, seconds, strict=True)]
    return found


@torch.no_grad()
def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of all rates, or of one surface."""
    if unit.key == RATES:
        return {"kind": RATES, "rows": [_formulas(config), _throughput(config)]}
    kind, count = unit.key.split("/")
    clock = CLOCKS[config.clock]
    begin = clock()
    surface = _cover(config, int(count)) if kind == COVERS else _set(int(count))
    record: Record = {"kind": kind, "count": int(count), "quadrics": len(surface), "build_seconds": clock() - begin}
    camera = PerspectiveCamera.framing(surface.domain, _DIRECTION)
    eye = torch.as_tensor(camera.position, dtype=torch.float64)
    begin = clock()
    culled = surface.seen_from(eye)
    record |= {"cull_seconds": clock() - begin, "left": _left(culled) / _left(surface)}
    record["frames"] = [_frame(config, {"whole": surface, "culled": culled}, camera, size) for size in config.sizes]
    record["rms"] = _error(surface, camera)
    image = raycast(surface, camera, size=(256, 256), subpixels=2, background=(1.0, 1.0, 1.0))
    assert isinstance(image, Tensor)
    record["image"] = run.save_image(unit.key.replace("/", "-"), image[..., :3])
    return {**record, "files": [record["image"]]}


def _cover(config: Config, count: int) -> Slim:
    return Slim(*covers.torus(count), offset=config.offset)


def _set(count: int) -> Quadrics:
    given = covers.sphere(count)
    return Quadrics(given.A, given.b, given.c, Tetrahedra(given.corners), faces="front")


def _left(surface: Slim | Quadrics) -> int:
    """How many quadrics are cast."""
    given = surface.described[0].quadrics if isinstance(surface, Slim) else surface.described
    return len(given.tree.order)


# --- pictures ---------------------------------------------------------------------------------------------------------


def _frame(config: Config, surfaces: dict[str, Any], camera: PerspectiveCamera, size: Size) -> Record:
    """Quartiles of frames per second, turn by turn."""
    work = {name: _picture(surface, camera, size) for name, surface in surfaces.items()}
    seconds = take_turns(work, seconds=config.seconds, clock=CLOCKS[config.clock]).seconds
    rates = {name: quartile_record(Quartiles.of([1 / s for s in found])) for name, found in seconds.items()}
    return {"size": list(size), **rates}


def _picture(surface: Slim | Quadrics, camera: PerspectiveCamera, size: Size) -> Callable[[], object]:
    return lambda: raycast(surface, camera, size=size)


def _error(surface: Slim | Quadrics, camera: PerspectiveCamera) -> float:
    """RMS distance of what is seen from what it stands for."""
    origins, directions = (x.double() for x in camera.rays(192, 192))
    hit = surface.hit(origins, directions)
    point = surface.at(origins, directions, hit, order=0).point[hit.valid]
    off = covers.distance(point) if isinstance(surface, Slim) else point.norm(dim=-1) - 1
    return float(off.square().mean().sqrt())


# --- rates ------------------------------------------------------------------------------------------------------------


def _formulas(config: Config) -> Record:
    """Millions of pairs of a ray and a quadric a second, by formula and clip."""
    cover = covers.torus(max(config.quadrics, 60))
    some = covers.CoverOf(*(x[: config.quadrics] for x in cover))
    camera = PerspectiveCamera.framing(_cover(config, 60).domain, _DIRECTION)
    side = math.ceil(math.sqrt(config.rays))
    eye, ways = (x.reshape(-1, 3)[: config.rays].double() for x in camera.rays(side, side))
    local = Quadrics(some.A, some.b, some.c, Spheres(some.centers, some.radii), origins=some.centers, faces="front")
    work = {
        "brute force": lambda: _brute_force(some, eye, ways),
        "incremental, not clipped": lambda: _incremental(some, eye[0], ways, clip=False),
        "incremental, clipped by balls": lambda: _incremental(some, eye[0], ways, clip=True),
        "recentred, stable, clipped by balls": lambda: _recentred(local, eye, ways),
        "program, all balls in sight": lambda: local.hit(eye, ways),
    }
    seconds = take_turns(work, seconds=config.seconds, clock=CLOCKS[config.clock]).seconds
    pairs = config.rays * len(some.c)
    rates = {name: quartile_record(Quartiles.of([pairs / s for s in found])) for name, found in seconds.items()}
    return {"what": "pairs", "rates": rates, "rays": config.rays, "quadrics": len(some.c)}


def _throughput(config: Config) -> Record:
    """Quadrics a second: built, culled, and cast at with four rays, as in a picture of 2 × 2."""
    rates = {}
    for name, surface in (("balls", _cover(config, config.covers[0])), ("tetrahedra", _set(config.sets[0]))):
        camera = PerspectiveCamera.framing(surface.domain, _DIRECTION)
        eye = torch.as_tensor(camera.position, dtype=torch.float64)
        origins, directions = camera.rays(2, 2)

        def built(surface: Slim | Quadrics = surface, rays: tuple[Tensor, Tensor] = (origins, directions)) -> object:
            return surface.with_tensors(surface.tensors).hit(*rays)

        def culled(surface: Slim | Quadrics = surface, eye: Tensor = eye) -> object:
            return surface.seen_from(eye)

        seconds = take_turns({"built": built, "culled": culled}, seconds=config.seconds, clock=CLOCKS[config.clock])
        for what, found in seconds.seconds.items():
            rates[f"{name}, {what}"] = quartile_record(Quartiles.of([len(surface) / s for s in found]))
    return {"what": "quadrics", "rates": rates}


def _brute_force(cover: covers.CoverOf, eye: Tensor, ways: Tensor) -> Tensor:
    """Equation 7 for every ray with every quadric, from coefficients of the world's origin."""
    A, b, c = _about_origin(cover)
    turn = lambda x: (A * x[:, None, None]).sum(-1)  # noqa: E731 (R, M, 3)
    e, v = eye[:, None], ways[:, None]
    alpha = (turn(ways) * v).sum(-1)
    beta = ((turn(eye) + b) * v).sum(-1)
    gamma = ((turn(eye) + 2 * b) * e).sum(-1) + c
    t = (-beta - (beta * beta - alpha * gamma).sqrt()) / alpha
    return _nearest(t, _within(cover, eye[0], ways, t))


def _incremental(cover: covers.CoverOf, eye: Tensor, ways: Tensor, clip: bool) -> Tensor:
    """Equations 9, 10 and 15: once for a quadric what can be, from the eye."""
    A, b, c = _about_origin(cover)
    turned = (A * eye).sum(-1)
    own, gamma = b + turned, c + (eye * (turned + 2 * b)).sum(-1)
    alpha = ((A * ways[:, None, None]).sum(-1) * ways[:, None]).sum(-1)
    beta = (own * ways[:, None]).sum(-1)
    t = gamma / (-beta + (beta * beta - alpha * gamma).sqrt())
    return _nearest(t, _within(cover, eye, ways, t) if clip else t > 0)


def _recentred(local: Quadrics, eye: Tensor, ways: Tensor) -> Tensor:
    """As `ops.reference.quadrics`, every ray with every leaf."""
    given = local.described
    rays = Rays.of(given.tree, eye, ways, False)
    pairs = (x.repeat_interleave(len(given.leaves), 0) for x in (rays.start, rays.along, rays.first, rays.last))
    start, along, first, last = pairs
    leaf = given.leaves.repeat(len(eye), 1, 1)
    tau = intersections(leaf, start, along, first, last, Kept(True, False, True), False)
    return tau.view(len(eye), -1).amin(1)


def _about_origin(cover: covers.CoverOf) -> tuple[Tensor, Tensor, Tensor]:
    turned = (cover.A * cover.centers[:, None]).sum(-1)
    return cover.A, cover.b - turned, cover.c + (cover.centers * (turned - 2 * cover.b)).sum(-1)


def _within(cover: covers.CoverOf, eye: Tensor, ways: Tensor, t: Tensor) -> Tensor:
    """(R, M) whether points at t are in the balls."""
    y = eye - cover.centers + t[..., None] * ways[:, None]
    return ((y * y).sum(-1) <= cover.radii**2) & (t > 0)


def _nearest(t: Tensor, hit: Tensor) -> Tensor:
    return torch.where(hit, t, torch.inf).amin(1)
