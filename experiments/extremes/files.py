"""Volume files whose bytes were damaged."""

from __future__ import annotations

import numpy as np

from experiments.extremes.contract import Case, Finding, Subject
from experiments.extremes.fuzzing import MAX_BYTES, MAX_PEAK, SECONDS, fuzzed
from experiments.extremes.originals import originals

CASES_AT_FULL_LENGTH = 120_000


def damaged(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """Edits of valid files of every format and encoding, read in a process that is watched."""
    count = max(int(CASES_AT_FULL_LENGTH * amount), len(originals()))
    found = fuzzed(count, int(random.integers(2**31)))
    told = f"{found.refused} refused, {found.read} still volumes; at most {found.seconds:.2g} s"
    told += f" and {found.bytes / 2**20:.2g} MiB each"
    return Finding(found.cases, float(len(found.findings)), 0.0, "; ".join([*found.findings[:3], told]))


CASES = (
    Case(
        "damaged-files",
        f"volume files of {len(originals())} kinds with bytes changed, added, left out",
        f"A volume of at most the {MAX_BYTES >> 20} MiB allowed, or a VolumeFileError that tells what was expected; "
        f"never a crash, {SECONDS:.0f} s, or {MAX_PEAK >> 20} MiB on the way.",
        damaged,
        seconds=90,
        tested=0.012,
    ),
)
