"""Does `filterlab recommend` keep its word? Volumes whose truth is known, several budgets each.

A case is a volume, a task and a budget. Of every way to reconstruct it that was considered (method, scheme, storage),
the true error is computed from the truth at random points of the inner 0.9 of the box, and set against

    the budget              the pick's true error must not exceed it
    the cheapest way        that truly meets the budget; the pick must not cost more than 1.5 times as much

Costs are those that `recommend` measured; what is judged is the choice. Scans have no closed form: a low-passed scan is
taken as truth, and every second voxel of it as the volume (`members.Scan`).
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import torch
from pydantic import Field
from torch import Tensor

import filterlab as fl
from experiments.config import ExperimentConfig, SignalChoice, VolumeChoice, number
from experiments.members import Sampling, Scan, WavesClass
from experiments.rms_error import evaluate, uniform_points
from experiments.runs import Record, Run, Unit
from filterlab import metrics
from filterlab.io.config import StrictModel
from filterlab.prediction import INNER
from filterlab.recommendation import Candidate, Recommendation, recommend

Share = Annotated[float, Field(gt=0, le=1)]
Size = Annotated[int, Field(ge=2, le=160)]
FACTOR = 1.5  # of the cheapest that truly meets the budget


class SampledSignal(StrictModel):
    """A signal at several resolutions, a volume each."""

    signal: SignalChoice
    resolutions: Annotated[list[Size], Field(min_length=1)]


class Waves(StrictModel):
    """Band-limited random fields (`members.WavesClass`), one of each bandwidth, in parts of the Nyquist frequency."""

    bandwidths: Annotated[list[Share], Field(min_length=1)]
    resolution: Size


class Config(ExperimentConfig):
    """Which volumes, tasks and budgets.

    Attributes:
        signals, waves, scans: where volumes come from.
        tasks, budgets: every one for every volume; budgets in parts of the value range.
        points: at which errors are computed.
        seconds: that costs are measured for, in each case.
    """

    experiment: Literal["recommend_validation"]
    signals: Annotated[list[SampledSignal], Field(default_factory=list)]
    waves: Annotated[list[Waves], Field(default_factory=list)]
    scans: Annotated[list[VolumeChoice], Field(default_factory=list)]
    tasks: Annotated[list[Literal["resample", "isosurface"]], Field(min_length=1)]
    budgets: Annotated[list[Share], Field(min_length=1)]
    points: Annotated[int, Field(ge=100, le=10**6)] = 4000
    seconds: Annotated[float, Field(gt=0, le=60)] = 0.3


@dataclass(frozen=True)
class _Subject:
    """A volume and its truth.

    Attributes:
        volume: samples on the integers.
        points: (P, 3), voxel coordinates.
        value, gradient: the truth there, the gradient per voxel.
    """

    volume: Tensor
    points: Tensor
    value: Tensor
    gradient: Tensor


def _subjects(config: Config) -> dict[str, Callable[[], _Subject]]:
    """Names of volumes -> how to make them."""
    made: dict[str, Callable[[], _Subject]] = {}
    for choice in config.signals:
        for n in choice.resolutions:
            made[f"{choice.signal.label}, {n}³"] = lambda c=choice, n=n: _of_signal(c.signal.build(), n, config)
    for waves in config.waves:
        for bandwidth in waves.bandwidths:
            label = f"waves to {bandwidth:g} of Nyquist, {waves.resolution}³"
            made[label] = lambda b=bandwidth, n=waves.resolution: _of_signal(_waves(b, n, config.seed), n, config)
    for scan in (scan for scan in config.scans if scan.present):
        made[f"scan {scan.file}"] = lambda s=scan: _of_scan(s, config)
    return made


def _waves(bandwidth: float, n: int, seed: int) -> fl.signals.Signal:
    drawn = WavesClass(kind="waves", title="waves", bandwidth=bandwidth)
    return drawn.draw(torch.Generator().manual_seed(seed), n)


def _of_signal(signal: fl.signals.Signal, n: int, config: Config) -> _Subject:
    volume = signal.sample(n, dtype=torch.float64)
    points = uniform_points(signal, config.points, INNER, config.seed, torch.float64, "cpu")
    value, gradient = evaluate(signal, points)
    return _Subject(volume.samples.float(), volume.world_to_voxel(points), value, gradient * volume.spacing[0])


def _of_scan(scan: VolumeChoice, config: Config) -> _Subject:
    known = Scan.of(scan.load().samples.double(), Sampling(resolution=32, inner=INNER))
    size = torch.tensor(known.coarse.shape[::-1], dtype=torch.float64)
    unit = torch.rand(config.points, 3, generator=torch.Generator().manual_seed(config.seed), dtype=torch.float64)
    points = size * (0.5 + INNER * (unit - 0.5)) - 0.5
    value, gradient = evaluate(known.truth, 2 * points)
    return _Subject(known.coarse.float(), points, value, 2 * gradient)


def check(config: Config, path: str = "") -> None:
    """Raises ConfigError unless the signals can be evaluated and the scans, but for optional ones, are here."""
    for i, choice in enumerate(config.signals):
        choice.signal.check(f"{path}signals[{i}].signal")
    for i, scan in enumerate(config.scans):
        if scan.present:
            scan.check(f"{path}scans[{i}]")


def units(config: Config) -> list[Unit]:
    """One per volume, task and budget."""
    return [
        Unit(f"{name}|{task}|{budget:g}", f"{name}, {task}, {budget:g}", 2.0)
        for name in _subjects(config)
        for task in config.tasks
        for budget in config.budgets
    ]


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one case."""
    name, task, budget = unit.key.split("|")
    common = {"volume": name, "task": task, "budget": float(budget)}
    subject = run.memo(name, _subjects(config)[name])
    answer = recommend(
        subject.volume, float(budget), task=task, boundary="reflect", seconds=config.seconds, seed=config.seed
    )
    return {**common, **judged(answer, subject_errors(answer, subject))}


