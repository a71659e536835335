"""The prefilter, described: from samples to coefficients by the recursions of `prefilters`, along some axes."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import torch
from torch import Tensor

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

    def places(self, n: int, before: int, behind: int, device: torch.device | None = None) -> Tensor:
        """Of n samples the one at each place from −tail−before to n−1+tail+behind of the extended line; −1: a zero."""
        return _places(self.boundary, n, self.tail + before, self.tail + behind, device)


@lru_cache(maxsize=128)
def _places(boundary: Boundary, n: int, before: int, behind: int, device: torch.device | None) -> Tensor:
    index = torch.arange(-before, n + behind)
    sources = boundary.source(index, n)
    if boundary is Boundary.ZEROS:
        sources = torch.where((index >= 0) & (index < n), sources, -1)
    return sources.to(device)  # which waits until they are there: any stream may read them
