"""Processes that are killed at every moment of writing, and what they leave behind.

A moment is a line of Python in one of the modules that write. What lies in the folder there is what a kill would leave:
it is read at every moment, and every state of it is looked at, and the work is done again, on top of it. As that only
says what a kill should leave, some kills are real. A child process, forked from one that has everything imported, ends
itself with SIGKILL when it has come to line k: nothing of Python or of the C library runs any more, as when the
machine's memory is out.

    python -m experiments.extremes.killing STRIDE      kills at every STRIDE-th moment; prints what came of it as JSON
"""

from __future__ import annotations

import json
import os
import signal
import sys
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import Any

import numpy as np
import torch

from experiments.config import ExperimentConfig
from experiments.runs import Run, read_provenance, read_records, run_file
from filterlab.io import VolumeFileError, atomic, images, load_image, load_volume, nifti, nrrd, numpy_files, save_volume
from filterlab.io import volumes as volume_files
from filterlab.volume import Volume

_WRITERS = {
    module.__file__ for module in (atomic, images, nifti, nrrd, numpy_files, volume_files, sys.modules[Run.__module__])
}
ENDINGS = (".nrrd", ".nii", ".nii.gz", ".npy", ".npz")


@dataclass
class Killed:
    """What came of killing one kind of work.

    Attributes:
        work: what it is.
        moments: lines that it runs through.
        states: of its folder, different ones, at any of them.
        kills: how many times it was killed.
        findings: what was left that must not be, each with its moment.
    """

    work: str
    moments: int
    states: int = 0
    kills: int = 0
    findings: list[str] = field(default_factory=list)


State = tuple[tuple[str, bytes | None], ...]
"""Of a folder: names below it, and what the files hold; None: a folder."""


@dataclass(frozen=True)
class Work:
    """Something that writes files.

    Attributes:
        name: of it.
        begin: folder -> None, writes what is there before.
        do: folder -> None, what is killed; done again on what it left, it must finish.
        damaged: folder -> what is wrong there after a kill, or None.
        finished: folder -> what is wrong there when all is done, or None.
    """

    name: str
    begin: Callable[[Path], None]
    do: Callable[[Path], None]
    damaged: Callable[[Path], str | None]
    finished: Callable[[Path], str | None]


def killed_everywhere(work: Work, stride: int = 1) -> Killed:
    """Looks at what every moment of the work would leave, and kills it at every `stride`-th."""
    moments, states = _watched(work)
    result = Killed(work.name, moments, len(states))
    for state, moment in states.items():
        with TemporaryDirectory() as folder:
            _lay_out(state, Path(folder))
            found = _found_after(work, Path(folder))
        result.findings += [] if found is None else [f"as of line {moment} of {moments}: {found}"]
    for moment in range(1, moments + 1, stride):
        with TemporaryDirectory() as folder:
            found = _killed_at(work, Path(folder), moment)
        result.kills += 1
        result.findings += [] if found is None else [f"line {moment} of {moments}: {found}"]
    return result


def _watched(work: Work) -> tuple[int, dict[State, int]]:
    """How many moments the work has, and every state of its folder, with the first moment that finds it."""
    count, states = 0, {}
    with TemporaryDirectory() as name:
        folder = Path(name)
        work.begin(folder)

        def at_line() -> None:
            nonlocal count
            count += 1
            states.setdefault(_state(folder), count)

        _traced(at_line, lambda: work.do(folder))
    return count, states


def _state(folder: Path) -> State:
    """The folders and files below a folder, with their contents."""
    below = sorted(folder.rglob("*"))
    return tuple((str(path.relative_to(folder)), None if path.is_dir() else path.read_bytes()) for path in below)


def _lay_out(state: State, folder: Path) -> None:
    for name, content in state:
        if content is None:
            (folder / name).mkdir()
        else:
            (folder / name).write_bytes(content)


def _killed_at(work: Work, folder: Path, moment: int) -> str | None:
    work.begin(folder)
    status = _in_a_child(lambda: _until(moment, lambda: work.do(folder)))
    if not (os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGKILL):
        return f"the process was not killed (status {status})"
    return _found_after(work, folder)


def _found_after(work: Work, folder: Path) -> str | None:
    """What is wrong with what a kill left, or with what the work, done again, makes of it."""
    found = checked(work.damaged, folder)
    if found is None and _in_a_child(lambda: work.do(folder)) != 0:
        found = "the work could not be done again"
    return found or checked(work.finished, folder)


def checked(check: Callable[[Path], str | None], folder: Path) -> str | None:
    """What a check finds; that it fails itself (it could not read a file) is a finding as well."""
    try:
        return check(folder)
    except Exception as error:
        return f"{type(error).__name__}: {error}"


