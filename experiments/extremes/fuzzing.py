"""Volume files that are damaged or forged, by the hundred thousand, in a process of their own.

That process may neither hang (an alarm, and a watchdog outside), nor take memory (a limit on its address space), nor
crash (then the case that it was at is known). A case is told again by its number:

    python -m experiments.extremes.fuzzing damaged|forged SEED FIRST COUNT      prints what came of it as JSON
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
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from experiments.extremes.forged import FORGERS, Pen
from experiments.extremes.mutations import edited, random_edits
from experiments.extremes.originals import originals
from filterlab.io import VolumeFileError, load_volume
from filterlab.io.volumes import files_of

MAX_BYTES = 2**20  # what a volume may take here, as `load_volume` is told
BASE_PEAK, PEAK_OF_FILE, PEAK_OF_SAMPLES = 4 * 2**20, 2, 3  # memory: that, and so many times the file and max_bytes
# CPU time: that, and so much for every byte of both
BASE_SECONDS, SECONDS_OF_FILE, SECONDS_OF_SAMPLES = 1.0, 4e-6, 5e-8
ADDRESS_SPACE = 2**28  # more than the process has when it begins; past it, allocating fails
SECONDS = 20.0  # a case that takes longer hangs
_SILENCE = 120.0  # a process that tells of nothing for so long hangs where no alarm reaches it
_TOLD_EVERY = 1000
_MEASURED_EVERY = 16  # cases; counting allocations takes longer than reading
PROGRAM = (sys.executable, "-m", "experiments.extremes.fuzzing")


def allowed_peak(size: int) -> int:
    """Bytes of memory that reading a file (and its sidecar) of that size may take, samples included."""
    return BASE_PEAK + PEAK_OF_FILE * size + PEAK_OF_SAMPLES * MAX_BYTES


def allowed_seconds(size: int) -> float:
    """Seconds of CPU time that it may take."""
    return BASE_SECONDS + SECONDS_OF_FILE * size + SECONDS_OF_SAMPLES * MAX_BYTES


class _HangsError(BaseException):
    """Raised by the alarm; nothing catches it on its way."""


@dataclass
class Fuzzed:
    """What came of many cases.

    Attributes:
        cases: how many were tried; read: were volumes nevertheless; refused: with a VolumeFileError.
        true: how many of those that were read had to be, with the samples that went in.
        seconds: the most CPU time that one case took.
        bytes: the most memory that one of those took, of which it was measured: what Python and NumPy allocated.
        time_share, memory_share: the same in units of what is allowed for a file of its size.
        findings: what must not be, each with the number of its case.
    """

    cases: int = 0
    read: int = 0
    refused: int = 0
    true: int = 0
    seconds: float = 0.0
    bytes: int = 0
    time_share: float = 0.0
    memory_share: float = 0.0
    findings: list[str] = field(default_factory=list)

    def add(self, other: Fuzzed) -> None:
        """Counts another one's cases too."""
        for name in ("cases", "read", "refused", "true", "findings"):
            setattr(self, name, getattr(self, name) + getattr(other, name))
        for name in ("seconds", "bytes", "time_share", "memory_share"):
            setattr(self, name, max(getattr(self, name), getattr(other, name)))


def fuzzed(source: str, count: int, seed: int, program: Sequence[str] = PROGRAM) -> Fuzzed:
    """The cases 0 … count − 1 of a seed, in processes of their own: a new one where one was lost.

    Args:
        source: which files, of SOURCES.
        count: cases.
        seed: of the random numbers.
        program: what is started with the source, SEED, FIRST, COUNT and the name of a file for its progress.
    """
    total, first = Fuzzed(), 0
    with TemporaryDirectory() as folder:
        progress = Path(folder) / "progress"
        while first < count:
            progress.write_text(json.dumps({"case": first, **asdict(Fuzzed())}))
            ended = _watched([*program, source, str(seed), str(first), str(count - first), str(progress)], progress)
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


@dataclass(frozen=True)
class Attempt:
    """A file that is about to be read.

    Attributes:
        name: of its kind.
        path, frame: what is loaded.
        size: bytes of all its files.
        samples: what must be found in it; None: a volume or a VolumeFileError.
        heavy: whether its memory is worth a look.
    """

    name: str
    path: Path
    frame: int | None
    size: int
    samples: np.ndarray | None = None
    heavy: bool = False


