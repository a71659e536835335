"""What fields cost on this machine: time to build them, time per sample, memory of their coefficients.

Candidates take turns, A B C A B C …: what slows the machine down slows all of them. Medians over the calls of a turn,
and over the rounds, do not see what something else disturbed. Letters: t_A(r), seconds of one call of candidate A in
round r. The ratio A ÷ B is the median over r of t_A(r) / t_B(r): what both suffer in a round cancels.
"""

from __future__ import annotations

import gc
import math
import statistics
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from filterlab.arrays import Array, as_tensor
from filterlab.fields.base import Field

Clock = Callable[[], float]
Tick = Callable[[float], None]
"""Told which fraction (0 … 1) is done."""

SHORTEST = (
    0.004  # seconds of a turn; what is faster is called several times in it, after half as many that do not count
)
BATCHES = 9  # of calls in a turn, at most
ROUNDS = 31  # at most, where the time allows
LEAST_ROUNDS = 3


@dataclass(frozen=True)
class Quartiles:
    """The lower quartile, the median and the upper quartile of a sample."""

    low: float
    median: float
    high: float

    @classmethod
    def of(cls, values: Sequence[float]) -> Quartiles:
        """Interpolated between the sorted values; of a single value all three are that value."""
        if len(values) == 1:
            return cls(values[0], values[0], values[0])
        return cls(*statistics.quantiles(values, n=4, method="inclusive"))


@dataclass(frozen=True)
class Rounds:
    """What `take_turns` found.

    Attributes:
        seconds: name -> seconds of one call, one number per round; where a turn has several calls, their median (of
            means of batches).
        calls: name -> calls in a turn.
        cores: how many cores this process kept busy on average while the rounds ran; far below the number of threads:
            the machine had other work, or the calls wait.
    """

    seconds: dict[str, list[float]]
    calls: dict[str, int]
    cores: float

    @property
    def number(self) -> int:
        """How many rounds there were."""
        return max(map(len, self.seconds.values()), default=0)


@dataclass(frozen=True)
class Cost:
    """What a field costs.

    Attributes:
        build: seconds to build it: the prefilter, and padding under the boundary.
        sample: nanoseconds per sample, of one jet of the asked order.
        coefficient_bytes: memory of the coefficients that the field keeps; 0 for one that has none, such as a signal.
        rounds: nanoseconds per sample in every round, in the order of the rounds, for ratios within them.
    """

    build: Quartiles
    sample: Quartiles
    coefficient_bytes: int
    rounds: tuple[float, ...]

    def relative_to(self, other: Cost) -> Quartiles:
        """Time per sample ÷ that of another candidate of the same `measure`, compared round by round.

        Raises ValueError for costs with different numbers of rounds: they were not measured together.
        """
        if len(self.rounds) != len(other.rounds):
            got = f"{len(self.rounds)} and {len(other.rounds)} rounds"
            raise ValueError(f"expected costs of one measurement, with as many rounds each; got {got}")
        return Quartiles.of(per_round(self.rounds, other.rounds))


def measure(
    candidates: Mapping[str, Callable[[], Field]],
    points: Array | Mapping[str, Array],
    *,
    order: int = 1,
    seconds: float = 2.0,
    clock: Clock | None = None,
    tick: Tick = lambda _: None,
) -> dict[str, Cost]:
    """What each candidate costs, on as many threads as torch is set to, without derivatives being recorded.

    Args:
        candidates: name -> builds the field, from samples that exist before: all that it does counts as building.
        points: world points `(P, 3)` (for batched fields `(N, P, 3)`) at which every candidate is evaluated; or those
            of each candidate by its name, to compare precisions (float64 points are computed in float64) or devices.
            Their order in space counts: points along rays read memory that is near, random ones do not.
        order: of the jets that are timed: 0 values, 1 values and gradients, 2 Hessians too.
        seconds: about how long it may take, half of it for building and half for sampling. Where that does not suffice
            for three rounds it takes longer; first calls, which compile and load, are not counted and come
            on top.
        clock: default: `time.perf_counter`. `time.process_time` does not see the time in which the core worked for
            others; it adds up all threads.
        tick: told which fraction is done.

    All fields are kept until the end: memory is the sum of their coefficients, and of one more while they are built.
    (Building them anew in every round was tried: fresh memory is slower, and not for all alike.)

    Returns:
        name -> `Cost`, in the order of the candidates.

    Raises:
        ValueError: no points, or points that the fields refuse.
    """
    where = {name: as_tensor(points[name] if isinstance(points, Mapping) else points) for name in candidates}
    for name, p in where.items():
        if p.numel() == 0:
            raise ValueError(f"expected points (P, 3) with P ≥ 1 to sample {name} at; got shape {tuple(p.shape)}")
    with torch.no_grad():
        builds = {name: _finished(build, where[name].device) for name, build in candidates.items()}
        fields = {name: build() for name, build in builds.items()}
        jets = {name: _finished(_jet(f, where[name], order), where[name].device) for name, f in fields.items()}
        for jet in jets.values():
            jet()
        building = take_turns(builds, seconds=seconds / 2, clock=clock, tick=lambda done: tick(done / 2))
        sampling = take_turns(jets, seconds=seconds / 2, clock=clock, tick=lambda done: tick((1 + done) / 2))
    return {
        name: _cost(field, building.seconds[name], [3e9 * s / where[name].numel() for s in sampling.seconds[name]])
        for name, field in fields.items()
    }


