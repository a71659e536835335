"""Splines on tetrahedra held by numbers of their cells that determine them, instead of by samples.

A determining set is a few coefficients of every cell, means of samples; all other coefficients follow by the rules that
join pieces smoothly. Quadratic super splines have one of 20 numbers a cube, cubic C¹ splines one of 56 (`type6.D2`,
`type6.D3`), quadratic C¹ splines the value and gradient at the centres of octahedra, 4 numbers for every 4 samples
(`octahedral.JETS`). A signed permutation of the axes that turns a cell turns its numbers into one another, or into what
they are with the other sign: their masks of samples tell which.

Source: Kalbe and Zeilfelder, Hardware-accelerated, high-quality rendering based on trivariate splines approximating
volume data, 2008: section 5.1, figures 6 and 7.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import cached_property
from typing import Self

import torch
from torch import Tensor

from filterlab.bernstein import Index, multi_indices
from filterlab.fields.tetrahedral import TURNS, Located, Mask, Spline, Turn, Vector, locate, product_of
from filterlab.fields.tetrahedral_pieces import FieldOnTetrahedra

Place = tuple[tuple[int, int, int], int]
"""A cell, relative to another, and which of its numbers."""

_AT_ONCE = 1 << 15  # cells whose numbers are computed together

Rule = Callable[[Tensor, Tensor | None], Tensor]
"""The numbers (K, P) that tetrahedra of the cone need, and their shapes (P,), to Bernstein coefficients (B, P)."""


def moved(mask: Mask, by: Sequence[int]) -> Mask:
    """The same weights of samples elsewhere."""
    return {(x + by[0], y + by[1], z + by[2]): weight for (x, y, z), weight in mask.items()}


@dataclass(frozen=True, eq=False)
class Determining:
    """Numbers of every cell that determine a spline.

    Attributes:
        spline: which.
        masks: of the numbers of one cell.
        needed: K, by the tetrahedra of the cone.
        rule: how coefficients follow from these.
    """

    spline: Spline
    masks: tuple[Mask, ...]
    needed: tuple[Place, ...]
    rule: Rule

    @classmethod
    def of_cell(cls, spline: Spline, masks: Sequence[Mask], rule: Rule) -> Self:
        """Those of one cell determine all that is in it."""
        return cls(spline, tuple(masks), tuple(((0, 0, 0), n) for n in range(len(masks))), rule)

    @classmethod
    def of_rows(
        cls, spline: Spline, masks: Sequence[Mask], rules: Sequence[Mapping[Index, Mapping[Place, Fraction]]]
    ) -> Self:
        """By weights, for every shape and coefficient, of numbers of cells."""
        needed = tuple(sorted({place for rule in rules for row in rule.values() for place in row}))
        distinct: dict[tuple[float, ...], int] = {}
        rows = [
            [
                distinct.setdefault(tuple(float(rule[alpha].get(place, 0)) for place in needed), len(distinct))
                for rule in rules
            ]
            for alpha in multi_indices(spline.degree, 3)
        ]
        matrix, which = torch.tensor(list(distinct), dtype=torch.float64), torch.tensor(rows)

        def weighed(numbers: Tensor, shape: Tensor | None) -> Tensor:
            every = product_of(matrix.to(numbers.device), numbers[None])[0]
            return every.gather(0, which.to(numbers.device)[:, shape])

        return cls(spline, tuple(masks), needed, weighed)

    @cached_property
    def tables(self) -> Turned:
        return Turned.of(self)


@dataclass(frozen=True, eq=False)
class Turned:
    """Where tetrahedra that are turned find what they need, as tensors; the last axis runs over turns by their `code`.

    Attributes:
        steps: (U, 3, 72) to the cells.
        which: (K,), the number of the step to each number's cell.
        number: (K, 72), of its cell's.
        sign: (K, 72), −1 or 1; None where all are 1.
    """

    steps: Tensor
    which: Tensor
    number: Tensor
    sign: Tensor | None

    @classmethod
    def of(cls, given: Determining) -> Turned:
        signed = {_key(mask): (n, 1) for n, mask in enumerate(given.masks)}
        for n, mask in enumerate(given.masks):
            signed.setdefault(_key({o: -w for o, w in mask.items()}), (n, -1))
        cells = sorted({step for step, _ in given.needed})
        steps = torch.zeros(len(cells), 3, 72, dtype=torch.int64)
        number, sign = torch.zeros(2, len(given.needed), 72, dtype=torch.int64)
        for turn in TURNS:
            at = _code(torch.tensor(turn.ranks), torch.tensor(turn.signs))
            steps[..., at] = torch.tensor([turn(step) for step in cells])
            found = [signed[_key(_turned(turn, given.masks[n]))] for _, n in given.needed]
            number[:, at], sign[:, at] = torch.tensor(found).T
        which = torch.tensor([cells.index(step) for step, _ in given.needed])
        return cls(steps, which, number, sign if bool((sign < 0).any()) else None)

    def to(self, device: torch.device) -> Turned:
        sign = None if self.sign is None else self.sign.to(device)
        return Turned(self.steps.to(device), self.which.to(device), self.number.to(device), sign)


def _key(mask: Mask) -> frozenset[tuple[Vector, Fraction]]:
    return frozenset(mask.items())


def _turned(turn: Turn, mask: Mask) -> Mask:
    return {turn(o): weight for o, weight in mask.items()}


def _code(ranks: Tensor, signs: Tensor) -> Tensor:
    """Of 72, for ranks and signs (3, …) of turns."""
    back = (signs < 0).long()
    return 8 * (3 * ranks[0] + ranks[1]) + 4 * back[0] + 2 * back[1] + back[2]


@dataclass(frozen=True, eq=False)
class Held:
    """The numbers of a field's cells.

    Attributes:
        field: what is held. given: what its numbers are.
        numbers: (M, N) of cells.
        lower, extent: the first cell along x, y, z, of all that the domain meets, and how many (of one parity, where
            cells are octahedra).
        place: (G,) int32, of those the number in `numbers`, −1 for none; None: all are held, in order.
    """

    field: FieldOnTetrahedra
    given: Determining
    numbers: Tensor
    lower: int
    extent: tuple[int, int, int]
    place: Tensor | None

    @classmethod
    def of(cls, field: FieldOnTetrahedra, given: Determining, dtype: torch.dtype, level: float | None = None) -> Held:
        """Of all cells that the domain meets, or of those that may hold a level.

        Raises ValueError for a batched field, or numbers that are of another spline than the field's.
        """
        if field.channels is not None:
            raise ValueError("numbers are those of one channel: `select` it from this batched field")
        if field.scheme.spline is not given.spline:
            raise ValueError(f"expected a field of {given.spline.name}, which the numbers are of; got {field!r}")
        period, size = given.spline.period, field.coefficients.size
        lower = -period
        x, y, z = ((n + 2 * period + period - 1) // period for n in size)
        cells = _grid((x, y, z), period, field.coefficients.values.device) + lower
        made = cls(field, given, cells.new_empty(0), lower, (x, y, z), None)
        place = None
        if level is not None:
            keep = made._needed_by(cells[field.may_hold(cells, level, torch.float64)])
            place = torch.where(keep, keep.cumsum(0) - 1, -1).int()
            cells = cells[keep]
        return replace(made, numbers=_numbers(field, given, cells, dtype), place=place)

    def _needed_by(self, cells: Tensor) -> Tensor:
        """(G,) whose numbers the tetrahedra of some cells (M, 3) need."""
        keep = torch.zeros(self.given.spline.period * math.prod(self.extent), dtype=torch.bool, device=cells.device)
        steps = self.given.tables.steps.movedim(1, -1).reshape(-1, 3).unique(dim=0).to(cells.device)
        last = self.lower + self.given.spline.period * torch.tensor(self.extent, device=cells.device)
        for step in steps:
            there = cells + step
            keep[self._rows(there[((there >= self.lower) & (there < last)).all(-1)].T)] = True
        return keep

    @property
    def bytes(self) -> tuple[int, int]:
        """Of the numbers, and of where they are."""
        place = 0 if self.place is None else self.place.nbytes
        return self.numbers.nbytes, place

    def coefficients(self, at: Located) -> Tensor:
        """(B, P) Bernstein coefficients of points' tetrahedra. Raises ValueError where a cell of one is not held."""
        tables, n = self.given.tables.to(self.numbers.device), len(self.given.masks)
        code = _code(at.ranks, at.sign)
        rows = torch.stack([self._rows(at.cell + step.index_select(1, code)) for step in tables.steps])
        if self.place is not None and bool((rows < 0).any()):
            lost = int((rows < 0).any(0).sum())
            raise ValueError(
                f"expected points in cells that may hold the level, whose numbers are held; {lost} are not"
            )
        index = rows.index_select(0, tables.which) * n + tables.number.index_select(1, code)
        found = self.numbers.view(-1).index_select(0, index.view(-1)).view(index.shape)
        if tables.sign is not None:
            found = found * tables.sign.to(found).index_select(1, code)
        return self.given.rule(found, at.shape)

    def _rows(self, cells: Tensor) -> Tensor:
        """(P,) of cells (3, P)."""
        x, y, z = cells - self.lower
        (nx, ny, nz), period = self.extent, self.given.spline.period
        row = ((z // period) * ny + y // period) * nx + x // period
        if period == 2:
            row = row + (x & 1) * (nx * ny * nz)
        return row if self.place is None else self.place.index_select(0, row).long()

    def jet(self, points: Tensor, order: int) -> list[Tensor]:
        """Rows (J, P) of derivatives of each order per voxel, at points (P, 3) of the domain in voxel coordinates.

        Raises ValueError for points outside of the domain, and as `coefficients` does.
        """
        domain = self.field.domain
        outside = ((points < points.new_tensor(domain.lower)) | (points > points.new_tensor(domain.upper))).any(-1)
        if bool(outside.any()):
            raise ValueError(f"expected points of the domain, in voxels; {int(outside.sum())} lie outside of it")
        jet = replace(self.field.evaluated, order=order)
        parts = []
        for part in points.split(1 << 13):
            at = locate(self.given.spline, jet.tables, part, self.numbers.dtype)
            parts.append(jet.rows(self.coefficients(at)[None], at))
        return [torch.cat(rows, -1)[0] for rows in zip(*parts, strict=True)]


def _grid(extent: tuple[int, int, int], period: int, device: torch.device) -> Tensor:
    """(G, 3) cells from 0 on: cubes, or octahedra, first those of even numbers."""
    z, y, x = (period * torch.arange(n, device=device) for n in reversed(extent))
    even = torch.stack(torch.meshgrid(z, y, x, indexing="ij")[::-1], -1).reshape(-1, 3)
    return torch.cat([even + parity for parity in range(period)])


def _numbers(field: FieldOnTetrahedra, given: Determining, cells: Tensor, dtype: torch.dtype) -> Tensor:
    """(M, N) of cells (M, 3)."""
    shift = given.spline.shift
    places = sorted({o for mask in given.masks for o in mask})
    weights = torch.tensor([[float(mask.get(o, 0)) for o in places] for mask in given.masks], dtype=torch.float64)
    offsets = torch.tensor([[int(c + shift) for c in o] for o in places], device=cells.device)
    first = int(cells.min() + offsets.min()) if len(cells) else 0
    last = (cells.amax(0) + offsets.amax(0)).tolist() if len(cells) else [0, 0, 0]
    samples = field.samples_between(first, last).to(dtype)
    strides = torch.tensor(samples.stride()[::-1], device=cells.device)
    out, weights = samples.new_empty(len(cells), len(weights)), weights.to(cells.device).T
    for part, own in zip(out.split(_AT_ONCE), cells.split(_AT_ONCE), strict=True):
        index = ((own - first) * strides).sum(-1)[:, None] + (offsets * strides).sum(-1)
        part.copy_(samples.view(-1)[index].double() @ weights)  # in float32 its digits would be others' choice
    return out
