"""A recommendation as people and programs read it: sentences and a table, plain data, a scene."""

from __future__ import annotations

import math
from dataclasses import asdict
from typing import Any

from rich.console import Group
from rich.table import Table
from rich.text import Text

from filterlab.recommendation.choice import IMAGE, Candidate, Recommendation
from filterlab.recommendation.survey import INNER

COUNTED = {
    "resample": "RMS of the value",
    "dvr": "RMS of value or gradient per voxel, whichever is larger, with what the step loses",
    "isosurface": "RMS of value or gradient per voxel, whichever is larger",
}
DONE_ONCE = {
    "resample": "as many values as there are voxels",
    "dvr": f"a picture of {IMAGE}² pixels",
    "isosurface": "value and gradient at as many points as there are voxels",
}


def text(found: Recommendation) -> Group:
    """Sentences and a table."""
    return Group(*(Text(line) for line in sentences(found)), _table(found), *(Text(line) for line in _notes(found)))


def sentences(found: Recommendation) -> list[str]:
    """What is counted, and what is recommended; or why nothing is, and the most accurate there is."""
    low, high = found.value_range
    counted = f"{COUNTED[found.task]}, in parts of the range {low:.6g} … {high:.6g}"
    where = "" if found.level is None else f", next to the surface of {found.level:g}"
    lines = [f"Error: {counted}; inner {INNER} of the volume{where}."]
    chosen = found.chosen
    if found.pick is not None:
        lines.append(f"Recommended: {_named(chosen)}, {_interval(chosen)} for a budget of {percent(found.max_error)}.")
        if chosen.error.high > found.max_error:
            lines.append("The interval reaches beyond the budget: so near to it, it is kept in nine of ten cases.")
    else:
        lines.append(f"Nothing is likely to meet the budget: {_why_not(found)}")
        lines.append(f"The most accurate: {_named(chosen)}, {_interval(chosen)}.")
        if chosen.error.likely > found.max_error:
            lines.append(f"What would help: {_help(found)}.")
    return lines


def _help(found: Recommendation) -> str:
    """Which budget would be met, and what to change for a smaller one."""
    ways = [f"a budget of {_percent_above(found.best.error.likely)}, which that one most likely keeps"]
    if found.task != "resample" and found.level is None and found.of_value.likely <= found.max_error:
        ways.append(
            "to count the value alone, as task resample does: the gradient is what is off, the value is likely within "
            f"{_percent_above(found.of_value.likely)}"
        )
    if found.best.resolved:
        ways.append("finer voxels")
    else:
        ways.append(
            "finer voxels, or a volume that its voxels resolve: smoothed, or onto a coarser grid by antialias=True "
            "(another signal, without the finest detail)"
        )
    return "; ".join(ways)


def _why_not(found: Recommendation) -> str:
    accurate = [c for c in found.candidates if c.error.likely <= found.max_error]
    if found.undecided and not accurate:
        return "some error may be within it, but the samples do not tell."
    if not accurate:
        return f"no method here has an error of at most {percent(found.max_error)} on this volume."
    least_memory, least_time = min(c.memory for c in accurate), min(c.seconds for c in accurate)
    return (
        f"methods with an error of at most {percent(found.max_error)} need {size(least_memory)} or more, and "
        f"{duration(least_time)} or more; asked for at most {_limit(found)}."
    )


def _limit(found: Recommendation) -> str:
    limits = [(found.max_memory, size), (found.max_time, duration)]
    return " and ".join(show(value) for value, show in limits if math.isfinite(value)) or "nothing"


def _table(found: Recommendation) -> Table:
    table = Table(box=None, padding=(0, 2))
    for name in ("", "method", "scheme", "storage", "step"):
        table.add_column(name)
    for name in ("error", "measured", "time", "per sample", "memory"):
        table.add_column(name, justify="right")
    for candidate in (found.chosen, *found.runners_up()):
        mark = ("→" if found.pick else "best") if candidate is found.chosen else ""
        table.add_row(
            mark,
            candidate.method,
            candidate.scheme,
            candidate.storage or "as it comes",
            "–" if candidate.step is None else f"{candidate.step:g}",
            f"{percent(candidate.error.low)} … {percent(candidate.error.high)}",
            percent(candidate.error.measured),
            duration(candidate.seconds),
            f"{candidate.nanoseconds:.3g} ns",
            size(candidate.memory),
        )
    return table


