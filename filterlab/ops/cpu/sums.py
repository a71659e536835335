"""Which code a stencil's sums are written by."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from filterlab.ops.cpu.lanes import Lanes, Storage, Value
from filterlab.ops.cpu.taps import WRITTEN_OUT, Grid, Location, Taps
from filterlab.ops.cpu.tetrahedra import TetrahedralTaps
from filterlab.ops.tetrahedra import LoweredStencil, TetrahedralStencil


class Sums(Protocol):
    """What `Taps` says; what `weigh` gives is known to itself alone."""

    lanes: Lanes
    stencil: Any

    def location(self, lanes: Lanes) -> Location: ...
    def weigh(self, u: Sequence[Value]) -> Any: ...
    def contract(self, taps: list[Value], here: Value, weights: Any, u: Sequence[Value]) -> list[Value]: ...
    def spread(self, taps: list[Value], here: Value, weights: Any, cotangents: list[Value]) -> None: ...


def sums_of(
    lanes: Lanes,
    stencil: LoweredStencil,
    storage: Storage,
    grid: Grid,
    room: bool = False,
    written_out: int = WRITTEN_OUT,
) -> Sums:
    """What writes the sums of a stencil; `written_out` concerns sums over taps alone. See `Taps`."""
    if isinstance(stencil, TetrahedralStencil):
        return TetrahedralTaps(lanes, stencil, storage, grid, room)
    return Taps(lanes, stencil, storage, grid, room, written_out)
