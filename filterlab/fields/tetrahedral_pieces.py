"""Pieces along rays of splines on tetrahedra, and which of their tetrahedra may hold a level; in plain torch.

    ray ─▶ planes between cells ─▶ cells that may hold the level ─▶ planes through their centres ─▶ one tetrahedron each

Every face of a tetrahedron lies in a plane n · x = k + offset that bounds cells, or n · (x − centre) = 0. The signed
permutations of a shape's faces give all normals n, primitive vectors of integers; that some planes go on where no
tetrahedron has a face there only cuts a piece in two. A piece is in the tetrahedron around its middle; its polynomial
is the blossom at both of its ends (`bernstein.restrict`), of the degree of the spline.

Source: Kalbe and Zeilfelder 2008, section 5, and the walk through planes instead of projected tetrahedra.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cache
from typing import NamedTuple

import torch
from torch import Tensor

from filterlab import bernstein
from filterlab.fields.base import Field, Relevant, type_of_rays
from filterlab.fields.grid import Evaluation, GridField
from filterlab.fields.tetrahedral import (
    TURNS,
    FusedOnTetrahedra,
    JetOnTetrahedra,
    Located,
    Normal,
    OnTetrahedra,
    Spline,
    Turn,
    locate,
    primitive,
    upright,
)
from filterlab.geometry import times_matrix
from filterlab.ops.differentiable import raycast as casting
from filterlab.ops.pieces import Pieces
from filterlab.ops.raycast import Candidates, Raycast
from filterlab.ops.reference.pieces import CHUNK, Lines, inside, joined
from filterlab.ops.reference.tetrahedra import largest_of_windows
from filterlab.ops.tetrahedra import TetrahedralLattice

_ROUNDING = 64  # units of rounding, relative to the largest value, by which bounds of a cell are widened

Bounds = tuple[Tensor, Tensor, int]
"""The least and the greatest sample that each cell needs, (D, H, W) float64, and the first cell along every axis."""


@dataclass(frozen=True)
class Planes:
    """The planes that faces lie in.

    Attributes:
        outer: (n, offset) of n · x = k + offset, for every integer k.
        inner: n of n · (x − centre) = 0.
    """

    outer: tuple[tuple[Normal, float], ...]
    inner: tuple[Normal, ...]

    @classmethod
    @cache
    def of(cls, spline: Spline) -> Planes:
        outer, inner = set(), set()
        for shape in spline.shapes:
            (apex, *sides) = (primitive(row) for row in shape.barycentric)
            for turn in TURNS:
                normal, d = upright(turn(apex[0]), -apex[1])
                outer.add((normal, float((sum(normal) * spline.shift + d) % 1)))
                inner.update(upright(turn(normal), Fraction(0))[0] for normal, _ in sides)
        return cls(tuple(sorted(outer)), tuple(sorted(inner)))


class TetrahedralPieces(NamedTuple):
    """Polynomials on tetrahedra.

    Attributes:
        corners: (M, 4, 3), in the world.
        coefficients: (M, B) of the Bernstein form on them, in the order of `bernstein.multi_indices`.
    """

    corners: Tensor
    coefficients: Tensor


class FieldOnTetrahedra(GridField):
    """A spline on tetrahedra; `relevant` and `pieces_along` are those of its tetrahedra."""

    scheme: OnTetrahedra
    _kept: tuple[int, Bounds] | None
    evaluated: JetOnTetrahedra

    def _settle(self) -> None:
        super()._settle()
        self._keep()

    def _exchange(self) -> None:
        super()._exchange()
        self._keep()

    def _keep(self) -> None:
        self._kept = None  # a copy has other coefficients
        first = self._own[0]
        self.evaluated = first.everywhere if isinstance(first, FusedOnTetrahedra) else first  # type: ignore[assignment]

    def _evaluations(self, values: Tensor) -> list[Evaluation]:
        coefficients = replace(self.coefficients, values=values)
        everywhere = self.scheme.everywhere(coefficients, self.placement)
        return [self.scheme.evaluation_by(everywhere, coefficients, order) for order in range(self.max_order + 1)]

    @property
    def degree_along_rays(self) -> int | None:
        return self.scheme.spline.degree if self.channels is None else None

    @property
    def lattice(self) -> TetrahedralLattice:
        """The cubes about the samples; of an unbatched field, padded for programs."""
        return self._once(self._cubes)

    def _cubes(self) -> TetrahedralLattice:
        spline, values = self.scheme.spline.lowered, self.coefficients.values
        for dim, n, first in zip((-1, -2, -3), self.coefficients.size, self.coefficients.first, strict=True):
            values = values.narrow(dim, -int(first) - spline.around, n + 2 * spline.around)
        x, y, z = (float(n) for n in self.coefficients.size)
        quantization = self.coefficients.quantization
        scale, shift = (1.0, 0.0) if quantization is None else quantization.numbers()
        return TetrahedralLattice(values, spline, (-0.5, -0.5, -0.5), (0.0, 0.0, 0.0), (x, y, z), scale, shift)

    def first_crossing(self, origins: Tensor, directions: Tensor, level: float) -> Tensor:
        given = self._program(level, origins, directions)
        if given is None:
            return Field.first_crossing(self, origins, directions, level)
        return casting.first(given, origins, directions)

    def crossings(self, origins: Tensor, directions: Tensor, level: float, count: int, farthest: bool) -> Tensor:
        given = self._program(level, origins, directions)
        if given is None:
            return Field.crossings(self, origins, directions, level, count, farthest)
        return casting.sheets(given, origins, directions, self._sheets(count, farthest))

    def crossing_candidates(self, origins: Tensor, directions: Tensor, level: float) -> Candidates:
        given = self._program(level, origins, directions)
        if given is None:
            return Field.crossing_candidates(self, origins, directions, level)
        return casting.candidates(given, origins, directions)

    def _program(self, level: float, origins: Tensor, directions: Tensor) -> Raycast | None:
        """What a program casts; None where none can run, or plain torch is how this field is evaluated."""
        self._check_pieces()
        if self.scheme.name == "direct" or casting.missing_for(
            self.lattice, type_of_rays(origins, directions), origins
        ):
            return None  # before bounds are made that nothing reads
        given = self._raycast(level, origins, directions)
        return given if casting.missing(given, origins) is None else None

    def _most_pieces(self) -> int:
        return super()._most_pieces() * (len(Planes.of(self.scheme.spline).inner) + 1)

    def pieces_along(self, origins: Tensor, directions: Tensor, level: float | None = None) -> Pieces:
        self._check_pieces()
        dtype, geometry = type_of_rays(origins, directions), self.domain.geometry
        own = geometry.to_voxel(origins.detach().double()), geometry.direction_to_voxel(directions.detach().double())
        x, y, z = (n - 0.5 for n in self.coefficients.size)
        lines, ray, start = inside(*own, (-0.5, -0.5, -0.5), (x, y, z))
        every = torch.arange(len(ray), device=ray.device)
        line, near, far = _cut(every, lines.near, lines.far, self._outer(lines))
        cells = self._cells(lines, line, near, far)
        if level is not None:
            keep = self.may_hold(cells, level, dtype)
            line, near, far, cells = (x[keep] for x in (line, near, far, cells))
        line, near, far = _cut(line, near, far, self._inner(lines, line, cells))
        coefficients = self._restricted(lines, line, near, far, dtype)
        return Pieces(ray[line], near, far, joined(coefficients, line, near, far), start)

    # --- where a ray passes from one polynomial into another ---

    def _outer(self, lines: Lines) -> Tensor:
        """Where lines (L) pass planes that bound cells, (L, K); beyond their ends where there are fewer."""
        found = []
        for normal, offset in Planes.of(self.scheme.spline).outer:
            n = lines.origins.new_tensor(normal)
            place, speed = (lines.origins * n).sum(-1) - offset, (lines.directions * n).sum(-1)
            ends = place + speed * lines.near, place + speed * lines.far
            first, last = torch.minimum(*ends).ceil(), torch.maximum(*ends).floor()
            count = int((last - first).max()) + 1 if len(first) else 0
            k = first[:, None] + torch.arange(max(count, 0), device=first.device)
            s = (k - place[:, None]) / torch.where(speed == 0, 1, speed)[:, None]
            found.append(torch.where((k <= last[:, None]) & (speed != 0)[:, None], s, torch.inf))
        return torch.cat(found, 1)

    def _inner(self, lines: Lines, line: Tensor, cells: Tensor) -> Tensor:
        """Where they pass planes through the centres of cells (P, 3), (P, M)."""
        normals = lines.origins.new_tensor(Planes.of(self.scheme.spline).inner).T
        place = times_matrix(lines.origins[line] - (cells + float(self.scheme.spline.shift)), normals)
        speed = times_matrix(lines.directions, normals)[line]
        return torch.where(speed == 0, torch.inf, -place / torch.where(speed == 0, 1, speed))

    def _cells(self, lines: Lines, line: Tensor, near: Tensor, far: Tensor) -> Tensor:
        """(P, 3), the cell around the middle of every piece."""
        return self.scheme.spline.cells(lines.chosen(line).at((near + far) / 2))

    # --- polynomials ---

    def _restricted(self, lines: Lines, line: Tensor, near: Tensor, far: Tensor, dtype: torch.dtype) -> Tensor:
        """(P, n + 1) Bernstein coefficients along pieces, each within one tetrahedron."""
        spline, parts = self.scheme.spline, []
        for part in torch.arange(len(line), device=line.device).split(CHUNK):
            own, a, b = lines.chosen(line[part]), near[part], far[part]
            at = locate(spline, self.evaluated.tables, own.at((a + b) / 2), dtype)
            coefficients = self._bernstein(at, dtype)
            ends = (self._barycentric(at, own.at(s), dtype) for s in (a, b))
            parts.append(bernstein.restrict(coefficients, *ends))
        return torch.cat(parts) if parts else near.new_zeros((0, spline.degree + 1), dtype=dtype)

    def _barycentric(self, at: Located, voxels: Tensor, dtype: torch.dtype) -> Tensor:
        """(P, 4) of other points of the same tetrahedra."""
        local = (voxels - (at.cell.T.to(voxels) + float(self.scheme.spline.shift))).T * at.sign
        rows = self.evaluated.tables.barycentric  # (S, 4, 4)
        own = rows[0].expand(len(voxels), 4, 4) if at.shape is None else rows[at.shape]
        place = local.gather(0, at.axes).T
        return (own[..., 0] + (own[..., 1:] * place[:, None]).sum(-1)).to(dtype)

    def _bernstein(self, at: Located, dtype: torch.dtype) -> Tensor:
        """(P, B) coefficients of tetrahedra."""
        jet, values = self.evaluated, self.coefficients.values.detach()
        index = jet.folding.flat(jet.tables, at)
        samples = values.reshape(-1).index_select(0, index.reshape(-1)).reshape(index.shape)
        samples = self._decoded_samples(samples, dtype)
        return jet.coefficients(samples[None], at)[0].T

    def _decoded_samples(self, stored: Tensor, dtype: torch.dtype) -> Tensor:
        quantization = self.coefficients.quantization
        scale, shift = (1.0, 0.0) if quantization is None else quantization.numbers()
        return scale * stored.to(dtype) + shift

    # --- bounds ---

    def may_hold(self, cells: Tensor, level: float, dtype: torch.dtype) -> Tensor:
        """Which cells (P, 3) may hold a level: the samples of one, widened by the norm of the spline, straddle it."""
        low, high, first = self._bounds()
        x, y, z = (cells - first).long().unbind(-1)
        low, high = low[z, y, x], high[z, y, x]
        middle, half = (low + high) / 2, (high - low) / 2 * float(self.scheme.spline.norm)
        size = torch.maximum(low.abs(), high.abs())
        margin = _ROUNDING * torch.finfo(dtype).eps * size
        return ~((middle - half > level + margin) | (middle + half < level - margin))  # NaN is never left out

    def _bounds(self) -> Bounds:
        """Kept for as long as the field has these coefficients and they are not written to."""
        values = self.coefficients.values
        if values.is_inference():  # it does not count how often it is written to
            return self._made_bounds()
        if self._kept is None or self._kept[0] != values._version:
            self._kept = values._version, self._made_bounds()
        return self._kept[1]

    def _made_bounds(self) -> Bounds:
        spline = self.scheme.spline
        reach = [int(spline.shift + s * max(abs(c) for o in spline.samples for c in o)) for s in (-1, 1)]
        first, window = -spline.period, reach[1] - reach[0] + 1
        every = self.samples_between(first + reach[0], [n + spline.period + reach[1] for n in self.coefficients.size])
        return -largest_of_windows(-every, window), largest_of_windows(every, window), first

    def samples_between(self, first: int, last: list[int]) -> Tensor:
        """(D, H, W) float64, the samples from `first` to `last` along x, y, z, under the boundary."""
        folding, flat = self.evaluated.folding, self.coefficients.values.detach().reshape(-1)
        x, y, z = (
            folding.lookup[int(zero) + first : int(zero) + n + 1] for zero, n in zip(folding.zero, last, strict=True)
        )
        index = z[:, None, None] + y[:, None] + x
        return self._decoded_samples(flat[index], torch.float64)

    def relevant(self, level: float) -> Relevant:
        """Cells whose centres lie in the domain, and tetrahedra of them."""
        cells, total = 0, 0
        for part, pieces in self._holding(level):
            held = torch.zeros(len(part), dtype=torch.bool, device=part.device)
            for number, _ in pieces:
                held[number] = True
                total += len(number)
            cells += int(held.sum())
        return Relevant(cells, total)

    def relevant_tetrahedra(self, level: float) -> TetrahedralPieces:
        """Those that `relevant` counts, in the world. They have no derivatives.

        Raises as `relevant` does.
        """
        spline, corners, coefficients = self.scheme.spline, [], []
        for cells, pieces in self._holding(level):
            for (number, rows), (shape, turn) in zip(pieces, spline.tetrahedra, strict=True):
                vertices = [[float(c) for c in turn(v)] for v in spline.shapes[shape].vertices]
                middle = cells[number] + float(spline.shift)
                corners.append(middle[:, None] + middle.new_tensor(vertices))
                coefficients.append(rows)
        none = self.coefficients.values.new_zeros(0, dtype=torch.float64)
        every = torch.cat([none.reshape(0, 4, 3), *corners])
        rows = torch.cat([none.reshape(0, len(bernstein.multi_indices(spline.degree, 3))), *coefficients])
        return TetrahedralPieces(self.domain.geometry.to_world(every), rows)

    def _holding(self, level: float) -> Iterator[tuple[Tensor, list[tuple[Tensor, Tensor]]]]:
        """Parts of the cells (P, 3) that may hold a level; for each tetrahedron of a cell which of them do (H,), and
        its coefficients there (H, B)."""
        self._check_pieces()
        spline, device = self.scheme.spline, self.coefficients.values.device
        axes = [torch.arange(n, dtype=torch.float64, device=device) for n in self.coefficients.size]
        cells = torch.stack(torch.meshgrid(*axes, indexing="ij"), -1).reshape(-1, 3)
        if spline.period == 2:  # of one octahedron for every four voxels
            cells = cells[(cells % 2 == cells[:, :1] % 2).all(-1)]
        cells = cells[self.may_hold(cells, level, torch.float64)]
        for part in cells.split(CHUNK):
            every = (self._bernstein(_placed(part, *which), torch.float64) for which in spline.tetrahedra)
            yield part, [_straddling(rows, level) for rows in every]


def _straddling(rows: Tensor, level: float) -> tuple[Tensor, Tensor]:
    """Numbers of the rows (P, B) that a level is between the numbers of, and these rows."""
    low, high = bernstein.bounds(rows)
    (number,) = ((low <= level) & (level <= high)).nonzero(as_tuple=True)
    return number, rows[number]


def _placed(cells: Tensor, shape: int, turn: Turn) -> Located:
    """One tetrahedron of every cell (P, 3); without barycentric coordinates."""
    count = len(cells)

    def everywhere(row: Sequence[int], dtype: torch.dtype) -> Tensor:
        return torch.tensor(row, dtype=dtype, device=cells.device)[:, None].expand(3, count)

    return Located(
        cells.long().T,
        everywhere([turn.ranks.index(axis) for axis in range(3)], torch.int64),
        everywhere(turn.ranks, torch.int64),
        everywhere(turn.signs, torch.float64),
        torch.full((count,), shape, device=cells.device),
        cells.new_empty(0),
    )


def _cut(line: Tensor, near: Tensor, far: Tensor, events: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Pieces of lines (P), cut at events (P, K) that lie in them: (line, near, far) of those of any length."""
    inner = torch.minimum(torch.maximum(events, near[:, None]), far[:, None]).sort(1)[0]
    ends = torch.cat((near[:, None], inner, far[:, None]), 1)
    a, b = ends[:, :-1], ends[:, 1:]
    some = b > a
    some[:, 0] |= far == near  # of a line that touches the domain
    return line[:, None].expand_as(a)[some], a[some], b[some]
