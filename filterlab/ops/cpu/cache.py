"""Compiled programs on disk: written once, read in milliseconds, never trusted blindly.

A file is a SHA-256 of its name and content, then the content. It appears under its name in one step (written beside it,
then renamed), so that processes that compile the same program at the same time each find nothing or all of it. A file
that is truncated, damaged, of another name or somebody else's counts as absent and is written anew.

Machine code is run, so what others could have put there is not read. The folder and the file are opened first, then
asked, so that nobody can exchange them in between:

    folder    of this user or root, writable by nobody else. The folders above and links to it do not matter: who can
              write there can put another folder in its place, but none of this user's that others can write
    file      no link, a regular file, of this user or root, writable by nobody else, at most `LARGEST` bytes

Where that does not hold, or nothing can be written (a read-only or missing home), programs live in memory only. Where
files have no owner and folders can't be opened (Windows), the kind and the size of a file are all that is looked at.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import secrets
import stat
import sys
from collections.abc import Callable, Iterator
from pathlib import Path

VARIABLE = "FILTERLAB_CACHE"
LARGEST = 1 << 25  # bytes of a file; programs have some 10⁵

_CAUTIOUS = sum(getattr(os, name, 0) for name in ("O_NOFOLLOW", "O_NONBLOCK", "O_BINARY"))  # a pipe must not block
_OTHERS = stat.S_IWGRP | stat.S_IWOTH


def folder() -> Path | None:
    """$FILTERLAB_CACHE, else the user's cache folder for this platform; None where there is no home."""
    if chosen := os.environ.get(VARIABLE):
        return Path(chosen)
    if sys.platform == "win32":
        base = os.environ.get("LOCALAPPDATA")
    elif not (base := os.environ.get("XDG_CACHE_HOME")):
        with contextlib.suppress(RuntimeError):
            base = str(Path.home() / ("Library/Caches" if sys.platform == "darwin" else ".cache"))
    return Path(base) / "filterlab" / "programs" if base else None


def read(name: str) -> bytes | None:
    """The content stored under a name; None when there is none or it can't be trusted."""
    where = folder()
    if where is None:
        return None
    try:
        with _entered(where) as (path, within), _opened(path / name, os.O_RDONLY, within) as handle:
            _check(os.fstat(handle), stat.S_ISREG)
            with os.fdopen(handle, "rb", closefd=False) as file:
                digest, content = file.read(32), file.read(LARGEST)
    except OSError:
        return None
    return content if _digest(name, content) == digest else None


def write(name: str, content: bytes) -> None:
    """Store the content under a name, or quietly nothing where nothing can be written."""
    where = folder()
    if where is None or len(content) > LARGEST - 32:
        return
    with contextlib.suppress(OSError):
        where.mkdir(mode=0o700, parents=True, exist_ok=True)
        with _entered(where) as (path, within):
            _write(path / name, _digest(name, content) + content, within)


def _write(path: Path, content: bytes, within: int | None) -> None:
    temporary = path.with_name(f"{secrets.token_hex(16)}.part")
    try:
        flags = os.O_WRONLY | os.O_CREAT | os.O_EXCL
        with _opened(temporary, flags, within) as handle, os.fdopen(handle, "wb", closefd=False) as file:
            file.write(content)
        os.replace(temporary, path, src_dir_fd=within, dst_dir_fd=within)
    except BaseException:
        with contextlib.suppress(OSError):
            os.unlink(temporary, dir_fd=within)
        raise


def _digest(name: str, content: bytes) -> bytes:
    return hashlib.sha256(f"{name}\0".encode() + content).digest()


@contextlib.contextmanager
def _entered(where: Path) -> Iterator[tuple[Path, int | None]]:
    """What paths in the folder begin with, and what they are relative to. PermissionError: it can't be trusted."""
    if os.open not in os.supports_dir_fd:
        yield where, None
        return
    with _opened(where, os.O_RDONLY | os.O_DIRECTORY, follow=True) as handle:
        _check(os.fstat(handle), stat.S_ISDIR)
        yield Path(), handle


@contextlib.contextmanager
def _opened(path: Path, flags: int, within: int | None = None, follow: bool = False) -> Iterator[int]:
    cautious = _CAUTIOUS & ~getattr(os, "O_NOFOLLOW", 0) if follow else _CAUTIOUS
    handle = os.open(path, flags | cautious, 0o600, dir_fd=within)
    try:
        yield handle
    finally:
        os.close(handle)


def _check(status: os.stat_result, kind: Callable[[int], bool]) -> None:
    """PermissionError unless it is of that kind, of a fair size, and nobody's but ours to write."""
    own = not hasattr(os, "geteuid") or (status.st_uid in (os.geteuid(), 0) and not status.st_mode & _OTHERS)
    if not (own and kind(status.st_mode) and status.st_size <= LARGEST):
        raise PermissionError("others may have written it")