def _in_a_child(action: Callable[[], object]) -> int:
    """The wait status of a forked process that does it: 0 when all went well."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            action()
            code = 0
        finally:
            os._exit(code)
    return os.waitpid(child, 0)[1]


def _traced(at_line: Callable[[], None], action: Callable[[], object]) -> None:
    def tracer(frame: FrameType, event: str, _argument: Any) -> Any:
        if frame.f_code.co_filename not in _WRITERS:
            return None
        if event == "line":
            at_line()
        return tracer

    sys.settrace(tracer)
    try:
        action()
    finally:
        sys.settrace(None)


def _until(moment: int, action: Callable[[], object]) -> None:
    left = moment

    def at_line() -> None:
        nonlocal left
        left -= 1
        if left == 0:
            os.kill(os.getpid(), signal.SIGKILL)

    _traced(at_line, action)


# --- runs -------------------------------------------------------------------------------------------------------------

_CONFIG = ExperimentConfig(experiment="killing", description="killed at every moment; é")
_UNITS = ("a", "b", "ω")


def _run(folder: Path) -> None:
    """A run of three units, each with a picture and numbers."""
    with Run.open(folder / "run", _CONFIG, {"command": "ünïcode"}) as run:
        for i, key in enumerate(_UNITS):
            if not run.done(key):
                files = [
                    run.save_image(key, torch.full((3, 3), 0.1 * i)),
                    run.save_array(key, torch.full((4,), 1.0 * i)),
                ]
                run.append(key, {"files": files, "number": i})


def _damaged_run(folder: Path) -> str | None:
    """Every record that is there has its files, whole; every other file under a final name is whole as well."""
    folder = folder / "run"
    records, good = read_records(folder)
    path = folder / "records.jsonl"
    torn = path.read_bytes()[good:] if path.exists() else b""
    if b"\n" in torn:
        return "a broken line before the last one"
    missing = [f for record in records.values() for f in record["files"] if not run_file(folder, f).is_file()]
    if missing:
        return f"records name files that are not there: {missing}"
    return next(filter(None, (_damaged_file(f) for f in (folder / "files").glob("*"))), None)


def _damaged_file(path: Path) -> str | None:
    if path.name.startswith(".tmp-"):
        return None
    i = _UNITS.index(path.stem)
    if path.suffix == ".npy":
        whole = bool((torch.from_numpy(np.load(path)) == i).all())
    else:
        whole = load_image(path, srgb=True).sub(0.1 * i).abs().max().item() < 0.01
    return None if whole else f"{path.name} is not what was written"


def _finished_run(folder: Path) -> str | None:
    folder = folder / "run"
    records, _ = read_records(folder)
    if list(records) != list(_UNITS) or [record["number"] for record in records.values()] != [0, 1, 2]:
        return f"the records are {records}"
    left = [path.name for path in folder.rglob(".tmp-*")]
    if left and not all(path.parent == folder for path in folder.rglob(".tmp-*")):
        return f"temporary files are left: {left}"
    if not 1 <= len(read_provenance(folder)) <= 2:
        return "a start is not written down"
    return _damaged_run(folder.parent)


# --- volumes ----------------------------------------------------------------------------------------------------------

_OLD = Volume(torch.arange(24.0).reshape(2, 3, 4), spacing=(1.0, 2.0, 3.0))
_NEW = Volume(torch.arange(24.0).flip(0).reshape(2, 3, 4), spacing=(3.0, 2.0, 0.5))
_PLAIN = Volume(torch.arange(24.0).flip(0).reshape(2, 3, 4))


def _volume(ending: str, new: Volume, name: str) -> Work:
    """A volume written over another one; afterwards it is the old one, the new one, or refused: never a mixture."""

    def path(folder: Path) -> Path:
        return folder / f"a{ending}"

    def is_one_of(folder: Path, *volumes: Volume) -> str | None:
        try:
            found = load_volume(path(folder))
        except FileNotFoundError:
            return None if ending == ".npy" and len(volumes) > 1 else "the old file is gone"
        except VolumeFileError as error:
            return f"half a file: {error}"
        if any(torch.equal(found.samples, v.samples) and found.geometry == v.geometry for v in volumes):
            return None
        return f"a mixture: {found.samples.flatten()[:2].tolist()} with spacing {found.spacing}"

    return Work(
        name,
        lambda folder: save_volume(_OLD, path(folder)),
        lambda folder: save_volume(new, path(folder)),
        lambda folder: is_one_of(folder, _OLD, new),
        lambda folder: is_one_of(folder, new),
    )


def works() -> list[Work]:
    """All that is killed. NIfTI only where nibabel is there."""
    try:
        import nibabel  # noqa: F401

        endings = ENDINGS
    except ImportError:
        endings = tuple(e for e in ENDINGS if ".nii" not in e)
    return [
        Work("a run", lambda _: None, _run, _damaged_run, _finished_run),
        *(_volume(ending, _NEW, f"{ending} over another") for ending in endings),
        _volume(".npy", _PLAIN, ".npy without geometry over one with"),
    ]


def main(stride: int) -> None:
    """Prints one JSON list of what came of every kind of work."""
    torch.set_num_threads(1)  # a process with threads must not fork
    print(json.dumps([asdict(killed_everywhere(work, stride)) for work in works()]))


if __name__ == "__main__":
    main(int(sys.argv[1]))
