"""Silhouettes: the part of an image's derivative that no hit sees, since hits move but what is hit changes at edges.

Letters: a pixel is the mean of L(u, v), u and v from left and top in 0 … 1. L jumps where the first hit becomes another
one or none: at the edges of what is seen, on curves m(u, v, θ) = 0. When θ changes, an edge sweeps over a part of the
pixel, and the mean changes by

    ∫ [L] ν dℓ,    ν = −∂m/∂θ / |∇m|, with [L] the jump along ∇m from the side that the edge leaves

beside what the hits' own derivatives give. Points of edges are found on lines through the pixel, across or down, and
counted with the inverse of how often such lines meet them there: ½ (|m_u| + |m_v|) / |∇m| for each unit of length, so
that a line that touches an edge counts no more than another.

A line is cut into parts, and these are cut on where rays at both ends see other hits: another number of them, or one
elsewhere among as many, as where one lump covers another. Of what is opaque the first hit is seen; all hits of a ray
are found but on both sides of the edges that are left, to tell which of them vanish.

What m is says the ray on the edge. With F = 0 the surface (`surfaces.base`), o + t d the ray:

| edge | m |
|---|---|
| two hits become one and vanish | (s₂ F(o + t₁ d) − s₁ F(o + t₂ d)) / (s₂ − s₁), t₁ and t₂ held, s their slopes ∇F·d |
| a hit leaves through a face of domain or region, or where rays begin | F of the point where the ray meets the face |
| a ray touches a piece (quadrics, SLIM), one or both of whose hits vanish | F of the piece at o + t* d, s = 0 there |
| a hit leaves the ball or plane that bounds its piece | distance from it of the hit, which moves (`Surface.ends`) |

Of the first, the derivative along the ray is 0 by its weights, be it smooth there or a crease of the surface: so m is
the extremum of F, whose place does not matter (the envelope theorem), and no second derivative of F is asked. Nothing
needs a distance.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from filterlab.ops.reference.optics import dot
from filterlab.render.image import Place
from filterlab.render.rays import Region, Spans, jitter, spans
from filterlab.surfaces.base import Hits, Surface

COUNTED = 64
"""Hits of a ray that are told apart: edges behind the last are not seen."""

_FINER = (
    8  # times as many parts of lines where but one hit of a ray is looked at, which is found sooner, and tells less
)
_CUT, _ROUNDS = 8, 10  # parts that what an edge lies in is cut into, and how often: L is that of 8⁻¹⁰ of it away
_APART, _STEEP = 0.125, 1  # voxels, and times how far rays are apart, by which hits differ if there is an edge between
_AT_FACE = 1e-4  # of the domain's diagonal: a hit that vanishes farther from a face is none that left through it
_AMONG = 100  # times how far rays at both sides of an edge are apart, within which it is of what it is told from
_STREAM = 1 << 48  # numbers from here on are drawn for lines, those below for subpixels


@dataclass(frozen=True)
class Silhouettes:
    """How edges are looked for in an image.

    Attributes:
        lines: through every pixel, each across or down at a place that is drawn; more of them make derivatives less
            noisy, and change nothing of what is expected.
        parts: of each line, at whose ends hits are compared: what comes and goes again within one is not seen. Those of
            opaque surfaces are cut into eight.

    Raises:
        ValueError: not two integers from 1 to 64.
    """

    lines: int = 1
    parts: int = 2

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if isinstance(value, bool) or not isinstance(value, int) or not 1 <= value <= 64:
                raise ValueError(f"{name} of silhouettes must be an integer from 1 to 64; got {value!r}")


@dataclass(frozen=True)
class Eye:
    """What is looked at.

    Attributes:
        surface, region: as of `raycast`.
        rays: those of some pixels, through a place within each.
        hits: (R, `COUNTED`) of spans of rays, in order, from where they enter.
        seen: (R, S) those that the image shows.
        radiance: (R, width) of rays: what jumps.
    """

    surface: Surface
    region: Region | None
    rays: Callable[[Tensor, Place], tuple[Tensor, Tensor]]
    hits: Callable[[Spans], Hits]
    seen: Callable[[Spans], Hits]
    radiance: Callable[[Tensor, Tensor], Tensor]

    def spans(self, lines: _Lines, x: Tensor) -> Spans:
        """Those of the rays at x of lines."""
        origins, directions = self.rays(lines.pixel, lines.place(x))
        return spans(origins.detach(), directions.detach(), self.surface.domain, self.region)

    def sheets(self, lines: _Lines, x: Tensor) -> Tensor:
        """t of their hits (Q, `COUNTED`)."""
        return self.hits(self.spans(lines, x)).t

    def shown(self, lines: _Lines, x: Tensor) -> Tensor:
        """t of those of their hits that the image shows (Q, S)."""
        return self.seen(self.spans(lines, x)).t

    def apart(self, stretches: _Stretches) -> Tensor:
        """How far from each other (Q,) rays at both ends of stretches pass the middle of the domain."""
        rays = [self.rays(stretches.lines.pixel, stretches.lines.place(x)) for x in stretches[1:3]]
        (o, d), other = ([x.detach() for x in pair] for pair in rays)
        middle = dot(o.new_tensor(self.surface.domain.center) - o, d)[:, None]
        return (o - other[0] + middle * (d - other[1])).norm(dim=-1)


class _Lines(NamedTuple):
    """Lines through pixels.

    Attributes:
        pixel: its number (Q,). row: its place among those in work (Q,).
        across: (Q,) whether u runs along it, not v. beside: (Q,) the other of both.
    """

    pixel: Tensor
    row: Tensor
    across: Tensor
    beside: Tensor

    @classmethod
    def drawn(cls, pixels: Tensor, lines: int, seed: int) -> _Lines:
        """So many through every pixel, by turns across and down, first as a coin says; those of a way in stripes."""
        draw = lambda stream: jitter(seed, _STREAM + pixels * (lines + 1) + stream)  # noqa: E731
        coin = draw(lines) < 0.5
        beside = torch.stack([(k // 2 + draw(k)) / ((lines + 1 - k % 2) // 2) for k in range(lines)])
        across = torch.stack([coin ^ bool(k % 2) for k in range(lines)])
        row = torch.arange(len(pixels), device=pixels.device)
        return cls(pixels.repeat(lines), row.repeat(lines), across.flatten(), beside.flatten())

    def some(self, which: Tensor) -> _Lines:
        return _Lines(*(field[which] for field in self))

    def place(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """(u, v) of x along the lines."""
        return torch.where(self.across, x, self.beside), torch.where(self.across, self.beside, x)


class _Stretches(NamedTuple):
    """Parts of lines.

    Attributes:
        low, high: (Q,) x of their ends.
        before, behind: (Q, S) hits there.
    """

    lines: _Lines
    low: Tensor
    high: Tensor
    before: Tensor
    behind: Tensor

    def some(self, which: Tensor) -> _Stretches:
        return _Stretches(self.lines.some(which), *(field[which] for field in self[1:]))


class _Edges(NamedTuple):
    """Where numbers of hits change along lines.

    Attributes:
        low, high: (Q,) x just before and just behind.
        rich: (Q,) that of them with more hits.
        t: (Q, 2) of the two hits that vanish there, or twice the one, from where the ray enters.
        fold: (Q,) whether they are two, or the ray touches the piece of the one.
        entering: (Q,) whether one leaves where rays enter, not where they end.
        piece: (Q,) of the first; None: the surface has none.
        bound: (Q,) which of the ends of its piece it leaves through; −1: through none.
    """

    lines: _Lines
    low: Tensor
    high: Tensor
    rich: Tensor
    t: Tensor
    fold: Tensor
    entering: Tensor
    piece: Tensor | None
    bound: Tensor

    def some(self, which: Tensor) -> _Edges:
        piece = None if self.piece is None else self.piece[which]
        fields = {name: getattr(self, name)[which] for name in self._fields if name not in ("lines", "piece")}
        return _Edges(self.lines.some(which), piece=piece, **fields)


def swept(how: Silhouettes, eye: Eye, pixels: Tensor, seed: int) -> Tensor:
    """(R, width) of 0, with the derivative of the pixels by what edges sweep over; first derivatives only."""
    edges = _found(eye, _Lines.drawn(pixels, how.lines, seed), how.parts)
    edges = edges._replace(t=edges.t.detach())
    jump = _jump(eye, edges).detach() / how.lines
    moved = (_moved(eye, edges)[:, None] * jump).to(jump)
    return jump.new_zeros(len(pixels), jump.shape[-1]).index_add(0, edges.lines.row, moved)


# --- finding edges ----------------------------------------------------------------------------------------------------


def _found(eye: Eye, lines: _Lines, parts: int) -> _Edges:
    """In parts of lines, those are cut on at whose ends hits are others, until but edges are left."""
    ends = [torch.full_like(lines.beside, x) for x in (0.0, 1.0)]
    whole = _Stretches(lines, *ends, *(eye.shown(lines, x) for x in ends))
    stretches = _cut(eye, whole, parts if whole.before.shape[1] > 1 else _FINER * parts)
    for _ in range(_ROUNDS):
        stretches = _cut(eye, stretches, _CUT)
    twice = _Lines(*(torch.cat((field, field)) for field in stretches.lines))
    before, behind = eye.sheets(twice, torch.cat(stretches[1:3])).chunk(2)
    stretches = stretches._replace(before=before, behind=behind)
    return _classified(eye, stretches.some(_count(before) != _count(behind)))


def _cut(eye: Eye, stretches: _Stretches, parts: int) -> _Stretches:
    """Of so many equal parts of each those at whose ends hits are others."""
    lines, low, high, before, behind = stretches
    inner = torch.arange(1, parts, dtype=low.dtype, device=low.device) / parts
    each = torch.arange(len(low), device=low.device).repeat_interleave(parts - 1)
    between = torch.lerp(low[:, None], high[:, None], inner)
    hits = eye.shown(lines.some(each), between.flatten()).view(len(low), parts - 1, before.shape[1])
    x, hits = (
        torch.cat(row, 1) for row in ((low[:, None], between, high[:, None]), (before[:, None], hits, behind[:, None]))
    )
    least = _APART / (_FINER if before.shape[1] == 1 else 1) * eye.surface.domain.voxel_size
    slack = torch.clamp(_STEEP * eye.apart(stretches) / parts, min=least)
    row, part = _differ(hits[:, :-1], hits[:, 1:], slack[:, None]).nonzero().unbind(-1)
    return _Stretches(lines.some(row), x[row, part], x[row, part + 1], hits[row, part], hits[row, part + 1])


def _differ(before: Tensor, behind: Tensor, slack: Tensor) -> Tensor:
    """Whether rays with these hits (..., S) differ in their number, or in one by more than some slack (...)."""
    return torch.where(before == behind, 0, (before - behind).abs()).amax(-1) > slack


def _count(t: Tensor) -> Tensor:
    return (t < torch.inf).sum(-1)


def _classified(eye: Eye, stretches: _Stretches) -> _Edges:
    """What vanishes there; without what neither folds nor leaves through a face, as at holes."""
    lines, low, high, before, behind = stretches
    falls = _count(before) > _count(behind)
    more, fewer = (torch.where(falls[:, None], *pair) for pair in ((before, behind), (behind, before)))
    rich = torch.where(falls, low, high)
    first, fold = _vanishing(more, fewer)
    t = more.gather(1, torch.stack((first, first + fold.long()), 1).clamp(max=COUNTED - 1))
    length = eye.spans(lines, rich).length
    entering = t[:, 0] < length / 2
    edges = _Edges(lines, low, high, rich, t, fold, entering, None, torch.full_like(first, -1))
    if eye.surface.in_pieces:
        edges = _of_pieces(eye, edges, first, eye.apart(stretches))
    beyond = torch.where(entering, t[:, 0], (t[:, 0] - length).abs())
    kept = edges.fold | (edges.bound >= 0) | (beyond < _AT_FACE * eye.surface.domain.diagonal)
    return edges.some(kept)


def _of_pieces(eye: Eye, edges: _Edges, first: Tensor, apart: Tensor) -> _Edges:
    """The same, with the pieces of what vanishes, and whether rays touch them there or they end.

    A ray that touches passes the surface within about as much as rays are apart, h = (F − s² / 2 d·H d) / |∇F|; hits
    that leave what bounds a piece are as near to it, but for the angle at which the ray meets the surface.
    """
    found = eye.hits(eye.spans(edges.lines, edges.rich)).piece
    assert found is not None
    piece = found.gather(1, first[:, None])[:, 0].clamp_min(0)
    surface, ray = eye.surface.detached, _rays(eye, edges, edges.lines.place(edges.rich))
    points = ray.at(edges.t[:, :1])[:, 0].detach()
    value, gradient, hessian = surface.jet(points, 2, piece)
    d, size = ray.directions.detach(), gradient.norm(dim=-1)
    slope = dot(gradient, d)
    bend = (d[:, :, None] * hessian * d[:, None]).sum((-2, -1))
    height = (value - slope * slope / (2 * bend)) / size
    near, bound = surface.ends(points, piece).max(-1)
    fold = height.abs() <= _AMONG * apart  # false where it is NaN
    leaves = ~fold & (near.abs() * slope.abs() <= _AMONG * apart * size)
    t = torch.where(fold, edges.t[:, 0] - slope / bend, edges.t[:, 0])
    return edges._replace(
        t=torch.stack((t, t), 1), fold=fold, piece=piece, bound=torch.where(leaves, bound, torch.full_like(bound, -1))
    )


def _vanishing(more: Tensor, fewer: Tensor) -> tuple[Tensor, Tensor]:
    """Which of the hits t (Q, S) are missing among fewer, by the first of them, and whether they are two: (Q,) each.

    Those whose removal makes both rows most alike: Σ_{j<i} |t_j − t'_j| + Σ_{j≥i} |t_{j+a} − t'_j| is least, of a hits
    removed from i on.
    """
    count, left = _count(more), _count(fewer)
    fold = (count - left) % 2 == 0
    place = torch.arange(more.shape[1], device=more.device)
    later = more.gather(1, (place + 1 + fold.long()[:, None]).clamp(max=more.shape[1] - 1))
    there = (fewer < torch.inf) & (later < torch.inf)
    apart = [torch.where(there, t - fewer, 0).abs().cumsum(1) for t in (more, later)]
    before, behind = apart[0].roll(1, 1), apart[1][:, -1:] - apart[1].roll(1, 1)
    before[:, 0], behind[:, 0] = 0, apart[1][:, -1]
    cost = torch.where(place <= left[:, None], before + behind, torch.inf)
    return cost.argmin(1), fold


# --- how they move ----------------------------------------------------------------------------------------------------


def _jump(eye: Eye, edges: _Edges) -> Tensor:
    """L (Q, width) before the edge less L behind it; 0 where one of both is not finite, as depths of nothing are."""
    before, behind = (eye.radiance(*eye.rays(edges.lines.pixel, edges.lines.place(x))) for x in (edges.low, edges.high))
    return torch.where(before.isfinite() & behind.isfinite(), before - behind, 0)


def _moved(eye: Eye, edges: _Edges) -> Tensor:
    """(Q,) 0, with the derivatives of where edges are along their lines, weighted as both kinds of lines are."""
    weights, across, down = _slopes(eye, edges)
    own = torch.where(edges.lines.across, across, down).sign()
    size = across.abs() + down.abs()
    factor = torch.where(size > 0, -2 * own / torch.where(size > 0, size, 1), 0)
    m = (weights * _values(eye, eye.surface, edges, edges.lines.place(edges.rich), edges.t)).sum(-1)
    return factor * (m - m.detach())


def _slopes(eye: Eye, edges: _Edges) -> tuple[Tensor, Tensor, Tensor]:
    """Weights (Q, 2) of m, and m_u, m_v (Q,); without derivatives."""
    u, v = (x.detach().requires_grad_() for x in edges.lines.place(edges.rich))
    t = edges.t.detach().requires_grad_()
    values = _values(eye, eye.surface.detached, edges, (u, v), t)
    share = torch.ones_like(u) if edges.piece is not None else _share(edges, values, t)
    weights = torch.stack((share, 1 - share), -1).detach()
    across, down = torch.autograd.grad((weights * values).sum(), (u, v))
    return weights, across, down


def _share(edges: _Edges, values: Tensor, t: Tensor) -> Tensor:
    """(Q,) of the first of both points of folds; 1 of what is no fold."""
    (slope,) = torch.autograd.grad(values.sum(), t, retain_graph=True)
    near, far = slope.unbind(-1)
    return torch.where(edges.fold, (far / (far - near)).nan_to_num(0.5).clamp(0, 1), 1)


class _Rays(NamedTuple):
    """Rays on edges.

    Attributes:
        origins, directions: (Q, 3). before: (Q, 1) from there to where they enter, held. faces: (Q, 1, 3) points where
            they enter or leave.
    """

    origins: Tensor
    directions: Tensor
    before: Tensor
    faces: Tensor

    def at(self, t: Tensor) -> Tensor:
        """Points (Q, k, 3) at t (Q, k) from where they enter."""
        return self.origins[:, None] + (self.before + t)[..., None] * self.directions[:, None]


def _rays(eye: Eye, edges: _Edges, place: Place) -> _Rays:
    origins, directions = eye.rays(edges.lines.pixel, place)
    inside = spans(origins, directions, eye.surface.domain, eye.region)
    before = dot((inside.entry - origins).detach(), directions.detach())[:, None]
    leaving = inside.entry + inside.length[:, None] * directions
    face = torch.where(edges.entering[:, None], inside.entry, leaving)[:, None]
    return _Rays(origins, directions, before, face)


def _values(eye: Eye, surface: Surface, edges: _Edges, place: Place, t: Tensor) -> Tensor:
    """F (Q, 2) of both points of folds, or twice that of the point on a face; of pieces twice m."""
    rays = _rays(eye, edges, place)
    if edges.piece is not None:
        return _piece_values(surface, edges, rays, t)[:, None].expand(-1, 2)
    return surface.jet(torch.where(edges.fold[:, None, None], rays.at(t), rays.faces), 0)[0]


def _piece_values(surface: Surface, edges: _Edges, rays: _Rays, t: Tensor) -> Tensor:
    """m (Q,): F of the piece at o + t* d, or on a face; the distance from what bounds it of the hit, which moves."""
    assert edges.piece is not None
    points, bounded = rays.at(t[:, :1])[:, 0], edges.bound >= 0
    on_face = ~edges.fold & ~bounded
    value, gradient = surface.jet(torch.where(on_face[:, None], rays.faces[:, 0], points), 1, edges.piece)
    slope = torch.where(bounded, dot(gradient, rays.directions).detach(), 1)
    moved = points - torch.where(bounded, value / slope, 0)[:, None] * rays.directions
    off = surface.ends(moved, edges.piece).gather(1, edges.bound.clamp_min(0)[:, None])[:, 0]
    return torch.where(bounded, off, value)
