"""From a run folder to its report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from experiments.errors import RunError
from experiments.registry import experiment_of
from experiments.report.page import render
from experiments.runs import read_provenance, read_records
from filterlab.io.atomic import atomic_write
from filterlab.io.config import load_config


def write_report(folder: Path) -> Path:
    """Draws `report.html` in a run folder from what is recorded there, and returns its path.

    Raises:
        RunError: that is no run folder.
    """
    config_file = folder / "config.yaml"
    if not config_file.is_file():
        raise RunError(f"expected a run folder with a config.yaml in it; got {folder}")
    experiment, _ = experiment_of(config_file)
    config: Any = load_config(config_file, experiment.config, None)
    records, _ = read_records(folder)
    units = experiment.units(config)
    page = render(
        title=experiment.name.replace("_", " "),
        config=config,
        section=experiment.draw(config, records, folder),
        done=sum(unit.key in records for unit in units),
        total=len(units),
        seconds=sum(record.get("seconds", 0.0) for record in records.values()),
        config_text=config_file.read_text(encoding="utf-8"),
        starts=read_provenance(folder),
    )
    path = folder / "report.html"
    with atomic_write(path) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return path
