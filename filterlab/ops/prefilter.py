"""The prefilter, described: from samples to coefficients by the recursions of `prefilters`, along some axes."""

from __future__ import annotations

from dataclasses import dataclass

from filterlab.prefilters import Prefilter
from filterlab.volume import Boundary

VOLUME = (-3, -2, -1)
"""The axes of a volume."""


@dataclass(frozen=True)
class Filtering:
    """What is done to samples.

    Attributes:
        dims: the axes that are filtered: all of `VOLUME` or a single one, negative, as a batch may stand before.
        prefilter, boundary: how.
        tail: coefficients beyond each end; negative: that many fewer.
    """

    dims: tuple[int, ...]
    prefilter: Prefilter
    boundary: Boundary
    tail: int
