"""What is shown: volume files, and signals."""

from __future__ import annotations

import importlib.util
import inspect
import os
from pathlib import Path
from typing import Annotated, Any, ClassVar, Self

import torch
from pydantic import AfterValidator, Field, ValidationInfo, field_validator, model_validator

from filterlab import signals
from filterlab.io.bounded import VolumeFileError
from filterlab.io.volumes import VolumeHeader, describe, load_volume
from filterlab.names import unknown_name
from filterlab.scenes.model.quantities import LISTED, Names, Section, Told, named
from filterlab.volume import Volume

VOLUMES_VARIABLE = "FILTERLAB_VOLUMES"

Parameters = dict[str, float | Annotated[tuple[float, ...], LISTED]]


class VolumeFile(Section):
    """A volume file; a bare name stands for the file as it is."""

    bare: ClassVar[str] = "file"
    examples = ("engine.nrrd", "{file: $SCANS/series.nii.gz, frame: 3, channel: 0}")

    file: Annotated[str, Field(min_length=1), Told("a path")]
    """A path; `$NAME` in it stands for an environment variable. One that is not absolute is looked for in the folder of
    the scene, in the current folder, and in the folder named by $FILTERLAB_VOLUMES; `package:path` is a file that comes
    with an installed Python package (`nibabel:tests/data/example4d.nii.gz`)."""
    frame: Annotated[int, Field(ge=0)] | None = None
    """Which volume of a time series, from 0."""
    channel: Annotated[int, Field(ge=0)] | None = None
    """Which of several values per voxel, from 0."""

    @model_validator(mode="before")
    @classmethod
    def _from_path(cls, value: Any) -> Any:
        return named(value, cls.bare)

    def path(self, folder: Path = Path()) -> Path:
        """The file, absolute. Raises ValueError if there is none; the message lists where it was looked for."""
        return find_volume(self.file, folder)

    def header(self) -> VolumeHeader:
        """What the file says of its volume; no voxels are read.

        Raises VolumeFileError for a damaged file, or one that holds several volumes.
        """
        header = describe(self.path(), frame=self.frame, channel=self.channel)
        header.check_choice()
        if len(header.shape) != 3:
            expected = "one volume of shape (D, H, W) to show (a frame and a channel of several)"
            raise VolumeFileError(self.path(), expected, f"a batch (N, C, D, H, W) = {header.shape}")
        return header

    def load(self) -> Volume:
        """The volume, with its geometry. Raises VolumeFileError as `header` does."""
        self.header()
        return load_volume(self.path(), frame=self.frame, channel=self.channel)


def find_volume(name: str, folder: Path = Path(), what: str = "a volume file") -> Path:
    """The existing file that `name` stands for (see `VolumeFile`), absolute. Raises ValueError if there is none."""
    package, colon, inside = name.partition(":")
    if colon and package.isidentifier() and len(package) > 1:  # one letter is a drive
        return _packaged(package, inside)
    path = Path(name)
    if not path.is_absolute() or not path.exists():  # else a name that is as it stands, with a $ in it or not
        path = Path(os.path.expandvars(name)).expanduser()
    if "$" in str(path) and not path.exists():
        raise ValueError(f"expected environment variables that are set; got {name!r}")
    volumes = os.environ.get(VOLUMES_VARIABLE)
    places = [Path("/")] if path.is_absolute() else [folder, Path()] + ([Path(volumes)] if volumes else [])
    for place in places:
        if (place / path).exists():
            return (place / path).resolve()
    looked = " or ".join(dict.fromkeys(str((place / path).absolute()) for place in places))
    hint = "" if volumes or path.is_absolute() else f" (set {VOLUMES_VARIABLE} to the folder of your volumes)"
    raise ValueError(f"expected {what}; found none at {looked}{hint}")


def folder_of(info: ValidationInfo) -> Path:
    """That of the file that is being read."""
    return Path((info.context or {}).get("folder", "."))


