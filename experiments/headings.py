"""How a config file is found, and which experiment it is for: what can be told of it without torch."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from pydantic import BaseModel, ConfigDict, Field

from filterlab.io.config import ConfigError, Problem, load_config
from filterlab.names import unknown_name

CONFIGS = Path(__file__).resolve().parent.parent / "configs"


def known_configs(folder: Path = CONFIGS) -> dict[str, Path]:
    """The config files of the project, by name.

    Raises:
        ConfigError: there are none, as in a copy of this package without its configs.
    """
    found = {path.stem: path for path in sorted(folder.glob("*.yaml"))}
    if not found:
        message = (
            "expected the config files of the project, *.yaml; found none (they come with a checkout of filterlab)"
        )
        raise ConfigError([Problem(str(folder), "", message)])
    return found


def config_path(name: str) -> Path:
    """The config file that `name` stands for: a path, or the bare name of a file in configs/.

    Raises:
        ConfigError: neither; the message tells the nearest name, and lists the known ones.
    """
    path = Path(name)
    if path.is_file():
        return path
    configs = known_configs()
    if name.removesuffix(".yaml") in configs:
        return configs[name.removesuffix(".yaml")]
    message = f"expected the path of a YAML file, or a config's name; {unknown_name('config', name, configs)}"
    raise ConfigError([Problem(name, "", message)])


class Heading(BaseModel):
    """The two keys that every config file begins with; the rest depends on the experiment."""

    model_config = ConfigDict(extra="ignore")

    experiment: str
    description: Annotated[str, Field(min_length=1)]


def load_heading(path: Path) -> Heading:
    """Which experiment a config file is for, and its one-line description."""
    return load_config(path, Heading, None)
