"""gather and scatter as one Triton program each: the rows of a stencil at many points, and the adjoint of that.

Letters: N batch, C channels, M points, J rows. A launch has ⌈M / BLOCK⌉ programs for every batch entry; each takes
BLOCK of the entry's points through all channels. In the last block of an entry the points beyond M stand at 0, where
they read coefficients that exist; they write nothing.
"""

from __future__ import annotations

from filterlab.ops.cuda.source import Source
from filterlab.ops.cuda.sums import Sums, sums_of
from filterlab.ops.tetrahedra import LoweredStencil

SIZES = (
    "count",  # M
    "channels",
    "depth",
    "height",
    "width",
    "start",  # the coordinate of coefficient 0
    "coefficients_entry",  # strides, in numbers
    "coefficients_channel",
    "points_entry",
)
PARAMETERS = ("coefficients", "points", "rows", *SIZES, "BLOCK: tl.constexpr")
"""coefficients (N, C, D, H, W), points (N, M, 3), rows (N, C, J, M) contiguous."""


def gather(stencil: LoweredStencil) -> Source:
    """rows[n, c, :, m] = the rows of the stencil at points[n, m]."""
    source, taps = _head("gather", stencil)
    with source.block("for _ in range(channels)"):
        taps.contract("first")
        for r in range(len(stencil.rows)):
            source.line(f"tl.store(here + {r} * count, row_{r}, inside)")
        _next_channel(source, stencil)
    return source


def scatter(stencil: LoweredStencil) -> Source:
    """coefficients += the transpose of `gather` applied to the rows. A point that is not finite adds nothing."""
    source, taps = _head("scatter", stencil)
    source.line("known = inside & (nothing == 0.0)")
    with source.block("for _ in range(channels)"):
        for r in range(len(stencil.rows)):
            source.line(f"row_{r} = tl.load(here + {r} * count, inside, 0.0)")
        taps.spread("first", "known")
        _next_channel(source, stencil)
    return source


def _head(name: str, stencil: LoweredStencil) -> tuple[Source, Sums]:
    """Everything before the channels: which points, where they read, the weights, where their rows are."""
    source = Source(name, PARAMETERS)
    taps = sums_of(source, stencil)
    line = source.line
    for size in SIZES:
        line(
            f"{size} = {size}.to(tl.int64)  # arrays may be large"
            if size == SIZES[0]
            else f"{size} = {size}.to(tl.int64)"
        )
    line("arithmetic = points.dtype.element_ty")
    line("blocks = (count + BLOCK - 1) // BLOCK")
    line("entry = tl.program_id(0) // blocks")
    line("i = tl.program_id(0) % blocks * BLOCK + tl.arange(0, BLOCK)")
    line("inside = i < count")
    line("point = points + (entry * points_entry + 3 * i)")
    for axis, letter in enumerate("xyz"):
        line(f"{letter} = tl.load(point + {axis}, inside, 0.0)")
    taps.locate("coefficients + entry * coefficients_entry")
    taps.weigh()
    line(f"here = rows + (entry * channels * {len(stencil.rows)} * count + i)")
    return source, taps


def _next_channel(source: Source, stencil: LoweredStencil) -> None:
    source.line("first += coefficients_channel")
    source.line(f"here += {len(stencil.rows)} * count")
