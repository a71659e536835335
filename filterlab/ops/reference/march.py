"""The march in plain torch: emission and absorption along rays through anything that can be sampled.

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

from filterlab.ops.march import Chords, Lighting, March
from filterlab.ops.reference.gather import gather as plain_gather
from filterlab.ops.reference.optics import Table, absorbed, shade

Report = Callable[[int], None]
"""Is told how many samples of the current part are done."""

BLOCK = 32  # K, consecutive segments of a ray that are composited together; a power of two
MEMORY = 1 << 28  # bytes that samples in work may take, roughly

_FLOATS_PER_SAMPLE = 160  # what a field of 27 taps and the marcher hold at a time, measured
_FLOATS_PER_SAMPLE_SAVED = 1000  # the same while autograd records them
_LARGEST_BLOCK = 2**18  # samples; more would only leave the caches


class Samples(Protocol):
    """What rays go through, sample by sample.

    Attributes:
        dtype: of the samples.
        transfer: from values to colours and opacities.
        step: world length of a segment.
        faint: transmittance below which a ray ends; 0: only at exactly 0.
        lit: whether colours are shaded by gradients.
        differentiable: whether derivatives are asked.
    """

    @property
    def dtype(self) -> torch.dtype: ...
    @property
    def transfer(self) -> Table: ...
    @property
    def step(self) -> float: ...
    @property
    def faint(self) -> float: ...
    @property
    def lit(self) -> bool: ...
    @property
    def differentiable(self) -> bool: ...
    def at(self, rays: Tensor) -> Samples:
        """The same for some of the rays."""
        ...

    def jet(self, points: Tensor, order: int) -> tuple[Tensor, ...]:
        """Values `(S,)` at points `(S, 3)`, and for order 1 gradients `(S, 3)` in the world."""
        ...

    def shade(self, color: Tensor, gradient: Tensor, ray: Tensor, direction: Tensor) -> Tensor:
        """Lit colours `(S, 3)` on rays of these numbers `(S,)` and directions `(S, 3)`."""
        ...


def march(given: March, memory: int = MEMORY, gather: Callable[..., Tensor] = plain_gather) -> tuple[Tensor, Tensor]:
    """Light (R, 3) and optical depth (R,), float64, of a march as it is described; bricks are not looked at.

    Differentiable any number of times in every tensor of the march, as far as `gather` is.

    Args:
        memory: bytes that samples in work may take, roughly.
        gather: what sums over taps, of the meaning of `ops.reference.gather.gather`.
    """
    return composite(given.chords, _Described(given, gather), memory, lambda done: None)


def composite(chords: Chords, samples: Samples, memory: int, report: Report) -> tuple[Tensor, Tensor]:
    """Emitted light (R, 3) and optical depth (R,), float64.

    Differentiable any number of times; blocks are recomputed in the backward pass, so that memory stays bounded.
    """
    count = chords.count
    light = torch.zeros_like(chords.entry)
    depth = torch.zeros_like(chords.length)
    alive = (count > 0).nonzero()[:, 0]
    at_once = rays_at_once(memory, samples.dtype, samples.differentiable)
    first, done = 0, 0
    while len(alive):
        for rays in alive.split(at_once):
            block = (samples.at(rays), chords.at(rays), depth[rays], first)
            if samples.differentiable:
                more, after = checkpoint(_block, *block, use_reentrant=False, preserve_rng_state=False)  # type: ignore[misc]
                light, depth = light.index_add(0, rays, more), depth.index_copy(0, rays, after)
            else:
                more, after = _block(*block)
                light.index_add_(0, rays, more)
                depth.index_copy_(0, rays, after)
            done += int((count[rays] - first).clamp_max(BLOCK).sum())
            report(done)
        first += BLOCK
        alive = alive[_goes_on(samples, count[alive], depth[alive].detach(), first)]
    return light, depth


@dataclass(frozen=True)
class _Described:
    """The samples of a march."""

    given: March
    gather: Callable[..., Tensor]

    @property
    def dtype(self) -> torch.dtype:
        return self.given.dtype

    @property
    def transfer(self) -> Table:
        t = self.given.transfer
        return Table(t.positions, t.colors, t.opacities, t.unit)

    @property
    def step(self) -> float:
        return self.given.step

    @property
    def faint(self) -> float:
        return self.given.faint

    @property
    def lit(self) -> bool:
        return self.given.lighting is not None

    @property
    def differentiable(self) -> bool:
        return torch.is_grad_enabled() and any(t.requires_grad for t in self.given.tensors.values())

    @property
    def _lighting(self) -> Lighting:
        assert self.given.lighting is not None
        return self.given.lighting

    def at(self, rays: Tensor) -> _Described:
        lighting = None if self.given.lighting is None else self.given.lighting.at(rays)
        return replace(self, given=replace(self.given, lighting=lighting))

    def jet(self, points: Tensor, order: int) -> tuple[Tensor, ...]:
        given = self.given
        stencil = given.stencil.up_to(order)
        value, *gradient = self.gather(given.coefficients[None, None], points[None], stencil, given.start)[0, 0]
        return (value, torch.stack(gradient, -1) @ self._lighting.world) if gradient else (value,)

    def shade(self, color: Tensor, gradient: Tensor, ray: Tensor, direction: Tensor) -> Tensor:
        s = self._lighting.at(ray)
        return shade(color, gradient, s.ambient, s.shininess, s.diffuse, s.specular, s.toward, s.halfway)


def rays_at_once(memory: int, dtype: torch.dtype, differentiable: bool) -> int:
    """How many rays' blocks fit into three quarters of the memory."""
    floats = _FLOATS_PER_SAMPLE_SAVED if differentiable else _FLOATS_PER_SAMPLE
    samples = min(memory * 3 // 4 // (floats * dtype.itemsize), _LARGEST_BLOCK)
    return max(samples // BLOCK, 1)


def segments(
    length: Tensor, step: float, first: int, number: int, offset: Tensor | float = 1.0
) -> tuple[Tensor, Tensor]:
    """Midpoints and lengths of `number` segments from the `first` on, `(R, number)` each, for rays of `length` `(R,)`.

    Segment i is [(i − 1 + offset) step, (i + offset) step] cut to [0, length]: with offset = 1 every segment is a step
    long and only the last is shorter; with an offset in (0, 1] the first one is shorter as well. The lengths of a ray's
    segments always sum to its length. Beyond the end the length is 0. Differentiable in `length`.
    """
    i = torch.arange(first, first + number, dtype=length.dtype, device=length.device)
    if isinstance(offset, Tensor):
        offset = offset[:, None]
    end = torch.minimum((i + offset) * step, length[:, None])
    start = torch.minimum(((i - 1 + offset) * step).clamp_min(0), length[:, None])
    return (start + end) / 2, end - start


def _goes_on(samples: Samples, count: Tensor, depth: Tensor, first: int) -> Tensor:
    if samples.differentiable:
        return count > first
    transmittance = torch.exp(-depth)
    return (count > first) & ~((transmittance < samples.faint) | (transmittance == 0))  # NaN goes on


def _block(
    samples: Samples, chords: Chords, depth: Tensor, first: int, in_one_pass: bool = False
) -> tuple[Tensor, Tensor]:
    """What K segments of every ray add to its light `(R, 3)`, and its optical depth behind them `(R,)`.

    Args:
        in_one_pass: gradients come with values, whatever else is known.
    """
    dtype, transfer, count = samples.dtype, samples.transfer, chords.count
    middle, thickness = segments(chords.length, samples.step, first, BLOCK, chords.offset)
    real = torch.arange(first, first + BLOCK, device=count.device) < count[:, None]  # (R, K)
    kept = None if bool(real.all()) else real.reshape(-1).nonzero()[:, 0]
    direction = chords.direction.to(dtype)
    middle = middle.to(dtype)[..., None]
    points = torch.addcmul(chords.entry.to(dtype)[:, None], middle, direction[:, None])  # (R, K, 3)
    points = _pick(points.reshape(-1, 3), kept)  # (S, 3)
    thickness = _pick(thickness.to(dtype).reshape(-1), kept)

    # gradients come in one pass with values when nearly every sample needs one: when derivatives are asked, or when no
    # value is transparent
    one_pass = samples.lit and (samples.differentiable or in_one_pass or not transfer.transparent_somewhere)
    jet = samples.jet(points, 1 if one_pass else 0)
    if (known := _known(jet)) is not None:  # nothing is where a value is NaN
        kept = known if kept is None else kept[known]
        points, thickness = points[known], thickness[known]
        # 0 · NaN is NaN: what is not there must not be in the graph either
        jet = samples.jet(points, len(jet) - 1) if samples.differentiable else tuple(_pick(x, known) for x in jet)
    located = transfer.locate(jet[0])
    tau = transfer.optical_depth(transfer.opacity(located), thickness)
    weight, after = _compose(_spread(tau, kept, real.shape), depth, samples.faint)

    weight = _pick(weight.reshape(-1), kept)
    seen = None if samples.differentiable else (weight != 0).nonzero()[:, 0]
    place = kept if seen is None else seen if kept is None else kept[seen]  # among all R K, of what is seen
    color = transfer.color(located if seen is None else located.at(seen))
    if samples.lit:
        gradient = _pick(jet[1], seen) if one_pass else _gradient(samples, _pick(points, seen))
        if not one_pass and _known((gradient,)) is not None:  # others are seen, too, where such a one is not there
            return _block(samples, chords, depth, first, in_one_pass=True)
        ray = (torch.arange(real.numel(), device=count.device) if place is None else place) // BLOCK
        color = samples.shade(color, gradient, ray, direction.index_select(0, ray))
    emitted = _pick(weight, seen)[:, None] * color
    return _sum_pairwise(_spread(emitted, place, real.shape)).double(), after


def _known(jet: Sequence[Tensor]) -> Tensor | None:
    """Which of S samples are no NaN, in any of `(S, *)`; None: all of them."""
    unknown = torch.stack([x.detach().isnan().reshape(len(x), -1).any(-1) for x in jet]).any(0)
    return (~unknown).nonzero()[:, 0] if bool(unknown.any()) else None


def _gradient(samples: Samples, points: Tensor) -> Tensor:
    return samples.jet(points, 1)[1] if len(points) else torch.zeros_like(points)


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
