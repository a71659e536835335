"""jet and splat in plain torch: any device, dtype and order. The other implementations are tested against this one.

Letters: N batch, C channels, M points; x, y, z along W, H, D; S taps per axis; u ∈ [0, 1) the local coordinate; m the
order of a derivative. A jet's rows are the multi-indices (m_x, m_y, m_z), m_x + m_y + m_z ≤ order, graded:
(0,0,0); (1,0,0) (0,1,0) (0,0,1); (2,0,0) (1,1,0) (1,0,1) (0,2,0) (0,1,1) (0,0,2); …
"""

from __future__ import annotations

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


def locate(x: Tensor, support: int, size: int) -> tuple[Tensor, Tensor]:
    """First tap (int64, always inside 0 … size − support) and local coordinate u of each x, in stored coordinates.

    NaN gives tap 0 and u = NaN: nothing is read out of bounds and the result is NaN.
    """
    shifted = x - (support / 2 - 1)
    base = torch.nan_to_num(shifted.floor(), nan=0.0).clamp(0, size - support)
    return base.long(), shifted - base


def tap_weights(u: Tensor, kernel: PiecewisePolynomial, order: int) -> list[list[Tensor]]:
    """weights[m][t]: the m-th derivative of the weight of tap t, each of the shape of u."""
    taps = kernel.taps(u.dtype, u.device)
    return [[horner(row.unbind(0), u) for row in differentiate(taps, m).unbind(0)] for m in range(order + 1)]


class _Stencil:
    """Where a chunk of points reads, and with which weights."""

    def __init__(
        self, points: Tensor, kernels: Sequence[PiecewisePolynomial], order: int, shape: Sequence[int]
    ) -> None:
        self.supports = [k.support for k in kernels]
        self.strides = (1, shape[-1], shape[-1] * shape[-2])
        located = [
            locate(x, s, n) for x, s, n in zip(points.unbind(-1), self.supports, tuple(shape)[:-4:-1], strict=True)
        ]
        (x, _), (y, _), (z, _) = located
        self.first: Tensor = x + y * self.strides[1] + z * self.strides[2]
        self.wx, self.wy, self.wz = (tap_weights(u, k, order) for (_, u), k in zip(located, kernels, strict=True))

    def rows(self) -> Iterator[tuple[int, list[tuple[int, list[Tensor]]]]]:
        """For each tap z: its taps y, each with the flat indices of its row of taps x."""
        for z in range(self.supports[2]):
            start = self.first + z * self.strides[2]
            yield (
                z,
                [
                    (y, [start + (y * self.strides[1] + x) for x in range(self.supports[0])])
                    for y in range(self.supports[1])
                ],
            )


def _chunks(coefficient_shape: Sequence[int], points: Tensor) -> Iterator[tuple[slice, Tensor, Tensor | int]]:
    """Chunks of the flattened points (N·M, 3) with the flat offset of the batch entry each belongs to."""
    n, m = points.shape[:2]
    flat = points.reshape(n * m, 3)
    volume = coefficient_shape[-1] * coefficient_shape[-2] * coefficient_shape[-3]
    for start in range(0, n * m, CHUNK):
        part = slice(start, min(start + CHUNK, n * m))
        offset = 0 if n == 1 else torch.arange(part.start, part.stop, device=points.device) // m * volume
        yield part, flat[part], offset


def jet(coefficients: Tensor, points: Tensor, kernels: Sequence[PiecewisePolynomial], order: int) -> Tensor:
    """Partial derivatives of Σ_k c_k φ_x(x−k_x) φ_y(y−k_y) φ_z(z−k_z) up to `order`.

    Args:
        coefficients: (N, C, D, H, W), any real dtype; each axis at least as long as its kernel's support.
        points: (N, M, 3), x, y, z in stored coordinates (coefficient 0 lies at 0); float32 or float64.
        kernels: one per axis x, y, z.

    Returns:
        (N, C, J, M) in the dtype of the points, J = len(multi_indices(order)).
    """
    n, c = coefficients.shape[:2]
    rows = multi_indices(order)
    flat = coefficients.transpose(0, 1).reshape(c, -1)
    parts = []
    for _, chunk, offset in _chunks(coefficients.shape, points):
        stencil = _Stencil(chunk, kernels, order, coefficients.shape)
        parts.append(_contract(flat, stencil, offset, order, chunk.dtype))
    if not parts:
        return points.new_zeros((n, c, len(rows), points.shape[1]))
    out = torch.cat(parts, -1)  # (J, C, N·M)
    return out.reshape(len(rows), c, n, points.shape[1]).permute(2, 1, 0, 3)


def _contract(flat: Tensor, stencil: _Stencil, offset: Tensor | int, order: int, dtype: torch.dtype) -> Tensor:
    """(J, C, M): taps summed along x, then y, then z (order + 1 sums along x serve every derivative in y and z)."""
    jets: dict[MultiIndex, Tensor] = {}
    for z, taps_y in stencil.rows():
        planes: dict[tuple[int, int], Tensor] = {}
        for y, indices in taps_y:
            values = [flat.index_select(1, index + offset).to(dtype) for index in indices]
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
    cotangents: Tensor, points: Tensor, kernels: Sequence[PiecewisePolynomial], order: int, shape: Sequence[int]
) -> Tensor:
    """The transpose of `jet`: Σ over points and rows of cotangent · weight, scattered into a coefficient array.

    Args:
        cotangents: (N, C, J, M), as `jet` returns.
        points, kernels, order: as for `jet`.
        shape: (D, H, W) of the result.

    Returns:
        (N, C, D, H, W) in the dtype of the points.
    """
    n, c = cotangents.shape[:2]
    full = (n, c, *shape)
    out = points.new_zeros((c, n * shape[0] * shape[1] * shape[2]))
    flat = cotangents.permute(2, 1, 0, 3).reshape(cotangents.shape[2], c, -1)  # (J, C, N·M)
    for part, chunk, offset in _chunks(full, points):
        stencil = _Stencil(chunk, kernels, order, full)
        jets = dict(zip(multi_indices(order), flat[..., part].to(points.dtype), strict=True))
        _scatter(out, jets, stencil, offset, order)
    return out.reshape(c, n, *shape).transpose(0, 1)


def _scatter(out: Tensor, jets: dict[MultiIndex, Tensor], stencil: _Stencil, offset: Tensor | int, order: int) -> None:
    """The three sums of `_contract` run backwards, in place on `out` (C, N·V)."""
    for z, taps_y in stencil.rows():
        planes: dict[tuple[int, int], Tensor] = {}
        for (mx, my, mz), cotangent in jets.items():
            _accumulate(planes, (mx, my), stencil.wz[mz][z], cotangent)
        for y, indices in taps_y:
            lines: dict[tuple[int], Tensor] = {}
            for (mx, my), plane in planes.items():
                _accumulate(lines, (mx,), stencil.wy[my][y], plane)
            for x, index in enumerate(indices):
                value = _dot([stencil.wx[mx][x] for mx in range(order + 1)], [lines[mx,] for mx in range(order + 1)])
                out.index_add_(1, index + offset, value)
