"""How methods and numbers look: the same everywhere in a report."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

MISSING = "–"
SUPERSCRIPTS = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


@dataclass(frozen=True)
class Look:
    """Colour on a light page, on a dark page, and matplotlib marker."""

    light: str
    dark: str
    marker: str


# After Okabe & Ito's palette, which readers with any colour vision can tell apart; markers tell the rest.
LOOKS: dict[str, Look] = {
    "nearest": Look("#4d4d4d", "#d0d0d0", "+"),
    "trilinear": Look("#7a7a7a", "#a8a8a8", "o"),
    "catmull-rom": Look("#4aa3d9", "#6bbcec", "s"),
    "ncrsi": Look("#d98c00", "#f0a92c", "^"),
    "triquadratic": Look("#0060a8", "#4f9be0", "D"),
    "notch": Look("#c44a00", "#f07a3a", "v"),
    "mitchell": Look("#b8608f", "#d98ab5", "P"),
    "tricubic": Look("#008060", "#2fb88f", "X"),
    "qss": Look("#a8336f", "#e070a4", "<"),
    "cubic-c1": Look("#6a3fb0", "#a98be6", "d"),
    "quadratic-c1": Look("#8a6d00", "#c9a81e", ">"),
}
OTHERS = (
    Look("#5b4b9a", "#9c8ee0", "*"),
    Look("#7a5c2e", "#c2a26b", "h"),
    Look("#a02040", "#e0607f", "p"),
)


def look(method: str) -> Look:
    """The look of a method; methods without one of their own share a few, chosen by name."""
    return LOOKS.get(method) or OTHERS[sum(method.encode()) % len(OTHERS)]


def label(record: Mapping[str, Any], *, gradient: bool = True) -> str:
    """A recipe in words, e.g. `triquadratic, no prefilter`; `gradient=False` where no gradient is shown."""
    parts = [str(record["method"])]
    if not record["prefilter"]:
        parts.append("no prefilter")
    if gradient and not record["default_gradient"]:
        parts.append({"central": "central differences", "analytic": "analytic gradient"}[record["gradient"]])
    if record.get("sampler", "exact") != "exact":
        parts.append("8-bit fractions")
    return ", ".join(parts)


def line_style(record: Mapping[str, Any]) -> dict[str, Any]:
    """matplotlib line properties of a recipe: filled and solid with its prefilter, hollow and dashed without."""
    own = look(str(record["method"]))
    plain = record["prefilter"] and record["default_gradient"]
    return {
        "color": own.light,
        "marker": own.marker,
        "linestyle": "-" if plain else "--" if not record["prefilter"] else ":",
        "markerfacecolor": own.light if plain else "none",
        "markeredgecolor": own.light,
        # another gradient kind often coincides with a default one: a wide ring shows around what lies on it
        "markersize": 5.0 if record["default_gradient"] else 9.0,
    }


def text(value: float | None, digits: int = 3) -> str:
    """A number with that many significant digits: 0.0448, 12.3, 4.90×10⁻⁶; a dash where there is none."""
    if value is None:
        return MISSING
    if value == 0:
        return "0"
    mantissa, exponent = f"{value:.{digits - 1}e}".split("e")
    power = int(exponent)
    if -4 < power < 5:
        return _minus(f"{value:.{max(digits - 1 - power, 0)}f}")
    return _minus(mantissa) + "×10" + str(power).translate(SUPERSCRIPTS)


def fixed(value: float | None, decimals: int = 2) -> str:
    """A number with that many decimals; a dash where there is none."""
    if value is None or not math.isfinite(value):
        return MISSING
    return _minus(f"{round(value, decimals) + 0.0:.{decimals}f}")  # + 0.0: no minus before a zero


def times(ratio: float | None) -> str:
    """A ratio as a factor: 12 ×, 1.08 ×, 0.46 ×, or 1/27 below a third; a dash where there is none."""
    if ratio is None or not math.isfinite(ratio) or ratio <= 0:
        return MISSING
    if ratio < 1 / 3:
        return f"1/{text(1 / ratio, 2)}"
    return f"{fixed(ratio) if ratio < 10 else text(ratio)} ×"


def memory(size: float | None) -> str:
    """Bytes in the unit that suits them: 14 KiB, 2.5 MiB."""
    if size is None:
        return MISSING
    power = min(max(int(math.log2(max(size, 1)) // 10), 0), 3)
    return f"{text(size / 2 ** (10 * power), 2 if size < 2 ** (10 * power) * 100 else 3)} {_UNITS[power]}"


_UNITS = ("B", "KiB", "MiB", "GiB")


def _minus(plain: str) -> str:
    return plain.replace("-", "−")
