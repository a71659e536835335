"""Terrains: first hits of quartic splines of heights against Embree's triangles, at equal numbers of data and at equal
errors, plain torch, growth with the size of the grid."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.harness import Comparison, Contestant, Item, Race, Ratio, race_item
from benchmarks.peers import embree_mesh
from benchmarks.peers.task import Casting
from benchmarks.records import at_most
from benchmarks.settings import Settings
from filterlab.names import SPLINES
from filterlab.ops.differentiable import height_hits
from filterlab.ops.differentiable import heights as jets
from filterlab.ops.raycast import Sheets
from filterlab.ops.reference.raycast import sheets_by
from filterlab.render import PerspectiveCamera
from filterlab.surfaces import HeightField

_HEIGHT, _ROUGHNESS = 0.12, 0.55  # of the largest hills, in edges of the square; of every octave, of the one before
_PLAIN = 64  # pixels along an edge of what plain torch casts
_GRAZING, _SHEETS = 10.0, 8  # degrees, hits of a ray
_COARSE = (25, 49, 97, 193)  # data along an edge of the splines whose errors triangles are given
_AROUND = 3  # data beyond every edge that they have
_SITES = 200  # along an edge, at which errors are measured
_MOST = 3000  # data along an edge of triangles


def size_of(settings: Settings) -> int:
    """Data along an edge."""
    return 8 * settings.image_voxels


def hills(size: int) -> Tensor:
    """(size, size) float32 over the unit square: octaves of noise, the finest of two steps."""
    total, amplitude = torch.zeros(size, size), _HEIGHT / 2
    for octave in range(1, max(2, math.ceil(math.log2(size)))):
        own = torch.rand(1, 1, 2**octave + 1, 2**octave + 1, generator=torch.Generator().manual_seed(octave)) - 0.5
        total += (
            2 * amplitude * torch.nn.functional.interpolate(own, (size, size), mode="bicubic", align_corners=True)[0, 0]
        )
        amplitude *= _ROUGHNESS
    return total


def franke(size: int, spline: str) -> HeightField:
    """Franke's function, from `size`² samples of the unit square; splines that need more have true ones around it."""
    around, step = (0 if spline == "linear" else _AROUND), 1 / (size - 1)
    x = step * torch.arange(-around, size + around, dtype=torch.float64)
    heights = franke_at(*torch.meshgrid(x, x, indexing="xy"))
    return HeightField(heights, spline, step, (float(x[0]), float(x[0])))


def franke_at(x: Tensor, y: Tensor) -> Tensor:
    """Franke, A critical comparison of some methods for interpolation of scattered data, 1979."""
    x, y = 9 * x, 9 * y
    total = 0.75 * (-((x - 2) ** 2 + (y - 2) ** 2) / 4).exp() + 0.75 * (-((x + 1) ** 2) / 49 - (y + 1) / 10).exp()
    return total + 0.5 * (-((x - 7) ** 2 + (y - 3) ** 2) / 4).exp() - 0.2 * (-((x - 4) ** 2) - (y - 7) ** 2).exp()


def view(pixels: int, degrees: float = 30.0) -> tuple[Tensor, Tensor]:
    """Rays (pixels, pixels, 3), float32, at the middle of the unit square from so many degrees above the horizon."""
    turn = math.radians(degrees)
    eye = (0.5, 0.5 - 1.6 * math.cos(turn), 1.6 * math.sin(turn))
    camera = PerspectiveCamera(position=eye, target=(0.5, 0.5, 0.0), field_of_view=30.0)
    origins, directions = camera.rays(pixels, pixels)
    return origins.expand_as(directions).float().contiguous(), directions.float().contiguous()


def ground(heights: Tensor, spline: str) -> HeightField:
    """Over the unit square."""
    return HeightField(heights, spline, spacing=1 / (len(heights) - 1))


def cast(surface: HeightField, rays: tuple[Tensor, Tensor], name: str, computes: str | None = None) -> Contestant:
    """First hits; bounds are made beforehand, as Embree's tree is."""
    surface.hit(*(x[:1, :1] for x in rays))
    call = lambda: surface.hit(*rays).t  # noqa: E731
    return Contestant(name, call, computes, lambda t: Casting.summary(t.numpy()), rays[0].shape[:-1].numel())


