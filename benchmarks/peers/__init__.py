"""Other libraries that do some of the same, each in a file of its own; those that are not installed are left out.

A module here has `NAME`, `missing()` (why it can't take part; None: it can) and one of these: `sampling(task)`, the
contestant for a `Sampling`, with `offers(kernel, gradient)`; `marching(scene)`, the contestant that renders a `Scene`;
`casting(task)`, the one that casts the rays of a `Casting`, or `bisecting(task)`, where that takes so long that few are
cast; `new_level(task, level)`, the one that begins with a level each time. Points, coefficients and tables are handed
over in the library's own form before anything is timed.
"""

from __future__ import annotations

from collections.abc import Iterator
from importlib import import_module
from types import ModuleType

_NAMES = (
    "torch_grid_sample",
    "torch_bicubic",
    "scipy_ndimage",
    "torch_interpol",
    "drjit_texture",
    "drjit_triquadratic",
    "drjit_march",
    "vtk_raycaster",
    "mitsuba_sdfgrid",
    "embree_mesh",
    "vtk_flying_edges",
    "isoray_bisection",
)

PEERS: tuple[ModuleType, ...] = tuple(import_module(f"benchmarks.peers.{name}") for name in _NAMES)


def samplers(kernel: str, gradient: bool) -> Iterator[ModuleType]:
    """The peers that have such a kernel, installed or not."""
    return (peer for peer in PEERS if hasattr(peer, "sampling") and peer.offers(kernel, gradient))


def marchers() -> Iterator[ModuleType]:
    """The peers that render, installed or not."""
    return (peer for peer in PEERS if hasattr(peer, "marching"))


def casters() -> Iterator[ModuleType]:
    """The peers that cast rays at level sets, installed or not."""
    return (peer for peer in PEERS if hasattr(peer, "casting"))
