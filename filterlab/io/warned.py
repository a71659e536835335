"""What is odd about a file, and read nevertheless."""

from __future__ import annotations

import os
import warnings

from filterlab.notices import Notice


class VolumeFileWarning(Notice):
    """Something of a volume file that is passed over; names the file and what it is."""


def warn(path: str | os.PathLike[str], message: str) -> None:
    """Tells it as a `VolumeFileWarning`."""
    warnings.warn(VolumeFileWarning(f"{path}: {message}"), stacklevel=2)
