"""The legend of a picture."""

from __future__ import annotations

from typing import Any

from pydantic import model_validator

from filterlab.render.legend import Side
from filterlab.scenes.model.quantities import Section


class LegendModel(Section):
    """A bar of the colours and their values beside the picture, which it makes larger; `true` stands for all defaults.

    Along the bar stands how opaque the values of a medium are: the square root of their part of the largest opacity.
    """

    examples = ("true", "{side: below, label: density in HU}")

    side: Side = "right"
    """Where it is."""
    label: str = ""
    """Of the values: what they are, and their unit."""

    @model_validator(mode="before")
    @classmethod
    def _from_true(cls, value: Any) -> Any:
        return {} if value is True else value
