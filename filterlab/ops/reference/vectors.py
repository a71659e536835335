"""Facts about vectors, in plain torch."""

from __future__ import annotations

import torch
from torch import Tensor

from filterlab.ops.vectors import Facts


def facts(vectors: Tensor) -> Facts:
    """Of vectors (..., 3) of floating-point numbers; a GPU is waited for twice, more often where a component is 0."""
    x = vectors.detach()
    if not x.numel():
        return Facts(0.0, False)
    low, high = torch.stack(x.aminmax()).tolist()
    some_zero = int(x.count_nonzero()) < x.numel()
    return Facts(max(abs(low), abs(high)), some_zero and bool((x == 0).all(-1).any()))
