"""Volumes whose numbers are names: which label is strongest between voxels, and whether a volume looks like one."""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from filterlab.volume import Boundary

MOST_LABELS = 1024  # of a volume that looks like labels
ALIKE = 0.75  # of its neighbours within what is labelled, the share that is equal
_PLANES = 16


def strongest(
    samples: Tensor,
    resampled: Callable[[Tensor], Tensor],
    boundary: Boundary,
    progress: Callable[[float], None] = lambda part: None,
) -> Tensor:
    """The label whose indicator is greatest after reconstruction: argmax_l R[samples = l], of equal ones the least.

    One label after the other: beside the result two numbers per voxel are kept, however many labels there are.

    Args:
        samples: of any real type; each value is a label. Not differentiable.
        resampled: R, from an indicator (float32, shaped as the samples) to the new grid.
        boundary: beyond `zeros` there is the label 0.
        progress: told what part of the labels is done.

    Raises:
        ValueError: a label that is not finite.
    """
    labels: Tensor = samples.unique()
    if not labels.isfinite().all():
        raise ValueError(f"labels must be finite numbers; got {labels[~labels.isfinite()][0].item()}")
    outside = boundary is Boundary.ZEROS
    if outside:
        labels = torch.cat((labels.new_zeros(1), labels)).unique()
    best: Tensor | None = None
    chosen: Tensor | None = None
    for index, label in enumerate(labels.unbind()):
        progress(index / len(labels))
        weight = resampled((samples == label).float())
        if outside and not label.any():  # what is left by all others, which are 0 out there
            weight = 1 - resampled((samples != 0).float())
        if best is None or chosen is None:
            best, chosen = weight, label.expand(weight.shape).clone()
            continue
        chosen.masked_fill_(weight > best, label)
        torch.maximum(best, weight, out=best)
    assert chosen is not None
    return chosen


def look_like_labels(samples: Tensor) -> bool:
    """Whether integers are likely to be names: few of them, in patches, and not in rising steps.

    Looked at in at most 16 planes of the first volume. Patches: of neighbours that are both not the background, which
    is the commonest value, three of four are equal. An image that varies slowly is told by its steps, which are small.
    """
    if samples.is_floating_point() or samples.numel() == 0:
        return False
    volume = samples.reshape(-1, *samples.shape[-3:])[0]
    planes = volume[:: -(-len(volume) // _PLANES)].long()
    values, counts = planes.unique(return_counts=True)
    if not 1 < len(values) <= MOST_LABELS:
        return False
    background = values[counts.argmax()]
    steps = torch.cat([_steps(planes, dim, background) for dim in (-1, -2)])
    if len(steps) == 0 or float((steps == 0).float().mean()) < ALIKE:
        return False
    jumps = steps[steps != 0]
    rising = len(values) > 8 and len(jumps) > 0 and float((jumps <= 2).float().mean()) > 0.9
    return not rising


def _steps(planes: Tensor, dim: int, background: Tensor) -> Tensor:
    """|difference| of neighbours along an axis, neither of which is background."""
    n = planes.shape[dim] - 1
    a, b = planes.narrow(dim, 0, n), planes.narrow(dim, 1, n)
    return (a - b).abs()[(a != background) & (b != background)]
