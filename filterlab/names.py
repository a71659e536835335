"""Names that functions, scenes and commands take, for those who have to know them before torch is there.

`METHODS` and `BOUNDARIES` are the keys of `filterlab.methods.METHODS` and the values of `filterlab.volume.Boundary`.
"""

from __future__ import annotations

import difflib
import sys
from collections.abc import Iterable
from typing import Literal, get_args

METHODS = (
    *("nearest", "trilinear", "catmull-rom", "ncrsi", "triquadratic", "notch", "mitchell", "tricubic"),
    *("qss", "cubic-c1", "quadratic-c1"),
)
BOUNDARIES = ("mirror", "reflect", "wrap", "border", "zeros")

NanChoice = Literal["refuse", "propagate", "fill"]
NAN_CHOICES: tuple[str, ...] = get_args(NanChoice)

SPLINES = ("linear", "c0", "c1", "c2")
"""Of heights: the keys of `filterlab.surfaces.quartic.SPLINES`."""

TASKS = ("resample", "dvr", "isosurface")
"""What a method is recommended for."""


def methods() -> tuple[str, ...]:
    """The methods that there are, own ones too where a program has registered some."""
    loaded = sys.modules.get("filterlab.methods")
    return METHODS if loaded is None else tuple(loaded.METHODS)


def unknown_name(what: str, name: object, known: Iterable[str], alike: float = 0.5) -> str:
    """The message for a name that nobody knows: "unknown method 'noch'; did you mean 'notch'? known methods: …".

    `alike` is how similar a name has to be for that, 0 … 1, as difflib measures it.
    """
    known = [str(k) for k in known]
    close = difflib.get_close_matches(str(name).lower(), known, n=1, cutoff=alike)
    hint = f"did you mean {close[0]!r}? " if close else ""
    return f"unknown {what} {shown(name)}; {hint}known {what}s: {', '.join(known) or '(none)'}"


def shown(value: object) -> str:
    """A value of a configuration as a message shows it, in 80 characters at most."""
    if isinstance(value, dict):
        return f"a section with the keys {', '.join(value)}"[:80] if value else "an empty section"
    text = "nothing" if value is None else str(value).lower() if isinstance(value, bool) else repr(value)
    return text if len(text) <= 80 else text[:77] + "..."
