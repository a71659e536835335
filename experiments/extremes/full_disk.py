"""Writing to a disk that fills up: a real one, a few pages large, that only this process sees.

A name space of one's own needs no rights where the system allows it (Linux, `unshare`); the disk goes with the process.

    python -m experiments.extremes.full_disk FOLDER     run inside; prints what came of it as JSON
"""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import torch

from experiments.errors import RunError
from experiments.extremes.killing import Work, checked, works
from filterlab.io.atomic import disk_is_full

PAGE = 4096
PAGES_LEFT = range(13)
SIZE = 2**19


@dataclass
class Filled:
    """What came of one kind of work on disks with more and more room.

    Attributes:
        work: what it is.
        failed: how often there was too little room; fitted: how often enough.
        findings: what must not be, each with the pages that were left.
    """

    work: str
    failed: int = 0
    fitted: int = 0
    findings: list[str] = field(default_factory=list)


def missing() -> str | None:
    """What keeps this machine from having a small disk for a process; None: nothing does."""
    if shutil.which("unshare") is None:
        return "the command unshare (Linux) is needed to make a small disk"
    with TemporaryDirectory() as folder:
        done = on_a_small_disk(["true"], Path(folder))
    return None if done.returncode == 0 else f"no name space of one's own: {done.stderr.strip()}"


def on_a_small_disk(command: Sequence[str], folder: Path, size: int = SIZE) -> subprocess.CompletedProcess[str]:
    """Runs a command for which `folder` is a disk of that many bytes."""
    mount = 'mount -t tmpfs -o size="$1" tmpfs "$2" && shift 2 && exec "$@"'
    return subprocess.run(
        ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c", mount, "sh", str(size), str(folder), *command],
        capture_output=True,
        text=True,
        check=False,
    )


def filled_everywhere(work: Work, disk: Path, pages_left: Sequence[int] = PAGES_LEFT) -> Filled:
    """Does the work with so many pages left, and once more when there is room again."""
    result = Filled(work.name)
    for pages in pages_left:
        folder = disk / "work"
        folder.mkdir()
        work.begin(folder)
        found = _filled(work, disk, folder, pages, result)
        result.findings += [] if found is None else [f"{pages} pages left: {found}"]
        shutil.rmtree(folder)
    return result


def _filled(work: Work, disk: Path, folder: Path, pages: int, result: Filled) -> str | None:
    ballast = disk / "ballast"
    state = os.statvfs(disk)
    ballast.write_bytes(bytes(max(state.f_bavail * state.f_frsize - pages * PAGE, 0)))
    try:
        work.do(folder)
        result.fitted += 1
    except (OSError, RunError) as error:
        result.failed += 1
        if not (disk_is_full(error) or isinstance(error, RunError)) or ".tmp-" in str(error):
            return f"{type(error).__name__}: {error}"
        left = [path.name for path in folder.rglob(".tmp-*")]
        if left:
            return f"temporary files are left: {left}"
    finally:
        ballast.unlink()
    found = checked(work.damaged, folder)
    if found is None:
        work.do(folder)
        found = checked(work.finished, folder)
    return found


def main(disk: Path) -> None:
    """Prints one JSON list of what came of every kind of work."""
    torch.set_num_threads(1)
    print(json.dumps([asdict(filled_everywhere(work, disk)) for work in works()]))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
