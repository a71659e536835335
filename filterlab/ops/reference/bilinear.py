"""Casting rays at bilinear quadrilaterals in plain torch: what their programs compute, whatever the device.

Roots are taken by the formulas of `ops.reference.quadrics`, in which nothing cancels. What α, β, γ are off by rounding,
E, moves u by E / 2 s, and points along the edge they are next to by as much of its length: so far may u lie beyond
[0, 1], and a ray pass by an edge that it meets. A ray that touches, β² = αγ but for rounding, hits once, as a front, if
the polynomial is 0 there: of rays along a flat patch and beside it α and β are small, and it is not. One that lies in a
flat patch, or on a line of a bent one, does not hit it: whatever it borders on is met there.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from filterlab.ops.bilinear import ACROSS, CENTER, CORNER, LENGTH, MEETING, PLACE, SQUARE, TWIST, UP, BilinearQuads
from filterlab.ops.quadrics import Kept
from filterlab.ops.reference.quadrics import from_center, stable_roots, walked


def hits(
    given: BilinearQuads, origins: Tensor, directions: Tensor, sheets: int, farthest: bool = False
) -> tuple[Tensor, Tensor]:
    """As of `ops.reference.quadrics.hits`."""
    return walked(given, intersections, origins, directions, sheets, farthest)


class _Patch(NamedTuple):
    """Eight patches and a ray (Q, ·, 8): Q, a, d, h, D; L; what places are off by."""

    from_corner: Tensor
    across: Tensor
    up: Tensor
    twist: Tensor
    along: Tensor
    length: Tensor
    place: Tensor


def intersections(
    leaf: Tensor, start: Tensor, along: Tensor, first: Tensor, last: Tensor, kept: Kept, reversed: bool
) -> Tensor:
    """τ (Q, 8, 2) where rays (Q, 3) meet the patches of leaves (Q, K, 8); ∞ where they don't."""
    u = along.unsqueeze(-1)
    q, behind = from_center(leaf[:, CENTER], start, u)
    patch, turned = _less_parallel(leaf, q - leaf[:, CORNER], u.expand_as(q))
    front, back, one, off = _roots(patch)
    near, far = first[:, None] - behind, last[:, None] - behind
    rho = torch.stack([_along(patch, root, off) for root in (front, back)], -1)
    falls, rises = (torch.where(turned, *which) for which in ((kept.rises, kept.falls), (kept.falls, kept.rises)))
    counts = torch.stack((torch.where(one, kept.touches, falls), ~one & rises), -1)
    within = (rho >= near[..., None]) & (rho <= far[..., None]) & (leaf[:, SQUARE] >= (q * q).sum(1))[..., None]
    return torch.where(within & counts, rho + behind[..., None], torch.inf)


def _less_parallel(leaf: Tensor, from_corner: Tensor, along: Tensor) -> tuple[_Patch, Tensor]:
    """Patches with a and d in that order in which D is less parallel to d and d + h; whether they changed places."""
    across, up, twist = leaf[:, ACROSS], leaf[:, UP], leaf[:, TWIST]
    apart = [torch.minimum(*(_square(_cross(along, edge)) for edge in (line, line + twist))) for line in (across, up)]
    turned = apart[0] > apart[1]
    first, second = (torch.where(turned[:, None], *pair) for pair in ((up, across), (across, up)))
    return _Patch(from_corner, first, second, twist, along, leaf[:, LENGTH], leaf[:, PLACE]), turned


def _roots(patch: _Patch) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """u (Q, 8) of front and back, NaN or infinite where there is none; whether they are one; by what they are off."""
    moment, side = _cross(patch.from_corner, patch.along), _cross(patch.across, patch.along)
    gamma, alpha = _dot(moment, patch.up), -_dot(side, patch.twist)
    beta = (_dot(moment, patch.twist) - _dot(side, patch.up)) / 2
    rounding = patch.length * patch.place
    radicand = beta * beta - alpha * gamma
    slack = rounding * (alpha.abs() + 2 * beta.abs() + gamma.abs())
    s, touches = radicand.sqrt(), radicand.abs() <= slack
    front, back = stable_roots(alpha, beta, gamma, s)
    front = torch.where(touches, -beta / alpha, front)
    off = torch.where(touches, slack.sqrt() / alpha.abs(), rounding / (2 * s))
    in_it = torch.maximum(torch.maximum(alpha.abs(), beta.abs()), gamma.abs()) <= rounding
    u = front.clamp(0, 1)
    beside = touches & (((alpha * u + 2 * beta) * u + gamma).abs() > MEETING * rounding)
    return torch.where(in_it | beside, torch.nan, front), torch.where(in_it, torch.nan, back), touches, off


def _along(patch: _Patch, u: Tensor, off: Tensor) -> Tensor:
    """ρ (Q, 8) where rays meet the lines at u; NaN where u or v is not in [0, 1]."""
    within = (u >= -off) & (u <= 1 + off)
    u = u.clamp(0, 1)
    line, way = patch.up + u[:, None] * patch.twist, u[:, None] * patch.across - patch.from_corner
    n = _cross(patch.along, line)
    square = _square(n)
    v = _dot(_cross(way, patch.along), n) / square
    inner = v.clamp(0, 1)
    point, edge = way + inner[:, None] * line, patch.across + inner[:, None] * patch.twist
    near = (v - inner).abs() * square.sqrt() <= patch.place + 3 * off.clamp_max(1) * _square(edge).sqrt()
    meets = _dot(point, _cross(patch.along, edge)).abs() <= MEETING * patch.length * patch.place
    return torch.where(within & ((v == inner) | (near & meets)), _dot(point, patch.along), torch.nan)


def _dot(x: Tensor, y: Tensor) -> Tensor:
    return (x * y).sum(1)


def _square(x: Tensor) -> Tensor:
    return _dot(x, x)


def _cross(x: Tensor, y: Tensor) -> Tensor:
    return torch.linalg.cross(x, y, dim=1)
