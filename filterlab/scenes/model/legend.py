"""The legend of a picture."""

from __future__ import annotations

from filterlab.render.legend import Side
from filterlab.scenes.model.quantities import Switched


class LegendModel(Switched):
    """A bar of the colours and their values beside the picture, which it makes larger; `true` stands for all defaults.

    Along the bar stands how opaque the values of a medium are: the square root of their part of the largest opacity.
    """

    examples = ("true", "{side: below, label: density in HU}")

    side: Side = "right"
    """Where it is."""
    label: str = ""
    """Of the values: what they are, and their unit."""