def _damaged(seed: int, folder: Path) -> Callable[[int], Attempt]:
    """Edits of valid files, kind after kind."""
    known = list(originals().values())
    places = [folder / str(i) for i in range(len(known))]
    for place, original in zip(places, known, strict=True):
        original.write(place)

    def attempt(case: int) -> Attempt:
        original, place = known[case % len(known)], places[case % len(known)]
        original.damage(place, edited(original.content, random_edits(np.random.default_rng([seed, case]))))
        return Attempt(original.name, place / original.path, original.frame, sum(map(len, original.files.values())))

    return attempt


def _forged(seed: int, folder: Path) -> Callable[[int], Attempt]:
    """Forged files, kind after kind."""
    kinds = list(FORGERS.items())
    before: list[Path] = []

    def attempt(case: int) -> Attempt:
        name, write = kinds[case % len(kinds)]
        forged = write(Pen(seed * 2**32 + case))
        while before:
            before.pop().unlink()
        for file, content in forged.files.items():
            (folder / file).write_bytes(content)
            before.append(folder / file)
        heavy = "heavy" in forged.told
        told = f"{name} ({forged.told})"
        return Attempt(told, folder / forged.path, forged.frame, forged.size, forged.samples, heavy)

    return attempt


SOURCES: dict[str, Callable[[int, Path], Callable[[int], Attempt]]] = {"damaged": _damaged, "forged": _forged}


def main(source: str, seed: int, first: int, count: int, progress: str | None = None) -> None:
    """Tries the cases; tells of them in a file every now and then, and at the end."""
    faulthandler.enable()
    torch.set_num_threads(1)
    limit_memory(ADDRESS_SPACE)
    result = Fuzzed()
    with TemporaryDirectory() as folder, _alarmed():
        prepare = SOURCES[source](seed, Path(folder))
        for case in range(first, first + count):
            _try(prepare(case), case, result)
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


def _try(attempt: Attempt, case: int, result: Fuzzed) -> None:
    """Reads a file and looks at the time; reads some once more and looks at the memory."""
    start = time.process_time()
    found = _read(attempt, result)
    seconds = time.process_time() - start
    result.cases += 1
    result.seconds, share = max(result.seconds, seconds), seconds / allowed_seconds(attempt.size)
    result.time_share = max(result.time_share, share)
    if share > 1:
        found = found or f"{seconds:.2f} s for {attempt.size} bytes"
    if found is None and (case % _MEASURED_EVERY == 0 or attempt.heavy):
        tracemalloc.start()
        found = _read(attempt, Fuzzed(), thoroughly=True)
        peak = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
        result.bytes, share = max(result.bytes, peak), peak / allowed_peak(attempt.size)
        result.memory_share = max(result.memory_share, share)
        if share > 1:
            found = found or f"{peak} bytes were allocated for {attempt.size}"
    if found is not None:
        result.findings.append(f"case {case}, {attempt.name}: {found}"[:400])


def _read(attempt: Attempt, result: Fuzzed, thoroughly: bool = False) -> str | None:
    """Reads the volume or is refused; what is wrong with that."""
    signal.setitimer(signal.ITIMER_REAL, SECONDS)
    try:
        found = _unsound(attempt, thoroughly)
        result.read += 1
        result.true += attempt.samples is not None
        return found
    except VolumeFileError as error:
        result.refused += 1
        if attempt.samples is not None:
            return f"a true file was refused: {error}"
        if "expected" not in str(error) or "; got " not in str(error) or str(attempt.path.parent) not in str(error):
            return f"a message that does not tell: {error}"
    except _HangsError:
        return f"hangs for {SECONDS} s"
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
    return None


def _unsound(attempt: Attempt, thoroughly: bool) -> str | None:
    """Reads the volume; what is wrong with it."""
    volume = load_volume(attempt.path, frame=attempt.frame, max_bytes=MAX_BYTES)
    if volume.samples.numel() * volume.samples.element_size() > MAX_BYTES:
        return f"{tuple(volume.shape)} is more than {MAX_BYTES} bytes"
    if not (np.isfinite(volume.affine).all() and math.isfinite(min(volume.spacing)) and min(volume.spacing) > 0):
        return f"a volume with the affine {volume.affine.tolist()}"
    if attempt.samples is not None and not np.array_equal(volume.samples.numpy(), attempt.samples):
        return "other samples than went in"
    if thoroughly and not all(file.is_file() for file in files_of(attempt.path)):
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
    main(sys.argv[1], int(sys.argv[2]), int(sys.argv[3]), int(sys.argv[4]), *sys.argv[5:6])
