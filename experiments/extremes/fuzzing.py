"""Volume files with damaged bytes, by the hundred thousand, in a process of their own.

That process may neither hang (an alarm, and a watchdog outside), nor take memory (a limit on its address space), nor
crash (then the case that it was at is known). A case is told again by its number:

    python -m experiments.extremes.fuzzing SEED FIRST COUNT      prints what came of it as JSON
"""

from __future__ import annotations

import faulthandler
import json
import math
import os
import signal
import subprocess
import sys
import time
import tracemalloc
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from experiments.extremes.mutations import edited, random_edits
from experiments.extremes.originals import Original, originals
from filterlab.io import VolumeFileError, load_volume
from filterlab.io.volumes import files_of

MAX_BYTES = 2**20  # what a volume may take here, as `load_volume` is told
MAX_PEAK = 8 * MAX_BYTES  # what reading it may take in all: blocks of 1 MiB before and behind decompression
ADDRESS_SPACE = 2**28  # more than the process has when it begins; past it, allocating fails
SECONDS = 10.0  # a case that takes longer hangs
_SILENCE = 120.0  # a process that tells of nothing for so long hangs where no alarm reaches it
_TOLD_EVERY = 1000
_MEASURED_EVERY = 16  # cases; counting allocations takes longer than reading
PROGRAM = (sys.executable, "-m", "experiments.extremes.fuzzing")


class _HangsError(BaseException):
    """Raised by the alarm; nothing catches it on its way."""


@dataclass
class Fuzzed:
    """What came of many cases.

    Attributes:
        cases: how many were tried; read: were volumes nevertheless; refused: with a VolumeFileError.
        seconds: the most that one case took.
        bytes: the most memory that one of those took, of which it was measured: what Python and NumPy allocated.
        findings: what must not be, each with the number of its case.
    """

    cases: int = 0
    read: int = 0
    refused: int = 0
    seconds: float = 0.0
    bytes: int = 0
    findings: list[str] = field(default_factory=list)

    def add(self, other: Fuzzed) -> None:
        """Counts another one's cases too."""
        self.cases, self.read, self.refused = (
            self.cases + other.cases,
            self.read + other.read,
            self.refused + other.refused,
        )
        self.seconds, self.bytes = max(self.seconds, other.seconds), max(self.bytes, other.bytes)
        self.findings += other.findings


def fuzzed(count: int, seed: int, program: Sequence[str] = PROGRAM) -> Fuzzed:
    """The cases 0 … count − 1 of a seed, in processes of their own: a new one where one was lost.

    Args:
        count: cases.
        seed: of the edits.
        program: what is started with SEED, FIRST, COUNT and the name of a file for its progress.
    """
    total, first = Fuzzed(), 0
    with TemporaryDirectory() as folder:
        progress = Path(folder) / "progress"
        while first < count:
            progress.write_text(json.dumps({"case": first, **asdict(Fuzzed())}))
            ended = _watched([*program, str(seed), str(first), str(count - first), str(progress)], progress)
            told = json.loads(progress.read_text())
            case = told.pop("case")
            total.add(Fuzzed(**told))
            if ended is not None:
                total.findings.append(f"case {case} or one of the {_TOLD_EVERY} behind it: the process {ended}")
                case += _TOLD_EVERY
            first = case
    return total


def _watched(command: list[str], progress: Path) -> str | None:
    """Runs a process to its end; how it ended when that was not by itself."""
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True)
    while True:
        try:
            _, errors = process.communicate(timeout=min(5.0, _SILENCE))
            break
        except subprocess.TimeoutExpired:
            if time.time() - progress.stat().st_mtime > _SILENCE:
                process.kill()
                process.communicate()
                return "hung"
    if process.returncode == 0:
        return None
    lines = errors.splitlines() or [""]
    told = next((line for line in lines if line.startswith("Fatal")), lines[-1])
    return f"ended with {process.returncode} ({told})"


# --- inside that process ----------------------------------------------------------------------------------------------


def main(seed: int, first: int, count: int, progress: str | None = None) -> None:
    """Tries the cases; tells of them in a file every now and then, and at the end."""
    faulthandler.enable()
    torch.set_num_threads(1)
    limit_memory(ADDRESS_SPACE)
    known = list(originals().values())
    result = Fuzzed()
    with TemporaryDirectory() as folder, _alarmed():
        places = [Path(folder) / str(i) for i in range(len(known))]
        for place, original in zip(places, known, strict=True):
            original.write(place)
        for case in range(first, first + count):
            which = case % len(known)
            if case % _MEASURED_EVERY == 0:
                tracemalloc.start()
            _try(known[which], places[which], np.random.default_rng([seed, case]), f"case {case}", result)
            tracemalloc.stop()
            if progress is not None and (case + 1) % _TOLD_EVERY == 0:
                _tell(progress, case + 1, result)
    _tell(progress, first + count, result)


def _tell(progress: str | None, case: int, result: Fuzzed) -> None:
    text = json.dumps({"case": case, **asdict(result)})
    if progress is None:
        print(text)
    else:
        Path(f"{progress}.new").write_text(text)
        os.replace(f"{progress}.new", progress)


def _try(original: Original, place: Path, rng: np.random.Generator, name: str, result: Fuzzed) -> None:
    original.damage(place, edited(original.content, random_edits(rng)))
    start = time.perf_counter()
    found = None
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        found = _unsound(original, place)
        result.read += 1
    except VolumeFileError as error:
        result.refused += 1
        if "expected" not in str(error) or "; got " not in str(error) or str(place) not in str(error):
            found = f"a message that does not tell: {error}"
    except _HangsError:
        found = f"hangs for {SECONDS} s"
    except Exception as error:
        found = f"{type(error).__name__}: {error}"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    peak = tracemalloc.get_traced_memory()[1]
    if peak > MAX_PEAK:
        found = found or f"{peak} bytes were allocated"
    result.cases += 1
    result.seconds, result.bytes = max(result.seconds, time.perf_counter() - start), max(result.bytes, peak)
    if found is not None:
        result.findings.append(f"{name}, {original.name}: {found}"[:400])


def _unsound(original: Original, place: Path) -> str | None:
    """Reads the volume; what is wrong with it."""
    path = place / original.path
    volume = load_volume(path, frame=original.frame, max_bytes=MAX_BYTES)
    if volume.samples.numel() * volume.samples.element_size() > MAX_BYTES:
        return f"{tuple(volume.shape)} is more than {MAX_BYTES} bytes"
    if not (np.isfinite(volume.affine).all() and math.isfinite(min(volume.spacing)) and min(volume.spacing) > 0):
        return f"a volume with the affine {volume.affine.tolist()}"
    if not all(file.is_file() for file in files_of(path)):
        return "it names files that are not there"
    return None


@contextmanager
def _alarmed() -> Iterator[None]:
    def hangs(_number: int, _frame: object) -> None:
        raise _HangsError

    before = signal.signal(signal.SIGALRM, hangs)
    try:
        yield
    finally:
        signal.signal(signal.SIGALRM, before)


def limit_memory(more: int) -> bool:
    """Lets this process have so many bytes of address space more than it has; False where that can't be told here."""
    statm = Path("/proc/self/statm")
    if not statm.exists():
        return False
    import resource

    now = int(statm.read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (now + more, now + more))
    return True


if __name__ == "__main__":
    main(int(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]), *sys.argv[4:5])
