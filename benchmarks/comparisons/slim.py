"""SLIM surfaces: covers of a torus, against Embree's triangles of equal error, plain torch, derivatives, growth."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.harness import Comparison, Contestant, Item, Race, Ratio, race_item
from benchmarks.level_sets import hits_and_normals
from benchmarks.peers import embree_mesh
from benchmarks.records import at_most
from benchmarks.settings import Settings
from experiments.covers import MAJOR, MINOR, distance, torus
from filterlab.ops.differentiable import slim as ops
from filterlab.render import PerspectiveCamera, raycast
from filterlab.surfaces import Slim

_BALLS, _MANY, _MOST = 5_000, 180_000, 1_000_000
_AROUND = MAJOR / MINOR  # of triangles, how many more around than across
_FIRST_RINGS = 100  # of the mesh that says how many rings an error takes
_PLAIN = 64  # pixels along an edge of what plain torch casts

Rays = tuple[Tensor, Tensor]


def cover_of(settings: Settings, balls: int) -> Slim:
    return Slim(*torus(balls if not settings.quick else max(100, balls // 100)))


def rays_of(surface: Slim, edge: int) -> Rays:
    """Of a camera, a fifth of which hit."""
    origins, directions = PerspectiveCamera.framing(surface.domain, (0.3, 1.0, 0.6)).rays(edge, edge)
    origins, directions = (x.reshape(-1, 3).float().contiguous() for x in torch.broadcast_tensors(origins, directions))
    return origins, directions


def error(points: Tensor) -> float:
    """RMS distance from the torus."""
    return float(distance(points).square().mean().sqrt())


def mesh_of(rms: float, rays: Rays) -> tuple[Any, int]:
    """Embree's scene of as many triangles as have that error where rays hit, and how many these are."""
    rings = _FIRST_RINGS
    for _ in range(2):  # the error falls with the square of the number of rings
        vertices, faces = triangles(rings)
        scene = embree_mesh.scene_of(vertices, faces)
        t = embree_mesh.depths(scene, rays)
        own = (rays[0].double() + t[:, None] * rays[1].double())[t < torch.inf]
        found, rings = error(own), round(rings * math.sqrt(error(own) / rms))
        if found <= 1.05 * rms:
            break
    return scene, len(faces)


def triangles(rings: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices on the torus, and faces."""
    vertices, faces = quads(rings)
    return vertices, np.concatenate([faces[:, own] for own in ((0, 1, 2), (0, 2, 3))])


def quads(rings: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices on the torus, and faces of four corners."""
    around = round(_AROUND * rings)
    u, v = 2 * np.pi * np.arange(around)[:, None] / around, 2 * np.pi * np.arange(rings) / rings
    across = MAJOR + MINOR * np.cos(v)
    vertices = np.stack(np.broadcast_arrays(across * np.cos(u), across * np.sin(u), MINOR * np.sin(v)), -1)
    i, j = np.arange(around)[:, None], np.arange(rings)
    at = lambda i, j: i % around * rings + j % rings  # noqa: E731
    corners = [np.broadcast_to(at(i + a, j + b), (around, rings)) for a, b in ((0, 0), (1, 0), (1, 1), (0, 1))]
    return vertices.reshape(-1, 3), np.stack(corners, -1).reshape(-1, 4)


def _first(settings: Settings) -> Race:
    surface = cover_of(settings, _BALLS)
    rays = rays_of(surface, 2 * settings.image)
    t = surface.hit(*(x.double() for x in rays)).t
    rms = error((rays[0].double() + t[:, None] * rays[1].double())[t < torch.inf])
    hits = Contestant("hits", lambda: surface.hit(*rays), samples=len(t))
    contestants = [hits, Contestant("hits and normals", lambda: hits_and_normals(surface, *rays), samples=len(t))]
    what = f"a torus in {len(surface):,} balls, RMS error {rms:.1e}, {len(t):,} float32 rays"
    if why := embree_mesh.missing():
        return Race(f"{what}: first hits", contestants, absent={embree_mesh.NAME: why})
    scene, count = mesh_of(rms, rays)
    contestants.append(Contestant(embree_mesh.NAME, lambda: embree_mesh.depths(scene, rays), samples=len(t)))
    ratios = [Ratio("hits", embree_mesh.NAME, at_most("4")), Ratio("hits and normals", embree_mesh.NAME)]
    return Race(f"{what}: first hits, against {count:,} triangles of that error", contestants, ratios)


def _plain(settings: Settings) -> Race:
    surface = cover_of(settings, _BALLS)
    rays = rays_of(surface, min(_PLAIN, settings.image))
    (given,) = surface.described

    def by(implementation: str) -> Contestant:
        call = lambda: ops.sheets(given, *rays, 1, implementation=implementation)  # noqa: E731
        numbers = lambda found: (torch.where(found.t < torch.inf, found.t, 0).numpy(), found.normal.numpy())  # noqa: E731
        return Contestant(implementation, call, "sheets", numbers, len(rays[0]))

    what = f"a torus in {len(surface):,} balls, {len(rays[0]):,} rays: first sheets"
    return Race(what, [by("reference"), by("cpu")], [Ratio("cpu", "reference", at_most("1/30"))], tolerance=1e-9)


def _backward(settings: Settings) -> Race:
    surface = cover_of(settings, _BALLS)
    rays = rays_of(surface, 2 * settings.image)
    given = [x.clone().requires_grad_() for x in surface.tensors]

    def forward() -> Tensor:
        """A cover that is new in every call, as in a descent."""
        t, normal = hits_and_normals(Slim(*given), *rays)
        return t.nan_to_num(posinf=0).sum() + normal.sum()

    def alone() -> Any:
        with torch.no_grad():
            return forward()

    both = lambda: torch.autograd.grad(forward(), given)  # noqa: E731
    contestants = [Contestant("forward", alone), Contestant("forward + backward", both)]
    what = f"a torus in {len(surface):,} new balls, {len(rays[0]):,} rays: depths and normals, gradients to all numbers"
    return Race(what, contestants, [Ratio("forward + backward", "forward")])


def _growth(settings: Settings) -> Race:
    """Pictures, with normals and light."""
    edge = 2 * settings.image
    covers = {count: cover_of(settings, count) for count in (_BALLS, _MANY, _MOST)}
    camera = PerspectiveCamera.framing(covers[_BALLS].domain, (0.3, 1.0, 0.6))
    shown: Callable[[Slim], Callable[[], Any]] = lambda s: lambda: raycast(s, camera, size=(edge, edge))  # noqa: E731
    contestants = [Contestant(f"{count:,}", shown(cover), samples=edge**2) for count, cover in covers.items()]
    first, many, most = (c.name for c in contestants)
    return Race(
        f"pictures of {edge}²: balls of covers", contestants, [Ratio(many, first, at_most("3")), Ratio(most, first)]
    )


def _items(settings: Settings) -> list[Item]:
    return [
        race_item("first", 30, _first),
        race_item("plain", 30, _plain),
        race_item("backward", 20, _backward),
        race_item("growth", 60, _growth),
    ]


COMPARISON = Comparison("slim", "first hits of covers by blended quadrics, against Embree's triangles", _items)
