"""The volume that a command reads."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from filterlab.volume import Volume

Progress = Callable[[float, str], None]


@contextmanager
def reading(progress: Progress) -> Iterator[None]:
    """Within it, progress is told how far a volume is read."""
    from filterlab.io.watching import watched

    with watched(lambda done: progress(done, "reading")):
        yield


def load(
    path: Path, frame: int | None, channel: int | None, progress: Progress, max_bytes: int | None = None
) -> Volume:
    """The volume in a file, as `load_volume` gives it; tells how far it is read."""
    from filterlab.io.volumes import load_volume

    limit = {} if max_bytes is None else {"max_bytes": max_bytes}
    with reading(progress):
        return load_volume(path, frame=frame, channel=channel, **limit)
