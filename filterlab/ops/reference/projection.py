"""The largest sample along rays in plain torch, through anything that can be sampled.

How work is cut up never changes an answer: samples are compared in their order, and the first of equal ones stays.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import torch
from torch import Tensor

from filterlab.ops.march import Chords
from filterlab.ops.projection import Projection
from filterlab.ops.reference.gather import gather

BLOCK = 64  # samples of a ray that are evaluated together
BYTES_PER_SAMPLE = 160
"""Of points in float64 and in the field's type, lengths, values and their comparison, roughly."""
MEMORY = 1 << 28  # bytes that samples in work may take, roughly

_SAMPLES = 1 << 16  # that are evaluated together; more would only leave the caches

OnChords = Callable[[Chords, Tensor], Tensor]
"""Values (R, K) at distances (R, K) along chords."""


def largest(given: Projection, report: Callable[[int], None] = lambda rays: None) -> Tensor:
    """The number of the first of the largest samples of every ray (R,) int64; −1 where none has a value.

    NaN and −∞ are no values.
    """

    def values(chords: Chords, t: Tensor) -> Tensor:
        points = chords.entry[:, None] + t[..., None] * chords.direction[:, None]
        rows = gather(
            given.coefficients[None, None],
            points.reshape(1, -1, 3).to(given.dtype),
            given.stencil.up_to(0),
            given.start,
        )
        return rows[0, 0, 0].reshape(t.shape)

    found = number_of_largest(values, given.chords, given.step, given.dtype, MEMORY)
    report(len(found))
    return found


def middles(chords: Chords, step: float, number: Tensor) -> Tensor:
    """How far along chords the middles of the segments of those numbers lie, `(R, K)`; `ops.reference.march.segments`.

    Differentiable in the lengths, of which the last segment is what is left.
    """
    end = (number + chords.offset[:, None]) * step
    length = chords.length[:, None]
    return (torch.minimum((end - step).clamp_min(0), length) + torch.minimum(end, length)) / 2


def number_of_largest(values: OnChords, chords: Chords, step: float, dtype: torch.dtype, memory: int) -> Tensor:
    """The same of values that are found on chords."""
    chords = Chords(*(x.detach() for x in vars(chords).values()))
    best = torch.full_like(chords.length, -math.inf, dtype=dtype)
    number = torch.full_like(chords.count, -1)
    alive, first = (chords.count > 0).nonzero()[:, 0], 0
    while len(alive):
        for rays in alive.split(rays_at_once(memory)):
            value, index = _block(values, chords.at(rays), step, first)
            better = value > best[rays]
            best[rays] = torch.where(better, value, best[rays])
            number[rays] = torch.where(better, index, number[rays])
        first += BLOCK
        alive = alive[chords.count[alive] > first]
    return number


def _block(values: OnChords, chords: Chords, step: float, first: int) -> tuple[Tensor, Tensor]:
    """(largest value, its number) `(R,)` among K samples of every chord; −∞ where none has a value."""
    number = torch.arange(first, first + BLOCK, device=chords.count.device)
    value = values(chords, middles(chords, step, number)).detach()
    real = number < chords.count[:, None]
    most, index = torch.where(real & ~value.isnan(), value, -math.inf).max(-1)
    return most, first + index


def rays_at_once(memory: int) -> int:
    """How many rays' blocks are in work."""
    return max(min(memory // BYTES_PER_SAMPLE, _SAMPLES) // BLOCK, 1)
