"""The first call of a kernel in a fresh process, compiled and loaded from the cache on disk; of torch.compile."""

from __future__ import annotations

import tempfile

from benchmarks.harness import Comparison, Item, Tick
from benchmarks.probe import measured
from benchmarks.records import Figure, Outcome, Spread, at_most
from benchmarks.settings import Settings

_METHODS = ("triquadratic", "tricubic")
_MOST = 5  # processes of each kind: each one imports torch
_BARS = {"compiled": at_most("0.5 s"), "loaded from the cache": at_most("0.02 s")}


def _first_calls(first: str, other: str, settings: Settings, tick: Tick) -> Outcome:
    """Every round starts with an empty cache folder: one process fills it, the next one reads it."""
    rounds = min(settings.repeats, 2 if settings.quick else _MOST)
    found: dict[str, list[dict[str, float]]] = {"compiled": [], "loaded from the cache": []}
    for r in range(rounds):
        with tempfile.TemporaryDirectory() as folder:
            for runs in found.values():
                runs.append(measured("first_call", {"FILTERLAB_CACHE": folder}, methods=[first, other]))
        tick((r + 1) / rounds)
    figures = [
        Figure(name=f"{which}, {how}", spread=Spread.of([run[key] for run in runs]), unit="s", bar=_BARS[how])
        for key, which in ((first, f"{first}, with imports"), (other, f"{other}, then"))
        for how, runs in found.items()
    ]
    again = Spread.of([run["again"] for run in found["loaded from the cache"]])
    return Outcome(
        name=f"{first}-first",
        what=f"first value and gradient of a fused {first}, then of a {other}, in a fresh process; 16 points",
        rounds=rounds,
        figures=(*figures, Figure(name=f"{other} once more", spread=again, unit="s")),
    )


def _torch_compile(settings: Settings, tick: Tick) -> Outcome:
    """Every round with an empty cache folder of torch's compiler."""
    rounds = 1 if settings.quick else min(settings.repeats, 3)
    found: dict[str | None, list[float]] = {_METHODS[0]: [], None: []}
    for r in range(rounds):
        for method, runs in found.items():
            with tempfile.TemporaryDirectory() as folder:
                environment = {"TORCHINDUCTOR_CACHE_DIR": folder}
                runs.append(measured("torch_compile", environment, threads=1, method=method)["seconds"])
        tick((r + 1) / rounds)
    step, least = (Spread.of(runs) for runs in found.values())
    return Outcome(
        name="torch.compile",
        what="CPU time of the first call and its derivatives, with torch's compilers, in a fresh process; 4,096 points",
        rounds=rounds,
        figures=(
            Figure(name=f"step that trains a {_METHODS[0]} Reconstruction", spread=step, unit="s", bar=at_most("15 s")),
            Figure(name="sum of sines", spread=least, unit="s"),
        ),
    )


def _items(settings: Settings) -> list[Item]:
    return [
        *(
            Item(f"{first}-first", 50, lambda s, tick, first=first, other=other: _first_calls(first, other, s, tick))
            for first, other in (_METHODS, _METHODS[::-1])
        ),
        Item("torch.compile", 100, _torch_compile),
    ]


COMPARISON = Comparison("startup", "first call of a new kernel, and of a cached one", _items)
