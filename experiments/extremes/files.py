"""Volume files whose bytes were damaged, and volume files that were forged field by field."""

from __future__ import annotations

import numpy as np

from experiments.extremes.contract import Case, Finding, Subject
from experiments.extremes.forged import FORGERS
from experiments.extremes.fuzzing import (
    BASE_PEAK,
    BASE_SECONDS,
    MAX_BYTES,
    PEAK_OF_FILE,
    PEAK_OF_SAMPLES,
    SECONDS_OF_FILE,
    SECONDS_OF_SAMPLES,
    fuzzed,
)
from experiments.extremes.originals import originals

DAMAGED_AT_FULL_LENGTH = 120_000
FORGED_AT_FULL_LENGTH = 100_000  # of each kind


def damaged(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """Edits of valid files of every format and encoding, read in a process that is watched."""
    return _found("damaged", max(int(DAMAGED_AT_FULL_LENGTH * amount), len(originals())), random)


def forged(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """Files of every format and encoding that were written field by field, true and false ones."""
    return _found("forged", len(FORGERS) * max(int(FORGED_AT_FULL_LENGTH * amount), 1), random)


def _found(source: str, count: int, random: np.random.Generator) -> Finding:
    found = fuzzed(source, count, int(random.integers(2**31)))
    told = f"{found.refused} refused, {found.read} read, {found.true} of them true; at most {found.seconds:.2g} s and "
    told += (
        f"{found.bytes / 2**20:.2g} MiB each, {found.time_share:.0%} and {found.memory_share:.0%} of what is allowed"
    )
    return Finding(found.cases, float(len(found.findings)), 0.0, "; ".join([*found.findings[:3], told]))


_BOUNDS = f"{BASE_PEAK >> 20} MiB + {PEAK_OF_FILE} × the file + {PEAK_OF_SAMPLES} × `max_bytes` of memory, and "
_BOUNDS += f"{BASE_SECONDS:.0f} s + {SECONDS_OF_FILE * 1e6:.0f} µs × the file + {SECONDS_OF_SAMPLES * 1e9:.0f} ns × "
_BOUNDS += "`max_bytes` of one core"

CASES = (
    Case(
        "damaged-files",
        f"volume files of {len(originals())} kinds with bytes changed, added, left out",
        f"A volume of at most the {MAX_BYTES >> 20} MiB allowed, or a VolumeFileError that tells what was expected; "
        f"never a crash, and at most {_BOUNDS}.",
        damaged,
        seconds=120,
        tested=0.005,
    ),
    Case(
        "forged-files",
        f"volume files of {len(FORGERS)} kinds written field by field, true or false; with bombs, chains, "
        "what is shared or overlaps, and very much of one thing",
        "The same; and files of which everything is true are read, with the samples that went in.",
        forged,
        seconds=2400,
        tested=0.0004,
    ),
)
