"""torch.nn.functional.grid_sample: the trilinear value, and its gradient by autograd."""

from __future__ import annotations

import torch
from torch.nn.functional import grid_sample

from benchmarks.harness import Contestant
from benchmarks.peers.task import Sampling

NAME = "torch grid_sample"


def missing() -> str | None:
    return None


def offers(kernel: str, gradient: bool) -> bool:
    return kernel == "linear"


def sampling(task: Sampling) -> Contestant:
    volume = task.coefficients[None, None]
    n = task.coefficients.shape[-1]
    grid = (task.points * (2 / (n - 1)) - 1)[None, None, None]

    def value() -> tuple[torch.Tensor, ...]:
        with torch.no_grad():
            return (_sampled(volume, grid).reshape(-1),)

    def value_and_gradient() -> tuple[torch.Tensor, ...]:
        x = grid.detach().requires_grad_()
        out = _sampled(volume, x)
        (slope,) = torch.autograd.grad(out, x, torch.ones_like(out))
        return out.detach().reshape(-1), slope.reshape(-1, 3) * (2 / (n - 1))

    return Contestant(
        NAME, value_and_gradient if task.gradient else value, task.computes, _parts, samples=len(task.points)
    )


def _sampled(volume: torch.Tensor, grid: torch.Tensor) -> torch.Tensor:
    return grid_sample(volume, grid, mode="bilinear", padding_mode="border", align_corners=True)


def _parts(result: tuple[torch.Tensor, ...]) -> list[torch.Tensor]:
    value, *gradient = result
    return [value, *(g.T for g in gradient)]
