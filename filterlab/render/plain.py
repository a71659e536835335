"""The plain marcher: emission and absorption along rays through any Field, in batched torch.

Letters: R rays, K samples of each ray in a block, S = samples of a block that exist (no more than R K), s the length of
a segment, τ its optical depth, T transmittance. Geometry (rays, distances) is float64; samples are `dtype`.

How work is cut up never changes a number: blocks have K consecutive segments of a ray wherever a part's edge is, and
sums over them have a fixed order.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import torch
from torch import Tensor
from torch.utils.checkpoint import checkpoint

from filterlab.fields.base import Field
from filterlab.render.rays import segments
from filterlab.render.shading import Shading
from filterlab.render.transfer import TransferFunction, absorbed

Report = Callable[[int], None]
"""Is told how many samples of the current part are done."""

BLOCK = 32  # K, consecutive segments of a ray that are composited together; a power of two
_FLOATS_PER_SAMPLE = 160  # what a field of 27 taps and the marcher hold at a time, measured
_FLOATS_PER_SAMPLE_SAVED = 1000  # the same while autograd records them
_LARGEST_BLOCK = 2**18  # samples; more would only leave the caches


@dataclass(frozen=True)
class Chords:
    """The parts of R rays that lie in a field's domain: points entry + t direction, 0 ≤ t ≤ length, in the world.

    Attributes:
        entry, direction: (R, 3) float64, unit directions.
        length: (R,) float64; 0 for a ray that misses.
        offset: (R,) float64: how far into a step the first segment reaches, in (0, 1].
        count: (R,) int64, segments.
    """

    entry: Tensor
    direction: Tensor
    length: Tensor
    offset: Tensor
    count: Tensor

    @property
    def nbytes(self) -> int:
        """Memory."""
        return sum(x.nbytes for x in (self.entry, self.direction, self.length, self.offset, self.count))

    def at(self, rays: Tensor) -> Chords:
        """Those of some of the rays."""
        return Chords(*(x[rays] for x in (self.entry, self.direction, self.length, self.offset, self.count)))


@dataclass(frozen=True)
class Medium:
    """What rays are marched through, and how.

    Attributes:
        field: unbatched.
        transfer: with tables in the dtype of the samples.
        shading: lights, or None.
        step: world length of a segment.
        faint: transmittance below which a ray ends; 0: only at exactly 0.
        differentiable: whether derivatives are asked.
    """

    field: Field
    transfer: TransferFunction
    shading: Shading | None
    step: float
    faint: float
    differentiable: bool

    @property
    def dtype(self) -> torch.dtype:
        return self.transfer.positions.dtype

    @property
    def order(self) -> int:
        """The highest derivative of the field that is asked for: none without light."""
        return 0 if self.shading is None else 1


class Marcher(Protocol):
    """Marches parts of an image's rays through a medium."""

    def march(self, medium: Medium, chords: Chords, report: Report) -> tuple[Tensor, Tensor]:
        """Emitted light (R, 3) and optical depth (R,), float64."""
        ...


class PlainMarcher:
    """Any field, device and derivative.

    Args:
        memory: bytes that samples in work may take, roughly.
    """

    def __init__(self, memory: int) -> None:
        self.memory = memory

    def march(self, medium: Medium, chords: Chords, report: Report) -> tuple[Tensor, Tensor]:
        """Emitted light (R, 3) and optical depth (R,), float64.

        Differentiable any number of times; blocks are recomputed in the backward pass, so that memory stays bounded.
        """
        medium, chords = _from_the_first_voxel(medium, chords)
        count = chords.count
        light = torch.zeros_like(chords.entry)
        depth = torch.zeros_like(chords.length)
        alive = (count > 0).nonzero()[:, 0]
        at_once = rays_at_once(self.memory, medium.dtype, medium.differentiable)
        first, done = 0, 0
        while len(alive):
            for rays in alive.split(at_once):
                block = (medium, chords.at(rays), depth[rays], first)
                if medium.differentiable:
                    more, after = checkpoint(_block, *block, use_reentrant=False, preserve_rng_state=False)  # type: ignore[misc]
                    light, depth = light.index_add(0, rays, more), depth.index_copy(0, rays, after)
                else:
                    more, after = _block(*block)
                    light.index_add_(0, rays, more)
                    depth.index_copy_(0, rays, after)
                done += int((count[rays] - first).clamp_max(BLOCK).sum())
                report(done)
            first += BLOCK
            alive = alive[_goes_on(medium, count[alive], depth[alive].detach(), first)]
        return light, depth


def _from_the_first_voxel(medium: Medium, chords: Chords) -> tuple[Medium, Chords]:
    """The same in a world whose origin is the volume's own: samples keep their digits wherever the volume stands."""
    origin = medium.field.domain.geometry.origin
    field = medium.field.relative_to(origin)
    return replace(medium, field=field), replace(chords, entry=chords.entry - chords.entry.new_tensor(origin))


