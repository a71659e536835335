"""The floor of this machine, and how near to it the fused jets come."""

from __future__ import annotations

from benchmarks import floor, workloads
from benchmarks.comparisons.jets import op_contestant
from benchmarks.harness import Comparison, Contestant, Item, Race, Ratio, Tick, race_item, run_race
from benchmarks.records import Figure, Outcome, Spread, Timing, at_least
from benchmarks.settings import Settings

_BARS = {"triquadratic": at_least("0.5"), "tricubic": at_least("0.7")}
_KERNELS = {"triquadratic": 3, "tricubic": 4}


def _rates(settings: Settings, tick: Tick) -> Outcome:
    operations = 10**7 if settings.quick else 10**9
    near, far = 2**14, 2**25 if settings.quick else 2**27
    times = operations // near
    race = Race(
        what="what one core can do: multiply-adds in registers, bytes from 16 KiB and from memory",
        contestants=[
            Contestant("multiply-adds", floor.multiply_adds(operations), samples=operations),
            Contestant("read, 16 KiB", floor.reads(near, times), samples=near * times),
            Contestant("read, memory", floor.reads(far), samples=far),
            Contestant("copy, memory", floor.copies(far), samples=2 * far),
        ],
    )
    outcome = run_race("rates", race, settings, tick)
    return outcome.model_copy(update={"figures": tuple(map(_rate, outcome.timings))})


def _rate(timing: Timing) -> Figure:
    rates = Spread.of([timing.samples / max(t, 1e-12) / 1e9 for t in timing.seconds])
    return Figure(name=timing.name, spread=rates, unit="10⁹/s" if timing.name == "multiply-adds" else "GB/s")


def _share(settings: Settings, name: str) -> Race:
    support = _KERNELS[name]
    (kernel, *_) = workloads.terms_of(name)[0].kernels
    alone, whole = floor.sums(support), floor.sums(support) + floor.weights(kernel)  # type: ignore[arg-type]
    where = workloads.points("coherent", settings.voxels, settings.points)
    contestants = [
        op_contestant(name, "fused", workloads.noise(settings.voxels), where, computes=None),
        *(
            Contestant(f"{n} multiply-adds", floor.multiply_adds(n * len(where)), samples=len(where))
            for n in (alone, whole)
        ),
    ]
    return Race(
        what=f"{name} value + gradient against its own multiply-adds alone: {alone} of sums, {whole} with the weights, "
        f"{floor.lanes()} lanes; along rays",
        contestants=contestants,
        ratios=[
            Ratio(f"{whole} multiply-adds", "op fused", _BARS[name], "share of the floor, weights counted"),
            Ratio(f"{alone} multiply-adds", "op fused", name="share of the floor, sums only"),
        ],
    )


def _items(settings: Settings) -> list[Item]:
    return [
        Item("rates", 8, _rates),
        *(race_item(name, 1, lambda s, name=name: _share(s, name)) for name in _KERNELS),
    ]


COMPARISON = Comparison("floor", "measured multiply-add, load and memory rates, and the share of them reached", _items)
