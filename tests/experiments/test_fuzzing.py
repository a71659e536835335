"""Damaged volume files in a process of their own; and that what goes wrong there is found."""

import sys

import numpy as np
import pytest

from experiments.extremes import fuzzing
from experiments.extremes.fuzzing import fuzzed
from experiments.extremes.mutations import KINDS, NUMBERS, Edit, edited, random_edits
from experiments.extremes.originals import SAMPLES, originals
from filterlab.io import load_volume


@pytest.mark.parametrize("name", list(originals()))
def test_the_originals_are_valid_and_packed_as_they_were(name, tmp_path):
    original = originals()[name]
    original.write(tmp_path)
    for _ in range(2):
        found = load_volume(tmp_path / original.path, frame=original.frame).samples.numpy()
        scaled = 2 * SAMPLES - 1 if "scaled" in name else SAMPLES
        assert (found == scaled).all()
        original.damage(tmp_path, original.content)  # in fact, not damaged


def test_edits_do_what_they_are_called():
    def one(kind, where, patch, content=b"sizes: 40 3 2"):
        return edited(content, [Edit(kind, where, patch)])

    assert one("set", 0.0, b"S") == b"Sizes: 40 3 2"
    assert one("insert", 0.0, b"S") == b"Ssizes: 40 3 2"
    assert one("delete", 0.0, b"123") == b"es: 40 3 2"
    assert one("repeat", 0.0, b"123") == b"sizsizes: 40 3 2"
    assert one("cut", 0.5, b"") == b"siz"
    assert [one("number", w, b"nan") for w in (0.0, 0.5, 1.0)] == [
        b"sizes: nan 3 2",
        b"sizes: 40 nan 2",
        b"sizes: 40 3 nan",
    ]
    assert one("number", 0.0, b"7", b"no numbers") == b"7o numbers"
    assert all(one(kind, 1.0, b"1", b"") in (b"", b"1") for kind in KINDS)
    rng = np.random.default_rng(0)
    cases = [random_edits(rng) for _ in range(600)]
    assert {e.kind for edits in cases for e in edits} == set(KINDS)
    assert {e.patch for edits in cases for e in edits if e.kind == "number"} <= set(NUMBERS)
    same_length = [edits for edits in cases if len(edited(bytes(4000), edits)) == 4000]
    assert len(same_length) > len(cases) / 3


BROKEN = """
import sys, os, time, ctypes, numpy as np
from experiments.extremes import fuzzing
from filterlab.io import VolumeFileError
fuzzing.SECONDS, fuzzing._TOLD_EVERY, fuzzing._MEASURED_EVERY = 0.2, 5, 2
whole, case = fuzzing.load_volume, [int(sys.argv[2]) - 1]

def load_volume(path, **options):
    case[0] += 1
    match case[0]:
        case 1: raise KeyError("x")
        case 2: raise VolumeFileError.__new__(VolumeFileError)
        case 3: time.sleep(60)
        case 4:
            while True: pass
        case 6: np.ones(2**22)
        case 7: bytearray(2**30)
        case 12: ctypes.string_at(0)
        case 22: os._exit(3)
    return whole(path, **options)

fuzzing.load_volume = load_volume
fuzzing.main(*map(int, sys.argv[1:4]), *sys.argv[4:])
"""


def test_what_goes_wrong_is_found(monkeypatch):
    monkeypatch.setattr(fuzzing, "_TOLD_EVERY", 5)
    found = fuzzed(30, 1, (sys.executable, "-c", BROKEN))
    expected = [
        ("case 1, ", "KeyError: 'x'"),
        ("case 2, ", "does not tell"),
        ("case 3, ", "hangs"),
        ("case 4, ", "hangs"),
        ("case 6, ", "bytes were allocated"),
        ("case 7, ", "MemoryError"),
        ("case 10 or", "ended with -11 (Fatal Python error: Segmentation fault)"),
        ("case 20 or", "ended with 3"),
    ]
    assert len(found.findings) == len(expected)
    for finding, words in zip(found.findings, expected, strict=True):
        assert all(word in finding for word in words)
    assert found.cases == 20  # of two times five nothing is known


def test_a_process_that_tells_nothing_is_ended(monkeypatch):
    monkeypatch.setattr(fuzzing, "_SILENCE", 1.0)
    monkeypatch.setattr(fuzzing, "_TOLD_EVERY", 10)
    found = fuzzed(10, 1, (sys.executable, "-c", "import time; time.sleep(60)"))
    assert found.cases == 0
    assert "hung" in found.findings[0]
