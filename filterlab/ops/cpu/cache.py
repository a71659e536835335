"""Compiled kernels on disk: written once, read in milliseconds, never trusted blindly.

A file is a SHA-256 of its content, then the content. It appears under its name in one step (written beside it, then
renamed), so that processes that compile the same kernel at the same time each find nothing or all of it. A file that is
truncated, damaged or somebody else's counts as absent and is written anew. Where nothing can be written (a read-only or
missing home), kernels live in memory only.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import sys
import tempfile
from pathlib import Path

VARIABLE = "FILTERLAB_CACHE"


def folder() -> Path | None:
    """$FILTERLAB_CACHE, else the user's cache folder for this platform; None where there is no home."""
    if chosen := os.environ.get(VARIABLE):
        return Path(chosen)
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA")
    elif not (base := os.environ.get("XDG_CACHE_HOME")):
        with contextlib.suppress(RuntimeError):
            base = str(Path.home() / ("Library/Caches" if sys.platform == "darwin" else ".cache"))
    return Path(base) / "filterlab" / "kernels" if base else None


def read(name: str) -> bytes | None:
    """The content stored under a name; None when there is none or it can't be trusted."""
    where = folder()
    if where is None:
        return None
    try:
        with open(where / name, "rb") as file:
            if hasattr(os, "getuid") and os.fstat(file.fileno()).st_uid not in (os.getuid(), 0):
                return None  # machine code of another user is not run
            digest, content = file.read(32), file.read()
    except OSError:
        return None
    return content if hashlib.sha256(content).digest() == digest else None


def write(name: str, content: bytes) -> None:
    """Store the content under a name, or quietly nothing where nothing can be written."""
    where = folder()
    if where is None:
        return
    temporary = None
    try:
        where.mkdir(mode=0o700, parents=True, exist_ok=True)
        handle, temporary = tempfile.mkstemp(prefix=name, suffix=".part", dir=where)
        with os.fdopen(handle, "wb") as file:
            file.write(hashlib.sha256(content).digest() + content)
        os.replace(temporary, where / name)
    except OSError:
        if temporary is not None:
            with contextlib.suppress(OSError):
                os.unlink(temporary)