def _jet(field: Field, points: Tensor, order: int) -> Callable[[], Any]:
    return lambda: field.jet(points, order)


def _cost(field: Field, building: Sequence[float], nanoseconds: Sequence[float]) -> Cost:
    size = coefficient_bytes(field)
    return Cost(Quartiles.of(building), Quartiles.of(nanoseconds), size, tuple(nanoseconds))


def coefficient_bytes(field: Field) -> int:
    """Memory of the coefficients that a field keeps, padding included; 0 for a field that has none."""
    coefficients = getattr(field, "coefficients", None)
    return 0 if coefficients is None else coefficients.values.nbytes


def _finished(call: Callable[[], Any], device: torch.device) -> Callable[[], Any]:
    """The call, returning only when the device has done the work."""
    if device.type != "cuda":
        return call

    def waiting() -> Any:
        result = call()
        torch.cuda.synchronize(device)
        return result

    return waiting


def take_turns(
    calls: Mapping[str, Callable[[], Any]],
    *,
    seconds: float,
    rounds: int = ROUNDS,
    least: int = LEAST_ROUNDS,
    clock: Clock | None = None,
    tick: Tick = lambda _: None,
) -> Rounds:
    """A B C A B C …: seconds per call of every candidate in every round, after a call of each that does not count.

    Args:
        calls: name -> does the work, all of it before it returns.
        seconds: so many rounds are taken as fit in that time, by the calls that did not count.
        rounds: but not more than that,
        least: and not fewer than that (or than `rounds`).
        clock: default: `time.perf_counter`.
        tick: told which fraction is done.
    """
    clock = clock or time.perf_counter
    warm = {name: _seconds(call, 1, time.perf_counter) for name, call in calls.items()}
    times = {name: max(1, math.ceil(SHORTEST / max(t, 1e-7))) for name, t in warm.items()}
    one_round = sum((times[name] + times[name] // 2) * t for name, t in warm.items())
    affordable = int(seconds / max(one_round, 1e-9))
    number = max(min(rounds, affordable), min(rounds, least)) if calls else 0
    taken: dict[str, list[float]] = {name: [] for name in calls}
    with _without_garbage_collection():
        wall, cpu = time.perf_counter(), time.process_time()
        for r in range(number):
            for i, (name, call) in enumerate(calls.items()):
                _seconds(call, times[name] // 2, clock)  # who went before left its own data in the caches
                taken[name].append(_turn(call, times[name], clock))
                tick((r + (i + 1) / len(calls)) / number)
        wall, cpu = time.perf_counter() - wall, time.process_time() - cpu
    return Rounds(taken, times, cpu / max(wall, 1e-9))


def _turn(call: Callable[[], Any], times: int, clock: Clock) -> float:
    """Seconds per call: the median of batches, so that a disturbance shorter than the turn does not count."""
    number = min(times, BATCHES)
    sizes = [times // number + (i < times % number) for i in range(number)]
    return statistics.median([_seconds(call, size, clock) for size in sizes])


def _seconds(call: Callable[[], Any], times: int, clock: Clock) -> float:
    start = clock()
    for _ in range(times):
        call()
    return (clock() - start) / max(times, 1)


@contextmanager
def _without_garbage_collection() -> Iterator[None]:
    enabled = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if enabled:
            gc.enable()


def per_round(above: Sequence[float], below: Sequence[float]) -> list[float]:
    """t_A(r) / t_B(r) for every round r."""
    return [a / max(b, 1e-12) for a, b in zip(above, below, strict=True)]
