"""contract in plain torch: any device, any transform, derivatives by weights too."""

from __future__ import annotations

import torch
from torch import Tensor

from filterlab.ops.contract import Contraction, Rows


def contract(samples: Tensor, contraction: Contraction, dtype: torch.dtype) -> Tensor:
    """Samples (..., D, H, W) contracted along z, y and x, in a floating type."""
    total = None
    for x, y, z in contraction.terms:
        part = samples.to(dtype)
        for dim, rows in ((-3, z), (-2, y), (-1, x)):
            part = _along(part, dim, rows)
        total = part if total is None else total + part
    assert total is not None
    return total


def _along(values: Tensor, dim: int, rows: Rows) -> Tensor:
    """One axis: the first entries of all rows that have one, then the second ones, …"""
    shape = list(values.shape)
    shape[dim] = rows.count
    total = values.new_zeros(shape)
    for t in range(int(rows.counts.max())):
        own = (rows.counts > t).nonzero()[:, 0]
        entries = rows.starts[own] + t
        weights = rows.weights[entries].to(values).reshape(-1, *(1 for _ in range(-1 - dim)))
        part = weights * values.index_select(dim, rows.places[entries].to(values.device))
        total = total + part if len(own) == rows.count else total.index_add(dim, own.to(values.device), part)
    return total
