"""Races: contestants in turn, their numbers compared first, their times as ratios within a round.

Letters: R rounds; t_A(r) the time of contestant A in round r. The ratio A ÷ B is the median over r of t_A(r) / t_B(r):
what slows both down in a round cancels, and a round that something else disturbed does not count.
"""

from __future__ import annotations

import math
import os
import re
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from benchmarks.records import Bar, Figure, Outcome, Spread, Timing
from benchmarks.settings import Settings
from filterlab.costs import Rounds, Tick, per_round, take_turns

Numbers = Sequence[Tensor | np.ndarray]
_CLOCKS = {"wall": time.perf_counter, "cpu": time.process_time}


@dataclass(frozen=True)
class Contestant:
    """One way to compute something.

    Attributes:
        name: what tables call it.
        call: does the work, all of it before it returns.
        computes: what it computes; contestants of a race with the same words here must agree. None: not compared.
        numbers: the result of `call` -> arrays that are compared, one after the other.
        samples: how many of whatever it computes in one call.
    """

    name: str
    call: Callable[[], Any]
    computes: str | None = None
    numbers: Callable[[Any], Numbers] = tuple
    samples: int = 1


@dataclass(frozen=True)
class Ratio:
    """above ÷ below: names of two contestants. It is left out where one of them did not take part."""

    above: str
    below: str
    bar: Bar | None = None
    name: str | None = None


@dataclass(frozen=True)
class Race:
    """Contestants and what is asked of them.

    Attributes:
        what: one line for people.
        contestants: in their turn.
        ratios: what is reported.
        tolerance: largest difference in units of the largest magnitude of the reference.
        references: what `computes` says -> the right numbers, computed once and not timed; without one the first
            contestant that computes it is the reference.
        absent: who does not take part, and why.
    """

    what: str
    contestants: Sequence[Contestant]
    ratios: Sequence[Ratio] = ()
    tolerance: float = 1e-5
    references: Mapping[str, Callable[[], Numbers]] = field(default_factory=dict)
    absent: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Item:
    """One race (or another measurement) of a comparison.

    Attributes:
        name: short key, as in `python -m benchmarks jets/tricubic-random`.
        seconds: expected, on two Zen 3 cores; the progress bar weighs items by it.
        run: does it.
        threads: cores that it may use, where that is not what the settings say; its clock is then the wall's.
    """

    name: str
    seconds: float
    run: Callable[[Settings, Tick], Outcome]
    threads: int | None = None


@dataclass(frozen=True)
class Comparison:
    """A question: its items, decided from the settings without computing anything."""

    name: str
    summary: str
    items: Callable[[Settings], list[Item]]


def race_item(name: str, seconds: float, build: Callable[[Settings], Race], threads: int | None = None) -> Item:
    """The item of a race that is built when its turn has come, and forgotten afterwards."""
    return Item(name, seconds, lambda settings, tick: run_race(name, build(settings), settings, tick), threads)


class DisagreementError(ArithmeticError):
    """Two contestants that should compute the same do not."""


def run_race(name: str, race: Race, settings: Settings, tick: Tick = lambda _: None) -> Outcome:
    """Call every contestant once, compare, then take the times."""
    _check_names(race)
    fit, firsts, found, errors = _first_calls(race)
    rounds, share = _take_times(fit, settings, tick)
    timings = tuple(
        Timing(
            name=c.name,
            first_call=firsts[c.name],
            seconds=tuple(rounds.seconds[c.name]),
            spread=Spread.of(rounds.seconds[c.name]),
            calls=rounds.calls[c.name],
            samples=c.samples,
            **found.get(c.name, {}),
        )
        for c in fit
    )
    return Outcome(
        name=name,
        what=race.what,
        rounds=rounds.number,
        share_of_core=share,
        timings=timings,
        figures=tuple(_figures(race.ratios, rounds.seconds)),
        absent=dict(race.absent),
        errors=errors,
    )


def _check_names(race: Race) -> None:
    names = [c.name for c in race.contestants]
    assert len(set(names)) == len(names), f"contestants share a name: {names}"
    known = {*names, *race.absent}
    assert all({r.above, r.below} <= known for r in race.ratios), f"a ratio names nobody of {sorted(known)}"


def _first_calls(race: Race) -> tuple[list[Contestant], dict[str, float], dict[str, dict[str, Any]], dict[str, str]]:
    """Who can run and agrees, seconds of the first calls, what was found by comparing, and what went wrong."""
    fit, firsts, found, errors = [], {}, {}, {}
    right: dict[str, tuple[str, list[np.ndarray]]] = {}
    for c in race.contestants:
        try:
            start = time.perf_counter()
            result = c.call()
            firsts[c.name] = time.perf_counter() - start
            if c.computes is not None:
                found[c.name] = _compared(c, result, race, right)
            fit.append(c)
        except Exception as error:  # a row without numbers, not the end of a long run
            errors[c.name] = explained(error)
    return fit, firsts, found, errors