def subject_errors(answer: Recommendation, subject: _Subject) -> list[float]:
    """The true error of every candidate, in parts of the range, counted as the task counts."""
    low, high = answer.value_range
    known: dict[tuple[str, str | None], float] = {}
    for candidate in answer.candidates:
        way = candidate.method, candidate.storage
        if way not in known:  # schemes compute the same field
            field = fl.reconstruct(subject.volume, boundary=answer.boundary, **candidate.options())
            value, gradient = evaluate(field, subject.points.float())
            errors = [float(metrics.rms(value.double(), subject.value))]
            if answer.task != "resample":
                errors.append(float(metrics.rms(gradient.double(), subject.gradient, vectors=True)))
            known[way] = max(errors) / (high - low)
    return [known[c.method, c.storage] for c in answer.candidates]


def judged(answer: Recommendation, errors: list[float]) -> dict[str, Any]:
    """Whether the budget holds, and what the pick costs beside the cheapest that truly meets it."""
    true = dict(zip(map(id, answer.candidates), errors, strict=True))
    meeting = [c for c in answer.candidates if true[id(c)] <= answer.max_error]
    cheapest = min(meeting, key=lambda c: c.seconds, default=None)
    pick = answer.pick
    holds = pick is None or true[id(pick)] <= answer.max_error
    factor = pick.seconds / cheapest.seconds if pick is not None and cheapest is not None else None
    return {
        "pick": None if pick is None else _described(pick, true[id(pick)]),
        "cheapest": None if cheapest is None else _described(cheapest, true[id(cheapest)]),
        "best": _described(answer.best, true[id(answer.best)]),
        "holds": holds,
        "factor": factor,
        "near": cheapest is None if pick is None else factor is not None and factor <= FACTOR,
        "ways": [_described(c, true[id(c)]) for c in answer.candidates if c.storage is None],
    }


def _described(candidate: Candidate, true: float) -> dict[str, Any]:
    error = candidate.error
    return {
        "method": candidate.method,
        "scheme": candidate.scheme,
        "storage": candidate.storage,
        "seconds": candidate.seconds,
        "predicted": error.predicted,
        "measured": error.measured,
        "high": error.high,
        "resolved": candidate.resolved,
        "true": number(true if math.isfinite(true) else math.nan),
    }
