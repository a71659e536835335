"""The best estimate of a signal that its samples allow: a spline of high degree that needs no boundary.

Letters: n samples along an axis, degree p (odd), h = (p − 1) / 2 coefficients beyond each end. A spline on the integers
has n + 2h coefficients c, of which n are fixed by the samples. The other 2h are by asking that the coefficients go on
as a polynomial of degree q − 1 at both ends, Δ^q c = 0, so that polynomials of that degree are reproduced up to the
ends and no extension of the samples has to be right. A lower q is less accurate there and magnifies noise less.

Source: de Boor, A Practical Guide to Splines, 2001, chapter IV (the not-a-knot end condition).
"""

from __future__ import annotations

import math
from functools import lru_cache

import torch
from torch import Tensor

from filterlab.fields.base import Field
from filterlab.kernels import bspline
from filterlab.methods import reconstruct
from filterlab.volume import Volume

ORDER = 4  # q


def endless_spline(samples: Tensor, degree: int) -> Field:
    """The spline of an odd degree through samples `(D, H, W)`, in voxel coordinates; float64, between the first and
    the last sample of every axis. Along an axis of one voxel it is constant."""
    coefficients = samples.double()
    for dim, n in enumerate(samples.shape):
        matrix = _coefficients_of_samples(n, degree).to(coefficients.device)
        coefficients = (matrix @ coefficients.movedim(dim, -2)).movedim(-2, dim)
    start = -float(degree // 2)
    return reconstruct(Volume(coefficients.contiguous(), origin=(start,) * 3), bspline(degree), prefilter=False)


@lru_cache(maxsize=32)
def _coefficients_of_samples(n: int, degree: int) -> Tensor:
    """The matrix (n + 2h, n) from samples along an axis to coefficients −h … n − 1 + h."""
    beyond = degree // 2
    count = n + 2 * beyond
    if n == 1:
        return torch.ones(count, 1, dtype=torch.float64)
    weights = bspline(degree)(torch.arange(-beyond, beyond + 1, dtype=torch.float64))
    order = min(ORDER, n)
    signed = [(-1.0) ** (order - j) * math.comb(order, j) for j in range(order + 1)]
    difference = torch.tensor(signed, dtype=torch.float64)
    system = torch.zeros(count, count, dtype=torch.float64)
    for i in range(n):
        system[beyond + i, i : i + 2 * beyond + 1] = weights
    for i in range(beyond):
        system[i, i : i + order + 1] = difference
        system[count - 1 - i, count - 1 - i - order : count - i] = difference.flip(0) * (-1.0) ** order
    return torch.linalg.inv(system)[:, beyond : beyond + n].contiguous()
