"""A run of an experiment: its units of work one after the other, what is told meanwhile, and its report."""

from __future__ import annotations

import argparse
import shlex
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from experiments.config import input_files
from experiments.errors import RunError
from experiments.registry import Experiment, load
from experiments.runs import Record, Run, Unit, provenance, run_folder
from filterlab.cli.imports import importing
from filterlab.cli.outcome import INTERRUPTED, OK
from filterlab.io.bounded import VolumeFileError
from filterlab.io.config import ConfigError

_NO_MEMORY = "expected enough memory; there is not: use a smaller resolution, image or number of points"
_ALLOCATOR_SAYS = ("DefaultCPUAllocator", "can't allocate memory", "out of memory", "Storage size calculation overflow")


def run(options: argparse.Namespace, overrides: dict[str, str], arguments: list[str]) -> int:
    """Runs the config that `options` name, or goes on with it, and writes its report; returns the exit code."""
    with importing():
        name, experiment, config = load(options.config, overrides)
    if config.threads is not None:
        torch.set_num_threads(config.threads)
    inputs = input_files(config)
    folder = run_folder(options.runs, name, config, inputs, fresh=options.fresh)
    command = shlex.join(["python", "-m", "experiments", *(a for a in arguments if a != "--fresh")])
    with Run.open(folder, config, provenance(config.device, config.seed, command, inputs)) as run:
        units = experiment.units(config)
        left = [unit for unit in units if not run.done(unit.key)]
        _announce(name, config.description, units, left, folder)
        _warn_of_other_code(run)
        try:
            _work(experiment, config, run, units, left)
        except KeyboardInterrupt:
            done = sum(run.done(unit.key) for unit in units)
            print(f"\nstopped; {done} of {len(units)} are done and kept. Go on with:\n  {command}", file=sys.stderr)
            return INTERRUPTED
    return report(folder)


def report(folder: Path) -> int:
    """Draws the report of a run folder; returns the exit code."""
    with importing():
        from experiments.report.write import write_report
    print(f"report: {write_report(folder)}")
    return OK


def _announce(name: str, description: str, units: list[Unit], left: list[Unit], folder: Path) -> None:
    print(f"{name}: {description}", file=sys.stderr)
    print(f"folder: {folder}", file=sys.stderr)
    if not left:
        print(f"all {len(units)} units of work are done already; --fresh does them again", file=sys.stderr)
        return
    done = len(units) - len(left)
    kept = f"{done} of {len(units)} units of work are done already; " if done else ""
    print(f"{kept}{len(left)} to do; the time left is told as they are done", file=sys.stderr)


def _warn_of_other_code(run: Run) -> None:
    others = run.made_by_other_code()
    if others:
        made = ", ".join(dict.fromkeys(_code(start) for start in others))
        print(
            f"warning: records kept in {run.folder} were computed by other code ({made}) than what runs now "
            f"({_code(run.start)}); this run mixes records of both. --fresh computes everything anew",
            file=sys.stderr,
        )


def _code(start: Record) -> str:
    return f"filterlab {start.get('filterlab')}, commit {start.get('commit') or 'unknown'}"


def _duration(seconds: float) -> str:
    if seconds < 90:
        return f"{max(round(seconds), 1)} s"
    return f"{seconds / 60:.0f} min" if seconds < 5400 else f"{seconds / 3600:.1f} h"


def _work(experiment: Experiment, config: Any, run: Run, units: list[Unit], left: list[Unit]) -> None:
    with _shown_progress(run, units, left) as shown:
        for unit in left:
            shown.begin(unit)
            start = time.perf_counter()
            record = _computed(experiment, config, unit, run)
            run.append(unit.key, {**record, "seconds": time.perf_counter() - start})
            shown.end(unit)


def _computed(experiment: Experiment, config: Any, unit: Unit, run: Run) -> Record:
    """The record of a unit. What only the work itself could find to be wrong with a config becomes a RunError."""
    try:
        return experiment.compute(config, unit, run)
    except (RunError, ConfigError, VolumeFileError):
        raise
    except MemoryError:
        raise RunError(f"{unit.label}: {_NO_MEMORY}") from None
    except ValueError as error:
        raise RunError(f"{unit.label}: {' '.join(str(error).split())}") from error
    except RuntimeError as error:
        if isinstance(error, torch.OutOfMemoryError) or any(words in str(error) for words in _ALLOCATOR_SAYS):
            raise RunError(f"{unit.label}: {_NO_MEMORY} ({str(error).splitlines()[0]})") from error
        raise


@contextmanager
def _shown_progress(run: Run, units: list[Unit], left: list[Unit]) -> Iterator[_Lines | _Bar]:
    console = Console(stderr=True)
    if not console.is_terminal:
        yield _Lines(len(units), left)
        return
    progress = Progress(
        TextColumn("{task.fields[units]}"),
        BarColumn(),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
        TextColumn("{task.description}"),
        console=console,
    )
    with progress:
        bar = _Bar(progress, len(units), left)
        run.on_advance(bar.advance)
        yield bar


class _Bar:
    """A progress bar with time left, for terminals."""

    def __init__(self, progress: Progress, total: int, left: list[Unit]) -> None:
        self._progress, self._total, self._done = progress, total, total - len(left)
        self._finished, self._unit = 0.0, 0.0
        self._task = progress.add_task("", total=sum(u.seconds for u in left), units=self._count())

    def _count(self) -> str:
        return f"{self._done}/{self._total}"

    def begin(self, unit: Unit) -> None:
        self._unit = unit.seconds
        self._progress.update(self._task, description=unit.label)

    def advance(self, fraction: float) -> None:
        self._progress.update(self._task, completed=self._finished + fraction * self._unit)

    def end(self, unit: Unit) -> None:
        self._done += 1
        self._finished += unit.seconds
        self._progress.update(self._task, completed=self._finished, units=self._count())


class _Lines:
    """A line now and then, for log files."""

    def __init__(self, total: int, left: list[Unit], every: float = 10.0) -> None:
        self._total, self._done, self._every = total, total - len(left), every
        self._expected, self._finished = sum(u.seconds for u in left), 0.0
        self._start = self._said = time.monotonic()

    def begin(self, unit: Unit) -> None:
        pass

    def end(self, unit: Unit) -> None:
        self._done += 1
        self._finished += unit.seconds
        now = time.monotonic()
        if now - self._said >= self._every:
            self._said = now
            left = (now - self._start) / self._finished * (self._expected - self._finished)
            print(f"{self._done} of {self._total} done, about {_duration(left)} left", file=sys.stderr, flush=True)
