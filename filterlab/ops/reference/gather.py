"""gather and scatter in plain torch: any device, dtype and stencil. The other implementations are tested against it.

Letters: N batch, C channels, M points, J rows; x, y, z along W, H, D; S taps per axis; u ∈ [0, 1) the local coordinate;
a, b, c weight functions along x, y, z (a kernel and the order of its derivative).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import groupby
from operator import itemgetter

import torch
from torch import Tensor

from filterlab.kernels import PiecewisePolynomial, differentiate, horner
from filterlab.ops.reference import tetrahedra
from filterlab.ops.stencil import Product, Stencil
from filterlab.ops.tetrahedra import AnyStencil, TetrahedralStencil

CHUNK = 1 << 15  # points at a time: temporaries stay in cache and memory does not grow with M
CHUNK_OF_GPU = 1 << 21  # enough for all of its cores


def locate(x: Tensor, support: int, size: int, start: int) -> tuple[Tensor, Tensor]:
    """First tap (int64, always inside 0 … size − support) and local coordinate u of each x.

    `start` is an integer so that it is never added to a coordinate: a float32 x keeps all its digits in u. NaN gives
    a tap inside and u = NaN: nothing is read out of bounds and the result is NaN.
    """
    shifted = x - (support / 2 - 1)
    base = torch.nan_to_num(shifted.floor(), nan=float(start)).clamp(start, start + size - support)
    return base.long() - start, shifted - base


Function = tuple[PiecewisePolynomial, int]
"""A weight function: a kernel and the order of its derivative."""

Taps = dict[int, Tensor]
"""The weight of every tap that a function has."""


def tap_weights(u: Tensor, function: Function, support: int) -> Taps:
    """The weights of a kernel's taps, each of the shape of u, numbered as the middle ones of `support` taps."""
    kernel, order = function
    first = (support - kernel.support) // 2
    rows = differentiate(kernel.taps(u.dtype, u.device), order)
    return {first + t: horner(row.unbind(0), u) for t, row in enumerate(rows.unbind(0))}


class _Reads:
    """Where a chunk of points reads, and with which weights.

    Attributes:
        first: flat index of each point's first tap, (M,).
        wx, wy, wz: for every weight function its `Taps`.
    """

    def __init__(
        self, points: Tensor, batch_offset: Tensor | int, stencil: Stencil, shape: Sequence[int], start: int
    ) -> None:
        self.stencil = stencil
        self.strides = (1, shape[-1], shape[-1] * shape[-2])
        located = [
            locate(x, s, n, start)
            for x, s, n in zip(points.unbind(-1), stencil.supports, tuple(shape)[:-4:-1], strict=True)
        ]
        (x, _), (y, _), (z, _) = located
        self.first: Tensor = x + y * self.strides[1] + z * self.strides[2] + batch_offset
        self.wx, self.wy, self.wz = (self._weights(axis, u) for axis, (_, u) in enumerate(located))

    def _weights(self, axis: int, u: Tensor) -> dict[Function, Taps]:
        functions = {(p.kernels[axis], p.orders[axis]): None for row in self.stencil.rows for p in row}
        return {f: tap_weights(u, f, self.stencil.supports[axis]) for f in functions}

    def lines(self) -> Iterator[tuple[int, int, list[tuple[Function, Function]]]]:
        """(z, y, pairs) for every line of taps, with the distinct (a, b) of products that read it."""
        for z in range(self.stencil.supports[2]):
            for y in range(self.stencil.supports[1]):
                pairs = dict.fromkeys(
                    (a, b)
                    for row in self.stencil.rows
                    for _, a, b, c in map(functions_of, row)
                    if y in self.wy[b] and z in self.wz[c]
                )
                if pairs:
                    yield z, y, list(pairs)

    def offset(self, z: int, y: int, x: int) -> int:
        """Flat offset of a tap from the first one."""
        return z * self.strides[2] + y * self.strides[1] + x


def functions_of(product: Product) -> tuple[float, Function, Function, Function]:
    """(weight, a, b, c)."""
    a, b, c = zip(product.kernels, product.orders, strict=True)
    return product.weight, a, b, c


def _chunks(coefficient_shape: Sequence[int], points: Tensor) -> Iterator[tuple[slice, Tensor, Tensor | int]]:
    """Chunks of the flattened points (N·M, 3) with the flat offset of the batch entry each belongs to."""
    n, m = points.shape[:2]
    flat = points.reshape(n * m, 3)
    volume = coefficient_shape[-1] * coefficient_shape[-2] * coefficient_shape[-3]
    size = CHUNK_OF_GPU if points.device.type == "cuda" else CHUNK
    for start in range(0, n * m, size):
        part = slice(start, min(start + size, n * m))
        offset = 0 if n == 1 else torch.arange(part.start, part.stop, device=points.device) // m * volume
        yield part, flat[part], offset


def _read(flat: Tensor, first: Tensor, offset: int) -> Tensor:
    """flat[:, first + offset], (C, M): a shifted view saves index arithmetic; 1-D gathers are twice as fast as 2-D."""
    if flat.shape[0] == 1:
        return flat[0, offset:].index_select(0, first)[None]
    return flat[:, offset:].index_select(1, first)


def _add(out: Tensor, first: Tensor, offset: int, values: Tensor) -> None:
    """out[:, first + offset] += values, in place; the transpose of `_read`."""
    if out.shape[0] == 1:
        out[0, offset:].scatter_add_(0, first, values[0])
    else:
        out[:, offset:].index_add_(1, first, values)


