"""Pictures of a signal that is known, by which fields made of its samples are judged: of a level, of a medium.

Letters: R rays, K cells of a ray, S steps of a march, N segments of each; T transmittance; s a step in voxels.

What is judged is what a picture shows, not its pixels: a pixel of a medium is a mean along its ray, in which errors
cancel. It can be right where all that it shows is wrong.

Half of the levels are drawn by volume: that much of the region is below them, and often they lie in what is nearly
even. Half are drawn by detail, |∇f| dV, which is what the surfaces of all levels have of area (the coarea formula):
they lie where the signal changes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

import filterlab as fl
from experiments.variety import Subject
from filterlab.recommendation.choice import STEPS
from filterlab.recommendation.survey import inner_box
from filterlab.render import TransferFunction, render
from filterlab.render.rays import Region, slab
from filterlab.signals import Signal
from filterlab.surfaces import LevelSet

_PIXELS = 40  # along an edge of a picture
LEVELS = ("volume", "detail")
"""By what the levels of pictures are drawn."""

_BELOW = 0.2, 0.8  # parts of it that may be below a level
_FEW = 100  # hits, or rays, that say nothing
_FAINT = 0.02  # opacity of a ray on which hardly anything is seen
_WIDTHS = 0.03, 1.0  # of a medium, in parts of the range, log-uniform
_DENSITIES = 0.02, 0.9  # the largest opacity of a voxel, log-uniform
_CELL, _CELLS = 1 / 8, 2**18  # voxels long, about; in all
_DRAWN = 2**11  # N
_NODES = 5  # of the mean over a segment
_WHITE, _BLACK = (1.0, 1.0, 1.0), (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Picture:
    """Parallel rays through the region that is promised, and a level that the true signal has there.

    Attributes:
        signal: the truth.
        span: the range that errors are parts of.
        level: of the surface.
        drawn_by: of `LEVELS`.
        region: corners of the box that is promised.
        origins, directions: (R, 3), where rays enter the region, and from there to where they leave it.
    """

    signal: Signal
    span: float
    level: float
    drawn_by: str
    region: Region
    origins: Tensor
    directions: Tensor

    @classmethod
    def of(cls, subject: Subject, span: float, random: np.random.Generator) -> Picture:
        """Seen from a direction drawn at random, as the level that a part drawn at random is below."""
        lower, upper = inner_box(subject.volume.shape)  # type: ignore[arg-type]
        region = lower.tolist(), upper.tolist()
        basis = torch.linalg.qr(torch.tensor(random.standard_normal((3, 3))))[0]
        steps = torch.linspace(-0.5, 0.5, _PIXELS, dtype=torch.float64) * float((upper - lower).norm())
        across = torch.cartesian_prod(steps, steps)
        middle = (lower + upper) / 2 + across[:, :1] * basis[0] + across[:, 1:] * basis[1]
        near, far = slab(middle, basis[2].expand_as(middle), *region)
        o, d = middle + near[:, None] * basis[2], (far - near)[:, None] * basis[2]
        drawn_by = LEVELS[int(random.integers(2))]
        level = level_of(subject, drawn_by, random.uniform(*_BELOW))
        return cls(subject.signal, span, level, drawn_by, region, o[near < far], d[near < far])

    def error(self, field: fl.Field) -> float | None:
        """As an isosurface counts it, of the hits that are seen; None: there are few."""
        hit = LevelSet(field, self.level).hit(self.origins, self.directions)
        seen = hit.t <= 1
        if int(seen.sum()) < _FEW:
            return None
        point = self.origins[seen] + hit.t[seen][:, None] * self.directions[seen]
        (_, own), (value, gradient) = field.value_and_gradient(point), self.signal.value_and_gradient(point)
        off = (value - self.level).square().mean(), (gradient - own).square().sum(-1).mean()
        return math.sqrt(float(max(off))) / self.span

    @property
    def lengths(self) -> Tensor:
        """(R,), of rays in the region."""
        return self.directions.norm(dim=-1)

    def some(self, most: int, random: np.random.Generator) -> Picture:
        """The same with that many rays at most, drawn at random."""
        kept = torch.tensor(random.permutation(len(self.origins))[:most])
        return replace(self, origins=self.origins[kept], directions=self.directions[kept])

    def at(self, ray: Tensor, t: Tensor) -> Tensor:
        """Points (..., 3) at parts t (...) of rays of these numbers (...)."""
        return self.origins[ray] + t[..., None] * self.directions[ray]


@dataclass(frozen=True)
class Cloud:
    """A translucent medium that rays of a picture go through, and the segments of marches that are seen of it.

    What is seen of a segment [a, b] is T_a − T_b, with the transmittances of the true signal: its light in the picture
    is that times its colour. By every step N segments are drawn, with repetition, in proportion to it: plain means over
    them are means over all segments of all rays, weighted by what is seen.

    Attributes:
        picture: its rays.
        transfer: opacities of a voxel.
        points: (S, N, 3), float32: where marches sample the segments, in the middle.
        value, gradient: (S, N), (S, N, 3), of the true signal there.
        loss: (S, N), what it is to take one sample for a segment: the value less the mean over the segment.
    """

    picture: Picture
    transfer: TransferFunction
    points: Tensor
    value: Tensor
    gradient: Tensor
    loss: Tensor

    @classmethod
    def of(cls, picture: Picture, random: np.random.Generator) -> Cloud | None:
        """Opaque at most around the level of the picture, at random; None: hardly anything is seen."""
        return cls.seen(picture, medium(picture.level, picture.span, random), random)

    @classmethod
    def seen(cls, picture: Picture, transfer: TransferFunction, random: np.random.Generator) -> Cloud | None:
        """Of as many rays as can be looked at closely; None: hardly anything is seen."""
        cells = math.ceil(float(picture.lengths.max()) / _CELL)
        picture = picture.some(max(_CELLS // cells, 2 * _FEW), random)
        shown = shown_by(picture, transfer, cells)
        if int((shown.sum(-1) > _FAINT).sum()) < _FEW:
            return None
        ray, t = drawn(shown, _DRAWN, random)
        samples = [_segments(picture, ray, t, step) for step in STEPS]
        return cls(picture, transfer, *(torch.stack(x) for x in zip(*samples, strict=True)))

    def errors(self, field: fl.Field) -> dict[float, float]:
        """Of marches by every step through a field, as dvr counts them: √(max(v², g²) + loss²), parts of the range."""
        value, gradient = field.value_and_gradient(self.points)
        v, g = (value.double() - self.value).square(), (gradient.double() - self.gradient).square().sum(-1)
        squares = torch.maximum(v.mean(-1), g.mean(-1)) + self.loss.square().mean(-1)
        return dict(zip(STEPS, (squares.sqrt() / self.picture.span).tolist(), strict=True))

    def rendered(self, field: fl.Field, step: float) -> float:
        """RMS difference of pixels of two pictures: of the field by a step, of the true signal by a quarter of it.

        Every voxel of the region is as opaque as the medium at most, and shines in proportion to the value, by 1 over
        the range: a pixel is a weighted mean of values, in parts of the range.
        """
        own, rays = self.picture, (self.picture.origins, self.picture.directions)
        ends = torch.tensor([own.level - 2 * own.span, own.level + 2 * own.span], dtype=torch.float32)
        ramp = TransferFunction(ends, [_BLACK, (4.0, 4.0, 4.0)], [float(self.transfer.opacities.max())] * 2)
        image = render(field, rays, ramp, step=step, region=own.region)
        true = render(own.signal, rays, ramp, step=step / 4, region=own.region, dtype=torch.float64)
        return float((image - true)[:, 0].square().mean().sqrt())


@dataclass(frozen=True)
class Pictures:
    """Of a true signal; None: there is none.

    Attributes:
        picture: of a level.
        cloud: of a medium.
    """

    picture: Picture | None = None
    cloud: Cloud | None = None

    @classmethod
    def of(cls, subject: Subject, span: float, random: np.random.Generator) -> Pictures:
        """Of a signal that has a gradient."""
        if not subject.differentiable:
            return cls()
        of_level, of_medium = random.spawn(2)
        picture = Picture.of(subject, span, of_level)
        return cls(picture, Cloud.of(picture, of_medium))

    def errors(self, field: fl.Field) -> tuple[float | None, dict[float, float] | None]:
        """Of a field, as isosurface and dvr count them."""
        hit = None if self.picture is None else self.picture.error(field)
        return hit, None if self.cloud is None else self.cloud.errors(field)


NO_PICTURES = Pictures()


def level_of(subject: Subject, drawn_by: str, part: float) -> float:
    """The level that a part of the volume, or of its detail, is below."""
    amount = subject.weights * (1.0 if drawn_by == "volume" else subject.gradient.norm(dim=-1))
    rank = subject.value.argsort()
    sums = amount[rank].cumsum(0)
    below = int((sums <= part * sums[-1]).sum())
    return float(subject.value[rank[min(below, len(rank) - 1)]])


def medium(level: float, span: float, random: np.random.Generator) -> TransferFunction:
    """A white medium of random width and density: around the level, above or below it."""
    width, alpha = (math.exp(random.uniform(*np.log(ends))) for ends in (_WIDTHS, _DENSITIES))
    kind = random.integers(3)
    if kind == 0:
        return TransferFunction.triangle_peaks([(level, width * span, alpha, _WHITE)])
    ends = [level - width * span / 2, level + width * span / 2]
    return TransferFunction(ends, [_WHITE] * 2, [0.0, alpha] if kind == 1 else [alpha, 0.0])


def shown_by(picture: Picture, transfer: TransferFunction, cells: int) -> Tensor:
    """What is seen of each of the equal cells of every ray through the true signal, (R, K)."""
    ray, cell = torch.arange(len(picture.origins))[:, None], torch.arange(cells)
    value = picture.signal(picture.at(ray.expand(-1, cells), ((cell + 0.5) / cells).expand(len(ray), -1)))
    opacity = transfer(value)[1]
    depth = transfer.optical_depth(opacity, (picture.lengths / cells)[:, None]).cumsum(-1)
    return -torch.exp(-depth).diff(dim=-1, prepend=torch.ones_like(depth[:, :1]))


def drawn(shown: Tensor, count: int, random: np.random.Generator) -> tuple[Tensor, Tensor]:
    """(number of the ray, part of its length) of places that are drawn by what is seen, (N,) each.

    At equal steps along the running sum, the first at random.
    """
    sums = shown.flatten().cumsum(0)
    at = (torch.arange(count, dtype=torch.float64) + random.random()) * (sums[-1] / count)
    cell = torch.searchsorted(sums, at, right=True).clamp_max(len(sums) - 1)
    within = ((at - sums[cell]) / shown.flatten()[cell] + 1).clamp(0, 1)
    return cell // shown.shape[1], (cell % shown.shape[1] + within) / shown.shape[1]


def _segments(picture: Picture, ray: Tensor, t: Tensor, step: float) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Of the segments of a march that hold these places: middles, value and gradient there, loss."""
    length = picture.lengths[ray]
    start = (t * length / step).floor() * step
    end = torch.minimum(start + step, length)
    points = picture.at(ray, (start + end) / (2 * length)).float()
    value, gradient = picture.signal.value_and_gradient(points.double())
    nodes, weights = (torch.tensor(x) for x in np.polynomial.legendre.leggauss(_NODES))
    along = (start + end)[:, None] + nodes * (end - start)[:, None]
    inside = picture.signal(picture.at(ray[:, None].expand_as(along), along / (2 * length)[:, None]))
    return points, value, gradient, value - (weights / 2 * inside).sum(-1)