def _compared(c: Contestant, result: Any, race: Race, right: dict[str, tuple[str, list[np.ndarray]]]) -> dict[str, Any]:
    """Compare with the reference; the first contestant becomes it where the race brings none."""
    assert c.computes is not None
    numbers = _arrays(c.numbers(result))
    if c.computes not in right:
        if c.computes not in race.references:
            right[c.computes] = c.name, numbers
            return {}
        right[c.computes] = "the direct sum", _arrays(race.references[c.computes]())
    name, expected = right[c.computes]
    off = difference(numbers, expected)
    if not off <= race.tolerance:
        raise DisagreementError(
            f"differs from {name} by {off:.2g} of the largest magnitude; {race.tolerance:.0e} is allowed"
        )
    return {"compared_with": name, "difference": off, "tolerance": race.tolerance}


def _arrays(numbers: Numbers) -> list[np.ndarray]:
    return [np.asarray(n.detach().cpu() if isinstance(n, Tensor) else n, dtype=np.float64) for n in numbers]


def difference(numbers: Sequence[np.ndarray], expected: Sequence[np.ndarray]) -> float:
    """max |a − b| / max |b| over all parts, each with its own largest magnitude; infinite where one is NaN."""
    if [n.shape for n in numbers] != [e.shape for e in expected]:
        shapes = [[n.shape for n in part] for part in (numbers, expected)]
        raise DisagreementError(f"expected numbers of shapes {shapes[1]}; got {shapes[0]}")
    worst = 0.0
    for a, b in zip(numbers, expected, strict=True):
        if a.size:
            off = float(np.abs(a - b).max() / (np.abs(b).max() or 1.0))
            worst = max(worst, off if math.isfinite(off) else math.inf)
    return worst


def explained(error: Exception) -> str:
    """The error in one line, without what names a folder of this machine."""
    text = " ".join(str(error).split()) or "no message"
    text = re.sub(r"(?<![\w.])(?:[A-Za-z]:)?(?:[/\\][\w.+@-]+){2,}", "…", text)
    return text[:300] if isinstance(error, DisagreementError) else f"{type(error).__name__}: {text}"[:300]


def _take_times(contestants: Sequence[Contestant], settings: Settings, tick: Tick) -> tuple[Rounds, float | None]:
    """A B C A B C …: seconds per call of every contestant in every round, and the share of the core we had."""
    rounds = take_turns(
        {c.name: c.call for c in contestants},
        seconds=settings.seconds,
        rounds=settings.repeats,
        least=settings.least_rounds,
        clock=_CLOCKS[settings.clock],
        tick=tick,
    )
    return rounds, rounds.cores / settings.threads if contestants else None


def _figures(ratios: Sequence[Ratio], seconds: Mapping[str, Sequence[float]]) -> Iterator[Figure]:
    for ratio in ratios:
        if ratio.above in seconds and ratio.below in seconds:
            yield Figure(
                name=ratio.name or f"{ratio.above} ÷ {ratio.below}",
                spread=Spread.of(per_round(seconds[ratio.above], seconds[ratio.below])),
                bar=ratio.bar,
            )


@contextmanager
def limited(threads: int) -> Iterator[None]:
    """This process on `threads` cores, the same ones throughout, and torch on as many threads."""
    before = torch.get_num_threads()
    pinned = os.sched_getaffinity(0) if hasattr(os, "sched_getaffinity") else None
    torch.set_num_threads(threads)
    if pinned is not None:
        os.sched_setaffinity(0, quietest_cores(pinned, threads))
    try:
        yield
    finally:
        torch.set_num_threads(before)
        if pinned is not None:
            os.sched_setaffinity(0, pinned)


def quietest_cores(cores: Collection[int], number: int, watch: float = 0.2) -> list[int]:
    """The `number` cores that idled most while watched for `watch` seconds; the last ones where nobody tells."""
    if len(cores) <= number:
        return sorted(cores)
    before = _idle()
    time.sleep(watch)
    after = _idle()
    return sorted(sorted(cores, key=lambda core: (after.get(core, 0) - before.get(core, 0), core))[-number:])


def _idle() -> dict[int, int]:
    """Ticks of every core in which it had nothing to do; empty where the system does not say (Linux does)."""
    try:
        lines = Path("/proc/stat").read_text(encoding="ascii").splitlines()
    except OSError:
        return {}
    rows = [line.split() for line in lines if re.match(r"cpu\d", line)]
    return {int(row[0].removeprefix("cpu")): int(row[4]) for row in rows}


def usable_cores() -> int:
    """Cores that this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
