"""A format of files: its endings, and which functions of this room read and write it, imported when they are called.

Whoever asks for the header of one file waits for the reader of its format only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any


@dataclass(frozen=True)
class Format:
    """A format.

    Attributes:
        name: for people.
        endings: of its files.
        reader, writer: `module.function` of `filterlab.io`; writer None: read only.
    """

    name: str
    endings: tuple[str, ...]
    reader: str
    writer: str | None = None

    def read_header(self, *arguments: Any) -> Any:
        """The checked header of a file."""
        return function(self.reader)(*arguments)

    def write(self, *arguments: Any, **options: Any) -> None:
        """Writes a file; there is a writer."""
        assert self.writer is not None
        function(self.writer)(*arguments, **options)


def function(place: str) -> Callable[..., Any]:
    """The function `module.function` of `filterlab.io`."""
    module, name = place.split(".")
    return getattr(import_module(f"filterlab.io.{module}"), name)
