"""Formats of pictures by the endings of their names; known without torch, so that a wrong one is refused at once."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

PICTURES = {".png": "PNG", ".jpg": "JPEG", ".jpeg": "JPEG"}
"""Endings of pictures, and their formats."""

ANIMATIONS = {".gif": "GIF", ".png": "PNG"}
"""Endings of pictures that move, and their formats."""


def format_of(path: str | os.PathLike[str], known: Mapping[str, str] = PICTURES) -> str:
    """The format by a name's ending. Raises ValueError that lists the known ones."""
    ending = Path(path).suffix.lower()
    if ending not in known:
        raise ValueError(f"expected a file name that ends in {' or '.join(known)}; got {path}")
    return known[ending]
