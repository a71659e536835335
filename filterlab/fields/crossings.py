"""Where functions that are no polynomials cross a level along rays: intervals are halved until what is known decides.

With h half the length of an interval, m its middle, and f and f' along the ray,

    |f(m)| > min(σ h, |f'(m)| h + β h² / 2)      nothing is crossed in it
    |f'(m)| > β h                                f is monotone: signs at its ends tell of the one crossing, or of none
    h is at the resolution                       as if it were monotone
    else                                         halves

with σ ≥ |f'| and β ≥ |f''|. So every crossing is found, but for pairs nearer to each other than the resolution; places
where f touches the level without crossing it are none. Source: Kalra & Barr, Guaranteed ray intersections with implicit
surfaces, 1989.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

_FINEST, _FINER = 2.0**-40, 2.0**-24  # resolution, of the way in the domain: where β is known, where it is not

Along = Callable[[Tensor, Tensor], tuple[Tensor, Tensor]]
"""Numbers of rays (M,) and places t (M,) -> f − level and its derivative by t, (M,) float64."""


@dataclass(frozen=True)
class Bounds:
    """What is known of a function in its domain.

    Attributes:
        slope: σ ≥ |∇f|, per world unit.
        bend: β ≥ |second derivative| along any direction of length 1; ∞: not known.
    """

    slope: float
    bend: float = math.inf

    @property
    def resolution(self) -> float:
        """Of the way in the domain; crossings that are nearer to each other may be lost in pairs."""
        return _FINEST if self.bend < math.inf else _FINER


def crossings(along: Along, length: Tensor, speed: Tensor, bounds: Bounds, first: bool) -> tuple[Tensor, Tensor]:
    """All crossings of rays with 0 on [0, length]: numbers of rays (M,) and t (M,), ray by ray, in order.

    Args:
        along: f on the rays.
        length: (R,) float64, in units of t. speed: (R,), world units per unit of t.
        bounds: of f in the world.
        first: crossings behind the first one of a ray may be left out.
    """
    ray = torch.arange(len(length), device=length.device)
    a, b, nearest = torch.zeros_like(length), length, torch.full_like(length, math.inf)
    found = [_at_start(along, ray)]
    while len(ray):
        m, h = (a + b) / 2, (b - a) / 2
        value, slope = along(ray, m)
        bend = bounds.bend * speed[ray] ** 2
        reach = torch.minimum(bounds.slope * speed[ray] * h, slope.abs() * h + bend * h * h / 2)
        may_hold = ~(value.abs() > reach * _ROUNDED) & (a <= nearest[ray])
        decided = (slope.abs() > bend * h) | (h <= bounds.resolution * length[ray])
        found.append(_in(along, *(x[may_hold & decided] for x in (ray, a, b))))
        if first:
            nearest.scatter_reduce_(0, *found[-1], "amin")
        on = may_hold & ~decided
        ray, a, b = torch.cat((ray[on],) * 2), torch.cat((a[on], m[on])), torch.cat((m[on], b[on]))
    return _in_order(*(torch.cat(x) for x in zip(*found, strict=True)))


def stepped(along: Along, length: Tensor, speed: Tensor, step: float) -> tuple[Tensor, Tensor]:
    """Crossings between places no more than `step` world units apart at which signs differ; else as `crossings`."""
    parts = (length * speed / step).ceil().clamp_min(1).long()
    ray = torch.repeat_interleave(torch.arange(len(length), device=length.device), parts)
    place = torch.arange(len(ray), device=ray.device) - (parts.cumsum(0) - parts)[ray]
    a, b = (length[ray] * ((place + k) / parts[ray]) for k in (0, 1))
    found = [_at_start(along, torch.arange(len(length), device=length.device)), _in(along, ray, a, b)]
    return _in_order(*(torch.cat(x) for x in zip(*found, strict=True)))


_ROUNDED = 1 + 1e-9  # bounds are rounded too


def _at_start(along: Along, ray: Tensor) -> tuple[Tensor, Tensor]:
    """Rays that begin on the level."""
    zero = torch.zeros(len(ray), dtype=torch.float64, device=ray.device)
    on_it = along(ray, zero)[0] == 0
    return ray[on_it], zero[on_it]


def _in(along: Along, ray: Tensor, a: Tensor, b: Tensor) -> tuple[Tensor, Tensor]:
    """The crossing of each interval at whose ends signs differ."""
    differ = (along(ray, a)[0] > 0) != (along(ray, b)[0] > 0)
    ray, a, b = ray[differ], a[differ], b[differ]
    within = root_between(lambda t, i: along(ray[i], torch.lerp(a[i], b[i], t))[0], len(ray), ray.device)
    return ray, torch.lerp(a, b, within)


def _in_order(ray: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Ray by ray; what two intervals found where they meet is one."""
    order = t.argsort(stable=True)
    order = order[ray[order].argsort(stable=True)]
    ray, t = ray[order], t[order]
    again = torch.zeros_like(ray, dtype=torch.bool)
    again[1:] = (ray[1:] == ray[:-1]) & (t[1:] - t[:-1] <= 4 * torch.finfo(t.dtype).eps * t[1:])
    return ray[~again], t[~again]


def root_between(value: Callable[[Tensor, Tensor], Tensor], count: int, device: torch.device | None) -> Tensor:
    """t (count,) in [0, 1] where functions vanish, by Chandrupatla's method, until no float lies between.

    Where rounding has both ends on one side, the function vanishes at one of them within rounding: the nearer is taken.

    Args:
        value: t (M,) and the numbers of functions (M,) -> (M,).
    """
    from scipy.optimize.elementwise import find_root

    def of_numpy(t: np.ndarray, number: np.ndarray) -> np.ndarray:
        given = (torch.from_numpy(np.ascontiguousarray(x)).to(device) for x in (t, number))
        return value(*given).double().cpu().numpy()

    if not count:
        return torch.zeros(0, dtype=torch.float64, device=device)
    numbers = np.arange(count)
    zero, one = np.zeros(count), np.ones(count)
    found = find_root(of_numpy, (zero, one), args=(numbers,), tolerances={"xatol": 2.0**-53})
    at_ends = np.where(abs(of_numpy(zero, numbers)) <= abs(of_numpy(one, numbers)), zero, one)
    return torch.from_numpy(np.where(found.status == _SAME_SIDE, at_ends, found.x)).to(device)


_SAME_SIDE = -1  # as scipy says it
