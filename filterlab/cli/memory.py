"""What a command may take of the machine's memory."""

from __future__ import annotations

import math
import os
import sys
from collections.abc import Sequence


def limit_in_bytes(gigabytes: float) -> int:
    """Bytes that one volume may take."""
    if not 0 < gigabytes < math.inf:  # a NaN fails too
        raise ValueError(f"expected --max-gigabytes to be a positive number; got {gigabytes}")
    return int(min(gigabytes * 2**30, sys.maxsize))  # beyond that there is nothing to limit


def check_memory(shape: Sequence[float], itemsize: int, limit: int) -> None:
    """Raises ValueError for a result (N, C and voxels along x, y, z) above the limit or what the machine has."""
    needed = math.prod(shape) * itemsize
    got = f"{' × '.join(f'{n:.6g}' for n in shape)} voxels of {itemsize} bytes, {needed / 2**30:.3g} GiB"
    if needed > limit:
        raise ValueError(f"expected a result of at most {limit / 2**30:g} GiB (--max-gigabytes); got {got}")
    if needed > (installed := _installed_memory()):
        raise ValueError(f"expected a result that fits in the {installed / 2**30:.3g} GiB of this machine; got {got}")


def as_float(n: int) -> float:
    """The number; ∞ for one that is beyond all floats."""
    try:
        return float(n)
    except OverflowError:
        return math.inf


def _installed_memory() -> float:
    """Bytes of main memory; ∞ where the system does not tell."""
    try:
        return float(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES"))
    except (AttributeError, OSError, ValueError):
        return math.inf