def _notes(found: Recommendation) -> list[str]:
    lines = [f"Time: prefilter and {DONE_ONCE[found.task]}, measured on this machine. Memory: coefficients."]
    lines.append("Error: between what it lies in 95 of 100 cases. Measured: from the best estimate of the signal.")
    if not found.chosen.resolved:
        lines.append("The volume hardly resolves what it shows: how far its best estimate is off, no sample tells.")
    return lines


def _named(candidate: Candidate) -> str:
    parts = [f"{candidate.method} ({candidate.scheme})"]
    parts += [f"stored as {candidate.storage}"] if candidate.storage else []
    parts += [f"step {candidate.step:g} voxels"] if candidate.step else []
    return ", ".join(parts)


def _interval(candidate: Candidate) -> str:
    return f"error {percent(candidate.error.low)} … {percent(candidate.error.high)}"


def percent(part: float) -> str:
    """0.00512 -> "0.512 %"."""
    return f"{100 * part:.3g} %"


def _percent_above(part: float) -> str:
    """Rounded up: what is within the number is within this."""
    digits = 2 - math.floor(math.log10(100 * part)) if part > 0 else 0
    return f"{math.ceil(100 * part * 10**digits * (1 - 1e-12)) / 10**digits:.3g} %"


def duration(seconds: float) -> str:
    """Seconds in the unit that reads best."""
    for unit, factor in (("s", 1.0), ("ms", 1e3)):
        if seconds * factor >= 1:
            return f"{seconds * factor:.3g} {unit}"
    return f"{seconds * 1e6:.3g} µs"


def size(count: float) -> str:
    """Bytes in the unit that reads best."""
    for unit, power in (("GiB", 30), ("MiB", 20), ("KiB", 10)):
        if count >= 2**power:
            return f"{count / 2**power:.3g} {unit}"
    return f"{count:.0f} bytes"


def data(found: Recommendation) -> dict[str, Any]:
    """Plain data, for JSON; limits that were not given are None."""

    def plain(candidate: Candidate | None) -> dict[str, Any] | None:
        if candidate is None:
            return None
        error = candidate.error
        return {
            "method": candidate.method,
            "scheme": candidate.scheme,
            "storage": candidate.storage,
            "step": candidate.step,
            "error": {name: _finite(number) for name, number in asdict(error).items()},
            "resolved": candidate.resolved,
            "seconds": candidate.seconds,
            "nanoseconds_per_sample": candidate.nanoseconds,
            "memory_bytes": candidate.memory,
        }

    return {
        "task": found.task,
        "level": found.level,
        "max_error": found.max_error,
        "max_memory": found.max_memory if math.isfinite(found.max_memory) else None,
        "max_time": found.max_time if math.isfinite(found.max_time) else None,
        "boundary": found.boundary,
        "value_range": list(found.value_range),
        "pick": plain(found.pick),
        "undecided": found.undecided,
        "best": plain(found.best),
        "value_error": {name: _finite(number) for name, number in asdict(found.of_value).items()},
        "runners_up": [plain(c) for c in found.runners_up()],
    }


def scene(found: Recommendation, file: str | dict[str, Any], look: dict[str, Any]) -> dict[str, Any]:
    """A scene that `filterlab render` takes: the volume, reconstructed as recommended.

    Args:
        file: the volume, as a scene has it.
        look: all else, as `scenes.default.suggested` tells it; a step that is recommended comes before its own.
    """
    chosen = found.chosen
    method: dict[str, Any] = {"name": chosen.method, "scheme": chosen.scheme, "boundary": found.boundary}
    method |= {"storage": chosen.storage} if chosen.storage else {}
    method |= {"nan": found.nan} if found.nan != "refuse" else {}
    return {
        "description": f"{chosen.method}, recommended for an error of {percent(found.max_error)} ({found.task})",
        "volume": file,
        "method": method,
        **look,
        **({"step": chosen.step} if chosen.step else {}),
    }


def _finite(number: float) -> float | None:
    return number if math.isfinite(number) else None