def triangles(
    heights: Tensor, rays: tuple[Tensor, Tensor], name: str = embree_mesh.NAME, computes: str | None = None
) -> Contestant:
    """Two for every four data over the unit square, cut along the same diagonal."""
    scene = embree_mesh.of_heights(heights.numpy(), 1 / (len(heights) - 1))
    flat = [x.reshape(-1, 3).numpy() for x in rays]
    call = lambda: scene.run(*flat, query="DISTANCE")  # noqa: E731
    return Contestant(name, call, computes, lambda t: Casting.summary(np.where(t < 1e30, t, np.inf)), len(flat[0]))


def _first(settings: Settings) -> Race:
    heights, rays = hills(size_of(settings)), view(2 * settings.image)
    computes = {"linear": "linear hits"}
    contestants = [cast(ground(heights, spline), rays, spline, computes.get(spline)) for spline in SPLINES]
    ratios, absent = [], {}
    if why := embree_mesh.missing():
        absent[embree_mesh.NAME] = why
    else:
        contestants.append(triangles(heights, rays, computes="linear hits"))
        ratios = [Ratio(s, embree_mesh.NAME, at_most("3") if s == "c1" else None) for s in SPLINES]
    what = (
        f"{len(heights)}² data, {contestants[0].samples:,} rays: first hits; {embree_mesh.NAME} of two triangles a cell"
    )
    return Race(what, contestants, ratios, tolerance=2e-3, absent=absent)


def error_of(surface: HeightField) -> float:
    """Root of the mean square of the spline less Franke's function, over the unit square."""
    x = (torch.arange(_SITES, dtype=torch.float64) + 0.5) / _SITES
    points = torch.stack(torch.meshgrid(x, x, indexing="xy"), -1)
    difference = surface.jet(points, 0)[0] - franke_at(*points.unbind(-1))
    return float(difference.square().mean().sqrt())


def _equal_error(settings: Settings) -> Race:
    """Triangles of as many data as it takes to be as near to Franke's function as a spline of few is."""
    rays, contestants, ratios = view(2 * settings.image, 60.0), [], []
    absent = {embree_mesh.NAME: why} if (why := embree_mesh.missing()) else {}
    for size in _COARSE:
        spline = franke(size, "c1")
        error = error_of(spline)
        name = f"c1 of {size}², error {error:.1e}"
        contestants.append(cast(spline, rays, name))
        if not absent:
            linear = franke(min(_size_with(error), _MOST if not settings.quick else 64), "linear")
            other = f"{embree_mesh.NAME} of {len(linear.heights)}², error {error_of(linear):.1e}"
            contestants.append(triangles(linear.heights, rays, other))
            ratios.append(Ratio(name, other))
    what = f"Franke's function, {contestants[0].samples:,} rays: first hits at equal root mean square errors"
    return Race(what, contestants, ratios, absent=absent)


def _size_with(error: float) -> int:
    """Data along an edge from which on the error of triangles is no larger, by their order, 2."""
    size = 128
    return math.ceil(size * math.sqrt(error_of(franke(size, "linear")) / error))


