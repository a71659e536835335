"""Casting rays at bilinear quadrilaterals in Triton: as `ops.cuda.quadrics`, with a program of their own."""

from __future__ import annotations

from torch import Tensor

from filterlab.ops.bilinear import BilinearQuads
from filterlab.ops.cuda.bilinear_hits import BilinearVariant
from filterlab.ops.cuda.quadrics import walked


def hits(
    given: BilinearQuads, origins: Tensor, directions: Tensor, sheets: int, farthest: bool = False
) -> tuple[Tensor, Tensor]:
    """`ops.reference.bilinear.hits`, fused."""
    return walked(given, BilinearVariant(given.kept(farthest)), origins, directions, sheets, farthest)
