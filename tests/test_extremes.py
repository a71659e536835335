"""The contract at the extremes: the cases of `experiments.extremes`, shorter, and what holds them together."""

from __future__ import annotations

import math
from operator import attrgetter

import pytest

from experiments.extremes import CASES, document, processes
from experiments.extremes.contract import Case, Finding, Subject, Tally, random_numbers
from tests.pairs import covering


def met(case: Case, subject: Subject) -> tuple[object, ...]:
    """What meets here: cases meet every method, and every scheme with every boundary; so do, in one case or another,
    methods. `stability` sweeps all of them together.
    """
    evaluation = subject.scheme, subject.boundary, subject.device
    return (case.key, subject.method), (case.key, *evaluation), *((subject.method, part) for part in evaluation)


BY_CASE = covering(((case, subject) for case in CASES.values() for subject in case.subjects()), met)


@pytest.mark.parametrize(("case", "subject"), BY_CASE, ids=[f"{case.key}-{subject.key}" for case, subject in BY_CASE])
def test_the_contract_is_kept(case: Case, subject: Subject, request: pytest.FixtureRequest) -> None:
    if case not in processes.CASES:  # those are about how a process of its own begins and ends
        request.getfixturevalue("forks")
    finding = case.run(subject, seed=2, amount=case.tested)
    if finding.skipped:
        pytest.skip(finding.skipped)
    assert finding.holds, finding


def test_a_finding_needs_inputs_and_an_error_within_the_bound() -> None:
    assert Finding(3, 0.5, 1.0).holds
    assert not Finding(3, 1.5, 1.0).holds
    assert not Finding(3, math.nan, 1.0).holds
    assert not Finding(0, 0.0, 1.0).holds
    assert not Finding(3, 0.0, 1.0, skipped="no GPU").holds


def test_a_tally_keeps_the_worst() -> None:
    tally = Tally(bound=1.0)
    for size in (0.5, 2.0, 0.25):
        tally.error(size, f"size {size}")
    assert tally.finding() == Finding(3, 2.0, 1.0, "size 2.0")
    tally = Tally(bound=1.0)
    tally.error(math.nan, "a NaN")
    assert not tally.finding().holds
    tally = Tally()
    tally.kept(True, "good", 5)
    assert tally.finding() == Finding(5, 0.0, 0.0)
    tally.kept(False, "bad", 2)
    assert tally.finding() == Finding(7, 1.0, 0.0, "bad")
    tally = Tally(bound=1e-3)
    tally.kept(False, "bad")
    assert not tally.finding().holds


def test_an_error_that_nobody_expects_breaks_the_contract() -> None:
    def check(subject, random, amount):
        raise IndexError("7 is out of range")

    finding = Case("boom", "", "", check).run(Subject(), 0)
    assert not finding.holds
    assert finding.note == "IndexError: 7 is out of range"


def test_cases_draw_their_own_numbers() -> None:
    same = [random_numbers("a", Subject("notch"), 1).random() for _ in range(2)]
    others = [random_numbers("b", Subject("notch"), 1).random(), random_numbers("a", Subject("ncrsi"), 1).random()]
    assert same[0] == same[1]
    assert len({same[0], *others}) == 3


def test_a_sweep_leaves_out_what_a_method_does_not_offer() -> None:
    case = Case("x", "", "", lambda *_: Finding(1, 0, 0), ("method", "scheme"))
    found = case.subjects(["mitchell", "notch"])
    assert Subject("mitchell", "sampled") not in found
    assert Subject("notch", "sampled") in found
    assert Case("y", "", "", lambda *_: Finding(1, 0, 0)).subjects() == [Subject()]


def test_every_case_meets_all_that_it_sweeps() -> None:
    for case in CASES.values():
        every, some = case.subjects(), [subject for own, subject in BY_CASE if own is case]
        for parts in (("method",), ("scheme", "boundary"), ("device",)):
            values = attrgetter(*parts)
            assert set(map(values, some)) == set(map(values, every)), (case.key, parts)
    for parts in (("method", "scheme"), ("method", "boundary")):
        values = attrgetter(*parts)
        swept = {values(subject) for case in CASES.values() for subject in case.subjects()}
        assert {values(subject) for _, subject in BY_CASE} == swept


# --- the documentation ------------------------------------------------------------------------------------------------


def test_the_documentation_shows_every_case_as_it_is_promised_and_none_broken() -> None:
    """A promise that changed, a case that was renamed: the table is of another time, and must be made again."""
    text = document.DOCUMENT.read_text(encoding="utf-8")
    measured = text.split(document.BEGIN)[1].split(document.END)[0]
    rows = [line for line in measured.splitlines() if line.startswith("| ")][1:]
    shown = [tuple(row.replace("\\|", "¦").split(" | ")[:2]) for row in rows]
    promised = [(f"| {case.title}", case.contract.replace("|", "¦")) for case in CASES.values()]
    assert shown == promised
    assert all(row.endswith("| kept |") for row in rows)


def test_only_what_stands_between_the_markers_is_replaced() -> None:
    text = f"before\n{document.BEGIN}\nold\n{document.END}\nafter\n"
    changed = document.with_table(text, "new\n")
    assert changed == f"before\n{document.BEGIN}\nnew\n{document.END}\nafter\n"
    assert document.with_table(changed, "new\n") == changed
    for broken in ("", document.BEGIN, f"{document.END}{document.BEGIN}", text + text):
        with pytest.raises(ValueError, match="expected one line <!-- measured: begin -->"):
            document.with_table(broken, "new\n")


def test_a_folder_without_records_is_said_so(tmp_path, capsys) -> None:
    assert document.main([str(tmp_path)]) == 1
    assert "has no records" in capsys.readouterr().err
