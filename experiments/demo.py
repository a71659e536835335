"""Several experiments as sections of one run and one report, each with parameters small enough for a demonstration."""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field, model_validator

from experiments import dvr_signal, dvr_volume, frequency_response, rms_error, terrain_views, texture_precision
from experiments.config import ExperimentConfig, check_device
from experiments.runs import Record, Run, Unit

PARTS: dict[str, Any] = {
    module.__name__.rpartition(".")[2]: module
    for module in (frequency_response, rms_error, dvr_signal, dvr_volume, texture_precision, terrain_views)
}

Part = Annotated[
    frequency_response.Config
    | rms_error.Config
    | dvr_signal.Config
    | dvr_volume.Config
    | texture_precision.Config
    | terrain_views.Config,
    Field(discriminator="experiment"),
]


class Config(ExperimentConfig):
    """Sections, each the config of another experiment.

    Seed and device hold for every section that does not set its own; threads hold for the whole run.
    """

    experiment: Literal["demo"]
    sections: Annotated[list[Part], Field(min_length=1)]

    @model_validator(mode="after")
    def _inherited(self) -> Config:
        for i, part in enumerate(self.sections):
            if part.threads is not None:
                raise ValueError(f"expected threads for the whole run only; section {i} sets {part.threads}")
        given = {"seed": self.seed, "device": self.device}
        parts = [
            part.model_copy(update={k: v for k, v in given.items() if k not in part.model_fields_set})
            for part in self.sections
        ]
        object.__setattr__(self, "sections", parts)
        return self


def check(config: Config, path: str = "") -> None:
    """Raises ConfigError unless this machine has what every section needs."""
    for i, part in enumerate(config.sections):
        check_device(part.device, f"{path}sections[{i}].device")
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
