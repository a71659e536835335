"""The extremes: what filterlab promises for inputs that break other tools, as cases that can be measured.

A case is a row of the contract: which inputs, what must hold, and a check that tries many of them. The experiment
`stability` runs all cases at full length and tabulates what it found; the tests run the same cases, shorter. Each
module here holds the cases of one kind; `contract` has the words, and `CASES` is all of them.
"""

from __future__ import annotations

from importlib import import_module

from experiments.extremes.contract import Case

_MODULES = ("coordinates", "values", "shapes", "addressing", "rendering", "configs", "files", "runs", "processes")


def _collected() -> dict[str, Case]:
    cases: dict[str, Case] = {}
    for module in _MODULES:
        for case in import_module(f"experiments.extremes.{module}").CASES:
            assert case.key not in cases, f"two cases are called {case.key}"
            cases[case.key] = case
    return cases


CASES: dict[str, Case] = _collected()
