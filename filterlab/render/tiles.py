"""The order in which the pixels of an image are marched: tile by tile, so that rays near each other follow each other.

They read the same coefficients, which are in the cache then. The image does not depend on the order.
"""

from __future__ import annotations

import torch
from torch import Tensor

_EDGES = (16, 4)  # pixels of a tile, and of the smaller ones it is made of


def tiled(height: int, width: int, device: torch.device) -> Tensor:
    """The pixel numbers y · width + x of an image, `(height · width,)`, tile by tile; those at the edges are cut."""
    edge, small = _EDGES
    rows, columns = -(-height // edge), -(-width // edge)
    y = torch.arange(rows * edge, device=device).view(rows, 1, edge // small, 1, small, 1)
    x = torch.arange(columns * edge, device=device).view(1, columns, 1, edge // small, 1, small)
    numbers = (y * width + x).flatten()
    if height % edge or width % edge:
        numbers = numbers[((y < height) & (x < width)).flatten()]
    return numbers


def tiled_part(height: int, width: int, first: int, last: int, device: torch.device) -> Tensor:
    """`tiled(height, width, device)[first:last]`, of which only the rows of tiles that are touched are made."""
    row = _EDGES[0] * width  # pixels
    top = first // row * _EDGES[0]
    bottom = min(-(-last // row) * _EDGES[0], height)
    return tiled(bottom - top, width, device)[first - top * width : last - top * width] + top * width
