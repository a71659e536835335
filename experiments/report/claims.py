"""The table of what the paper says and what was measured."""

from __future__ import annotations

from collections.abc import Sequence

from experiments.report.page import Column, Table
from experiments.report.style import fixed, times
from experiments.runs import Record

VERDICTS = {"holds": "✓ holds", "in part": "± in part", "does not hold": "✗ does not hold"}
NARROW = str.maketrans(" ", "\u00a0")  # no line breaks in numbers and verdicts


def claims_table(claims: Sequence[Record], resolutions: Sequence[int]) -> Table:
    """One row for each claim: the verdict, the paper's number, the numbers here."""
    columns = [
        Column("", numeric=False),
        Column("the paper says", numeric=False),
        Column("its number", numeric=False),
        Column("measured here", numeric=False),
        Column("found", numeric=False),
    ]
    rows = [
        [
            VERDICTS[c["verdict"]].translate(NARROW),
            c["said"],
            c["paper"],
            f"{c['measured']}: {_limit(c)}",
            _found(c, [f"{n}³" for n in resolutions]),
        ]
        for c in claims
    ]
    caption = (
        "A claim holds where every number keeps to its limit, in part where some do. Limits are the paper's numbers, "
        f"or what its words let one expect. Numbers are those at {', '.join(f'{n}³' for n in resolutions)}, in this "
        "order, where no resolution is named; 1/4.3 means 4.3 times less."
    )
    return Table(columns, rows, caption, wrapped=True)


def _limit(claim: Record) -> str:
    return f"{'≤' if claim['at_most'] else '≥'} {_number(claim, claim['limit'])}".translate(NARROW)


def _number(claim: Record, value: float) -> str:
    return (f"{fixed(value, 1)} dB" if claim["unit"] == "dB" else times(value)).translate(NARROW)


def _found(claim: Record, everywhere: Sequence[str]) -> str:
    """The numbers of each signal together; their resolutions are named unless they are all there."""
    groups: dict[str, dict[str, float]] = {}
    for where, value in claim["found"].items():
        signal, _, resolution = where.rpartition(" ")
        groups.setdefault(signal, {})[resolution] = value
    said = []
    for signal, numbers in groups.items():
        named = list(numbers) != list(everywhere)
        listed = ", ".join(f"{_number(claim, v)}{f' at {n}' if named else ''}" for n, v in numbers.items())
        said.append(f"{signal} {listed}".strip())
    return "; ".join(said)
