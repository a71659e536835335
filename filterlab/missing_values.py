"""Voxels without a value: NaN, as scanners and simulations leave them outside of what they know, and ±inf.

A recursive prefilter would carry a NaN along whole lines of the volume. What happens instead is chosen where a volume
becomes a field:

    refuse      a ValueError with the number of such voxels (the default)
    propagate   NaN exactly where the kernel reaches such a voxel; elsewhere as with fill. There media have neither
                colour nor opacity, and level sets end
    fill        values from the voxels around, by pull-push
"""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from filterlab.arrays import all_finite
from filterlab.names import NAN_CHOICES
from filterlab.ops.differentiable.recording import transformed


def resolved(samples: Tensor, choice: str) -> tuple[Tensor, Tensor | None]:
    """Samples `(..., D, H, W)` that are all finite, and a mask of the voxels that are NaN in the field (None: none).

    Integer samples are not looked at, nor those inside a transform of torch.func, where nobody can look. ±inf counts as
    NaN does. Costs a sum over the volume where all is finite. Differentiable in the finite samples.

    Raises:
        ValueError: an unknown choice; with "refuse", how many voxels are not finite; a volume without a finite voxel.
    """
    if choice not in NAN_CHOICES:
        raise ValueError(f"nan must be one of {', '.join(NAN_CHOICES)}; got {choice!r}")
    if not samples.dtype.is_floating_point or transformed() or all_finite(samples):
        return samples, None
    unknown = ~samples.detach().isfinite()
    if choice == "refuse":
        raise ValueError(_told(samples))
    if bool(unknown.flatten(-3).all(-1).any()):
        raise ValueError("expected at least one finite voxel to fill from; got a volume without any")
    return filled(samples, unknown), unknown if choice == "propagate" else None


def _told(samples: Tensor) -> str:
    counts = {"NaN": int(samples.isnan().sum()), "infinite": int(samples.isinf().sum())}
    found = " and ".join(f"{n:,} {name}" for name, n in counts.items() if n)
    return (
        f"expected finite voxels; got {found} of {samples.numel():,}: nan='fill' takes values from the voxels around, "
        "nan='propagate' makes the field NaN where it depends on them"
    )


def filled(samples: Tensor, unknown: Tensor) -> Tensor:
    """The samples, with values from around where `unknown`; differentiable in the others.

    Pull: averages of 2³ known voxels, again and again, until all is known. Push: what is unknown is interpolated
    linearly from the next coarser level. Time and memory are proportional to the number of voxels.

    Source: Gortler et al., The Lumigraph, 1996, section 3.4.
    """
    shape = samples.shape
    values = samples.to(torch.promote_types(samples.dtype, torch.float32)).reshape(-1, 1, *shape[-3:])
    mask = unknown.reshape(values.shape)
    known = values.masked_fill(mask, 0)
    return _pulled_and_pushed(known, mask).reshape(shape).to(samples.dtype)


def _pulled_and_pushed(values: Tensor, unknown: Tensor) -> Tensor:
    if not bool(unknown.any()):
        return values
    pool = {"kernel_size": [min(2, n) for n in values.shape[-3:]], "ceil_mode": True}
    weight = functional.avg_pool3d((~unknown).to(values.dtype), **pool)
    coarse = functional.avg_pool3d(values, **pool) / weight.clamp_min(torch.finfo(values.dtype).tiny)
    coarse = _pulled_and_pushed(coarse, weight == 0)
    around = functional.interpolate(coarse, values.shape[-3:], mode="trilinear", align_corners=False)
    return torch.where(unknown, around, values)
