"""What must be whole in a forked child: a fork waits until no thread is in the middle of it.

A child has one thread, the one that forked. What another one held at that moment, it holds there for ever: a lock, a
module half imported, a compiler half way through a program. So all of that happens with `lock` held, and a fork takes
`lock` first: it waits for a compilation, a second or so, and the child finds everything as between two.
"""

from __future__ import annotations

import contextlib
import os
import sys
from contextlib import AbstractContextManager
from functools import cached_property
from threading import RLock

lock = RLock()
"""Held by whoever does what a fork must not cut in two."""

gate = RLock()
"""Passed before `lock` is taken by those who take it often, else a fork might never get it. A fork holds both."""


others: list[AbstractContextManager] = []
"""Locks of libraries, taken after `lock` by who holds that."""


def _before() -> None:
    gate.acquire()
    lock.acquire()
    for other in others:
        other.__enter__()


def _after_in_parent() -> None:
    for own in (*others[::-1], lock, gate):
        with contextlib.suppress(RuntimeError):  # something was raised while it was waited for: it is not ours
            own.__exit__(None, None, None)


def _after_in_child() -> None:
    global lock, gate
    _after_in_parent()
    lock, gate = RLock(), RLock()
    if sys.version_info < (3, 12):
        _free_properties()


def _free_properties() -> None:
    """Before Python 3.12 a `cached_property` has a lock, one for all objects of its class."""
    for module in [m for name, m in sys.modules.items() if name.partition(".")[0] == __package__]:
        for kind in [kind for kind in vars(module).values() if isinstance(kind, type)]:
            for found in vars(kind).values():
                if isinstance(found, cached_property):
                    found.lock = RLock()  # type: ignore[attr-defined]


if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_before, after_in_parent=_after_in_parent, after_in_child=_after_in_child)
