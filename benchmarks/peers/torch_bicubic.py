"""torch.nn.functional.grid_sample with mode="bicubic" on volumes, where this version of torch has it."""

from __future__ import annotations

from functools import cache

import torch
from torch.nn.functional import grid_sample

from benchmarks.harness import Contestant
from benchmarks.peers.task import Sampling

NAME = "torch 5-D bicubic"


@cache
def missing() -> str | None:
    try:
        _sampled(torch.zeros(1, 1, 4, 4, 4), torch.zeros(1, 1, 1, 1, 3))
    except (RuntimeError, NotImplementedError):
        return f"torch {torch.__version__} has bicubic sampling of images only"
    return None


def offers(kernel: str, gradient: bool) -> bool:
    return kernel == "keys" and not gradient


def sampling(task: Sampling) -> Contestant:
    volume = task.coefficients[None, None]
    n = task.coefficients.shape[-1]
    grid = (task.points * (2 / (n - 1)) - 1)[None, None, None]
    call = lambda: (_sampled(volume, grid).reshape(-1),)  # noqa: E731
    return Contestant(NAME, call, task.computes, samples=len(task.points))


def _sampled(volume: torch.Tensor, grid: torch.Tensor) -> torch.Tensor:
    with torch.no_grad():
        return grid_sample(volume, grid, mode="bicubic", padding_mode="border", align_corners=True)
