"""EXPERIMENTS: what the command, the tests and the demo know, each imported when it is asked for.

An experiment is a module here with `Config`, `units`, `compute` (and `check`), and a module of the same name in
`experiments.report` with `draw`. To add one: write both, add its name to `_NAMES`, add a config to configs/.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from experiments.headings import Heading, config_path, load_heading
from filterlab.io.config import ConfigError, Problem, load_config
from filterlab.names import unknown_name

if TYPE_CHECKING:
    from experiments.report.page import Section
    from experiments.runs import Record, Run, Unit

_NAMES = (
    "frequency_response",
    "rms_error",
    "dvr_signal",
    "dvr_volume",
    "texture_precision",
    "inverse_dvr",
    "inverse_surface",
    "inverse_terrain",
    "silhouettes",
    "speed_accuracy",
    "equal_error",
    "brick_economy",
    "fit_kernel",
    "recommend_validation",
    "stability",
    "quadrics_numerics",
    "root_finding",
    "hit_error",
    "isosurface_quality",
    "partitions",
    "prefilters_on_tetrahedra",
    "tetrahedral_table",
    "quadrics_tables",
    "inverse_slim",
    "slim_error",
    "quadrics_gallery",
    "terrain_error",
    "terrain_quality",
    "terrain_roots",
    "terrain_frames",
    "terrain_views",
    "demo",
)


def _nothing_to_check(_config: Any, _path: str = "") -> None:
    pass


@dataclass(frozen=True)
class Experiment:
    """A question that can be asked of the lab.

    Attributes:
        name: the value of `experiment:` in a config file.
        config: the model its configs are checked against.
        units: config -> all units of work, in the order they are done; computes nothing.
        compute: (config, unit, run) -> the record of that unit; may read records of earlier units from the run.
        draw: (config, records by key, run folder) -> a section of the report; computes nothing.
        check: (config, path of the config's keys) -> None; raises ConfigError where this machine lacks what the config
            needs (a volume file), or where the work would fail for a reason that can be seen beforehand.
    """

    name: str
    config: type
    units: Callable[[Any], list[Unit]]
    compute: Callable[[Any, Unit, Run], Record]
    draw: Callable[[Any, Mapping[str, Record], Path], Section]
    check: Callable[[Any, str], None] = _nothing_to_check


@cache
def _experiment(name: str) -> Experiment:
    """Drawing is imported when something is drawn: matplotlib takes a second."""
    computing = import_module(f"experiments.{name}")

    def draw(config: Any, records: Mapping[str, Record], folder: Path) -> Section:
        return import_module(f"experiments.report.{name}").draw(config, records, folder)

    check = getattr(computing, "check", _nothing_to_check)
    return Experiment(name, computing.Config, computing.units, computing.compute, draw, check)


class _Experiments(Mapping[str, Experiment]):
    """Those of `_NAMES`: all imported at once take longer than torch."""

    def __getitem__(self, name: str) -> Experiment:
        if name not in _NAMES:
            raise KeyError(name)
        return _experiment(name)

    def __contains__(self, name: object) -> bool:
        return name in _NAMES

    def __iter__(self) -> Iterator[str]:
        return iter(_NAMES)

    def __len__(self) -> int:
        return len(_NAMES)


EXPERIMENTS: Mapping[str, Experiment] = _Experiments()


def heading_of(path: Path) -> Heading:
    """What a config file is for. Raises ConfigError that lists the known experiments."""
    heading = load_heading(path)
    if heading.experiment not in EXPERIMENTS:
        message = unknown_name("experiment", heading.experiment, EXPERIMENTS)
        raise ConfigError([Problem(str(path), "experiment", message)])
    return heading


def experiment_of(path: Path) -> tuple[Experiment, Heading]:
    """The experiment a config file is for. Raises ConfigError that lists the known experiments."""
    heading = heading_of(path)
    return EXPERIMENTS[heading.experiment], heading


def load(name: str, overrides: Mapping[str, str] | None = None) -> tuple[str, Experiment, Any]:
    """Name, experiment and typed config of a config file, given by path or bare name, checked against this machine."""
    from experiments.config import check_device  # it imports torch, which names and headings need not wait for

    path = config_path(name)
    experiment, _ = experiment_of(path)
    config = load_config(path, experiment.config, overrides)
    check_device(config.device)
    experiment.check(config, "")
    return path.stem, experiment, config
