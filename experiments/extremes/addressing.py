"""Arrays of more than 2³¹ numbers: addresses are 64 bits wide.

Such a volume is a file with a hole: it has its full size, but only the pages that are written to take any room. What is
read from it, next to where 32 bits would have wrapped round, is compared with the same numbers in a small volume.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

import filterlab as fl
from experiments.extremes.contract import Case, Finding, Subject, Tally
from filterlab import ops
from filterlab.fields.tensor_product import Direct

SHAPE = (1400, 1300, 1300)  # 2.37·10⁹ voxels
PIECE = 12


def huge_volumes(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """Sums over taps at the far end of a volume of 2.4·10⁹ bytes, most of which were never written."""
    if subject.scheme == "eight_trilinear":
        return Finding(0, 0.0, 0.0, skipped="its samples are sums of the scheme direct")
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "volume"
        try:
            with path.open("wb") as file:
                file.truncate(int(np.prod(SHAPE)))
            if path.stat().st_blocks * 512 > 2**20:
                return Finding(0, 0.0, 0.0, skipped="this file system has no files with holes")
            return _compared(subject, np.memmap(path, np.uint8, "r+", shape=SHAPE), random, amount)
        except (OSError, AttributeError) as error:  # st_blocks is POSIX; a small disk may refuse the length
            return Finding(0, 0.0, 0.0, skipped=f"no room for a file with a hole of 2.4 GB ({error})")


def _compared(subject: Subject, mapped: np.memmap, random: np.random.Generator, amount: float) -> Finding:
    tally = Tally(1e-5)
    stencil = Direct(fl.METHODS[subject.method].value_terms).stencils[1]
    implementation = "cpu" if subject.scheme == "fused" else "reference"
    corners = [tuple(n - PIECE for n in SHAPE), (SHAPE[0] // 2, 3, 5), (0, 0, 0)]
    count = max(int(2000 * amount), 200)
    for corner in corners:
        piece = random.integers(0, 256, (PIECE,) * 3, dtype=np.uint8)
        mapped[tuple(slice(c, c + PIECE) for c in corner)] = piece
        local = torch.tensor(random.uniform(2, PIECE - 3, (1, count, 3)), dtype=torch.float64)
        offset = torch.tensor(corner[::-1], dtype=torch.float64)
        volume = torch.from_numpy(mapped)[None, None]
        found = ops.gather(volume, local + offset, stencil, 0, implementation)
        small = torch.from_numpy(piece.astype(np.float64))[None, None]
        expected = ops.gather(small, local, stencil, 0, "reference")
        tally.error(_largest(found - expected) / 255, f"at {corner} of a volume {SHAPE}", count)
    return tally.finding()


def _largest(x: Tensor) -> float:
    return float(x.abs().max())


def many_segments(subject: Subject, random: np.random.Generator, amount: float) -> Finding:
    """A ray of 3·10⁹ segments: the count is exact, and an image of it is refused before it is marched."""
    from filterlab.render import TransferFunction, render

    tally = Tally()
    field = fl.reconstruct(torch.rand(8, 8, 8), "trilinear")
    rays = torch.tensor([[-3.0, 4, 4]], dtype=torch.float64), torch.tensor([[1.0, 0, 0]], dtype=torch.float64)
    transfer = TransferFunction([0.0, 1.0], [[1.0, 1, 1]] * 2, [0.1, 0.1])
    for exponent in random.uniform(31.5, 60, max(int(20 * amount), 4)):
        step = 8.0 / 2.0**exponent
        try:
            render(field, rays, transfer, step=step, max_samples=2**31)
            tally.kept(False, f"an image of 2^{exponent:.1f} samples was begun")
        except ValueError as error:
            tally.kept(f"{2.0**exponent:.3g} samples" in str(error), f"another count than 2^{exponent:.3f}: {error}")
    return tally.finding()


CASES = (
    Case(
        "huge-volumes",
        "2.4·10⁹ voxels",
        "Taps beyond 2³¹ are read where they are.",
        huge_volumes,
        ("method", "scheme"),
        0.3,
    ),
    Case(
        "many-segments",
        "10⁹ … 10¹⁸ samples of a ray",
        "Counted without wrapping round, and refused with the count before anything is marched.",
        many_segments,
        (),
        0.1,
    ),
)
