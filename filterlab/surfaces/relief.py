"""What the ground is like at points: slope, aspect and curvatures, from the derivatives of the height there.

Letters, as in geomorphometry: p = ∂z/∂x, q = ∂z/∂y, r = ∂²z/∂x², s = ∂²z/∂x∂y, t = ∂²z/∂y²; x to the east, y to the
north, z up, all three in one unit of length. Angles are in radians, curvatures per unit of length, positive where the
ground is convex: a dome of radius R has mean curvature 1/R.

    steepness    S = p² + q²,    stretch  E = 1 + p² + q²
    down         D = p² r + 2 p q s + q² t,    across  A = q² r − 2 p q s + p² t

| measure | formula | what it is |
|---|---|---|
| slope | atan √S | the steepest angle with the horizontal |
| aspect | atan2(−p, −q) | where it falls most steeply, clockwise from north |
| profile curvature | −D / (S E^³ᐟ²) | of the section down the slope: water speeds up where it is positive |
| tangential curvature | −A / (S E^½) | of the normal section across the slope: water parts where it is positive |
| plan curvature | −A / S^³ᐟ² | of the contour line |
| mean curvature | −((1 + q²) r − 2 p q s + (1 + p²) t) / (2 E^³ᐟ²) | half of profile and tangential curvature |
| Gaussian curvature | (r t − s²) / E² | the product of the principal curvatures |

Zevenbergen and Thorne's profile and plan curvatures, −D / S and −A / S, are second derivatives of z, not curvatures of
lines; where the ground is almost level they are the profile and tangential curvatures here.

Source: Florinsky, Digital Terrain Analysis, 2nd edition 2016, chapter 2 (slope, aspect, kv, kh, kp, H, K); Zevenbergen
& Thorne, Quantitative analysis of land surface topography, 1987.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor


@dataclass(frozen=True)
class Relief:
    """A jet of the height, and what follows from it. Differentiable; NaN in holes.

    Where the ground is level there is no direction down: aspect is NaN there, and profile, tangential and plan
    curvature are 0.

    Attributes:
        height: z (*P).
        gradient: (p, q) (*P, 2).
        hessian: ((r, s), (s, t)) (*P, 2, 2); None where curvatures are not asked.
    """

    height: Tensor
    gradient: Tensor
    hessian: Tensor | None = None

    @property
    def slope(self) -> Tensor:
        """(*P) from 0 to π/2."""
        return torch.where(self._level, 0.0, self._steepness.sqrt()).atan()

    @property
    def aspect(self) -> Tensor:
        """(*P) from 0 to 2π: 0 north, π/2 east."""
        p, q = torch.where(self._level[..., None], 1.0, self.gradient).unbind(-1)
        return torch.where(self._level, torch.nan, torch.atan2(-p, -q).remainder(2 * torch.pi))

    @property
    def profile_curvature(self) -> Tensor:
        """(*P) of the vertical section down the slope, kv."""
        return -self._down / (self._steepness * self._stretch**1.5)

    @property
    def tangential_curvature(self) -> Tensor:
        """(*P) of the normal section across the slope, kh."""
        return -self._across / (self._steepness * self._stretch**0.5)

    @property
    def plan_curvature(self) -> Tensor:
        """(*P) of the contour line, kp."""
        return -self._across / self._steepness**1.5

    @property
    def mean_curvature(self) -> Tensor:
        """(*P) half the sum of the principal curvatures, H."""
        p, q, r, s, t = self._letters
        return -((1 + q * q) * r - 2 * p * q * s + (1 + p * p) * t) / (2 * self._stretch**1.5)

    @property
    def gaussian_curvature(self) -> Tensor:
        """(*P) the product of the principal curvatures, K."""
        _, _, r, s, t = self._letters
        return (r * t - s * s) / self._stretch**2

    @property
    def _letters(self) -> tuple[Tensor, ...]:
        if self.hessian is None:
            raise ValueError("curvatures need a relief of order 2; got one of order 1")
        (p, q), (r, s, _, t) = self.gradient.unbind(-1), self.hessian.flatten(-2).unbind(-1)
        return p, q, r, s, t

    @property
    def _down(self) -> Tensor:
        p, q, r, s, t = self._letters
        return p * p * r + 2 * p * q * s + q * q * t

    @property
    def _across(self) -> Tensor:
        p, q, r, s, t = self._letters
        return q * q * r - 2 * p * q * s + p * p * t

    @property
    def _level(self) -> Tensor:
        return (self.gradient.detach() == 0).all(-1)

    @property
    def _steepness(self) -> Tensor:
        """p² + q², and 1 where it is level."""
        return torch.where(self._level, 1.0, (self.gradient * self.gradient).sum(-1))

    @property
    def _stretch(self) -> Tensor:
        """1 + p² + q²: the square of how much larger the ground is than its map."""
        return 1 + (self.gradient * self.gradient).sum(-1)
