"""Run folders: what was asked for, by what it was computed, and what came out. An interrupted run loses nothing.

runs/<config name>-<hash of the resolved config and of the input files>[-2, -3, … with --fresh]/
    config.yaml        the resolved config
    provenance.jsonl   one line per start: its number, versions, commit, device, threads, seed, input files by content
    records.jsonl      one line per finished unit of work, flushed to disk before the next begins; `start` made it
    files/             images and arrays that records name
    report.html        what `experiments report` draws from the above
"""

from __future__ import annotations

import hashlib
import json
import os
import platform
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import torch
from pydantic import BaseModel
from torch import Tensor

from experiments.errors import RunError
from filterlab.io import load_image, save_image
from filterlab.io.atomic import atomic_write, remove_temporaries
from filterlab.io.config import dump_config
from filterlab.io.numpy_files import write_array

Record = dict[str, Any]
T = TypeVar("T")
CODE = ("filterlab", "commit")  # of a start: by which code its records were computed
_APPENDING = os.O_WRONLY | os.O_APPEND | os.O_CREAT | getattr(os, "O_BINARY", 0)
_WRITTEN_WITHIN = 60.0  # seconds: a report that another process is writing just now is not taken from it


@dataclass(frozen=True)
class Unit:
    """A piece of work that ends in one record.

    Attributes:
        key: its name, unique within the run; a run that resumes skips the keys it finds.
        label: what the progress bar calls it.
        seconds: a rough expectation; what is told of the time left weighs units by it, and measures.
    """

    key: str
    label: str
    seconds: float = 1.0


def resolved(config: BaseModel) -> dict[str, Any]:
    """The config with every default written out, as plain data."""
    return config.model_dump(mode="json")


def config_hash(config: BaseModel, inputs: Mapping[str, str] | None = None) -> str:
    """Ten hexadecimal digits that change with any value of the resolved config, and with any input file.

    `inputs` is {path: digest of the content}, as `experiments.config.input_files` gives it.
    """
    canonical = json.dumps([resolved(config), dict(inputs or {})], sort_keys=True, ensure_ascii=False)
    return hashlib.sha256(canonical.encode()).hexdigest()[:10]


def run_folder(
    root: Path, name: str, config: BaseModel, inputs: Mapping[str, str] | None = None, *, fresh: bool = False
) -> Path:
    """The folder of the latest run of that config on those input files below `root`.

    With `fresh`, the next one that does not exist.
    """
    stem = f"{name}-{config_hash(config, inputs)}"
    k = 1
    while _numbered(root, stem, k).exists():
        k += 1
    return _numbered(root, stem, k if fresh else max(k - 1, 1))


def _numbered(root: Path, stem: str, k: int) -> Path:
    return root / (stem if k == 1 else f"{stem}-{k}")


