"""Casting rays at quadrics in plain torch: what their programs compute, whatever the device.

With s = √(β² − αγ), front is where F goes from + to −, α ρ + β = −s:

    front    β ≤ 0: γ / (s − β)    β > 0: −(β + s) / α
    back     β ≤ 0: (s − β) / α    β > 0: −γ / (β + s)

No term cancels, and there is no case for small α: then one of them is the root of a linear equation, the other goes off
to infinity and is clipped away. What rounding cannot tell from 0 is 0:

    β² = αγ            the ray touches the surface: one hit, a front, at −β / α
    α = β = γ = 0      it lies on the surface: one hit, a front, where it enters the ball and its planes

so that double planes, apices of cones and tangents are hit. Pairs of rays and nodes are kept on a stack, the nearest on
top, and those behind a ray's last hit are dropped: memory does not grow with the number of quadrics.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import torch
from torch import Tensor

from filterlab.ops.quadrics import (
    CENTER,
    CONSTANT,
    MATRIX,
    PLANES,
    ROUNDINGS,
    SIZES,
    SMALLEST,
    SQUARE,
    VECTOR,
    InLeaves,
    Kept,
    Quadrics,
    Rays,
    in_parts,
)

PAIRS_AT_ONCE = 1 << 14  # of rays and nodes, or leaves
_RAYS_AT_ONCE = 1 << 18

Meets = Callable[[Tensor, Tensor, Tensor, Tensor, Tensor, Kept, bool], Tensor]
"""What `intersections` is, of whatever is in leaves."""


def hits(
    given: Quadrics, origins: Tensor, directions: Tensor, sheets: int, farthest: bool = False
) -> tuple[Tensor, Tensor]:
    """t (R, k) float64 of the first hits of rays (R, 3) in order, or the last ones from the last on; ∞ where no more.

    Returns:
        t, and numbers of the quadrics (R, k) int64, −1 where none is hit.
    """
    return walked(given, intersections, origins, directions, sheets, farthest)


def walked(
    given: InLeaves, meets: Meets, origins: Tensor, directions: Tensor, sheets: int, farthest: bool
) -> tuple[Tensor, Tensor]:
    """The same of whatever is in the leaves of a tree, and meets rays as that function says."""
    cast = lambda o, d: _of_part(given, meets, o, d, sheets, farthest)  # noqa: E731
    t, piece = in_parts(cast, origins, directions, _RAYS_AT_ONCE)
    return t, piece


def _of_part(
    given: InLeaves, meets: Meets, origins: Tensor, directions: Tensor, sheets: int, farthest: bool
) -> tuple[Tensor, Tensor]:
    rays = Rays.of(given.tree, origins, directions, farthest)
    table = _Table.of_rays(rays, sheets)
    walk(given, meets, rays, table)
    return rays.t(table.tau), given.tree.numbers(table.place)


class Taking(Protocol):
    """Who is told of hits on a walk."""

    @property
    def limit(self) -> Tensor:
        """τ (R,): hits behind it need not be told."""
        ...

    def take(self, ray: Tensor, tau: Tensor, place: Tensor) -> None:
        """Hits (M,) in no order: numbers of rays, τ, and places of what is hit."""
        ...


def walk(given: InLeaves, meets: Meets, rays: Rays, found: Taking) -> None:
    """Tells of every hit before its limit, the nearest leaves first, more or less."""
    stack = _Pairs.at_root(rays).split()
    while stack:
        pairs = stack.pop()
        pairs = pairs.some(pairs.near <= found.limit[pairs.ray])
        if not len(pairs.ray):
            continue
        inner = pairs.some(pairs.node >= 0)
        if len(inner.ray):
            stack += _below(given, rays, inner).split()
        leaves = pairs.some(pairs.node < 0)
        if len(leaves.ray):
            found.take(*_in_leaves(given, meets, rays, leaves.ray, -1 - leaves.node))


class _Pairs(NamedTuple):
    """Rays and nodes that they may hit something in: numbers of rays (Q,), of nodes, or −1 − those of leaves, and where
    they enter their boxes, τ (Q,)."""

    ray: Tensor
    node: Tensor
    near: Tensor

    @classmethod
    def at_root(cls, rays: Rays) -> _Pairs:
        going = (rays.first <= rays.last).nonzero()[:, 0]
        return cls(going, torch.zeros_like(going), rays.first[going])

    def some(self, which: Tensor) -> _Pairs:
        return _Pairs(*(x[which] for x in self))

    def split(self) -> list[_Pairs]:
        """Some at a time, the nearest last."""
        if len(self.ray) <= PAIRS_AT_ONCE:
            return [self]
        order = self.near.argsort(descending=True)
        return [_Pairs(*rows) for rows in zip(*(x[order].split(PAIRS_AT_ONCE) for x in self), strict=True)]


def _below(given: InLeaves, rays: Rays, pairs: _Pairs) -> _Pairs:
    """The children whose boxes are met."""
    start, along = rays.start[pairs.ray], rays.along[pairs.ray]
    along = torch.where(along.abs() < SMALLEST, SMALLEST, along)
    lower, upper = given.tree.boxes[pairs.node].double().unflatten(1, (2, 3)).unbind(1)  # (Q, 3, 8) each
    forward = (along > 0)[..., None]
    near, far = (
        (torch.where(forward, *ends) - start[..., None]) / along[..., None] for ends in ((lower, upper), (upper, lower))
    )
    near = torch.maximum(near.amax(1), rays.first[pairs.ray, None])
    far = torch.minimum(far.amin(1), rays.last[pairs.ray, None])
    pair, child = (near <= far).nonzero().unbind(1)
    first = given.tree.children[pairs.node].long()[pair]
    return _Pairs(pairs.ray[pair], torch.where(first < 0, first - child, first + child), near[pair, child])


def _in_leaves(given: InLeaves, meets: Meets, rays: Rays, ray: Tensor, leaf: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """All hits of rays in leaves (Q,): numbers of rays, τ, and places (M,)."""
    start, along, first, last = (x[ray] for x in (rays.start, rays.along, rays.first, rays.last))
    kept = given.kept(rays.reversed)
    tau = meets(given.leaves[leaf], start, along, first, last, kept, rays.reversed)
    pair, lane, _ = hit = (tau < torch.inf).nonzero().unbind(1)
    return ray[pair], tau[hit], given.leaves.shape[-1] * leaf[pair] + lane


def intersections(
    leaf: Tensor, start: Tensor, along: Tensor, first: Tensor, last: Tensor, kept: Kept, reversed: bool
) -> Tensor:
    """τ (Q, 8, 2) where rays (Q, 3) meet the quadrics of leaves (Q, K, 8): front and back; ∞ where they don't."""
    u = along.unsqueeze(-1)
    q, behind = from_center(leaf[:, CENTER], start, u)
    near, far = _clipped(leaf, q, u, first[:, None] - behind, last[:, None] - behind)
    front, back, one = _roots(leaf, q, u, far if reversed else near)
    counts = torch.stack((torch.where(one, kept.touches, kept.falls), ~one & kept.rises), -1)
    roots = torch.stack((front, back), -1)
    within = (roots >= near[..., None]) & (roots <= far[..., None])
    return torch.where(within & counts, roots + behind[..., None], torch.inf)


