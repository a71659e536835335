"""Level sets: rays against Mitsuba's trilinear `sdfgrid` and Embree's triangles, plain torch, derivatives, growth."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from itertools import cycle
from typing import Any

import torch

from benchmarks.comparisons.scaling import thread_numbers
from benchmarks.harness import Comparison, Contestant, Item, Race, Ratio, Tick, race_item, usable_cores
from benchmarks.level_sets import LEVEL, hits_and_normals, surface_of, task_of
from benchmarks.peers import casters, embree_mesh, isoray_bisection, mitsuba_sdfgrid, vtk_flying_edges, vtk_raycaster
from benchmarks.peers.task import Casting
from benchmarks.probe import measured
from benchmarks.records import Figure, Outcome, Spread, at_least, at_most
from benchmarks.scene import marschner_lobb
from benchmarks.settings import Settings
from filterlab.fields.base import Field
from filterlab.methods import METHODS, reconstruct
from filterlab.render.materials import Phong
from filterlab.render.raycast import raycast
from filterlab.surfaces import LevelSet

_LEVELS = (0.48, 0.49, 0.5, 0.51, 0.52)
SEARCHED = tuple(name for name, method in METHODS.items() if method.facts.continuity >= 0)
"""Methods whose level sets are surfaces."""

_BARS = {
    "trilinear": at_most("0.25"),
    "triquadratic": at_most("0.45"),
    "tricubic": at_most("0.9"),
    "cubic-c1": at_most("0.4"),
}
_BARS_TO_TRIQUADRATIC = {"qss": at_most("0.7"), "cubic-c1": at_most("0.8"), "quadratic-c1": at_most("0.7")}
_TILED = f"{mitsuba_sdfgrid.NAME}, tile by tile"
_PROCESSES = 3  # of which the peak memory is taken
_BORDER = (
    0.5  # voxels beyond the outermost samples, which are ours and no peer's: there are more hits, and earlier ones
)
_BISECTED = 32  # pixels along an edge of what isoray casts
_PLAIN = 64  # pixels along an edge of what plain torch casts
_SHEETS = 8


def described(task: Casting) -> str:
    n = task.volume.shape[-1]
    return f"Marschner-Lobb {n}³ float32, level {task.level:g}, {task.rays:,} rays"


def _hits(task: Casting, method: str, scheme: str = "fused", name: str | None = None) -> Contestant:
    """First hits and normals."""
    surface = surface_of(task, method, scheme)
    call = lambda: hits_and_normals(surface, task.origins, task.directions)  # noqa: E731
    computes = task.computes if method == "trilinear" else f"{method} hits"
    return Contestant(name or method, call, computes, lambda found: task.summary(found[0].numpy()), task.rays)


def _first(settings: Settings) -> Race:
    task = task_of(settings)
    contestants, absent = [_hits(task, method) for method in SEARCHED], {}
    ratios = [Ratio(method, "triquadratic", bar) for method, bar in _BARS_TO_TRIQUADRATIC.items()]
    for peer in casters():
        if why := peer.missing():
            absent[peer.NAME] = why
            continue
        contestants.append(peer.casting(task))
    if mitsuba_sdfgrid.NAME not in absent:
        ratios += [Ratio(method, mitsuba_sdfgrid.NAME, bar) for method, bar in _BARS.items()]
        contestants.append(replace(mitsuba_sdfgrid.casting(task.tile_by_tile()), name=_TILED))
        ratios += [Ratio(method, _TILED) for method in _BARS]
    if embree_mesh.NAME not in absent:
        ratios.append(Ratio("triquadratic", embree_mesh.NAME, at_most("2")))
    what = f"{described(task)}: first hits and normals; {embree_mesh.NAME} without"
    return Race(what, contestants, ratios, tolerance=_BORDER / task.volume.shape[-1], absent=absent)


def _bisecting(settings: Settings) -> Race:
    """Few rays: each takes as long as some hundred of ours."""
    task, absent = task_of(settings, _BISECTED), {}
    contestants, ratios = [_hits(task, "trilinear")], []
    if why := isoray_bisection.missing():
        absent[isoray_bisection.NAME] = why
    else:
        contestants.append(isoray_bisection.bisecting(task))
        ratios.append(Ratio("trilinear", isoray_bisection.NAME))
    what = f"{described(task)}: first hits and normals; {isoray_bisection.NAME} without"
    return Race(what, contestants, ratios, tolerance=_BORDER / task.volume.shape[-1], absent=absent)


def _renderers(settings: Settings) -> Race:
    """Lit images. On a CPU VTK has no other way to a level set than steps, of ½ voxel, through opacity that jumps."""
    n, size, steps = settings.image_voxels, 2 * settings.image, 512
    above = torch.arange(steps) >= round(LEVEL * (steps - 1))
    table = torch.cat((torch.full((steps, 3), 0.8), above[:, None].float()), 1)
    scene = replace(marschner_lobb(n, size), table=table, threads=settings.threads)
    surface = LevelSet(reconstruct(scene.volume, "trilinear", gradient="analytic"), LEVEL)
    draw = lambda: raycast(surface, scene.camera, Phong(), size=(size, size))  # noqa: E731
    contestants, ratios, absent = [Contestant("trilinear", draw, samples=size**2)], [], {}
    if why := vtk_raycaster.missing():
        absent[vtk_raycaster.NAME] = why
    else:
        contestants.append(vtk_raycaster.marching(scene))
        ratios.append(Ratio("trilinear", vtk_raycaster.NAME))
    return Race(f"Marschner-Lobb {n}³ float32, level {LEVEL:g}, lit images {size}²", contestants, ratios, absent=absent)


def _new_level(settings: Settings) -> Race:
    """Another level in every call: nothing that was found out for one serves the next."""
    task = task_of(settings)
    field = reconstruct(task.volume, "triquadratic")
    levels = cycle(_LEVELS)

    call = lambda: hits_and_normals(LevelSet(field, next(levels)), task.origins, task.directions)  # noqa: E731
    contestants, absent, bars = [Contestant("triquadratic", call, samples=task.rays)], {}, {embree_mesh: "1/3"}
    ratios = []
    for peer in (embree_mesh, vtk_flying_edges):
        if why := peer.missing():
            absent[peer.NAME] = why
            continue
        other = cycle(_LEVELS)
        contestants.append(peer.new_level(task, partial(next, other)))
        ratios.append(Ratio("triquadratic", contestants[-1].name, at_most(bars[peer]) if peer in bars else None))
    what = f"{described(task)}: from a new level to hits (and normals)"
    return Race(what, contestants, ratios, absent=absent)


def _plain(settings: Settings) -> Race:
    """Fewer rays: plain torch takes some 0.2 ms for each, of splines on octahedra several, which are left out."""
    task = task_of(settings, min(_PLAIN, settings.image))
    contestants, ratios = [], []
    for method in (name for name in SEARCHED if name != "quadratic-c1"):
        contestants += [_hits(task, method, scheme, f"{method}, {scheme}") for scheme in ("fused", "direct")]
        ratios.append(Ratio(f"{method}, fused", f"{method}, direct", at_most("1/30")))
    return Race(f"{described(task)}: first hits and normals", contestants, ratios)


def _sheets(settings: Settings) -> Race:
    """All sheets of few rays, by the program and by plain torch from the pieces that it finds."""
    task = task_of(settings, settings.image)
    contestants, ratios = [], []
    for method in ("trilinear", "triquadratic", "tricubic"):
        surface = surface_of(task, method)
        contestants += [_listed(task, surface, f"{method}, {how}", how) for how in ("fused", "plain roots")]
        ratios.append(Ratio(f"{method}, fused", f"{method}, plain roots"))
    return Race(f"{described(task)}: {_SHEETS} sheets", contestants, ratios)


def _listed(task: Casting, surface: LevelSet, name: str, how: str) -> Contestant:
    field, level = surface.field, task.level
    cast = field.crossings if how == "fused" else partial(Field.crossings, field)
    return Contestant(name, lambda: cast(task.origins, task.directions, level, _SHEETS, False), samples=task.rays)


def ways_of(task: Casting) -> tuple[Callable[[], Any], Callable[[], Any]]:
    """Depths and normals forward, and with gradients to samples and origins.

    Of samples that are new in every call, as in a descent: coefficients and bounds are made anew either way.
    """
    volume, origins = task.volume.clone().requires_grad_(), task.origins.clone().requires_grad_()

    def forward() -> Any:
        surface = LevelSet(reconstruct(volume, "triquadratic"), task.level)
        t, normal = hits_and_normals(surface, origins, task.directions)
        return torch.where(t < torch.inf, t, 0).sum() + normal.sum()

    def alone() -> Any:
        with torch.no_grad():
            return forward()

    return alone, lambda: torch.autograd.grad(forward(), (volume, origins))


def _backward(settings: Settings) -> Race:
    task = task_of(settings)
    forward, both = ways_of(task)
    contestants = [
        Contestant("forward", forward, samples=task.rays),
        Contestant("forward + backward", both, samples=task.rays),
    ]
    ratios = [Ratio("forward + backward", "forward", at_most("3"))]
    return Race(f"{described(task)}: gradients of depths and normals to samples and origins", contestants, ratios)


def _threads(settings: Settings) -> Race:
    task = task_of(settings)
    numbers = thread_numbers(usable_cores())
    contestants = [_on(threads, _hits(task, "triquadratic")) for threads in numbers]
    ratios = [
        Ratio(contestants[0].name, c.name, at_least("1.8") if n == 2 else None)
        for n, c in zip(numbers[1:], contestants[1:], strict=True)
    ]
    absent = {} if len(numbers) > 1 else {"2 threads": "one core only"}
    return Race(f"{described(task)}: first hits and normals on threads", contestants, ratios, absent=absent)


def _on(threads: int, c: Contestant) -> Contestant:
    def call() -> Any:
        torch.set_num_threads(threads)
        return c.call()

    return replace(c, name=f"{threads} thread{'s' * (threads != 1)}", call=call)


def _growth(settings: Settings, what: str) -> Race:
    """Twice as many pixels, or voxels, along an edge."""
    task = task_of(settings)
    size, voxels = 2 * settings.image, settings.image_voxels
    cases: dict[str, Callable[[], Casting]] = {
        "pixels": lambda: task_of(settings, size // 2),
        "voxels": lambda: task_of(settings, size, voxels // 2),
    }
    small = _hits(cases[what](), "triquadratic", name=f"half the {what} along an edge")
    large = _hits(task, "triquadratic", name="all")
    contestants = [replace(c, computes=None) for c in (small, large)]
    return Race(f"{described(task)}: first hits and normals", contestants, [Ratio("all", small.name)])


def _memory(settings: Settings, tick: Tick) -> Outcome:
    """Of bounds, hits and normals, beyond the field; in processes of their own."""
    size, voxels = 2 * settings.image, settings.image_voxels
    cases = {"all": (voxels, size), "half the pixels along an edge": (voxels, size // 2)}
    cases["half the voxels along an edge"] = (voxels // 2, size)
    figures = []
    for done, (name, (n, edge)) in enumerate(cases.items()):
        own = [measured("casting_memory", threads=settings.threads, voxels=n, size=edge) for _ in range(_PROCESSES)]
        beyond = [(x["peak"] - x["before"]) / 2**20 for x in own]
        figures.append(Figure(name=f"{name}, beyond the field", spread=Spread.of(beyond), unit="MiB"))
        tick((done + 1) / len(cases))
    what = f"peak memory of a first picture: bounds, first hits and normals, triquadratic, {voxels}³, {size}² rays"
    return Outcome(name="memory", what=what, figures=tuple(figures))


def _items(settings: Settings) -> list[Item]:
    return [
        race_item("first", 30, _first),
        race_item("isoray", 180, _bisecting),
        race_item("images", 20, _renderers),
        race_item("new-level", 30, _new_level),
        race_item("plain", 60, _plain),
        race_item("sheets", 30, _sheets),
        race_item("backward", 10, _backward),
        race_item("threads", 5, _threads, threads=usable_cores()),
        race_item("pixels", 5, lambda s: _growth(s, "pixels")),
        race_item("voxels", 5, lambda s: _growth(s, "voxels")),
        Item("memory", 30, _memory),
    ]


COMPARISON = Comparison(
    "surfaces", "first hits of level sets, against Mitsuba's sdfgrid and Embree's triangles", _items
)
