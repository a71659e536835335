"""Does filterlab keep its promises at the extremes? Every case of `experiments.extremes`, at full length.

One unit per case and subject (method, scheme, boundary, device: what the case sweeps). A record says how many inputs
were tried, the worst error among them, and the bound that it must stay within.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

import torch
from pydantic import AfterValidator, Field

from experiments.config import ExperimentConfig, number
from experiments.extremes import CASES
from experiments.extremes.contract import Case, Subject
from experiments.runs import Record, Run, Unit
from filterlab.names import unknown_name
from filterlab.scenes.model import MethodName


def _known_case(key: str) -> str:
    if key not in CASES:
        raise ValueError(unknown_name("case", key, CASES))
    return key


class Config(ExperimentConfig):
    """Which cases, on what, and how many inputs.

    Attributes:
        cases: keys of `experiments.extremes.CASES`; left out, all.
        methods: what cases that sweep methods are checked for; left out, all.
        amount: 1 is the full length; the number of inputs is proportional to it, roughly.
    """

    experiment: Literal["stability"]
    cases: Annotated[list[Annotated[str, AfterValidator(_known_case)]], Field(min_length=1)] | None = None
    methods: Annotated[list[MethodName], Field(min_length=1)] | None = None
    amount: Annotated[float, Field(gt=0, le=100)] = 1.0

    @property
    def chosen(self) -> list[Case]:
        """The cases, each once."""
        return [CASES[key] for key in dict.fromkeys(self.cases or CASES)]

    def work(self) -> dict[str, tuple[Case, Subject]]:
        """Unit keys -> what is checked."""
        devices = ["cpu", *(["cuda"] if torch.cuda.is_available() else [])]
        return {
            f"{case.key}/{subject.key}": (case, subject)
            for case in self.chosen
            for subject in case.subjects(self.methods, devices=devices)
        }


def units(config: Config) -> list[Unit]:
    """One per case and subject."""
    return [
        Unit(key, f"{case.title}: {subject.key}", case.seconds * config.amount)
        for key, (case, subject) in config.work().items()
    ]


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one unit."""
    case, subject = run.memo("work", config.work)[unit.key]
    finding = case.run(subject, config.seed, config.amount)
    return {
        "case": case.key,
        "title": case.title,
        "contract": case.contract,
        **_described(subject),
        "inputs": finding.inputs,
        "worst": number(finding.worst),
        "bound": finding.bound,
        "holds": finding.holds,
        "note": finding.note,
        "skipped": finding.skipped,
    }


def _described(subject: Subject) -> dict[str, Any]:
    return {name: getattr(subject, name) for name in ("method", "scheme", "boundary", "device")}
