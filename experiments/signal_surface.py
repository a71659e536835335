"""The level set of a signal itself: ground truth, found by none of the code that is judged.

Along a ray the signal is sampled densely, and the first change of sign is halved until floats end. Two crossings
between neighbouring samples are not seen; where there may be any, the ray is doubtful.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from filterlab.ops.reference.pieces import inside
from filterlab.signals import Signal
from filterlab.surfaces import Hits, Surface

SAMPLES = 2048  # of the signal along a ray
BISECTIONS = 60
_AT_ONCE = 512  # rays


class SignalSurface(Surface):
    """The points where a signal has a value, for pictures; no derivatives, first hits alone.

    Args:
        signal: on a box along the world's axes.
        level: the value.
        samples: of the signal along a ray within its box, before bisection.
    """

    max_order = 2

    def __init__(self, signal: Signal, level: float, samples: int = SAMPLES) -> None:
        self.signal, self.level, self.samples = signal, level, samples
        self.domain = signal.domain

    def jet(self, points: Tensor, order: int, piece: Tensor | None = None) -> tuple[Tensor, ...]:
        value, *derivatives = self.signal.jet(points, order)
        return value - self.level, *derivatives

    @property
    def detached(self) -> SignalSurface:
        return self

    def _first(self, origins: Tensor, directions: Tensor) -> Hits:
        lines, ray, start = inside(origins.double(), directions.double(), self.domain.lower, self.domain.upper)
        t, _ = first_crossings(self.signal, self.level, lines.origins, lines.directions, lines.far, self.samples)
        return Hits(torch.full_like(start, math.inf).index_put((ray,), start[ray] + t))

    def _sheets(self, origins: Tensor, directions: Tensor, sheets: int, farthest: bool) -> Hits:
        raise ValueError("a signal's surface is hit first alone; expected sheets=1")


def first_crossings(
    signal: Signal, level: float, origins: Tensor, directions: Tensor, length: Tensor, samples: int = SAMPLES
) -> tuple[Tensor, Tensor]:
    """Where rays (R, 3) cross a level of a signal first, within lengths (R,) in units of their directions.

    Returns:
        t (R,), ∞ where no change of sign is seen; and whether two crossings may lie unseen before that (R,).
    """
    parts = zip(*(x.split(_AT_ONCE) for x in (origins, directions, length)), strict=True)
    found = [_first_crossings(signal, level, o, d, own, samples) for o, d, own in parts]
    t, doubtful = (torch.cat(rows) for rows in zip(*found, strict=True))
    return t, doubtful


def _first_crossings(
    signal: Signal, level: float, origins: Tensor, directions: Tensor, length: Tensor, samples: int
) -> tuple[Tensor, Tensor]:
    def value(t: Tensor) -> Tensor:
        return signal(origins[:, None] + t[..., None] * directions[:, None]) - level

    t = torch.linspace(0, 1, samples + 1, dtype=torch.float64) * length[:, None]
    f = value(t)
    crossing = (f[:, 1:] >= 0) != (f[:, :-1] >= 0)
    first = torch.where(crossing.any(-1), crossing.int().argmax(-1), samples)
    bend = f.diff(n=2).abs().amax(-1, keepdim=True)  # a parabola that crosses twice in between is no farther away
    before = torch.arange(samples + 1) < first[:, None]
    doubtful = ((f.abs() < bend) & before).any(-1)
    at = first.clamp_max(samples - 1)[:, None]
    low, high, side = t.gather(1, at), t.gather(1, at + 1), f.gather(1, at) >= 0
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        same = (value(middle) >= 0) == side
        low, high = torch.where(same, middle, low), torch.where(same, high, middle)
    return torch.where(first < samples, low[:, 0], math.inf), doubtful
