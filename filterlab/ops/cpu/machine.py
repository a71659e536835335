"""What this machine has: lanes of a register, threads worth waking."""

from __future__ import annotations

from functools import cache

import torch

from filterlab.ops.cpu.compiler import features

CHUNKS_PER_THREAD = 16
"""So that a thread that is held up leaves its share to the others."""

MOST_POINTS = 1 << 16
"""Of a chunk, times channels: between two of them Ctrl-C is heard."""


@cache
def lanes_of(dtype: torch.dtype) -> int:
    """P: 8 floats or 4 doubles; twice as many with AVX-512.

    Measured with AVX2 (Zen 3), where 8 floats fill a register: 16 lanes need two, the weights of a 3×3×3 kernel no
    longer fit and jets become 1.0 to 1.5 times, splats 1.3 to 1.9 times as slow.
    """
    return (64 if "avx512f" in features() else 32) // dtype.itemsize


def threads_for(count: int, least: int) -> int:
    """As many threads as torch uses, but each with `least` of `count` things to do or more; at least one."""
    worth = count // least
    return min(torch.get_num_threads(), worth) if worth > 1 else 1