def from_center(center: Tensor, start: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """q (Q, 3, 8), the points of rays (Q, 3), along u (Q, 3, 1), nearest to centres, from there; and τ of them."""
    p = start.unsqueeze(-1) - center
    behind = -(p * u).sum(1)
    return p + behind[:, None] * u, behind


def _clipped(leaf: Tensor, q: Tensor, u: Tensor, first: Tensor, last: Tensor) -> tuple[Tensor, Tensor]:
    """Between which ρ (Q, 8) rays are in the ball, between all planes and within their ends; NaN: never."""
    half = (leaf[:, SQUARE] - (q * q).sum(1)).sqrt()
    near, far = torch.maximum(-half, first), torch.minimum(half, last)
    for plane in leaf[:, PLANES:].unflatten(1, (-1, 4)).unbind(1) if leaf.shape[1] > PLANES else ():
        speed = (plane[:, :3] * u).sum(1)
        height = (plane[:, :3] * q).sum(1) + plane[:, 3]
        at = -height / speed
        near = torch.where(speed < 0, torch.maximum(near, at), near)
        far = torch.where(speed > 0, torch.minimum(far, at), far)
        far = torch.where((speed == 0) & (height > 0), torch.nan, far)
    return near, far


def _roots(leaf: Tensor, q: Tensor, u: Tensor, entry: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """ρ (Q, 8) of front and back, wherever they are, NaN or infinite where there is none; and whether they are one."""
    a, b, c = leaf[:, MATRIX], leaf[:, VECTOR], leaf[:, CONSTANT]
    turned = _times(a, q)
    alpha = (u * _times(a, u)).sum(1)
    beta = (u * (turned + b)).sum(1)
    gamma = (q * (turned + 2 * b)).sum(1) + c
    size_a, size_b = leaf[:, SIZES].unbind(1)
    reach = (q * q).sum(1).sqrt()
    size_beta = size_a * reach + size_b
    size_gamma = reach * (size_beta + size_b) + c.abs()
    rounding = ROUNDINGS * torch.finfo(leaf.dtype).eps
    radicand = beta * beta - alpha * gamma
    slack = rounding * (2 * beta.abs() * size_beta + size_a * gamma.abs() + alpha.abs() * size_gamma)
    front, back = stable_roots(alpha, beta, gamma, radicand.sqrt())
    touches = radicand.abs() <= slack
    on = (alpha.abs() <= rounding * size_a) & (beta.abs() <= rounding * size_beta)
    on = on & (gamma.abs() <= rounding * size_gamma)
    front = torch.where(on, entry, torch.where(touches, -beta / alpha, front))
    return front, back, on | touches


def stable_roots(alpha: Tensor, beta: Tensor, gamma: Tensor, s: Tensor) -> tuple[Tensor, Tensor]:
    """Front and back of α ρ² + 2 β ρ + γ = 0, s = √(β² − αγ): those with α ρ + β = −s and s."""
    receding = beta > 0
    front = torch.where(receding, -(beta + s) / alpha, gamma / (s - beta))
    return front, torch.where(receding, -gamma / (beta + s), (s - beta) / alpha)


def _times(a: Tensor, x: Tensor) -> Tensor:
    """A x (Q, 3, 8) of entries xx, yy, zz, xy, xz, yz (Q, 6, 8)."""
    xx, yy, zz, xy, xz, yz = a.unbind(1)
    x, y, z = x.expand(-1, -1, a.shape[-1]).unbind(1)
    return torch.stack((xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z), 1)


class _Table:
    """The best hits of every ray so far, in order.

    Attributes:
        tau: (R, k), ∞ where there are no more yet.
        place: (R, k) of the quadrics.
    """

    def __init__(self, tau: Tensor, place: Tensor) -> None:
        self.tau, self.place = tau, place

    @classmethod
    def of_rays(cls, rays: Rays, sheets: int) -> _Table:
        tau = rays.first.new_full((len(rays.first), sheets), torch.inf)
        return cls(tau, torch.full_like(tau, -1, dtype=torch.int64))

    @property
    def limit(self) -> Tensor:
        return self.tau[:, -1]

    def take(self, ray: Tensor, tau: Tensor, place: Tensor) -> None:
        rows = ray.unique()
        ray = torch.cat((rows.repeat_interleave(self.tau.shape[1]), ray))
        tau, place = torch.cat((self.tau[rows].flatten(), tau)), torch.cat((self.place[rows].flatten(), place))
        order = tau.argsort(stable=True)
        order = order[ray[order].argsort(stable=True)]
        ray, tau, place = ray[order], tau[order], place[order]
        rank = torch.arange(len(ray), device=ray.device) - torch.searchsorted(ray, ray)
        fits = rank < self.tau.shape[1]
        where = ray[fits], rank[fits]
        self.tau[where], self.place[where] = tau[fits], place[fits]
