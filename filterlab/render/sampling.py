"""How a picture is sampled: everything about an image that is neither what it shows nor where it is seen from."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import SupportsFloat, SupportsIndex

import torch

MOST_SEGMENTS = 2.0**62
"""Of a ray, that can be counted; no limit on the number of samples is as high."""


@dataclass(frozen=True)
class Sampling:
    """How rays are sampled; see `render`, whose arguments these are.

    Attributes:
        step: in voxels of the field (its `domain.voxel_size`).
        jitter_seed: moves the segments of every pixel by its own fraction of a step; None: not.
        termination: a ray stops when no more than this much can change; None: only behind what is exactly opaque.
        dtype: float32 or float64, of samples and image.
        max_samples: images of more samples are refused.
        memory: bytes that rays and samples in work may take, roughly.

    Raises:
        ValueError: a number out of range.
    """

    step: float = 0.5
    jitter_seed: int | None = None
    termination: float | None = None
    dtype: torch.dtype = torch.float32
    max_samples: int = 2**34
    memory: int = 2**28

    def __post_init__(self) -> None:
        if not 0 < _number(self.step) < math.inf:
            raise ValueError(f"step must be a positive number of voxels; got {self.step!r}")
        if self.termination is not None and not 0 < _number(self.termination) < 1:
            raise ValueError(f"termination must be a transmittance between 0 and 1, or None; got {self.termination!r}")
        if self.dtype not in (torch.float32, torch.float64):
            raise ValueError(f"dtype must be torch.float32 or torch.float64; got {self.dtype}")
        if not _number(self.max_samples) > 0:
            raise ValueError(f"max_samples must be a positive number; got {self.max_samples!r}")
        if not isinstance(self.memory, SupportsIndex) or self.memory <= 0:
            raise ValueError(f"memory must be a positive whole number of bytes; got {self.memory!r}")

    def step_in(self, voxel_size: float) -> float:
        """The step as a world length. Raises ValueError where float64 has none."""
        length = float(self.step) * voxel_size
        if not length > 0:
            raise ValueError(f"step must be a world length in float64; got {self.step!r} voxels of {voxel_size:g}")
        return length

    def check_count(self, total: float) -> int:
        """That many samples of all images together. Raises ValueError above `max_samples`."""
        if not total <= self.max_samples:
            more = "more than " if total >= MOST_SEGMENTS else ""
            raise ValueError(
                f"the image would take {more}{total:.3g} samples; the limit is max_samples={self.max_samples:.3g}: "
                "use a longer step, a smaller image or region, or raise max_samples"
            )
        return int(total)


def _number(value: object) -> float:
    """The value as one number; NaN where it is none."""
    try:
        return float(value) if isinstance(value, SupportsFloat) else math.nan
    except (TypeError, ValueError, ArithmeticError, RuntimeError):  # a tensor of several, an integer beyond all floats
        return math.nan
