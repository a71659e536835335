"""Several experiments as sections of one run and one report, each with parameters small enough for a demonstration."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from experiments import dvr_signal, dvr_volume, frequency_response, rms_error, texture_precision
from experiments.config import ExperimentConfig
from experiments.runs import Record, Run, Unit

PARTS: dict[str, Any] = {
    module.__name__.rpartition(".")[2]: module
    for module in (frequency_response, rms_error, dvr_signal, dvr_volume, texture_precision)
}

Part = Annotated[
    frequency_response.Config | rms_error.Config | dvr_signal.Config | dvr_volume.Config | texture_precision.Config,
    Field(discriminator="experiment"),
]


class Config(ExperimentConfig):
    """Sections, each the config of another experiment. Device, threads and seed of the sections are their own."""

    experiment: Literal["demo"]
    sections: Annotated[list[Part], Field(min_length=1)]


def check(config: Config, path: str = "") -> None:
    """Raises ConfigError unless this machine has what every section needs."""
    for i, part in enumerate(config.sections):
        part_check = getattr(PARTS[part.experiment], "check", None)
        if part_check is not None:
            part_check(part, f"{path}sections[{i}].")


def units(config: Config) -> list[Unit]:
    """The units of all sections, one section after the other."""
    return [
        Unit(f"{i}/{unit.key}", unit.label, unit.seconds)
        for i, part in enumerate(config.sections)
        for unit in PARTS[part.experiment].units(part)
    ]


def compute(config: Config, unit: Unit, run: Run) -> Record:
    """The record of one unit, computed by its section's experiment."""
    index, _, key = unit.key.partition("/")
    part = config.sections[int(index)]
    return PARTS[part.experiment].compute(part, Unit(key, unit.label, unit.seconds), run.section(index))
