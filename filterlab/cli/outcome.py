"""How a command ends: exit codes, and what is said of errors."""

from __future__ import annotations

import os
import re
import sys

OK, FAILED, USAGE, NOTHING_FITS, INTERRUPTED = 0, 1, 2, 3, 130


class UsageError(ValueError):
    """A command line that makes no sense: exit code 2."""


def unread() -> int:
    """How a command ends, quietly, whose output nobody reads any more, as in `filterlab methods | head -1`."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return FAILED


def message_of(error: ValueError | OSError) -> str:
    """The text of an error; for the operating system's own, what it says about which file."""
    from filterlab.io.atomic import disk_is_full

    if disk_is_full(error):
        where = f"cannot write {error.filename}: " if error.filename else ""  # type: ignore[union-attr]
        return f"{where}the disk is full ({error.strerror})"  # type: ignore[union-attr]
    if isinstance(error, OSError) and error.strerror:
        return f"{error.filename or ''}: {error.strerror}".removeprefix(": ")
    return str(error)


def out_of_memory(error: RuntimeError) -> bool:
    """Whether it is torch that could not allocate, on the CPU or on a device."""
    signs = ("can't allocate memory", "not enough memory", "out of memory", "Storage size calculation overflowed")
    return any(sign in str(error) for sign in signs)


def shortage(error: RuntimeError) -> str:
    asked = re.search(r"[Tt]ried to allocate ([\d.]+ \w+)", str(error))
    return f"torch could not get another {asked[1]}" if asked else first_line(error)


def first_line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
