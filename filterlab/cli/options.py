"""What several commands are asked in the same way, and the checks of it."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Collection
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, TypeVar, Union

from tyro.conf import arg

from filterlab.cli.outcome import UsageError, first_line
from filterlab.names import unknown_name

if TYPE_CHECKING:
    from filterlab.io.bounded import VolumeHeader

Given = TypeVar("Given")
Maybe = Union[None, Given]  # noqa: UP007 (tyro imports typeguard to look at a `Given | None`: 0.1 s)
Triple = tuple[float, float, float]
Output = Annotated[Path, arg(aliases=["-o"], metavar="FILE")]
Frame = Annotated[Maybe[int], arg(metavar="T")]
Channel = Annotated[Maybe[int], arg(metavar="C")]
Quiet = Annotated[bool, arg(aliases=["-q"])]


def check_asked(output: Path | None, explain: bool, ending: str) -> None:
    """Raises UsageError unless a command makes something, or explains what it would make."""
    if explain == (output is not None):
        raise UsageError(f"expected either -o FILE{ending} or --explain; got " + ("both" if explain else "neither"))


def check_not_input(output: Path, source: Path) -> None:
    if os.path.realpath(output) == os.path.realpath(source):
        raise ValueError(f"expected an output other than the input; got {output} for both")


def check_name(what: str, name: str, known: Collection[str]) -> None:
    """Raises ValueError for a name that is not known."""
    if name not in known:
        raise ValueError(unknown_name(what, name, known))


INTEGERS = ("uint8", "int8", "uint16", "int16", "uint32", "int32", "uint64", "int64")
FLOATS = ("float32", "float64")


def result_type(name: str, source: VolumeHeader) -> str:
    """The type in the file that is asked for, by NumPy's name; `input` is that of the volume."""
    check_name("dtype", name, [*FLOATS, *INTEGERS, "input"])
    if name != "input":
        return name
    if source.sample_type.kind == "f":
        return source.sample_type.name
    return source.stored if source.stored in INTEGERS else "uint8"  # bool


def check_device(name: str) -> None:
    import torch

    try:  # rays are float64, and a value must come back (`meta` has none)
        torch.ones(1, dtype=torch.float64, device=name).item()
    except (RuntimeError, AssertionError, TypeError) as error:
        raise ValueError(
            f"device: expected a device that torch can use here, like cpu; got {name!r} ({first_line(error)})"
        ) from None


MEMORY = {"": 1.0, "B": 1.0} | {
    f"{letter}{ending}": base**power
    for power, letter in enumerate("KMGT", start=1)
    for ending, base in (("B", 1000.0), ("iB", 1024.0))
}
TIME = {"": 1.0, "s": 1.0, "ms": 1e-3, "min": 60.0, "h": 3600.0}


def quantity(option: str, text: str | None, units: dict[str, float]) -> float:
    """A positive number with one of the units; infinite for None. Raises UsageError for anything else."""
    if text is None:
        return math.inf
    match = re.fullmatch(r"\s*([0-9.eE+-]+)\s*([A-Za-z%]*)\s*", text)
    known = {unit.lower(): factor for unit, factor in units.items()}
    try:
        value = float(match[1]) * known[match[2].lower()] if match else math.nan
    except (ValueError, KeyError):
        value = math.nan
    if not 0 < value < math.inf:
        listed = ", ".join(unit for unit in units if unit)
        raise UsageError(f"expected {option} to be a positive number, with or without a unit ({listed}); got {text!r}")
    return value
