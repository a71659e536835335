"""COMPARISONS: what `python -m benchmarks` knows. To add one, write a module with `COMPARISON` and name it here."""

from __future__ import annotations

import difflib
from importlib import import_module

from benchmarks.harness import Comparison, Item
from benchmarks.settings import Settings

_NAMES = (
    "floor",
    "jets",
    "derivatives",
    "peers",
    "prefilter",
    "resample",
    "roots",
    "dvr",
    "surfaces",
    "terrain",
    "slim",
    "absent",
    "scaling",
    "steadiness",
    "startup",
    "gpu",
)

COMPARISONS: dict[str, Comparison] = {
    name: import_module(f"benchmarks.comparisons.{name}").COMPARISON for name in _NAMES
}


class UnknownNameError(ValueError):
    """A name that is neither a comparison nor the beginning of an item of one."""


def chosen(names: list[str], settings: Settings) -> list[tuple[Comparison, list[Item]]]:
    """The items asked for, in the order of the registry: all, those of a comparison, or those beginning `jets/tric`.

    Raises:
        UnknownNameError: with the nearest name that there is.
    """
    every = {c: c.items(settings) for c in COMPARISONS.values()}
    if not names:
        return list(every.items())
    known = [*COMPARISONS, *(f"{c.name}/{item.name}" for c, items in every.items() for item in items)]
    for name in names:
        if not any(_asks_for(name, k) for k in known):
            raise UnknownNameError(_unknown(name, known))
    picked = [
        (c, [i for i in items if any(_asks_for(n, f"{c.name}/{i.name}") for n in names)]) for c, items in every.items()
    ]
    return [(c, items) for c, items in picked if items]


def _asks_for(name: str, key: str) -> bool:
    """`jets` asks for jets/…, `jets/tric` for jets/tricubic-random."""
    return key == name or key.startswith(name if "/" in name else f"{name}/")


def _unknown(name: str, known: list[str]) -> str:
    nearest = difflib.get_close_matches(name, known, n=1, cutoff=0.4)
    hint = f"did you mean {nearest[0]}? " if nearest else ""
    return f"unknown comparison {name!r}; {hint}comparisons: {', '.join(COMPARISONS)}"
