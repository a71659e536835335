"""The prefilter as vector code for this processor: describes the arrays to the program of `ops.cpu.recursion`.

Same meaning as `ops.reference.prefilter`, any number of poles. Memory: the result, and for every thread a
scratch array of two bundles of lines (n + warm-up numbers each, at most 64 lines: about 140 KB for 256 voxels). Samples
are read as they are stored, through any strides but along x; what lies otherwise is copied first. Never written to.
"""

from __future__ import annotations

import math

import numpy as np
import torch
from torch import Tensor

from filterlab.ops.cpu import compiler
from filterlab.ops.cpu import threads as pool
from filterlab.ops.cpu.machine import CHUNKS_PER_THREAD, lanes_of, threads_for
from filterlab.ops.cpu.memory import ARITHMETIC, fresh
from filterlab.ops.cpu.recursion import RecursionJob, RecursionVariant
from filterlab.ops.gather import STORAGE
from filterlab.ops.prefilter import Filtering

_STATES = (
    8  # packs that a bundle's recursions remember, K times the poles; with AVX2 2 are slower by a quarter, so are 16
)
_NUMBERS_PER_THREAD = 1 << 16  # fewer are not worth waking a thread for
_MOST_NUMBERS = 1 << 22  # of a chunk, unless a plane has more: between two of them Ctrl-C is heard
_ALIGNMENT = 64  # bytes of a cache line


def filter_axes(samples: Tensor, how: Filtering) -> Tensor:
    """Coefficients along one axis or all three, of a prefilter with at least one pole; no derivatives.

    Args:
        samples: real, of a dtype of `ops.gather.STORAGE`.
    """
    dtype = torch.promote_types(samples.dtype, torch.float32)
    samples = samples.detach().resolve_neg()
    shape = list(samples.shape)
    for dim in how.dims:
        shape[dim] += 2 * how.tail
    if 0 in shape:
        return samples.new_empty(shape, dtype=dtype)
    if len(how.dims) == 1 or how.tail < 0:
        for dim in how.dims:
            samples = _Filter(samples, dtype, how).along(dim)
        return samples
    return _Filter(samples, dtype, how).volume()


