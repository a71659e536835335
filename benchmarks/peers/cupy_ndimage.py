"""cupyx.scipy.ndimage.spline_filter: the prefilters of SciPy on an NVIDIA GPU."""

# pyright: reportMissingImports=false

from __future__ import annotations

import torch
from torch import Tensor

from benchmarks.harness import Contestant
from benchmarks.peers.cupy_texture import missing

__all__ = ["NAME", "missing", "prefiltering"]

NAME = "CuPy spline_filter"


def prefiltering(samples: Tensor, order: int, computes: str) -> Contestant:
    """Of float32 samples on the GPU, in float32; a call ends when the GPU has."""
    import cupy
    from cupyx.scipy import ndimage

    array = cupy.from_dlpack(samples.contiguous())

    def call() -> tuple[Tensor]:
        with cupy.cuda.ExternalStream(torch.cuda.current_stream().cuda_stream):
            filtered = ndimage.spline_filter(array, order, output=cupy.float32, mode="mirror")
        torch.cuda.synchronize()
        return (torch.from_dlpack(filtered),)

    return Contestant(NAME, call, computes, samples=samples.numel())
