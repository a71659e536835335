"""The report of `demo`: the sections of its experiments, one after the other."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from experiments.report import dvr_signal, dvr_volume, frequency_response, rms_error, terrain_views, texture_precision
from experiments.report.page import Section
from experiments.runs import Record

if TYPE_CHECKING:
    from experiments.demo import Config

DRAW = {
    module.__name__.rpartition(".")[2]: module.draw
    for module in (frequency_response, rms_error, dvr_signal, dvr_volume, texture_precision, terrain_views)
}


def draw(config: Config, records: Mapping[str, Record], folder: Path) -> Section:
    """The section of the report that holds all others."""
    parts = []
    for i, part in enumerate(config.sections):
        own = {key.removeprefix(f"{i}/"): r for key, r in records.items() if key.startswith(f"{i}/")}
        section = DRAW[part.experiment](part, own, folder)  # type: ignore[operator]
        parts.append(replace(section, lead=(part.description, *section.lead)))
    return Section("filterlab: a demonstration", (), (), parts)
