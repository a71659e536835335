"""Imports of much at once, as commands need them to answer soon."""

from __future__ import annotations

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager


@contextmanager
def importing() -> Iterator[None]:
    """What is imported within is not looked through for cycles, neither meanwhile nor later.

    Modules stay to the end: each search for cycles among what they made, 300,000 objects of torch and pydantic, finds
    nothing. With such searches importing takes a ninth longer, and a small render in all a third (4.8 s for 3.6).
    Only a command may decide that for a process.
    """
    if not gc.isenabled():  # within another, or as whoever started this process wishes
        yield
        return
    known = len(sys.modules)
    gc.disable()
    try:
        yield
        if len(sys.modules) > known:
            gc.freeze()
    finally:
        gc.enable()
