"""Files that appear whole or not at all: written under a temporary name, then renamed."""

from __future__ import annotations

import errno
import os
import re
import shutil
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def check_writable(path: str | os.PathLike[str]) -> Path:
    """The path, once it is known that a file can be created there. Call it before long work begins.

    Raises:
        FileNotFoundError, NotADirectoryError, IsADirectoryError, PermissionError: what is wrong with the place.
    """
    path = Path(path)
    _check_place(path)
    if path.is_dir():
        raise IsADirectoryError(f"cannot write {path}: expected a file name; got a folder")
    if path.exists() and not os.access(path, os.W_OK):
        raise PermissionError(
            f"cannot write {path}: expected a file that may be replaced; got one that is write-protected"
        )
    return path


def check_new_folder(path: str | os.PathLike[str]) -> Path:
    """The path, once it is known that a folder can be made there; one that is empty may be there already.

    Raises:
        FileExistsError, and what `check_writable` raises: what is wrong with the place.
    """
    path = Path(path)
    _check_place(path)
    if path.exists() and not path.is_dir():
        raise FileExistsError(f"cannot write {path}: expected a new or an empty folder; got a file")
    if path.is_dir() and any(path.iterdir()):
        raise FileExistsError(f"cannot write {path}: expected a new or an empty folder; got one with files in it")
    return path


def _check_place(path: Path) -> None:
    """Raises OSError unless a name can be made there."""
    folder = Path(os.path.realpath(path)).parent
    if not folder.exists():
        raise FileNotFoundError(f"cannot write {path}: expected an existing folder; got {folder}, which does not exist")
    if not folder.is_dir():
        raise NotADirectoryError(f"cannot write {path}: expected a folder; got {folder}, which is a file")
    if not os.access(folder, os.W_OK | os.X_OK, effective_ids=os.access in os.supports_effective_ids):
        raise PermissionError(f"cannot write {path}: expected a writable folder; got {folder}, which is not")


@contextmanager
def atomic_write(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary path in the folder of `path`; renamed to `path` on success, removed on any error or Ctrl-C.

        with atomic_write("image.png") as temporary:
            temporary.write_bytes(data)

    The temporary name keeps the endings of `path` (`.nii.gz`), for writers that look at them. A reader of `path` sees
    the old file or the new one, never a part. A symbolic link stays a link: the file it points to is replaced.

    Raises:
        OSError: the folder does not exist or is not writable (before the block runs), or the block's own error; one
            that names no file, or the temporary one, names `path` instead.
    """
    check_writable(path)
    target = Path(os.path.realpath(path))
    temporary = target.with_name(f".tmp-{os.urandom(8).hex()}{''.join(target.suffixes[-2:])}")
    try:
        yield temporary
        _flush(temporary)
        os.replace(temporary, target)
    except BaseException as error:
        temporary.unlink(missing_ok=True)
        if isinstance(error, OSError) and error.errno is not None and error.filename in (None, str(temporary)):
            raise OSError(error.errno, error.strerror, str(path)) from error
        raise


@contextmanager
def atomic_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A temporary folder beside `path`; renamed to `path` on success, removed with all in it on any error or Ctrl-C.

    Raises:
        OSError: as `check_new_folder` (before the block runs), or the block's own error.
    """
    target = Path(os.path.realpath(check_new_folder(path)))
    temporary = target.with_name(f".tmp-{os.urandom(8).hex()}")
    temporary.mkdir()
    try:
        yield temporary
        os.replace(temporary, target)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise


def remove_temporaries(folder: str | os.PathLike[str], older: float = 0.0) -> None:
    """Removes what writers that were killed left in a folder, where nobody else is writing now.

    Args:
        folder: the files in it, not below; one that does not exist has none.
        older: only those that were last written so many seconds ago.
    """
    for path in Path(folder).glob(".tmp-*"):
        if re.match(r"\.tmp-[0-9a-f]{16}(\.|$)", path.name) and time.time() - path.stat().st_mtime >= older:
            shutil.rmtree(path, ignore_errors=True) if path.is_dir() else path.unlink(missing_ok=True)


def disk_is_full(error: BaseException) -> bool:
    """Whether an error says that there is no room: on the disk, in a quota, or in a file."""
    return isinstance(error, OSError) and error.errno in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG)


def _flush(path: Path) -> None:
    """Hand the file's bytes to the disk before its name changes, so that a power cut leaves no empty file."""
    with path.open("rb+") as file:
        os.fsync(file.fileno())
