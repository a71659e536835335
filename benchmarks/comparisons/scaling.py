"""Cost against the number of samples and of threads."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import torch

from benchmarks import workloads
from benchmarks.comparisons.jets import field_contestant, op_contestant
from benchmarks.harness import Comparison, Contestant, Item, Race, Ratio, race_item, usable_cores
from benchmarks.records import at_least
from benchmarks.settings import Settings

_FEWEST = 10**3
_DIRECT_UP_TO = 10**6
_BAR = at_least("1.65")  # two threads


def _samples(settings: Settings, arrangement: str) -> Race:
    """10³, 10⁴, … points: overheads first, then cost per sample, then memory."""
    volume = workloads.noise(settings.voxels)
    contestants, counts, count = [], [], _FEWEST
    while count <= settings.most_points:
        where = workloads.points(arrangement, settings.voxels, count)
        counts.append(count)
        for scheme in ("fused", "direct") if count <= _DIRECT_UP_TO else ("fused",):
            computes = f"{count} points"
            contestants.append(
                field_contestant("triquadratic", scheme, volume, where, name=f"{scheme}, {count:,}", computes=computes)
            )
        count *= 10
    ratios = [Ratio(f"fused, {n:,}", f"direct, {n:,}") for n in counts if n <= _DIRECT_UP_TO]
    return Race(f"triquadratic value + gradient of a field, points {arrangement}", contestants, ratios, tolerance=2e-5)


def _threads(settings: Settings, arrangement: str) -> Race:
    """The same contestant on 1, 2, 4, … threads up to the cores there are."""
    volume = workloads.noise(settings.voxels)
    where = workloads.points(arrangement, settings.voxels, settings.points)
    numbers = thread_numbers(usable_cores())
    contestants = [
        _on(threads, kind)
        for kind in (
            op_contestant("triquadratic", "fused", volume, where),
            field_contestant("triquadratic", "fused", volume, where, name="field fused"),
        )
        for threads in numbers
    ]
    kinds = ("op fused", "field fused")
    ratios = [
        Ratio(_label(kind, 1), _label(kind, n), _BAR if n == 2 and kind == "op fused" else None)
        for kind in kinds
        for n in numbers[1:]
    ]
    absent = {} if len(numbers) > 1 else {"2 threads": "one core only"}
    return Race(f"triquadratic value + gradient on threads, points {arrangement}", contestants, ratios, absent=absent)


def thread_numbers(cores: int) -> list[int]:
    """1, 2, 4, … and the cores themselves."""
    numbers = [1]
    while 2 * numbers[-1] <= cores:
        numbers.append(2 * numbers[-1])
    return numbers if numbers[-1] == cores else [*numbers, cores]


def _label(name: str, threads: int) -> str:
    return f"{name}, {threads} thread{'s' * (threads != 1)}"


def _on(threads: int, c: Contestant) -> Contestant:
    return Contestant(_label(c.name, threads), _with_threads(threads, c.call), c.computes, c.numbers, c.samples)


def _with_threads(threads: int, call: Callable[[], Any]) -> Callable[[], Any]:
    def wrapped() -> Any:
        torch.set_num_threads(threads)
        return call()

    return wrapped


def _items(settings: Settings) -> list[Item]:
    samples = [race_item(f"samples-{o}", 30, lambda s, o=o: _samples(s, o)) for o in workloads.ARRANGEMENTS]
    threads = [
        race_item(f"threads-{o}", 3, lambda s, o=o: _threads(s, o), threads=usable_cores())
        for o in workloads.ARRANGEMENTS
    ]
    return [*samples, *threads]


COMPARISON = Comparison("scaling", "cost against the number of samples and of threads", _items)