def gather(coefficients: Tensor, points: Tensor, stencil: AnyStencil, start: int = 0) -> Tensor:
    """The rows of a stencil at the points.

    Args:
        coefficients: (N, C, D, H, W), any real dtype; each axis at least as long as the stencil's support.
        points: (N, M, 3), x, y, z; float32 or float64.
        stencil: what is summed.
        start: the coordinate of coefficient 0, the same along every axis.

    Returns:
        (N, C, J, M) in the dtype of the points.
    """
    n, c = coefficients.shape[:2]
    flat = coefficients.transpose(0, 1).reshape(c, n * math.prod(coefficients.shape[2:]))
    parts = []
    for _, chunk, offset in _chunks(coefficients.shape, points):
        if isinstance(stencil, TetrahedralStencil):
            at = tetrahedra.Reads(chunk, stencil, coefficients.shape, start)
            parts.append(tetrahedra.contract(flat, at, offset, chunk.dtype))
        else:
            parts.append(_contract(flat, _Reads(chunk, offset, stencil, coefficients.shape, start), chunk.dtype))
    rows = len(stencil.rows)
    if not parts:
        return points.new_zeros((n, c, rows, points.shape[1]))
    out = torch.cat(parts, -1)  # (J, C, N·M)
    return out.reshape(rows, c, n, points.shape[1]).permute(2, 1, 0, 3)


def _contract(flat: Tensor, at: _Reads, dtype: torch.dtype) -> Tensor:
    """(J, C, M): taps summed along x, then y, then z (the sums along x serve every function along y and z)."""
    rows: dict[int, Tensor] = {}
    for z, lines in groupby(at.lines(), key=itemgetter(0)):
        planes: dict[tuple[Function, Function], Tensor] = {}
        for _, y, pairs in lines:
            functions = dict.fromkeys(a for a, _ in pairs)
            taps = sorted({x for a in functions for x in at.wx[a]})
            values = {x: _read(flat, at.first, at.offset(z, y, x)).to(dtype) for x in taps}
            sums = {a: _dot([(w, values[x]) for x, w in at.wx[a].items()]) for a in functions}
            for a, b in pairs:
                _accumulate(planes, (a, b), at.wy[b][y], sums[a])
        for r, row in enumerate(at.stencil.rows):
            for weight, a, b, c in map(functions_of, row):
                if z in at.wz[c] and (a, b) in planes:
                    _accumulate(rows, r, at.wz[c][z], planes[a, b], weight)
    return torch.stack([rows[r] for r in range(len(at.stencil.rows))])


def _dot(terms: Sequence[tuple[Tensor, Tensor]]) -> Tensor:
    (weight, value), *others = terms
    total = weight * value
    for weight, value in others:
        total = torch.addcmul(total, weight, value)
    return total


def _accumulate(sums: dict, key: object, weight: Tensor, value: Tensor, factor: float = 1.0) -> None:
    """sums[key] += factor · weight · value."""
    if key in sums:
        sums[key] = torch.addcmul(sums[key], weight, value, value=factor)
    else:
        sums[key] = weight * value if factor == 1 else factor * (weight * value)


def scatter(cotangents: Tensor, points: Tensor, stencil: AnyStencil, shape: Sequence[int], start: int = 0) -> Tensor:
    """The transpose of `gather`: Σ over points and rows of cotangent · weight, added up in a coefficient array.

    Args:
        cotangents: (N, C, J, M), as `gather` returns.
        points, stencil, start: as for `gather`.
        shape: (D, H, W) of the result.

    Returns:
        (N, C, D, H, W) in the dtype of the points. A point that is not finite adds nothing.
    """
    n, c = cotangents.shape[:2]
    full = (n, c, *shape)
    out = points.new_zeros((c, n * shape[0] * shape[1] * shape[2]))
    flat = cotangents.permute(2, 1, 0, 3).reshape(cotangents.shape[2], c, n * points.shape[1])  # (J, C, N·M)
    for part, chunk, offset in _chunks(full, points):
        known = chunk.isfinite().all(-1)
        own, chunk = torch.where(known, flat[..., part].to(points.dtype), 0), torch.where(known[:, None], chunk, 0)
        if isinstance(stencil, TetrahedralStencil):
            tetrahedra.spread(out, own, tetrahedra.Reads(chunk, stencil, full, start), offset)
        else:
            _spread(out, own, _Reads(chunk, offset, stencil, full, start))
    return out.reshape(c, n, *shape).transpose(0, 1)


def _spread(out: Tensor, cotangents: Tensor, at: _Reads) -> None:
    """The three sums of `_contract` run backwards, in place on `out` (C, N·V); cotangents (J, C, M)."""
    for z, lines in groupby(at.lines(), key=itemgetter(0)):
        planes: dict[tuple[Function, Function], Tensor] = {}
        for row, cotangent in zip(at.stencil.rows, cotangents, strict=True):
            for weight, a, b, c in map(functions_of, row):
                if z in at.wz[c]:
                    _accumulate(planes, (a, b), at.wz[c][z], cotangent, weight)
        for _, y, pairs in lines:
            sums: dict[Function, Tensor] = {}
            for a, b in pairs:
                _accumulate(sums, a, at.wy[b][y], planes[a, b])
            for x in sorted({x for a in sums for x in at.wx[a]}):
                terms = [(at.wx[a][x], line) for a, line in sums.items() if x in at.wx[a]]
                _add(out, at.first, at.offset(z, y, x), _dot(terms))
