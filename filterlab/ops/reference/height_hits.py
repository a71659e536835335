"""Casting rays at a spline over a grid of heights in plain torch: all rays of a part take one step after the other.

Letters as in `ops.height_hits`: L lines, Q of them that still go on, or cells that they are in.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from filterlab import bernstein
from filterlab.ops.height_hits import DEGREE, ROUNDING, SMALLEST, Cell, HeightHits, Pyramid, enclose, slack_of
from filterlab.ops.heights import Heights
from filterlab.ops.raycast import Candidates, Sheets, joined
from filterlab.ops.reference.heights import patches
from filterlab.ops.reference.pieces import Lines, inside
from filterlab.ops.reference.raycast import sheets_by
from filterlab.roots import first_root

RAYS_AT_ONCE = 1 << 16
_CELLS_AT_ONCE = 1 << 16


class Entered(NamedTuple):
    """Rays that meet the box around all heights.

    Attributes:
        lines: (L), from where they enter it.
        ray: (L,) int64, which rays they are.
        start: (L,) how far from the origin that is, in the lengths of the lines' directions.
        length: (L,) of these in units of the rays' own.
    """

    lines: Lines
    ray: Tensor
    start: Tensor
    length: Tensor

    def t(self, s: Tensor) -> Tensor:
        """In units of the rays' directions; ∞ stays."""
        return torch.where(s < math.inf, (self.start + s) * self.length, math.inf)


def entered(given: HeightHits, origins: Tensor, directions: Tensor) -> Entered:
    """Rays (R, 3) in the world as lines in coordinates of cells."""
    o, d = origins.detach().double(), directions.detach().double()
    shift = o.new_tensor((*given.heights.origin, 0.0))
    spacing = o.new_tensor((*(given.cell.steps * d for d in given.heights.spacing), 1.0))
    o, d = (o - shift) / spacing, d / spacing
    largest = d.abs().amax(-1)
    low, high = given.pyramid.range
    lines, ray, start = inside(o, d / largest[:, None], (0.0, 0.0, low), (*given.domain, high))
    return Entered(lines, ray, start[ray], 1 / largest[ray])


# --- what is asked ----------------------------------------------------------------------------------------------------


def first(given: HeightHits, origins: Tensor, directions: Tensor) -> Tensor:
    """t (R,) float64, where rays (R, 3) first meet the surface; ∞ where they don't."""
    parts = zip(origins.split(RAYS_AT_ONCE), directions.split(RAYS_AT_ONCE), strict=True)
    return torch.cat([_first_of_part(given, o, d) for o, d in parts])


def _first_of_part(given: HeightHits, origins: Tensor, directions: Tensor) -> Tensor:
    own = entered(given, origins, directions)
    s = torch.full_like(own.start, math.inf)

    def take(found: Pieces) -> Tensor:
        within = torch.full_like(found.near, math.inf)
        within[found.holds] = first_root(found.coefficients[found.holds])
        which = (within < math.inf).int().argmax(1, keepdim=True)
        near, far, within = (x.gather(1, which)[:, 0] for x in (found.near, found.far, within))
        hit = within < math.inf
        s[found.line[hit]] = torch.lerp(near[hit], far[hit], within[hit])
        return hit

    walk(given, own.lines, take)
    return origins.new_full((len(origins),), math.inf, dtype=torch.float64).index_copy(0, own.ray, own.t(s))


def met(given: HeightHits, origins: Tensor, directions: Tensor) -> Tensor:
    """(R,) bool, whether rays (R, 3) meet the surface at all."""
    return first(given, origins, directions) < math.inf


def sheets(given: HeightHits, origins: Tensor, directions: Tensor, asked: Sheets) -> Tensor:
    """t (R, k) float64, where rays (R, 3) meet the surface, in order, or from the last on; ∞ behind the last."""
    return sheets_by(lambda o, d: candidates(given, o, d), origins, directions, asked)


def candidates(given: HeightHits, origins: Tensor, directions: Tensor) -> Candidates:
    """The pieces of rays (R, 3) that may hold a hit, ray by ray, in order."""
    parts = [
        _candidates_of_part(given, o, d, k * RAYS_AT_ONCE)
        for k, (o, d) in enumerate(zip(origins.split(RAYS_AT_ONCE), directions.split(RAYS_AT_ONCE), strict=True))
    ]
    return joined(parts)


