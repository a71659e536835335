"""Whether calls on all threads take as long each time, and what becomes of them where all threads share one core."""

from __future__ import annotations

from benchmarks.harness import Comparison, Item, Tick, usable_cores
from benchmarks.probe import measured
from benchmarks.records import Figure, Outcome, Spread, at_most
from benchmarks.settings import Settings

_RENDERS = 50
_PROCESSES = 3


def _renders(settings: Settings, tick: Tick) -> Outcome:
    """In processes of their own, with as many threads as a library has that nobody told a number."""
    number = 1 if settings.quick else _PROCESSES
    cores, size, voxels = settings.threads, settings.image, settings.image_voxels
    found = []
    for done in range(number):
        renders = 5 if settings.quick else _RENDERS
        arguments = {"threads": cores, "voxels": voxels, "size": size, "renders": renders}
        found.append(measured("steadiness", {"OMP_NUM_THREADS": str(cores)}, **arguments))
        tick((done + 1) / number)
    slowest = Spread.of([one["slowest"] / one["median"] for one in found])
    figures = [
        Figure(name="slowest ÷ median", spread=slowest, bar=at_most("2")),
        Figure(name="median", spread=Spread.of([one["median"] for one in found]), unit="s"),
        Figure(name="threads kept busy", spread=Spread.of([one["busy"] for one in found])),
    ]
    if "packed" in found[0]:
        packed = Spread.of([one["packed"] / one["alone"] for one in found])
        name = "CPU time, all threads on one core ÷ one thread"
        figures.append(Figure(name=name, spread=packed, bar=at_most("1.5")))
    return Outcome(
        name="renders",
        what=f"Marschner-Lobb {voxels}³ at {size}², lit, triquadratic fused, on {cores} threads",
        rounds=number,
        figures=tuple(figures),
    )


def _items(settings: Settings) -> list[Item]:
    return [Item("renders", 60, _renders, threads=usable_cores())]


COMPARISON = Comparison("steadiness", "whether a render takes as long every time, on all threads", _items)
