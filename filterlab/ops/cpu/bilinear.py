"""Casting rays at bilinear quadrilaterals as vector code: as `ops.cpu.quadrics`, with a program of their own."""

from __future__ import annotations

from torch import Tensor

from filterlab.ops.bilinear import BilinearQuads
from filterlab.ops.cpu.bilinear_hits import BilinearVariant
from filterlab.ops.cpu.quadrics import has_fma, walked


def hits(
    given: BilinearQuads, origins: Tensor, directions: Tensor, sheets: int, farthest: bool = False
) -> tuple[Tensor, Tensor]:
    """`ops.reference.bilinear.hits`, fused."""
    variant = BilinearVariant(given.kept(farthest), farthest, has_fma())
    return walked(given, variant, origins, directions, sheets, farthest)
