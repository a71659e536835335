"""Typed, validated experiment configs: what they share."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Iterator
from itertools import pairwise
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import torch
from pydantic import AfterValidator, BaseModel, Field, model_validator

import filterlab as fl
from filterlab import signals
from filterlab.fields.base import Domain
from filterlab.io.config import ConfigError, Problem, StrictModel
from filterlab.io.volumes import files_of
from filterlab.scenes.model import Reconstruction, SignalModel, VolumeFile

Dtype = Literal["float32", "float64"]
BoundaryName = Literal["mirror", "reflect", "wrap", "border", "zeros"]


class Recipe(Reconstruction):
    """One of the reconstructions that an experiment compares. A bare method name stands for its defaults."""

    @model_validator(mode="after")
    def _prefiltered(self) -> Recipe:
        if not self.prefilter and not fl.METHODS[self.name].facts.prefiltered:
            raise ValueError(f"{self.name} has no prefilter to leave out; remove prefilter: false")
        return self

    @property
    def gradient_kind(self) -> str:
        """`analytic` or `central`: what is used, the method's default where none is asked for."""
        return self.gradient or fl.METHODS[self.name].gradients[0]

    @property
    def first_scheme(self) -> str:
        """The scheme asked for, else the method's first, which it takes where that can run."""
        return self.scheme or fl.METHODS[self.name].schemes[0]

    @property
    def declared_order(self) -> int:
        """The approximation order that the method declares, with or without its prefilter."""
        facts = fl.METHODS[self.name].facts
        return facts.approximation_order if self.prefilter else facts.approximation_order_without_prefilter

    @property
    def key(self) -> str:
        """A short unique name for records and files, e.g. `triquadratic+unprefiltered`."""
        facts = fl.METHODS[self.name].facts
        parts = [
            self.name,
            "" if self.prefilter else "unprefiltered",
            "" if self.gradient_kind == facts.gradients[0] else self.gradient_kind,
            self.scheme or "",
            "" if self.sampler == "exact" else self.sampler,
            self.storage or "",
        ]
        return "+".join(p for p in parts if p)

    def record(self) -> dict[str, Any]:
        """What a record says about the recipe, so that a report needs nothing else to label it."""
        return {
            "recipe": self.key,
            "method": self.name,
            "prefilter": self.prefilter,
            "gradient": self.gradient_kind,
            "scheme": self.scheme or "default",
            "sampler": self.sampler,
            "storage": self.storage or "default",
            "default_gradient": self.gradient_kind == fl.METHODS[self.name].facts.gradients[0],
        }


def distinct(recipes: list[Recipe]) -> list[Recipe]:
    """The recipes. Raises ValueError unless they are all different."""
    seen: set[str] = set()
    for recipe in recipes:
        if recipe.key in seen:
            raise ValueError(f"{recipe.key} is listed twice")
        seen.add(recipe.key)
    return recipes


Recipes = Annotated[list[Recipe], Field(min_length=1), AfterValidator(distinct)]


class VolumeChoice(VolumeFile):
    """A volume file of an experiment.

    Attributes:
        optional: left out where there is no such file, by experiments that say so.
    """

    optional: bool = False

    def check(self, path: str) -> Domain:
        """The domain of the volume, by its header: no voxels are read.

        Raises ConfigError for the key at `path` unless the file is there with a sound header of one volume.
        """
        try:
            header = self.header()
        except (ValueError, OSError) as error:
            raise ConfigError([Problem(self.file, path, str(error))]) from None
        return Domain.of_grid(header.size, header.geometry)

    @property
    def present(self) -> bool:
        """Whether it counts: it is there, or it has to be."""
        if self.optional:
            try:
                self.path()
            except ValueError:
                return False
        return True

    def extent(self) -> float:
        """Voxels along an axis, the geometric mean of the three; 128 where the file can't be read here."""
        try:
            size = self.header().size
        except (ValueError, OSError):
            return 128.0
        return float(np.prod(np.asarray(size, dtype=np.float64)) ** (1 / 3))


def check_signal(signal: SignalModel, path: str) -> signals.Signal:
    """The signal. Raises ConfigError, for the key at `path`, unless it is finite at a point like any other."""
    try:
        return signal.finite()
    except ValueError as error:
        raise ConfigError([Problem(signal.label, path, str(error))]) from None


def input_files(config: BaseModel) -> dict[str, str]:
    """{resolved path: SHA-256 of the content} of every file that the volumes of a config are read from.

    Raises:
        ValueError, OSError: a file that is not there or can't be read.
    """
    present = (choice for choice in _volume_choices(config) if choice.present)
    files = {file for choice in present for file in files_of(choice.path())}
    return {str(file): _digest(file) for file in sorted(files)}


def _volume_choices(value: Any) -> Iterator[VolumeChoice]:
    """Every volume choice in a config, however deep."""
    if isinstance(value, VolumeChoice):
        yield value
    elif isinstance(value, BaseModel):
        for _, inner in value:
            yield from _volume_choices(inner)
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from _volume_choices(inner)


def _digest(file: Path) -> str:
    with file.open("rb") as content:
        return hashlib.file_digest(content, "sha256").hexdigest()


class ExperimentConfig(StrictModel):
    """What every experiment's config has."""

    experiment: str
    description: Annotated[str, Field(min_length=1)]
    seed: Annotated[int, Field(ge=0, lt=2**63)] = 0
    device: str = "cpu"
    threads: Annotated[int, Field(ge=1, le=1024)] | None = None


def torch_dtype(name: Dtype) -> torch.dtype:
    """The torch dtype of that name."""
    return {"float32": torch.float32, "float64": torch.float64}[name]


def increasing(numbers: Iterable[int]) -> list[int]:
    """The numbers as a list. Raises ValueError unless they increase strictly."""
    listed = list(numbers)
    if any(b <= a for a, b in pairwise(listed)):
        raise ValueError(f"expected increasing numbers; got {listed}")
    return listed


def check_device(name: str, path: str = "device") -> None:
    """Raises ConfigError unless torch can compute on that device here and give the result back (`meta` can't)."""
    try:
        float(torch.ones(1, device=torch.device(name)).sum())
    except (RuntimeError, AssertionError, ImportError, ValueError) as error:
        message = f"expected a device that torch can compute on here, like cpu; got {name!r} ({_first_line(error)})"
        raise ConfigError([Problem(name, path, message)]) from None


def _first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]


def number(value: float | torch.Tensor) -> float | None:
    """A plain number for a record; None where it is not finite (JSON has no infinity)."""
    plain = float(value)
    return plain if math.isfinite(plain) else None
