"""How far the reading or writing of a file is, for whoever waits: readers and writers tell, `watched` listens."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar

_listener: ContextVar[Callable[[float], None] | None] = ContextVar("listener", default=None)


@contextmanager
def watched(progress: Callable[[float], None]) -> Iterator[None]:
    """Within it, what is read or written tells which part is done, 0 … 1."""
    token = _listener.set(progress)
    try:
        yield
    finally:
        _listener.reset(token)


def tell_done(part: float) -> None:
    """Tells which part of a volume's samples is read or written."""
    if (progress := _listener.get()) is not None:
        progress(part)
