"""Colours as scenes write them: linear RGB, or by name or hexadecimal as CSS does.

Numbers are linear light, in which everything is computed. Names and `#rrggbb` are what they are everywhere else,
colours of a screen, encoded by sRGB; they are decoded here, so that an unlit, opaque colour has just these digits in
the picture.
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Mapping
from typing import Annotated, Any

import torch
from PIL import ImageColor
from pydantic import BeforeValidator

from filterlab.io.images import from_srgb
from filterlab.scenes.model.quantities import Component, Told

HEXADECIMAL = re.compile(r"#([0-9a-fA-F]{3,4}|[0-9a-fA-F]{6}|[0-9a-fA-F]{8})")
SPELLED = "a colour: linear [r, g, b] ≥ 0, a CSS name like tomato, or '#rgb', '#rrggbb', '#rrggbbaa' in quotes"


def parsed(text: str) -> tuple[tuple[float, float, float], float]:
    """(linear RGB, opacity) of a CSS name or a hexadecimal colour; without digits of its own the opacity is 1.

    Raises:
        ValueError: neither, with the nearest name.

    Source: CSS Color Module Level 4, sections 5.2 and 6.1.
    """
    if not HEXADECIMAL.fullmatch(text) and text.lower() not in ImageColor.colormap:
        close = difflib.get_close_matches(text.lower(), ImageColor.colormap, n=1, cutoff=0.5)
        hint = f"; did you mean {close[0]!r}?" if close else ""
        raise ValueError(f"expected {SPELLED}; got {text!r}{hint}")
    red, green, blue, alpha = (*ImageColor.getrgb(text), 255)[:4]
    linear = from_srgb(torch.tensor((red, green, blue), dtype=torch.float64) / 255)
    return tuple(linear.tolist()), alpha / 255


def linear_rgb(value: Any) -> Any:
    """The colour as three numbers where it is a text. Raises ValueError for one with an opacity, which has no use."""
    if value is None:
        raise ValueError(f"expected {SPELLED}; got nothing (# begins a comment unless it stands in quotes)")
    if not isinstance(value, str):
        return tuple(value) if isinstance(value, list) else value
    color, opacity = parsed(value)
    if opacity != 1:
        raise ValueError(f"expected a colour without an opacity here; got {value!r}")
    return color


def with_opacity(section: Any, key: str) -> Any:
    """A section whose `color` may bring its opacity, `#rrggbbaa`: that becomes the section's `key`.

    Raises ValueError where the section has both.
    """
    color = section.get("color") if isinstance(section, Mapping) else None
    if not isinstance(color, str) or not re.fullmatch("#(.{4}|.{8})", color):
        return section
    linear, opacity = parsed(color)
    if key in section:
        raise ValueError(f"expected the opacity once; got {color!r} and {key}: {section[key]}")
    return {**section, "color": linear, key: opacity}


Color = Annotated[tuple[Component, Component, Component], BeforeValidator(linear_rgb), Told("[colour](#colours)")]