def _candidates_of_part(given: HeightHits, origins: Tensor, directions: Tensor, before: int) -> Candidates:
    own, parts = entered(given, origins, directions), []

    def take(found: Pieces) -> Tensor:
        keep = found.holds
        line = found.line[:, None].expand_as(keep)[keep]
        length = own.length[line]
        start, near, far = (length * x for x in (own.start[line], found.near[keep], found.far[keep]))
        none = torch.zeros_like(line, dtype=torch.bool)
        ray, coefficients, repeated = own.ray[line] + before, found.coefficients[keep], found.repeated[keep]
        parts.append(Candidates(ray, start, near, far, coefficients, none, repeated))
        return torch.zeros_like(found.line, dtype=torch.bool)

    walk(given, own.lines, take)
    if not parts:
        return _no_candidates(origins)
    every = joined(parts)
    order = every.ray.argsort(stable=True)  # of every ray pieces came in order
    return Candidates(*(column[order] for column in every))


def _no_candidates(rays: Tensor) -> Candidates:
    whole, number = (rays.new_zeros(0, dtype=dtype) for dtype in (torch.int64, torch.float64))
    none = whole > 0
    return Candidates(whole, number, number, number, number.new_zeros(0, DEGREE + 1), none, none)


# --- the way ----------------------------------------------------------------------------------------------------------


class Pieces(NamedTuple):
    """Both pieces of lines in cells, in order.

    Attributes:
        line: (Q,). near, far: (Q, 2).
        coefficients: (Q, 2, 5), the surface less the line.
        holds: (Q, 2) whether a piece may hold a hit: no hole, and coefficients on both sides of 0, or on it.
        repeated: (Q, 2) whether it begins on the surface, where the piece before ended on it.
    """

    line: Tensor
    near: Tensor
    far: Tensor
    coefficients: Tensor
    holds: Tensor
    repeated: Tensor


class _Places(NamedTuple):
    """Where lines are: (Q,) each.

    Attributes:
        line: which.
        x, y: a cell. level: log₂ of the cells along an edge of the block around it that is looked at.
        s: how far they have come.
        ended_at, ended_with: where the last piece ended, and with which value.
    """

    line: Tensor
    x: Tensor
    y: Tensor
    level: Tensor
    s: Tensor
    ended_at: Tensor
    ended_with: Tensor

    def chosen(self, mask: Tensor) -> _Places:
        return _Places(*(column[mask] for column in self))


def walk(given: HeightHits, lines: Lines, take: Callable[[Pieces], Tensor]) -> None:
    """The cells that lines pass, front to back, but for those whose block they stay above or below.

    Args:
        take: of both pieces in a cell of some lines, whether these need not go on (Q,).
    """
    at = _begin(given, lines)
    while len(at.line):
        own = lines.chosen(at.line)
        out, along_y = _way_out(own, at)
        relevant = _relevant(given.pyramid, own, at, out)
        here = relevant & (at.level == 0)
        ended = torch.zeros_like(here)
        if bool(here.any()):
            pieces, at = _in_cells(given, own, at, out, here)
            ended[here] = take(pieces)
        down = relevant & ~here
        on = _advanced(given, own, at, out, along_y)
        lower = torch.where(at.level > given.pyramid.finest, at.level - 1, 0)
        at = _Places(*(torch.where(down, *both) for both in zip(at._replace(level=lower), on, strict=True)))
        inside_ = (at.x >= 0) & (at.x < given.heights.cells[0]) & (at.y >= 0) & (at.y < given.heights.cells[1])
        at = at.chosen(~ended & inside_ & (down | (out < own.far)))


def _begin(given: HeightHits, lines: Lines) -> _Places:
    x, y = (lines.origins[:, axis].floor().long().clamp(0, given.heights.cells[axis] - 1) for axis in range(2))
    nothing = torch.zeros_like(lines.near)
    return _Places(
        torch.arange(len(x), device=x.device),
        x,
        y,
        torch.full_like(x, given.pyramid.top),
        nothing,
        nothing - 1,
        nothing,
    )


