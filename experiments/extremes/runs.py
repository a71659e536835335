"""Runs and files whose writer is killed, whose disk is full, whose folder must not be written."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import torch

from experiments.config import ExperimentConfig
from experiments.errors import RunError
from experiments.extremes import full_disk
from experiments.extremes.contract import Case, Finding, Subject, Tally
from experiments.runs import Run
from filterlab.io import save_volume
from filterlab.io.atomic import atomic_write


def killed(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """A run, and volumes written over others: what every line of the code that writes leaves, and some kills; then done
    again."""
    if not hasattr(os, "fork"):
        return Finding(0, 0.0, 0.0, skipped="processes are forked here, which this system does not do")
    stride = max(1, round(1 / amount))
    command = [sys.executable, "-m", "experiments.extremes.killing", str(stride)]
    results = json.loads(subprocess.run(command, capture_output=True, text=True, check=True).stdout)
    return _collected(results, "states", "kills")


def full(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """The same on a disk that has room for 0, 1, 2, … more pages; then once more with room."""
    missing = full_disk.missing()
    if missing:
        return Finding(0, 0.0, 0.0, skipped=missing)
    with TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "experiments.extremes.full_disk", folder]
        done = full_disk.on_a_small_disk(command, Path(folder))
    if done.returncode != 0:
        return Finding(1, 1.0, 0.0, done.stderr[-300:])
    return _collected(json.loads(done.stdout), "failed")


def _collected(results: list[dict], *counted: str) -> Finding:
    findings = [f"{result['work']}: {finding}" for result in results for finding in result["findings"]]
    told = ", ".join(f"{result['work']} {' + '.join(str(result[what]) for what in counted)}" for result in results)
    inputs = sum(result[what] for result in results for what in counted)
    return Finding(inputs, float(len(findings)), 0.0, "; ".join([*findings[:3], told]))


def unwritable(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """Folders that are missing, are files, or are locked (modes do not bind root, who is not asked about those)."""
    tally = Tally()
    config = ExperimentConfig(experiment="unwritable", description="nothing is written")
    with TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "file").write_text("")
        (folder / "locked").mkdir(mode=0o555)
        places = [folder / "missing", folder / "file"]
        if not os.access(folder / "locked", os.W_OK):
            places.append(folder / "locked")
        for place in places:
            for ending in (".nrrd", ".npy", ".npz"):
                told = _told(lambda place=place, ending=ending: save_volume(torch.rand(2, 2, 2), place / f"a{ending}"))
                tally.kept(told.startswith("cannot write") and "expected" in told, f"{place.name}: {told}")
            told = _told(lambda place=place: _written(place / "a.txt"))
            tally.kept(told.startswith("cannot write"), f"{place.name}: {told}")
            if place.name != "missing":  # a run makes its folder
                told = _told(lambda place=place: _opened(place / "run", config))
                tally.kept("expected a run folder that can be written" in told, f"{place.name}: {told}")
        tally.kept(sorted(os.listdir(folder)) == ["file", "locked"], "something was written")
    return tally.finding()


def _told(action) -> str:
    try:
        action()
    except (OSError, RunError) as error:
        return str(error)
    return "nothing was refused"


def _written(path: Path) -> None:
    with atomic_write(path) as temporary:
        temporary.write_text("")


def _opened(folder: Path, config: ExperimentConfig) -> None:
    with Run.open(folder, config, {}):
        pass


def outside(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """Names of files, in records and asked for by experiments, that lead out of the run folder."""
    tally = Tally()
    config = ExperimentConfig(experiment="outside", description="nothing is written outside")
    parts = ["..", ".", "/", "//", "a", "etc", "passwd", "\0", "...", "~", "C:", "files"]
    with TemporaryDirectory() as name, Run.open(Path(name) / "run", config, {}) as run:
        for _ in range(max(int(2000 * amount), 50)):
            chosen = "/".join(parts[int(i)] for i in random.integers(len(parts), size=int(random.integers(1, 5))))
            told = _told(lambda chosen=chosen: run.load_array(chosen))
            inside = os.path.normpath(os.path.join("/run", chosen.replace("\0", "/.."))).startswith("/run")
            refused = "expected the name of a file in" in told
            tally.kept(refused or inside, f"{chosen!r} is read: {told}")
            _told(lambda chosen=chosen: run.save_array(chosen, torch.zeros(1)))
        tally.kept(os.listdir(name) == ["run"], "something was written outside")
        kept = {"config.yaml", "provenance.jsonl", "lock", "files"}
        tally.kept(set(os.listdir(run.folder)) == kept, "something was written beside the files")
    return tally.finding()


CASES = (
    Case(
        "killed",
        "a run, and files written over others, killed before every line of the code that writes",
        "What is under a final name is whole, old or new, and never a mixture; the same work goes on and finishes.",
        killed,
        seconds=60,
        tested=0.01,
    ),
    Case(
        "full-disk",
        "the same on a disk with room for 0 … 12 more pages",
        "An error that says the disk is full and names the file; nothing half-written is left; with room it goes on.",
        full,
        seconds=8,
    ),
    Case(
        "unwritable",
        "folders that are missing, files, or locked",
        "A message that says what was expected of which folder, before anything is written.",
        unwritable,
        seconds=0.1,
    ),
    Case(
        "outside-the-run",
        "file names in records and of results that lead out of the run folder",
        "Refused, or written inside under another name; nothing is read or written outside.",
        outside,
        seconds=2,
    ),
)