def _plain(settings: Settings) -> Race:
    heights, rays = hills(size_of(settings) // 2), view(min(_PLAIN, settings.image))
    contestants, ratios = [], []
    for spline in SPLINES:
        given = ground(heights, spline).cast
        flat = [x.reshape(-1, 3) for x in rays]
        for name, how in (("fused", "cpu"), ("plain", "reference")):
            call: Callable[[], Any] = partial(height_hits.first, given, *flat, how)
            words = f"{spline} hits"
            contestants.append(
                Contestant(f"{spline}, {name}", call, words, lambda t: Casting.summary(t.numpy()), len(flat[0]))
            )
        ratios.append(Ratio(f"{spline}, fused", f"{spline}, plain", at_most("1/30")))
    what = f"{len(heights)}² data, {len(flat[0]):,} rays: first hits, fused and in plain torch"
    return Race(what, contestants, ratios)


def _sheets(settings: Settings) -> Race:
    """All that grazing rays hit: by one program, by plain torch from the pieces that a program finds, by it alone."""
    heights, rays = hills(size_of(settings) // 2), view(min(_PLAIN, settings.image), _GRAZING)
    origins, directions = (x.reshape(-1, 3) for x in rays)
    contestants, ratios = [], []
    for spline in SPLINES:
        surface = ground(heights, spline)
        given, asked = surface.cast, Sheets(_SHEETS, False, surface.domain.diagonal)
        pieces = partial(height_hits.candidates, given, implementation="cpu")
        ways: dict[str, Callable[[], Any]] = {
            "fused": partial(height_hits.sheets, given, origins, directions, asked, "cpu"),
            "plain roots": partial(sheets_by, pieces, origins, directions, asked),
            "plain": partial(height_hits.sheets, given, origins, directions, asked, "reference"),
        }
        for way, call in ways.items():
            shown = lambda t: Casting.summary(t.numpy())  # noqa: E731
            contestants.append(Contestant(f"{spline}, {way}", call, f"{spline} sheets", shown, len(origins)))
        fused, *others = (f"{spline}, {way}" for way in ways)
        ratios += [Ratio(fused, other, at_most("1/30") if other == others[-1] else None) for other in others]
    what = f"{len(heights)}² data, {len(origins):,} rays from {_GRAZING:g}° above the horizon: {_SHEETS} sheets"
    return Race(what, contestants, ratios)


def _growth(settings: Settings) -> Race:
    """Twice as many data along an edge."""
    rays, size = view(2 * settings.image), size_of(settings)
    contestants = [cast(ground(hills(n), "c1"), rays, f"{n}²") for n in (size // 2, size, 2 * size)]
    names = [c.name for c in contestants]
    ratios = [Ratio(b, a, at_most("1.3")) for a, b in itertools.pairwise(names)]
    return Race(f"c1, {contestants[0].samples:,} rays: first hits by the size of the grid", contestants, ratios)


def _jets(settings: Settings, transposed: bool) -> Race:
    """Points that lie all over the grid, in no order."""
    heights, count = hills(size_of(settings)), settings.points // 5
    points = torch.rand(1, count, 2, generator=torch.Generator().manual_seed(1)) * (len(heights) - 1)
    cotangents = torch.rand(1, 3, count, generator=torch.Generator().manual_seed(2)) - 0.5
    contestants, ratios = [], []
    for spline in SPLINES:
        values = heights.clone().requires_grad_(transposed)
        described = HeightField(values, spline)._described
        for name, how in (("fused", "cpu"), ("plain", "reference")):
            if transposed:
                jet = jets.jet(described, points, 1, how)
                call: Callable[[], Any] = partial(torch.autograd.grad, jet, values, cotangents, retain_graph=True)
                shown = lambda found: (found[0],)  # noqa: E731
            else:
                call = partial(jets.jet, described, points, 1, how)
                shown = lambda rows: (rows[0, 0], rows[0, 1:])  # noqa: E731
            contestants.append(Contestant(f"{spline}, {name}", call, spline, shown, count))
        ratios.append(Ratio(f"{spline}, fused", f"{spline}, plain", at_most("1/30")))
    kind = "the transpose of jets" if transposed else "jets"
    what = f"{len(heights)}² data, {count:,} points in no order: {kind} of order 1, fused and in plain torch"
    return Race(what, contestants, ratios, tolerance=1e-3)


def _items(settings: Settings) -> list[Item]:
    return [
        race_item("first", 30, _first),
        race_item("equal-error", 30, _equal_error),
        race_item("plain", 60, _plain),
        race_item("sheets", 60, _sheets),
        race_item("size", 10, _growth),
        race_item("scattered", 20, partial(_jets, transposed=False)),
        race_item("scattered-transpose", 20, partial(_jets, transposed=True)),
    ]


COMPARISON = Comparison("terrain", "first hits of quartic splines of heights, against Embree's triangles", _items)