def _way_out(lines: Lines, at: _Places) -> tuple[Tensor, Tensor]:
    """s (Q,) where lines leave their blocks, or end, and whether it is along y.

    Where a line crosses a plane is (plane − o) / d, whoever asks.
    """
    ways = []
    for axis, cell in enumerate((at.x, at.y)):
        direction = lines.directions[:, axis]
        plane = ((cell >> at.level) + (direction > 0)) << at.level
        still = direction == 0
        ways.append(torch.where(still, math.inf, (plane - lines.origins[:, axis]) / torch.where(still, 1, direction)))
    out = torch.minimum(torch.minimum(*ways), lines.far)
    return torch.maximum(out, at.s), ways[1] < ways[0]


def _relevant(pyramid: Pyramid, lines: Lines, at: _Places, out: Tensor) -> Tensor:
    """(Q,) whether lines may meet something in their blocks."""
    level = (at.level - pyramid.finest).clamp_min(0)
    starts, widths = torch.tensor([pyramid.starts[:-1], [w for _, w in pyramid.sizes]], device=level.device)
    shift = level + pyramid.finest
    low, high = pyramid.numbers[starts[level] + (at.y >> shift) * widths[level] + (at.x >> shift)].double().unbind(-1)
    a, b = (lines.origins[:, 2] + s * lines.directions[:, 2] for s in (at.s, out))
    meets = (torch.minimum(a, b) <= high) & (torch.maximum(a, b) >= low)
    return meets | (at.level < pyramid.finest)


def _advanced(given: HeightHits, lines: Lines, at: _Places, out: Tensor, along_y: Tensor) -> _Places:
    """At the beginning of the next block."""
    cells = []
    for axis, cell in enumerate((at.x, at.y)):
        own = along_y if axis else ~along_y
        step = lines.directions[:, axis].sign().long()
        low = (cell >> at.level) << at.level
        high = (low + (1 << at.level) - 1).clamp_max(given.heights.cells[axis] - 1)
        place = (lines.origins[:, axis] + out * lines.directions[:, axis]).floor().long()
        place = torch.minimum(torch.maximum(place, torch.where(step > 0, cell, low)), torch.where(step < 0, cell, high))
        across = torch.where(step > 0, low + (1 << at.level), low - 1)
        cells.append(torch.where(own, across, place))
    finest = given.pyramid.finest
    up = torch.where(at.level >= finest, at.level + 1, finest)
    leaves = ((cells[0] >> up) != (at.x >> up)) | ((cells[1] >> up) != (at.y >> up))
    level = torch.where(leaves, up.clamp_max(given.pyramid.top), at.level)
    return at._replace(x=cells[0], y=cells[1], level=level, s=out)


# --- cells ------------------------------------------------------------------------------------------------------------


def _in_cells(given: HeightHits, lines: Lines, at: _Places, out: Tensor, here: Tensor) -> tuple[Pieces, _Places]:
    """Both pieces of the lines under a mask, and all places, which know how these ended."""
    own, far = at.chosen(here), out[here]
    lines = lines.chosen(here.nonzero()[:, 0])
    crossing, upper_first = _diagonal(given.cell, lines, own)
    passed = torch.stack((crossing >= own.s, crossing <= far), 1)
    ends = torch.stack((own.s, torch.minimum(torch.maximum(crossing, own.s), far), far), 1)
    c = _restricted(given, lines, own, ends, upper_first)
    before, ended_at, repeated = own.ended_with, own.ended_at, []
    for k in range(2):
        follows = (ended_at == ends[:, k]) & before.isfinite() & c[:, k, 0].isfinite()
        c[:, k, 0] = torch.where(follows, before, c[:, k, 0])
        repeated.append(follows & (before == 0))
        before = torch.where(passed[:, k], c[:, k, -1], before)
        ended_at = torch.where(passed[:, k], ends[:, k + 1], ended_at)
    low, high = c.aminmax(dim=-1)
    holds = passed & (low <= 0) & (high >= 0) & c.isfinite().all(-1)
    found = Pieces(own.line, ends[:, :-1], ends[:, 1:], c, holds, torch.stack(repeated, 1))
    ended = at.ended_at.masked_scatter(here, far), at.ended_with.masked_scatter(here, before)
    return found, at._replace(ended_at=ended[0], ended_with=ended[1])


