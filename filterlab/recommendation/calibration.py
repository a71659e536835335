"""How far a signal is from its best estimate, in units of what two estimates of it differ by.

Letters: u the RMS difference of two splines, φ the fall of the spectrum towards the Nyquist frequency, decibels. A true
error t is set against the distance d that was measured from the estimate: c and C are such that

    d − c u ≤ t ≤ √(d² + (C u)²)

fails below and above in one of twenty cases each, where u counts at all (u > d / 20). They are quantiles over methods,
boundaries and volumes of known truth near each φ: those of the tuning half of the experiment `recommend_validation`,
whose report shows them anew, and how often they held on the other half. Where the spectrum falls steeply, the estimate
is off by about u; where it does not fall, as with steps, noise and fractals, by several times u.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import lru_cache

import numpy as np

FALLS = (0.0, 1.0, 2.0, 4.0, 8.0, 14.0, 24.0, 40.0)
"""φ at which factors are known; in between they are linear, beyond constant."""

CALIBRATION: Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]] = {
    "value": ((1.0, 0.7, 0.5, 0.8, 1.7, 1.5, 1.0, 0.8), (5.6, 5.7, 5.2, 4.0, 2.3, 1.7, 1.3, 0.9)),
    "gradient": ((1.0, 0.7, 0.5, 0.8, 1.7, 1.5, 1.0, 0.8), (5.6, 7.0, 5.6, 5.0, 2.6, 1.6, 1.2, 0.9)),
    "bend": ((2.0, 2.0, 2.0, 2.0, 2.0, 2.0, 1.5, 1.5), (15.0, 15.0, 8.0, 6.0, 3.0, 2.5, 2.5, 2.0)),
}
"""Of values, gradients and second derivatives along lines: c and C at each of `FALLS`."""


@lru_cache(maxsize=1024)
def factors(quantity: str, fall: float) -> tuple[float, float]:
    """(c, C) at φ."""
    least, most = CALIBRATION[quantity]
    return float(np.interp(fall, FALLS, least)), float(np.interp(fall, FALLS, most))