def found(name: str, info: ValidationInfo, what: str) -> Path:
    """`find_volume` for a key of the file that is being read, in which `what` stands."""
    return find_volume(name, folder_of(info), what)


def _packaged(package: str, inside: str) -> Path:
    spec = importlib.util.find_spec(package)
    if spec is None or not spec.submodule_search_locations:
        raise ValueError(f"expected the installed package {package!r}; it is not here (pip install {package})")
    path = Path(spec.submodule_search_locations[0]) / inside
    if not path.is_file():
        raise ValueError(f"expected a file of the package {package}; it has no {inside!r}")
    return path


class SignalModel(Section):
    """A closed-form signal; a bare name stands for its default parameters."""

    bare: ClassVar[str] = "name"

    name: Annotated[str, AfterValidator(Names("signal", lambda: signals.SIGNALS))]
    """Of a signal."""
    parameters: Annotated[Parameters, Field(default_factory=dict), Told("numbers, or [x, y, z], by name")]
    """Of that signal; left out, its own defaults (`filterlab.signals`)."""

    @model_validator(mode="before")
    @classmethod
    def _from_name(cls, value: Any) -> Any:
        return named(value, cls.bare)

    @field_validator("parameters")
    @classmethod
    def _usable(cls, parameters: Parameters, info: ValidationInfo) -> Parameters:
        if "name" in info.data:  # else the name is the mistake
            _check_parameters(info.data["name"], parameters)
        return parameters

    def build(self) -> signals.Signal:
        """The signal."""
        return signals.named(self.name, **self.parameters)  # type: ignore[arg-type]

    def finite(self) -> signals.Signal:
        """The signal. Raises ValueError unless it is finite at a point like any other."""
        told = f"expected parameters with which {self.name} is finite; got {self.parameters}"
        try:
            signal = self.build()
            point = torch.tensor([signal.domain.center], dtype=torch.float64) + 0.1 * signal.domain.voxel_size
            found = signal.value_and_gradient(point)
        except (ArithmeticError, RuntimeError, TypeError) as error:
            raise ValueError(f"{told} ({error})") from None
        if not all(bool(x.isfinite().all()) for x in found):
            raise ValueError(told)
        return signal

    @property
    def label(self) -> str:
        """The name with its parameters, e.g. `gaussian (sigma 0.2)`."""
        listed = ", ".join(f"{k} {list(v) if isinstance(v, tuple) else v}" for k, v in self.parameters.items())
        return f"{self.name} ({listed})" if listed else self.name


class SignalSource(SignalModel):
    """A signal that is shown, exact or sampled; a bare name stands for its default parameters."""

    examples = ("marschner-lobb", "{name: marschner-lobb, parameters: {frequency: 5}, samples: 40}")

    samples: (
        Annotated[int, Field(ge=1, le=2048)]
        | Annotated[tuple[int, int, int], LISTED, Told("[nx, ny, nz] of them")]
        | None
    ) = None
    """How many voxels along an axis (or x, y, z) it is sampled on, for a method to reconstruct; left out, it is shown
    itself."""

    @model_validator(mode="after")
    def _accepted(self) -> Self:
        if isinstance(self.samples, tuple) and min(self.samples) < 1:
            raise ValueError(f"samples must be positive; got {self.samples}")
        self.finite()
        return self


def _check_parameters(name: str, parameters: Parameters) -> None:
    """Raises ValueError for a parameter that the signal does not have, of another kind, or that it refuses."""
    known = inspect.signature(signals.SIGNALS[name]).parameters
    for parameter, value in parameters.items():
        if parameter not in known:
            raise ValueError(unknown_name(f"parameter of {name}", parameter, known))
        expected = "three numbers [x, y, z]" if isinstance(known[parameter].default, tuple) else "a number"
        vector = isinstance(value, tuple)
        if vector != isinstance(known[parameter].default, tuple) or (vector and len(value) != 3):
            raise ValueError(f"{parameter}: expected {expected}; got {value}")
    signals.named(name, **parameters)  # type: ignore[arg-type]
