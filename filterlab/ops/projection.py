"""Maximum intensity projection, described: which sample along a ray is the largest.

Samples are taken in the middles of segments (`ops.reference.march.segments`), as a march takes them. The answer is a
number, which has no derivative; the value there has, as any sample of a field.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from filterlab.ops.march import Chords
from filterlab.ops.tetrahedra import AnyStencil


@dataclass(frozen=True)
class Projection:
    """R rays through coefficients.

    Attributes:
        coefficients: (D, H, W), of any dtype of `ops.gather.STORAGE`.
        start: the coordinate of coefficient 0.
        stencil: its first row is the value.
        chords: in coordinates of the coefficients, as those of a `March`.
        step: world length of a segment.
        dtype: of the samples, float32 or float64.
    """

    coefficients: Tensor
    start: int
    stencil: AnyStencil
    chords: Chords
    step: float
    dtype: torch.dtype