def _restricted(given: HeightHits, lines: Lines, at: _Places, ends: Tensor, upper_first: Tensor) -> Tensor:
    """(Q, 2, 5): the surface less the line, on the part between ends (Q, 3) in the first triangle and in the second."""
    places = _in_cell(given.cell, lines, at, ends)
    z = lines.origins[:, None, 2] + ends * lines.directions[:, None, 2]
    upper, lower = patches(given.heights, torch.stack((at.x, at.y), -1), torch.float64)[0].unbind(1)
    part = torch.arange(DEGREE + 1, device=z.device) / DEGREE
    pieces = []
    for k, own in enumerate((upper_first, ~upper_first)):
        triangle = torch.where(own[:, None], upper, lower)
        start, end = (_barycentric(places[:, n], own) for n in (k, k + 1))
        height = z[:, k, None] + part * (z[:, k + 1] - z[:, k])[:, None]
        pieces.append(bernstein.restrict(triangle, start, end) - height)
    return torch.stack(pieces, 1)


def _diagonal(cell: Cell, lines: Lines, at: _Places) -> tuple[Tensor, Tensor]:
    """s (Q,) where lines cross the diagonals of their cells, and whether they come from the upper triangle.

    A line along a diagonal, whose crossing is at ±∞, stays in the triangle it is in.
    """
    sign = -1 if cell.mirrored else 1
    o, d = (sign * x[:, 0] + x[:, 1] for x in (lines.origins, lines.directions))
    level = (at.y - at.x if cell.mirrored else at.x + at.y + 1).to(o)
    along, beside = d == 0, torch.where(o <= level, math.inf, -math.inf)
    return torch.where(along, beside, (level - o) / torch.where(along, 1, d)), d >= 0


def _in_cell(cell: Cell, lines: Lines, at: _Places, ends: Tensor) -> Tensor:
    """(Q, 3, 2): s and t at ends (Q, 3), from the side where the upper triangle has its right angle."""
    own = torch.stack((at.x, at.y), -1)
    places = ((lines.origins[:, :2] - own)[:, None] + ends[..., None] * lines.directions[:, None, :2]).clamp(0, 1)
    return torch.stack((1 - places[..., 0], places[..., 1]), -1) if cell.mirrored else places


def _barycentric(place: Tensor, upper: Tensor) -> Tensor:
    """(Q, 3) of places (Q, 2) in cells, in the upper triangle or the lower one."""
    s, t = torch.where(upper[:, None], place, 1 - place).unbind(-1)
    return torch.stack((1 - s - t, s, t), -1)


# --- bounds -----------------------------------------------------------------------------------------------------------


def pyramid(heights: Heights, cell: Cell) -> Pyramid:
    """Of the spline over one grid."""
    (columns, rows), edge = heights.cells, 1 << cell.finest
    found, slack = Pyramid.room(heights, cell.finest), slack_of(heights, cell)
    step = edge * max(1, _CELLS_AT_ONCE // (edge * columns))
    for begin in range(0, rows, step):
        y, x = torch.meshgrid(torch.arange(begin, min(begin + step, rows)), torch.arange(columns), indexing="ij")
        cells = torch.stack((x, y), -1).flatten(0, 1).to(heights.values.device)
        level = _widened(_bounds(patches(heights, cells, torch.float64)[0]), slack).unflatten(0, x.shape)
        enclose(level, edge, found.level(0)[begin // edge : -(-(begin + step) // edge)])
    return found.complete()


def _bounds(coefficients: Tensor) -> Tensor:
    """(Q, 2) of cells, from the coefficients (Q, 2, 15) of triangles, but for those that are holes."""
    hole = coefficients.isfinite().all(-1, keepdim=True).logical_not()
    low, high = (torch.where(hole, none, coefficients) for none in (math.inf, -math.inf))
    return torch.stack((low.amin((1, 2)), high.amax((1, 2))), -1)


def _widened(bounds: Tensor, slack: float) -> Tensor:
    """float32, however it is rounded; ∞ stays."""
    more = slack + ROUNDING * bounds.abs() + SMALLEST
    wide = bounds + torch.stack((-more[..., 0], more[..., 1]), -1)
    return torch.where(bounds.isfinite(), wide, bounds).float()
