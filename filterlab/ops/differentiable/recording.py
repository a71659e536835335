"""Whether anything has to be recorded for derivatives.

What is asked is looked up, never switched: torch's grad mode is left as it is, since Ctrl-C between the lines of
`torch.no_grad` would leave it off for good. Where nothing requires a gradient, nothing is recorded in any mode.
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.autograd import forward_ad


def plain(*tensors: Tensor) -> bool:
    """True when no derivative of any kind is asked: autograd.Function's own 0.1 ms can be saved."""
    for tensor in tensors:  # `any` of a generator takes three times as long, and this is asked at every call
        if tensor.requires_grad:
            return False
    return not transformed()


def transformed() -> bool:
    """True inside a transform: vmap, jvp and the like, forward mode, torch.compile."""
    return torch.compiler.is_compiling() or transforming()


def transforming() -> bool:
    """The same but for torch.compile."""
    return torch._C._are_functorch_transforms_active() or forward_ad._current_level >= 0
