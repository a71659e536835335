"""How far a signal is from its best estimate, in units of what two estimates of it differ by.

Letters: u the RMS difference of two splines, φ the fall of the spectrum towards the Nyquist frequency, decibels. A true
error t is set against the distance d that was measured from the estimate: c and C are such that

    d − c u ≤ t ≤ √(d² + (C u)²)

fails below and above in three of a hundred cases each, where u counts at all (u > d / 20), and L, in place of C, in
fifteen. They are quantiles over methods, boundaries and volumes of known truth near each φ: those of the tuning half of
the experiment `recommend_validation`, whose report shows them anew, and how often they held on the other half. Where
the spectrum falls steeply, the estimate is off by about u; where it does not fall, as with steps, noise and fractals,
by several times u.

Recommended is what stays within the budget by L. Most picks are nowhere near their budget, so that 99 in 100 keep it;
by C all did, and one refusal in fourteen was of a budget that something met.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import numpy as np

FALLS = (0.0, 1.0, 2.0, 4.0, 8.0, 14.0, 24.0, 40.0)
"""φ at which factors are known; in between they are linear, beyond constant."""

CALIBRATION: Mapping[str, tuple[tuple[float, ...], tuple[float, ...], tuple[float, ...]]] = {
    "value": (
        (1.07, 0.98, 0.31, 1.12, 1.05, 0.93, 0.93, 0.87),
        (5.75, 5.72, 5.54, 4.00, 3.25, 1.49, 0.84, 0.78),
        (5.02, 5.07, 4.86, 2.66, 2.35, 0.75, 0.70, 0.14),
    ),
    "gradient": (
        (0.88, 0.86, 0.32, 1.20, 1.15, 0.88, 0.81, 0.72),
        (7.84, 9.93, 9.97, 6.17, 3.83, 1.44, 0.90, 0.53),
        (5.52, 6.40, 5.82, 3.51, 2.67, 0.84, 0.70, 0.00),
    ),
    "bend": (
        (3.95, 3.61, 0.14, 0.61, 0.65, 0.56, 0.36, 0.13),
        (13.23, 18.61, 19.64, 11.06, 6.84, 2.48, 2.41, 1.87),
        (7.51, 8.81, 10.23, 5.45, 3.43, 1.40, 1.51, 1.40),
    ),
}
"""Of values, gradients and second derivatives along lines: c, C and L at each of `FALLS`."""

SURFACE: Mapping[str, tuple[float, float, float]] = {"value": (1.33, 1.26, 1.0), "gradient": (1.56, 1.32, 1.0)}
"""By what c, C and L are multiplied where errors are those on a surface: it is a smaller part of a volume, and where it
is an edge, the estimates of the signal are off to the same side all along it."""


@lru_cache(maxsize=1024)
def factors(quantity: str, fall: float, on_surface: bool = False) -> tuple[float, ...]:
    """(c, C, L) at φ."""
    found = (float(np.interp(fall, FALLS, known)) for known in CALIBRATION[quantity])
    return tuple(f * g for f, g in zip(found, SURFACE[quantity] if on_surface else (1.0, 1.0, 1.0), strict=True))
