"""Which code a stencil's sums are written by."""

from __future__ import annotations

from typing import Any, Protocol

from filterlab.ops.cuda.source import Source
from filterlab.ops.cuda.taps import WRITTEN_OUT, Taps
from filterlab.ops.cuda.tetrahedra import TetrahedralTaps
from filterlab.ops.tetrahedra import LoweredStencil, TetrahedralStencil


class Sums(Protocol):
    """What `Taps` says."""

    stencil: Any

    def locate(self, volume: str) -> None: ...
    def weigh(self) -> None: ...
    def contract(self, tap: str, rows: str = "row") -> None: ...
    def spread(self, tap: str, mask: str, rows: str = "row") -> None: ...


def sums_of(source: Source, stencil: LoweredStencil, written_out: int = WRITTEN_OUT) -> Sums:
    """What writes the sums of a stencil; `written_out` concerns sums over taps alone. See `Taps`."""
    if isinstance(stencil, TetrahedralStencil):
        return TetrahedralTaps(source, stencil)
    return Taps(source, stencil, written_out)
