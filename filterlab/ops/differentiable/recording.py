"""Whether anything has to be recorded for derivatives."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

import torch
from torch import Tensor
from torch.autograd import forward_ad


def plain(*tensors: Tensor) -> bool:
    """True when no derivative of any kind is asked: autograd.Function's own 0.1 ms can be saved."""
    return not (any([t.requires_grad for t in tensors]) or transformed())  # noqa: C419 (a list is half as long as a generator)


def transformed() -> bool:
    """True inside a transform: vmap, jvp and the like, forward mode, torch.compile."""
    return transforming() or torch.compiler.is_compiling()


def transforming() -> bool:
    """The same but for torch.compile."""
    return torch._C._are_functorch_transforms_active() or forward_ad._current_level >= 0


_modes = threading.local()  # in its list, one mark for everybody who has changed the grad mode


@contextmanager
def differentiating(on: bool) -> Iterator[None]:
    """torch's grad mode, put back in any case.

    `torch.no_grad` leaves it off for good when Ctrl-C comes between its first line and the block. This generator, left
    behind there, is closed with the exception; and whoever is around it has put the mode back by then, marks included.
    """
    before, mark, marks = torch.is_grad_enabled(), object(), _modes.__dict__.setdefault("marks", [])
    try:
        marks.append(mark)
        torch._C._set_grad_enabled(on)
        yield
    finally:
        if mark in marks:
            torch._C._set_grad_enabled(before)
            del marks[marks.index(mark) :]
