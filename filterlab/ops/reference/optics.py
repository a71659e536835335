"""What a sample looks like, in plain torch: transfer functions, absorption, shading.

Letters: v a field's value; x_j the control points; α opacity; s a world length; τ optical depth; n the normal, the
gradient made a unit vector; l the direction to a light, h halfway between it and the viewer.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor


class OnTable(NamedTuple):
    """Where values fall between control points: interval `(...)` (integer) and fraction `(...)` in 0 … 1."""

    interval: Tensor
    fraction: Tensor

    def at(self, index: Tensor) -> OnTable:
        """Those of some of the values `(S,)`."""
        return OnTable(self.interval.index_select(0, index), self.fraction.index_select(0, index))


class Table:
    """M control points: colour and opacity are linear in between and constant beyond both ends.

    Attributes:
        positions: `(M,)` increasing scalars x_j.
        colors: `(M, 3)` linear RGB.
        opacities: `(M,)` opacities per `unit`, 0 … 1; 1 is exactly opaque.
        unit: the world length that the opacities are for.
    """

    def __init__(self, positions: Tensor, colors: Tensor, opacities: Tensor, unit: float) -> None:
        self.positions, self.colors, self.opacities, self.unit = positions, colors, opacities, unit

    @property
    def transparent_somewhere(self) -> bool:
        """True when some value has opacity 0."""
        return bool((self.opacities == 0).any())

    @property
    def opaque_somewhere(self) -> bool:
        """True when some value has opacity 1."""
        return bool((self.opacities >= 1).any())

    def locate(self, value: Tensor) -> OnTable:
        """Between which control points the values `(...)` lie; the one search that opacity and colour share."""
        x = self.positions
        if len(x) == 1:
            return OnTable(torch.zeros_like(value, dtype=torch.int32), torch.zeros_like(value) * value)
        interval = torch.searchsorted(
            x[1:-1].detach().contiguous(), value.detach().contiguous(), right=True, out_int32=True
        )
        fraction = (value - _take(x[:-1], interval)) / _take(x.diff(), interval)
        return OnTable(interval, fraction.clamp(0, 1))

    def opacity(self, located: OnTable) -> Tensor:
        """Opacities per unit, `(...)`."""
        return _interpolated(self.opacities, located.interval, located.fraction)

    def color(self, located: OnTable) -> Tensor:
        """Linear RGB, `(..., 3)`."""
        return _interpolated(self.colors, located.interval, located.fraction[..., None])

    def optical_depth(self, opacity: Tensor, length: Tensor) -> Tensor:
        """τ = −log1p(−α) · length / unit, `(...)`; ∞ for α = 1 over any length > 0, with derivative 0 there."""
        length = length / self.unit
        if not self.opaque_somewhere:
            return -torch.log1p(-opacity) * length
        opaque = opacity >= 1
        depth = -torch.log1p(-torch.where(opaque, torch.zeros_like(opacity), opacity)) * length
        return torch.where(opaque & (length > 0), torch.full_like(depth, torch.inf), depth)


def _interpolated(table: Tensor, interval: Tensor, fraction: Tensor) -> Tensor:
    if len(table) == 1:
        return _take(table, interval) + 0 * fraction
    return torch.lerp(_take(table[:-1], interval), _take(table[1:], interval), fraction)  # exact at both ends


def _take(table: Tensor, interval: Tensor) -> Tensor:
    return table.index_select(0, interval.reshape(-1)).reshape(interval.shape + table.shape[1:])


def absorbed(depth: Tensor) -> Tensor:
    """1 − e^{−τ}, the opacity of optical depths τ ≥ 0, `(...)`; derivatives too keep their digits at both ends.

    torch takes the derivative of expm1 as its value plus 1, of which nothing is left where the value is near −1.
    """
    return torch.where(depth > 1, 1 - torch.exp(-depth), -torch.expm1(-depth))


def shade(
    color: Tensor,
    gradient: Tensor,
    ambient: Tensor,
    shininess: Tensor,
    diffuse: Tensor,
    specular: Tensor,
    toward: Tensor,
    halfway: Tensor,
) -> Tensor:
    """Two-sided Blinn-Phong, rgb · (ambient + Σ_k D_k |n·l_k|) + Σ_k S_k |n·h_k|^shininess, `(S, 3)`.

    Args:
        color, gradient: `(S, 3)`; a gradient of zero has no normal, and no derivative.
        ambient, shininess: numbers.
        diffuse, specular: `(K, 3)`, D and S: colours of the lights times the weights of either kind of reflection.
        toward, halfway: `(S, K, 3)` unit vectors l and h.

    Source: Blinn, Models of light reflection for computer synthesized pictures, 1977.
    """
    normal = safe_normalize(gradient)[:, None]
    facing, half = dot(normal, toward).abs()[..., None], power(dot(normal, halfway).abs(), shininess)[..., None]
    return color * (ambient + (diffuse * facing).sum(1)) + (specular * half).sum(1)


def safe_normalize(vector: Tensor) -> Tensor:
    """vector / |vector| along the last axis, and 0 (with derivative 0) for the zero vector.

    Vectors are first divided by their largest component, held constant: the result does not depend on the scale, so its
    derivatives of every order are unchanged, while neither tiny nor huge vectors under- or overflow.
    """
    largest = vector.detach().abs().amax(-1, keepdim=True)
    zero = largest == 0
    scaled = vector / torch.where(zero, torch.ones_like(largest), largest)
    scaled = torch.where(zero, torch.zeros_like(scaled), scaled)
    squared = dot(scaled, scaled)[..., None]
    return scaled / torch.where(zero, torch.ones_like(squared), squared).sqrt()


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Σ_d a_d b_d in the order x, y, z, whatever the number of vectors: a reduction might regroup."""
    return a[..., 0] * b[..., 0] + a[..., 1] * b[..., 1] + a[..., 2] * b[..., 2]


def power(base: Tensor, exponent: Tensor) -> Tensor:
    """base^exponent for 0 ≤ base ≤ 1, and 0 with derivative 0 at 0 (where 1 < exponent < 2 has no second one).

    A cosine that is rounded to more than 1 is 1: a large exponent would make it infinite.
    """
    positive = base != 0
    base = base - (base.detach() - 1).clamp_min(0)
    return torch.where(positive, torch.where(positive, base, torch.ones_like(base)) ** exponent, torch.zeros_like(base))