class _Filter:
    """One call: the samples and how they are to be filtered."""

    def __init__(self, samples: Tensor, dtype: torch.dtype, how: Filtering) -> None:
        self.samples, self.dtype, self.how, self.tail = samples, dtype, how, how.tail
        self.warm_up = how.prefilter.decay(dtype)
        self.poles = np.array(how.prefilter.poles)
        self.gain = math.prod((1 - z) ** 2 for z in how.prefilter.poles)
        self.lanes = lanes_of(dtype)
        self.packs = max(1, _STATES // len(self.poles))
        self.bundle = self.lanes * self.packs

    def volume(self) -> Tensor:
        """All three axes: every plane along x and y into its place in the result, then the result along z in place."""
        *leading, d, h, w = self.samples.shape
        out_d, out_h, out_w = (n + 2 * self.tail for n in (d, h, w))
        source = self._with_neighbours(self.samples.reshape(-1, d, h, w))
        target = self._fresh((source.shape[0], out_d, out_h, out_w))
        inside = target[:, self.tail :, self.tail :]
        places_x, places_y, places_z = (self._places(n) for n in (w, h, d))
        self._run(
            False,
            source,
            inside,
            source_plane=source.stride(1),
            source_row=source.stride(2),
            target_plane=target.stride(1),
            target_row=target.stride(2),
            planes=d,
            lines=h,
            width=w,
            places=places_x,
            count=out_w,
            along_y=1,
            places_y=places_y,
            count_y=out_h,
            before_y=self.tail,
            gain=self.gain**3,
            part=h,
            parts=1,
            chunks=source.shape[0] * d,
        )
        self._filter_columns(target[:, self.tail :], target, out_h * out_w, places_z, out_d, 1.0)
        return target.reshape(*leading, out_d, out_h, out_w)

    def along(self, dim: int) -> Tensor:
        """One axis, negative."""
        shape = self.samples.shape
        n = shape[dim]
        outer, inner = math.prod(shape[:dim]), math.prod(shape[dim:][1:])
        source = self.samples.reshape(outer, n, inner)
        source = self._with_neighbours(source[..., 0] if inner == 1 else source)
        places, count = self._places(n), n + 2 * self.tail
        target = self._fresh((outer, count, inner))
        if inner == 1:
            part = self._part(outer)
            self._run(
                False,
                source[None],
                target[None],
                source_row=source.stride(0),
                target_row=target.stride(0),
                planes=1,
                lines=outer,
                width=n,
                places=places,
                count=count,
                gain=self.gain,
                part=part,
                parts=-(-outer // part),
                chunks=-(-outer // part),
            )
        else:
            self._filter_columns(source, target, inner, places, count, self.gain)
        return target.reshape(*shape[:dim], count, *shape[dim:][1:])

    def _filter_columns(
        self, source: Tensor, target: Tensor, width: int, places: Tensor, count: int, gain: float
    ) -> None:
        """Along axis 1 of (entries, n, …)."""
        entries = source.shape[0]
        part = self._part(width, entries)
        parts = -(-width // part)
        self._run(
            True,
            source,
            target,
            source_row=source.stride(1),
            target_row=target.stride(1),
            width=width,
            places=places,
            count=count,
            gain=gain,
            part=part,
            parts=parts,
            chunks=entries * parts,
        )

    def _run(
        self,
        columns: bool,
        source: Tensor,
        target: Tensor,
        places: Tensor,
        places_y: Tensor | None = None,
        **fields: float,
    ) -> None:
        """Compile, add what all jobs need, and let the threads loose."""
        storage, arithmetic = STORAGE[source.dtype], ARITHMETIC[self.dtype]
        variant = RecursionVariant(columns, len(self.poles), arithmetic, storage, self.lanes, self.packs)
        function = compiler.compiled(variant)
        longest = max(fields["count"], fields.get("count_y", 0))
        transposed = _rounded(int(longest + self.warm_up) * self.bundle, _ALIGNMENT)
        rows = _rounded(int(max(fields["width"], fields["count"])), self.lanes) if not columns else 0
        size = transposed + _rounded(rows * self.bundle, _ALIGNMENT)
        threads = self._threads(target.numel())
        scratch = _scratch(threads * size * self.dtype.itemsize)
        job = RecursionJob(
            scratch_size=size,
            transposed=transposed,
            source_entry=source.stride(0),
            target_entry=target.stride(0),
            warm_up=self.warm_up,
            **fields,
        )
        job.point(source=source, target=target, scratch=scratch, poles=self.poles, places=places)
        if places_y is not None:
            job.point(places_y=places_y)
        pool.run(function, [job] * threads)

    def _fresh(self, shape: tuple[int, ...]) -> Tensor:
        return fresh(shape, self.dtype, room=1)  # lines of three coefficients are read as four

    def _with_neighbours(self, samples: Tensor) -> Tensor:
        """The samples with neighbours along the last axis lying together."""
        return samples if samples.stride(-1) == 1 or samples.shape[-1] == 1 else samples.contiguous()

    def _places(self, n: int) -> Tensor:
        return self.how.places(n, self.warm_up, self.warm_up)

    def _threads(self, numbers: int) -> int:
        return threads_for(numbers, _NUMBERS_PER_THREAD)

    def _part(self, lines: int, entries: int = 1) -> int:
        """Neighbouring lines of a chunk: whole bundles, few enough that all threads have enough to take."""
        numbers = self.samples.numel()
        chunks = max(1, self._threads(numbers) * CHUNKS_PER_THREAD // entries, numbers // (_MOST_NUMBERS * entries))
        return _rounded(max(1, lines // chunks), self.bundle)


def _scratch(size: int) -> np.ndarray:
    """So many bytes, from the start of a cache line on."""
    memory = np.empty(size + _ALIGNMENT, np.uint8)
    start = -memory.ctypes.data % _ALIGNMENT
    return memory[start : start + size]


def _rounded(number: int, multiple: int) -> int:
    """Up to a multiple."""
    return -(-number // multiple) * multiple
