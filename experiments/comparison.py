"""Is one filter better than another? Judged on members that neither was fitted to, one by one and together.

A learned filter is there several times, fitted to other members each time. It is called `better` than a named method
when its RMS error over all members is at least one part in a hundred smaller every time, and it is smaller on at least
nine of ten members; `worse` when the same holds the other way round; else the outcome is `mixed`.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence

from experiments.runs import Record

BETTER, WORSE, MIXED = "better", "worse", "mixed"
MARGIN = 0.01  # the least difference of the errors over all members that counts
AGREEMENT = 0.9  # the least share of members that must agree
QUANTITIES = ("value", "gradient")

Errors = Mapping[str, Sequence[float]]
"""RMS errors of every member, by quantity."""


def pooled(errors: Sequence[float]) -> float:
    """The RMS error over all members, from that of each (all have as many points)."""
    return math.sqrt(sum(e * e for e in errors) / len(errors))


def compared(learned: Sequence[Errors], named: Errors, quantity: str) -> Record:
    """A learned filter, once for every repetition, against a named method on the same members.

    Returns `ratio` (geometric mean over repetitions of the ratio of the errors over all members; below 1 the learned
    one is better), `ratios` (every one), `wins` of `comparisons` (over members and repetitions), and the `verdict`.
    """
    against = named[quantity]
    ratios = [_ratio(pooled(errors[quantity]), pooled(against)) for errors in learned]
    single = [_ratio(a, b) for errors in learned for a, b in zip(errors[quantity], against, strict=True)]
    wins, losses = sum(r < 1 for r in single), sum(r > 1 for r in single)
    return {
        "ratio": math.exp(sum(map(math.log, ratios)) / len(ratios)),
        "ratios": ratios,
        "wins": wins,
        "comparisons": len(single),
        "verdict": verdict(ratios, wins / len(single), losses / len(single)),
    }


def verdict(ratios: Sequence[float], wins: float, losses: float) -> str:
    """`better`, `worse` or `mixed`, from the ratio of every repetition and the shares of members won and lost."""
    if max(ratios) <= 1 - MARGIN and wins >= AGREEMENT:
        return BETTER
    if min(ratios) >= 1 + MARGIN and losses >= AGREEMENT:
        return WORSE
    return MIXED


def chosen(fits: Iterable[Record]) -> dict[int, str]:
    """{taps: candidate} with the least mean objective on the validation members; the test members have no say."""
    objectives: dict[tuple[int, str], list[float]] = {}
    for fit in fits:
        objectives.setdefault((fit["taps"], fit["candidate"]), []).append(fit["validation"])
    best: dict[int, tuple[float, str]] = {}
    for (taps, candidate), listed in objectives.items():
        mean = sum(listed) / len(listed)
        if taps not in best or mean < best[taps][0]:
            best[taps] = (mean, candidate)
    return {taps: candidate for taps, (_, candidate) in sorted(best.items())}


def _ratio(a: float, b: float) -> float:
    """a / b of two errors; a positive number even where one of them is zero."""
    tiny = 1e-300
    return max(a, tiny) / max(b, tiny)