def rays_at_once(memory: int, dtype: torch.dtype, differentiable: bool) -> int:
    """How many rays' blocks fit into three quarters of the memory."""
    floats = _FLOATS_PER_SAMPLE_SAVED if differentiable else _FLOATS_PER_SAMPLE
    samples = min(memory * 3 // 4 // (floats * dtype.itemsize), _LARGEST_BLOCK)
    return max(samples // BLOCK, 1)


def _goes_on(medium: Medium, count: Tensor, depth: Tensor, first: int) -> Tensor:
    if medium.differentiable:
        return count > first
    transmittance = torch.exp(-depth)
    return (count > first) & ~((transmittance < medium.faint) | (transmittance == 0))  # NaN goes on


def _block(medium: Medium, chords: Chords, depth: Tensor, first: int) -> tuple[Tensor, Tensor]:
    """What K segments of every ray add to its light `(R, 3)`, and its optical depth behind them `(R,)`."""
    dtype, transfer, shading, count = medium.dtype, medium.transfer, medium.shading, chords.count
    middle, thickness = segments(chords.length, medium.step, first, BLOCK, chords.offset)
    real = torch.arange(first, first + BLOCK, device=count.device) < count[:, None]  # (R, K)
    kept = None if bool(real.all()) else real.reshape(-1).nonzero()[:, 0]
    direction = chords.direction.to(dtype)
    middle = middle.to(dtype)[..., None]
    points = torch.addcmul(chords.entry.to(dtype)[:, None], middle, direction[:, None])  # (R, K, 3)
    points = _pick(points.reshape(-1, 3), kept)  # (S, 3)
    thickness = _pick(thickness.to(dtype).reshape(-1), kept)

    # gradients come in one pass with values when nearly every sample needs one: when derivatives are asked, or when no
    # value is transparent
    one_pass = shading is not None and (medium.differentiable or not transfer.transparent_somewhere)
    jet = medium.field.jet(points, medium.order if one_pass else 0)
    located = transfer.locate(jet[0])
    tau = transfer.optical_depth(transfer.opacity(located), thickness)
    weight, after = _compose(_spread(tau, kept, real.shape), depth, medium.faint)

    weight = _pick(weight.reshape(-1), kept)
    seen = None if medium.differentiable else (weight != 0).nonzero()[:, 0]
    place = kept if seen is None else seen if kept is None else kept[seen]  # among all R K, of what is seen
    color = transfer.color(located if seen is None else located.at(seen))
    if shading is not None:
        gradient = _pick(jet[1], seen) if one_pass else _gradient(medium.field, _pick(points, seen))
        ray = (torch.arange(real.numel(), device=count.device) if place is None else place) // BLOCK
        color = shading(color, gradient, direction.index_select(0, ray))
    emitted = _pick(weight, seen)[:, None] * color
    return _sum_pairwise(_spread(emitted, place, real.shape)).double(), after


def _gradient(field: Field, points: Tensor) -> Tensor:
    return field.jet(points, 1)[1] if len(points) else torch.zeros_like(points)


def _compose(tau: Tensor, depth: Tensor, faint: float) -> tuple[Tensor, Tensor]:
    """Weights T_i (1 − e^{−τ_i}) `(R, K)` of segments behind an optical depth `(R,)`, and the depth behind them.

    Segments where less than `faint` of the light still passes get weight 0.
    """
    sums = tau.cumsum(-1)
    before = torch.cat((torch.zeros_like(sums[:, :1]), sums[:, :-1]), -1) + depth.to(tau.dtype)[:, None]  # never ∞ − ∞
    transmittance = torch.exp(-before)
    weight = transmittance * absorbed(tau)
    if faint > 0:
        weight = torch.where(transmittance < faint, torch.zeros_like(weight), weight)
    return weight, depth + sums[:, -1].double()


def _pick(x: Tensor, index: Tensor | None) -> Tensor:
    """Rows of x; all of them for None."""
    return x if index is None else x.index_select(0, index)


def _spread(x: Tensor, index: Tensor | None, shape: Sequence[int]) -> Tensor:
    """Rows put back where `_pick` took them from, zeros elsewhere: `(S, *)` to `(*shape, *)`."""
    if index is not None:
        x = x.new_zeros((math.prod(shape), *x.shape[1:])).index_copy(0, index, x)
    return x.reshape(*shape, *x.shape[1:])


def _sum_pairwise(x: Tensor) -> Tensor:
    """Σ over axis 1 of `(R, K, 3)`, K a power of two, in one fixed order."""
    while x.shape[1] > 1:
        half = x.shape[1] // 2
        x = x[:, :half] + x[:, half:]
    return x[:, 0]
