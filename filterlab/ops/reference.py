"""jet and splat in plain torch: any device, dtype and order. The other implementations are tested against this one.

Letters: N batch, C channels, M points; x, y, z along W, H, D; S taps per axis; u ∈ [0, 1) the local coordinate; m the
order of a derivative. A jet's rows are the multi-indices (m_x, m_y, m_z), m_x + m_y + m_z ≤ order, graded:
(0,0,0); (1,0,0) (0,1,0) (0,0,1); (2,0,0) (1,1,0) (1,0,1) (0,2,0) (0,1,1) (0,0,2); …
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from functools import lru_cache

import torch
from torch import Tensor

from filterlab.kernels import PiecewisePolynomial, differentiate, horner

CHUNK = 1 << 15  # points at a time: temporaries stay in cache and memory does not grow with M

MultiIndex = tuple[int, int, int]


@lru_cache
def multi_indices(order: int) -> tuple[MultiIndex, ...]:
    """The rows of a jet."""
    return tuple((total - j, j - k, k) for total in range(order + 1) for j in range(total + 1) for k in range(j + 1))


def locate(x: Tensor, support: int, size: int, start: int) -> tuple[Tensor, Tensor]:
    """First tap (int64, always inside 0 … size − support) and local coordinate u of each x.

    `start` is an integer so that it is never added to a coordinate: a float32 x keeps all its digits in u. NaN gives
    a tap inside and u = NaN: nothing is read out of bounds and the result is NaN.
    """
    shifted = x - (support / 2 - 1)
    base = torch.nan_to_num(shifted.floor(), nan=float(start)).clamp(start, start + size - support)
    return base.long() - start, shifted - base


def tap_weights(u: Tensor, kernel: PiecewisePolynomial, order: int) -> list[list[Tensor]]:
    """weights[m][t]: the m-th derivative of the weight of tap t, each of the shape of u."""
    taps = kernel.taps(u.dtype, u.device)
    return [[horner(row.unbind(0), u) for row in differentiate(taps, m).unbind(0)] for m in range(order + 1)]


class _Stencil:
    """Where a chunk of points reads, and with which weights.

    Attributes:
        first: flat index of each point's first tap, (M,).
        supports: taps along x, y, z.
        wx, wy, wz: `tap_weights` along each axis.
    """

    def __init__(
        self,
        points: Tensor,
        batch_offset: Tensor | int,
        kernels: Sequence[PiecewisePolynomial],
        order: int,
        shape: Sequence[int],
        start: int,
    ) -> None:
        self.supports = [k.support for k in kernels]
        self.strides = (1, shape[-1], shape[-1] * shape[-2])
        located = [
            locate(x, s, n, start)
            for x, s, n in zip(points.unbind(-1), self.supports, tuple(shape)[:-4:-1], strict=True)
        ]
        (x, _), (y, _), (z, _) = located
        self.first: Tensor = x + y * self.strides[1] + z * self.strides[2] + batch_offset
        self.wx, self.wy, self.wz = (tap_weights(u, k, order) for (_, u), k in zip(located, kernels, strict=True))

    def row(self, z: int, y: int) -> range:
        """Flat offsets, from the first tap, of the taps along x in row (z, y)."""
        start = z * self.strides[2] + y * self.strides[1]
        return range(start, start + self.supports[0])


def _chunks(coefficient_shape: Sequence[int], points: Tensor) -> Iterator[tuple[slice, Tensor, Tensor | int]]:
    """Chunks of the flattened points (N·M, 3) with the flat offset of the batch entry each belongs to."""
    n, m = points.shape[:2]
    flat = points.reshape(n * m, 3)
    volume = coefficient_shape[-1] * coefficient_shape[-2] * coefficient_shape[-3]
    for start in range(0, n * m, CHUNK):
        part = slice(start, min(start + CHUNK, n * m))
        offset = 0 if n == 1 else torch.arange(part.start, part.stop, device=points.device) // m * volume
        yield part, flat[part], offset


def _gather(flat: Tensor, first: Tensor, offset: int) -> Tensor:
    """flat[:, first + offset], (C, M): a shifted view saves index arithmetic; 1-D gathers are twice as fast as 2-D."""
    if flat.shape[0] == 1:
        return flat[0, offset:].index_select(0, first)[None]
    return flat[:, offset:].index_select(1, first)


def _scatter(out: Tensor, first: Tensor, offset: int, values: Tensor) -> None:
    """out[:, first + offset] += values, in place; the transpose of `_gather`."""
    if out.shape[0] == 1:
        out[0, offset:].scatter_add_(0, first, values[0])
    else:
        out[:, offset:].index_add_(1, first, values)


def jet(
    coefficients: Tensor, points: Tensor, kernels: Sequence[PiecewisePolynomial], order: int, start: int = 0
) -> Tensor:
    """Partial derivatives of Σ_k c_k φ_x(x−k_x) φ_y(y−k_y) φ_z(z−k_z) up to `order`.

    Args:
        coefficients: (N, C, D, H, W), any real dtype; each axis at least as long as its kernel's support.
        points: (N, M, 3), x, y, z; float32 or float64.
        kernels: one per axis x, y, z.
        start: the coordinate of coefficient 0, the same along every axis.

    Returns:
        (N, C, J, M) in the dtype of the points, J = len(multi_indices(order)).
    """
    n, c = coefficients.shape[:2]
    rows = multi_indices(order)
    flat = coefficients.transpose(0, 1).reshape(c, n * math.prod(coefficients.shape[2:]))
    parts = []
    for _, chunk, offset in _chunks(coefficients.shape, points):
        stencil = _Stencil(chunk, offset, kernels, order, coefficients.shape, start)
        parts.append(_contract(flat, stencil, order, chunk.dtype))
    if not parts:
        return points.new_zeros((n, c, len(rows), points.shape[1]))
    out = torch.cat(parts, -1)  # (J, C, N·M)
    return out.reshape(len(rows), c, n, points.shape[1]).permute(2, 1, 0, 3)


def _contract(flat: Tensor, stencil: _Stencil, order: int, dtype: torch.dtype) -> Tensor:
    """(J, C, M): taps summed along x, then y, then z (order + 1 sums along x serve every derivative in y and z)."""
    jets: dict[MultiIndex, Tensor] = {}
    for z in range(stencil.supports[2]):
        planes: dict[tuple[int, int], Tensor] = {}
        for y in range(stencil.supports[1]):
            values = [_gather(flat, stencil.first, offset).to(dtype) for offset in stencil.row(z, y)]
            for mx in range(order + 1):
                line = _dot(stencil.wx[mx], values)
                for my in range(order + 1 - mx):
                    _accumulate(planes, (mx, my), stencil.wy[my][y], line)
        for (mx, my), plane in planes.items():
            for mz in range(order + 1 - mx - my):
                _accumulate(jets, (mx, my, mz), stencil.wz[mz][z], plane)
    return torch.stack([jets[m] for m in multi_indices(order)])


def _dot(weights: Sequence[Tensor], values: Sequence[Tensor]) -> Tensor:
    total = weights[0] * values[0]
    for w, v in zip(weights[1:], values[1:], strict=True):
        total = torch.addcmul(total, w, v)
    return total


def _accumulate(sums: dict, key: tuple[int, ...], weight: Tensor, value: Tensor) -> None:
    sums[key] = torch.addcmul(sums[key], weight, value) if key in sums else weight * value


def splat(
    cotangents: Tensor,
    points: Tensor,
    kernels: Sequence[PiecewisePolynomial],
    order: int,
    shape: Sequence[int],
    start: int = 0,
) -> Tensor:
    """The transpose of `jet`: Σ over points and rows of cotangent · weight, scattered into a coefficient array.

    Args:
        cotangents: (N, C, J, M), as `jet` returns.
        points, kernels, order, start: as for `jet`.
        shape: (D, H, W) of the result.

    Returns:
        (N, C, D, H, W) in the dtype of the points.
    """
    n, c = cotangents.shape[:2]
    full = (n, c, *shape)
    out = points.new_zeros((c, n * shape[0] * shape[1] * shape[2]))
    flat = cotangents.permute(2, 1, 0, 3).reshape(cotangents.shape[2], c, n * points.shape[1])  # (J, C, N·M)
    for part, chunk, offset in _chunks(full, points):
        stencil = _Stencil(chunk, offset, kernels, order, full, start)
        jets = dict(zip(multi_indices(order), flat[..., part].to(points.dtype), strict=True))
        _spread(out, jets, stencil, order)
    return out.reshape(c, n, *shape).transpose(0, 1)


def _spread(out: Tensor, jets: dict[MultiIndex, Tensor], stencil: _Stencil, order: int) -> None:
    """The three sums of `_contract` run backwards, in place on `out` (C, N·V)."""
    for z in range(stencil.supports[2]):
        planes: dict[tuple[int, int], Tensor] = {}
        for (mx, my, mz), cotangent in jets.items():
            _accumulate(planes, (mx, my), stencil.wz[mz][z], cotangent)
        for y in range(stencil.supports[1]):
            lines: dict[tuple[int], Tensor] = {}
            for (mx, my), plane in planes.items():
                _accumulate(lines, (mx,), stencil.wy[my][y], plane)
            for x, offset in enumerate(stencil.row(z, y)):
                value = _dot([stencil.wx[mx][x] for mx in range(order + 1)], [lines[mx,] for mx in range(order + 1)])
                _scatter(out, stencil.first, offset, value)
