"""Values that sections of a scene are made of, and what the reference says of them beside their types."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar

from pydantic import BeforeValidator, Field, model_validator

from filterlab.io.config import StrictModel
from filterlab.names import unknown_name


class Section(StrictModel):
    """A section of a scene file. The text under each key, and the examples, become the reference.

    A section that a bare value may stand for says in a class variable `bare` for which key that is.

    Attributes:
        examples: sections as people write them, in YAML; together they have every key.
    """

    examples: ClassVar[tuple[str, ...]] = ()


class Switched(Section):
    """A section that `true` stands for, with every default."""

    bare: ClassVar[str] = ""

    @model_validator(mode="before")
    @classmethod
    def _from_true(cls, value: Any) -> Any:
        return {} if value is True else value


@dataclass(frozen=True)
class Told:
    """What the reference says of a value where its type does not.

    Attributes:
        written: how it is written.
        unit: what it is counted in.
    """

    written: str | None = None
    unit: str | None = None


@dataclass(frozen=True)
class Names:
    """A check that a name is a known one.

    Attributes:
        what: what it names.
        known: the names, asked when one is checked.
    """

    what: str
    known: Callable[[], Iterable[str]]

    def __call__(self, name: str) -> str:
        """The name. Raises ValueError that lists the known ones."""
        known = [str(k) for k in self.known()]
        if name not in known:
            raise ValueError(unknown_name(self.what, name, known))
        return name


def part(value: Any) -> Any:
    """A part as a number, or as a text like `0.5%`."""
    if not isinstance(value, str):
        return value
    number = value.removesuffix("%").strip()
    if number == value or not re.fullmatch(r"[0-9]*\.?[0-9]+(e-?[0-9]+)?", number):
        raise ValueError(f"expected a part like 0.005 or 0.5%; got {value!r}")
    return float(number) / 100


def named(value: Any, key: str) -> Any:
    """A bare text stands for the section with that key and every default."""
    return {key: value} if isinstance(value, str) else value


# a section that a bare name may stand for is validated as Python data, where a strict tuple would be no list
LISTED = BeforeValidator(lambda value: tuple(value) if isinstance(value, list) else value)

Vector = Annotated[tuple[float, float, float], LISTED]
Component = Annotated[float, Field(ge=0)]
Positive = Annotated[float, Field(gt=0)]
Opacity = Annotated[float, Field(ge=0, le=1)]
Pixels = Annotated[int, Field(ge=1, le=2**15)]
