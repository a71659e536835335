"""contract as vector code for this processor: describes the arrays to the program of `ops.cpu.contraction`.

Same meaning as `ops.reference.contract`. Memory: the result, and for every thread a scratch array of about 2 MB, or of
what one line of the result depends on where that is more. Samples are read as they are stored, through any strides but
along x; what lies otherwise is copied first. Never written to.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import torch
from torch import Tensor

from filterlab.ops.contract import Axes, Contraction, Rows
from filterlab.ops.cpu import compiler
from filterlab.ops.cpu import threads as pool
from filterlab.ops.cpu.contraction import ContractionJob, ContractionVariant
from filterlab.ops.cpu.job import AXES
from filterlab.ops.cpu.machine import CHUNKS_PER_THREAD, lanes_of, threads_for
from filterlab.ops.cpu.memory import ARITHMETIC, fresh
from filterlab.ops.gather import STORAGE

_PACKS = 8  # of a sum: as many products as are under way at a time
_KEPT = 1 << 21  # bytes of lines that a thread keeps
_MOST_PLANES = 16  # of a block
_NUMBERS_PER_THREAD = 1 << 16  # fewer are not worth waking a thread for


def contract(samples: Tensor, contraction: Contraction, dtype: torch.dtype) -> Tensor:
    """`ops.reference.contract.contract`, fused; no derivatives.

    Args:
        samples: real, of a dtype of `ops.gather.STORAGE`.
    """
    samples = samples.detach().resolve_neg()
    if samples.stride(-1) != 1 and samples.shape[-1] != 1:
        samples = samples.contiguous()
    source = samples.reshape(-1, *samples.shape[-3:])
    target = fresh((len(source), *contraction.shape), dtype)
    for number, term in enumerate(contraction.terms):
        if target.numel():
            _Term(source, target, term).run(adds=number > 0)
    return target.reshape(*samples.shape[:-3], *contraction.shape)


class _Term:
    """Matrices along x, y, z of samples (N, D, H, W), and where their result goes."""

    def __init__(self, source: Tensor, target: Tensor, term: Axes) -> None:
        self.source, self.target, self.term = source, target, term
        self.lanes = lanes_of(target.dtype)
        self.line = _rounded(source.shape[-1], self.lanes)

    def run(self, adds: bool) -> None:
        dtype, lines = self.target.dtype, self.lanes * _PACKS
        arithmetic = ARITHMETIC[dtype]
        variant = ContractionVariant(adds, arithmetic, STORAGE[self.source.dtype], self.lanes, _PACKS)
        function = compiler.compiled(variant)
        threads = threads_for(self.target.numel(), _NUMBERS_PER_THREAD)
        bands = _Bands.of(self.term[1], max(1, _KEPT // (self.line * dtype.itemsize)))
        block = self._planes_of_block(bands, threads)
        kept = bands.most * self.line
        parts = block * kept, lines * self.line, lines * self.line, lines * self.lanes
        size = sum(parts)
        entries, planes = self.target.shape[:2]
        blocks = -(-planes // block)
        job = ContractionJob(
            scratch_size=size,
            bundle=parts[0],
            rows=sum(parts[:2]),
            tile=sum(parts[:3]),
            source_entry=self.source.stride(0),
            source_line=self.source.stride(2),
            target_entry=self.target.stride(0),
            target_plane=self.target.stride(1),
            target_line=self.target.stride(2),
            width=self.source.shape[-1],
            line=self.line,
            kept=kept,
            planes=planes,
            result=self.target.shape[-1],
            block=block,
            blocks=blocks,
            bands=len(bands.first) - 1,
            chunks=entries * blocks * (len(bands.first) - 1),
        )
        scratch = np.empty(threads * size, arithmetic)
        job.point(source=self.source, target=self.target, scratch=scratch)
        job.point(band=bands.first, needs=bands.needs, needed=bands.needed)
        for axis, rows, places, stride in zip(AXES, self.term, (None, bands.places, None), self._strides, strict=True):
            own = (rows.places if places is None else places) * stride
            given = {"starts": rows.starts, "places": own, "weights": rows.weights.to(dtype)}
            job.point(**{f"{name}_{axis}": array for name, array in given.items()})
        pool.run(function, [job] * threads)

    @property
    def _strides(self) -> tuple[int, int, int]:
        """What a place along x, y and z counts."""
        return self.lanes * _PACKS, self.line, self.source.stride(1)

    def _planes_of_block(self, bands: _Bands, threads: int) -> int:
        """As many as are kept, but leave all threads enough to take."""
        entries, planes = self.target.shape[:2]
        room = _KEPT // (bands.most * self.line * self.target.dtype.itemsize)
        chunks = threads * CHUNKS_PER_THREAD if threads > 1 else 1
        fair = planes * entries * (len(bands.first) - 1) // chunks
        return max(1, min(room, fair, _MOST_PLANES, planes))


class _Bands:
    """Neighbouring rows of a matrix, so few that they depend on no more columns than `room`, or one.

    Attributes:
        first: (bands + 1,) the first row of each.
        needed, needs: the columns that each depends on, and where these begin.
        places: of every entry, in these.
        most: columns of a band.
    """

    def __init__(self, rows: Rows, first: Tensor) -> None:
        self.first = first
        parts = [rows.places[a:b].unique(return_inverse=True) for a, b in pairwise(rows.starts[first].tolist())]
        self.needed = torch.cat([needed for needed, _ in parts])
        self.places = torch.cat([places for _, places in parts])
        counts = torch.tensor([0, *(len(needed) for needed, _ in parts)])
        self.needs, self.most = counts.cumsum(0), max(1, int(counts.max()))

    @classmethod
    def of(cls, rows: Rows, room: int) -> _Bands:
        number = 1
        while True:
            bands = cls(rows, torch.linspace(0, rows.count, number + 1, dtype=torch.float64).round().long())
            if bands.most <= room or number == rows.count:
                return bands
            number = min(2 * number, rows.count)


def _rounded(number: int, multiple: int) -> int:
    """Up to a multiple."""
    return -(-number // multiple) * multiple
