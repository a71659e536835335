"""What a sweep in pairs has, and leaves out."""

from __future__ import annotations

from itertools import combinations, product

import pytest

from tests.pairs import covering, in_pairs

FULL = list(product("abcde", range(5), (True, False), "xyz"))
SWEEPS = {
    "full": FULL,
    "with gaps": [row for row in FULL if not (row[0] == "a" and row[1] > 1) and not (row[2] and row[3] == "z")],
    "two": list(product("abc", "xy")),
    "one": [("a",), ("b",)],
    "none": [],
}


def pairs(rows):
    return {(i, j, row[i], row[j]) for row in rows for i, j in combinations(range(len(row)), 2)}


@pytest.mark.parametrize("rows", SWEEPS.values(), ids=SWEEPS)
def test_every_pair_is_there_and_every_row_is_of_the_sweep_in_its_order(rows):
    some = in_pairs(rows)
    assert [set(values) for values in zip(*some, strict=True)] == [set(values) for values in zip(*rows, strict=True)]
    assert pairs(some) == pairs(rows)
    assert some == [row for row in rows if row in set(some)]


def test_few_rows_do():
    assert len(in_pairs(FULL)) <= 30  # of 150; fewer than 5 · 5 can't have the pairs of the first two
    assert len(in_pairs(SWEEPS["two"])) == 6
    assert len(in_pairs([*FULL, *FULL])) == len(in_pairs(FULL))


def test_all_that_is_shown_is_kept_and_nothing_else():
    rows = list(product("abcd", (1, 2), "xy"))
    some = covering(rows, lambda letter, number, other: (letter, (number, other)))
    assert {row[0] for row in some} == set("abcd")
    assert {row[1:] for row in some} == set(product((1, 2), "xy"))
    assert len(some) == 4
    assert covering(rows, lambda *_: ("the same",)) == rows[:1]
