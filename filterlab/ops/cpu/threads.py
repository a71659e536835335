"""Runs a compiled kernel on as many threads as torch uses. The kernel itself hands out the chunks."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from typing import Any

from filterlab.ops.cpu.compiler import Function

Job = Any  # a ctypes.Structure with the fields `next` (the chunk to be taken next) and `chunks` (where it stops)

MOST = 1024  # threads; they start when they are first needed


def _new_pool() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(MOST, thread_name_prefix="filterlab")


_pool = _new_pool()


def run(function: Function, jobs: Sequence[Job]) -> None:
    """Call `function` with every job, the first one here, the others on threads; a job given twice is shared."""
    addresses = [ctypes.addressof(job) for job in jobs]
    helpers: list[Future[None]] = []
    try:
        for address in addresses[1:]:
            helpers.append(_pool.submit(function, address))  # noqa: PERF401 (all that started are waited for)
    except RuntimeError:  # the interpreter is shutting down: this thread does it all
        pass
    try:
        for address in addresses:  # whatever the helpers have not taken, too
            function(address)
    finally:  # nobody may still be at work when the arrays go: not even after Ctrl-C
        for job in jobs:
            job.next = job.chunks
        if helpers:
            wait(helpers)


def _forget_pool() -> None:
    """A fork of this process has none of its threads."""
    global _pool
    _pool = _new_pool()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget_pool)
