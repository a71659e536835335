"""Damaged volume files in a process of their own; and that what goes wrong there is found."""

import contextlib
import sys
import tracemalloc

import numpy as np
import pytest

from experiments.extremes import fuzzing
from experiments.extremes.forged import FORGERS, Pen
from experiments.extremes.fuzzing import fuzzed
from experiments.extremes.mutations import KINDS, NUMBERS, Edit, edited, random_edits
from experiments.extremes.originals import SAMPLES, originals
from filterlab.io import VolumeFileError, load_volume


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
import sys, os, time, ctypes, signal, numpy as np
from experiments.extremes import fuzzing
from filterlab.io import VolumeFileError
fuzzing.SECONDS, fuzzing.BASE_SECONDS, fuzzing._TOLD_EVERY, fuzzing._MEASURED_EVERY = 1.5, 0.1, 5, 2
whole, prepare, case = fuzzing.load_volume, fuzzing._damaged, [0]

def damaged(seed, folder):
    attempt = prepare(seed, folder)
    def numbered(number):
        case[0] = number
        return attempt(number)
    return numbered

def load_volume(path, **options):
    match case[0]:
        case 1: raise KeyError("x")
        case 2: raise VolumeFileError.__new__(VolumeFileError)
        case 3: time.sleep(60)
        case 4:
            while True: pass
        case 6: np.ones(2**22)
        case 7: bytearray(2**30)
        case 8:
            signal.setitimer(signal.ITIMER_REAL, 60)  # CPU time that others may make long does not hang
            start = time.process_time()
            while time.process_time() < start + 0.25: pass
        case 12: ctypes.string_at(0)
        case 22: os._exit(3)
    return whole(path, **options)

fuzzing.load_volume, fuzzing.SOURCES["damaged"] = load_volume, damaged
fuzzing.main(sys.argv[1], *map(int, sys.argv[2:5]), *sys.argv[5:])
"""


def test_what_goes_wrong_is_found(forks, monkeypatch):
    monkeypatch.setattr(fuzzing, "_TOLD_EVERY", 5)
    found = fuzzed("damaged", 30, 1, (sys.executable, "-c", BROKEN))
    expected = [
        ("case 1, ", "KeyError: 'x'"),
        ("case 2, ", "does not tell"),
        ("case 3, ", "hangs"),
        ("case 4, ", "hangs"),
        ("case 6, ", "bytes were allocated"),
        ("case 7, ", "MemoryError"),
        ("case 8, ", " s for "),
        ("case 10 or", "ended with -11 (Fatal Python error: Segmentation fault)"),
        ("case 20 or", "ended with 3"),
    ]
    assert len(found.findings) == len(expected)
    for finding, words in zip(found.findings, expected, strict=True):
        assert all(word in finding for word in words)
    assert found.cases == 20  # of two times five nothing is known


def test_a_process_that_tells_nothing_is_ended(forks, monkeypatch):
    monkeypatch.setattr(fuzzing, "_SILENCE", 1.0)
    monkeypatch.setattr(fuzzing, "_TOLD_EVERY", 10)
    found = fuzzed("damaged", 10, 1, (sys.executable, "-c", "import time; time.sleep(60)"))
    assert found.cases == 0
    assert "hung" in found.findings[0]


# --- forged files -----------------------------------------------------------------------------------------------------


@pytest.mark.filterwarnings("ignore::filterlab.io.warned.VolumeFileWarning")
@pytest.mark.parametrize("kind", list(FORGERS))
def test_forged_files_are_true_and_false(kind, tmp_path):
    """True ones are read with the samples that went in, and most false ones refused: else they would prove nothing."""
    true, refused, seen = 0, 0, set()
    for seed in range(120):
        forged = FORGERS[kind](Pen(seed))
        assert forged.samples is None or forged.told in ("", "heavy")
        seen |= set(forged.told.split(", "))
        for name, content in forged.files.items():
            (tmp_path / name).write_bytes(content)
        try:
            samples = load_volume(tmp_path / forged.path, frame=forged.frame, max_bytes=2**20).samples.numpy()
        except VolumeFileError:
            assert forged.samples is None, seed
            refused += 1
        else:
            assert forged.samples is None or np.array_equal(samples, forged.samples), seed
            true += forged.samples is not None
        for name in forged.files:
            (tmp_path / name).unlink()
    assert true > 30
    assert refused > 30
    assert len(seen) > 6  # different fields are false


@pytest.mark.filterwarnings("ignore::filterlab.io.warned.VolumeFileWarning")
@pytest.mark.parametrize("kind", ["NRRD raw", "NRRD bzip2", "NIfTI-1 gzip", "TIFF deflate", "npz raw", "raw"])
def test_heavy_files_are_heavy_and_within_the_bounds(kind, tmp_path, monkeypatch):
    """As much of one thing as the format has room for."""
    monkeypatch.setattr("experiments.extremes.forged.HEAVY", 1.0)
    monkeypatch.setattr("experiments.extremes.forged.RATES", (0.0,))
    forged = FORGERS[kind](Pen(1))
    assert forged.size > 15_000
    for name, content in forged.files.items():
        (tmp_path / name).write_bytes(content)
    tracemalloc.start()
    with contextlib.suppress(*([VolumeFileError] if forged.samples is None else [])):
        load_volume(tmp_path / forged.path, frame=forged.frame, max_bytes=2**20)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < fuzzing.allowed_peak(forged.size)


def test_a_case_is_told_again_by_its_number(tmp_path):
    for case in range(30):
        first, again = (fuzzing.SOURCES["forged"](7, tmp_path)(case) for _ in range(2))
        assert (first.name, first.size, first.path) == (again.name, again.size, again.path)
