"""SimpleITK: a volume on another grid by ResampleImageFilter, on as many threads as asked. Sums in float64."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from torch import Tensor

from benchmarks.harness import Contestant
from benchmarks.peers.task import without

NAME = "SimpleITK"
_INTERPOLATORS = {"trilinear": "sitkLinear", "tricubic": "sitkBSpline"}


def missing() -> str | None:
    return without("SimpleITK")


def resampling(samples: Tensor, method: str, shape: Sequence[int], threads: int, computes: str) -> Contestant:
    """The box of voxels kept, as `resample(shape=…)` does; coefficients of the spline are computed each time."""
    import SimpleITK as sitk  # noqa: N813

    image = sitk.GetImageFromArray(samples.numpy())
    grid = sitk.Image([int(n) for n in reversed(shape)], sitk.sitkFloat32)
    spacing = [old / new for old, new in zip(samples.shape[::-1], reversed(shape), strict=True)]
    grid.SetSpacing(spacing)
    grid.SetOrigin([(s - 1) / 2 for s in spacing])
    resampler = sitk.ResampleImageFilter()
    resampler.SetReferenceImage(grid)
    resampler.SetInterpolator(getattr(sitk, _INTERPOLATORS[method]))
    resampler.SetNumberOfThreads(threads)

    def numbers(result: sitk.Image) -> tuple[np.ndarray, ...]:
        return (sitk.GetArrayViewFromImage(result),)

    return Contestant(NAME, lambda: resampler.Execute(image), computes, numbers, int(np.prod(shape)))