class Run:
    """An open run folder: records are appended, files written; nothing that was finished is ever done again.

    Use `Run.open`. `section(name)` is a view of the same folder whose keys and files carry a prefix: a run composed
    of several experiments gives each its own.
    """

    def __init__(
        self, folder: Path, records: dict[str, Record], prefix: str = "", shared: _Shared | None = None
    ) -> None:
        self.folder = folder
        self.prefix = prefix
        self._records = records
        self._shared = shared or _Shared([{"start": 1}])

    @classmethod
    @contextmanager
    def open(cls, folder: Path, config: BaseModel, provenance: Mapping[str, Any]) -> Iterator[Run]:
        """The folder, created or resumed, and locked against a second process.

        Args:
            folder: what `run_folder` gives.
            config: the resolved config.
            provenance: of this start; it is written down with its number.

        Raises:
            RunError: it can't be created or written, holds another config or other input files, or is in use.
        """
        try:
            (folder / "files").mkdir(parents=True, exist_ok=True)
            lock = (folder / "lock").open("w")
        except OSError as error:
            raise RunError(f"expected a run folder that can be written; {folder}: {error.strerror}") from None
        with lock:
            _lock(lock, folder)
            remove_temporaries(folder, older=_WRITTEN_WITHIN)
            remove_temporaries(folder / "files")
            _write_config(folder, config)
            starts = _begin(folder, provenance)
            yield cls(folder, repaired_records(folder), shared=_Shared(starts))

    def section(self, name: str) -> Run:
        """The same run, with every key and file under `name/`."""
        return Run(self.folder, self._records, f"{self.prefix}{name}/", self._shared)

    @property
    def records(self) -> dict[str, Record]:
        """Finished records of this section by key, without the section's prefix."""
        return {
            key.removeprefix(self.prefix): record
            for key, record in self._records.items()
            if key.startswith(self.prefix)
        }

    def done(self, key: str) -> bool:
        """True when the unit is recorded and every file that the record names is there."""
        record = self._records.get(self.prefix + key)
        return record is not None and all(run_file(self.folder, f).is_file() for f in record.get("files", []))

    @property
    def start(self) -> Record:
        """The provenance of this start."""
        return self._shared.starts[-1]

    def made_by_other_code(self) -> list[Record]:
        """The earlier starts that records here were made by, as far as filterlab's version or commit was another."""
        now, earlier = self.start, self._shared.starts[:-1]
        if not earlier:
            return []
        makers = {record.get("start", earlier[-1]["start"]) for record in self._records.values()}
        return [s for s in earlier if s["start"] in makers and any(s.get(k) != now.get(k) for k in CODE)]

    def append(self, key: str, record: Mapping[str, Any]) -> Record:
        """Writes the record of a finished unit, with the number of this start; then it is on the disk."""
        full = {"key": self.prefix + key, "start": self.start["start"], **record}
        descriptor = os.open(self.folder / "records.jsonl", _APPENDING, 0o644)
        try:
            _append_line(descriptor, full)
        finally:
            os.close(descriptor)
        self._records[full["key"]] = full
        return full

    def save_image(self, name: str, image: Tensor, *, srgb: bool = True) -> str:
        """Saves a float image as PNG under a temporary name, renames it, and returns its name for the record."""
        path = self._file(f"{name}.png")
        save_image(image, path, srgb=srgb)
        return str(path.relative_to(self.folder))

    def save_array(self, name: str, array: Tensor) -> str:
        """Saves numbers as .npy under a temporary name, renames it, and returns its name for the record."""
        path = self._file(f"{name}.npy")
        with atomic_write(path) as temporary, temporary.open("wb") as file:
            write_array(file, array.detach().cpu().numpy())
        return str(path.relative_to(self.folder))

    def load_array(self, name: str) -> Tensor:
        """An array that a record names."""
        return torch.from_numpy(np.load(run_file(self.folder, name), allow_pickle=False))

    def load_image(self, name: str) -> Tensor:
        """An image that a record names."""
        return load_image(run_file(self.folder, name))

    def memo(self, key: str, make: Callable[[], T]) -> T:
        """`make()`, kept in memory until `memo` of the same kind (the key up to its first colon) is asked for anew."""
        kind, name = key.partition(":")[0], self.prefix + key
        held = self._shared.memory.get(kind)
        if held is None or held[0] != name:
            self._shared.memory.pop(kind, None)  # freed before the next is made: two large volumes need not fit
            held = (name, make())
            self._shared.memory[kind] = held
        return held[1]

    def advance(self, fraction: float) -> None:
        """Says that this fraction (0 … 1) of the current unit is done."""
        self._shared.on_advance(fraction)

    def on_advance(self, callback: Callable[[float], None]) -> None:
        """Where `advance` goes: the progress bar."""
        self._shared.on_advance = callback

    def _file(self, name: str) -> Path:
        path = run_file(self.folder, "files/" + (self.prefix + name).replace("/", "--"))
        path.parent.mkdir(parents=True, exist_ok=True)
        return path


@dataclass
class _Shared:
    """What the sections of one run have in common."""

    starts: list[Record]  # all so far, the current one last
    memory: dict[str, tuple[str, Any]] = field(default_factory=dict)
    on_advance: Callable[[float], None] = lambda _fraction: None


def run_file(folder: Path, name: str) -> Path:
    """The file of a run folder by the name that a record has for it.

    Raises:
        RunError: a name that leads out of the folder; no record of ours has one.
    """
    path = Path(name)
    if path.is_absolute() or path.drive or ".." in path.parts or "\0" in name:
        raise RunError(f"expected the name of a file in {folder}; got {name!r}, which is none")
    return folder / path


def _lock(lock: Any, folder: Path) -> None:
    """Held until the file is closed, which the operating system does even for a process that is killed."""
    try:
        if sys.platform == "win32":
            import msvcrt

            msvcrt.locking(lock.fileno(), msvcrt.LK_NBLCK, 1)
        else:
            import fcntl

            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except (BlockingIOError, PermissionError):
        advice = "wait for it, or use --fresh for a folder of your own"
        raise RunError(f"{folder} is in use by another process; {advice}") from None


def _write_config(folder: Path, config: BaseModel) -> None:
    path, text = folder / "config.yaml", dump_config(config)
    if path.exists():
        if path.read_text(encoding="utf-8") != text:
            raise RunError(f"{path} holds another config than the one asked for; use --fresh for a new folder")
        return
    with atomic_write(path) as temporary:
        temporary.write_text(text, encoding="utf-8")


