"""The prefilter in plain torch, one recursion after the other: any device and any transform."""

from __future__ import annotations

from itertools import pairwise

import torch
from torch import Tensor

from filterlab.ops.prefilter import Filtering


def filter_axes(samples: Tensor, how: Filtering) -> Tensor:
    """Coefficients; torch differentiates it by itself, any number of times."""
    out = samples.to(torch.promote_types(samples.dtype, torch.float32))
    warm_up = how.prefilter.decay(out.dtype)
    for dim in how.dims:
        lines = how.boundary.extend(out, dim, how.tail + warm_up, how.tail + warm_up).movedim(dim, 0).contiguous()
        for pole in how.prefilter.poles:
            lines = _two_sided_exponential(lines, pole)
        out = lines[warm_up : lines.shape[0] - warm_up].movedim(0, dim)
    return out


class _TwoSidedExponential(torch.autograd.Function):
    """A causal and an anticausal recursion along axis 0, both started from zero.

    With L the causal one as a matrix this is y = (1−z)² Lᵀ L x: symmetric, so it is its own adjoint, exactly.
    """

    @staticmethod
    def forward(x: Tensor, pole: float) -> Tensor:
        y = x * (1 - pole) ** 2
        rows = y.unbind(0)
        for previous, row in pairwise(rows):
            row.add_(previous, alpha=pole)
        for following, row in pairwise(reversed(rows)):
            row.add_(following, alpha=pole)
        return y

    @staticmethod
    def setup_context(ctx, inputs, output) -> None:
        ctx.pole = inputs[1]

    @staticmethod
    def backward(ctx, *gradients: Tensor):
        return _two_sided_exponential(gradients[0], ctx.pole), None

    @staticmethod
    def jvp(ctx, *tangents):
        return _two_sided_exponential(tangents[0], ctx.pole)

    @staticmethod
    def vmap(info, in_dims, x: Tensor, pole: float):
        return _two_sided_exponential(x.movedim(in_dims[0], -1), pole), x.ndim - 1


def _two_sided_exponential(x: Tensor, pole: float) -> Tensor:
    return _TwoSidedExponential.apply(x, pole)  # type: ignore[return-value]
