"""Prefilters: what turns samples into the coefficients that a kernel is summed with. `ops.prefilter` computes it.

A prefilter undoes discrete symmetric filters q: c = q⁻¹ ∗ f, P(ω) = Π 1 / q̂(ω). Written with its poles z (|z| < 1) the
inverse of one factor is the symmetric two-sided exponential

    c_k = gain · Σ_j z^|k−j| f_j,        gain = (1 − z)²  per pole,  after which a constant stays what it was,

computed as one causal and one anticausal first-order recursion: O(n) per line.

The boundary has no code here. A line is first extended by the boundary's own rule, far enough that what lies beyond
(|z|^length below rounding) does not matter; then the recursions start from zero. So every boundary is exact, at both
ends, for axes of 1, 2, 3, … voxels. Under mirror, reflect and wrap the coefficients extend as the samples do. Under
border and zeros they do not: they have a tail that decays like |z|^k outside, which is kept (`tail` of
`prefilter_axis`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from fractions import Fraction
from functools import cached_property

import numpy as np
import torch
from torch import Tensor

from filterlab.kernels import Kernel, bspline


@dataclass(frozen=True)
class Prefilter:
    """The inverse of a cascade of symmetric discrete filters.

    Attributes:
        name: as in the registry.
        factors: each factor (q₀, q₁, …) stands for q̂(ω) = q₀ + 2 Σ_k q_k cos(kω); q̂(0) = 1. Empty: the identity.
    """

    name: str
    factors: tuple[tuple[Fraction, ...], ...] = ()

    @cached_property
    def poles(self) -> tuple[float, ...]:
        """The poles inside the unit circle, with multiplicity, factor by factor."""
        return tuple(z for factor in self.factors for z in _poles_inside(factor))

    @property
    def is_identity(self) -> bool:
        return len(self.factors) == 0

    def response(self, omega: Tensor) -> Tensor:
        """P(ω) = Π 1 / q̂(ω); ω in radians per voxel."""
        out = torch.ones_like(omega)
        for factor in self.factors:
            q = torch.full_like(omega, float(factor[0]))
            for k, c in enumerate(factor[1:], start=1):
                q = q + 2 * float(c) * torch.cos(k * omega)
            out = out / q
        return out

    def decay(self, dtype: torch.dtype) -> int:
        """Voxels after which the influence of a sample has fallen below the rounding of `dtype`."""
        if self.is_identity:
            return 0
        slowest = max(abs(z) for z in self.poles)
        return math.ceil(math.log(torch.finfo(dtype).eps / 16) / math.log(slowest)) + 2 * len(self.poles)


def _poles_inside(factor: tuple[Fraction, ...]) -> list[float]:
    """The roots inside the unit circle of q₀ + Σ q_k (z^k + z^−k), all real for B-splines; polished by Newton's method.

    Raises ValueError when a root lies on the circle (q̂ vanishes somewhere and cannot be inverted) or is not real.
    """
    p = np.array([float(c) for c in (*factor[:0:-1], *factor)])
    roots = np.roots(p)
    taps = ", ".join(str(c) for c in factor)
    if np.any(np.abs(np.abs(roots) - 1) < 1e-6):
        raise ValueError(f"the discrete filter ({taps}) has a zero in its response: no inverse exists")
    if np.any(np.abs(roots.imag) > 1e-9):
        raise ValueError(f"the discrete filter ({taps}) has poles that are not real; such a prefilter is not offered")
    slope = np.polyder(p)
    inside = []
    for z in sorted(r.real for r in roots if abs(r) < 1):
        for _ in range(3):
            z -= np.polyval(p, z) / np.polyval(slope, z)
        inside.append(float(z))
    return inside


def interpolation(kernel: Kernel) -> Prefilter:
    """The prefilter with which a kernel interpolates: the inverse of its integer samples (paper, eqs. 16-19).

    Raises ValueError for a kernel that is not symmetric, or whose integer samples do not sum to 1.
    """
    if kernel.interpolating:
        return IDENTITY
    samples = kernel.integer_samples()
    if not kernel.symmetric or sum(samples.values()) != 1:
        listed = ", ".join(str(v) for v in samples.values())
        raise ValueError(
            f"a prefilter is derived for symmetric kernels whose integer samples sum to 1; {kernel.name} has ({listed})"
        )
    reach = max(k for k, value in samples.items() if value)
    taps = tuple(samples[k] for k in range(reach + 1))
    return Prefilter(f"{kernel.name}-interpolation", (taps,))


IDENTITY = Prefilter("identity")
QUADRATIC = Prefilter("quadratic", interpolation(bspline(2)).factors)
CUBIC = Prefilter("cubic", interpolation(bspline(3)).factors)
QUARTIC = Prefilter("quartic", interpolation(bspline(4)).factors)
QUINTIC = Prefilter("quintic", interpolation(bspline(5)).factors)
# paper, section 3.3: q_notch = q_quad ∗ q_quad; quasi-interpolation of order three
NOTCH = Prefilter("notch", QUADRATIC.factors * 2)

PREFILTERS: dict[str, Prefilter] = {p.name: p for p in (IDENTITY, QUADRATIC, CUBIC, QUARTIC, QUINTIC, NOTCH)}


def named(prefilter: str | Prefilter) -> Prefilter:
    """The prefilter of that name, or the prefilter itself. Raises ValueError that lists the known names."""
    if isinstance(prefilter, Prefilter):
        return prefilter
    if prefilter not in PREFILTERS:
        raise ValueError(f"unknown prefilter {prefilter!r}; known prefilters: {', '.join(PREFILTERS)}")
    return PREFILTERS[prefilter]
