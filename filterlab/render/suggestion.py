"""How a field may be shown when nobody has said how: what its values look like, and from where they are seen.

Values are told apart in up to four classes by their histogram (Otsu's thresholds). The class that most of the domain's
faces have is what is around: air, and its noise. It is not seen. The others are, the more the further their values are
from it, and each so much that it is neither missed nor in the way, however thick it is:

    α_k = 1 − e^(−τ_k / ℓ_k)    ℓ_k  voxels of class k on a line that meets it, in the mean over lines along the axes

Source of the thresholds: Liao, Chen & Chung, A fast algorithm for multilevel thresholding, 2001.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import torch
from torch import Tensor
from torch.nn import functional

from filterlab.fields.base import Field

Direction = tuple[float, float, float]

_MOST = 64  # samples along an axis
_BINS = 256
_LEFT_OUT = 5e-4  # of the values at either end: a few voxels of metal are not what a scan is of
_CLASSES = 4
_MOST_OPAQUE = 0.95
_HARDLY = 0.02  # of the largest opacity: what has less is not framed
_LOOKS = (
    (0.3, (0.30, 0.45, 0.65)),
    (3.0, (0.85, 0.50, 0.28)),
    (12.0, (1.0, 0.93, 0.80)),
)
"""τ and linear RGB of classes, from next to what is around to furthest from it."""

DIRECTION: Direction = (-0.55, 0.75, -0.35)
"""In which a camera looks: along no axis, somewhat downwards."""
FROM_THE_FRONT: Direction = (-0.55, -0.75, -0.35)
"""The same of a patient: coordinates are right, anterior, superior."""


class Sampled(NamedTuple):
    """A field on a regular grid in its domain.

    Attributes:
        corners: (D + 1, H + 1, W + 1, 3) world: of the cells in whose middles samples lie.
        values: (D, H, W); NaN where there is none.
        spacing: between neighbours along D, H, W, in voxels.
    """

    corners: Tensor
    values: Tensor
    spacing: tuple[float, ...]


def sampled(field: Field) -> Sampled:
    """Up to 64³ samples, float64. Raises ValueError for a batched field, or one that has a value nowhere."""
    if field.channels is not None:
        raise ValueError("what is suggested is for one channel: `select` it from this batched field")
    domain = field.domain
    sides = [high - low for low, high in zip(domain.lower, domain.upper, strict=True)]
    lengths = [s * n / domain.voxel_size for s, n in zip(sides, domain.geometry.spacing, strict=True)]
    counts = [min(_MOST, max(1, round(length))) for length in lengths]
    ends = [
        torch.linspace(low, high, n + 1).double()
        for low, high, n in zip(domain.lower, domain.upper, counts, strict=True)
    ]
    middles = [(own[1:] + own[:-1]) / 2 for own in ends]
    corners, points = (domain.geometry.to_world(_grid(axes)) for axes in (ends, middles))
    values = field(points.to(field.device or "cpu")).detach().double().cpu()
    if not bool(values.isfinite().any()):
        raise ValueError("expected a field with a finite value somewhere to show; got none at its samples")
    spacing = tuple(length / n for length, n in zip(reversed(lengths), reversed(counts), strict=True))
    return Sampled(corners, values.masked_fill(~values.isfinite(), math.nan), spacing)


def tables(given: Sampled) -> tuple[Tensor, Tensor, Tensor]:
    """Positions (M,), colours (M, 3) and opacities per voxel (M,) of a transfer function."""
    known = ~given.values.isnan()
    thresholds = _thresholds(given.values[known])
    kinds = torch.bucketize(given.values, thresholds, right=True).masked_fill(~known, -1)
    around = _around(kinds) if len(thresholds) else -1
    ranks = [abs(k - around) for k in range(len(thresholds) + 1)] if len(thresholds) else [1]
    looks = _LOOKS[len(_LOOKS) - max(ranks) :] if len(thresholds) else _LOOKS[1:2]
    points = []
    for kind, rank in enumerate(ranks):
        if kind == around:  # clear between its ends, in the colours of its neighbours
            ends = thresholds[max(kind - 1, 0) : kind + 1]
            points += [(float(end), looks[0][1], 0.0) for end in ends]
        else:
            depth, color = looks[rank - 1]
            alpha = -math.expm1(-depth / _length(kinds == kind, given.spacing))
            points.append((float(given.values[kinds == kind].median()), color, min(alpha, _MOST_OPAQUE)))
    x, rgb, alpha = (torch.tensor(column, dtype=torch.float64) for column in zip(*points, strict=True))
    return x, rgb, alpha


def seen(given: Sampled, opacities: Tensor) -> Tensor:
    """World points (M, 3): corners of the cells that are seen, of samples of these opacities (D, H, W); or of all."""
    mask = opacities > _HARDLY * opacities.max()
    cells = mask if bool(mask.any()) else torch.ones_like(mask)
    padded = functional.pad(cells[None].float(), (1,) * 6)
    return given.corners[functional.max_pool3d(padded, 2, stride=1)[0] > 0]


def _grid(axes: list[Tensor]) -> Tensor:
    """Points (D, H, W, 3) of places along x, y, z."""
    z, y, x = torch.meshgrid(*reversed(axes), indexing="ij")
    return torch.stack((x, y, z), -1)


def direction_for(field: Field) -> Direction:
    """In which direction to look at a field."""
    return FROM_THE_FRONT if field.domain.geometry.world.axes == "RAS" else DIRECTION


def _thresholds(values: Tensor) -> Tensor:
    """(K − 1,) between K classes of values (M,), as many as there are; none where all are the same."""
    ends = values.sort().values[[round(part * (len(values) - 1)) for part in (_LEFT_OUT, 1 - _LEFT_OUT)]]
    low, high = ends if bool(ends[1] > ends[0]) else values.aminmax()
    if not bool(high > low):
        return values.new_zeros(0)
    counts = torch.histc(values.clamp(low, high), _BINS, float(low), float(high))
    middles = low + (high - low) * (torch.arange(_BINS, dtype=values.dtype) + 0.5) / _BINS
    classes = min(_CLASSES, int((counts > 0).sum()))
    ends = middles[_last_bins(counts, middles - middles.mean(), classes)] + (high - low) / (2 * _BINS)
    # between the values on both sides: where there are none for a while, in the middle
    return torch.stack([(values[values <= end].max() + values[values > end].min()) / 2 for end in ends])


def _last_bins(counts: Tensor, middles: Tensor, classes: int) -> Tensor:
    """(K − 1,) of bins (B,) the last one of every class but the last, where the variance between classes is largest:

    Σ_k (Σ n_b x_b)² / Σ n_b over the bins b of class k; classes without a value are none. Best first parts are extended
    class by class, O(K B²). (scikit-image has it, for 0.3 s of imports.)
    """
    n, s = (functional.pad(x.double().cumsum(0), (1, 0)) for x in (counts, counts * middles))
    number = (n - n[:, None]).triu(1)  # of the values from bin i up to bin j
    between = torch.where(number > 0, (s - s[:, None]) ** 2 / number, -torch.inf)
    best, ways = between[0], []
    for _ in range(classes - 1):
        best, way = (best[:, None] + between).max(0)
        ways.append(way)
    last, ends = len(counts), []
    for way in reversed(ways):
        last = int(way[last])
        ends.append(last - 1)
    return torch.tensor(ends[::-1], dtype=torch.int64)


def _around(kinds: Tensor) -> int:
    """The class that most of the faces of (D, H, W) have."""
    faces = torch.cat([kinds.select(dim, end).flatten() for dim in range(3) for end in (0, -1)])
    faces = faces[faces >= 0]
    return int((faces if len(faces) else kinds[kinds >= 0]).bincount().argmax())


def _length(mask: Tensor, spacing: tuple[float, ...]) -> float:
    """ℓ: how much of the lines that meet a mask (D, H, W) lies in it."""
    found = []
    for dim, width in enumerate(spacing):
        along = mask.sum(dim)
        found.append(float(along[along > 0].double().mean()) * width)
    return sum(found) / len(found)