def _begin(folder: Path, provenance: Mapping[str, Any]) -> list[Record]:
    """Writes this start down and returns all. Raises RunError if earlier ones had other input files."""
    starts = read_provenance(folder)
    path, inputs = folder / "provenance.jsonl", provenance.get("inputs", {})
    if starts and starts[-1].get("inputs", {}) != inputs:
        raise RunError(f"{path} tells of other input files than those that are there now; use --fresh for a new folder")
    start = {"start": len(starts) + 1, **provenance}
    with path.open("ab") as file:
        if path.stat().st_size and not path.read_bytes().endswith(b"\n"):
            file.write(b"\n")  # a line that was torn by a kill stays alone
            file.flush()
        _append_line(file.fileno(), start)
    return [*starts, start]


def _append_line(descriptor: int, record: Mapping[str, Any]) -> None:
    """The whole line or, on a full disk, nothing of it."""
    line = (json.dumps(record, ensure_ascii=False, allow_nan=False) + "\n").encode()
    before = os.fstat(descriptor).st_size
    try:
        while line:
            line = line[os.write(descriptor, line) :]
        os.fsync(descriptor)
    except OSError:
        os.ftruncate(descriptor, before)
        raise


def read_records(folder: Path) -> tuple[dict[str, Record], int]:
    """The records of a run folder by key, and how many bytes of the file they fill; reads, never writes.

    Reading stops at the first line that is not a whole record: what a kill or a full disk left there is to be redone.
    """
    path = folder / "records.jsonl"
    records: dict[str, Record] = {}
    good = 0
    if not path.exists():
        return records, good
    for line in path.read_bytes().splitlines(keepends=True):
        record = _record(line)
        if record is None:
            break
        records[record["key"]] = record
        good += len(line)
    return records, good


def _record(line: bytes) -> Record | None:
    if not line.endswith(b"\n"):
        return None
    try:
        record = json.loads(line)
    except (ValueError, RecursionError):
        return None
    return record if isinstance(record, dict) and "key" in record else None


def repaired_records(folder: Path) -> dict[str, Record]:
    """The whole records of the folder; a torn end of the file is cut off so that appending goes on cleanly.

    Raises:
        RunError: whole records stand behind a broken line; then the file was damaged by something else.
    """
    records, good = read_records(folder)
    path = folder / "records.jsonl"
    if path.exists() and path.stat().st_size > good:
        torn = path.read_bytes()[good:]
        if any(_record(line) is not None for line in torn.splitlines(keepends=True)):
            raise RunError(f"{path} has a broken line before whole records; mend or remove it, or use --fresh")
        os.truncate(path, good)
    return records


def read_provenance(folder: Path) -> list[Record]:
    """One entry per start of the run, each with its number."""
    path = folder / "provenance.jsonl"
    if not path.exists():
        return []
    entries = []
    for line in path.read_bytes().splitlines():
        try:
            entry = json.loads(line)
        except (ValueError, RecursionError):
            continue  # torn by a kill at the very start, maybe in the middle of a letter; the next start wrote its own
        if isinstance(entry, dict):
            entries.append({"start": len(entries) + 1, **entry})
    return entries


def provenance(device: str, seed: int, command: str, inputs: Mapping[str, str] | None = None) -> Record:
    """What a later reader needs to know about this start of a run; `inputs` is {path: digest} of the files it reads."""
    return {
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "command": command,
        "filterlab": _version("filterlab"),
        "commit": _commit(),
        "torch": torch.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
        "system": f"{platform.system()} {platform.machine()}",
        "device": _device_name(device),
        "threads": torch.get_num_threads(),
        "seed": seed,
        "inputs": dict(inputs or {}),
    }


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def _device_name(device: str) -> str:
    return f"{device} ({torch.cuda.get_device_name(device)})" if device.startswith("cuda") else device


def _commit() -> str | None:
    """The commit of the checkout, with `+changes` and a digest of them when files differ; None outside a checkout."""
    here = Path(__file__).resolve().parent
    try:
        ask = lambda *words: subprocess.run(  # noqa: E731
            ["git", "-C", str(here), *words], capture_output=True, text=True, timeout=10, check=True
        ).stdout.strip()
        commit, status = ask("rev-parse", "--short=12", "HEAD"), ask("status", "--porcelain")
        if not status:
            return commit
        changes = hashlib.sha256(f"{status}\n{ask('diff', 'HEAD')}".encode()).hexdigest()
        return f"{commit}+changes.{changes[:8]}"
    except (OSError, subprocess.SubprocessError):
        return None


def timed(work: Callable[[], T]) -> tuple[T, float]:
    """The result and the wall-clock seconds that it took."""
    start = time.perf_counter()
    result = work()
    return result, time.perf_counter() - start
