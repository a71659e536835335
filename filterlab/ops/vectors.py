"""What is asked of vectors before anything is computed of them, described: are all numbers finite, is any vector 0.

    greatest = max |x_k|      none = any x = 0

`ops.reference.vectors` says how; a program makes one pass over them, with all threads.
"""

from __future__ import annotations

import math
from typing import NamedTuple


class Facts(NamedTuple):
    """What is known of some vectors.

    Attributes:
        greatest: |x| of the greatest component; ∞ or NaN where one is not finite, 0 of no vectors.
        none: whether any vector is 0.
    """

    greatest: float
    none: bool

    @property
    def finite(self) -> bool:
        """Whether all numbers are."""
        return math.isfinite(self.greatest)
