"""What a value between samples is made of, along one axis: rows of weights of samples.

    f(x) = Σ_k c_k φ(x − k),   c = p ∗ f   ⇒   f(x) = Σ_j f_j κ(x − j),   κ(x) = Σ_k p_k φ(x − k)

with the samples f_j extended to all integers by the boundary: κ is the *cardinal* kernel, φ itself where there is no
prefilter. Its tails end where they fall below rounding. What stands beyond the ends is a sample again (or 0), so that a
row is one of a sparse matrix, exact at both ends and under every boundary.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import pad

from filterlab.kernels import PiecewisePolynomial
from filterlab.ops.contract import Rows
from filterlab.ops.reference.gather import tap_weights
from filterlab.prefilters import Prefilter
from filterlab.volume import Boundary


@dataclass(frozen=True)
class Given:
    """How samples are reconstructed along an axis.

    Attributes:
        kernel, prefilter, boundary: φ, p, and how samples go on beyond the ends.
        dtype: below whose rounding the tails of weights are left out.
    """

    kernel: PiecewisePolynomial
    prefilter: Prefilter
    boundary: Boundary
    dtype: torch.dtype


def rows_of(x: Tensor, n: int, given: Given) -> Rows:
    """The matrix from n samples to values at x (R,) float64."""
    first, weights = taps(x, given.kernel)
    impulse = x.new_tensor(impulse_response(given.prefilter, given.dtype))
    return folded(first - len(impulse) // 2, convolved(weights, impulse), n, given.boundary)


def reached(x: Tensor, n: int, width: float, boundary: Boundary) -> Rows:
    """The matrix with a 1, or more, wherever a kernel of some width at x (R,) reaches one of n samples."""
    first = (x - width / 2).floor().long() + 1
    return folded(first, x.new_ones(len(x), math.ceil(width)), n, boundary)


def taps(x: Tensor, kernel: PiecewisePolynomial) -> tuple[Tensor, Tensor]:
    """The first integer under a kernel at each x (R,), and φ(x − k) for it and those behind it (R, S)."""
    shifted = x - (kernel.support / 2 - 1)
    first = shifted.floor()
    weights = tap_weights(shifted - first, (kernel, 0), kernel.support)
    return first.long(), torch.stack([weights[t] for t in range(kernel.support)], -1)


@lru_cache(maxsize=64)
def impulse_response(prefilter: Prefilter, dtype: torch.dtype) -> tuple[float, ...]:
    """p_k for |k| ≤ `prefilter.decay(dtype)`: of every pole z the two-sided exponential (1 − z) / (1 + z) z^|k|."""
    reach = prefilter.decay(dtype)
    k = np.abs(np.arange(-reach, reach + 1))
    response = np.where(k == 0, 1.0, 0.0)
    for z in prefilter.poles:
        response = np.convolve(response, (1 - z) / (1 + z) * z**k, "same")
    return tuple(response.tolist())


def convolved(weights: Tensor, impulse: Tensor) -> Tensor:
    """Σ_i impulse_i weights_{k−i}: (R, S) with (P,) to (R, S + P − 1)."""
    longer, shorter = weights, impulse.expand(len(weights), -1)
    if longer.shape[1] < shorter.shape[1]:
        longer, shorter = shorter, longer
    count = shorter.shape[1]
    total = weights.new_zeros(len(weights), longer.shape[1] + count - 1)
    for i in range(count):
        total = total + pad(shorter[:, i, None] * longer, (i, count - 1 - i))
    return total


def folded(first: Tensor, weights: Tensor, n: int, boundary: Boundary) -> Rows:
    """Weights (R, T) of the integers from `first` (R,) on, as weights of n samples that a boundary extends."""
    count, width = weights.shape
    index = first[:, None] + torch.arange(width)
    rows = torch.arange(count)[:, None].expand_as(index)
    kept = ((index >= 0) & (index < n)) if boundary is Boundary.ZEROS else torch.ones_like(index, dtype=torch.bool)
    return Rows.of_entries(rows[kept], boundary.source(index, n)[kept], weights[kept], (count, n))
